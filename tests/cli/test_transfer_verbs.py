"""transfer-color, -labels, -weights and -landmarks through the program's only door.

Maps are made by construction; the last test alone matches.
"""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import FakeMatching, Run, refused, well
from tests.conftest import icosphere
from tests.transfer.known import split
from tests.transfer.skinned import write_skinned_glb

VERBS = ("transfer-color", "transfer-labels", "transfer-weights", "transfer-landmarks")


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
    b = load_shape("b.ply")
    save_map("ab.npz", VertexMap.between(a, b, np.arange(a.V), verdict="good"))
    np.save("values.npy", a.verts)
    np.save("labels.npy", (a.verts[:, 2] > 0).astype(int))
    np.savez("weights.npz", weights=np.stack([a.verts[:, 2] + 1, 1 - a.verts[:, 2]], 1), names=["up", "down"])
    Path("marks.csv").write_text("name,vertex\nnose,3\nchin,7\n")
    return tmp_path


def call(verb: str, *more: str | Path, map: str | None = "ab.npz", out: str = "") -> list[str | Path]:
    data = {"labels": "labels.npy", "landmarks": "marks.csv", "weights": "weights.npz"}
    noun = verb.removeprefix("transfer-")
    words: list[str | Path] = [verb, "a.ply", "b.ply"]
    default = {"color": "out.ply", "labels": "out.npy", "weights": "out.npz", "landmarks": "out.csv"}[noun]
    words += ["-o", out or default]
    if noun in data and f"--{noun}" not in more:
        words += [f"--{noun}", data[noun]]
    return [*words, *([] if map is None else ["--map", map]), *more]


@pytest.mark.parametrize("out", ["out.ply", "out.glb", "out.obj", "out.off", "out.npy", "out.csv"])
def test_colors_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    answer = well(run(*call("transfer-color", out=out)))
    a, b = load_shape("a.ply"), load_shape("b.ply")
    assert a.colors is not None
    if out.endswith(".npy"):
        found = np.load(out)
    elif out.endswith(".csv"):
        found = np.loadtxt(out, delimiter=",", skiprows=1)[:, 1:]
    else:
        shape = load_shape(out)
        assert np.allclose(shape.verts, b.verts, atol=1e-7)
        assert np.array_equal(shape.faces, b.faces)
        assert shape.colors is not None
        found = np.array(shape.colors)
    assert np.abs(found[: a.V, :3] - a.colors[:, :3]).max() < 0.51 / 255
    assert np.abs(found[:, :3] - (b.verts / 2 + 0.5)).max() < 0.05
    assert f"wrote {out}: colors for the {b.V} vertices of b.ply" in answer.err
    assert "used the map ab.npz from a.ply to b.ply" in answer.err


def test_values_of_a_finer_copy(run: Run, pair: Path) -> None:
    answer = well(run(*call("transfer-color", "--values", "values.npy", "--json", out="v.npy")))
    assert np.abs(np.load("v.npy") - load_shape("b.ply").verts).max() < 1e-6
    record = json.loads(answer.out)
    assert record["columns"] == 3
    assert record["output"] == "v.npy"
    assert (record["source"], record["target"]) == ("a.ply", "b.ply")
    assert (record["source_vertices"], record["target_vertices"]) == (162, 642)
    assert record["map"] == "ab.npz"
    assert record["verdict"] == "good"
    assert (record["low_confidence"], record["blank"], record["filled"]) == (0, 0, 0)
    assert record["confidence_mean"] > 0.99
    assert "3 numbers each" in answer.err


def test_directions_turn_with_the_surface(run: Run, pair: Path) -> None:
    """Normals of a ball on a finer one that was turned."""
    a, b = load_shape("a.ply"), load_shape("b.ply")
    save_shape("b.ply", Shape(b.verts[:, [1, 2, 0]], b.faces))
    save_map("ab.npz", VertexMap.between(a, load_shape("b.ply"), np.arange(a.V), verdict="good"))
    well(run(*call("transfer-color", "--values", "values.npy", "--directions", out="v.npy")))
    normals = load_shape("b.ply").vertex_normals
    assert (np.load("v.npy") * normals).sum(axis=1).min() > 0.99
    assert run(*call("transfer-color", "--directions")).status == 1


def test_values_by_csv_and_in_a_ply(run: Run, pair: Path) -> None:
    Path("heat.csv").write_text("heat\n" + "".join(f"{z}\n" for z in load_shape("a.ply").verts[:, 2].tolist()))
    well(run(*call("transfer-color", "--values", "heat.csv", out="v.csv")))
    rows = list(csv.reader(Path("v.csv").read_text().splitlines()))
    assert rows[0] == ["vertex", "heat"]
    assert np.abs(np.array(rows[1:], float)[:, 1] - load_shape("b.ply").verts[:, 2]).max() < 1e-6
    well(run(*call("transfer-color", "--values", "heat.csv", out="v.ply")))
    assert b"property double heat" in Path("v.ply").read_bytes()


@pytest.fixture
def doubtful(pair: Path) -> np.ndarray:
    """The map knows nothing about x > 0.5; which vertices of b that is."""
    a, b = load_shape("a.ply"), load_shape("b.ply")
    sure = np.where(a.verts[:, 0] > 0.5, 0.01, 1.0)
    save_map("ab.npz", VertexMap.between(a, b, np.arange(a.V), confidence=sure, verdict="fair"))
    return np.asarray(b.verts[:, 0] > 0.7)


def test_blank_values(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    answer = well(run(*call("transfer-color", "--values", "values.npy", "--blank", "nan", "--json", out="v.npy")))
    found = np.isnan(np.load("v.npy")).all(axis=1)
    assert found[doubtful].all()
    assert not found[load_shape("b.ply").verts[:, 0] < 0].any()
    record = json.loads(answer.out)
    assert record["blank"] == record["low_confidence"] == found.sum()
    assert record["low_confidence_share"] == pytest.approx(found.mean())
    assert f"({found.sum()} of 642)" in answer.err and "left blank" in answer.err


def test_blank_colors(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    well(run(*call("transfer-color", "--blank", "#804020")))
    colors = load_shape("out.ply").colors
    assert colors is not None
    assert np.allclose(colors[doubtful] * 255, [0x80, 0x40, 0x20, 255])


def test_filled_values(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    answer = well(run(*call("transfer-color", "--values", "values.npy", "--fill", "--json", out="v.npy")))
    found = np.load("v.npy")
    assert found[doubtful, 0].max() < 0.7  # nothing above the rim is known
    record = json.loads(answer.out)
    assert record["filled"] == record["low_confidence"] > 0
    assert "filled in from their neighbours" in answer.err


def test_values_in_doubt_are_kept_unless_asked(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    answer = well(run(*call("transfer-color", "--values", "values.npy", out="v.npy")))
    assert np.load("v.npy")[doubtful, 0].min() > 0.55
    assert "transferred all the same" in answer.err


@pytest.mark.parametrize("verb", VERBS)
def test_the_least_confidence_is_a_choice(run: Run, pair: Path, doubtful: np.ndarray, verb: str) -> None:
    counts = []
    for least in ("0", "0.3", "1"):
        answer = well(run(*call(verb, "--min-confidence", least, "--json")))
        record = json.loads(answer.out)
        assert record["min_confidence"] == float(least)
        counts.append(record["low_confidence"])
    assert counts[0] == 0
    assert counts == sorted(counts)
    if verb != "transfer-landmarks":
        assert counts[2] > counts[1] > 0


@pytest.mark.parametrize("out", ["out.npy", "out.csv", "out.txt", "out.json", "out.ply"])
def test_labels_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    answer = well(run(*call("transfer-labels", "--json", out=out)))
    record = json.loads(answer.out)
    assert (record["from"], record["to"], record["labels"]) == ("vertices", "vertices", 2)
    height = load_shape("b.ply").verts[:, 2]
    if out.endswith(".npy"):
        found = np.load(out)
    elif out.endswith(".json"):
        found = np.array(json.loads(Path(out).read_text())["labels"])
    elif out.endswith(".ply"):
        assert b"property int label" in Path(out).read_bytes()
        return
    else:
        found = np.array([line.split(",")[-1] for line in Path(out).read_text().splitlines() if line != "vertex,label"])
        found = found.astype(int)
    clear = np.abs(height) > 0.2
    assert np.array_equal(found[clear], (height > 0).astype(int)[clear])


def test_labels_of_faces(run: Run, pair: Path) -> None:
    a = load_shape("a.ply")
    names = np.where(a.verts[a.faces, 0].mean(axis=1) > 0, "right", "left")
    Path("faces.txt").write_text("\n".join(names) + "\n")
    answer = well(run(*call("transfer-labels", "--labels", "faces.txt", "--json", out="f.txt")))
    assert Path("f.txt").read_text().split() == [*names] * 4
    assert json.loads(answer.out)["to"] == "faces"
    assert f"2 different labels on the {4 * a.F} faces of b.ply" in answer.err
    well(run(*call("transfer-labels", "--labels", "faces.txt", "--to", "vertices", out="v.txt")))
    assert len(Path("v.txt").read_text().split()) == load_shape("b.ply").V
    answer = well(run(*call("transfer-labels", "--to", "faces", "--json", out="g.npy")))
    assert np.load("g.npy").shape == (4 * a.F,)
    assert (json.loads(answer.out)["from"], json.loads(answer.out)["to"]) == ("vertices", "faces")


def test_labels_of_equal_counts_are_asked_about(run: Run, pair: Path) -> None:
    four = Shape(np.eye(4)[:, :3], np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]))
    save_shape("a.ply", four)
    save_shape("b.ply", four)
    np.save("labels.npy", np.arange(4))
    np.save("same.npy", np.arange(4))
    before = {path.name for path in pair.iterdir()}
    refused(run(*call("transfer-labels", map="same.npy")), "--on vertices or --on faces", pair, before)
    for on in ("vertices", "faces"):
        answer = well(run(*call("transfer-labels", "--on", on, "--json", map="same.npy")))
        assert json.loads(answer.out)["to"] == on
        assert np.load("out.npy").tolist() == [0, 1, 2, 3]


def test_blank_and_filled_labels(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    np.save("labels.npy", np.where(load_shape("a.ply").verts[:, 0] > 0.5, 8, 2))
    well(run(*call("transfer-labels", "--blank", "-1")))
    assert set(np.load("out.npy")) == {2, -1}
    well(run(*call("transfer-labels", "--fill")))
    assert set(np.load("out.npy")) == {2}
    well(run(*call("transfer-labels")))
    assert set(np.load("out.npy")) == {2, 8}


def test_labels_of_faces_onto_a_cloud_go_to_its_points(run: Run, pair: Path) -> None:
    a = load_shape("a.ply")
    save_shape("b.ply", Shape(a.verts, np.empty((0, 3), int)))
    np.save("same.npy", np.arange(a.V))
    np.save("labels.npy", (a.verts[a.faces, 2].mean(axis=1) > 0).astype(int))
    answer = well(run(*call("transfer-labels", "--json", map="same.npy")))
    assert json.loads(answer.out)["to"] == "vertices"
    clear = np.abs(a.verts[:, 2]) > 0.3
    assert np.array_equal(np.load("out.npy")[clear], (a.verts[clear, 2] > 0).astype(int))
    before = {path.name for path in pair.iterdir()}
    answer = run(*call("transfer-labels", "--to", "faces", map="same.npy"))
    refused(answer, "b.ply is a point cloud", pair, before)


@pytest.mark.parametrize("out", ["out.npz", "out.json"])
def test_weights_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    answer = well(run(*call("transfer-weights", "--json", out=out)))
    if out.endswith(".npz"):
        with np.load(out, allow_pickle=False) as archive:
            joints, weights, names = archive["joints"], archive["weights"], archive["names"].tolist()
    else:
        record = json.loads(Path(out).read_text())
        joints, weights, names = np.array(record["joints"]), np.array(record["weights"]), record["names"]
    assert names == ["up", "down"]
    up = np.where(joints == 0, weights, 0).sum(axis=1)
    assert np.abs(up - (load_shape("b.ply").verts[:, 2] + 1) / 2).max() < 1e-6
    record = json.loads(answer.out)
    assert (record["joints"], record["used_joints"], record["without_weights"]) == (2, 2, 0)


def test_as_many_influences_as_asked(run: Run, pair: Path) -> None:
    rng = np.random.default_rng(0)
    np.savez("weights.npz", weights=rng.random((162, 9)))
    for most in (1, 3):
        well(run(*call("transfer-weights", "--influences", str(most))))
        with np.load("out.npz") as archive:
            assert archive["weights"].shape == (642, most)
            assert np.allclose(archive["weights"].sum(axis=1), 1)


def test_the_skin_of_a_glb(run: Run, pair: Path) -> None:
    write_skinned_glb(Path("s.glb"))
    shape = load_shape("s.glb")
    np.save("same.npy", np.arange(shape.V))
    words = ["transfer-weights", "s.glb", "s.glb", "-o", "out.npz", "--map", "same.npy"]
    answer = well(run(*words))
    assert "warning: 3 of the 10 vertices have no weights" in answer.err
    with np.load("out.npz") as archive:
        assert archive["names"].tolist() == ["hip", "knee"]
        assert np.allclose(archive["weights"].sum(axis=1), [1] * 7 + [0] * 3)
    shown = Path("other.ply")
    save_shape(shown, shape)
    well(run("transfer-weights", shown, "s.glb", "--weights", "s.glb", *words[3:]))


def test_weights_are_filled(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    a = load_shape("a.ply")
    right = a.verts[:, 0] > 0.5
    np.savez("weights.npz", weights=np.stack([right, ~right], 1).astype(float))
    well(run(*call("transfer-weights", "--fill")))
    with np.load("out.npz") as archive:
        joints, weights = archive["joints"], archive["weights"]
    assert np.allclose(weights.sum(axis=1), 1)
    assert np.where(joints == 0, weights, 0).sum(axis=1)[doubtful].max() <= 0.5


def test_a_file_without_a_skin_asks_for_weights(run: Run, pair: Path) -> None:
    before = {path.name for path in pair.iterdir()}
    answer = run("transfer-weights", "a.ply", "b.ply", "-o", "out.npz", "--map", "ab.npz")
    refused(answer, "a.ply has no skin weights", pair, before)
    assert "--weights" in answer.err


@pytest.mark.parametrize("out", ["out.csv", "out.json", "out.pp"])
def test_landmarks_of_a_finer_copy(run: Run, pair: Path, out: str) -> None:
    answer = well(run(*call("transfer-landmarks", "--json", out=out)))
    assert json.loads(answer.out)["landmarks"] == 2
    at = load_shape("b.ply").verts[[3, 7]]
    if out.endswith(".csv"):
        rows = list(csv.DictReader(Path(out).read_text().splitlines()))
        found = [[float(row[axis]) for axis in "xyz"] for row in rows]
        assert [row["name"] for row in rows] == ["nose", "chin"]
        assert [int(row["vertex"]) for row in rows] == [3, 7]
    elif out.endswith(".json"):
        record = json.loads(Path(out).read_text())["landmarks"]
        found = [entry["position"] for entry in record]
        assert [entry["vertex"] for entry in record] == [3, 7]
    else:
        from xml.etree import ElementTree

        points = list(ElementTree.parse(out).getroot().iter("point"))
        found = [[float(point.get(axis) or "nan") for axis in "xyz"] for point in points]
        assert [point.get("name") for point in points] == ["nose", "chin"]
    assert np.allclose(found, at, atol=1e-12)


def test_unsure_landmarks_are_named(run: Run, pair: Path, doubtful: np.ndarray) -> None:
    right = int(load_shape("a.ply").verts[:, 0].argmax())
    Path("marks.csv").write_text(f"name,vertex\nleft,{load_shape('a.ply').verts[:, 0].argmin()}\nright,{right}\n")
    answer = well(run(*call("transfer-landmarks", "--quiet")))
    assert answer.err == "warning: landmark right is uncertain: its confidence is 0.01\n"
    Path("marks.csv").write_text("vertex\n" + f"{right}\n" * 15)
    answer = well(run(*call("transfer-landmarks", "--quiet")))
    assert len(answer.err.splitlines()) == 11
    assert "so are 5 more" in answer.err


def test_landmarks_off_the_surface_are_mentioned(run: Run, pair: Path) -> None:
    Path("marks.csv").write_text("name,x,y,z\nnose,1.3,0,0\n")
    answer = well(run(*call("transfer-landmarks")))
    assert "warning: a landmark lies 0.3" in answer.err
    assert "the nearest point of the surface was taken" in answer.err


def missing(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).unlink()


def plain(folder: Path) -> None:
    shape = load_shape("a.ply")
    save_shape("a.ply", Shape(shape.verts, shape.faces))


def short(name: str) -> Callable[[Path], object]:
    return lambda folder: np.save(folder / name, np.arange(9))


def nothing(folder: Path) -> None:
    pass


WRONG: dict[str, tuple[list[str | Path], Callable[[Path], object], str]] = {
    "no colors": (call("transfer-color"), plain, "a.ply has no vertex colors"),
    "colors as stl": (call("transfer-color", out="c.stl"), nothing, "'.stl' is not a format for vertex colors"),
    "values as glb": (
        call("transfer-color", "--values", "values.npy", out="c.glb"),
        nothing,
        "'.glb' is not a format for values",
    ),
    "short values": (
        call("transfer-color", "--values", "values.npy", out="v.npy"),
        short("values.npy"),
        "9 rows, but a.ply has 162",
    ),
    "blank colors": (call("transfer-color", "--blank", "red"), nothing, "--blank red: 4 numbers are needed"),
    "colors out of range": (call("transfer-color", "--blank", "2"), nothing, "a color has 3 or 4 numbers within 0..1"),
    "both": (call("transfer-color", "--blank", "0", "--fill"), nothing, "contradict each other"),
    "short labels": (
        call("transfer-labels"),
        short("labels.npy"),
        "9 labels, but a.ply has 162 vertices and 320 faces",
    ),
    "labels as obj": (call("transfer-labels", out="l.obj"), nothing, "'.obj' is not a format for labels"),
    "blank labels": (call("transfer-labels", "--blank", "none"), nothing, "labels are whole numbers here"),
    "labels of what": (call("transfer-labels", "--on", "faces"), nothing, "cannot be of its faces"),
    "no labels": (call("transfer-labels", "--labels", "gone.npy"), nothing, "there is no file gone.npy"),
    "both labels": (call("transfer-labels", "--blank", "0", "--fill"), nothing, "contradict each other"),
    "weights as fbx": (call("transfer-weights", out="w.fbx"), nothing, "not a format for skin weights"),
    "other weights": (call("transfer-weights", "--weights", "values.npy"), nothing, "not read from '.npy' files"),
    "landmarks as txt": (call("transfer-landmarks", out="l.txt"), nothing, "not a format for landmarks"),
    "landmarks of another": (
        call("transfer-landmarks"),
        lambda folder: (folder / "marks.csv").write_text("name,vertex\nnose,900\n"),
        "nose is vertex 900, but a.ply has 162 vertices",
    ),
    "over an input": (call("transfer-labels", out="labels.npy"), nothing, "is an input of this command"),
    "over the map": (
        call("transfer-color", "--values", "values.npy", out="ab.npz"),
        nothing,
        "not a format for values",
    ),
    "over the source": (call("transfer-color", out="a.ply"), nothing, "is an input of this command"),
    "over the weights": (call("transfer-weights", out="weights.npz"), nothing, "is an input of this command"),
    "over the landmarks": (call("transfer-landmarks", out="marks.csv"), nothing, "is an input of this command"),
    "no source": (call("transfer-color"), missing("a.ply"), "there is no file a.ply"),
    "no target": (call("transfer-color"), missing("b.ply"), "there is no file b.ply"),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_cannot_be_is_told_in_a_line(run: Run, pair: Path, case: str) -> None:
    words, prepare, message = WRONG[case]
    prepare(pair)
    before = {path.name for path in pair.iterdir()}
    refused(run(*words), message, pair, before)


@pytest.mark.parametrize("verb", VERBS)
def test_a_match_is_told_and_recorded(run: Run, pair: Path, verb: str, stub: FakeMatching) -> None:
    choices = ["--refine", "latent", "--seed", "7"]
    answer = well(run(*call(verb, *choices, "--json", map=None)))
    record = json.loads(answer.out)
    assert (record["map"], record["model"], record["refine"], record["seed"]) == (None, "human", "latent", 7)
    assert record["seconds"] == 2.5
    assert "matched a.ply to b.ply (2.5 s)" in answer.err
    assert "a.ply: 3 faces dropped" in answer.err


def test_without_a_map_the_two_are_matched(run: Run, tmp_path: Path) -> None:
    """From the weights of one bundled body to those of the other, each a mesh of its own."""
    samples = bundled_folder() / "samples"
    a, b = load_shape(samples / "dancer.ply"), load_shape(samples / "climber.ply")
    height = a.verts[:, 1] - a.verts[:, 1].min()
    np.save(tmp_path / "height.npy", height / height.max())
    words = ["--values", tmp_path / "height.npy", "--refine", "none", "--json", "--threads", "1"]
    out = tmp_path / "out.npy"
    answer = well(run("transfer-color", samples / "dancer.ply", samples / "climber.ply", "-o", out, *words))
    found = np.load(out)
    head, foot = b.verts[:, 2].argmax(), b.verts[:, 2].argmin()
    assert found.shape == (b.V,)
    assert 0 <= found.min() and found.max() <= 1
    assert found[head] > 0.9 and found[foot] < 0.15
    record = json.loads(answer.out)
    assert record["confidence_mean"] > 0.5
    assert (record["model"], record["refine"]) == ("human", "none")
