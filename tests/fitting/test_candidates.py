"""Readings of a pose: what is torn costs, readings that differ are all fitted to the end."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.fitting.candidates import CandidateScorer, averaged, choose, differ, lying
from meshmatch.fitting.fit_shape import node_system
from meshmatch.fitting.network_fit import Candidate
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import egg_model, scan_of

EYE, ZERO = np.eye(3), np.zeros(3)


@pytest.fixture(scope="module")
def system() -> NodeSystem:
    return node_system(egg_model())


@pytest.fixture(scope="module")
def scan(system: NodeSystem) -> Scan:
    return scan_of(Shape(system.verts, system.faces), 1500)


def still(system: NodeSystem, residual: float = 0.03) -> Candidate:
    return Candidate(EYE, ZERO, np.zeros((system.K, 3)), residual)


def folded(system: NodeSystem, residual: float = 0.03) -> Candidate:
    """One half of the egg laid upon the other: each place of the scan has two of the template."""
    nodes = egg_model().template.nodes
    vectors = np.zeros_like(nodes)
    vectors[:, 0] = np.where(nodes[:, 0] > 0, -2 * nodes[:, 0], 0)
    return Candidate(EYE, ZERO, vectors, residual)


def test_a_right_fit_tears_nothing_and_a_folded_one_much(system: NodeSystem, scan: Scan) -> None:
    judge = CandidateScorer(system, scan)
    whole = judge.torn(scan, still(system).vectors)
    assert whole < 0.02  # a template is coarse: neighbours may have vertices apart
    torn = judge.torn(scan, folded(system).vectors)
    assert 2 * whole < torn <= 1.0
    assert judge.score(scan, folded(system)) == pytest.approx(0.03 + 0.1 * torn)


def test_the_same_pose_in_another_frame_is_no_other_reading(system: NodeSystem) -> None:
    here = still(system)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    nodes = egg_model().template.nodes
    # scan = R core + c: the core moved by the opposite lies at the same place
    there = Candidate(turn, np.array([1.0, 2, 3]), (nodes - np.array([1, 2, 3])) @ turn - nodes, 0.03)
    assert np.allclose(lying(system, here), system.verts)
    assert not differ(lying(system, here), lying(system, there))
    assert differ(lying(system, here), lying(system, folded(system)))
    assert differ(lying(system, here), lying(system, replace(here, center=np.array([0.2, 0, 0]))))


def test_what_looked_worse_at_first_wins_at_the_end(system: NodeSystem, scan: Scan) -> None:
    """A folded reading leads before and after a few steps, and the right one catches up by refinement."""
    right, wrong = still(system, 0.040), folded(system, 0.030)
    finished: list[float] = []

    def fitted(candidate: Candidate, whole: bool) -> Candidate:
        if whole:
            finished.append(candidate.residual)
        return replace(candidate, residual=0.02 if whole else candidate.residual)

    told: list[float] = []
    judge = CandidateScorer(system, scan)
    readings = [wrong, replace(wrong, residual=0.031), right]
    best = choose(
        readings, 2, fitted, lambda c: judge.score(scan, c), lambda c: lying(system, c), told.append
    )
    assert np.array_equal(best.vectors, right.vectors)
    assert finished == [0.03, 0.04]  # of two alike only the better one is fitted to the end
    assert told[-1] == 1.0 and told == sorted(told)


def test_readings_alike_cost_one_refinement(system: NodeSystem) -> None:
    calls = {False: 0, True: 0}

    def fitted(candidate: Candidate, whole: bool) -> Candidate:
        calls[whole] += 1
        return candidate

    candidates = [still(system, 0.03 + 0.001 * k) for k in range(9)]
    best = choose(candidates, 4, fitted, lambda c: c.residual, lambda c: lying(system, c))
    assert best.residual == 0.03
    assert calls == {False: 4, True: 1}


def test_readings_that_say_the_same_are_averaged_and_others_are_not(system: NodeSystem) -> None:
    near = [replace(still(system), vectors=np.full((system.K, 3), size)) for size in (0.0, 0.01, 0.02)]
    elsewhere = replace(near[1], rotation=np.eye(3))  # another frame, though an equal one
    far = folded(system)
    mean = averaged(system, near[0], [*near, elsewhere, far])
    assert np.allclose(mean.vectors, 0.01)
    assert averaged(system, far, near) is far


def test_of_a_rough_cloud_positions_alone_are_judged_and_squares(system: NodeSystem, scan: Scan) -> None:
    shifted = replace(still(system), vectors=np.full((system.K, 3), [0.02, 0, 0]))
    apart = np.linalg.norm(system.verts[:, None] + [0.02, 0, 0] - scan.points, axis=2)
    wanted = np.sqrt(0.5 * np.square(apart.min(1)).mean() + 0.5 * np.square(apart.min(0)).mean())
    rough, smooth, half = (CandidateScorer(system, scan, share) for share in (1.0, 0.0, 0.5))
    assert rough.scatter(scan, shifted.vectors) == pytest.approx(wanted)
    torn = 0.1 * rough.torn(scan, shifted.vectors)
    assert rough.score(scan, shifted) == pytest.approx(wanted + torn)
    assert smooth.score(scan, shifted) == pytest.approx(0.03 + torn)
    assert half.score(scan, shifted) == pytest.approx(0.5 * (0.03 + wanted) + torn)
    # a template out of reach: every distance counts as the cap
    away = replace(still(system), vectors=np.full((system.K, 3), 3.0))
    assert rough.scatter(scan, away.vectors) == pytest.approx(0.1)
