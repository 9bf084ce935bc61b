"""Files that Blender turns into glb, and glb into: fbx, blend, dae and usd.

Blender is large, global, and its readers were not made for files of strangers: it runs as a process of its own, which may
take only so much time and memory, and runs no scripts of a file (``_blender/convert.py``).
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
"""Files that are read by way of a glb."""
WRITTEN = (".fbx", ".usdz", ".dae", ".blend")
"""Files that are written by way of a glb: all but .dae hold their images."""
VARIABLE = "MESHMATCH_BLENDER"
"""The environment variable that names Blender, or a Python that has the package bpy."""
SCRIPTS = Path(__file__).with_name("_blender")
"""The folder of what runs inside Blender, by its Python."""
_LARGEST = 1 << 30  # bytes of a file that is read
_SECONDS = 300
_KEPT = 4  # files that are not converted again while the process lasts: a verb reads each several times
_MAC = "/Applications/Blender.app/Contents/MacOS/Blender"
_HINT = (
    f"install Blender (blender.org), or `pip install bpy` for a Python 3.11 of its own, and set {VARIABLE} to that "
    "program"
)
_POLYGONS = "with polygons"  # what the script says of a file that has some
_done: OrderedDict[tuple[str, int, int], tuple[bytes, bool]] = OrderedDict()
_lock = threading.Lock()


class _Trouble(NamedTuple):
    """Why Blender did not convert a file, and what to do if that is not for want of a good file."""

    why: str
    hint: str = ""


def is_converted(path: Path) -> bool:
    """Whether a file is read or written by way of a glb."""
    return path.suffix.lower() in SUFFIXES


def command(name: str) -> list[str]:
    """How Blender is started with a script; `OptionError`, which names the file that needs it, if it is not there."""
    named = os.environ.get(VARIABLE, "")
    program = shutil.which(named) if named else shutil.which("blender") or shutil.which(_MAC)
    if named and program is None:
        raise OptionError(f"there is no program {named} ({VARIABLE})", _HINT)
    if program is None and importlib.util.find_spec("bpy") is not None:
        program = sys.executable
    if program is None:
        raise OptionError(f"{name}: a {Path(name).suffix.lower()} file needs Blender, which is not found", _HINT)
    if Path(program).stem.lower().startswith("python"):
        return [program, "-I"]
    return [program, "--background", "--factory-startup", "--disable-autoexec", "--python-exit-code", "1", "--python"]


def glb_of(path: Path) -> bytes:
    """The glb that a file becomes: in meters, y up, with materials, skeletons, clips and morph targets.

    `InputError` if Blender cannot read it, `OptionError` if there is no Blender.
    """
    return _converted(path)[0]


def has_polygons(path: Path) -> bool:
    """Whether a file has faces of more than three corners, of which its glb has triangles; errors as `glb_of`."""
    return _converted(path)[1]


def _converted(path: Path) -> tuple[bytes, bool]:
    found = path.stat()
    key = os.path.realpath(path), found.st_mtime_ns, found.st_size
    with _lock:
        if key not in _done:
            if found.st_size > _LARGEST:
                raise InputError(f"{path.name} is larger than {_LARGEST >> 30} GiB", "export it as .glb")
            with tempfile.TemporaryDirectory(prefix="meshmatch-") as folder:
                glb = Path(folder, "converted.glb")
                said = _run(path, glb)
                if isinstance(said, _Trouble):
                    hint = said.hint or _other_export(path)
                    raise InputError(f"{path.name} cannot be read: {said.why}", hint)
                _done[key] = glb.read_bytes(), _POLYGONS in said
        _done.move_to_end(key)
        while len(_done) > _KEPT:
            _done.popitem(last=False)
        return _done[key]


def _other_export(path: Path) -> str:
    """What to do about a file that Blender does not read."""
    with path.open("rb") as file:
        written_out = path.suffix.lower() == ".fbx" and file.read(1) == b";"
    return "export it as a binary .fbx, or as .glb" if written_out else "is it damaged? export it as .glb"


def check_written(path: Path) -> None:
    """Refuse, before the work, a file that Blender cannot write, or if there is no Blender (`OptionError`)."""
    if path.suffix.lower() not in WRITTEN:
        raise OptionError(f"{path.name}: {path.suffix} files are only read", f"write one of {', '.join(WRITTEN)}")
    command(path.name)


def from_glb(glb: Path, place: Path, path: Path) -> dict[Path, bytes]:
    """Write to ``place`` what a glb becomes as the file ``path``; the images of a dae, which belong beside it with its name
    before theirs and are not there yet, are returned.

    `OutputError` if Blender cannot, `OptionError` if there is none or an image would replace another file.
    """
    with tempfile.TemporaryDirectory(prefix="meshmatch-") as folder:
        output = Path(folder, path.name)
        said = _run(glb, output)
        if isinstance(said, _Trouble):
            hint = said.hint or "write a .glb, and open that in the other program"
            raise OutputError(f"cannot write {path}: {said.why}", hint)
        made = [file for file in sorted(Path(folder).iterdir()) if file != output and file.is_file()]
        new = [file for file in made if not is_converted(file) and _is_new(path.parent / file.name, file, path)]
        shutil.copyfile(output, place)
        return {path.parent / file.name: file.read_bytes() for file in new}


def _is_new(copy: Path, file: Path, path: Path) -> bool:
    """Whether a file that belongs to an output is not beside it yet; `OptionError` if another one has its name."""
    if not copy.exists():
        return True
    if not copy.is_file() or copy.read_bytes() != file.read_bytes():
        hint = "choose another folder for the output, or remove the file"
        raise OptionError(f"cannot write {file.name} beside {path.name}: another {copy} is there", hint)
    return False


def _run(source: Path, output: Path) -> _Trouble | list[str]:
    """Let Blender convert a file; why it did not, or the lines that it said. What it leaves out is told."""
    script = SCRIPTS / "convert.py"
    theirs = (source if output.suffix == ".glb" else output).name  # the other one is ours, and temporary
    words = [*command(theirs), str(script)]
    words += ["--", str(source.absolute()), str(output.absolute())]
    with tempfile.TemporaryFile() as said:
        try:
            done = subprocess.run(
                words, stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT, timeout=_SECONDS, check=False
            )
        except subprocess.TimeoutExpired:
            return _Trouble(f"Blender took longer than {_SECONDS // 60} minutes")
        except OSError as error:
            return _Trouble(f"Blender cannot be started: {error.strerror}", _HINT)
        said.seek(max(0, said.tell() - 100_000))
        lines = said.read().decode(errors="replace").splitlines()
    if done.returncode:
        worth = [line.strip() for line in lines if line.strip() and not line.startswith((" ", "note: "))]
        why = (worth or [f"Blender ended with status {done.returncode}"])[-1].split("Error: ")[-1]
        return _Trouble(why, _HINT if "No module named 'bpy'" in why else "")
    if not output.is_file():
        return _Trouble("Blender wrote nothing", f"is {words[0]} Blender? {_HINT}")
    notes = dict.fromkeys(line.removeprefix("note: ") for line in lines if line.startswith("note: "))
    for line in list(notes)[:8]:
        warn(f"{theirs}: {line}")
    return lines
