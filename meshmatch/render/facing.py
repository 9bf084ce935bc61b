"""Guess which way is up and which side is the front, where the user does not say.

A shape that is tall and would not fall over stands on its feet: its chest gives the lateral axis, its feet the front. Any
other shape stands on the axis that usually points up in modelling programs, with a broad side to the viewer.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

Rotation = Float[Floats, "3 3"]
Direction = Float[Floats, " 3"]
Points = Float[Floats, "N 3"]
Rotations = tuple[Rotation | None, Rotation | None]
"""Of source and target, into y up and z to the viewer; None where unknown."""

_AXES = {sign + name: (-1.0 if sign else 1.0) * np.eye(3)[k] for k, name in enumerate("xyz") for sign in ("", "-")}
_MAX_POINTS = 20_000  # larger shapes are thinned out to this
# Lengths in units of sqrt(area), tuned on bodies in many poses, quadrupeds and furniture.
_MIN_HEIGHT = 1.05  # of a standing body
_MIN_SUPPORT = -0.03  # of the center of mass, negative outside the feet: scans are cut off
_MIN_SUPPORT_USUAL = -0.2  # where y or z points up, the usual axes: people lean while they move
_SOLE_HEIGHT = 0.035  # points up to this height above the lowest one carry the shape
_NEAR_AXIS = np.cos(np.radians(35.0))
_TORSO_RADIUS = 0.2  # half width of the chest without arms


def guess_rotation(shape: Shape, up: str | None = None, front: str | None = None) -> Rotation:
    """Rotation into y up, z to the front, by named axes of the file; axes that are not named are guessed. `OptionError` for
    an axis other than x, y, z, -x, -y, -z, or the same axis twice.
    """
    axes = {name: axis.lstrip("+").lower() for name, axis in (("up", up), ("front", front)) if axis is not None}
    for name, axis in axes.items():
        if axis not in _AXES:
            raise OptionError(f"{name}: invalid axis '{axis}'", f"choose from {', '.join(_AXES)}")
    ahead = _AXES[axes["front"]] if front is not None else None
    points, weights = _surface_samples(shape)
    upward, stands = (_AXES[axes["up"]], False) if up is not None else _guess_up(points, ahead)
    if ahead is None and stands:
        ahead = _guess_front(points, weights, upward)
    if ahead is None:
        extents = np.ptp(points, axis=0)
        free = [k for k in range(3) if upward[k] == 0]
        ahead = np.eye(3)[min(free, key=lambda k: extents[k])]
    if abs(upward @ ahead) > 1e-6:
        raise OptionError(f"up and front are the same axis: '{up}' and '{front}'")
    return np.stack([np.cross(upward, ahead), upward, ahead])


def snap_upright(rotation: Rotation) -> Rotation:
    """The rotation with its up direction snapped to an axis of the file, if one is near. The frame of a fit follows the
    torso, which may lean, but files nearly always have an axis that points up.
    """
    axis = int(np.abs(rotation[1]).argmax())
    upward = np.sign(rotation[1, axis]) * np.eye(3)[axis]
    return rotation if rotation[1] @ upward < _NEAR_AXIS else _rotation_from(upward, rotation[2])


def rotations_to_same_side(
    source: Shape,
    target: Shape,
    vertex_map: VertexMap,
    rotations: Rotations = (None, None),
    up: str | None = None,
    front: str | None = None,
) -> tuple[Rotation, Rotation]:
    """Rotations of source and target into y up, z to the viewer that show both from the same side.

    Rotations of fits (`Frame.rotation`) are used if known; else the named axes; else the source's follows from its own
    shape, and the target's from the map.
    """
    first, second = (None if rotation is None else snap_upright(rotation) for rotation in rotations)
    if first is None:
        first = guess_rotation(source, up, front)
    if second is None:
        named = up is not None or front is not None
        second = guess_rotation(target, up, front) if named else rotation_by_map(source, target, vertex_map, first)
    return first, second


def rotation_by_map(source: Shape, target: Shape, vertex_map: VertexMap, rotation: Rotation) -> Rotation:
    """Rotation that shows the target from the side from which ``rotation`` shows the source; ``rotation`` if unknown."""
    known = source.valid
    if not known.any():
        return rotation
    points, seen = vertex_map.points(target)[known], source.verts[known] @ rotation.T
    normals = None
    if not (source.is_cloud or target.is_cloud):
        there = target.vertex_normals[vertex_map.index[known]]
        normals = there, source.vertex_normals[known] @ rotation.T
    # Weighted by area: otherwise hands, where vertices are dense, would outweigh the trunk.
    return rotation_like(target, points, seen, source.vertex_areas[known], normals)


def rotation_like(
    shape: Shape,
    points: Points,
    seen: Points,
    weights: Float[Floats, " N"] | None = None,
    normals: tuple[Points, Points] | None = None,
) -> Rotation:
    """Rotation that shows a shape from the side from which another one is seen; upright, if the shape stands by itself.

    ``points`` are of this shape, in its file's frame; ``seen`` are the corresponding points of the other one, y up and z to
    the viewer, with ``weights``. Where ``normals`` of both are known these decide: a raised arm has normals on all sides,
    while its positions would turn a body around.
    """
    weights = (
        np.full(len(points), 1 / len(points)) if weights is None or not weights.sum() > 0 else weights / weights.sum()
    )
    a, b = (each - np.average(each, axis=0, weights=weights) for each in (points, seen))
    correlation = (b * weights[:, None]).T @ a
    sizes = np.linalg.svd(correlation, compute_uv=False)
    if not sizes[1] > 1e-9 * sizes[0]:  # everything was matched to a line or a point
        return guess_rotation(shape)
    if normals is None:
        turn = _nearest_rotation(correlation)
    else:
        sides = (normals[1] * weights[:, None]).T @ normals[0]
        # one of the two meshes may be inside out
        turn = max(
            (_nearest_rotation(each) for each in (sides, -sides)), key=lambda found: float((found * correlation).sum())
        )
    upward, stands = _guess_up(_surface_samples(shape)[0], None)
    return _rotation_from(upward, turn[2]) if stands and upward @ turn[1] >= 0.5 else np.asarray(turn)


def _nearest_rotation(matrix: Float[Floats, "3 3"]) -> Rotation:
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right)) or 1.0]) @ right)


def _rotation_from(upward: Direction, ahead: Direction) -> Rotation:
    """The rotation whose y is ``upward`` and whose z is nearest to ``ahead``."""
    ahead = ahead - (ahead @ upward) * upward
    ahead = ahead / np.linalg.norm(ahead)
    return np.stack([np.cross(upward, ahead), upward, ahead])


def _surface_samples(shape: Shape) -> tuple[Points, Float[Floats, " N"]]:
    """Points all over the surface, centred, in units of sqrt(area), and each one's share of the area."""
    if shape.is_cloud:
        points = shape.verts[shape.valid]
        weights = np.ones(len(points))
    else:
        points, weights = shape.verts[shape.faces].mean(axis=1), shape.face_areas
        points, weights = points[weights > 0], weights[weights > 0]
    if len(points) == 0:
        points, weights = shape.verts, np.ones(shape.V)
    step = -(-len(points) // _MAX_POINTS)
    points, weights = points[::step], weights[::step]
    unit = np.sqrt(shape.area) if shape.area > 0 else float(np.ptp(points, axis=0).max()) or 1.0
    return (points - np.average(points, axis=0, weights=weights)) / unit, weights / weights.sum()


def _guess_up(points: Points, ahead: Direction | None) -> tuple[Direction, bool]:
    """The axis that points up, and whether the shape stands on it by itself."""
    extents = np.ptp(points, axis=0)
    free = [k for k in range(3) if ahead is None or ahead[k] == 0]
    for axis in sorted(free, key=lambda k: -extents[k] * (1.1 if k == 1 else 1.0)):
        for sign in (1.0, -1.0):
            minimum = _MIN_SUPPORT_USUAL if sign > 0 and axis != 0 else _MIN_SUPPORT
            if extents[axis] >= _MIN_HEIGHT and _support(points, sign * np.eye(3)[axis]) > minimum:
                return sign * np.eye(3)[axis], True
    usual = {1: 0.1, 2: 0.0, 0: -0.4}
    score = {k: usual[k] + 0.3 * extents[k] + float(np.clip(_support(points, np.eye(3)[k]), -0.3, 0.15)) for k in free}
    return np.eye(3)[max(free, key=lambda k: score[k])], False


def _support(points: Points, upward: Direction) -> float:
    """Distance of the center of mass from the border of the footprint: positive inside, negative outside."""
    from scipy.spatial import ConvexHull, QhullError

    height = points @ upward
    sole = points[height < height.min() + _SOLE_HEIGHT][:, upward == 0]
    try:
        hull = ConvexHull(sole)
    except (QhullError, ValueError):  # a point, or a line
        return -1.0
    return float(-hull.equations[:, 2].max())


def _guess_front(points: Points, weights: Float[Floats, " N"], upward: Direction) -> Direction | None:
    """Unit vector to the front of a standing body, by its chest and feet; None if its chest is round."""
    level = np.flatnonzero(upward == 0)
    height = points @ upward
    share = (height - height.min()) / np.ptp(height)
    flat = points[:, level]
    chest = (share > 0.5) & (share < 0.8)
    if chest.sum() >= 20:
        chest &= np.linalg.norm(flat - np.median(flat[chest], axis=0), axis=1) < _TORSO_RADIUS
    if chest.sum() < 20:
        return None
    spread, axes = np.linalg.eigh(np.cov(flat[chest].T, aweights=weights[chest]))
    if spread[1] < 1.25 * spread[0]:
        return None
    ahead = np.zeros(3)
    ahead[level] = axes[:, 0]
    feet, shins = share < 0.035, (share > 0.05) & (share < 0.12)
    if feet.any() and shins.any():
        forward = np.average(points[feet], axis=0, weights=weights[feet])
        forward = forward - np.average(points[shins], axis=0, weights=weights[shins])
        if abs(forward @ ahead) > 0.006:
            return ahead * np.sign(forward @ ahead)
    return ahead * (np.sign(ahead[np.abs(ahead).argmax()]) or 1.0)
