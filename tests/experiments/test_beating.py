"""The beating heart's motion is known, and what is measured of tracked points is right."""

from pathlib import Path

import numpy as np

from meshmatch.experiments.bench.beating import move_heart, paths_of, row, write_frames
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


def test_a_beat_ends_where_it_began() -> None:
    verts = icosphere(3).verts * [60.0, 50, 45]
    moved = np.array([move_heart(verts, phase) for phase in (0.0, 1.0, np.pi, 2 * np.pi)])
    assert np.allclose(moved[3], moved[0]) and np.linalg.norm(moved[2] - moved[0], axis=1).max() > 8


def test_frames_have_other_triangles_and_known_paths(tmp_path: Path) -> None:
    heart = Shape(icosphere(3).verts * [60.0, 50, 45], icosphere(3).faces)
    true = write_frames(tmp_path / "frames", heart, 5, 0)
    frames = [load_shape(tmp_path / "frames" / f"frame{k}.ply") for k in range(1, 6)]
    assert len({frame.V for frame in frames}) > 1 and all(frame.V < heart.V for frame in frames)
    faces = heart.faces[::7]
    paths = paths_of(true[0][faces].mean(axis=1), heart, true)
    assert np.allclose(paths, true[:, faces].mean(axis=2))
    exact = row("", true, true, heart.faces)
    assert exact["mean"] == exact["strain"] == 0 and exact["times"] == 1
    off = row("", true + np.array([0.0, 1, 1, 1, 1])[:, None, None] * [3.0, 0, 4], true, heart.faces)
    assert abs(off["mean"] - 5) < 1e-9 and off["strain"] < 1e-9 and off["times"] > 1
