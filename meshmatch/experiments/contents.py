"""What is in a wheel: the hash and the size of every file and of the whole, so that two builds can be compared."""

from __future__ import annotations

import hashlib
import sys
import zipfile
from pathlib import Path
from typing import Annotated

from typer import Argument

from meshmatch.errors import InputError
from meshmatch.experiments import runner


@runner.command
def main(wheel: Annotated[Path, Argument(help="the wheel")]) -> runner.Report:
    try:
        with zipfile.ZipFile(wheel) as archive:
            names = sorted(archive.namelist())
            held = {name: archive.read(name) for name in names}
    except (OSError, zipfile.BadZipFile) as error:
        raise InputError(f"{wheel} is not a wheel: {error}") from error
    hashes = {name: hashlib.sha256(data).hexdigest() for name, data in held.items()}
    contents = hashlib.sha256("".join(f"{hashes[name]}  {name}\n" for name in names).encode()).hexdigest()
    lines = [f"{hashes[name][:16]} {len(held[name]):>10,} {name}" for name in names]
    return runner.Report({"files": len(names), "contents": contents}, notes=lines)


if __name__ == "__main__":
    sys.exit(main())
