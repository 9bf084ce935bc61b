"""The check of a folder of evaluation data: what it says of a right one, and of each thing that may lack."""

import json
from collections.abc import Callable
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


def without(pattern: str) -> Callable[[Path], None]:
    """Removes files of SHREC'19."""
    return lambda data: [path.unlink() for path in (data / "shrec19").glob(pattern)].clear()


def with_landmarks(values: np.ndarray) -> Callable[[Path], None]:
    """Gives other landmarks to one of its shapes."""
    return lambda data: np.save(data / "shrec19" / "1.landmarks.npy", values)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (without("pairs.txt"), "cannot read"),
        (lambda data: (data / "shrec19" / "pairs.txt").write_text("1 2\n7 1\n"), "lacks 7"),
        (without("10.landmarks.npy"), "cannot read"),
        (with_landmarks(np.full(BODY.V, BODY.V)), f"names vertex {BODY.V} of {BODY.V}"),
        (with_landmarks(np.arange(3)), "different numbers of landmarks"),
        (with_landmarks(np.arange(BODY.V) + 0.5), "not integers"),
        (lambda data: save_shape(data / "shrec19" / "1.ply", Shape(BODY.verts, np.empty((0, 3), int))), "has no faces"),
        (without("*"), "no *.ply"),
    ],
)
def test_something_lacks(
    data: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], object], words: str
) -> None:
    spoil(data)
    status, rows, told = answer(capsys, str(data), "--sets", "shrec19,scape")
    assert status == 1
    assert (rows["shrec19"]["state"], rows["scape"]["state"]) == ("lacks something", "complete")
    assert "1 of 2 sets" in told and words in told.replace("\n", " ") and words in str(rows["shrec19"]["problem"])


def test_the_folder_that_results_are_of(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = [name for name in CHECKS if name not in ("shrec19", "scape", "faust")]
    status, rows, told = answer(capsys, str(bench), "--sets", ",".join(small))
    assert (status, told) == (0, "")
    assert all(row["shapes"] == row["published"] for row in rows.values())
