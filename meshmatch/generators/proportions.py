"""Change proportions: children, stylised characters with large heads, hands and feet, and bodies built of parts.

Bodies are changed at rest, before they are posed: bones and the skin around them are scaled, and parts are rounded towards
balls, barrels and boxes. Probabilities and sizes are set by hand; lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from meshmatch.arrays import Float, Int
from meshmatch.generators.figure import PARTS, SIDED, Figure, part
from meshmatch.generators.rig import skin

PLAIN, CHILD, FREE, TOON, BUILT = range(5)
SHARES = (0.56, 0.1, 0.05, 0.15, 0.14)
"""Shares of the styles among characters: plain, children, freely scaled, stylised, built of parts."""
STYLISED = SHARES[TOON]
# Typical scale of parts along and across their axes, and the standard deviation of its logarithm.
_CHILD = {"head": (1.5, 1.45, 0.14), "neck": (0.75, 1.0, 0.12), "thigh": (0.72, 1.0, 0.12), "shin": (0.72, 1.0, 0.12),
          "upper arm": (0.78, 1.0, 0.1), "forearm": (0.78, 1.0, 0.1), "hand": (0.95, 1.0, 0.08), "foot": (0.95, 1.0, 0.08),
          "belly": (0.95, 1.02, 0.08)}  # fmt: skip
_TOON = {"head": (2.6, 2.9, 0.3), "neck": (0.3, 1.1, 0.35), "thigh": (0.3, 1.25, 0.3), "shin": (0.33, 1.4, 0.3),
         "upper arm": (0.65, 1.35, 0.25), "forearm": (0.65, 1.5, 0.25), "hand": (1.2, 1.5, 0.25),
         "foot": (1.2, 1.6, 0.25), "belly": (0.8, 1.25, 0.22), "chest": (0.8, 1.15, 0.22),
         "hips": (0.9, 1.25, 0.22)}  # fmt: skip
_SPREAD = 0.22  # standard deviation of log sizes of free and built bodies


def shares_with_stylised(stylised: float) -> tuple[float, ...]:
    """`SHARES` with another share of stylised characters; the others keep their ratios."""
    if stylised == STYLISED:
        return SHARES
    factor = (1 - stylised) / (1 - STYLISED)
    return tuple(stylised if kind == TOON else factor * share for kind, share in enumerate(SHARES))


@dataclass(frozen=True, eq=False)
class Style:
    """Style of B bodies: ``kind``, and scale factors of each part along its axis (1) and across it (0 and 2)."""

    kind: Int[Tensor, " B"]
    sizes: Float[Tensor, "B P 3"]

    def rows(self, at: Int[Tensor, " N"]) -> Style:
        """Style of the bodies with these indices."""
        return Style(self.kind[at], self.sizes[at])


def draw_style(B: int, generator: torch.Generator, shares: Sequence[float] = SHARES) -> Style:
    """Draw kinds with the given shares, and sizes of parts that are equal on both sides."""
    kind = torch.multinomial(torch.tensor(shares), B, True, generator=generator)
    middle, spread = torch.zeros(5, len(PARTS), 2), torch.zeros(5, len(PARTS))
    for k, table in ((CHILD, _CHILD), (TOON, _TOON)):
        for name, (along, across, deviation) in table.items():
            for at in _part_indices(name):
                middle[k, at] = torch.tensor([along, across]).log()
                spread[k, at] = deviation
    spread[FREE] = spread[BUILT] = _SPREAD
    noise = torch.randn(B, len(PARTS), 3, generator=generator)
    shared = torch.randn(B, len(PARTS), 1, generator=generator)  # common to all directions of a part
    depth = torch.randn(B, len(PARTS), 1, generator=generator)
    for name in SIDED:
        left, right = _part_indices(name)
        for values in (noise, shared, depth):
            values[:, right] = values[:, left]
    noise[..., 2:] = noise[..., :1] + 0.4 * depth
    # Sizes within an arm, a leg and the trunk are correlated.
    for group in (("upper arm", "forearm"), ("thigh", "shin"), ("hips", "belly", "chest")):
        rows = [k for name in group for k in _part_indices(name)]
        for values in (shared, noise):
            values[:, rows] = 0.8 * values[:, rows[:1]] + 0.6 * values[:, rows]
    log = middle[kind][..., [1, 0, 1]] + spread[kind][..., None] * (0.7 * shared + 0.6 * noise)
    # Exaggeration: from much less than the typical proportions to more.
    strength = torch.where(kind == CHILD, 0.2, 0.4) + torch.rand(B, generator=generator)
    return Style(kind, (log * strength.clamp(max=1.3)[:, None, None]).exp().clamp(0.18, 4.5))


def _part_indices(name: str) -> tuple[int, ...]:
    return (part(name, "L"), part(name, "R")) if name in SIDED else (part(name),)


def scale_bones(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], style: Style
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B J 3"]]:
    """Scale the bones of bodies at rest; return vertices and joints."""
    axes = figure.axes(heads)
    scale = (axes.transpose(-1, -2) @ (style.sizes[..., None] * axes))[:, figure.of_joint]
    placed: list[Tensor] = []
    for joint, parent in enumerate(figure.rig.parents):
        head = heads[:, joint]
        if parent >= 0:
            head = placed[parent] + (scale[:, parent] @ (heads[:, joint] - heads[:, parent])[..., None])[..., 0]
        placed.append(head)
    new_heads = torch.stack(placed, 1)
    return skin(figure.rig, rest, scale, new_heads - (scale @ heads[..., None])[..., 0]), new_heads


def round_parts(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], kind: Int[Tensor, " B"],
    generator: torch.Generator,
) -> Float[Tensor, "B V 3"]:  # fmt: skip
    """Deform parts towards balls, barrels and boxes (superellipsoids), in particular all parts of built bodies."""
    B, P = len(rest), len(PARTS)
    is_built = (kind == BUILT)[:, None]

    def draw(low: float, high: float) -> Tensor:
        value = low + (high - low) * torch.rand(B, P, generator=generator)
        for name in SIDED:
            left, right = _part_indices(name)
            value[:, right] = value[:, left]
        return value

    is_end = torch.zeros(P, dtype=torch.bool)
    is_end[[k for name in ("head", "hand", "foot") for k in _part_indices(name)]] = True
    solid = torch.rand(B, 1, generator=generator) < 0.6  # built bodies that consist of solids, like robots
    amount = torch.where(is_built, draw(0.3, 1.0), torch.where(is_end, draw(0.0, 1.0), draw(0.0, 0.8)))
    amount = torch.where(is_built & solid, draw(0.85, 1.0), amount)
    girth = torch.where(is_built, draw(0.85, 1.35), torch.ones(B, P))[..., None].repeat(1, 1, 3)
    # Solids are wide or narrow, deep or flat, and slightly shorter or longer than the part that they replace.
    sizes = torch.stack([draw(0.6, 1.6), draw(0.9, 1.15), draw(0.6, 1.6)], -1)
    girth = torch.where((is_built & solid)[..., None], sizes, girth)
    around = torch.where(draw(0, 1) < 0.6, 2.0, draw(3, 9))  # exponents: 2 is round, 8 almost a box
    along = torch.where(is_end & ~is_built, draw(2, 3), draw(3, 9))
    sharp = torch.where(is_built, 1 + 5 * torch.rand(B, 1, generator=generator), torch.ones(B, 1))
    axes = figure.axes(heads)
    total = torch.zeros_like(rest)
    weight = torch.zeros(*rest.shape[:2], 1)
    for p in range(P):
        part_share = figure.share[:, p]
        at = torch.nonzero(part_share > 0.02)[:, 0]
        weights = part_share[at]
        points = rest[:, at]
        core = (weights > 0.5).float() * weights + 1e-6
        middle = (core[:, None] * points).sum(1, keepdim=True) / core.sum()
        local = (points - middle) @ axes[:, p].transpose(-1, -2)
        half = 1.55 * ((core[:, None] * local.square()).sum(1, keepdim=True) / core.sum()).sqrt() * girth[:, p, None]
        unit = (local / half).abs().clamp_min(1e-4)
        n, m = around[:, p, None], along[:, p, None]
        ring = (unit[..., 0] ** n + unit[..., 2] ** n) ** (m / n)
        norm = (ring + unit[..., 1] ** m) ** (1 / m)
        on_solid = middle + (local / norm[..., None]) @ axes[:, p]
        share = weights**sharp
        total[:, at] += share[..., None] * torch.lerp(points, on_solid, amount[:, p, None, None])
        weight[:, at] += share[..., None]
    return torch.where(weight > 1e-6, total / weight.clamp_min(1e-6), rest)
