"""Landmarks: forward along a map, in and out of files."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.landmarks import (
    LANDMARK_SUFFIXES,
    Landmarks,
    at_faces,
    at_points,
    at_vertices,
    join_landmarks,
    landmark_positions,
    load_landmarks,
    push_landmarks,
    save_landmarks,
    save_specimens,
)
from tests.conftest import icosphere
from tests.transfer.known import split

COARSE = icosphere(1)
FINE, FORWARD, BACK = split(COARSE)


def some() -> Landmarks:
    """Two vertices, two points of faces."""
    rng = np.random.default_rng(0)
    faces = at_faces(COARSE, np.array([3, 60]), rng.dirichlet([1, 1, 1], 2), ("C 7", "Ünde & <so>"))
    return join_landmarks([at_vertices(COARSE, np.array([5, 0]), ("nose", "ear")), faces])


def on_surface(shape: Shape, landmarks: Landmarks) -> None:
    inside = landmarks.face >= 0
    corners = shape.verts[shape.faces[landmarks.face[inside]]]
    points = np.einsum("nk,nkd->nd", landmarks.barycentric[inside], corners)
    assert np.allclose(points, landmarks.points[inside], atol=1e-12)
    assert np.array_equal(shape.verts[landmarks.vertex[~inside]], landmarks.points[~inside])


def test_the_identity_moves_nothing() -> None:
    given = some()
    found = push_landmarks(VertexMap.identity(COARSE), COARSE, COARSE, given)
    assert np.abs(found.points - given.points).max() < 1e-12
    assert np.array_equal(found.vertex, given.vertex)
    assert found.names == given.names
    assert (found.confidence == 1).all()
    on_surface(COARSE, found)


def test_on_a_finer_copy_they_lie_at_the_same_points() -> None:
    found = push_landmarks(FORWARD, COARSE, FINE, some())
    assert np.abs(found.points - some().points).max() < 1e-12
    on_surface(FINE, found)


def test_on_a_coarser_copy_too() -> None:
    rng = np.random.default_rng(1)
    given = at_faces(FINE, np.arange(0, FINE.F, 7), rng.dirichlet([1, 1, 1], len(range(0, FINE.F, 7))))
    found = push_landmarks(BACK, FINE, COARSE, given)
    assert np.abs(found.points - given.points).max() < 1e-12
    on_surface(COARSE, found)


def test_they_lie_on_the_surface_where_the_map_is_bent(sphere: Shape) -> None:
    index = np.linalg.norm(COARSE.verts[:, None] - sphere.verts, axis=2).argmin(axis=1)
    found = push_landmarks(VertexMap.between(COARSE, sphere, index), COARSE, sphere, some())
    on_surface(sphere, found)
    assert np.linalg.norm(found.points, axis=1).min() > 0.98
    assert (found.points * some().points).sum(axis=1).min() > 0.9


def test_a_torn_face_sends_its_landmark_with_the_heaviest_corner(sphere: Shape) -> None:
    first, second, _ = sphere.faces[3]
    index = np.arange(sphere.V)
    index[first] = np.argmin(sphere.verts @ sphere.verts[first])
    torn = VertexMap.between(sphere, sphere, index)
    given = at_faces(sphere, np.array([3]), np.array([[0.3, 0.6, 0.1]]))
    found = push_landmarks(torn, sphere, sphere, given)
    assert found.vertex.tolist() == [second]
    assert np.array_equal(found.points[0], sphere.verts[second])


def test_confidence_is_that_of_the_map() -> None:
    sure = np.linspace(0, 1, COARSE.V).astype(np.float32)
    given = some()
    found = push_landmarks(replace(FORWARD, confidence=sure), COARSE, FINE, given)
    assert np.allclose(found.confidence[:2], sure[[5, 0]])
    expected = (given.barycentric[2:] * sure[COARSE.faces[given.face[2:]]]).sum(axis=1)
    assert np.allclose(found.confidence[2:], expected)


def test_onto_a_cloud(sphere: Shape) -> None:
    points = Shape(FINE.verts, np.empty((0, 3), int), "points")
    forward = VertexMap.between(COARSE, points, np.arange(COARSE.V))
    found = push_landmarks(forward, COARSE, points, some())
    assert (found.face == -1).all()
    nearest = np.linalg.norm(some().points[:, None] - FINE.verts, axis=2).argmin(axis=1)
    assert np.array_equal(found.vertex, nearest)


def test_a_position_stands_for_the_nearest_point() -> None:
    given = some()
    outside = given.points * 1.05
    found, distance = at_points(COARSE, outside)
    assert np.allclose(distance, np.linalg.norm(found.points - outside, axis=1))
    on_surface(COARSE, found)
    exact, none = at_points(COARSE, given.points)
    assert np.abs(exact.points - given.points).max() < 1e-12
    assert none.max() < 1e-12


@pytest.mark.parametrize("suffix", LANDMARK_SUFFIXES)
def test_write_then_read(tmp_path: Path, suffix: str) -> None:
    given = replace(some(), confidence=np.array([1, 0.25, 0.5, 0.1]))
    save_landmarks(tmp_path / f"l{suffix}", given)
    found, distance = load_landmarks(tmp_path / f"l{suffix}", COARSE)
    assert found.names == (given.names if suffix != ".tps" else ("0", "1", "2", "3"))
    assert np.abs(found.points - given.points).max() < 1e-12
    assert distance < 1e-12
    if suffix in (".csv", ".json"):
        assert np.array_equal(found.vertex, given.vertex)
        assert np.array_equal(found.face, given.face)
        assert np.allclose(found.barycentric, given.barycentric, atol=1e-15)


def test_the_files_say_everything(tmp_path: Path) -> None:
    given = replace(some(), confidence=np.array([1, 0.25, 0.5, 0.1]))
    save_landmarks(tmp_path / "l.csv", given)
    lines = (tmp_path / "l.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "name,vertex,x,y,z,face,w0,w1,w2,confidence"
    assert lines[1].startswith("nose,5,") and lines[2].endswith(",-1,1.0,0.0,0.0,0.25")
    save_landmarks(tmp_path / "l.json", given)
    record = json.loads((tmp_path / "l.json").read_text(encoding="utf-8"))
    assert record["format"] == "meshmatch landmarks 1"
    assert set(record["landmarks"][3]) == {*("name", "vertex", "position", "face", "barycentric", "confidence")}
    assert record["landmarks"][3]["confidence"] == 0.1
    save_landmarks(tmp_path / "l.pp", given)
    text = (tmp_path / "l.pp").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE PickedPoints>\n<PickedPoints>")
    assert 'active="1"' in text


MESHLAB = """<!DOCTYPE PickedPoints>
<PickedPoints>
 <DocumentData>
  <DateTime date="2024-01-01" time="12:00:00"/>
  <DataFileName name="a.ply"/>
  <templateName name="new Template"/>
 </DocumentData>
 <point x="{0}" y="{1}" z="{2}" active="1" name="tip"/>
 <point active="0" x="0" y="0" z="0" name="not placed"/>
</PickedPoints>
"""
READABLE: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "meshlab": ("a.pp", MESHLAB, ("tip",)),
    "a header": ("a.csv", "\ufeffVertex , Name\n5,tip\n", ("tip",)),
    "positions with a header": ("a.csv", "# of a head\nname,x,y,z\ntip,{0},{1},{2}\n", ("tip",)),
    "bare positions": ("a.csv", "{0},{1},{2}\n", ("0",)),
    "named positions": ("a.csv", "tip,{0},{1},{2}\n", ("tip",)),
    "named vertices": ("a.csv", "tip,5\n", ("tip",)),
    "bare vertices": ("a.csv", "5\n", ("0",)),
    "a list of vertices": ("a.txt", "5\n", ("0",)),
    "json of vertices": ("a.json", '{{"tip": 5}}', ("tip",)),
    "json of positions": ("a.json", '{{"tip": [{0}, {1}, {2}]}}', ("tip",)),
    "json of both": ("a.json", '{{"tip": {{"vertex": 5, "position": [0, 0, 0]}}}}', ("tip",)),
    "a json list": ("a.json", "[5]", ("0",)),
    "a json list of positions": ("a.json", "[[{0}, {1}, {2}]]", ("0",)),
    "json landmarks": ("a.json", '{{"landmarks": [{{"name": "tip", "vertex": 5}}]}}', ("tip",)),
}


@pytest.mark.parametrize("case", READABLE)
def test_what_people_have_is_read(tmp_path: Path, case: str) -> None:
    name, text, names = READABLE[case]
    x, y, z = COARSE.verts[5].tolist()
    (tmp_path / name).write_text(text.format(x, y, z), encoding="utf-8")
    found, distance = load_landmarks(tmp_path / name, COARSE)
    assert found.names == names
    assert np.abs(found.points - COARSE.verts[5]).max() < 1e-12
    assert distance < 1e-12


def test_the_order_of_the_file_is_kept(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(
        '[7, [0, 0.1, 1.1], {"face": 3, "barycentric": [0.25, 0.25, 0.5], "name": "in"}, 2]'
    )
    found, distance = load_landmarks(tmp_path / "a.json", COARSE)
    assert found.names == ("0", "1", "in", "3")
    assert found.vertex[[0, 3]].tolist() == [7, 2]
    assert found.face[2] == 3
    assert 0 < distance < 0.2


def write(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


BOMB = '<!DOCTYPE P [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><PickedPoints>&b;</PickedPoints>'
BAD: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "not there": ("a.csv", lambda path: None, "there is no file"),
    "empty": ("a.csv", lambda path: path.touch(), "is empty"),
    "a header alone": ("a.csv", write("name,vertex\n"), "holds no landmark"),
    "pairs": ("a.csv", write("5,7\n"), "names no columns"),
    "no columns": ("a.csv", write("a,b,c,d,e\n"), "names no columns"),
    "ragged": ("a.csv", write("name,vertex\nnose,1,2\n"), "line 2 has 3 cells, the first 2"),
    "a word for a vertex": ("a.csv", write("name,vertex\nnose,left\n"), "left"),
    "out of range": ("a.csv", write("name,vertex\nnose,42\n"), "nose is vertex 42, but sphere1 has 42"),
    "negative": ("a.csv", write("name,vertex\nnose,-1\n"), "nose is vertex -1"),
    "a face out of range": (
        "a.json",
        write('[{"name": "nose", "face": 80, "barycentric": [1, 0, 0]}]'),
        "in face 80, but sphere1 has 80 faces",
    ),
    "negative weight": ("a.json", write('[{"name": "nose", "face": 8, "barycentric": [2, -1, 0]}]'), "is negative"),
    "weights": ("a.json", write('[{"name": "nose", "face": 8, "barycentric": [1, 1, 0]}]'), "do not sum to 1"),
    "far away": ("a.csv", write("name,x,y,z\nnose,100,0,0\n"), "lies 9.* away from sphere1"),
    "no position": ("a.csv", write("name,x,y,z\nnose,nan,0,0\n"), "nose has no position"),
    "infinite": ("a.csv", write("name,x,y,z\nnose,1e999,0,0\n"), "nose has no position"),
    "nothing": ("a.json", write('[{"name": "nose"}]'), "nose has no vertex and no position"),
    "two numbers": ("a.json", write('{"nose": [1, 2]}'), "three numbers"),
    "half a vertex": ("a.json", write('[{"vertex": 1.5}]'), "not the number of a vertex"),
    "true": ("a.json", write('[{"vertex": true}]'), "not the number of a vertex"),
    "huge": ("a.json", write('[{"vertex": 1e300}]'), "not the number of a vertex"),
    "no json": ("a.json", write("{"), "can be read"),
    "a word": ("a.json", write('"nose"'), "no list of landmarks"),
    "no xml": ("a.pp", write("PickedPoints"), "is not XML"),
    "other xml": ("a.pp", write("<svg/>"), "its root is 'svg'"),
    "a bomb": ("a.pp", write(BOMB), "XML entities"),
    "a coordinate": ("a.pp", write('<PickedPoints><point x="a" y="0" z="0"/></PickedPoints>'), "can be read"),
    "a suffix": ("a.xlsx", write("x"), "not read from '.xlsx'"),
    "not text": ("a.csv", lambda path: path.write_bytes(b"\xff\xfe\x00\x01"), "can be read"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_landmarks_are_told_in_words(tmp_path: Path, case: str) -> None:
    name, make, words = BAD[case]
    make(tmp_path / name)
    with pytest.raises(InputError, match=words):
        load_landmarks(tmp_path / name, COARSE)


@pytest.mark.parametrize("suffix", LANDMARK_SUFFIXES)
def test_what_is_missing_is_read_as_missing(tmp_path: Path, suffix: str) -> None:
    given = some().without(np.array([True, False, True, False]))
    save_landmarks(tmp_path / f"l{suffix}", given)
    found, _ = load_landmarks(tmp_path / f"l{suffix}", COARSE)
    assert np.abs(found.points - some().points[[1, 3]]).max() < 1e-12
    assert found.names == (given.names[1::2] if suffix != ".tps" else ("1", "3"))
    assert "and 1 more are missing: left out" in found.notes[0]
    assert np.array_equal(np.isnan(landmark_positions(tmp_path / f"l{suffix}")).all(axis=1), given.missing)


def test_what_is_missing_goes_nowhere() -> None:
    found = push_landmarks(FORWARD, COARSE, FINE, some().without(np.array([False, True, True, False])))
    assert found.missing.tolist() == [False, True, True, False]
    assert found.vertex[1:3].tolist() == [-1, -1]


def test_names_cannot_break_a_file(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"a\nb\x00\x1b<&": 3}))
    found, _ = load_landmarks(tmp_path / "a.json", COARSE)
    for suffix in LANDMARK_SUFFIXES:
        save_landmarks(tmp_path / f"l{suffix}", found)
        if suffix == ".tps":  # which has none
            continue
        assert load_landmarks(tmp_path / f"l{suffix}", COARSE)[0].names == ("a b <&",)


@pytest.mark.parametrize("suffix", [".csv", ".tps", ".txt"])
def test_a_table_of_specimens_is_read_again(tmp_path: Path, suffix: str) -> None:
    own, names = some().points, some().names
    own[2] = np.nan
    save_specimens(tmp_path / f"all{suffix}", {"a\nb": own + 0.1, "sphere1": own, "sphere1.x": own - 0.1}, names)
    found, _ = load_landmarks(tmp_path / f"all{suffix}", COARSE)
    assert np.abs(found.points - own[[0, 1, 3]]).max() < 1e-12
    assert found.names == ((*names[:2], names[3]) if suffix == ".csv" else ("0", "1", "3"))
    if suffix != ".csv":
        assert (tmp_path / f"all{suffix}").read_text().count("\nNA NA NA\n") == 3  # as geomorph asks for
    with pytest.raises(InputError, match="landmarks of 3 shapes, 0 of them of x"):
        load_landmarks(tmp_path / f"all{suffix}", Shape(COARSE.verts, COARSE.faces, "x.ply"))


def test_an_unknown_suffix_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"l\.txt: '\.txt' is not a format for landmarks"):
        save_landmarks(tmp_path / "l.txt", some())
