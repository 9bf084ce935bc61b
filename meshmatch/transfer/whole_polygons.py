"""Unfolding of a single polygon, triangle by triangle, whatever its shape."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints


def unfold_polygon(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> tuple[Float[Floats, "M 2"], Int[Ints, "F 3"]]:
    """Unfold a few triangles, each next to what it shares most corners with: corners (M, 2), and their numbers per face."""
    places: list[Floats] = []
    out = np.empty((len(faces), 3), np.int64)
    at: dict[int, int] = {}
    corners = faces.tolist()
    around: dict[int, list[int]] = {}  # faces at each vertex
    for face, own in enumerate(corners):
        for vertex in own:
            around.setdefault(vertex, []).append(face)
    shared, queue = [0] * len(corners), [(0, face) for face in range(len(corners))]
    while queue:  # the first of the triangles that share most corners with what is unfolded
        priority, face = heappop(queue)
        if priority != -shared[face]:  # outdated: queued again since, or unfolded already
            continue
        own, shared[face] = corners[face], -1
        for k in [k for k in range(3) if own[k] not in at]:
            a, b = (own[(k + step) % 3] for step in (1, 2))
            known = [at[vertex] for vertex in (a, b) if vertex in at]
            if len(known) == 2:
                place = _unfold_corner(verts[[a, b, own[k]]], places[known[0]], places[known[1]])
            elif known:
                other = a if a in at else b
                place = places[known[0]] + [float(np.linalg.norm(verts[own[k]] - verts[other])), 0.0]
            else:
                place = np.array([max((float(each[0]) for each in places), default=0.0), 0.0])
            for other in around[own[k]] if own[k] not in at else ():
                if shared[other] >= 0:
                    shared[other] += 1
                    heappush(queue, (-shared[other], other))
            at[own[k]] = len(places)
            places.append(np.asarray(place))
        out[face] = [at[vertex] for vertex in own]
    return np.array(places), out


def _unfold_corner(corners: Floats, a: Floats, b: Floats) -> Floats:
    """Position of a triangle's third corner in the plane, to the left of the direction from a to b."""
    along, aside = corners[1] - corners[0], corners[2] - corners[0]
    length = max(float(along @ along), 1e-30)
    share = float(aside @ along) / length
    height = float(np.linalg.norm(aside - share * along)) / np.sqrt(length)
    edge = b - a
    return np.asarray(a + share * edge + height * np.array([-edge[1], edge[0]]))
