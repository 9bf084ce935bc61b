"""Charts of triangles made charts of polygons: a seam may run along a quad, and not across it."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints


def whole_polygons(
    verts: Float[Floats, "V 3"],
    corners: Int[Ints, "F 3"],
    uv: Float[Floats, "N 2"],
    faces: Int[Ints, "F 3"],
    polygons: Int[Ints, " F"],
) -> tuple[Float[Floats, "M 2"], Int[Ints, "F 3"]]:
    """Coordinates and faces over them in which the triangles of a polygon hang together: one that a seam cuts becomes a
    chart.

    Parameters
    ----------
    verts
        Positions.
    corners
        Triangles over them.
    uv
        Coordinates, in the unit of the positions.
    faces
        The same triangles over the coordinates: charts are what hangs together.
    polygons
        The polygon of each triangle.
    """
    cut = _cut(corners, faces, polygons)
    places, faces = list(uv), faces.copy()
    aside = uv.max(axis=0) + 1.0  # charts lie apart
    order = np.argsort(polygons, kind="stable")
    for first, last in np.searchsorted(polygons[order], [cut, cut + 1]).T.tolist():
        at: dict[int, int] = {}
        left = order[first:last].tolist()
        while left:  # one that hangs together with what is laid
            face = max(left, key=lambda each: sum(vertex in at for vertex in corners[each].tolist()))
            left.remove(face)
            own = corners[face].tolist()
            for k in [k for k in range(3) if own[k] not in at]:
                a, b = (own[(k + step) % 3] for step in (1, 2))
                known = [at[vertex] for vertex in (a, b) if vertex in at]
                if len(known) == 2:
                    place = _unfolded(verts[[a, b, own[k]]], places[known[0]], places[known[1]])
                elif known:
                    other = a if a in at else b
                    place = places[known[0]] + [np.linalg.norm(verts[own[k]] - verts[other]), 0.0]
                else:
                    place = aside
                at[own[k]] = len(places)
                places.append(place)
            faces[face] = [at[vertex] for vertex in own]
        aside = np.max([places[k] for k in at.values()], axis=0) + 1.0
    return np.array(places), faces


def _cut(corners: Ints, faces: Ints, polygons: Ints) -> Ints:
    """Polygons of which some vertex has two places."""
    rows = np.unique(np.stack([np.repeat(polygons, 3), corners.ravel(), faces.ravel()], axis=1), axis=0)
    twice = (rows[1:, :2] == rows[:-1, :2]).all(axis=1)
    return np.unique(rows[1:][twice, 0])


def _unfolded(corners: Floats, a: Floats, b: Floats) -> Floats:
    """Where the third corner of a triangle lies in the plane, to the left of the way from the first to the second."""
    along, aside = corners[1] - corners[0], corners[2] - corners[0]
    length = max(float(along @ along), 1e-30)
    share = float(aside @ along) / length
    height = float(np.linalg.norm(aside - share * along)) / np.sqrt(length)
    way = b - a
    return np.asarray(a + share * way + height * np.array([-way[1], way[0]]))
