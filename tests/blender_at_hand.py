"""Detection of Blender for tests, and a fake program in its place."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from meshmatch import blender
from meshmatch.errors import OptionError

SECONDS = 300


def found() -> bool:
    try:
        blender.command("any.fbx")
    except OptionError:
        return False
    return True


needs_blender = pytest.mark.skipif(not found(), reason=f"needs Blender ({blender.ENVIRONMENT_VARIABLE})")


def run_inside(script: Path, *words: str | Path) -> str:
    """Run a script in Blender with arguments after "--"; return its stdout."""
    call = [*blender.command("any.blend"), str(script), "--", *map(str, words)]
    done = subprocess.run(call, capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def stand_in(folder: Path, monkeypatch: pytest.MonkeyPatch, does: str = "shutil.copyfile(source, output)") -> None:
    """Install a fake Blender that runs the Python statement ``does`` with the variables ``source`` and ``output``."""
    program = folder / ("blender.cmd" if os.name == "nt" else "blender")
    source = (
        f"#!{sys.executable}\nimport shutil, sys, time\nsource, output = sys.argv[sys.argv.index('--') + 1 :]\n{does}\n"
    )
    program.write_text(source)
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv(blender.ENVIRONMENT_VARIABLE, str(program))
