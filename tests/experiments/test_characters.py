"""Characters: robots whose solids hang on bones, clothes with their bodies, and what is measured of maps, by hand."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.experiments.bench import characters
from meshmatch.experiments.makers.character_designs import Character, Designer
from meshmatch.generators.figure import PARTS, SIDED, Figure, joints_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.generators.stick import stick_figure


@pytest.fixture(scope="module")
def designer() -> Designer:
    return Designer(Figure.of(stick_figure(4)))


def test_robots_are_solids_along_the_bones(designer: Designer) -> None:
    first, second = designer.robots(2)
    assert np.array_equal(np.unique(first.bones), np.arange(len(PARTS)))
    assert first.shape.V == len(first.bones)
    assert first.shape.V != second.shape.V or not np.allclose(first.shape.verts, second.shape.verts)
    assert np.array_equal(designer.robots(1)[0].shape.verts, first.shape.verts)
    heads = designer.figure.rig.heads[0].numpy()
    for name in SIDED:
        ends = [heads[joint] for joint in joints_of(designer.figure.rig, name, "L")]
        own = first.shape.verts[first.bones == PARTS.index(f"{name} L")]
        length = np.linalg.norm(ends[1] - ends[0])
        assert np.ptp(own, axis=0).max() < 3 * length  # no further than a thick, joined part reaches
    left, right = (first.shape.verts[first.bones == PARTS.index(f"thigh {side}")] for side in "LR")
    assert left[:, 0].mean() > 0 > right[:, 0].mean()


def test_soldiers_wear_plates_on_the_bones_of_the_body_below(designer: Designer) -> None:
    (soldier,) = designer.soldiers(1)
    body = designer.figure.rig.rest.shape[1]
    assert np.array_equal(soldier.bones[:body], designer.figure.share.argmax(1).numpy())
    assert soldier.shape.V > body
    assert soldier.shape.faces.max() < soldier.shape.V


def ball(
    bones: np.ndarray, places: np.ndarray | None = None, body: Shape | None = None, name: str = "ball"
) -> Character:
    return Character(replace(icosphere(2), name=name), bones, body, places)


def test_same_bones_and_distances_below_the_clothes_by_hand(tmp_path: Path) -> None:
    shape = icosphere(2)
    bones = np.where(shape.verts[:, 0] > 0, 1, 0)
    bones[:10] = -1  # a weapon
    own = np.arange(shape.V)
    half = Shape(0.5 * shape.verts, shape.faces, "body")
    source, target = ball(bones, own, half), ball(bones, own, half)
    same = characters.measured(source, target, VertexMap("a", "b", own), tmp_path)
    assert same == {"bone": 1.0, "cm": 0.0}
    astray = np.where(bones < 0, np.flatnonzero(bones == 1)[0], own)  # wherever the weapon goes
    assert characters.measured(source, target, VertexMap("a", "b", astray), tmp_path)["bone"] == 1.0
    turned = VertexMap(
        "a", "b", np.array([int(np.argmin(np.linalg.norm(shape.verts + v, axis=1))) for v in shape.verts])
    )
    across = characters.measured(source, target, turned, tmp_path)
    assert across["bone"] < 0.15
    # Half the girth of a ball with a skin of 1.9 m2, by edges a little longer.
    girth = 100 * np.pi * np.sqrt(1.9 / (4 * np.pi))
    assert girth < across["cm"] < 1.1 * girth
    assert "cm" not in characters.measured(ball(bones), ball(bones), VertexMap("a", "b", own), tmp_path)


def test_every_ordered_pair_counts_with_the_worse_verdict() -> None:
    bones = np.zeros(icosphere(2).V, np.int64)
    verdicts = iter(["good", "fair", "poor"])

    class Stub:
        def fit(self, shape: Shape) -> SimpleNamespace:
            return SimpleNamespace(verdict=next(verdicts), reasons=())

        def map(self, source: SimpleNamespace, target: SimpleNamespace) -> VertexMap:
            return VertexMap("a", "b", np.arange(len(bones)))

    row = characters.row_of("robots", [ball(bones, name=name) for name in "abc"], Stub(), None)  # type: ignore[arg-type]
    assert (row["pairs"], row["bone"], row["verdicts"]) == (6, 1.0, "0 / 2 / 4")
    assert "mean_cm" not in row
    assert row["slowest"] >= row["seconds"] > 0
