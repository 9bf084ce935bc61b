"""Docstrings of the public names list what there is: parameters, results, attributes; and their examples run."""

import ast
import doctest
import inspect
import re
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch

ROOT = Path(__file__).resolve().parents[2]
PUBLIC = {name: getattr(meshmatch, name) for name in meshmatch.__all__ if name != "__version__"}


def methods(thing: type) -> Iterator[tuple[str, Callable[..., Any]]]:
    """Public methods that the class itself defines, without properties."""
    for name, member in vars(thing).items():
        function = getattr(member, "__func__", member)
        if not name.startswith("_") and inspect.isfunction(function):
            yield name, function


FUNCTIONS = {name: thing for name, thing in PUBLIC.items() if not inspect.isclass(thing)} | {
    f"{name}.{method}": function
    for name, thing in PUBLIC.items()
    if inspect.isclass(thing)
    for method, function in methods(thing)
}
CLASSES = {name: thing for name, thing in PUBLIC.items() if inspect.isclass(thing) and not issubclass(thing, Warning)}


def section(thing: Any, title: str) -> list[str]:
    """The names that a section of a docstring lists, in order."""
    text = inspect.getdoc(thing) or ""
    found = re.search(rf"^{title}\n-+\n((?:[^\n]*\n?)*?)(?=^\w+\n--|\Z)", text, re.MULTILINE)
    return re.findall(r"^(\S.*)$", found[1], re.MULTILINE) if found else []


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_lists_its_parameters_and_its_result(name: str) -> None:
    signature = inspect.signature(FUNCTIONS[name])
    expected = [each for each in signature.parameters if each not in ("self", "cls")]
    assert section(FUNCTIONS[name], "Parameters") == expected
    gives = signature.return_annotation not in (None, "None")
    assert bool(section(FUNCTIONS[name], "Returns") or section(FUNCTIONS[name], "Yields")) == gives


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_lists_what_it_is_made_of(name: str) -> None:
    thing = CLASSES[name]
    if is_dataclass(thing):
        assert sorted(section(thing, "Attributes")) == sorted(each.name for each in fields(thing))
    else:
        assert section(thing, "Parameters") == list(inspect.signature(thing).parameters)


def test_a_section_ends_where_the_next_begins() -> None:
    def told(a: int, b: int) -> int:
        """Both.

        Parameters
        ----------
        a
            The first.
        b
            The second.

        Returns
        -------
        int
            Their sum.
        """
        return a + b

    assert (section(told, "Parameters"), section(told, "Returns"), section(told, "Raises")) == (["a", "b"], ["int"], [])


EXAMPLES = {name: doctest.DocTestParser().get_examples(inspect.getdoc(thing) or "") for name, thing in PUBLIC.items()}
OF_SAMPLES = {
    name: "".join(example.source for example in examples)
    for name, examples in EXAMPLES.items()
    if not any(re.search(r"chair|my-|\bkind=", example.source) for example in examples)
}


@pytest.mark.parametrize("name", PUBLIC)
def test_every_public_name_has_an_example_that_compiles(name: str) -> None:
    assert 1 <= len(EXAMPLES[name]) <= 4
    compile("".join(example.source for example in EXAMPLES[name]), name, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("name", OF_SAMPLES)
def test_the_examples_on_the_samples_run(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, remembered_fits: Any
) -> None:
    (tmp_path / "templates").symlink_to(ROOT / "templates")
    monkeypatch.chdir(tmp_path)
    exec(compile(OF_SAMPLES[name], name, "exec"), {"meshmatch": meshmatch, "np": np})


HEADLESS = frozenset(("by", "from", "in", "of", "on", "that", "those", "to", "which", "who", "whom", "whose", "with"))
"""Words with which a first line describes something that it does not name."""


def headless(source: str) -> list[str]:
    """First lines of docstrings that begin with such a word."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    texts = [ast.get_docstring(node) for node in ast.walk(ast.parse(source)) if isinstance(node, documented)]
    return [text.splitlines()[0] for text in texts if text and text.split()[0].lower() in HEADLESS]


def test_a_docstring_names_what_it_describes() -> None:
    modules = sorted((ROOT / "meshmatch").rglob("*.py"))
    assert [f"{path}: {line}" for path in modules for line in headless(path.read_text("utf-8"))] == []


def test_the_rule_sees_a_headless_docstring() -> None:
    assert headless('def half(n):\n    """Of a number."""\n\nclass A:\n    """Half of a number."""\n') == [
        "Of a number."
    ]
