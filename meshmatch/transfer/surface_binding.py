"""A shape's own mesh, carried by the template that was laid on it."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.template_footpoints import template_footpoints
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape


class SurfaceBinding:
    """Every vertex of a shape rides on its place on the fitted template.

    What lies between the vertex and its place is kept, and turns with the template: so the pose of the fit gives back
    the shape, with all its detail.

    Parameters
    ----------
    part : Repaired
        The shape; all vertices of its original ride.
    fit : Fit
    turns : (V, 3, 3)
        How the fitted template is turned at each of its vertices.
    """

    def __init__(self, part: Repaired, fit: Fit, turns: Floats, workers: int = 1) -> None:
        self._shape = part.original
        foot, _ = template_footpoints(part.shape, fit, workers)
        rows = part.original_to_repaired
        self._corners, self._weights = fit.faces[foot.face[rows]], foot.barycentric[rows]
        offset = fit.frame.apply(part.original.verts) - self._on(fit.points)
        self._offsets = [np.einsum("nji,nj->ni", turns[self._corners[:, k]], offset) for k in range(3)]

    def at(self, points: Floats, turns: Floats) -> Floats:
        """Vertices (N, 3) of the shape where the template has its points (V, 3) and is turned (V, 3, 3); core frame."""
        verts = self._on(points)
        for k, offset in enumerate(self._offsets):
            turned = np.einsum("nij,nj->ni", turns[self._corners[:, k]], offset)
            verts += self._weights[:, k, None] * turned
        return verts

    def shape(self, verts: Floats, name: str = "") -> Shape:
        """The shape with other positions (N, 3) of its vertices."""
        return Shape(verts, self._shape.faces, name, self._shape.colors, self._shape.invalid)

    def _on(self, points: Floats) -> Floats:
        return interpolate(points, self._corners, self._weights)
