"""The flat base that a body stands on and is fused with: a piece of the floor in a scan, the plate or plinth of a figurine.

It has a plane in which much of the surface lies. Something stands on that, and behind it is nothing, or a block no higher
than what stands on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints

# All of these were set by hand.
_POINTS, _PLANES, _KEPT = 3000, 200, 8  # samples, planes through some of them, and how many of these are fitted
_STEPS = 6  # of each fit
_FLAT = 0.01  # share of the height of what stands on a plane that what lies in it may be off
_LEVEL = np.cos(np.radians(25))  # normals of what lies in a plane
_LARGE = 0.04  # share of the area that lies in it at least
_STANDING = 0.01  # share of the area that stands on it at least


@dataclass(frozen=True)
class Plane:
    """All x with x . normal = offset, and the share (0..1) of the surface that lies in it; ``near`` is how far off that may
    be. Lengths are in the unit of the file.
    """

    normal: Float[Floats, " 3"]
    offset: float
    share: float
    near: float

    def below(self, points: Float[Floats, "N 3"]) -> Bool[Bools, " N"]:
        """Which points are of the base: in the plane, or behind it."""
        return np.asarray(points @ self.normal - self.offset <= self.near)


def base_plane(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], vectors: Float[Floats, "F 3"]) -> Plane | None:
    """The plane on which a connected surface stands, if it is fused with a base; ``vectors`` are normals of the faces, twice
    as long as their area.
    """
    area = np.linalg.norm(vectors, axis=1)
    rng, total = np.random.default_rng(0), np.cumsum(area)
    at = np.searchsorted(total, (rng.permutation(_POINTS) + 0.5) / _POINTS * total[-1])
    at = np.minimum(at, len(faces) - 1)
    points = np.einsum("pk,pki->pi", rng.dirichlet(np.ones(3), _POINTS), verts[faces[at]])
    normals = vectors[at] / area[at, None]
    middle = points.mean(axis=0)
    points = points - middle
    planes = normals[:_PLANES], np.einsum("nd,nd->n", normals[:_PLANES], points[:_PLANES])
    share, _ = _in_planes(points, normals, *planes)
    best: Plane | None = None
    for k in np.argsort(-share.mean(axis=0), kind="stable")[:_KEPT]:
        normal, offset = planes[0][k], float(planes[1][k])
        for _ in range(_STEPS):
            inside, near = _in_planes(points, normals, normal[None], np.array([offset]))
            own = points[inside[:, 0]]
            if len(own) < _LARGE * _POINTS / 4:
                break
            center = own.mean(axis=0)
            fitted = np.linalg.svd(own - center, full_matrices=False)[2][2]
            normal = fitted if fitted @ normal > 0 else -fitted
            offset = float(center @ normal)
        inside, near = _in_planes(points, normals, normal[None], np.array([offset]))
        found = float(inside.mean())
        if found >= _LARGE and (best is None or found > best.share):
            best = Plane(normal, offset + float(middle @ normal), found, float(near[0]))
    return best


def _in_planes(
    points: Float[Floats, "P 3"],
    normals: Float[Floats, "P 3"],
    along: Float[Floats, "N 3"],
    offset: Float[Floats, " N"],
) -> tuple[Bool[Bools, "P N"], Float[Floats, " N"]]:
    """Which points lie in each of some planes, none in one on which nothing stands; and how far off they may be."""
    height = points @ along.T - offset
    above, behind = height.max(axis=0), -height.min(axis=0)
    near = _FLAT * above
    stands = ((height > near).mean(axis=0) >= _STANDING) & (behind <= above)
    return (np.abs(height) <= near) & (normals @ along.T >= _LEVEL) & stands, near
