"""Read and write point clouds as xyz text and as NumPy arrays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError, warn
from meshmatch.shapes import formats
from meshmatch.shapes.formats import NO_FACES, Raw, columns, damaged, parse_numbers, words_per_line
from meshmatch.shapes.input_files import check_text_size, read_npy
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_npy

_MAX_HEADER_LINES = 30
_HEADER_LINE = re.compile(
    rb"\s*(\d+[ \t]*\n\s*)?(?![+-]?(?:nan|inf))([/%!]*[ \t]*[a-z_][^\n]{,2000}|//+[ \t]*)(?=\n|\Z)", re.IGNORECASE
)
_AXES = ((b"x", b"y", b"z"), (b"points:0", b"points:1", b"points:2"))
_DECIMAL_COMMA = re.compile(rb"(?<!\S)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\S)")
_AMBIGUOUS_COMMA = re.compile(rb"[+-]?[\d.]*,\d+(?:[eE][+-]?\d+)?|[+-]?\d{1,3},\d{3}\.\d*")
_PAIRS = re.compile(rb"(?:\s*+[+-]?\d++,\d++(?:,[+-]?\d++,\d++){2,}+[ \t]*+)++\s*+")
_FRACTION = re.compile(rb",0\d|,\d{5}")  # no integer begins with 0, and five digits are rare in an integer column


def read_xyz(path: Path, data: bytes) -> Raw:
    """Read x y z from the first three columns, or from those that a header names.

    Columns are separated by white space, commas or semicolons.
    """
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not a text file of points", formats.WRONG_SUFFIX)
    check_text_size(name, data)
    text = formats.without_comments(data.translate(bytes.maketrans(b"\r\"'", b"\n  ")))
    text, labels = _without_header(text)
    text = _normalize_separators(name, text)
    counts = words_per_line(text)
    formats.check_element_count(name, len(data), len(counts), text=True)
    if len(counts) > 1 and counts[0] == 1 and counts[1:].min() >= 3 and text.split(None, 1)[0].isdigit():
        declared, text = text.split(None, 1)  # the first line has the number of points
        counts = counts[1:]
        if declared.lstrip(b"0") != str(len(counts)).encode():
            warn(f"{name} promises {declared[:20].decode()} points, but holds {len(counts)}: these are read")
    if len(counts) == 0:
        raise InputError(f"{name} holds no points", "each line should be: x y z")
    columns_of_xyz = [0, 1, 2]
    for axes in _AXES if len(labels) == counts[0] else ():
        if all(labels.count(axis) == 1 for axis in axes):
            columns_of_xyz = [labels.index(axis) for axis in axes]
    n_needed = max(columns_of_xyz) + 1
    if counts.min() < n_needed:
        bad = int(np.flatnonzero(counts < n_needed)[0])
        raise damaged(name, f"point {bad} has only {int(counts[bad])} of {n_needed} coordinates")
    return Raw(columns(parse_numbers(name, text), counts, 0, n_needed)[:, columns_of_xyz], NO_FACES)


def _without_header(text: bytes) -> tuple[bytes, list[bytes]]:
    """Split off header lines; return the text after them, and the column names in the last of them."""
    labels: list[bytes] = []
    for _ in range(_MAX_HEADER_LINES):
        match = _HEADER_LINE.match(text)
        if match is None:
            break
        line, text = match[2], (match[1] or b"") + text[match.end() :]
        split = next((separator for separator in (b";", b",", b"\t") if separator in line), None)
        labels = [cell.strip(b" \t/").lower() for cell in line.strip(b"/%! ").split(split)]
    return text, labels


def _normalize_separators(name: str, text: bytes) -> bytes:
    """Normalise a table of numbers: cells separated by spaces, nan in empty cells, and decimal points.

    A comma within a word is a decimal comma if other separators split the lines into at least three words, no word has two
    commas and no number has a point. `InputError` if it may be a decimal comma or a separator.
    """
    if b"," not in text and b";" not in text:
        return text
    text = re.sub(rb"([,;])[ \t]*(?=[,;])", rb"\1 nan ", text)
    text = re.sub(rb"^[ \t]*(?=[,;])", b"nan ", text, flags=re.MULTILINE).replace(b";", b" ")
    words, spaced = re.subn(rb",(?!\S)|(?<!\S),", b" ", text)
    counts = words_per_line(words)
    data_counts = (
        counts[1:] if len(counts) > 1 and counts[0] == 1 else counts
    )  # without a first line that has their number
    is_ambiguous = False
    if b"," in words and len(data_counts) and data_counts.min() >= 3:
        if not spaced and b"." not in words and words.count(b",") == len(_DECIMAL_COMMA.findall(words)):
            return words.replace(b",", b".")
        start = 1 if len(data_counts) < len(counts) else 0
        is_ambiguous = any(_AMBIGUOUS_COMMA.fullmatch(word) for word in words.split(None, start + 3)[start : start + 3])
    elif b"," in words and b"." not in words:  # commas only: 0,46183,1,04,-2,5
        is_ambiguous = bool(_FRACTION.search(words)) and _PAIRS.fullmatch(words) is not None
    if is_ambiguous:
        raise InputError(f"{name}: its commas may be decimal commas, separators, or both", formats.DECIMAL_COMMA)
    return words.replace(b",", b" ")


def write_xyz(path: Path, shape: Shape) -> None:
    """Write one line per point, in full precision."""
    path.write_text("".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in shape.verts_or_nan.tolist()))


def read_points(path: Path, data: bytes) -> Raw:
    """Read an npy array of points: (N, 3), (N, 6) with normals, which are ignored, or structured with fields x, y, z."""
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
    """Write an npy array (N, 3) of float64."""
    write_npy(path, shape.verts_or_nan)
