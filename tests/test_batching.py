"""Questions of several tasks that are answered together: by whom, with what, and what cannot keep them waiting."""

import threading
import time
from collections.abc import Callable, Sequence

import pytest

from meshmatch import batching
from meshmatch.batching import CallBatcher, batched_call
from meshmatch.derived import derived
from meshmatch.threads import parallel_map


class Squares:
    """Answers with squares, and remembers how many questions it had at a time."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def __call__(self, numbers: Sequence[int]) -> list[int]:
        self.asked.append(len(numbers))
        if -1 in numbers:
            raise ValueError("minus one")
        return [number * number for number in numbers]


def run(tasks: int, threads: int, so_many: int, work: Callable[[int], object]) -> list[object]:
    """What each task of a gathering makes of its number; a `ValueError` instead where it raises one."""
    together = CallBatcher(tasks, threads, so_many)

    def one(number: int) -> object:
        with together.task(), together.together():
            try:
                return work(number)
            except ValueError as error:
                return error

    return parallel_map(one, range(tasks), threads=together.in_progress)


def test_tasks_ask_together_and_each_hears_its_own_answer() -> None:
    squares = Squares()
    found = run(8, 1, 8, lambda number: [batched_call(squares, number), batched_call(squares, number + 100)])
    assert found == [[number**2, (number + 100) ** 2] for number in range(8)]
    assert squares.asked == [8, 8]


def test_questions_wait_until_they_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batching, "_MAX_WAIT", 30.0)
    squares = Squares()
    run(8, 2, 4, lambda number: [batched_call(squares, number) for _ in range(20)])
    assert sum(squares.asked) == 160 and max(squares.asked) <= 6
    assert sum(each >= 4 for each in squares.asked) > 0.5 * len(squares.asked)  # fewer once fewer tasks are left


def test_no_more_are_in_progress_than_may_be_and_no_more_run_than_there_are_threads() -> None:
    begun, running, most = [0, 0], [0], [0, 0]
    lock = threading.Lock()

    def count(change: int) -> None:
        with lock:
            running[0] += change
            most[0] = max(most[0], running[0])
            most[1] = max(most[1], begun[0] - begun[1])

    def answer(numbers: Sequence[int]) -> Sequence[int]:
        return numbers

    def work(number: int) -> None:
        begun[0] += 1
        for _ in range(5):
            count(1)
            time.sleep(0.002)
            count(-1)
            batched_call(answer, number)
        begun[1] += 1

    run(30, 2, 4, work)
    assert most == [2, 6]


@pytest.mark.parametrize(("tasks", "threads", "so_many"), [(2, 2, 16), (1, 1, 16), (9, 3, 1)])
def test_where_there_are_threads_for_all_or_nothing_is_said_each_asks_alone(
    tasks: int, threads: int, so_many: int
) -> None:
    squares = Squares()
    assert run(tasks, threads, so_many, lambda number: batched_call(squares, number)) == [n * n for n in range(tasks)]
    assert squares.asked == [1] * tasks


def test_outside_of_a_gathering_a_question_is_asked_alone() -> None:
    squares = Squares()
    assert batched_call(squares, 7) == 49 and squares.asked == [1]


def test_an_error_is_heard_by_all_who_asked_together_and_by_nobody_later() -> None:
    squares = Squares()
    gathered_twice = run(4, 1, 4, lambda number: batched_call(squares, -1 if number == 2 else number))
    assert all(isinstance(each, ValueError) for each in gathered_twice)
    assert run(4, 1, 4, lambda number: batched_call(squares, number)) == [0, 1, 4, 9]


def test_who_asks_no_more_or_fails_keeps_nobody_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batching, "_MAX_WAIT", 90.0)
    squares = Squares()

    def work(number: int) -> int:
        if number == 0:
            raise ValueError("at once")
        return number if number == 1 else sum(batched_call(squares, number) for _ in range(number))

    began = time.monotonic()
    found = run(5, 1, 5, work)
    assert isinstance(found[0], ValueError) and found[1:] == [1, 8, 27, 64]
    assert squares.asked == [3, 3, 2, 1] and time.monotonic() - began < 60


def test_what_is_computed_once_for_all_is_asked_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first holds a lock that the others need before they can ask."""
    monkeypatch.setattr(batching, "_MAX_WAIT", 90.0)
    squares = Squares()

    class Owner:
        pass

    @derived
    def known(owner: Owner) -> int:
        return batched_call(squares, 3)

    owner, began = Owner(), time.monotonic()
    assert run(4, 2, 4, lambda number: known(owner) + batched_call(squares, number)) == [9, 10, 13, 18]
    assert squares.asked[0] == 1 and sum(squares.asked) == 5 and time.monotonic() - began < 60


def test_nobody_waits_for_long_for_one_who_is_at_something_else() -> None:
    squares, done = Squares(), threading.Event()

    def work(number: int) -> int:
        if number == 0:
            assert done.wait(20)
            return 0
        found = batched_call(squares, number)
        done.set()
        return found

    assert run(3, 2, 3, work) == [0, 1, 4]
    assert sum(squares.asked) == 2
