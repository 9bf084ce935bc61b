"""Arguments that are something else than what is asked for: told in a line, and not by whatever trips over them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import meshmatch
from meshmatch import Atlas, MeshmatchError, VertexMap
from meshmatch.api.inputs import checked_threads
from meshmatch.collections.workers import open_workers
from meshmatch.implicit.codes import fit_implicit
from meshmatch.implicit.model import check_resolution
from meshmatch.maps.places import Places
from meshmatch.scalars import check_seed
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import read_registered
from meshmatch.training.loop import TrainConfig
from meshmatch.training.recipes import Recipe, default
from tests.conftest import icosphere
from tests.models.small_model import small_template

BALL = icosphere(1)
SAME = VertexMap.identity(BALL)
RAGGED: Any = [[1, 2, 3], [4, 5]]


def evaluated(**how: Any) -> Any:
    return meshmatch.evaluate(SAME, BALL, BALL, **{"unit": "x100"} | how)


@pytest.mark.parametrize(("call", "words"), [
    (lambda: evaluated(truth=RAGGED), "the truth: not an array"),
    (lambda: evaluated(seed=-1), "a seed is"), (lambda: evaluated(seed=1.5), "a seed is"),
    (lambda: evaluated(unit=np.zeros(3)), "invalid unit"),
    (lambda: meshmatch.measure_distance(np.zeros((1, 3)), BALL, unit="x100"), "no surface area"),
    (lambda: meshmatch.measure_distance(np.ones((300, 3)), BALL, unit="x100"), "no surface area"),
    (lambda: VertexMap("a", "b", RAGGED), "index: not an array"), (lambda: VertexMap.identity("a.ply"), "must be a Shape"),
    (lambda: VertexMap.between(BALL, BALL, RAGGED), "index: not an array"),
    (lambda: VertexMap("a", "b", np.arange(2), confidence="x"), "confidence must be numbers"),
    (lambda: VertexMap("a", "b", np.arange(2), barycentric=RAGGED), "barycentric must be numbers"),
    (lambda: meshmatch.Errors("x"), "errors must be numbers"),
    (lambda: meshmatch.Frame("x", np.eye(3), np.zeros(3)), "scale must be numbers"),
    (lambda: meshmatch.Frame(np.ones(2), np.eye(3), np.zeros(3)), "scale must be positive"),
    (lambda: meshmatch.load_fit(None), "expected a path"), (lambda: meshmatch.Collection(None), "expected a path"),
    (lambda: Places.of(None, None), "repaired shape"),
])  # fmt: skip
def test_what_is_something_else_is_told(call: Callable[[], Any], words: str) -> None:
    with pytest.raises(MeshmatchError) as caught:
        call()
    assert words in caught.value.message


def test_the_next_frame_is_followed_from_a_fit() -> None:
    with pytest.raises(MeshmatchError, match="Shape is not a fit"):
        meshmatch.Matcher("human").follow(BALL, BALL)  # type: ignore[arg-type]


@pytest.mark.parametrize("recipe", [None, default()])
def test_shapes_to_learn_are_named(recipe: Recipe | None, tmp_path: Path) -> None:
    with pytest.raises(MeshmatchError, match="expected a path"):
        meshmatch.train(tmp_path / "model", shapes=3, recipe=recipe)  # type: ignore[arg-type]


def test_shapes_to_measure_on_are_named() -> None:
    with pytest.raises(MeshmatchError, match="expected a path"):
        read_registered(3, small_template())  # type: ignore[arg-type]


BALLS = [BALL.verts * [1, 1, axis] for axis in (1.0, 1.2, 1.3, 1.5, 1.6)]
ROW = Atlas.of(BALLS, BALL.faces)
PAIRS: Any = (ROW.names[:2], ROW.names[2:])


@pytest.mark.parametrize("call", [
    lambda: checked_threads(True), lambda: check_seed(True), lambda: ROW.sample(True), lambda: ROW.sample(2, True),
    lambda: Atlas.of(BALLS, BALL.faces, modes=True), lambda: ROW.compare(*PAIRS, permutations=True),
    lambda: ROW.compare(*PAIRS, seed=True), lambda: meshmatch.interpolate([BALL, BALL], True),
    lambda: meshmatch.InterpolationOptions(stop=True), lambda: meshmatch.ConfidenceRule(True),
    lambda: meshmatch.transfer_weights(BALL, BALL, np.ones((BALL.V, 1)), influences=True),
    lambda: meshmatch.BakeOptions(samples=True), lambda: TrainConfig(steps=True), lambda: TrainConfig(workers=True),
    lambda: TrainConfig(rate=True), lambda: TrainConfig(seed=True), lambda: NodeConfig(clusters=True),
    lambda: NodeConfig(seed=True), lambda: meshmatch.laplacian_basis(BALL, True), lambda: check_resolution(True),
    lambda: open_workers(True).__enter__(), lambda: fit_implicit(BALL, BALL, steps=True),
])  # fmt: skip
def test_a_bool_is_no_number(call: Callable[[], Any]) -> None:
    with pytest.raises(MeshmatchError, match=r"True|positive rate"):
        call()


def test_numbers_of_numpy_are_numbers() -> None:
    assert checked_threads(np.int64(3)) == 3
    assert len(ROW.sample(np.int32(2), np.uint8(1))) == 2
    assert meshmatch.BakeOptions(size=np.int16(64)).size == 64
