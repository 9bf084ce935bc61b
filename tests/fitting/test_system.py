"""The compiled least squares against a dense one written out, on a template of 36 nodes."""

import numpy as np
import pytest

from meshmatch.fitting.solve import banded
from meshmatch.fitting.solve.banded import Envelope, solved_band
from meshmatch.fitting.solve.system import NodeSystem, _DensePairs, node_system
from meshmatch.geometry.kernels import KERNELS
from meshmatch.models.trained import TrainedModel
from tests.fitting.eggs import egg_model, gentle_vectors

ORDER = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]


@pytest.fixture(scope="module", params=KERNELS)
def model(request: pytest.FixtureRequest) -> TrainedModel:
    return egg_model(request.param)


@pytest.fixture(scope="module")
def system(model: TrainedModel) -> NodeSystem:
    shape = model.template.shape
    return NodeSystem(shape, model.field(shape.verts), gradient_points=40)


class Problem:
    """Random terms of a solve, with roots of the weights: H_p = A_p^T A_p. A third of the vertices have none."""

    def __init__(self, system: NodeSystem, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        V, G = len(system.verts), len(system.gradient_points)
        self.roots = rng.normal(size=(V, 3, 3)) * (rng.random((V, 1, 1)) < 2 / 3)
        self.places = rng.normal(size=(V, 3))
        self.targets = rng.normal(size=(G, 3, 3))
        self.current = rng.normal(size=(system.K, 3))
        self.strain, self.damping = 0.7, 0.05
        H = self.roots.transpose(0, 2, 1) @ self.roots
        self.weights = np.stack([H[:, a, b] for a, b in ORDER], 1)
        self.pulls = np.einsum("vab,vb->va", H, self.places)

    def solve(self, system: NodeSystem) -> np.ndarray:
        return system.solve(self.weights, self.pulls, self.strain, self.targets, self.damping, self.current)

    def rows(self, system: NodeSystem) -> tuple[np.ndarray, np.ndarray]:
        """Matrix and right-hand side, a row for each residual; unknown 3 k + a is component a of node k."""
        phi, slopes = system.phi.toarray(), system.equations.gradient.toarray().reshape(-1, 3, system.K)
        eye = np.eye(3)
        data = np.einsum("vab,vk->vakb", self.roots, phi).reshape(-1, 3 * system.K)
        offset = np.einsum("vab,vb->va", self.roots, self.places - system.verts).ravel()
        # F[g, a, b] = delta_ab + sum_k u_ka slopes[g, b, k]
        strain = np.sqrt(self.strain) * np.einsum("gbk,ac->gabkc", slopes, eye).reshape(-1, 3 * system.K)
        wanted = np.sqrt(self.strain) * (self.targets - eye).ravel()
        still = np.sqrt(self.damping) * np.eye(3 * system.K)
        return (
            np.concatenate([data, strain, still]),
            np.concatenate([offset, wanted, np.sqrt(self.damping) * self.current.ravel()]),
        )

    def energy(self, system: NodeSystem, vectors: np.ndarray) -> float:
        matrix, right = self.rows(system)
        return float(np.square(matrix @ vectors.ravel() - right).sum())


@pytest.mark.parametrize("seed", [0, 1])
def test_the_solution_is_that_of_dense_least_squares(system: NodeSystem, seed: int) -> None:
    problem = Problem(system, seed)
    matrix, right = problem.rows(system)
    wanted = np.linalg.lstsq(matrix, right, rcond=None)[0].reshape(-1, 3)
    assert np.allclose(problem.solve(system), wanted, atol=1e-8)


def test_weights_of_no_direction_are_solved_as_any_other(system: NodeSystem) -> None:
    problem = Problem(system)
    problem.roots = np.abs(problem.roots[:, :1, :1]) * np.eye(3)
    problem.weights = np.square(problem.roots[:, 0, 0])[:, None] * np.array([1.0, 0, 0, 1, 0, 1])
    problem.pulls = problem.weights[:, :1] * problem.places
    matrix, right = problem.rows(system)
    wanted = np.linalg.lstsq(matrix, right, rcond=None)[0].reshape(-1, 3)
    assert np.allclose(problem.solve(system), wanted, atol=1e-8)


def test_products_too_many_to_be_kept_are_formed_anew(
    model: TrainedModel, system: NodeSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = int((np.diff(system.phi.indptr) ** 2).sum())
    shape, problem = model.template.shape, Problem(system)
    for most, formed in ((kept, False), (kept - 1, True)):
        monkeypatch.setattr("meshmatch.fitting.solve.system._MAX_PRODUCTS", most)
        other = NodeSystem(shape, model.field(shape.verts), gradient_points=40)
        assert isinstance(other.equations.pairs, _DensePairs) == formed
        assert np.allclose(problem.solve(other), problem.solve(system), atol=1e-8)


def test_a_step_never_raises_the_energy_that_it_minimises(system: NodeSystem) -> None:
    problem = Problem(system)
    found = problem.solve(system)
    lowest = problem.energy(system, found)
    rng = np.random.default_rng(5)
    assert lowest < problem.energy(system, problem.current)
    for _ in range(5):
        assert lowest < problem.energy(system, found + 0.01 * rng.normal(size=found.shape))


def test_nothing_changes_what_the_caller_holds(system: NodeSystem) -> None:
    problem = Problem(system)
    names = ("weights", "pulls", "targets", "current")
    before = {name: getattr(problem, name).copy() for name in names}
    first = problem.solve(system)
    assert all(np.array_equal(getattr(problem, name), before[name]) for name in names)
    assert np.array_equal(problem.solve(system), first)


def test_what_holds_already_is_left_alone(system: NodeSystem, model: TrainedModel) -> None:
    """Every point at its place and every gradient at its target: the current vectors are the answer."""
    problem = Problem(system)
    problem.current = gentle_vectors(model)
    H = problem.roots.transpose(0, 2, 1) @ problem.roots
    problem.pulls = np.einsum("vab,vb->va", H, system.moved(problem.current))
    problem.targets = system.deformation_gradient(problem.current)
    assert np.allclose(problem.solve(system), problem.current, atol=1e-10)


def test_an_affine_motion_of_the_nodes_moves_the_template_by_it(system: NodeSystem, model: TrainedModel) -> None:
    rng = np.random.default_rng(0)
    A, t = np.eye(3) + 0.3 * rng.normal(size=(3, 3)), rng.normal(size=3)
    nodes = model.template.nodes
    vectors = nodes @ A.T + t - nodes
    assert np.allclose(system.moved(vectors), system.verts @ A.T + t, atol=1e-5)
    assert np.allclose(system.deformation_gradient(vectors), A, atol=1e-4)


def test_the_gradient_is_the_slope_of_the_motion(system: NodeSystem, model: TrainedModel) -> None:
    """F of a smooth bend against differences of the bend itself, which the field nearly reproduces."""
    vectors, at, step = gentle_vectors(model), system.gradient_points, 1e-4
    F = system.deformation_gradient(vectors)
    for axis in range(3):
        aside = np.zeros(3)
        aside[axis] = step
        there, back = (model.field(system.verts[at] + sign * aside) for sign in (1, -1))
        phi = (there.phi.toarray() - back.phi.toarray()).astype(float) / (2 * step)
        assert np.allclose(F[:, :, axis] - np.eye(3)[axis], phi @ vectors, atol=5e-3)


def test_normals_are_unit_and_outward_and_turn_along(system: NodeSystem, model: TrainedModel) -> None:
    normals = system.normals(system.verts)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    assert ((normals * system.verts).sum(1) > 0).all()
    a, b, c = (system.verts[system.faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    by_hand = flat[(system.faces == 7).any(1)].sum(0)
    assert np.allclose(normals[7], by_hand / np.linalg.norm(by_hand))
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(system.normals(system.verts @ turn.T), normals @ turn.T)


def test_the_system_of_a_model_is_built_once(model: TrainedModel) -> None:
    assert node_system(model) is node_system(model)
    assert len(node_system(model).gradient_points) == model.template.shape.V  # fewer than the most there may be
    assert len(np.unique(node_system(model).gradient_points)) == model.template.shape.V


@pytest.mark.parametrize("exported", [True, False])
def test_a_band_is_solved_as_the_whole_matrix_is(exported: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not exported:
        monkeypatch.setattr(banded, "_LAPACK", None)
    elif banded._LAPACK is None:
        pytest.skip("SciPy exports it with other types")
    rng, N, above = np.random.default_rng(0), 30, 6
    band = rng.normal(size=(N, above + 1))
    band[:, 0] += 20
    right, whole = rng.normal(size=N), np.zeros((N, N))
    for i in range(N):
        for k in range(min(above + 1, N - i)):
            whole[i + k, i] = whole[i, i + k] = band[i, k]
    np.testing.assert_allclose(solved_band(band.copy(), right.copy()), np.linalg.solve(whole, right), rtol=1e-10)
    rows = rng.normal(size=(3, N))
    np.testing.assert_allclose(solved_band(band.copy(), rows.copy()), np.linalg.solve(whole, rows.T).T, rtol=1e-9)
    band[12, 0] = -50.0
    with pytest.raises(np.linalg.LinAlgError):
        solved_band(band, right)


@pytest.mark.parametrize("exported", [True, False])
@pytest.mark.parametrize("reaches", [(3, 3, 3), (2, 41, 6), (0, 0, 0), (7, 99, 99)], ids=str)
def test_an_envelope_is_solved_as_the_whole_matrix_is(
    exported: bool, reaches: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    if not exported:
        monkeypatch.setattr(banded, "_LAPACK", None)
    elif banded._LAPACK is None:
        pytest.skip("SciPy exports it with other types")
    rng, N = np.random.default_rng(0), 100
    reach = np.repeat(reaches, [40, 30, 30])
    ends = np.maximum.accumulate(np.minimum(np.arange(N) + reach + 1, N))
    envelope = Envelope(ends)
    band, whole = np.zeros((N, envelope.columns)), np.zeros((N, N))
    for i in range(N):
        band[i, : ends[i] - i] = rng.normal(size=ends[i] - i)
        band[i, 0] = 50.0
        whole[i : ends[i], i] = whole[i, i : ends[i]] = band[i, : ends[i] - i]
    right = rng.normal(size=N)
    np.testing.assert_allclose(envelope.solve(band.copy(), right.copy()), np.linalg.solve(whole, right), rtol=1e-10)
    band[67, 0] = -50.0
    with pytest.raises(np.linalg.LinAlgError, match="68"):
        envelope.solve(band.copy(), right)
    if exported:
        with pytest.raises(ValueError, match="envelope"):
            envelope.solve(np.zeros((N, envelope.columns + 1)), right)
