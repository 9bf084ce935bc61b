"""A part thicker than any of an ordinary body is read as if it were smaller."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh

from meshmatch.api.inputs import as_model
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search import thick_parts
from meshmatch.fitting.search.predictor import Candidate
from meshmatch.fitting.search.task import FitTask, Registration
from meshmatch.fitting.search.thick_parts import Contraction, largest_ball, with_thick_part_smaller
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import RigidPose
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import scan_of


@pytest.fixture(scope="module")
def human() -> TrainedModel:
    return as_model("human")


def cartoon(human: TrainedModel) -> Shape:
    """The resting template with a head four times as large, and short legs."""
    template = human.template
    verts, names = template.shape.verts.copy(), np.array(template.label_names)[template.labels]
    head = names == "head"
    neck, hips = (verts[names == name][:, 1].min() for name in ("head", "hips"))
    leg = np.isin(names, [f"{side} {part}" for side in ("left", "right") for part in ("thigh", "shin", "foot")])
    verts[leg, 1] = hips + 0.4 * (verts[leg, 1] - hips)
    share = np.clip((verts[:, 1] - neck) / 0.05, 0, 1)[:, None] * (np.abs(verts[:, :1]) < 0.15)
    below = np.array([0.0, neck, verts[head][:, 2].mean()])
    return Shape(verts + share * 3 * (verts - below), template.shape.faces, "cartoon")


def still(human: TrainedModel) -> np.ndarray:
    return np.zeros((node_system(human).K, 3))


class Unrefined:
    """Takes interpretations as they are."""

    def __init__(self, task: FitTask, candidates: list[Candidate]) -> None:
        pass

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        return candidate

    def score(self, candidate: Candidate, in_full: bool) -> float:
        return candidate.residual


def test_a_contraction_is_undone() -> None:
    points = np.random.default_rng(0).normal(size=(500, 3))
    contraction = Contraction(np.array([0.2, 0.0, -0.1]), 0.7, 0.4)
    drawn = contraction.apply(points)
    assert np.allclose(contraction.invert(drawn), points, atol=1e-12)
    before, after = (np.linalg.norm(each - contraction.middle, axis=1) for each in (points, drawn))
    assert (np.diff(after[np.argsort(before)]) > 0).all()
    assert np.allclose(after[before < 0.7], 0.4 * before[before < 0.7])
    assert np.allclose(after[before > 0.7], before[before > 0.7] - 0.6 * 0.7)


def test_the_largest_ball_lies_in_the_thickest_part() -> None:
    large, small = trimesh.creation.icosphere(3, 0.4), trimesh.creation.icosphere(3, 0.2)
    small.apply_translation([0.7, 0, 0])
    both = trimesh.util.concatenate([small, large])
    found = largest_ball(scan_of(Shape(both.vertices, both.faces), 4000), 200)
    assert found is not None
    assert np.linalg.norm(found[0]) < 0.03 and found[1] == pytest.approx(0.4, rel=0.05)


def test_a_sheet_holds_no_ball() -> None:
    x, y = (each.reshape(-1) for each in np.meshgrid(np.linspace(0, 1, 20), np.linspace(0, 1, 20)))
    faces = np.array([[k, k + 1, k + 20] for k in range(379) if k % 20 < 19])
    assert largest_ball(scan_of(Shape(np.stack([x, y, 0.1 * x * y], 1), faces), 2000), 200) is None


def test_the_gap_between_a_body_and_its_coat_holds_no_ball() -> None:
    """Both sheets face outwards: a ball between them would touch the upper one from within, the lower one from out."""
    skin = np.array([[0, 0, -0.3], [1, 0, -0.3], [1, 1, -0.3], [0, 1, -0.3]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    worn = Shape(np.concatenate([skin, skin + np.array([0, 0, 0.3])]), np.concatenate([faces, faces + 4]))
    assert largest_ball(scan_of(worn, 4000), 200) is None


def test_a_head_larger_than_all_the_rest_is_no_trunk(human: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cartoon on short legs."""
    monkeypatch.setattr(thick_parts, "SETTINGS", replace(thick_parts.SETTINGS, factors=(0.36,)))  # one is quicker
    shape = cartoon(human)
    fit = Fitter(human, FitConfig()).fit(shape)
    assert fit.verdict == "fair"
    assert np.linalg.norm(fit.frame.undo(fit.points) - shape.verts, axis=1).mean() < 0.06  # of 1.7; 0.48 without


def test_only_a_better_fit_is_taken(human: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = cartoon(human)
    found = Registration(FitTask.of(human, FitConfig(), shape), Candidate(RigidPose.identity(), still(human), 0.05))
    read: list[float] = []

    def nothing(task: FitTask, contraction: Contraction) -> Candidate:
        read.append(contraction.factor)
        return found.candidate

    monkeypatch.setattr(thick_parts, "_fit_contracted", nothing)
    monkeypatch.setattr(thick_parts, "WholeComparison", Unrefined)
    assert with_thick_part_smaller(found) is None and sorted(read) == [0.36, 0.5, 0.65]


def test_ordinary_bodies_and_clouds_are_not_asked(human: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thick_parts, "_fit_contracted", lambda *_: pytest.fail("read anew"))
    body = human.template.shape
    for shape in (body, Shape(cartoon(human).verts, np.zeros((0, 3), np.int64))):
        task = FitTask.of(human, FitConfig(), shape)
        assert with_thick_part_smaller(Registration(task, Candidate(RigidPose.identity(), still(human), 0.05))) is None


def test_the_smaller_shape_keeps_landmarks_and_side(human: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    shape = cartoon(human)
    task = FitTask.of(human, FitConfig(), shape, (np.array([7]), shape.verts[[7]]), mirrored=True)
    asked: list[tuple[Shape, np.ndarray, bool]] = []

    def of(model: TrainedModel, config: FitConfig, other: Shape, landmarks: Any, mirrored: bool) -> FitTask:
        asked.append((other, landmarks[1], mirrored))
        raise InterruptedError

    monkeypatch.setattr(FitTask, "of", of)
    with pytest.raises(InterruptedError):
        thick_parts._fit_contracted(task, Contraction(np.zeros(3), 0.3, 0.5))
    ((other, places, mirrored),) = asked
    assert mirrored is task.frame.mirrored
    assert np.allclose(places, other.verts[[7]]) and not np.allclose(places, shape.verts[[7]])
