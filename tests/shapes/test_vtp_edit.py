"""A .vtp that gets arrays keeps all else: polygons, arrays of points and cells, and how its numbers are written."""

import zlib
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import MeshmatchWarning
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import vtk
from meshmatch.shapes.formats.vtk_xml import _File
from meshmatch.shapes.formats.vtp_edit import VtpFile
from meshmatch.shapes.shape import Shape

PLACES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0.5, 0]])


def appended(*arrays: np.ndarray) -> tuple[list[int], bytes]:
    """Raw blocks that zlib compressed, and where each begins."""
    places, out = [], b""
    for array in arrays:
        data = array.tobytes()
        packed = zlib.compress(data)
        places.append(len(out))
        out += np.array([1, len(data), 0, len(packed)], "<u4").tobytes() + packed
    return places, out


def example(data: str = "<PointData Scalars='t'>\n{}</PointData>", more: str = "") -> bytes:
    """A quad and a triangle with thicknesses, as ParaView writes them."""
    arrays = PLACES, np.arange(5) / 3, np.array([0, 1, 2, 3, 1, 4, 2]), np.array([4, 7])
    at, blocks = appended(*arrays)
    thick = f'<DataArray type="Float64" Name="thickness" format="appended" offset="{at[1]}"/>\n'
    return (
        (
            '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="0.1" byte_order="LittleEndian" header_type="UInt32" '
            'compressor="vtkZLibDataCompressor">\n<PolyData>\n<Piece NumberOfPoints="5" NumberOfPolys="2">\n'
            + data.format(thick)
            + more
            + f'<Points><DataArray type="Float64" NumberOfComponents="3" format="appended" offset="{at[0]}"/></Points>\n'
            f'<Polys><DataArray type="Int64" Name="connectivity" format="appended" offset="{at[2]}"/>\n'
            f'<DataArray type="Int64" Name="offsets" format="appended" offset="{at[3]}"/></Polys>\n'
            '</Piece></PolyData>\n<AppendedData encoding="raw">\n_'
        ).encode()
        + blocks
        + b"\n</AppendedData></VTKFile>\n"
    )


def arrays_of(data: bytes, group: str) -> dict[str, np.ndarray]:
    file = _File("a.vtp", data)
    found = file.root.findall(f"./*/Piece/{group}/DataArray")
    return {str(each.get("Name")): file._array(each) for each in found}


@pytest.mark.parametrize("data", ["<PointData Scalars='t'>\n{}</PointData>", "<PointData/>", ""])
def test_arrays_of_points_are_added_and_all_else_stays(data: str, tmp_path: Path) -> None:
    before = example(data)
    after = VtpFile.parsed("a.vtp", before).with_arrays(
        {"a <b>": np.arange(5) / 7, "Colors": np.full((5, 3), 9, np.uint8)}, {}, ["m"]
    )
    found = arrays_of(after, "PointData")
    np.testing.assert_array_equal(found["a <b>"], np.arange(5) / 7)
    if "{}" in data:
        np.testing.assert_array_equal(found["thickness"], np.arange(5) / 3)
    assert b"<!-- m -->" in after
    assert after.endswith(before[before.index(b"<Points>") :])
    path = tmp_path / "a.vtp"
    path.write_bytes(after)
    shape = load_shape(path)
    np.testing.assert_array_equal(shape.verts, PLACES)
    np.testing.assert_allclose(shape.colors, [[9 / 255] * 3 + [1.0]] * 5)
    same = VtpFile.of(path, shape)
    assert same is not None
    assert same.data == after


def test_a_cell_has_what_most_of_its_triangles_have(tmp_path: Path) -> None:
    path = tmp_path / "a.vtp"
    path.write_bytes(example())
    shape = load_shape(path)
    file = VtpFile.of(path, shape, faces=True)
    assert file is not None
    after = file.with_arrays({}, {"label": np.array([4, 4, 7], np.int32)})
    np.testing.assert_array_equal(arrays_of(after, "CellData")["label"], [4, 7])
    again = VtpFile.parsed("a.vtp", after).with_arrays({"x": np.ones(5)}, {})
    np.testing.assert_array_equal(arrays_of(again, "CellData")["label"], [4, 7])


def test_what_is_replaced_is_said() -> None:
    with pytest.warns(MeshmatchWarning, match="a.vtp has an array thickness already, which is replaced"):
        after = VtpFile.parsed("a.vtp", example()).with_arrays({"thickness": np.ones(5)}, {})
    np.testing.assert_array_equal(arrays_of(after, "PointData")["thickness"], 1.0)


def test_files_that_cannot_be_edited_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "a.vtp"
    path.write_bytes(example())
    shape = load_shape(path)
    path.write_bytes(example().replace(b'NumberOfPolys="2"', b'NumberOfPolys="2" NumberOfLines="1"'))
    assert VtpFile.of(path, shape, faces=True) is None
    assert VtpFile.of(path, shape) is not None
    pieces = example().replace(b"</Piece>", b"</Piece><Piece></Piece>")
    path.write_bytes(pieces)
    assert VtpFile.of(path, shape) is None
    assert VtpFile.of(tmp_path / "a.ply", shape) is None


def test_what_the_package_wrote_can_be_edited(tmp_path: Path) -> None:
    path = tmp_path / "a.vtp"
    path.write_bytes(example())
    shape = load_shape(path)
    vtk.write_vtp(path, shape, {"height": shape.verts[:, 1]})
    file = VtpFile.of(path, shape)
    assert file is not None
    found = arrays_of(file.with_arrays({"label": np.arange(5)}, {}), "PointData")
    np.testing.assert_array_equal(found["height"], PLACES[:, 1])
    np.testing.assert_array_equal(found["label"], np.arange(5))


TRAPS = {
    "comment": (b"<Piece ", b"<!-- <Piece> <PointData> </PointData> --><Piece "),
    "closed with a space": (b"</PointData>", b"</PointData >"),
    "a sign in an attribute": (b"Scalars='t'", b"Scalars='a>b'"),
    "a comment inside": (b"</PointData>", b"<!-- </PointData> --></PointData>"),
    "cdata": (b"<Points>", b"<FieldData><![CDATA[ <CellData> ]]></FieldData><Points>"),
}


@pytest.mark.parametrize("trap", TRAPS)
def test_what_only_looks_like_a_tag_is_none(trap: str, tmp_path: Path) -> None:
    path = tmp_path / "a.vtp"
    path.write_bytes(example().replace(*TRAPS[trap]))
    file = VtpFile.of(path, load_shape(path), faces=True)
    assert file is not None
    after = file.with_arrays({"é": np.arange(5.0)}, {}, ["label 0 a---x\x01"])
    after = VtpFile.parsed("a.vtp", after).with_arrays({}, {"label": np.array([4, 4, 7], np.int32)}, ["label 0 b"])
    np.testing.assert_array_equal(arrays_of(after, "PointData")["é"], np.arange(5.0))
    np.testing.assert_array_equal(arrays_of(after, "PointData")["thickness"], np.arange(5) / 3)
    np.testing.assert_array_equal(arrays_of(after, "CellData")["label"], [4, 7])
    assert after.count(b"<!-- label 0") == 1


def test_an_array_is_replaced_however_its_name_is_written(tmp_path: Path) -> None:
    old = "<PointData>{}<DataArray type='Int32' Name = 'a&amp;b' format='ascii'>1 2 3 4 5</DataArray ></PointData>"
    with pytest.warns(MeshmatchWarning, match="a.vtp has an array a&b already"):
        after = VtpFile.parsed("a.vtp", example(old)).with_arrays({"a&b": np.full(5, 9)}, {})
    assert list(arrays_of(after, "PointData")) == ["thickness", "a&b"]
    np.testing.assert_array_equal(arrays_of(after, "PointData")["a&b"], 9)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("header", ["UInt32", "UInt64"])
@pytest.mark.parametrize("packed", ["", 'compressor="vtkZLibDataCompressor"', 'compressor="vtkLZMADataCompressor"'])
def test_arrays_are_written_as_those_of_the_file(order: str, header: str, packed: str) -> None:
    points = " ".join(str(each) for each in PLACES.ravel())
    data = (
        f'<VTKFile type="PolyData" byte_order="{"Big" if order == ">" else "Little"}Endian" header_type="{header}" {packed}>'
        f'<PolyData><Piece NumberOfPoints="5"><Points><DataArray type="Float64" NumberOfComponents="3">{points}</DataArray>'
        "</Points></Piece></PolyData></VTKFile>"
    ).encode()
    values = np.array([1.5, np.nan, np.inf, -2.0, 0.0])
    after = VtpFile.parsed("a.vtp", data).with_arrays({"v": values, "n": np.arange(10).reshape(5, 2)}, {})
    np.testing.assert_array_equal(arrays_of(after, "PointData")["v"], values)
    np.testing.assert_array_equal(arrays_of(after, "PointData")["n"], np.arange(10))


def test_a_file_that_has_changed_is_not_edited(tmp_path: Path) -> None:
    path = tmp_path / "a.vtp"
    path.write_bytes(example())
    shape = load_shape(path)
    assert VtpFile.of(path, Shape(shape.verts + 1, shape.faces)) is None
    assert VtpFile.of(path, Shape(shape.verts, shape.faces[:1]), faces=True) is None
    path.unlink()
    assert VtpFile.of(path, shape) is None
