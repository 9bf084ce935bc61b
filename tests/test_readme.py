"""The README's commands are whole and safe to paste, and every page's calls are ones that the program accepts.

That the two commands also *run* on a fresh machine is `.ci/run`'s to show; what else pages must keep is in
``tests/documentation``.
"""

import ast
import importlib
import re
import shlex
import subprocess
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer import TyperException
from typer.main import get_command

import meshmatch
from meshmatch.cli.app import app

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def blocks(text: str, language: str) -> list[str]:
    """The fenced code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def commands(script: str) -> list[list[str]]:
    """The words of every simple command of a shell script, comments left out."""
    pieces = re.split(r"&&|\|\||;|\n", script.replace("\\\n", " "))
    return [words for piece in pieces if (words := shlex.split(piece, comments=True))]


def calls(text: str) -> list[list[str]]:
    """Every call of meshmatch in the shell blocks of a page, as words after the program's name."""
    scripts = blocks(text, "bash")
    return [words[1:] for script in scripts for words in commands(script) if words[0] == "meshmatch"]


def parse(words: list[str]) -> dict[str, Any]:
    """What the program would make of the words, without doing it; `TyperException` if it would refuse them."""
    command: Any = get_command(app)
    while hasattr(command, "commands"):
        assert words, f"{command.name} is not a whole command"
        assert words[0] in command.commands, f"{command.name} has no verb {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    parameters: dict[str, Any] = command.make_context(command.name, list(words)).params
    return parameters


@pytest.fixture(scope="module")
def scripts() -> list[str]:
    return blocks((ROOT / "README.md").read_text(encoding="utf-8"), "bash")


def test_the_readme_has_two_commands_that_the_shell_understands(scripts: list[str]) -> None:
    assert len(scripts) == 2
    for script in scripts:
        subprocess.run(["bash", "-n"], input=script, text=True, check=True)


@pytest.mark.parametrize("number", [0, 1])
def test_a_command_needs_nothing_before_it_and_stops_at_the_first_failure(scripts: list[str], number: int) -> None:
    lines = scripts[number].strip().split("\n")
    assert all(line.endswith("&&") for line in lines[:-1])
    words = commands(scripts[number])
    assert words[:2] == [["python3", "-m", "venv", ".venv"], [".", ".venv/bin/activate"]]
    if number == 1:  # before anything else can pull another build of it
        assert words.pop(2) == ["pip", "install", "torch==2.13.0"]
    assert words[2][:3] == ["pip", "install", "-e"]


def test_the_pinned_torch_is_one_that_the_package_accepts() -> None:
    assert "torch>=2.13,<3" in PROJECT["optional-dependencies"]["train"]


def test_the_extras_that_pages_name_exist() -> None:
    named = {
        extra
        for page in PAGES
        for found in re.findall(r"(?:meshmatch|'\.)\[([a-z,]+)\]", page.read_text(encoding="utf-8"))
        for extra in found.split(",")
    }
    assert "dev" in named
    assert named <= set(PROJECT["optional-dependencies"])


def test_the_first_tutorial_lists_every_extra() -> None:
    text = (ROOT / "docs" / "start.md").read_text(encoding="utf-8")
    table = text.partition("| extra |")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == set(PROJECT["optional-dependencies"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_call_on_a_page_is_one_that_the_program_accepts(page: Path) -> None:
    for words in calls(page.read_text(encoding="utf-8")):
        parse(words)


def test_every_verb_is_shown_on_some_page() -> None:
    shown = {words[0] for page in PAGES for words in calls(page.read_text(encoding="utf-8"))}
    assert shown == set(get_command(app).commands)


def test_a_call_that_the_program_would_refuse_is_noticed() -> None:
    (call,) = calls("```bash\nmeshmatch match a.ply b.ply \\\n  -o m.npy --color red  # no\n```\n")
    with pytest.raises(TyperException, match="--color"):
        parse(call)
    with pytest.raises(TyperException, match="'w' is not one of"):
        parse(["match", "a.ply", "b.ply", "-o", "m.npy", "--up", "w"])
    with pytest.raises(TyperException, match="Missing parameter: name"):
        parse(["models", "show"])
    with pytest.raises(AssertionError, match="no verb mach"):
        parse(["mach", "a.ply"])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_on_a_page_compiles_and_names_what_exists(page: Path) -> None:
    sources = blocks(page.read_text(encoding="utf-8"), "python")
    for source in sources:
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "meshmatch":
                assert node.attr in meshmatch.__all__
            elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("meshmatch"):
                module = importlib.import_module(str(node.module))
                assert {alias.name for alias in node.names} <= set(dir(module))


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, remembered_fits: Any) -> None:
    (tmp_path / "templates").symlink_to(ROOT / "templates")
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    for source in blocks((ROOT / "README.md").read_text(encoding="utf-8"), "python"):
        exec(compile(source, "README.md", "exec"), found)
    assert len(found["result"].map.index) == len(found["points"]) == len(found["heights"])
    assert (tmp_path / "map.npz").exists()
