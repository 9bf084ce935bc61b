"""Similarities between coordinate systems, rigid poses, and the least-squares rigid motion between point sets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats, PickledFields, ShortRepr, as_numbers, as_read_only, to_numpy
from meshmatch.errors import InputError


@dataclass(frozen=True, eq=False, repr=False)
class Frame(ShortRepr, PickledFields):
    """A similarity between a file's coordinates and a model's.

    It contains a reflection for a shape that is fitted in mirror image.

    Attributes
    ----------
    scale
        Length of one model unit, in the unit of the file.
    rotation
        (3, 3) acts on column vectors; its determinant is -1 for a reflection.
    center
        (3,) the model's origin, in the file's coordinates.

    Examples
    --------
    >>> frame = meshmatch.Frame(2.0, np.eye(3), np.zeros(3))
    >>> frame.apply([[2.0, 0.0, 0.0]])  # (1, 3): one model unit along x
    >>> frame.undo(frame.apply([[2.0, 0.0, 0.0]]))
    """

    scale: float  # file length that becomes 1; positive
    rotation: Float[Floats, "3 3"]  # applied after centring; orthonormal, determinant +1, or -1 for a mirrored frame
    center: Float[Floats, " 3"]  # file point that becomes the origin

    def __post_init__(self) -> None:
        rotation = as_read_only(self.rotation, np.float64, "a frame's rotation")
        center = as_read_only(self.center, np.float64, "a frame's center")
        scale = as_numbers(self.scale, "a frame's scale")
        if rotation.shape != (3, 3) or center.shape != (3,):
            raise InputError(f"a frame needs a (3, 3) rotation and a (3,) center, not {rotation.shape}, {center.shape}")
        if not np.isfinite(center).all():
            raise InputError("a frame's center must be finite, but holds nan or infinite values")
        if not (scale.ndim == 0 and np.isfinite(scale) and scale > 0):
            raise InputError(
                f"a frame's scale must be positive and finite, not {self.scale}", "does the shape have a size?"
            )
        is_bounded = (np.abs(rotation) < 2).all()  # larger entries could overflow in the product
        if not (is_bounded and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)):
            raise InputError("a frame's rotation must be orthonormal")
        for name, value in (("scale", float(scale)), ("rotation", rotation), ("center", center)):
            object.__setattr__(self, name, value)

    @classmethod
    def identity(cls) -> Frame:
        """The identity frame.

        Returns
        -------
        Frame
            Scale 1, no rotation, the file's origin.
        """
        return cls(1.0, np.eye(3), np.zeros(3))

    @property
    def mirrored(self) -> bool:
        """Whether the frame contains a reflection."""
        return bool(np.linalg.det(self.rotation) < 0)

    @property
    def turn(self) -> Float[Floats, "3 3"]:
        """The rotation; for a mirrored frame, the rotation with the same up and front axes."""
        return self.rotation * [[-1], [1], [1]] if self.mirrored else self.rotation

    def apply(self, points: ArrayLike) -> Float[Floats, "... 3"]:
        """Transform points from the file to the model: ``((points - center) @ rotation.T) / scale``.

        Parameters
        ----------
        points
            (..., 3) in the file's coordinates.

        Returns
        -------
        (..., 3) float64
            In the model's frame.
        """
        return ((np.asarray(to_numpy(points), np.float64) - self.center) @ self.rotation.T) / self.scale

    def undo(self, points: ArrayLike) -> Float[Floats, "... 3"]:
        """Transform points from the model back to the file.

        Parameters
        ----------
        points
            (..., 3) in the model's frame.

        Returns
        -------
        (..., 3) float64
            In the file's coordinates.
        """
        return (np.asarray(to_numpy(points), np.float64) * self.scale) @ self.rotation + self.center

    def compose(self, outer: Frame) -> Frame:
        """Apply this frame first, then `outer`: ``self.compose(outer).apply(x) = outer.apply(self.apply(x))``.

        Parameters
        ----------
        outer
            The second frame.

        Returns
        -------
        Frame
            The composition.
        """
        return Frame(self.scale * outer.scale, outer.rotation @ self.rotation, self.undo(outer.center))


@dataclass(frozen=True, eq=False)
class RigidPose:
    """Pose of a body in the world: world = rotation @ local + center."""

    rotation: Float[Floats, "3 3"]  # orthonormal, determinant +1
    center: Float[Floats, " 3"]  # position of the local origin in the world

    @classmethod
    def identity(cls) -> RigidPose:
        """The pose whose local coordinates are world coordinates."""
        return cls(np.eye(3), np.zeros(3))

    def to_local(self, points: Float[Floats, "... 3"]) -> Float[Floats, "... 3"]:
        """Transform points from world to local coordinates."""
        return (points - self.center) @ self.rotation

    def to_world(self, points: Float[Floats, "... 3"]) -> Float[Floats, "... 3"]:
        """Transform points from local to world coordinates."""
        return points @ self.rotation.T + self.center

    def __matmul__(self, inner: RigidPose) -> RigidPose:
        """Composition: the world pose of a body whose pose relative to this one is ``inner``."""
        return RigidPose(self.rotation @ inner.rotation, self.rotation @ inner.center + self.center)

    @property
    def frame(self) -> Frame:
        """The same transformation as a `Frame` from world to local coordinates."""
        return Frame(1.0, self.rotation.T, self.center)

    def angle_to(self, other: RigidPose) -> float:
        """Angle between the rotations of two poses, in degrees."""
        cosine = (np.trace(self.rotation.T @ other.rotation) - 1) / 2
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def kabsch(
    source: Float[Floats, "N 3"], target: Float[Floats, "N 3"], weights: Float[Floats, " N"] | None = None
) -> RigidPose:
    """Least-squares rigid motion (Kabsch 1976): ``pose.to_world(source)`` approximates ``target``.

    Weights must be nonnegative; by default all points count equally.
    """
    if weights is None:
        a, b = source.mean(0), target.mean(0)
        spread = (target - b).T @ (source - a)
    else:
        weights = weights / max(weights.sum(), 1e-30)
        a, b = weights @ source, weights @ target
        spread = (target - b).T @ (weights[:, None] * (source - a))
    U, _, Vh = np.linalg.svd(spread)
    U[:, 2] *= np.sign(np.linalg.det(U @ Vh))
    R = U @ Vh
    return RigidPose(R, b - R @ a)
