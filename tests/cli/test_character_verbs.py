"""A .vrm that goes in comes back as one, through the program's only door."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.gltf_morphs import read_morphs
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import Run, refused, well
from tests.shapes.characters import VERSIONS, read, read_extensions, write_character
from tests.shapes.painted import write_gltf

CALLS = {
    "transfer-texture": ("a.vrm", "b.vrm", "--size", "64"),
    "transfer-color": ("painted.ply", "b.vrm"),
    "transfer-shapes": ("a.vrm", "b.vrm"),
}


@pytest.fixture(params=VERSIONS)
def pair(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two characters with the same faces, and one of them with colors as a ply."""
    monkeypatch.chdir(tmp_path)
    write_character(Path("a.vrm"), 1)
    write_character(Path("b.vrm"), request.param)
    shape = load_shape("a.vrm")
    save_shape("painted.ply", Shape(shape.verts, shape.faces, "painted", np.tile([1.0, 0, 0, 1], (shape.V, 1))))
    return tmp_path


@pytest.mark.parametrize("verb", CALLS)
def test_a_character_comes_back(run: Run, pair: Path, verb: str) -> None:
    before = read_extensions(Path("b.vrm"))
    assert "wrote out.vrm: " in well(run(verb, *CALLS[verb], "-o", "out.vrm")).err
    assert read_extensions(Path("out.vrm")) == before
    well(run(verb, *CALLS[verb], "-o", "out.glb"))
    assert Path("out.glb").read_bytes() == Path("out.vrm").read_bytes()


@pytest.mark.parametrize("verb", CALLS)
def test_several_keep_their_suffix(run: Run, pair: Path, verb: str) -> None:
    source, _, *more = CALLS[verb]
    Path("in").mkdir()
    Path("b.vrm").rename("in/b.vrm")
    write_gltf(Path("in/c.glb"), primitives=[{}] * 3)
    before = read_extensions(Path("in/b.vrm"))
    well(run(verb, source, "in", *more, "-o", "out"))
    assert sorted(path.name for path in Path("out").glob("[!.]*")) == ["b.vrm", "c.glb", "transfers.csv"]
    assert read_extensions(Path("out/b.vrm")) == before


def test_a_garment_is_joined(run: Run, pair: Path) -> None:
    write_gltf(Path("coat.glb"))
    assert (
        "wrote out.vrm: coat.glb"
        in well(run("transfer-garment", "coat.glb", "a.vrm", "b.vrm", "-o", "out.vrm", "--join")).err
    )
    assert len(read(Path("out.vrm")).json["meshes"]) == 3
    Path("in").mkdir()
    Path("b.vrm").rename("in/b.vrm")
    write_character(Path("in/c.vrm"), 0)
    well(run("transfer-garment", "coat.glb", "a.vrm", "in", "-o", "worn", "--join"))
    assert sorted(path.name for path in Path("worn").glob("[!.]*")) == ["b.vrm", "c.vrm", "transfers.csv"]
    before = {path.name for path in pair.iterdir()}
    call = ("transfer-garment", "coat.glb", "a.vrm", "in", "-o", "other", "--join", "--format", "obj")
    refused(run(*call), "'.obj' is not a format for a target with a garment in it", pair, before)


@pytest.mark.parametrize("verb", CALLS)
def test_what_is_no_character_is_refused(run: Run, pair: Path, verb: str) -> None:
    write_gltf(Path("plain.glb"), primitives=[{}] * 3)
    before = {path.name for path in pair.iterdir()}
    source, _, *more = CALLS[verb]
    words = "out.vrm would be no character: plain.glb has no VRM extension"
    refused(run(verb, source, "plain.glb", *more, "-o", "out.vrm"), words, pair, before)


def test_shapes_of_other_names_are_added(run: Run, pair: Path) -> None:
    shape = load_shape("a.vrm")
    save_shape("wink.ply", Shape(shape.verts + 0.1, shape.faces))
    before = read_extensions(Path("b.vrm"))
    well(run("transfer-shapes", "a.vrm", "b.vrm", "--shapes", "wink.ply", "-o", "out.vrm"))
    assert read_extensions(Path("out.vrm")) == before
    assert read_morphs(Path("out.vrm"), Path("out.vrm").read_bytes()).names == ("shape 0", "wink", "a", "o", "smile")
