"""Parts of shapes: when one is tried, what it costs, and one side of a real body."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from meshmatch.errors import OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fit_shape import _part, _sought, boundary_length, fit_shape, node_system, take_samples
from meshmatch.fitting.initial_frames import frames_of_part, frames_to_try
from meshmatch.fitting.network_fit import Candidate, one_way_residual
from meshmatch.fitting.part import SHARES, cost
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.verdict import empty_share, judge
from meshmatch.geometry.frames import Frame
from meshmatch.models.trained import TrainedModel
from meshmatch.pipeline import map_between, read_model
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.fitting.eggs import egg_model

SQUARE = Shape(np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


def test_the_boundary_by_hand() -> None:
    assert boundary_length(SQUARE) == 8.0
    closed = Shape(SQUARE.verts, np.concatenate([SQUARE.faces, SQUARE.faces[:, ::-1]]))
    assert boundary_length(closed) == 0.0


def test_a_smaller_share_costs_more() -> None:
    costs = [cost(0.02, share) for share in SHARES]
    assert costs[0] == 0.02
    assert costs == sorted(costs)


def test_partial_must_be_a_known_word() -> None:
    with pytest.raises(OptionError, match="partial cannot be 'maybe'"):
        FitConfig(partial="maybe")  # type: ignore[arg-type]


def test_what_is_not_seen_is_not_held_against_a_part() -> None:
    system = node_system(egg_model())
    samples = sample_surface(Shape(system.verts, system.faces), 3000, np.random.default_rng(0))
    half = samples.points[:, 1] > 0
    scan, still = Scan(samples.points[half], samples.normals[half]), np.zeros((system.K, 3))
    assert 0.3 < empty_share(scan, system.verts) < 0.6
    assert judge(0.02, scan, system.verts)[0] == "poor"
    verdict, reasons = judge(0.02, scan, system.verts, partial=True)
    assert verdict == "fair"
    assert "taken for a part" in reasons[0]
    assert judge(0.05, scan, system.verts, partial=True)[0] == "poor"
    whole = Scan(samples.points, samples.normals)
    assert one_way_residual(system, scan, still) == pytest.approx(
        one_way_residual(system, whole, still), rel=0.1
    )


def side_of(body: Shape, direction: np.ndarray) -> tuple[Shape, np.ndarray]:
    """The faces that look one way, as a mesh of their own, and which vertices it kept."""
    faces = body.faces[body.face_normals @ direction > 0]
    used = np.unique(faces)
    return Shape(body.verts[used], np.searchsorted(used, faces), "side"), used


def test_one_side_of_a_body_is_found_to_be_a_part_and_matches_the_whole() -> None:
    dancer = load_shape(bundled_folder() / "samples" / "dancer.ply")
    side, used = side_of(dancer, np.array([0.3, 0.1, 1.0]))
    model = read_model("human")
    whole, part = fit_shape(model, dancer), fit_shape(model, side)
    assert (whole.partial, part.partial) == (False, True)
    assert part.verdict != "good"
    found = map_between(side, part, dancer, whole, model="human").index
    apart = np.linalg.norm(dancer.verts[found] - dancer.verts[used], axis=1)  # centimetres
    assert apart.mean() < 5
    never = fit_shape(model, side, FitConfig(partial="no"))
    assert not never.partial
    alone = map_between(side, never, dancer, whole).index
    assert apart.mean() < np.linalg.norm(dancer.verts[alone] - dancer.verts[used], axis=1).mean()


def test_a_whole_stays_a_whole_where_parts_are_tried() -> None:
    climber = load_shape(bundled_folder() / "samples" / "climber.ply")
    assert not fit_shape(read_model("human"), climber, FitConfig(partial="yes")).partial


@pytest.mark.parametrize("residuals", [(0.01, 0.0), (0.08, 0.01), (0.06, 0.08)])
def test_a_poor_part_is_looked_at_again_from_more_sides_and_the_better_fit_kept(
    monkeypatch: pytest.MonkeyPatch, residuals: tuple[float, float]
) -> None:
    model = egg_model()
    open_egg, _ = side_of(model.template.shape, np.array([0.0, 1.0, 0.0]))
    asked: list[tuple[int, int, bool]] = []

    def seek(
        model: TrainedModel, frame: Frame, scan: Scan, config: FitConfig, wide: bool, tell: object
    ) -> tuple[Frame, Scan, Candidate]:
        asked.append((config.copies, config.hypotheses, wide))
        still = np.zeros((model.template.K, 3))
        return frame, scan, Candidate(np.eye(3), np.zeros(3), still, residuals[len(asked) - 1])

    monkeypatch.setattr("meshmatch.fitting.fit_shape._sought", seek)
    frame, scan = take_samples(open_egg, 500, np.random.default_rng(0), Frame.identity())
    found = _part(model, open_egg, frame, scan, FitConfig(), print)
    once, again = (48, 2, False), (96, 8, True)
    assert asked == ([once] if residuals[0] == 0.01 else [once, again])
    assert found[2].residual == min(residuals[: len(asked)])


def test_frames_of_a_part_are_tried_along_the_body() -> None:
    model = read_model("human")
    bust = load_shape(bundled_folder() / "samples" / "dancer.ply")
    scan = take_samples(bust, 2048, np.random.default_rng(0))[1]
    plain = FitConfig(copies=4, hypotheses=1)
    few = frames_of_part(model, scan, plain, wide=False)
    assert len(few) == len(frames_to_try(model, scan, plain))
    many = frames_of_part(model, scan, plain, wide=True)
    assert len(many) == len(few) + 6 * 8 * 4
    turned = {tuple(frame.rotation.round(6).ravel()) for frame in many[len(few) :]}
    assert len(turned) == 6 * 8
    for given, turns in (({"up": "y"}, 12), ({"up": "z", "front": "-y"}, 1)):
        config = replace(plain, **given)
        own = len(frames_to_try(model, scan, config))
        found = frames_of_part(model, scan, config, wide=False)[own:]
        assert len(found) == 4 * turns
        assert all(frame.rotation["xyz".index(given["up"]), 1] == pytest.approx(1) for frame in found)
        along = {round(float(frame.center @ frame.rotation[:, 1]), 6) for frame in found}
        assert along == {-0.3, -0.15, 0.0, 0.15}
        assert all(np.linalg.norm(np.cross(f.center, f.rotation[:, 1])) < 1e-9 for f in found)
    placed = replace(model, card=replace(model.card, frame={"orientation": "none", "scale": "area"}))
    assert len(frames_of_part(placed, scan, plain, wide=True)) == 1


def test_a_bust_is_found_where_its_up_is_told() -> None:
    """Of a third of a body the network alone does not know which way is up."""
    dancer = load_shape(bundled_folder() / "samples" / "dancer.ply")
    height = dancer.verts[dancer.faces].mean(1)[:, 1]
    faces = dancer.faces[height > np.median(height)]
    used = np.unique(faces)
    bust = Shape(dancer.verts[used], np.searchsorted(used, faces), "bust")
    model = read_model("human")
    whole, part = fit_shape(model, dancer), fit_shape(model, bust, FitConfig(up="y", front="z"))
    assert part.partial and part.verdict == "fair"
    found = map_between(bust, part, dancer, whole, model="human").index
    assert np.linalg.norm(dancer.verts[found] - dancer.verts[used], axis=1).mean() < 4  # centimetres


def test_a_wide_search_lays_more_frames_with_care(monkeypatch: pytest.MonkeyPatch) -> None:
    model, laid, tried = read_model("human"), [], []

    def search(
        model: TrainedModel,
        system: object,
        scan: Scan,
        orient: Callable[[Scan], list],
        *rest: object,
        **how: int,
    ) -> tuple[float, Scan, Candidate]:
        laid.append(how["laid"])
        tried.append(len(orient(scan)))
        return 1.0, scan, Candidate(np.eye(3), np.zeros(3), np.zeros((model.template.K, 3)), 0.0)

    monkeypatch.setattr("meshmatch.fitting.fit_shape.fit_part", search)
    frame, scan = take_samples(model.template.shape, 2048, np.random.default_rng(0))
    for wide in (False, True):
        _sought(model, frame, scan, FitConfig(copies=4, hypotheses=1), wide, print)
    assert laid == [6, 16]
    assert tried[1] == tried[0] + 6 * 8 * 4
