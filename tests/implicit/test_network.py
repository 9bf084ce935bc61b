"""Both deformations answer the same questions, and their gradients are those of finite differences."""

import numpy as np
import pytest
import torch

from meshmatch.implicit.network import ImplicitNetwork
from meshmatch.implicit.space import CUBE_RADIUS, cube_nodes
from tests.implicit.boxes import config

BOTH = pytest.mark.parametrize("deformation", ["mls", "pointwise"])


def network(deformation: str) -> ImplicitNetwork:
    """An untrained one in float64, its deformation large enough to be seen."""
    torch.manual_seed(0)
    near = torch.from_numpy(np.random.default_rng(0).uniform(-0.7, 0.7, (20, 3)))
    nodes = torch.cat([near, torch.from_numpy(cube_nodes())])
    radii = torch.cat([torch.full((20,), 0.5), torch.full((44,), CUBE_RADIUS)])
    made = ImplicitNetwork(config(deformation), 3, nodes, radii).double()
    with torch.no_grad():
        for name, parameter in made.named_parameters():
            if "decoder" in name or "maker" in name:
                parameter.mul_(3)
    return made


def points() -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(1).uniform(-0.9, 0.9, (2, 30, 3)))


@BOTH
def test_gradients_are_those_of_finite_differences(deformation: str) -> None:
    made, at, step = network(deformation), points(), 1e-5
    code = made.codes[:2]
    found = made(at, code)
    u_and_distance = made.distance(at, code)
    assert torch.allclose(found.distance, u_and_distance[0])
    for k in range(3):
        h = step * torch.eye(3, dtype=torch.float64)[k]
        (f1, y1), (f0, y0) = made.distance(at + h, code), made.distance(at - h, code)
        assert (found.gradient[..., k] - (f1 - f0) / (2 * step)).abs().max() < 1e-5
        assert (found.F[..., k] - (y1 - y0) / (2 * step)).abs().max() < 1e-5


@BOTH
def test_losses_reach_every_parameter(deformation: str) -> None:
    made = network(deformation)
    found = made(points(), made.codes[:2])
    (found.distance.sum() + found.gradient.square().sum() + found.F.square().sum()).backward()
    assert all(parameter.grad is not None for parameter in made.parameters())


@BOTH
def test_shapes_of_a_batch_do_not_act_on_each_other(deformation: str) -> None:
    made, at = network(deformation), points()
    both = made(at, made.codes[:2])
    alone = made(at[1:], made.codes[1:2])
    assert torch.allclose(both.distance[1:], alone.distance)
    assert torch.allclose(both.gradient[1:], alone.gradient)


@BOTH
def test_without_gradients_the_answer_is_the_same(deformation: str) -> None:
    made, at = network(deformation), points()
    wanted = made(at, made.codes[:2])
    with torch.no_grad():
        found = made(at, made.codes[:2])
    assert torch.allclose(found.gradient, wanted.gradient)
    assert not found.gradient.requires_grad
