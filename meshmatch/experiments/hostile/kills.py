"""Kill commands at random moments, or run them on a full disk: afterwards the old or the new files must be there, complete,
and nothing else.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from meshmatch.cli import main as command
from meshmatch.collections.stores import LOCK
from meshmatch.errors import MeshmatchError
from meshmatch.experiments.hostile.learned import write_eggs
from meshmatch.experiments.hostile.samples import small_shape, write_small_model
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.card import IMPLICIT
from meshmatch.models.registry import HOME_VARIABLE
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder

Files = Callable[[Path], None]
Outputs = Callable[[Path], list[Path]]
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGHUP, signal.SIGINT)


@dataclass(frozen=True)
class Case:
    """A command to kill, in its own folder.

    `reset` restores the old state before each kill. `outputs` returns the digests of the output files, and `states` are the
    two allowed results: old and new. With `apart`, each file may be old or new independently. `after` is a command that
    then continues the work or cleans up. `seconds` are durations of complete runs.
    """

    name: str
    folder: Path
    words: tuple[str, ...]
    reset: Callable[[], None]
    outputs: Callable[[], dict[str, str]]
    after: tuple[str, ...] = ()
    states: list[dict[str, str]] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    apart: bool = False


@dataclass(frozen=True)
class Outcome:
    """Outcome of a kill: fine, missed (the command had finished before) or broken."""

    outcome: str
    what: str = ""


def make_cases(folder: Path, training: bool) -> list[Case]:  # noqa: C901
    """Prepare all cases, fast commands several times; each command is run to its end, to record the new state."""
    shape = small_shape()

    def case(name: str, words: str, files: Files, outputs: Outputs, after: str = "", apart: bool = False) -> Case:
        place = folder / name.replace(" ", "-")
        place.mkdir(parents=True)
        files(place)
        original = folder / f"{place.name}-kept"
        shutil.copytree(place, original)

        def reset() -> None:
            shutil.rmtree(place)
            shutil.copytree(original, place)

        def found() -> dict[str, str]:
            paths = {str(path.relative_to(place)): path for path in outputs(place) if path.is_file()}
            return {name: digest(path) for name, path in paths.items() if "/." not in f"/{name}"}

        new_case = Case(name, place, tuple(words.split()), reset, found, tuple(after.split()), apart=apart)
        new_case.states.append(found())
        for _ in range(2):  # the second run is as fast as those that are killed
            reset()
            start = time.monotonic()
            status = os.waitstatus_to_exitcode(os.waitpid(_start(new_case), 0)[1])
            new_case.seconds.insert(0, time.monotonic() - start)
            if status:
                raise MeshmatchError(f"{name} ended with {status} in {place}")
        new_case.states.append(found())
        return new_case

    def pair(place: Path) -> None:
        source, target = (bundled_folder() / "samples" / f"{name}.ply" for name in ("climber", "dancer"))
        shutil.copyfile(source, place / "a.ply")
        shutil.copyfile(target, place / "b.ply")
        (place / "m.npz").write_bytes(b"the old")

    def texture(place: Path) -> None:
        paint = np.random.default_rng(0).integers(0, 256, (64, 64, 4)).astype(np.uint8)
        uv = np.random.default_rng(1).random((shape.F, 3, 2))
        save_textured(place / "a.obj", TexturedMesh(shape.verts, shape.faces, uv), paint)
        save_shape(place / "b.ply", shape)
        save_map(place / "m.npz", VertexMap.identity(shape))
        for name in ("o.obj", "o.mtl", "o.png"):
            (place / name).write_bytes(b"the old")

    def model(place: Path) -> None:
        write_small_model(place / "new" / "blob")
        write_small_model(place / "home" / "models" / "blob")
        card = place / "home" / "models" / "blob" / "card.json"
        card.write_text(card.read_text().replace('"seed": ', '"seed": 7'))

    def collection(place: Path) -> None:
        (place / "in").mkdir()
        for k in range(3):
            verts = shape.verts @ (np.eye(3) + 0.05 * np.random.default_rng(k).normal(size=(3, 3)))
            save_shape(place / "in" / f"s{k}.ply", Shape(verts, shape.faces))

    def all_of(*parts: str) -> Callable[[Path], list[Path]]:
        return lambda place: sorted(path for part in parts for path in (place / part).rglob("*") if path.is_file())

    def trained(place: Path) -> list[Path]:
        """Files of the model, if it has a card."""
        if not any((place / "m" / card).exists() for card in ("card.json", IMPLICIT)):
            return []
        return [path for name in ("weights", "template") for path in (place / "m").glob(f"{name}.safetensors")]

    def prepared(place: Path) -> list[Path]:
        """All files but the picture, which is drawn last."""
        return [path for path in all_of("out")(place) if path.name != "nodes.png"]

    def ready(place: Path) -> None:
        collection(place)
        shutil.copytree(prepare.folder / "out", place / "out")

    def fitted(place: Path) -> None:
        shutil.copytree(fit.folder / "fits", place / "fits")

    add = case("models add", "models add new/blob --replace", model, all_of("home/models"), "models add new/blob")
    obj = case(
        "transfer-texture", "transfer-texture a.obj b.ply --map m.npz -o o.obj --size 64 -q", texture,
        lambda place: [place / name for name in ("o.obj", "o.mtl", "o.png")], apart=True,
    )  # fmt: skip
    prepare = case("prepare", "prepare in -o out --nodes 40 --radius 0.4 --strategy uniform -q", collection, prepared)
    match = case("match", "match a.ply b.ply -o m.npz -q", pair, lambda place: [place / "m.npz"])
    fits = "fit in -o fits --model none --jobs 1 -q"
    fit = case("fit", fits, lambda place: write_eggs(place / "in"), all_of("fits/fits"), fits, True)
    maps = "map fits -o maps --all --jobs 1 -q"
    mapping = case("map", maps, fitted, all_of("maps"), maps, True)
    atlas = case("atlas", "atlas fits -o out --no-measures --modes 2 -q", fitted, all_of("out"))
    long = [prepare, match, fit, atlas]
    if training:
        learn = "train --shapes out -o m --steps 3 --workers 0 -q"
        long.append(case("train", learn, ready, trained, learn))
        implicit = "train --implicit --shapes in -o m --steps 3 -q"
        long.append(case("train --implicit", implicit, lambda place: write_eggs(place / "in"), trained, implicit))
    return [new_case for last in long for new_case in (*[add, obj, mapping, add, mapping, add] * 2, last)]


def kill(case: Case, seed: int, number: int) -> Outcome:
    """Start a command and kill it at a random moment; the files must then be the old or the new ones."""
    rng = np.random.default_rng([seed, 1, number])
    case.reset()
    child = _start(case)
    time.sleep(float(rng.uniform(0.0, 1.0)) * case.seconds[0])
    sign = SIGNALS[int(rng.integers(len(SIGNALS)))]
    os.kill(child, sign)
    kill_time = time.monotonic()
    while not (waited := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() - kill_time > 30:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return Outcome("broken", f"{case.name} did not end within 30 s after {sign.name}")
        time.sleep(0.002)
    status = os.waitstatus_to_exitcode(waited[1])
    allowed = {0, -sign, 128 + sign}
    hidden = [] if sign == signal.SIGKILL else _hidden_files(case)
    _quietly(case.folder, ("models", "list"))  # any next command cleans up
    after_kill = case.outputs()
    what = f"{case.name} after {sign.name}: status {status}, hidden {hidden}, found {after_kill}, not {case.states}"
    what += f"\n{_output_file(case).read_text(errors='replace')}"
    case.seconds[0] *= 0.85 if status == 0 else 1.03  # adapt, so that most commands are hit
    if status not in allowed or (hidden and not case.after) or not _old_or_new(case, after_kill):
        return Outcome("broken", what)
    if case.after:
        _quietly(case.folder, case.after)
        hidden = _hidden_files(case)
        after_state = case.outputs()
        if hidden or after_state != (case.states[1] if case.after == case.words else after_kill):
            return Outcome("broken", f"{what}; then {' '.join(case.after)} left hidden {hidden}, found {after_state}")
    return Outcome("missed" if status == 0 else "fine")


def fill(case: Case, seed: int, number: int) -> Outcome:
    """Run a command with a random limit on the size of files, as on a full disk; it must report a proper error."""
    rng = np.random.default_rng([seed, 2, number])
    case.reset()
    largest = max(path.stat().st_size for path in case.folder.rglob("*") if path.is_file())
    limit = int(rng.integers(1000, max(2000, largest)))
    status = os.waitstatus_to_exitcode(os.waitpid(_start(case, limit), 0)[1])
    output, outputs = _output_file(case).read_text(errors="replace"), case.outputs()
    what = f"{case.name} with {limit} bytes a file: status {status}, hidden {_hidden_files(case)}, found {outputs}\n{output}"
    is_proper_error = output.startswith("error: cannot write") and output.count("\n") <= 2
    if not (status == 0 or (status == 1 and is_proper_error)) or _hidden_files(case) or not _old_or_new(case, outputs):
        return Outcome("broken", what)
    return Outcome("missed" if status == 0 else "fine")


def _hidden_files(case: Case) -> list[str]:
    """Names of hidden files, which are incomplete output; except the lock."""
    return [path.name for path in case.folder.rglob(".*") if path.name != LOCK]


def _old_or_new(case: Case, files: dict[str, str]) -> bool:
    """Whether the files are the old or the new ones; all of the same state, unless the case has `apart`."""
    if files in case.states:
        return True
    old, new = case.states
    return case.apart and all(files.get(name) in (old.get(name), new.get(name)) for name in {*old, *new, *files})


def _start(case: Case, limit: int | None = None) -> int:
    """Start the command in a forked process, where all is imported, optionally with a limit on the size of files."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS[1:])  # no signal may unwind the caller's stack in the forked copy
    child = os.fork()
    if child:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS[1:])
        return child
    status = 99
    try:
        with open(_output_file(case), "wb") as output:
            os.dup2(output.fileno(), 1)
            os.dup2(output.fileno(), 2)
        for sign in SIGNALS[1:]:
            signal.signal(sign, signal.default_int_handler if sign == signal.SIGINT else signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS[1:])
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        status = _run(case.folder, case.words)
    except KeyboardInterrupt:
        status = 130  # interrupted before the command started
    except BaseException:
        traceback.print_exc()
    finally:
        os._exit(status)


def _output_file(case: Case) -> Path:
    return case.folder.with_suffix(".said")


def _quietly(place: Path, words: tuple[str, ...]) -> None:
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        _run(place, words)


def _run(place: Path, words: tuple[str, ...]) -> int:
    """Run a command in a folder, with a separate registry and cache."""
    os.environ |= {HOME_VARIABLE: str(place / "home"), "XDG_CACHE_HOME": str(place / "cache")}
    previous = os.getcwd()
    os.chdir(place)
    try:
        return command(words)
    finally:
        os.chdir(previous)
        sys.stdout.flush()


def digest(path: Path) -> str:
    """Hash of a file's content."""
    data = path.read_bytes()
    if path.suffix == ".safetensors":  # the order of keys in the header is random
        size = 8 + int.from_bytes(data[:8], "little")
        data = json.dumps(json.loads(data[8:size]), sort_keys=True).encode() + data[size:]
    return hashlib.sha256(data).hexdigest()[:16]
