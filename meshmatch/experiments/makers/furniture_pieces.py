"""Pieces that chairs and tables share: random choices, rods, boards, legs, columns and runners."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.experiments.makers.furniture_solids import Rod, Slab, Solid, plane

X, Y, Z = np.eye(3)
FLAT = plane(X, Z)
"""Axes of a plate that lies: width, depth, up."""
Parts = list[tuple[int, Solid]]
_ROOM = 0.004  # of a plate's surface over what ends in it
_THIN = 0.014  # of the legs' extent: no leg has a smaller radius


class Draw:
    """Random choices."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def __call__(self, low: float, high: float) -> float:
        """Any number of an interval."""
        return float(self.rng.uniform(low, high))

    def chance(self, share: float) -> bool:
        """True in such a share of all cases."""
        return bool(self.rng.random() < share)

    def one(self, **weights: float) -> str:
        """One of the names, by weight."""
        share = np.array(list(weights.values()))
        return str(self.rng.choice(list(weights), p=share / share.sum()))

    def count(self, low: int, high: int) -> int:
        """A number from low to high, both possible."""
        return int(self.rng.integers(low, high + 1))


def rod(line: ArrayLike, *radii: float) -> Rod:
    """A rod along points; radii are spread over them."""
    points = np.asarray(line, float)
    ticks = np.linspace(0, 1, len(radii)) if len(radii) > 1 else np.zeros(1)
    return Rod(points, np.interp(np.linspace(0, 1, len(points)), ticks, np.array(radii, float)))


def board(
    start: Float[Floats, " 3"], end: Float[Floats, " 3"], wide: Float[Floats, " 3"], half: tuple[float, float]
) -> Slab:
    """A straight board between two points: half its width along ``wide``, and half its thickness."""
    axes = plane(wide, end - start)
    length = float(np.linalg.norm(end - start))
    return Slab(0.5 * (start + end), axes, (half[0], 0.5 * length), (half[1], half[1]), 12.0, edge=min(half) / 2)


def curve(start: ArrayLike, end: ArrayLike, out: ArrayLike, count: int = 9) -> Float[Floats, "N 3"]:
    """Points from one to another, bulging by ``out`` like an S where it is a pair, else like a bow."""
    share = np.linspace(0, 1, count)[:, None]
    bulge = np.atleast_2d(np.asarray(out, float))
    wave = np.sin(np.pi * share) * bulge[0] if len(bulge) == 1 else np.sin(2 * np.pi * share) * bulge[0]
    return np.asarray((1 - share) * np.asarray(start, float) + share * np.asarray(end, float) + wave)


def inside(points: Float[Floats, "N 3"], plate: Slab, share: float = 0.85) -> Float[Floats, "N 3"]:
    """The same points, drawn in towards the axis where they lie beyond a share of a lying plate's outline."""
    wide = plate.half[0] * (1 + plate.taper * np.clip(points[:, 2] / plate.half[1], -1, 1))
    norm = np.hypot(0, np.stack([points[:, 0] / wide, points[:, 2] / plate.half[1]]))
    norm = (norm**plate.power).sum(0) ** (1 / plate.power)
    return np.asarray(points * np.where(np.arange(3) == 1, 1, np.minimum(1, share / np.maximum(norm, 1e-9))[:, None]))


def height_in(plate: Slab, radius: float) -> float:
    """The height at which a round end of a radius does not show above a lying plate."""
    return float(plate.center[1] + min(plate.thick[0] - radius - _ROOM, 0))


def legs_of(
    draw: Draw, part: int, tops: Float[Floats, "N 3"], feet: Float[Floats, "N 3"], thick: float, style: str
) -> Parts:
    """One leg for each pair of points: straight, tapered, square, or curved."""
    found: Parts = []
    least = _THIN * float(np.ptp(np.concatenate([tops, feet]), axis=0).max())
    thick = max(thick, least)
    end = max(thick * draw(0.4, 1.0), least) if style != "straight" else thick
    bulge, twice = draw(-0.12, 0.12) * float(np.ptp(np.r_[tops, feet][:, 1])), draw.chance(0.4)
    wide = draw(0.7, 1.8)
    for top, foot in zip(tops, feet, strict=True):
        outward = np.array([top[0], 0, top[2]]) / max(float(np.hypot(top[0], top[2])), 1e-9)
        if style == "square":
            top = top + 0.7 * thick * Y
            sideways = X if wide < 1.2 else np.cross(Y, outward)
            found.append((part, board(top, foot, sideways, (thick * (1.0 if wide < 1.2 else wide), thick))))
        elif style == "curved":
            out = [bulge * outward] * (2 if twice else 1)
            found.append((part, rod(curve(top, foot, out), thick, end, end)))
        else:
            found.append((part, rod([top, foot], thick, end)))
    return found


def ring(count: int, radius: tuple[float, float], height: float, first: float) -> Float[Floats, "N 3"]:
    """Points of an ellipse at a height, the first at an angle in turns."""
    angle = 2 * np.pi * (first + np.arange(count) / count)
    return np.stack([radius[0] * np.sin(angle), np.full(count, height), radius[1] * np.cos(angle)], 1)


def corners(width: float, depth: float, height: float) -> Float[Floats, "4 3"]:
    """Front right, front left, back left, back right, at half widths."""
    return np.array([(x, height, z) for x, z in ((width, depth), (-width, depth), (-width, -depth), (width, -depth))])


def pedestal(draw: Draw, part: int, plate: Slab, thick: float, wheels: bool = False) -> Parts:
    """A column under a plate, with a disc, a bell or three to five feet under it."""
    foot, top = draw(0.6, 0.9) * min(plate.half), height_in(plate, 1.6 * thick)
    kind = "star" if wheels else draw.one(disc=2, star=3, bell=1)
    low = 0.02 if kind != "star" else 0.05
    if kind == "bell":
        line = [(0, share * top, 0) for share in (0.08, 0.15, 0.3, 1)]
        plate = Slab(0.018 * Y, FLAT, (foot, foot), (0.018, 0.018), 2.0)
        return [(part, rod(line, min(0.5 * foot, 0.08 * top), 2 * thick, thick, thick)), (part, plate)]
    found: Parts = [(part, rod([(0, low, 0), (0, top, 0)], thick * draw(1.0, 1.6), thick))]
    if kind == "disc":
        found.append((part, Slab(0.018 * Y, FLAT, (foot, foot), (0.02, 0.018), draw(2.0, 4.0))))
        return found
    rise = draw(0.02, 0.15) * top
    for end in ring(draw.count(4, 5) if wheels else draw.count(3, 5), (foot, foot), 0.03, draw(0, 1)):
        found.append((part, rod([(0, 0.05 + rise, 0), end], 0.85 * thick, 0.6 * thick)))
        if wheels:
            found.append((part, rod([end, end - 0.01 * Y], 0.03)))
    return found


def stretchers(draw: Draw, parts: Parts, part: int, tops: Floats, feet: Floats, radius: float) -> None:
    """Rods between four legs, sometimes: around, like an H, or a cross."""
    kind = draw.one(none=5, ring=1, letter=2, cross=1)
    share = draw(0.4, 0.8)
    at = (1 - share) * tops + share * feet
    radius = max(radius, 0.011)
    pairs = {
        "none": [],
        "ring": [(0, 1), (1, 2), (2, 3), (3, 0)],
        "letter": [(1, 2), (3, 0)],
        "cross": [(0, 2), (1, 3)],
    }
    for a, b in pairs[kind]:
        parts.append((part, rod([at[a], at[b]], radius)))
    if kind == "letter":
        parts.append((part, rod([at[[1, 2]].mean(0), at[[3, 0]].mean(0)], radius)))


def sled(draw: Draw, part: int, plate: Slab, radius: float) -> Parts:
    """Two runners with posts up to a plate, or the front posts alone."""
    radius = min(radius, 0.9 * plate.thick[0])
    tops = inside(corners(0.85 * plate.half[0], 0.85 * plate.half[1], height_in(plate, radius)), plate)
    feet = tops * [1, 0, draw(0.9, 1.2)] + radius * Y
    springy = draw.chance(0.35)
    found: Parts = []
    for front, rear in ((0, 3), (1, 2)):
        line = [tops[front], feet[front], feet[rear]]
        found.append((part, rod(line if springy else [*line, tops[rear]], radius)))
    if springy or draw.chance(0.5):
        found.append((part, rod(feet[[2, 3]], radius)))
    return found
