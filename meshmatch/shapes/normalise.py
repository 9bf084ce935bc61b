"""Frames that bring every shape to one position and size, whatever its unit."""

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.shape import Shape


def sqrt_area_frame(shape: Shape) -> Frame:
    """The frame with the area-weighted centroid at 0 and a surface area of 1.

    Area hardly changes with pose, where a bounding sphere does. A cloud's area and centroid come from
    `meshmatch.shapes.cloud.local_areas`. No rotation.

    Raises
    ------
    InputError
        The shape has no area: all vertices in a point or on a line.
    """
    area = shape.area
    if not area > (1e-9 * shape.diagonal) ** 2:
        raise InputError(
            f"{shape.name or 'the shape'} has no surface area", "all its vertices lie in a point or a line"
        )
    return Frame(float(np.sqrt(area)), np.eye(3), _centroid(shape))


def unit_sphere_frame(shape: Shape) -> Frame:
    """The frame with the area-weighted centroid at 0 and the furthest vertex at distance 1. No rotation.

    Raises
    ------
    InputError
        All vertices lie in one point.
    """
    center = _centroid(shape) if shape.area > 0 else shape.bounds.mean(axis=0)
    valid = shape.verts if shape.invalid is None else shape.verts[~shape.invalid]
    radius = float(np.sqrt(((valid - center) ** 2).sum(axis=1).max()))
    if not radius > 0:
        raise InputError(f"{shape.name or 'the shape'} has no size", "all its vertices lie in one point")
    return Frame(radius, np.eye(3), center)


def _centroid(shape: Shape) -> Floats:
    """(3,) area-weighted centroid; exact for a mesh: around a vertex lies a third of each of its faces."""
    return np.asarray(shape.vertex_areas @ shape.verts / shape.vertex_areas.sum())
