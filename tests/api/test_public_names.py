"""The public names: all there, and described. That they have types, mypy asks of `client.py`."""

import ast
import dataclasses
import importlib
import inspect
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix

import meshmatch
from meshmatch.api.interpolation import Interpolation, Step
from meshmatch.collections.fit_all import Fitted
from meshmatch.collections.setting import Record
from meshmatch.fields.field import PointwiseField
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.shapes.shape import Shape
from tests.models.small_model import small_card

ROOT = Path(__file__).resolve().parents[2]
PUBLIC = {name: getattr(meshmatch, name) for name in meshmatch.__all__ if name != "__version__"}


def test_public_names_are_there_and_nothing_else_is() -> None:
    assert dir(meshmatch) == sorted(meshmatch.__all__)
    for name in meshmatch.__all__:
        assert getattr(meshmatch, name) is not None
    assert (ROOT / "meshmatch" / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'mach'"):
        _ = meshmatch.mach  # type: ignore[attr-defined]


def test_the_client_that_mypy_reads_uses_every_name() -> None:
    client = (ROOT / "tests" / "api" / "client.py").read_text("utf-8")
    assert [name for name in meshmatch.__all__ if not re.search(rf"\b{name}\b", client)] == []


def listed() -> list[str]:
    """The dotted names that the reference describes."""
    pages = sorted((ROOT / "docs" / "reference").glob("*.md"))
    return [name for page in pages for name in re.findall(r"^::: (\S+)$", page.read_text("utf-8"), re.MULTILINE)]


@cache
def imports_of(module: str) -> dict[str, str]:
    """The names that a module imports, also for its annotations alone, and from where."""
    nodes = [
        node for node in ast.walk(ast.parse(inspect.getsource(sys.modules[module]))) if isinstance(node, ast.ImportFrom)
    ]
    return {alias.name: str(node.module) for node in nodes for alias in node.names}


def named_types(thing: Any) -> Iterator[tuple[str, Any]]:
    """Words and values of the package's own types in the signature of a function, or in what a class shows."""
    shown = [thing]
    if inspect.isclass(thing):
        members = (vars(thing)[name] for name in vars(thing) if not name.startswith("_") or name == "__init__")
        shown += [getattr(each, "fget", getattr(each, "func", getattr(each, "__func__", each))) for each in members]
    annotations = [str(each) for some in shown for each in getattr(some, "__annotations__", {}).values()]
    words = set(re.findall(r"\b[A-Z]\w+", " ".join(annotations)))
    homes = imports_of(thing.__module__)
    for word in words - {"None"}:
        home = homes.get(word, thing.__module__)
        there = importlib.import_module(home)
        if home.startswith("meshmatch") and home != "meshmatch.arrays" and hasattr(there, word):
            yield word, getattr(there, word)


def test_what_the_reference_names_can_be_imported_from_there() -> None:
    for name in listed():
        assert inspect.getdoc(imported(name)), name


def test_every_type_of_a_public_signature_is_in_the_reference() -> None:
    """A class by its public name or that of its module; what stands for several types in a table."""
    known = [imported(name) for name in listed()]
    words = set(re.findall(r"`(\w+)`", (ROOT / "docs" / "reference" / "types.md").read_text("utf-8")))
    missing = {
        word
        for thing in PUBLIC.values()
        for word, found in named_types(thing)
        if not (any(found is each for each in known) or (not inspect.isclass(found) and word in words))
    }
    assert sorted(missing) == []


def test_values_of_arrays_are_shown_by_their_sizes() -> None:
    """A class of the reference whose repr is that of dataclasses would print all numbers."""
    arrays = re.compile(r"(Float|Int|Bool|UInt8)\[|ndarray|Tensor")
    shown = [thing for thing in map(imported, listed()) if dataclasses.is_dataclass(thing)]
    printing = [
        f"{thing.__name__}.{each.name}"
        for thing in shown
        if hasattr(thing.__repr__, "__wrapped__")  # made by dataclass
        for each in dataclasses.fields(thing)
        if each.repr and arrays.search(str(each.type))
    ]
    assert len(shown) > 40 and printing == []
    sizes = (
        ShapeFunctions(csr_matrix(np.zeros((4, 2))), None),
        PointwiseField(torch.zeros(5, 3), torch.zeros(2, 3), id, 3),
    )
    assert [repr(each) for each in sizes] == [
        "ShapeFunctions(phi: 4 x 2)",
        "PointwiseField(points: 5 x 3, gradient_points: 2 x 3, motion=<built-in function id>, D=3)",
    ]


def test_results_of_many_shapes_are_shown_in_a_line() -> None:
    few, many = (Fitted((Record("a", "a.ply", "good"),) * n + (Record("b", "b.ply"),), n, "human") for n in (2, 1000))
    assert repr(few) == "Fitted(model 'human', 2 good, 1 failed, 0 elsewhere)"
    step = Step(0.0, Shape(np.eye(3), np.array([[0, 1, 2]])))
    short, long = (Interpolation((step,) * n, (), (), "files", 0.1, 2.0, ("a note",) * n) for n in (3, 60))
    assert repr(short) == "Interpolation(3 frames, 0 fits, 'files', 2.0 s, 3 notes)"
    card = small_card(metrics={f"set {n}": {"mean_cm": 1.0} for n in range(1000)})
    assert repr(card) == "ModelCard('blob', category 'blobs', 3 steps, 2026-01-31)"
    assert max(len(repr(each)) for each in (many, long)) < 80


def imported(name: str) -> Any:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)
