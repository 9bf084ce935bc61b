"""Shapes that no model knows are matched directly, by every road that makes a map."""

import pickle
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

import meshmatch
from meshmatch.api import kinds
from meshmatch.api.direct import match_without_model
from meshmatch.api.inputs import repair_allowing_parts
from meshmatch.api.matcher import Matcher
from meshmatch.cli.app import app
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting import direct, same_pose
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.maps.deformed import deformed
from meshmatch.shapes.parts import leave_out
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from tests.fitting.small_viscous import SmallViscous
from tests.fitting.test_direct import QUICK, bent, creature
from tests.shapes.scenes import together


@pytest.fixture(scope="module")
def shapes() -> tuple[Shape, Shape]:
    source = creature(3)
    target = bent(source, Rotation.from_euler("z", 60, degrees=True), 10.0)
    return Shape(source.verts, source.faces, "source"), Shape(target.verts, target.faces, "target")


@pytest.fixture(scope="module")
def found(shapes: tuple[Shape, Shape]) -> Any:
    return direct.match_directly(*shapes, QUICK)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits of shapes that stand alike are of few nodes."""
    monkeypatch.setattr(same_pose, "ViscousConfig", SmallViscous)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, found: Any, small: None) -> None:
    """What a search would find is known."""
    monkeypatch.setattr(direct, "match_either_side", lambda *_, **__: found)


@pytest.mark.usefixtures("small")
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


@pytest.mark.parametrize(
    ("direct_verdict", "over_guess", "taken"),
    [("good", 0.0, True), ("fair", 0.01, True), ("fair", 0.0, False), ("poor", 0.01, False)],
)
def test_a_map_of_a_model_that_is_not_good_gives_way_to_a_better_one(
    direct_verdict: Any, over_guess: float, taken: bool, found: Any, shapes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = replace(found.target, verdict=direct_verdict)
    monkeypatch.setattr(direct, "match_either_side", lambda *_: replace(found, target=target, guess_lead=over_guess))
    clean, configs = [repair_allowing_parts(shape) for shape in shapes], [meshmatch.FitConfig()] * 2
    by_model: Any = SimpleNamespace(source_fit=replace(found.source, model="human"), target_fit=found.target)
    result = match_without_model(clean, configs, None, 1, None, guess=by_model)
    assert (result is not by_model) == taken
    assert not taken or any("human" in note and "directly" in note for note in result.notes)


@pytest.mark.usefixtures("quick")
def test_a_pair_may_be_alike_unless_something_is_known_of_it(
    shapes: tuple[Shape, Shape], found: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Landmarks and the map of a model have been heeded by the search, and would not be again."""
    part = replace(found, source=replace(found.source, partial=True), target=replace(found.target, seconds=1e6))
    monkeypatch.setattr(direct, "match_either_side", lambda *_: found)
    monkeypatch.setattr(same_pose, "refine_match", lambda *_: part)
    clean, configs = [repair_allowing_parts(shape) for shape in shapes], [meshmatch.FitConfig()] * 2
    result = match_without_model(clean, configs, None, 1, None)
    assert "source: taken for a part of target" in result.notes
    assert result.seconds < 1e6  # of all that was done, not of one fit
    same = np.arange(5), np.arange(5)
    assert not any("part" in note for note in match_without_model(clean, configs, same, 1, None).notes)


def test_a_poor_match_of_several_parts_says_how_to_choose(
    shapes: tuple[Shape, Shape], found: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No model is at hand that could tell which part is the floor."""
    source, target = shapes
    floor = Shape(np.array([[-2.0, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]]), np.array([[0, 2, 1], [0, 3, 2]]))
    scene = together("scene", source, floor)
    monkeypatch.setattr(same_pose, "refine_match", lambda *given: given[2])
    configs, words = [meshmatch.FitConfig()] * 2, "scene: has 2 parts: if it is not all one object, choose with --only"
    for verdict, one, said in (("poor", scene, True), ("good", scene, False), ("poor", leave_out(scene, [1]), False)):
        of_target = replace(found.target, verdict=verdict)
        monkeypatch.setattr(direct, "match_either_side", lambda *_, now=of_target: replace(found, target=now))
        clean = [repair_allowing_parts(one), repair_allowing_parts(target)]
        notes = match_without_model(clean, configs, None, 1, None).notes
        assert any(note.startswith(words) for note in notes) == said
        assert not any(note.startswith("target: has") for note in notes)


@pytest.mark.usefixtures("quick")
def test_a_mirror_image_is_taken_unless_it_is_not_wanted(
    shapes: tuple[Shape, Shape], found: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = direct.MIRROR.compose(found.target.frame)
    image = replace(found, target=replace(found.target, frame=frame))
    monkeypatch.setattr(direct, "match_either_side", lambda *_: image)
    monkeypatch.setattr(same_pose, "refine_match", lambda *given: given[2])
    monkeypatch.setattr(direct, "match_directly", lambda *_: found)
    clean = [repair_allowing_parts(shape) for shape in shapes]
    for mirror, said in ((None, True), ("no", False)):
        result = match_without_model(clean, [meshmatch.FitConfig(mirror=mirror)] * 2, None, 1, None)
        assert ("target: taken for a mirror image of source" in result.notes) == said


@pytest.mark.usefixtures("quick")
def test_what_cannot_be_matched_directly_keeps_the_map_of_its_model(
    shapes: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = Matcher("none").match(*shapes)
    fits = [replace(fit, verdict="fair") for fit in (plain.source_fit, plain.target_fit)]
    unsure = replace(plain.map, verdict="fair")

    def refuse(*_: Any, **__: Any) -> Any:
        raise InputError("its points lie on no surface")

    monkeypatch.setattr(Matcher, "_choose_model", lambda self, clean, _: (clean, [(), ()], []))
    monkeypatch.setattr(Matcher, "_fit_all", lambda *_: fits)
    monkeypatch.setattr("meshmatch.api.matcher.maps_of_fits", lambda *_: (unsure, None))
    monkeypatch.setattr("meshmatch.api.matcher.match_without_model", refuse)
    assert Matcher("auto").match(*shapes).map is unsure


def test_one_known_shape_of_two_is_still_told() -> None:
    card = SimpleNamespace(category="human")
    models: Any = [SimpleNamespace(card=card)]
    mesh = creature(2)
    config = meshmatch.FitConfig(partial="no")
    unknown, known = kinds.Classification(None, card), kinds.Classification("human", card)  # type: ignore[arg-type]
    for found, error in (([unknown, unknown], kinds.UnknownKindsError), ([unknown, known], InputError)):
        with pytest.raises(InputError) as caught:
            kinds._refuse_unknown(models, np.full((1, 2), np.inf), found, [mesh, mesh], [config, config])
        assert type(caught.value) is error


def test_a_matcher_without_a_model_needs_two_shapes(shapes: tuple[Shape, Shape]) -> None:
    matcher = pickle.loads(pickle.dumps(Matcher("none")))
    assert repr(matcher) == "Matcher('none')"
    with pytest.raises(OptionError, match="without a model") as caught:
        matcher.fit(shapes[0])
    assert "match two shapes" in caught.value.hint and "--onto" in caught.value.hint


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


@pytest.mark.usefixtures("quick")
def test_shapes_between_two_that_no_model_knows(shapes: tuple[Shape, Shape], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(clean: Any, *_: Any) -> Any:
        raise kinds.UnknownKindsError(f"{clean[0].shape.name} is of no kind")

    monkeypatch.setattr(kinds, "choose_model", refuse)
    options = meshmatch.InterpolationOptions(place="files")
    found = meshmatch.interpolate(shapes, 3, options=options)
    assert any("directly" in note for note in found.notes)
    for step, shape in zip((found.steps[0], found.steps[2]), shapes, strict=True):
        off = np.linalg.norm(step.shape.verts - shape.verts, axis=1) / np.sqrt(shape.area)
        assert off.mean() < (1e-9 if step.time == 0 else 0.03)
    assert found.to_target is not None and found.to_target < 0.02
    for changed in ({"mesh": "template"}, {"way": "codes"}):
        with pytest.raises(OptionError, match="without a model"):
            meshmatch.interpolate(shapes, 3, options=meshmatch.InterpolationOptions(**changed), model="none")  # type: ignore[arg-type]


@pytest.mark.usefixtures("quick")
def test_one_mesh_is_laid_onto_another_shape(shapes: tuple[Shape, Shape], tmp_path: Any) -> None:
    files = [tmp_path / f"{shape.name}.ply" for shape in shapes]
    for file, shape in zip(files, shapes, strict=True):
        meshmatch.save_shape(file, shape)
    words = ["register", str(files[0]), "--onto", str(files[1]), "-o", str(tmp_path / "laid.ply"), "--model", "none"]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    laid = meshmatch.load_shape(tmp_path / "laid.ply")
    assert np.array_equal(laid.faces, shapes[0].faces)
    assert (np.linalg.norm(laid.verts - shapes[1].verts, axis=1) / np.sqrt(shapes[1].area)).mean() < 0.03
    assert '"model": "none"' in done.stdout
    refused = CliRunner().invoke(app, [*words, "--dense"])
    assert "--dense does not go with --onto" in str(refused.exception)


def test_a_mesh_laid_onto_a_mirror_image_still_faces_out(shapes: tuple[Shape, Shape], found: Any) -> None:
    source, fit = repair(shapes[0]), found.target
    mirror = Frame(fit.frame.scale, fit.frame.rotation @ np.diag([-1.0, 1.0, 1.0]), fit.frame.center)
    plain, mirrored = (deformed(source, found.source, each) for each in (fit, replace(fit, frame=mirror)))
    assert np.allclose(mirrored.verts - fit.frame.center, (plain.verts - fit.frame.center) * [-1, 1, 1])
    for shape in (plain, mirrored):
        assert np.linalg.det(shape.verts[shape.faces] - fit.frame.center).sum() > 0


def test_node_vectors_of_a_fit_make_its_points(found: Any) -> None:
    made = found.system.moved(found.target.vectors)
    assert np.linalg.norm(made - found.target.points, axis=1).mean() < 1e-3
