"""Fixtures that run the command line: arguments in; status, stdout and stderr out."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api import matching
from meshmatch.api.inputs import as_model, repair_or_raise
from meshmatch.api.results import MatchResult
from meshmatch.cli import main
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.solve.regularity import Regularity
from meshmatch.geometry.frames import Frame
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the default size of pictures small: ray casting takes seconds."""
    monkeypatch.setattr("meshmatch.render.picture.HEIGHT", 160)


@dataclass(frozen=True)
class Answer:
    status: int
    out: str
    err: str

    @property
    def record(self) -> dict[str, Any]:
        """The JSON record of a command that succeeded."""
        found: dict[str, Any] = json.loads(well(self).out)
        return found


Run = Callable[..., Answer]


def well(answer: Answer) -> Answer:
    """Assert that a command succeeded, and return its answer."""
    assert answer.status == 0, answer.err
    return answer


def refused(answer: Answer, words: str, folder: Path, before: set[str]) -> None:
    """Assert that a command failed: status 1, one line of error, at most one hint, and no new files in the folder."""
    assert answer.status == 1, answer.err
    assert [line.partition(":")[0] for line in answer.err.splitlines()] in (["error", "hint"], ["error"]), answer.err
    assert words in answer.err
    assert answer.out == ""
    assert {path.name for path in folder.iterdir()} == before


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Function that runs the program through `main`."""
    monkeypatch.delenv("MESHMATCH_DEBUG", raising=False)

    def call(*words: str | Path) -> Answer:
        capsys.readouterr()
        status = main([str(word) for word in words])
        heard = capsys.readouterr()
        return Answer(status, heard.out, heard.err)

    return call


@pytest.fixture
def two(tmp_path: Path, sphere: Shape, torus: Shape) -> tuple[Path, Path]:
    """Files of two shapes: a.ply (sphere, 642 vertices) and b.ply (torus, 1600 vertices)."""
    files = tmp_path / "a.ply", tmp_path / "b.ply"
    save_shape(files[0], sphere)
    save_shape(files[1], torus)
    return files


def fake_fit(shape: Shape, verdict: str = "good", reasons: tuple[str, ...] = (), **other: Any) -> Fit:
    """A made-up fit of a template of two triangles."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    rest: dict[str, Any] = {"frame": Frame(2.0, np.eye(3), np.array([10.0, 0, 0])), "front": "-z", "residual": 0.0123}
    rest["regularity"] = Regularity(0.001, 0.25)
    rest |= {"template_hash": "0" * 16, "model": "human", "verts": shape.verts, "verdict": verdict, "reasons": reasons}
    return some_fit(corners, np.array([[0, 1, 2], [0, 2, 3]]), seconds=1.0, **(rest | other))


def nearest_map(source: Shape, target: Shape, **about: Any) -> VertexMap:
    """A made-up map: vertex i to vertex i modulo the number of target vertices."""
    return VertexMap.between(
        source, target, np.arange(source.V) % target.V, **{"confidence": np.ones(source.V)} | about
    )


class FakeMatching:
    """Fake of the matching that records its arguments and returns made-up results at once."""

    def __init__(self) -> None:
        self.called: dict[str, Any] = {}
        self.verdict = "good"
        self.reasons: tuple[str, ...] = ()
        self.make_map: Callable[..., VertexMap] = nearest_map
        self.make_fit: Callable[..., Fit] = fake_fit

    def match(self, a: Shape, b: Shape, **options: Any) -> MatchResult:
        self.called = {"source": a.name, "target": b.name} | options
        options["progress"]("orientation", "a.ply", 0.5)
        found = self.make_map(a, b, verdict=self.verdict, reasons=self.reasons)
        fits = self.make_fit(a, self.verdict), self.make_fit(b, self.verdict)
        result = MatchResult(found, *fits, 2.5, ("a.ply: 3 faces dropped",), fits)
        object.__setattr__(result, "backward", lambda: self.make_map(b, a))
        object.__setattr__(result, "deformed_source", lambda: a)
        return result

    def fit_all(self, matcher: matching.Matcher, shapes: Any, config: Any = None) -> list[Fit]:
        (shape,) = shapes
        matcher._model = matcher._model or as_model("human")
        self.called = {"shape": shape, "config": matcher.config, "threads": matcher.threads}
        if matcher.progress is not None:
            matcher.progress("orientation", "a.ply", 0.5)
        notes = tuple(f"{shape.name}: {note}" for note in repair_or_raise(shape).notes)
        return [replace(self.make_fit(shape, self.verdict, self.reasons), notes=notes)]


@pytest.fixture
def stub(monkeypatch: pytest.MonkeyPatch) -> FakeMatching:
    fake = FakeMatching()
    monkeypatch.setattr(matching, "match", fake.match)
    monkeypatch.setattr(matching.Matcher, "fit_all", lambda *words: fake.fit_all(*words))
    return fake


@pytest.fixture
def no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail if a fit begins: errors must be reported before."""

    def begun(*_: object, **__: object) -> None:
        raise AssertionError("a fit began")

    monkeypatch.setattr(matching.Matcher, "_fit_all", begun)
