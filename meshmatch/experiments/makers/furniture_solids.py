"""What generated furniture and planes are made of: rods and slabs that belong to parts, joined by round fillets; and the
pieces that designs share: boards, legs, columns, runners.

A solid has a field that is negative inside, zero on its surface and near it about the distance in length units. The field
of a whole is the smooth minimum of its solids' (a polynomial of degree two, `fillet` wide). scikit-image's marching cubes
make one watertight mesh of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import blend, closest_on_triangles
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

_NEAREST = 12  # triangles, by their centers, among which the closest point is looked for
_RIM = 2  # voxels around a solid in which its field is known
_AT_ONCE = 200_000  # points


class Solid(Protocol):
    """A closed body; lengths in the whole's unit."""

    @property
    def box(self) -> Float[Floats, "2 3"]:
        """Lower and upper corner of a box around it."""

    def field(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        """Negative inside, zero on the surface, near it about the distance."""


@dataclass(frozen=True, eq=False)
class Rod:
    """A round rod along a line of points (at least two), with the radius at each; its ends are half balls."""

    line: Float[Floats, "N 3"]
    radii: Float[Floats, " N"]

    @property
    def box(self) -> Float[Floats, "2 3"]:
        out = self.radii[:, None]
        return np.stack([(self.line - out).min(0), (self.line + out).max(0)])

    def field(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        nearest = np.full(len(points), np.inf)
        steps = zip(self.line[:-1], self.line[1:], self.radii[:-1], self.radii[1:], strict=True)
        for start, end, first, last in steps:
            along, off = end - start, points - start
            share = np.clip(off @ along / max(along @ along, 1e-12), 0, 1)
            thick = first + share * (last - first)
            nearest = np.minimum(nearest, np.linalg.norm(off - share[:, None] * along, axis=1) - thick)
        return nearest


@dataclass(frozen=True, eq=False)
class Slab:
    """A plate: a rounded outline in a plane, and a thickness.

    The outline is a superellipse of half widths ``half`` along the first two ``axes`` (unit rows, the third is the
    normal) with ``power`` 2 (an ellipse) to 20 (a rectangle). It is wider by ``taper`` (a share) at the far end of the
    second axis and narrower at the near one, and shifted along the second axis by ``sweep`` times |first|. ``thick`` is
    half the thickness, in the middle of the first axis and at its ends. Edges are rounded by ``edge``; ``bend`` lifts the
    plate by so much (1/length) times the first coordinate squared.
    """

    center: Float[Floats, " 3"]
    axes: Float[Floats, "3 3"]
    half: tuple[float, float]
    thick: tuple[float, float]
    power: float = 8.0
    taper: float = 0.0
    edge: float = 0.01
    bend: float = 0.0
    sweep: float = 0.0
    narrow: float = 0.0  # share of the second half width that is lost at the ends of the first axis

    @property
    def box(self) -> Float[Floats, "2 3"]:
        a, b = self.half
        wide = a * (1 + abs(self.taper))
        lift, slide = self.bend * wide**2, self.sweep * wide
        local = [
            (x, y, z)
            for x in (-wide, wide)
            for y in (-b + min(slide, 0), b + max(slide, 0))
            for z in (-max(self.thick) + min(lift, 0), max(self.thick) + max(lift, 0))
        ]
        corners = self.center + np.array(local) @ self.axes
        return np.stack([corners.min(0), corners.max(0)])

    def field(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        x, y, z = ((points - self.center) @ self.axes.T).T
        a, b = self.half
        out = np.clip(np.abs(x) / a, 0, 1)
        y = y - self.sweep * np.abs(x)
        wide = np.maximum(a * (1 + self.taper * np.clip(y / b, -1, 1)), 0.05 * a)
        deep = b * (1 - self.narrow * out)
        u, v = np.abs(x) / wide, np.abs(y) / deep
        norm = (u**self.power + v**self.power + 1e-30) ** (1 / self.power)
        slope = np.hypot((u / norm) ** (self.power - 1) / wide, (v / norm) ** (self.power - 1) / deep)
        flat = (norm - 1) / np.maximum(slope, 1e-9) / np.sqrt(1 + self.sweep**2)
        thick = self.thick[0] + out * (self.thick[1] - self.thick[0])
        tall = np.abs(z - self.bend * x**2) - thick
        edge = min(self.edge, *self.thick)
        pair = np.stack([flat + edge, tall + edge])
        return np.minimum(pair.max(0), 0) + np.linalg.norm(np.maximum(pair, 0), axis=0) - edge


def plane(first: ArrayLike, second: ArrayLike) -> Float[Floats, "3 3"]:
    """Axes of a plate: unit rows along ``first``, near ``second``, and the normal, second x first."""
    one = np.asarray(first, float) / np.linalg.norm(first)
    two = np.asarray(second, float) - one * (one @ np.asarray(second, float))
    two /= np.linalg.norm(two)
    return np.stack([one, two, np.cross(two, one)])


@dataclass(frozen=True, eq=False)
class Assembly:
    """Solids, the part (an index of ``names``) of each, and the width of the fillets between them."""

    kind: str
    names: tuple[str, ...]
    solids: tuple[tuple[int, Solid], ...]
    fillet: float

    def field(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        """Field of the whole, see the module; negative inside."""
        total = np.full(len(points), np.inf)
        for _, solid in self.solids:
            total = _smooth_minimum(total, solid.field(points), self.fillet)
        return total

    def parts_at(self, points: Float[Floats, "N 3"]) -> Int[Ints, " N"]:
        """The part that each point is nearest to."""
        best, part = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
        for number, solid in self.solids:
            here = solid.field(points)
            part[here < best] = number
            best = np.minimum(best, here)
        return part

    def mesh(self, resolution: int = 96) -> Shape:
        """The surface as one watertight mesh, with about so many voxels along its longest side."""
        boxes = np.stack([solid.box for _, solid in self.solids])
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        step = float((high - low).max()) / resolution
        origin = low - (_RIM + 2) * step
        counts = np.ceil((high - origin) / step).astype(int) + _RIM + 3
        rim = self.fillet + _RIM * step
        grid = np.full(counts, np.inf)
        for _, solid in self.solids:
            near, far = solid.box
            first = np.maximum(np.floor((near - rim - origin) / step).astype(int), 0)
            last = np.minimum(np.ceil((far + rim - origin) / step).astype(int) + 1, counts)
            ticks = [origin[k] + step * np.arange(first[k], last[k]) for k in range(3)]
            points = np.stack(np.meshgrid(*ticks, indexing="ij"), -1).reshape(-1, 3)
            window = tuple(slice(*ends) for ends in zip(first, last, strict=True))
            inside = grid[window]
            grid[window] = _smooth_minimum(inside, solid.field(points).reshape(inside.shape), self.fillet)
        grid = np.clip(grid, -rim, rim)
        grid[grid == 0] = 1e-9  # a surface through a grid point would make triangles without area
        verts, faces, _, _ = marching_cubes(grid, 0.0, spacing=(step,) * 3, allow_degenerate=False)
        return Shape(verts.astype(np.float64) + origin, faces.astype(np.int64), self.kind)

    @cached_property
    def surface(self) -> Shape:
        """The mesh that samples and distances are of."""
        return self.mesh()

    def sdf(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        """Signed distance to the surface, negative inside: exact to the mesh, the sign of the field."""
        shape = self.surface
        corners = shape.verts[shape.faces]
        tree = cKDTree(corners.mean(1))
        found = []
        for start in range(0, len(points), _AT_ONCE):
            here = points[start : start + _AT_ONCE]
            nearest = tree.query(here, k=min(_NEAREST, len(corners)))[1].reshape(len(here), -1)
            best = np.full(len(here), np.inf)
            for column in nearest.T:
                triangle = corners[column]
                weights = closest_on_triangles(here, *triangle.transpose(1, 0, 2))
                at = blend(triangle, weights)
                best = np.minimum(best, np.linalg.norm(at - here, axis=1))
            found.append(np.where(self.field(here) < 0, -best, best))
        return np.concatenate(found) if found else np.zeros(0)

    def sample(
        self, count: int, rng: np.random.Generator
    ) -> tuple[Float[Floats, "N 3"], Float[Floats, "N 3"], Int[Ints, " N"]]:
        """Points evenly on the surface, outward unit normals, and the part of each."""
        drawn = sample_surface(self.surface, count, rng)
        return drawn.points, drawn.normals, self.parts_at(drawn.points)


def _smooth_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The smaller of two, and where they are nearer to each other than ``width`` less, up to a quarter of it."""
    if width <= 0:
        return np.minimum(a, b)
    with np.errstate(invalid="ignore"):
        near = np.maximum(width - np.abs(a - b), 0) / width
    return np.minimum(a, b) - 0.25 * width * np.nan_to_num(near) ** 2


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
