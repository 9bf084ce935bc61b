"""Points: xyz text, and NumPy arrays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError, warn
from meshmatch.shapes import formats
from meshmatch.shapes.formats import NO_FACES, Raw, columns, damaged, parse_numbers, words_per_line
from meshmatch.shapes.input_files import check_text, read_npy
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_npy

_MOST_HEADERS = 30
_WORDS = re.compile(
    rb"\s*(\d+[ \t]*\n\s*)?(?![+-]?(?:nan|inf))([/%!]*[ \t]*[a-z_][^\n]{,2000}|//+[ \t]*)(?=\n|\Z)", re.IGNORECASE
)
_AXES = ((b"x", b"y", b"z"), (b"points:0", b"points:1", b"points:2"))
_DECIMAL_COMMA = re.compile(rb"(?<!\S)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\S)")
_UNCLEAR_COMMA = re.compile(rb"[+-]?[\d.]*,\d+(?:[eE][+-]?\d+)?|[+-]?\d{1,3},\d{3}\.\d*")
_PAIRS = re.compile(rb"(?:\s*+[+-]?\d++,\d++(?:,[+-]?\d++,\d++){2,}+[ \t]*+)++\s*+")
_FRACTION = re.compile(rb",0\d|,\d{5}")  # no whole number begins with 0, and few columns have five digits


def read_xyz(path: Path, data: bytes) -> Raw:
    """x y z at the start of each line, or where a header says; split by space, comma or semicolon."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not a text file of points", formats.WRONG_SUFFIX)
    check_text(name, data)
    text = formats.without_comments(data.translate(bytes.maketrans(b"\r\"'", b"\n  ")))
    text, labels = _without_header(text)
    text = _split_by_spaces(name, text)
    counts = words_per_line(text)
    formats.check_element_count(name, len(data), len(counts), text=True)
    if len(counts) > 1 and counts[0] == 1 and counts[1:].min() >= 3 and text.split(None, 1)[0].isdigit():
        promised, text = text.split(None, 1)  # a first line with the number of points
        counts = counts[1:]
        if promised.lstrip(b"0") != str(len(counts)).encode():
            warn(f"{name} promises {promised[:20].decode()} points, but holds {len(counts)}: these are read")
    if len(counts) == 0:
        raise InputError(f"{name} holds no points", "each line should be: x y z")
    places = [0, 1, 2]
    for axes in _AXES if len(labels) == counts[0] else ():
        if all(labels.count(axis) == 1 for axis in axes):
            places = [labels.index(axis) for axis in axes]
    least = max(places) + 1
    if counts.min() < least:
        short = int(np.flatnonzero(counts < least)[0])
        raise damaged(name, f"point {short} has only {int(counts[short])} of {least} coordinates")
    return Raw(columns(parse_numbers(name, text), counts, 0, least)[:, places], NO_FACES)


def _without_header(text: bytes) -> tuple[bytes, list[bytes]]:
    """The text behind its first lines of words, and the last of these: a name for each column."""
    labels: list[bytes] = []
    for _ in range(_MOST_HEADERS):
        found = _WORDS.match(text)
        if found is None:
            break
        line, text = found[2], (found[1] or b"") + text[found.end() :]
        split = next((mark for mark in (b";", b",", b"\t") if mark in line), None)
        labels = [cell.strip(b" \t/").lower() for cell in line.strip(b"/%! ").split(split)]
    return text, labels


def _split_by_spaces(name: str, text: bytes) -> bytes:
    """A table of numbers with spaces between its cells, nan in those that are empty, and decimal points.

    A comma inside a word is a decimal comma where something else splits the lines into three words and more, no word has
    two commas, and no number has a point. `InputError` where it may be one, but that cannot be told.
    """
    if b"," not in text and b";" not in text:
        return text
    text = re.sub(rb"([,;])[ \t]*(?=[,;])", rb"\1 nan ", text)
    text = re.sub(rb"^[ \t]*(?=[,;])", b"nan ", text, flags=re.MULTILINE).replace(b";", b" ")
    words, spaced = re.subn(rb",(?!\S)|(?<!\S),", b" ", text)
    counts = words_per_line(words)
    several = counts[1:] if len(counts) > 1 and counts[0] == 1 else counts  # behind a first line with their number
    unclear = False
    if b"," in words and len(several) and several.min() >= 3:
        if not spaced and b"." not in words and words.count(b",") == len(_DECIMAL_COMMA.findall(words)):
            return words.replace(b",", b".")
        start = 1 if len(several) < len(counts) else 0
        unclear = any(_UNCLEAR_COMMA.fullmatch(word) for word in words.split(None, start + 3)[start : start + 3])
    elif b"," in words and b"." not in words:  # nothing but commas: 0,46183,1,04,-2,5
        unclear = bool(_FRACTION.search(words)) and _PAIRS.fullmatch(words) is not None
    if unclear:
        raise InputError(f"{name}: its commas may be decimal commas, separators, or both", formats.DECIMAL_COMMA)
    return words.replace(b",", b" ")


def write_xyz(path: Path, shape: Shape) -> None:
    """A line for each point, with every digit that it has."""
    path.write_text("".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in shape.verts_or_nan.tolist()))


def read_points(path: Path, data: bytes) -> Raw:
    """An npy array (N, 3) of points, or (N, 6) with normals, which are ignored; or rows with fields x, y and z."""
    array = read_npy(path)
    if array.ndim == 1 and {"x", "y", "z"} <= set(array.dtype.names or ()):
        array = np.stack([array[axis] for axis in "xyz"], axis=1)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path.name} does not hold an array of numbers", "save points as an (N, 3) array")
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        hint = "points are an array of (N, 3), or (N, 6)"
        raise InputError(f"{path.name} holds an array of {array.shape}, not a point cloud", hint)
    formats.check_element_count(path.name, len(data), len(array))
    return Raw(np.array(array[:, :3], np.float64), NO_FACES)


def write_points(path: Path, shape: Shape) -> None:
    """An npy array (N, 3) of float64."""
    write_npy(path, shape.verts_or_nan)
