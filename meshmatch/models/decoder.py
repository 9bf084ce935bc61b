"""Decoders: a shape code to the rows that a field reads, one displacement vector per node or the code itself."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import nn

from meshmatch.arrays import Float
from meshmatch.fields.pointwise import pack
from meshmatch.models.layers import residual_mlp


class FlatDecoder(nn.Module):
    """One residual MLP from the code to all node vectors at once."""

    def __init__(self, code: int, width: int, depth: int, K: int) -> None:
        super().__init__()
        self.network = residual_mlp(code, width, depth, 3 * K)

    def forward(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B K 3"]:
        """Node vectors of codes."""
        return self.network(code).unflatten(-1, (-1, 3))


class NodeDecoder(nn.Module):
    """The paper's decoder: [q_i, code] -> MLP shared over nodes, 2 tanh at the end.

    The code's part of the first layer is computed once per shape and broadcast over the nodes: the same
    numbers for a fraction of the cost.
    """

    def __init__(self, code: int, nodes: Float[torch.Tensor, "K 3"], width: int = 1024) -> None:
        super().__init__()
        self.nodes: torch.Tensor
        self.register_buffer("nodes", nodes)
        self.from_code = nn.Linear(code, width)
        self.from_node = nn.Linear(3, width, bias=False)
        sizes = [width, width // 2, width // 4]
        layers: list[nn.Module] = [nn.BatchNorm1d(width), nn.ReLU()]
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.BatchNorm1d(b), nn.ReLU()]
        layers.append(nn.Linear(sizes[-1], 3))
        self.network = nn.Sequential(*layers)

    def forward(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B K 3"]:
        """Node vectors of codes."""
        hidden = self.from_code(code)[:, None] + self.from_node(self.nodes)  # B K width
        return 2 * torch.tanh(self.network(hidden.flatten(0, 1))).unflatten(0, hidden.shape[:2])


class PointDecoder(nn.Module):
    """The decoder of *3D-CODED* (ECCV 2018): [x, code] -> MLP shared over all points, 2 tanh at the end.

    Layers are normalised within a point where the original normalises over a batch of points: with that, a point's
    displacement would depend on all others, and its derivative be no deformation gradient. The answer to a code is the
    code, for a field with `displacement` in it.
    """

    def __init__(self, code: int, width: int = 1024) -> None:
        super().__init__()
        self.from_code = nn.Linear(code, width)
        self.from_point = nn.Linear(3, width, bias=False)
        sizes = [width, width // 2, width // 4]
        layers: list[nn.Module] = [nn.LayerNorm(width), nn.ReLU()]
        for a, b in pairwise(sizes):
            layers += [nn.Linear(a, b), nn.LayerNorm(b), nn.ReLU()]
        last = nn.Linear(sizes[-1], 3)
        nn.init.normal_(last.weight, std=2e-3)  # untrained it leaves its template almost at rest
        nn.init.zeros_(last.bias)
        self.network = nn.Sequential(*layers, last)

    def forward(self, code: Float[torch.Tensor, "B D"]) -> Float[torch.Tensor, "B R 3"]:
        return pack(code)

    def displacement(
        self, points: Float[torch.Tensor, "B P 3"], code: Float[torch.Tensor, "B D"]
    ) -> Float[torch.Tensor, "B P 3"]:
        return 2 * torch.tanh(self.network(self.from_code(code)[:, None] + self.from_point(points)))
