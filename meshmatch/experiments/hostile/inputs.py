"""Read damaged files one after the other, in a process with limits on time and memory."""

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

from meshmatch.errors import MAX_MESSAGE_LENGTH, MeshmatchError, MeshmatchWarning, visible
from meshmatch.experiments.hostile.damage import apply_damage
from meshmatch.experiments.hostile.learned import trainers, update_hashes
from meshmatch.experiments.hostile.readers import BadMessage, readers
from meshmatch.experiments.hostile.samples import Sample, small_shape
from meshmatch.shapes.shape import Shape

KINDS = ("traceback", "crash", "time", "memory", "printed", "message")
"""Kinds of failure: an exception other than meshmatch's, a crash of the process, more than `SECONDS` of CPU time, more
memory than allowed, output that is not a message, a message that is too long or contains terminal escapes."""
SECONDS = 20.0
BATCH = 200  # inputs per process
# Files with hashes, which an attacker would adapt to the damage.
_SIGNED = ("models", "implicit models", "templates")
# Changes that other systems make to the names of accompanying files.
_NAMES: tuple[Callable[[str], str], ...] = (
    *(str.swapcase, str.upper, lambda name: name.replace(" ", "%20"), lambda name: f"textures\\{name}"),
    *(partial(unicodedata.normalize, form) for form in ("NFC", "NFD")),
)
_PATIENCE = 300.0  # seconds of wall time, against readers that sleep or ignore the signal
_MEMORY_LIMIT = 1 << 30  # bytes, in addition to the memory of the process at its start


@dataclass(frozen=True)
class Failure:
    """A failed input."""

    number: int
    family: str
    kind: str
    what: str


_shape = cache(small_shape)


class _TimeLimitExceeded(BaseException):
    """The time limit was exceeded; not an `Exception`, so that readers do not catch it."""


def make_input(samples: Sequence[Sample], seed: int, number: int, folder: Path) -> tuple[Sample, Path]:
    """Write a damaged sample into a folder, determined by seed and number; families alternate."""
    rng = np.random.default_rng([seed, number])
    families = list(dict.fromkeys(sample.family for sample in samples))
    family = families[number % len(families)]
    family_samples = [sample for sample in samples if sample.family == family]
    sample, other = (family_samples[int(rng.integers(len(family_samples)))] for _ in range(2))
    for name in sample.files:
        (folder / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(sample.folder / name, folder / name)
    chosen = sample.files[0] if rng.random() < 0.8 else sample.files[int(rng.integers(len(sample.files)))]
    data = (sample.folder / chosen).read_bytes()
    (folder / chosen).write_bytes(apply_damage(data, (other.folder / other.files[0]).read_bytes(), rng))
    if family in _SIGNED and rng.random() < 0.5:
        update_hashes(folder)
    if family == "shapes" and len(sample.files) > 1 and rng.random() < 0.3:
        other_name = str(rng.choice(sample.files[1:]))
        rename = _NAMES[int(rng.integers(len(_NAMES)))]
        os.replace(folder / other_name, folder / rename(other_name))
    return sample, folder / sample.files[0]


def judge(family: str, path: Path, shape: Shape, printed: IO[bytes]) -> tuple[str, str]:
    """Kind and description of the failure of an input; both are empty if there is none."""
    for read in readers(family, path, shape):
        kind, what = "", ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                warnings.simplefilter("ignore", MeshmatchWarning)  # meant for the user
                read()
        except MeshmatchError as error:
            if "allocate" in error.message:
                kind, what = "memory", error.message
            elif (
                max(len(error.message), len(error.hint)) > MAX_MESSAGE_LENGTH or visible(error.message) != error.message
            ):
                kind, what = "message", error.message
        except BadMessage as error:
            kind, what = "message", str(error)
        except MemoryError:
            kind, what = "memory", traceback.format_exc()
        except _TimeLimitExceeded:
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
    """Judge the inputs with the given numbers; each failure is kept in a folder, with the file and the output."""
    failures: list[Failure] = []
    remaining = numbers
    _shape(), trainers()  # built once, before processes are forked
    while remaining:
        read_end, write_end = os.pipe()
        child = os.fork()
        if not child:
            status = 1
            try:
                os.close(read_end)
                with os.fdopen(write_end, "w") as out:
                    _work(samples, seed, remaining, out)
                status = 0
            finally:
                os._exit(status)  # the forked copy must not run the cleanup of this process
        os.close(write_end)
        last, new_failures = _listen(read_end, child, remaining.start)
        failures += new_failures
        remaining = range(last + 1, remaining.stop)
    for failure in failures:
        target = keep / f"{failure.kind}-{failure.family}-{failure.number}"
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        make_input(samples, seed, failure.number, target)
        (target / "what.txt").write_text(failure.what, encoding="utf-8", errors="replace")
    return failures


def _listen(pipe: int, child: int, first: int) -> tuple[int, list[Failure]]:
    """Collect a worker's reports; return the last number and the failures.

    If the worker ends early, the number after its last report has failed.
    """
    import select

    failures, last, family, text = [], first - 1, "", b""
    timed_out = False
    while True:
        readable, _, _ = select.select([pipe], [], [], _PATIENCE)
        timed_out = not readable
        chunk = b"" if timed_out else os.read(pipe, 1 << 16)
        if not chunk:
            break
        text += chunk
        *lines, text = text.split(b"\n")
        for line in lines:
            record = json.loads(line)
            if "begun" in record:
                family = record["begun"]
                continue
            last, family = record["number"], "unknown"
            if record["kind"]:
                failures.append(Failure(**record))
    if timed_out:
        os.kill(child, signal.SIGKILL)
    os.close(pipe)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if status or timed_out:
        last += 1
        failures.append(Failure(last, family, "time" if timed_out else "crash", f"the process ended with {status}"))
    return last, failures


def _work(samples: Sequence[Sample], seed: int, numbers: range, out: IO[str]) -> None:
    """Worker process: read the inputs and report the result of each."""

    def on_alarm(number: int, frame: object) -> None:
        raise _TimeLimitExceeded

    signal.signal(signal.SIGPROF, on_alarm)
    shape = _shape()
    with tempfile.TemporaryFile() as printed, tempfile.TemporaryDirectory() as temporary:
        os.dup2(printed.fileno(), 2)
        sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + _MEMORY_LIMIT, used + _MEMORY_LIMIT))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in numbers:
            folder = Path(temporary, str(number))
            folder.mkdir()
            sample, path = make_input(samples, seed, number, folder)
            print(json.dumps({"begun": sample.family}), file=out, flush=True)
            kind, what = "", ""
            with suppress(_TimeLimitExceeded):
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
