"""One transfer to many targets, through the program's only door."""

import csv
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from meshmatch.api import matching
from meshmatch.api.results import MatchResult
from meshmatch.collections.transfers import Targets
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.landmarks import landmark_positions
from tests.cli.conftest import FakeMatching, Run, nearest_map, refused, well
from tests.conftest import icosphere

LABELS = ("transfer-labels", "a.ply", "in", "--labels", "labels.txt", "-o", "out")
VERBS = {
    "transfer-color": ("b.ply", "sub/c.glb"),
    "transfer-labels": ("b.npy", "sub/c.npy"),
    "transfer-weights": ("b.npz", "sub/c.npz"),
    "transfer-landmarks": ("b.csv", "sub/c.csv"),
    "measure": ("b.csv", "sub/c.csv"),
    "transfer-shapes": ("b.glb", "sub/c.glb"),
    "transfer-garment": ("b.obj", "sub/c.obj"),
}
"""What each verb writes of in/b.ply and in/sub/c.glb."""
MORE = {
    "transfer-labels": ("--labels", "labels.txt"),
    "transfer-weights": ("--weights", "weights.json"),
    "transfer-landmarks": ("--landmarks", "points.txt"),
    "measure": ("--landmarks", "points.txt", "--measurements", "what.csv"),
    "transfer-shapes": ("--shapes", "moved.ply"),
}


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A source and a folder of two targets, and what verbs want beside them."""
    sphere, ring = icosphere(2), trimesh.creation.torus(1.0, 0.4, major_sections=20, minor_sections=12)
    other = Shape(ring.vertices, ring.faces)
    monkeypatch.chdir(tmp_path)
    Path("in/sub").mkdir(parents=True)
    save_shape("worn.obj", Shape(1.1 * sphere.verts, sphere.faces, "worn"))
    save_shape("moved.ply", Shape(sphere.verts + 0.1, sphere.faces))
    save_shape("a.ply", Shape(sphere.verts, sphere.faces, "a", np.full((sphere.V, 4), 0.5)))
    save_shape("in/b.ply", other)
    save_shape("in/sub/c.glb", other)
    Path("labels.txt").write_text("1\n" * sphere.V)
    Path("weights.json").write_text(json.dumps({"weights": [[1.0]] * sphere.V}))
    Path("points.txt").write_text("0\n5\n")
    Path("what.csv").write_text("far,distance,0,1\n")
    return tmp_path


def table(folder: str = "out") -> dict[str, dict[str, str]]:
    with Path(folder, "transfers.csv").open(encoding="utf-8", newline="") as file:
        return {row["name"]: row for row in csv.DictReader(file)}


def counted(stub: FakeMatching, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of targets, as they are matched from now on."""
    seen: list[str] = []

    def match(a: Shape, b: Shape, **options: Any) -> MatchResult:
        seen.append(b.name)
        return stub.match(a, b, **options)

    monkeypatch.setattr(matching, "match", match)
    return seen


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_takes_a_folder(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    garment = ("worn.obj",) if verb == "transfer-garment" else ()
    answer = well(run(verb, *garment, "a.ply", "in", "-o", "out", *MORE.get(verb, ()), "--json"))
    assert {str(path.relative_to("out")) for path in Path("out").rglob("*.*")} >= {*VERBS[verb], "transfers.csv"}
    record = answer.record
    assert (record["output"], record["table"], record["verdicts"]) == ("out", "out/transfers.csv", {"good": 2})
    assert [each["name"] for each in record["targets"]] == ["b", "sub/c"]
    assert [each["source"] for each in record["targets"]] == ["a.ply", "a.ply"]
    lines = answer.err.splitlines()
    assert lines[0].split() == ["target", "verdict", "confidence", "seconds"]
    assert [line.split()[:3] for line in lines if line.startswith(("b ", "sub/c "))] == [
        ["b", "good", "1.00"], ["sub/c", "good", "1.00"]
    ]  # fmt: skip
    assert "2 of 2 targets are in out: 2 good; see out/transfers.csv" in lines


def test_what_is_finished_is_kept(run: Run, files: Path, stub: FakeMatching, monkeypatch: pytest.MonkeyPatch) -> None:
    well(run(*LABELS))
    seen = counted(stub, monkeypatch)
    before = {path: path.read_bytes() for path in Path("out").rglob("*.npy")}
    answer = well(run(*LABELS, "--json", "--threads", "1"))
    assert (seen, "kept" in answer.err) == ([], True)
    assert [each["kept"] for each in answer.record["targets"]] == [True, True]
    assert before == {path: path.read_bytes() for path in Path("out").rglob("*.npy")} != {}
    Path("out/b.npy").unlink()
    well(run(*LABELS))
    assert seen == ["b.ply"]
    later = load_shape("in/sub/c.glb").verts + 1.0
    save_shape("in/sub/c.glb", Shape(later, load_shape("in/sub/c.glb").faces))
    save_shape("in/d.ply", load_shape("in/b.ply"))
    well(run(*LABELS))
    assert seen == ["b.ply", "d.ply", "c.glb"]
    well(run(*LABELS, "--to", "faces"))  # another choice
    assert seen[3:] == ["b.ply", "d.ply", "c.glb"]
    os.utime("labels.txt", (1, 1))  # another file, as far as one can tell
    well(run(*LABELS, "--to", "faces"))
    assert seen[6:] == ["b.ply", "d.ply", "c.glb"]


def test_a_picture_that_is_missing_is_drawn(run: Run, files: Path, stub: FakeMatching) -> None:
    well(run(*LABELS))
    assert "kept" not in well(run(*LABELS, "--picture", "pictures")).err
    Path("pictures/b.png").unlink()
    assert well(run(*LABELS, "--picture", "pictures")).err.count("kept") == 1
    assert Path("pictures/b.png").exists()


def test_one_that_fails_stops_no_other(run: Run, files: Path, stub: FakeMatching) -> None:
    Path("in/a-bad.ply").write_text("nothing")
    answer = run(*LABELS, "--json")
    assert answer.status == 1
    assert "warning: a-bad: a-bad.ply is not a ply file" in answer.err
    assert answer.err.splitlines()[-2] == "error: 1 of 3 targets failed: a-bad"
    assert json.loads(answer.out)["verdicts"] == {"failed": 1, "good": 2}
    assert Path("out/b.npy").exists() and not Path("out/a-bad.npy").exists()
    assert table()["a-bad"]["verdict"] == "failed" and "not a ply file" in table()["a-bad"]["error"]
    save_shape("in/a-bad.ply", load_shape("in/b.ply"))
    answer = well(run(*LABELS))
    assert answer.err.count("kept") == 2
    assert table()["a-bad"]["verdict"] == "good"


def test_what_is_wrong_with_the_source_is_said_once(run: Run, files: Path, stub: FakeMatching) -> None:
    Path("labels.txt").write_text("none\n")
    answer = run(*LABELS)
    assert answer.status == 1 and answer.err.count("warning: ") == 1
    assert len([line for line in answer.err.splitlines() if " failed" in line and "targets" not in line]) == 2
    reason = table()["b"]["error"]
    assert answer.err.splitlines()[-2] == f"error: 2 of 2 targets failed: b, sub/c, all for one reason: {reason}"


def test_a_poor_map_fails_where_that_is_asked(run: Run, files: Path, stub: FakeMatching) -> None:
    stub.verdict = "poor"
    assert well(run(*LABELS)).err.count("poor") >= 2
    answer = run(*LABELS, "--strict")
    assert answer.status == 1 and "2 of 2 targets failed: b, sub/c" in answer.err


def test_lists_patterns_and_pictures(run: Run, files: Path, stub: FakeMatching) -> None:
    words = LABELS[:2], ("in/b.ply", "in/sub/c.glb"), LABELS[3:]
    well(run(*words[0], *words[1], *words[2], "--picture", "pictures", "--format", ".txt"))
    assert sorted(path.name for path in Path("pictures").iterdir()) == ["b.png", "c.png"]
    assert sorted(path.name for path in Path("out").glob("*.txt")) == ["b.txt", "c.txt"]
    well(run(*words[0], "in/*.ply", *words[2][:-1], "some"))
    assert list(table("some")) == ["b"]
    well(run(*words[0], "in/b.ply", "a.ply", *words[2][:-1], "others"))
    assert list(table("others")) == ["b"]  # not to itself


WRONG = [
    ((*LABELS[:-1], "out.npy"), "for several targets the output is a folder, not out.npy"),
    ((*LABELS, "--picture", "p.png"), "for several targets the picture is a folder, not p.png"),
    ((*LABELS[:-1], "taken"), "taken/transfers.csv is no table of transfers"),
    ((*LABELS[:2], "empty", *LABELS[3:]), "there are no shapes in empty"),
    ((*LABELS[:2], "in/b.ply", *LABELS[3:-1], "out.npy", "--format", "txt"), "--format is for several targets"),
    ((*LABELS, "--up", "y", "--front", "-y"), "lie along one axis"),
]


@pytest.mark.parametrize(("words", "message"), WRONG)
def test_what_cannot_be_is_told(
    run: Run, files: Path, stub: FakeMatching, words: tuple[str, ...], message: str
) -> None:
    Path("empty").mkdir()
    Path("taken").mkdir()
    Path("taken/transfers.csv").write_text("mine\n")
    answer = run(*words)
    assert answer.status == 1 and message in answer.err, answer.err
    assert Path("taken/transfers.csv").read_text() == "mine\n"
    assert not Path("out").exists()


UNKNOWN = [(verb, "gbl") for verb in (*VERBS, "transfer-rig", "transfer-texture")]


@pytest.mark.parametrize(("verb", "suffix"), [*UNKNOWN, *(("transfer-shapes", each) for each in ("", "7", "../x.glb"))])
def test_a_format_that_cannot_be_is_told_once(
    run: Run, files: Path, stub: FakeMatching, verb: str, suffix: str
) -> None:
    garment = ("worn.obj",) if verb == "transfer-garment" else ()
    before = {path.name for path in files.iterdir()}
    words = verb, *garment, "a.ply", "in", "-o", "out", *MORE.get(verb, ()), "--format", suffix
    refused(run(*words), "b." if suffix != "../x.glb" else "is a suffix", files, before)


LANDMARKS = ("transfer-landmarks", "a.ply", "in", "--landmarks", "points.txt", "-o", "out")


@pytest.mark.parametrize("format", [".csv", ".mrk.json"])
def test_landmarks_of_all_are_one_table(run: Run, files: Path, stub: FakeMatching, format: str) -> None:
    words = *LANDMARKS, "--format", format, "--table", "all.npz"
    answer = well(run(*words))
    assert "wrote all.npz: 2 landmarks of 3 specimens, a included" in answer.err
    with np.load("all.npz") as found:
        assert (found["specimens"].tolist(), found["landmarks"].tolist()) == (["a", "b", "sub/c"], ["0", "1"])
        assert np.array_equal(found["points"][0], load_shape("a.ply").verts[[0, 5]])
        assert np.array_equal(found["points"][1], landmark_positions(Path(f"out/b{format}")))
        before = found["points"]
    Path("all.npz").unlink()
    assert well(run(*words)).err.count("kept") == 2  # a table of what was there
    with np.load("all.npz") as found:
        assert np.array_equal(found["points"], before)
    Path("in/a-bad.ply").write_text("nothing")
    answer = run(*words[:-1], "all.csv")
    assert answer.status == 1 and "wrote all.csv: 2 landmarks of 3 specimens" in answer.err
    rows = Path("all.csv").read_text().splitlines()
    assert (rows[0], len(rows), rows[3].startswith("b,0,")) == ("specimen,landmark,x,y,z", 7, True)


def test_a_table_of_several_units_is_told(run: Run, files: Path, stub: FakeMatching, sphere: Shape) -> None:
    save_shape("in/b.ply", Shape(1.1 * sphere.verts, sphere.faces))
    save_shape("in/sub/c.glb", Shape(sphere.verts, sphere.faces))
    stub.make_map = lambda a, b, **words: VertexMap.between(a, b, np.arange(a.V))
    assert "one unit" not in well(run(*LANDMARKS, "--table", "all.csv")).err
    save_shape("in/sub/c.glb", Shape(0.001 * sphere.verts, sphere.faces))
    answer = well(run(*LANDMARKS, "--table", "all.csv"))
    assert "b is 1,100 times as large as sub/c: do the files have one unit?" in " ".join(answer.err.split())


def test_what_a_target_lacks_is_missing_in_the_table(run: Run, files: Path, stub: FakeMatching) -> None:
    def unsure(a: Shape, b: Shape, **words: Any) -> VertexMap:
        return replace(nearest_map(a, b, **words), confidence=np.where(np.arange(a.V) == 5, 0.1, 0.9))

    stub.make_map = unsure
    answer = well(run(*LANDMARKS, "--table", "all.tps"))
    assert "; missing are 1 of b, 1 of sub/c" in answer.err
    assert Path("all.tps").read_text().splitlines()[6] == "NA NA NA"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((*LANDMARKS, "--table", "all.ods"), "'.ods' is not a format for a table of landmarks"),
        ((*LANDMARKS, "--table", "in/b.ply"), "'.ply' is not a format"),
        ((*LANDMARKS, "--table", "points.txt"), "cannot write points.txt: it is an input"),
        (
            (*LANDMARKS[:2], "in/b.ply", *LANDMARKS[3:-1], "b.csv", "--table", "all.csv"),
            "--table is for several targets",
        ),
        ((*LANDMARKS[:2], "in/b.ply", "more/a.ply", *LANDMARKS[3:], "--table", "all.csv"), "are both called a"),
    ],
)
def test_a_table_that_cannot_be_is_told_first(
    run: Run, files: Path, stub: FakeMatching, words: tuple[str, ...], message: str
) -> None:
    Path("more").mkdir()
    save_shape("more/a.ply", load_shape("in/b.ply"))
    refused(run(*words), message, files, {path.name for path in files.iterdir()})


def test_a_failure_leaves_rows_of_other_files(run: Run, files: Path, stub: FakeMatching) -> None:
    well(run(*LABELS))
    before = table()
    Path("out/b.txt").mkdir()
    answer = run(*LABELS, "--format", "txt")
    assert answer.status == 1 and "1 of 2 targets failed: b" in answer.err
    assert table()["b"] == before["b"] and table()["sub/c"]["output"] == "out/sub/c.txt"
    assert "kept" in well(run(*LABELS)).err


def test_a_damaged_row_is_done_again(run: Run, files: Path, stub: FakeMatching) -> None:
    well(run(*LABELS))
    text = Path("out/transfers.csv").read_text().splitlines()
    Path("out/transfers.csv").write_text("\n".join([*text[:2], text[2][:20]]))
    answer = well(run(*LABELS))
    assert answer.err.count("kept") == 1
    assert len(table()) == 2


def test_fits_leave_nothing_to_match(
    run: Run, files: Path, stub: FakeMatching, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = Targets.find([Path("in")], Path("a.ply"), None, Path("out"))
    monkeypatch.setattr(Targets, "find", lambda *_: replace(found, fits=Path("in")))
    before = {path.name for path in files.iterdir()}
    refused(run(*LABELS, "--model", "human"), "--model does not go with a folder of fits", files, before)


@pytest.mark.parametrize("name", ["../x", "sub/../../x", "/x", "x\0", ""])
def test_no_name_of_a_fit_leads_out(run: Run, files: Path, stub: FakeMatching, name: str) -> None:
    Path("fits").mkdir()
    with Path("fits/fits.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["name", "file", "verdict"], [name, "in/b.ply", "good"]])
    before = {path.name for path in files.iterdir()}
    words = "transfer-labels", "a.ply", "fits", "--labels", "labels.txt", "-o", "out"
    refused(run(*words), "is no name of a shape", files, before)
