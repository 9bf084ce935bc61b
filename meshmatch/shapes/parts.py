"""The connected parts of a mesh by number, and which of them may be an object of their own.

Files without names, such as ply and stl, hold a body together with a floor, a pedestal or a chair. Numbers name the parts:
from 1, the largest area first. A flat base that something is fused with is a part too, after all others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry import triangles
from meshmatch.shapes.faces import flat_faces, seams
from meshmatch.shapes.shape import Shape

# All of these were set by hand; lengths are in units of sqrt(area) of the reference part, see `_reference`.
_LARGE = 0.02  # share of the reference part's area from which on a part may be an object, or most of one
_MOST_LARGE = 12  # parts whose form is looked at
_PLAIN = 0.03  # mean depth below the convex hull up to which a part is as plain as a box, a plate or a column
_HULL_POINTS = 1500
_SAMPLES, _MOST_SAMPLES, _LEAST_SAMPLES = 12_000, 6_000, 2  # of all parts, and of each
_TOUCHING = 0.03  # parts so near to each other are one group
_BELONGING, _SMALL = 0.1, 0.2  # parts so near, and no larger than this share of a part, belong to it: eyes, hair, shoes
_MOST_TRIES = 6
_MOST_BASES = 2  # parts of which a base is looked for, the largest ones
_OF_STANDING = 0.4  # share of all that stands on a base that one piece has: not each of the legs of a table


@dataclass(frozen=True, eq=False)
class Parts:
    """The connected parts of a mesh; part n, counted from 1, is the one of the n-th largest area.

    Vertices at one position are connected where they lie on open edges, as at the seams of textures and the corners of an
    stl. Equal areas (to 6 digits) are in the order of their first vertices. Bases come last, see `of`; what stands on one
    keeps the number that both have together.

    Attributes
    ----------
    shape : the mesh
    number : (V,) which part each vertex is in; 0 for one that no face with any area uses
    faces : (F,) which part each face is in; 0 for a face without area, or at an invalid vertex
    areas : (P,) of each part, squared units of the file
    bases : how many of the parts are bases: the last ones
    """

    shape: Shape
    number: Int[Ints, " V"]
    faces: Int[Ints, " F"]
    areas: Float[Floats, " P"]
    bases: int = 0

    @classmethod
    def of(cls, shape: Shape, bases: bool = False) -> Parts:
        """The parts of a shape; a cloud has none. ``bases`` cuts off the flat ones that something is fused with, see
        `meshmatch.shapes.bases`: parts of their own, to which the vertices along the cut belong. A cloud with a base has two
        parts.
        """
        if bases and shape.is_cloud:
            return _of_cloud(cls, shape)
        usable = np.flatnonzero(shape.valid_faces)
        corners = shape.faces[usable]
        twin = seams(shape.verts, corners)
        vectors = shape.face_vectors[usable]
        solid = ~flat_faces(shape.verts, twin[corners], vectors, shape.diagonal)
        usable, corners = usable[solid], corners[solid]
        number, of_face = np.zeros(shape.V, np.int64), np.zeros(shape.F, np.int64)
        if not len(usable):
            return cls(shape, number, of_face, np.empty(0))
        label = triangles.face_parts(twin[corners], shape.V)
        area = shape.face_areas[usable]
        areas = np.bincount(label, area).astype(np.float64)
        first = np.full(len(areas), shape.V)
        np.minimum.at(first, label, corners.min(axis=1))
        order = np.lexsort((first, -np.log(np.maximum(areas, 1e-300)).round(6)))
        rank = np.empty(len(order), np.int64)
        rank[order] = np.arange(1, len(order) + 1)
        part = rank[label]
        found = _bases(shape, twin[corners], area, part) if bases else []
        number[corners] = part[:, None]
        for own in found:
            part[own] = part.max() + 1
            number[corners[own]] = part[own, None]
        of_face[usable] = part
        return cls(shape, number, of_face, np.bincount(part, area)[1:].astype(np.float64), len(found))

    def __len__(self) -> int:
        return len(self.areas)

    @cached_property
    def shares(self) -> Float[Floats, " P"]:
        """Share (0..1) of the area that each part has."""
        return np.asarray(self.areas / max(self.areas.sum(), 1e-300))

    @cached_property
    def counts(self) -> Int[Ints, " P"]:
        """How many vertices each part has."""
        return np.asarray(np.bincount(self.number, minlength=len(self) + 1)[1:])

    @cached_property
    def first_vertices(self) -> Int[Ints, " P"]:
        """The first vertex of each part in the order of the file."""
        first = np.full(len(self) + 1, self.shape.V)
        np.minimum.at(first, self.number, np.arange(self.shape.V))
        return first[1:]

    @cached_property
    def bounds(self) -> Float[Floats, "P 2 3"]:
        """Lowest and highest corner of the box around each part, in the frame of the file."""
        found = np.full((len(self) + 1, 2, 3), np.inf)
        np.minimum.at(found[:, 0], self.number, self.shape.verts)
        np.minimum.at(found[:, 1], self.number, -self.shape.verts)
        found[:, 1] *= -1
        return found[1:]

    def share(self, numbers: Iterable[int]) -> float:
        """Share (0..1) of the area that some parts have."""
        return float(self.shares[np.array(sorted(numbers), np.int64) - 1].sum())

    def others(self, numbers: Iterable[int]) -> tuple[int, ...]:
        """The numbers of all parts but these."""
        return tuple(sorted(set(range(1, len(self) + 1)) - set(numbers)))


def without_parts(shape: Shape, parts: Parts, numbers: Sequence[int]) -> Shape:
    """The shape with weight 0 at all vertices of these parts: no fit looks at them, and they keep their places."""
    weights = np.ones(shape.V) if shape.weights is None else shape.weights.copy()
    weights[np.isin(parts.number, np.asarray(numbers, np.int64))] = 0.0
    return replace(shape, weights=weights)


def leave_out(shape: Shape, numbers: Sequence[int]) -> Shape:
    """As `without_parts`; the shape itself where there are none to be left out."""
    return without_parts(shape, Parts.of(shape, bases=True), numbers) if numbers else shape


def tries(parts: Parts) -> list[frozenset[int]]:
    """Numbers of parts that may be an object of their own beside something else, a few sets of them, likelier ones first.

    What touches stays together, such as a body and its clothes: when the largest plain part is left out, and when all large
    plain ones are: floors, pedestals, boxes. Then single large parts are taken with what is small and lies on them.
    """
    if len(parts) < 2:
        return []
    if parts.shape.is_cloud:
        return [frozenset({1})]
    reference = _reference(parts)
    unit = float(np.sqrt(parts.areas[reference - 1]))
    large = [n for n in range(1, min(len(parts), 10 * _MOST_LARGE) + 1) if parts.areas[n - 1] >= _LARGE * unit**2]
    plain = [n for n in large[:_MOST_LARGE] if _is_plain(parts, n)]
    points, owner = _samples(parts, unit)
    everything = frozenset(range(1, len(parts) + 1))
    groups: list[list[frozenset[int]]] = []
    for left_out in dict.fromkeys(frozenset(plain[:count]) for count in (len(plain), 1, 2, 3, 0)):
        touching = _touching(points, owner, everything - left_out, len(parts), _TOUCHING * unit)
        large_groups = [group for group in touching if parts.share(group) >= _LARGE * parts.shares[reference - 1]]
        groups.append(sorted(large_groups, key=lambda group: -parts.share(group)))
    singles = [n for n in large[:_MOST_LARGE] if n not in plain][:3] + plain[:2]
    found = [group for each in groups for group in each[:1]]
    found += [_with_belongings(parts, n, points, owner) for n in singles]
    found += [group for each in groups for group in each[1:2]]
    return [each for each in dict.fromkeys(found) if each != everything][:_MOST_TRIES]


def apart(parts: Parts, one: frozenset[int], other: frozenset[int]) -> bool:
    """Whether two sets of parts are beside each other: not one, such as a coat, around the other."""
    if one & other:
        return False
    low, high = np.stack([_box(parts, each) for each in (one, other)], axis=1)
    overlap = np.maximum(np.minimum(*high) - np.maximum(*low), 0.0).prod()
    return bool(overlap < 0.5 * np.maximum(high - low, 1e-300).prod(axis=1).min())


def _box(parts: Parts, numbers: frozenset[int]) -> Float[Floats, "2 3"]:
    bounds = parts.bounds[np.array(sorted(numbers)) - 1]
    return np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])


def _reference(parts: Parts) -> int:
    """The part that lengths and areas are measured by: the largest one that is not plain, or else the second one."""
    return next((n for n in range(1, min(len(parts), _MOST_LARGE) + 1) if not _is_plain(parts, n)), 2)


def _bases(shape: Shape, corners: Int[Ints, "F 3"], area: Float[Floats, " F"], part: Int[Ints, " F"]) -> list[Ints]:
    """Which of some faces, that are in parts, are of each flat base."""
    from meshmatch.shapes.bases import base_plane

    found = []
    for number in range(1, min(_MOST_BASES, int(part.max())) + 1):
        own = np.flatnonzero(part == number)
        plane = base_plane(Shape(shape.verts, corners[own]))
        if plane is None:
            continue
        centers = shape.verts[corners[own]].mean(axis=1)
        low = plane.is_base(centers)
        base, rest = own[low], own[~low]
        if len(base) and len(rest) and _plain(shape.verts[np.unique(corners[base])], centers[low], area[base]):
            pieces = np.bincount(triangles.face_parts(corners[rest], shape.V), area[rest])
            if pieces.max() >= _OF_STANDING * pieces.sum():
                found.append(base)
    return found


def _of_cloud(cls: type[Parts], shape: Shape) -> Parts:
    """What stands on the base of a cloud, and the base; no parts if it has none."""
    from meshmatch.shapes.bases import base_plane

    number, faces = np.zeros(shape.V, np.int64), np.empty(0, np.int64)
    plane = base_plane(Shape(shape.verts[shape.valid], shape.faces))
    low = shape.valid & plane.is_base(shape.verts) if plane is not None else number > 0
    if not low.any() or not _plain(shape.verts[low], shape.verts[low], shape.vertex_areas[low]):
        return cls(shape, number, faces, np.empty(0))
    number = np.where(shape.valid, 1 + low, 0)
    return cls(shape, number, faces, np.bincount(number, shape.vertex_areas)[1:].astype(np.float64), 1)


def _is_plain(parts: Parts, number: int) -> bool:
    shape, chosen = parts.shape, np.flatnonzero(parts.faces == number)
    corners = shape.faces[chosen]
    return _plain(shape.verts[np.unique(corners)], shape.verts[corners].mean(axis=1), shape.face_areas[chosen])


def _plain(verts: Float[Floats, "V 3"], centers: Float[Floats, "F 3"], area: Float[Floats, " F"]) -> bool:
    """Whether faces between vertices are as flat or convex as floors, pedestals and boxes are."""
    from scipy.spatial import ConvexHull, QhullError

    some = verts[np.linspace(0, len(verts) - 1, min(len(verts), _HULL_POINTS)).astype(np.int64)]
    middle = some.mean(axis=0)
    try:
        planes = ConvexHull(some - middle).equations
    except QhullError:  # flat
        return True
    picked = np.linspace(0, len(centers) - 1, min(len(centers), _HULL_POINTS)).astype(np.int64)
    weights = np.maximum(area[picked], 1e-300)
    depth = np.maximum(-((centers[picked] - middle) @ planes[:, :3].T + planes[:, 3]).max(axis=1), 0.0)
    return bool((depth * weights).sum() / weights.sum() <= _PLAIN * np.sqrt(area.sum()))


def _samples(parts: Parts, unit: float) -> tuple[Float[Floats, "S 3"], Int[Ints, " S"]]:
    """Points on all parts, evenly on each, and the number of the part that each is on; in all about `_SAMPLES`, and a few
    of every part.
    """
    shape = parts.shape
    order = np.argsort(parts.faces, kind="stable")
    order = order[np.count_nonzero(parts.faces == 0) :]
    total = np.cumsum(shape.face_areas[order])
    wanted = _SAMPLES * np.minimum(parts.areas, 4 * unit**2) / np.minimum(parts.areas, 4 * unit**2).sum()
    count = np.clip(wanted, _LEAST_SAMPLES, _MOST_SAMPLES).astype(np.int64)
    ends = np.cumsum(parts.areas)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    owner = np.repeat(np.arange(1, len(parts) + 1), count)
    at = (ends - parts.areas)[owner - 1] + (within + 0.5) / count[owner - 1] * parts.areas[owner - 1]
    last = np.searchsorted(parts.faces[order], owner, side="right") - 1
    first = np.searchsorted(parts.faces[order], owner, side="left")
    face = order[np.clip(np.searchsorted(total, at), first, last)]
    rng = np.random.default_rng(0)
    return np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), len(face)), shape.verts[shape.faces[face]]), owner


def _touching(
    points: Float[Floats, "S 3"], owner: Int[Ints, " S"], numbers: frozenset[int], count: int, near: float
) -> list[frozenset[int]]:
    """Groups of parts of which each comes near another, by the cells of a grid in which both have points around them."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    here = np.isin(owner, np.array(sorted(numbers), np.int64))
    at = np.floor(points[here] / near - 0.5).astype(np.int64)
    at = at[:, None] + np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = triangles.same_rows(at.reshape(-1, 3))
    ends = np.repeat(owner[here], 8), count + 1 + cells
    size = count + 1 + len(cells)
    graph = coo_array((np.ones(len(cells), np.int8), ends), shape=(size, size))
    group = connected_components(graph, directed=False)[1]
    found: dict[int, list[int]] = {}
    for number in sorted(numbers):
        found.setdefault(int(group[number]), []).append(number)
    return [frozenset(each) for each in found.values()]


def _with_belongings(parts: Parts, number: int, points: Float[Floats, "S 3"], owner: Int[Ints, " S"]) -> frozenset[int]:
    """A part and the small ones that lie on or in it, such as eyes."""
    from meshmatch.geometry.trees import cKDTree

    area = parts.areas[number - 1]
    small = np.flatnonzero(parts.areas <= _SMALL * area) + 1
    asked = np.isin(owner, small)
    reach = _BELONGING * float(np.sqrt(area))
    near = np.isfinite(cKDTree(points[owner == number]).query(points[asked], distance_upper_bound=reach)[0])
    share = np.bincount(owner[asked], near, len(parts) + 1) / np.maximum(
        np.bincount(owner, minlength=len(parts) + 1), 1
    )
    return frozenset([number, *small[share[small] > 0.9].tolist()])
