"""Limbs that a fit has in a wrong place are bent to where it leaves the shape bare."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.api.inputs import as_model
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search import limbs as limbs_module
from meshmatch.fitting.search import refinement
from meshmatch.fitting.search.limbs import Limbs, limbs_of, uncovered_regions
from meshmatch.fitting.search.predictor import Candidate, mirror_of
from meshmatch.fitting.search.refinement import WholeComparison, with_limb_bent
from meshmatch.fitting.search.task import FitTask
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.fitting.eggs import egg_model, scan_of

STILL = RigidPose.identity()


@pytest.fixture(scope="module")
def human() -> TrainedModel:
    return as_model("human")


@pytest.fixture(scope="module")
def kicking(human: TrainedModel) -> np.ndarray:
    """Node vectors of the template with its left leg, from the knee on, kicked forward."""
    labels, names = human.template.labels, human.template.label_names
    nodes = human.template.nodes
    below = np.isin(labels, [names.index("left shin"), names.index("left foot")])
    verts = human.template.shape.verts
    nearest = np.linalg.norm(nodes[:, None] - verts[None], axis=2).argmin(1)
    knee = verts[below][verts[below][:, 1].argmax()]
    turn = Rotation.from_euler("x", -100, degrees=True).as_matrix()
    return np.where(below[nearest][:, None], (nodes - knee) @ turn.T + knee - nodes, 0.0)


def shape_of(system: NodeSystem, vectors: np.ndarray) -> Shape:
    return Shape(system.moved(vectors), system.faces)


def test_bare_places_are_found_the_largest_first() -> None:
    """Of three balls beside the fitted one, all but the one with hardly a sample; a mask may hide a place."""
    sphere = icosphere(3)

    def ball(count: int, x: float) -> OrientedPoints:
        found = scan_of(sphere, count)
        return replace(found, points=0.1 * found.points + [x, 0, 0])

    balls = [ball(3000, 0.0), ball(100, 1.0), ball(200, 2.0), ball(10, 3.0)]
    points, normals = (np.concatenate([getattr(each, name) for each in balls]) for name in ("points", "normals"))
    samples, surface = OrientedPoints(points, normals), ball(2000, 0.0)
    found = uncovered_regions(samples, surface)
    assert np.allclose(found, [[2, 0, 0], [1, 0, 0]], atol=0.03)
    hidden = replace(samples, weights=np.where(np.abs(points[:, 0] - 2) < 0.2, 0.0, 1.0))
    assert np.allclose(uncovered_regions(hidden, surface), [[1, 0, 0]], atol=0.03)
    assert uncovered_regions(replace(samples, weights=np.zeros(len(points))), surface) == []
    assert uncovered_regions(balls[0], surface) == []


def test_limbs_hang_on_a_template_by_its_labels(human: TrainedModel) -> None:
    limbs, template = limbs_of(human), human.template
    core = np.zeros(template.shape.V, bool)
    core[template.core] = True
    ends = {id(bend.end): bend.end for bend in limbs.bends}.values()
    assert not any(core[end.verts].any() for end in ends)
    shares = np.stack([end.share for end in ends])
    assert shares.min() >= 0 and shares.max() <= 1 + 1e-6
    ends_of = {" ".join(sorted(names_of(human, end.verts))): end for end in ends}
    assert {"left foot", "left foot left shin", "head neck", "left hand"} <= set(ends_of)
    ways = [
        [" ".join(sorted(names_of(human, limb.verts))) for limb in bend.turned_joints]
        for bend in limbs.bends
        if bend.end is ends_of["left foot"]
    ]
    assert [len(way) for way in ways] == sorted(len(way) for way in ways)  # the simple ones come first
    knee, hip = "left foot left shin", "left foot left shin left thigh"
    assert [hip, knee, "left foot"] in ways and [knee] in ways  # from the core outwards
    assert [hip] not in ways  # as good as bending the whole leg


def names_of(model: TrainedModel, verts: np.ndarray) -> set[str]:
    return {model.template.label_names[k] for k in np.unique(model.template.labels[verts])}


def test_a_template_without_limbs_has_nothing_to_bend() -> None:
    assert limbs_of(egg_model()).bends == []
    assert limbs_of(as_model("quadruped")).bends == []  # all of it is core


def test_a_bent_limb_is_as_long_as_before_and_the_rest_stays(human: TrainedModel) -> None:
    limbs, system = limbs_of(human), node_system(human)
    still = np.zeros((system.K, 3))
    bend = next(
        each
        for each in limbs.bends
        if names_of(human, each.end.verts) == {"left hand"} and len(each.turned_joints) == 2
    )
    hand = system.verts[bend.end.verts].mean(0)
    place = hand + np.array([-0.2, 0.15, 0.2])
    bent, missed = limbs.bent(still, bend, place)
    moved = system.moved(bent)
    assert missed < 0.03
    assert np.linalg.norm(moved[bend.end.verts].mean(0) - place) < 0.05  # what is near the joints follows in part
    assert np.abs(moved - system.verts)[human.template.core].max() < 1e-3
    size = [
        np.ptp(each[bend.end.verts] @ np.linalg.svd(each[bend.end.verts] - each[bend.end.verts].mean(0))[2][0])
        for each in (system.verts, moved)
    ]
    assert size[1] == pytest.approx(size[0], rel=0.1)
    assert limbs.bent(still, bend, hand + np.array([3.0, 0, 0]))[1] > 1  # out of reach


def test_the_limb_that_belongs_to_a_bare_place_is_bent(human: TrainedModel, kicking: np.ndarray) -> None:
    limbs, system = limbs_of(human), node_system(human)
    samples = scan_of(shape_of(system, kicking), 2048)
    still = np.zeros((system.K, 3))
    place = uncovered_regions(samples, system.surface(still))[0]
    found = limbs.reaching(samples, still, place)
    truth = system.moved(kicking)

    def error(vectors: np.ndarray) -> float:
        return float(np.linalg.norm(system.moved(vectors) - truth, axis=1).mean())

    assert error(found[0]) < 0.4 * error(still)
    assert 1 < len(found) <= limbs_module.SETTINGS.max_tried
    assert not limbs.reaching(samples, still, np.array([5.0, 0, 0]))


def task_for(model: TrainedModel, vectors: np.ndarray) -> tuple[FitTask, Candidate]:
    """A task in which samples lie in the core frame, and the resting template as a candidate."""
    system = node_system(model)
    task = FitTask.of(model, FitConfig(samples=4096), shape_of(system, vectors))
    scan = scan_of(shape_of(system, vectors), 4096)
    task = replace(task, samples=scan, visible_samples=scan)
    return task, Candidate(STILL, np.zeros((system.K, 3)), 0.03)


def test_a_fit_with_a_limb_in_a_wrong_place_is_made_good(
    human: TrainedModel, kicking: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    task, still = task_for(human, kicking)
    comparison = WholeComparison(task, [still])
    fit = comparison.refined(still, in_full=True)
    truth = task.system.moved(kicking)
    starts: list[np.ndarray] = []
    reaching = Limbs.reaching
    monkeypatch.setattr(Limbs, "reaching", lambda *given: starts.append(given[2]) or reaching(*given))
    both = fit, with_limb_bent(comparison, still, fit)
    assert [np.array_equal(*each) for each in zip(starts, (still.vectors, fit.vectors), strict=True)] == [True, True]
    off = [np.linalg.norm(task.system.moved(each.vectors) - truth, axis=1) for each in both]
    assert off[0].max() > 0.25 and off[1].max() < 0.1
    place = uncovered_regions(task.coarse, task.system.surface(fit.vectors))
    with monkeypatch.context() as every_limb_leaves_a_region:
        every_limb_leaves_a_region.setattr(refinement, "uncovered_regions", lambda *_: place)
        assert with_limb_bent(comparison, still, fit) is fit
    monkeypatch.setattr(refinement, "SETTINGS", replace(refinement.SETTINGS, bent_margin=0.1))
    assert with_limb_bent(comparison, still, fit) is fit  # no fit is so much better


@pytest.mark.parametrize("legs", [0, 2])
def test_a_fit_that_leaves_nothing_bare_or_too_much_is_kept(
    human: TrainedModel, kicking: np.ndarray, legs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    mirror = mirror_of(human)
    assert mirror is not None
    task, still = task_for(human, legs / 2 * (kicking + mirror.vectors(kicking)))
    places = uncovered_regions(task.coarse, task.system.surface(still.vectors))
    assert len(places) == legs
    monkeypatch.setattr(Limbs, "reaching", lambda *_: pytest.fail("looked for a limb"))
    comparison = WholeComparison(task, [still])
    assert with_limb_bent(comparison, still, still) is still


def test_limbs_of_a_cloud_are_left(human: TrainedModel, kicking: np.ndarray) -> None:
    task, still = task_for(human, kicking)
    cloud = replace(task.samples, signed=False)
    comparison = WholeComparison(replace(task, samples=cloud, visible_samples=cloud), [still])
    assert with_limb_bent(comparison, still, still) is still
