"""Even sampling of surfaces, and triangulation of point clouds."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.spatial import Delaunay, QhullError

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import dot, interpolate, normalized, triangle_vectors
from meshmatch.shapes.shape import Shape

_N_NEIGHBOURS = 16
_CANDIDATES_PER_POINT = 30  # candidates per chosen point: more would not improve the choice
_MAX_EDGE = 3.0  # maximum edge length, relative to the median distance of the sixth neighbour


@dataclass(frozen=True, eq=False, kw_only=True)
class Samples(OrientedPoints):
    """Points on a shape in its own frame, with the normals of their faces.

    Normals of a cloud are estimated, without reliable signs. `face` is the face of each point (-1 for a cloud), and
    `barycentric` its weights there, which sum to 1 ((1, 0, 0) for a cloud); `vertex` is the corner with the largest
    weight, or the drawn point of the cloud.
    """

    face: Int[Ints, " P"]
    barycentric: Float[Floats, "P 3"]
    vertex: Int[Ints, " P"]


def sample_surface(shape: Shape, P: int, rng: np.random.Generator) -> Samples:
    """Draw `P` points with uniform probability per area; the same state of `rng` gives the same points.

    From a cloud, its own points are drawn with probability proportional to the area that each represents (so dense
    regions are not favoured), without repetition while there are enough. `InputError` if there is no area.
    """
    areas = shape.vertex_areas if shape.is_cloud else shape.face_areas
    total = np.cumsum(areas)
    if not total[-1] > 0:
        raise InputError(f"{shape.name or 'the shape'} has no surface to sample", "all its faces are degenerate")
    if shape.is_cloud:
        chosen = _draw_points(areas, P, rng)
        weights, face = np.tile([1.0, 0.0, 0.0], (P, 1)), np.full(P, -1, np.int64)
        normals = shape.vertex_normals[chosen]
        trust = None if shape.weights is None else shape.weights[chosen]
        return Samples(shape.verts[chosen], normals, False, trust, face=face, barycentric=weights, vertex=chosen)
    # side="right" skips faces without area
    face = np.searchsorted(total, rng.random(P) * total[-1], side="right").astype(np.int64)
    face = np.minimum(face, np.flatnonzero(areas)[-1])
    root = np.sqrt(rng.random(P))
    other = rng.random(P)
    weights = np.stack([1.0 - root, root * (1.0 - other), root * other], axis=1)  # P 3
    corners = shape.faces[face]  # P 3
    points = interpolate(shape.verts, corners, weights)
    vertex = corners[np.arange(P), weights.argmax(axis=1)]
    trust = None if shape.weights is None else (weights * shape.weights[corners]).sum(axis=1)
    return Samples(
        points, normalized(shape.face_vectors[face]), True, trust, face=face, barycentric=weights, vertex=vertex
    )


def farthest_points(points: Float[Floats, "N D"], K: int) -> Int[Ints, " K"]:
    """Farthest point sampling: indices of points that are each as far as possible from all previous ones.

    The first point is the start. Takes K passes over the points. With fewer distinct points than `K` the last ones
    repeat positions, never indices. `InputError` if there are fewer points.
    """
    points = np.asarray(points, np.float64)
    if not 0 < K <= len(points):
        raise InputError(f"cannot choose {K} of {len(points)} points")
    first, *others = np.ascontiguousarray(points.T)
    chosen = np.empty(K, np.int64)
    nearest = np.full(len(points), np.inf)
    current = 0
    for k in range(K):
        chosen[k] = current
        squared = (first - first[current]) ** 2
        for axis in others:
            squared += (axis - axis[current]) ** 2
        np.minimum(nearest, squared, out=nearest)
        nearest[current] = -1.0  # do not choose it again
        current = int(nearest.argmax())
    return chosen


def _draw_points(areas: Floats, P: int, rng: np.random.Generator) -> Ints:
    """Indices (P,) drawn by weight, first without repetition (Efraimidis and Spirakis 2006), then with."""
    possible = np.flatnonzero(areas)
    with np.errstate(divide="ignore"):
        keys = np.log(rng.random(len(possible))) / areas[possible]
    once = possible[np.argsort(keys, kind="stable")[::-1][:P]]
    if len(once) >= P:
        return once.astype(np.int64)
    total = np.cumsum(areas[possible])
    again = np.searchsorted(total, rng.random(P - len(once)) * total[-1], side="right")
    return np.concatenate([once, possible[np.minimum(again, len(possible) - 1)]]).astype(np.int64)


def triangulate_cloud(cloud: Shape, most: int) -> tuple[Int[Ints, " V"], Int[Ints, "F 3"]]:
    """Triangulate some points of a cloud by the triangles on which their Delaunay stars in the tangent planes agree.

    After the localised Delaunay triangulation of Gopi, Krishnan and Silva (*Surface Reconstruction based on Lower
    Dimensional Localized Delaunay Triangulation*, 2000): a triangle is kept if it is in the stars of all three corners.
    Where noisy points make stars disagree a small hole remains; no point is moved or added.

    There are at most about `most` triangles: half as many points are used, evenly distributed. Returns the points that
    are corners, and faces over them, counter-clockwise seen from where the cloud's estimated normals point.
    `InputError` if hardly any two stars agree: the points do not lie on a surface.
    """
    chosen = np.arange(cloud.V)
    if cloud.V > _CANDIDATES_PER_POINT * (most // 2):  # farthest point sampling is linear in the points
        chosen = np.sort(np.random.default_rng(0).choice(cloud.V, _CANDIDATES_PER_POINT * (most // 2), replace=False))
    if len(chosen) > most // 2:
        chosen = np.sort(chosen[farthest_points(cloud.verts[chosen], most // 2)])
    points, normals = cloud.verts[chosen], cloud.vertex_normals[chosen]
    k = min(_N_NEIGHBOURS, len(points) - 1)
    distance, index = cKDTree(points).query(points, k + 1)
    reach = _MAX_EDGE * np.median(distance[:, min(6, k)])
    votes: Counter[tuple[int, ...]] = Counter()
    for center, neighbours in enumerate(index):
        stars = _star(points[neighbours], normals[center], reach)
        votes.update(
            tuple(sorted((center, int(neighbours[second]), int(neighbours[third])))) for second, third in stars
        )
    faces = np.array([key for key, count in votes.items() if count == 3], np.int64).reshape(-1, 3)
    if 3 * len(faces) < len(points):
        rough = f"{cloud.name or 'the cloud'} is too rough for a template: its points lie on no surface"
        raise InputError(rough, "give a cleaner or denser cloud, or a mesh, with --template")
    outwards = dot(triangle_vectors(points, faces), normals[faces].sum(1))
    faces[outwards < 0] = faces[outwards < 0][:, ::-1]
    used, corners = np.unique(faces, return_inverse=True)
    return chosen[used], corners.reshape(-1, 3)


def _star(points: Floats, normal: Floats, reach: float) -> list[tuple[int, int]]:
    """Triangles of the Delaunay star of the first point in the plane of a normal, as pairs of the other two corners."""
    across = np.linalg.svd(normal[None])[2][1:]
    planar = (points - points[0]) @ across.T
    try:
        triangles = Delaunay(planar).simplices
    except QhullError:
        return []  # all points are collinear
    pairs = []
    for corners in triangles[(triangles == 0).any(axis=1)]:
        b, c = (int(i) for i in corners if i != 0)
        edges = (points[b] - points[0], points[c] - points[0], points[b] - points[c])
        if max(float(edge @ edge) for edge in edges) < reach**2:
            pairs.append((b, c))
    return pairs
