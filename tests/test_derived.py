"""What is derived from an object is computed once, and dies with the object."""

import gc
import pickle
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

from meshmatch.derived import derived, store_derived
from meshmatch.shapes.shape import Shape


def copy_of(shape: Shape) -> Shape:
    return Shape(shape.verts, shape.faces)


def test_two_threads_that_ask_at_the_same_time_share_one_result(cube: Shape) -> None:
    calls, together = [], threading.Barrier(2)

    @derived
    def slow(shape: Shape) -> object:
        calls.append(shape)
        time.sleep(0.05)
        return object()

    def ask(_: int) -> object:
        together.wait()
        return slow(cube)

    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(ask, range(2))
    assert first is second is slow(cube)
    assert calls == [cube]


def test_each_object_each_function_and_each_argument_has_its_own_result(cube: Shape) -> None:
    @derived
    def counted(shape: Shape, count: int) -> list[int]:
        return [count]

    @derived
    def doubled(shape: Shape, count: int) -> list[int]:
        return 2 * counted(shape, count)  # one may need another

    assert counted(cube, 1) is counted(cube, 1)
    assert counted(cube, 1) is not counted(copy_of(cube), 1)
    assert counted(cube, 2) == [2] and doubled(cube, 2) == [2, 2]


def test_what_is_known_is_not_computed(cube: Shape) -> None:
    @derived
    def never(shape: Shape) -> int:
        raise AssertionError

    store_derived(never, own := copy_of(cube), 3)
    assert never(own) == 3


def test_results_neither_keep_an_object_alive_nor_travel_with_it(cube: Shape) -> None:
    @derived
    def holder(shape: Shape) -> tuple[Shape, threading.Lock]:
        return shape, threading.Lock()

    shape = copy_of(cube)
    holder(shape)
    pickle.dumps(shape)
    gone = weakref.ref(shape)
    del shape
    gc.collect()
    assert gone() is None
