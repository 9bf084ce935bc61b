"""Clouds: a first fit settles their scale and their outliers, and the verdict forgives them their noise."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.judge.features import cloud_allowance, subtract_in_quadrature
from meshmatch.fitting.search.candidates import estimate_scale, isolated_points
from meshmatch.fitting.search.predictor import Candidate, two_way_residual
from meshmatch.fitting.solve.agreement import AgreeConfig
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import PairTerm
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import egg_model

STILL = RigidPose.identity()


def cloud_of(system: NodeSystem, P: int, noise: float = 0.0, strays: int = 0) -> OrientedPoints:
    """Points of the resting egg with normals as a cloud estimates them; outliers come last."""
    rng = np.random.default_rng(0)
    points = sample_surface(Shape(system.verts, system.faces), P, rng).points
    points = np.concatenate([points + noise * rng.standard_normal(points.shape), rng.uniform(-1, 1, (strays, 3))])
    return OrientedPoints(points, Shape(points, np.empty((0, 3), np.int64)).vertex_normals)


class Scaler:
    """Stands for the network: the template blown up by ``share`` of what the scan is too large by."""

    def __init__(self, system: NodeSystem, nodes: np.ndarray, share: float) -> None:
        self.nodes, self.share, self.calls = nodes, share, 0
        self.size = float(np.median(np.linalg.norm(cloud_of(system, 600).points, axis=1)))

    def fit(self, scan: OrientedPoints, start: RigidPose) -> Candidate:
        self.calls += 1
        larger = float(np.median(np.linalg.norm(scan.points, axis=1))) / self.size
        vectors = (larger**self.share - 1) * self.nodes
        return Candidate(start, vectors, 0.0)


def rescaled(
    system: NodeSystem, cloud: OrientedPoints, candidate: Candidate, fit: Callable[..., Candidate]
) -> tuple[float, OrientedPoints, Candidate]:
    return estimate_scale(system, cloud, isolated_points(cloud.points), candidate, fit)


@pytest.mark.parametrize("factor", [0.87, 1.0, 1.15])
def test_the_scale_is_that_of_the_template(system: NodeSystem, factor: float) -> None:
    nodes = egg_model().template.nodes
    scan = cloud_of(system, 600)
    wrong = OrientedPoints(scan.points * factor, scan.normals)
    network = Scaler(system, nodes, 0.8)
    first = network.fit(wrong, STILL)
    scale, settled, best = rescaled(system, wrong, first, network.fit)
    assert scale == pytest.approx(factor, rel=0.03)
    assert np.allclose(settled.points * scale, wrong.points[: len(settled.points)])
    assert best.residual == 0.0


def test_a_wrong_fit_cannot_scale_without_end(system: NodeSystem) -> None:
    nodes = egg_model().template.nodes
    blown = Candidate(STILL, 4.0 * nodes, 0.0)
    scale, _, _ = rescaled(system, cloud_of(system, 300), blown, lambda scan, start: blown)
    assert scale == pytest.approx(1.3)


def test_points_far_away_and_isolated_are_dropped_and_no_others(system: NodeSystem) -> None:
    scan = cloud_of(system, 800, strays=40)
    rest = Candidate(STILL, np.zeros((system.K, 3)), 0.0)
    scale, settled, _ = rescaled(system, scan, rest, lambda part, start: rest)
    assert scale == 1.0
    kept = {tuple(point) for point in settled.points}
    strays = scan.points[800:]
    near = np.abs(np.linalg.norm(strays[:, None] - scan.points[:800], axis=2)).min(1) < 0.1
    assert all(tuple(point) in kept for point in scan.points[:800])
    assert sum(tuple(point) not in kept for point in strays[~near]) > 0.8 * (~near).sum() > 5


def test_what_is_far_is_told_where_the_template_lies(system: NodeSystem) -> None:
    """A cloud that stands elsewhere, and a candidate that says so: the same points are dropped."""
    scan, none = cloud_of(system, 800, strays=40), np.zeros((system.K, 3))
    turn, center = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([0.4, -0.3, 0.2])
    moved = OrientedPoints(scan.points @ turn.T + center, scan.normals @ turn.T)
    left = []
    for cloud, rest in ((scan, Candidate(STILL, none, 0.0)), (moved, Candidate(RigidPose(turn, center), none, 0.0))):
        left.append(rescaled(system, cloud, rest, lambda part, start, rest=rest: rest)[1])
    assert len(left[0].points) < 840
    assert np.allclose(left[1].points, left[0].points @ turn.T + center)
    assert np.allclose(left[1].normals, left[0].normals @ turn.T)


def test_a_centre_is_scaled_with_its_cloud(system: NodeSystem) -> None:
    pose, center = RigidPose(np.eye(3), np.array([0.4, -0.3, 0.2])), []
    larger = Candidate(pose, 0.1 * egg_model().template.nodes, 0.0)

    def fit(scan: OrientedPoints, start: RigidPose) -> Candidate:
        center.append(start.center)
        return replace(larger, pose=start)

    rescaled(system, cloud_of(system, 300), larger, fit)
    assert np.allclose(center, pose.center / np.array([[1.1], [1.1**2], [1.3]]), rtol=1e-4)


def test_a_lost_limb_is_not_dropped(system: NodeSystem) -> None:
    """Far from the template, but as dense as a surface is."""
    scan = cloud_of(system, 800)
    limb = scan.points[:400] * 0.3 + [2.0, 0, 0]
    both = OrientedPoints(np.concatenate([scan.points, limb]), np.concatenate([scan.normals, scan.normals[:400]]))
    rest = Candidate(STILL, np.zeros((system.K, 3)), 0.0)
    assert len(rescaled(system, both, rest, lambda part, start: rest)[1].points) == 1200


def test_isolated_points_by_hand() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 2, [0.0]), -1).reshape(-1, 3)
    assert isolated_points(np.concatenate([grid, [[30.0, 0, 0]]])).nonzero()[0].tolist()[-1] == 64
    assert not isolated_points(grid)[27]


@pytest.mark.parametrize(("P", "noise"), [(3000, 0.0), (3000, 0.03), (400, 0.0), (400, 0.03)])
def test_a_right_fit_of_a_poor_cloud_is_forgiven(system: NodeSystem, P: int, noise: float) -> None:
    scan, still = cloud_of(system, P, noise), np.zeros((system.K, 3))
    clean = sample_surface(Shape(system.verts, system.faces), 3000, np.random.default_rng(1))
    clear = two_way_residual(system, OrientedPoints(clean.points, clean.normals), still)
    residual = two_way_residual(system, scan, still)
    allowance = cloud_allowance(system, scan, P, still)
    explained = np.sqrt(max(residual**2 - allowance**2, 0))
    assert explained < 1.35 * clear
    assert cloud_allowance(system, scan, P, still) == allowance


def test_noise_has_a_limit(system: NodeSystem) -> None:
    """A template far from the whole shape is a wrong fit, however noisy it would have to be."""
    scan = cloud_of(system, 2000)
    far = OrientedPoints(scan.points * 1.5, scan.normals)
    assert cloud_allowance(system, far, 2000, np.zeros((system.K, 3))) < 0.5 * two_way_residual(
        system, far, np.zeros((system.K, 3)), cap=1.0
    )


def test_squares_add_up_in_what_is_explained() -> None:
    assert subtract_in_quadrature(0.05, 0.03) == pytest.approx(0.04)
    assert subtract_in_quadrature(0.02, 0.03) == 0.0


def test_a_repeated_point_is_no_company(system: NodeSystem) -> None:
    """A cloud of few points is drawn from again and again, its strays too."""
    points = cloud_of(system, 300, strays=6).points
    alone = isolated_points(points)
    again = np.concatenate([points, points[::-1], points])
    assert alone[-6:].all() and alone.mean() < 0.2
    assert np.array_equal(isolated_points(again), np.concatenate([alone, alone[::-1], alone]))


def test_noise_makes_a_cloud_rough_and_its_fit_stiff(system: NodeSystem) -> None:
    points = sample_surface(Shape(system.verts, system.faces), 3000, np.random.default_rng(0)).points
    noise = np.random.default_rng(1).standard_normal(points.shape)
    none = np.empty((0, 3), np.int64)
    clean, some, much = (Shape(points + size * noise, none).roughness for size in (0.0, 0.01, 0.03))
    assert clean < 0.05 < some < much <= 1.0
    assert Shape(system.verts, system.faces).roughness == 0.0
    config = FitConfig()
    assert config.for_noise(clean).nodes.schedule.prior == pytest.approx(config.nodes.schedule.prior, rel=0.15)
    stiff = config.for_noise(1.0)
    assert stiff.nodes.schedule.prior == pytest.approx((0.003, 0.001))
    assert stiff.nodes.schedule.scale == pytest.approx((0.1, 0.06)) and stiff.samples > config.samples
    assert config.for_noise(0.0) is config
    agree = AgreeConfig()
    assert agree.for_noise(1.0).schedule.prior == pytest.approx((0.008, 0.008))
    assert (stiff.nodes.shared, agree.for_noise(1.0).shared, agree.for_noise(0.25).shared) == (1.0, 1.0, 0.25)
    assert agree.for_noise(0.0) == agree


def test_fits_of_rough_clouds_are_suited_to_them(system: NodeSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a cloud's roughness asks for reaches the refinement, alone and where two agree."""
    rng = np.random.default_rng(0)
    points = sample_surface(Shape(system.verts, system.faces), 900, rng).points
    clouds = [
        Shape(points + size * rng.standard_normal(points.shape), np.empty((0, 3), np.int64)) for size in (0.0, 0.04)
    ]
    asked: list[float] = []
    paired: list[int] = []

    def refined(system, scan, vectors, config, fixed):
        asked.append(config.schedule.prior[1])
        return refine_nodes(system, scan, vectors, config, fixed)

    quadratic = PairTerm.quadratic

    def paired_again(term, system, vectors, scale):
        paired.append(term.config.back_points)
        return quadratic(term, system, vectors, scale)

    monkeypatch.setattr("meshmatch.fitting.search.refinement.refine_nodes", refined)
    config = FitConfig(partial="no", variants=2, finalists=1, careful=1)
    fits = []
    for cloud in clouds:
        asked.clear()
        fits.append(replace(Fitter(egg_model(), config).fit(cloud), verdict="good"))
        expected = config.nodes.schedule.prior[1] * 10**cloud.roughness
        assert asked and asked == pytest.approx([expected] * len(asked))
    assert clouds[1].roughness > clouds[0].roughness + 0.3
    monkeypatch.setattr(PairTerm, "quadratic", paired_again)
    how = AgreeConfig(schedule=replace(AgreeConfig.schedule, steps=1), back_points=100)
    agreed_fits(egg_model(), clouds, fits, config, how=how)
    assert paired == [round(100 * (1 + cloud.roughness)) for cloud in clouds]
