"""Characters: what is measured of maps, by hand."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.experiments.bench import characters
from meshmatch.experiments.makers.character_designs import Character, clothed_people
from meshmatch.generators.proportions import PLAIN
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template
from tests.conftest import icosphere


def ball(bones: np.ndarray, name: str = "ball") -> Character:
    shape = icosphere(2)
    return Character(
        replace(shape, name=name), bones, Shape(0.5 * shape.verts, shape.faces, "body"), np.arange(shape.V)
    )


def test_same_bones_and_distances_below_the_clothes_by_hand(tmp_path: Path) -> None:
    shape = icosphere(2)
    own, one = np.arange(shape.V), ball(np.where(shape.verts[:, 0] > 0, 1, 0))
    same = characters.measure_pair(one, one, VertexMap("a", "b", own), tmp_path)
    assert same == {"bone": 1.0, "cm": 0.0}
    turned = VertexMap(
        "a", "b", np.array([int(np.argmin(np.linalg.norm(shape.verts + v, axis=1))) for v in shape.verts])
    )
    across = characters.measure_pair(one, one, turned, tmp_path)
    assert across["bone"] < 0.15
    # Half the girth of a ball with a skin of 1.9 m2, by edges a little longer.
    girth = 100 * np.pi * np.sqrt(1.9 / (4 * np.pi))
    assert girth < across["cm"] < 1.1 * girth


def test_every_ordered_pair_counts_with_the_worse_verdict(tmp_path: Path) -> None:
    bones = np.zeros(icosphere(2).V, np.int64)
    verdicts = iter(["good", "fair", "poor"])

    class Stub:
        def fit(self, shape: Shape) -> SimpleNamespace:
            return SimpleNamespace(verdict=next(verdicts), reasons=())

        def map(self, source: SimpleNamespace, target: SimpleNamespace) -> VertexMap:
            return VertexMap("a", "b", np.arange(len(bones)))

    row = characters.row_of("clothed", [ball(bones, name) for name in "abc"], Stub(), tmp_path)  # type: ignore[arg-type]
    assert (row["pairs"], row["bone"], row["mean_cm"], row["verdicts"]) == (6, 1.0, 0.0, "0 / 2 / 4")
    assert row["slowest"] >= row["seconds"] > 0
    assert row["wrong_good"] == 0


def test_a_pair_that_is_far_off_and_called_good_is_counted(tmp_path: Path) -> None:
    bones, shape = np.zeros(icosphere(2).V, np.int64), icosphere(2)
    opposite = np.argmin(shape.verts @ shape.verts.T, axis=1)
    verdicts = iter(["good", "good", "fair"])

    class Stub:
        def fit(self, shape: Shape) -> SimpleNamespace:
            return SimpleNamespace(verdict=next(verdicts), reasons=())

        def map(self, source: SimpleNamespace, target: SimpleNamespace) -> VertexMap:
            return VertexMap("a", "b", opposite)

    row = characters.row_of("fused", [ball(bones, name) for name in "abc"], Stub(), tmp_path)  # type: ignore[arg-type]
    assert (row["verdicts"], row["wrong_good"]) == ("2 / 4 / 0", 2)


@pytest.mark.slow
def test_people_in_clothes_have_other_triangles_and_a_body_below() -> None:
    pytest.importorskip("anny")
    first, second = clothed_people(read_template("human-T"), 2, PLAIN)
    for each in (first, second):
        assert len(each.bones) == len(each.places) == each.shape.V and each.places.max() < each.body.V
        away = np.linalg.norm(each.body.verts[each.places] - each.shape.verts, axis=1)
        assert 0 < np.median(away) < 0.1  # metres: the cloth
    assert first.shape.F != second.shape.F
