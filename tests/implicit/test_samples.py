"""Samples tell the truth about distance, side and normal, from meshes, clouds and given distances; bad files are told."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.implicit.samples import FAR, FILLED, read_implicit_samples, sample_shape
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.implicit.boxes import box, box_sdf, boxes

HALF = np.array([1.0, 0.4, 0.6])


def test_distances_of_meshes(tmp_path: Path) -> None:
    halves = boxes(tmp_path, 3)
    found = read_implicit_samples(tmp_path)
    assert found.names == ("box0", "box1", "box2")
    for frame, rows, half in zip(found.frames, found.rows, halves, strict=True):
        points, sdf, normals = rows[:, :3], rows[:, 3], rows[:, 4:]
        truth = box_sdf(frame.undo(points), half) / frame.scale
        surface = len(sdf) // 2
        assert np.abs(truth[:surface]).max() < 1e-5
        assert np.abs(truth - sdf).mean() < 2e-3
        assert np.mean(np.sign(truth[surface:]) != np.sign(sdf[surface:])) < 0.005
        assert np.abs(points).max() <= 1
        assert np.abs(points[:surface]).max() == pytest.approx(FILLED, abs=1e-3)
        assert np.allclose(np.linalg.norm(normals[:surface], axis=1), 1, atol=1e-5)
        assert not normals[surface:].any()


def test_the_seed_alone_decides(tmp_path: Path) -> None:
    boxes(tmp_path, 2)
    a, b, other = (read_implicit_samples(tmp_path, seed) for seed in (0, 0, 1))
    assert np.array_equal(a.rows, b.rows)
    assert not np.array_equal(a.rows, other.rows)


def test_clouds_and_given_distances(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    drawn = sample_surface(box(HALF), 4000, rng)
    np.savez(tmp_path / "normals.npz", points=drawn.points, normals=drawn.normals)
    save_shape(tmp_path / "cloud.ply", Shape(drawn.points, np.zeros((0, 3), np.int64)))
    anywhere = rng.uniform(-1.3, 1.3, (20_000, 3))
    np.savez(tmp_path / "sdf.npz", points=anywhere, distances=box_sdf(anywhere, HALF))
    np.save(tmp_path / "cloud.labels.npy", np.zeros(4000))
    found = read_implicit_samples(tmp_path)
    assert found.names == ("cloud", "normals", "sdf")
    for number in (0, 1):  # of clouds only the surface is known, and where it is not
        frame, rows = found.frames[number], found.rows[number]
        truth = box_sdf(frame.undo(rows[:, :3]), HALF) / frame.scale
        half = len(rows) // 2
        assert np.abs(truth[:half]).max() < 1e-5
        assert not rows[:half, 3].any()
        assert np.isnan(rows[half:, 3]).all()
        assert np.quantile(np.abs(truth[half:]), 0.01) > 0.9 * FAR  # but where the cloud has gaps
        assert (truth[half:] < 0).any()
    kept = np.sign(found.frames[1].undo(found.rows[1, :10, :3])) * found.rows[1, :10, 4:]
    assert (kept.sum(1) > 0).all()  # outwards, as the file has them
    frame, rows = found.frames[2], found.rows[2]
    assert np.abs(box_sdf(frame.undo(rows[:, :3]), HALF) / frame.scale - rows[:, 3]).mean() < 1e-4
    assert not rows[:, 4:].any()


def test_a_mesh_with_a_hole_may_be_taken_as_a_surface() -> None:
    whole = box(HALF)
    open_one = Shape(whole.verts, whole.faces[1:])
    rows = sample_shape(open_one, 400, np.random.default_rng(0), closed=False)[1]
    assert np.isnan(rows[200:, 3]).all()
    solid = sample_shape(whole, 400, np.random.default_rng(0), closed=False)[1]
    assert (solid[200:, 3] < 0).any()


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"points": np.zeros((5, 3))}, "needs points"),
        ({"points": np.zeros((5, 2)), "distances": np.zeros(5)}, "needs points"),
        ({"points": np.zeros((5, 3)), "distances": np.full(5, np.nan)}, "finite"),
        ({"points": np.zeros((5, 3)), "normals": np.full((5, 3), 1e308)}, "huge"),
        ({"points": np.eye(5, 3), "distances": np.array([-1e40, -1, -1, -1, 1])}, "far beyond"),
        ({"points": np.full((5, 3), "a"), "distances": np.zeros(5)}, "finite"),
        ({"points": np.zeros((5, 3)), "distances": np.ones(5)}, "four are needed"),
        ({"points": np.zeros((5, 3)), "distances": -np.ones(5)}, "scale"),
        ({"points": np.array([{}] * 5, object), "distances": np.zeros(5)}, "objects"),
    ],
)
def test_bad_arrays_are_told_in_a_line(tmp_path: Path, arrays: dict[str, np.ndarray], said: str) -> None:
    boxes(tmp_path, 1)
    np.savez(tmp_path / "odd.npz", **arrays)
    with pytest.raises(InputError, match=said) as caught:
        read_implicit_samples(tmp_path)
    assert "\n" not in caught.value.message


def test_a_mesh_with_a_hole_has_no_inside(tmp_path: Path) -> None:
    boxes(tmp_path, 1)
    whole = box(HALF)
    save_shape(tmp_path / "open.ply", Shape(whole.verts, whole.faces[1:]))
    with pytest.raises(InputError, match="watertight"):
        read_implicit_samples(tmp_path)


def test_one_shape_is_too_few(tmp_path: Path) -> None:
    boxes(tmp_path, 1)
    with pytest.raises(InputError, match="two are needed"):
        read_implicit_samples(tmp_path)
