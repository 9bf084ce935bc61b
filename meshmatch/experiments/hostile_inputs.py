"""Damaged files read one after the other, in a process that may not take more time or memory than the product promises."""

from __future__ import annotations

import io
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import IO

import numpy as np
import torch

from meshmatch.cli.info import info
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.collection import Collection
from meshmatch.collections.fit_files import load_fit
from meshmatch.collections.map_all import load_pairs as load_names
from meshmatch.collections.registered import Registered, read_group
from meshmatch.errors import LONGEST, MeshmatchError, visible
from meshmatch.experiments.hostile_damage import damaged
from meshmatch.experiments.hostile_learned import sign, trainers
from meshmatch.experiments.hostile_samples import Sample, small_shape
from meshmatch.generators.pose_files import load_poses
from meshmatch.implicit.model import load_implicit
from meshmatch.implicit.samples import samples_of
from meshmatch.maps.files import load_map
from meshmatch.maps.table_files import load_pairs, load_points
from meshmatch.models.card import read_card
from meshmatch.models.checkpoint import load_weights as load_network
from meshmatch.models.implicit_card import IMPLICIT, read_implicit_card
from meshmatch.models.registry import TEMPLATE, verify_model
from meshmatch.shapes.appearance import ImageReader
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import find_appearance, load_coordinates
from meshmatch.templates.prepared_folder import (
    frame_of,
    has_sides,
    is_registered,
    read_landmarks,
    read_registered,
    read_samples,
)
from meshmatch.templates.template import load_template
from meshmatch.training.datasets import registered_source
from meshmatch.transfer.label_files import load_labels
from meshmatch.transfer.landmarks import load_landmarks
from meshmatch.transfer.vertex_files import load_values, load_weights

KINDS = ("traceback", "crash", "time", "memory", "printed", "message")
"""What can fail: another exception than ours, the end of the process, more than `SECONDS`, more memory than four times the
file and a gigabyte, something printed that is no message, and a message that is long or could command a terminal."""
SECONDS = 20.0
BATCH = 200  # inputs of one process
_SIGNED = (
    "models",
    "implicit models",
    "templates",
)  # with hashes that whoever damages a file on purpose would write too
_EGGS = Registered(
    np.empty((0, 0, 3)), np.empty((0, 3), np.int64), ("egg0", "egg1", "egg 2", "egg3"), None, {"egg4": "poor"}
)
_PATIENCE = 15.0  # seconds beyond, for a library that hears no signal
_ROOM = 1 << 30


@dataclass(frozen=True)
class Failure:
    """One input that went wrong."""

    number: int
    family: str
    kind: str
    what: str


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
    return sample, folder / sample.files[0]


def readers(family: str, path: Path, shape: Shape) -> Iterator[Callable[[], object]]:
    """All that the product does with a file of a family while it is read."""
    if family == "shapes":
        yield lambda: _look_at(path)
        if path.suffix in (".glb", ".gltf"):
            yield lambda: load_weights(path, load_shape(path))
    simple: dict[str, tuple[Callable[[], object], ...]] = {
        "maps": (lambda: load_map(path), lambda: load_map(path, shape, shape)),
        "tables": (lambda: load_values(path, shape),),
        "lists": (lambda: load_pairs(path), lambda: load_points(path)),
        "known points": (lambda: read_landmarks(path, repair(shape)),),
        "names": (lambda: read_group(path, _EGGS) if path.stem == "group" else load_names(path),),
        "poses": (lambda: load_poses(path),),
        "samples": (lambda: samples_of(path, 64, np.random.default_rng(0)),),
        "fits": (lambda: Collection(path.parents[1], 1).atlas(poor=True), lambda: _map_all(path)),
        "atlases": (lambda: _look_at_atlas(path),),
        "prepared": tuple(partial(read, path.parent) for read in (_learn_from, is_registered, frame_of, has_sides)),
        "checkpoints": (lambda: trainers()[path.stem == "chair"].load(path),),
        "models": (lambda: verify_model(path.parent),),
        "implicit models": (lambda: verify_model(path.parent), lambda: load_implicit(path.parent)),
        "labels": (lambda: load_labels(path, shape, "vertices"), lambda: load_labels(path, shape)),
        "weights": (lambda: load_weights(path, shape),),
        "landmarks": (lambda: load_landmarks(path, shape),),
        "images": (lambda: ImageReader().decode(path.read_bytes(), path.name),),
        "safetensors": (lambda: load_network(path, {"a.weight": (4, 70), "a.bias": (4,)}),),
        "templates": (lambda: load_template(path),),
        "cards": (lambda: read_implicit_card(path.parent) if path.name == IMPLICIT else read_card(path),),
    }
    yield from simple.get(family, ())
    if family in ("shapes", "maps", "templates"):
        yield lambda: _info(path)


def _look_at(path: Path) -> None:
    shape = load_shape(path)
    found = []
    for look in (find_appearance, load_coordinates):
        try:
            found.append(look(path, shape))
        except MeshmatchError as error:
            _check(error.message, error.hint)


def _map_all(path: Path) -> None:
    fits = path.parents[1]
    if path.parent.name == "alone":
        load_fit(path, load_template(fits / TEMPLATE))
    Collection(fits, 1).save_maps(fits / "maps")


def _look_at_atlas(path: Path) -> None:
    atlas = Atlas.load(path)
    atlas.sample(1)
    atlas.project(atlas.mean)
    _check(*atlas.names)


def _learn_from(folder: Path) -> None:
    """Draw shapes of a prepared folder, as a training does."""
    template = load_template(folder / TEMPLATE)
    read_samples(folder, template)
    registered_source(torch.from_numpy(read_registered(folder, template)))(2, torch.Generator().manual_seed(0))


def _info(path: Path) -> None:
    """What the verb says is judged, and kept from where failures are looked for."""
    out = io.StringIO()
    with redirect_stdout(out):
        info(path, False)
    _check(*out.getvalue().splitlines())


class _BadMessage(Exception):
    """Words that are too long, or that could command a terminal."""


def _check(*lines: str) -> None:
    for line in lines:
        if visible(line) != line or "\n" in line:
            raise _BadMessage(line)


def judge(family: str, path: Path, shape: Shape, printed: IO[bytes]) -> tuple[str, str]:
    """Kind and words of what goes wrong with an input; empty where nothing does."""
    for read in readers(family, path, shape):
        kind, what = "", ""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("always")
                read()
        except MeshmatchError as error:
            if "allocate" in error.message:
                kind, what = "memory", error.message
            elif max(len(error.message), len(error.hint)) > LONGEST or visible(error.message) != error.message:
                kind, what = "message", error.message
        except _BadMessage as error:
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
        _keep(samples, seed, failure, keep)
    return failures


@cache
def _shape() -> Shape:
    return small_shape()


def _listen(ready: int, child: int, first: int) -> tuple[int, list[Failure]]:
    """What a worker says of each number; a worker that ends early has failed at the number after its last."""
    import select

    found, at, family, text = [], first - 1, "", b""
    late = False
    while True:
        heard, _, _ = select.select([ready], [], [], SECONDS + _PATIENCE)
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

    signal.signal(signal.SIGALRM, late)
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
            with suppress(_Late), _alarm(SECONDS):
                kind, what = "time", "it took too long, and swallowed the alarm"
                try:
                    kind, what = judge(sample.family, path, shape, printed)
                except Exception:
                    kind, what = "crash", traceback.format_exc()
            printed.seek(0)
            printed.truncate()
            print(json.dumps(asdict(Failure(number, sample.family, kind, what[-4000:]))), file=out, flush=True)
            shutil.rmtree(folder)


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)


def _keep(samples: Sequence[Sample], seed: int, failure: Failure, keep: Path) -> None:
    folder = keep / f"{failure.kind}-{failure.family}-{failure.number}"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    make_input(samples, seed, failure.number, folder)
    (folder / "what.txt").write_text(failure.what, encoding="utf-8", errors="replace")
