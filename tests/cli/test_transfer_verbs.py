"""transfer-color, -labels, -weights and -landmarks through the program's only door.

Maps are made by construction; the last test alone matches.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.formats.vtk import write_vtp
from meshmatch.shapes.formats.vtk_xml import point_arrays
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer.label_files import load_labels
from meshmatch.transfer.landmarks import load_landmarks
from meshmatch.transfer.value_files import load_values
from meshmatch.transfer.weight_files import load_weights
from tests.cli.conftest import FakeMatching, Run, refused, well
from tests.conftest import icosphere
from tests.transfer.known import split
from tests.transfer.skinned import write_skinned_glb

DATA = {"labels": "labels.npy", "landmarks": "marks.csv", "weights": "weights.npz"}
OUTPUT = {"color": "out.ply", "labels": "out.npy", "weights": "out.npz", "landmarks": "out.csv"}


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a painted a.ply, a finer b.ply of the same surface, a map between them, and data of a."""
    monkeypatch.chdir(tmp_path)
    ball = icosphere(2)
    shade = np.concatenate([ball.verts / 2 + 0.5, np.ones((ball.V, 1))], axis=1)
    save_shape("a.ply", Shape(ball.verts, ball.faces, "a", np.round(shade * 255) / 255))
    a = load_shape("a.ply")
    fine, _, _ = split(a)
    save_shape("b.ply", fine)
    save_map("ab.npz", VertexMap.between(a, load_shape("b.ply"), np.arange(a.V), verdict="good"))
    np.save("values.npy", a.verts)
    np.save("labels.npy", (a.verts[:, 2] > 0).astype(int))
    np.savez("weights.npz", weights=np.stack([a.verts[:, 2] + 1, 1 - a.verts[:, 2]], 1), names=["up", "down"])
    Path("marks.csv").write_text("name,vertex\nnose,3\nchin,7\n")
    return tmp_path


def call(words: str, map: str = "ab.npz", out: str = "") -> list[str]:
    """The whole call of a verb and its options, such as "labels --to faces"."""
    noun, *more = words.split()
    given = [f"--{noun}", DATA[noun]] if noun in DATA and f"--{noun}" not in more else []
    return [f"transfer-{noun}", "a.ply", "b.ply", "-o", out or OUTPUT[noun], *given, "--map", map, *more]


def test_a_vtp_keeps_its_arrays(run: Run, pair: Path) -> None:
    a, b = load_shape("a.ply"), load_shape("b.ply")
    write_vtp(Path("a.vtp"), a, {"height": a.verts[:, 2]})
    write_vtp(Path("b.vtp"), b, {"thickness": np.arange(b.V)})
    given = {"color": ["--values", "a.vtp"], "labels": ["--labels", "labels.npy"]}
    for noun, options in given.items():
        well(run(f"transfer-{noun}", "a.ply", "b.vtp", "-o", f"{noun}.vtp", *options, "--map", "ab.npz"))
    assert list(point_arrays(Path("color.vtp"))) == ["thickness", "height"]
    assert list(point_arrays(Path("labels.vtp"))) == ["thickness", "label"]


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_texture_coordinates_that_another_format_loses_are_told(run: Run, pair: Path, suffix: str) -> None:
    ball, name = load_shape("b.ply"), f"laid.{suffix}"
    if suffix == "ply":
        lines = [f"{x} {y} {z} {x} {y}" for x, y, z in ball.verts.tolist()]
        lines += [f"3 {a} {b} {c}" for a, b, c in ball.faces.tolist()]
        head = [f"property double {each}" for each in ("x", "y", "z", "s", "t")]
        head = ["ply", "format ascii 1.0", f"element vertex {ball.V}", *head, f"element face {ball.F}"]
        Path(name).write_text("\n".join([*head, "property list uchar int vertex_indices", "end_header", *lines]))
    else:
        mesh = TexturedMesh(ball.verts, ball.faces, ball.verts[ball.faces][..., :2])
        save_textured(name, mesh, np.full((4, 4, 4), 255, np.uint8))
    save_map("laid.npz", VertexMap.between(load_shape("a.ply"), load_shape(name), np.zeros(load_shape("a.ply").V, int)))
    for out in ("out.glb", "out.obj", "out.ply", "out.off"):
        answer = well(run("transfer-color", "a.ply", name, "--map", "laid.npz", "-o", out))
        told = "texture coordinates" in answer.err and f"of {name}" in answer.err
        assert told == (out.rpartition(".")[2] != suffix), answer.err


@pytest.mark.parametrize("suffix", ["ply", "obj"])
def test_files_that_the_output_names_but_lacks_are_told(run: Run, pair: Path, suffix: str) -> None:
    """The text of the target is kept, with the names of its images or materials, which are not copied."""
    save_shape(f"b.{suffix}", load_shape("b.ply"))
    Path("far").mkdir()
    text = Path(f"b.{suffix}").read_bytes()
    names = text.replace(b"element vertex", b"comment TextureFile skin.png\nelement vertex", 1)
    Path(f"b.{suffix}").write_bytes(names if suffix == "ply" else b"mtllib b.mtl\n" + text)
    Path("b.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    Path("skin.png").write_bytes(b"an image")
    named = "skin.png" if suffix == "ply" else "b.mtl, skin.png"
    command = ["transfer-color", "a.ply", f"b.{suffix}", "--map", "ab.npz", "-o"]
    told = f"warning: out.{suffix} refers to {named}, which is not in its folder: copy it from that of b.{suffix}\n"
    assert told in well(run(*command, f"far/out.{suffix}")).err
    assert "refers to" not in well(run(*command, f"out.{suffix}")).err


@pytest.mark.parametrize("out", ["out.ply", "out.glb", "out.obj", "out.off", "out.npy", "out.csv"])
def test_colors_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    answer = well(run(*call("color", out=out)))
    a, b = load_shape("a.ply"), load_shape("b.ply")
    if out.endswith((".npy", ".csv")):
        found = load_values(out, b).numbers
    else:
        shape = load_shape(out)
        assert np.allclose(shape.verts, b.verts, atol=1e-7)
        assert np.array_equal(shape.faces, b.faces)
        found = np.array(shape.colors)
    assert np.abs(found[: a.V, :3] - a.colors[:, :3]).max() < 0.51 / 255
    assert np.abs(found[:, :3] - (b.verts / 2 + 0.5)).max() < 0.05
    assert f"wrote {out}: colors for the {b.V} vertices of b.ply" in answer.err
    assert "used the map ab.npz from a.ply to b.ply" in answer.err


def test_landmarks_of_one_name_are_all_kept_and_told(run: Run, pair: Path) -> None:
    Path("marks.csv").write_text("name,vertex\nnose,3\nchin,7\nnose,9\n")
    answer = well(run(*call("landmarks")))
    assert "warning: marks.csv has several landmarks of one name: nose\n" in answer.err
    found, _ = load_landmarks("out.csv", load_shape("b.ply"))
    assert (found.names, found.vertex.tolist()) == (("nose", "chin", "nose"), [3, 7, 9])
    answer = well(run("evaluate", "ab.npz", "a.ply", "b.ply", "--points", "marks.csv", "out.csv", "--json"))
    assert answer.record["points"] == 1 and "warning: names of several landmarks are left out: nose\n" in answer.err


def test_two_poses_of_a_mesh_are_told(run: Run, pair: Path) -> None:
    save_shape("posed.ply", replace(load_shape("a.ply"), verts=2.0 * load_shape("a.ply").verts + 1.0))
    answer = well(run("transfer-color", "a.ply", "posed.ply", "--values", "values.npy", "-o", "v.npy"))
    assert "a.ply and posed.ply have the same faces: each vertex is mapped to the one with the same index" in answer.err
    np.testing.assert_array_equal(np.load("v.npy"), np.load("values.npy"))
    words = ("transfer-color", "a.ply", "posed.ply", "--values", "values.npy", "-o", "v.npy")
    assert "have the same faces" not in run(*words, "--landmarks", "nowhere.txt").err


def test_values_of_a_finer_copy(run: Run, pair: Path) -> None:
    answer = run(*call("color --values values.npy --json", out="v.npy"))
    assert np.abs(np.load("v.npy") - load_shape("b.ply").verts).max() < 1e-6
    found = answer.record
    assert found.pop("confidence_mean") > 0.99
    assert found.items() >= {
        ("columns", 3), ("output", "v.npy"), ("source", "a.ply"), ("target", "b.ply"), ("source_vertices", 162),
        ("target_vertices", 642), ("map", "ab.npz"), ("verdict", "good"), ("low_confidence", 0), ("blank", 0),
        ("filled", 0),
    }  # fmt: skip
    assert "3 numbers each" in answer.err


def test_names_of_columns_stay(run: Run, pair: Path) -> None:
    Path("heat.csv").write_text("heat\n" + "".join(f"{z}\n" for z in load_shape("a.ply").verts[:, 2].tolist()))
    well(run(*call("color --values heat.csv", out="v.csv")))
    found = load_values("v.csv", load_shape("b.ply"))
    assert found.names == ("heat",)
    assert np.abs(found.numbers.ravel() - load_shape("b.ply").verts[:, 2]).max() < 1e-6
    well(run(*call("color --values heat.csv", out="v.ply")))
    assert b"property float heat" in Path("v.ply").read_bytes()


def test_directions_turn_with_the_surface(run: Run, pair: Path) -> None:
    """Normals of a ball on a finer one that was turned."""
    a, b = load_shape("a.ply"), load_shape("b.ply")
    save_shape("b.ply", Shape(b.verts[:, [1, 2, 0]], b.faces))
    save_map("ab.npz", VertexMap.between(a, load_shape("b.ply"), np.arange(a.V), verdict="good"))
    well(run(*call("color --values values.npy --directions", out="v.npy")))
    assert (np.load("v.npy") * load_shape("b.ply").vertex_normals).sum(axis=1).min() > 0.99


@pytest.mark.parametrize("out", ["out.npy", "out.csv", "out.txt", "out.json"])
def test_labels_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    found = run(*call("labels --json", out=out)).record
    assert (found["from"], found["to"], found["labels"]) == ("vertices", "vertices", 2)
    b = load_shape("b.ply")
    labels = load_labels(out, b)
    clear = np.abs(b.verts[:, 2]) > 0.2
    assert np.array_equal(np.array(labels.names)[labels.codes][clear], (b.verts[:, 2] > 0)[clear])


def test_labels_of_faces(run: Run, pair: Path) -> None:
    a = load_shape("a.ply")
    names = np.where(a.verts[a.faces, 0].mean(axis=1) > 0, "right", "left")
    Path("faces.txt").write_text("\n".join(names) + "\n")
    answer = run(*call("labels --labels faces.txt --json", out="f.txt"))
    assert answer.record["to"] == "faces"
    assert Path("f.txt").read_text().split() == [*names] * 4
    assert f"2 different labels on the {4 * a.F} faces of b.ply" in answer.err
    well(run(*call("labels --labels faces.txt --to vertices", out="v.txt")))
    assert len(Path("v.txt").read_text().split()) == load_shape("b.ply").V
    found = run(*call("labels --to faces --json", out="g.npy")).record
    assert np.load("g.npy").shape == (4 * a.F,)
    assert (found["from"], found["to"]) == ("vertices", "faces")


def test_labels_of_equal_counts_are_asked_about(run: Run, pair: Path) -> None:
    four = Shape(np.eye(4)[:, :3], np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    for name in ("a.ply", "b.ply"):
        save_shape(name, four)
    for name in ("labels.npy", "same.npy"):
        np.save(name, np.arange(4))
    refused(run(*call("labels", map="same.npy")), "--on vertices", pair, {path.name for path in pair.iterdir()})
    for on in ("vertices", "faces"):
        assert run(*call(f"labels --on {on} --json", map="same.npy")).record["to"] == on
        assert np.load("out.npy").tolist() == [0, 1, 2, 3]


def test_labels_of_faces_onto_a_cloud_go_to_its_points(run: Run, pair: Path) -> None:
    a = load_shape("a.ply")
    save_shape("b.ply", Shape(a.verts, np.empty((0, 3), int)))
    np.save("same.npy", np.arange(a.V))
    np.save("labels.npy", (a.verts[a.faces, 2].mean(axis=1) > 0).astype(int))
    assert run(*call("labels --json", map="same.npy")).record["to"] == "vertices"
    clear = np.abs(a.verts[:, 2]) > 0.3
    assert np.array_equal(np.load("out.npy")[clear], (a.verts[clear, 2] > 0).astype(int))
    before = {path.name for path in pair.iterdir()}
    refused(run(*call("labels --to faces", map="same.npy")), "point cloud", pair, before)


@pytest.mark.parametrize("out", ["out.npz", "out.json"])
def test_weights_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    found = run(*call("weights --json", out=out)).record
    assert (found["joints"], found["used_joints"], found["without_weights"]) == (2, 2, 0)
    b = load_shape("b.ply")
    weights = load_weights(out, b)
    assert weights.names == ("up", "down")
    assert np.abs(weights.matrix.toarray()[:, 0] - (b.verts[:, 2] + 1) / 2).max() < 1e-6


@pytest.mark.parametrize("most", [1, 3])
def test_as_many_influences_as_asked(run: Run, pair: Path, most: int) -> None:
    np.savez("weights.npz", weights=np.random.default_rng(0).random((162, 9)))
    well(run(*call(f"weights --influences {most}")))
    with np.load("out.npz") as archive:
        assert archive["weights"].shape == (642, most)
        assert np.allclose(archive["weights"].sum(axis=1), 1)


def test_the_skin_of_a_glb(run: Run, pair: Path) -> None:
    write_skinned_glb(Path("s.glb"))
    shape = load_shape("s.glb")
    np.save("same.npy", np.arange(shape.V))
    words = ["s.glb", "-o", "out.npz", "--map", "same.npy"]
    answer = well(run("transfer-weights", "s.glb", *words))
    assert "warning: 3 of the 10 vertices have no weights" in answer.err
    weights = load_weights("out.npz", shape)
    assert weights.names == ("hip", "knee")
    assert np.allclose(weights.matrix.sum(axis=1), [1] * 7 + [0] * 3)
    save_shape("other.ply", shape)
    well(run("transfer-weights", "other.ply", "--weights", "s.glb", *words))
    before = {path.name for path in pair.iterdir()}
    refused(run("transfer-weights", "other.ply", *words), "no skin weights", pair, before)


@pytest.mark.parametrize("out", ["out.csv", "out.json", "out.pp", "out.mrk.json", "out.tps"])
def test_landmarks_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    assert run(*call("landmarks --json", out=out)).record["landmarks"] == 2
    b = load_shape("b.ply")
    found, furthest = load_landmarks(out, b)
    assert found.names == (("0", "1") if out == "out.tps" else ("nose", "chin"))
    assert np.allclose(found.points, b.verts[[3, 7]], atol=1e-9) and furthest < 1e-9
    assert out != "out.tps" or Path(out).read_text().endswith("\nID=b\n")


# Low confidence


@pytest.fixture
def doubtful(pair: Path) -> np.ndarray:
    """The map knows nothing about x > 0.5; which vertices of b that is."""
    a, b = load_shape("a.ply"), load_shape("b.ply")
    sure = np.where(a.verts[:, 0] > 0.5, 0.01, 1.0)
    save_map("ab.npz", VertexMap.between(a, b, np.arange(a.V), confidence=sure, verdict="fair"))
    return np.asarray(b.verts[:, 0] > 0.7)


def test_values_in_doubt_are_kept_filled_or_blank(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    answer = well(run(*call("color --values values.npy", out="v.npy")))
    assert np.load("v.npy")[doubtful, 0].min() > 0.55
    assert "kept as transferred" in answer.err

    answer = run(*call("color --values values.npy --blank nan --json", out="v.npy"))
    blank = np.isnan(np.load("v.npy")).all(axis=1)
    assert blank[doubtful].all() and not blank[load_shape("b.ply").verts[:, 0] < 0].any()
    found = answer.record
    assert found["blank"] == found["low_confidence"] == blank.sum()
    assert found["low_confidence_share"] == pytest.approx(blank.mean())
    assert f"({blank.sum()} of 642)" in answer.err and "left blank" in answer.err

    answer = run(*call("color --values values.npy --fill --json", out="v.npy"))
    assert np.load("v.npy")[doubtful, 0].max() < 0.7  # nothing above the rim is known
    found = answer.record
    assert found["filled"] == found["low_confidence"] > 0
    assert "filled in from their neighbours" in answer.err


def test_other_data_in_doubt(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    right = load_shape("a.ply").verts[:, 0] > 0.5
    well(run(*call("color --blank #804020")))
    assert np.allclose(np.array(load_shape("out.ply").colors)[doubtful] * 255, [0x80, 0x40, 0x20, 255])
    np.save("labels.npy", np.where(right, 8, 2))
    for words, left in (("--blank -1", {2, -1}), ("--fill", {2}), ("", {2, 8})):
        well(run(*call(f"labels {words}")))
        assert set(np.load("out.npy")) == left
    np.savez("weights.npz", weights=np.stack([right, ~right], 1).astype(float))
    well(run(*call("weights --fill")))
    weights = load_weights("out.npz", load_shape("b.ply")).matrix.toarray()
    assert np.allclose(weights.sum(axis=1), 1)
    assert weights[doubtful, 0].max() <= 0.5


@pytest.mark.parametrize("noun", OUTPUT)
def test_the_least_confidence_is_a_choice(run: Run, pair: Path, doubtful: np.ndarray, noun: str) -> None:
    found = [run(*call(f"{noun} --min-confidence {least} --json")).record for least in ("0", "0.3", "1")]
    assert [each["min_confidence"] for each in found] == [0, 0.3, 1]
    counts = [each["low_confidence"] for each in found]
    assert counts[0] == 0 and counts == sorted(counts)
    assert noun == "landmarks" or counts[2] > counts[1] > 0


def test_unsure_landmarks_are_named(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    x = load_shape("a.ply").verts[:, 0]
    Path("marks.csv").write_text(f"name,vertex\nleft,{x.argmin()}\nright,{x.argmax()}\n")
    answer = well(run(*call("landmarks --quiet")))
    assert answer.err == "warning: b.ply: missing are landmarks of confidence below 0.3: right (0.01)\n"
    assert load_landmarks("out.csv", load_shape("b.ply"))[0].names == ("left",)
    well(run(*call("landmarks --min-confidence 0 --quiet")))
    assert load_landmarks("out.csv", load_shape("b.ply"))[0].names == ("left", "right")
    Path("marks.csv").write_text("vertex\n" + f"{x.argmax()}\n" * 15)
    answer = well(run(*call("landmarks --quiet")))
    assert len(answer.err.splitlines()) == 1
    assert answer.err.endswith(" and 5 more\n")


def test_landmarks_off_the_surface_are_mentioned(run: Run, pair: Path) -> None:
    Path("marks.csv").write_text("name,x,y,z\nnose,1.3,0,0\n")
    said = well(run(*call("landmarks"))).err
    assert "warning: a landmark lies 0.3" in said and "wrote out.csv: 1 landmark on b.ply\n" in said


# What cannot be


def unpainted() -> None:
    shape = load_shape("a.ply")
    save_shape("a.ply", Shape(shape.verts, shape.faces))


@pytest.mark.parametrize(
    ("words", "out", "told"),
    [
        ("color", "c.stl", "'.stl' is not a format"),
        ("color --values values.npy", "c.glb", "'.glb' is not a format"),
        ("color --values values.npy", "ab.npz", "not a format"),
        ("color --values labels.npy --directions", "v.npy", "directions"),
        ("color --directions", "", "--directions needs --values"),
        ("color --blank red", "", "--blank red"),
        ("color --blank 2", "", "within 0..1"),
        ("color --blank 0 --fill", "", "contradict each other"),
        ("color", "a.ply", "is an input of this command"),
        ("labels", "l.obj", "'.obj' is not a format"),
        ("labels --blank none", "", "whole numbers"),
        ("labels --on faces", "", "cannot be of its faces"),
        ("labels --labels gone.npy", "", "there is no file gone.npy"),
        ("labels --blank 0 --fill", "", "contradict each other"),
        ("labels", "labels.npy", "is an input of this command"),
        ("weights", "w.fbx", "a skeleton too"),
        ("weights", "w.txt", "not a format"),
        ("weights --weights values.npy", "", "'.npy'"),
        ("weights", "weights.npz", "is an input of this command"),
        ("landmarks", "l.txt", "not a format"),
        ("landmarks", "marks.csv", "is an input of this command"),
    ],
)
def test_what_cannot_be_is_told_in_a_line(run: Run, pair: Path, words: str, out: str, told: str) -> None:
    refused(run(*call(words, out=out)), told, pair, {path.name for path in pair.iterdir()})


@pytest.mark.parametrize(
    ("spoil", "words", "told"),
    [
        (unpainted, "color", "a.ply has no vertex colors"),
        (lambda: np.save("values.npy", np.arange(9)), "color --values values.npy", "9 rows"),
        (lambda: np.save("labels.npy", np.arange(9)), "labels", "162 vertices and 320 faces"),
        (lambda: Path("marks.csv").write_text("name,vertex\nnose,900\n"), "landmarks", "nose is vertex 900"),
        (lambda: Path("a.ply").unlink(), "color", "there is no file a.ply"),
        (lambda: Path("b.ply").unlink(), "color", "there is no file b.ply"),
    ],
)
def test_files_that_do_not_fit_are_told(
    run: Run, pair: Path, spoil: Callable[[], object], words: str, told: str
) -> None:
    spoil()
    refused(run(*call(words)), told, pair, {path.name for path in pair.iterdir()})


# Without a map


@pytest.mark.parametrize("noun", OUTPUT)
def test_a_match_is_told_and_recorded(run: Run, pair: Path, noun: str, stub: FakeMatching) -> None:
    words = [word for word in call(f"{noun} --refine latent --seed 7 --json") if word not in ("--map", "ab.npz")]
    answer = run(*words)
    expected = {("map", None), ("model", "human"), ("refine", "latent"), ("seed", 7), ("seconds", 2.5)}
    assert {(key, value) for key, value in answer.record.items() if key in dict(expected)} == expected
    assert "matched a.ply to b.ply (2.5 s)" in answer.err
    assert "a.ply: 3 faces dropped" in answer.err


def test_without_a_map_the_two_are_matched(run: Run, tmp_path: Path) -> None:
    """From one bundled body to the other, each a mesh of its own."""
    samples = bundled_folder() / "samples"
    a, b = load_shape(samples / "dancer.ply"), load_shape(samples / "climber.ply")
    height = a.verts[:, 1] - a.verts[:, 1].min()
    np.save(tmp_path / "height.npy", height / height.max())
    words = ["--values", tmp_path / "height.npy", "--refine", "none", "--json", "--threads", "1"]
    out = tmp_path / "out.npy"
    answer = run("transfer-color", samples / "dancer.ply", samples / "climber.ply", "-o", out, *words)
    found = np.load(out)
    assert found.shape == (b.V,)
    assert 0 <= found.min() and found.max() <= 1
    assert found[b.verts[:, 2].argmax()] > 0.9 and found[b.verts[:, 2].argmin()] < 0.15
    said = answer.record
    assert said["confidence_mean"] > 0.5
    assert (said["model"], said["refine"]) == ("human", "none")
