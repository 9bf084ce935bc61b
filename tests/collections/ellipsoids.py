"""Registered shapes whose mean and modes are known: ellipsoids that differ in their three half axes alone.

Stretching along the axes turns nothing and moves no center, so that laying them over one another changes nothing.
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
    """Shapes whose half axes vary independently."""
    ball = icosphere(splits)
    axes = AXES + spread * np.random.default_rng(seed).standard_normal((count, 3))
    return Ellipsoids(ball.verts * axes[:, None], ball.faces, axes)


def moved(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Each shape turned and moved at random, but the first."""
    random = np.random.default_rng(seed)
    turns = Rotation.random(len(points), rng=random).as_matrix()
    turns[0] = np.eye(3)
    return points @ turns.transpose(0, 2, 1) + 5 * random.standard_normal((len(points), 1, 3))
