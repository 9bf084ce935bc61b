"""Rigid motions of one set of oriented points onto another by iterative closest points, from many starts at once.

Both sets look for their closest, normals included, with robust weights (Besl and McKay 1992; Geman and McClure). All starts
take a step together: what they ask is asked at once, and NumPy is called a few times rather than for each.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints, nearest, with_normals

# Set by hand, in units of sqrt(area): the scale of robust weights, and the distance from which on a point counts as far.
_SCALE, _CAP = 0.1, 0.2
_STILL = 1e-4  # a step that changes no entry of a pose by more is the last one


class ClosestPoints:
    """Two sets of points, both about their middles; poses are those of the target: the shape is near ``to_world(target)``.

    Of both, points whose numbers are in ``asking`` look for their closest among all of the other; all of them without it.
    """

    def __init__(
        self,
        shape: OrientedPoints,
        target: OrientedPoints,
        asking: tuple[Int[Ints, " P"], Int[Ints, " Q"]] | None = None,
    ) -> None:
        self._shape, self._target = shape, target
        self._features = shape.features, target.features
        self._own, self._other = (shape, target) if asking is None else (shape.rows(asking[0]), target.rows(asking[1]))

    def _asked(
        self, turns: Float[Floats, "N 3 3"], centers: Float[Floats, "N 3"]
    ) -> tuple[Float[Floats, "N P 6"], Float[Floats, "N Q 6"]]:
        """Points of the shape in each pose, and of the target in the world: what asks is moved, and not what is asked."""
        (own, other), back = (self._own, self._other), turns.transpose(0, 2, 1)
        here = with_normals((own.points - centers[:, None]) @ turns, own.normals @ turns)
        return here, with_normals(other.points @ back + centers[:, None], other.normals @ back)

    def _closest(
        self, here: Float[Floats, "N P 6"], there: Float[Floats, "N Q 6"]
    ) -> tuple[Int[Ints, "N P"], Int[Ints, "N Q"]]:
        """Of points of the shape those of the target that are closest, and the other way around."""
        to_target = nearest(self._features[1], here.reshape(-1, 6)).reshape(here.shape[:2])
        return to_target, nearest(self._features[0], there.reshape(-1, 6)).reshape(there.shape[:2])

    def residuals(self, poses: list[RigidPose]) -> Float[Floats, " N"]:
        """Mean capped distance there and back in each pose, normals included."""
        here, there = self._asked(*_stacked(poses))
        to_target, to_shape = self._closest(here, there)
        far = np.linalg.norm(here - self._features[1][to_target], axis=2)
        back = np.linalg.norm(there - self._features[0][to_shape], axis=2)
        return np.asarray(0.5 * np.minimum(far, _CAP).mean(1) + 0.5 * np.minimum(back, _CAP).mean(1))

    def nearer(self, poses: list[RigidPose], steps: int) -> list[RigidPose]:
        """Poses after some steps from others, or fewer where they stand still before."""
        turns, centers = _stacked(poses)
        own, other, going = self._own, self._other, np.arange(len(poses))
        weight = np.repeat([1 / len(own.points), 1 / len(other.points)], [len(own.points), len(other.points)])
        for _ in range(steps):
            R, c = turns[going], centers[going]
            to_target, to_shape = self._closest(*self._asked(R, c))
            here, there = (np.broadcast_to(each.points, (len(R), *each.points.shape)) for each in (own, other))
            source = np.concatenate([self._target.points[to_target], there], 1)
            place = (np.concatenate([here, self._shape.points[to_shape]], 1) - c[:, None]) @ R
            off = np.square(source - place).sum(2)
            turn, shift = _motions(source, place, weight / np.square(1.0 + off / _SCALE**2))
            turns[going], centers[going] = R @ turn, (R @ shift[..., None])[..., 0] + c
            moves = np.maximum(np.abs(turn - np.eye(3)).max((1, 2)), np.abs(shift).max(1))
            going = going[moves >= _STILL]
            if not len(going):
                break
        return [RigidPose(*pose) for pose in zip(turns, centers, strict=True)]


def _stacked(poses: list[RigidPose]) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"]]:
    return np.array([pose.rotation for pose in poses]), np.array([pose.center for pose in poses])


def _motions(
    source: Float[Floats, "N P 3"], place: Float[Floats, "N P 3"], weights: Float[Floats, "N P"]
) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"]]:
    """As `meshmatch.geometry.frames.kabsch`, of many."""
    weights = (weights / np.maximum(weights.sum(1, keepdims=True), 1e-30))[:, None]
    a, b = weights @ source, weights @ place
    spread = (place - b).transpose(0, 2, 1) @ (weights.transpose(0, 2, 1) * (source - a))
    U, _, Vh = np.linalg.svd(spread)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vh))[:, None]
    R = U @ Vh
    return R, (b - a @ R.transpose(0, 2, 1))[:, 0]
