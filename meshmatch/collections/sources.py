"""Which shapes a collection is made of, and what they are called in it."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePath, PurePosixPath

from meshmatch import blender
from meshmatch.collections.setting import LEFT_OUT, Record, Source
from meshmatch.collections.stores import Store, is_url
from meshmatch.errors import InputError, warn
from meshmatch.outputs import as_path, plain_text
from meshmatch.shapes.files import SUFFIXES
from meshmatch.shapes.input_files import stem_of, suffix_of

_COMPANIONS = {
    *(".mtl", ".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tga", ".tif", ".tiff", ".gif", ".exr", ".hdr", ".psd"),
    *(".mp4", ".mov", ".bin", ".raw", ".zraw", ".safetensors"),
    *(".csv", ".tsv", ".xls", ".xlsx", ".ods", ".json", ".npz", ".mat", ".xml", ".yaml", ".yml", ".rds", ".rda"),
    *(".fcsv", ".tps", ".pts", ".pp", ".landmarkascii"),
    *(".txt", ".md", ".rst", ".html", ".pdf", ".svg", ".doc", ".docx", ".odt", ".rtf", ".log", ".ini", ".db"),
    *(".py", ".r", ".rdata", ".ipynb", ".sh"),
}  # what lies beside shapes and is none
_ABOUT = {"readme", "license", "licence", "copying", "changelog", "makefile", "authors", "notice"}
_NAMED = 5  # of the files that are not read
_PATTERN = "*?["


def find_sources(
    shapes: str | Path | Sequence[str | Path], output: Store | None = None
) -> tuple[list[Source], list[Record]]:
    """The shapes of files, folders, patterns and URLs of folders, sorted by name; and what was left out, with the reason.

    A shape of a folder is called by its path in it, without the suffix; any other by its file's name. Left out, which is
    told, are files of unknown formats, and those that Blender reads of a folder that holds other shapes. Arrays (.npy),
    images, tables and the like beside shapes have records too, but those of the same name as a shape; so have links to
    folders. What lies in the folder of the fits does not count.

    `InputError` if there is nothing, or two shapes have one name.
    """
    given = [shapes] if isinstance(shapes, str | Path) else list(shapes)
    folders = [Store.of(each) for each in given if is_url(each) or as_path(each).is_dir()]
    if output is not None and output in folders:
        raise InputError(f"cannot fit {output.location} into itself", "choose another folder with --output")
    found: list[Source] = []
    left_out: list[Record] = []
    for each in given:
        _find(each, output, found, left_out)
    found.sort(key=lambda source: source.name)
    if not found:
        raise InputError(
            f"there are no shapes in {given[0] if given else 'nothing'}", f"read are {', '.join(SUFFIXES)}"
        )
    counts = Counter(source.name for source in found)
    for source in found:
        if counts[source.name] > 1:
            alike = [each for each in found if each.name == source.name]
            apart = len({each.folder.location for each in alike}) > 1
            hint = "give the folder that both folders are in, or rename one" if apart else "rename one"
            both = " and ".join(each.path for each in alike)
            if len({os.path.realpath(each.path) for each in alike}) == 1:
                raise InputError(f"{alike[0].path} is named {len(alike)} times", "name each file once")
            raise InputError(f"two shapes are called {source.name}: {both}", hint)
    return found, left_out


def frame_times(names: Iterable[str]) -> dict[str, int]:
    """The place of each frame in the sequence of its folder, from 0."""
    counts: Counter[str] = Counter()
    found = {}
    for name in in_sequences(names):
        found[name] = counts[folder := folder_of(name)]
        counts[folder] += 1
    return found


def folder_of(name: str) -> str:
    """The sequence that a frame belongs to."""
    return name.rpartition("/")[0]


def in_sequences(names: Iterable[str]) -> list[str]:
    """Frames of one folder after the other, in natural order; what lies in a subfolder is none of the folder's."""
    return sorted(names, key=lambda name: (natural(folder := folder_of(name)), folder, natural(name), name))


def natural(name: str) -> list[tuple[int, str]]:
    """A key that sorts names as people do: frame2 before frame10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _find(given: str | Path, output: Store | None, found: list[Source], left_out: list[Record]) -> None:
    """Add the shapes of a file, a folder, a pattern or a URL, and what is left out of it."""
    path = None if is_url(given) else as_path(given)
    if path is None or path.is_dir():
        folder = Store.of(given)
        names = [PurePosixPath(name) for name in folder.names()]
        own = "" if output is None else f"{output.location}/"
        inside = [file for file in names if not own or not f"{folder.location}/{file}".startswith(own)]
        _leave_out(
            folder.location, "files of unknown format", filter(_is_unknown, inside), left_out, f"{folder.location}/"
        )
        shapes = [file for file in inside if suffix_of(file) in SUFFIXES]
        plain = [file for file in shapes if suffix_of(file) not in blender.SUFFIXES] or shapes
        taken = [file for file in plain if suffix_of(file) != ".npy"] or plain
        known = {file.with_name(stem_of(file)) for file in (*taken, *plain)}
        projects = [file for file in shapes if file.with_name(stem_of(file)) not in known]
        _leave_out(folder.location, "files for Blender beside other shapes", projects, left_out, f"{folder.location}/")
        left_out += _beside(inside, taken, projects, f"{folder.location}/")
        why = "a link to a folder, which is not followed"
        left_out += [Record(link, f"{folder.location}/{link}", LEFT_OUT, reasons=why) for link in folder.folder_links()]
        found += [Source(str(file.with_name(stem_of(file))), folder, str(file)) for file in taken]
        return
    files = [path]
    if not path.exists() and any(mark in str(given) for mark in _PATTERN):
        files = [Path(match) for match in glob.glob(str(path), recursive=True)]
        unknown = (file for file in files if _is_unknown(file) and file.is_file())
        _leave_out(str(given), "files of unknown format", unknown, left_out)
        matches, files = files, [file for file in files if suffix_of(file) in SUFFIXES]
        left_out += _beside([file for file in matches if file.is_file()], files, [], "")
    found += [Source(stem_of(file), Store.of(file.parent), file.name) for file in files]


def _is_unknown(file: PurePath) -> bool:
    """Slices of a scanner often have no suffix."""
    return suffix_of(file) not in (*SUFFIXES, *_COMPANIONS) if file.suffix else file.name.lower() not in _ABOUT


def _beside(
    files: Sequence[PurePath], taken: Sequence[PurePath], told: Sequence[PurePath], folder: str
) -> list[Record]:
    """A record of each file that is neither taken nor told already, nor belongs to a shape, whose name it has."""
    known, owners = {*taken, *told}, {file.with_name(stem_of(file)) for file in taken}
    found = []
    for file in files:
        words = file.name.split(".")
        belongs = any(file.with_name(".".join(words[:count])) in owners for count in range(1, len(words)))
        if file not in known and not belongs and not _is_unknown(file):
            is_array = suffix_of(file) == ".npy"
            why = "an array beside shapes" if is_array else "a format of no shapes"
            found.append(Record(str(file), f"{folder}{file}", LEFT_OUT, reasons=why))
    return found


def _leave_out(given: str, why: str, files: Iterable[PurePath], left_out: list[Record], folder: str = "") -> None:
    """Say which files of a folder or a pattern are left out, and keep a record of each."""
    names = [str(file) for file in files]
    if names:
        shown = ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
        warn(f"{given}: {why} are left out: {plain_text(shown)}")
        left_out += [Record(name, f"{folder}{name}", reasons=f"left out: {why}") for name in names]
