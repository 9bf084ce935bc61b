"""The pointwise field: rows that are a code and a turn, and gradients by automatic differentiation."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshmatch.fields.field import PointwiseField, code_rows, pack, rotated_rows, unpack, value_and_jacobian
from meshmatch.models.layers import PointDecoder

D = 7


@pytest.fixture
def decoder() -> PointDecoder:
    torch.manual_seed(0)
    made = PointDecoder(D, 16).double()
    torch.nn.init.normal_(made.network[-1].weight, std=0.5)  # else it hardly moves anything
    return made


@pytest.fixture
def points() -> torch.Tensor:
    return torch.randn(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


@pytest.fixture
def codes() -> torch.Tensor:
    return torch.randn(2, D, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def test_rows_hold_a_code_of_any_length() -> None:
    for length in (1, 2, 3, 7, 512):
        code = torch.randn(2, length)
        rows = pack(code)
        assert rows.shape == (2, code_rows(length) + 3, 3)
        back, turn = unpack(rows, length)
        assert torch.equal(back, code)
        assert not turn.any()


def test_the_decoder_is_the_textbooks(decoder: PointDecoder, points: torch.Tensor, codes: torch.Tensor) -> None:
    """[x, code] through one MLP, a point at a time."""
    moved = decoder.displacement(points.expand(2, -1, -1), codes)
    first = torch.cat([decoder.from_point.weight, decoder.from_code.weight], 1)
    for b, code in enumerate(codes):
        for p, x in enumerate(points):
            hidden = first @ torch.cat([x, code]) + decoder.from_code.bias
            assert torch.allclose(moved[b, p], 2 * torch.tanh(decoder.network(hidden)))


def test_the_gradient_is_that_of_finite_differences(
    decoder: PointDecoder, points: torch.Tensor, codes: torch.Tensor
) -> None:
    field = PointwiseField(points, points, decoder.displacement, D)
    rows = pack(codes)
    rows[:, -3:] = 0.3 * torch.randn(2, 3, 3, dtype=torch.float64)  # a turn as well
    F = field.deformation_gradient(rows)
    h = 1e-6
    for k, step in enumerate(h * torch.eye(3, dtype=torch.float64)):
        there, back = (
            PointwiseField(at, at, decoder.displacement, D).displacement(rows) + at
            for at in (points + step, points - step)
        )
        assert torch.allclose(F[..., k], (there - back) / (2 * h), atol=1e-6)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_the_gradient_needs_no_graph_around_it(mode, decoder, points, codes) -> None:
    wanted = value_and_jacobian(decoder.displacement, points.expand(2, -1, -1), codes)[1]
    assert wanted.requires_grad  # training differentiates it again
    with mode():
        again = codes * 1.0
        found = value_and_jacobian(decoder.displacement, points.expand(2, -1, -1), again)[1]
    assert not found.requires_grad
    assert torch.allclose(found, wanted.detach())


def test_rows_turn_with_what_they_move(decoder, points, codes) -> None:
    field = PointwiseField(points, points, decoder.displacement, D)
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    rows = pack(codes)[:1]
    once = torch.from_numpy(rotated_rows(rows[0].detach().numpy(), turn))[None]
    moved = points + field.displacement(rows)
    assert torch.allclose(points + field.displacement(once), moved @ torch.from_numpy(turn))
    back = torch.from_numpy(rotated_rows(once[0].numpy(), turn.T))[None]
    assert torch.allclose(back, rows)


def test_arrays_are_answered_as_tensors_are(points: torch.Tensor) -> None:
    torch.manual_seed(0)
    plain = PointDecoder(D, 16)
    at = points.float()
    field = PointwiseField(at, at, plain.displacement, D)
    rows = pack(torch.randn(1, D))
    given = rows[0].double().numpy()
    assert np.allclose(field.displaced(given), field.displacement(rows)[0].detach(), atol=1e-7)
    some = np.array([3, 0])
    F = field.deformation_gradient(rows)[0].detach()
    assert np.allclose(field.deformation_gradient_at(given, some), F[some], atol=1e-6)
    part = field.for_training(2)
    assert torch.allclose(part.deformation_gradient(rows)[0], F[:2], atol=1e-6)
    assert part.displacement(rows).shape == (1, 5, 3)
    assert torch.allclose(field.part(1, 3).displacement(rows), field.displacement(rows)[:, 1:3], atol=1e-7)
