"""Bodies of other proportions: children, stylised characters with large heads, hands and feet, bodies built of parts.

All of it happens to resting bodies, before they are posed: bones and the skin around them are stretched, and parts are
rounded towards balls, barrels and boxes. Shares and sizes are set by hand; lengths are metres.
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
"""Of the characters: as they are, children, freely stretched, stylised, built of parts."""
STYLISED = SHARES[TOON]
# Typical sizes of parts: along and across, and how much they vary (deviation of the logarithm).
_CHILD = {"head": (1.5, 1.45, 0.14), "neck": (0.75, 1.0, 0.12), "thigh": (0.72, 1.0, 0.12), "shin": (0.72, 1.0, 0.12),
          "upper arm": (0.78, 1.0, 0.1), "forearm": (0.78, 1.0, 0.1), "hand": (0.95, 1.0, 0.08), "foot": (0.95, 1.0, 0.08),
          "belly": (0.95, 1.02, 0.08)}  # fmt: skip
_TOON = {"head": (2.6, 2.9, 0.3), "neck": (0.3, 1.1, 0.35), "thigh": (0.3, 1.25, 0.3), "shin": (0.33, 1.4, 0.3),
         "upper arm": (0.65, 1.35, 0.25), "forearm": (0.65, 1.5, 0.25), "hand": (1.2, 1.5, 0.25),
         "foot": (1.2, 1.6, 0.25), "belly": (0.8, 1.25, 0.22), "chest": (0.8, 1.15, 0.22),
         "hips": (0.9, 1.25, 0.22)}  # fmt: skip
_SPREAD = 0.22  # of free and built bodies


def shares_with(stylised: float) -> tuple[float, ...]:
    """`SHARES` with another one of stylised characters; the others stand to each other as they did."""
    if stylised == STYLISED:
        return SHARES
    left = (1 - stylised) / (1 - STYLISED)
    return tuple(stylised if kind == TOON else left * share for kind, share in enumerate(SHARES))


@dataclass(frozen=True, eq=False)
class Style:
    """How B bodies are built: their kind, and how long (1), and how thick (0 and 2) each part becomes."""

    kind: Int[Tensor, " B"]
    sizes: Float[Tensor, "B P 3"]

    def rows(self, at: Int[Tensor, " N"]) -> Style:
        """Of some of the bodies."""
        return Style(self.kind[at], self.sizes[at])


def draw_style(B: int, generator: torch.Generator, shares: Sequence[float] = SHARES) -> Style:
    """Kinds, in these shares, and sizes, the same on both sides."""
    kind = torch.multinomial(torch.tensor(shares), B, True, generator=generator)
    middle, spread = torch.zeros(5, len(PARTS), 2), torch.zeros(5, len(PARTS))
    for k, table in ((CHILD, _CHILD), (TOON, _TOON)):
        for name, (along, across, deviation) in table.items():
            for at in _both(name):
                middle[k, at] = torch.tensor([along, across]).log()
                spread[k, at] = deviation
    spread[FREE] = spread[BUILT] = _SPREAD
    noise = torch.randn(B, len(PARTS), 3, generator=generator)
    shared = torch.randn(B, len(PARTS), 1, generator=generator)  # a part grows as a whole, for the most part
    depth = torch.randn(B, len(PARTS), 1, generator=generator)
    for name in SIDED:
        left, right = _both(name)
        for drawn in (noise, shared, depth):
            drawn[:, right] = drawn[:, left]
    noise[..., 2:] = noise[..., :1] + 0.4 * depth
    # Limbs, and the parts of the trunk, vary together.
    for group in (("upper arm", "forearm"), ("thigh", "shin"), ("hips", "belly", "chest")):
        rows = [k for name in group for k in _both(name)]
        for drawn in (shared, noise):
            drawn[:, rows] = 0.8 * drawn[:, rows[:1]] + 0.6 * drawn[:, rows]
    log = middle[kind][..., [1, 0, 1]] + spread[kind][..., None] * (0.7 * shared + 0.6 * noise)
    # How far towards the typical proportions: from a hint to more than that.
    strength = torch.where(kind == CHILD, 0.2, 0.4) + torch.rand(B, generator=generator)
    return Style(kind, (log * strength.clamp(max=1.3)[:, None, None]).exp().clamp(0.18, 4.5))


def _both(name: str) -> tuple[int, ...]:
    return (part(name, "L"), part(name, "R")) if name in SIDED else (part(name),)


def stretched(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], style: Style
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B J 3"]]:
    """Resting bodies whose bones have other sizes."""
    axes = figure.axes(heads)
    scale = (axes.transpose(-1, -2) @ (style.sizes[..., None] * axes))[:, figure.of_joint]
    places: list[Tensor] = []
    for joint, parent in enumerate(figure.rig.parents):
        head = heads[:, joint]
        if parent >= 0:
            head = places[parent] + (scale[:, parent] @ (heads[:, joint] - heads[:, parent])[..., None])[..., 0]
        places.append(head)
    moved = torch.stack(places, 1)
    return skin(figure.rig, rest, scale, moved - (scale @ heads[..., None])[..., 0]), moved


def rounded(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], kind: Int[Tensor, " B"],
    generator: torch.Generator,
) -> Float[Tensor, "B V 3"]:  # fmt: skip
    """Parts drawn towards balls, barrels and boxes: heads, hands and feet of stylised bodies, everything of built ones."""
    B, P = len(rest), len(PARTS)
    built = (kind == BUILT)[:, None]

    def draw(low: float, high: float) -> Tensor:
        value = low + (high - low) * torch.rand(B, P, generator=generator)
        for name in SIDED:
            left, right = _both(name)
            value[:, right] = value[:, left]
        return value

    ends = torch.zeros(P, dtype=torch.bool)
    ends[[k for name in ("head", "hand", "foot") for k in _both(name)]] = True
    solid = torch.rand(B, 1, generator=generator) < 0.6  # of built bodies: made of solids, like robots
    amount = torch.where(built, draw(0.3, 1.0), torch.where(ends, draw(0.0, 1.0), draw(0.0, 0.8)))
    amount = torch.where(built & solid, draw(0.85, 1.0), amount)
    girth = torch.where(built, draw(0.85, 1.35), torch.ones(B, P))[..., None].repeat(1, 1, 3)
    # Solids are wide or narrow, deep or flat, and a little shorter or longer than what they stand for.
    sizes = torch.stack([draw(0.6, 1.6), draw(0.9, 1.15), draw(0.6, 1.6)], -1)
    girth = torch.where((built & solid)[..., None], sizes, girth)
    around = torch.where(draw(0, 1) < 0.6, 2.0, draw(3, 9))  # exponents: 2 is round, 8 a box
    along = torch.where(ends & ~built, draw(2, 3), draw(3, 9))
    sharp = torch.where(built, 1 + 5 * torch.rand(B, 1, generator=generator), torch.ones(B, 1))
    axes = figure.axes(heads)
    total = torch.zeros_like(rest)
    weight = torch.zeros(*rest.shape[:2], 1)
    for p in range(P):
        own = figure.share[:, p]
        at = torch.nonzero(own > 0.02)[:, 0]
        mine = own[at]
        points = rest[:, at]
        heavy = (mine > 0.5).float() * mine + 1e-6
        middle = (heavy[:, None] * points).sum(1, keepdim=True) / heavy.sum()
        local = (points - middle) @ axes[:, p].transpose(-1, -2)
        half = 1.55 * ((heavy[:, None] * local.square()).sum(1, keepdim=True) / heavy.sum()).sqrt() * girth[:, p, None]
        unit = (local / half).abs().clamp_min(1e-4)
        n, m = around[:, p, None], along[:, p, None]
        ring = (unit[..., 0] ** n + unit[..., 2] ** n) ** (m / n)
        norm = (ring + unit[..., 1] ** m) ** (1 / m)
        onto = middle + (local / norm[..., None]) @ axes[:, p]
        share = mine**sharp
        total[:, at] += share[..., None] * torch.lerp(points, onto, amount[:, p, None, None])
        weight[:, at] += share[..., None]
    return torch.where(weight > 1e-6, total / weight.clamp_min(1e-6), rest)
