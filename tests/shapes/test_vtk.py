"""VTK's files: what ParaView and 3D Slicer write comes in, what is written is theirs to read, and damage is told."""

import base64
import lzma
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch.collections.sources import find_sources
from meshmatch.collections.stores import Store
from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import vtk, vtk_xml
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.growth import grows_with_size

VERTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.0]])
QUAD_AND_TRIANGLE = np.array([0, 1, 2, 3, 0, 1, 4])
FACES = [[0, 1, 2], [0, 2, 3], [0, 1, 4]]
COLORS = (np.arange(20).reshape(5, 4) * 12).astype("u1")


def packed(data: bytes, form: str, width: str, pack: str) -> bytes:
    """Numbers as VTK's XML writers encode them."""
    if pack:
        half = 2 * max(len(data) // 4, 1)
        blocks = [data[k : k + half] for k in range(0, len(data), half)]
        small = [zlib.compress(block) if pack == "zlib" else lzma.compress(block) for block in blocks]
        last = len(blocks[-1]) % half
        head = np.array([len(blocks), half, last, *map(len, small)], width).tobytes()
        body = b"".join(small)
        return head + body if form == "raw" else base64.b64encode(head) + base64.b64encode(body)
    head = np.array([len(data)], width).tobytes()
    if form == "raw":
        return head + data
    return base64.b64encode(head + data) if form == "together" else base64.b64encode(head) + base64.b64encode(data)


def write_vtp(
    path: Path, form: str = "ascii", width: str = "<u4", pack: str = "", appended: bool = False, grid: bool = False
) -> None:
    order = {"<": "LittleEndian", ">": "BigEndian"}[width[0]]
    ends, kinds = np.array([4, 7]), np.array([9, 5])
    held = b""

    def element(name: str, values: np.ndarray, kind: str, more: str = "") -> str:
        nonlocal held
        head = f'<DataArray type="{kind}" Name="{name}" {more}'
        if form == "ascii":
            return f'{head} format="ascii">{" ".join(map(str, values.ravel().tolist()))}</DataArray>'
        data = packed(values.astype(values.dtype.newbyteorder(width[0])).tobytes(), form, width, pack)
        if not appended:
            return f'{head} format="binary">\n  {data.decode()}\n</DataArray>'
        at = len(held)
        held += data
        return f'{head} format="appended" offset="{at}"/>'

    three, four = 'NumberOfComponents="3"', 'NumberOfComponents="4"'
    cells = element("connectivity", QUAD_AND_TRIANGLE, "Int64") + element("offsets", ends, "Int64")
    cells += element("types", kinds.astype("u1"), "UInt8") if grid else ""
    pack_ = {"": "", "zlib": ' compressor="vtkZLibDataCompressor"', "lzma": ' compressor="vtkLZMADataCompressor"'}[pack]
    kind, group, count = ("UnstructuredGrid", "Cells", "Cells") if grid else ("PolyData", "Polys", "Polys")
    text = (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" byte_order="{order}" header_type="UInt{8 * int(width[2])}"{pack_}>'
        f'<{kind}><Piece NumberOfPoints="5" NumberOf{count}="2">'
        f"<PointData>{element('Colors', COLORS, 'UInt8', four)}</PointData>"
        f"<Points>{element('Points', VERTS, 'Float64', three)}</Points><{group}>{cells}</{group}></Piece></{kind}>"
    )
    encoding = "raw" if form == "raw" else "base64"
    tail = f'<AppendedData encoding="{encoding}">\n _'.encode() + held + b"</AppendedData>" if appended else b""
    path.write_bytes(text.encode() + tail + b"</VTKFile>")


def is_known(path: Path) -> None:
    shape = load_shape(path)
    np.testing.assert_allclose(shape.verts, VERTS)
    assert shape.faces.tolist() == FACES
    assert shape.colors is not None
    np.testing.assert_allclose(shape.colors * 255, COLORS)


@pytest.mark.parametrize("grid", [False, True])
@pytest.mark.parametrize("width", ["<u4", "<u8", ">u4"])
@pytest.mark.parametrize(
    ("form", "pack", "appended"),
    [
        *(("ascii", "", False), ("together", "", False), ("apart", "", False), ("apart", "zlib", False)),
        *(("raw", "", True), ("raw", "zlib", True), ("raw", "lzma", True), ("together", "", True)),
        *(("apart", "zlib", True), ("apart", "lzma", True)),
    ],
)
def test_all_that_xml_may_be(tmp_path: Path, form: str, pack: str, appended: bool, width: str, grid: bool) -> None:
    path = tmp_path / ("a.vtu" if grid else "a.vtp")
    write_vtp(path, form, width, pack, appended, grid)
    is_known(path)


def old(dataset: str = "POLYDATA", binary: bool = False, new: bool = False, colors: bool = True) -> bytes:
    def numbers(values: np.ndarray, kind: str) -> bytes:
        if binary:
            return values.astype(f">{kind}").tobytes() + b"\n"
        return " ".join(map(str, values.ravel().tolist())).encode() + b"\n"

    cells = np.array([4, 0, 1, 2, 3, 3, 0, 1, 4])
    word = "POLYGONS" if dataset == "POLYDATA" else "CELLS"
    parts = [f"# vtk DataFile Version 5.1\na title\n{'BINARY' if binary else 'ASCII'}\nDATASET {dataset}\n".encode()]
    parts += [b"POINTS 5 double\n", numbers(VERTS, "f8"), b"METADATA\nINFORMATION 0\n\n"]
    if new:
        parts += [f"{word} 3 7\nOFFSETS vtktypeint64\n".encode(), numbers(np.array([0, 4, 7]), "i8")]
        parts += [b"CONNECTIVITY vtktypeint64\n", numbers(QUAD_AND_TRIANGLE, "i8")]
    else:
        parts += [f"{word} 2 9\n".encode(), numbers(cells, "i4")]
    if dataset != "POLYDATA":
        parts += [b"CELL_TYPES 2\n", numbers(np.array([9, 5]), "i4")]
    parts += [b"\nPOINT_DATA 5\nNORMALS n float\n", numbers(VERTS, "f4")]
    if colors:
        parts += [b"COLOR_SCALARS c 4\n", numbers(COLORS if binary else COLORS / 255.0, "u1")]
    return b"".join(parts)


@pytest.mark.parametrize("dataset", ["POLYDATA", "UNSTRUCTURED_GRID"])
@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("new", [False, True])
def test_the_older_files(tmp_path: Path, dataset: str, binary: bool, new: bool) -> None:
    (tmp_path / "a.vtk").write_bytes(old(dataset, binary, new))
    is_known(tmp_path / "a.vtk")
    (tmp_path / "b.vtk").write_bytes(old(dataset, binary, new, colors=False))
    assert load_shape(tmp_path / "b.vtk").colors is None


@pytest.mark.parametrize("first", [False, True])
def test_colors_of_cells_are_not_those_of_points(tmp_path: Path, first: bool) -> None:
    data = old(colors=True)
    begin = data.index(b"\nPOINT_DATA")
    cells = b"\nCELL_DATA 2\nCOLOR_SCALARS c 4\n1 0 0 1 1 0 0 1\n"
    (tmp_path / "a.vtk").write_bytes(data[:begin] + cells + data[begin:] if first else data + cells)
    is_known(tmp_path / "a.vtk")
    (tmp_path / "b.vtk").write_bytes(data[:begin] + cells)
    assert load_shape(tmp_path / "b.vtk").colors is None


def test_fields_between_sections_lose_no_faces(tmp_path: Path) -> None:
    field = b"FIELD FieldData 1\nAB 1 2 double\n1 2\n"
    for section in (b"POINTS 5", b"POLYGONS 2"):
        (tmp_path / "a.vtk").write_bytes(old().replace(section, field + section))
        is_known(tmp_path / "a.vtk")


def test_strips_pixels_and_what_is_no_face(tmp_path: Path) -> None:
    head = b"# vtk DataFile Version 3.0\nx\nASCII\n"
    points = b"POINTS 5 float\n0 0 0 1 0 0 0 1 0 1 1 0 0 2 0\n"
    (tmp_path / "strip.vtk").write_bytes(head + b"DATASET POLYDATA\n" + points + b"TRIANGLE_STRIPS 1 6\n5 0 1 2 3 4\n")
    assert load_shape(tmp_path / "strip.vtk").faces.tolist() == [[0, 1, 2], [2, 1, 3], [2, 3, 4]]
    grid = head + b"DATASET UNSTRUCTURED_GRID\n" + points
    (tmp_path / "pixel.vtk").write_bytes(grid + b"CELLS 2 8\n4 0 1 2 3 2 3 4\nCELL_TYPES 2\n8 3\n")
    with pytest.warns(MeshmatchWarning, match="lines are not faces"):
        assert load_shape(tmp_path / "pixel.vtk").faces.tolist() == [[0, 1, 3], [0, 3, 2]]
    (tmp_path / "tetra.vtk").write_bytes(grid + b"CELLS 1 5\n4 0 1 2 3\nCELL_TYPES 1\n10\n")
    with pytest.raises(InputError, match="cells of VTK type 10") as caught:
        load_shape(tmp_path / "tetra.vtk")
    assert "Extract Surface" in str(caught.value.hint)
    (tmp_path / "cloud.vtk").write_bytes(head + b"DATASET POLYDATA\n" + points)
    assert load_shape(tmp_path / "cloud.vtk").is_cloud


@pytest.mark.parametrize("suffix", [".vtk", ".vtp"])
def test_what_is_written_comes_back(tmp_path: Path, suffix: str) -> None:
    sphere = icosphere(2)
    colors = np.random.default_rng(0).integers(0, 256, (sphere.V, 4)) / 255
    shape = Shape(sphere.verts * 1e-20 + 1e7, sphere.faces, "s", colors)
    save_shape(tmp_path / f"a{suffix}", shape)
    again = load_shape(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(again.verts, shape.verts)
    np.testing.assert_array_equal(again.faces, shape.faces)
    np.testing.assert_allclose(again.colors, colors)
    cloud = Shape(sphere.verts, np.empty((0, 3), np.int64))
    save_shape(tmp_path / f"c{suffix}", cloud)
    assert load_shape(tmp_path / f"c{suffix}").is_cloud


@pytest.mark.parametrize(("write", "suffix"), [(vtk.write_vtk, "vtk"), (vtk.write_vtp, "vtp")])
def test_vtk_itself_reads_the_data_of_vertices(tmp_path: Path, write: object, suffix: str) -> None:
    io = pytest.importorskip("vtkmodules.vtkIOXML" if suffix == "vtp" else "vtkmodules.vtkIOLegacy")
    shape = icosphere(2)
    values = {"label": np.arange(shape.V) % 7, "two words": shape.verts, 'odd "<&>"': shape.verts[:, 0].astype("f4")}
    path = tmp_path / f"a.{suffix}"
    write(path, shape, values)  # type: ignore[operator]
    reader = io.vtkXMLPolyDataReader() if suffix == "vtp" else io.vtkPolyDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    found = reader.GetOutput()
    data = found.GetPointData()
    assert (found.GetNumberOfPoints(), found.GetNumberOfPolys()) == (shape.V, shape.F)
    assert [data.GetArray(k).GetRange()[1] for k in range(3)] == pytest.approx([each.max() for each in values.values()])


BOMB = zlib.compress(bytes(300_000_000))


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.vtp", b"<VTKFile type='ImageData'/>", "holds ImageData, not a surface"),
        ("a.vtp", b"<VTKFile type='PolyData'><PolyData>", "it is not XML"),
        ("a.vtp", b"<!DOCTYPE x [<!ENTITY a 'b'>]><VTKFile type='PolyData'/>", "has a document type"),
        ("a.vtp", b"<VTKFile type='PolyData'/>", "no vertices"),
        ("a.vtk", b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\n", "holds STRUCTURED_POINTS"),
        (
            "a.vtk",
            b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET POLYDATA\nPOINTS 9 float\n1 2 3\n",
            "3 numbers where 27",
        ),
        ("a.vtk", b"# vtk DataFile Version 3.0\nx\nBINARY\nDATASET POLYDATA\nPOINTS 999999 float\n123", "ends before"),
        ("a.vtk", old().replace(b"POLYGONS 2 9", b"POLYGONS 3 9"), "a cell has fewer points"),
        ("a.vtk", old().replace(b"4 0 1 2 3", b"4 0 1 2 9"), "refers to vertex 9"),
        ("a.vtk", old().replace(b"POINTS 5", b"POINTS 99999999999"), "vertices and faces"),
        ("a.vtk", old().replace(b"POLYGONS", b"POLYGONES"), "where a section should begin"),
        ("a.vtk", old().replace(b"3 0 1 4", b"3 0 1 1.5"), "not an integer"),
        ("a.vtk", old(new=True).replace(b"\n0 4 7", b"\n1 4 7"), "does not begin at the first"),
        ("a.vtp", "<!DOCTYPE x [<!ENTITY a 'b'>]><VTKFile type='PolyData'/>".encode("utf-16"), "another encoding"),
        ("a.vtp", b"<?xml version='1.0' encoding='utf-7'?><VTKFile type='PolyData'/>", "another encoding"),
        ("a.vtp", b"<AppendedData " * 200_000, "it is not XML"),
    ],
)
def test_damage_is_told(tmp_path: Path, name: str, content: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        load_shape(tmp_path / name)


def test_nothing_is_unpacked_beyond_what_the_file_can_mean(tmp_path: Path) -> None:
    head = np.array([1, 3_000_000_000, 0, len(BOMB)], "<u4").tobytes()
    text = base64.b64encode(head) + base64.b64encode(BOMB)
    write_vtp(tmp_path / "a.vtp", "apart", "<u4", "zlib")
    data = (tmp_path / "a.vtp").read_bytes()
    begin = data.index(b">", data.index(b'Name="Points"')) + 1
    (tmp_path / "a.vtp").write_bytes(data[:begin] + text + data[data.index(b"</DataArray>", begin) :])
    with pytest.raises(InputError, match="more than points and faces can need"):
        load_shape(tmp_path / "a.vtp")


def test_nothing_is_read_again_and_again(tmp_path: Path) -> None:
    """Pieces that share one array cost no more than a file of their size may."""
    piece = (
        '<Piece NumberOfPoints="0" NumberOfPolys="1"><Points><DataArray type="Float32" format="ascii"/></Points><Polys>'
        '<DataArray type="UInt8" Name="connectivity" format="appended" offset="0"/>'
        '<DataArray type="UInt8" Name="offsets" format="appended" offset="0"/></Polys></Piece>'
    )
    head = '<VTKFile type="PolyData" byte_order="LittleEndian"><PolyData>' + 200 * piece + "</PolyData>"
    held = np.array([4_000_000], "<u4").tobytes() + bytes(4_000_000)
    tail = b'<AppendedData encoding="raw">_' + held + b"</AppendedData></VTKFile>"
    (tmp_path / "a.vtp").write_bytes(head.encode() + tail)
    with pytest.raises(InputError, match="other than the 1 cells"):
        load_shape(tmp_path / "a.vtp")
    long = '<DataArray type="UInt32" Name="offsets" format="ascii">3000000</DataArray>'
    (tmp_path / "c.vtp").write_bytes(
        head.replace('<DataArray type="UInt8" Name="offsets" format="appended" offset="0"/>', long).encode() + tail
    )
    with pytest.raises(InputError, match="vertices and faces"):
        load_shape(tmp_path / "c.vtp")
    paint = '<PointData><DataArray type="UInt8" NumberOfComponents="4" format="appended" offset="0"/></PointData>'
    painted = head.replace('NumberOfPolys="1">', f'NumberOfPolys="0">{paint}').encode() + tail
    (tmp_path / "d.vtp").write_bytes(painted)
    with pytest.raises(InputError, match="more than points and faces can need"):
        load_shape(tmp_path / "d.vtp")
    many = head.replace('NumberOfPolys="1"', 'NumberOfPolys="4000000"').encode() + tail
    (tmp_path / "b.vtp").write_bytes(many)
    with pytest.raises(InputError, match="vertices and faces"):
        load_shape(tmp_path / "b.vtp")


def test_many_arrays_in_a_long_tail(tmp_path: Path) -> None:
    """None takes a copy of all that lies behind where it begins."""

    def prepared(count: int) -> Callable[[], dict[str, Any]]:
        array = '<DataArray type="Float32" Name="{}" format="appended" offset="4"/>'
        arrays = "".join(array.format(k) for k in range(count))
        head = '<VTKFile type="PolyData" byte_order="LittleEndian"><PolyData>'
        piece = f'<Piece NumberOfPoints="1"><PointData>{arrays}</PointData></Piece></PolyData>'
        held = b"AAAA" + packed(np.array([2.5], "<f4").tobytes(), "apart", "<u4", "") + b"A" * 2_500 * count
        tail = b'<AppendedData encoding="base64">_' + held + b"</AppendedData></VTKFile>"
        (tmp_path / "a.vtp").write_bytes((head + piece).encode() + tail)
        return lambda: vtk_xml.point_arrays(tmp_path / "a.vtp")

    found = grows_with_size(prepared, 3000)
    assert len(found) == 3000 and all(values.tolist() == [2.5] for values in found.values())


def test_a_piece_does_not_take_the_vertices_of_another(tmp_path: Path) -> None:
    write_vtp(tmp_path / "a.vtp")
    text = (tmp_path / "a.vtp").read_text()
    begin, end = text.index("<Piece"), text.index("</Piece>") + len("</Piece>")
    piece = text[begin:end]
    (tmp_path / "b.vtp").write_text(text[:end] + piece + text[end:])
    assert load_shape(tmp_path / "b.vtp").faces.tolist() == [*FACES[:2], FACES[2], *(np.array(FACES) + 5).tolist()]
    wrong = piece.replace(">0 1 2 3 0 1 4<", ">0 1 2 3 0 1 -1<")
    (tmp_path / "c.vtp").write_text(text[:end] + wrong + text[end:])
    with pytest.raises(InputError, match="refers to vertex -1"):
        load_shape(tmp_path / "c.vtp")


def test_other_compressors_are_named(tmp_path: Path) -> None:
    write_vtp(tmp_path / "a.vtp", "apart", "<u4", "zlib")
    data = (tmp_path / "a.vtp").read_bytes().replace(b"vtkZLibDataCompressor", b"vtkLZ4DataCompressor")
    (tmp_path / "a.vtp").write_bytes(data)
    with pytest.raises(InputError, match="compressed by vtkLZ4DataCompressor"):
        load_shape(tmp_path / "a.vtp")


def test_a_folder_of_them_is_fitted_whole(tmp_path: Path) -> None:
    for name in ("a.vtk", "b.vtp", "c.ply"):
        save_shape(tmp_path / name, icosphere(1))
    for name in ("c.mtl", "c.wrl", "a.zip", "notes.txt", "README", "scan.wrl", "volume.dcm", "IM0001", "more.zip"):
        (tmp_path / name).write_text("something")
    unknown = ["IM0001", "more.zip", "volume.dcm"]
    with pytest.warns(MeshmatchWarning) as warned:
        found, left_out = find_sources(tmp_path, Store.of(tmp_path / "out"))
    first, second = (str(each.message) for each in warned)
    assert first.endswith("shapes in formats that are not read are left out: scan.wrl")
    assert second.endswith(f"files of unknown format are left out: {', '.join(unknown)}")
    verdicts = dict.fromkeys((*unknown, "README", "notes.txt"), "left out") | {"scan.wrl": "failed"}
    assert {record.name: record.verdict for record in left_out} == verdicts
    assert [source.file for source in found] == ["a.vtk", "b.vtp", "c.ply"]
    assert meshmatch.load_shape(tmp_path / "b.vtp").F == icosphere(1).F
