"""Merging of charts along a part of their common border, as the sides of an unfolded box are joined at hinges: a closed
piece, which cannot be flattened whole, becomes one chart instead of two. Both charts keep their form; only the corners along
the hinge move.

Where many charts remain, pairs that both bend are flattened again together, cut along all of their border but the hinge.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import component_minima, triangle_areas
from meshmatch.progress import Progress
from meshmatch.transfer.flat_layout import Layout, flatten_faces, opposite_edges
from meshmatch.transfer.pack_charts import Chart, hull_area

Complexes: TypeAlias = NDArray[np.complex128]

# All of these were set by hand; areas are shares of the whole surface.
_MIN_CHARTS = 40  # charts below which merging stops
_MAX_SMALLER_AREA = 0.02  # largest area of the smaller chart of a pair
_MAX_EDGE_MISMATCH = 0.1  # as a fraction of the edge's length, between an edge of the hinge and its counterpart
# Smallest share of its convex hull that a merged chart fills: in all, and of what the two charts fill of theirs.
_MIN_FILL, _MIN_FILL_KEPT = 0.72, 0.95
_ANY_FORM_AREA = 0.004  # area of both together below which any form is accepted
_MAX_HINGES = 4  # hinges that are tried for a pair of charts
_MIN_CHARTS_REFLATTEN = 60  # charts below which none are flattened again
_REFLATTEN_FILL, _REFLATTEN_FILL_KEPT, _REFLATTEN_ANY_FORM = 0.7, 0.9, 0.02  # the same limits for these
_MAX_CHAINS, _CHAIN_PARTS = 3, (1.0, 0.6, 0.35)  # chains of shared edges that are tried, and parts of each
# Triangles of a pair: above the first number only whole chains are tried, above the second none.
_MAX_FACES_PARTS, _MAX_FACES = 2_500, 8_000


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges that two charts share: their end corners in each chart, in the order of the first."""

    one: Int[Ints, "N 2"]
    two: Int[Ints, "N 2"]

    def chains(self) -> list[_Edges]:
        """Maximal runs of edges that are consecutive in both charts."""
        begins = {int(begin): k for k, begin in enumerate(self.one[:, 0])}
        ends = {int(end) for end in self.one[:, 1]}
        starts = [k for k in range(len(self.one)) if int(self.one[k, 0]) not in ends] + list(range(len(self.one)))
        done = np.zeros(len(self.one), bool)
        found = []
        for k in starts:
            chain = []
            while not done[k]:
                done[k] = True
                chain.append(k)
                k = begins.get(int(self.one[k, 1]), k)
                if self.two[chain[-1], 1] != self.two[k, 0]:
                    break
            if chain:
                found.append(_Edges(self.one[chain], self.two[chain]))
        return found


class HingeMerger:
    """Greedy merging of small charts with neighbours along hinges, the pairs first that fill their common hull best."""

    def __init__(
        self, verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], charts: list[Chart], max_stretch: float, texels: int
    ) -> None:
        areas = triangle_areas(verts, faces)
        self.verts, self.faces, self.max_stretch, self.texels, self.total = (
            verts,
            faces,
            max_stretch,
            texels,
            float(areas.sum()),
        )
        self.reflatten = False  # whether pairs are flattened again
        self.by_id: dict[int, Chart] = dict(enumerate(charts))
        self.area = [float(areas[chart.members].sum()) / self.total for chart in charts]
        region, corner = np.empty(len(faces), np.int64), np.empty((len(faces), 3), np.int64)
        for number, chart in self.by_id.items():
            region[chart.members], corner[chart.members] = number, chart.corners
        edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        local = corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        one, two = opposite_edges(edges)
        on_border = region[one // 3] != region[two // 3]
        one, two = one[on_border], two[on_border]
        first, second = region[one // 3], region[two // 3]
        swap = first > second
        one, two = np.where(swap, two, one), np.where(swap, one, two)
        key = np.minimum(first, second) * len(charts) + np.maximum(first, second)
        self.shared: dict[int, dict[int, _Edges]] = {k: {} for k in self.by_id}
        order = np.argsort(key, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            if len(rows):
                a, b = divmod(int(key[rows[0]]), len(charts))
                self._set_shared(a, b, _Edges(local[one[rows]], local[two[rows]][:, ::-1]))
        self.queue: list[tuple[float, int, int, Chart | None]] = []

    def _set_shared(self, a: int, b: int, edges: _Edges) -> None:
        self.shared[a][b], self.shared[b][a] = edges, _Edges(edges.two[::-1, ::-1], edges.one[::-1, ::-1])

    def charts(self, progress: Progress = Progress()) -> list[Chart]:
        """Merge along hinges, then by flattening again, while there are more charts than wanted; return the charts."""
        for self.reflatten, min_charts in ((False, _MIN_CHARTS), (True, _MIN_CHARTS_REFLATTEN)):
            if len(self.by_id) > min_charts:
                for done, (one, others) in enumerate(self.shared.items()):
                    for two in others:
                        if one < two:
                            self._enqueue(one, two)
                    if not self.reflatten:  # most of the work
                        progress((done + 1) / len(self.shared))
            while self.queue and len(self.by_id) > min_charts:
                _, one, two, chart = heappop(self.queue)
                if one in self.by_id and two in self.by_id and (merged := chart or self._flatten_pair(one, two)):
                    self._replace(one, two, merged)
            self.queue = []
        return list(self.by_id.values())

    def _enqueue(self, one: int, two: int) -> None:
        smaller = min(self.area[one], self.area[two])
        if self.reflatten:
            heappush(self.queue, (smaller, one, two, None))
        elif smaller < _MAX_SMALLER_AREA and (best := self._best_hinge(one, two)):
            heappush(self.queue, (-best[0], one, two, best[1]))

    def _best_hinge(self, one: int, two: int) -> tuple[float, Chart] | None:
        """The share of its hull that the merged chart fills, and the chart; None if all overlap or are badly formed."""
        a, b = self.by_id[one], self.by_id[two]
        area, best = (self.area[one] + self.area[two]) * self.total, None
        least = (
            max(_MIN_FILL, _MIN_FILL_KEPT * area / max(hull_area(a.uv) + hull_area(b.uv), 1e-300))
            if area > _ANY_FORM_AREA * self.total
            else 0.0
        )
        for hinge in _find_hinges(a.uv, b.uv, self.shared[one][two]):
            chart = _merge(a, b, hinge)
            filled = area / max(hull_area(chart.uv), 1e-300)
            if filled >= least and (best is None or filled > best[0]):
                layout = Layout.of(chart.uv, chart.corners, np.ones(len(chart.members), bool), self.texels)
                best = best if len(layout.bad) else (filled, chart)
        return best

    def _flatten_pair(self, one: int, two: int) -> Chart | None:
        """Flatten both as one chart, joined at the hinge that gives the largest share of the hull; None if none is good."""
        a, b = self.by_id[one], self.by_id[two]
        if len(a.members) + len(b.members) > _MAX_FACES:
            return None
        area, best = (self.area[one] + self.area[two]) * self.total, None
        least = max(_REFLATTEN_FILL, _REFLATTEN_FILL_KEPT * area / max(hull_area(a.uv) + hull_area(b.uv), 1e-300))
        try_parts = len(a.members) + len(b.members) <= _MAX_FACES_PARTS
        for hinge in _chain_parts(a.uv, self.shared[one][two], _CHAIN_PARTS if try_parts else _CHAIN_PARTS[:1]):
            chart = _merge(a, b, hinge)
            points = np.empty((len(chart.uv), 3))
            points[chart.corners.ravel()] = self.verts[self.faces[chart.members].ravel()]
            layout = flatten_faces(points, chart.corners, self.max_stretch, self.texels)
            if layout is None or len(layout.bad):
                continue
            filled = area / max(hull_area(layout.uv), 1e-300)
            if (filled >= least or area <= _REFLATTEN_ANY_FORM * self.total) and (best is None or filled > best[0]):
                best = filled, Chart(chart.members, layout.uv, layout.corners)
        return best and best[1]

    def _replace(self, one: int, two: int, merged: Chart) -> None:
        a, b = self.by_id[one], self.by_id[two]
        new = len(self.area)
        self.by_id[new] = merged
        self.area.append(self.area[one] + self.area[two])
        number = {one: np.zeros(len(a.uv), np.int64), two: np.zeros(len(b.uv), np.int64)}  # of corners in the new chart
        number[one][a.corners.ravel()] = merged.corners[: len(a.members)].ravel()
        number[two][b.corners.ravel()] = merged.corners[len(a.members) :].ravel()
        del self.by_id[one], self.by_id[two]
        self.shared[new] = {}
        parts: dict[int, list[_Edges]] = {}
        for old in (one, two):
            for other, edges in self.shared.pop(old).items():
                if other in (one, two):
                    continue
                del self.shared[other][old]
                parts.setdefault(other, []).append(_Edges(number[old][edges.one], edges.two))
        for other, some in parts.items():
            self._set_shared(
                new, other, _Edges(np.concatenate([e.one for e in some]), np.concatenate([e.two for e in some]))
            )
        for other in parts:
            self._enqueue(*sorted((new, other)))


def _find_hinges(a: Floats, b: Floats, edges: _Edges) -> list[_Edges]:
    """The longest parts of a common border along which the second chart fits the first after a rigid motion."""
    found: list[tuple[float, _Edges]] = []
    for chain in edges.chains():
        p = a[np.append(chain.one[:, 0], chain.one[-1, 1])] @ [1, 1j]
        q = b[np.append(chain.two[:, 0], chain.two[-1, 1])] @ [1, 1j]
        length = np.minimum(np.abs(np.diff(p)), np.abs(np.diff(q)))
        end = last = 0
        for begin in range(len(length)):
            end = max(end, begin)
            while end < len(length) and _fits(p[begin : end + 2], q[begin : end + 2], length[begin : end + 1]):
                end += 1
            if end > max(begin, last):
                found.append((float(length[begin:end].sum()), _Edges(chain.one[begin:end], chain.two[begin:end])))
                last = end
    return [hinge for _, hinge in sorted(found, key=lambda each: -each[0])[:_MAX_HINGES]]


def _chain_parts(a: Floats, edges: _Edges, parts: tuple[float, ...]) -> list[_Edges]:
    """The longest chains of shared edges: each whole, and its beginning, middle and end."""
    chains = edges.chains()
    lengths = np.array([np.linalg.norm(a[chain.one[:, 0]] - a[chain.one[:, 1]], axis=1).sum() for chain in chains])
    found = []
    for k in np.argsort(-lengths, kind="stable")[:_MAX_CHAINS].tolist():
        count, ends = len(chains[k].one), set()
        for part in parts:
            n_edges = int(np.ceil(part * count))
            ends |= {(begin, begin + n_edges) for begin in (0, (count - n_edges) // 2, count - n_edges)}
        found += [_Edges(chains[k].one[begin:end], chains[k].two[begin:end]) for begin, end in sorted(ends)]
    return found


def _rigid_motion(p: Complexes, q: Complexes) -> tuple[complex, complex]:
    """Rotation (a unit complex number) and translation that bring q closest to p."""
    rotation = complex((np.conj(q - q.mean()) * (p - p.mean())).sum())
    rotation = rotation / abs(rotation) if abs(rotation) > 0 else 1.0 + 0j
    return rotation, complex(p.mean() - rotation * q.mean())


def _fits(p: Complexes, q: Complexes, length: Floats) -> bool:
    """Whether q fits p after the best rigid motion, up to a small fraction of each edge's length."""
    rotation, shift = _rigid_motion(p, q)
    error = np.abs(rotation * q + shift - p)
    return bool((np.maximum(error[1:], error[:-1]) <= _MAX_EDGE_MISMATCH * length).all())


def _merge(a: Chart, b: Chart, hinge: _Edges) -> Chart:
    """Merge two charts: the second is moved to the first, and corners along the hinge become one."""
    p, q = a.uv @ [1, 1j], b.uv @ [1, 1j]
    one, two = np.append(hinge.one[:, 0], hinge.one[-1, 1]), np.append(hinge.two[:, 0], hinge.two[-1, 1])
    rotation, shift = _rigid_motion(p[one], q[two])
    N, both = len(p), np.concatenate([p, rotation * q + shift])
    both[one] = 0.5 * (both[one] + both[N + two])
    number = component_minima(len(both), one, N + two)
    kept_corners, place = np.unique(number, return_inverse=True)
    uv = np.stack([both[kept_corners].real, both[kept_corners].imag], axis=1)
    corners = place[np.concatenate([a.corners, b.corners + N])]
    return Chart(np.concatenate([a.members, b.members]), uv, corners)
