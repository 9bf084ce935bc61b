"""Least squares on the nodes: its parts by hand, and laws of the whole."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.fitting.fit_config import NodeRefineConfig
from meshmatch.fitting.search.predictor import two_way_residual
from meshmatch.fitting.solve.nodes import refine_nodes
from meshmatch.fitting.solve.priors import nearest_rotations, signed_svd
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import PairTerm, robust_weight
from meshmatch.geometry.oriented import OrientedPoints, with_normals
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import gentle_vectors, scan_of

CONFIG = NodeRefineConfig()


@pytest.fixture(scope="module")
def truth(model: TrainedModel) -> np.ndarray:
    return gentle_vectors(model)


@pytest.fixture(scope="module")
def scan(system: NodeSystem, truth: np.ndarray) -> OrientedPoints:
    """Samples of the template under the true vectors."""
    return scan_of(Shape(system.moved(truth), system.faces), 2000)


def test_robust_weights_by_hand() -> None:
    offset = np.array([[0.0, 0, 0], [0, 0.1, 0], [0, 0, 0.2], [3, 4, 0]])
    assert np.allclose(robust_weight(offset, 0.1), [1, 1 / 4, 1 / 25, 1 / (1 + 2500) ** 2])


def test_the_areas_of_vertices_add_up_to_the_shapes(system: NodeSystem) -> None:
    areas = vertex_areas(system.verts, system.faces)
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(Shape(system.verts, system.faces).area)
    corner = vertex_areas(np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [9, 9, 9]]), np.array([[0, 1, 2]]))
    assert np.allclose(corner, [1, 1, 1, 0])


def test_the_nearest_rotation_is_the_one_that_was_applied() -> None:
    rng = np.random.default_rng(0)
    start = np.eye(3) + 0.2 * rng.normal(size=(20, 3, 3))
    turns = Rotation.random(20, random_state=1).as_matrix()
    assert np.allclose(nearest_rotations(turns @ start, start), turns)
    anything = nearest_rotations(rng.normal(size=(20, 3, 3)), start)  # mirrored ones too
    assert np.allclose(np.linalg.det(anything), 1)
    assert np.allclose(anything @ anything.transpose(0, 2, 1), np.eye(3))


def test_signed_singular_values_are_those_of_a_rotation() -> None:
    F = np.random.default_rng(0).normal(size=(50, 3, 3))
    U, sizes, Vh = signed_svd(F)
    assert np.allclose((U * sizes[:, None]) @ Vh, F) and np.allclose(np.linalg.det(U @ Vh), 1)
    assert np.array_equal(sizes[:, 2] < 0, np.linalg.det(F) < 0)


def test_nearest_rotations_are_those_of_singular_values() -> None:
    F, start = np.random.default_rng(0).normal(size=(2, 200, 3, 3))  # half of them turned inside out
    F[0], F[1, 0] = 0, F[1, 1]  # no rotation is nearest to nothing; a plane has one
    U, _, Vh = np.linalg.svd(F @ start.transpose(0, 2, 1))
    U[:, :, 2] *= np.linalg.det(U @ Vh)[:, None]
    found = nearest_rotations(F, start)
    assert np.allclose(found[1:], (U @ Vh)[1:])
    assert np.allclose(found @ found.transpose(0, 2, 1), np.eye(3)) and np.allclose(np.linalg.det(found), 1)


@pytest.mark.parametrize("weight", [CONFIG.pair_normals, 1.5])
def test_pairs_are_those_of_a_plain_loop(system: NodeSystem, weight: float) -> None:
    scan = scan_of(Shape(1.1 * system.verts + 0.02, system.faces), 60)
    config = replace(CONFIG, back_points=20, pair_normals=weight)
    vectors = np.zeros((system.K, 3))
    weights, pulls = PairTerm(scan, config).quadratic(system, vectors, 0.08)

    normals = system.normals(system.verts)
    seen = with_normals(system.verts, normals, weight)
    there = with_normals(scan.points, scan.normals, weight)
    area = vertex_areas(system.verts, system.faces)
    pairs = []
    for v in range(len(seen)):
        p = int(np.square(there - seen[v]).sum(1).argmin())
        pairs.append((v, p, area[v] / area.sum()))
    for p in range(0, 60, 3):
        v = int(np.square(seen - there[p]).sum(1).argmin())
        pairs.append((v, p, 1 / 20))
    H, s = np.zeros((len(seen), 3, 3)), np.zeros((len(seen), 3))
    for v, p, share in pairs:
        n, point = scan.normals[p], scan.points[p]
        if normals[v] @ n > config.normal_cosine:
            offset = system.verts[v] - point
            share *= 0.5 / (1 + offset @ offset / 0.08**2) ** 2
            term = share * (np.outer(n, n) + config.point_share * np.eye(3))
            H[v] += term
            s[v] += term @ point
    assert np.allclose(weights, H.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])
    assert np.allclose(pulls, s)
    assert weights.any()


def test_shared_pairs_are_those_of_a_plain_loop(system: NodeSystem) -> None:
    scan = scan_of(Shape(1.1 * system.verts + 0.02, system.faces), 60)
    config = replace(CONFIG, back_points=20, shared=1.0, spread=0.05)
    vectors = np.zeros((system.K, 3))
    normals, area = system.normals(system.verts), vertex_areas(system.verts, system.faces)
    H, s = np.zeros((len(area), 3, 3)), np.zeros((len(area), 3))
    for p in range(0, 60, 3):
        apart = np.linalg.norm(system.verts - scan.points[p], axis=1)
        near = np.argsort(apart)[:16]
        share = area[near] * np.exp(-0.5 * (apart[near] / 0.05) ** 2)
        share *= 1 / share.sum() / 20 / (1 + apart.min() ** 2 / 0.08**2) ** 2
        for v, weight in zip(near, share, strict=True):
            term = weight * (np.outer(normals[v], normals[v]) + config.point_share * np.eye(3))
            H[v] += term
            s[v] += term @ scan.points[p]
    weights, pulls = PairTerm(scan, config).quadratic(system, vectors, 0.08)
    assert np.allclose(weights, H.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]])
    assert np.allclose(pulls, s)
    # in between both kinds have their share
    nearest = PairTerm(scan, replace(config, shared=0.0)).quadratic(system, vectors, 0.08)
    mixed = PairTerm(scan, replace(config, shared=0.25)).quadratic(system, vectors, 0.08)
    for found, alone, together in zip(mixed, nearest, (weights, pulls), strict=True):
        assert np.allclose(found, 0.75 * alone + 0.25 * together)


def test_noise_that_shares_its_pairs_leaves_the_template_where_it_belongs(system: NodeSystem) -> None:
    """Points about a surface that rests: the nearest ones pull the template away, shared ones less."""
    clean = scan_of(Shape(system.verts, system.faces), 4000)
    noisy = clean.points + 0.03 * np.random.default_rng(0).standard_normal(clean.points.shape)
    scan = OrientedPoints(noisy, clean.normals)
    start = np.zeros((system.K, 3))
    moves = []
    for shared in (0.0, 1.0):
        config = replace(CONFIG, back_points=4000, point_share=1.0, shared=shared, spread=0.03)
        found = refine_nodes(system, scan, start, config)
        moves.append(np.linalg.norm(system.moved(found) - system.verts, axis=1).mean())
    assert moves[1] < 0.95 * moves[0]


def test_a_surface_that_faces_the_other_way_is_no_partner(system: NodeSystem, scan: OrientedPoints) -> None:
    inside_out = OrientedPoints(scan.points, -scan.normals)
    weights, _ = PairTerm(inside_out, CONFIG).quadratic(system, np.zeros((system.K, 3)), 0.1)
    # a few pairs reach the far side of the egg, where normals agree and the robust weight is nearly nothing
    right = PairTerm(scan, CONFIG).quadratic(system, np.zeros((system.K, 3)), 0.1)[0]
    assert weights.sum() < 0.05 * right.sum()


def off_surface(system: NodeSystem, vectors: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far vertices (V,) are off the true surface: sliding along it is what no scan can tell."""
    apart = system.moved(vectors) - system.moved(truth)
    return np.abs((apart * system.normals(system.moved(truth))).sum(1))


def test_a_small_bend_is_found_again(system: NodeSystem, scan: OrientedPoints, truth: np.ndarray) -> None:
    still = np.zeros_like(truth)
    found = refine_nodes(system, scan, still, CONFIG)
    assert off_surface(system, still, truth).mean() > 0.015
    assert off_surface(system, found, truth).mean() < 0.005
    assert two_way_residual(system, scan, found) < 0.8 * two_way_residual(system, scan, still)


def test_what_fits_already_stays(system: NodeSystem, scan: OrientedPoints, truth: np.ndarray) -> None:
    found = refine_nodes(system, scan, truth, CONFIG)
    assert off_surface(system, found, truth).max() < 0.01
    assert two_way_residual(system, scan, found) <= two_way_residual(system, scan, truth)


def test_each_step_lowers_the_energy_that_it_is_given(
    system: NodeSystem, scan: OrientedPoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pairs and weights change between the steps; within one, the quadratic energy goes down."""
    energies: list[tuple[float, float]] = []
    solve = NodeSystem.solve

    def watched(self, weights, pulls, strain, targets, damping, current):
        found = solve(self, weights, pulls, strain, targets, damping, current)

        def energy(vectors: np.ndarray) -> float:
            y = self.moved(vectors)
            H = weights[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
            data = np.einsum("va,vab,vb->", y, H, y) - 2 * (y * pulls).sum()
            bent = np.square(self.deformation_gradient(vectors) - targets).sum()
            return float(data + strain * bent + damping * np.square(vectors - current).sum())

        energies.append((energy(current), energy(found)))
        return found

    monkeypatch.setattr(NodeSystem, "solve", watched)
    refine_nodes(system, scan, np.zeros((system.K, 3)), CONFIG)
    assert len(energies) == CONFIG.schedule.steps
    assert all(after <= before for before, after in energies)
    assert energies[0][1] < energies[0][0]


def test_turning_everything_turns_the_answer(system: NodeSystem, scan: OrientedPoints, model: TrainedModel) -> None:
    Q = Rotation.from_rotvec([0.3, -0.9, 0.4]).as_matrix()
    turned = OrientedPoints(scan.points @ Q.T, scan.normals @ Q.T)
    nodes = model.template.nodes
    plain = refine_nodes(system, scan, np.zeros((system.K, 3)), CONFIG)
    other = refine_nodes(system, turned, nodes @ Q.T - nodes, CONFIG)
    assert np.allclose(nodes + other, (nodes + plain) @ Q.T, atol=1e-5)


def test_landmarks_are_met_and_the_rest_stays_on_the_surface(
    system: NodeSystem, scan: OrientedPoints, truth: np.ndarray
) -> None:
    """Pairs a little beside where the surface alone would put them."""
    at = np.array([3, 40, 90])
    free = refine_nodes(system, scan, truth, CONFIG)
    place = system.moved(free)[at] + 0.05 * np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])

    def apart(vectors: np.ndarray) -> float:
        return float(np.linalg.norm(system.moved(vectors)[at] - place, axis=1).mean())

    held = refine_nodes(system, scan, truth, CONFIG, (at, place))
    loose = refine_nodes(system, scan, truth, replace(CONFIG, landmark_weight=0.0), (at, place))
    firm = refine_nodes(system, scan, truth, replace(CONFIG, landmark_weight=5.0), (at, place))
    assert np.array_equal(loose, free)
    assert apart(firm) < apart(held) < 0.2 * apart(free)
    assert apart(firm) < 0.001
    assert off_surface(system, held, truth).mean() < 0.01


def test_of_a_part_only_what_is_near_it_is_pulled(system: NodeSystem, scan: OrientedPoints, truth: np.ndarray) -> None:
    upper = scan.points[:, 1] > 0
    half, scale = OrientedPoints(scan.points[upper], scan.normals[upper]), 0.03
    moved = system.moved(truth)
    to_half = half.tree.query(with_normals(moved, system.normals(moved)))[1]
    far = np.linalg.norm(moved - half.points[to_half], axis=1) >= 3 * scale
    never = far & (moved[:, 1] < -0.2)  # nor do points of the half ask for these
    assert never.sum() > 20
    config = replace(CONFIG, normal_cosine=-1.0)
    whole, part = (PairTerm(half, config, one_sided).quadratic(system, truth, scale)[0] for one_sided in (False, True))
    assert (whole[never] != 0).any(1).all()
    assert (part[never] == 0).all()
    assert np.array_equal(part[~far], whole[~far])


def test_no_steps_change_nothing(system: NodeSystem, scan: OrientedPoints) -> None:
    none = replace(CONFIG, schedule=replace(CONFIG.schedule, steps=0))
    ones = np.ones((system.K, 3))
    assert np.array_equal(refine_nodes(system, scan, ones, none), ones)


def test_samples_of_weight_zero_do_not_pull(system: NodeSystem, scan: OrientedPoints, truth: np.ndarray) -> None:
    """Half of the egg is shown too large: the template follows if it is trusted, and is held by its prior if not."""
    top = scan.points[:, 1] > 0
    lifted = OrientedPoints(scan.points + 0.03 * top[:, None] * scan.normals, scan.normals)
    masked = replace(lifted, weights=np.where(top, 0.0, 1.0))
    there = system.moved(truth)[:, 1] > 0.05
    off = [
        off_surface(system, refine_nodes(system, each, truth, CONFIG), truth)[there].mean()
        for each in (scan, lifted, masked)
    ]
    assert off[0] < 0.003
    assert off[1] > 0.02
    assert off[2] < 0.4 * off[1]


@pytest.mark.parametrize("shared", [0.0, 0.5, 1.0])
def test_weights_of_samples_scale_their_pairs(
    system: NodeSystem, scan: OrientedPoints, truth: np.ndarray, shared: float
) -> None:
    config = replace(CONFIG, shared=shared)
    plain = PairTerm(scan, config).quadratic(system, truth, 0.1)
    for weight in (0.0, 0.5, 1.0):
        weighted = replace(scan, weights=np.full(len(scan.points), weight))
        for terms, expected in zip(PairTerm(weighted, config).quadratic(system, truth, 0.1), plain, strict=True):
            assert np.allclose(terms, weight * expected)
