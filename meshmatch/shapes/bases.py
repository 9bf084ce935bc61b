"""Detection of a flat base that a body is fused with: a piece of floor in a scan, the plate or plinth of a figurine.

A base lies in a plane with much of the surface. The body stands on that plane, and behind it is nothing, or a block no
higher than the body.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# All of these were set by hand.
_POINTS, _PLANES, _FITTED = 3000, 200, 8  # samples, candidate planes through them, and the number that are fitted
_FIT_STEPS = 6  # iterations of each fit
# Maximum distance from the plane, as a share of the height of the body on it; for a mesh and for a cloud.
_TOLERANCE, _CLOUD_TOLERANCE = 0.01, 0.02
_MIN_COSINE = np.cos(np.radians(25))  # minimum cosine between the normal of a point and that of the plane
# Minimum share of the area in the plane. Clouds, whose normals have no signs, need more: in 168 clouds of people and
# animals up to 0.104 of the area lies in one plane.
_MIN_SHARE, _MIN_CLOUD_SHARE = 0.04, 0.12
_MIN_ABOVE = 0.01  # minimum share of the area on the plane's front side


@dataclass(frozen=True)
class Plane:
    """The plane normal . x = offset of a base, in the unit of the file.

    ``share`` (0..1) of the surface lies within ``tolerance`` of it.
    """

    normal: Float[Floats, " 3"]
    offset: float
    share: float
    tolerance: float

    def is_base(self, points: Float[Floats, "N 3"]) -> Bool[Bools, " N"]:
        """Whether each point belongs to the base: in the plane, or behind it."""
        return np.asarray(points @ self.normal - self.offset <= self.tolerance)


def base_plane(shape: Shape) -> Plane | None:
    """The plane of a base that something stands on; for a mesh of one part, or a cloud. None if there is no base."""
    if not shape.area > 0:
        return None
    samples = sample_surface(shape, _POINTS, np.random.default_rng(0))
    centered = _Samples(samples.points - samples.points.mean(axis=0), samples.normals, samples.signed)
    plane = centered.best_plane()
    if plane is None:
        return None
    return replace(plane, offset=plane.offset + float(plane.normal @ samples.points.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class _Samples:
    """Centred points of a surface with unit normals, whose signs mean nothing for a cloud."""

    points: Float[Floats, "P 3"]
    normals: Float[Floats, "P 3"]
    signed: bool

    def best_plane(self) -> Plane | None:
        """The plane with the largest share of the surface, if that is large enough."""
        best_plane: Plane | None = None
        normals, offsets = self.normals[:_PLANES], np.einsum("nd,nd->n", self.normals[:_PLANES], self.points[:_PLANES])
        if not self.signed:
            normals, offsets = np.concatenate([normals, -normals]), np.concatenate([offsets, -offsets])
        for k in np.argsort(-self.find_inliers(normals, offsets)[0].mean(axis=0), kind="stable")[:_FITTED]:
            normal, offset = normals[k], float(offsets[k])
            for _ in range(_FIT_STEPS):
                inliers = self.points[self.find_inliers(normal[None], np.array([offset]))[0][:, 0]]
                if len(inliers) < 3:
                    break
                center = inliers.mean(axis=0)
                fitted = np.linalg.svd(inliers - center, full_matrices=False)[2][2]
                normal = fitted if fitted @ normal > 0 else -fitted
                offset = float(center @ normal)
            inside, tolerance = self.find_inliers(normal[None], np.array([offset]))
            share = float(inside.mean())
            if share >= (_MIN_SHARE if self.signed else _MIN_CLOUD_SHARE) and (
                best_plane is None or share > best_plane.share
            ):
                best_plane = Plane(normal, offset, share, float(tolerance[0]))
        return best_plane

    def find_inliers(
        self, normal: Float[Floats, "N 3"], offset: Float[Floats, " N"]
    ) -> tuple[Bool[Bools, "P N"], Float[Floats, " N"]]:
        """Masks of the points in each candidate plane, and the distances up to which they count.

        A plane that supports no body has no inliers.
        """
        height, cosine = self.points @ normal.T - offset, self.normals @ normal.T
        above, behind = height.max(axis=0), -height.min(axis=0)
        tolerance = (_TOLERANCE if self.signed else _CLOUD_TOLERANCE) * above
        supports_body = ((height > tolerance).mean(axis=0) >= _MIN_ABOVE) & (behind <= above)
        return (np.abs(height) <= tolerance) & (
            (cosine if self.signed else np.abs(cosine)) >= _MIN_COSINE
        ) & supports_body, tolerance
