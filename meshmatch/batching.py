"""Batching of calls from several threads into one.

Concurrent tasks, such as fits of many shapes, often call the same costly function with little input each: a network for
a few clouds, say, whose weights are read from memory every time. Tasks of a `CallBatcher` wait for one another with such
calls, and one of them answers the whole batch. Callers need not know about it, with one exception: a thread that holds
a lock has to call unbatched (`unbatched`), because others may need the lock before they join the batch.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from meshmatch.threads import released_slot, worker_slot

Question = TypeVar("Question")
Answer = TypeVar("Answer")
_MAX_WAIT = 0.5  # maximum wait for a full batch, in seconds: another task may be busy with something else

_thread_state = threading.local()


@dataclass(frozen=True, eq=False)
class _Call:
    """A pending call."""

    answer: Callable[[Sequence[Any]], Sequence[Any]]
    question: Any
    result: Future[Any] = field(default_factory=Future)


class CallBatcher:
    """Batches the calls of ``tasks`` tasks that share ``threads`` threads, ``together`` calls at a time.

    A task that waits for a batch releases its thread to another task, so more tasks are in progress than there are
    threads. A batch is run once it is full, or every remaining task waits, and after half a second at the latest.
    Nothing is batched if there are no more tasks than threads.
    """

    def __init__(self, tasks: int, threads: int, together: int = 1) -> None:
        self._batch_size = together if tasks > threads else 1
        self.in_progress = min(tasks, threads + together) if self._batch_size > 1 else threads
        self._n_left = tasks
        self.slots = threading.Semaphore(threads)
        self._waiting: list[_Call] = []
        self._changed = threading.Condition()

    @contextmanager
    def task(self) -> Iterator[None]:
        """Run the block as one of the tasks; waits for a free thread first."""
        try:
            with worker_slot(self.slots):
                yield
        finally:
            with self._changed:
                self._n_left -= 1
                self._changed.notify_all()  # every remaining task may be waiting now

    @contextmanager
    def together(self) -> Iterator[None]:
        """Batch the calls by `batched_call` that this thread makes in the block, inside its `task`."""
        with _use_gathering(self if self._batch_size > 1 else None):
            yield

    def ask(self, answer: Callable[[Sequence[Question]], Sequence[Answer]], question: Question) -> Answer:
        """The answer to one question, from a function that answers several.

        An error in the function is raised in every caller of the batch.
        """
        own, notified = _Call(answer, question), True
        with self._changed:
            self._waiting.append(own)
        while not own.result.done():
            with self._changed:
                batch: list[_Call] = []
                if own in self._waiting and (self._is_due or not notified):
                    batch, self._waiting = self._waiting, []
            if batch:
                self._run_batch(batch)
            else:
                with released_slot(), self._changed:
                    notified = self._changed.wait_for(
                        lambda: own.result.done() or (own in self._waiting and self._is_due), _MAX_WAIT
                    )
        result: Answer = own.result.result()
        return result

    @property
    def _is_due(self) -> bool:
        """Whether the waiting calls make up a batch."""
        return len(self._waiting) >= min(self._batch_size, self._n_left)

    def _run_batch(self, batch: Sequence[_Call]) -> None:
        """Answer the calls of a batch, grouped by function, and wake their callers."""
        for answer in dict.fromkeys(each.answer for each in batch):
            calls = [each for each in batch if each.answer == answer]
            try:
                answers = answer([each.question for each in calls])
            except BaseException as error:
                for each in calls:
                    each.result.set_exception(error)
            else:
                for each, value in zip(calls, answers, strict=True):
                    each.result.set_result(value)
        with self._changed:
            self._changed.notify_all()


def batched_call(answer: Callable[[Sequence[Question]], Sequence[Answer]], question: Question) -> Answer:
    """The answer to one question, from a function that answers several.

    Calls are batched inside `CallBatcher.together`, and made alone outside.
    """
    gathering: CallBatcher | None = getattr(_thread_state, "gathering", None)
    return answer([question])[0] if gathering is None else gathering.ask(answer, question)


@contextmanager
def unbatched() -> Iterator[None]:
    """Do not batch the calls that this thread makes in the block."""
    with _use_gathering(None):
        yield


@contextmanager
def _use_gathering(gathering: CallBatcher | None) -> Iterator[None]:
    before, _thread_state.gathering = getattr(_thread_state, "gathering", None), gathering
    try:
        yield
    finally:
        _thread_state.gathering = before
