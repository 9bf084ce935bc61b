"""Pieces of a surface laid flat: as conformal as possible (least squares), then as rigid as possible (Liu et al. 2008)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import SuperLU

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.smoothing import factors
from meshmatch.geometry.triangles import flat_areas, same_rows, signed_areas, together, triangle_areas, unit
from meshmatch.transfer.texels import faces_on

# All of these were set by hand.
_HOPELESS = 1e6  # times the stretch that is allowed: of the conformal layout
_ROUNDS = 5
_COTANGENTS = 0.02, 20.0  # of thin triangles
_THIN = 1e-3  # height over base: thinner triangles are laid out as if they had this one
_NOTHING = 0.01  # share of the area that it has then: nobody sees whether a thinner one is turned over
_SHORT = 1e-9  # of sqrt(area): an edge without length
_UNTANGLED = 6  # rounds of moving corners between their neighbours where triangles are turned over
_GRID = 1024  # texels across a piece on which it must not cover itself: at most,
_FINE = 16  # and for each row of triangles
_LONG = 600  # edges of a border whose crossings are looked for, each with each


@dataclass(frozen=True, eq=False)
class Layout:
    """Faces in the plane, counterclockwise where the surface is seen from outside, in the unit of the positions."""

    uv: Float[Floats, "M 2"]
    corners: Int[Ints, "F 3"]
    seen: Bool[Bools, " F"]  # false for threads, of which nobody sees whether they are turned over
    bad: Int[Ints, " K"]  # faces that are turned over, or lie on others
    pair: tuple[int, int] | None = None  # two faces in the middle of what lies on itself

    @classmethod
    def of(cls, uv: Floats, corners: Ints, seen: Bools, least: int) -> Layout:
        """Faces in the plane, with what is wrong with them."""
        return cls(uv, corners, seen, *_bad(uv, corners, seen, least))

    def only(self, rows: Int[Ints, " K"], least: int) -> Layout:
        """Some of the faces, where they lie."""
        used, corners = np.unique(self.corners[rows], return_inverse=True)
        return Layout.of(self.uv[used], corners.reshape(-1, 3), self.seen[rows], least)


def laid_flat(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], most: float, least: int) -> Layout | None:
    """Faces laid flat, of the area that they have.

    Parameters
    ----------
    verts, faces
        The piece, in units of any length.
    most
        Stretch or shrinking, whichever is more, that its mean over the area may reach.
    least
        Texels across the piece, at least, that are looked at to see whether it covers itself.

    Returns
    -------
    layout
        None for faces that do not hang together, or that would be stretched more.
    """
    corners, whole = _welded(faces)
    count = int(corners.max()) + 1
    if not whole:
        return None
    points = np.empty((count, 3))
    points[corners.ravel()] = verts[faces.ravel()]
    flat = apart(points[corners])
    areas, own = 0.5 * flat[:, 1, 0] * flat[:, 2, 1], triangle_areas(points, corners)
    if not (areas > 0).all():
        return None
    try:
        uv = _as_conformal(points, corners, flat, areas)
        if _stretch(uv[corners], flat, own) > _HOPELESS * most:
            return None
        for step in _as_rigid(uv, corners, flat):
            uv = step
    except RuntimeError:  # nothing holds some corners
        return None
    if not np.isfinite(uv).all():
        return None
    uv = _untangled(uv, corners)
    if _stretch(uv[corners], flat, own) > most:
        return None
    uv *= np.sqrt(own.sum() / flat_areas(uv[corners]).sum())
    return Layout.of(uv, corners, own > _NOTHING * areas, least)


def _bad(uv: Floats, corners: Ints, seen: Bools, least: int) -> tuple[Int[Ints, " K"], tuple[int, int] | None]:
    """Faces that are seen and turned over; and of two that share a texel the one closer to the border. And such two."""
    F, laid = len(corners), uv[corners]
    over, pair = (signed_areas(laid) <= 0) & seen, None
    if not over.any() and _has_simple_border(uv, corners[seen]):
        return np.empty(0, np.int64), None
    grid = int(np.clip(_FINE * np.sqrt(F), least, _GRID))
    low, high = laid.min(axis=(0, 1)), laid.max(axis=(0, 1))
    image = (0.01 + 0.98 * (laid - low) / (high - low).max()) * grid
    image[~seen] = 0.0
    found, twice = faces_on(image, grid)
    if twice:
        other = F - 1 - faces_on(image[::-1], grid)[0]
        differ = (found >= 0) & (found != other)
        edges = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        number = same_rows(edges)
        alone = (np.bincount(number, minlength=len(edges))[number] == 1).reshape(F, 3).sum(axis=1)
        one, two = found[differ], other[differ]
        over[np.where(alone[one] > alone[two], one, two)] = True
        if len(one):
            pair = int(one[len(one) // 2]), int(two[len(two) // 2])
    return np.flatnonzero(over), pair


def _has_simple_border(uv: Floats, corners: Ints) -> bool:
    """Whether the border of faces that are not turned over is seen at once not to cross itself: as many faces lie on a point
    as its loops run around it, so that no two do where one loop runs around all others. False is no answer.
    """
    M = len(uv)
    edges = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    first, count = np.unique(np.sort(edges, axis=1) @ [M, 1], return_index=True, return_counts=True)[1:]
    begin, end = edges[first[count == 1]].T
    if not 3 <= len(begin) <= _LONG or count.max() > 2 or np.bincount(begin).max() > 1:  # several loops at one corner
        return False
    a, b = uv[begin], uv[end]
    loop = together(M, begin, end)[begin]
    if (np.bincount(loop, a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > 0).sum() != 1:
        return False
    along, other = b - a, a[None] - a[:, None]
    # On which side of each edge the others begin and end.
    one = along[:, None, 0] * other[..., 1] - along[:, None, 1] * other[..., 0]
    two = one + along[:, None, 0] * along[None, :, 1] - along[:, None, 1] * along[None, :, 0]
    beside = (one > 0) == (two > 0)
    meets = ~(beside | beside.T)
    near = (begin[:, None] == end) | np.eye(len(begin), dtype=bool)
    return not (meets & ~(near | near.T)).any()


def joined(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, "F 3"]:
    """Faces with one number for what is one vertex: the ends of an edge without length, and those of two open edges that lie
    at one place, as at seams of files that give each side vertices of its own. `verts` in units of sqrt(area).
    """
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    short = edges[((verts[edges[:, 0]] - verts[edges[:, 1]]) ** 2).sum(axis=1) < _SHORT**2]
    number = same_rows(np.sort(edges, axis=1))
    free = edges[np.bincount(number)[number] == 1]
    one, two = twins(same_rows(verts)[free])
    begin = [short[:, 0], free[one, 0], free[one, 1]]
    end = [short[:, 1], free[two, 1], free[two, 0]]
    return together(len(verts), np.concatenate(begin), np.concatenate(end))[faces]


def across(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> tuple[Ints, Ints, Floats]:
    """The two faces at each edge that two faces run along in opposite directions, and its length."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    one, two = twins(edges)
    return one // 3, two // 3, np.linalg.norm(verts[edges[one, 0]] - verts[edges[one, 1]], axis=1)


def apart(corners: Float[Floats, "F 3 3"]) -> Float[Floats, "F 3 2"]:
    """Each triangle in a plane of its own: the first corner at 0, the second on the x axis."""
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    base = np.linalg.norm(along, axis=1)
    flat = np.zeros((len(corners), 3, 2))
    flat[:, 1, 0] = base
    flat[:, 2, 0] = np.einsum("fi,fi->f", other, unit(along))
    height = np.linalg.norm(other - flat[:, 2, :1] * unit(along), axis=1)
    flat[:, 2, 1] = np.maximum(height, _THIN * np.maximum(base, np.linalg.norm(other, axis=1)))
    return flat


def twins(edges: Int[Ints, "N 2"]) -> tuple[Ints, Ints]:
    """Rows that are the same edge in opposite directions, where there are two of it."""
    number = same_rows(np.sort(edges, axis=1))
    order = np.argsort(number, kind="stable")
    number, count = number[order], np.bincount(number)
    first = np.flatnonzero((number[1:] == number[:-1]) & (count[number[1:]] == 2))
    one, two = order[first], order[first + 1]
    opposite = edges[one, 0] == edges[two, 1]
    return one[opposite], two[opposite]


def _welded(faces: Int[Ints, "F 3"]) -> tuple[Int[Ints, "F 3"], bool]:
    """Corners numbered anew, those as one that faces with a common edge share; and whether the faces hang together."""
    F = len(faces)
    one, two = twins(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    corner = np.arange(3 * F)
    begin, end = corner, corner.reshape(F, 3)[:, [1, 2, 0]].ravel()
    welded = together(3 * F, np.concatenate([begin[one], end[one]]), np.concatenate([end[two], begin[two]]))
    whole = not together(F, one // 3, two // 3).any()
    return np.unique(welded, return_inverse=True)[1].reshape(F, 3), whole


def _as_conformal(points: Floats, corners: Ints, flat: Floats, areas: Floats) -> Float[Floats, "M 2"]:
    """Least squares conformal maps (Lévy et al. 2002), two far points held."""
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
        held = columns == other
        pulled = -products[held] * found[other]
        right = np.bincount(rows[held], pulled.real, M) + 1j * np.bincount(rows[held], pulled.imag, M)
        found[free] = _factors(products, rows, columns, free).solve(right[free])
    uv = np.stack([found.real, found.imag], axis=1)
    return np.asarray(uv * np.sqrt(areas.sum() / max(flat_areas(uv[corners]).sum(), 1e-300)))


def _as_rigid(uv: Floats, corners: Ints, flat: Floats) -> Iterator[Float[Floats, "M 2"]]:
    """Layouts in which each triangle is closer to a turned copy of itself."""
    M = len(uv)
    into, out = np.roll(flat, -1, axis=1) - flat, np.roll(flat, -2, axis=1) - flat
    cross = np.abs(into[..., 0] * out[..., 1] - into[..., 1] * out[..., 0])
    weights = np.clip((into * out).sum(axis=2) / np.maximum(cross, 1e-300), *_COTANGENTS)  # of the opposite edges
    begin, end = corners[:, [1, 2, 0]].ravel(), corners[:, [2, 0, 1]].ravel()
    edges = flat[:, [2, 0, 1]] - flat[:, [1, 2, 0]]
    w = weights.ravel()
    values, rows = np.concatenate([-w, -w, w, w]), np.concatenate([begin, end, begin, end])
    columns = np.concatenate([end, begin, begin, end])
    solver = _factors(values, rows, columns, np.arange(M) > 0)
    complex_edges = (edges[..., 0] + 1j * edges[..., 1]) * weights
    for _ in range(_ROUNDS):
        now = uv[corners[:, [2, 0, 1]]] - uv[corners[:, [1, 2, 0]]]
        turned = ((now[..., 0] + 1j * now[..., 1]) * complex_edges.conj()).sum(axis=1)
        size = np.abs(turned)
        turn = (np.where(size > 0, turned, 1.0) / np.where(size > 0, size, 1.0))[:, None] * complex_edges
        pull = [
            np.bincount(end, part, M) - np.bincount(begin, part, M) for part in (turn.real.ravel(), turn.imag.ravel())
        ]
        uv = np.zeros((M, 2))
        uv[1:] = solver.solve(np.stack(pull, axis=1)[1:])
        yield uv


def _factors(values: NDArray[Any], rows: Ints, columns: Ints, kept: Bools) -> SuperLU:
    """Of the rows and columns that are kept of a symmetric matrix without negative eigenvalues, a sum of entries."""
    place = np.cumsum(kept) - 1
    both, count = kept[rows] & kept[columns], int(kept.sum())
    matrix = coo_array((values[both], (place[rows[both]], place[columns[both]])), shape=(count, count)).tocsc()
    return factors(matrix)


def _untangled(uv: Floats, corners: Ints) -> Floats:
    """Corners around triangles that are turned over, moved between their neighbours (Tutte); further ones each round."""
    if (signed_areas(uv[corners]) > 0).all():
        return uv
    M = len(uv)
    edges = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    key, number = np.unique(edges.min(axis=1) * M + edges.max(axis=1), return_inverse=True)
    forward = edges[:, 0] < edges[:, 1]
    once = np.bincount(number, forward) != np.bincount(number, ~forward)
    one, two = key // M, key % M
    border = np.zeros(M, bool)
    border[one[once]] = border[two[once]] = True
    begin, end = np.concatenate([one, two]), np.concatenate([two, one])
    degree = np.bincount(begin, minlength=M)
    uv, moved = uv.copy(), np.zeros(M, bool)
    for _ in range(_UNTANGLED):
        bad = signed_areas(uv[corners]) <= 0
        if not bad.any():
            break
        moved[corners[bad].ravel()] = True
        moved[end[moved[begin]]] = True
        inner: Bools = moved & ~border
        if not inner.any():
            break
        held = inner[begin] & ~inner[end]
        right = np.stack([np.bincount(begin[held], axis, M) for axis in uv[end[held]].T], axis=1)
        every = np.arange(M)
        values = np.concatenate([-np.ones(len(begin)), degree.astype(float)])
        rows, columns = np.concatenate([begin, every]), np.concatenate([end, every])
        uv[inner] = _factors(values, rows, columns, inner).solve(right[inner])
    return uv


def _stretch(laid: Float[Floats, "F 3 2"], flat: Float[Floats, "F 3 2"], areas: Float[Floats, " F"]) -> float:
    """Mean over the area of stretch or shrinking, whichever is more, of faces that are not turned over; infinite if half
    of the area is.
    """
    one, two = laid[:, 1] - laid[:, 0], laid[:, 2] - laid[:, 0]
    along = one / flat[:, 1, :1]  # images of the axes
    up = (two - along * flat[:, 2, :1]) / flat[:, 2, 1:]
    turned = along[:, 0] * up[:, 1] - along[:, 1] * up[:, 0]
    right = turned > 0
    if right @ areas < 0.5 * areas.sum():
        return np.inf
    along, up, turned, areas = along[right], up[right], turned[right], areas[right]
    squares = (along**2 + up**2).sum(axis=1)
    most = (np.sqrt(squares + 2 * turned) + np.sqrt(np.maximum(squares - 2 * turned, 0))) / 2
    return float(np.maximum(most, most / turned) @ areas / areas.sum())
