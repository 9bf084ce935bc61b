"""Damaged files read one after the other, in a process that may not take more time or memory than the product promises."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import unicodedata
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import IO

import numpy as np

from meshmatch.errors import LONGEST, MeshmatchError, MeshmatchWarning, visible
from meshmatch.experiments.hostile.damage import damaged
from meshmatch.experiments.hostile.learned import sign, trainers
from meshmatch.experiments.hostile.readers import BadMessage, readers
from meshmatch.experiments.hostile.samples import Sample, small_shape
from meshmatch.shapes.shape import Shape

KINDS = ("traceback", "crash", "time", "memory", "printed", "message")
"""What can fail: another exception than ours, the end of the process, more than `SECONDS` of the processor, more memory than
four times the file and a gigabyte, something printed that is no message, a message that is long or commands a terminal."""
SECONDS = 20.0
BATCH = 200  # inputs of one process
# With hashes that whoever damages a file on purpose would write too.
_SIGNED = ("models", "implicit models", "templates")
_NAMES: tuple[Callable[[str], str], ...] = (
    *(str.swapcase, str.upper, lambda name: name.replace(" ", "%20"), lambda name: f"textures\\{name}"),
    *(partial(unicodedata.normalize, form) for form in ("NFC", "NFD")),
)  # what a file beside another may be called on its way through other systems
_PATIENCE = 300.0  # seconds by the clock, for what sleeps, or hears no signal
_ROOM = 1 << 30


@dataclass(frozen=True)
class Failure:
    """One input that went wrong."""

    number: int
    family: str
    kind: str
    what: str


_shape = cache(small_shape)


class _Late(BaseException):
    """The time is over; no `except Exception` may swallow it."""


def make_input(samples: Sequence[Sample], seed: int, number: int, folder: Path) -> tuple[Sample, Path]:
    """Put a damaged sample into a folder; the same for the same seed and number. Families take turns."""
    rng = np.random.default_rng([seed, number])
    families = list(dict.fromkeys(sample.family for sample in samples))
    family = families[number % len(families)]
    ours = [sample for sample in samples if sample.family == family]
    sample, other = (ours[int(rng.integers(len(ours)))] for _ in range(2))
    for name in sample.files:
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(sample.folder / name, folder / name)
    chosen = sample.files[0] if rng.random() < 0.8 else sample.files[int(rng.integers(len(sample.files)))]
    data = (sample.folder / chosen).read_bytes()
    (folder / chosen).write_bytes(damaged(data, (other.folder / other.files[0]).read_bytes(), rng))
    if family in _SIGNED and rng.random() < 0.5:
        sign(folder)
    if family == "shapes" and len(sample.files) > 1 and rng.random() < 0.3:
        other_name = str(rng.choice(sample.files[1:]))
        rename = _NAMES[int(rng.integers(len(_NAMES)))]
        os.replace(folder / other_name, folder / rename(other_name))
    return sample, folder / sample.files[0]


def judge(family: str, path: Path, shape: Shape, printed: IO[bytes]) -> tuple[str, str]:
    """Kind and words of what goes wrong with an input; empty where nothing does."""
    for read in readers(family, path, shape):
        kind, what = "", ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.simplefilter("ignore", MeshmatchWarning)  # words for the user
                read()
        except MeshmatchError as error:
            if "allocate" in error.message:
                kind, what = "memory", error.message
            elif max(len(error.message), len(error.hint)) > LONGEST or visible(error.message) != error.message:
                kind, what = "message", error.message
        except BadMessage as error:
            kind, what = "message", str(error)
        except MemoryError:
            kind, what = "memory", traceback.format_exc()
        except _Late:
            kind, what = "time", traceback.format_exc()
        except Exception:
            kind, what = "traceback", traceback.format_exc()
        sys.stderr.flush()
        if not kind and printed.seek(0, os.SEEK_END):
            printed.seek(0)
            kind, what = "printed", printed.read().decode(errors="replace")
        if kind:
            return kind, what
    return "", ""


def run_batch(samples: Sequence[Sample], seed: int, numbers: range, keep: Path) -> list[Failure]:
    """Judge the inputs of some numbers; each failure is kept as a folder with the file and what it said."""
    failures: list[Failure] = []
    left = numbers
    _shape(), trainers()  # once, for all processes forked from this one
    while left:
        ready, say = os.pipe()
        child = os.fork()
        if not child:
            status = 1
            try:
                os.close(ready)
                with os.fdopen(say, "w") as out:
                    _work(samples, seed, left, out)
                status = 0
            finally:
                os._exit(status)  # nothing of this process's is cleaned up by its copy
        os.close(say)
        at, found = _listen(ready, child, left.start)
        failures += found
        left = range(at + 1, left.stop)
    for failure in failures:
        place = keep / f"{failure.kind}-{failure.family}-{failure.number}"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        make_input(samples, seed, failure.number, place)
        (place / "what.txt").write_text(failure.what, encoding="utf-8", errors="replace")
    return failures


def _listen(ready: int, child: int, first: int) -> tuple[int, list[Failure]]:
    """What a worker says of each number; a worker that ends early has failed at the number after its last."""
    import select

    found, at, family, text = [], first - 1, "", b""
    late = False
    while True:
        heard, _, _ = select.select([ready], [], [], _PATIENCE)
        late = not heard
        more = b"" if late else os.read(ready, 1 << 16)
        if not more:
            break
        text += more
        *lines, text = text.split(b"\n")
        for line in lines:
            record = json.loads(line)
            if "begun" in record:
                family = record["begun"]
                continue
            at, family = record["number"], "unknown"
            if record["kind"]:
                found.append(Failure(**record))
    if late:
        os.kill(child, signal.SIGKILL)
    os.close(ready)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status or late:
        at += 1
        found.append(Failure(at, family, "time" if late else "crash", f"the process ended with {status}"))
    return at, found


def _work(samples: Sequence[Sample], seed: int, numbers: range, out: IO[str]) -> None:
    """In a process of its own: read, and say of each number what went wrong."""

    def late(number: int, frame: object) -> None:
        raise _Late

    signal.signal(signal.SIGPROF, late)
    shape = _shape()
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryDirectory() as place:
        os.dup2(printed.fileno(), 2)
        sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + _ROOM, used + _ROOM))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in numbers:
            folder = Path(place, str(number))
            folder.mkdir()
            sample, path = make_input(samples, seed, number, folder)
            print(json.dumps({"begun": sample.family}), file=out, flush=True)
            kind, what = "", ""
            with suppress(_Late):
                kind, what = "time", "it took too long, and swallowed the alarm"
                signal.setitimer(signal.ITIMER_PROF, SECONDS)
                try:
                    kind, what = judge(sample.family, path, shape, printed)
                except Exception:
                    kind, what = "crash", traceback.format_exc()
                finally:
                    signal.setitimer(signal.ITIMER_PROF, 0)
            printed.seek(0)
            printed.truncate()
            print(json.dumps(asdict(Failure(number, sample.family, kind, what[-4000:]))), file=out, flush=True)
            shutil.rmtree(folder)
