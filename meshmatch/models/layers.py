"""Small building blocks of the networks."""

from __future__ import annotations

import torch
from torch import nn

from meshmatch.arrays import Float


class ResidualBlock(nn.Module):
    """x + W2 gelu(W1 norm(x)), a pre-norm residual layer of constant width."""

    def __init__(self, width: int, dropout: float = 0.0) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.widen = nn.Linear(width, width)
        self.dropout = nn.Dropout(dropout)
        self.narrow = nn.Linear(width, width)
        nn.init.zeros_(self.narrow.weight)
        nn.init.zeros_(self.narrow.bias)

    def forward(self, x: Float[torch.Tensor, "*B W"]) -> Float[torch.Tensor, "*B W"]:
        return x + self.narrow(self.dropout(nn.functional.gelu(self.widen(self.norm(x)))))


def residual_mlp(inputs: int, width: int, depth: int, outputs: int) -> nn.Sequential:
    """inputs -> width, ``depth`` residual blocks, -> outputs."""
    blocks = [ResidualBlock(width) for _ in range(depth)]
    last = nn.Linear(width, outputs)
    # Start near zero: an untrained deformer then leaves its template almost at rest.
    nn.init.normal_(last.weight, std=2e-3)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(inputs, width), *blocks, nn.LayerNorm(width), nn.GELU(), last)
