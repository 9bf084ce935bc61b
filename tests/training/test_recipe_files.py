"""Recipes on cards, read back: the same, or refused in a line."""

import json
import warnings
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import InputError, MeshmatchError, MeshmatchWarning, OptionError
from meshmatch.models.inference import training_device
from meshmatch.templates.location import bundled_folder
from meshmatch.training.loop import TrainConfig
from meshmatch.training.losses import CorrespondenceLoss
from meshmatch.training.recipe_files import read_recipe, recipe_record
from meshmatch.training.recipes import (
    Recipe,
    clouds,
    compact,
    default,
    paper,
    paper_clouds,
    people,
    recipe_for,
    small_data,
)


def written(folder: Path, record: object) -> Path:
    path = folder / "card.json"
    path.write_text(json.dumps(record))
    return path


@pytest.mark.parametrize("made", [default, people, paper, small_data, clouds, paper_clouds, compact])
def test_a_recipe_comes_back_from_its_record(made: Any, tmp_path: Path) -> None:
    recipe = made().changed(steps=77, volume=0.25, seed=9, device="cpu", minutes=3)
    record = {"recipe": recipe_record(recipe), "network": recipe.network.to_dict(), "field": {"kernel": recipe.kernel}}
    back = read_recipe(written(tmp_path, record), default())
    assert back == replace(recipe, train=replace(recipe.train, device="auto", minutes=None))


@pytest.mark.parametrize("name", ["human", "quadruped", "hand", "head"])
def test_the_cards_that_ship_can_be_read(name: str) -> None:
    path = bundled_folder() / "models" / name / "card.json"
    card = json.loads(path.read_text())
    found = read_recipe(path, people(), started=True)
    assert asdict(found.train)["loss"] == card["recipe"]["train"]["loss"]
    assert (found.train.steps, found.train.seed) == (card["recipe"]["train"]["steps"], card["recipe"]["train"]["seed"])
    assert found.network.to_dict() == card["network"]
    # a card that left a setting out would be read as what is usual today
    later = {"device", "draw", "tf32", "compile"}  # off before there was a choice, or of the machine
    assert {each.name for each in fields(TrainConfig)} - card["recipe"]["train"].keys() == later


@pytest.mark.parametrize(("name", "options"), [("head", {"steps": 1800}), ("hand", {"align_steps": 0})])
def test_hands_and_heads_learn_again_as_their_cards_say(name: str, options: dict[str, int]) -> None:
    """The commands of docs/models.md."""
    usual, path = recipe_for(kind=name), bundled_folder() / "models" / name / "card.json"
    assert read_recipe(path, usual, started=True) == usual.changed(workers=0, **options)


def test_what_a_recipe_has_behind_it_is_told(tmp_path: Path) -> None:
    begun = written(tmp_path, {"recipe": {"start": {"model": "human", "steps": 5}}})
    with pytest.warns(MeshmatchWarning, match="started from the model human"):
        read_recipe(begun, people())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_recipe(begun, people(), started=True)
    with pytest.warns(MeshmatchWarning, match="settings changed on the way"):
        read_recipe(written(tmp_path, {"recipe": {"earlier": [{"until_step": 3, "train.steps": 3}]}}), people())


def test_another_number_of_processes_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    by_two = written(tmp_path, {"recipe": {"processes": 2}})
    with pytest.warns(MeshmatchWarning, match="were 2 in that training, and are 1 in this one"):
        read_recipe(by_two, people())
    monkeypatch.setenv("WORLD_SIZE", "2")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_recipe(by_two, people())
        read_recipe(written(tmp_path, {"recipe": {"train": {"steps": 5}}}), people())
    with pytest.warns(MeshmatchWarning, match="were 1 in that training, and are 2 in this one"):
        read_recipe(bundled_folder() / "models" / "hand" / "card.json", recipe_for(kind="hand"), started=True)


def test_a_part_changes_a_part(tmp_path: Path) -> None:
    part = {"recipe": {"train": {"steps": 5, "loss": {"arap": 1}}}}
    usual = people()
    wanted = replace(usual, train=replace(usual.train, steps=5, loss=replace(usual.train.loss, arap=1)))
    assert read_recipe(written(tmp_path, part), usual) == wanted


@dataclass(frozen=True)
class Mine(CorrespondenceLoss):
    more: float = 1.0


def test_a_loss_of_ones_own_is_named_and_never_loaded(tmp_path: Path) -> None:
    recipe: Recipe = replace(people(), train=replace(people().train, loss=Mine()))
    record = recipe_record(recipe)
    assert record["loss"].endswith("test_recipe_files.Mine") and record["train"]["loss"]["more"] == 1.0
    with pytest.raises(InputError, match="a custom loss") as caught:
        read_recipe(written(tmp_path, {"recipe": record}), people())
    assert "Python" in caught.value.hint


@pytest.mark.parametrize(("record", "words"), [
    ([], "not an object"), ({"recipe": 3}, "recipe must be an object"),
    ({"recipe": {"train": {"stps": 1}}}, "train.stps"),
    ({"recipe": {"train": {"steps": "9"}}}, "steps must be int"), ({"recipe": {"train": {"steps": True}}}, "must be int"),
    ({"recipe": {"train": {"steps": 0}}}, "steps must be at least 1, not 0"),
    ({"recipe": {"scan": {"points": 10**9}}}, "64..100,000"),
    ({"recipe": {"train": {"rate": float("nan")}}}, "rate must be float"),
    ({"recipe": {"scan": {"noise": -1}}}, "noise must be at least 0"),
    ({"recipe": {"loss": ["x"]}}, "a custom loss"), ({"recipe": {"storage": "int2"}}, "storage"),
    ({"recipe": {"train": {"loss": {"robust": 1}}}}, "robust must be bool"), ({"network": {"code": 10**9}}, "code must be"),
    ({"network": {"size": 1}}, "unknown network"), ({"field": {"kernel": {}}}, "kernel"), ({"recipe": {"tain": {}}}, "tain"),
    ({"recipe": {"scan": {"points": 1}}}, "64..100,000"), ({"recipe": {"train": {"momentum": 7}}}, "momentum"),
    ({"recipe": {"template": "../other"}}, "included template"),
    ({"train": {"steps": 5}}, "train is unknown"), ({"steps": 5}, "no training settings"), ({}, "no training settings"),
])  # fmt: skip
def test_what_is_no_recipe_is_told(record: Any, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a recipe") as caught:
        read_recipe(written(tmp_path, record), people())
    assert words in caught.value.message and caught.value.hint and "\n" not in caught.value.message


@pytest.mark.parametrize(("settings", "words"), [
    ({"points": 3}, "64..100,000"), ({"points": "a"}, "points must be int"), ({"seed": -1}, "seed must be at least 0"),
    ({"volume": -1}, "volume must be at least 0"), ({"bf16": "maybe"}, "bf16 must be bool"), ({"rate": "x"}, "rate must be"),
    ({"minutes": "a"}, "minutes must be"), ({"workers": "a"}, "workers must be int"),
    ({"loss": 3}, "a loss is an Objective"),
    ({"loss": CorrespondenceLoss}, "a loss is an Objective"), ({"stps": 3}, "unknown training setting 'stps'"),
])  # fmt: skip
def test_a_change_is_checked_as_a_file_is(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(OptionError) as caught:
        people().changed(**settings)
    assert words in caught.value.message


def test_a_change_takes_the_numbers_of_arrays() -> None:
    assert people().changed(steps=np.int64(5), rate=np.float32(0.5)) == people().changed(steps=5, rate=0.5)


@pytest.mark.parametrize(
    "settings",
    [{"threads": 10**9}, {"rate": "x"}, {"rate": np.inf}, {"workers": "a"}, {"minutes": "a"}, {"loss": None}],
)
def test_settings_of_a_training_are_checked(settings: dict[str, Any]) -> None:
    with pytest.raises(OptionError):
        TrainConfig(**settings)


@pytest.mark.parametrize("how", [{}, {"unsupervised": True}, {"preset": "paper"}])
def test_a_folder_that_is_not_prepared_has_no_recipe(how: dict[str, Any], tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "gone"):
        with pytest.raises(InputError, match="not a prepared folder"):
            recipe_for(folder, **how)
    with pytest.raises(InputError, match="expected a path"):
        recipe_for(3, **how)  # type: ignore[arg-type]


def test_a_kind_that_is_not_generated_has_no_recipe() -> None:
    with pytest.raises(OptionError, match="unknown kind 'humn'"):
        recipe_for(kind="humn")


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "text.json").write_text("{")
    for name in ("text.json", "gone.json", ""):
        with pytest.raises(InputError):
            read_recipe(tmp_path / name, people())


def test_a_device_that_is_not_there_is_refused_before_the_work() -> None:
    assert training_device(wanted="cpu").type == "cpu"
    with pytest.raises(OptionError, match="no device 'tpu'") as caught:
        training_device(wanted="tpu")
    assert "cpu" in caught.value.hint


@pytest.mark.parametrize("steps", [0, -1, 2**53 + 1])
def test_steps_have_one_range_wherever_they_come_from(steps: int, tmp_path: Path) -> None:
    file = written(tmp_path, {"recipe": {"train": {"steps": steps}}})
    for take in (
        lambda: read_recipe(file, people()),
        lambda: people().changed(steps=steps),
        lambda: TrainConfig(steps=steps),
    ):
        technical_limit = r"steps must lie in 1\.\.9,007,199,254,740,992, not"
        with pytest.raises(MeshmatchError, match="steps must be at least 1, not" if steps < 1 else technical_limit):
            take()
