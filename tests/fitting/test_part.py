"""Parts of shapes: when one is tried, what it costs, and one side of a real body."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.api.inputs import as_model
from meshmatch.api.matcher import Matcher
from meshmatch.errors import OptionError
from meshmatch.fitting import fitter
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import boundary_length
from meshmatch.fitting.judge.features import FitFeatures, compute_features, uncovered_share
from meshmatch.fitting.judge.verdict import Judgement, judge
from meshmatch.fitting.search import candidates
from meshmatch.fitting.search.candidates import SETTINGS
from meshmatch.fitting.search.frames import frames_of_part, frames_to_try
from meshmatch.fitting.search.predictor import Candidate, one_way_residual
from meshmatch.fitting.search.task import FitTask, Registration, take_samples
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.triangles import normalized
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.fitting.eggs import egg_model

pytestmark = pytest.mark.usefixtures("remembered_fits")
MATCHER = Matcher("human")
FEW = FitConfig(copies=16, variants=2, finalists=1, careful=1)
SQUARE = Shape(np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))


def test_the_boundary_by_hand() -> None:
    assert boundary_length(SQUARE) == 8.0
    closed = Shape(SQUARE.verts, np.concatenate([SQUARE.faces, SQUARE.faces[:, ::-1]]))
    assert boundary_length(closed) == 0.0


@pytest.mark.parametrize(("gap", "length"), [(0.1, 0.0), (1.0, 16.0)])
def test_a_boundary_against_another_part_is_no_cut(gap: float, length: float) -> None:
    verts = np.concatenate([SQUARE.verts, SQUARE.verts + np.array([0, 0, gap])])
    assert boundary_length(Shape(verts, np.concatenate([SQUARE.faces, SQUARE.faces + 4]))) == length


def test_a_smaller_share_costs_more() -> None:
    costs = [Candidate(RigidPose.identity(), np.zeros((1, 3)), 0.02, share).cost for share in SETTINGS.shares]
    assert costs[0] == 0.02
    assert all(more > less for less, more in pairwise(costs))


def test_partial_must_be_a_known_word() -> None:
    with pytest.raises(OptionError, match="partial cannot be 'maybe'"):
        FitConfig(partial="maybe")  # type: ignore[arg-type]


def test_what_is_not_visible_is_not_held_against_a_part() -> None:
    system = node_system(egg_model())
    samples = sample_surface(Shape(system.verts, system.faces), 3000, np.random.default_rng(0))
    half = samples.points[:, 1] > 0
    scan, still = OrientedPoints(samples.points[half], samples.normals[half]), np.zeros((system.K, 3))
    assert 0.3 < uncovered_share(scan, system.verts) < 0.6
    assert judge(compute_features(system, still, scan, 0.02, egg_model().template.labels)).verdict == "poor"
    features = compute_features(system, still, scan, 0.02, egg_model().template.labels, partial=True)
    judged = judge(replace(features, hidden=0.5))
    assert judged.verdict == "fair"
    assert judged.reasons == ("fitted as a part: 50 % of the template has no counterpart",)
    assert (
        judge(compute_features(system, still, scan, 0.05, egg_model().template.labels, partial=True)).verdict == "poor"
    )
    whole = OrientedPoints(samples.points, samples.normals)
    assert one_way_residual(system, scan, still) == pytest.approx(one_way_residual(system, whole, still), rel=0.1)


def side_of(body: Shape, direction: np.ndarray) -> tuple[Shape, np.ndarray]:
    """The faces that look one way, as a mesh of their own, and which vertices it kept."""
    faces = body.faces[normalized(body.face_vectors) @ direction > 0]
    used = np.unique(faces)
    return Shape(body.verts[used], np.searchsorted(used, faces), "side"), used


@pytest.fixture(scope="module")
def dancer() -> Shape:
    return load_shape(bundled_folder() / "samples" / "dancer.ply")


@pytest.fixture(scope="module")
def whole(dancer: Shape, remembered_fits: Callable) -> Fit:
    """The fit of all of the dancer."""
    return MATCHER.fit(dancer)


@pytest.mark.slow
def test_one_side_of_a_body_is_found_to_be_a_part_and_matches_the_whole(dancer: Shape, whole: Fit) -> None:
    side, used = side_of(dancer, np.array([0.3, 0.1, 1.0]))
    found_part = MATCHER.fit(side, FEW)
    assert (whole.partial, found_part.partial) == (False, True)
    assert found_part.verdict != "good"
    assert "part" in {reason.code for reason in found_part.reasons}
    found = MATCHER.map(found_part, whole).index
    apart = np.linalg.norm(dancer.verts[found] - dancer.verts[used], axis=1)  # centimetres
    assert apart.mean() < 5
    never = MATCHER.fit(side, replace(FEW, partial="no"))
    assert not never.partial
    alone = MATCHER.map(never, whole, agree=False).index
    assert apart.mean() < np.linalg.norm(dancer.verts[alone] - dancer.verts[used], axis=1).mean()


@pytest.mark.parametrize("part", [False, True])
def test_what_is_said_to_be_a_part_is_tried_as_a_whole_with_little_effort(
    monkeypatch: pytest.MonkeyPatch, dancer: Shape, part: bool
) -> None:
    """In full only where it is none: a whole gets the fit that it has when nothing is said."""
    tried: list[int] = []
    fit_whole = fitter.fit_whole

    def counted(task: FitTask) -> Registration:
        tried.append(task.config.finalists)
        return fit_whole(task)

    def fitted(said: str) -> Fit:
        return fitter.Fitter(as_model("human"), replace(FEW, finalists=3, seed=int(part), partial=said)).fit(
            repair(dancer).shape
        )

    usual = fitted("no")
    monkeypatch.setattr(fitter, "fit_whole", counted)
    monkeypatch.setattr(fitter, "_part_is_plausible", lambda whole: part)
    monkeypatch.setattr(fitter, "_as_part_if_better", lambda whole: (whole, True))
    found = fitted("yes")
    assert found.partial == part
    assert tried == ([1] if part else [1, 3])
    assert part or np.array_equal(found.points, usual.points)


@pytest.mark.parametrize(
    ("border", "bare", "harder", "tried"),
    [(0.5, 0.0, False, False), (0.5, 0.0, True, True), (0.5, 0.1, False, True), (1.2, 0.0, False, True)],
)
def test_a_character_of_open_parts_is_tried_as_a_part_of_a_body_only_in_a_long_search(
    monkeypatch: pytest.MonkeyPatch, dancer: Shape, border: float, bare: float, harder: bool, tried: bool
) -> None:
    """Unless the fit of the whole leaves template bare, or the border is longer than such parts have."""
    monkeypatch.setattr(fitter, "boundary_length", lambda shape: border * np.sqrt(shape.area))
    monkeypatch.setattr(fitter, "uncovered_share", lambda *_: bare)
    task = SimpleNamespace(config=FitConfig(try_harder=harder), shape=dancer)
    whole = SimpleNamespace(
        task=task, candidate=SimpleNamespace(residual=0.05), local=None, surface=SimpleNamespace(points=0)
    )
    assert fitter._part_is_plausible(whole) is tried  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_whole_stays_a_whole_where_parts_are_tried() -> None:
    climber = load_shape(bundled_folder() / "samples" / "climber.ply")
    assert not MATCHER.fit(climber, replace(FEW, partial="yes")).partial


@pytest.mark.parametrize("wide_is_better", [True, False])
def test_a_poor_part_is_searched_again_from_more_sides_and_the_better_fit_kept(
    monkeypatch: pytest.MonkeyPatch, wide_is_better: bool
) -> None:
    model = egg_model()
    open_egg, _ = side_of(model.template.shape, np.array([0.0, 1.0, 0.0]))
    task = FitTask.of(model, FitConfig(samples=400, variants=1, refine="none"), open_egg)
    far, near = (RigidPose(np.eye(3), np.array([away, 0.0, 0.0])) for away in (5.0, 0.0))
    asked: set[tuple[int, int, bool]] = set()
    patient = replace(candidates.SETTINGS, max_narrow_residual=np.inf)

    def frames(
        model: TrainedModel, samples: OrientedPoints, config: FitConfig, wide: bool, upright: bool
    ) -> tuple[list[RigidPose], list[RigidPose]]:
        asked.add((config.copies, config.hypotheses, wide))
        return [near if wide == wide_is_better else far], []

    found = {}
    monkeypatch.setattr(candidates, "frames_of_part", frames)
    for verdict in ("fair", "poor"):
        monkeypatch.setattr(candidates, "SETTINGS", patient)
        monkeypatch.setattr(
            fitter,
            "judge_registration",
            lambda found, partial, verdict=verdict: Judgement(verdict, (), FitFeatures(residual=0.02)),
        )
        asked.clear()
        best = fitter._best_part(task, thorough=True)
        assert best is not None
        found[verdict] = best.candidate.cost
        assert asked == ({(48, 2, False)} if verdict == "fair" else {(48, 2, False), (96, 4, True)})
    assert found["poor"] <= found["fair"]
    assert (found["poor"] < found["fair"]) or not wide_is_better
    # where nothing is near, the wide search begins before anything is refined
    monkeypatch.setattr(candidates, "SETTINGS", replace(patient, max_narrow_residual=0.0))
    assert fitter.fit_part(task) is None
    wide = fitter.fit_part(task, wide=True)
    best = fitter._best_part(task, thorough=True)
    assert wide is not None and best is not None and best.candidate.cost == wide.candidate.cost
    asked.clear()
    assert fitter._best_part(task, thorough=False) is None
    assert asked == {(48, 2, False)}


def test_frames_of_a_part_are_tried_along_the_body(dancer: Shape) -> None:
    model = as_model("human")
    scan = take_samples(dancer, 2048, np.random.default_rng(0))[1]
    plain = FitConfig(copies=4, hypotheses=1)
    likely, others = frames_of_part(model, scan, plain, wide=False)
    assert len(likely) == len(frames_to_try(model, scan, plain)) and not others
    likely, others = frames_of_part(model, scan, plain, wide=True)
    assert not likely and len(others) == 6 * 8 * 4  # the votes were tried before
    assert len({tuple(frame.rotation.round(6).ravel()) for frame in others}) == 6 * 8
    for given, turns in (({"up": "y"}, 12), ({"up": "z", "front": "-y"}, 1)):
        found = frames_of_part(model, scan, replace(plain, **given), wide=False)[1]
        assert len(found) == 4 * turns
        assert all(frame.rotation["xyz".index(given["up"]), 1] == pytest.approx(1) for frame in found)
        along = {round(float(frame.center @ frame.rotation[:, 1]), 6) for frame in found}
        assert along == {-0.3, -0.15, 0.0, 0.15}
        assert all(np.linalg.norm(np.cross(f.center, f.rotation[:, 1])) < 1e-9 for f in found)
    placed = replace(model, card=replace(model.card, frame={"orientation": "none", "scale": "area"}))
    likely, others = frames_of_part(placed, scan, plain, wide=True)
    assert len(likely) == 1 and not others


@pytest.mark.parametrize("parts", [1, 2, 3, 40, 129])
def test_boundaries_against_another_part_do_not_count(parts: int) -> None:
    """What all distances between the parts say, for any number of them."""
    rng = np.random.default_rng(parts)
    corners = rng.random((parts, 1, 3)) * parts**0.5 + 0.5 * rng.standard_normal((parts, 3, 3))
    shape = Shape(corners.reshape(-1, 3), np.arange(3 * parts).reshape(-1, 3))
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    points = np.concatenate([corners, middles], axis=1)
    apart = np.linalg.norm(middles[:, :, None, None] - points, axis=-1)  # part edge part point
    apart[np.arange(parts), :, np.arange(parts)] = np.inf
    free = apart.min((2, 3)) > 0.06 * np.sqrt(shape.area)
    lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1)
    assert boundary_length(shape) == pytest.approx(lengths[free].sum())
    assert free.any() and (parts < 40 or not free.all())
