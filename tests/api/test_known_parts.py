"""Where a whole file cannot be fitted its parts are tried apart: by readings, and at the end with the models that ship."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch.api import known_parts, matcher
from meshmatch.api.inputs import as_model, repair_allowing_parts
from meshmatch.api.known_parts import find_known_parts
from meshmatch.api.matcher import Matcher
from meshmatch.errors import InputError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge import category
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.parts import Parts, leave_out
from meshmatch.shapes.parts import are_separate as parts_apart
from meshmatch.shapes.shape import Shape
from tests.shapes.scenes import (
    beside,
    chair,
    coat,
    eyes,
    floor,
    fused_with_floor,
    moved,
    pack,
    pedestal,
    sample,
    second,
    together,
)

CONFIG = FitConfig()
BODY = sample("climber")


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[int, float]], list[int]]:
    """Readings in hundredths of the shapes that have so many vertices, 8 of all others; gives which were read."""

    def install(known: dict[int, float]) -> list[int]:
        asked: list[int] = []

        def read(model: Any, shape: Shape, *_: Any) -> float:
            asked.append(shape.V)
            return known.get(shape.V, 8.0) / 100

        monkeypatch.setattr(category, "category_residual", read)
        return asked

    return install


def loaders(count: int = 1) -> list[Callable[[], Any]]:
    return [lambda: as_model("human")] * count


Reads = Callable[[dict[int, float]], list[int]]


def test_the_parts_that_are_known_are_kept_and_the_others_said(reads: Reads) -> None:
    asked = reads({BODY.V: 3.7})
    scene = together("scan.ply", BODY, floor(BODY), pack(BODY))
    alone = find_known_parts(loaders(), scene, CONFIG)
    assert alone is not None and alone.fit is None and alone.residuals == pytest.approx([0.037])
    body = int(Parts.of(scene).number[0])
    assert alone.clean.left_out == tuple({1, 2, 3} - {body})
    assert alone.clean.shape.V == BODY.V and len(alone.clean.original_to_repaired) == scene.V
    share = 100 * (1 - BODY.area / scene.area)
    assert alone.clean.notes[0].startswith(f"left out 2 of 3 parts, {share:.0f} % of the area: parts ")
    assert not any("weight 0" in note for note in alone.clean.notes)
    assert len(asked) <= 6


def test_a_base_that_a_body_is_fused_with_is_left_out(reads: Reads) -> None:
    scene = fused_with_floor(BODY)
    rest = repair_allowing_parts(leave_out(scene, [2])).shape.V
    reads({rest: 3.7})
    alone = find_known_parts(loaders(), scene, CONFIG)
    assert alone is not None and alone.clean.left_out == (2,)
    words = "left out the flat base that it is fused with, 8"
    assert alone.clean.notes[0].startswith(words) and "part 2 (--only" in alone.clean.notes[0]


def test_clothes_stay_where_they_read_as_well(reads: Reads) -> None:
    dressed = together("dressed", BODY, coat(BODY), eyes(BODY))
    scene = together("scan.ply", dressed, pedestal(BODY))
    kept = repair_allowing_parts(dressed).shape.V  # without the eyes, which repair drops
    for with_coat, expected in ((4.0, kept), (4.6, BODY.V)):
        reads({BODY.V: 3.7, kept: with_coat})
        alone = find_known_parts(loaders(), scene, CONFIG)
        assert alone is not None and alone.clean.shape.V == expected
        assert len(alone.clean.left_out) == (1 if expected == kept else 2)


def test_two_bodies_are_for_the_user_to_choose_from(reads: Reads) -> None:
    reads({BODY.V: 3.7})
    scene = together("two.ply", BODY, second(BODY))
    with pytest.raises(
        InputError, match=r"two\.ply contains several shapes of one kind: part 1 .* and part 2 "
    ) as caught:
        find_known_parts(loaders(), scene, CONFIG)
    assert "--only 1 or --only 2" in caught.value.hint


def test_of_copies_in_a_scene_any_is_meant(reads: Reads, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = together("two.glb", BODY, moved(BODY, [1.0, 0, 0]))
    made = SimpleNamespace(verdict="fair", trust=0.8, partial=False)
    monkeypatch.setattr(known_parts, "classify", lambda *_: (True, made))
    for reading in (3.7, 5.0):  # the last is of a body that reads strangely, whose fit tells
        reads({BODY.V: reading})
        alone = find_known_parts(loaders(), replace(scene, meshes=(("a", BODY.V), ("b", BODY.V))), CONFIG)
        assert alone is not None and alone.clean.shape.V == BODY.V
        assert alone.clean.copied is not None and alone.clean.copied.sum() == BODY.V


def test_two_bodies_that_run_into_each_other_are_not_one_in_clothes(reads: Reads) -> None:
    reads({BODY.V: 3.7})
    other = Shape(BODY.verts + 0.04 * np.sqrt(BODY.area), BODY.faces)
    scene = together("two.ply", BODY, other)
    parts = Parts.of(scene)
    assert not parts_apart(parts, frozenset([1]), frozenset([2]))
    with pytest.raises(InputError, match="several shapes of one kind"):
        find_known_parts(loaders(), scene, CONFIG)
    # a body and its clothes read as a body, both alone and together
    on_floor = together("scan.ply", BODY, other, floor(BODY))
    reads({BODY.V: 3.7, 2 * BODY.V: 3.9})
    alone = find_known_parts(loaders(), on_floor, CONFIG)
    assert alone is not None and alone.clean.shape.V == 2 * BODY.V


def test_a_body_that_reads_strangely_may_be_meant_too(reads: Reads, monkeypatch: pytest.MonkeyPatch) -> None:
    strange = decimate(second(BODY), 10_000)
    scene = together("two.ply", BODY, strange)
    reads({BODY.V: 3.7, repair_allowing_parts(strange).shape.V: 5.0})
    for trust in (0.6, 0.8):
        made = SimpleNamespace(verdict="fair", trust=trust, partial=False)
        monkeypatch.setattr(known_parts, "classify", lambda *_, made=made: (True, made))
        if trust < 0.7:
            alone = find_known_parts(loaders(), scene, CONFIG)
            assert alone is not None and alone.fit is None and len(alone.clean.left_out) == 1
        else:
            with pytest.raises(InputError, match="several shapes of one kind"):
                find_known_parts(loaders(), scene, CONFIG)


def test_what_its_user_chose_and_what_has_no_parts_is_left_alone(reads: Reads) -> None:
    asked = reads({BODY.V: 3.7})
    scene = together("scan.ply", BODY, floor(BODY))
    chosen = Shape(scene.verts, scene.faces, weights=np.ones(scene.V))
    cloud = Shape(scene.verts, np.empty((0, 3), np.int64))
    for shape in (chosen, cloud, BODY):
        assert find_known_parts(loaders(), shape, CONFIG) is None
    assert find_known_parts(loaders(), scene, FitConfig(partial="yes")) is None
    assert asked == []


def test_nothing_is_made_of_what_nobody_knows(reads: Reads, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = reads({})
    scene = together("room.ply", chair(beside(BODY)), floor(BODY))
    assert find_known_parts(loaders(2), scene, CONFIG, [[0], [1]]) is None
    assert 0 < len(asked) <= 12  # both models were asked
    # what reads strangely needs a fit that can be trusted
    table = chair(beside(BODY))
    reads({table.V: 5.5})
    for fit, found in (("fair", 0.6, False), False), (("fair", 0.8, True), False), (("fair", 0.8, False), True):
        made = SimpleNamespace(verdict=fit[0], trust=fit[1], partial=fit[2])
        monkeypatch.setattr(known_parts, "classify", lambda *_, made=made: (made.verdict != "poor", made))
        scene = together("room.ply", table, floor(BODY))
        alone = find_known_parts(loaders(), scene, FitConfig(try_harder=True))
        assert (alone is not None) is found
        assert find_known_parts(loaders(), scene, CONFIG) is None  # such a fit takes long


def test_a_model_that_knows_some_parts_spares_the_others(reads: Reads) -> None:
    asked = reads({BODY.V: 3.7})
    scene = together("scan.ply", BODY, floor(BODY))
    alone = find_known_parts(loaders(2), scene, CONFIG, [[0], [1]])
    assert alone is not None and alone.row == 0 and np.isinf(alone.residuals[1])
    assert len(asked) == len(set(asked))


def a_fit(verdict: str, shape: Shape) -> Any:
    from tests.cli.conftest import fake_fit

    return fake_fit(shape, verdict)


@pytest.mark.parametrize(
    ("whole", "alone", "kept"), [("poor", "good", "good"), ("poor", "poor", "whole"), ("fair", "", "whole")]
)
def test_only_a_poor_fit_of_the_whole_gives_way_to_a_better_one(
    reads: Reads, monkeypatch: pytest.MonkeyPatch, whole: str, alone: str, kept: str
) -> None:
    asked = reads({BODY.V: 3.7})
    scene = together("scan.ply", BODY, floor(BODY))
    monkeypatch.setattr(matcher.Fitter, "fit", lambda self, shape: a_fit(whole if shape.V == scene.V else alone, shape))
    fit = Matcher("human").fit(scene)
    assert fit.left_out == (() if kept == "whole" else (1,))
    assert any("left out 1 of 2 parts" in note for note in fit.notes) is (kept != "whole")
    assert fit.repaired is not None and fit.repaired.original.V == scene.V
    assert fit.verdict == (whole if kept == "whole" else alone)
    assert (asked == []) is (whole == "fair")
    hard = Matcher("human").fit(scene, FitConfig(try_harder=True))
    hinted = [any("--try-harder" in note for note in each.notes) for each in (fit, hard)]
    assert hinted == [fit.verdict == "poor", False]


def test_parts_far_apart_are_tried_before_they_are_refused(reads: Reads, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = together("scan.ply", BODY, chair(beside(BODY, 3.0)))
    assert repair_allowing_parts(scene).far_parts
    monkeypatch.setattr(matcher.Fitter, "fit", lambda self, shape: a_fit("good", shape))
    reads({BODY.V: 3.7})
    assert len(Matcher("human").fit(scene).left_out) == 6
    reads({})
    with pytest.raises(InputError, match="large parts far apart") as caught:
        Matcher("human").fit(scene)
    assert "--only" in caught.value.hint


@pytest.mark.slow
def test_a_body_on_a_floor_is_matched_as_if_it_were_alone(remembered_fits: Any) -> None:
    scene = together("scan.ply", BODY, floor(BODY), pack(BODY), chair(beside(BODY)))
    fit = meshmatch.register(scene)
    alone = meshmatch.register(BODY)
    assert fit.verdict == "good" and len(fit.left_out) == 8
    assert "scan.ply: human" in fit.notes
    away = np.linalg.norm(fit.points_in_file - alone.points_in_file, axis=1) / np.sqrt(BODY.area)
    assert away.mean() < 0.005
    matcher = Matcher("human")
    found = matcher.map(fit, alone, agree=False)
    off = np.linalg.norm(BODY.verts[found.index[: BODY.V]] - BODY.verts, axis=1) / np.sqrt(BODY.area)
    assert len(found.index) == scene.V and off.mean() < 0.01
    assert found.confidence[: BODY.V].mean() > 0.8 > 0.2 > found.confidence[BODY.V :].mean()


@pytest.mark.slow
def test_a_calf_on_a_pedestal_is_a_calf(remembered_fits: Any) -> None:
    calf = sample("calf")
    scene = together("zoo.ply", calf, pedestal(calf))
    fit = meshmatch.register(scene)
    assert fit.verdict != "poor" and "zoo.ply: quadruped" in fit.notes and len(fit.left_out) == 1


@pytest.mark.slow
def test_a_chair_and_boxes_stay_of_no_kind() -> None:
    boxes = together("boxes", pedestal(BODY), pack(BODY))
    for scene, refusal in ((chair(np.zeros(3)), "does not look like anything"), (boxes, "large parts far apart")):
        with pytest.raises(InputError, match=refusal):
            meshmatch.register(scene)


@pytest.mark.slow
def test_a_collection_leaves_the_floor_out_and_says_so(tmp_path: Path, remembered_fits: Any) -> None:
    scene = together("", BODY, floor(BODY))
    meshmatch.save_shape(tmp_path / "scan.ply", scene)
    meshmatch.save_shape(tmp_path / "body.ply", BODY)
    collection = meshmatch.Collection(tmp_path / "fits", workers=1)
    made = collection.fit(tmp_path, model="human", agree=False)
    notes = {record.name: record.notes for record in made.records}
    assert notes["body"] == "" and notes["scan"].startswith("left out 1 of 2 parts")
    assert collection.fit_of("scan").left_out == (1,)
    found = collection.map("scan", "body")
    off = np.linalg.norm(BODY.verts[found.index[: BODY.V]] - BODY.verts, axis=1) / np.sqrt(BODY.area)
    assert len(found.index) == scene.V and off.mean() < 0.01
    assert "left out 1 of 2 parts" in (tmp_path / "fits" / "fits.csv").read_text()
