"""Models, matchers and results in other processes."""

import copy
import multiprocessing
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.api.matcher import Matcher
from meshmatch.api.results import MatchResult
from meshmatch.collections.collection import Collection
from meshmatch.errors import ModelError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.models.registry import load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import bent_egg, egg_model, write_model

QUICK = FitConfig(samples=1000, coarse_samples=300, copies=4, hypotheses=1, variants=2, finalists=1, screening=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_model(egg_model(), tmp_path_factory.mktemp("models") / "egg")


@pytest.fixture(scope="module")
def matcher(folder: Path) -> Matcher:
    return Matcher(folder, QUICK, threads=1, progress=lambda stage, name, share: None)


@pytest.fixture(scope="module")
def eggs(matcher: Matcher) -> tuple[Shape, Shape]:
    return bent_egg(matcher.model, 1), bent_egg(matcher.model, 2)


@pytest.fixture(scope="module")
def result(matcher: Matcher, eggs: tuple[Shape, Shape]) -> MatchResult:
    return matcher.match(*eggs)


def again(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))


def points_of(matcher: Matcher, shape: Shape) -> np.ndarray:
    return matcher.fit(shape).points


def test_a_matcher_that_has_fitted_comes_back_and_fits_alike(
    matcher: Matcher, eggs: tuple[Shape, Shape], result: MatchResult
) -> None:
    assert len(pickle.dumps(matcher)) < 20_000  # the weights stay where they are
    back = again(matcher)
    assert np.array_equal(back.match(*eggs).map.index, result.map.index)
    assert back.model is again(matcher).model  # loaded once in a process
    assert back.config == matcher.config and back.progress is None and matcher.progress is not None


def test_a_loaded_model_is_loaded_again_and_must_be_the_same(folder: Path, tmp_path: Path) -> None:
    own = write_model(egg_model(), tmp_path / "own")
    model = load_model(own)
    model.network  # noqa: B018  (what is derived stays behind)
    data = pickle.dumps(model)
    assert pickle.loads(data).card == model.card
    card = (own / "card.json").read_text()
    (own / "card.json").write_text(card.replace('"eggs"', '"other eggs"'))
    os.utime(own / "weights.safetensors", (1, 1))  # looked at again
    with pytest.raises(ModelError, match="not the one that was pickled") as caught:
        pickle.loads(data)
    assert "models add" in caught.value.hint
    (own / "card.json").unlink()
    os.utime(own / "weights.safetensors", (2, 2))
    with pytest.raises(ModelError, match="cannot be loaded here") as caught:
        pickle.loads(data)
    assert caught.value.hint


def test_the_arrays_of_a_model_in_memory_travel(eggs: tuple[Shape, Shape]) -> None:
    model = egg_model()
    for back in (again(model), again(replace(model, card=model.card)), copy.deepcopy(model)):
        assert back.card == model.card and back.template.hash == model.template.hash
        clouds = [np.asarray(shape.verts) for shape in eggs]
        assert np.array_equal(back.inference.predict(clouds), model.inference.predict(clouds))


def test_results_come_back_bit_for_bit_and_read_only(matcher: Matcher, result: MatchResult) -> None:
    back = again(result)
    for name in ("index", "face", "barycentric", "confidence"):
        before, after = getattr(result.map, name), getattr(back.map, name)
        assert before.tobytes() == after.tobytes() and not after.flags.writeable
    assert np.array_equal(back.backward().index, result.backward().index)
    fits = [again(result.source_fit), again(result.target_fit)]
    assert np.array_equal(
        matcher.map(*fits, agree=False).index, matcher.map(result.source_fit, result.target_fit, agree=False).index
    )
    assert fits[0].reasons == result.source_fit.reasons
    assert [reason.code for reason in fits[0].reasons] == [reason.code for reason in result.source_fit.reasons]


def test_what_a_shape_derives_stays_behind(cube: Shape) -> None:
    plain = len(pickle.dumps(Shape(cube.verts, cube.faces, "cube")))
    assert cube.edges and cube.hash and cube.area
    back = again(cube)
    assert len(pickle.dumps(cube)) <= plain + 20 and back.hash == cube.hash and not back.verts.flags.writeable


def test_a_collection_comes_back_without_its_fits(tmp_path: Path) -> None:
    collection = Collection(tmp_path, workers=3, progress=lambda stage, name, share: None)
    back = again(collection)
    assert back.store == collection.store and back.workers == 3 and back.progress is None
    assert repr(back) == f"Collection({str(tmp_path)!r})"


@pytest.mark.parametrize(
    "start", ["spawn", pytest.param("fork", marks=pytest.mark.slow), pytest.param("forkserver", marks=pytest.mark.slow)]
)
def test_processes_of_every_kind_fit_alike(
    start: str, matcher: Matcher, eggs: tuple[Shape, Shape], result: MatchResult
) -> None:
    with multiprocessing.get_context(start).Pool(1) as pool:
        found = pool.apply_async(points_of, (matcher, eggs[0])).get(timeout=120)
    assert np.array_equal(found, result.before_agreement[0].points)


class Points:
    """A data set whose items are fits."""

    def __init__(self, matcher: Matcher, shapes: tuple[Shape, ...]) -> None:
        self.matcher, self.shapes = matcher, shapes

    def __len__(self) -> int:
        return len(self.shapes)

    def __getitem__(self, number: int) -> np.ndarray:
        return points_of(self.matcher, self.shapes[number])


@pytest.mark.slow
def test_a_data_loader_fits_in_its_workers(matcher: Matcher, eggs: tuple[Shape, Shape], result: MatchResult) -> None:
    from torch.utils.data import DataLoader

    data: Any = Points(matcher, eggs)
    loader = DataLoader(data, batch_size=2, num_workers=1, multiprocessing_context="spawn", timeout=120)
    (batch,) = loader
    assert np.array_equal(batch.numpy(), [fit.points for fit in result.before_agreement])


@pytest.mark.slow
def test_joblib_fits_in_its_workers(matcher: Matcher, eggs: tuple[Shape, Shape], result: MatchResult) -> None:
    joblib = pytest.importorskip("joblib")
    found = joblib.Parallel(n_jobs=2)(joblib.delayed(points_of)(matcher, shape) for shape in eggs)
    assert np.array_equal(found, [fit.points for fit in result.before_agreement])


def test_the_other_process_may_lack_the_model(matcher: Matcher, folder: Path, tmp_path: Path) -> None:
    data = tmp_path / "matcher"
    data.write_bytes(pickle.dumps(matcher).replace(str(folder).encode(), str(folder).replace("egg", "gge").encode()))
    code = (
        "import pickle, sys\ntry: pickle.load(open(sys.argv[1], 'rb'))\nexcept Exception as e: print(repr(e), e.hint)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(data)], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("ModelError(") and "models add" in done.stdout


def test_values_are_shown_in_a_line(matcher: Matcher, result: MatchResult) -> None:
    values: list[Any] = [result, result.source_fit, result.map, matcher, matcher.model, matcher.model.template]
    values += [result.source_fit.frame, result.source_fit.repaired]
    for value in values:
        text = repr(value)
        assert text.startswith(type(value).__name__) and "\n" not in text and "[" not in text and len(text) < 400
    fit, model = result.source_fit, matcher.model
    assert isinstance(fit, Fit) and isinstance(model, TrainedModel)
    assert all(word in repr(fit) for word in ("egg 1", fit.verdict, fit.up, fit.front))
    assert "egg" in repr(model) and str(model.template.K) in repr(model)
    assert repr(Matcher()) == "Matcher('auto')"
