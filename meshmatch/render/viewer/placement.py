"""How the two shapes stand beside each other: both upright, facing the same way, in one scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Floats
from meshmatch.geometry.topology import edges_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.facing import facing, facing_alike
from meshmatch.render.viewer.drawn import Drawn
from meshmatch.shapes.shape import Shape

_PAIRS = 20_000
_ODD = 3.0  # more than this between the sizes drawn, and the map is no guide to them


@dataclass(frozen=True, eq=False)
class Box:
    """The cube in which a shape is drawn.

    Parameters
    ----------
    rotation : (3, 3) float64
        From the file's axes to y up, z to the front.
    low : (3,) float64
        Its lowest corner, turned, unit of the file.
    edge : float
        Its edge, unit of the file.
    size : float
        Its edge on the page, where one unit is the same for both shapes.
    """

    rotation: Floats
    low: Floats
    edge: float
    size: float

    def place(self, points: Floats) -> Floats:
        """(N, 3) points of the file, 0..1 in the cube; what lies outside comes to its side."""
        return np.asarray(np.clip((points @ self.rotation.T - self.low) / self.edge, 0.0, 1.0))


def boxes(
    shapes: tuple[Shape, Shape], drawn: tuple[Drawn, Drawn], there: VertexMap, rotations: tuple[Floats, Floats]
) -> tuple[Box, Box]:
    """A cube for each of two shapes, in one scale as far as the map can tell."""
    cubes = [_cube(part, rotation) for part, rotation in zip(drawn, rotations, strict=True)]
    ratio = relative_size(*shapes, there)
    if there.verdict == "poor":
        ratio = float(np.sqrt(shapes[1].area / shapes[0].area)) if min(s.area for s in shapes) > 0 else 1.0
    sizes = cubes[0][1], cubes[1][1] / ratio
    if not 1 / _ODD < sizes[0] / sizes[1] < _ODD:
        sizes = 1.0, 1.0
    largest = max(sizes)
    a, b = (
        Box(rotation, low, edge, size / largest)
        for (low, edge), rotation, size in zip(cubes, rotations, sizes, strict=True)
    )
    return a, b


def _cube(drawn: Drawn, rotation: Floats) -> tuple[Floats, float]:
    turned = drawn.verts[drawn.used] @ rotation.T
    low, high = turned.min(axis=0), turned.max(axis=0)
    edge = float((high - low).max())
    edge = edge if edge > 0 else 1.0
    return (low + high) / 2 - edge / 2, edge


def relative_size(source: Shape, target: Shape, there: VertexMap) -> float:
    """Length on the target of what has length 1 on the source.

    Compares short distances, which a pose hardly changes, where the map is confident, without those that it
    has torn; 1 where no pair of vertices tells.
    """
    if source.is_cloud:
        some = np.arange(source.V)[:: max(1, source.V // _PAIRS)]
        near = cKDTree(source.verts).query(source.verts[some], k=min(9, source.V))[1].reshape(len(some), -1)
        pairs = np.stack([some, near[:, -1]], axis=1)
    else:
        pairs = edges_of(source.faces).vertices
        pairs = pairs[:: max(1, len(pairs) // _PAIRS)]
    points = there.points(target)
    own = np.linalg.norm(source.verts[pairs[:, 0]] - source.verts[pairs[:, 1]], axis=1)
    image = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    sure = there.confidence[pairs].min(axis=1) * (image <= np.quantile(image, 0.95))
    lengths = float(sure @ own), float(sure @ image)
    return lengths[1] / lengths[0] if min(lengths) > 0 else 1.0


def upright(
    source: Shape, target: Shape, there: VertexMap, given: tuple[Floats | None, Floats | None] = (None, None)
) -> tuple[Floats, Floats]:
    """Rotations (3, 3) of both shapes to y up, z front.

    The source's is guessed unless it is given. The target's, unless it is given, shows matched points from the same
    side; with a poor map it is that of the source.
    """
    own = np.asarray(given[0] if given[0] is not None else facing(source), np.float64)
    if given[1] is not None:
        return own, np.asarray(given[1], np.float64)
    known = np.ones(source.V, bool) if source.invalid is None else ~source.invalid
    if there.verdict == "poor" or not known.any():
        return own, own
    return own, facing_alike(target, there.points(target)[known], source.verts[known] @ own.T)


def levelled(shape: Shape, rotation: Floats) -> Floats:
    """A fit's rotation (3, 3), which has the trunk upright, so that a shape that stands stays on its ground."""
    return facing_alike(shape, shape.verts, shape.verts @ rotation.T)
