"""transfer-shapes through the program's only door; maps are made by construction."""

from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.blend_shape_files import load_blend_shapes
from meshmatch.shapes.blend_shapes import BlendShapes, WeightClip
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_morphs import read_morphs, with_morphs
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from tests.cli.conftest import Run, refused, well
from tests.shapes.painted import quarters
from tests.transfer.rigs import tube, write_tube

CALL = ("transfer-shapes", "a.glb", "b.ply", "--map", "ab.npz")
LYING = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
NAMES = ("swell", "a/b: c", "A_B_ c")


def moves_of(shape: Shape) -> np.ndarray:
    """A swelling, a shift of the upper half, and one that moves a single vertex."""
    out = shape.verts * [1.0, 0.0, 1.0]
    up = np.where(shape.verts[:, 1:2] > 1.2, [0.0, 0.2, 0.0], 0.0)
    one = np.zeros_like(out)
    one[100] = 0.1
    return np.stack([0.2 * out, up, one]).astype(np.float32)


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tube a.glb with three shapes and a clip, a larger one b.ply that lies on its back, and the map between them."""
    monkeypatch.chdir(tmp_path)
    write_tube(Path("plain.glb"))
    shape = load_shape("plain.glb")
    clip = WeightClip("breathe", np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [1, 0, 0]]), "LINEAR")
    shapes = BlendShapes(NAMES, moves_of(shape), np.array([0.0, 0.5, 0.0]), clips=(clip,))
    document = Document(Path("plain.glb"), Path("plain.glb").read_bytes())
    Path("a.glb").write_bytes(with_morphs(document, shape, shapes, np.eye(3)))
    Path("plain.glb").unlink()
    save_shape("b.ply", Shape(2 * shape.verts @ LYING.T, shape.faces))
    a, b = load_shape("a.glb"), load_shape("b.ply")
    save_map("ab.npz", VertexMap.between(a, b, np.arange(a.V), verdict="good"))
    return tmp_path


def true_moves() -> np.ndarray:
    return np.asarray(2 * moves_of(tube()) @ LYING.T)


def test_shapes_into_a_glb(run: Run, pair: Path) -> None:
    answer = well(run(*CALL, "-o", "out.glb", "--json", "--picture", "p.png"))
    record = answer.record
    assert (record["shapes"], record["still"], record["clips"]) == (list(NAMES), [], ["breathe"])
    assert "wrote out.glb: b.ply with 3 blendshapes, 1 clip (" in answer.err
    assert Path("p.png").stat().st_size > 1000
    found = read_morphs(Path("out.glb"), Path("out.glb").read_bytes())
    assert (found.names, found.weights.tolist()) == (NAMES, [0, 0.5, 0])
    assert np.allclose(found.clips[0].weights, [[0, 0, 0], [1, 0, 0]])
    # the ply lies, the glb stands as a.glb does
    assert np.allclose(found.moves[:2], 2 * moves_of(tube())[:2], atol=0.02)
    assert np.allclose(load_shape("out.glb").verts, 2 * tube().verts, atol=1e-5)


def test_an_obj_keeps_its_texture_in_a_glb(run: Run, pair: Path) -> None:
    b = load_shape("b.ply")
    save_textured("b.obj", TexturedMesh(b.verts, b.faces, np.random.default_rng(0).random((b.F, 3, 2))), quarters())
    with Path("b.obj").open("a") as text:
        text.write("f 1/1 2/2 3/3 4/4\n")
    save_map("ab.npz", VertexMap.between(load_shape("a.glb"), load_shape("b.obj"), np.arange(b.V), verdict="good"))
    answer = well(run("transfer-shapes", "a.glb", "b.obj", "--map", "ab.npz", "-o", "out.glb", "--quiet"))
    assert answer.err == "warning: out.glb does not have the polygons of b.obj\n"
    out, before = load_shape("out.glb"), load_shape("b.obj")
    look, given = load_appearance("out.glb", out), load_appearance("b.obj", before)
    np.testing.assert_allclose(look.uv, given.uv, atol=1e-6)
    np.testing.assert_array_equal(look.materials[0].image, given.materials[0].image)
    found = read_morphs(Path("out.glb"), Path("out.glb").read_bytes())
    np.testing.assert_allclose(found.moves[:2, out.faces], 2 * moves_of(tube())[:2, before.faces], atol=0.02)
    assert (found.moves[2, out.faces].any(axis=2) == (before.faces == 100)).all()


def test_shapes_into_arrays(run: Run, pair: Path) -> None:
    answer = well(run(*CALL, "-o", "out.npz", "--json"))
    assert answer.record["clips"] == []
    assert "warning: out.npz cannot contain clips: breathe\n" in answer.err and "3 blendshapes (" in answer.err
    found = load_blend_shapes("out.npz", load_shape("b.ply"))
    assert found.names == NAMES
    assert np.allclose(found.moves[:2], true_moves()[:2], atol=0.02)


def test_a_folder_of_meshes(run: Run, pair: Path) -> None:
    """An .obj comes back with its own text, and each file is named after its shape as far as files can be."""
    b = load_shape("b.ply")
    save_shape("b.obj", b)
    Path("b.obj").write_text("# mine\nmtllib b.mtl\n" + Path("b.obj").read_text())
    Path("b.mtl").write_text("newmtl wool\n")
    save_map("ab.npz", VertexMap.between(load_shape("a.glb"), load_shape("b.obj"), np.arange(b.V)))
    words = [word.replace("b.ply", "b.obj") for word in CALL]
    answer = well(run(*words, "-o", "faces"))
    assert (
        "wrote faces: b.obj with 3 blendshapes (" in answer.err
        and "faces cannot contain clips: breathe\n" in answer.err
    )
    assert {file.name for file in Path("faces").iterdir()} == {"swell.obj", "a_b_ c.obj", "A_B_ c-2.obj", "b.mtl"}
    assert Path("faces/swell.obj").read_text().startswith("# mine\nmtllib b.mtl\n")
    assert np.allclose(load_shape("faces/swell.obj").verts, b.verts + true_moves()[0], atol=0.02)


def test_a_folder_that_is_not_empty_stays(run: Run, pair: Path) -> None:
    Path("faces").mkdir()
    well(run(*CALL, "-o", "faces"))
    Path("faces/swell.obj").write_text("mine")
    before = {path.name for path in pair.iterdir()}
    refused(run(*CALL, "-o", "faces"), "the folder faces is not empty", pair, before)
    assert Path("faces/swell.obj").read_text() == "mine"


def test_a_folder_may_have_a_version(run: Run, pair: Path) -> None:
    well(run(*CALL, "-o", "v1.0"))
    assert {file.name for file in Path("v1.0").iterdir()} == {"swell.obj", "a_b_ c.obj", "A_B_ c-2.obj"}


def test_shapes_from_meshes(run: Run, pair: Path) -> None:
    shape = tube()
    save_shape("a.obj", shape)
    Path("expressions").mkdir()
    save_shape("expressions/neutral.obj", shape)
    for name, move in zip(("swell", "lift"), moves_of(shape)[:2], strict=True):
        save_shape(f"expressions/{name}.ply", Shape(shape.verts + move, shape.faces))
    save_map("ab.npz", VertexMap.between(load_shape("a.obj"), load_shape("b.ply"), np.arange(shape.V)))
    words = "transfer-shapes", "a.obj", "b.ply", "--map", "ab.npz"
    answer = well(run(*words, "-o", "out.npz", "--shapes", "expressions", "--json"))
    assert answer.record["shapes"] == ["lift", "swell"]
    found = load_blend_shapes("out.npz", load_shape("b.ply"))
    assert np.allclose(found.moves, true_moves()[[1, 0]], atol=0.02)
    well(run(*words, "-o", "out.npz", "--shapes", "expressions/swell.ply", "--shapes", "expressions/lift.ply", "-q"))
    assert load_blend_shapes("out.npz", load_shape("b.ply")).names == ("swell", "lift")
    well(run(*words, "-o", "again.npz", "--shapes", "out.npz", "-q"))
    assert load_blend_shapes("again.npz", load_shape("b.ply")).names == ("swell", "lift")


def test_shapes_that_move_nothing_are_named(run: Run, pair: Path) -> None:
    a = load_shape("a.glb")
    save_shape("half.ply", Shape(2 * a.verts[:320], a.faces[(a.faces < 320).all(axis=1)]))
    half = load_shape("half.ply")
    moves = np.zeros((2, a.V, 3), np.float32)
    moves[0, 600:] = [0, 0.1, 0]
    moves[1, :100] = [0, 0.1, 0]
    seen: list[tuple[str, float]] = []
    result = meshmatch.transfer_shapes(
        "a.glb", half, VertexMap.between(a, half, np.minimum(np.arange(a.V), 319), confidence=(np.arange(a.V) < 320) * 1.0),
        shapes=BlendShapes(("top", "bottom"), moves, np.zeros(2)),
        progress=lambda stage, name, share: seen.append((stage, share)),
    )  # fmt: skip
    assert result.still == ("top",) and seen == [("transferring displacements", k / 2) for k in range(3)]


WRONG = [
    (("-o", "out.stl"), "'.stl' is not a format for blendshapes"),
    (("-o", "out.glb", "--shapes", "same.ply"), "the files of blendshapes are all like the source"),
    (("-o", "out.glb", "--shapes", "small.ply"), "small.ply has 3 vertices, but a.glb has 658"),
    (("-o", "out.glb", "--shapes", "empty"), "there are no shapes in empty"),
    (("-o", "out.glb", "--shapes", "wrong.npz"), "wrong.npz does not hold 'moves'"),
    (("-o", "out.glb", "--shapes", "nan.npz"), "nan.npz: a move is no number, or too large"),
    (("-o", "out.glb", "--shapes", "twice.npz"), "twice.npz has 2 shapes, and 1 different names"),
    (("-o", "out.glb", "--shapes", "other.npz"), "other.npz has 5 vertices, but a.glb has 658"),
    (("-o", "a.glb"), "is an input of this command"),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_what_cannot_be_is_told(run: Run, pair: Path, words: tuple[str, ...], message: str) -> None:
    a = load_shape("a.glb")
    save_shape("same.ply", a)
    Path("empty").mkdir()
    save_shape("small.ply", Shape(np.eye(3), [[0, 1, 2]]))
    np.savez("wrong.npz", names=["one"])
    np.savez("nan.npz", names=["one"], moves=np.full((1, a.V, 3), np.nan))
    np.savez("twice.npz", names=["one", "one"], moves=np.zeros((2, a.V, 3)))
    np.savez("other.npz", names=["one"], moves=np.ones((1, 5, 3)))
    save_map("ab.npz", VertexMap.between(a, load_shape("b.ply"), np.arange(a.V)))
    before = {path.name for path in pair.iterdir()}
    refused(run(*CALL, *words), message, pair, before)


def test_sources_that_cannot_be(pair: Path) -> None:
    with pytest.raises(InputError, match=r"b.ply has no blendshapes"):
        meshmatch.transfer_shapes("b.ply", "a.glb", "ab.npz")
    with pytest.raises(InputError, match="two shapes are called b"):
        save_shape("b.obj", load_shape("b.ply"))
        load_blend_shapes(["b.ply", "b.obj"], load_shape("a.glb"))
    with pytest.raises(InputError, match="target is a point cloud"):
        meshmatch.transfer_shapes("a.glb", tube().verts)
    with pytest.raises(OptionError, match=r"is not a format for blendshapes"):
        meshmatch.transfer_shapes("a.glb", "b.ply", "ab.npz").save("out.stl")
