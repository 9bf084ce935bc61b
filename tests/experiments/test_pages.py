"""Results are files of one form; the pages are made from them, are fresh, and name nothing that is not there."""

import importlib
import importlib.util
import json
import re
import shlex
from pathlib import Path

import pytest

from meshmatch.errors import InputError
from meshmatch.experiments import pages
from meshmatch.experiments.runner import Report, saved_record, table

DOCS = pages.DOCS
ROOT = DOCS.parent
FILES = sorted((DOCS / "results").glob("*.json"))
OF_ROOMS = {
    f"meshmatch.experiments.{room}": f"meshmatch.experiments.{room}.{module}"
    for room, module in (("bench", "accuracy"), ("bench.viewers", "__main__"), ("hostile", "campaign"))
}
GUIDES = {"categories.md", "collections.md", "method.md"}  # whose paths are those of users
TEXTS = [(name, (DOCS / name).read_text(encoding="utf-8")) for name in pages.PAGES if name not in GUIDES]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_file_of_results_says_how_it_was_made(path: Path) -> None:
    found = json.loads(path.read_text(encoding="utf-8"))
    assert {"experiment", "commands", "date", "commit", "machine", "data", "tables", "values"} <= found.keys()
    assert found["commands"] and all(isinstance(each, str) for each in found["commands"])
    for each in found["tables"]:
        assert each["title"] and {len(row) for row in each["rows"]} == {len(each["columns"])}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_the_commands_of_results_are_here_or_in_a_commit_that_is_named(path: Path) -> None:
    found = json.loads(path.read_text(encoding="utf-8"))
    if "last_commit" in found:
        assert re.fullmatch(r"[0-9a-f]{7,40}", found["last_commit"])
        return
    for command in found["commands"]:
        words = shlex.split(command.partition(", ")[0])
        if words[:2] == ["python", "-m"]:
            module = importlib.import_module(OF_ROOMS.get(words[2], words[2]))
            assert module.main([*words[3:], "--help"]) == 0  # an unknown option would be refused


def test_the_page_continues_the_ablations_with_the_options_of_their_file() -> None:
    text = (DOCS / "paper.md").read_text(encoding="utf-8").replace("\\\n", " ")
    command = re.search(r"^    python -m (meshmatch\.experiments\.paper\.ablations --views .*)$", text, re.MULTILINE)
    assert command
    words = shlex.split(command[1])[1:]
    given = dict(zip(words[::2], words[1::2], strict=True))
    used = json.loads((DOCS / "results" / "paper-ablations.json").read_text(encoding="utf-8"))["options"]
    for option in ("views", "seeds", "repeated", "rounds", "steps", "shapes", "rows", "output"):
        assert given[f"--{option}"] == str(used[option]), option


def test_a_page_names_the_last_commit_of_a_command_that_is_gone(tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    record = {"date": "d", "commit": "c", "machine": "m", "last_commit": "abc1234"}
    record |= {"tables": [{"columns": ["a"], "rows": [["1"]]}]}
    (tmp_path / "results" / "few.json").write_text(json.dumps(record))
    assert pages.build_table("few 1", tmp_path).endswith("d, commit c, m; to repeat it, check out abc1234.\n\n")


def test_a_file_that_an_experiment_writes_has_the_same_form() -> None:
    drawn = table("T", [{"set": "a", "cm": 1.234}], {"set": "set", "mean": "cm:.1f"})
    head = {"experiment": "x", "date": "d", "commit": "c", "machine": "m", "options": {"data": "there"}}
    found = saved_record(head, ["python -m x"], Report({"rows": [1.5]}, [drawn]))
    assert found["tables"] == [{"title": "T", "columns": ["set", "mean"], "rows": [["a", "1.2"]]}]
    assert (found["data"], found["commands"], found["values"]) == ("there", ["python -m x"], {"rows": [1.5]})


def test_the_pages_are_fresh() -> None:
    assert pages.main(["--check"]) == 0


def test_a_page_that_differs_from_its_files_is_told_and_then_made(tmp_path: Path) -> None:
    (tmp_path / "results").mkdir()
    record = {"date": "d", "commit": "c", "machine": "m", "tables": [{"columns": ["a", "b"], "rows": [["1", "2"]]}]}
    (tmp_path / "results" / "few.json").write_text(json.dumps(record))
    for name in pages.PAGES:
        (tmp_path / name).write_text("before\n<!-- results few 1: b -->\nold\n<!-- end -->\nafter\n")
    assert pages.main(["--check", "--docs", str(tmp_path)]) == 1
    assert pages.main(["--docs", str(tmp_path)]) == 0
    text = (tmp_path / pages.PAGES[0]).read_text()
    assert "| b |\n|---|\n| 2 |\n" in text and "old" not in text and text.endswith("after\n")
    assert pages.main(["--check", "--docs", str(tmp_path)]) == 0
    twice = "<!-- results few 1: a -->\n<!-- end -->\n<!-- results few 1: b -->\n<!-- end -->\n"
    first, second = pages.update_tables(twice, tmp_path).split("<!-- end -->\n")[:2]
    assert "d, commit c, m." in first and second.endswith("(results/few.json), as above.\n\n") and "| 2 |" in second
    (tmp_path / "results" / "few.json").write_text("{}")
    with pytest.raises(InputError, match="few"):
        pages.results_file("few", tmp_path)


def test_the_card_of_people_has_the_errors_of_the_results() -> None:
    card = json.loads((ROOT / "templates" / "models" / "human" / "card.json").read_text(encoding="utf-8"))
    sets = json.loads((DOCS / "results" / "accuracy.json").read_text(encoding="utf-8"))["values"]["sets"]
    assert card["metrics"].keys() == sets.keys()
    for name, found in card["metrics"].items():
        assert found["nodes"] == {key: sets[name][key] for key in found["nodes"]}


def test_results_are_one_short_page() -> None:
    assert len((DOCS / "results.md").read_text(encoding="utf-8").split()) <= 1500


@pytest.mark.parametrize(("name", "text"), TEXTS)
def test_a_page_names_no_file_and_no_command_that_is_not_there(name: str, text: str) -> None:
    paths = re.findall(r"`((?:\w+/)+\w*\.?\w*)`", text)
    assert [each for each in paths if not (ROOT / each).exists() and not (ROOT / "meshmatch" / each).exists()] == []
    modules = set(re.findall(r"python -m (meshmatch[\w.]*)", text))
    assert [each for each in modules if importlib.util.find_spec(each) is None] == []
