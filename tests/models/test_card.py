"""The model card: what is written comes back, and nothing else is accepted."""

import json
from dataclasses import FrozenInstanceError, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import ModelError
from meshmatch.models.card import MAX_BYTES, ModelCard, card_from_json, card_to_json, check_name, read_card, write_card

from .small_model import small_card


def test_written_card_comes_back_equal(tmp_path: Path) -> None:
    card = small_card()
    write_card(card, tmp_path / "card.json")
    assert read_card(tmp_path / "card.json") == card
    text = (tmp_path / "card.json").read_text(encoding="utf-8")
    assert list(json.loads(text))[:2] == ["schema", "name"]
    assert "Größe" in text  # people read it


def test_a_changed_value_makes_another_card() -> None:
    assert small_card() != small_card(seed=2)
    assert small_card(network={"width": 9}) != small_card(network={"width": 8})


def test_tuples_become_lists_so_that_saving_changes_nothing() -> None:
    card = small_card(recipe={"rates": (1, 2), "inner": {"x": ((3,),)}})
    assert card.recipe == {"rates": [1, 2], "inner": {"x": [[3]]}}
    assert card_from_json(card_to_json(card)) == card


def test_card_does_not_share_its_dictionaries() -> None:
    mine = {"width": 8}
    card = small_card(network=mine)
    mine["width"] = 9
    assert card.network == {"width": 8}
    with pytest.raises(FrozenInstanceError):
        card.seed = 3  # type: ignore[misc]


def test_whole_minutes_are_a_number_too() -> None:
    minutes = small_card(training_minutes=3).training_minutes
    assert type(minutes) is float
    assert minutes == 3.0


_WRONG: list[tuple[str, Any, str]] = [
    ("name", "", "name of a model"),
    ("name", "../human", "name of a model"),
    ("name", "a/b", "name of a model"),
    ("name", "Human", "name of a model"),
    ("name", ".hidden", "name of a model"),
    ("name", "a\n", "name of a model"),
    ("name", "a" * 65, "name of a model"),
    ("name", 7, "name must be text"),
    ("category", None, "category must be text"),
    ("template_hash", "0123", "16 hex digits"),
    ("template_hash", "0123456789ABCDEF", "16 hex digits"),
    ("network", [], "network must be an object"),
    ("network", {"a": np.float32(1)}, "network.a cannot hold"),
    ("network", {"a": float("nan")}, "network.a must be finite"),
    ("network", {1: 2}, "a key that is not text"),
    ("field", {"kernel": "smooth", "radius": 0.5}, "field must have kernel, radius, nodes"),
    ("field", {"kernel": "smooth", "radius": 0.5, "nodes": 6, "x": 1}, "field must have"),
    ("field", {"kernel": 1, "radius": 0.5, "nodes": 6}, "field.kernel must be text"),
    ("field", {"kernel": "smooth", "radius": 0.5, "nodes": 6.5}, "field.nodes must be a whole number"),
    ("field", {"kernel": "smooth", "radius": 0.0, "nodes": 6}, "field.radius must be above 0"),
    ("field", {"kernel": "smooth", "radius": 0.5, "nodes": 3}, "field.nodes must be 4 or more"),
    ("recipe", "fast", "recipe must be an object"),
    ("seed", 1.0, "seed must be a whole number"),
    ("seed", True, "seed must be a whole number"),
    ("steps", -1, "0 or more"),
    ("training_minutes", "3", "training_minutes must be a number"),
    ("training_minutes", float("inf"), "training_minutes must be finite"),
    ("metrics", {"scape": 3.0}, "metrics.scape must be an object"),
    ("metrics", {"scape": {"none": "good"}}, "metrics.scape.none must be a number"),
    ("metrics", {"scape": {"none": {"mean": {"x": 1}}}}, "metrics.scape.none must be a number"),
    ("metrics", {"scape": {"none": True}}, "metrics.scape.none must be a number"),
    ("weights_sha256", "ab" * 31, "64 hex digits"),
    ("created", "yesterday", "ISO date"),
    ("created", "2026-02-30", "ISO date"),
    ("stiffness", 0, "stiffness must be above 0"),
    ("stiffness", -0.5, "stiffness must be above 0"),
    ("schema", 0, "schema 0, not 4"),
    ("schema", True, "schema must be a whole number"),
]


@pytest.mark.parametrize(("entry", "value", "told"), _WRONG)
def test_wrong_values_are_refused(entry: str, value: Any, told: str) -> None:
    with pytest.raises(ModelError, match=told) as caught:
        small_card(**{entry: value})
    assert caught.value.hint


@pytest.mark.parametrize("entry", [item.name for item in fields(ModelCard)])
def test_every_entry_must_be_there(entry: str) -> None:
    words = json.loads(card_to_json(small_card()))
    del words[entry]
    with pytest.raises(ModelError, match=f"missing entries: {entry}"):
        card_from_json(json.dumps(words))


def test_extra_entries_are_refused() -> None:
    words = json.loads(card_to_json(small_card())) | {"__reduce__": "x", "zzz": 1}
    with pytest.raises(ModelError, match="unknown entries: '__reduce__', 'zzz'"):
        card_from_json(json.dumps(words))


@pytest.mark.parametrize(
    ("schema", "lacking", "odd"),
    [
        (1, ["frame", "stiffness", "mirror"], {"frame": {"orientation": "none", "scale": "area"}}),
        (2, ["stiffness", "mirror"], {"stiffness": 0.5}),
        (3, ["mirror"], {"mirror": "auto"}),
    ],
)
def test_a_card_of_an_older_schema_is_read_as_it_was_meant(schema: int, lacking: list[str], odd: dict) -> None:
    words = json.loads(card_to_json(small_card())) | {"schema": schema}
    for entry in (*lacking, "correspondence"):
        del words[entry]
    card = card_from_json(json.dumps(words))
    assert card == small_card()
    assert (card.schema, card.frame) == (4, {"orientation": "searched", "scale": "area"})
    assert (card.stiffness, card.mirror) == (1.0, "no")
    with pytest.raises(ModelError, match=f"missing entries: {', '.join(lacking)}, correspondence"):
        card_from_json(json.dumps(words | {"schema": 4}))
    rest = [entry for entry in lacking if entry not in odd]  # an entry of a newer schema is no sign of an older one
    with pytest.raises(ModelError, match=f"missing entries: {', '.join([*rest, 'correspondence'])}"):
        card_from_json(json.dumps(words | odd))


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        ({}, "frame must have orientation, scale"),
        ({"orientation": "none"}, "frame must have"),
        ({"orientation": "sideways", "scale": "area"}, "frame.orientation must be one of"),
        ({"orientation": "none", "scale": 3}, "frame.scale must be one of"),
        ({"orientation": "none", "scale": "area", "more": 1}, "frame must have"),
    ],
)
def test_a_wrong_frame_is_refused(frame: dict[str, object], told: str) -> None:
    with pytest.raises(ModelError, match=told):
        small_card(frame=frame)


@pytest.mark.parametrize(
    ("loss", "known"),
    [({"correct": 1.0}, True), ({"landmarks": 1.0}, False), ({"landmarks": 1.0, "robust": True}, True), ("odd", True)],
)
def test_an_older_card_tells_by_its_recipe_what_it_learned_from(loss: object, known: bool) -> None:
    words = json.loads(card_to_json(small_card())) | {"schema": 3, "recipe": {"train": {"loss": loss}}}
    del words["mirror"], words["correspondence"]
    assert card_from_json(json.dumps(words)).correspondence is known
    words["data"] = "32 shapes of pets, without correspondence"
    assert not card_from_json(json.dumps(words)).correspondence


def test_a_newer_schema_asks_for_an_update_whatever_else_it_holds() -> None:
    words = json.loads(card_to_json(small_card())) | {"schema": 5, "unheard": 1}
    with pytest.raises(ModelError, match="schema 5") as caught:
        card_from_json(json.dumps(words))
    assert "update" in caught.value.hint


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "7", '{"name": NaN}', '{"a": 1, "a": 1}', "[" * 100_000, '"' + "x" * 50]
)
def test_what_is_no_card_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "card.json"
    path.write_text(text)
    with pytest.raises(ModelError):
        read_card(path)


def test_a_repeated_key_is_refused() -> None:
    text = card_to_json(small_card()).replace('"seed": 1,', '"seed": 1, "seed": 1,')
    with pytest.raises(ModelError, match="a key occurs twice"):
        card_from_json(text)


def test_size_is_bounded(tmp_path: Path) -> None:
    path = tmp_path / "card.json"
    text = card_to_json(small_card())
    path.write_text(text + " " * (MAX_BYTES - len(text.encode())))
    assert read_card(path) == small_card()
    with path.open("a") as file:
        file.write(" ")
    with pytest.raises(ModelError, match="larger than 1000 kB"):
        read_card(path)


def test_a_card_that_is_not_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "card.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(ModelError, match="not text"):
        read_card(tmp_path / "card.json")


def test_missing_card_names_what_a_model_is(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="holds no model") as caught:
        read_card(tmp_path / "card.json")
    assert "weights.safetensors" in caught.value.hint


@pytest.mark.parametrize("name", ["a", "human", "human-2.1_b", "0", "a" * 64])
def test_good_names_pass(name: str) -> None:
    assert check_name(name) == name
