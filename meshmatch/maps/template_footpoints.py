"""Where every vertex of a shape belongs on the template, also where two sheets touch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.islands import reassign_islands
from meshmatch.maps.surface import Footpoints, Surface
from meshmatch.shapes.shape import Shape

_ROUNDS = 3
# The share of a cloud's points that are neighbours of one where noise is 1 % of the diagonal; and the least and the
# largest number of them. Set by hand on noisy scans of bodies.
_NEIGHBOURS, _NEIGHBOUR_RANGE = 0.005, (9, 64)
_CHUNK = 16_384  # points at a time


def template_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> tuple[Footpoints, Float[Floats, "V 3"]]:
    """The point of the fitted template for every vertex, and the same point of the resting template.

    The closest point in space jumps to another limb where two of them touch: `meshmatch.maps.islands` corrects that on
    a mesh. Points of a cloud have no edges that would reveal it, and noise takes them across: each is searched again,
    near the median of its neighbours.
    """
    points, normals = in_core_frame(shape, fit)
    template_normals = vertex_normals(fit.points, fit.faces)
    surface = Surface(fit.points, fit.faces, template_normals, fit.resting)
    found = closest_footpoints(shape, fit, workers)

    def resting(foot: Footpoints) -> Floats:
        return foot.values(fit.faces, fit.resting)

    if not shape.is_cloud:
        return reassign_islands(
            points,
            shape.faces,
            shape.vertex_areas,
            found,
            resting,
            lambda rows, near: surface.query(points[rows], normals[rows], workers, near),
            _ROUNDS,
        )
    near = neighbours(points, shape.roughness)
    for _ in range(_ROUNDS):
        found = surface.query(points, normals, workers, neighbour_medians(resting(found), near))
    return found, resting(found)


def closest_footpoints(shape: Shape, fit: Fit, workers: int = 1) -> Footpoints:
    """Closest points of the fitted template, of those that face the same way as the vertices of a shape."""
    surface = Surface(fit.points, fit.faces, vertex_normals(fit.points, fit.faces))
    return surface.query(*in_core_frame(shape, fit), workers)


def neighbours(points: Float[Floats, "V 3"], roughness: float) -> Int[Ints, "V K"]:
    """The nearest points of each of a cloud, itself first: more of them where noise is large (`Shape.roughness`)."""
    k = int(np.clip(_NEIGHBOURS * roughness * len(points), *_NEIGHBOUR_RANGE))
    return np.asarray(cKDTree(points).query(points, min(k, len(points)))[1])


def neighbour_medians(values: Float[Floats, "V D"], near: Int[Ints, "V K"]) -> Float[Floats, "V D"]:
    """Median, coordinate by coordinate, of the values of neighbours."""
    found = np.empty_like(values)
    for low in range(0, len(values), _CHUNK):
        part = slice(low, low + _CHUNK)
        found[part] = np.median(values[near[part]], axis=1)
    return found


def in_core_frame(shape: Shape, fit: Fit) -> tuple[Float[Floats, "V 3"], Float[Floats, "V 3"]]:
    """Vertices and unit normals of a shape in the core frame, where its fit is; zero normals for a cloud."""
    points = fit.frame.apply(shape.verts)
    return points, np.zeros_like(points) if shape.is_cloud else shape.vertex_normals @ fit.frame.rotation.T
