"""Samples tell the truth about distance, side and normal, from meshes, clouds and given distances; bad files are told."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("skimage", reason="scikit-image is of the extra `bench`")

from meshmatch.errors import InputError
from meshmatch.experiments.implicit_samples import FILLED, read_implicit_samples
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.experiments.small_implicit import box, box_sdf, boxes

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
    np.savez(tmp_path / "sdf.npz", points=anywhere, sdf=box_sdf(anywhere, HALF))
    np.save(tmp_path / "cloud.labels.npy", np.zeros(4000))
    found = read_implicit_samples(tmp_path)
    assert found.names == ("cloud", "normals", "sdf")
    for number, limit in ((0, 0.02), (1, 0.02), (2, 1e-4)):
        frame = found.frames[number]
        truth = box_sdf(frame.undo(found.rows[number, :, :3]), HALF) / frame.scale
        assert np.abs(truth - found.rows[number, :, 3]).mean() < limit
    assert not found.rows[2, :, 4:].any()


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"points": np.zeros((5, 3))}, "needs points"),
        ({"points": np.zeros((5, 2)), "sdf": np.zeros(5)}, "needs points"),
        ({"points": np.zeros((5, 3)), "sdf": np.full(5, np.nan)}, "finite"),
        ({"points": np.full((5, 3), "a"), "sdf": np.zeros(5)}, "finite"),
        ({"points": np.zeros((5, 3)), "sdf": np.ones(5)}, "four are needed"),
        ({"points": np.zeros((5, 3)), "sdf": -np.ones(5)}, "scale"),
        ({"points": np.array([{}] * 5, object), "sdf": np.zeros(5)}, "objects"),
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
