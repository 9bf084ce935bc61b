"""No option without a test that passes it; and the few that no other test passes."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.main import get_command

from meshmatch import pipeline
from meshmatch.api import interpolation
from meshmatch.cli.app import app
from meshmatch.errors import InputError
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import Run

TESTS = Path(__file__).resolve().parents[1]


def options(command: Any, verb: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], tuple[str, ...]]]:
    """Every verb with each of its options: all spellings of one, yes and no apart."""
    for name, inner in getattr(command, "commands", {}).items():
        yield from options(inner, (*verb, name))
    if verb and not hasattr(command, "commands"):
        for parameter in command.params:
            if parameter.param_type_name == "option" and "--help" not in parameter.opts:
                yield verb, tuple(parameter.opts)
                if parameter.secondary_opts:
                    yield verb, tuple(parameter.secondary_opts)


def words_of_tests() -> list[set[str]]:
    """The words in quotes of each file of tests."""
    found = []
    for file in TESTS.rglob("*.py"):
        nodes = ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        texts = [node.value for node in nodes if isinstance(node, ast.Constant)]
        found.append({word for text in texts if isinstance(text, str) for word in (text, *text.split())})
    return found


WORDS = words_of_tests()
OPTIONS = list(options(get_command(app)))


@pytest.mark.parametrize(
    ("verb", "names"), OPTIONS, ids=[" ".join((*verb, names[0])) for verb, names in OPTIONS]
)
def test_some_file_of_tests_names_the_verb_and_the_option(
    verb: tuple[str, ...], names: tuple[str, ...]
) -> None:
    """A net with wide meshes: it catches an option that is new, and not one that is passed to another verb alone."""
    # the tests' own call("transfer-labels") adds --labels
    by_itself = {f"--{verb[-1].removeprefix('transfer-')}"} == set(names)
    assert by_itself or any(set(verb) <= words and words & set(names) for words in WORDS)


def test_the_net_catches_an_option_that_nobody_passes() -> None:
    assert len(OPTIONS) > 150
    assert not any({"match", "--no" + "body-passes-this"} <= words for words in WORDS)


@pytest.mark.parametrize(("flag", "word"), [("--partial", "yes"), ("--whole", "no"), (None, "auto")])
def test_interpolate_hands_partial_on(
    run: Run, two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, flag: str | None, word: str
) -> None:
    heard: dict[str, Any] = {}

    def stop(*_: object, **choices: object) -> None:
        heard.update(choices)
        raise InputError("far enough")

    monkeypatch.setattr(interpolation, "interpolate", stop)
    out = two[0].with_name("between")
    answer = run("interpolate", *two, "-o", out, *([] if flag is None else [flag]))
    assert (answer.status, heard["config"].partial) == (1, word)
    assert not out.exists()


def test_picture_with_its_defaults_spelled_out(run: Run, two: tuple[Path, Path]) -> None:
    """The same bytes; and others without."""
    bytes_of = []
    for words in ((), ("--ground", "--names"), ("--no-ground", "--no-names")):
        out = two[0].with_name("p.png")
        assert run("picture", two[0], "-o", out, "--size", "96x80", *words).status == 0
        bytes_of.append(out.read_bytes())
    assert bytes_of[0] == bytes_of[1] != bytes_of[2]


@pytest.fixture
def painted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cube: Shape) -> Path:
    """A painted a.ply, a b.ply of the same shape, and a poor map between them."""
    monkeypatch.chdir(tmp_path)
    save_shape("a.ply", Shape(cube.verts, cube.faces, "a", np.ones((8, 4)) * 0.5))
    save_shape("b.ply", cube)
    ends = load_shape("a.ply"), load_shape("b.ply")
    save_map("ab.npz", VertexMap.between(*ends, np.arange(8), verdict="poor", reasons=("it lies elsewhere",)))
    return tmp_path


def test_transfer_texture_that_is_strict(run: Run, painted: Path) -> None:
    words = ("transfer-texture", "a.ply", "b.ply", "-o", "out.glb", "--map", "ab.npz", "--size", "32")
    answer = run(*words, "--strict")
    assert answer.status == 1
    assert answer.err.startswith("error: poor fit, nothing was written: it lies elsewhere")
    assert not Path("out.glb").exists()
    assert run(*words).status == 0


def test_choices_for_matching_reach_the_pipeline_from_transfer_texture(
    run: Run, painted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    heard: dict[str, object] = {}

    def carry(*_: object, **choices: object) -> None:
        heard.update(choices)
        raise InputError("far enough")

    monkeypatch.setattr(pipeline, "carry", carry)
    choices = ("--model", "human", "--refine", "latent", "--seed", "7", "--up", "y", "--front", "-z")
    answer = run("transfer-texture", "a.ply", "b.ply", "-o", "out.glb", *choices, "--threads", "3")
    assert "far enough" in answer.err
    heard.pop("progress")
    wanted = {"model": "human", "refine": "latent", "seed": 7, "up": "y", "front": "-z", "workers": 3}
    assert heard == wanted
    assert not Path("out.glb").exists()
