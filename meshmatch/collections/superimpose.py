"""Shapes with the same vertices, laid over one another: generalised Procrustes analysis.

Source: Gower, Generalized Procrustes analysis, Psychometrika 40 (1975), with a weight for each vertex, its share of the
surface: how finely a part is triangulated does not change what it counts.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import vertex_areas
from meshmatch.shapes.shape import LARGEST

Scale = Literal["keep", "remove"]
Shapes: TypeAlias = Sequence[ArrayLike] | Floats
"""S arrays (V, 3): an array (S, V, 3), a list, or anything that gives one shape after the other when it is indexed."""
_BLOCK = 4_000_000  # coordinates at a time: what is held in memory of a long list
_ROUNDS, _CLOSE = 200, 1e-10  # at most; a change, as a share of the size, that ends them


@dataclass(frozen=True, eq=False)
class Poses:
    """How S shapes were moved: ``factor * rotation (point - center)``.

    ``sizes`` are root mean square distances from the center over the surface, in the unit of the shapes, before.
    """

    centers: Float[Floats, "S 3"]
    rotations: Float[Floats, "S 3 3"]
    factors: Float[Floats, " S"]
    sizes: Float[Floats, " S"]

    def apply(self, points: Float[Floats, "S N 3"]) -> Float[Floats, "S N 3"]:
        """Points of each shape, moved as it was."""
        turned = (points - self.centers[:, None]) @ self.rotations.transpose(0, 2, 1)
        return np.asarray(self.factors[:, None, None] * turned)

    def undo(self, points: Float[Floats, "S N 3"]) -> Float[Floats, "S N 3"]:
        """Back to where each shape was."""
        return np.asarray(points / self.factors[:, None, None] @ self.rotations + self.centers[:, None])


@dataclass(frozen=True, eq=False)
class Superimposed:
    """Shapes laid over one another: their ``consensus``, the ``weights`` of vertices (V,), which sum to 1, and the common
    size to which each is scaled, or None where sizes are kept.
    """

    consensus: Float[Floats, "V 3"]
    weights: Float[Floats, " V"]
    size: float | None

    def poses(self, points: Float[Floats, "S V 3"]) -> Poses:
        """How to lay shapes over the consensus by least squares; no reflections."""
        centers = np.einsum("v,svi->si", self.weights, points)
        moved = points - centers[:, None]
        sizes = np.sqrt(np.einsum("v,svi,svi->s", self.weights, moved, moved))
        if not (sizes > 0).all():
            raise InputError("a shape is a single point", "leave it out")
        spread = np.einsum("vi,svj->sij", self.weights[:, None] * self.consensus, moved)
        left, _, right = np.linalg.svd(spread)
        left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
        factors = np.ones(len(points)) if self.size is None else self.size / sizes
        return Poses(centers, left @ right, factors, sizes)

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


def superimpose(shapes: Shapes, faces: Int[Ints, "F 3"], scale: Scale = "keep", robust: bool = False) -> Superimposed:
    """Lay shapes over one another, as the first one lies; their frame's origin is the center of the surface.

    ``scale``: keep the shapes' sizes, or scale all to one size, the mean of theirs. ``robust``: the consensus is the
    spatial median of the shapes, not their mean, and so few shapes that are nothing like the others do not move it.

    `InputError`: fewer than three shapes, other vertices, vertices that are not finite, faces of other vertices.
    """
    if len(shapes) < 3:
        raise InputError(f"an atlas needs three shapes or more, not {len(shapes)}")
    start = _checked(shapes[0], 0, np.shape(shapes[0]))
    V = len(start)
    if len(faces) == 0 or faces.min() < 0 or faces.max() >= V:
        raise InputError(f"faces must name vertices from 0 to {V - 1}", "give the template's faces (F, 3)")
    found = Superimposed(start - start.mean(axis=0), np.full(V, 1 / V), 1.0 if scale == "remove" else None)
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
        found = Superimposed(consensus, areas / areas.sum(), size)
        if change < _CLOSE * common:
            break
    turn = found.poses(start[None]).rotations[0]  # as the first shape lies
    center = found.weights @ found.consensus
    return Superimposed((found.consensus - center) @ turn, found.weights, found.size)
