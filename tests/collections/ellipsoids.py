"""Registered shapes with known mean and modes: ellipsoids that differ only in their three semi-axes.

Scaling along the axes has no rotation and keeps the center, so that aligning the shapes changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tests.conftest import icosphere

AXES = np.array([1.0, 1.5, 2.2])
SPREAD = np.array([0.02, 0.05, 0.15])


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    points: np.ndarray  # (S, V, 3)
    faces: np.ndarray
    axes: np.ndarray  # (S, 3)


def ellipsoids(count: int, *, seed: int = 0, splits: int = 2, spread: np.ndarray = SPREAD) -> Ellipsoids:
    """Draw ellipsoids whose semi-axes vary independently."""
    ball = icosphere(splits)
    axes = AXES + spread * np.random.default_rng(seed).standard_normal((count, 3))
    return Ellipsoids(ball.verts * axes[:, None], ball.faces, axes)


def moved(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Move each shape (S, V, 3) but the first by a random rotation, and all by random translations."""
    random = np.random.default_rng(seed)
    turns = Rotation.random(len(points), rng=random).as_matrix()
    turns[0] = np.eye(3)
    return points @ turns.transpose(0, 2, 1) + 5 * random.standard_normal((len(points), 1, 3))
