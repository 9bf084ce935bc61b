"""Fits once, maps as often as wanted; the whole road with the model that ships is in test_match.py."""

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch.api.matcher import Matcher
from meshmatch.api.results import MatchResult
from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fitter import Fitter
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.indices import corners_of
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit

SAMPLES = Path(__file__).parents[2] / "templates" / "samples"
pytestmark = pytest.mark.usefixtures("remembered_fits")


@pytest.fixture(scope="module")
def matcher() -> Matcher:
    return Matcher("human")


@pytest.fixture(scope="module")
def result(matcher: Matcher, remembered_fits: Any) -> MatchResult:
    return matcher.match(SAMPLES / "climber.ply", SAMPLES / "dancer.ply")


def test_fits_made_once_give_the_map_of_match(matcher: Matcher, result: MatchResult) -> None:
    fits = matcher.fit_all([SAMPLES / "climber.ply", SAMPLES / "dancer.ply"])
    found = matcher.map(*fits)
    assert np.array_equal(found.index, result.map.index)
    assert np.array_equal(found.confidence, result.map.confidence)
    # without agreement the map is another one, and knows less about what it got wrong
    plain = matcher.map(*fits, agree=False)
    assert 0.2 < (plain.index == found.index).mean() < 0.9
    assert plain.confidence.mean() > found.confidence.mean() + 0.01


def test_the_backward_map_doubts_what_the_forward_map_doubts(result: MatchResult) -> None:
    forward, backward = result.map.confidence, result.backward().confidence
    assert abs(float(forward.mean()) - float(backward.mean())) < 0.02
    assert 0.04 < (backward < 0.8).mean() < 0.16  # 0.026 where agreement is forgotten


def test_what_goes_there_and_back_comes_to_where_it_was(matcher: Matcher, result: MatchResult) -> None:
    """Whichever shape comes first: maps that are made each way by itself miss more of it."""
    climber, dancer = (meshmatch.load_shape(SAMPLES / name) for name in ("climber.ply", "dancer.ply"))
    fits = matcher.fit_all([dancer, climber])
    other, plain = matcher.map(*fits), matcher.map(*fits, agree=False)
    assert np.array_equal(other.points(climber), result.backward().points(climber))

    def missed(back: meshmatch.VertexMap) -> float:
        """The share of vertices that do not come within a centimetre, where the body is 1.8 m."""
        forward = result.map
        corners = corners_of(dancer.faces, forward.face, forward.index)
        again = interpolate(back.points(climber), corners, forward.barycentric)
        return float((np.linalg.norm(again - climber.verts, axis=1) > 0.007 * np.sqrt(climber.area)).mean())

    assert missed(other) < 0.03
    assert missed(plain) > 0.1


def test_fits_of_other_templates_or_without_shapes_are_refused(matcher: Matcher, result: MatchResult) -> None:
    from dataclasses import replace

    fit = result.source_fit
    with pytest.raises(OptionError, match="another template") as caught:
        matcher.map(replace(fit, template_hash="0" * 16), fit)
    assert "human" in caught.value.hint
    with pytest.raises(OptionError, match="does not contain its shape"):
        matcher.map(fit, replace(fit, repaired=None))


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch, sphere: Shape) -> Iterator[dict[str, Any]]:
    """Fits that wait for each other: the one of "bad" fails when the other has begun."""
    seen: dict[str, Any] = {"began": threading.Event(), "reports": 0, "ended": []}

    def fit(fitter: Fitter, shape: Shape) -> None:
        if shape.name == "bad":
            assert seen["began"].wait(10)
            raise OptionError("bad")
        try:
            for _ in range(1000):
                seen["reports"] += 1
                assert fitter.progress is not None
                fitter.progress("orientation", shape.name, 0.5)
                seen["began"].set()
                threading.Event().wait(0.01)
        finally:
            seen["ended"].append(shape.name)

    monkeypatch.setattr(Fitter, "fit", fit)
    yield seen


@pytest.mark.parametrize("order", [("bad", "good"), ("good", "bad")])
def test_a_failed_fit_stops_the_other(
    matcher: Matcher, fits: dict[str, Any], sphere: Shape, order: tuple[str, str]
) -> None:
    with pytest.raises(OptionError, match=r"^bad$"):
        matcher.fit_all([Shape(sphere.verts, sphere.faces, name) for name in order])
    assert fits["ended"] == ["good"]
    assert fits["reports"] < 900


def test_errors_take_the_place_of_fits(
    matcher: Matcher, monkeypatch: pytest.MonkeyPatch, sphere: Shape, tmp_path: Path
) -> None:
    def fit(self: Any, shape: Shape, landmarks: Any = None) -> Fit:
        if shape.name == "bad":
            raise OptionError("bad")
        return some_fit(shape.verts, shape.faces)

    monkeypatch.setattr(Fitter, "fit", fit)
    told: list[tuple[str, str, float]] = []
    matcher.progress = lambda *about: told.append(about)
    (tmp_path / "cut.ply").write_bytes(b"ply")
    shapes = [Shape(sphere.verts, sphere.faces, name) for name in ("one", "bad", "two")]
    found = matcher.fit_all([*shapes, tmp_path / "cut.ply", tmp_path / "none.ply", 3], errors="return")  # type: ignore[list-item]
    matcher.progress = None
    assert [type(each).__name__ for each in found] == ["Fit", "OptionError", "Fit", *["InputError"] * 3]
    assert isinstance(found[2], Fit) and found[2].repaired is not None and found[2].repaired.shape.name == "two"
    shares = [share for stage, _, share in told if stage == "shapes"]
    assert shares == pytest.approx(np.arange(1, 7) / 6)
    assert matcher.fit_all([], errors="return") == []
    for wrong in (lambda: matcher.fit_all("a.ply", errors="return"), lambda: matcher.fit_all(shapes, errors="ignore")):  # type: ignore[call-overload]
        with pytest.raises(MeshmatchError):
            wrong()


def test_an_interrupt_stops_all_fits(
    matcher: Matcher, fits: dict[str, Any], sphere: Shape, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        assert fits["began"].wait(10)
        raise KeyboardInterrupt

    monkeypatch.setattr("concurrent.futures.wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        matcher.fit_all([Shape(sphere.verts, sphere.faces, name) for name in ("one", "two")])
    assert fits["ended"] == ["one", "two"] or fits["ended"] == ["two", "one"]
    assert fits["reports"] < 1800


@pytest.mark.parametrize(
    "wrong", [3, None, object(), np.zeros(5), (np.zeros((4, 2)), np.zeros((1, 3), int)), {"vertices": 1}]
)
def test_what_is_no_shape_is_refused_in_words(wrong: Any) -> None:
    with pytest.raises(MeshmatchError) as caught:
        meshmatch.register(wrong)
    assert caught.value.hint


def test_configs_and_threads_that_do_not_fit(matcher: Matcher, sphere: Shape) -> None:
    with pytest.raises(OptionError, match="2 shapes need one FitConfig, or 2 of them, not 3"):
        matcher.match(sphere, sphere, [meshmatch.FitConfig()] * 3)
    with pytest.raises(OptionError, match="threads must be an integer from 1 to 4096"):
        Matcher("human", threads=0)
    with pytest.raises(OptionError, match="not 4097"):
        Matcher("human", threads=4097)


@pytest.mark.parametrize(
    "call",
    [
        lambda: Matcher(3),  # type: ignore[arg-type]
        lambda: Matcher(meshmatch.FitConfig()),  # type: ignore[arg-type]
        lambda: Matcher("human", threads=1.5),  # type: ignore[arg-type]
        lambda: Matcher("human", threads="2"),  # type: ignore[arg-type]
        lambda: Matcher("human", {"up": "y"}),  # type: ignore[arg-type]
        lambda: meshmatch.interpolate("a.ply"),
        lambda: meshmatch.interpolate([np.zeros((3, 3))] * 2, 2.5),  # type: ignore[arg-type]
        lambda: meshmatch.load_shape(None),  # type: ignore[arg-type]
        lambda: meshmatch.load_map(3),  # type: ignore[arg-type]
        lambda: meshmatch.load_model(None),  # type: ignore[arg-type]
        lambda: meshmatch.prepare(None, "out"),  # type: ignore[arg-type]
        lambda: meshmatch.save_shape("q.ply", 3),  # type: ignore[arg-type]
        lambda: meshmatch.save_shape(None, np.eye(3)),  # type: ignore[arg-type]
        lambda: meshmatch.save_map("q.npy", np.arange(3)),  # type: ignore[arg-type]
        lambda: meshmatch.VertexMap("a", "b", [0]).compose(np.arange(1)),  # type: ignore[arg-type]
    ],
)
def test_arguments_of_other_types(call: Any) -> None:
    with pytest.raises(MeshmatchError):
        call()


def test_matchers_refuse_other_types_with_a_hint(matcher: Matcher, sphere: Shape) -> None:
    for call in (
        lambda: matcher.fit(sphere, {"up": "y"}),  # type: ignore[arg-type]
        lambda: matcher.fit_all("a.ply"),
        lambda: matcher.fit_all((sphere.verts, sphere.faces)),
        lambda: matcher.map("a.ply", "b.ply"),  # type: ignore[arg-type]
    ):
        with pytest.raises(MeshmatchError) as caught:
            call()
        assert caught.value.hint


@pytest.mark.parametrize(
    ("landmarks", "told"),
    [
        (([0], [1], [2]), "two lists of vertices, not 3"),
        ([(0, 1), (2, 3)], "not a list of pairs"),
        (([0, 1], [0]), "in pairs"),
        (([0.5], [1]), "lists of vertex numbers"),
        (([9999], [1]), "vertex 9999 is not on"),
        (([3, 5, 3], [1, 2, 4]), "vertex 3 of .* with two of .*: 1 and 4"),
    ],
)
def test_landmarks_are_checked_before_the_shapes_are_fitted(
    matcher: Matcher, sphere: Shape, landmarks: Any, told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Matcher, "_fit_all", lambda *_: pytest.fail("fitted"))
    with pytest.raises(OptionError, match=told):
        matcher.match(sphere, sphere, landmarks=landmarks)


def test_a_landmark_needs_a_position(matcher: Matcher, sphere: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Matcher, "_fit_all", lambda *_: pytest.fail("fitted"))
    torn = Shape(sphere.verts, sphere.faces, invalid=np.arange(sphere.V) == 7)
    with pytest.raises(OptionError, match="has no position"):
        matcher.match(torn, sphere, landmarks=([3, 7], [3, 7]))


@pytest.mark.parametrize(
    "wrong",
    [{"up": "w"}, {"front": ""}, {"up": 3}, {"up": "y", "front": "-y"}, {"seed": -1}, {"seed": 1.5}, {"samples": 0}],
)
def test_a_config_is_checked_when_it_is_made(wrong: dict[str, Any]) -> None:
    with pytest.raises(OptionError) as caught:
        meshmatch.FitConfig(**wrong)
    assert caught.value.hint
