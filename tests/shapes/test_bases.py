"""Flat bases are told from what stands on them, and nothing else is taken for one."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshmatch.errors import InputError
from meshmatch.shapes.bases import base_plane
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.parts import Parts, leave_out
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from tests.shapes.scenes import fused_with_floor, moved, sample, together


def landscape(heights: np.ndarray, width: float = 4.0) -> Shape:
    """One sheet, with a height at each point of a square grid."""
    N = len(heights)
    x, y = np.meshgrid(*[np.linspace(-width / 2, width / 2, N)] * 2, indexing="ij")
    corner = np.arange(N * N).reshape(N, N)
    a, b, c, d = (each.ravel() for each in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    verts = np.stack([x, y, heights], -1).reshape(-1, 3)
    return Shape(verts, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def hills(*centers: tuple[float, float], height: float = 2.0, N: int = 81) -> np.ndarray:
    x, y = np.meshgrid(*[np.linspace(-2, 2, N)] * 2, indexing="ij")
    return height * sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 0.08) for a, b in centers)


@pytest.mark.parametrize("noise", [0.0, 0.005])
def test_the_plane_that_a_hill_stands_on_is_found_however_it_lies(noise: float) -> None:
    shape = landscape(hills((0.3, 0.2)))
    rng = np.random.default_rng(0)
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    verts = 100 * (shape.verts + noise * rng.standard_normal(shape.verts.shape)) @ turn.T + [7.0, 8.0, 9.0]
    found = base_plane(Shape(verts, shape.faces))
    assert found is not None and found.normal @ turn[:, 2] > 0.999
    below = found.is_base(verts)
    assert below[shape.verts[:, 2] < 1e-3].mean() > 0.95 and not below[shape.verts[:, 2] > 0.1].any()


@pytest.mark.parametrize("name", ["climber", "dancer", "fox", "pointing", "laughing"])
def test_what_stands_on_nothing_has_no_base(name: str) -> None:
    shape = sample(name)
    assert Parts.of(shape, bases=True).bases == 0


def test_legs_on_a_plate_are_a_table_and_not_on_a_base() -> None:
    table = landscape(hills((-1.2, -1.2), (1.2, -1.2), (-1.2, 1.2), (1.2, 1.2)))
    assert base_plane(table) is not None
    assert Parts.of(table, bases=True).bases == 0


def test_numbers_of_other_parts_stay_and_a_base_is_the_last() -> None:
    body = sample("climber")
    scene = together("scan.ply", moved(body, [2.0, 0, 0]), fused_with_floor(body))
    plain, parts = Parts.of(scene), Parts.of(scene, bases=True)
    assert len(parts) == len(plain) + 1 and parts.bases == 1 and plain.bases == 0
    base = parts.number == len(parts)
    assert np.array_equal(parts.number[~base], plain.number[~base])
    assert parts.areas.sum() == pytest.approx(plain.areas.sum())
    assert parts.share([len(parts)]) == pytest.approx(9 / scene.area, rel=0.02)


def test_a_user_may_leave_out_a_base_and_a_part_is_chosen_with_it(tmp_path: Path) -> None:
    body = sample("climber")
    scene = fused_with_floor(body)
    save_shape(tmp_path / "scan.ply", scene)
    without = load_shape(tmp_path / "scan.ply", without=2)
    kept = np.asarray(without.weights) > 0
    assert kept[: body.V].mean() > 0.97 and not kept[body.V :].any()
    assert np.array_equal(np.asarray(leave_out(scene, [2]).weights) > 0, kept)
    assert np.asarray(load_shape(tmp_path / "scan.ply", only=1).weights).all()
    with pytest.raises(InputError, match="no part 3"):
        load_shape(tmp_path / "scan.ply", without=3)


@pytest.mark.parametrize("points", [np.zeros((50, 3)), np.eye(3), np.arange(60.0).reshape(20, 3)])
def test_a_cloud_that_is_no_surface_has_no_base(points: np.ndarray) -> None:
    assert Parts.of(Shape(points, np.empty((0, 3), np.int64)), bases=True).bases == 0


def test_vertices_without_a_position_do_no_harm() -> None:
    scene = fused_with_floor(sample("climber"))
    verts = np.array(scene.verts)
    verts[[5, -3]] = np.nan
    for faces in (scene.faces, np.empty((0, 3), np.int64)):
        broken = Shape.with_invalid(verts, faces, "broken")
        assert (Parts.of(broken, bases=True).number[[5, -3]] == 0).all()


def cloud_of(shape: Shape) -> Shape:
    return Shape(sample_surface(shape, 4000, np.random.default_rng(5)).points, np.empty((0, 3), np.int64))


def test_the_floor_of_a_cloud_is_a_part_and_a_body_alone_has_none() -> None:
    body = sample("climber")
    for shape, bases in ((fused_with_floor(body), 1), (body, 0)):
        parts = Parts.of(cloud_of(shape), bases=True)
        assert parts.bases == bases and len(parts) == 2 * bases
    found = Parts.of(cloud_of(fused_with_floor(body)), bases=True)
    assert np.allclose(found.bounds[1][:, 2], body.bounds[0, 2], atol=0.05)
