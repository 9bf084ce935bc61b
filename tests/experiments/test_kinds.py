"""Errors of animals by kind, by verdict and by animal: by hand, and bumpy balls with a model of an egg."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.api.matcher import Matcher
from meshmatch.experiments.bench import kinds
from meshmatch.experiments.bench.sets import Pair
from meshmatch.experiments.makers.cut_scans import CutScan
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from tests.experiments.small_bench import build
from tests.fitting.eggs import egg_model, write_model


def test_rows_by_hand() -> None:
    near, far = np.array([0.01, 0.03, 0.05, 0.2]), np.array([0.0, 0.0, 0.0, 0.04])
    errors: dict[Pair, np.ndarray] = {("a", "b"): near, ("b", "a"): far, ("a", "c"): far}
    rows = kinds.rows_of(errors, lambda pair: "a" if pair[0] == "a" else "rest")
    assert [row["of"] for row in rows] == ["a", "rest"]
    assert rows[0] == {"of": "a", "pairs": 2, "mean_x100": 4.125, "median_x100": 4.125, "off": 0.125}
    assert rows[1]["mean_x100"] == 1.0


def test_every_pair_counts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    build(tmp_path)
    (tmp_path / "faust").rename(tmp_path / "animal")
    spoiled = tmp_path / "animal" / "tr_reg_010.landmarks.npy"  # of the same body each: the maps are perfect
    np.save(spoiled, np.roll(np.load(spoiled), 1))
    model = write_model(egg_model(), tmp_path / "egg")
    words = ["--data", str(tmp_path), "--cache", str(tmp_path / "cache"), "--sets", "animals", "--model", str(model)]
    assert kinds.main(words) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])["animals"]
    assert record["all"]["pairs"] == sum(row["pairs"] for row in record["verdict"]) == 6
    assert [row["of"] for row in record["species"]] == ["other to other"]
    assert set(record["verdicts"]) == {"tr_reg_000", "tr_reg_001", "tr_reg_010"}


def test_pairs_without_a_model_have_no_fits_of_their_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    build(tmp_path)
    (tmp_path / "faust").rename(tmp_path / "animal")

    def match(self: Matcher, source: Shape, target: Shape) -> SimpleNamespace:
        index = np.arange(source.V)
        return SimpleNamespace(map=VertexMap(source.name, target.name, index, target_vertices=target.V, verdict="fair"))

    monkeypatch.setattr(Matcher, "match", match)
    words = ["--data", str(tmp_path), "--cache", str(tmp_path / "cache"), "--sets", "animals", "--model", "none"]
    assert kinds.main([*words, "--limit-pairs", "4"]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])["animals"]
    assert record["all"]["pairs"] == 4 and record["verdicts"] == {}
    assert [(row["of"], row["pairs"]) for row in record["verdict"]] == [("fair", 4)]


def test_sides_are_counted(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Balls of which one is said to be a left hand; nothing is mirrored by a model of what is symmetric."""
    balls = [load_shape(file) for file in sorted(build(tmp_path).glob("faust/*.ply"))]
    own, kept = np.arange(balls[0].V), np.ones(balls[0].V, bool)
    made = [CutScan(ball, ball, own, kept, 2.0, mirrored=number == 1) for number, ball in enumerate(balls)]
    monkeypatch.setattr(kinds, "make_scans", lambda kind, count, seed: made[:count])
    egg = egg_model()
    both = TrainedModel(replace(egg.card, mirror="auto"), egg.template, egg.inference)
    subjects = kinds.cut_scans("hand", 3, 0, tmp_path / "cache")
    record, tables = kinds.measure_set("hand", subjects, Matcher(both))
    assert [str(table.title).split()[-1] for table in tables] == ["length", "verdict", "sides", "Sides"]
    assert {row["of"]: row["pairs"] for row in record["sides"]} == {
        "left to right": 2,
        "right to left": 2,
        "right to right": 2,
    }
    sides = record["side"]
    assert (sides["shapes"], sides["left"], sides["found"]) == (3, 1, pytest.approx(2 / 3))
    good = [name for name, verdict in record["verdicts"].items() if verdict == "good"]
    assert sides["wrong_called_good"] == sum(balls[1].name in (a, b) for a in good for b in good if a != b)


def test_species_by_the_names_of_files() -> None:
    assert [kinds.species_of(name) for name in ("fox-05", "Davis_Cow_00000", "timthumb")] == ["dog", "cow", "other"]
