"""Shapes with the same vertices, laid over one another: generalised Procrustes analysis.

Source: Gower, Generalized Procrustes analysis, Psychometrika 40 (1975), with a weight for each vertex, its share of the
surface: how finely a part is triangulated does not change what it counts.

Shapes of several parts, such as the bones of a joint, may be laid over one another by one part, so that the pose of the
others shows, or each part alone, so that no pose shows. ``groups`` (V,) say so: vertices of one number from 0 are moved
together, as they lie best; those of -1 go with group 0, and have no say.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Bool, Bools, Brief, Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.shapes.shape import LARGEST

Scale = Literal["keep", "remove"]
Shapes: TypeAlias = Sequence[ArrayLike] | Floats
"""S arrays (V, 3): an array (S, V, 3), a list, or anything that gives one shape after the other when it is indexed."""
_BLOCK = 4_000_000  # coordinates at a time: what is held in memory of a long list
MOST_GROUPS = 256
"""Of vertices that are moved together: every one is looked at for each group."""
_ROUNDS, _CLOSE = 200, 1e-10  # at most; a change, as a share of the size, that ends them


@dataclass(frozen=True, eq=False, repr=False)
class Poses(Brief):
    """How G groups of vertices of S shapes were moved: ``factor * rotation (point - center) + place``.

    ``sizes`` are root mean square distances from the centers of groups, in the unit of the shapes, before. ``groups`` (V,)
    are none where there is one: any points are moved with it.
    """

    centers: Float[Floats, "S G 3"]
    rotations: Float[Floats, "S G 3 3"]
    factors: Float[Floats, " S"]
    sizes: Float[Floats, " S"]
    places: Float[Floats, "G 3"]
    groups: Int[Ints, " V"] | None = None

    def apply(self, points: Float[Floats, "S N 3"]) -> Float[Floats, "S N 3"]:
        """Points of each shape, moved as it was."""
        moved = np.empty(points.shape)
        for group, some in self._of(points):
            turned = (points[:, some] - self.centers[:, group, None]) @ self.rotations[:, group].transpose(0, 2, 1)
            moved[:, some] = self.factors[:, None, None] * turned + self.places[group]
        return moved

    def undo(self, points: Float[Floats, "S N 3"]) -> Float[Floats, "S N 3"]:
        """Back to where each shape was."""
        moved = np.empty(points.shape)
        for group, some in self._of(points):
            turned = (points[:, some] - self.places[group]) / self.factors[:, None, None] @ self.rotations[:, group]
            moved[:, some] = turned + self.centers[:, group, None]
        return moved

    def _of(self, points: Float[Floats, "S N 3"]) -> Iterator[tuple[int, slice | Bool[Bools, " N"]]]:
        """Each group, and which of the points belong to it."""
        if self.groups is None:
            yield 0, slice(None)
            return
        if points.shape[1] != len(self.groups):
            what = "each part is superimposed alone, and these are not the vertices of the shapes"
            raise InputError(what, "superimpose whole shapes, or by one part")
        for group in range(len(self.places)):
            yield group, np.maximum(self.groups, 0) == group


@dataclass(frozen=True, eq=False, repr=False)
class Superimposed(Brief):
    """Shapes laid over one another: their ``consensus``, the ``weights`` of vertices (V,), which sum to 1, and the common
    size to which each is scaled, or None where sizes are kept. ``groups`` (V,) are those of vertices that are moved
    together, none where whole shapes are.
    """

    consensus: Float[Floats, "V 3"]
    weights: Float[Floats, " V"]
    size: float | None
    groups: Int[Ints, " V"] | None = None

    @property
    def count(self) -> int:
        """How many groups are moved, each for itself."""
        return 1 if self.groups is None else int(self.groups.max()) + 1

    @property
    def center(self) -> Float[Floats, " 3"]:
        """Center of the surface of what is laid over another."""
        counted = self.weights if self.groups is None else self.weights * (self.groups >= 0)
        return np.asarray(counted @ self.consensus / counted.sum())

    def poses(self, points: Float[Floats, "S V 3"]) -> Poses:
        """How to lay shapes over the consensus by least squares; no reflections."""
        count, squared = self.count, np.zeros(len(points))
        centers, turns = np.empty((len(points), count, 3)), np.empty((len(points), count, 3, 3))
        places, shares = np.zeros((count, 3)), np.zeros(count)
        for group in range(count):
            some = slice(None) if self.groups is None else self.groups == group
            shares[group] = self.weights[some].sum()
            weights = self.weights[some] if self.groups is None else self.weights[some] / shares[group]
            there, own = self.consensus[some], points[:, some]
            centers[:, group] = np.einsum("v,svi->si", weights, own)
            moved = own - centers[:, group, None]
            squared += shares[group] * np.einsum("v,svi,svi->s", weights, moved, moved)
            spread = np.einsum("vi,svj->sij", weights[:, None] * there, moved)
            left, _, right = np.linalg.svd(spread)
            left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
            turns[:, group] = left @ right
            if count > 1:  # one lies about the origin
                places[group] = weights @ there
        sizes = np.sqrt(squared if self.groups is None else squared / shares.sum())
        if not (sizes > 0).all():
            raise InputError("a shape is a single point", "leave it out")
        factors = np.ones(len(points)) if self.size is None else self.size / sizes
        return Poses(centers, turns, factors, sizes, places, self.groups if count > 1 else None)

    def align(self, points: Float[Floats, "S V 3"]) -> Float[Floats, "S V 3"]:
        """Shapes laid over the consensus."""
        return self.poses(points).apply(points)


def blocks(shapes: Shapes) -> Iterator[tuple[slice, Float[Floats, "B V 3"]]]:
    """Some shapes at a time, and which; `InputError` for those that are not finite or have other vertices."""
    count = len(shapes)
    first = np.shape(shapes[0])
    step = max(1, _BLOCK // max(1, int(np.prod(first))))
    for low in range(0, count, step):
        part = slice(low, min(low + step, count))
        rows = [_checked(shapes[k], k, first) for k in range(part.start, part.stop)]
        yield part, np.stack(rows)


def _checked(points: ArrayLike, number: int, first: tuple[int, ...]) -> Float[Floats, "V 3"]:
    found = np.asarray(points, np.float64)
    if found.ndim != 2 or found.shape[1] != 3 or found.shape != first:
        hint = "all shapes are fits of one template"
        raise InputError(f"shape {number} is an array of {found.shape}, the first one of {first}; not (V, 3)", hint)
    if not (np.abs(found) < LARGEST).all():
        raise InputError(f"shape {number} has vertices that are not finite, or huge", "leave it out")
    return found


def superimpose(
    shapes: Shapes,
    faces: Int[Ints, "F 3"],
    scale: Scale = "keep",
    robust: bool = False,
    groups: ArrayLike | None = None,
) -> Superimposed:
    """Lay shapes over one another, as the first one lies; their frame's origin is the center of the surface, or of the part
    by which they are laid.

    ``scale``: keep the shapes' sizes, or scale all to one size, the mean of theirs. ``robust``: the consensus is the
    spatial median of the shapes, not their mean, and so few shapes that are nothing like the others do not move it.
    ``groups``: (V,) vertices of one number from 0 are moved together, each group for itself, which then lies where it does
    on average; those of -1 go with group 0.

    `InputError`: fewer than three shapes, other vertices, vertices that are not finite, faces of other vertices, groups that
    are not one number for each vertex, or without surface.
    """
    if len(shapes) < 3:
        raise InputError(f"an atlas needs three shapes or more, not {len(shapes)}")
    start = _checked(shapes[0], 0, np.shape(shapes[0]))
    V = len(start)
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= V:
        raise InputError(f"faces must name vertices from 0 to {V - 1}", "give the template's faces (F, 3)")
    found = Superimposed(start - start.mean(axis=0), np.full(V, 1 / V), 1.0 if scale == "remove" else None)
    if groups is not None:
        whole = superimpose(shapes, faces, "keep", robust)
        found = Superimposed(whole.consensus, whole.weights, found.size, _checked_groups(groups, whole.weights))
    common = float(np.linalg.norm(start - start.mean(axis=0), axis=1).mean())
    for _ in range(_ROUNDS):
        total, share, sizes = np.zeros((V, 3)), 0.0, []
        for _, points in blocks(shapes):
            poses = found.poses(points)
            aligned = poses.apply(points)
            trust = np.ones(len(points))
            if robust:  # one step of Weiszfeld's to the spatial median
                apart = np.einsum("v,svi,svi->s", found.weights, *(2 * [aligned - found.consensus]))
                trust = 1 / np.maximum(np.sqrt(apart), 1e-9 * common)
            total += np.einsum("s,svi->vi", trust, aligned)
            share += float(trust.sum())
            sizes.append(poses.sizes)
        consensus = total / share
        areas = vertex_areas(consensus, faces)
        if not areas.sum() > 0:
            raise InputError("the mean of the shapes has no surface", "are they fits of one template?")
        size = float(np.concatenate(sizes).mean()) if scale == "remove" else None
        change = np.abs(consensus - found.consensus).max()
        found = replace(found, consensus=consensus, weights=areas / areas.sum(), size=size)
        if change < _CLOSE * common:
            break
    turn = found.poses(start[None]).rotations[0, 0] if found.count == 1 else np.eye(3)  # as the first shape lies
    return replace(found, consensus=(found.consensus - found.center) @ turn)


def _checked_groups(groups: ArrayLike, weights: Float[Floats, " V"]) -> Int[Ints, " V"]:
    found = np.asarray(groups)
    if found.shape != weights.shape or found.dtype.kind not in "iu" or found.min() < -1:
        raise InputError(f"groups must be {len(weights)} whole numbers from -1", "one for each vertex")
    count = int(found.max()) + 1
    if count > MOST_GROUPS:
        raise InputError(f"{count:,} groups of vertices are too many", f"{MOST_GROUPS} can be superimposed, each alone")
    if count < 1 or count > len(weights) or not (np.bincount(found[found >= 0], weights[found >= 0], count) > 0).all():
        raise InputError("a group of vertices has no surface", "number groups 0, 1, 2, ...")
    return found.astype(np.int64)
