"""Cells of VTK: which of them are faces of a surface, and their triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes.formats import Raw, check_element_count, damaged, runs, strips, warn_if_no_triangles
from meshmatch.shapes.formats.polygons import triangles_of

_POINTS, _LINES = (0, 1, 2), (3, 4, 21)
_POLYGONS = (5, 7, 9)  # triangles, polygons, quads
_STRIP, _PIXEL = 6, 8


@dataclass(frozen=True, eq=False)
class Cells:
    """Cells one after the other: numbers of points, how many each has, and of what kind it is."""

    corners: Int[Ints, " N"]
    sizes: Int[Ints, " P"]
    kinds: Int[Ints, " P"]

    def moved(self, first: int, count: int) -> Self:
        """With so much added to the numbers of points; what is none of the piece's ``count`` stays none."""
        known = (self.corners >= 0) & (self.corners < count)
        return replace(self, corners=np.where(known, self.corners + first, -1))


def raw_of(
    name: str, size: int, verts: Float[Floats, "V 3"], cells: Sequence[Cells], colors: Float[Floats, "V 4"] | None
) -> Raw:
    """What a file of this size says. `InputError` for cells that are no surface, or numbers that lead nowhere."""
    triangles = [np.zeros((0, 3), np.int64)]
    listed = made = 0
    for each in cells:
        if (each.sizes < 0).any() or each.sizes.sum() > len(each.corners):
            raise damaged(name, "a cell has fewer points than it says")
        made += max(int(each.sizes.sum()) - 2 * len(each.sizes), 0)
        check_element_count(name, size, len(verts), made)
        known = np.isin(each.kinds, (*_POINTS, *_LINES, *_POLYGONS, _STRIP, _PIXEL))
        if not known.all():
            kind = int(each.kinds[~known][0])
            hint = "save its surface alone (in ParaView: Extract Surface)"
            raise InputError(
                f"{name} has cells of VTK's kind {kind}, which are no faces of three or more corners", hint
            )
        if np.isin(each.kinds, _LINES).any():
            warn(f"{name}: its lines are no faces, and are left out")
        starts = np.cumsum(each.sizes) - each.sizes
        for kinds in (_POLYGONS, (_STRIP,), (_PIXEL,)):
            some = np.flatnonzero(np.isin(each.kinds, kinds))
            if not len(some):
                continue
            listed += len(some)
            corners, sizes = each.corners[runs(starts[some], each.sizes[some])], each.sizes[some]
            if kinds == (_STRIP,):
                triangles.append(strips(corners, sizes))
                continue
            if kinds == (_PIXEL,):
                if (sizes != 4).any():
                    raise damaged(name, "a pixel has other than four points")
                corners = corners.reshape(-1, 4)[:, [0, 1, 3, 2]].ravel()
            triangles.append(corners[triangles_of(name, verts, corners, sizes)])
    found = np.concatenate(triangles)
    warn_if_no_triangles(name, listed, found)
    return Raw(verts, found, colors)
