"""Which triangles of a surface become one chart: compact regions that lie flat, found on a coarse copy.

On the copy, cells that face about one way are joined as long as they lie flat together and fill a rectangle well; each
triangle of the surface then goes with the region of the coarse triangle beside it. What lies flat there only with too much
stretch is halved. At last small charts are joined along hinges. Nothing is tried without end: what is left when the effort
is spent becomes charts of single polygons.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import heappop, heappush

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import triangle_areas, triangle_vectors, unit
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.flat_layout import Layout, across, laid_flat
from meshmatch.transfer.hinged_charts import Hinging
from meshmatch.transfer.pack_charts import Chart, hull
from meshmatch.transfer.whole_polygons import unfolded_polygon

# All of these were set by hand; areas are shares of the whole.
_COARSE = 2_000  # triangles of the copy
_MOST_STEPS = 100  # of smoothing borders of the surface; beyond, a copy between the two takes them
_CELLS = 80
_BEND = 4.0  # how much further it is to a triangle that faces another way
_CENTERED = 4  # rounds in which cells are grown from their middles
_NOTCH, _FILLED_IN = 0.7, 3  # of the angle around a vertex; rounds
_SOFT = 3  # steps of smoothing borders of the copy
_STRETCH, _MORE = 1.5, 1.6  # mean stretch or shrinking of a region at most: of the copy and of the surface
_FILLED = 0.78  # of the convex hull of a region, at least
_ROUGH = 0.004  # smaller regions may have any form
_FEW = 2_500  # triangles of the surface, in which crumbs are joined again at last
_CRUMB = 0.004  # smaller ones join whatever they can
_LARGEST = 0.2
_SPOILED = 0.01  # of the area of a region, at most, that is handed on to its neighbours
_HANGING = 10  # rounds of joining what does not hang together
_RINGS = 4  # of triangles around it
_HANDED_ON = 6  # rounds in which this is done
_SHARED = 0.25  # of the smaller border of two regions, that joining them removes at least
_TEXELS = 96, 256  # of the copy and of the surface, across a region that must not cover itself
_FACING = 0.02  # of sqrt(area), that a normal counts as when the nearest triangle is looked for
# Of triangles that are laid out: times all and so many more at most, and what an attempt costs beside its own.
_EFFORT, _ALWAYS, _OVERHEAD = 8, 200_000, 300


@dataclass
class _Surface:
    """Triangles, who lies beside whom, and what may still be tried."""

    verts: Floats
    faces: Ints
    texels: int  # across a region, on which it must not cover itself
    one: Ints = field(init=False)
    two: Ints = field(init=False)
    length: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.one, self.two, self.length = across(self.verts, self.faces)
        vectors = triangle_vectors(self.verts, self.faces)
        self.areas, self.normals = triangle_areas(self.verts, self.faces), unit(vectors)
        self.middles = self.verts[self.faces].mean(axis=1)
        self.total = float(self.areas.sum())
        self.beside = self.graph(self.length)
        self.effort = _EFFORT * len(self.faces) + _ALWAYS

    def graph(self, weights: Floats) -> csr_array:
        """Triangles joined over their common edges."""
        F = len(self.faces)
        ends = np.concatenate([self.one, self.two]), np.concatenate([self.two, self.one])
        return coo_array((np.concatenate([weights, weights]), ends), shape=(F, F)).tocsr()

    def laid(self, members: Ints, most: float) -> Layout | None:
        """How some triangles lie flat, for as long as the effort lasts."""
        self.effort -= len(members) + _OVERHEAD
        return laid_flat(self.verts, self.faces[members], most, self.texels) if self.effort > 0 else None

    def spoiled(self, members: Ints, layout: Layout | None) -> float:
        """The area of what is turned over, or lies on the rest."""
        return np.inf if layout is None else float(self.areas[members[layout.bad]].sum())


def chart_regions(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], polygons: Int[Ints, " F"]) -> list[Chart]:
    """Charts of all triangles, each once: compact, with little stretch, and none of them covers itself.

    Parameters
    ----------
    verts, faces
        The surface, in units of sqrt(area).
    polygons
        What each triangle is part of: these stay whole where charts meet.
    """
    surface = _Surface(verts, faces, _TEXELS[1])
    copy = _Surface(*_coarse(verts, faces, _COARSE), _TEXELS[0])
    alone = np.arange(len(copy.faces))
    cells = _flat_parts(copy, _smooth(copy, _cells(copy), _SOFT), _STRETCH, alone)
    regions = np.empty(len(copy.faces), np.int64)
    for joined, chart in enumerate(_Joining(copy, cells, _STRETCH).charts()):
        regions[chart.members] = joined
    if len(faces) // len(copy.faces) > _MOST_STEPS:
        between = _Surface(*_coarse(verts, faces, int(np.sqrt(len(faces) * len(copy.faces)))), _TEXELS[1])
        copy, regions = between, _carried_over(copy, regions, between)
    region = _carried_over(copy, regions, surface)
    first, number = np.unique(polygons, return_index=True, return_inverse=True)[1:]
    region = _hanging(surface, region[first][number])
    charts = _flat_parts(surface, region, _MORE, number)
    charts = _Joining(surface, charts, _MORE, crumbs=True).charts()
    return Hinging(surface.verts, surface.faces, charts, _MORE, surface.texels).charts()


def _carried_over(copy: _Surface, regions: Ints, surface: _Surface) -> Int[Ints, " F"]:
    """The regions of the triangles beside, with borders that do not follow the larger triangles of the copy."""
    places = [np.concatenate([each.middles, _FACING * each.normals], axis=1) for each in (copy, surface)]
    region = regions[cKDTree(places[0]).query(places[1])[1]]
    if len(copy.faces) >= len(surface.faces):
        return np.asarray(region)
    return _smooth(surface, region, len(surface.faces) // len(copy.faces))


def _coarse(verts: Floats, faces: Ints, count: int) -> tuple[Floats, Ints]:
    if len(faces) <= count:
        return verts, faces
    copy = decimate(Shape(verts, faces), count)
    real = copy.face_areas > 0
    return (copy.verts, copy.faces[real]) if real.any() else (verts, faces)


def _cells(surface: _Surface) -> Int[Ints, " F"]:
    """Cells of about the same width, narrower where the surface bends."""
    one, two = surface.one, surface.two
    turned = 1 - np.einsum("ni,ni->n", surface.normals[one], surface.normals[two])
    away = np.linalg.norm(surface.middles[one] - surface.middles[two], axis=1)
    graph = surface.graph(away * (1 + _BEND * turned) + 1e-9)
    part = connected_components(graph, directed=False)[1]
    seeds = np.unique(part, return_index=True)[1].tolist()
    far = dijkstra(graph, indices=seeds, min_only=True)
    while len(seeds) < _CELLS and far.max() > 0:
        seeds.append(int(far.argmax()))
        far = np.minimum(far, dijkstra(graph, indices=seeds[-1], limit=float(far.max())))
    for _ in range(_CENTERED):
        source = dijkstra(graph, indices=seeds, min_only=True, return_predecessors=True)[2]
        cell = np.unique(source, return_inverse=True)[1]
        weight = np.bincount(cell, surface.areas)
        middle = (
            np.stack([np.bincount(cell, surface.areas * axis) for axis in surface.middles.T], axis=1) / weight[:, None]
        )
        order = np.lexsort((((surface.middles - middle[cell]) ** 2).sum(axis=1), cell))
        seeds = order[np.searchsorted(cell[order], np.arange(len(weight)))].tolist()
    return cell


def _smooth(surface: _Surface, region: Ints, steps: int) -> Int[Ints, " F"]:
    """Regions with smoother borders: each spreads over its neighbours, and a triangle goes with what it has most of."""
    F = len(region)
    graph = surface.graph(surface.length)
    around = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1e-300)
    spread = coo_array((0.5 / around, (np.arange(F), np.arange(F)))).tocsr() @ graph
    share = coo_array((np.ones(F), (np.arange(F), region)), shape=(F, int(region.max()) + 1)).tocsr()
    for _ in range(steps):
        share = 0.5 * share + spread @ share
    region = _most(share.tocoo(), region)
    for _ in range(_FILLED_IN):
        region = _without_notches(surface, region)
    return _hanging(surface, region)


def _without_notches(surface: _Surface, region: Ints) -> Int[Ints, " F"]:
    """Regions that have most of the angle around a vertex get the rest: laid flat, they would cover themselves there."""
    corners, F = surface.faces, len(region)
    ends = [
        unit(surface.verts[np.roll(corners, -k, axis=1)].reshape(-1, 3) - surface.verts[corners.ravel()])
        for k in (1, 2)
    ]
    angles = np.arccos(np.clip(np.einsum("ni,ni->n", *ends), -1, 1))
    rows, owner = corners.ravel(), np.repeat(region, 3)
    V = len(surface.verts)
    held = coo_array((angles, (rows, owner)), shape=(V, int(region.max()) + 1)).tocsr()
    held.sum_duplicates()
    total = np.bincount(rows, angles, V)
    most = _most(held.tocoo(), np.full(V, -1))
    best = np.maximum.reduceat(held.data, held.indptr[:-1][np.diff(held.indptr) > 0]) if held.nnz else held.data
    share = np.zeros(V)
    share[np.diff(held.indptr) > 0] = best
    claims = (share > _NOTCH * total) & (share < total * (1 - 1e-9))
    corner_claims = np.where(claims[corners], most[corners], -1)
    strength = np.where(claims[corners], (share / np.maximum(total, 1e-300))[corners], 0.0)
    winner = strength.argmax(axis=1)
    new = corner_claims[np.arange(F), winner]
    return np.where(new >= 0, new, region)


def _hanging(surface: _Surface, region: Ints, most: float = np.inf) -> Int[Ints, " F"]:
    """Regions that hang together: parts beside the largest of one join the neighbour of their longest border, or become
    regions if they are larger than `most`.
    """
    one, two = (np.concatenate(ends) for ends in ((surface.one, surface.two), (surface.two, surface.one)))
    length = np.concatenate([surface.length, surface.length])
    part = _parts(surface, region)
    for _ in range(_HANGING):
        size = np.bincount(part, surface.areas)
        owner = np.zeros(len(size), np.int64)
        owner[part] = region
        largest = np.zeros(int(region.max()) + 1)
        np.maximum.at(largest, owner, size)
        meets = part[one] != part[two]
        shape = len(size), len(largest)
        joins = _most(coo_array((length[meets], (part[one[meets]], region[two[meets]])), shape=shape), owner)
        joins = np.where((size < largest[owner]) & (size < most), joins, owner)
        if (joins == owner).all():
            break
        region = joins[part]
        part = _parts(surface, region)
    return part


def _most(shares: coo_array, now: Ints) -> Int[Ints, " N"]:
    """The column with the largest sum of each row; `now` for a row that is empty."""
    sums = shares.tocsr()
    sums.sum_duplicates()
    out, rows = now.copy(), np.repeat(np.arange(len(now)), np.diff(sums.indptr))
    order = np.lexsort((sums.data, rows))
    last = np.flatnonzero(np.append(rows[order][1:] != rows[order][:-1], True)) if len(order) else order
    out[rows[order][last]] = sums.indices[order][last]
    return out


def _parts(surface: _Surface, region: Ints) -> Int[Ints, " F"]:
    """What hangs together of each region."""
    same = (region[surface.one] == region[surface.two]).astype(float)
    graph = surface.graph(same)
    graph.eliminate_zeros()
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _flat_parts(surface: _Surface, region: Ints, most: float, polygons: Ints) -> list[Chart]:
    """Regions that lie flat. What spoils a region goes to its neighbours; regions that do
    not lie flat even so are halved.
    """
    known, tried = _Known(surface, most, polygons), set[int]()
    turn = 0
    while True:
        parts, spoiled, after = _split(region), [np.empty(0, np.int64)], region.copy()
        layouts = [known.layout(members) for members in parts]
        for members, layout in zip(parts, layouts, strict=True):
            if layout is not None and not len(layout.bad):
                continue
            home, small = int(known.home[members[0]]), _SPOILED * surface.areas[members].sum()
            if layout is not None and home not in tried and surface.spoiled(members, layout) < small:
                tried.add(home)
                spoiled.append(members[layout.bad])
            elif surface.effort > 0:
                pair = None if layout is None else layout.pair
                after[members] = after.max() + 1 + _halved(surface, members, polygons, pair)
            else:
                after[members] = after.max() + 1 + np.unique(polygons[members], return_inverse=True)[1]
        bad = _with_rings(surface, region, np.concatenate(spoiled), min(turn, _RINGS))
        if len(bad):
            bad = np.flatnonzero(np.isin(polygons, polygons[bad]))
        if turn < _HANDED_ON:
            after = _handed_on(surface, after, bad, polygons)
        elif len(bad):
            after[bad] = after.max() + 1
        if (after == region).all() and not len(bad):
            return [Chart(members, own.uv, own.corners) for members, own in zip(parts, layouts, strict=True) if own]
        turn, region = turn + 1, _hanging(surface, after, 0.0 if turn >= _HANDED_ON else 0.5 * _CRUMB * surface.total)


class _Known:
    """How regions lie flat: part of one that did stays where it is."""

    def __init__(self, surface: _Surface, most: float, polygons: Ints) -> None:
        self.surface, self.most, self.polygons = surface, most, polygons
        self.layouts: list[tuple[Ints, Layout | None]] = []
        self.home = np.full(len(surface.faces), -1)

    def layout(self, members: Ints) -> Layout | None:
        """None where it is not known how."""
        whole = self.polygons[members]
        if (whole == whole[0]).all():
            laid = unfolded_polygon(self.surface.verts, self.surface.faces[members])
            return Layout(*laid, np.ones(len(members), bool), np.empty(0, np.int64))
        home = int(self.home[members[0]])
        if home >= 0 and (self.home[members] == home).all():
            whole, before = self.layouts[home]
            if len(whole) == len(members):
                return before
            if before is not None:
                return self._keep(members, before.only(np.searchsorted(whole, members), self.surface.texels))
        return self._keep(members, self.surface.laid(members, self.most))

    def _keep(self, members: Ints, layout: Layout | None) -> Layout | None:
        self.home[members] = len(self.layouts)
        self.layouts.append((members, layout))
        return layout


def _split(region: Ints) -> list[Ints]:
    """The members of each."""
    return np.split(np.argsort(region, kind="stable"), np.cumsum(np.bincount(region))[:-1])


def _with_rings(surface: _Surface, region: Ints, faces: Ints, rings: int) -> Ints:
    """Faces with those of their regions around them."""
    marked = np.zeros(len(region), bool)
    marked[faces] = True
    same = region[surface.one] == region[surface.two]
    one, two = surface.one[same], surface.two[same]
    for _ in range(rings):
        beside = np.zeros(len(region), bool)
        beside[one[marked[two]]] = beside[two[marked[one]]] = True
        marked |= beside
    return np.flatnonzero(marked)


def _handed_on(surface: _Surface, region: Ints, faces: Ints, polygons: Ints) -> Int[Ints, " F"]:
    """Regions in which some faces are part of a neighbour, where they have one."""
    one, two = (np.concatenate(ends) for ends in ((surface.one, surface.two), (surface.two, surface.one)))
    length = np.concatenate([surface.length, surface.length])
    left = np.zeros(len(region), bool)
    left[faces] = True
    K = int(polygons.max()) + 1, int(region.max()) + 1
    for _ in range(_HANDED_ON):
        meets = left[one] & ~left[two] & (region[one] != region[two])
        shares = coo_array((length[meets], (polygons[one[meets]], region[two[meets]])), shape=K)
        taker = _most(shares, np.full(K[0], -1))[polygons]
        taken = left & (taker >= 0)
        if not taken.any():
            break
        region, left = np.where(taken, taker, region), left & ~taken
    return region


def _halved(surface: _Surface, members: Ints, polygons: Ints, pair: tuple[int, int] | None) -> Int[Ints, " n"]:
    """Parts of a region: what is closer to one and the other of a pair; what faces one way and the other; or else what lies
    on one side and the other.
    """
    first, number = np.unique(
        members if polygons is None else polygons[members], return_index=True, return_inverse=True
    )[1:]
    if len(first) == 1:  # a polygon alone
        return np.arange(len(members))
    part = _Surface(surface.verts, surface.faces[members], surface.texels)
    if pair is not None:
        away = np.linalg.norm(part.middles[part.one] - part.middles[part.two], axis=1)
        source = dijkstra(part.graph(away + 1e-9), indices=pair, min_only=True, return_predecessors=True)[2]
        half = np.asarray(source == pair[0]).astype(np.int64)[first][number]
        if half.min() < half.max():
            return half
    for values, least in ((part.normals, 0.1), (part.middles, 1e-3)):
        about = values - np.average(values, axis=0, weights=part.areas)
        along = about @ np.linalg.eigh((about * part.areas[:, None]).T @ about)[1][:, 2]
        half = _smooth(part, (along > 0).astype(np.int64), _SOFT)[first][number]
        if half.min() < half.max() and np.bincount(half, part.areas).max() < (1 - least) * part.total:
            return np.asarray(half)
    return np.asarray(number > number.max() // 2).astype(np.int64)


class _Joining:
    """Charts joined as long as they lie flat together, those first whose common border is long for their size."""

    def __init__(self, surface: _Surface, charts: list[Chart], most: float, crumbs: bool = False) -> None:
        self.surface, self.most, self.crumbs, K = surface, most, crumbs, len(charts)
        self.own = dict(enumerate(charts))
        region = np.empty(len(surface.faces), np.int64)
        for number, chart in self.own.items():
            region[chart.members] = number
        self.area = (np.bincount(region, surface.areas) / surface.total).tolist()
        edges = surface.verts[surface.faces] - surface.verts[np.roll(surface.faces, -1, axis=1)]
        border = np.bincount(region, np.linalg.norm(edges, axis=2).sum(axis=1))
        same = region[surface.one] == region[surface.two]
        border -= 2 * np.bincount(region[surface.one[same]], surface.length[same], K)
        self.border = np.maximum(border, 1e-300).tolist()
        self.shared: dict[int, dict[int, float]] = {k: {} for k in self.own}
        for one, two, length in zip(
            region[surface.one].tolist(), region[surface.two].tolist(), surface.length.tolist(), strict=True
        ):
            if one != two:
                self.shared[one][two] = self.shared[two][one] = self.shared[one].get(two, 0.0) + length
        self.grown = [0] * K
        self.waiting: list[tuple[float, int, int, int, int]] = []
        for one, others in self.shared.items():
            for two in others:
                if one < two:
                    self._wait(one, two)

    def charts(self) -> list[Chart]:
        """What they become."""
        while self.waiting:
            _, one, two, *grown = heappop(self.waiting)
            if [self.grown[one], self.grown[two]] == grown and (chart := self._together(one, two)):
                self._join(one, two, chart)
                for other in self.shared[one]:
                    self._wait(min(one, other), max(one, other))
        return list(self.own.values())

    def _wait(self, one: int, two: int) -> None:
        shared, area = self.shared[one][two], self.area[one] + self.area[two]
        removed = 2 * shared / min(self.border[one], self.border[two])
        crumb = min(self.area[one], self.area[two]) < _CRUMB
        if not crumb and (self.crumbs or area > _LARGEST or removed < _SHARED):
            return
        if self.crumbs and len(self.own[one].members) + len(self.own[two].members) > _FEW:
            return
        around = self.border[one] + self.border[two] - 2 * shared
        round_ = around / np.sqrt(area)
        small = 0.05 + np.sqrt(min(self.area[one], self.area[two]))
        heappush(self.waiting, (-removed / (max(round_, 1e-300) * small), one, two, self.grown[one], self.grown[two]))

    def _together(self, one: int, two: int) -> Chart | None:
        members, least = np.concatenate([self.own[k].members for k in (one, two)]), min(self.area[one], self.area[two])
        layout = self.surface.laid(members, self.most)
        allowed = 0.0 if self.crumbs else _SPOILED * least * self.surface.total
        if layout is None or self.surface.spoiled(members, layout) > allowed:
            return None
        area = (self.area[one] + self.area[two]) * self.surface.total
        filled = area < _ROUGH * self.surface.total or least < _CRUMB or area >= _FILLED * hull(layout.uv)
        return Chart(members, layout.uv, layout.corners) if filled else None

    def _join(self, one: int, two: int, chart: Chart) -> None:
        self.own[one] = chart
        del self.own[two]
        self.border[one] += self.border[two] - 2 * self.shared[one][two]
        self.area[one] += self.area[two]
        self.grown[one] += 1
        self.grown[two] = -1
        for other, length in self.shared.pop(two).items():
            del self.shared[other][two]
            if other != one:
                self.shared[one][other] = self.shared[other][one] = self.shared[one].get(other, 0.0) + length
