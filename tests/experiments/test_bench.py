"""The benchmark's command: fits once, maps every pair, speaks in a table and a JSON line."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments import bench as command
from meshmatch.experiments.bench import main, run_set, save_maps
from meshmatch.experiments.sets import load_set
from meshmatch.shapes.shape import Shape
from tests.experiments.small_bench import BODY, Oracle, build, truth


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def test_every_shape_is_fitted_once(small: Path, kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[str] = []

    def fit(self: Oracle, shape: Shape) -> str:
        fitted.append(Path(shape.name).stem)
        return fitted[-1]

    monkeypatch.setattr(Oracle, "fit", fit)
    bench = load_set("faust", small)
    found = run_set(bench, Oracle(), bench.pairs, cache=kept)
    assert sorted(fitted) == sorted(bench.shapes)
    record = found.as_dict()
    assert record["mean_cm"] == 0
    assert record["complete"]
    assert not record["failed"]
    assert set(record["groups"]) == {"same subject", "cross subject"}
    assert len(found.map_seconds) == 6
    assert set(found.fit_seconds) == set(bench.shapes)


def test_two_processes_find_the_same(small: Path, kept: Path) -> None:
    bench = load_set("shrec19", small)
    alone, together = (
        run_set(bench, Oracle(turned=True), bench.pairs, cache=kept, jobs=jobs).scores for jobs in (1, 2)
    )
    assert alone.joined.mean_cm > 10
    assert alone.as_dict() == together.as_dict()


def test_a_shape_that_cannot_be_fitted_costs_its_pairs(small: Path, kept: Path) -> None:
    bench = load_set("shrec19", small)
    found = run_set(bench, Oracle(refuses="2"), bench.pairs, cache=kept)
    record = found.as_dict()
    assert record["pairs"] == 3
    assert record["complete"]
    assert record["failed"] == [["1", "2", "2 cannot be fitted"], ["10", "2", "2 cannot be fitted"]]
    assert record["flips"] == pytest.approx(2 / 3, abs=1e-4)
    assert record["fits"]["2"] == ["failed", "2 cannot be fitted"]


def test_a_bug_is_not_a_failed_pair(small: Path, kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Oracle, shape: Shape) -> str:
        raise ZeroDivisionError

    monkeypatch.setattr(Oracle, "fit", broken)
    bench = load_set("scape", small)
    with pytest.raises(ZeroDivisionError):
        run_set(bench, Oracle(), bench.pairs, cache=kept)


def test_the_command(
    small: Path, kept: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command.OurMethod, "fit", lambda self, shape: Oracle().fit(shape))
    monkeypatch.setattr(command.OurMethod, "map", lambda self, *pair: Oracle().map(*pair))
    words = ["--data", str(small), "--cache", str(kept), "--refine", "none", "--seed", "3"]
    saved, curve = tmp_path / "maps", tmp_path / "curve.png"
    assert main([*words, "--save-maps", str(saved), "--curve", str(curve)]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    record = json.loads(lines[-1])
    assert {name: part["pairs"] for name, part in record["sets"].items()} == {"shrec19": 3, "scape": 2, "faust": 6}
    assert all(part["mean_cm"] == 0 for part in record["sets"].values())
    assert (record["options"]["refine"], record["options"]["seed"]) == ("none", 3)
    assert record["threads"] == record["jobs"] == 1
    assert {"date", "commit", "machine", "geodesic", "seconds"} <= set(record)
    assert all(words in "".join(lines[:-1]) for words in ("shrec19", "same subject", "Dijkstra"))
    assert curve.stat().st_size > 1000
    # The saved maps give the same numbers.
    assert main(["--data", str(small), "--cache", str(kept), "--maps", str(saved), "--sets", "faust,scape"]) == 0
    again = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert again["sets"]["faust"]["mean_cm"] == 0
    assert list(again["sets"]) == ["faust", "scape"]
    # A part says that it is one.
    assert main([*words, "--limit-pairs", "2", "--sets", "faust"]) == 0
    text = capsys.readouterr().out
    assert "2 of 6" in text and "Not all pairs were measured" in text
    assert not json.loads(text.strip().splitlines()[-1])["sets"]["faust"]["complete"]


def test_the_command_speaks_of_the_users_mistakes(
    small: Path, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert "no shapes in" in " ".join(capsys.readouterr().err.split())
    assert main(["--data", str(small), "--sets", "tosca"]) == 1
    assert "unknown set 'tosca'" in capsys.readouterr().err
    bench = load_set("scape", small)
    save_maps(tmp_path, bench, {pair: truth(*pair) for pair in bench.pairs})
    words = ["--data", str(small), "--cache", str(kept), "--maps", str(tmp_path), "--sets", "scape"]
    assert main(words) == 0
    np.save(tmp_path / "scape" / "mesh000-mesh001.npy", np.full(BODY.V, BODY.V + 3))
    assert main(words) == 1
    assert "mesh000-mesh001.npy" in capsys.readouterr().err
