"""What occurs twice in a mesh, or is nothing: vertices of seams, faces, slivers."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.topology import edge_keys, open_edges, same_rows
from meshmatch.geometry.triangles import squared_lengths


def seams(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, " V"]:
    """(V,) the vertex to use instead of each: the first at the same position, if both lie on an open edge."""
    twin = same_rows(verts)
    own = np.arange(len(verts))
    if (twin == own).all():
        return twin
    shared = np.zeros(len(verts), bool)
    shared[twin[twin != own]] = True
    shared = shared[twin]
    border = np.zeros(len(verts), bool)
    border[open_edges(faces[shared[faces].any(axis=1)])] = True
    border &= shared
    # the first of a group need not be on the border: number the border alone
    place = np.flatnonzero(border)
    own[place] = place[same_rows(verts[place])]
    return own


def flat_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], diagonal: float
) -> Bool[Bools, " F"]:
    """True for a face that names a vertex twice, or whose height is rounding beside its longest edge."""
    double_areas = squared_lengths(cross)
    flat = double_areas <= (1e-12 * diagonal**2) ** 2  # no edge is longer than the diagonal
    small = np.flatnonzero(flat)
    a, b, c = (verts[faces[small, k]] for k in range(3))
    longest = np.maximum(np.maximum(squared_lengths(b - a), squared_lengths(c - a)), squared_lengths(c - b))
    flat[small] = double_areas[small] <= (1e-12 * longest) ** 2
    return np.asarray(flat)


def duplicate_faces(faces: Int[Ints, "F 3"]) -> Bool[Bools, " F"]:
    """True for faces to drop: all but the first of the same three corners, and both of a flap.

    Two that face opposite ways cancel. On a surface that goes on around them they are a fold of no volume,
    and without both it is closed as before; in a sheet that is double all over, one of each is the surface.
    """
    a, b, c = np.ascontiguousarray(faces.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first = same_rows(np.stack([low, a + b + c - low - high, high], axis=1))
    double = first != np.arange(len(faces))
    if not double.any():
        return double
    many = np.bincount(first, minlength=len(faces))
    second = np.flatnonzero(double & (many[first] == 2))
    pair = np.stack([first[second], second], axis=1)
    pair = pair[_handed(faces[pair[:, 0]]) != _handed(faces[pair[:, 1]])]
    at_pair = np.zeros(int(faces.max()) + 1, bool)
    at_pair[faces[pair.ravel()]] = True
    beside = at_pair[faces].any(axis=1) & (many[first] == 1)
    single = np.sort(edge_keys(faces[beside], len(at_pair)))
    keys = edge_keys(faces[pair[:, 0]], len(at_pair)).reshape(3, -1).T
    others = np.searchsorted(single, keys, "right") - np.searchsorted(single, keys, "left")  # pairs 3
    flap = ((others == 0) | (others == 2)).all(axis=1) & (others == 2).any(axis=1)
    double[pair[flap, 0]] = True
    return double


def _handed(faces: Ints) -> Bools:
    """Which of its two ways round each face goes: the same for a b c, b c a and c a b."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return np.asarray(turned[:, 1] < turned[:, 2])
