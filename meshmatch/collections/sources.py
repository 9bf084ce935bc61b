"""Find the shapes of a collection among files, folders, patterns and URLs, and name them."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePath, PurePosixPath
from unicodedata import normalize

from meshmatch import blender
from meshmatch.collections.setting import FAILED, LEFT_OUT, Record, Source
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
}  # suffixes of files that are often kept with shapes but are not shapes
_UNREADABLE_SHAPES = {
    *(".3dm", ".3ds", ".3mf", ".abc", ".amf", ".asc", ".byu", ".c4d", ".ctm", ".drc", ".dxf", ".e57", ".gii", ".gts"),
    *(".iges", ".igs", ".las", ".laz", ".lwo", ".ma", ".max", ".mb", ".mesh", ".msh", ".mz3", ".pmd", ".pmx", ".ptx"),
    *(".skp", ".sldprt", ".spz", ".step", ".stp", ".vrml", ".wrl", ".wrz", ".x3d", ".ztl", ".zpr"),
}  # suffixes of formats of shapes that `load_shape` does not read
_UNREADABLE, _UNKNOWN = "shapes in formats that are not read", "files of unknown format"
WARNED = "left out: "
"""Begins the reasons of files that a warning named."""
_TEXT_FILES = {"readme", "license", "licence", "copying", "changelog", "makefile", "authors", "notice"}
_MAX_NAMES = 5  # files listed in a warning
_WILDCARDS = "*?["


def find_sources(
    shapes: str | Path | Sequence[str | Path], output: Store | None = None
) -> tuple[list[Source], list[Record]]:
    """Find the shapes of files, folders, patterns and URLs of folders, sorted by name; and list what was left out.

    A shape of a folder is named by its path in the folder, without the suffix; any other shape by the name of its file.
    Shapes in formats that cannot be read have failed, as have files that need Blender in a folder with other shapes; a
    warning names them. Files of unknown formats are left out with a warning. Images, tables, links to folders, and .npy
    arrays next to other shapes are left out without a warning. All of these have records, except files that share the name
    of a shape. Files in the ``output`` folder are ignored.

    `InputError` if there is no shape, or two shapes have the same name.
    """
    given = [shapes] if isinstance(shapes, str | Path) else list(shapes)
    folders = [Store.of(each) for each in given if is_url(each) or as_path(each).is_dir()]
    if output is not None and output in folders:
        raise InputError(f"cannot fit {output.location} into itself", "choose another folder with --output")
    found: list[Source] = []
    left_out: list[Record] = []
    for each in given:
        _add_sources(each, output, found, left_out)
    found.sort(key=lambda source: source.name)
    if not found:
        raise InputError(
            f"there are no shapes in {given[0] if given else 'nothing'}", f"supported formats are {', '.join(SUFFIXES)}"
        )
    counts = Counter(source.name for source in found)
    for source in found:
        if counts[source.name] > 1:
            same_name = [each for each in found if each.name == source.name]
            in_different_folders = len({each.folder.location for each in same_name}) > 1
            hint = "give the folder that both folders are in, or rename one" if in_different_folders else "rename one"
            paths = " and ".join(each.path for each in same_name)
            if len({os.path.realpath(each.path) for each in same_name}) == 1:
                raise InputError(f"{same_name[0].path} is named {len(same_name)} times", "name each file once")
            raise InputError(f"two shapes are called {source.name}: {paths}", hint)
    return found, left_out


def spellings(word: str) -> tuple[str, ...]:
    """Spellings by which a list of shapes may name one, the likeliest first: as given, composed, without a file's suffix.

    Programs compose letters such as é differently (Unicode NFC and NFD), and so do names of files.
    """
    stem = word[: len(word) - len(suffix_of(PurePath(word)))]
    return word, normalize("NFC", word), stem, normalize("NFC", stem)


def name_index(names: Iterable[str]) -> dict[str, str]:
    """Names of shapes by themselves and by their composed spelling, see `spellings`."""
    known = list(names)
    return {normalize("NFC", name): name for name in known} | {name: name for name in known}


def find_name(word: str, index: Mapping[str, str]) -> str | None:
    """The name of the shape that a word means, in a `name_index`; None if there is none."""
    return next((index[each] for each in spellings(word) if each in index), None)


def frame_times(names: Iterable[str]) -> dict[str, int]:
    """Index of each frame in the sequence of its folder, from 0."""
    counts: Counter[str] = Counter()
    found = {}
    for name in sort_by_sequence(names):
        found[name] = counts[folder := folder_of(name)]
        counts[folder] += 1
    return found


def folder_of(name: str) -> str:
    """Folder of a shape, by its name: the sequence that a frame belongs to."""
    return name.rpartition("/")[0]


def sort_by_sequence(names: Iterable[str]) -> list[str]:
    """Sort names by folder, then in natural order; a subfolder is a sequence of its own."""
    return sorted(names, key=lambda name: (natural_key(folder := folder_of(name)), folder, natural_key(name), name))


def natural_key(name: str) -> list[tuple[int, str]]:
    """Key of the natural order of names: frame2 before frame10."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _add_sources(given: str | Path, output: Store | None, found: list[Source], left_out: list[Record]) -> None:
    """Append the shapes of a file, folder, pattern or URL to ``found``, and records of what is skipped to ``left_out``."""
    path = None if is_url(given) else as_path(given)
    if path is None or path.is_dir():
        folder = Store.of(given)
        names = [PurePosixPath(name) for name in folder.names()]
        output_prefix = "" if output is None else f"{output.location}/"
        candidates = [
            file for file in names if not output_prefix or not f"{folder.location}/{file}".startswith(output_prefix)
        ]
        shapes = [file for file in candidates if suffix_of(file) in SUFFIXES]
        preferred = [file for file in shapes if suffix_of(file) not in blender.SUFFIXES] or shapes
        selected = [file for file in preferred if suffix_of(file) != ".npy"] or preferred
        known = {file.with_name(stem_of(file)) for file in (*selected, *preferred)}
        projects = [file for file in shapes if file.with_name(stem_of(file)) not in known]
        skipped = _skipped_files(candidates, [*selected, *projects], selected)
        left_out += _records_with_warning(folder.location, skipped, projects, f"{folder.location}/")
        why = "a link to a folder, which is not followed"
        left_out += [Record(link, f"{folder.location}/{link}", LEFT_OUT, reasons=why) for link in folder.folder_links()]
        found += [Source(str(file.with_name(stem_of(file))), folder, str(file)) for file in selected]
        return
    files = [path]
    if not path.exists() and any(mark in str(given) for mark in _WILDCARDS):
        files = [Path(match) for match in glob.glob(str(path), recursive=True)]
        matches, files = files, [file for file in files if suffix_of(file) in SUFFIXES]
        skipped = _skipped_files([file for file in matches if file.is_file()], files, files)
        left_out += _records_with_warning(str(given), skipped, [], "")
    found += [Source(stem_of(file), Store.of(file.parent), file.name) for file in files]


def _is_unknown(file: PurePath) -> bool:
    """Whether a file's format is unknown; a file without suffix counts, as slices of a scanner often have none."""
    known = (*SUFFIXES, *_COMPANIONS, *_UNREADABLE_SHAPES)
    return suffix_of(file) not in known if file.suffix else file.name.lower() not in _TEXT_FILES


def _skipped_files(
    files: Sequence[PurePath], known: Sequence[PurePath], selected: Sequence[PurePath]
) -> list[PurePath]:
    """Files that are not ``known``, without those that share the name of a selected shape."""
    expected, owners = set(known), {file.with_name(stem_of(file)) for file in selected}
    found = []
    for file in files:
        words = file.name.split(".")
        belongs = any(file.with_name(".".join(words[:count])) in owners for count in range(1, len(words)))
        if file not in expected and not belongs:
            found.append(file)
    return found


def _records_with_warning(
    given: str, skipped: Sequence[PurePath], projects: Sequence[PurePath], folder: str
) -> list[Record]:
    """Records of skipped files and of Blender files of a folder or a pattern, with a warning for unexpected formats."""
    unreadable = [file for file in skipped if suffix_of(file) in _UNREADABLE_SHAPES]
    unknown = [file for file in skipped if _is_unknown(file)]
    warned = {*unreadable, *unknown}
    failed = {"Blender files next to other shapes": projects, _UNREADABLE: unreadable}
    found = []
    for why, files in (failed | {_UNKNOWN: unknown}).items():
        if names := [str(file) for file in files]:
            more = f" and {len(names) - _MAX_NAMES} more" if len(names) > _MAX_NAMES else ""
            warn(f"{given}: {why} are left out: {plain_text(', '.join(names[:_MAX_NAMES]) + more)}")
            verdict = FAILED if why in failed else LEFT_OUT
            found += [Record(name, f"{folder}{name}", verdict, reasons=f"{WARNED}{why}") for name in names]
    for file in skipped:
        if file not in warned:
            why = "an array next to shapes" if suffix_of(file) == ".npy" else "not a format of shapes"
            found.append(Record(str(file), f"{folder}{file}", LEFT_OUT, reasons=why))
    return found
