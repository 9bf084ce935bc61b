"""What in a mesh is double, nothing, or no part of the object: vertices of seams, faces, slivers, loose parts."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.topology import edge_keys, face_parts, open_edges, same_rows
from meshmatch.geometry.triangles import squared_lengths

OUTLIER_SHARE = 0.02
"""A part with less than this share of the largest part's area is an outlier. This and the next two are set by hand."""
_FAR = 0.25  # gap between two big parts, in diagonals of the largest, from which they count as apart
_NEAR = 0.05  # gap up to which a small part belongs to a shape that is made of small parts


def seams(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Int[Ints, " V"]:
    """The vertex to use instead of each: the first at the same position, if both lie on an open edge."""
    twin = same_rows(verts)
    own = np.arange(len(verts))
    if (twin == own).all():
        return twin
    shared = np.zeros(len(verts), bool)
    shared[twin[twin != own]] = True
    shared = shared[twin]
    border = np.zeros(len(verts), bool)
    border[open_edges(faces[shared[faces].any(axis=1)])] = True
    # the first of a group need not be on the border: number the border alone
    place = np.flatnonzero(border & shared)
    own[place] = place[same_rows(verts[place])]
    return own


def flat_faces(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"], diagonal: float
) -> Bool[Bools, " F"]:
    """True for a face that names a vertex twice, or whose height is rounding beside its longest edge.

    `cross` is the normal of each face, twice its area long.
    """
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


def find_parts(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"]
) -> tuple[Bool[Bools, " F"], int, int, int, float]:
    """Judge the connected parts of a mesh; `cross` as in `flat_faces`.

    Returns
    -------
    Faces of outlier parts; how many parts are outliers, and how many are not; how many of the latter are big but lie
    far from the rest; and the share of the surface that these have, in 0..1.
    """
    part = face_parts(faces, len(verts))
    if part.max() == 0:
        return np.zeros(len(faces), bool), 0, 1, 0, 0.0
    face_areas = 0.5 * np.sqrt(squared_lengths(cross))
    areas = np.bincount(part, weights=face_areas)
    largest = int(areas.argmax())
    small = areas < OUTLIER_SHARE * areas[largest]
    big = np.flatnonzero(~small)
    # the body grows from the largest part by all big parts that are near
    body = np.array([largest])
    while len(body) < len(big):
        gap, diagonal = _gaps(verts, faces, face_areas, part, body, np.setdiff1d(big, body))
        near = np.setdiff1d(big[gap[big] <= _FAR * diagonal], body)
        if len(near) == 0:
            break
        body = np.concatenate([body, near])
    far = np.setdiff1d(big, body)
    outlier = small.copy()
    if areas[small].sum() > 0.1 * areas.sum():
        gap, diagonal = _gaps(verts, faces, face_areas, part, big, np.flatnonzero(small))
        outlier &= gap > _NEAR * diagonal
    many = int(outlier.sum())
    return outlier[part], many, len(areas) - many, len(far), float(areas[far].sum() / areas.sum())


def _gaps(verts: Floats, faces: Ints, face_areas: Floats, part: Ints, body: Ints, others: Ints) -> tuple[Floats, float]:
    """Distance (parts,) of each of the `others` to the parts in `body`, else 0; and the body's diagonal."""
    from scipy.spatial import cKDTree

    gap = np.zeros(int(part.max()) + 1)
    ours, theirs = np.isin(part, body), np.isin(part, others)
    anchor, chosen = faces[ours], faces[theirs]
    diagonal = float(np.linalg.norm(np.ptp(verts[anchor].reshape(-1, 3), axis=0)))
    if len(others):
        # points on the body's faces, because its vertices may be far apart
        rng = np.random.default_rng(0)
        total = np.cumsum(face_areas[ours])
        face = np.searchsorted(total, rng.random(20_000) * total[-1]).clip(max=len(anchor) - 1)
        points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), len(face)), verts[anchor[face]])
        corners = np.flatnonzero(np.bincount(chosen.ravel()))
        of_vertex = np.zeros(len(verts), np.int64)
        of_vertex[chosen] = part[theirs, None]
        gap[others] = np.inf
        np.minimum.at(gap, of_vertex[corners], cKDTree(points).query(verts[corners])[0])
    return gap, diagonal
