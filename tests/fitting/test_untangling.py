"""Limbs in wrong places are read anew with the other limbs out of the way."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.api.inputs import as_model
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search import untangling
from meshmatch.fitting.search.limbs import limbs_of
from meshmatch.fitting.search.predictor import Candidate
from meshmatch.fitting.search.task import FitTask, Registration
from meshmatch.fitting.search.untangling import untangled
from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.geometry.frames import RigidPose
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import egg_model, scan_of


@pytest.fixture(scope="module")
def human() -> TrainedModel:
    return as_model("human")


def raised(human: TrainedModel, place: np.ndarray) -> np.ndarray:
    """Node vectors of the template with its left hand at a place."""
    limbs, labels, names = limbs_of(human), human.template.labels, human.template.label_names
    hand = next(
        each
        for each in limbs.bends
        if len(each.turned_joints) == 3 and (labels[each.end.verts] == names.index("left hand")).all()
    )
    vectors, missed = limbs.bent(np.zeros((node_system(human).K, 3)), hand, place)
    assert missed < 0.05
    return vectors


def registered(human: TrainedModel, truth: np.ndarray, fit: np.ndarray) -> Registration:
    """A fit of the template moved by other node vectors than its own; samples lie in the core frame."""
    system: NodeSystem = node_system(human)
    shape = Shape(system.moved(truth), system.faces)
    scan = scan_of(shape, 8000)
    task = replace(FitTask.of(human, FitConfig(), shape), samples=scan, visible_samples=scan)
    return Registration(task, Candidate(RigidPose.identity(), fit, 0.03))


def test_branches_are_arms_and_legs_in_pieces(human: TrainedModel) -> None:
    template = human.template
    branches = limbs_of(human).branches
    names = [[template.label_names[template.labels[piece[0]]] for piece in each.pieces] for each in branches]
    assert sorted(each[0] for each in names) == ["left thigh", "left upper arm", "right thigh", "right upper arm"]
    assert all(len(each) == 3 for each in names)
    for branch in branches:
        assert sorted(np.concatenate(branch.pieces)) == sorted(branch.limbs[0].verts)
        held = template.label_names[template.labels[branch.holder[0]]]
        assert held == ("hips" if "thigh" in names[branches.index(branch)][0] else "chest")
    assert limbs_of(egg_model()).branches == []


def test_a_limb_in_a_wrong_place_is_found(human: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    chest = node_system(human).verts[human.template.core].mean(0)
    truth = raised(human, chest + np.array([0.1, 0.25, 0.3]))
    found = registered(human, truth, np.zeros_like(truth))
    better = untangled(found)
    assert better is not None and better.task is found.task
    moved = found.task.system.moved
    off = np.linalg.norm(moved(better.candidate.vectors) - moved(truth), axis=1)
    before = np.linalg.norm(moved(truth) - moved(found.candidate.vectors), axis=1)
    assert before.max() > 0.3 and off.max() < 0.15 and off.mean() < 0.03
    monkeypatch.setattr(untangling, "SETTINGS", replace(untangling.SETTINGS, margin=0.1))
    assert untangled(found) is None  # no fit is so much better


def test_a_fit_without_a_sign_of_tangles_is_left(human: TrainedModel, monkeypatch: pytest.MonkeyPatch) -> None:
    still = np.zeros((node_system(human).K, 3))
    found = registered(human, still, still)
    monkeypatch.setattr(untangling, "_predict_limbs", lambda *_: pytest.fail("looked for limbs"))
    assert untangled(found) is None
    cloud = replace(found.task, samples=replace(found.task.samples, signed=False))
    assert untangled(replace(found, task=cloud)) is None


def test_samples_of_other_limbs_come_to_rest(human: TrainedModel) -> None:
    system, limbs = node_system(human), limbs_of(human)
    chest = system.verts[human.template.core].mean(0)
    truth = raised(human, chest + np.array([0.1, 0.25, 0.3]))
    samples = system.surface(truth)
    rested = untangling._at_rest(system, samples, truth, limbs.branches)
    off = [np.linalg.norm(each.points - system.verts, axis=1) for each in (samples, rested)]
    assert off[0].max() > 0.3 and np.percentile(off[1], 99) < 0.06
    kept = untangling._at_rest(system, samples, truth, [])
    assert np.array_equal(kept.points, samples.points)
