"""Flattening of surface pieces: least squares conformal maps, then as-rigid-as-possible iterations (Liu et al. 2008)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import SuperLU

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.smoothing import factorize
from meshmatch.geometry.triangles import (
    component_minima,
    normalized,
    planar_areas,
    same_rows,
    signed_areas,
    triangle_areas,
)
from meshmatch.transfer.texels import draw_triangles

# All of these were set by hand.
_MAX_CONFORMAL_STRETCH = 1e6  # times the allowed stretch: a conformal layout with more is given up
_RIGID_ROUNDS = 5
_COTANGENTS = 0.02, 20.0  # limits of the weights of thin triangles
_MIN_HEIGHT = 1e-3  # height over base: thinner triangles are laid out as if they had this one
_MIN_VISIBLE = 0.01  # share of that area: whether a triangle with less is flipped cannot be seen
_ZERO_LENGTH = 1e-9  # of sqrt(area): shorter edges have no length
_UNTANGLE_ROUNDS = 6  # rounds that move the corners of flipped triangles between their neighbours
_MAX_GRID = 1024  # texels across a piece in the test for self-overlap: at most,
_TEXELS_PER_ROW = 16  # and for each row of triangles
_MAX_BORDER = 600  # edges of a border that are tested for crossings, each pair of them


@dataclass(frozen=True, eq=False)
class Layout:
    """Faces in the plane, counterclockwise as seen from outside the surface, in the unit of the positions."""

    uv: Float[Floats, "M 2"]
    corners: Int[Ints, "F 3"]
    visible: Bool[Bools, " F"]  # False for slivers, for which being flipped does not matter
    bad: Int[Ints, " K"]  # faces that are flipped, or overlap others
    pair: tuple[int, int] | None = None  # two faces in the middle of an overlap

    @classmethod
    def of(cls, uv: Floats, corners: Ints, visible: Bools, min_texels: int) -> Layout:
        """A layout with its bad faces; `min_texels` as in `flatten_faces`."""
        return cls(uv, corners, visible, *_find_bad(uv, corners, visible, min_texels))

    def only(self, rows: Int[Ints, " K"], min_texels: int) -> Layout:
        """The layout of some of the faces, at their places."""
        used, corners = np.unique(self.corners[rows], return_inverse=True)
        return Layout.of(self.uv[used], corners.reshape(-1, 3), self.visible[rows], min_texels)


def flatten_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], max_stretch: float, min_texels: int
) -> Layout | None:
    """Flatten faces, with their total area preserved.

    Parameters
    ----------
    verts, faces
        The piece, in any unit.
    max_stretch
        Largest stretch or shrinking, whichever is more, as a mean over the area.
    min_texels
        Minimum resolution across the piece of the test for self-overlap.

    Returns
    -------
    layout
        None for faces that are not connected, that would be stretched more, or whose system is singular.
    """
    corners, connected = _weld_corners(faces)
    count = int(corners.max()) + 1
    if not connected:
        return None
    points = np.empty((count, 3))
    points[corners.ravel()] = verts[faces.ravel()]
    flat = flat_triangles(points[corners])
    areas, own = 0.5 * flat[:, 1, 0] * flat[:, 2, 1], triangle_areas(points, corners)
    if not (areas > 0).all():
        return None
    try:
        uv = _conformal_layout(points, corners, flat, areas)
        if _stretch(uv[corners], flat, own) > _MAX_CONFORMAL_STRETCH * max_stretch:
            return None
        for step in _rigid_layouts(uv, corners, flat):
            uv = step
    except RuntimeError:  # a singular system: some corners are not fixed by anything
        return None
    if not np.isfinite(uv).all():
        return None
    uv = _untangle(uv, corners)
    if _stretch(uv[corners], flat, own) > max_stretch:
        return None
    uv *= np.sqrt(own.sum() / planar_areas(uv[corners]).sum())
    return Layout.of(uv, corners, own > _MIN_VISIBLE * areas, min_texels)


def _find_bad(
    uv: Floats, corners: Ints, visible: Bools, min_texels: int
) -> tuple[Int[Ints, " K"], tuple[int, int] | None]:
    """Flipped visible faces, and of two that share a texel the one closer to the border; and two overlapping faces."""
    F, positions = len(corners), uv[corners]
    is_bad, pair = (signed_areas(positions) <= 0) & visible, None
    if not is_bad.any() and _has_simple_border(uv, corners[visible]):
        return np.empty(0, np.int64), None
    grid = int(np.clip(_TEXELS_PER_ROW * np.sqrt(F), min_texels, _MAX_GRID))
    low, high = positions.min(axis=(0, 1)), positions.max(axis=(0, 1))
    image = (0.01 + 0.98 * (positions - low) / (high - low).max()) * grid
    image[~visible] = 0.0
    found, overlaps = draw_triangles(image, grid)
    if overlaps:
        other = F - 1 - draw_triangles(image[::-1], grid)[0]
        differ = (found >= 0) & (found != other)
        edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        number = same_rows(edges)
        open_edges = (np.bincount(number, minlength=len(edges))[number] == 1).reshape(F, 3).sum(axis=1)
        one, two = found[differ], other[differ]
        is_bad[np.where(open_edges[one] > open_edges[two], one, two)] = True
        if len(one):
            pair = int(one[len(one) // 2]), int(two[len(two) // 2])
    return np.flatnonzero(is_bad), pair


def _has_simple_border(uv: Floats, corners: Ints) -> bool:
    """Whether the border of faces, none of which is flipped, provably does not cross itself.

    A point is covered by as many faces as loops of the border run around it, so faces do not overlap if one loop runs around
    all others. False means unknown.
    """
    M = len(uv)
    edges = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    first, count = np.unique(np.sort(edges, axis=1) @ [M, 1], return_index=True, return_counts=True)[1:]
    begin, end = edges[first[count == 1]].T
    if (
        not 3 <= len(begin) <= _MAX_BORDER or count.max() > 2 or np.bincount(begin).max() > 1
    ):  # or several loops at one corner
        return False
    a, b = uv[begin], uv[end]
    loop = component_minima(M, begin, end)[begin]
    if (np.bincount(loop, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 0).sum() != 1:
        return False
    along, other = b - a, a[None] - a[:, None]
    # On which side of each edge the other edges begin and end.
    one = along[:, None, 0] * other[..., 1] - along[:, None, 1] * other[..., 0]
    two = one + along[:, None, 0] * along[None, :, 1] - along[:, None, 1] * along[None, :, 0]
    same_side = (one > 0) == (two > 0)
    crosses = ~(same_side | same_side.T)
    adjacent = (begin[:, None] == end) | np.eye(len(begin), dtype=bool)
    return not (crosses & ~(adjacent | adjacent.T)).any()


def weld(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, "F 3"]:
    """Weld vertices: the ends of an edge without length, and those of two open edges at one place, as at seams of files that
    duplicate the vertices on both sides. `verts` in units of sqrt(area).
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    short = edges[((verts[edges[:, 0]] - verts[edges[:, 1]]) ** 2).sum(axis=1) < _ZERO_LENGTH**2]
    number = same_rows(np.sort(edges, axis=1))
    free = edges[np.bincount(number)[number] == 1]
    one, two = opposite_edges(same_rows(verts)[free])
    begin = [short[:, 0], free[one, 0], free[one, 1]]
    end = [short[:, 1], free[two, 1], free[two, 0]]
    return component_minima(len(verts), np.concatenate(begin), np.concatenate(end))[faces]


def adjacent_faces(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> tuple[Ints, Ints, Floats]:
    """The two faces at each edge that exactly two faces share with opposite orientation, and the edge's length."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    one, two = opposite_edges(edges)
    return one // 3, two // 3, np.linalg.norm(verts[edges[one, 0]] - verts[edges[one, 1]], axis=1)


def flat_triangles(corners: Float[Floats, "F 3 3"]) -> Float[Floats, "F 3 2"]:
    """Each triangle in its own plane: the first corner at the origin, the second on the x axis."""
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    base = np.linalg.norm(along, axis=1)
    flat = np.zeros((len(corners), 3, 2))
    flat[:, 1, 0] = base
    flat[:, 2, 0] = np.einsum("fi,fi->f", other, normalized(along))
    height = np.linalg.norm(other - flat[:, 2, :1] * normalized(along), axis=1)
    flat[:, 2, 1] = np.maximum(height, _MIN_HEIGHT * np.maximum(base, np.linalg.norm(other, axis=1)))
    return flat


def opposite_edges(edges: Int[Ints, "N 2"]) -> tuple[Ints, Ints]:
    """Pairs of rows that are one edge in opposite directions, for edges that occur exactly twice."""
    number = same_rows(np.sort(edges, axis=1))
    order = np.argsort(number, kind="stable")
    number, count = number[order], np.bincount(number)
    first = np.flatnonzero((number[1:] == number[:-1]) & (count[number[1:]] == 2))
    one, two = order[first], order[first + 1]
    opposite = edges[one, 0] == edges[two, 1]
    return one[opposite], two[opposite]


def _weld_corners(faces: Int[Ints, "F 3"]) -> tuple[Int[Ints, "F 3"], bool]:
    """Corners renumbered, with one number where faces share an edge; and whether the faces are connected over edges."""
    F = len(faces)
    one, two = opposite_edges(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    corner = np.arange(3 * F)
    begin, end = corner, corner.reshape(F, 3)[:, [1, 2, 0]].ravel()
    welded = component_minima(3 * F, np.concatenate([begin[one], end[one]]), np.concatenate([end[two], begin[two]]))
    connected = not component_minima(F, one // 3, two // 3).any()
    return np.unique(welded, return_inverse=True)[1].reshape(F, 3), connected


def _conformal_layout(points: Floats, corners: Ints, flat: Floats, areas: Floats) -> Float[Floats, "M 2"]:
    """Least squares conformal map (Lévy et al. 2002), with two distant points fixed."""
    z = flat[..., 0] + 1j * flat[..., 1]
    weights = (z[:, [2, 0, 1]] - z[:, [1, 2, 0]]) / np.sqrt(2 * areas)[:, None]
    M = len(points)
    one = int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())
    other = int(((points - points[one]) ** 2).sum(axis=1).argmax())
    found = np.zeros(M, complex)
    found[other] = np.linalg.norm(points[one] - points[other])
    free = np.ones(M, bool)
    free[[one, other]] = False
    if free.any():
        products = (weights.conj()[:, :, None] * weights[:, None, :]).ravel()
        rows, columns = np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, 3).ravel()
        fixed = columns == other
        pulled = -products[fixed] * found[other]
        right = np.bincount(rows[fixed], pulled.real, M) + 1j * np.bincount(rows[fixed], pulled.imag, M)
        found[free] = _factorize(products, rows, columns, free).solve(right[free])
    uv = np.stack([found.real, found.imag], axis=1)
    return np.asarray(uv * np.sqrt(areas.sum() / max(planar_areas(uv[corners]).sum(), 1e-300)))


def _rigid_layouts(uv: Floats, corners: Ints, flat: Floats) -> Iterator[Float[Floats, "M 2"]]:
    """As-rigid-as-possible layouts, one per iteration: each triangle is closer to a rotated copy of itself."""
    M = len(uv)
    into, out = np.roll(flat, -1, axis=1) - flat, np.roll(flat, -2, axis=1) - flat
    cross = np.abs(into[..., 0] * out[..., 1] - into[..., 1] * out[..., 0])
    weights = np.clip((into * out).sum(axis=2) / np.maximum(cross, 1e-300), *_COTANGENTS)  # for the opposite edges
    begin, end = corners[:, [1, 2, 0]].ravel(), corners[:, [2, 0, 1]].ravel()
    edges = flat[:, [2, 0, 1]] - flat[:, [1, 2, 0]]
    w = weights.ravel()
    values, rows = np.concatenate([-w, -w, w, w]), np.concatenate([begin, end, begin, end])
    columns = np.concatenate([end, begin, begin, end])
    solver = _factorize(values, rows, columns, np.arange(M) > 0)
    complex_edges = (edges[..., 0] + 1j * edges[..., 1]) * weights
    for _ in range(_RIGID_ROUNDS):
        current = uv[corners[:, [2, 0, 1]]] - uv[corners[:, [1, 2, 0]]]
        correlation = ((current[..., 0] + 1j * current[..., 1]) * complex_edges.conj()).sum(axis=1)
        size = np.abs(correlation)
        target = (np.where(size > 0, correlation, 1.0) / np.where(size > 0, size, 1.0))[:, None] * complex_edges
        pull = [
            np.bincount(end, part, M) - np.bincount(begin, part, M)
            for part in (target.real.ravel(), target.imag.ravel())
        ]
        uv = np.zeros((M, 2))
        uv[1:] = solver.solve(np.stack(pull, axis=1)[1:])
        yield uv


def _factorize(values: NDArray[Any], rows: Ints, columns: Ints, selected: Bools) -> SuperLU:
    """Factorize the selected rows and columns of a symmetric positive semidefinite matrix; duplicate entries are summed."""
    place = np.cumsum(selected) - 1
    both, count = selected[rows] & selected[columns], int(selected.sum())
    matrix = coo_array((values[both], (place[rows[both]], place[columns[both]])), shape=(count, count)).tocsc()
    return factorize(matrix)


def _untangle(uv: Floats, corners: Ints) -> Floats:
    """Move the corners of flipped triangles to the mean of their neighbours (Tutte); each round moves one ring more."""
    if (signed_areas(uv[corners]) > 0).all():
        return uv
    M = len(uv)
    edges = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key, number = np.unique(edges.min(axis=1) * M + edges.max(axis=1), return_inverse=True)
    forward = edges[:, 0] < edges[:, 1]
    on_border = np.bincount(number, forward) != np.bincount(number, ~forward)
    one, two = key // M, key % M
    border = np.zeros(M, bool)
    border[one[on_border]] = border[two[on_border]] = True
    begin, end = np.concatenate([one, two]), np.concatenate([two, one])
    degree = np.bincount(begin, minlength=M)
    uv, moved = uv.copy(), np.zeros(M, bool)
    for _ in range(_UNTANGLE_ROUNDS):
        bad = signed_areas(uv[corners]) <= 0
        if not bad.any():
            break
        moved[corners[bad].ravel()] = True
        moved[end[moved[begin]]] = True
        inner: Bools = moved & ~border
        if not inner.any():
            break
        fixed = inner[begin] & ~inner[end]
        right = np.stack([np.bincount(begin[fixed], axis, M) for axis in uv[end[fixed]].T], axis=1)
        every = np.arange(M)
        values = np.concatenate([-np.ones(len(begin)), degree.astype(float)])
        rows, columns = np.concatenate([begin, every]), np.concatenate([end, every])
        uv[inner] = _factorize(values, rows, columns, inner).solve(right[inner])
    return uv


def _stretch(positions: Float[Floats, "F 3 2"], flat: Float[Floats, "F 3 2"], areas: Float[Floats, " F"]) -> float:
    """Area-weighted mean of the stretch or shrinking, whichever is more, of faces that are not flipped; infinite if half of
    the area is flipped.
    """
    one, two = positions[:, 1] - positions[:, 0], positions[:, 2] - positions[:, 0]
    along = one / flat[:, 1, :1]  # images of the axes
    up = (two - along * flat[:, 2, :1]) / flat[:, 2, 1:]
    determinant = along[:, 0] * up[:, 1] - along[:, 1] * up[:, 0]
    upright = determinant > 0
    if upright @ areas < 0.5 * areas.sum():
        return np.inf
    along, up, determinant, areas = along[upright], up[upright], determinant[upright], areas[upright]
    squares = (along**2 + up**2).sum(axis=1)
    largest = (np.sqrt(squares + 2 * determinant) + np.sqrt(np.maximum(squares - 2 * determinant, 0))) / 2
    return float(np.maximum(largest, largest / determinant) @ areas / areas.sum())
