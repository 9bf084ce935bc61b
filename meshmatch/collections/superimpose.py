"""Superimpose shapes with the same vertices: generalised Procrustes analysis.

Source: Gower, Generalized Procrustes analysis, Psychometrika 40 (1975), with the share of the surface around each vertex
as its weight, so that the result does not depend on how finely parts are triangulated.

Shapes of several parts, such as the bones of a joint, may be superimposed by one part, so that the poses of the others
vary, or part by part, so that no pose varies. An array ``groups`` (V,) controls this: each group 0, 1, 2, ... is moved on
its own by least squares; vertices of -1 move with group 0 but do not count.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, ShortRepr
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.shapes.shape import LARGEST

Scale = Literal["keep", "remove"]
Shapes: TypeAlias = Sequence[ArrayLike] | Floats
"""S arrays (V, 3): an array (S, V, 3), a list, or anything that returns the shapes by index."""
_BLOCK = 4_000_000  # coordinates loaded at a time, of a long list of shapes
MAX_GROUPS = 256
"""Largest number of groups of vertices; the cost grows with the number of groups times that of vertices."""
_MAX_ROUNDS, _TOLERANCE = 200, 1e-10  # iterations; change of the consensus at which they end, relative to its size


@dataclass(frozen=True, eq=False, repr=False)
class Poses(ShortRepr):
    """Transformations of G groups of vertices of S shapes: ``factor * rotation (point - center) + place``.

    ``sizes`` are root mean square distances from the centers of the groups, in the unit of the shapes, before scaling.
    ``groups`` (V,) is None if there is one group; the transformation then applies to any points of a shape.
    """

    centers: Float[Floats, "S G 3"]
    rotations: Float[Floats, "S G 3 3"]
    factors: Float[Floats, " S"]
    sizes: Float[Floats, " S"]
    places: Float[Floats, "G 3"]
    groups: Int[Ints, " V"] | None = None

    def apply(self, points: Float[Floats, "S N 3"]) -> Float[Floats, "S N 3"]:
        """Apply the transformation of each shape to points of the shape."""
        moved = np.empty(points.shape)
        for group, some in self._split(points):
            turned = (points[:, some] - self.centers[:, group, None]) @ self.rotations[:, group].transpose(0, 2, 1)
            moved[:, some] = self.factors[:, None, None] * turned + self.places[group]
        return moved

    def undo(self, points: Float[Floats, "S N 3"]) -> Float[Floats, "S N 3"]:
        """Invert `apply`."""
        moved = np.empty(points.shape)
        for group, some in self._split(points):
            turned = (points[:, some] - self.places[group]) / self.factors[:, None, None] @ self.rotations[:, group]
            moved[:, some] = turned + self.centers[:, group, None]
        return moved

    def _split(self, points: Float[Floats, "S N 3"]) -> Iterator[tuple[int, slice | Bool[Bools, " N"]]]:
        """Yield each group's number, and the points that belong to it; `InputError` for points that are not vertices."""
        if self.groups is None:
            yield 0, slice(None)
            return
        if points.shape[1] != len(self.groups):
            what = "each part is superimposed alone, and these are not the vertices of the shapes"
            raise InputError(what, "superimpose whole shapes, or by one part")
        for group in range(len(self.places)):
            yield group, np.maximum(self.groups, 0) == group


@dataclass(frozen=True, eq=False, repr=False)
class Superimposed(ShortRepr):
    """The result of a superimposition, with which further shapes can be aligned.

    ``consensus`` is the mean (or spatial median) of the aligned shapes, and ``weights`` (V,) are those of the vertices,
    which sum to 1. ``size`` is the common size that shapes are scaled to, None if sizes are kept. ``groups`` (V,) are the
    groups of vertices that move together, None if whole shapes do.
    """

    consensus: Float[Floats, "V 3"]
    weights: Float[Floats, " V"]
    size: float | None
    groups: Int[Ints, " V"] | None = None

    @property
    def count(self) -> int:
        """Number of groups that move independently."""
        return 1 if self.groups is None else int(self.groups.max()) + 1

    @property
    def center(self) -> Float[Floats, " 3"]:
        """Center of the surface of the consensus, of the vertices that count."""
        counted = self.weights if self.groups is None else self.weights * (self.groups >= 0)
        return np.asarray(counted @ self.consensus / counted.sum())

    def poses(self, points: Float[Floats, "S V 3"]) -> Poses:
        """Transformations that align shapes with the consensus by least squares, without reflections."""
        count, squared = self.count, np.zeros(len(points))
        centers, rotations = np.empty((len(points), count, 3)), np.empty((len(points), count, 3, 3))
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
            rotations[:, group] = left @ right
            if count > 1:  # a single group stays centred on the origin
                places[group] = weights @ there
        sizes = np.sqrt(squared if self.groups is None else squared / shares.sum())
        if not (sizes > 0).all():
            raise InputError("a shape is a single point", "leave it out")
        factors = np.ones(len(points)) if self.size is None else self.size / sizes
        return Poses(centers, rotations, factors, sizes, places, self.groups if count > 1 else None)

    def align(self, points: Float[Floats, "S V 3"]) -> Float[Floats, "S V 3"]:
        """Align shapes with the consensus."""
        return self.poses(points).apply(points)


def iter_blocks(shapes: Shapes) -> Iterator[tuple[slice, Float[Floats, "B V 3"]]]:
    """Yield blocks of shapes, with the slice of each; `InputError` for shapes that are not finite or differ in size."""
    count = len(shapes)
    first = np.shape(shapes[0])
    step = max(1, _BLOCK // max(1, int(np.prod(first))))
    for low in range(0, count, step):
        part = slice(low, min(low + step, count))
        rows = [_checked_points(shapes[k], k, first) for k in range(part.start, part.stop)]
        yield part, np.stack(rows)


def _checked_points(points: ArrayLike, number: int, first: tuple[int, ...]) -> Float[Floats, "V 3"]:
    """Validate the vertices of shape ``number``, as float64; ``first`` is the array size of the first shape."""
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
    """Superimpose shapes by generalised Procrustes analysis.

    The result has the orientation of the first shape; its origin is the center of the surface of the vertices that count.

    Parameters
    ----------
    shapes : S arrays (V, 3)
    faces : (F, 3) triangles, for the weights of vertices
    scale : "keep" the sizes of the shapes, or "remove" them: scale all shapes to their mean size
    robust : whether the consensus is the spatial median of the shapes rather than their mean, which outliers hardly move
    groups : (V,) groups of vertices that move together, see the module; each group ends at its average place

    Raises
    ------
    InputError
        Fewer than three shapes, shapes with different or non-finite vertices, faces of other vertices, groups that are
        not one number per vertex, or without surface.
    """
    if len(shapes) < 3:
        raise InputError(f"an atlas needs three shapes or more, not {len(shapes)}")
    start = _checked_points(shapes[0], 0, np.shape(shapes[0]))
    V = len(start)
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= V:
        raise InputError(f"faces must name vertices from 0 to {V - 1}", "give the template's faces (F, 3)")
    found = Superimposed(start - start.mean(axis=0), np.full(V, 1 / V), 1.0 if scale == "remove" else None)
    if groups is not None:
        whole = superimpose(shapes, faces, "keep", robust)
        found = Superimposed(whole.consensus, whole.weights, found.size, _checked_groups(groups, whole.weights))
    common = float(np.linalg.norm(start - start.mean(axis=0), axis=1).mean())
    for _ in range(_MAX_ROUNDS):
        total, share, sizes = np.zeros((V, 3)), 0.0, []
        for _, points in iter_blocks(shapes):
            poses = found.poses(points)
            aligned = poses.apply(points)
            trust = np.ones(len(points))
            if robust:  # one step of Weiszfeld's algorithm for the spatial median
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
        if change < _TOLERANCE * common:
            break
    turn = (
        found.poses(start[None]).rotations[0, 0] if found.count == 1 else np.eye(3)
    )  # the orientation of the first shape
    return replace(found, consensus=(found.consensus - found.center) @ turn)


def _checked_groups(groups: ArrayLike, weights: Float[Floats, " V"]) -> Int[Ints, " V"]:
    """Validate groups of vertices, as int64."""
    found = np.asarray(groups)
    if found.shape != weights.shape or found.dtype.kind not in "iu" or found.min() < -1:
        raise InputError(f"groups must be {len(weights)} whole numbers from -1", "one for each vertex")
    count = int(found.max()) + 1
    if count > MAX_GROUPS:
        raise InputError(f"{count:,} groups of vertices are too many", f"{MAX_GROUPS} can be superimposed, each alone")
    if count < 1 or count > len(weights) or not (np.bincount(found[found >= 0], weights[found >= 0], count) > 0).all():
        raise InputError("a group of vertices has no surface", "number groups 0, 1, 2, ...")
    return found.astype(np.int64)
