"""The pointwise representation: a network says for each point and code where the point goes.

There are no node vectors. The rows (R, 3) that stand for a deformation are the code, three numbers a row, and last
three rows T of a turn that comes after the network:

    x' = y + T^T y,   y = x + u(x, code)

T is 0 for what a decoder answers; it is there so that a deformation read in a turned frame can be turned back. The
deformation gradient comes from automatic differentiation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from meshmatch.arrays import Float, Floats, Int, Ints

# (points (B, P, 3), code (B, D)) -> displacements (B, P, 3); what happens to a point depends on no other point.
Motion = Callable[[Float[torch.Tensor, "B P 3"], Float[torch.Tensor, "B D"]], Float[torch.Tensor, "B P 3"]]
TURN_ROWS = 3


def code_rows(D: int) -> int:
    """How many rows of three numbers hold a code of D."""
    return -(-D // 3)


def pack(code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B R 3"]:
    """Rows of codes, without a turn."""
    D = code.shape[1]
    fill = 3 * (code_rows(D) + TURN_ROWS) - D
    return torch.nn.functional.pad(code, (0, fill)).unflatten(1, (-1, 3))


def unpack(
    rows: Float[torch.Tensor, "B R 3"], D: int
) -> tuple[Float[torch.Tensor, "B D"], Float[torch.Tensor, "B 3 3"]]:
    """Codes and turns T of rows."""
    return rows[:, :-TURN_ROWS].flatten(1)[:, :D], rows[:, -TURN_ROWS:]


def turned_rows(rows: Float[Floats, "R 3"], turn: Float[Floats, "3 3"]) -> Float[Floats, "R 3"]:
    """Rows of the deformation whose moved points are those of ``rows`` times ``turn`` (points are rows)."""
    turned = rows.copy()
    turned[-TURN_ROWS:] = (np.eye(3) + rows[-TURN_ROWS:]) @ turn - np.eye(3)
    return turned


@dataclass(frozen=True, eq=False)
class PointwiseField:
    """A network's motion on fixed points, with gradients on ``strained``; codes have D numbers."""

    points: Float[torch.Tensor, "P 3"]
    strained: Float[torch.Tensor, "G 3"]
    motion: Motion
    D: int

    def displacement(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B P 3"]:
        code, turn = unpack(rows, self.D)
        u = self.motion(self.points.expand(len(code), -1, -1), code)
        return u + (self.points + u) @ turn

    def deformation_gradient(self, rows: Float[torch.Tensor, "B R 3"]) -> Float[torch.Tensor, "B G 3 3"]:
        code, turn = unpack(rows, self.D)
        F = jacobian(self.motion, self.strained.expand(len(code), -1, -1), code)
        F = F + torch.eye(3, dtype=F.dtype, device=F.device)
        return F + turn.transpose(1, 2)[:, None] @ F

    def displaced(self, rows: Float[Floats, "R 3"]) -> Float[Floats, "P 3"]:
        with torch.no_grad():
            return self.displacement(torch.from_numpy(np.array(rows)).float()[None])[0].double().numpy()

    def strain(self, rows: Float[Floats, "R 3"], at: Int[Ints, " N"] | slice = slice(None)) -> Float[Floats, "N 3 3"]:
        """F of one answer at some of the points, in float64."""
        index = at if isinstance(at, slice) else torch.from_numpy(at)
        part = PointwiseField(self.points, self.points[index], self.motion, self.D)
        with torch.no_grad():
            given = torch.from_numpy(np.array(rows)).float()[None]
            return part.deformation_gradient(given)[0].double().numpy()

    def for_training(self, strained: int | None = None) -> PointwiseField:
        return PointwiseField(self.points, self.points[:strained], self.motion, self.D)

    def for_descent(self) -> PointwiseField:
        return self

    def part(self, start: int, stop: int) -> PointwiseField:
        points = self.points[start:stop]
        return PointwiseField(points, points, self.motion, self.D)

    def to(self, *args, **kwargs) -> PointwiseField:
        """Where the points are; the network is moved by whoever owns it."""
        points, strained = (each.to(*args, **kwargs) for each in (self.points, self.strained))
        return PointwiseField(points, strained, self.motion, self.D)


def jacobian(
    motion: Motion, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
) -> Float[torch.Tensor, "B P 3 3"]:
    """du_a / dx_k of a motion, by automatic differentiation; itself differentiable where gradients are.

    Points do not act on one another, so the gradient of a sum over points holds each point's own. Backwards through the
    network once for each coordinate: forward mode costs the same here and more memory for its tangents.
    """
    wanted = torch.is_grad_enabled() and not torch.is_inference_mode_enabled()
    with torch.inference_mode(False), torch.enable_grad():
        at = points.clone().requires_grad_(True)
        moved = motion(at, code.clone())
        rows = [
            torch.autograd.grad(moved[..., a].sum(), at, create_graph=wanted, retain_graph=wanted or a < 2)[0]
            for a in range(3)
        ]
    return torch.stack(rows, -2)
