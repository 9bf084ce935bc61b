"""The check of a folder of evaluation data: what it says of a right one, and of each thing that may lack."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.bench.datasets import CHECKS, main
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.experiments.small_bench import BODY, build

SETS = "shrec19,scape,faust,heart,chair"


@pytest.fixture
def data(tmp_path: Path) -> Path:
    build(tmp_path)
    for folder in ("heart", "chair"):
        (tmp_path / folder).mkdir()
        for name in ("1", "2"):
            save_shape(tmp_path / folder / f"{name}.ply", BODY)
            if folder == "heart":
                np.save(tmp_path / folder / f"{name}.truth.npy", np.zeros((BODY.V, 2), np.int32))
            else:
                np.save(tmp_path / folder / f"{name}.keypoints.npy", np.arange(5))
    return tmp_path


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, dict[str, dict[str, object]], str]:
    status = main(list(words))
    printed = capsys.readouterr()
    return status, {row["set"]: row for row in json.loads(printed.out.splitlines()[-1])["sets"]}, printed.err


def test_a_folder_that_is_right(data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, rows, told = answer(capsys, str(data), "--sets", SETS)
    assert (status, told) == (0, "")
    assert [row["state"] for row in rows.values()] == ["complete"] * 5
    assert (rows["shrec19"]["shapes"], rows["shrec19"]["pairs"], rows["shrec19"]["published"]) == (3, 3, 18)
    assert rows["shrec19"]["truth"] == f"{BODY.V} landmarks" and rows["heart"]["truth"] == "every vertex"
    assert rows["scape"]["truth"] == "vertex i is vertex i" and rows["scape"]["vertices"] == str(BODY.V)


def lose_pairs(data: Path) -> None:
    (data / "shrec19" / "pairs.txt").unlink()


def name_a_stranger(data: Path) -> None:
    (data / "shrec19" / "pairs.txt").write_text("1 2\n7 1\n")


def lose_landmarks(data: Path) -> None:
    (data / "shrec19" / "10.landmarks.npy").unlink()


def point_past_the_end(data: Path) -> None:
    np.save(data / "shrec19" / "1.landmarks.npy", np.full(BODY.V, BODY.V))


def have_fewer_landmarks(data: Path) -> None:
    np.save(data / "shrec19" / "1.landmarks.npy", np.arange(3))


def have_decimals(data: Path) -> None:
    np.save(data / "shrec19" / "1.landmarks.npy", np.arange(BODY.V) + 0.5)


def lose_faces(data: Path) -> None:
    save_shape(data / "shrec19" / "1.ply", Shape(BODY.verts, np.empty((0, 3), np.int64)))


def lose_all(data: Path) -> None:
    for path in (data / "shrec19").iterdir():
        path.unlink()


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lose_pairs, "cannot read"),
        (name_a_stranger, "lacks 7"),
        (lose_landmarks, "cannot read"),
        (point_past_the_end, f"names vertex {BODY.V} of {BODY.V}"),
        (have_fewer_landmarks, "different numbers of landmarks"),
        (have_decimals, "not integers"),
        (lose_faces, "has no faces"),
        (lose_all, "no shapes"),
    ],
)
def test_something_lacks(data: Path, capsys: pytest.CaptureFixture[str], spoil: object, words: str) -> None:
    assert callable(spoil)
    spoil(data)
    status, rows, told = answer(capsys, str(data), "--sets", "shrec19,scape")
    assert status == 1
    assert (rows["shrec19"]["state"], rows["scape"]["state"]) == ("lacks something", "complete")
    assert "1 of 2 sets lack something" in told and words in told.replace("\n", " ")
    assert "docs/datasets.md" in told and words in str(rows["shrec19"]["problem"])


def test_the_folder_that_results_are_of(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = [name for name in CHECKS if name not in ("shrec19", "scape", "faust")]
    status, rows, told = answer(capsys, str(bench), "--sets", ",".join(small))
    assert (status, told) == (0, "")
    assert all(row["shapes"] == row["published"] for row in rows.values())
