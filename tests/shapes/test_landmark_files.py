"""The same landmarks in the formats of other programs, on a shape and for a folder of shapes."""

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchWarning
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.landmark_files import mesh_space, read_landmark_file
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepared_folder import KnownPoints, read_known_points, read_landmarks, sort_by_name
from meshmatch.transfer.landmarks import at_vertices, load_landmarks, push_landmarks, save_landmarks
from tests.conftest import icosphere

SHAPE = icosphere(1)
VERTICES = np.array([5, 0, 17])
POINTS = SHAPE.verts[VERTICES]
NAMES = ("tip", "left ear", "b, c")


def rows(form: str, comma: bool = False) -> str:
    """A line for each landmark of k, name, x, y and z."""
    texts = ([repr(float(x)).replace(".", "," if comma else ".") for x in point] for point in POINTS)
    return "".join(form.format(k, name, *xyz) + "\n" for k, (name, xyz) in enumerate(zip(NAMES, texts, strict=True)))


def markups(space: str = "LPS", flip: float = 1.0) -> str:
    points = [
        {"id": f"{k}", "label": name, "position": [flip * x, flip * y, z], "positionStatus": "defined"}
        for k, (name, (x, y, z)) in enumerate(zip(NAMES, POINTS.tolist(), strict=True))
    ]
    unset = {"label": "unset", "position": [0, 0, 0], "positionStatus": "undefined"}
    return json.dumps({"markups": [{"type": "Fiducial", "coordinateSystem": space, "controlPoints": [*points, unset]}]})


FCSV = (
    "# Markups fiducial file version = 4.11\n# CoordinateSystem = {}\n"
    "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
)
AMIRA = "# Avizo 3D ASCII 2.0\ndefine Markers {}\nMarkers {{ float[3] Coordinates }} @1\n{}"
FILES = {
    "Slicer's markups": ("a.mrk.json", markups()),
    "Slicer's fiducials": ("a.fcsv", FCSV.format("LPS") + rows('{0},{2},{3},{4},0,0,0,1,1,1,0,"{1}",,')),
    "German Excel": ("a.csv", "Name;X;Y;Z\n" + rows("{1};{2};{3};{4}", comma=True)),
    "columns of other names": ("a.csv", "point;px;py;pz\n" + rows('"{1}";{2};{3};{4}')),
    "label for a name": ("a.csv", "id,label,x,y,z\n" + rows('{0},"{1}",{2},{3},{4}')),
    "a missing one": ("a.csv", "name,x,y,z\nnone,nan,NA,\n" + rows('"{1}",{2},{3},{4}')),
    "positions": ("a.txt", rows("{2} {3} {4}")),
    "positions with decimal commas": ("a.txt", rows("{2} {3} {4}", comma=True)),
    "vertices of pandas": (
        "a.csv",
        "name,vertex\n" + "".join(f'"{n}",{v}.0\n' for n, v in zip(NAMES, VERTICES, strict=True)),
    ),
    "vertices, one missing": ("a.txt", "".join(f"{v}\n" for v in VERTICES) + "-1\n"),
    "IBUG": ("a.pts", "version: 1\nn_points: 3\n{{\n".replace("{{", "{") + rows("{2} {3} {4}") + "}\n"),
    "Landmark": ("a.pts", "Version 1.0\n4\n" + rows("S00{0} {2} {3} {4}") + "S003 9999.0 9999.0 9999.0\n"),
    "tps": ("a.tps", "LM3=4\n" + rows("{2} {3} {4}") + "NA NA NA\nID=a\n"),
    "tps of several": ("a.tps", "LM3=1\n0 0 9\nID=other\nLM3=3\n" + rows("{2} {3} {4}") + "ID=sphere1\n"),
    "tps of names with dots": (
        "a.tps",
        "LM3=1\n0 0 9\nID=sphere1.left\nLM3=3\n" + rows("{2} {3} {4}") + "ID=sphere1\n",
    ),
    "Morphologika": (
        "a.txt",
        "[individuals]\n2\n[landmarks]\n3\n[dimensions]\n3\n[names]\nother\nsphere1\n[labels]\nsex\n[rawpoints]\n'#1\n"
        + "9 9 9\n" * 3
        + "\n'#2\n"
        + rows("{2} {3} {4}"),
    ),
    "Amira": (
        "a.landmarkAscii",
        AMIRA.format(3, 'Parameters { NumSets 1, ContentType "LandmarkSet" }\n# Data section follows\n@1\n')
        + rows("{2} {3} {4} "),
    ),
    "a table of specimens": ("a.csv", "specimen,landmark,x,y,z\nother,a,9,9,9\n" + rows('sphere1,"{1}",{2},{3},{4}')),
    "picked with commas": (
        "a.pp",
        "<PickedPoints>" + rows('<point x="{2}" y="{3}" z="{4}" name="{1}"/>', comma=True) + "</PickedPoints>",
    ),
    "Slicer's fiducials with semicolons": (
        "a.fcsv",
        FCSV.format("LPS").replace(",", ";") + rows('{0};{2};{3};{4};0;0;0;1;1;1;0;"{1}";;', comma=True) + ";;;\n",
    ),
    "Slicer's markups beside a region": (
        "a.mrk.json",
        markups().replace(
            '{"markups": [', '{"markups": [{"type": "ROI", "coordinateSystem": "LPS", "center": [0, 0, 0]}, '
        ),
    ),
    "points with commas": ("a.pts", rows("{2}, {3}, {4}")),
    "tps of a Windows folder": (
        "a.tps",
        "LM3=1\n0 0 9\nID=other\nLM=3\n" + rows("{2} {3} {4}") + "IMAGE=D:\\in\\sphere1.ply\n",
    ),
    "vertices as floats": ("a.json", json.dumps(VERTICES.astype(float).tolist())),
    "json by axes": ("a.json", json.dumps([dict(zip("xyz", p, strict=True)) for p in POINTS.tolist()])),
}


@pytest.mark.parametrize("case", FILES)
def test_landmarks_of_other_programs(tmp_path: Path, case: str) -> None:
    """On a shape, and as `prepare` reads them, which keeps the rows of missing ones."""
    name, content = FILES[case]
    (tmp_path / name).write_text(content, encoding="utf-8")
    found, distance = load_landmarks(tmp_path / name, SHAPE)
    assert np.allclose(found.points, POINTS, atol=1e-12) and distance < 1e-9
    known = read_landmarks(tmp_path / name, repair(SHAPE))
    assert np.allclose(known[np.isfinite(known).all(axis=1)], POINTS, atol=1e-12)
    assert len(known) - len(found.points) == len(found.notes)
    if "Slicer" in case or "German" in case or case.startswith(("columns", "label", "a missing", "vertices of")):
        assert found.names == NAMES


@pytest.mark.parametrize("array", [VERTICES, VERTICES[:, None], VERTICES.astype(float), POINTS])
def test_arrays(tmp_path: Path, array: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", array)
    assert np.allclose(load_landmarks(tmp_path / "a.npy", SHAPE)[0].points, POINTS)
    broken = np.vstack([POINTS, np.full((1, 3), np.nan)])
    np.save(tmp_path / "b.npy", broken)
    found, _ = load_landmarks(tmp_path / "b.npy", SHAPE)
    assert len(found.names) == 3 and found.notes == ("landmark 3 has no position: left out",)


@pytest.mark.parametrize("stated", ["", "LPS", "RAS"])
@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_frames_of_slicer(tmp_path: Path, stated: str, space: str) -> None:
    """Points are turned where the mesh says that it is in the other frame, and it is said."""
    save_shape(tmp_path / "a.ply", SHAPE)
    if stated:
        data = (tmp_path / "a.ply").read_bytes()
        comment = f"\ncomment 3D Slicer output. SPACE={stated}\nelement vertex".encode()
        (tmp_path / "a.ply").write_bytes(data.replace(b"\nelement vertex", comment, 1))
    assert mesh_space(tmp_path / "a.ply") == stated
    differs = stated not in ("", space)
    (tmp_path / "a.mrk.json").write_text(markups(space, -1.0 if differs else 1.0))
    found, _ = load_landmarks(tmp_path / "a.mrk.json", SHAPE, mesh_space(tmp_path / "a.ply"))
    assert np.allclose(found.points, POINTS, atol=1e-12)
    assert any("x and y change their signs" in note for note in found.notes) is differs
    with (
        pytest.warns(MeshmatchWarning, match=f"a.mrk.json is in {space}, .* is in {stated}")
        if differs
        else nullcontext()
    ):
        known = read_known_points(tmp_path / "a.mrk.json", repair(SHAPE), mesh_space(tmp_path / "a.ply"))
    assert np.allclose(known.points[:3], POINTS) and known.names == (*NAMES, "unset")


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_a_mesh_that_states_no_frame_has_that_of_landmarks_on_it(tmp_path: Path, space: str) -> None:
    """Else the nearest points of the other side would be taken, or none."""
    for place in ([0.0, 0.0, 0.0], [3.0, 9.0, 0.0]):
        there = Shape(SHAPE.verts * [1.0, 0.7, 1.0] + [0.2, 0.1, 0.0] + place, SHAPE.faces, "a.ply")
        points = there.verts[VERTICES]
        for signs in ([1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]):
            save_landmarks(tmp_path / "a.mrk.json", replace(at_vertices(there, VERTICES), points=points * signs), space)
            found, distance = load_landmarks(tmp_path / "a.mrk.json", there)
            assert np.allclose(found.points, points) and distance < 1e-9
            why = f"a.mrk.json is in {space}: x and y change their signs, because its landmarks then lie on a.ply"
            assert found.notes == ((why,) if signs[0] < 0 else ())


@pytest.mark.parametrize("suffix", [".fcsv", ".mrk.json"])
@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_what_slicer_gets_states_its_frame(tmp_path: Path, suffix: str, space: str) -> None:
    path = tmp_path / f"a{suffix}"
    save_landmarks(path, at_vertices(SHAPE, VERTICES, NAMES), "RAS" if space == "RAS" else "LPS")
    found = read_landmark_file(path)
    assert (found.space, found.has_names) == (space, True)
    assert [place.name for place in found.places] == list(NAMES)
    assert np.array_equal([place.where for place in found.places], POINTS)


def test_curves_of_slicer_stay_curves(tmp_path: Path) -> None:
    """Semi-landmarks of a curve are one on every specimen; a plane's points do not say all about it."""
    kinds = ["Curve", "Plane", "ClosedCurve", "Curve"]
    given = json.loads(markups())["markups"][0]
    given = {"markups": [given | {"type": kind} for kind in kinds]}
    (tmp_path / "a.mrk.json").write_text(json.dumps(given))
    found, _ = load_landmarks(tmp_path / "a.mrk.json", SHAPE)
    pushed = push_landmarks(VertexMap.identity(SHAPE), SHAPE, SHAPE, found)
    save_landmarks(tmp_path / "b.mrk.json", pushed)
    lists = json.loads((tmp_path / "b.mrk.json").read_text())["markups"]
    assert [each["type"] for each in lists] == ["Curve", "Fiducial", "ClosedCurve", "Curve"]
    assert [[point["label"] for point in each["controlPoints"]] for each in lists] == 4 * [list(NAMES)]
    ids = [point["id"] for each in lists for point in each["controlPoints"]]
    assert ids == [str(k + 1) for k in range(4 * len(NAMES))]


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.tps", "LM=2\n1 2\n3 4\nID=a\n", "lie in a plane"),
        ("a.tps", "LM3=1\n0 0 1\nID=a\nLM3=1\n0 0 1\nID=b\n", "landmarks of 2 shapes, 0 of them of sphere1"),
        ("a.tps", "0 0 1\n", "it begins with"),
        ("a.csv", "specimen,x,y,z\na,0,0,1\nb,0,0,1\n", "landmarks of 2 shapes, 0 of them of sphere1"),
        ("a.txt", "[individuals]\n1\n[landmarks]\n2\n[rawpoints]\n0 0 1\n0 1 0\n", "does not say how many"),
        ("a.txt", "[individuals]\n1\n[landmarks]\n2\n[dimensions]\n2\n[rawpoints]\n0 0\n0 1\n", "have 2 dimensions"),
        ("a.txt", "[individuals]\n9\n[landmarks]\n2\n[dimensions]\n3\n[rawpoints]\n0 0 1\n", "it has 1 points, not 2"),
        ("a.pts", "version: 1\nn_points: 1\n{\n1 2\n}\n", "lie in a plane"),
        ("a.pts", "0 0 1 255 255 255 255\n", "is not a point"),
        ("a.fcsv", "# CoordinateSystem = IJK\n1,0,0,1\n", "not LPS or RAS"),
        ("a.fcsv", "# columns = id,x,y,z,label\n1,0,46,1,2,3,4,L\n", "8 cells, but there are 5 columns"),
        ("a.landmarkAscii", "# AmiraMesh 3D ASCII 2.0\ndefine Lattice 2\n", "not the text of a set of landmarks"),
        ("a.landmarkAscii", AMIRA.format(2, "@1\n0 0 1\n"), "has 1 landmarks, but declares 2"),
        ("a.landmarkAscii", AMIRA.format(1, "Markers { float[3] Other } @2\n@1\n0 0 1\n@2\n0 0 1\n"), "2 sets of"),
        ("a.json", '{"markups": [{"controlPoints": 7}]}', "no list of control points"),
        ("a.json", '{"nose": [0,46, 1,2, 3,4]}', "three numbers are needed"),
        ("a.csv", "name,x,y,z\nnose,0,46,1,2,3,4\n", "line 2 has 7 cells, the first 4"),
        ("a.csv", "name,x,y,z\na,nan,0,0\nb,0,nan,0\n", "landmark a has no position, and 1 more are missing"),
    ],
)
def test_what_is_refused_in_words(tmp_path: Path, name: str, content: str, told: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=told) as caught:
        load_landmarks(tmp_path / name, SHAPE)
    if "46" in content:
        assert "decimal comma" in caught.value.hint


def test_points_of_a_folder_are_ordered_by_their_names() -> None:
    first = KnownPoints(POINTS, ("a", "b", "c"))
    second = KnownPoints(POINTS[::-1], ("c", "b", "a"))
    fewer = KnownPoints(POINTS[1:], ("b", "c"))
    found = sort_by_name([first, None, second, fewer])
    assert found[1] is None
    assert all(each is not None and np.array_equal(each[1:], POINTS[1:]) for each in (found[0], found[2], found[3]))
    assert found[3] is not None and np.isnan(found[3][0]).all()
    bare = KnownPoints(POINTS[::-1], ())
    for others in ([first, bare], [first, KnownPoints(POINTS, ("x", "y", "z"))]):
        assert [np.array_equal(each, one.points) for each, one in zip(sort_by_name(others), others, strict=True)] == [
            True
        ] * 2
