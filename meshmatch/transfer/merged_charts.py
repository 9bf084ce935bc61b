"""Charts joined to larger ones that still lie flat: where a surface bends sharply, xatlas leaves hundreds of crumbs.

What is joined is laid out anew: as conformal as possible (least squares), then as rigid as possible (Liu et al. 2008).
"""

from __future__ import annotations

from collections.abc import Iterator
from heapq import heapify, heappop, heappush

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import face_parts, same_rows, triangle_areas, unit
from meshmatch.transfer.texels import faces_on

# All of these were set by hand; areas are shares of the whole.
_CRUMB = 0.002  # charts that are smaller join their neighbours all at once, for together they fill holes
_SMALL = 0.01  # charts that are smaller join a neighbour one by one, the smallest first
_NEIGHBOURS = 2  # that are tried for each
_EFFORT = 20  # times all triangles are laid out, at most
_OVERHEAD = 300  # triangles that an attempt costs beside its own
_STRETCH = 1.35  # mean stretch or shrinking of a chart, at most
_HOPELESS = 4.0  # the same of the conformal layout
_ROUNDS = 5
_COTANGENTS = 0.02, 20.0  # of thin triangles
_GRID = 512  # texels across a chart on which it must not cover itself


def merged_charts(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], uv: Float[Floats, "N 2"], corners: Int[Ints, "F 3"]
) -> tuple[Float[Floats, "M 2"], Int[Ints, "F 3"]]:
    """Fewer charts of the same triangles.

    Parameters
    ----------
    verts, faces
        The surface.
    uv, corners
        Its charts, in the unit of the positions: they are what hangs together.

    Returns
    -------
    uv, corners
        The same where nothing could be joined.
    """
    charts = _Charts(verts, faces, face_parts(corners, len(uv)))
    charts.join_crumbs()
    charts.join_small()
    places, found, count = [uv], corners.copy(), len(uv)
    aside = uv.max(axis=0)  # charts lie apart
    for chart, (own, own_corners) in charts.laid.items():
        found[charts.members[chart]] = count + own_corners
        places.append(own - own.min(axis=0) + aside)
        aside = places[-1].max(axis=0)
        count += len(own)
    used, numbers = np.unique(found, return_inverse=True)
    return np.concatenate(places)[used], numbers.reshape(-1, 3)


class _Charts:
    """Which faces are in which chart, how long their common borders are, and the layout of those that were joined."""

    def __init__(self, verts: Floats, faces: Ints, chart_of: Ints) -> None:
        self.verts, self.faces = verts, faces
        areas = triangle_areas(verts, faces)
        areas /= max(float(areas.sum()), 1e-300)
        order = np.argsort(chart_of, kind="stable")
        ends = np.cumsum(np.bincount(chart_of))[:-1]
        self.members = dict(enumerate(np.split(order, ends)))
        self.area = dict(enumerate(np.bincount(chart_of, areas).tolist()))
        self.laid: dict[int, tuple[Floats, Ints]] = {}
        self.effort = _EFFORT * len(faces)
        self.borders: dict[int, dict[int, float]] = {chart: {} for chart in self.members}
        one, two, length = _across(verts, faces)
        for a, b, far in zip(chart_of[one].tolist(), chart_of[two].tolist(), length.tolist(), strict=True):
            if a != b:
                self.borders[a][b] = self.borders[b][a] = self.borders[a].get(b, 0.0) + far

    def neighbours(self, chart: int) -> list[int]:
        """Those that it borders on, the longest border first."""
        return sorted(self.borders[chart], key=lambda other: (-self.borders[chart][other], other))

    def join_crumbs(self) -> None:
        """Join crumbs to the neighbours of their longest borders; where all of one do not lie flat together, by halves."""
        crumbs = [chart for chart, area in self.area.items() if area < _CRUMB and self.borders[chart]]
        pairs = np.array([(chart, self.neighbours(chart)[0]) for chart in crumbs], np.int64).reshape(-1, 2)
        size = len(self.members)
        graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
        groups: dict[int, list[int]] = {}
        for chart, group in enumerate(connected_components(graph, directed=False)[1].tolist()):
            groups.setdefault(group, []).append(chart)
        for members in groups.values():
            first, *others = sorted(members, key=lambda chart: -self.area[chart])
            self._join(first, others)

    def _join(self, into: int, others: list[int]) -> None:
        if not others or self.effort <= 0 or self._try(into, others) or len(others) == 1:
            return
        self._join(into, others[: len(others) // 2])
        self._join(into, others[len(others) // 2 :])

    def join_small(self) -> None:
        """Join small charts one by one, as long as the effort lasts."""
        waiting = [(area, chart) for chart, area in self.area.items() if area < _SMALL]
        heapify(waiting)
        failed: dict[int, float] = {}  # the area that each had
        while waiting and self.effort > 0:
            area, chart = heappop(waiting)
            if self.area.get(chart) != area or failed.get(chart) == area:
                continue  # it has grown, or is part of another
            into = next((each for each in self.neighbours(chart)[:_NEIGHBOURS] if self._try(each, [chart])), None)
            if into is None:
                failed[chart] = area
                continue
            for other in (into, *self.borders[into]):  # may fit now
                failed.pop(other, None)
                if self.area[other] < _SMALL:
                    heappush(waiting, (self.area[other], other))

    def _try(self, into: int, others: list[int]) -> bool:
        if not any(chart in self.borders[into] for chart in others):
            return False
        members = np.concatenate([self.members[chart] for chart in (into, *others)])
        self.effort -= len(members) + _OVERHEAD
        laid = laid_flat(self.verts, self.faces[members])
        if laid is None:
            return False
        self.members[into], self.laid[into] = members, laid
        for chart in others:
            del self.members[chart]
            self.laid.pop(chart, None)
            self.area[into] += self.area.pop(chart)
            for other, far in self.borders.pop(chart).items():
                del self.borders[other][chart]
                if other != into:
                    far += self.borders[into].get(other, 0.0)
                    self.borders[into][other] = self.borders[other][into] = far
        return True


def laid_flat(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> tuple[Floats, Ints] | None:
    """Places in the plane for the corners of some faces, (M, 2) and (F, 3), where these hang together and lie flat without
    turning, covering or stretching themselves much; None elsewhere.
    """
    corners = _welded(faces)
    count = int(corners.max()) + 1
    if face_parts(corners, count).max() > 0:
        return None
    points = np.empty((count, 3))
    points[corners.ravel()] = verts[faces.ravel()]
    flat = _apart(points[corners])
    areas = 0.5 * flat[:, 1, 0] * flat[:, 2, 1]
    if not (areas > 1e-14 * areas.sum()).all():
        return None
    try:
        uv = _as_conformal(points, corners, flat, areas)
        if _stretch(uv[corners], flat, areas) > _HOPELESS:
            return None
        for step in _as_rigid(uv, corners, flat):
            uv = step
    except RuntimeError:  # nothing holds some corners
        return None
    if not np.isfinite(uv).all() or _stretch(uv[corners], flat, areas) > _STRETCH:
        return None
    low, high = uv.min(axis=0), uv.max(axis=0)
    small = 0.01 + 0.98 * (uv - low) / (high - low).max()
    return None if faces_on(small[corners] * _GRID, _GRID)[1] else (uv, corners)


def _across(verts: Floats, faces: Ints) -> tuple[Ints, Ints, Floats]:
    """The two faces at each edge that has two, and its length."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    one, two = _twins(edges)
    return one // 3, two // 3, np.linalg.norm(verts[edges[one, 0]] - verts[edges[one, 1]], axis=1)


def _twins(edges: Int[Ints, "N 2"]) -> tuple[Ints, Ints]:
    """Rows that are the same edge, where there are two of it."""
    number = same_rows(edges)
    order = np.argsort(number, kind="stable")
    number, count = number[order], np.bincount(number)
    first = np.flatnonzero((number[1:] == number[:-1]) & (count[number[1:]] == 2))
    return order[first], order[first + 1]


def _welded(faces: Int[Ints, "F 3"]) -> Int[Ints, "F 3"]:
    """Corners numbered anew: one number for those that faces with a common edge share."""
    F = len(faces)
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    one, two = _twins(np.sort(edges, axis=1))
    begin, end = (np.arange(3 * F), (np.arange(3 * F).reshape(F, 3)[:, [1, 2, 0]]).ravel())
    alike = edges[one, 0] == edges[two, 0]
    rows = np.concatenate([begin[one], end[one]])
    columns = np.concatenate([np.where(alike, begin[two], end[two]), np.where(alike, end[two], begin[two])])
    graph = coo_array((np.ones(len(rows), np.int8), (rows, columns)), shape=(3 * F, 3 * F))
    return np.asarray(connected_components(graph, directed=False)[1].reshape(F, 3), np.int64)


def _apart(corners: Float[Floats, "F 3 3"]) -> Float[Floats, "F 3 2"]:
    """Each triangle in a plane of its own: the first corner at 0, the second on the x axis."""
    along, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    flat = np.zeros((len(corners), 3, 2))
    flat[:, 1, 0] = np.linalg.norm(along, axis=1)
    flat[:, 2, 0] = np.einsum("fi,fi->f", other, unit(along))
    flat[:, 2, 1] = np.linalg.norm(other - flat[:, 2, :1] * unit(along), axis=1)
    return flat


def _as_conformal(points: Floats, corners: Ints, flat: Floats, areas: Floats) -> Float[Floats, "M 2"]:
    """Least squares conformal maps (Lévy et al. 2002), two far points held."""
    z = flat[..., 0] + 1j * flat[..., 1]
    weights = (z[:, [2, 0, 1]] - z[:, [1, 2, 0]]) / np.sqrt(2 * areas)[:, None]
    F, M = len(corners), len(points)
    rows = np.repeat(np.arange(F), 3)
    matrix = coo_array((weights.ravel(), (rows, corners.ravel())), shape=(F, M)).tocsc()
    normal = (matrix.conj().T @ matrix).tocsc()
    one = int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())
    other = int(((points - points[one]) ** 2).sum(axis=1).argmax())
    free = np.setdiff1d(np.arange(M), [one, other])
    found = np.zeros(M, complex)
    found[other] = np.linalg.norm(points[one] - points[other])
    if len(free):
        right = -(normal[:, [other]].toarray()[:, 0] * found[other])[free]
        found[free] = splu(normal[free][:, free].tocsc()).solve(right)
    uv = np.stack([found.real, found.imag], axis=1)
    size = np.abs(np.linalg.det(uv[corners[:, 1:]] - uv[corners[:, :1]])).sum() / 2
    return np.asarray(uv * np.sqrt(areas.sum() / max(size, 1e-300)))


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
    solver = splu(coo_array((values, (rows, columns)), shape=(M, M)).tocsc()[1:][:, 1:].tocsc())
    for _ in range(_ROUNDS):
        now = uv[corners[:, [2, 0, 1]]] - uv[corners[:, [1, 2, 0]]]
        products = np.einsum("fk,fki,fkj->fij", weights, now, edges)
        angle = np.arctan2(products[:, 1, 0] - products[:, 0, 1], products[:, 0, 0] + products[:, 1, 1])
        turn = np.exp(1j * angle)[:, None] * (edges[..., 0] + 1j * edges[..., 1]) * weights
        pull = [
            np.bincount(end, part, M) - np.bincount(begin, part, M) for part in (turn.real.ravel(), turn.imag.ravel())
        ]
        uv = np.zeros((M, 2))
        uv[1:] = solver.solve(np.stack(pull, axis=1)[1:])
        yield uv


def _stretch(laid: Float[Floats, "F 3 2"], flat: Float[Floats, "F 3 2"], areas: Float[Floats, " F"]) -> float:
    """Mean over the area of stretch or shrinking, whichever is more; infinite if one is turned over."""
    one, two = laid[:, 1] - laid[:, 0], laid[:, 2] - laid[:, 0]
    across = one / flat[:, 1, :1]  # images of the axes
    up = (two - across * flat[:, 2, :1]) / flat[:, 2, 1:]
    turned = across[:, 0] * up[:, 1] - across[:, 1] * up[:, 0]
    if not (turned > 0).all():
        return np.inf
    squares = (across**2 + up**2).sum(axis=1)
    most = (np.sqrt(squares + 2 * turned) + np.sqrt(np.maximum(squares - 2 * turned, 0))) / 2
    return float(np.maximum(most, most / turned) @ areas / areas.sum())
