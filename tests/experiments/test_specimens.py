"""Specimens of the bench have the truth that they claim, and what is measured of them is right."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.api.matcher import Matcher
from meshmatch.collections.setting import Record
from meshmatch.experiments import runner
from meshmatch.experiments.bench import specimens
from meshmatch.experiments.bench.specimens import Done, Specimens, by_points, main, make_scan, sides_found, start_of
from meshmatch.experiments.makers.molars_and_leaves import MAKERS
from meshmatch.geometry.frames import Frame
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape


@pytest.mark.parametrize("kind", MAKERS)
def test_makers_draw_other_shapes_that_face_out(kind: str) -> None:
    made = MAKERS[kind](3, 1)
    assert made.verts.shape[0] == 3 and made.faces.max() < made.verts.shape[1]
    assert np.linalg.norm(made.verts[0] - made.verts[1], axis=1).mean() > 0.3
    shapes = [Shape(verts, made.faces) for verts in made.verts]
    assert all(shape.edges.open.any() == (kind == "leaves") for shape in shapes)
    if kind != "leaves":
        a, b, c = (shapes[0].verts[corner] for corner in made.faces.T)
        assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0
    assert np.array_equal(MAKERS[kind](3, 1).verts, made.verts)


def test_scans_know_where_their_vertices_belong_on_others() -> None:
    made = MAKERS["molars"](2, 0)
    rng = np.random.default_rng(0)
    whole = [Shape(verts, made.faces) for verts in made.verts]
    a = make_scan(whole[0], rng, False, False)
    b = make_scan(whole[0], rng, True, True)
    assert a.shape.V != b.shape.V < whole[0].V and b.shape.edges.open.any()
    there = a.true_points_on(b)
    gone = np.isnan(there).any(axis=1)
    assert 0.1 < gone.mean() < 0.5 and not np.isnan(b.true_points_on(a)).any()
    back = start_of(b, a)
    assert back.mirrored and np.abs(back.scale - 1) < 1e-6
    assert np.abs(back.apply(there[~gone]) - a.shape.verts[~gone]).max() < 0.2


def test_errors_are_of_places_that_both_have() -> None:
    shape = Shape(MAKERS["leaves"](1, 0).verts[0], MAKERS["leaves"](1, 0).faces)
    rng = np.random.default_rng(0)
    a = by_points(shape, np.array([5, 9, -1]), 3, rng)
    b = by_points(shape, np.array([5, -1, 7]), 3, rng)
    errors = Specimens({"a": a, "b": b}, "mm").errors(("a", "b"), b.shape.verts[[5, 9]] + [[3.0, 0, 4], [0, 0, 0]])
    assert abs(errors[0] - 5) < 1e-9 and np.isnan(errors[1])


def test_a_side_is_found_whichever_the_template_has() -> None:
    shape = Shape(MAKERS["leaves"](1, 0).verts[0], MAKERS["leaves"](1, 0).faces)
    rng, points = np.random.default_rng(0), np.array([1, 2])
    some = Specimens({str(k): by_points(shape, points, 2, rng, k == 2) for k in range(3)}, "mm")
    told = [Record(str(k), "", mirrored=int(k != 2)) for k in range(3)]
    nothing = Done(lambda pair: np.zeros((2, 3)))
    assert sides_found(some, replace(nothing, records=told)) == 1
    assert sides_found(some, replace(nothing, records=[Record("1", ""), Record("2", "")])) == 0.5
    assert sides_found(some, replace(nothing, pairs=[("good", True)] * 3 + [("poor", False)])) == 0.75
    assert sides_found(Specimens({"0": some.each["0"]}, "mm"), nothing) is None


def test_pairs_are_matched_by_themselves_and_asked_for_sides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def match(self: Matcher, source: Shape, target: Shape) -> SimpleNamespace:
        same = VertexMap("a", "b", np.zeros(source.V, np.int64), target_vertices=target.V, verdict="fair")
        fits = [SimpleNamespace(frame=Frame(1.0, np.diag([sign, 1, 1]), np.zeros(3))) for sign in (1.0, -1.0)]
        return SimpleNamespace(map=same, source_fit=fits[0], target_fit=fits[1])

    monkeypatch.setattr(Matcher, "match", match)
    row = specimens.measure("leaves", specimens.PAIRS, tmp_path, 3, 1, 4, 0, tmp_path)
    assert (row["fair"], row["good"], row["sides"]) == (4, 0, None) and row["lost"] > 0


def test_the_command_goes_on_with_the_rows_that_are_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = {"set": "leaves", "method": "none", "specimens": 3, "unit": "mm", "error": 1.0, "worst": 2.0, "lost": 0.0}
    called: list[str] = []

    def measure(name: str, *rest: object) -> dict[str, object]:
        called.append(name)
        return row | {"set": name, "cpu": 1.0}

    monkeypatch.setattr(specimens, "measure", measure)
    words = ["--methods", "none", "--work", str(tmp_path), "--sets"]
    assert main([*words, "leaves"]) == 0 == main([*words, "molars,leaves"]) and called == ["leaves", "molars"]


def test_a_method_that_is_not_here_is_told() -> None:
    found = runner.installed(["none", "no_such_package", "own"], ["no_such_package", "numpy"])
    assert found == (["none", "own"], ["skipped: no_such_package is not installed"])
    assert runner.installed(["numpy"], ["numpy"]) == (["numpy"], [])
