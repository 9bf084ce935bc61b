"""Which shapes a collection is made of, and what they are called in it."""

from __future__ import annotations

import glob
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from meshmatch import blender
from meshmatch.collections.setting import Source
from meshmatch.collections.stores import Store, is_url
from meshmatch.errors import InputError, warn
from meshmatch.outputs import as_path, plain_text
from meshmatch.shapes.files import SUFFIXES
from meshmatch.shapes.input_files import stem_of, suffix_of

_COMPANIONS = {
    ".mtl",
    ".png",
    ".jpg",
    ".jpeg",
    ".webp",
    ".bmp",
    ".tga",
    ".tif",
    ".tiff",
    ".gif",
    ".bin",
    ".csv",
    ".tsv",
    ".xls",
    ".xlsx",
    ".txt",
    ".json",
    ".npz",
    ".mat",
    ".xml",
    ".yaml",
    ".yml",
    ".md",
    ".rst",
    ".html",
    ".pdf",
    ".svg",
    ".log",
    ".py",
    ".r",
    ".sh",
    ".fcsv",
    ".tps",
    ".pp",
    ".safetensors",
    ".raw",
    ".zraw",
    ".zip",
}  # what lies beside shapes and is none
_NAMED = 5  # of the files that are not read
_PATTERN = "*?["


def find_sources(shapes: str | Path | Sequence[str | Path], output: Store) -> list[Source]:
    """The shapes of files, folders, patterns and URLs of folders, sorted by name.

    A shape of a folder is called by its path in it, without the suffix; any other by its file's name. What lies in the
    folder of the fits is left out; so are arrays (.npy), and files that Blender reads, of a folder that holds other shapes.

    `InputError` if there is nothing, or two shapes have one name.
    """
    given = [shapes] if isinstance(shapes, str | Path) else list(shapes)
    if any(Store.of(each).location == output.location for each in given if is_url(each) or as_path(each).is_dir()):
        raise InputError(f"cannot fit {output.location} into itself", "choose another folder with --output")
    found = sorted((source for each in given for source in _sources(each, output)), key=lambda source: source.name)
    if not found:
        raise InputError(
            f"there are no shapes in {given[0] if given else 'nothing'}", f"read are {', '.join(SUFFIXES)}"
        )
    counts = Counter(source.name for source in found)
    for source in found:
        if counts[source.name] > 1:
            both = " and ".join(each.file for each in found if each.name == source.name)
            raise InputError(f"two shapes are called {source.name}: {both}", "rename one, or put them into two folders")
    return found


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names as people do: frame2 before frame10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _sources(given: str | Path, output: Store) -> Iterable[Source]:
    if is_url(given):
        return _of_folder(Store.of(given), output)
    path = as_path(given)
    if path.is_dir():
        return _of_folder(Store.of(path), output)
    if not path.exists() and any(mark in str(given) for mark in _PATTERN):
        files = [Path(match) for match in glob.glob(str(path), recursive=True)]
        files = [file for file in files if suffix_of(file) in SUFFIXES]
    else:
        files = [path]
    return [Source(stem_of(file), Store.of(file.parent), file.name) for file in files]


def _of_folder(folder: Store, output: Store) -> list[Source]:
    """The shapes of a folder. Files of unknown formats are told."""
    found = [PurePosixPath(name) for name in folder.names()]
    found = [file for file in found if not f"{folder.location}/{file}".startswith(f"{output.location}/")]
    files = [file for file in found if suffix_of(file) in SUFFIXES]
    other = [str(file) for file in found if suffix_of(file) not in (*SUFFIXES, *_COMPANIONS) and file.suffix]
    if other:
        names = ", ".join(other[:_NAMED]) + (f" and {len(other) - _NAMED} more" if len(other) > _NAMED else "")
        warn(f"{folder.location}: files of unknown format are left out: {plain_text(names)}")
    for beside in (set(blender.SUFFIXES), {".npy"}):
        files = [file for file in files if file.suffix.lower() not in beside] or files
    return [Source(str(file.with_name(stem_of(file))), folder, str(file)) for file in files]
