"""Connected parts of a mesh, by number, and sets of parts that may be separate objects.

Files without names, such as ply and stl, often contain a body together with a floor, a pedestal or a chair. Parts are
numbered from 1, the largest area first. A flat base that a body is fused with is a part too, after all others.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry import triangles
from meshmatch.shapes.faces import degenerate_faces, seam_representatives
from meshmatch.shapes.shape import Shape

# All constants were set by hand; lengths are in units of sqrt(area) of the reference part, see `_reference_part`.
# minimum area of a large part, which may be an object or most of one, as a share of the reference part's area
_MIN_LARGE_SHARE = 0.02
_MAX_LARGE = 12  # maximum number of large parts to examine
# maximum mean depth below the convex hull for a part that is as simple as a box, a plate or a column
_MAX_HULL_DEPTH = 0.03
_HULL_POINTS = 1500
_SAMPLES, _MAX_SAMPLES, _MIN_SAMPLES = 12_000, 6_000, 2  # samples in all, and bounds for each part
_MAX_GROUP_GAP = 0.03  # maximum gap between parts of one group
# maximum gap and area (as a share of a part) of parts that belong to it: eyes, hair, shoes
_MAX_BELONGING_GAP, _MAX_BELONGING_SHARE = 0.1, 0.2
_MAX_TRIES = 6
_MAX_BASES = 2  # number of largest parts that are searched for a base
_MIN_STANDING_SHARE = 0.4  # minimum share of a single piece in all that stands on a base, unlike the legs of a table


@dataclass(frozen=True, eq=False)
class Parts:
    """The connected parts of a mesh; part n, counted from 1, has the n-th largest area.

    Vertices at one position are connected if they lie on open edges, as at texture seams and between the triangles of
    an stl. Equal areas (to 6 digits) are in the order of their first vertices. Bases come last, see `of`; what stands
    on one keeps the number that both have together.

    Attributes
    ----------
    shape : the mesh
    number : (V,) part of each vertex; 0 for vertices without a face of positive area
    faces : (F,) part of each face; 0 for faces without area, or at an invalid vertex
    areas : (P,) area of each part, in squared units of the file
    bases : number of parts that are bases: the last ones
    """

    shape: Shape
    number: Int[Ints, " V"]
    faces: Int[Ints, " F"]
    areas: Float[Floats, " P"]
    bases: int = 0

    @classmethod
    def of(cls, shape: Shape, bases: bool = False) -> Parts:
        """Find the parts of a shape; a cloud has none, or two if ``bases`` finds a base in it.

        ``bases`` separates flat bases that something is fused with (`meshmatch.shapes.bases`) as parts of their own;
        vertices along the cut belong to the base.
        """
        if bases and shape.is_cloud:
            return _parts_of_cloud(cls, shape)
        usable = np.flatnonzero(shape.valid_faces)
        corners = shape.faces[usable]
        twin = seam_representatives(shape.verts, corners)
        vectors = shape.face_vectors[usable]
        has_area = ~degenerate_faces(shape.verts, twin[corners], vectors, shape.diagonal)
        usable, corners = usable[has_area], corners[has_area]
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
        base_faces = _find_bases(shape, twin[corners], area, part) if bases else []
        number[corners] = part[:, None]
        for base in base_faces:
            part[base] = part.max() + 1
            number[corners[base]] = part[base, None]
        of_face[usable] = part
        return cls(shape, number, of_face, np.bincount(part, area)[1:].astype(np.float64), len(base_faces))

    def __len__(self) -> int:
        return len(self.areas)

    @cached_property
    def shares(self) -> Float[Floats, " P"]:
        """Share (0..1) of each part in the area."""
        return np.asarray(self.areas / max(self.areas.sum(), 1e-300))

    @cached_property
    def counts(self) -> Int[Ints, " P"]:
        """Number of vertices of each part."""
        return np.asarray(np.bincount(self.number, minlength=len(self) + 1)[1:])

    @cached_property
    def first_vertices(self) -> Int[Ints, " P"]:
        """First vertex of each part in the order of the file."""
        first = np.full(len(self) + 1, self.shape.V)
        np.minimum.at(first, self.number, np.arange(self.shape.V))
        return first[1:]

    @cached_property
    def bounds(self) -> Float[Floats, "P 2 3"]:
        """Lowest and highest corner of each part's bounding box, in the frame of the file."""
        boxes = np.full((len(self) + 1, 2, 3), np.inf)
        np.minimum.at(boxes[:, 0], self.number, self.shape.verts)
        np.minimum.at(boxes[:, 1], self.number, -self.shape.verts)
        boxes[:, 1] *= -1
        return boxes[1:]

    def share(self, numbers: Iterable[int]) -> float:
        """Share (0..1) of these parts together in the area."""
        return float(self.shares[np.array(sorted(numbers), np.int64) - 1].sum())

    def others(self, numbers: Iterable[int]) -> tuple[int, ...]:
        """Numbers of all other parts."""
        return tuple(sorted(set(range(1, len(self) + 1)) - set(numbers)))


def without_parts(shape: Shape, parts: Parts, numbers: Sequence[int]) -> Shape:
    """The shape with weight 0 at all vertices of these parts: fits ignore them, but they keep their places."""
    weights = np.ones(shape.V) if shape.weights is None else shape.weights.copy()
    weights[np.isin(parts.number, np.asarray(numbers, np.int64))] = 0.0
    return replace(shape, weights=weights)


def leave_out(shape: Shape, numbers: Sequence[int]) -> Shape:
    """As `without_parts`, for parts of the shape with bases; the shape itself if ``numbers`` is empty."""
    return without_parts(shape, Parts.of(shape, bases=True), numbers) if numbers else shape


def candidate_sets(parts: Parts) -> list[frozenset[int]]:
    """Sets of parts that may be an object next to something else, the likelier ones first; at most `_MAX_TRIES`.

    Touching parts, such as a body and its clothes, stay together: groups are formed without all large simple parts
    (floors, pedestals, boxes), or without the largest ones. Then come single large parts with the small parts on them.
    """
    if len(parts) < 2:
        return []
    if parts.shape.is_cloud:
        return [frozenset({1})]
    reference = _reference_part(parts)
    unit = float(np.sqrt(parts.areas[reference - 1]))
    large = [
        n for n in range(1, min(len(parts), 10 * _MAX_LARGE) + 1) if parts.areas[n - 1] >= _MIN_LARGE_SHARE * unit**2
    ]
    simple = [n for n in large[:_MAX_LARGE] if _is_simple_part(parts, n)]
    points, owner = _sample_parts(parts, unit)
    everything = frozenset(range(1, len(parts) + 1))
    groups: list[list[frozenset[int]]] = []
    for left_out in dict.fromkeys(frozenset(simple[:count]) for count in (len(simple), 1, 2, 3, 0)):
        touching = _touching_groups(points, owner, everything - left_out, len(parts), _MAX_GROUP_GAP * unit)
        large_groups = [
            group for group in touching if parts.share(group) >= _MIN_LARGE_SHARE * parts.shares[reference - 1]
        ]
        groups.append(sorted(large_groups, key=lambda group: -parts.share(group)))
    singles = [n for n in large[:_MAX_LARGE] if n not in simple][:3] + simple[:2]
    candidates = [group for each in groups for group in each[:1]]
    candidates += [_with_belongings(parts, n, points, owner) for n in singles]
    candidates += [group for each in groups for group in each[1:2]]
    return [each for each in dict.fromkeys(candidates) if each != everything][:_MAX_TRIES]


def are_separate(parts: Parts, one: frozenset[int], other: frozenset[int]) -> bool:
    """Whether two sets of parts are next to each other: neither is around the other, as a coat is."""
    if one & other:
        return False
    low, high = np.stack([_bounding_box(parts, each) for each in (one, other)], axis=1)
    overlap = np.maximum(np.minimum(*high) - np.maximum(*low), 0.0).prod()
    return bool(overlap < 0.5 * np.maximum(high - low, 1e-300).prod(axis=1).min())


def _bounding_box(parts: Parts, numbers: frozenset[int]) -> Float[Floats, "2 3"]:
    bounds = parts.bounds[np.array(sorted(numbers)) - 1]
    return np.stack([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])


def _reference_part(parts: Parts) -> int:
    """The part whose area is the unit: the largest one that is not simple, else the second one."""
    return next((n for n in range(1, min(len(parts), _MAX_LARGE) + 1) if not _is_simple_part(parts, n)), 2)


def _find_bases(
    shape: Shape, corners: Int[Ints, "F 3"], area: Float[Floats, " F"], part: Int[Ints, " F"]
) -> list[Ints]:
    """For each flat base, which faces belong to it."""
    from meshmatch.shapes.bases import base_plane

    bases = []
    for number in range(1, min(_MAX_BASES, int(part.max())) + 1):
        in_part = np.flatnonzero(part == number)
        plane = base_plane(Shape(shape.verts, corners[in_part]))
        if plane is None:
            continue
        centers = shape.verts[corners[in_part]].mean(axis=1)
        is_base = plane.is_base(centers)
        base, standing = in_part[is_base], in_part[~is_base]
        if (
            len(base)
            and len(standing)
            and _is_simple(shape.verts[np.unique(corners[base])], centers[is_base], area[base])
        ):
            pieces = np.bincount(triangles.face_parts(corners[standing], shape.V), area[standing])
            if pieces.max() >= _MIN_STANDING_SHARE * pieces.sum():
                bases.append(base)
    return bases


def _parts_of_cloud(cls: type[Parts], shape: Shape) -> Parts:
    """The parts of a cloud: what stands on its base, and the base; none without a base."""
    from meshmatch.shapes.bases import base_plane

    number, faces = np.zeros(shape.V, np.int64), np.empty(0, np.int64)
    plane = base_plane(Shape(shape.verts[shape.valid], shape.faces))
    is_base = shape.valid & plane.is_base(shape.verts) if plane is not None else number > 0
    if not is_base.any() or not _is_simple(shape.verts[is_base], shape.verts[is_base], shape.vertex_areas[is_base]):
        return cls(shape, number, faces, np.empty(0))
    number = np.where(shape.valid, 1 + is_base, 0)
    return cls(shape, number, faces, np.bincount(number, shape.vertex_areas)[1:].astype(np.float64), 1)


def _is_simple_part(parts: Parts, number: int) -> bool:
    shape, chosen = parts.shape, np.flatnonzero(parts.faces == number)
    corners = shape.faces[chosen]
    return _is_simple(shape.verts[np.unique(corners)], shape.verts[corners].mean(axis=1), shape.face_areas[chosen])


def _is_simple(verts: Float[Floats, "V 3"], centers: Float[Floats, "F 3"], area: Float[Floats, " F"]) -> bool:
    """Whether faces are as flat or convex as floors, pedestals and boxes."""
    from scipy.spatial import ConvexHull, QhullError

    sample = verts[np.linspace(0, len(verts) - 1, min(len(verts), _HULL_POINTS)).astype(np.int64)]
    middle = sample.mean(axis=0)
    try:
        planes = ConvexHull(sample - middle).equations
    except QhullError:  # coplanar
        return True
    picked = np.linspace(0, len(centers) - 1, min(len(centers), _HULL_POINTS)).astype(np.int64)
    weights = np.maximum(area[picked], 1e-300)
    depth = np.maximum(-((centers[picked] - middle) @ planes[:, :3].T + planes[:, 3]).max(axis=1), 0.0)
    return bool((depth * weights).sum() / weights.sum() <= _MAX_HULL_DEPTH * np.sqrt(area.sum()))


def _sample_parts(parts: Parts, unit: float) -> tuple[Float[Floats, "S 3"], Int[Ints, " S"]]:
    """About `_SAMPLES` points, evenly distributed on each part, a few on every one; and the part of each point."""
    shape = parts.shape
    order = np.argsort(parts.faces, kind="stable")
    order = order[np.count_nonzero(parts.faces == 0) :]
    total = np.cumsum(shape.face_areas[order])
    wanted = _SAMPLES * np.minimum(parts.areas, 4 * unit**2) / np.minimum(parts.areas, 4 * unit**2).sum()
    count = np.clip(wanted, _MIN_SAMPLES, _MAX_SAMPLES).astype(np.int64)
    ends = np.cumsum(parts.areas)
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    owner = np.repeat(np.arange(1, len(parts) + 1), count)
    position = (ends - parts.areas)[owner - 1] + (within + 0.5) / count[owner - 1] * parts.areas[owner - 1]
    last = np.searchsorted(parts.faces[order], owner, side="right") - 1
    first = np.searchsorted(parts.faces[order], owner, side="left")
    face = order[np.clip(np.searchsorted(total, position), first, last)]
    rng = np.random.default_rng(0)
    return np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), len(face)), shape.verts[shape.faces[face]]), owner


def _touching_groups(
    points: Float[Floats, "S 3"], owner: Int[Ints, " S"], numbers: frozenset[int], count: int, max_gap: float
) -> list[frozenset[int]]:
    """Groups of parts that are connected by near pairs: by grid cells that have points of both in their neighbourhood."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    in_group = np.isin(owner, np.array(sorted(numbers), np.int64))
    cell = np.floor(points[in_group] / max_gap - 0.5).astype(np.int64)
    cell = cell[:, None] + np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = triangles.same_rows(cell.reshape(-1, 3))
    ends = np.repeat(owner[in_group], 8), count + 1 + cells
    size = count + 1 + len(cells)
    graph = coo_array((np.ones(len(cells), np.int8), ends), shape=(size, size))
    group = connected_components(graph, directed=False)[1]
    members: dict[int, list[int]] = {}
    for number in sorted(numbers):
        members.setdefault(int(group[number]), []).append(number)
    return [frozenset(each) for each in members.values()]


def _with_belongings(parts: Parts, number: int, points: Float[Floats, "S 3"], owner: Int[Ints, " S"]) -> frozenset[int]:
    """A part together with the small parts on or in it, such as eyes."""
    from meshmatch.geometry.trees import cKDTree

    area = parts.areas[number - 1]
    small = np.flatnonzero(parts.areas <= _MAX_BELONGING_SHARE * area) + 1
    on_small = np.isin(owner, small)
    reach = _MAX_BELONGING_GAP * float(np.sqrt(area))
    near = np.isfinite(cKDTree(points[owner == number]).query(points[on_small], distance_upper_bound=reach)[0])
    share = np.bincount(owner[on_small], near, len(parts) + 1) / np.maximum(
        np.bincount(owner, minlength=len(parts) + 1), 1
    )
    return frozenset([number, *small[share[small] > 0.9].tolist()])
