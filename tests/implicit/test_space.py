"""Moving least squares in the whole cube: the functions of `build_field`, one radius for each node, no point without."""

import numpy as np
import pytest
import torch

from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.fields.shape_functions import build_field
from meshmatch.geometry.kernels import KERNELS, Kernel, poorly_supported
from meshmatch.implicit.space import CUBE_RADIUS, SpaceField, cube_nodes


def nodes_and_radii(seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Nodes near a sphere, and those on the cube."""
    near = np.random.default_rng(seed).normal(size=(80, 3))
    near *= 0.6 / np.linalg.norm(near, axis=1, keepdims=True)
    far = cube_nodes()
    return np.concatenate([near, far]), np.concatenate([np.full(80, 0.4), np.full(len(far), CUBE_RADIUS)])


def field_of(points: np.ndarray, kernel: Kernel = "smooth", kind: torch.dtype = torch.float64) -> SpaceField:
    at, nodes, radii = (torch.from_numpy(each).to(kind) for each in (points, *nodes_and_radii()))
    return SpaceField.at(at[None], nodes, radii, kernel)


POINTS = np.random.default_rng(1).uniform(-1, 1, (300, 3))
NODES = nodes_and_radii()[0]
VECTORS = torch.from_numpy(np.random.default_rng(2).normal(size=(1, len(NODES), 3)))


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
    u = wanted.phi.toarray() @ VECTORS[0].numpy()
    J = (wanted.gradient.toarray() @ VECTORS[0].numpy()).reshape(-1, 3, 3).transpose(0, 2, 1)
    assert np.abs(found.displacement(VECTORS)[0].numpy() - u).max() < 1e-5 * np.abs(u).max()
    assert np.abs(found.jacobian(VECTORS)[0].numpy() - J).max() < 1e-5 * np.abs(J).max()


@pytest.mark.parametrize(("kind", "limit"), [(torch.float64, 1e-10), (torch.float32, 1e-3)])
def test_affine_maps_are_reproduced_everywhere(kind: torch.dtype, limit: float) -> None:
    A = np.random.default_rng(2).normal(size=(3, 3))
    field = field_of(POINTS, kind=kind)
    vectors = torch.from_numpy(NODES @ A.T + 0.3 - NODES).to(kind)[None]
    moved = POINTS + field.displacement(vectors)[0].double().numpy()
    assert np.abs(moved - (POINTS @ A.T + 0.3)).max() < limit
    F = np.eye(3) + field.jacobian(vectors)[0].double().numpy()
    assert np.abs(F - A).max() < limit


def test_each_shape_has_its_own_points_and_vectors() -> None:
    at, nodes, radii = (torch.from_numpy(each) for each in (POINTS.reshape(3, 100, 3), *nodes_and_radii()))
    vectors = torch.cat([VECTORS, 2 * VECTORS, -VECTORS])
    both = SpaceField.at(at, nodes, radii, "smooth")
    for k in range(3):
        alone = SpaceField.at(at[k : k + 1], nodes, radii, "smooth")
        assert torch.allclose(both.displacement(vectors)[k], alone.displacement(vectors[k : k + 1])[0])
        assert torch.allclose(both.jacobian(vectors)[k], alone.jacobian(vectors[k : k + 1])[0])


def test_its_gradient_is_that_of_finite_differences() -> None:
    found, step = field_of(POINTS).jacobian(VECTORS)[0], 1e-5
    for k in range(3):
        ahead, behind = (field_of(POINTS + sign * step * np.eye(3)[k]).displacement(VECTORS)[0] for sign in (1, -1))
        assert (found[..., k] - (ahead - behind) / (2 * step)).abs().max() < 1e-5


def test_a_rigid_motion_costs_no_energy() -> None:
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    F = torch.eye(3) + field_of(POINTS).jacobian(torch.from_numpy(NODES @ turn.T + 0.1 - NODES)[None])
    assert volume_energy(F).max() < 1e-12
    assert arap_energy(F).max() < 1e-5


def test_without_a_gradient_the_displacement_is_the_same() -> None:
    at, nodes, radii = (torch.from_numpy(each) for each in (POINTS[None], *nodes_and_radii()))
    alone = SpaceField.at(at, nodes, radii, "smooth", gradient=False)
    assert torch.equal(alone.displacement(VECTORS), field_of(POINTS).displacement(VECTORS))
    assert alone.change is None
