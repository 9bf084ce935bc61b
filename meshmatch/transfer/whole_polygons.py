"""A polygon alone: its triangles laid out beside each other, whatever they do."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints


def unfolded_polygon(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> tuple[Float[Floats, "M 2"], Int[Ints, "F 3"]]:
    """Places of the corners of a few triangles, each laid out beside what it shares most corners with; and their numbers."""
    places: list[Floats] = []
    out = np.empty((len(faces), 3), np.int64)
    at: dict[int, int] = {}
    left = list(range(len(faces)))
    while left:  # one that hangs together with what is laid
        face = max(left, key=lambda each: sum(vertex in at for vertex in faces[each].tolist()))
        left.remove(face)
        own = faces[face].tolist()
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
