"""Moving least squares: a slow textbook oracle, finite differences in float64, and the laws."""

import warnings
from contextlib import nullcontext, suppress
from typing import Any

import numpy as np
import pytest
import torch

from meshmatch.errors import InputError, MeshmatchError, MeshmatchWarning, OptionError, TemplateError
from meshmatch.fields.field import Field, arap_energy, volume_energy
from meshmatch.fields.shape_functions import build_field
from meshmatch.geometry.kernels import KERNELS, MINIMUM_EIGENVALUE, poorly_supported


def weight(x, q, r, kernel):
    d = np.linalg.norm(x - q)
    if d > r:
        return 0.0
    return (1 - d / r) ** 3 if kernel == "cubic" else (1 - d**2 / r**2) ** 3


def textbook_phi(x, nodes, radii, kernel):
    """Phi_i = p(x)^T M^-1 w_i p(q_i), written as the formula reads, in the global basis."""

    def p(y):
        return np.array([1.0, *y])

    held = list(zip(nodes, np.broadcast_to(radii, len(nodes)), strict=True))
    M = sum(weight(x, q, r, kernel) * np.outer(p(q), p(q)) for q, r in held)
    left = p(x) @ np.linalg.inv(M)
    return np.array([left @ (weight(x, q, r, kernel) * p(q)) for q, r in held])


def textbook_gradient(x, nodes, r, kernel, h=1e-6):
    rows = []
    for k in range(3):
        e = np.zeros(3)
        e[k] = h
        rows.append((textbook_phi(x + e, nodes, r, kernel) - textbook_phi(x - e, nodes, r, kernel)) / (2 * h))
    return np.array(rows)


@pytest.fixture
def cloud():
    rng = np.random.default_rng(0)
    return rng.uniform(-0.6, 0.6, (12, 3)), rng.uniform(-1, 1, (150, 3))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("radius", [0.7, np.linspace(0.4, 1.3, 150)], ids=["one", "each"])
def test_shape_functions_and_gradient_equal_the_textbook(cloud, kernel, radius):
    """Of nodes that share a radius, and of nodes with their own."""
    points, nodes = cloud
    field = Field.of(build_field(points, nodes, radius, kernel))
    phi = field.phi.to_dense().numpy()
    gradient = field.gradient.to_dense().numpy().reshape(len(points), 3, -1)
    for n, x in enumerate(points):
        assert np.allclose(phi[n], textbook_phi(x, nodes, radius, kernel), atol=1e-5)
        assert np.allclose(gradient[n], textbook_gradient(x, nodes, radius, kernel), atol=2e-4)


@pytest.mark.parametrize("kernel", KERNELS)
def test_laws(cloud, kernel):
    points, nodes = cloud
    field = Field.of(build_field(points, nodes, 0.7, kernel))
    phi = field.phi.to_dense().double().numpy()
    assert np.allclose(phi.sum(1), 1, atol=1e-5)
    assert np.allclose(phi @ nodes, points, atol=1e-5)
    assert (phi[np.linalg.norm(points[:, None] - nodes, axis=2) > 0.7] == 0).all()
    assert torch.equal(field.displacement(torch.zeros(2, len(nodes), 3)), torch.zeros(2, len(points), 3))


@pytest.mark.parametrize("kernel", KERNELS)
def test_an_affine_motion_of_the_nodes_is_affine_everywhere(cloud, kernel):
    points, nodes = cloud
    field = Field.of(build_field(points, nodes, 0.7, kernel))
    A = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3], [0.0, 0.1, 1.2]])
    vectors = torch.from_numpy(nodes @ (A - np.eye(3)).T + 0.5).float()[None]
    assert np.allclose(field.displacement(vectors)[0].numpy(), points @ (A - np.eye(3)).T + 0.5, atol=1e-5)
    assert np.allclose(field.deformation_gradient(vectors)[0].numpy(), A, atol=1e-4)


def test_a_rigid_motion_has_no_energy_and_a_stretch_has(cloud):
    points, nodes = cloud
    field = Field.of(build_field(points, nodes, 0.7, "smooth"))
    angle = 0.7
    R = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    rigid = field.deformation_gradient(torch.from_numpy(nodes @ (R - np.eye(3)).T + 0.1).float()[None])
    assert volume_energy(rigid).max() < 1e-7
    assert arap_energy(rigid).max() < 1e-3
    double = field.deformation_gradient(torch.from_numpy(nodes).float()[None])  # x -> 2 x
    assert torch.allclose(volume_energy(double), torch.tensor(49.0), rtol=1e-3)  # (8 - 1)^2
    assert torch.allclose(arap_energy(double), torch.tensor(27.0).sqrt(), rtol=1e-3)  # |4 I - I|


def test_energies_equal_the_plain_formulas():
    F = torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.allclose(volume_energy(F), (torch.linalg.det(F) - 1).square())
    plain = torch.linalg.matrix_norm(F.transpose(1, 2) @ F - torch.eye(3, dtype=F.dtype))
    assert torch.allclose(arap_energy(F), plain, atol=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_slope_is_the_derivative(kernel):
    d = torch.linspace(0.01, 0.99, 30, dtype=torch.float64)
    r = torch.ones_like(d)
    slope = KERNELS[kernel](d, r)[1]
    h = 1e-6
    numeric = (KERNELS[kernel](d + h, r)[0] - KERNELS[kernel](d - h, r)[0]) / (2 * h)
    assert torch.allclose(slope * d, numeric, atol=1e-6)
    assert KERNELS[kernel](torch.tensor([1.5]), torch.ones(1))[0] == 0
    assert KERNELS["cubic"](torch.zeros(1), torch.ones(1))[1] == 0


def test_far_from_the_origin_float32_holds():
    rng = np.random.default_rng(1)
    points, nodes = rng.uniform(-0.5, 0.5, (20, 3)), rng.uniform(-1, 1, (150, 3))
    near = Field.of(build_field(points, nodes, 0.7, "smooth")).phi.to_dense()
    far = Field.of(build_field(points + 1000, nodes + 1000, 0.7, "smooth")).phi.to_dense()
    assert torch.allclose(near, far, atol=1e-5)


def test_a_point_out_of_reach_is_named():
    nodes = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    with pytest.raises(TemplateError, match="points 1"):
        Field.of(build_field(np.array([[0.0, 0, 0], [9.0, 0, 0]]), nodes, 0.8, "smooth"))


def test_coplanar_nodes_are_not_enough():
    flat = np.random.default_rng(0).uniform(-1, 1, (100, 3)) * [1, 1, 0]
    with pytest.raises(TemplateError, match="non-coplanar"):
        Field.of(build_field(np.zeros((1, 3)), flat, 0.8, "smooth"))


@pytest.mark.parametrize(("lift", "told"), [(0.5, False), (0.02, True)])
def test_nodes_nearly_in_a_plane_are_told(lift, told):
    """A point above three nodes and one a little above these moves by the quotient of the heights."""
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.4, 0.4, lift]], float)
    largest = np.abs(np.linalg.solve(np.concatenate([nodes.T, np.ones((1, 4))]), [0.3, 0.3, 0.6, 1.0])).sum()
    with pytest.warns(MeshmatchWarning, match=f"may move by {largest:,.0f} times") if told else nullcontext():
        field = build_field([[0.3, 0.3, 0.6]], nodes, 2.0, "smooth")
    assert abs(field.phi).sum() == pytest.approx(largest, rel=1e-3)


def test_what_is_told_is_bounded():
    """Whatever nodes are accepted, the sum of the absolute shape functions is at most 1 / sqrt(MINIMUM_EIGENVALUE)."""
    rng, accepted = np.random.default_rng(0), []
    for height in np.geomspace(0.2, 1e-3, 40):
        nodes = rng.uniform(-1, 1, (8, 3)) * [1, 1, height]
        with suppress(TemplateError), warnings.catch_warnings(record=True):
            warnings.simplefilter("always")
            accepted.append(abs(build_field([[0.2, 0.1, 0.9]], nodes, 2.0, "smooth").phi).sum())
    assert 10 < len(accepted) < 40 and 50 < max(accepted) <= MINIMUM_EIGENVALUE**-0.5


def test_wide_nodes_among_narrow_ones_are_as_well_conditioned():
    """Far from the narrow nodes a point sees wide ones alone; in the narrow ones' unit it would seem unsupported."""
    rng = np.random.default_rng(3)
    nodes = np.concatenate([rng.normal(0, 0.01, (200, 3)), rng.normal(5, 0.5, (40, 3))])
    radii = np.repeat([0.005, 2.0], [200, 40])
    points = np.full((1, 3), 5.0)
    assert poorly_supported(points, nodes, radii).tolist() == []
    both = build_field(points, nodes, radii, "smooth").phi.toarray()
    wide = build_field(points, nodes[200:], 2.0, "smooth").phi.toarray()
    assert np.allclose(both[:, 200:], wide, atol=1e-6) and not both[:, :200].any()


@pytest.mark.parametrize(
    ("changes", "error", "words"),
    [
        ({"points": np.full((2, 3), np.nan)}, InputError, "points must be finite"),
        ({"points": np.zeros((2, 2))}, InputError, r"points must be an array of \(N, 3\), not \(2, 2\)"),
        ({"nodes": np.zeros(3)}, InputError, "nodes must be an array"),
        ({"nodes": [["a", "b", "c"]]}, InputError, "nodes must be numbers"),
        ({"radius": 0.0}, InputError, "radius must be positive"),
        ({"radius": np.inf}, InputError, "radius must be finite"),
        ({"radius": np.ones(3)}, InputError, "one for each of 8 nodes"),
        ({"kernel": "gaussian"}, OptionError, "invalid kernel 'gaussian'"),
    ],
)
def test_what_a_field_cannot_be_made_of_is_refused_in_words(
    changes: dict[str, Any], error: type[MeshmatchError], words: str
) -> None:
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), -1).reshape(-1, 3)
    given: dict[str, Any] = {"points": corners / 2, "nodes": corners, "radius": 2.0, "kernel": "smooth"}
    assert build_field(**given).phi.shape == (8, 8)
    with pytest.raises(error, match=words):
        build_field(**(given | changes))
