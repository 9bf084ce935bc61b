"""Charts joined along a part of their common border alone, as the sides of an unfolded box are: a closed piece, which cannot
lie flat, becomes one chart instead of two. Both keep their form; only the corners along the hinge move.

Where there are still many charts, pairs that both bend are laid flat again, cut along all of their border but the hinge.
"""

from __future__ import annotations

from dataclasses import dataclass
from heapq import heappop, heappush
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import together, triangle_areas
from meshmatch.transfer.flat_layout import Layout, laid_flat, twins
from meshmatch.transfer.pack_charts import Chart, hull

Complexes: TypeAlias = NDArray[np.complex128]

# All of these were set by hand; areas are shares of the whole.
_ENOUGH = 40  # charts: so few are left as they are
_SMALL = 0.02  # of two charts one at least is smaller
_OFF = 0.1  # of its length, by which an edge of the hinge may miss the one that it is joined with
_FILLED, _KEPT = 0.72, 0.95  # of the convex hull of both, at least; of what each fills of its own
_ROUGH = 0.004  # both together may have any form if they are smaller
_TRIED = 4  # hinges of two charts
_MANY = 60  # charts: of more, some are laid flat again
_AGAIN_FILLED, _AGAIN_KEPT, _AGAIN_ROUGH = 0.7, 0.9, 0.02  # the same limits for these
_HINGES, _PARTS = 3, (1.0, 0.6, 0.35)  # borders of two charts that are tried, and how much of each
_FEW, _LARGE = 2_500, 8_000  # triangles: of more, only whole borders are tried; of still more, none


@dataclass(frozen=True, eq=False)
class _Edges:
    """Edges that two charts share: their ends in each, in the order of the first."""

    one: Int[Ints, "N 2"]
    two: Int[Ints, "N 2"]

    def chains(self) -> list[_Edges]:
        """Those that follow one another in both."""
        left = {int(begin): k for k, begin in enumerate(self.one[:, 0])}
        before = {int(end) for end in self.one[:, 1]}
        starts = [k for k in range(len(self.one)) if int(self.one[k, 0]) not in before] + list(range(len(self.one)))
        done = np.zeros(len(self.one), bool)
        found = []
        for k in starts:
            chain = []
            while not done[k]:
                done[k] = True
                chain.append(k)
                k = left.get(int(self.one[k, 1]), k)
                if self.two[chain[-1], 1] != self.two[k, 0]:
                    break
            if chain:
                found.append(_Edges(self.one[chain], self.two[chain]))
        return found


class Hinging:
    """Charts of a surface, the small of which are joined with others, those first that fill their common hull best."""

    def __init__(
        self, verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], charts: list[Chart], most: float, texels: int
    ) -> None:
        areas = triangle_areas(verts, faces)
        self.verts, self.faces, self.most, self.texels, self.total = verts, faces, most, texels, float(areas.sum())
        self.again = False  # whether charts are laid flat again
        self.own: dict[int, Chart] = dict(enumerate(charts))
        self.area = [float(areas[chart.members].sum()) / self.total for chart in charts]
        region, corner = np.empty(len(faces), np.int64), np.empty((len(faces), 3), np.int64)
        for number, chart in self.own.items():
            region[chart.members], corner[chart.members] = number, chart.corners
        edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        local = corner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        one, two = twins(edges)
        apart = region[one // 3] != region[two // 3]
        one, two = one[apart], two[apart]
        first, second = region[one // 3], region[two // 3]
        swap = first > second
        one, two = np.where(swap, two, one), np.where(swap, one, two)
        key = np.minimum(first, second) * len(charts) + np.maximum(first, second)
        self.shared: dict[int, dict[int, _Edges]] = {k: {} for k in self.own}
        order = np.argsort(key, kind="stable")
        for rows in np.split(order, np.flatnonzero(np.diff(key[order])) + 1):
            if len(rows):
                a, b = divmod(int(key[rows[0]]), len(charts))
                self._share(a, b, _Edges(local[one[rows]], local[two[rows]][:, ::-1]))
        self.waiting: list[tuple[float, int, int, Chart | None]] = []

    def _share(self, a: int, b: int, edges: _Edges) -> None:
        self.shared[a][b], self.shared[b][a] = edges, _Edges(edges.two[::-1, ::-1], edges.one[::-1, ::-1])

    def charts(self) -> list[Chart]:
        """What they become."""
        for self.again, enough in ((False, _ENOUGH), (True, _MANY)):
            if len(self.own) > enough:
                for one, others in self.shared.items():
                    for two in others:
                        if one < two:
                            self._wait(one, two)
            while self.waiting and len(self.own) > enough:
                _, one, two, chart = heappop(self.waiting)
                if one in self.own and two in self.own and (joined := chart or self._laid_again(one, two)):
                    self._join(one, two, joined)
            self.waiting = []
        return list(self.own.values())

    def _wait(self, one: int, two: int) -> None:
        smaller = min(self.area[one], self.area[two])
        if self.again:
            heappush(self.waiting, (smaller, one, two, None))
        elif smaller < _SMALL and (found := self._hinged(one, two)):
            heappush(self.waiting, (-found[0], one, two, found[1]))

    def _hinged(self, one: int, two: int) -> tuple[float, Chart] | None:
        """How much of its hull both fill as one chart, and that; None if they lie on each other, or have a poor form."""
        a, b = self.own[one], self.own[two]
        area, best = (self.area[one] + self.area[two]) * self.total, None
        least = max(_FILLED, _KEPT * area / max(hull(a.uv) + hull(b.uv), 1e-300)) if area > _ROUGH * self.total else 0.0
        for hinge in _hinges(a.uv, b.uv, self.shared[one][two]):
            chart = _joined(a, b, hinge)
            filled = area / max(hull(chart.uv), 1e-300)
            if filled >= least and (best is None or filled > best[0]):
                layout = Layout.of(chart.uv, chart.corners, np.ones(len(chart.members), bool), self.texels)
                best = best if len(layout.bad) else (filled, chart)
        return best

    def _laid_again(self, one: int, two: int) -> Chart | None:
        """Both laid flat as one chart, by the hinge with which that fills most of its hull."""
        a, b = self.own[one], self.own[two]
        if len(a.members) + len(b.members) > _LARGE:
            return None
        area, best = (self.area[one] + self.area[two]) * self.total, None
        least = max(_AGAIN_FILLED, _AGAIN_KEPT * area / max(hull(a.uv) + hull(b.uv), 1e-300))
        few = len(a.members) + len(b.members) <= _FEW
        for hinge in _parts_of(a.uv, self.shared[one][two], _PARTS if few else _PARTS[:1]):
            chart = _joined(a, b, hinge)
            points = np.empty((len(chart.uv), 3))
            points[chart.corners.ravel()] = self.verts[self.faces[chart.members].ravel()]
            layout = laid_flat(points, chart.corners, self.most, self.texels)
            if layout is None or len(layout.bad):
                continue
            filled = area / max(hull(layout.uv), 1e-300)
            if (filled >= least or area <= _AGAIN_ROUGH * self.total) and (best is None or filled > best[0]):
                best = filled, Chart(chart.members, layout.uv, layout.corners)
        return best and best[1]

    def _join(self, one: int, two: int, joined: Chart) -> None:
        a, b = self.own[one], self.own[two]
        new = len(self.area)
        self.own[new] = joined
        self.area.append(self.area[one] + self.area[two])
        number = {
            one: np.zeros(len(a.uv), np.int64),
            two: np.zeros(len(b.uv), np.int64),
        }  # of corners, in the new chart
        number[one][a.corners.ravel()] = joined.corners[: len(a.members)].ravel()
        number[two][b.corners.ravel()] = joined.corners[len(a.members) :].ravel()
        del self.own[one], self.own[two]
        self.shared[new] = {}
        parts: dict[int, list[_Edges]] = {}
        for old in (one, two):
            for other, edges in self.shared.pop(old).items():
                if other in (one, two):
                    continue
                del self.shared[other][old]
                parts.setdefault(other, []).append(_Edges(number[old][edges.one], edges.two))
        for other, some in parts.items():
            self._share(
                new, other, _Edges(np.concatenate([e.one for e in some]), np.concatenate([e.two for e in some]))
            )
        for other in parts:
            self._wait(*sorted((new, other)))


def _hinges(a: Floats, b: Floats, edges: _Edges) -> list[_Edges]:
    """The longest parts of a common border that fit together when one chart is moved to the other as it is."""
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
    return [hinge for _, hinge in sorted(found, key=lambda each: -each[0])[:_TRIED]]


def _parts_of(a: Floats, edges: _Edges, parts: tuple[float, ...]) -> list[_Edges]:
    """The longest parts of a common border, each as a whole and its beginning, middle and end."""
    chains = edges.chains()
    long = np.array([np.linalg.norm(a[chain.one[:, 0]] - a[chain.one[:, 1]], axis=1).sum() for chain in chains])
    found = []
    for k in np.argsort(-long, kind="stable")[:_HINGES].tolist():
        count, ends = len(chains[k].one), set()
        for part in parts:
            some = int(np.ceil(part * count))
            ends |= {(begin, begin + some) for begin in (0, (count - some) // 2, count - some)}
        found += [_Edges(chains[k].one[begin:end], chains[k].two[begin:end]) for begin, end in sorted(ends)]
    return found


def _moved(p: Complexes, q: Complexes) -> tuple[complex, complex]:
    """The turn and the way that bring q closest to p."""
    turn = complex((np.conj(q - q.mean()) * (p - p.mean())).sum())
    turn = turn / abs(turn) if abs(turn) > 0 else 1.0 + 0j
    return turn, complex(p.mean() - turn * q.mean())


def _fits(p: Complexes, q: Complexes, length: Floats) -> bool:
    """Whether the edges between points miss those between others by little, after the best turn."""
    turn, way = _moved(p, q)
    off = np.abs(turn * q + way - p)
    return bool((np.maximum(off[1:], off[:-1]) <= _OFF * length).all())


def _joined(a: Chart, b: Chart, hinge: _Edges) -> Chart:
    """Two charts, the second moved to the first, with common corners along a hinge."""
    p, q = a.uv @ [1, 1j], b.uv @ [1, 1j]
    one, two = np.append(hinge.one[:, 0], hinge.one[-1, 1]), np.append(hinge.two[:, 0], hinge.two[-1, 1])
    turn, way = _moved(p[one], q[two])
    N, both = len(p), np.concatenate([p, turn * q + way])
    both[one] = 0.5 * (both[one] + both[N + two])
    number = together(len(both), one, N + two)
    kept, place = np.unique(number, return_inverse=True)
    uv = np.stack([both[kept].real, both[kept].imag], axis=1)
    corners = place[np.concatenate([a.corners, b.corners + N])]
    return Chart(np.concatenate([a.members, b.members]), uv, corners)
