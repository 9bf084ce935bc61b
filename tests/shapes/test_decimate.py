"""Decimation: near the target, near the surface, closed where it was closed, for any input."""

import builtins
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import is_watertight
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1750.0])
@pytest.mark.parametrize("quality", ["fast", "meshlab"])
def test_closed_mesh_stays_closed_and_near(make_sphere: Callable[[int], Shape], scale: float, quality: str) -> None:
    if quality == "meshlab":
        pytest.importorskip("pymeshlab", exc_type=ImportError)
    ball = make_sphere(4)
    shape = Shape(ball.verts * scale + 5 * scale, ball.faces, "ball")
    small = decimate(shape, 600, quality)
    assert abs(small.F - 600) <= 6
    assert is_watertight(small.faces)
    assert small.V - 3 * small.F // 2 + small.F == 2  # Euler: still a sphere
    radius = np.linalg.norm(small.verts / scale - 5, axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=0.02)
    assert small.area == pytest.approx(shape.area, rel=0.02)
    assert (np.einsum("vi,vi->v", small.vertex_normals, small.verts / scale - 5) > 0).all()
    assert small.name == "ball"


def test_small_enough_is_returned_as_it_is(cube: Shape) -> None:
    assert decimate(cube, 12) is cube
    assert decimate(cube, 5000) is cube


def test_open_and_non_manifold_and_unused_are_survived(torus: Shape) -> None:
    fin = np.stack([np.arange(0, 300), np.arange(1, 301), np.arange(700, 1000)], axis=1)
    verts = np.vstack([torus.verts, [[9, 9, 9]]])
    shape = Shape(verts, np.vstack([torus.faces[:-400], fin]))
    small = decimate(shape, 800)
    assert small.F < 1000
    assert np.abs(small.verts).max() < 2  # the unused vertex is gone
    assert (np.diff(np.sort(small.faces, axis=1), axis=1) > 0).all()


def test_colors_come_from_the_nearest_vertex(make_sphere: Callable[[int], Shape]) -> None:
    ball = make_sphere(3)
    colors = np.random.default_rng(0).random((ball.V, 4))
    small = decimate(Shape(ball.verts, ball.faces, colors=colors), 300)
    np.testing.assert_array_equal(small.colors, colors[cKDTree(ball.verts).query(small.verts)[1]])


@pytest.mark.parametrize(("lost", "tries", "faces"), [([2, 0], 2, 300), ([18, 4, 10, 14], 4, 296)])
def test_the_first_closed_result_is_taken_or_the_best(
    sphere: Shape, monkeypatch: pytest.MonkeyPatch, lost: list[int], tries: int, faces: int
) -> None:
    import fast_simplification

    real, asked = fast_simplification.simplify, []

    def leaky(points: np.ndarray, faces: np.ndarray, target_count: int, agg: float):
        asked.append(agg)
        verts, small = real(points, faces, target_count=target_count, agg=agg)
        return verts, small[lost[len(asked) - 1] :]

    monkeypatch.setattr(fast_simplification, "simplify", leaky)
    small = decimate(sphere, 300)
    assert abs(small.F - faces) < 4 and is_watertight(small.faces) == (faces == 300)
    assert len(asked) == tries and asked[0] == 3.0  # the gentlest way first


def test_threads_do_not_mix_their_meshes(make_sphere: Callable[[int], Shape]) -> None:
    shapes = [make_sphere(5), Shape(make_sphere(5).verts * [1.0, 2.0, 3.0], make_sphere(5).faces)] * 12
    alone = [decimate(shape, 900) for shape in shapes[:2]]
    for number, found in enumerate(parallel_map(lambda shape: decimate(shape, 900), shapes, threads=2)):
        assert np.array_equal(found.verts, alone[number % 2].verts)
        assert np.array_equal(found.faces, alone[number % 2].faces)


def test_target_is_reached_where_the_gentle_way_stops_short(sphere: Shape) -> None:
    small = decimate(sphere, 60)
    assert small.F <= 62
    assert is_watertight(small.faces)


def test_choices_that_do_not_exist(sphere: Shape) -> None:
    with pytest.raises(OptionError, match="unknown decimation quality 'best'") as caught:
        decimate(sphere, 100, "best")
    assert "fast or meshlab" in caught.value.hint
    with pytest.raises(OptionError, match="cannot decimate to 3 faces"):
        decimate(sphere, 3)
    with pytest.raises(InputError, match="point cloud"):
        decimate(Shape(sphere.verts, []), 100)


def test_lost_filters_are_named(sphere: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    pymeshlab = pytest.importorskip("pymeshlab")
    monkeypatch.setattr(pymeshlab, "MeshSet", type("MeshSet", (), {}))
    with pytest.raises(OptionError, match="lacks its filter meshing_decimation") as caught:
        decimate(sphere, 100, "meshlab")
    assert "libopengl0" in caught.value.hint


@pytest.mark.parametrize(
    ("error", "hint"),
    [
        (ModuleNotFoundError("No module named 'pymeshlab'"), "pip install pymeshlab"),
        (ImportError("libGL.so.1: cannot open shared object file"), "apt-get install libgl1"),
    ],
)
def test_missing_pymeshlab_is_explained(
    sphere: Shape, monkeypatch: pytest.MonkeyPatch, error: ImportError, hint: str
) -> None:
    real = builtins.__import__

    def refuse(name: str, *rest: object, **more: object) -> object:
        if name == "pymeshlab":
            raise error
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(OptionError) as caught:
        decimate(sphere, 100, "meshlab")
    assert hint in caught.value.hint
    assert decimate(sphere, 100).F <= 102  # the default way does not need it
