"""Conversion of fbx, blend, dae and usd files from and to glb by Blender.

Blender is large, keeps global state, and its readers are not hardened against malicious files. It runs in a separate
process, with limits on time and memory, and does not execute scripts in files (``_blender/convert.py``).
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import OrderedDict
from pathlib import Path
from typing import NamedTuple

from meshmatch.errors import InputError, OptionError, OutputError, warn

SUFFIXES = (".fbx", ".usdz", ".usd", ".usda", ".usdc", ".dae", ".blend")
"""Formats that are read through a glb."""
WRITABLE = (".fbx", ".usdz", ".dae", ".blend")
"""Formats that are written through a glb; all but .dae embed their images."""
ENVIRONMENT_VARIABLE = "MESHMATCH_BLENDER"
"""Environment variable with the path of Blender, or of a Python that has the package bpy."""
SCRIPTS = Path(__file__).with_name("_blender")
"""Folder of the code that Blender's Python runs."""
_MAX_BYTES = 1 << 30  # maximum size of an input file, in bytes
_TIMEOUT = 300  # seconds
_CACHE_SIZE = 4  # converted files to keep in memory: a command reads each several times
_MAC_PROGRAM = "/Applications/Blender.app/Contents/MacOS/Blender"
_HINT = (
    "install Blender (blender.org), or `pip install bpy` for a Python 3.11 of its own, and set "
    f"{ENVIRONMENT_VARIABLE} to that program"
)
_POLYGONS_LINE = "with polygons"  # output line of the script for a file with polygons
_cache: OrderedDict[tuple[str, int, int], tuple[bytes, bool]] = OrderedDict()
_lock = threading.Lock()


class _Failure(NamedTuple):
    """Why Blender did not convert a file, and a hint unless the file is at fault."""

    why: str
    hint: str = ""


def is_converted(path: Path) -> bool:
    """Whether a file is read or written through a glb."""
    return path.suffix.lower() in SUFFIXES


def command(name: str) -> list[str]:
    """The command that runs a script in Blender.

    `OptionError` if Blender is not found; ``name`` is the file that needs it.
    """
    configured = os.environ.get(ENVIRONMENT_VARIABLE, "")
    program = shutil.which(configured) if configured else shutil.which("blender") or shutil.which(_MAC_PROGRAM)
    if configured and program is None:
        raise OptionError(f"there is no program {configured} ({ENVIRONMENT_VARIABLE})", _HINT)
    if program is None and importlib.util.find_spec("bpy") is not None:
        program = sys.executable
    if program is None:
        raise OptionError(f"{name}: a {Path(name).suffix.lower()} file needs Blender, which is not found", _HINT)
    if Path(program).stem.lower().startswith("python"):
        return [program, "-I"]
    return [program, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1", "--python"]


def convert_to_glb(path: Path) -> bytes:
    """Convert a file to glb: in metres, y up, with materials, skeletons, clips and morph targets.

    `InputError` if Blender cannot read it, `OptionError` if there is no Blender.
    """
    return _convert(path)[0]


def has_polygons(path: Path) -> bool:
    """Whether a file has faces with more than three corners (triangles in its glb); errors as for `convert_to_glb`."""
    return _convert(path)[1]


def _convert(path: Path) -> tuple[bytes, bool]:
    """The glb of a file, and whether the file has polygons; cached."""
    stat = path.stat()
    key = os.path.realpath(path), stat.st_mtime_ns, stat.st_size
    with _lock:
        if key not in _cache:
            if stat.st_size > _MAX_BYTES:
                raise InputError(f"{path.name} is larger than {_MAX_BYTES >> 30} GiB", "export it as .glb")
            with tempfile.TemporaryDirectory(prefix="meshmatch-") as folder:
                glb = Path(folder, "converted.glb")
                outcome = _run(path, glb)
                if isinstance(outcome, _Failure):
                    hint = outcome.hint or _export_hint(path)
                    raise InputError(f"{path.name} cannot be read: {outcome.why}", hint)
                _cache[key] = glb.read_bytes(), _POLYGONS_LINE in outcome
        _cache.move_to_end(key)
        while len(_cache) > _CACHE_SIZE:
            _cache.popitem(last=False)
        return _cache[key]


def _export_hint(path: Path) -> str:
    """A hint for a file that Blender cannot read."""
    with path.open("rb") as file:
        is_ascii = path.suffix.lower() == ".fbx" and file.read(1) == b";"
    return "export it as a binary .fbx, or as .glb" if is_ascii else "is it damaged? export it as .glb"


def check_written(path: Path) -> None:
    """`OptionError` if Blender cannot write this format, or there is no Blender. Call it before long work."""
    if path.suffix.lower() not in WRITABLE:
        raise OptionError(f"{path.name}: {path.suffix} files are only read", f"write one of {', '.join(WRITABLE)}")
    command(path.name)


def from_glb(glb: Path, place: Path, path: Path) -> dict[Path, bytes]:
    """Convert a glb to the format of ``path`` and write it to ``place``; return images of a dae that do not exist yet.

    Their keys are paths next to ``path``, whose stem their names begin with. `OutputError` if Blender fails,
    `OptionError` if there is no Blender or an image would replace another file.
    """
    with tempfile.TemporaryDirectory(prefix="meshmatch-") as folder:
        output = Path(folder, path.name)
        outcome = _run(glb, output)
        if isinstance(outcome, _Failure):
            hint = outcome.hint or "write a .glb, and open that in the other program"
            raise OutputError(f"cannot write {path}: {outcome.why}", hint)
        images = [file for file in sorted(Path(folder).iterdir()) if file != output and file.is_file()]
        new = [file for file in images if not is_converted(file) and _is_new(path.parent / file.name, file, path)]
        shutil.copyfile(output, place)
        return {path.parent / file.name: file.read_bytes() for file in new}


def _is_new(copy: Path, file: Path, path: Path) -> bool:
    """Whether ``copy`` does not exist yet; `OptionError` if a different file of that name does."""
    if not copy.exists():
        return True
    if not copy.is_file() or copy.read_bytes() != file.read_bytes():
        hint = "choose another folder for the output, or remove the file"
        raise OptionError(f"cannot write {file.name} next to {path.name}: another {copy} is there", hint)
    return False


def _run(source: Path, output: Path) -> _Failure | list[str]:
    """Convert a file with Blender; return the lines of its output, or a failure.

    A warning is issued for each note among the lines.
    """
    script = SCRIPTS / "convert.py"
    name = (source if output.suffix == ".glb" else output).name  # of the user's file; the other one is temporary
    arguments = [*command(name), str(script)]
    arguments += ["--", str(source.absolute()), str(output.absolute())]
    with tempfile.TemporaryFile() as log:
        try:
            done = subprocess.run(
                arguments, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, timeout=_TIMEOUT, check=False
            )
        except subprocess.TimeoutExpired:
            return _Failure(f"Blender took longer than {_TIMEOUT // 60} minutes")
        except OSError as error:
            return _Failure(f"Blender cannot be started: {error.strerror}", _HINT)
        log.seek(max(0, log.tell() - 100_000))
        lines = log.read().decode(errors="replace").splitlines()
    if done.returncode:
        messages = [line.strip() for line in lines if line.strip() and not line.startswith((" ", "note: "))]
        why = (messages or [f"Blender ended with status {done.returncode}"])[-1].split("Error: ")[-1]
        return _Failure(why, _HINT if "No module named 'bpy'" in why else "")
    if not output.is_file():
        return _Failure("Blender wrote nothing", f"is {arguments[0]} Blender? {_HINT}")
    notes = dict.fromkeys(line.removeprefix("note: ") for line in lines if line.startswith("note: "))
    for line in list(notes)[:8]:
        warn(f"{name}: {line}")
    return lines
