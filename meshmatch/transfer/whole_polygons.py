"""A polygon alone: its triangles laid out beside each other, whatever they do."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints


def unfolded_polygon(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> tuple[Float[Floats, "M 2"], Int[Ints, "F 3"]]:
    """Places of the corners of a few triangles, each laid out beside what it shares most corners with; and their numbers."""
    places: list[Floats] = []
    out = np.empty((len(faces), 3), np.int64)
    at: dict[int, int] = {}
    corners = faces.tolist()
    around: dict[int, list[int]] = {}  # the faces at each corner
    for face, own in enumerate(corners):
        for vertex in own:
            around.setdefault(vertex, []).append(face)
    shared, waiting = [0] * len(corners), [(0, face) for face in range(len(corners))]
    while waiting:  # the first of those that hang together best with what is laid
        less, face = heappop(waiting)
        if less != -shared[face]:  # it waits elsewhere, or is laid
            continue
        own, shared[face] = corners[face], -1
        for k in [k for k in range(3) if own[k] not in at]:
            a, b = (own[(k + step) % 3] for step in (1, 2))
            known = [at[vertex] for vertex in (a, b) if vertex in at]
            if len(known) == 2:
                place = _unfolded(verts[[a, b, own[k]]], places[known[0]], places[known[1]])
            elif known:
                other = a if a in at else b
                place = places[known[0]] + [float(np.linalg.norm(verts[own[k]] - verts[other])), 0.0]
            else:
                place = np.array([max((float(each[0]) for each in places), default=0.0), 0.0])
            for other in around[own[k]] if own[k] not in at else ():
                if shared[other] >= 0:
                    shared[other] += 1
                    heappush(waiting, (-shared[other], other))
            at[own[k]] = len(places)
            places.append(np.asarray(place))
        out[face] = [at[vertex] for vertex in own]
    return np.array(places), out


def _unfolded(corners: Floats, a: Floats, b: Floats) -> Floats:
    """Where the third corner of a triangle lies in the plane, to the left of the way from the first to the second."""
    along, aside = corners[1] - corners[0], corners[2] - corners[0]
    length = max(float(along @ along), 1e-30)
    share = float(aside @ along) / length
    height = float(np.linalg.norm(aside - share * along)) / np.sqrt(length)
    way = b - a
    return np.asarray(a + share * way + height * np.array([-way[1], way[0]]))
