"""Position, size, unit and orientation: frames that bring every shape to one size, guesses at what its file does not
say, and rigid alignment of one sampled shape to another: from the orientation that is given, or from any.

The alignment is by iterative closest points (Besl and McKay 1992) with normals, both ways and with robust weights. It
finds the nearest minimum, so a search begins from many turns: the axes of both files, and the principal axes of both
shapes, in all 24 ways. Where several fit nearly as well, the orientation that the file has is believed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Floats
from meshmatch.derived import derived
from meshmatch.errors import InputError
from meshmatch.geometry.closest_points import ClosestPoints
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.shape import Shape

Align = Literal["none", "near", "rigid"]
ALIGNS: tuple[Align, ...] = get_args(Align)
Mirroring = Literal["auto", "no"]
"""Whether the mirror image of a shape is tried too."""

# Set by hand.
_CLEARLY = 0.9  # a turn must fit better than the given orientation by this factor
_CLOSE = 15.0  # degrees: two alignments nearer than that are one
# Standing people are 1.2 to 2.2 m tall; a unit fits if it makes that of the longest extent.
_SMALL, _TALL = 1.2, 2.2
_SLENDER = 1.0  # longest extent in roots of the area; of people 1.1 to 1.7, however they stand
_FINE = 1e-6  # of the diagonal: what rounding may move
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
    radius = float(np.sqrt(np.nanmax(((shape.verts_or_nan - center) ** 2).sum(axis=1))))
    if not radius > 0:
        raise InputError(f"{shape.name or 'the shape'} has no size", "all its vertices lie in one point")
    return Frame(radius, np.eye(3), center)


@derived
def in_single_precision(shape: Shape) -> Shape:
    """A shape as formats of single precision hold it: two interpretations of a pose may fit so nearly alike that less
    decides between them, and a shape is to be fitted the same from any file. One far from the origin stays as it is.
    """
    with np.errstate(over="ignore"):  # what is larger than single precision holds moves without end
        verts = shape.verts.astype(np.float32).astype(np.float64)
    moved = float(np.abs(verts - shape.verts).max())
    return replace(shape, verts=verts) if 0 < moved < _FINE * shape.diagonal else shape


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
    """The unit in which the shape would be as long as a standing person; None if there is none, or its surface is too
    large for one.
    """
    length = float((shape.bounds[1] - shape.bounds[0]).max())
    if not shape.is_cloud and length < _SLENDER * np.sqrt(shape.area):
        return None
    return next((name for name, metres in _UNITS.items() if _SMALL <= length * metres <= _TALL), None)


@dataclass(frozen=True, eq=False)
class Alignment:
    """shape = pose.to_world(target), as in a core frame; residual: mean capped distance both ways, normals included."""

    pose: RigidPose
    residual: float


def align(shape: OrientedPoints, target: OrientedPoints, how: Align, keep: int = 1) -> list[Alignment]:
    """Rigid motions that bring a target onto a shape, the best one first; at most `keep`, and one but for "rigid".

    Both are centered, of one scale, their points in random order. "none" takes the orientation as it is, "near"
    improves it, "rigid" searches all orientations.
    """
    coarse = ClosestPoints(shape.thinned(200), target.thinned(300))
    fine = ClosestPoints(shape.thinned(1200), target.thinned(1200))
    as_it_is = RigidPose.identity()
    if how != "rigid":
        return _nearer(fine, [as_it_is], 25 if how == "near" else 0)
    # the 24 turns of a cube in the files' own axes, and in the principal axes of both
    turns = Rotation.create_group("O").as_matrix()
    own, theirs = _principal_axes(shape.points), _principal_axes(target.points)
    starts = [RigidPose(start, np.zeros(3)) for start in (*turns, *(own @ turn @ theirs.T for turn in turns))]
    chosen = _distinct(_best_first(_nearer(coarse, starts, 6)))[: max(keep, 4)]
    given, *found = _nearer(fine, [as_it_is, *(each.pose for each in chosen)], 25)
    found = _best_first(found)
    found.insert(0 if found[0].residual > _CLEARLY * given.residual else len(found), given)
    return _distinct(found)[:keep]


def _nearer(points: ClosestPoints, poses: list[RigidPose], steps: int) -> list[Alignment]:
    nearer = points.nearer(poses, steps)
    return [Alignment(*each) for each in zip(nearer, points.residuals(nearer).tolist(), strict=True)]


def _best_first(found: list[Alignment]) -> list[Alignment]:
    return sorted(found, key=attrgetter("residual"))


def _distinct(found: list[Alignment]) -> list[Alignment]:
    """Those that are not near an earlier one."""
    distinct: list[Alignment] = []
    for each in found:
        if all(each.pose.angle_to(other.pose) > _CLOSE for other in distinct):
            distinct.append(each)
    return distinct


def residual(shape: OrientedPoints, target: OrientedPoints) -> float:
    """Mean of the capped six-dimensional nearest distances, one way and back; of where both lie."""
    return float(ClosestPoints(shape, target).residuals([RigidPose.identity()])[0])


def _principal_axes(points: Floats) -> Floats:
    axes = np.linalg.eigh(np.cov(points.T))[1]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)
