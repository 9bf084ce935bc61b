"""Shapes from arrays and from the meshes of other libraries, and back."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh

from meshmatch.errors import InputError
from meshmatch.shapes.files import as_shape, save_shape
from meshmatch.shapes.shape import Shape


def test_a_shape_stays_itself_and_a_path_is_read(tmp_path: Path, cube: Shape) -> None:
    assert as_shape(cube) is cube
    save_shape(tmp_path / "cube.off", cube)
    for path in (tmp_path / "cube.off", str(tmp_path / "cube.off")):
        assert as_shape(path).hash == cube.hash


def test_arrays_and_objects_are_copied_in_order(cube: Shape) -> None:
    verts, faces = cube.verts.copy(), cube.faces.copy()
    sources: list[Any] = [
        (verts, faces),
        [verts.tolist(), faces.tolist()],
        SimpleNamespace(vertices=verts, faces=faces),
        SimpleNamespace(vertices=verts, triangles=faces.astype(np.int32)),
        trimesh.Trimesh(verts, faces, process=False),
    ]
    for source in sources:
        assert as_shape(source, "box").hash == cube.hash
    verts[0] = 99  # a copy
    cloud = as_shape(cube.verts)
    assert cloud.is_cloud and np.array_equal(cloud.verts, cube.verts)
    assert as_shape(SimpleNamespace(vertices=cube.verts)).is_cloud
    assert as_shape([[0, 0, 0], [1, 2, 3]]).V == 2  # two points are no pair of vertices and faces


def test_nan_vertices_keep_their_place(cube: Shape) -> None:
    verts = cube.verts.copy()
    verts[2] = np.nan
    shape = as_shape((verts, cube.faces))
    assert shape.invalid is not None and np.flatnonzero(shape.invalid).tolist() == [2]


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (7, "cannot make a shape of int"),
        (None, "cannot make a shape of NoneType"),
        (np.zeros((4, 2)), r"vertices must be an array of \(V, 3\), not \(4, 2\)"),
        ([["a", "b", "c"]], "not an array of numbers"),
        ((np.zeros((4, 3)), [[0, 1]]), r"faces must be an array of \(F, 3\)"),
        ((np.zeros((4, 3)), [[0, 1, 9]]), "a face refers to vertex 9"),
        ((np.zeros((4, 3)), [[0, 1, 2.5]]), "faces must be integers"),
        (np.full((4, 3), np.nan), "no vertex has a usable position"),
        (np.zeros((0, 3)), "holds no vertices"),
        (([[0, 0, 0], [1, 1]], [[0, 1, 2]]), "not an array of numbers"),
    ],
)
def test_wrong_input_is_one_line_with_a_hint(source: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        as_shape(source)


def test_a_trimesh_there_and_back(cube: Shape) -> None:
    colors = np.tile([1.0, 0.5, 0.25, 1.0], (cube.V, 1))
    painted = Shape(cube.verts, cube.faces, "cube", colors)
    mesh = painted.to_trimesh()
    assert np.array_equal(mesh.vertices, cube.verts) and np.array_equal(mesh.faces, cube.faces)
    back = as_shape(mesh)
    assert back.hash == cube.hash and back.colors is not None
    assert np.allclose(back.colors, colors, atol=0.5 / 255)
    assert as_shape(cube.to_trimesh()).colors is None
    assert as_shape(as_shape(cube.verts).to_trimesh()).is_cloud
    assert as_shape(trimesh.PointCloud(cube.verts)).colors is None


def test_only_stl_loads_trimesh(tmp_path: Path, cube: Shape) -> None:
    """It takes 0.7 s, which nobody who matches plies should wait for; reading them needs no scipy either."""
    for suffix in (".ply", ".stl"):
        save_shape(tmp_path / f"a{suffix}", cube)
    code = (
        "import sys; from meshmatch.shapes.files import load_shape; load_shape(sys.argv[1])\n"
        "print([name for name in ('trimesh', 'scipy', 'PIL') if name in sys.modules])"
    )
    for suffix, loaded in ((".ply", "[]"), (".stl", "trimesh")):
        words = [sys.executable, "-c", code, str(tmp_path / f"a{suffix}")]
        assert loaded in subprocess.run(words, capture_output=True, text=True, check=True).stdout
