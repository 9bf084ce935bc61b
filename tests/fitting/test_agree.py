"""Fits that agree: the mean stretch by hand, and what agreeing does to two fits of one egg."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search.task import Landmarks
from meshmatch.fitting.solve.agreement import AgreeConfig, Member, agree, likeness, log_stretch, mean_log, stretch_of
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit

TURNS = Rotation.random(4, random_state=np.random.default_rng(0)).as_matrix()


def stretches(*factors: float) -> np.ndarray:
    """(4, 3, 3) the same stretch along the axes, each under another rotation from the left."""
    return TURNS @ np.diag(factors)


def mean_stretch(gradients: list[np.ndarray]) -> np.ndarray:
    return stretch_of(mean_log([log_stretch(F) for F in gradients]))


def test_doubling_and_halving_cancel() -> None:
    common = mean_stretch([stretches(2.0, 1.0, 3.0), stretches(0.5, 1.0, 3.0)])
    assert np.allclose(common, np.diag([1.0, 1.0, 3.0]))


def test_the_mean_of_one_is_its_own_stretch_without_the_turn() -> None:
    F = np.random.default_rng(1).normal(0, 0.3, (6, 3, 3)) + np.eye(3)
    common = mean_stretch([F])
    assert np.allclose(common, common.transpose(0, 2, 1))
    assert np.allclose(common @ common, F.transpose(0, 2, 1) @ F)
    assert np.allclose(mean_stretch([TURNS[0] @ F]), common)


def test_a_collapsed_point_has_a_finite_mean() -> None:
    assert np.isfinite(mean_stretch([np.zeros((1, 3, 3)), stretches(1, 1, 1)[:1]])).all()


def agreeing(steps: int, prior: float = 1e-4, momentum: float = 0.6, **settings: float) -> AgreeConfig:
    schedule = replace(AgreeConfig.schedule, steps=steps, prior=(prior, prior), momentum=momentum)
    return AgreeConfig(schedule=schedule, **settings)


def scan_of(system: NodeSystem) -> OrientedPoints:
    """The resting egg itself."""
    samples = sample_surface(Shape(system.verts, system.faces), 1500, np.random.default_rng(0))
    return OrientedPoints(samples.points, samples.normals)


def slid(system: NodeSystem, nodes: np.ndarray, turn: float) -> np.ndarray:
    """Node vectors that let the template slide along the egg: twisted about the long axis by up to ``turn``."""
    angle = turn * np.tanh(nodes[:, 1])
    x, z = nodes[:, 0], nodes[:, 2]
    # the egg is 0.8 wide and 1.0 deep: turn on a circle, then back to the ellipse
    x, z = x / 0.8, z
    x, z = np.cos(angle) * x + np.sin(angle) * z, -np.sin(angle) * x + np.cos(angle) * z
    return np.stack([0.8 * x, nodes[:, 1], z], 1) - nodes


def test_two_that_slid_apart_come_closer(system: NodeSystem, model: TrainedModel) -> None:
    scan, nodes, config = scan_of(system), model.template.nodes, agreeing(6, 0.01)
    apart = [slid(system, nodes, 0.15), slid(system, nodes, -0.15)]
    nearer = agree(system, [Member(samples=scan, vectors=each, config=config) for each in apart])

    def gap(pair: list[np.ndarray]) -> float:
        return float(np.linalg.norm(system.moved(pair[0]) - system.moved(pair[1]), axis=1).mean())

    assert gap(nearer) < 0.75 * gap(apart)
    alone = agree(system, [Member(samples=scan, vectors=apart[0], config=config)])
    assert gap([alone[0], apart[1]]) > gap(nearer)


def test_two_that_are_equal_stay_so_and_the_same_twice(system: NodeSystem, model: TrainedModel) -> None:
    member = Member(samples=scan_of(system), vectors=slid(system, model.template.nodes, 0.1), config=AgreeConfig())
    first, again = (agree(system, [member, member]) for _ in range(2))
    assert np.array_equal(first[0], first[1])
    assert np.array_equal(first[0], again[0])


def test_two_are_alike_by_how_far_their_stretches_are_apart() -> None:
    one, other = (log_stretch(stretches(np.exp(x), 1.0, 1.0)) for x in (0.1, 0.5))
    assert likeness(one, [one, one], 0.4) == 1.0
    assert likeness(one, [one, other], 0.4) == pytest.approx(0.5)
    assert likeness(other, [one, other], 0.8) == pytest.approx(1 / (1 + 0.5**8))
    assert likeness(other, [one, other], 0.2) == pytest.approx(1 / (1 + 2.0**8))


def test_a_thick_and_a_thin_one_keep_their_stretch(system: NodeSystem, model: TrainedModel) -> None:
    """An egg, and one half as thick again: made to agree they come closer in stretch; by themselves they do not."""
    scan, nodes = scan_of(system), model.template.nodes
    thick = OrientedPoints(scan.points * [1.5, 1, 1.5], scan.normals)
    vectors = [np.zeros_like(nodes), nodes * [0.5, 0, 0.5]]

    def apart(alike: float) -> float:
        config = agreeing(6, 1.0, alike=alike)
        members = [
            Member(samples=each, vectors=start, config=config)
            for each, start in zip((scan, thick), vectors, strict=True)
        ]
        one, other = (log_stretch(system.deformation_gradient(each)) for each in agree(system, members))
        return float(np.linalg.norm((one - other).reshape(len(one), -1), axis=1).mean())

    assert AgreeConfig().alike < 0.5
    assert apart(AgreeConfig().alike) > 1.5 * apart(np.inf)


def test_landmarks_hold(system: NodeSystem, model: TrainedModel) -> None:
    scan, start = scan_of(system), slid(system, model.template.nodes, 0.1)
    at = np.array([3, 40])
    places = system.moved(start)[at] + [0.15, 0.0, 0.0]
    config = agreeing(3)

    def missed(known: Landmarks | None) -> float:
        moved = system.moved(agree(system, [Member(samples=scan, vectors=start, config=config, landmarks=known)])[0])
        return float(np.linalg.norm(moved[at] - places, axis=1).max())

    assert missed((at, places)) < 0.25 * missed(None)


def fit_of(system: NodeSystem, vectors: np.ndarray, verdict: str = "good") -> Fit:
    frame = Frame(2.0, TURNS[1], np.array([1.0, 2.0, 3.0]))
    about = {"frame": frame, "verts": frame.undo(system.verts), "verdict": verdict, "residual": 0.02}
    return some_fit(system.moved(vectors), system.faces, vectors=vectors, resting=system.verts, **about)


def test_fits_agree_in_their_own_frames(system: NodeSystem, model: TrainedModel) -> None:
    vectors = [slid(system, model.template.nodes, turn) for turn in (0.15, -0.15)]
    fits = [fit_of(system, each) for each in vectors]
    shape = Shape(fits[0].frame.undo(system.verts), system.faces)
    how = agreeing(6, 0.01)
    agreed = agreed_fits(model, [shape, shape], fits, FitConfig(samples=1500), how=how)
    before, after = (np.linalg.norm(a.points - b.points, axis=1).mean() for a, b in (fits, agreed))
    assert after < before
    for fit in agreed:
        assert np.allclose(fit.points, system.moved(fit.vectors))
        assert 0 < fit.vertex_distance.max() < 0.2  # of the egg's vertices from the template's, in the core frame
        assert (fit.verdict, fit.residual) == ("good", 0.02)


def test_a_poor_fit_has_no_say(system: NodeSystem, model: TrainedModel) -> None:
    vectors = [slid(system, model.template.nodes, turn) for turn in (0.15, -0.15)]
    fits = [fit_of(system, vectors[0]), fit_of(system, vectors[1], "poor")]
    shape = Shape(fits[0].frame.undo(system.verts), system.faces)
    assert agreed_fits(model, [shape, shape], fits) == fits
    good = [replace(fit, verdict="good") for fit in fits]
    assert agreed_fits(model, [shape, shape], good, FitConfig(refine="none")) == good


def test_the_card_says_how_stiff(system: NodeSystem, model: TrainedModel) -> None:
    vectors = [slid(system, model.template.nodes, turn) for turn in (0.15, -0.15)]
    fits = [fit_of(system, each) for each in vectors]
    shape = Shape(fits[0].frame.undo(system.verts), system.faces)
    soft = replace(model, card=replace(model.card, stiffness=0.25))

    def points(which: TrainedModel, how: AgreeConfig | None = None) -> np.ndarray:
        return agreed_fits(which, [shape, shape], fits, FitConfig(samples=1500), how=how)[0].points

    plain = AgreeConfig()
    assert np.array_equal(points(soft), points(model, agreeing(8, 0.25e-4)))
    assert np.array_equal(points(model), points(model, plain))
    assert not np.array_equal(points(soft), points(model))


def test_momentum_goes_further_in_as_many_steps(model: TrainedModel, system: NodeSystem) -> None:
    scan, nodes = scan_of(system), model.template.nodes
    apart = [slid(system, nodes, amount) for amount in (0.1, -0.1)]

    def left(momentum: float) -> float:
        config = agreeing(3, 0.01, momentum)
        found = agree(system, [Member(samples=scan, vectors=each, config=config) for each in apart])
        return float(np.abs(found[0] - found[1]).mean())

    assert left(AgreeConfig().schedule.momentum) < 0.97 * left(0.0)
