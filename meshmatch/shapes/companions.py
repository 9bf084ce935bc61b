"""Find files that another file refers to: the images and material files of an obj, mtl, glTF or ply.

Such names were written on other computers, often carelessly: in other case, with a drive, with backslashes, in another
encoding, or as a URI. Files outside the folder are never returned.
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

_MAX_LENGTH = 4096  # maximum length of a name in characters; no system opens longer ones
_MAX_DEPTH = 32  # maximum number of folders in a name
_MAX_EQUIVALENT = 16  # maximum number of equivalent folders (names that differ only in case and the like) to search
_MIN_AGE = 2_000_000_000  # how old a folder's modification must be for its listing to be cached, in nanoseconds
_DRIVE = re.compile(r"[a-z]:(?=[\\/])|file:(?=/)", re.IGNORECASE)


def find_companion(folder: Path, name: str, uri: bool = False) -> Path | None:
    """Find the file that a name refers to, in a folder or below it; None if there is none.

    Parameters
    ----------
    folder
        Folder of the file that contains the name. Nothing outside it is found, not even through links.
    name
        The name as written in that file, as text (bytes that are not UTF-8 as surrogates); quotes around it are
        ignored.
    uri
        Whether the name is a URI, as in glTF, so that ``%20`` is a space unless a file has that literal name.

    Returns
    -------
    Path | None
        The first of these that exists: the name as written; with ``/`` for ``\\``; with percent escapes decoded; and
        without ``?query`` and ``#fragment``. For each, an exact match is preferred, then one that differs only in case,
        in Unicode composition, or in encoding (cp1252); among several of these the choice is deterministic. If the
        whole path leads nowhere, or out of the folder (``C:\\scan\\maps\\a.png``, ``../maps/a.png``), its ends are
        tried, the longest first: ``maps/a.png``, then ``a.png``.

    Notes
    -----
    Folders are listed only if there is no exact match; listings are cached until the folder changes.
    """
    spellings = list(dict.fromkeys(_spellings(name.strip(), uri))) if len(name) <= _MAX_LENGTH else []
    for spelling in spellings:
        if (file := _inside(folder, spelling)) is not None:
            return file
    paths = list(dict.fromkeys(tuple(_parts(spelling)) for spelling in spellings))
    for length in range(max(map(len, paths), default=0), 0, -1):
        for parts in paths:
            if len(parts) >= length and (file := _find_equivalent(folder, parts[-length:])) is not None:
                return file
    return None


def _spellings(name: str, uri: bool) -> Iterator[str]:
    """The possible readings of a name, the likeliest first."""
    unquoted = [name, *([name[1:-1].strip()] if name[:1] in "'\"" and name[-1:] == name[:1] else [])]
    stripped = [re.split("[?#]", each)[0] for each in unquoted]
    decoded, stripped_decoded = (
        [unquote(each, errors="surrogateescape") for each in names] for names in (unquoted, stripped)
    )
    for names in (
        (decoded, unquoted, stripped_decoded, stripped) if uri else (unquoted, decoded, stripped, stripped_decoded)
    ):
        for each in filter(None, names):
            yield each
            yield each.replace("\\", "/")


def _parts(name: str) -> list[str]:
    """The folders and file name of a path, at most `_MAX_DEPTH`, without its drive; parent references are resolved."""
    parts: list[str] = []
    for part in _DRIVE.sub("", name, count=1).replace("\\", "/").split("/"):
        if part == "..":
            parts = parts[:-1]
        elif part not in ("", "."):
            parts.append(part)
    return parts[-_MAX_DEPTH:]


def _inside(folder: Path, name: str) -> Path | None:
    """The file of exactly this name, if it lies in the folder or below it."""
    try:
        file = (folder / name).resolve()
        return file if file.is_relative_to(folder.resolve()) and file.is_file() else None
    except (OSError, RuntimeError, ValueError):  # too long, a cycle of links, or a NUL in the name
        return None


def _find_equivalent(folder: Path, parts: tuple[str, ...]) -> Path | None:
    """The file at a path whose components may differ in case and the like."""
    if (file := _inside(folder, "/".join(parts))) is not None:
        return file
    prefixes = [""]
    for part in parts:
        prefixes = [
            os.path.join(path, entry) for path in prefixes for entry in _equivalent_entries(folder / path, part)
        ][:_MAX_EQUIVALENT]
    return next((file for name in prefixes if (file := _inside(folder, name)) is not None), None)


def _equivalent_entries(folder: Path, name: str) -> list[str]:
    """The names in a folder that are equivalent to ``name``, the most similar first."""
    try:
        state = folder.stat()
        # A recent change may be followed by another with the same timestamp.
        is_recent = abs(time.time_ns() - state.st_mtime_ns) < _MIN_AGE
        listing = (_entries.__wrapped__ if is_recent else _entries)(
            folder, (state.st_dev, state.st_ino, state.st_mtime_ns)
        )
        entries = listing.get(canonical_name(name), [])
    except (OSError, ValueError):
        return []
    composed = unicodedata.normalize("NFC", name)
    return sorted(entries, key=lambda entry: (entry != name, unicodedata.normalize("NFC", entry) != composed, entry))


@lru_cache(maxsize=4)
def _entries(folder: Path, state: tuple[int, int, int]) -> dict[str, list[str]]:
    """Names in a folder, grouped by their canonical form; `state` identifies its content in the cache."""
    entries: dict[str, list[str]] = {}
    for entry in os.listdir(folder):
        entries.setdefault(canonical_name(entry), []).append(entry)
    return entries


def canonical_name(name: str) -> str:
    """Canonical form of a name: equal for names that differ only in case, Unicode composition, or encoding."""
    data = name.encode("utf-8", "surrogateescape")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", text).casefold())
