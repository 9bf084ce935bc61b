"""Position, size, unit and orientation: normalising frames, guesses at what files do not specify, and rigid alignment.

Alignment of sampled shapes is by iterative closest points (Besl and McKay 1992) with normals, in both directions and
with robust weights. It finds the nearest minimum, so a search starts from many rotations: the 24 rotations of a cube
about the axes of the files, and about the principal axes of both shapes. If several fit nearly as well, the orientation
of the file is preferred.
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
"""Whether to try the mirror image of a shape as well."""

# Set by hand.
# maximum residual of a rotation that replaces the given orientation, relative to the latter's
_MAX_RESIDUAL_RATIO = 0.9
_N_PLACES = 8  # places of a part's center on its whole from which an alignment starts
_MIN_ANGLE = 15.0  # alignments closer than this, in degrees, are treated as one
# Height of standing people in metres; a unit is plausible if it brings the longest extent into this range.
_MIN_HEIGHT, _MAX_HEIGHT = 1.2, 2.2
_MIN_SLENDERNESS = 1.0  # minimum longest extent of a person in sqrt(area): 1.1 to 1.7 in any pose
_MAX_ROUNDING = 1e-6  # maximum effect of rounding, as a fraction of the diagonal
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001, "inches": 0.0254, "feet": 0.3048}


def sqrt_area_frame(shape: Shape) -> Frame:
    """The frame with the area-weighted centroid at 0 and a surface area of 1, without rotation.

    Area hardly changes with pose, unlike a bounding sphere. `InputError` if the shape has no area: all its vertices lie
    in a point or on a line.
    """
    area = shape.area
    if not area > (1e-9 * shape.diagonal) ** 2:
        nothing = f"{shape.name or 'the shape'} has no surface area"
        raise InputError(nothing, "all its vertices lie in a point or a line")
    return Frame(float(np.sqrt(area)), np.eye(3), _centroid(shape))


def unit_sphere_frame(shape: Shape) -> Frame:
    """The frame with the area-weighted centroid at 0 and the farthest vertex at distance 1, without rotation.

    `InputError` if all vertices lie in one point.
    """
    center = _centroid(shape) if shape.area > 0 else shape.bounds.mean(axis=0)
    radius = float(np.sqrt(np.nanmax(((shape.verts_or_nan - center) ** 2).sum(axis=1))))
    if not radius > 0:
        raise InputError(f"{shape.name or 'the shape'} has no size", "all its vertices lie in one point")
    return Frame(radius, np.eye(3), center)


@derived
def in_single_precision(shape: Shape) -> Shape:
    """The shape rounded to single precision, as many formats store it.

    It is then fitted in the same way from any file: two interpretations of a pose may fit so nearly alike that rounding
    decides between them. Shapes far from the origin, which rounding would change noticeably, are returned unchanged.
    """
    with np.errstate(over="ignore"):  # values beyond single precision become infinite
        verts = shape.verts.astype(np.float32).astype(np.float64)
    moved = float(np.abs(verts - shape.verts).max())
    return replace(shape, verts=verts) if 0 < moved < _MAX_ROUNDING * shape.diagonal else shape


def _centroid(shape: Shape) -> Floats:
    """(3,) area-weighted centroid; exact for a mesh, where each vertex has a third of the area of its faces."""
    return np.asarray(shape.vertex_areas @ shape.verts / shape.vertex_areas.sum())


def long_axis(shape: Shape) -> str | None:
    """The axis along which the shape is clearly longest, "x", "y" or "z"; None if there is none.

    Shapes are usually longest along their up axis or their back; extents do not determine its sign.
    """
    extents = shape.bounds[1] - shape.bounds[0]
    order = extents.argsort()
    return None if extents[order[2]] < 1.15 * extents[order[1]] else "xyz"[int(order[2])]


def guess_unit(shape: Shape) -> str | None:
    """The unit in which the shape is as long as a standing person; None if there is none, or its area is too large."""
    length = float((shape.bounds[1] - shape.bounds[0]).max())
    if not shape.is_cloud and length < _MIN_SLENDERNESS * np.sqrt(shape.area):
        return None
    return next((name for name, metres in _UNITS.items() if _MIN_HEIGHT <= length * metres <= _MAX_HEIGHT), None)


@dataclass(frozen=True, eq=False)
class Alignment:
    """An alignment: shape = pose.to_world(target), as in a core frame.

    Its residual is the mean capped distance in both directions, normals included.
    """

    pose: RigidPose
    residual: float


def align(shape: OrientedPoints, target: OrientedPoints, how: Align, keep: int = 1) -> list[Alignment]:
    """Rigid motions that align a target with a shape, the best first: at most `keep` for "rigid", one otherwise.

    Both are centred and have one scale, and their points are in random order. "none" keeps the orientation, "near"
    refines it, "rigid" searches all orientations.
    """
    coarse = ClosestPoints(shape.thinned(200), target.thinned(300))
    fine = ClosestPoints(shape.thinned(1200), target.thinned(1200))
    unrotated = RigidPose.identity()
    if how != "rigid":
        return _refine(fine, [unrotated], 25 if how == "near" else 0)
    # the 24 rotations of a cube, about the files' axes and about the principal axes of both
    rotations = Rotation.create_group("O").as_matrix()
    shape_axes, target_axes = _principal_axes(shape.points), _principal_axes(target.points)
    starts = [
        RigidPose(start, np.zeros(3))
        for start in (*rotations, *(shape_axes @ turn @ target_axes.T for turn in rotations))
    ]
    chosen = _distinct(_best_first(_refine(coarse, starts, 6)))[: max(keep, 4)]
    unrotated_fit, *candidates = _refine(fine, [unrotated, *(each.pose for each in chosen)], 25)
    candidates = _best_first(candidates)
    candidates.insert(
        0 if candidates[0].residual > _MAX_RESIDUAL_RATIO * unrotated_fit.residual else len(candidates), unrotated_fit
    )
    return _distinct(candidates)[:keep]


def align_part(shape: OrientedPoints, target: OrientedPoints, keep: int = 1) -> list[Alignment]:
    """Rigid motions that align a target with a shape that is a part of it, the best first: at most ``keep``.

    Both have one scale, and their points are in random order. The part is rotated by the 24 rotations of a cube, and its
    center is put onto places all over the target; residuals are those of the part's points alone.
    """
    from scipy.cluster.vq import kmeans2  # slow to import, and only parts need it

    coarse = ClosestPoints(shape.thinned(200), target.thinned(300), partial=True)
    fine = ClosestPoints(shape.thinned(1200), target.thinned(1200), partial=True)
    center, places = shape.points.mean(0), kmeans2(target.points, _N_PLACES, seed=0, minit="++")[0]
    rotations = Rotation.create_group("O").as_matrix()
    starts = [RigidPose(turn, center - turn @ place) for turn in rotations for place in places]
    chosen = _best_first(_refine(coarse, starts, 6))[: 4 * keep]
    return _best_first(_refine(fine, [each.pose for each in chosen], 25))[:keep]


def _refine(points: ClosestPoints, poses: list[RigidPose], steps: int) -> list[Alignment]:
    nearer = points.nearer(poses, steps)
    return [Alignment(*each) for each in zip(nearer, points.residuals(nearer).tolist(), strict=True)]


def _best_first(alignments: list[Alignment]) -> list[Alignment]:
    return sorted(alignments, key=attrgetter("residual"))


def _distinct(alignments: list[Alignment]) -> list[Alignment]:
    """The alignments that are not close to an earlier one."""
    distinct: list[Alignment] = []
    for each in alignments:
        if all(each.pose.angle_to(other.pose) > _MIN_ANGLE for other in distinct):
            distinct.append(each)
    return distinct


def alignment_residual(shape: OrientedPoints, target: OrientedPoints) -> float:
    """Mean capped six-dimensional nearest distance in both directions, for the current positions."""
    return float(ClosestPoints(shape, target).residuals([RigidPose.identity()])[0])


def _principal_axes(points: Floats) -> Floats:
    axes = np.linalg.eigh(np.cov(points.T))[1]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)
