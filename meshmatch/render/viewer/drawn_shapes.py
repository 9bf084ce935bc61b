"""What a page draws of two shapes (less of a large one), and where: both upright and at one scale."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.facing import Rotations, guess_rotation, rotation_by_map
from meshmatch.render.surface import corners_of
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.shape import Shape

MAX_VERTICES = 150_000
"""Maximum number of vertices of a shape that is drawn completely."""
_NONE = np.empty(0, np.int64)
_REDUCED_SHARE = 2 / 3  # share of `MAX_VERTICES` that is drawn of a larger shape
_NORMAL_WEIGHT = 3.0  # distance of opposite normals in the search for the nearest vertex, in mean edges drawn
_MAX_PAIRS = 20_000
_MAX_RATIO = 3.0  # between the sizes drawn; beyond, the map is not used for them


@dataclass(frozen=True, eq=False)
class Drawn:
    """The part of a shape that is drawn, in the file's frame and unit.

    ``faces`` is empty where points are drawn. ``normals`` are equal on both sides of a texture seam, zeros where there is
    none. ``vertex`` is the vertex of the file for each row; ``file_face`` the face of the file for each triangle, empty
    where a decimated surface is drawn. ``note`` says what was left out, if anything.
    """

    verts: Float[Floats, "N 3"]
    faces: Int[Ints, "M 3"]
    normals: Float[Floats, "N 3"]
    vertex: Int[Ints, " N"]
    file_face: Int[Ints, " K"]
    note: str = ""

    @property
    def radius(self) -> float:
        """Half the median distance to the fifth neighbour, for balls that nearly touch; 0 for triangles."""
        if len(self.faces) or len(self.verts) < 2:
            return 0.0
        some = self.verts[:: max(1, len(self.verts) // 2_000)]
        reach, _ = cKDTree(self.verts).query(some, k=min(6, len(self.verts)))
        return float(np.median(reach[:, -1])) / 2

    @cached_property
    def used(self) -> Int[Ints, " U"]:
        """Rows that are visible: those of a face, or every point."""
        return corners_of(self.faces) if len(self.faces) else np.arange(len(self.verts))


def draw(shape: Shape, most: int = MAX_VERTICES) -> Drawn:
    """Select what to draw of a shape: no vertices without a position, and a decimated surface above `most` vertices."""
    valid = shape.valid
    if not valid.any():  # placeholders only: still write a page
        valid[:] = True
    sound = np.flatnonzero(valid[shape.faces].all(axis=1))
    faces = shape.faces[sound]
    if len(faces) == 0:
        return _draw_points(shape, np.flatnonzero(valid), most)
    welded = seam_representatives(shape.verts, faces)
    smooth = Shape(shape.verts, welded[faces]).vertex_normals[welded]
    if shape.V <= most:
        return Drawn(shape.verts, faces, smooth, np.arange(shape.V), sound)
    kept = corners_of(welded[faces])
    number = np.empty(shape.V, np.int64)
    number[kept] = np.arange(len(kept))
    coarse = decimate(Shape(shape.verts[kept], number[welded[faces]]), 2 * int(_REDUCED_SHARE * most))
    used = corners_of(faces)
    if coarse.V > most:  # single triangles that are not connected cannot be decimated
        return _draw_points(shape, used, most)
    # Each vertex of the coarse mesh stands for the nearest one of the file with a similar normal.
    edges = coarse.verts[coarse.faces] - coarse.verts[np.roll(coarse.faces, 1, axis=1)]
    weight = _NORMAL_WEIGHT * float(np.linalg.norm(edges, axis=2).mean()) / 2
    tree = cKDTree(np.hstack([shape.verts[used], weight * smooth[used]]))
    vertex = used[tree.query(np.hstack([coarse.verts, weight * coarse.vertex_normals]))[1]]
    note = f"drawn with {coarse.V:,} of {shape.V:,} vertices"
    return Drawn(coarse.verts, coarse.faces, coarse.vertex_normals, vertex, _NONE, note)


def _draw_points(shape: Shape, rows: Int[Ints, " N"], most: int) -> Drawn:
    note, count = "", len(rows)
    if count > most:
        rows = rows[np.linspace(0, count - 1, int(_REDUCED_SHARE * most)).astype(np.int64)]
        note = f"drawn with {len(rows):,} of {count:,} points"
    none = np.empty((0, 3), np.int64)
    verts = shape.verts[rows]
    normals = Shape(verts, none).vertex_normals if shape.is_cloud else shape.vertex_normals[rows]
    return Drawn(verts, none, normals, rows, _NONE, note)


def span(points: Float[Floats, "N 3"]) -> tuple[Float[Floats, " 3"], float, dict[str, list[float]]]:
    """The lowest corner of the cube around points, its edge, and its description for a page where the edge is 1 long."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0)
    edge = float(extent.max()) or 1.0
    return low, edge, {"low": (-extent / edge / 2).round(6).tolist(), "extent": (extent / edge).round(6).tolist()}


@dataclass(frozen=True, eq=False)
class Box:
    """The cube in which a shape is drawn.

    ``rotation`` leads from the file's axes to y up, z to the front; ``low`` is the lowest corner, rotated, and ``edge`` the
    edge, both in the file's unit; ``size`` is the edge on the page, in a unit that is the same for both shapes.
    """

    rotation: Float[Floats, "3 3"]
    low: Float[Floats, " 3"]
    edge: float
    size: float

    def place(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points of the file as 0..1 in the cube, clipped to it."""
        return np.asarray(np.clip((points @ self.rotation.T - self.low) / self.edge, 0.0, 1.0))


def boxes(
    shapes: tuple[Shape, Shape], drawn: tuple[Drawn, Drawn], there: VertexMap, rotations: tuple[Floats, Floats]
) -> list[Box]:
    """A cube for each of two shapes, at a common scale as far as the map gives it."""
    ratio = relative_size(*shapes, there)
    if there.verdict == "poor":
        ratio = float(np.sqrt(shapes[1].area / shapes[0].area)) if min(s.area for s in shapes) > 0 else 1.0
    turned = [part.verts[part.used] @ turn.T for part, turn in zip(drawn, rotations, strict=True)]
    edges = [float(np.ptp(verts, axis=0).max()) or 1.0 for verts in turned]
    sizes = [edges[0], edges[1] / ratio]
    if not 1 / _MAX_RATIO < sizes[0] / sizes[1] < _MAX_RATIO:
        sizes = [1.0, 1.0]
    corners = [
        (verts.min(axis=0) + verts.max(axis=0)) / 2 - edge / 2 for verts, edge in zip(turned, edges, strict=True)
    ]
    return [Box(rotations[k], corners[k], edges[k], sizes[k] / max(sizes)) for k in (0, 1)]


def relative_size(source: Shape, target: Shape, there: VertexMap) -> float:
    """Length on the target of what has length 1 on the source; 1 if that is unknown.

    It is measured over short distances, which poses hardly change, weighted by the map's confidence, without those that the
    map tears.
    """
    if source.is_cloud:
        sample = np.arange(source.V)[:: max(1, source.V // _MAX_PAIRS)]
        near = cKDTree(source.verts).query(source.verts[sample], k=min(9, source.V))[1].reshape(len(sample), -1)
        pairs = np.stack([sample, near[:, -1]], axis=1)
    else:
        pairs = source.edges.vertices
        pairs = pairs[:: max(1, len(pairs) // _MAX_PAIRS)]
    points = there.points(target)
    own = np.linalg.norm(source.verts[pairs[:, 0]] - source.verts[pairs[:, 1]], axis=1)
    image = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    weights = there.assumed_confidence[pairs].min(axis=1) * (image <= np.quantile(image, 0.95))
    lengths = float(weights @ own), float(weights @ image)
    return lengths[1] / lengths[0] if min(lengths) > 0 else 1.0


def view_rotations(
    source: Shape, target: Shape, there: VertexMap, rotations: Rotations = (None, None)
) -> tuple[Floats, Floats]:
    """Rotations (3, 3) of both shapes to y up, z front. Unless given, the source's is guessed, and the target's shows
    matched points from the same side; with a poor map it is the source's.
    """
    own = np.asarray(guess_rotation(source) if rotations[0] is None else rotations[0], np.float64)
    if rotations[1] is not None:
        return own, np.asarray(rotations[1], np.float64)
    return own, own if there.verdict == "poor" else rotation_by_map(source, target, there, own)
