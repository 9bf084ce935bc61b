"""`models`: what is in the registry, and what a damaged model is told to be."""

import json
import shutil
from pathlib import Path

import pytest

from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import Run


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "home"
    monkeypatch.setenv("MESHMATCH_HOME", str(folder))
    return folder


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """The human model under another name."""
    folder = tmp_path / "work"
    shutil.copytree(bundled_folder() / "models" / "human", folder)
    card = json.loads((folder / "card.json").read_text())
    (folder / "card.json").write_text(json.dumps(card | {"name": "mine"}))
    return folder


SHIPPED = ["hand", "head", "human", "quadruped"]


def names(run: Run) -> list[str]:
    return [entry["name"] for entry in run("models", "list", "--json").record["models"]]


def test_list_knows_the_model_that_ships(run: Run) -> None:
    answer = run("models", "list")
    assert answer.status == 0
    assert answer.err == ""
    rows = [line.split() for line in answer.out.splitlines()]
    assert rows[0][0] == "NAME"
    assert {(name, name) for name in SHIPPED} <= {tuple(row[:2]) for row in rows}
    words = next(line for line in answer.out.splitlines() if line.startswith("hand "))
    assert words.endswith("right hands of 1024 generated people in sampled poses, cut ...")
    assert "cut off above the wrist (anny" in run("models", "list", "--json").out


def test_show_is_the_card(run: Run) -> None:
    card = run("models", "show", "human").record
    assert card["name"] == "human"
    assert {"data", "licence", "recipe", "metrics", "weights_sha256", "template_hash"} <= card.keys()
    line = run("models", "show", "human", "--json").out
    assert json.loads(line) == card and line.count("\n") == 1


def test_a_mistyped_name_is_an_error_with_a_guess(run: Run) -> None:
    for words in (["show", "humna"], ["remove", "humna"], ["verify", "humna"]):
        answer = run("models", *words)
        assert answer.status == 1
        assert "humna" in answer.err
        assert "human" in answer.err.replace("humna", "")


def test_add_then_remove(run: Run, mine: Path, home: Path) -> None:
    assert names(run) == SHIPPED
    answer = run("models", "add", mine)
    assert (answer.status, answer.out) == (0, "")
    assert names(run) == [*SHIPPED, "mine"]
    assert (home / "models" / "mine" / "card.json").is_file()
    assert run("models", "remove", "mine").status == 0
    assert names(run) == SHIPPED


def test_a_name_is_taken_once(run: Run, mine: Path) -> None:
    run("models", "add", mine)
    answer = run("models", "add", mine)
    assert answer.status == 1
    assert "--replace" in answer.err
    assert run("models", "add", mine, "--replace").status == 0


def test_the_model_that_ships_stays(run: Run) -> None:
    assert run("models", "remove", "human").status == 1
    assert "human" in names(run)


def test_verify(run: Run, mine: Path, home: Path) -> None:
    run("models", "add", mine)
    answer = run("models", "verify")
    assert answer.status == 0
    assert [line.split(":")[0] for line in answer.out.splitlines()] == [*SHIPPED, "mine"]
    weights = home / "models" / "mine" / "weights.safetensors"
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    answer = run("models", "verify")
    assert answer.status == 1
    assert [line.split(":")[0] for line in answer.out.splitlines()] == SHIPPED
    assert "mine: " in answer.err
    assert f"1 of {len(SHIPPED) + 1} models could not be verified" in answer.err
    assert run("models", "verify", "human").status == 0
    assert run("models", "verify", "mine").status == 1


def test_list_shows_a_damaged_model_and_why(run: Run, home: Path) -> None:
    (home / "models" / "broken").mkdir(parents=True)
    (home / "models" / "broken" / "card.json").write_text("{")
    answer = run("models", "list")
    assert answer.status == 0
    assert "damaged" in next(line for line in answer.out.splitlines() if line.startswith("broken"))
    assert "warning: model broken: " in answer.err


def test_what_is_no_model_is_not_added(run: Run, tmp_path: Path) -> None:
    assert run("models", "add", tmp_path).status == 1
    assert run("models", "add", tmp_path / "nowhere").status == 1


def test_json_of_every_verb(run: Run, mine: Path, home: Path) -> None:
    added = run("models", "add", mine, "--json").record
    assert added == {"added": "mine", "folder": str(home / "models" / "mine")}
    (home / "models" / "mine" / "weights.safetensors").write_bytes(b"")
    answer = run("models", "verify", "--json")
    assert answer.status == 1
    checked = {model["name"]: model for model in json.loads(answer.out)["models"]}
    assert checked["human"]["problem"] == ""
    assert len(checked["human"]["sha256"]) == 64
    assert checked["mine"]["sha256"] is None
    assert "is damaged" in checked["mine"]["problem"]
    assert run("models", "remove", "mine", "--json").record == {"removed": "mine"}
