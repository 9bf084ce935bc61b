"""A shape's own mesh, moved by the template that was fitted to it."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.template_footpoints import template_footpoints
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape


class SurfaceBinding:
    """Every vertex of a shape is bound to its footpoint on the fitted template.

    The offset from the footpoint is kept, and turns with the template (``turns`` are rotations at its vertices): so the
    pose of the fit reproduces the shape with all its detail.
    """

    def __init__(self, part: Repaired, fit: Fit, turns: Float[Floats, "V 3 3"], workers: int = 1) -> None:
        self._shape = part.original
        foot, _ = template_footpoints(part.shape, fit, workers)
        rows = part.original_to_repaired  # all vertices of the original are bound
        self._corners, self._weights = fit.faces[foot.face[rows]], foot.barycentric[rows]
        offset = fit.frame.apply(part.original.verts) - self._on(fit.points)
        self._offsets = [np.einsum("nji,nj->ni", turns[self._corners[:, k]], offset) for k in range(3)]

    def at(self, points: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> Float[Floats, "N 3"]:
        """Vertices (N, 3) of the shape for points (V, 3) and rotations (V, 3, 3) of the template; core frame."""
        verts = self._on(points)
        for k, offset in enumerate(self._offsets):
            turned = np.einsum("nij,nj->ni", turns[self._corners[:, k]], offset)
            verts += self._weights[:, k, None] * turned
        return verts

    def shape(self, verts: Float[Floats, "N 3"], name: str = "") -> Shape:
        """The shape with other positions (N, 3) of its vertices."""
        return Shape(verts, self._shape.faces, name, self._shape.colors, self._shape.invalid)

    def _on(self, points: Floats) -> Floats:
        return interpolate(points, self._corners, self._weights)
