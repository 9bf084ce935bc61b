"""Questions of several threads that are answered together.

Work on many things at once, such as fits of many shapes, asks the same costly function again and again about a little: a
network about a few clouds, say, whose weights are read from memory each time. Tasks of a `Gathering` wait for
one another with what they ask, and one of them answers for all. Nothing else of their work has to know, but that who holds
a lock has to ask alone (`asking_alone`): others may need it before they ask.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from meshmatch.threads import lent_slot, worker_slot

Question = TypeVar("Question")
Answer = TypeVar("Answer")
_PATIENCE = 0.5  # seconds that a question waits for others at most: another task may be long at something else

_of_thread = threading.local()


@dataclass(frozen=True, eq=False)
class _Asked:
    answer: Callable[[Sequence[Any]], Sequence[Any]]
    question: Any
    found: Future[Any] = field(default_factory=Future)


class Gathering:
    """Tasks of so many ``threads`` that ask ``together``, so many at a time.

    A task that asks waits, and its thread is free for another task meanwhile: so many more are in progress than there are
    threads. Questions are answered when enough of them wait, or all tasks that are left, and at the latest after half a
    second. No task waits where there are no more tasks than threads.
    """

    def __init__(self, tasks: int, threads: int, together: int = 1) -> None:
        self._enough = together if tasks > threads else 1
        self.in_progress = min(tasks, threads + together) if self._enough > 1 else threads
        self._left = tasks
        self.slots = threading.Semaphore(threads)
        self._waiting: list[_Asked] = []
        self._changed = threading.Condition()

    @contextmanager
    def task(self) -> Iterator[None]:
        """One of the tasks; it waits for a free thread first."""
        try:
            with worker_slot(self.slots):
                yield
        finally:
            with self._changed:
                self._left -= 1
                self._changed.notify_all()  # perhaps all that are left wait

    @contextmanager
    def together(self) -> Iterator[None]:
        """What this thread asks by `gathered` in the block, inside its `task`, it asks together with other tasks."""
        with _asking_in(self if self._enough > 1 else None):
            yield

    def ask(self, answer: Callable[[Sequence[Question]], Sequence[Answer]], question: Question) -> Answer:
        """The answer to one question, by a function of several; what that raises, all hear who asked together."""
        mine, patient = _Asked(answer, question), True
        with self._changed:
            self._waiting.append(mine)
        while not mine.found.done():
            with self._changed:
                taken: list[_Asked] = []
                if mine in self._waiting and (self._due or not patient):
                    taken, self._waiting = self._waiting, []
            if taken:
                self._answer(taken)
            else:
                with lent_slot(), self._changed:
                    patient = self._changed.wait_for(
                        lambda: mine.found.done() or (mine in self._waiting and self._due), _PATIENCE
                    )
        found: Answer = mine.found.result()
        return found

    @property
    def _due(self) -> bool:
        return len(self._waiting) >= min(self._enough, self._left)

    def _answer(self, taken: Sequence[_Asked]) -> None:
        for answer in dict.fromkeys(each.answer for each in taken):
            asked = [each for each in taken if each.answer == answer]
            try:
                found = answer([each.question for each in asked])
            except BaseException as error:
                for each in asked:
                    each.found.set_exception(error)
            else:
                for each, value in zip(asked, found, strict=True):
                    each.found.set_result(value)
        with self._changed:
            self._changed.notify_all()


def gathered(answer: Callable[[Sequence[Question]], Sequence[Answer]], question: Question) -> Answer:
    """The answer to a question by a function of several: together with others', in the block of `Gathering.together`."""
    gathering: Gathering | None = getattr(_of_thread, "gathering", None)
    return answer([question])[0] if gathering is None else gathering.ask(answer, question)


@contextmanager
def asking_alone() -> Iterator[None]:
    """What this thread asks in the block, it asks without others."""
    with _asking_in(None):
        yield


@contextmanager
def _asking_in(gathering: Gathering | None) -> Iterator[None]:
    before, _of_thread.gathering = getattr(_of_thread, "gathering", None), gathering
    try:
        yield
    finally:
        _of_thread.gathering = before
