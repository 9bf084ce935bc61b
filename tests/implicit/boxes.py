"""Boxes with known signed distance, and settings for training within a second."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from meshmatch.implicit.network import ImplicitConfig
from meshmatch.implicit.training import TRAINING
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape

TRAIN = replace(TRAINING, steps=6, shapes=2, warm_up=1)


def config(field: str) -> ImplicitConfig:
    return ImplicitConfig(field, code=8, width=24, depth=2, inner=8, nodes=20)  # type: ignore[arg-type]


def box(half: np.ndarray, name: str = "box") -> Shape:
    """Build a closed box, centred at the origin, with outward faces."""
    verts = np.array(list(product((-1.0, 1.0), repeat=3))) * half
    faces = ConvexHull(verts).simplices.astype(np.int64)
    corners = verts[faces]
    inwards = (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(1)).sum(1) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    return Shape(verts, faces, name)


def box_sdf(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0)


def boxes(folder: Path, count: int = 4) -> list[np.ndarray]:
    """Write boxes of different sizes; return their half sides."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    halves = [rng.uniform([0.5, 0.2, 0.3], [1.0, 0.6, 0.8]) for _ in range(count)]
    for number, half in enumerate(halves):
        save_shape(folder / f"box{number}.ply", box(half))
    return halves
