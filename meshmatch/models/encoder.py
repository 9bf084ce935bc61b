"""Encoders: a point set to a shape code. Both ignore the order and the number of the points."""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import nn

from meshmatch.arrays import Float
from meshmatch.models.layers import residual_mlp
from meshmatch.models.neighbours import nearest


class BasisEncoder(nn.Module):
    """Offsets from a fixed set of basis points to the nearest input point, then an MLP.

    After *Efficient Learning on Point Clouds with Basis Point Sets* (ICCV 2019). The features cost one tree
    query per basis point, about a thousandth of a point MLP of the same quality.
    """

    def __init__(self, basis: Float[torch.Tensor, "M 3"], width: int, depth: int, outputs: int) -> None:
        super().__init__()
        self.basis: torch.Tensor
        self.register_buffer("basis", basis)
        self.network = residual_mlp(3 * len(basis), width, depth, outputs)

    def features(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B M 3"]:
        """Offsets from the basis, in units of about one standard deviation."""
        offsets = nearest(self.basis.expand(len(points), -1, -1), points)[1]
        return offsets * 5.0

    def forward(self, features: Float[torch.Tensor, "B ..."]) -> Float[torch.Tensor, "B D"]:
        return self.network(features.flatten(1))


class PointEncoder(nn.Module):
    """The paper's encoder: positional encoding on a hypersphere, shared MLP, max-pool, two linear layers."""

    def __init__(self, outputs: int, latent: int = 1024, frequencies: int = 21, dropout: float = 0.3) -> None:
        super().__init__()
        self.frequencies: torch.Tensor
        self.register_buffer("frequencies", torch.logspace(-1, 2, frequencies, base=2.0))
        sizes = [6 * frequencies, latent // 8, latent // 4, latent // 2, latent]
        layers: list[nn.Module] = []
        for i, (a, b) in enumerate(pairwise(sizes)):
            layers += [nn.Conv1d(a, b, 1), nn.BatchNorm1d(b)]
            layers += [nn.ReLU()] if i < len(sizes) - 2 else []
        self.points = nn.Sequential(*layers)
        self.head = nn.Sequential(nn.Linear(latent, latent), nn.ReLU(), nn.Dropout(dropout), nn.Linear(latent, outputs))

    def features(self, points: Float[torch.Tensor, "B P 3"]) -> Float[torch.Tensor, "B P E"]:
        """Encodings of unit length."""
        angle = 2 * math.pi * points[..., None, :] * self.frequencies[:, None]
        waves = torch.cat([angle.sin(), angle.cos()], -1).flatten(-2)
        return waves / math.sqrt(3 * len(self.frequencies))

    def forward(self, features: Float[torch.Tensor, "B ..."]) -> Float[torch.Tensor, "B D"]:
        return self.head(self.points(features.transpose(1, 2)).amax(-1))
