"""What a set's truth says beside vertices in the same order, where shapes have them."""

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import InputError, OptionError
from meshmatch.experiments.sets import BenchSet, load_set
from meshmatch.experiments.truth import Kept, main, measure, part_rows, parts_at, template_row
from meshmatch.experiments.truths import NearDistances, Truths, consensus_points, same_triangles
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit
from tests.experiments.small_bench import BODY, build

STRETCHED = [1.0, 2.0, 1.0]


@dataclass(frozen=True)
class Keeps:
    """Sends vertex i to vertex i, or to a neighbour of it, where that is in the target."""

    moved: int = 0

    def fit(self, shape: Shape) -> Any:
        return Path(shape.name).stem

    def map(self, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        index = np.minimum(np.arange(source.V), target.V - 1)
        index[: self.moved] = 1
        return VertexMap.between(source, target, index)


def write(folder: Path, landmarks: dict[str, np.ndarray], faces: dict[str, np.ndarray] | None = None) -> BenchSet:
    """SHREC'19 with shapes in the order of `BODY`, each with its own landmarks."""
    (folder / "shrec19").mkdir()
    for number, (name, ids) in enumerate(landmarks.items()):
        verts = BODY.verts * np.power(STRETCHED, 0.1 * number)
        save_shape(folder / "shrec19" / f"{name}.ply", Shape(verts, (faces or {}).get(name, BODY.faces), name))
        np.save(folder / "shrec19" / f"{name}.landmarks.npy", ids)
    names = list(landmarks)
    lines = [f"{a} {b}" for a, b in pairwise(names)]
    (folder / "shrec19" / "pairs.txt").write_text("\n".join(lines))
    return load_set("shrec19", folder)


def edge_cm(shape: Shape) -> float:
    return float(np.linalg.norm(shape.verts[0] - shape.verts[1]) / np.sqrt(shape.area) * CM_PER_UNIT)


def test_triangles_are_compared_and_not_positions() -> None:
    turned = np.roll(BODY.faces, 1, axis=1)
    assert same_triangles(BODY.faces, turned) == 1
    turned[:3] = turned[:3, ::-1]
    assert same_triangles(BODY.faces, turned) == pytest.approx(1 - 3 / len(BODY.faces))
    other = np.random.default_rng(0).permutation(BODY.V)[BODY.faces]
    assert same_triangles(BODY.faces, other) == 0
    assert same_triangles(BODY.faces, BODY.faces[:-1]) == 0


def test_a_set_without_such_shapes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = build(tmp_path)  # every shape is shuffled in its own way
    for name in ("1", "2", "10"):
        ids = np.load(data / "shrec19" / f"{name}.landmarks.npy")
        np.save(data / "shrec19" / f"{name}.landmarks.npy", ids[:-1])  # no shape is the template
    with pytest.raises(InputError, match="no two shapes"):
        measure(Truths(load_set("shrec19", data)), Keeps(), None, Kept(tmp_path / "kept", {}))
    assert main(["--set", "shrec19", "--data", str(data), "--work", str(tmp_path / "kept")]) == 1
    assert "no two shapes" in capsys.readouterr().err
    assert Truths(load_set("scape", data)).groups == [["mesh000", "mesh001"]]


def test_a_truth_that_is_wrong_by_hand(tmp_path: Path) -> None:
    """Of the second shape landmark 0 is one edge off: a perfect map is charged for it, ours by identity is not."""
    ids = np.arange(BODY.V - 1)  # one less than vertices: neither shape is the template
    wrong = ids.copy()
    wrong[0] = 1
    bench = write(tmp_path, {"1": ids, "2": wrong})
    found = measure(Truths(bench), Keeps(), None, Kept(tmp_path / "kept", {}))
    (row,), (identity, whole) = found["groups"], found["protocol"]
    assert (row["names"], row["pairs"], row["alike"]) == ("1, 2", 2, 1.0)
    edges = [edge_cm(bench.shape(name)) / len(ids) for name in ("1", "2")]
    assert row["perfect_cm"] == pytest.approx(np.mean(edges), rel=0.02)
    assert row["charged_cm"] == pytest.approx(row["perfect_cm"])
    assert row["true_cm"] == row["true_over_15cm"] == 0.0
    assert row["stretch_set"] > row["stretch_identity"] > 0
    assert identity["kind"] == "identity" and (whole["kind"], whole["pairs"]) == ("all", 1)
    assert identity["charged_cm"] == pytest.approx(edges[1], rel=0.02) and identity["true_cm"] == 0.0
    other = Kept(tmp_path / "other", {})
    ours = measure(Truths(bench), Keeps(moved=1), None, other)["groups"][0]  # vertex 0 to vertex 1 everywhere
    assert ours["true_cm"] == pytest.approx(edges[1] / 2, rel=0.02)  # the second shape has no landmark there


def test_what_is_kept_is_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two shapes in one order, both the template, and a third; the command is stopped at its second target."""
    ids = np.arange(BODY.V)
    wrong = ids.copy()
    wrong[3] = 4
    other = np.random.default_rng(0).permutation(BODY.V)
    bench = write(tmp_path, {"1": ids, "2": wrong, "3": np.argsort(other)}, {"3": other[BODY.faces]})
    whole = measure(Truths(bench), Keeps(), None, Kept(tmp_path / "whole", {"seed": 0}))
    kept, plain = Kept(tmp_path / "kept", {"seed": 0}), Keeps.map
    done: list[tuple[str, str]] = []
    stop = ["3"]

    def watched(self: Keeps, source: Shape, source_fit: Any, target: Shape, target_fit: Any) -> VertexMap:
        if target_fit in stop:
            raise KeyboardInterrupt
        done.append((source_fit, target_fit))
        return plain(self, source, source_fit, target, target_fit)

    monkeypatch.setattr(Keeps, "map", watched)
    with pytest.raises(KeyboardInterrupt):
        measure(Truths(bench), Keeps(), None, kept)
    assert done == [("1", "2")]
    stop.clear()
    assert measure(Truths(bench), Keeps(), None, kept) == whole
    assert done == [("1", "2"), ("2", "3"), ("2", "1")]

    def never(*_: Any) -> Any:
        raise AssertionError("measured again")

    for owner, name in ((Keeps, "fit"), (Keeps, "map"), (NearDistances, "between"), (NearDistances, "among")):
        monkeypatch.setattr(owner, name, never)
    assert measure(Truths(bench), Keeps(), None, kept) == whole
    with pytest.raises(OptionError, match=r"other choices \(seed\)"):
        measure(Truths(bench), Keeps(), None, Kept(kept.folder, {"seed": 1}))


def test_errors_by_part(tmp_path: Path) -> None:
    """The template lies on the shape, its left and right hands below and its head above."""
    bench = write(tmp_path, {"1": np.arange(BODY.V), "2": np.arange(BODY.V)})
    labels = np.where(BODY.verts[:, 2] > 0, 2, (BODY.verts[:, 0] > 0).astype(int))
    template: Any = SimpleNamespace(labels=labels, label_names=("left hand", "right hand", "head"))
    fit = some_fit(BODY.verts, BODY.faces, repaired=repair(BODY))
    parts = parts_at(Truths(bench), "1", fit, template)
    assert parts == ["head" if label == 2 else "hand" for label in labels]
    assert parts_at(Truths(bench), "1", fit, None) == parts_at(Truths(bench), "1", "no fit", template) == []
    off = Errors(np.where(labels == 2, 0.03, 0.01))
    head, hand = part_rows({("1", "2"): off, ("2", "1"): off}, {"1": parts, "2": []})
    assert (head["part"], hand["part"]) == ("head", "hand")
    assert head["cm"] == pytest.approx(3 * hand["cm"], rel=1e-5)
    assert head["landmarks"] == pytest.approx((labels == 2).mean())
    assert head["sum"] + hand["sum"] == pytest.approx(1)


def test_the_mean_of_the_others_and_the_template(tmp_path: Path) -> None:
    """Three shapes in one order; the landmark that one of them has elsewhere is put right by the two others."""
    ids = np.arange(BODY.V - 1)
    wrong = ids.copy()
    wrong[5] = 40
    faces = {"4": np.random.default_rng(0).permutation(BODY.V)[BODY.faces]}
    bench = write(tmp_path, {"1": ids, "2": wrong, "3": ids, "4": ids}, faces)
    truths = Truths(bench)
    assert truths.groups == [["1", "2", "3"]] and not truths.templates
    assert consensus_points(truths, "2")[5] == pytest.approx(bench.shape("2").verts[5], abs=1e-5)
    here, there, kind = truths.of_pair(("2", "4"))
    assert (here.tolist(), there.tolist(), kind) == (ids.tolist(), ids.tolist(), "consensus")
    assert truths.of_pair(("4", "2"))[1].tolist() == ids.tolist()
    assert truths.of_pair(("1", "2"))[2] == "identity"


def test_a_shape_that_is_the_template(tmp_path: Path) -> None:
    ids = np.arange(BODY.V)
    ids[0] = 1
    other = np.random.default_rng(0).permutation(BODY.V)
    bench = write(tmp_path, {"1": ids, "2": np.argsort(other)}, {"2": other[BODY.faces]})
    truths = Truths(bench)
    assert truths.templates == ["1"] and truths.groups == []
    assert truths.of_pair(("2", "1"))[1].tolist() == list(range(BODY.V))
    assert truths.of_pair(("2", "1"))[2] == "own order"
    some = Truths(bench, 3).known("1")[0]  # landmarks, evenly spread
    assert len(some) == 3 and (some[0], some[-1]) == (0, BODY.V - 1)
    row = template_row(truths, "1")
    assert row["perfect_cm"] == pytest.approx(edge_cm(bench.shape("1")) / BODY.V, rel=0.02)
    assert row["own_number"] == pytest.approx(1 - 1 / BODY.V)


def test_the_tables_of_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], bench: Path) -> None:
    """The real set, of which a perfect map alone is asked here; ours takes minutes."""
    truths = Truths(load_set("shrec19", bench))
    assert truths.groups == [["11", "13"], ["23", "29", "33", "35", "37", "39"], ["25", "31"]]
    assert truths.templates == ["41"]
    kinds = [truths.of_pair(pair)[2] for pair in truths.bench.pairs]
    assert kinds.count("identity") == 9 and sum(kind != "the set's own" for kind in kinds) == 39
    json.dumps(template_row(truths, "41"))
