"""Shapes from arrays and from the meshes of other libraries, and back."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from meshmatch.arrays import as_numbers
from meshmatch.errors import InputError, MeshmatchWarning
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


CELLS = [[0, 1, 2, 3], [4, 5, 6]]  # a quad and a triangle
FANS = [[0, 1, 2], [0, 2, 3], [4, 5, 6]]
FLAT = np.array([4, 0, 1, 2, 3, 3, 4, 5, 6])  # the same as VTK has them


def thing(**attributes: Any) -> Any:
    return SimpleNamespace(**attributes)


def dataset(kind: str) -> Any:
    """What vedo keeps an object of VTK in."""
    return type(kind, (), {})()


class Batch:
    """The way PyTorch3D holds meshes."""

    def __init__(self, count: int, verts: np.ndarray) -> None:
        self.count, self.verts = count, verts

    def __len__(self) -> int:
        return self.count

    def verts_packed(self) -> Any:
        return torch.tensor(self.verts, requires_grad=True)

    def faces_packed(self) -> Any:
        return torch.tensor(FANS)


class Legacy:
    """The way Open3D's tensor geometry gives its older kind."""

    def __init__(self, older: Any) -> None:
        self.to_legacy = lambda: older


def meshes_of_libraries(verts: np.ndarray) -> dict[str, Any]:
    blocks = [thing(type="quad", data=np.array(CELLS[:1])), thing(type="triangle", data=np.array(CELLS[1:]))]
    loose = [thing(type="line", data=np.array([[0, 1]])), thing(type="vertex", data=np.array([[0]]))]
    open3d = thing(vertices=verts, triangles=np.array(FANS, np.int32), has_vertex_colors=lambda: False)
    return {
        "vedo": thing(vertices=verts, points=verts, cells=CELLS, lines=[], dataset=dataset("vtkPolyData")),
        "vedo of old": thing(points=lambda: verts, faces=lambda: CELLS),
        "PyVista": thing(points=verts, faces=FLAT, verts=np.empty(0, int), lines=np.array([2, 0, 1]), n_cells=2),
        "PyVista, a grid of faces": thing(points=verts, cells=FLAT, celltypes=np.array([9, 5]), n_cells=2),
        "PyVista, a grid with points": thing(
            points=verts, cells=np.append(FLAT, [1, 7]), celltypes=np.array([9, 5, 1]), n_cells=3
        ),
        "Open3D": open3d,
        "Open3D, tensors": Legacy(open3d),
        "meshio": thing(points=verts, cells=[*loose, *blocks]),
        "meshio of old": thing(points=verts, cells=[("quad", np.array(CELLS[:1])), ("triangle", np.array(CELLS[1:]))]),
        "PyMeshLab": thing(vertex_matrix=lambda: verts, face_matrix=lambda: np.array(FANS)),
        "PyTorch3D": Batch(1, verts),
        "floats": (verts, np.array(FANS, float)),
        "lists of polygons": (verts.tolist(), CELLS),
        "tensors": (torch.tensor(verts, requires_grad=True), torch.tensor(FANS)),
        "list of tensors": [torch.tensor(verts), torch.tensor(FANS, dtype=torch.int32)],
        "a parameter": thing(vertices=torch.nn.Parameter(torch.tensor(verts)), faces=torch.tensor(FANS).float()),
    }


VERTS = np.arange(24.0).reshape(8, 3) ** 1.5


@pytest.mark.parametrize("library", meshes_of_libraries(VERTS))
def test_meshes_of_other_libraries_keep_their_faces(library: str) -> None:
    shape = as_shape(meshes_of_libraries(VERTS)[library])
    assert np.array_equal(shape.verts, VERTS)
    assert sorted(map(tuple, shape.faces)) == sorted(map(tuple, FANS))


@pytest.mark.parametrize("library", ["vedo", "PyVista", "meshio", "lists"])
def test_concave_faces_of_other_libraries_stay_inside(library: str) -> None:
    """An arrow and an L, of 2 and 3 squares: fans would run across their bays."""
    verts = np.array([[0, 0], [2, -1], [1, 0], [2, 1], [9, 0], [11, 0], [11, 1], [10, 1], [10, 2], [9, 2]], float)
    verts = np.insert(verts, 2, 1.0, axis=1)
    cells = [[1, 2, 3, 0], [5, 6, 7, 8, 9, 4]]
    flat = np.concatenate([[len(cell), *cell] for cell in cells])
    blocks = [thing(type="quad", data=np.array(cells[:1])), thing(type="polygon", data=np.array(cells[1:]))]
    shape = as_shape(
        {
            "vedo": thing(vertices=verts, points=verts, cells=cells, lines=[], dataset=dataset("vtkPolyData")),
            "PyVista": thing(points=verts, faces=flat, verts=np.empty(0, int), lines=[], n_cells=2),
            "meshio": thing(points=verts, cells=blocks),
            "lists": (verts.tolist(), cells),
        }[library]
    )
    assert (shape.V, shape.F) == (10, 6) and shape.area == pytest.approx(1.0 + 3.0)


@pytest.mark.parametrize(
    "cloud",
    [
        thing(points=VERTS, colors=np.ones((8, 3)), has_colors=lambda: True),
        thing(points=VERTS, faces=np.empty(0, int), verts=np.tile([1, 0], 8), lines=[], n_cells=8),
        thing(vertices=VERTS, cells=[], lines=[], dataset=dataset("vtkPolyData")),
        thing(points=VERTS, cells=[thing(type="vertex", data=np.arange(8)[:, None])]),
        thing(vertices=VERTS, faces=None),
        torch.tensor(VERTS, requires_grad=True),
        torch.tensor(VERTS, dtype=torch.float64),
        np.ma.masked_array(VERTS),
        (VERTS, None),
    ],
)
def test_clouds_of_other_libraries_are_clouds(cloud: Any) -> None:
    shape = as_shape(cloud)
    assert shape.is_cloud and np.array_equal(shape.verts, VERTS)
    assert (shape.colors is not None) == hasattr(cloud, "has_colors")


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (thing(points=VERTS, cells=np.array([4, 0, 1, 2, 3]), celltypes=np.array([10]), n_cells=1), "volumes"),
        (thing(vertices=VERTS, cells=[CELLS[0]], cell_types_array=np.array([10])), "volumes"),
        (thing(points=VERTS, cells=[thing(type="tetra", data=np.array(CELLS[:1]))]), "cells of type tetra"),
        (thing(points=VERTS, cells=[thing(type="line", data=np.array([[0, 1]]))]), "cells of type line"),
        (thing(vertices=VERTS, cells=CELLS[:1]), "faces or volumes"),
        (thing(points=VERTS, cells=FLAT), "without their types"),
        (thing(points=VERTS, cells=FLAT, celltypes=np.array([9])), "2 cells and 1 types"),
        (thing(points=VERTS, faces=FLAT[:-1]), "counts and corners"),
        (thing(points=VERTS, faces=np.array([-1, 0])), "counts and corners"),
        (thing(points=VERTS, faces=[], strips=np.array([4, 0, 1, 2, 3])), r"\.strips"),
        (thing(vertices=VERTS, indices=np.array([0, 1, 2])), r"\.indices"),
        (thing(vertices=VERTS, tets=np.array([[0, 1, 2, 3]])), r"\.tets"),
        (thing(points=VERTS, edges=np.array([[0, 1]])), r"\.edges"),
        (thing(points=VERTS, n_cells=1), "a grid"),
        (thing(points=VERTS, cells=[], dataset=dataset("vtkImageData")), "a grid"),
        (thing(vertices=VERTS, entities=[1]), r"\.entities"),
        (thing(points=VERTS, simplices=np.array(FANS)), r"\.simplices"),
        (thing(vertices=VERTS, faces=[[[0, 1], [2, 3]], [[0, 1, 2]]]), "list of vertices"),
        (thing(vertices=VERTS[None]), r"batch of \(1, 8, 3\)"),
        ((VERTS[None], np.array([[0, 1, 2]])), r"batch of \(1, 8, 3\)"),
        (thing(vertices=7), r"\(V, 3\)"),
        (Batch(2, VERTS), "batch of 2"),
        ((VERTS, CELLS[:1]), "quads or tetrahedra"),
        ((VERTS, [[1, 2, 8]]), "from 1 to 8"),
        (VERTS * 1j, "complex"),
        (torch.tensor(VERTS).to_sparse(), "must be numbers"),
        (torch.empty(8, 3, device="meta"), "must be numbers"),
        (7, "cannot make a shape of int"),
        (None, "cannot make a shape of NoneType"),
        (np.zeros((4, 2)), r"vertices must be an array of \(V, 3\), not \(4, 2\)"),
        ([["a", "b", "c"]], "must be numbers"),
        ((np.zeros((4, 3)), [[0, 1]]), r"faces must be an array of \(F, 3\)"),
        ((np.zeros((4, 3)), [[0, 1, 9]]), "a face refers to vertex 9"),
        ((np.zeros((4, 3)), [[0, 1, 2.5]]), "faces must be integers"),
        (np.full((4, 3), np.nan), "no vertex has a usable position"),
        (np.zeros((0, 3)), "holds no vertices"),
        (([[0, 0, 0], [1, 1]], [[0, 1, 2]]), "must be numbers"),
    ],
)
def test_what_is_no_surface_is_refused_and_never_a_cloud(source: Any, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        as_shape(source)
    assert caught.value.hint


@pytest.mark.parametrize("missing", [np.ma.masked_greater, lambda verts, most: np.where(verts > most, np.nan, verts)])
def test_masked_positions_and_nan_are_invalid(missing: Any) -> None:
    shape = as_shape(missing(VERTS, VERTS[7, 0] - 1))
    assert shape.invalid is not None and np.flatnonzero(shape.invalid).tolist() == [7]


def test_a_trimesh_scene_is_one_shape_in_place(cube: Shape) -> None:
    moved = trimesh.transformations.translation_matrix([5, 0, 0])
    mirrored = np.diag([-1.0, 1, 1, 1])
    mesh, scene = trimesh.Trimesh(cube.verts, cube.faces, process=False), trimesh.Scene()
    for matrix in (moved, mirrored):
        scene.add_geometry(mesh, transform=matrix)
    shape = as_shape(scene)
    parts = [cube.verts + np.array([5, 0, 0]), cube.verts * [-1, 1, 1]]
    assert np.allclose(shape.verts, np.concatenate(parts)) and shape.F == 2 * cube.F
    volumes = [trimesh.Trimesh(shape.verts, faces, process=False).volume for faces in np.split(shape.faces, 2)]
    assert np.allclose(volumes, mesh.volume)  # the mirrored one faces out as well
    with pytest.raises(InputError, match="without meshes"):
        as_shape(trimesh.Scene())


def test_tensors_are_numbers_everywhere() -> None:
    values = torch.tensor([[0.5, 1.0]], requires_grad=True)
    assert as_numbers(values, "values").tolist() == [[0.5, 1.0]]
    assert as_numbers(values.bfloat16(), "values").tolist() == [[0.5, 1.0]]
    assert as_numbers([values[0], values[0]], "values").shape == (2, 2)
    with pytest.raises(InputError, match="values must be numbers"):
        as_numbers(torch.empty(2, device="meta"), "values")


def test_reading_a_mesh_loads_no_trimesh(tmp_path: Path, cube: Shape) -> None:
    """It takes 0.7 s to import; reading needs neither SciPy nor Pillow."""
    for suffix in (".ply", ".stl"):
        save_shape(tmp_path / f"a{suffix}", cube)
    code = (
        "import sys; from meshmatch.shapes.files import load_shapes; load_shapes(sys.argv[1:])\n"
        "print([name for name in ('trimesh', 'scipy', 'PIL') if name in sys.modules])"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "a.ply"), str(tmp_path / "a.stl")]
    assert "[]" in subprocess.run(words, capture_output=True, text=True, check=True).stdout


def test_colors_of_a_trimeshs_faces_are_those_of_vertices(cube: Shape) -> None:
    mesh = trimesh.Trimesh(cube.verts, cube.faces, process=False)
    mesh.visual.face_colors = np.tile([255, 0, 0, 255], (cube.F, 1))
    with pytest.warns(MeshmatchWarning, match="the mean of those around"):
        found = as_shape(mesh)
    assert found.colors == pytest.approx(np.tile([1.0, 0.0, 0.0, 1.0], (cube.V, 1)))


def test_what_has_a_shape_is_none(cube: Shape) -> None:
    """A fit has points and faces, but in the frame of its template."""
    with pytest.raises(InputError, match="cannot make a shape") as told:
        as_shape(thing(shape=cube, points=cube.verts, faces=cube.faces))
    assert told.value.hint.startswith("pass its .shape")
