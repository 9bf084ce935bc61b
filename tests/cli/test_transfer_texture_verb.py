"""transfer-texture through the program's only door. Maps are made by construction; the last test alone matches."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.api import texture
from meshmatch.api.results import MapPair
from meshmatch.errors import InputError
from meshmatch.maps.files import load_map, save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes import dressed_files
from meshmatch.shapes.appearance import Appearance, png_bytes
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer.texels import draw_triangles
from meshmatch.transfer.unwrap import unwrapped
from tests.cli.conftest import Run, refused, well
from tests.conftest import icosphere
from tests.shapes.painted import FACES, encoded, quarters, write_gltf, write_square_obj
from tests.transfer.known import split

SMALL = ("--size", "64", "--padding", "2", "--threads", "1")


def picture(size: int = 32) -> np.ndarray:
    """Slow waves: close by, colors are nearly the same."""
    y, x = np.mgrid[:size, :size] / size
    image = np.full((size, size, 4), 255, np.uint8)
    image[..., :3] = np.round(127 + 100 * np.stack([np.sin(5 * x), np.sin(4 * y), np.cos(5 * x * y)], -1))
    return image


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a textured a.glb, a finer b.ply of the same surface, and a map between them."""
    monkeypatch.chdir(tmp_path)
    ball = icosphere(2)
    save_textured("a.glb", TexturedMesh(ball.verts, ball.faces, unwrapped(ball, 32, 2)), picture())
    fine, _, _ = split(ball)
    save_shape("b.ply", fine)
    a, b = load_shape("a.glb"), load_shape("b.ply")
    # copies at the seams lie where the first ones do
    first = [int(np.linalg.norm(ball.verts - vertex, axis=1).argmin()) for vertex in a.verts]
    save_map("ab.npz", VertexMap.between(a, b, first, verdict="good"))
    return tmp_path


def call(words: str = "", target: str = "b.ply", out: str = "out.glb", map: str | None = "ab.npz") -> list[str]:
    """The whole call, with these options."""
    given = [] if map is None else ["--map", map]
    return ["transfer-texture", "a.glb", target, "-o", out, *given, *SMALL, *words.split()]


def seen(path: str, at: np.ndarray) -> np.ndarray:
    """(N, 3) bytes of what a textured file shows nearest to points of the unit sphere."""
    shape = load_shape(path)
    look = load_appearance(path, shape)
    return colors_at(shape, look, at)


def colors_at(shape: Shape, look: Appearance, at: np.ndarray) -> np.ndarray:
    image = look.materials[0].image
    assert image is not None
    middle = shape.verts[shape.faces].mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    face = (at @ middle.T).argmax(axis=1)
    uv = look.uv[face].mean(axis=1)
    row, column = (np.floor(uv[:, k] * image.shape[1 - k]).astype(int) for k in (1, 0))
    return image[row, column, :3].astype(int)


def sample_points() -> np.ndarray:
    fine = icosphere(3)
    points = fine.verts[fine.faces].mean(axis=1)[::7]
    return points / np.linalg.norm(points, axis=1, keepdims=True)


# What it does


@pytest.mark.parametrize("out", ["out.glb", "out.obj", "two words.OBJ"])
def test_a_finer_copy_shows_the_same(run: Run, pair: Path, out: str) -> None:
    answer = well(run(*call(out=out)))
    shape, b = load_shape(out), load_shape("b.ply")
    np.testing.assert_allclose(shape.verts[: b.V], b.verts, atol=1e-6)
    if out != "out.glb":
        np.testing.assert_array_equal(shape.faces, b.faces)
    off = np.abs(seen(out, sample_points()) - seen("a.glb", sample_points())).max(axis=1)
    assert np.median(off) < 20 and (off < 60).mean() > 0.9  # the middles of two triangles, not one place
    assert "used the map ab.npz" in answer.err
    assert "new texture coordinates: " in answer.err
    assert "the map turns over 0.00 % of the surface" in answer.err
    assert f"wrote {out}" in answer.err
    assert answer.out == ""


def test_json_says_all_of_it(run: Run, pair: Path) -> None:
    answer = run(*call("--json -q", out="out.obj"))
    record = answer.record
    assert answer.err == ""
    assert record["files"] == ["out.obj", "out.mtl", "out.png"]
    assert (record["size"], record["uv"], record["alpha"]) == (64, "new", "opaque")
    assert 0.1 < record["used"] < 1
    assert record["low_confidence_share"] == record["filled_share"] == record["blank_share"] == 0
    assert (record["source"], record["target"], record["map"]) == ("a.glb", "b.ply", "ab.npz")
    assert record["baking_seconds"] > 0
    assert record["flipped"] == 0 and record["crushed"] < 0.01 and 1 <= record["stretch"] < 1.2


@pytest.mark.parametrize(("uv", "used"), [("auto", "own"), ("keep", "own"), ("new", "new")])
def test_the_targets_own_coordinates_are_used_replaced_or_demanded(run: Run, pair: Path, uv: str, used: str) -> None:
    b = load_shape("b.ply")
    own = unwrapped(b, 64, 2)[..., ::-1].copy()  # new ones would be the same but for that
    save_textured("b.glb", TexturedMesh(b.verts, b.faces, own), picture())
    save_map("ab2.npz", VertexMap.between(load_shape("a.glb"), load_shape("b.glb"), load_map("ab.npz").index))
    assert run(*call(f"--uv {uv} --json", target="b.glb", map="ab2.npz")).record["uv"] == used
    found = load_appearance("out.glb", load_shape("out.glb")).uv
    assert (found.shape == own.shape and np.allclose(found, own, atol=1e-6)) == (used == "own")


def folded(shape: Shape) -> np.ndarray:
    """Texture coordinates that both halves of a ball, left and right, have in common."""
    x, y, z = np.moveaxis(shape.verts[shape.faces], 2, 0)
    angle = np.arctan2(np.sign(x.mean(axis=1, keepdims=True) + 1e-9) * x, z)
    angle = np.clip(np.where(angle < -np.pi / 2, angle + 2 * np.pi, angle), -0.3, np.pi + 0.3)
    return 0.1 + 0.8 * np.stack([angle / np.pi, (y + 1) / 2], axis=-1)


def test_overlapping_coordinates_are_replaced_with_a_note(run: Run, pair: Path) -> None:
    b = load_shape("b.ply")
    save_textured("b.obj", TexturedMesh(b.verts, b.faces, folded(b)), picture())
    save_map("ab2.npz", replace(load_map("ab.npz"), target_hash=load_shape("b.obj").hash))
    answer = run(*call("--json", target="b.obj", map="ab2.npz"))
    assert answer.record["uv_note"]
    assert "note: b.obj: its own texture coordinates cannot be used: they overlap" in answer.err
    before = {path.name for path in pair.iterdir()}
    refused(run(*call("--uv keep --quiet", target="b.obj", map="ab2.npz")), "they overlap", pair, before)


@pytest.mark.parametrize("output", ["out.obj", "out.glb"])
def test_mirrored_coordinates_are_used_where_both_halves_look_alike(run: Run, pair: Path, output: str) -> None:
    """The source is symmetric. For the glb one half was moved aside, into another tile, as for baking."""
    a, b = load_shape("a.glb"), load_shape("b.ply")
    save_shape("a.ply", replace(a, colors=np.insert(np.abs(a.verts), 3, 1.0, axis=1)))
    save_map("ab2.npz", replace(load_map("ab.npz"), source_hash=load_shape("a.ply").hash))
    mirrored = folded(b)
    aside = (b.verts[b.faces].mean(axis=1)[:, 0] < 0) * (output == "out.glb")
    laid = mirrored + aside[:, None, None] * [1.0, 0.0]
    save_textured("b.obj", TexturedMesh(b.verts, b.faces, laid), picture())
    words = ["transfer-texture", "a.ply", "b.obj", "-o", output, "--map", "ab2.npz", *SMALL, "--uv", "keep", "--json"]
    answer = run(*words)
    assert answer.record["uv"] == "own"
    assert "% of their texels to several places, as to mirrored halves; these look alike" in answer.err
    out = load_shape(output)
    found = load_appearance(output, out)
    assert np.allclose(found.uv, mirrored, atol=1e-6)
    image = found.materials[0].image
    assert image is not None
    column, row = (64 * mirrored.mean(axis=1)).astype(int).T
    expected = 255 * np.abs(b.verts[b.faces].mean(axis=1))
    assert np.abs(image[row, column, :3] - expected).mean() < 12


def tiled(name: str) -> None:
    """The target as an obj whose upper half lies in tile 1002, each half in all of its tile; written beside the others."""
    fine = load_shape("b.ply")
    upper = fine.verts[fine.faces][:, :, 2].mean(axis=1) > 0
    uv = np.zeros((fine.F, 3, 2))
    for half, column in ((upper, 1.0), (~upper, 0.0)):
        uv[half] = unwrapped(Shape(fine.verts, fine.faces[half]), 64, 2) + np.array([column, 0.0])
    lines = [f"v {x} {y} {z}" for x, y, z in fine.verts] + [f"vt {u} {1 - v}" for u, v in uv.reshape(-1, 2)]
    for number, face in enumerate(fine.faces + 1):
        lines.append("f " + " ".join(f"{vertex}/{3 * number + k + 1}" for k, vertex in enumerate(face)))
    Path(name).write_text("\n".join(lines) + "\n")


def test_each_tile_of_the_target_gets_an_image(run: Run, pair: Path) -> None:
    tiled("b.obj")
    answer = well(run(*call("--uv keep --json", "b.obj", "out.obj")))
    record = answer.record
    assert record["uv"] == "own" and record["tiles"] == [1001, 1002]
    files = ["out.obj", "out.mtl", "out.1001.png", "out.1002.png"]
    assert record["files"] == files and all(Path(file).exists() for file in files)
    assert "map_Kd out.<UDIM>.png" in Path("out.mtl").read_text() and not Path("out.png").exists()
    kept = [line for line in Path("out.obj").read_text().splitlines() if line.startswith(("v", "f"))]
    assert kept == Path("b.obj").read_text().splitlines()
    shape = load_shape("out.obj")
    look = load_appearance("out.obj", shape)
    assert len(look.materials) == 2
    points = sample_points()
    for number, half in enumerate((points[:, 2] < -0.1, points[:, 2] > 0.1)):  # the lower tile is the first material
        one = replace(
            look, materials=(look.materials[number],), material=np.zeros_like(look.material), uv=look.uv % 1.0
        )
        difference = np.abs(colors_at(shape, one, points[half]) - seen("a.glb", points[half]))
        assert np.median(difference) <= 4


def test_a_glb_has_no_tiles(run: Run, pair: Path) -> None:
    tiled("b.obj")
    answer = well(run(*call("--json", "b.obj", "out.glb")))
    assert answer.record["uv"] == "new" and "has no tiles (UDIM)" in answer.err
    before = {path.name for path in pair.iterdir()}
    refused(run(*call("--uv keep --quiet", "b.obj", "no.glb")), "they overlap", pair, before)


def test_the_layout_of_the_source_is_carried_over(run: Run, pair: Path) -> None:
    """The image that comes out is that of the source."""
    answer = run(*call("--uv source --json"))
    assert answer.record["uv"] == "source"
    assert "note: the layout of a.glb (" in answer.err and "texture coordinates of the source: " in answer.err
    before, after = (load_appearance(name, load_shape(name)) for name in ("a.glb", "out.glb"))
    assert np.abs(np.sort(before.uv.mean(axis=(0, 1))) - np.sort(after.uv.mean(axis=(0, 1)))).max() < 0.02
    column, row = (64 * after.uv.mean(axis=1)).astype(int).T
    image, own = after.materials[0].image, before.materials[0].image
    assert image is not None and own is not None
    assert np.abs(image[row, column].astype(int) - own[row // 2, column // 2]).mean() < 12


def test_size_samples_and_padding(run: Run, pair: Path) -> None:
    def image(words: str) -> np.ndarray:
        well(run(*call(words)))
        found = load_appearance("out.glb", load_shape("out.glb")).materials[0].image
        assert found is not None
        return found

    assert image("--size 48").shape == (48, 48, 4)
    assert (image("--samples 1") != image("--samples 3")).any()
    assert image("--padding 4")[..., :3].max(axis=2).min() > 0
    bare = image("--padding 0")
    off = draw_triangles(load_appearance("out.glb", load_shape("out.glb")).uv * 64, 64)[0] < 0
    assert (bare[off, :3] == 0).all()


@pytest.fixture
def doubtful(pair: Path) -> None:
    """The map knows nothing about z > 0.3."""
    sure = np.where(load_shape("a.glb").verts[:, 2] > 0.3, 0.0, 1.0).astype(np.float32)
    save_map("doubt.npz", replace(load_map("ab.npz"), confidence=sure))


def test_doubt_is_kept_filled_or_left_blank(run: Run, doubtful: None) -> None:
    kept = run(*call("--json", map="doubt.npz"))
    assert kept.record["low_confidence_share"] == pytest.approx((1 - 0.3) / 2, abs=0.08)  # of a sphere, above z = 0.3
    assert "has less confidence than 0.3: kept" in kept.err
    top = np.array([[0.0, 0.0, 1.0]])
    was = seen("out.glb", top)

    record = run(*call("--json --fill", map="doubt.npz")).record
    assert record["filled_share"] == record["low_confidence_share"]
    assert (seen("out.glb", top) != was).any()
    answer = run(*call("--json --blank #ff0080", map="doubt.npz"))
    assert answer.record["blank_share"] > 0.2 and "left blank" in answer.err
    np.testing.assert_array_equal(seen("out.glb", top), [[255, 0, 128]])
    assert run(*call("--json --blank 0", map="doubt.npz")).record["alpha"] == "mask"
    assert load_appearance("out.glb", load_shape("out.glb")).materials[0].alpha == "mask"
    assert run(*call("--json --min-confidence 0", map="doubt.npz")).record["low_confidence_share"] == 0


def test_doubt_about_vertex_colors(run: Run, doubtful: None) -> None:
    assert run(*call("--json --blank 1,0,0", map="doubt.npz", out="out.ply")).record["blank"] > 0
    colors = load_shape("out.ply").colors
    assert colors is not None
    np.testing.assert_array_equal(colors[load_shape("b.ply").verts[:, 2].argmax(), :3], [1, 0, 0])
    assert run(*call("--json --fill", map="doubt.npz", out="out.ply")).record["filled"] > 0


@pytest.mark.parametrize(
    ("target", "out"), [("b.npy", "a.ply"), ("b.ply", "a.ply"), ("b.npy", "a.obj"), ("b.ply", "a.off")]
)
def test_clouds_and_ply_get_vertex_colors(run: Run, pair: Path, target: str, out: str) -> None:
    b = load_shape("b.ply")
    np.save("b.npy", b.verts)
    save_map("ab.npz", VertexMap.between(load_shape("a.glb"), load_shape(target), load_map("ab.npz").index))
    answer = run(*call("--json", target=target, out=out))
    assert answer.record["files"] == [out] and not Path("a.mtl").exists()
    assert "with vertex colors" in answer.err
    found = load_shape(out)
    assert found.colors is not None and np.ptp(found.colors[:, :3]) > 0.5
    assert (found.V, found.is_cloud) == (b.V, target == "b.npy")


@pytest.mark.parametrize("target", ["b.npy", "b.ply"])
def test_a_map_tells_how_the_target_stands(run: Run, pair: Path, target: str) -> None:
    """It remembers what its match found; a node turns a mesh, or a cloud, upright."""
    b = load_shape("b.ply")
    np.save("b.npy", b.verts)
    save_shape("a.ply", replace(load_shape("a.glb"), colors=np.ones((load_shape("a.glb").V, 4))))
    a, index = load_shape("a.ply"), load_map("ab.npz").index
    save_map("up.npz", VertexMap.between(a, load_shape(target), index, target_up="+z"))
    well(run("transfer-texture", "a.ply", target, "-o", "out.glb", "--map", "up.npz", *SMALL, "--json"))
    upright = load_shape("out.glb").verts[: b.V]
    np.testing.assert_allclose(upright, b.verts @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-5)


def test_a_painted_mesh_is_a_source_like_any_other(run: Run, pair: Path) -> None:
    well(run(*call(out="mesh.ply")))
    b = load_shape("b.ply")
    save_map("ba.npz", VertexMap.between(load_shape("mesh.ply"), b, np.arange(b.V)))
    well(run("transfer-texture", "mesh.ply", "b.ply", "-o", "again.glb", "--map", "ba.npz", *SMALL))
    off = np.abs(seen("again.glb", sample_points()) - seen("a.glb", sample_points())).max(axis=1)
    assert np.median(off) < 20


def test_a_picture_for_a_source_that_names_none(run: Run, pair: Path) -> None:
    write_square_obj(pair / "square.obj", mtl=None)
    (pair / "skin.png").write_bytes(encoded(quarters(32)))
    save_map("id.npz", VertexMap.identity(load_shape("square.obj")))
    words = "square.obj square.obj -o out.obj --map id.npz --size 32 --image skin.png --padding 2 --threads 1"
    well(run("transfer-texture", *words.split()))
    look = load_appearance("out.obj", load_shape("out.obj"))
    np.testing.assert_array_equal(look.materials[0].image, quarters(32))
    np.testing.assert_array_equal(load_shape("out.obj").faces, FACES)


def test_the_same_words_give_the_same_bytes(run: Run, pair: Path) -> None:
    well(run(*call()))
    first = Path("out.glb").read_bytes()
    well(run(*call("--threads 2")))
    assert Path("out.glb").read_bytes() == first


# What can be wrong


def plain_source() -> None:
    save_shape("a.glb", icosphere(2))


def missing_image() -> None:
    write_gltf(Path("a.gltf"), images=["skin.png"], primitives=[{"material": 0}])
    Path("a.gltf").rename("a.glb")
    write_square_obj(Path("a.obj"))
    Path("square.mtl").write_text("newmtl paint\nmap_Kd skin.png\n")


def damaged_source() -> None:
    Path("a.glb").write_bytes(Path("a.glb").read_bytes()[:2000])


def damaged_image() -> None:
    whole = Path("a.glb").read_bytes()
    at = whole.index(b"IDAT")
    Path("a.glb").write_bytes(whole[: at + 8] + bytes(64) + whole[at + 72 :])


def wild_coordinates() -> None:
    ball = icosphere(2)
    uv = unwrapped(ball, 32, 2)
    uv[5] = 1e8
    save_textured("a.glb", TexturedMesh(ball.verts, ball.faces, uv), picture())


def nothing() -> None:
    pass


def a_cloud() -> None:
    np.save("b.npy", load_shape("b.ply").verts)


@pytest.mark.parametrize(
    ("spoil", "words", "said"),
    [
        (plain_source, call(map=None), "a.glb has no texture and no vertex colors: there is nothing to transfer"),
        (damaged_source, call(map=None), "a.glb"),
        (damaged_image, call(map=None), "damaged image"),
        (wild_coordinates, call(map=None), "texture coordinates of 1 faces are out of range"),
        (
            missing_image,
            ["transfer-texture", "a.obj", "b.ply", "-o", "out.glb"],
            "a.obj needs the image skin.png of its material paint, which is not there",
        ),
        *(
            (nothing, call(words, map=None), said)
            for words, said in (
                ("--size 8", "size must be an integer from 16 to 8192"),
                ("--size 9000", "size must be an integer from 16 to 8192"),
                ("--samples 0", "samples must be an integer from 1 to 8"),
                ("--padding 33", "padding of 33 texels"),
                ("--blank purple", "--blank purple"),
                ("--blank 2,0,0", "a color has 3 or 4 numbers within 0..1"),
                ("--blank 0 --fill", "contradict each other"),
                ("--image gone.png", "there is no file gone.png"),
                ("--image b.ply", "b.ply cannot be read as an image"),
                ("--uv keep", "b.ply has no texture coordinates to keep"),
            )
        ),
        (
            lambda: Path("skin.png").write_bytes(png_bytes(picture())),
            call("--image skin.png", out="skin.obj", map=None),
            "cannot write skin.png: it is an input",
        ),
        (lambda: Path("out.png").mkdir(), call(out="out.obj", map=None), "cannot write out.png: it is a folder"),
        (a_cloud, call("--uv keep", target="b.npy", out="out.ply", map=None), "b.npy gets vertex colors"),
        (nothing, call("--uv keep", out="out.ply", map=None), "end the output in .glb or .obj"),
    ],
)
def test_what_cannot_be_is_told_before_the_work(
    run: Run, pair: Path, no_fit: None, spoil: Callable[[], object], words: list[str], said: str
) -> None:
    spoil()
    refused(run(*words), said, pair, {path.name for path in pair.iterdir()})


def test_a_map_of_the_wrong_direction_is_refused_before_the_target_is_unwrapped(
    run: Run, pair: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_work(*_: object) -> None:
        raise RuntimeError("unwrapped")

    found = load_map("ab.npz", load_shape("a.glb"), load_shape("b.ply"))
    save_map("ba.npz", replace(MapPair(load_shape("a.glb"), load_shape("b.ply"), found).backward, verdict="good"))
    monkeypatch.setattr(texture, "atlas_of", no_work)
    before = {path.name for path in pair.iterdir()}
    refused(run(*call(map="ba.npz")), "b.ply to a.glb", pair, before)
    for match in ("ba.npz", load_map("ba.npz")):
        with pytest.raises(InputError, match=r"b\.ply to a\.glb"):
            meshmatch.transfer_texture("a.glb", "b.ply", match)


def test_a_full_disk_leaves_nothing(run: Run, pair: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    before = {path.name for path in pair.iterdir()}
    monkeypatch.setattr(dressed_files, "with_material", full)
    refused(run(*call("-q")), "No space left on device", pair, before)


# The whole road


def test_without_a_map_the_two_are_matched(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    samples = bundled_folder() / "samples"
    answer = run(
        "transfer-texture", samples / "dancer-textured.glb", samples / "climber.ply", "-o", "out.glb",
        *("--size", "256", "--refine", "none", "--seed", "1", "--json"),
    )  # fmt: skip
    record = answer.record
    assert "matched dancer-textured.glb to climber.ply" in answer.err
    assert record["verdict"] in ("good", "fair", "poor")
    assert record["model"] == "human" and record["seed"] == 1
    shape = load_shape("out.glb")
    look = load_appearance("out.glb", shape)
    # striped socks on the lowest part, hair on top: the glb stands along y, which the climber's file does not
    middle = shape.verts[shape.faces].mean(axis=1)
    top = middle[:, 1] > np.quantile(shape.verts[:, 1], 0.995)
    image = look.materials[0].image
    assert image is not None
    uv = look.uv[top].mean(axis=1)
    hair = image[(uv[:, 1] * 256).astype(int), (uv[:, 0] * 256).astype(int), :3].astype(int)
    assert np.median(np.abs(hair - (92, 56, 33)).max(axis=1)) < 40
