"""Which connected parts of a mesh belong to the object, and which are dirt or another object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.geometry.topology import face_parts
from meshmatch.geometry.triangles import squared_lengths

OUTLIER_SHARE = 0.02
"""A part with less than this share of the largest part's area is an outlier. This and the next two are set by hand."""
_FAR = 0.25  # gap between two big parts, in diagonals of the largest, from which they count as apart
_NEAR = 0.05  # gap up to which a small part belongs to a shape that is made of small parts


@dataclass(frozen=True, eq=False)
class Parts:
    """What `find_parts` found.

    Parameters
    ----------
    outlier : (F,) bool
        Faces of outlier parts.
    outlier_parts, kept : int
        How many parts are outliers, and how many are not.
    far : int
        How many of the kept ones are big but lie far from the rest.
    far_share : float
        Their share of the surface, in 0..1.
    """

    outlier: Bool[Bools, " F"]
    outlier_parts: int
    kept: int
    far: int
    far_share: float


def find_parts(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], cross: Float[Floats, "F 3"]) -> Parts:
    """Judge the connected parts of a mesh; `cross` (F, 3) is the normal of each face, twice its area long."""
    part = face_parts(faces, len(verts))
    if part.max() == 0:
        return Parts(np.zeros(len(faces), bool), 0, 1, 0, 0.0)
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
    share = float(areas[far].sum() / areas.sum())
    return Parts(outlier[part], int(outlier.sum()), len(areas) - int(outlier.sum()), len(far), share)


def _gaps(verts: Floats, faces: Ints, face_areas: Floats, part: Ints, body: Ints, others: Ints) -> tuple[Floats, float]:
    """Distance (parts,) of each of the `others` to the parts in `body`, else 0; and the body's diagonal."""
    from scipy.spatial import cKDTree

    count = int(part.max()) + 1
    theirs, ours = np.isin(np.arange(count), others), np.isin(np.arange(count), body)
    chosen, anchor = theirs[part], faces[ours[part]]
    diagonal = float(np.linalg.norm(np.ptp(verts[_corners(anchor, len(verts))], axis=0)))
    gap = np.zeros(count)
    if len(others):
        # points on the body's faces, because its vertices may be far apart
        rng = np.random.default_rng(0)
        total = np.cumsum(face_areas[ours[part]])
        face = np.searchsorted(total, rng.random(20_000) * total[-1]).clip(max=len(anchor) - 1)
        points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), len(face)), verts[anchor[face]])
        corners = _corners(faces[chosen], len(verts))
        of_vertex = np.zeros(len(verts), np.int64)
        of_vertex[faces[chosen]] = part[chosen, None]
        gap[others] = np.inf
        np.minimum.at(gap, of_vertex[corners], cKDTree(points).query(verts[corners])[0])
    return gap, diagonal


def _corners(faces: Ints, V: int) -> Ints:
    """The vertices that these faces use, in order."""
    used = np.zeros(V, bool)
    used[faces.ravel()] = True
    return np.flatnonzero(used)
