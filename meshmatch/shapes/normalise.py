"""Position, size and unit: frames that bring every shape to one size, and guesses at what its file does not say."""

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.shape import Shape

# Standing people are 1.2 to 2.2 m tall; a unit fits if it makes that of the longest extent.
_SMALL, _TALL = 1.2, 2.2
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "feet": 0.3048}


def sqrt_area_frame(shape: Shape) -> Frame:
    """The frame with the area-weighted centroid at 0 and a surface area of 1, without rotation.

    Area hardly changes with pose, where a bounding sphere does. `InputError` if the shape has no area: all its
    vertices lie in a point or on a line.
    """
    area = shape.area
    if not area > (1e-9 * shape.diagonal) ** 2:
        nothing = f"{shape.name or 'the shape'} has no surface area"
        raise InputError(nothing, "all its vertices lie in a point or a line")
    return Frame(float(np.sqrt(area)), np.eye(3), _centroid(shape))


def unit_sphere_frame(shape: Shape) -> Frame:
    """The frame with the area-weighted centroid at 0 and the furthest vertex at distance 1, without rotation.

    `InputError` if all vertices lie in one point.
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


def long_axis(shape: Shape) -> str | None:
    """The axis along which the shape is clearly longest, "x", "y" or "z"; None if none is.

    Whatever stands or lies is longest along its up axis or its back; the sign cannot be told from extents.
    """
    extents = shape.bounds[1] - shape.bounds[0]
    order = extents.argsort()
    return None if extents[order[2]] < 1.15 * extents[order[1]] else "xyz"[int(order[2])]


def guess_unit(shape: Shape) -> str | None:
    """The unit in which the shape would be as long as a standing person; None if there is none."""
    length = float((shape.bounds[1] - shape.bounds[0]).max())
    return next((name for name, metres in _UNITS.items() if _SMALL <= length * metres <= _TALL), None)
