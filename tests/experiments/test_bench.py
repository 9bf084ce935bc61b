"""The benchmark's command: fits once, maps every pair, speaks in a table and a JSON line."""

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.experiments.bench import accuracy as command
from meshmatch.experiments.bench.accuracy import main, run_set
from meshmatch.experiments.bench.methods import OurMethod
from meshmatch.experiments.bench.sets import load_set
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from tests.experiments.small_bench import Oracle, build

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"


@dataclass(frozen=True)
class Named:
    """A fit that is only a shape's name, and how long it took."""

    name: str
    seconds: float = 0.0


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
    mapped: list[tuple[str, str]] = []
    kept_in: set[Path | None] = set()

    def fit(self: OurMethod, shape: Shape) -> Named:
        kept_in.add(self.kept)
        return Named(Oracle().fit(shape), 7.0)

    def mapping(self: OurMethod, source: Shape, source_fit: Named, target: Shape, target_fit: Named) -> VertexMap:
        mapped.append((source_fit.name, target_fit.name))
        return Oracle().map(source, source_fit.name, target, target_fit.name)

    monkeypatch.setattr(command.OurMethod, "fit", fit)
    monkeypatch.setattr(command.OurMethod, "map", mapping)
    words = ["--data", str(small), "--cache", str(kept), "--refine", "none", "--seed", "3"]
    output, curve = tmp_path / "kept", tmp_path / "curve.png"
    assert main([*words, "--output", str(output), "--curve", str(curve)]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    record = json.loads(lines[-1])
    assert {name: part["pairs"] for name, part in record["sets"].items()} == {"shrec19": 3, "scape": 2, "faust": 6}
    assert all(part["mean_cm"] == 0 for part in record["sets"].values())
    assert (record["options"]["refine"], record["options"]["seed"]) == ("none", 3)
    assert record["threads"] == record["jobs"] == 1
    assert {"date", "commit", "machine", "geodesic", "seconds"} <= set(record)
    assert all(words in "".join(lines[:-1]) for words in ("shrec19", "same subject", "Dijkstra"))
    assert curve.stat().st_size > 1000
    # What was kept is not made again, what is missing is, and other choices are refused.
    missing = output / "maps" / "faust" / "tr_reg_000-tr_reg_001.npy"
    missing.unlink()
    mapped.clear()
    assert main([*words, "--output", str(output), "--sets", "faust"]) == 0
    again = json.loads(capsys.readouterr().out.strip().splitlines()[-1])
    assert mapped == [("tr_reg_000", "tr_reg_001")] and missing.is_file()
    assert again["sets"]["faust"]["mean_cm"] == 0
    assert again["sets"]["faust"]["fit_seconds_max"] == 7.0
    assert kept_in == {output / "fits"}
    assert main([*words[:-1], "4", "--output", str(output), "--sets", "faust"]) == 1
    assert "other options (seed)" in capsys.readouterr().err
    # A part says that it is one.
    assert main([*words, "--limit-pairs", "2", "--sets", "faust"]) == 0
    text = capsys.readouterr().out
    assert "2 of 6" in text and "Not all pairs were measured" in text
    assert not json.loads(text.strip().splitlines()[-1])["sets"]["faust"]["complete"]


def test_the_command_speaks_of_the_users_mistakes(
    small: Path, kept: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert "there are no *.ply files" in " ".join(capsys.readouterr().err.split())
    assert main(["--data", str(small), "--sets", "tosca"]) == 1
    assert "unknown set 'tosca'" in capsys.readouterr().err


def test_a_fit_that_was_kept_maps_as_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = [load_shape(SAMPLES / name) for name in ("dancer.ply", "climber.ply")]
    method = OurMethod(kept=tmp_path / "fits")
    fits = [method.fit(shape) for shape in shapes]
    monkeypatch.setattr(OurMethod, "_matcher", lambda _: SimpleNamespace(config=FitConfig()))  # which fits nothing
    again = [method.fit(shape) for shape in shapes]
    monkeypatch.undo()
    before, after = (method.map(shapes[0], pair[0], shapes[1], pair[1]) for pair in (fits, again))
    np.testing.assert_array_equal(before.index, after.index)
    assert again[0].seconds == fits[0].seconds > 0
