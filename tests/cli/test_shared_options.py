"""Options that several verbs share, in each of them; and a few that no other test passes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api import interpolation
from meshmatch.errors import InputError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import FakeMatching, Run, nearest_map

PAIR = {
    "match": ("map.npy",),
    "view": ("page.html",),
    "transfer-color": ("out.ply",),
    "transfer-labels": ("out.txt", "--labels", "labels.txt"),
    "transfer-weights": ("out.npz", "--weights", "weights.json"),
    "transfer-landmarks": ("out.csv", "--landmarks", "points.txt"),
    "transfer-texture": ("out.glb", "--size", "32", "--samples", "1"),
}
"""Verbs of two shapes: the output, and what else each needs."""
SHARED: list[tuple[tuple[str, ...], dict[str, Any], dict[str, Any]]] = [
    *((("--refine", name), {"refine": name}, {"refine": name}) for name in ("none", "latent")),
    *((("--up", axis), {"up": axis.lower()}, {"up": axis.lower()}) for axis in ("x", "-z", "Y")),
    *((("--mirror", word), {"mirror": word}, {"mirror": word}) for word in ("auto", "no")),
    (("--front", "-y"), {"front": "-y"}, {"front": "-y"}),
    (("--seed", "7"), {"seed": 7}, {"seed": 7}),
    (("--partial",), {"partial": "yes"}, {"partial": "yes"}),
    (("--whole",), {"partial": "no"}, {"partial": "no"}),
    (("--source-up", "z"), {"up": "z"}, {}),
    (("--target-up", "Z", "--up", "y"), {"up": "y"}, {"up": "z"}),
    (("--source-front", "x", "--target-front", "-x"), {"front": "x"}, {"front": "-x"}),
]
"""Options, and what they change for the source and for the target."""


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sphere: Shape, torus: Shape) -> Path:
    """Two colored shapes, and everything that verbs want beside them."""
    monkeypatch.chdir(tmp_path)
    for name, shape in (("a.ply", sphere), ("b.ply", torus)):
        save_shape(name, Shape(shape.verts, shape.faces, name, np.full((shape.V, 4), 0.5)))
    Path("labels.txt").write_text("1\n" * sphere.V)
    Path("weights.json").write_text(json.dumps({"weights": [[1.0]] * sphere.V}))
    Path("points.txt").write_text("0\n5\n")
    Path("pairs.txt").write_text("0 10\n5 11\n")
    return tmp_path


@pytest.mark.parametrize("verb", PAIR)
def test_shared_options_reach_the_matching(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    output, *rest = PAIR[verb]
    for words, source, target in SHARED:
        answer = run(verb, "a.ply", "b.ply", "-o", output, *rest, *words)
        assert answer.status == 0, answer.err
        assert stub.called["config"] == (FitConfig(**source), FitConfig(**target)), words
        assert (stub.called["landmarks"], stub.called["threads"]) == (None, 2)
    pairs = "--pairs" if verb == "transfer-landmarks" else "--landmarks"
    more = (pairs, "pairs.txt", "--threads", "3", "--model", "./model")
    (files / "model").mkdir()
    assert run(verb, "a.ply", "b.ply", "-o", output, *rest, *more).status == 0
    assert [list(side) for side in stub.called["landmarks"]] == [[0, 5], [10, 11]]
    assert (stub.called["threads"], stub.called["model"]) == (3, "./model")


@pytest.mark.parametrize("verb", PAIR)
def test_axes_along_one_line_are_refused(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    output, *rest = PAIR[verb]
    answer = run(verb, "a.ply", "b.ply", "-o", output, *rest, "--up", "y", "--target-front", "-y")
    assert (answer.status, stub.called) == (1, {})
    assert "up (y) and front (-y) lie along one axis" in answer.err


@pytest.mark.parametrize("verb", [verb for verb in PAIR if verb != "match"])
def test_a_map_leaves_nothing_to_match(run: Run, files: Path, stub: FakeMatching, verb: str) -> None:
    output, *rest = PAIR[verb]
    save_map("ab.npz", nearest_map(load_shape("a.ply"), load_shape("b.ply")))
    for words in (("--partial",), ("--source-up", "y"), ("--target-front", "x")):
        answer = run(verb, "a.ply", "b.ply", "-o", output, *rest, "--map", "ab.npz", *words)
        assert answer.status == 1
        assert f"{words[0]} controls matching" in answer.err
    assert stub.called == {}


@pytest.mark.parametrize(("words", "source", "target"), SHARED[:9])
def test_register_hands_options_on(
    run: Run, files: Path, stub: FakeMatching, words: tuple[str, ...], source: dict[str, Any], target: object
) -> None:
    assert run("register", "a.ply", "-o", "fitted.ply", *words).status == 0
    assert stub.called["config"] == FitConfig(**source)


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
    assert answer.err.startswith("error: the map is poor, nothing was written: it lies elsewhere")
    assert not Path("out.glb").exists()
    assert run(*words).status == 0
