"""Files that another file names: the images and material files of an obj, an mtl, a glTF or a ply.

Such a name was written on another computer, and often by a program that did not ask how it would look elsewhere: in other
case, with a drive, with backslashes, with an accent of its own, or as a URI. What is found never leaves a folder.
"""

from __future__ import annotations

import os
import re
import time
import unicodedata
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from urllib.parse import unquote

_LONGEST = 4096  # characters of a name: no system opens a longer one
_DEEPEST = 32  # folders in a name
_MOST_ALIKE = 16  # folders whose names differ in nothing but case, that are looked into
_MOMENT = 2_000_000_000  # nanoseconds
_DRIVE = re.compile(r"[a-z]:(?=[\\/])|file:(?=/)", re.IGNORECASE)


def beside(folder: Path, name: str, uri: bool = False) -> Path | None:
    """The file that a name means, in a folder or below it; None if there is none.

    Parameters
    ----------
    folder
        Where the file lies that has the name in it. Nothing outside is found, also not by way of links.
    name
        As that file has it, already text (bytes that are not UTF-8 as surrogates); quotes around it do not count.
    uri
        Whether the name is a URI, as in glTF, so that ``%20`` is a space unless a file is really called so.

    Returns
    -------
    Path | None
        The first of these that exists: the name as it stands; with ``/`` for ``\\``; with what ``%20`` and the like stand
        for; and without ``?query`` and ``#fragment``. Of each, the exact name is preferred, then one that differs only in
        case, in how accents are composed, or in that one is in the letters of Windows (cp1252); of several of these,
        always the same one. Where the whole path leads nowhere, or out of the folder (``C:\\scan\\maps\\a.png``,
        ``../maps/a.png``), its ends are tried, the longest first: ``maps/a.png``, then ``a.png``.

    Notes
    -----
    Folders are listed only for names that are not there exactly, and a list is kept while its folder stays as it is.
    """
    spelled = list(dict.fromkeys(_spellings(name.strip(), uri))) if len(name) <= _LONGEST else []
    for spelling in spelled:
        if (file := _inside(folder, spelling)) is not None:
            return file
    paths = list(dict.fromkeys(tuple(_parts(spelling)) for spelling in spelled))
    for length in range(max(map(len, paths), default=0), 0, -1):
        for parts in paths:
            if len(parts) >= length and (file := _alike(folder, parts[-length:])) is not None:
                return file
    return None


def _spellings(name: str, uri: bool) -> Iterator[str]:
    """A name, and what else it may mean; the likeliest first."""
    plain = [name, *([name[1:-1].strip()] if name[:1] in "'\"" and name[-1:] == name[:1] else [])]
    short = [re.split("[?#]", each)[0] for each in plain]
    decoded, short_decoded = ([unquote(each, errors="surrogateescape") for each in names] for names in (plain, short))
    for names in (decoded, plain, short_decoded, short) if uri else (plain, decoded, short, short_decoded):
        for each in filter(None, names):
            yield each
            yield each.replace("\\", "/")


def _parts(name: str) -> list[str]:
    """The last folders and the file of a path, without the drive and without what leads upwards."""
    parts: list[str] = []
    for part in _DRIVE.sub("", name, count=1).replace("\\", "/").split("/"):
        if part == "..":
            parts = parts[:-1]
        elif part not in ("", "."):
            parts.append(part)
    return parts[-_DEEPEST:]


def _inside(folder: Path, name: str) -> Path | None:
    """The file of exactly that name, if it lies in the folder or below it."""
    try:
        file = (folder / name).resolve()
        return file if file.is_relative_to(folder.resolve()) and file.is_file() else None
    except (OSError, RuntimeError, ValueError):  # a name too long, a circle of links, a NUL in the name
        return None


def _alike(folder: Path, parts: tuple[str, ...]) -> Path | None:
    """The file at the end of a path, whose folders and file may differ in case and the like."""
    if (file := _inside(folder, "/".join(parts))) is not None:
        return file
    found = [""]
    for part in parts:
        found = [os.path.join(path, own) for path in found for own in _entries_like(folder / path, part)][:_MOST_ALIKE]
    return next((file for name in found if (file := _inside(folder, name)) is not None), None)


def _entries_like(folder: Path, name: str) -> list[str]:
    """The names in a folder that are like another one, the most similar first."""
    try:
        state = folder.stat()
        # What changed a moment ago may change again without a later time on it.
        fresh = abs(time.time_ns() - state.st_mtime_ns) < _MOMENT
        listed = (_entries.__wrapped__ if fresh else _entries)(folder, (state.st_dev, state.st_ino, state.st_mtime_ns))
        entries = listed.get(folded(name), [])
    except (OSError, ValueError):
        return []
    composed = unicodedata.normalize("NFC", name)
    return sorted(entries, key=lambda entry: (entry != name, unicodedata.normalize("NFC", entry) != composed, entry))


@lru_cache(maxsize=4)
def _entries(folder: Path, state: tuple[int, int, int]) -> dict[str, list[str]]:
    """The names in a folder, by what is the same in all that are alike; `state` says whether it is still the same one."""
    entries: dict[str, list[str]] = {}
    for entry in os.listdir(folder):
        entries.setdefault(folded(entry), []).append(entry)
    return entries


def folded(name: str) -> str:
    """What is the same in two names that differ only in case, in how accents are composed, or in their encoding."""
    data = name.encode("utf-8", "surrogateescape")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())
