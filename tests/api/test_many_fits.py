"""Many fits at once: each is the one that its shape has alone, whatever is fitted beside it."""

import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.api import matcher as matching
from meshmatch.api.matcher import Matcher
from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.models.inference import NodeNetwork
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template
from tests.conftest import some_fit

QUICK = FitConfig.quick(samples=1000, coarse_samples=500, partial="no")


@pytest.fixture(scope="module")
def shapes() -> list[Shape]:
    """The resting template, turned and stretched in five ways; a cloud among them."""
    human = read_template("human-T").shape
    verts, faces, rng = human.verts, human.faces, np.random.default_rng(0)
    made = []
    for number, turn in enumerate(Rotation.random(5, rng=rng).as_matrix()):
        stretched = verts * (1 + 0.1 * rng.standard_normal(3))
        made.append(Shape(stretched @ turn.T, faces if number != 3 else faces[:0], f"person {number}"))
    return made


def same(one: Fit | MeshmatchError, other: Fit | MeshmatchError) -> bool:
    """Whether two fits are the same, bit for bit, but for the time that they took."""
    assert isinstance(one, Fit) and isinstance(other, Fit)
    named = ("residual", "trust", "verdict", "reasons", "notes", "partial", "signs", "up", "front")
    arrays = (one.vectors, other.vectors), (one.points_in_file, other.points_in_file)
    return all(np.array_equal(*each) for each in arrays) and all(
        getattr(one, name) == getattr(other, name) for name in named
    )


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many questions the network was asked at a time."""
    sizes: list[int] = []
    plain = NodeNetwork.predict_each

    def counted(self: NodeNetwork, questions: Sequence[Any]) -> Any:
        sizes.append(len(questions))
        return plain(self, questions)

    monkeypatch.setattr(NodeNetwork, "predict_each", counted)
    return sizes


def test_a_fit_is_the_same_alone_and_among_others(shapes: list[Shape], asked: list[int]) -> None:
    matcher = Matcher("human", QUICK, threads=1)
    alone = [matcher.fit(shape) for shape in shapes]
    assert set(asked) == {1}
    for threads in (1, 2):
        matcher = Matcher("human", QUICK, threads=threads)
        asked.clear()
        assert all(map(same, matcher.fit_all(shapes), alone))
        assert max(asked) == len(shapes)
    some = [shapes[k] for k in (4, 0, 3)]
    found = matcher.fit_all(some, errors="return")
    assert all(map(same, found, [alone[k] for k in (4, 0, 3)]))


def test_two_shapes_with_a_thread_each_do_not_wait_for_one_another(shapes: list[Shape], asked: list[int]) -> None:
    Matcher("human", replace(QUICK, refine="none"), threads=2).match(shapes[0], shapes[1])
    assert set(asked) == {1}


def test_a_fit_that_fails_takes_no_other_with_it(
    shapes: list[Shape], asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    matcher, plain = Matcher("human", QUICK, threads=1), Fitter.fit
    alone = [matcher.fit(shapes[k]) for k in (0, 2)]

    def failing(self: Fitter, shape: Shape, landmarks: Any = None) -> Fit:
        def report(stage: str, name: str, share: float) -> None:
            if name == "person 1" and stage == "refinement":
                raise OptionError("bad")

        return plain(Fitter(self.model, self.config, report), shape)

    monkeypatch.setattr(Fitter, "fit", failing)
    asked.clear()
    found = matcher.fit_all(shapes[:3], errors="return")
    assert max(asked) == 3
    assert isinstance(found[1], OptionError) and same(found[0], alone[0]) and same(found[2], alone[1])
    with pytest.raises(OptionError, match=r"^bad$"):
        matcher.fit_all(shapes[:3])


def test_an_interrupt_ends_fits_that_wait_for_one_another(shapes: list[Shape], monkeypatch: pytest.MonkeyPatch) -> None:
    began, ended = threading.Event(), []
    plain = NodeNetwork.predict_each

    def slow(self: NodeNetwork, questions: Sequence[Any]) -> Any:
        began.set()
        return plain(self, questions)

    def watched(self: Fitter, shape: Shape, landmarks: Any = None) -> Fit:
        try:
            return fit(self, shape)
        except BaseException as error:
            ended.append(type(error).__name__)
            raise

    def interrupted(*_: object, **__: object) -> None:
        assert began.wait(20)
        raise KeyboardInterrupt

    fit = Fitter.fit
    matcher = Matcher("human", QUICK, threads=1)
    monkeypatch.setattr(NodeNetwork, "predict_each", slow)
    monkeypatch.setattr(Fitter, "fit", watched)
    monkeypatch.setattr("concurrent.futures.wait", interrupted)
    with pytest.raises(KeyboardInterrupt):
        matcher.fit_all(shapes[:3])
    assert ended and set(ended) == {"CancelledError"}


@pytest.mark.parametrize(("small", "most"), [(10_000, 4), (10, 2)])
@pytest.mark.parametrize("errors", ["raise", "return"])
def test_so_many_shapes_are_in_progress_and_of_large_ones_one_for_each_thread(
    shapes: list[Shape], monkeypatch: pytest.MonkeyPatch, small: int, most: int, errors: Any
) -> None:
    lock, seen, network = threading.Lock(), [0, 0], Matcher("human").model.inference
    cloud = shapes[0].verts[:50]

    def fit(self: Fitter, shape: Shape, landmarks: Any = None) -> Fit:
        with lock:
            seen[0] += 1
            seen[1] = max(seen)
        for _ in range(3):
            network.predict([cloud])
        with lock:
            seen[0] -= 1
        return some_fit(shape.verts, shape.faces)

    monkeypatch.setattr(Fitter, "fit", fit)
    monkeypatch.setattr(matching, "_BATCH_SIZE", 2)
    monkeypatch.setattr(matching, "_MAX_BATCHED_VERTICES", small)
    many = [replace(shapes[0], name=str(number)) for number in range(12)]
    found = Matcher("human", QUICK, threads=2).fit_all(many, errors=errors)
    assert [fit.repaired.shape.name for fit in found] == [shape.name for shape in many]
    assert seen == [0, most]
