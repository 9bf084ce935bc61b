"""Interpretations of a pose: discontinuities cost, interpretations that differ are all refined in full."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.api.inputs import as_model
from meshmatch.fitting.fit_config import FitConfig, Partial
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search import candidates, frames, refinement
from meshmatch.fitting.search.candidates import candidates_of_whole
from meshmatch.fitting.search.discontinuities import discontinuous_share, neighbours
from meshmatch.fitting.search.predictor import Candidate, Predictor
from meshmatch.fitting.search.refinement import (
    CandidateScorer,
    PartComparison,
    WholeComparison,
    average_similar,
    choose,
    differ,
    has_common_axes,
)
from meshmatch.fitting.search.task import FitTask
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import read_template
from tests.conftest import icosphere
from tests.fitting.eggs import egg_model, scan_of

STILL = RigidPose.identity()


@pytest.fixture(scope="module")
def scan(system: NodeSystem) -> OrientedPoints:
    return scan_of(Shape(system.verts, system.faces), 1500)


def still(system: NodeSystem, residual: float = 0.03) -> Candidate:
    return Candidate(STILL, np.zeros((system.K, 3)), residual)


@pytest.mark.parametrize(("residual", "partial", "tried"), [(0.03, "auto", 0), (0.06, "auto", 144), (0.06, "yes", 0)])
def test_a_shape_that_the_network_misses_is_turned_every_way(
    monkeypatch: pytest.MonkeyPatch, residual: float, partial: Partial, tried: int
) -> None:
    model = egg_model()
    task = FitTask.of(model, FitConfig(partial=partial), Shape(model.template.shape.verts, model.template.shape.faces))
    monkeypatch.setattr(candidates, "frames_to_try", lambda *_: [STILL] * 6)
    asked: list[list[RigidPose]] = []

    def fit_all(self: Predictor, starts: list[tuple[OrientedPoints, RigidPose]], *_: int, **__: int) -> list[Candidate]:
        asked.append([pose for _, pose in starts])
        right = [pose.rotation[1, 1] < -0.95 for _, pose in starts]
        still = np.zeros((task.system.K, 3))
        return [
            Candidate(pose, still, 0.02 if each else residual) for each, (_, pose) in zip(right, starts, strict=True)
        ]

    monkeypatch.setattr(Predictor, "fit_all", fit_all)
    _, found = candidates_of_whole(task)
    assert [len(each) for each in asked] == [6, 3, *([tried, 12] if tried else []), 1]
    assert (found[0].pose.rotation[1, 1] < -0.95) == bool(tried)


def test_frames_anywhere_are_near_to_any_and_obey_the_user() -> None:
    model = as_model("human")
    samples = scan_of(model.template.shape, 500)
    poses = frames.frames_anywhere(model, samples, FitConfig())
    turns = Rotation.from_matrix([pose.rotation for pose in poses])
    asked = Rotation.random(200, random_state=np.random.default_rng(0))
    nearest = [np.degrees((turns * each.inv()).magnitude().min()) for each in asked]
    assert max(nearest) < 45
    below = [pose.rotation.T @ (pose.center - samples.points.mean(0)) for pose in poses]
    assert np.ptp(below, axis=0).max() < 1e-9 and below[0][1] < 0
    obeying = frames.frames_anywhere(model, samples, FitConfig(up="-z"))
    assert 0 < len(obeying) < len(poses) / 2
    assert all(pose.rotation[2, 1] < -0.5 for pose in obeying)
    aligned = replace(model, card=replace(model.card, frame=model.card.frame | {"orientation": "rigid"}))
    assert frames.frames_anywhere(aligned, samples, FitConfig()) == []


def test_where_the_orientation_is_not_searched_what_is_missed_widely_is_not_turned() -> None:
    model = as_model("human")
    aligned = replace(model, card=replace(model.card, frame=model.card.frame | {"orientation": "rigid"}))
    assert Fitter(aligned, FitConfig()).fit(icosphere(3)).verdict == "poor"


def test_a_body_that_folds_forward_is_found() -> None:
    """Its aligner takes it for another one upside down; turned every way, the network reads it."""
    verts, hips = read_template("human-T").shape.verts, 0.05
    share = np.clip((verts[:, 1] - hips) / 0.1 + 0.5, 0, 1)
    angle = np.radians(160) * share**2 * (3 - 2 * share)
    up, ahead = verts[:, 1] - hips, verts[:, 2]
    up, ahead = up * np.cos(angle) - ahead * np.sin(angle), up * np.sin(angle) + ahead * np.cos(angle)
    body = Shape(np.stack([verts[:, 0], hips + up, ahead], 1), read_template("human-T").shape.faces)
    fit = Fitter(as_model("human"), FitConfig()).fit(body)
    apart = np.linalg.norm(fit.points_in_file - body.verts, axis=1).mean() / np.sqrt(body.area)
    assert apart < 0.03 and fit.verdict != "poor"


@pytest.mark.parametrize(("front", "right"), [(None, True), ("z", False)])
def test_a_body_taken_back_to_front_is_turned_about(
    monkeypatch: pytest.MonkeyPatch, front: str | None, right: bool
) -> None:
    """All frames that are tried have its back to the front; where the user says so, it is left."""
    model, config = as_model("human"), FitConfig(careful=1)
    task = FitTask.of(model, config, load_shape(bundled_folder() / "samples" / "climber.ply"))
    true = candidates_of_whole(task)[1][0].pose
    turned = RigidPose(true.rotation * [-1.0, 1.0, -1.0], true.center)
    monkeypatch.setattr(candidates, "frames_to_try", lambda *_: [turned])
    found = candidates_of_whole(replace(task, config=replace(config, front=front)))[1][0].pose
    assert (found.rotation[:, 2] @ true.rotation[:, 2] > 0.9) == right


@pytest.mark.parametrize(("upright", "careful"), [(False, 3), (True, 4)])
def test_how_a_file_stands_is_tried_however_badly_it_begins(
    monkeypatch: pytest.MonkeyPatch, upright: bool, careful: int
) -> None:
    """The aligner has five other orientations, which look better at first."""
    model = egg_model()
    task = FitTask.of(model, FitConfig(), replace(model.template.shape, upright=upright))
    odd = np.eye(3)[[1, 2, 0]]
    monkeypatch.setattr(frames, "principal_pose", lambda _: RigidPose.identity())
    monkeypatch.setattr(frames, "propose", lambda *_: [RigidPose(odd, np.zeros(3))])
    monkeypatch.setattr(frames, "with_flips", lambda poses: poses * 5)
    asked: list[list[RigidPose]] = []

    def fit_all(self: Predictor, starts: list[tuple[OrientedPoints, RigidPose]], *_: int, **__: int) -> list[Candidate]:
        asked.append([pose for _, pose in starts])
        still = np.zeros((task.system.K, 3))
        return [Candidate(pose, still, 0.04 if (pose.rotation == odd).all() else 0.045) for _, pose in starts]

    monkeypatch.setattr(Predictor, "fit_all", fit_all)
    _, found = candidates_of_whole(task)
    assert [len(poses) for poses in asked] == [5 + upright, careful, 1]
    assert [bool((each.pose.rotation == odd).all()) for each in found] == [True] * 3 + [False] * upright
    assert candidates.upright_candidate(task, found) == found[3:]  # it will be refined, too


def test_another_orientation_than_the_files_costs_a_little(monkeypatch: pytest.MonkeyPatch) -> None:
    model = egg_model()
    turned = RigidPose(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))  # up along z, front along -y
    costs = {}
    for upright in (False, True):
        task = FitTask.of(model, FitConfig(), replace(model.template.shape, upright=upright))
        comparison = WholeComparison(task, [])
        monkeypatch.setattr(refinement.CandidateScorer, "score", lambda *_: 0.03)
        monkeypatch.setattr(comparison, "doubt", lambda _: 0.0)
        here = still(task.system)
        costs[upright] = [comparison.score(replace(here, pose=pose), True) for pose in (STILL, turned)]
    assert costs == {False: [0.03, 0.03], True: [0.03, pytest.approx(0.031)]}


class Scored:
    """Compares candidates by their residual, and keeps a record of what is refined."""

    def __init__(self, system: NodeSystem, refined: float | None = None, scorer=lambda c: c.residual) -> None:
        self.system, self.residual, self.scorer = system, refined, scorer
        self.calls: dict[bool, list[float]] = {False: [], True: []}

    def refined(self, candidate: Candidate, in_full: bool) -> Candidate:
        self.calls[in_full].append(candidate.residual)
        return replace(candidate, residual=self.residual) if in_full and self.residual else candidate

    def score(self, candidate: Candidate, in_full: bool) -> float:
        return self.scorer(candidate)

    def vertices(self, candidate: Candidate) -> np.ndarray:
        return candidate.pose.to_world(self.system.moved(candidate.vectors))


def folded(system: NodeSystem, residual: float = 0.03) -> Candidate:
    """One half of the egg laid upon the other: each place of the scan has two of the template."""
    nodes = egg_model().template.nodes
    vectors = np.zeros_like(nodes)
    vectors[:, 0] = np.where(nodes[:, 0] > 0, -2 * nodes[:, 0], 0)
    return Candidate(STILL, vectors, residual)


def test_a_right_fit_is_continuous_and_a_folded_one_is_not(system: NodeSystem, scan: OrientedPoints) -> None:
    scorer = CandidateScorer(system, scan)
    whole = discontinuous_share(system, neighbours(scan), scan, still(system).vectors)
    assert whole < 0.02  # a template is coarse: neighbours may have vertices apart
    cut = discontinuous_share(system, neighbours(scan), scan, folded(system).vectors)
    assert 2 * whole < cut <= 1.0
    assert scorer.score(scan, folded(system)) == pytest.approx(0.03 + 0.1 * cut)


def test_the_same_pose_in_another_frame_is_no_other_interpretation(system: NodeSystem) -> None:
    here = still(system)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    nodes = egg_model().template.nodes
    # scan = R core + c: the core moved by the opposite lies at the same place
    pose = RigidPose(turn, np.array([1.0, 2, 3]))
    there = Candidate(pose, (nodes - np.array([1, 2, 3])) @ turn - nodes, 0.03)
    shifted = replace(here, pose=RigidPose(np.eye(3), np.array([0.2, 0, 0])))
    verts = Scored(system).vertices
    assert np.allclose(verts(here), system.verts)
    assert not differ(verts(here), verts(there))
    assert differ(verts(here), verts(folded(system)))
    assert differ(verts(here), verts(shifted))


def test_what_looked_worse_at_first_wins_at_the_end(system: NodeSystem, scan: OrientedPoints) -> None:
    """A folded interpretation leads before and after a few steps, and the right one catches up by refinement."""
    right, wrong = still(system, 0.0305), folded(system, 0.030)
    scorer = CandidateScorer(system, scan)
    comparison = Scored(system, 0.02, lambda candidate: candidate.residual)
    comparison.score = lambda each, in_full: scorer.score(scan, each) if in_full else each.residual  # type: ignore[method-assign]
    shares: list[float] = []
    progress = Progress(lambda stage, name, share: shares.append(share))
    best = choose([wrong, replace(wrong, residual=0.0301), right], 2, comparison, progress)[1]
    assert np.array_equal(best.vectors, right.vectors)
    assert comparison.calls[True] == [0.03, 0.0305]  # of two alike only the better one is refined
    assert shares[-1] == 1.0 and shares == sorted(shares)


def test_interpretations_alike_cost_one_refinement(system: NodeSystem) -> None:
    candidates = [still(system, 0.03 + 0.001 * k) for k in range(9)]
    comparison = Scored(system)
    assert choose(candidates, 4, comparison, Progress())[1].residual == 0.03
    assert {in_full: len(calls) for in_full, calls in comparison.calls.items()} == {False: 0, True: 1}


def test_an_interpretation_left_far_behind_is_not_refined_in_full(system: NodeSystem) -> None:
    comparison = Scored(system)
    assert choose([still(system, 0.03), folded(system, 0.033)], 4, comparison, Progress())[1].residual == 0.03
    assert comparison.calls == {False: [0.03, 0.033], True: [0.03]}


def test_interpretations_that_say_the_same_are_averaged_and_others_are_not(system: NodeSystem) -> None:
    near = [replace(still(system), vectors=np.full((system.K, 3), size)) for size in (0.0, 0.01, 0.02)]
    elsewhere = replace(near[1], pose=RigidPose.identity())  # another frame, though an equal one
    far = folded(system)
    mean = average_similar(system, near[0], [*near, elsewhere, far])
    assert np.allclose(mean.vectors, 0.01)
    assert average_similar(system, far, near) is far


def test_of_a_rough_cloud_positions_alone_are_scorerd_and_squares(system: NodeSystem, scan: OrientedPoints) -> None:
    shifted = replace(still(system), vectors=np.full((system.K, 3), [0.02, 0, 0]))
    apart = np.linalg.norm(system.verts[:, None] + [0.02, 0, 0] - scan.points, axis=2)
    wanted = np.sqrt(0.5 * np.square(apart.min(1)).mean() + 0.5 * np.square(apart.min(0)).mean())
    rough, smooth, half = (CandidateScorer(system, scan, share) for share in (1.0, 0.0, 0.5))
    assert rough.scatter(scan, shifted.vectors) == pytest.approx(wanted)
    cut = 0.1 * discontinuous_share(system, neighbours(scan), scan, shifted.vectors)
    assert rough.score(scan, shifted) == pytest.approx(wanted + cut)
    assert smooth.score(scan, shifted) == pytest.approx(0.03 + cut)
    assert half.score(scan, shifted) == pytest.approx(0.5 * (0.03 + wanted) + cut)
    # a template out of reach: every distance counts as the cap
    away = replace(still(system), vectors=np.full((system.K, 3), 3.0))
    assert rough.scatter(scan, away.vectors) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("up", "front", "usual"),
    [("y", "z", True), ("z", "-y", True), ("y", "-z", False), ("-y", "z", False), ("z", "y", False), ("x", "z", False)],
)
def test_how_most_files_stand(up: str, front: str, usual: bool) -> None:
    def axis(name: str) -> np.ndarray:
        return np.eye(3)["xyz".index(name[-1])] * (-1 if name.startswith("-") else 1)

    rotation = np.stack([np.cross(axis(up), axis(front)), axis(up), axis(front)], 1)
    assert has_common_axes(RigidPose(rotation, np.zeros(3))) is usual


@pytest.mark.parametrize(("reads", "spread", "told"), [(True, 0.02, True), (True, 0.09, True), (False, 0.02, False)])
def test_of_interpretations_that_tie_the_network_chooses(
    monkeypatch: pytest.MonkeyPatch, reads: bool, spread: float, told: bool
) -> None:
    """Front and back, say: the one that is read in tilted copies, by a model that reads these."""
    model = egg_model()
    task = FitTask.of(model, FitConfig(), model.template.shape)
    comparison = WholeComparison(task, [])
    here, there = still(comparison.task.system), folded(comparison.task.system)
    monkeypatch.setattr(refinement, "is_tilt_consistent", lambda _: reads)
    monkeypatch.setattr(Predictor, "spread", lambda self, local, vectors, at: spread if vectors.any() else 0.01)
    doubt = comparison.doubt(there) - comparison.doubt(here)
    assert (doubt > 0) is told and doubt <= 0.3 * 0.02 + 1e-9  # beyond a usual spread it is no more
    both = [comparison.score(there, in_full) for in_full in (True, False)]
    monkeypatch.setattr(Predictor, "spread", lambda *_: 0.01)
    assert [both[0] - comparison.score(there, True), both[1] - comparison.score(there, False)] == [
        pytest.approx(doubt),
        0.0,
    ]
    assert PartComparison(task).doubt(there) == 0.0
