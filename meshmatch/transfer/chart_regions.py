"""Segmentation of a surface into charts: compact regions that can be flattened with little stretch.

Regions are found on a decimated copy. Cells grow there from farthest-point seeds, and neighbouring cells are merged as long
as they flatten together and fill their convex hull. Each triangle of the surface then takes the region of the nearest coarse
triangle, and regions that stretch too much are bisected. Small charts are finally merged along hinges. All attempts share a
work budget; once it is spent, what is left becomes charts of single polygons.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import heappop, heappush

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components, dijkstra

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import normalized, triangle_areas, triangle_vectors
from meshmatch.progress import Progress
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.flat_layout import Layout, adjacent_faces, flatten_faces
from meshmatch.transfer.hinged_charts import HingeMerger
from meshmatch.transfer.pack_charts import Chart, hull_area
from meshmatch.transfer.whole_polygons import unfold_polygon

# All of these were set by hand; areas are shares of the whole surface.
_COARSE_FACES = 2_000  # triangles of the decimated copy
_MAX_SMOOTHING = 100  # steps on the surface; where more are needed, borders are first smoothed on a finer copy
_N_CELLS = 80
_BEND_COST = 4.0  # how much longer a path becomes where neighbouring triangles face different ways
_CENTERING_ROUNDS = 4  # rounds in which cells grow again from their centers
_NOTCH_SHARE, _NOTCH_ROUNDS = 0.7, 3  # share of the angle around a vertex above which a region takes the rest
_COPY_SMOOTHING = 3  # steps that smooth borders on the copy
_COPY_STRETCH, _MAX_STRETCH = 1.5, 1.6  # largest mean stretch or shrinking of a region: on the copy, on the surface
_MIN_FILL = 0.78  # smallest share of its convex hull that a region fills
_ANY_FORM_AREA = 0.004  # smaller regions may have any form
_MAX_CRUMB_FACES = 2_500  # triangles of two charts of the surface together, up to which crumbs are merged at the end
_CRUMB_AREA = 0.004  # smaller regions (crumbs) join whatever they can
_MAX_CHART_AREA = 0.2
_MAX_BAD_AREA = 0.01  # share of a region's area that may be given to its neighbours
_CONNECT_ROUNDS = 10  # rounds that reassign disconnected parts of regions
_MAX_RINGS = 4  # rings of triangles around bad ones that are given away with them
_REASSIGN_ROUNDS = 6  # rounds in which bad triangles are given to neighbours
_MIN_SHARED = 0.25  # smallest share of the shorter border of two regions that merging them removes
_TEXELS = 96, 256  # resolution of the test for self-overlap: on the copy, on the surface
_NORMAL_WEIGHT = 0.02  # length (sqrt(area)) that a unit normal counts for in the search for the nearest triangle
# Work budget, counted in flattened triangles: per triangle of the surface, in addition, and the cost of an attempt.
_EFFORT, _MIN_EFFORT, _ATTEMPT_COST = 8, 200_000, 300


@dataclass
class _Surface:
    """Triangles, their adjacent pairs, and the work budget that is left for flattening them."""

    verts: Floats
    faces: Ints
    texels: int  # resolution across a region of the test for self-overlap
    face_a: Ints = field(init=False)
    face_b: Ints = field(init=False)
    length: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.face_a, self.face_b, self.length = adjacent_faces(self.verts, self.faces)
        vectors = triangle_vectors(self.verts, self.faces)
        self.areas, self.normals = triangle_areas(self.verts, self.faces), normalized(vectors)
        self.centers = self.verts[self.faces].mean(axis=1)
        self.total = float(self.areas.sum())
        self.budget = _EFFORT * len(self.faces) + _MIN_EFFORT

    def graph(self, weights: Floats) -> csr_array:
        """(F, F) sparse: adjacent faces, with the weight (E,) of their common edge."""
        F = len(self.faces)
        ends = np.concatenate([self.face_a, self.face_b]), np.concatenate([self.face_b, self.face_a])
        return coo_array((np.concatenate([weights, weights]), ends), shape=(F, F)).tocsr()

    def flatten(self, members: Ints, max_stretch: float) -> Layout | None:
        """Flatten some triangles; None if that fails, or the work budget is spent."""
        self.budget -= len(members) + _ATTEMPT_COST
        return flatten_faces(self.verts, self.faces[members], max_stretch, self.texels) if self.budget > 0 else None

    def bad_area(self, members: Ints, layout: Layout | None) -> float:
        """Area of the triangles that are flipped or overlap others; infinite without a layout."""
        return np.inf if layout is None else float(self.areas[members[layout.bad]].sum())


def chart_regions(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], polygons: Int[Ints, " F"], progress: Progress = Progress()
) -> list[Chart]:
    """Charts that cover every triangle once: compact, with little stretch, free of overlaps.

    Parameters
    ----------
    verts, faces
        The surface, in units of sqrt(area).
    polygons
        (F,) the polygon that each triangle belongs to; polygons are not cut where charts meet.
    progress
        Called with the share (0..1) that is done, approximately.
    """
    surface = _Surface(verts, faces, _TEXELS[1])
    copy = _Surface(*_decimated(verts, faces, _COARSE_FACES), _TEXELS[0])
    own_polygon = np.arange(len(copy.faces))
    progress(0.05)
    cells = _split_until_flat(
        copy, _smooth_regions(copy, _grow_cells(copy), _COPY_SMOOTHING), _COPY_STRETCH, own_polygon
    )
    progress(0.1)
    regions = np.empty(len(copy.faces), np.int64)
    for label, chart in enumerate(_ChartMerger(copy, cells, _COPY_STRETCH).charts()):
        regions[chart.members] = label
    progress(0.2)
    if len(faces) // len(copy.faces) > _MAX_SMOOTHING:
        between = _Surface(*_decimated(verts, faces, int(np.sqrt(len(faces) * len(copy.faces)))), _TEXELS[1])
        copy, regions = between, _transfer_regions(copy, regions, between)
    region = _transfer_regions(copy, regions, surface)
    progress(0.4)
    first, number = np.unique(polygons, return_index=True, return_inverse=True)[1:]
    region = _connect_regions(surface, region[first][number])
    charts = _split_until_flat(surface, region, _MAX_STRETCH, number, progress.between(0.4, 0.65))
    charts = _ChartMerger(surface, charts, _MAX_STRETCH, crumbs_only=True).charts()
    merger = HingeMerger(surface.verts, surface.faces, charts, _MAX_STRETCH, surface.texels)
    return merger.charts(progress.between(0.7, 1.0))


def _transfer_regions(copy: _Surface, regions: Ints, surface: _Surface) -> Int[Ints, " F"]:
    """Give each triangle the region of the nearest triangle of the copy; smooth away the coarse triangles' outlines."""
    features = [np.concatenate([each.centers, _NORMAL_WEIGHT * each.normals], axis=1) for each in (copy, surface)]
    region = regions[cKDTree(features[0]).query(features[1])[1]]
    if len(copy.faces) >= len(surface.faces):
        return np.asarray(region)
    return _smooth_regions(surface, region, len(surface.faces) // len(copy.faces))


def _decimated(verts: Floats, faces: Ints, count: int) -> tuple[Floats, Ints]:
    """At most about `count` triangles of the same surface, without degenerate ones."""
    if len(faces) <= count:
        return verts, faces
    copy = decimate(Shape(verts, faces), count)
    real = copy.face_areas > 0
    return (copy.verts, copy.faces[real]) if real.any() else (verts, faces)


def _grow_cells(surface: _Surface) -> Int[Ints, " F"]:
    """Grow cells of similar width, narrower where the surface bends (geodesic Voronoi cells, recentered a few times)."""
    one, two = surface.face_a, surface.face_b
    bend = 1 - np.einsum("ni,ni->n", surface.normals[one], surface.normals[two])
    length = np.linalg.norm(surface.centers[one] - surface.centers[two], axis=1)
    graph = surface.graph(length * (1 + _BEND_COST * bend) + 1e-9)
    part = connected_components(graph, directed=False)[1]
    seeds = np.unique(part, return_index=True)[1].tolist()
    distance = dijkstra(graph, indices=seeds, min_only=True)
    while len(seeds) < _N_CELLS and distance.max() > 0:
        seeds.append(int(distance.argmax()))
        distance = np.minimum(distance, dijkstra(graph, indices=seeds[-1], limit=float(distance.max())))
    for _ in range(_CENTERING_ROUNDS):
        source = dijkstra(graph, indices=seeds, min_only=True, return_predecessors=True)[2]
        cell = np.unique(source, return_inverse=True)[1]
        weight = np.bincount(cell, surface.areas)
        middle = (
            np.stack([np.bincount(cell, surface.areas * axis) for axis in surface.centers.T], axis=1) / weight[:, None]
        )
        order = np.lexsort((((surface.centers - middle[cell]) ** 2).sum(axis=1), cell))
        seeds = order[np.searchsorted(cell[order], np.arange(len(weight)))].tolist()
    return cell


def _smooth_regions(surface: _Surface, region: Ints, steps: int) -> Int[Ints, " F"]:
    """Smooth the borders of regions: shares diffuse over edges, and each triangle takes the region with the largest."""
    F = len(region)
    graph = surface.graph(surface.length)
    perimeter = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1e-300)
    spread = coo_array((0.5 / perimeter, (np.arange(F), np.arange(F)))).tocsr() @ graph
    share = coo_array((np.ones(F), (np.arange(F), region)), shape=(F, int(region.max()) + 1)).tocsr()
    for _ in range(steps):
        share = 0.5 * share + spread @ share
    region = _heaviest_column(share.tocoo(), region)
    for _ in range(_NOTCH_ROUNDS):
        region = _fill_notches(surface, region)
    return _connect_regions(surface, region)


def _fill_notches(surface: _Surface, region: Ints) -> Int[Ints, " F"]:
    """Complete regions that have most of the angle around a vertex: flattened, they would overlap themselves there."""
    corners, F = surface.faces, len(region)
    ends = [
        normalized(surface.verts[np.roll(corners, -k, axis=1)].reshape(-1, 3) - surface.verts[corners.ravel()])
        for k in (1, 2)
    ]
    angles = np.arccos(np.clip(np.einsum("ni,ni->n", *ends), -1, 1))
    rows, owner = corners.ravel(), np.repeat(region, 3)
    V = len(surface.verts)
    sums = coo_array((angles, (rows, owner)), shape=(V, int(region.max()) + 1)).tocsr()
    sums.sum_duplicates()
    total = np.bincount(rows, angles, V)
    heaviest = _heaviest_column(sums.tocoo(), np.full(V, -1))
    best = np.maximum.reduceat(sums.data, sums.indptr[:-1][np.diff(sums.indptr) > 0]) if sums.nnz else sums.data
    share = np.zeros(V)
    share[np.diff(sums.indptr) > 0] = best
    claims = (share > _NOTCH_SHARE * total) & (share < total * (1 - 1e-9))
    corner_claims = np.where(claims[corners], heaviest[corners], -1)
    strength = np.where(claims[corners], (share / np.maximum(total, 1e-300))[corners], 0.0)
    winner = strength.argmax(axis=1)
    new = corner_claims[np.arange(F), winner]
    return np.where(new >= 0, new, region)


def _connect_regions(surface: _Surface, region: Ints, most: float = np.inf) -> Int[Ints, " F"]:
    """Make regions connected: all but the largest part of each join the neighbour across their longest border, or become
    regions themselves if their area is `most` or more.
    """
    one, two = (np.concatenate(ends) for ends in ((surface.face_a, surface.face_b), (surface.face_b, surface.face_a)))
    length = np.concatenate([surface.length, surface.length])
    part = _connected_parts(surface, region)
    for _ in range(_CONNECT_ROUNDS):
        size = np.bincount(part, surface.areas)
        owner = np.zeros(len(size), np.int64)
        owner[part] = region
        largest = np.zeros(int(region.max()) + 1)
        np.maximum.at(largest, owner, size)
        meets = part[one] != part[two]
        shape = len(size), len(largest)
        joins = _heaviest_column(coo_array((length[meets], (part[one[meets]], region[two[meets]])), shape=shape), owner)
        joins = np.where((size < largest[owner]) & (size < most), joins, owner)
        if (joins == owner).all():
            break
        region = joins[part]
        part = _connected_parts(surface, region)
    return part


def _heaviest_column(shares: coo_array, default: Ints) -> Int[Ints, " N"]:
    """The column with the largest sum in each row; `default` where a row is empty."""
    sums = shares.tocsr()
    sums.sum_duplicates()
    out, rows = default.copy(), np.repeat(np.arange(len(default)), np.diff(sums.indptr))
    order = np.lexsort((sums.data, rows))
    last = np.flatnonzero(np.append(rows[order][1:] != rows[order][:-1], True)) if len(order) else order
    out[rows[order][last]] = sums.indices[order][last]
    return out


def _connected_parts(surface: _Surface, region: Ints) -> Int[Ints, " F"]:
    """Connected components of all regions."""
    same = (region[surface.face_a] == region[surface.face_b]).astype(float)
    graph = surface.graph(same)
    graph.eliminate_zeros()
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _split_until_flat(
    surface: _Surface, region: Ints, max_stretch: float, polygons: Ints, progress: Progress = Progress()
) -> list[Chart]:
    """Split regions until each can be flattened. Small flipped or overlapping parts of a region go to its neighbours;
    regions with larger ones are bisected. Reports the share of triangles that were tried at least once.
    """
    cache, tried = _LayoutCache(surface, max_stretch, polygons), set[int]()
    iteration = 0
    while True:
        parts, bad_parts, new = _members_of_regions(region), [np.empty(0, np.int64)], region.copy()
        layouts, done = list[Layout | None](), 0
        for members in parts:
            layouts.append(cache.layout(members))
            done += len(members)
            if iteration == 0:
                progress(done / len(region))
        for members, layout in zip(parts, layouts, strict=True):
            if layout is not None and not len(layout.bad):
                continue
            home, small = int(cache.home[members[0]]), _MAX_BAD_AREA * surface.areas[members].sum()
            if layout is not None and home not in tried and surface.bad_area(members, layout) < small:
                tried.add(home)
                bad_parts.append(members[layout.bad])
            elif surface.budget > 0:
                pair = None if layout is None else layout.pair
                new[members] = new.max() + 1 + _bisect(surface, members, polygons, pair)
            else:
                new[members] = new.max() + 1 + np.unique(polygons[members], return_inverse=True)[1]
        bad = _add_rings(surface, region, np.concatenate(bad_parts), min(iteration, _MAX_RINGS))
        if len(bad):
            bad = np.flatnonzero(np.isin(polygons, polygons[bad]))
        if iteration < _REASSIGN_ROUNDS:
            new = _reassign(surface, new, bad, polygons)
        elif len(bad):
            new[bad] = new.max() + 1
        if (new == region).all() and not len(bad):
            return [Chart(members, flat.uv, flat.corners) for members, flat in zip(parts, layouts, strict=True) if flat]
        iteration, region = (
            iteration + 1,
            _connect_regions(surface, new, 0.0 if iteration >= _REASSIGN_ROUNDS else 0.5 * _CRUMB_AREA * surface.total),
        )


class _LayoutCache:
    """Layouts of regions; a subset of a region that was flattened keeps its place there."""

    def __init__(self, surface: _Surface, max_stretch: float, polygons: Ints) -> None:
        self.surface, self.max_stretch, self.polygons = surface, max_stretch, polygons
        self.layouts: list[tuple[Ints, Layout | None]] = []
        self.home = np.full(len(surface.faces), -1)

    def layout(self, members: Ints) -> Layout | None:
        """Flatten a region; None if that fails. A single polygon is unfolded triangle by triangle."""
        polygon = self.polygons[members]
        if (polygon == polygon[0]).all():
            unfolded = unfold_polygon(self.surface.verts, self.surface.faces[members])
            return Layout(*unfolded, np.ones(len(members), bool), np.empty(0, np.int64))
        home = int(self.home[members[0]])
        if home >= 0 and (self.home[members] == home).all():
            polygon, known = self.layouts[home]
            if len(polygon) == len(members):
                return known
            if known is not None:
                return self._keep(members, known.only(np.searchsorted(polygon, members), self.surface.texels))
        return self._keep(members, self.surface.flatten(members, self.max_stretch))

    def _keep(self, members: Ints, layout: Layout | None) -> Layout | None:
        self.home[members] = len(self.layouts)
        self.layouts.append((members, layout))
        return layout


def _members_of_regions(region: Ints) -> list[Ints]:
    """The members of each region."""
    return np.split(np.argsort(region, kind="stable"), np.cumsum(np.bincount(region))[:-1])


def _add_rings(surface: _Surface, region: Ints, faces: Ints, rings: int) -> Ints:
    """Add rings of adjacent faces of the same regions."""
    marked = np.zeros(len(region), bool)
    marked[faces] = True
    same = region[surface.face_a] == region[surface.face_b]
    one, two = surface.face_a[same], surface.face_b[same]
    for _ in range(rings):
        neighbours = np.zeros(len(region), bool)
        neighbours[one[marked[two]]] = neighbours[two[marked[one]]] = True
        marked |= neighbours
    return np.flatnonzero(marked)


def _reassign(surface: _Surface, region: Ints, faces: Ints, polygons: Ints) -> Int[Ints, " F"]:
    """Give faces, a polygon at a time, to the neighbouring region across their longest border, where there is one."""
    one, two = (np.concatenate(ends) for ends in ((surface.face_a, surface.face_b), (surface.face_b, surface.face_a)))
    length = np.concatenate([surface.length, surface.length])
    remaining = np.zeros(len(region), bool)
    remaining[faces] = True
    K = int(polygons.max()) + 1, int(region.max()) + 1
    for _ in range(_REASSIGN_ROUNDS):
        meets = remaining[one] & ~remaining[two] & (region[one] != region[two])
        shares = coo_array((length[meets], (polygons[one[meets]], region[two[meets]])), shape=K)
        new_region = _heaviest_column(shares, np.full(K[0], -1))[polygons]
        reassigned = remaining & (new_region >= 0)
        if not reassigned.any():
            break
        region, remaining = np.where(reassigned, new_region, region), remaining & ~reassigned
    return region


def _bisect(surface: _Surface, members: Ints, polygons: Ints, pair: tuple[int, int] | None) -> Int[Ints, " n"]:
    """Bisect a region (labels 0 and 1 of its members): by distance to the two faces of `pair`, if given; else along the
    principal axis of its normals, or of its centers; else by half of its polygons each.
    """
    first, number = np.unique(
        members if polygons is None else polygons[members], return_index=True, return_inverse=True
    )[1:]
    if len(first) == 1:  # a single polygon
        return np.arange(len(members))
    part = _Surface(surface.verts, surface.faces[members], surface.texels)
    if pair is not None:
        length = np.linalg.norm(part.centers[part.face_a] - part.centers[part.face_b], axis=1)
        source = dijkstra(part.graph(length + 1e-9), indices=pair, min_only=True, return_predecessors=True)[2]
        half = np.asarray(source == pair[0]).astype(np.int64)[first][number]
        if half.min() < half.max():
            return half
    for values, least in ((part.normals, 0.1), (part.centers, 1e-3)):
        centered = values - np.average(values, axis=0, weights=part.areas)
        projection = centered @ np.linalg.eigh((centered * part.areas[:, None]).T @ centered)[1][:, 2]
        half = _smooth_regions(part, (projection > 0).astype(np.int64), _COPY_SMOOTHING)[first][number]
        if half.min() < half.max() and np.bincount(half, part.areas).max() < (1 - least) * part.total:
            return np.asarray(half)
    return np.asarray(number > number.max() // 2).astype(np.int64)


class _ChartMerger:
    """Greedy merging of charts that flatten together, longest common border for their size first."""

    def __init__(self, surface: _Surface, charts: list[Chart], max_stretch: float, crumbs_only: bool = False) -> None:
        self.surface, self.max_stretch, self.crumbs_only, K = surface, max_stretch, crumbs_only, len(charts)
        self.by_id = dict(enumerate(charts))
        region = np.empty(len(surface.faces), np.int64)
        for number, chart in self.by_id.items():
            region[chart.members] = number
        self.area = (np.bincount(region, surface.areas) / surface.total).tolist()
        edges = surface.verts[surface.faces] - surface.verts[np.roll(surface.faces, -1, axis=1)]
        border = np.bincount(region, np.linalg.norm(edges, axis=2).sum(axis=1))
        same = region[surface.face_a] == region[surface.face_b]
        border -= 2 * np.bincount(region[surface.face_a[same]], surface.length[same], K)
        self.border = np.maximum(border, 1e-300).tolist()
        self.shared: dict[int, dict[int, float]] = {k: {} for k in self.by_id}
        for one, two, length in zip(
            region[surface.face_a].tolist(), region[surface.face_b].tolist(), surface.length.tolist(), strict=True
        ):
            if one != two:
                self.shared[one][two] = self.shared[two][one] = self.shared[one].get(two, 0.0) + length
        self.version = [0] * K
        self.queue: list[tuple[float, int, int, int, int]] = []
        for one, others in self.shared.items():
            for two in others:
                if one < two:
                    self._enqueue(one, two)

    def charts(self) -> list[Chart]:
        """Merge until the queue is empty, and return the charts."""
        while self.queue:
            _, one, two, *versions = heappop(self.queue)
            if [self.version[one], self.version[two]] == versions and (chart := self._merge_if_flat(one, two)):
                self._replace(one, two, chart)
                for neighbour in self.shared[one]:
                    self._enqueue(min(one, neighbour), max(one, neighbour))
        return list(self.by_id.values())

    def _enqueue(self, one: int, two: int) -> None:
        shared, area = self.shared[one][two], self.area[one] + self.area[two]
        removed = 2 * shared / min(self.border[one], self.border[two])
        crumb = min(self.area[one], self.area[two]) < _CRUMB_AREA
        if not crumb and (self.crumbs_only or area > _MAX_CHART_AREA or removed < _MIN_SHARED):
            return
        if self.crumbs_only and len(self.by_id[one].members) + len(self.by_id[two].members) > _MAX_CRUMB_FACES:
            return
        border = self.border[one] + self.border[two] - 2 * shared
        roundness = border / np.sqrt(area)
        small = 0.05 + np.sqrt(min(self.area[one], self.area[two]))
        heappush(
            self.queue, (-removed / (max(roundness, 1e-300) * small), one, two, self.version[one], self.version[two])
        )

    def _merge_if_flat(self, one: int, two: int) -> Chart | None:
        members, least = (
            np.concatenate([self.by_id[k].members for k in (one, two)]),
            min(self.area[one], self.area[two]),
        )
        layout = self.surface.flatten(members, self.max_stretch)
        allowed = 0.0 if self.crumbs_only else _MAX_BAD_AREA * least * self.surface.total
        if layout is None or self.surface.bad_area(members, layout) > allowed:
            return None
        area = (self.area[one] + self.area[two]) * self.surface.total
        filled = (
            area < _ANY_FORM_AREA * self.surface.total
            or least < _CRUMB_AREA
            or area >= _MIN_FILL * hull_area(layout.uv)
        )
        return Chart(members, layout.uv, layout.corners) if filled else None

    def _replace(self, one: int, two: int, chart: Chart) -> None:
        self.by_id[one] = chart
        del self.by_id[two]
        self.border[one] += self.border[two] - 2 * self.shared[one][two]
        self.area[one] += self.area[two]
        self.version[one] += 1
        self.version[two] = -1
        for neighbour, length in self.shared.pop(two).items():
            del self.shared[neighbour][two]
            if neighbour != one:
                self.shared[one][neighbour] = self.shared[neighbour][one] = (
                    self.shared[one].get(neighbour, 0.0) + length
                )
