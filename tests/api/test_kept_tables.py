"""Transfers and moved meshes: a .ply or .vtp of the target keeps polygons and numbers of its own."""

import warnings
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.errors import MeshmatchWarning
from meshmatch.shapes.deformed_files import save_moved
from meshmatch.shapes.formats.ply import parsed

VERTICES = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (2, 0.5, 0)]
PLY = (
    "ply\nformat ascii 1.0\ncomment of mine\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    "property float thickness\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    + "".join(f"{x} {y} {z} {k}.5\n" for k, (x, y, z) in enumerate(VERTICES))
    + "4 0 1 2 3\n3 1 4 2\n"
)
PLACES = "\n".join(" ".join(str(x) for x in v) for v in VERTICES)
VTP = (
    '<VTKFile type="PolyData" byte_order="LittleEndian"><PolyData><Piece NumberOfPoints="5" NumberOfPolys="2"><PointData>'
    '<DataArray type="Float32" Name="thickness" format="ascii">0.5 1.5 2.5 3.5 4.5</DataArray></PointData><Points>'
    f'<DataArray type="Float32" NumberOfComponents="3">{" ".join(str(x) for v in VERTICES for x in v)}</DataArray></Points>'
    '<Polys><DataArray type="Int32" Name="connectivity">0 1 2 3 1 4 2</DataArray>'
    '<DataArray type="Int32" Name="offsets">4 7</DataArray></Polys></Piece></PolyData></VTKFile>'
)


@pytest.fixture(params=["ply", "vtp"])
def target(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / f"target.{request.param}"
    path.write_text(PLY if request.param == "ply" else VTP)
    return path


def is_kept(path: Path) -> bool:
    text = path.read_bytes()
    if path.suffix == ".vtp":
        return b'Name="thickness"' in text and b">4 7<" in text
    content = parsed(path.name, text)
    polygons = content.faces[0].table["vertex_indices"][1].tolist() == [4, 3]
    return polygons and content.comments == ["of mine"] and content.vertices.table["thickness"][4] == 4.5


def test_a_transfer_adds_to_the_file_of_the_target(target: Path) -> None:
    out = target.with_stem("out")
    moves = (
        meshmatch.transfer_labels(target, target, [3, 3, 5, 5, 3]),
        meshmatch.transfer_labels(target, target, [3, 3, 5]),  # of faces
        meshmatch.transfer_values(target, target, np.arange(5) / 4),
        meshmatch.transfer_colors(target, target, colors=np.eye(5, 3)),
    )
    for move in moves:
        move.save(out)
        assert is_kept(out)
    painted = meshmatch.load_shape(out)
    assert painted.verts.tolist() == [list(map(float, each)) for each in VERTICES]
    assert painted.colors is not None
    np.testing.assert_allclose(painted.colors[:, :3], np.eye(5, 3))


def test_what_another_format_does_not_hold_is_told(target: Path) -> None:
    word = "property" if target.suffix == ".ply" else "array"
    other = target.with_name(f"out.{'vtp' if target.suffix == '.ply' else 'ply'}")
    told = rf"^{other.name} does not have the polygons and {word} thickness of {target.name}$"
    with pytest.warns(MeshmatchWarning, match=told):
        meshmatch.transfer_labels(target, target, [3, 3, 5, 5, 3]).save(other)
    with pytest.warns(MeshmatchWarning, match=told):
        meshmatch.transfer_values(target, target, np.arange(5) / 4).save(other)
    shape = meshmatch.load_shape(target)
    with pytest.warns(MeshmatchWarning, match=rf"^out.stl does not have .*the {word} thickness of {target.name}$"):
        save_moved(target.with_name("out.stl"), target, shape, np.tile(np.eye(3), (5, 1, 1)))


OFF = f"OFF\n5 2 0\n{PLACES}\n4 0 1 2 3\n3 1 4 2\n"
VTK = (
    f"# vtk DataFile Version 4.2\na\nASCII\nDATASET POLYDATA\nPOINTS 5 float\n{PLACES}\nPOLYGONS 2 9\n4 0 1 2 3\n3 1 4 2\n"
    "POINT_DATA 5\nSCALARS thickness float 1\nLOOKUP_TABLE default\n0 1 2 3 4\nFIELD FieldData 1\nage 1 5 int\n5 4 3 2 1\n"
)
NEWER = VTK.replace(
    "POLYGONS 2 9\n4 0 1 2 3\n3 1 4 2", "POLYGONS 3 7\nOFFSETS int\n0 4 7\nCONNECTIVITY int\n0 1 2 3 1 4 2"
)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.off", OFF, "polygons"),
        ("a.off", OFF.replace("5 2", "5 3").replace("4 0 1 2 3", "3 0 1 2\n3 0 2 3"), ""),
        ("a.vtk", VTK, "polygons, array thickness and array age"),
        ("a.vtk", NEWER, "polygons, array thickness and array age"),
        ("a.vtk", VTK.partition("POINT_DATA")[0].replace("2 9\n4 0 1 2 3", "3 12\n3 0 1 2\n3 0 2 3"), ""),
    ],
)
def test_what_is_written_anew_is_told(tmp_path: Path, name: str, text: str, said: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        meshmatch.transfer_labels(path, path, [3, 3, 5, 5, 3]).save(tmp_path / "out.ply")
    assert [str(each.message) for each in told] == ([f"out.ply does not have the {said} of {name}"] if said else [])


def test_without_a_file_a_shape_is_written(target: Path) -> None:
    shape = meshmatch.load_shape(target)
    out = target.with_stem("out")
    meshmatch.transfer_labels(shape, shape, [3, 3, 5, 5, 3]).save(out)
    assert b"thickness" not in out.read_bytes()
    assert meshmatch.load_shape(out).F == 3


def test_a_ply_that_moves_keeps_its_polygons(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(PLY)
    shape = meshmatch.load_shape(tmp_path / "a.ply")
    moved = meshmatch.Shape(shape.verts + 1, shape.faces)
    save_moved(tmp_path / "b.ply", tmp_path / "a.ply", moved, np.tile(np.eye(3), (5, 1, 1)))
    assert is_kept(tmp_path / "b.ply")
    np.testing.assert_array_equal(meshmatch.load_shape(tmp_path / "b.ply").verts, shape.verts + 1)


def test_a_file_that_cannot_be_kept_is_told(target: Path) -> None:
    several = {
        ".ply": PLY.replace("element face 2", "element face 1").replace(
            "end_header", "element face 1\nproperty list uchar int vertex_indices\nend_header"
        ),
        ".vtp": VTP.replace('Polys="2"', 'Polys="2" NumberOfLines="0" NumberOfVerts="1"'),
    }
    target.write_text(several[target.suffix])
    count = meshmatch.load_shape(target).F
    with pytest.warns(MeshmatchWarning, match=f"^out{target.suffix} does not have the .* thickness of {target.name}$"):
        meshmatch.transfer_labels(target, target, [3] * count).save(target.with_stem("out"))
    target.unlink()
