"""What README and docs tell people to type exists."""

import re
import shlex
from pathlib import Path

import pytest
from typer.main import get_command

from meshmatch.cli import reference
from meshmatch.cli.app import app

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(page: Path, language: str) -> list[str]:
    """Fenced code blocks of a language."""
    return re.findall(
        rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )


def commands(page: Path) -> list[list[str]]:
    """Every call of the program in the page's shell blocks, as words after its name."""
    found = []
    for block in blocks(page, "(?:bash|sh)"):
        for part in re.split(r"&&|\n|;|\|", block.replace("\\\n", " ")):
            words = shlex.split(part, comments=True)
            if words and Path(words[0]).name == "meshmatch":
                found.append(words[1:])
    return found


def complaint(words: list[str]) -> str:
    """What is wrong with a call; empty if its verb and options exist and its arguments are enough."""
    command = get_command(app)
    rest = list(words)
    while hasattr(command, "commands") and rest and not rest[0].startswith("-"):
        if rest[0] not in command.commands:
            return f"no verb {rest[0]}"
        command = command.commands[rest.pop(0)]
    options = {
        name for item in command.params for name in (*item.opts, *item.secondary_opts) if name[0] == "-"
    }
    options |= {"-h", "--help"}
    used = [
        word.split("=")[0]
        for word in rest
        if re.match(r"--?[A-Za-z]", word) and word not in ("-x", "-y", "-z")
    ]
    unknown = [word for word in used if word not in options]
    if unknown:
        return f"no option {unknown[0]}"
    missing = [
        item.name
        for item in command.params
        if item.required and item.param_type_name == "option" and not {*item.opts} & {*used}
    ]
    if missing and "--help" not in used:
        return f"needs {missing[0]}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_call_in_the_documentation_exists(page: Path) -> None:
    wrong = {" ".join(words): complaint(words) for words in commands(page)}
    assert {words: why for words, why in wrong.items() if why} == {}


def test_there_are_calls_to_check() -> None:
    assert {tuple(words[:1]) for page in PAGES for words in commands(page)} >= {
        ("match",),
        ("register",),
        ("evaluate",),
        ("models",),
        ("prepare",),
        ("train",),
    }


def test_the_check_sees_what_does_not_exist() -> None:
    assert complaint(["macth", "a", "b"]) == "no verb macth"
    assert complaint(["match", "a", "b", "-o", "c.npy", "--speed", "9"]) == "no option --speed"
    assert complaint(["match", "a", "b"]) == "needs output"
    assert complaint(["match", "a", "b", "-o", "c.npy", "--up", "-z"]) == ""
    assert complaint(["models", "lst"]) == "no verb lst"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_pictures_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8"))
    local = [target for target in targets if not target.startswith(("http:", "https:", "mailto:"))]
    assert [target for target in local if not (page.parent / target).exists()] == []


def test_the_page_of_the_command_line_is_fresh() -> None:
    assert (ROOT / "docs" / "cli.md").read_text(encoding="utf-8") == reference.reference()


def test_the_page_does_not_depend_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    page = reference.reference()
    monkeypatch.setenv("COLUMNS", "40")
    assert reference.reference() == page


def test_the_check_of_the_page_fails_on_a_stale_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "cli.md"
    assert reference.main(["--check", str(file)]) == 1
    assert reference.main([str(file)]) == 0
    assert reference.main(["--check", str(file)]) == 0
    file.write_text(file.read_text() + "old words\n")
    assert reference.main(["--check", str(file)]) == 1
    assert "stale" in capsys.readouterr().err


def first_two() -> list[str]:
    """The two commands of the README, each on one line."""
    return [" ".join(block.replace("\\\n", " ").split()) for block in blocks(ROOT / "README.md", "bash")[:2]]


def test_both_commands_do_all_of_their_own_set_up() -> None:
    for command in first_two():
        steps = [step.strip() for step in command.split("&&")]
        assert steps[0].startswith("python3 -m venv ")
        torch = next(n for n, step in enumerate(steps) if "torch==2.13.0" in step)
        package = next(n for n, step in enumerate(steps) if re.search(r"pip install (-e )?'?\.", step))
        assert 0 < torch < package < len(steps) - 1


def test_the_first_command_matches_the_two_shapes_that_ship() -> None:
    words = shlex.split(first_two()[0].split("&&")[-1])
    assert words[1] == "match"
    samples = [ROOT / word for word in words[2:4]]
    assert sorted(samples) == sorted((ROOT / "templates" / "samples").glob("*.ply"))


def test_the_second_command_runs_the_tests() -> None:
    last = first_two()[1].split("&&")[-1].split()
    assert "pytest" in last[0] or last[1:3] == ["-m", "pytest"]
