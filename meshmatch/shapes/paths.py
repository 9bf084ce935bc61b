"""Files to be read: are they there, and are they where a mesh may ask for them?"""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

from meshmatch.errors import InputError

LARGEST_FILE = 1 << 32
"""Bytes: a hundred million vertices, more than anything here can work on. Larger files are refused unread."""


def existing(path: Path, hint: str = "", suffixes: tuple[str, ...] = ()) -> Path:
    """The path, if an ordinary file that is not empty and not too large is there.

    Parameters
    ----------
    hint : str
        For the error; without it, one is made up, with the most similar name of a file with one of ``suffixes``.

    Raises
    ------
    InputError
        Missing, a folder, a pipe or device, empty, or larger than `LARGEST_FILE`.
    """
    try:
        if path.is_dir():
            raise InputError(f"{path} is a folder, not a file", hint or "give the name of a file")
        if not path.exists():
            if path.is_symlink():
                raise InputError(f"{path} is a link to a file that is not there", "mend the link, or name the file")
            raise InputError(f"there is no file {path}", hint or _similar(path, suffixes))
        if not path.is_file():
            raise InputError(
                f"{path} is not a regular file (it is a pipe or a device)", "write its data to a file first"
            )
        size = path.stat().st_size
        with path.open("rb"):  # may it be read?
            pass
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}", hint or "check the name") from error
    if size == 0:
        raise InputError(f"{path.name} is empty (0 bytes)", hint or "was the download or the export cut short?")
    if size > LARGEST_FILE:
        raise InputError(
            f"{path.name} is too large: {size / 2**30:.1f} GiB", f"the limit is {LARGEST_FILE / 2**30:.0f} GiB"
        )
    return path


def read_bytes(path: Path, hint: str = "") -> bytes:
    """All of a file.

    Raises
    ------
    InputError
        As `existing`; or reading fails.
    """
    try:
        return existing(path, hint).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}", hint or "check the disk") from error


def beside(folder: Path, name: str) -> Path | None:
    """The file of that name in a folder or below it; None if it is not there, or elsewhere."""
    try:
        file = (folder / name).resolve()
        return file if file.is_relative_to(folder.resolve()) and file.is_file() else None
    except (OSError, RuntimeError, ValueError):  # a name too long, a circle of links, a NUL in the name
        return None


def _similar(path: Path, suffixes: tuple[str, ...]) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent} either"
    names = [entry.name for entry in path.parent.iterdir() if entry.suffix.lower() in suffixes]
    close = get_close_matches(path.name, names, n=1)
    return f"did you mean {path.parent / close[0]}?" if close else "check the name and the folder"
