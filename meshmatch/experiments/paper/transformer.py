"""The network of the baseline TransMatch: points of a shape and of the template become displacements of the template's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from meshmatch.arrays import Float


@dataclass(frozen=True)
class TransConfig:
    """Sizes of the transformer."""

    width: int = 192
    heads: int = 6
    latents: int = 96
    depth: int = 4
    frequencies: int = 6


class Block(nn.Module):
    """Attention of ``x`` to a memory, then an MLP; pre-norm, residual."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.memory_norm, self.mlp_norm = (nn.LayerNorm(width) for _ in range(3))
        self.query, self.out = nn.Linear(width, width), nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.mlp = nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))

    def forward(self, x: Float[Tensor, "B N W"], memory: Float[Tensor, "B M W"]) -> Float[Tensor, "B N W"]:
        query = self.query(self.norm(x)).unflatten(-1, (self.heads, -1)).transpose(1, 2)
        pair = self.key_value(self.memory_norm(memory)).unflatten(-1, (2, self.heads, -1))
        key, value = pair.permute(2, 0, 3, 1, 4)
        seen = nn.functional.scaled_dot_product_attention(query, key, value)
        x = x + self.out(seen.transpose(1, 2).flatten(2))
        return x + self.mlp(self.mlp_norm(x))


class Transformer(nn.Module):
    """Points of a shape and of the template -> displacements of the template's; lengths in sqrt(area)."""

    def __init__(self, config: TransConfig) -> None:
        super().__init__()
        self.config = config
        width, heads = config.width, config.heads
        self.frequencies: Tensor
        self.register_buffer("frequencies", 2.0 ** torch.arange(config.frequencies))
        inputs = 3 + 6 * config.frequencies
        self.embed_shape, self.embed_template = nn.Linear(inputs, width), nn.Linear(inputs, width)
        self.latents = nn.Parameter(0.5 * torch.randn(config.latents, width))
        self.read = Block(width, heads)
        self.think = nn.ModuleList(Block(width, heads) for _ in range(config.depth))
        self.ask = nn.ModuleList(Block(width, heads) for _ in range(2))
        self.last_norm, self.last = nn.LayerNorm(width), nn.Linear(width, 3)
        nn.init.normal_(self.last.weight, std=2e-3)  # the template begins at rest
        nn.init.zeros_(self.last.bias)

    def _waves(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B waves"]:
        angle = (math.pi * points[..., None, :] * self.frequencies[:, None]).flatten(-2)
        return torch.cat([points, angle.sin(), angle.cos()], -1)

    def forward(self, points: Float[Tensor, "B P 3"], template: Float[Tensor, "N 3"]) -> Float[Tensor, "B N 3"]:
        seen = self.embed_shape(self._waves(points))
        latents = self.read(self.latents.expand(len(points), -1, -1), seen)
        for block in self.think:
            latents = block(latents, latents)
        asked = self.embed_template(self._waves(template)).expand(len(points), -1, -1)
        for block in self.ask:
            asked = block(asked, latents)
        return self.last(self.last_norm(asked))
