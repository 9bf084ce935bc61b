"""Radial basis functions: a slow textbook oracle, finite differences in float64, and what they promise."""

import numpy as np
import pytest
import torch

from meshmatch.errors import TemplateError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import build_rbf


@pytest.fixture
def cloud() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-0.6, 0.6, (9, 3)), rng.uniform(-1, 1, (40, 3))


def textbook(x: np.ndarray, nodes: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """f(x) = sum_i (Phi^-1 U)_i phi(x, q_i), phi = sqrt(1 + 50 |a - b|^2) with shapes in the unit sphere, as it reads."""
    size = max(float(np.linalg.norm(q - nodes.mean(0))) for q in nodes)

    def phi(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.sqrt(1 + 50 * ((a - b) @ (a - b)) / size**2))

    matrix = np.array([[phi(a, b) for b in nodes] for a in nodes])
    coefficients = np.linalg.solve(matrix, vectors)
    total = np.zeros(3)
    for c, q in zip(coefficients, nodes, strict=True):
        total += c * phi(x, q)
    return total


def test_displacement_and_gradient_equal_the_textbook(cloud: tuple[np.ndarray, np.ndarray]) -> None:
    points, nodes = cloud
    vectors = np.random.default_rng(1).standard_normal((len(nodes), 3))
    field = Field.of(build_rbf(points, nodes))
    given = torch.from_numpy(vectors).float()[None]
    moved, F = field.displacement(given)[0].numpy(), field.deformation_gradient(given)[0].numpy()
    for n, x in enumerate(points):
        assert np.allclose(moved[n], textbook(x, nodes, vectors), atol=1e-4)
        slopes = [
            (textbook(x + step, nodes, vectors) - textbook(x - step, nodes, vectors)) / 2e-5
            for step in 1e-5 * np.eye(3)
        ]
        assert np.allclose(F[n], np.eye(3) + np.transpose(slopes), atol=1e-3)


def test_the_field_passes_through_its_node_vectors(cloud: tuple[np.ndarray, np.ndarray]) -> None:
    nodes = cloud[1]
    assert np.allclose(Field.of(build_rbf(nodes, nodes)).phi.numpy(), np.eye(len(nodes)), atol=1e-6)


def test_a_shift_of_all_nodes_is_nearly_one_of_the_points() -> None:
    """Nearly: the multiquadric reproduces no polynomial, and comes close inside a dense set of nodes."""
    ticks = np.linspace(-1, 1, 6)
    nodes = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    points = np.random.default_rng(2).uniform(-0.5, 0.5, (20, 3))
    sums = Field.of(build_rbf(points, nodes)).phi.sum(1).numpy()
    assert np.allclose(sums, 1, atol=0.01)
    assert not np.allclose(sums, 1, atol=1e-7)


def test_unit_and_place_do_not_matter(cloud: tuple[np.ndarray, np.ndarray]) -> None:
    points, nodes = cloud
    near, far = Field.of(build_rbf(points, nodes)), Field.of(build_rbf(100 * points + 5, 100 * nodes + 5))
    assert torch.allclose(near.phi, far.phi, atol=1e-5)
    assert torch.allclose(near.gradient, 100 * far.gradient, atol=1e-4)


def test_two_nodes_in_one_place_are_refused(cloud: tuple[np.ndarray, np.ndarray]) -> None:
    points, nodes = cloud
    with pytest.raises(TemplateError, match="too close together") as caught:
        Field.of(build_rbf(points, np.concatenate([nodes, nodes[:1]])))
    assert "rbf" in caught.value.hint
