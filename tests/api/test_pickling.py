"""Models, matchers and results in other processes."""

import copy
import json
import multiprocessing
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from safetensors.numpy import load_file, save_file

from meshmatch.api.fits import load_fit, save_fit
from meshmatch.api.matcher import Matcher
from meshmatch.api.results import MatchResult, shape_of
from meshmatch.collections.collection import Collection
from meshmatch.errors import InputError, MeshmatchError, ModelError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.fit_files import read_fit_header
from meshmatch.maps.places import PlacedFit, Places
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


def test_fits_come_back_from_files(matcher: Matcher, folder: Path, result: MatchResult, tmp_path: Path) -> None:
    fits = result.before_agreement
    assert isinstance(fits[0], Fit) and isinstance(fits[1], Fit)
    left_out = replace(fits[0], left_out=(2,), notes=("about it",))
    for name, fit in (("a", left_out), ("b", fits[1])):
        save_fit(tmp_path / f"{name}.safetensors", fit)
    back = [load_fit(tmp_path / f"{name}.safetensors", folder) for name in "ab"]
    found = matcher.map(back[0], back[1])
    for name in ("index", "face", "barycentric", "confidence", "source_hash", "target_hash"):
        assert np.array_equal(getattr(found, name), getattr(result.map, name)), name
    assert back[0].left_out == (2,) and back[0].notes == ("about it",) and back[0].trust == fits[0].trust
    assert "egg 1" in repr(back[0])
    placed = PlacedFit.of(fits[1], Places.of(shape_of(fits[1]), fits[1]))
    composed = matcher.map(back[0], fits[1], agree=False)
    assert np.mean(matcher.map(back[0], placed).index == composed.index) > 0.9  # it is not laid out anew
    pool_map = again(matcher).map(again(back[0]), again(back[1]))
    assert np.array_equal(pool_map.index, found.index)


def test_files_of_fits_are_refused_in_words(folder: Path, result: MatchResult, tmp_path: Path) -> None:
    fit, path = result.source_fit, tmp_path / "a.safetensors"
    assert isinstance(fit, Fit)
    calls: list[tuple[type[MeshmatchError], str, Callable[[], object]]] = [
        (OptionError, "not a format for fits", lambda: save_fit(tmp_path / "a.npz", fit)),
        (OptionError, "without a model cannot be saved", lambda: save_fit(path, replace(fit, model="none"))),
        (InputError, "does not contain its shape", lambda: save_fit(path, replace(fit, repaired=None))),
        (InputError, "MatchResult is not a fit", lambda: save_fit(path, result)),  # type: ignore[arg-type]
        (InputError, "not a fit's file|no such file", lambda: load_fit(path)),
    ]
    for error, words, call in calls:
        with pytest.raises(error, match=words) as caught:
            call()
        assert not path.exists() and caught.value.hint
    save_fit(path, fit)
    with pytest.raises(ModelError, match="a fit of a model 'egg'"):
        load_fit(path)
    with pytest.raises(InputError, match="of another template"):
        load_fit(path, "human")
    arrays, words = load_file(path), read_fit_header(path)
    header = {"fit": json.dumps({"schema": 1, "fit": words[0], "more": words[1]})}
    damaged: dict[str, NDArray[Any]] = {
        **{"shape_verts": np.full((9, 3), np.nan), "shape_faces": np.full((4, 3), 10**6)},
        **{"rotation": 2 * np.eye(3), "center": np.full(3, np.nan)},
    }
    for name, bad in damaged.items():
        save_file(arrays | {name: bad}, path, header)
        with pytest.raises(InputError, match=r"a\.safetensors is damaged") as caught:
            load_fit(path, folder)
        assert "fit the shape again" in caught.value.hint
    del arrays["shape_verts"]
    save_file(arrays, path, header)
    with pytest.raises(InputError, match="contains neither the shape of its fit nor"):
        load_fit(path, folder)


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
