"""What depends on a model alone is computed once, and dies with the model."""

import gc
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from meshmatch.models.trained import TrainedModel, once_per_model
from tests.fitting.eggs import egg_model


def test_two_threads_that_ask_at_the_same_time_share_one_result() -> None:
    model, calls = egg_model(), []
    together = threading.Barrier(2)

    @once_per_model
    def slow(model: TrainedModel) -> object:
        calls.append(model)
        time.sleep(0.05)
        return object()

    def ask(_: int) -> object:
        together.wait()
        return slow(model)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(ask, range(2))
    assert first is second is slow(model)
    assert calls == [model]


def test_each_model_and_each_argument_has_its_own_result() -> None:
    @once_per_model
    def counted(model: TrainedModel, count: int) -> list[int]:
        return [count]

    model = egg_model()
    other = replace(model, card=model.card)
    assert counted(model, 1) is counted(model, 1)
    assert counted(model, 1) is not counted(other, 1)
    assert counted(model, 2) == [2]


def test_one_result_may_need_another() -> None:
    @once_per_model
    def inner(model: TrainedModel) -> str:
        return model.card.name

    @once_per_model
    def outer(model: TrainedModel) -> str:
        return inner(model) + "!"

    assert outer(egg_model()) == "egg!"


def test_results_do_not_keep_a_model_alive() -> None:
    @once_per_model
    def holder(model: TrainedModel) -> tuple[TrainedModel]:
        return (model,)

    model = egg_model()
    holder(model)
    gone = weakref.ref(model)
    del model
    gc.collect()
    assert gone() is None
