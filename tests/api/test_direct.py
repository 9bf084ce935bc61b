"""Shapes that no model knows are matched directly, by every road that makes a map."""

import pickle
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import meshmatch
from meshmatch.api import kinds
from meshmatch.api.matcher import Matcher
from meshmatch.cli.app import app
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting import direct
from meshmatch.geometry.frames import kabsch
from meshmatch.shapes.shape import Shape
from tests.fitting.test_direct import QUICK, bent, creature


@pytest.fixture(scope="module")
def shapes() -> tuple[Shape, Shape]:
    source = creature(3)
    target = bent(source, Rotation.from_euler("z", 60, degrees=True), 10.0)
    return Shape(source.verts, source.faces, "source"), Shape(target.verts, target.faces, "target")


@pytest.fixture(scope="module")
def found(shapes: tuple[Shape, Shape]) -> Any:
    return direct.match_directly(*shapes, QUICK)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, found: Any) -> None:
    monkeypatch.setattr(direct, "match_directly", lambda *_: found)


@pytest.mark.usefixtures("quick")
def test_a_pair_is_matched_both_ways_without_a_model(shapes: tuple[Shape, Shape]) -> None:
    result = meshmatch.match(*shapes, model="none")
    for way, target in ((result.map, shapes[1]), (result.backward(), shapes[0])):
        off = np.linalg.norm(way.points(target) - target.verts, axis=1) / np.sqrt(target.area)
        assert off.mean() < 0.03
    assert {result.source_fit.model, result.target_fit.model} == {"none"}
    moved, still = result.target_fit.points, result.source_fit.points
    assert kabsch(still, moved).rotation == pytest.approx(np.eye(3), abs=1e-6)  # pictures show both the same way up
    again = Matcher("none").map(result.source_fit, result.target_fit)
    assert np.array_equal(again.index, result.map.index)


@pytest.mark.usefixtures("quick")
def test_what_no_model_knows_is_matched_directly_and_this_is_said(
    shapes: tuple[Shape, Shape], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(clean: Any, *_: Any) -> Any:
        raise kinds.UnknownKindsError(f"{clean[0].shape.name} is of no kind")

    monkeypatch.setattr(kinds, "choose_model", refuse)
    result = meshmatch.match(*shapes)
    assert any("directly" in note for note in result.notes)
    with pytest.raises(InputError, match="no kind"):
        meshmatch.register(shapes[0])


def test_one_known_shape_of_two_is_still_told() -> None:
    card = SimpleNamespace(category="human")
    models: Any = [SimpleNamespace(card=card)]
    mesh = creature(2)
    config = meshmatch.FitConfig(partial="no")
    unknown, known = kinds.Classification(None, card), kinds.Classification("human", card)  # type: ignore[arg-type]
    for found, error in (([unknown, unknown], kinds.UnknownKindsError), ([unknown, known], InputError)):
        with pytest.raises(InputError) as caught:
            kinds._refuse_unknown(models, found, [mesh, mesh], [config, config])
        assert type(caught.value) is error


def test_a_matcher_without_a_model_needs_two_shapes(shapes: tuple[Shape, Shape]) -> None:
    matcher = pickle.loads(pickle.dumps(Matcher("none")))
    assert repr(matcher) == "Matcher('none')"
    with pytest.raises(OptionError, match="without a model") as caught:
        matcher.fit(shapes[0])
    assert "match two shapes" in caught.value.hint


@pytest.mark.usefixtures("quick")
def test_known_pairs_that_are_missed_are_named(shapes: tuple[Shape, Shape]) -> None:
    wrong = np.array([0, 5, 9]), np.array([400, 300, 200])
    result = meshmatch.match(*shapes, model="none", landmarks=wrong)
    assert result.map.verdict != "good" and result.map.reasons


@pytest.mark.usefixtures("quick")
def test_the_command_line_matches_without_a_model(shapes: tuple[Shape, Shape], tmp_path: Any) -> None:
    files = [tmp_path / f"{shape.name}.ply" for shape in shapes]
    for file, shape in zip(files, shapes, strict=True):
        meshmatch.save_shape(file, shape)
    words = ["match", *map(str, files), "-o", str(tmp_path / "map.npy"), "--model", "none", "--json", "--up", "y"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert len(np.load(tmp_path / "map.npy")) == shapes[0].V
    assert '"model": "none"' in done.stdout and "not used" in done.output
