"""Convert VTK cells to the triangles of a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes.formats import (
    Raw,
    check_element_count,
    concatenated_ranges,
    damaged,
    strips,
    warn_if_no_triangles,
)
from meshmatch.shapes.formats.polygons import triangles_of

_POINTS, _LINES = (0, 1, 2), (3, 4, 21)
_POLYGONS = (5, 7, 9)  # triangles, polygons, quads
_STRIP, _PIXEL = 6, 8


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells: point indices of all cells, concatenated; the number of points of each; and its VTK cell type."""

    corners: Int[Ints, " N"]
    sizes: Int[Ints, " P"]
    kinds: Int[Ints, " P"]

    def moved(self, first: int, count: int) -> Self:
        """Add ``first`` to the point indices; indices outside the ``count`` points of the piece become -1."""
        is_valid = (self.corners >= 0) & (self.corners < count)
        return replace(self, corners=np.where(is_valid, self.corners + first, -1))


def build_raw(
    name: str, size: int, verts: Float[Floats, "V 3"], cells: Sequence[Cells], colors: Float[Floats, "V 4"] | None
) -> Raw:
    """Build the `Raw` of a file of `size` bytes; `InputError` for cells that are not faces, or inconsistent counts.

    Points are ignored, and lines with a warning.
    """
    triangles = [np.zeros((0, 3), np.int64)]
    n_faces = n_triangles = 0
    for each in cells:
        if (each.sizes < 0).any() or each.sizes.sum() > len(each.corners):
            raise damaged(name, "a cell has fewer points than it says")
        n_triangles += max(int(each.sizes.sum()) - 2 * len(each.sizes), 0)
        check_element_count(name, size, len(verts), n_triangles)
        is_known = np.isin(each.kinds, (*_POINTS, *_LINES, *_POLYGONS, _STRIP, _PIXEL))
        if not is_known.all():
            kind = int(each.kinds[~is_known][0])
            hint = "save its surface alone (in ParaView: Extract Surface)"
            raise InputError(f"{name} has cells of VTK type {kind}, which are not faces of three or more corners", hint)
        if np.isin(each.kinds, _LINES).any():
            warn(f"{name}: its lines are not faces and are left out")
        starts = np.cumsum(each.sizes) - each.sizes
        for cell_types in (_POLYGONS, (_STRIP,), (_PIXEL,)):
            rows = np.flatnonzero(np.isin(each.kinds, cell_types))
            if not len(rows):
                continue
            n_faces += len(rows)
            corners, sizes = each.corners[concatenated_ranges(starts[rows], each.sizes[rows])], each.sizes[rows]
            if cell_types == (_STRIP,):
                triangles.append(strips(corners, sizes))
                continue
            if cell_types == (_PIXEL,):
                if (sizes != 4).any():
                    raise damaged(name, "a pixel has other than four points")
                corners = corners.reshape(-1, 4)[:, [0, 1, 3, 2]].ravel()
            triangles.append(corners[triangles_of(name, verts, corners, sizes)])
    faces = np.concatenate(triangles)
    warn_if_no_triangles(name, n_faces, faces)
    return Raw(verts, faces, colors)
