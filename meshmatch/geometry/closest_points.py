"""Rigid registration of oriented point sets by iterative closest points (ICP), from many starts at once.

Correspondences run both ways and compare normals too, with robust weights (Besl and McKay 1992; Geman and McClure). All
starts take each step together, so that one query and a few NumPy calls serve all of them.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.frames import RigidPose
from meshmatch.geometry.oriented import OrientedPoints, nearest_by_brute_force, with_normals

# Set by hand, in units of sqrt(area): scale of the robust weights, and the distance at which residuals are capped.
_ROBUST_SCALE, _MAX_DISTANCE = 0.1, 0.2
_POSE_TOLERANCE = 1e-4  # iteration stops once no entry of a pose changes by more


class ClosestPoints:
    """Two centred point sets. Poses are those of the target: ``pose.to_world(target)`` approximates the shape.

    ``queries`` are the rows of the shape and of the target that search for their closest point among all points of the
    other set; by default all rows. If the shape is a part of the target (``partial``), only its points search.
    """

    def __init__(
        self,
        shape: OrientedPoints,
        target: OrientedPoints,
        queries: tuple[Int[Ints, " P"], Int[Ints, " Q"]] | None = None,
        partial: bool = False,
    ) -> None:
        self._shape, self._target = shape, target
        self._features = shape.features, target.features
        self._shape_queries, self._target_queries = (
            (shape, target) if queries is None else (shape.rows(queries[0]), target.rows(queries[1]))
        )
        self._shares = (1.0, 0.0) if partial else (0.5, 0.5)  # weights of the two directions

    def _transformed_queries(
        self, turns: Float[Floats, "N 3 3"], centers: Float[Floats, "N 3"]
    ) -> tuple[Float[Floats, "N P 6"], Float[Floats, "N Q 6"]]:
        """Query points of the shape in each pose's local frame, and query points of the target in the world frame.

        The queries are transformed rather than the sets they search, so that the search structures stay valid.
        """
        (shape_queries, target_queries), inverse = (self._shape_queries, self._target_queries), turns.transpose(0, 2, 1)
        shape_local = with_normals((shape_queries.points - centers[:, None]) @ turns, shape_queries.normals @ turns)
        return shape_local, with_normals(
            target_queries.points @ inverse + centers[:, None], target_queries.normals @ inverse
        )

    def _correspondences(
        self, shape_local: Float[Floats, "N P 6"], target_world: Float[Floats, "N Q 6"]
    ) -> tuple[Int[Ints, "N P"], Int[Ints, "N Q"]]:
        """Indices of the target points closest to the shape's queries, and of the shape points closest to the target's."""
        to_target = nearest_by_brute_force(self._features[1], shape_local.reshape(-1, 6)).reshape(shape_local.shape[:2])
        return to_target, nearest_by_brute_force(self._features[0], target_world.reshape(-1, 6)).reshape(
            target_world.shape[:2]
        )

    def residuals(self, poses: list[RigidPose]) -> Float[Floats, " N"]:
        """Mean capped distance both ways for each pose, normals included."""
        shape_local, target_world = self._transformed_queries(*_stack_poses(poses))
        to_target, to_shape = self._correspondences(shape_local, target_world)
        forward = np.linalg.norm(shape_local - self._features[1][to_target], axis=2)
        backward = np.linalg.norm(target_world - self._features[0][to_shape], axis=2)
        return np.asarray(
            self._shares[0] * np.minimum(forward, _MAX_DISTANCE).mean(1)
            + self._shares[1] * np.minimum(backward, _MAX_DISTANCE).mean(1)
        )

    def nearer(self, poses: list[RigidPose], steps: int) -> list[RigidPose]:
        """Poses after at most ``steps`` iterations from the given ones; converged poses stop early."""
        turns, centers = _stack_poses(poses)
        shape_queries, target_queries, active = self._shape_queries, self._target_queries, np.arange(len(poses))
        weight = np.repeat(
            [self._shares[0] / len(shape_queries.points), self._shares[1] / len(target_queries.points)],
            [len(shape_queries.points), len(target_queries.points)],
        )
        for _ in range(steps):
            R, c = turns[active], centers[active]
            to_target, to_shape = self._correspondences(*self._transformed_queries(R, c))
            shape_points, target_points = (
                np.broadcast_to(each.points, (len(R), *each.points.shape)) for each in (shape_queries, target_queries)
            )
            source = np.concatenate([self._target.points[to_target], target_points], 1)
            destination = (np.concatenate([shape_points, self._shape.points[to_shape]], 1) - c[:, None]) @ R
            squared = np.square(source - destination).sum(2)
            turn, shift = _kabsch_batch(source, destination, weight / np.square(1.0 + squared / _ROBUST_SCALE**2))
            turns[active], centers[active] = R @ turn, (R @ shift[..., None])[..., 0] + c
            moves = np.maximum(np.abs(turn - np.eye(3)).max((1, 2)), np.abs(shift).max(1))
            active = active[moves >= _POSE_TOLERANCE]
            if not len(active):
                break
        return [RigidPose(*pose) for pose in zip(turns, centers, strict=True)]


def _stack_poses(poses: list[RigidPose]) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"]]:
    return np.array([pose.rotation for pose in poses]), np.array([pose.center for pose in poses])


def _kabsch_batch(
    source: Float[Floats, "N P 3"], place: Float[Floats, "N P 3"], weights: Float[Floats, "N P"]
) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"]]:
    """Rotations and translations of N weighted point sets, as by `meshmatch.geometry.frames.kabsch`."""
    weights = (weights / np.maximum(weights.sum(1, keepdims=True), 1e-30))[:, None]
    a, b = weights @ source, weights @ place
    spread = (place - b).transpose(0, 2, 1) @ (weights.transpose(0, 2, 1) * (source - a))
    U, _, Vh = np.linalg.svd(spread)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vh))[:, None]
    R = U @ Vh
    return R, (b - a @ R.transpose(0, 2, 1))[:, 0]
