"""Moving least squares in the whole cube: the functions of `build_field`, one radius for each node, no point without."""

import numpy as np
import pytest
import torch

from meshmatch.experiments.implicit_nodes import CUBE_RADIUS, cube_nodes, field_at
from meshmatch.fields.field import Field, arap_energy, volume_energy
from meshmatch.fields.shape_functions import build_field
from meshmatch.geometry.kernels import KERNELS, Kernel, poorly_supported


def nodes_and_radii(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Nodes near a sphere, and those on the cube."""
    near = np.random.default_rng(seed).normal(size=(80, 3))
    near *= 0.6 / np.linalg.norm(near, axis=1, keepdims=True)
    far = cube_nodes()
    return np.concatenate([near, far]), np.concatenate([np.full(80, 0.4), np.full(len(far), CUBE_RADIUS)])


def field_of(points: np.ndarray, kernel: Kernel = "smooth", kind: torch.dtype = torch.float64) -> Field:
    tensors = (torch.from_numpy(each).to(kind) for each in (points, *nodes_and_radii()))
    return field_at(*tensors, kernel)


POINTS = np.random.default_rng(1).uniform(-1, 1, (300, 3))


def test_nodes_lie_on_vertices_and_edges_of_the_cube() -> None:
    nodes = cube_nodes()
    assert len(nodes) == 8 + 12 * 3
    assert ((np.abs(nodes) == 1).sum(1) >= 2).all()
    assert len(cube_nodes(0)) == 8


@pytest.mark.parametrize("kernel", list(KERNELS))
def test_every_point_of_the_cube_has_enough_nodes_of_the_cube_alone(kernel: Kernel) -> None:
    ticks = np.linspace(-1, 1, 17)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks), -1).reshape(-1, 3)
    nodes = cube_nodes()
    assert len(poorly_supported(grid, nodes, CUBE_RADIUS, kernel)) == 0
    assert len(poorly_supported(grid, nodes, 1.3, kernel)) > 0  # a smaller radius would leave holes


@pytest.mark.parametrize("kernel", list(KERNELS))
def test_it_is_the_field_of_fixed_points(kernel: Kernel) -> None:
    found, wanted = field_of(POINTS, kernel), build_field(POINTS, *nodes_and_radii(), kernel)
    assert np.abs(found.phi.numpy() - wanted.phi.toarray()).max() < 1e-6
    assert np.abs(found.gradient.numpy() - wanted.gradient.toarray()).max() < 1e-5


@pytest.mark.parametrize(("kind", "limit"), [(torch.float64, 1e-10), (torch.float32, 1e-3)])
def test_affine_maps_are_reproduced_everywhere(kind: torch.dtype, limit: float) -> None:
    A = np.random.default_rng(2).normal(size=(3, 3))
    nodes = nodes_and_radii()[0]
    field = field_of(POINTS, kind=kind)
    assert (field.phi.sum(1) - 1).abs().max() < limit
    vectors = torch.from_numpy(nodes @ A.T + 0.3 - nodes).to(kind)[None]
    moved = POINTS + field.displacement(vectors)[0].double().numpy()
    assert np.abs(moved - (POINTS @ A.T + 0.3)).max() < limit
    assert np.abs(field.deformation_gradient(vectors)[0].double().numpy() - A).max() < limit


def test_its_gradient_is_that_of_finite_differences() -> None:
    field, step = field_of(POINTS), 1e-5
    for k in range(3):
        ahead, behind = (field_of(POINTS + sign * step * np.eye(3)[k]).phi for sign in (1, -1))
        wanted = (ahead - behind) / (2 * step)
        assert (field.gradient.unflatten(0, (-1, 3))[:, k] - wanted).abs().max() < 1e-5


def test_a_rigid_motion_costs_no_energy() -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    nodes = nodes_and_radii()[0]
    F = field_of(POINTS).deformation_gradient(torch.from_numpy(nodes @ turn.T + 0.1 - nodes)[None])
    assert volume_energy(F).max() < 1e-12
    assert arap_energy(F).max() < 1e-5


def test_without_a_gradient_phi_is_the_same() -> None:
    tensors = [torch.from_numpy(each) for each in (POINTS, *nodes_and_radii())]
    alone = field_at(*tensors, "smooth", gradient=False)
    assert torch.equal(alone.phi, field_at(*tensors, "smooth").phi)
    assert len(alone.gradient) == 0
