"""The flat base that a body stands on and is fused with: a piece of the floor in a scan, the plate or plinth of a figurine.

It has a plane in which much of the surface lies. Something stands on that, and behind it is nothing, or a block no higher
than what stands on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# All of these were set by hand.
_POINTS, _PLANES, _KEPT = 3000, 200, 8  # samples, planes through some of them, and how many of these are fitted
_STEPS = 6  # of each fit
_FLAT, _ROUGH = 0.01, 0.02  # share of the height of what stands on a plane that what lies in it may be off; of a cloud
_LEVEL = np.cos(np.radians(25))  # normals of what lies in a plane
# Share of the area that lies in it at least; of a cloud, whose normals have no signs, more: up to 0.104 do of 168 clouds of
# people and animals.
_LARGE, _LARGE_OF_CLOUD = 0.04, 0.12
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


def base_plane(shape: Shape) -> Plane | None:
    """The plane on which something stands that is fused with a base; of a mesh of one part, or of a cloud."""
    if not shape.area > 0:
        return None
    samples = sample_surface(shape, _POINTS, np.random.default_rng(0))
    seen = _Samples(samples.points - samples.points.mean(axis=0), samples.normals, samples.signed)
    found = seen.best()
    if found is None:
        return None
    return replace(found, offset=found.offset + float(found.normal @ samples.points.mean(axis=0)))


@dataclass(frozen=True, eq=False)
class _Samples:
    """Points of a surface around the origin with unit normals, whose signs say nothing of a cloud."""

    points: Float[Floats, "P 3"]
    normals: Float[Floats, "P 3"]
    signed: bool

    def best(self) -> Plane | None:
        """The plane with most of the surface, and not too little."""
        best: Plane | None = None
        along, offsets = self.normals[:_PLANES], np.einsum("nd,nd->n", self.normals[:_PLANES], self.points[:_PLANES])
        if not self.signed:
            along, offsets = np.concatenate([along, -along]), np.concatenate([offsets, -offsets])
        for k in np.argsort(-self.within(along, offsets)[0].mean(axis=0), kind="stable")[:_KEPT]:
            normal, offset = along[k], float(offsets[k])
            for _ in range(_STEPS):
                own = self.points[self.within(normal[None], np.array([offset]))[0][:, 0]]
                if len(own) < 3:
                    break
                center = own.mean(axis=0)
                fitted = np.linalg.svd(own - center, full_matrices=False)[2][2]
                normal = fitted if fitted @ normal > 0 else -fitted
                offset = float(center @ normal)
            inside, near = self.within(normal[None], np.array([offset]))
            share = float(inside.mean())
            if share >= (_LARGE if self.signed else _LARGE_OF_CLOUD) and (best is None or share > best.share):
                best = Plane(normal, offset, share, float(near[0]))
        return best

    def within(
        self, along: Float[Floats, "N 3"], offset: Float[Floats, " N"]
    ) -> tuple[Bool[Bools, "P N"], Float[Floats, " N"]]:
        """Which points lie in each of some planes, none in one on which nothing stands; and how far off they may be."""
        height, level = self.points @ along.T - offset, self.normals @ along.T
        above, behind = height.max(axis=0), -height.min(axis=0)
        near = (_FLAT if self.signed else _ROUGH) * above
        stands = ((height > near).mean(axis=0) >= _STANDING) & (behind <= above)
        return (np.abs(height) <= near) & ((level if self.signed else np.abs(level)) >= _LEVEL) & stands, near
