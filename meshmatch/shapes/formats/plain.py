"""The plain formats: Geomview OFF (text), and points as xyz text or NumPy arrays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError, warn
from meshmatch.shapes import formats
from meshmatch.shapes.formats import NO_FACES, Raw, columns, damaged, numbers, words_per_line
from meshmatch.shapes.input_files import check_text, read_npy
from meshmatch.shapes.shape import Shape

_WORDS = re.compile(rb"\s*(\d+[ \t]*\n\s*)?(?![+-]?(?:nan|inf))(/*[ \t]*[a-z_][^\n]{,2000})(?=\n|\Z)", re.IGNORECASE)
_AXES = ((b"x", b"y", b"z"), (b"points:0", b"points:1", b"points:2"))
_DECIMAL_COMMA = re.compile(rb"(?<!\S)[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\S)")
_UNCLEAR_COMMA = re.compile(rb"[+-]?[\d.]*,\d+(?:[eE][+-]?\d+)?|[+-]?\d{1,3},\d{3}\.\d*")
_PAIRS = re.compile(rb"(?:\s*+[+-]?\d++,\d++(?:,[+-]?\d++,\d++){2,}+[ \t]*+)++\s*+")
_FRACTION = re.compile(rb",0\d|,\d{5}")  # no whole number begins with 0, and few columns have five digits
_HEADER = re.compile(rb"\s*((?:ST)?C?N?)OFF\b|\s*((?:ST)?C?N?)OFF(?=\d)")


def read_off(path: Path, data: bytes) -> Raw:
    """With or without colors and normals."""
    name = path.name
    check_text(name, data)
    text = formats.without_comments(data).replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    header = _HEADER.match(text)
    if not header:
        raise InputError(f"{name} is not an off file: it does not begin with 'OFF'", formats.WRONG_SUFFIX)
    kind = header.group(1) or header.group(2) or b""
    body = text[header.end() :]
    if body.lstrip()[:6] == b"BINARY":
        raise InputError(f"{name} is a binary off file", "convert it to ply")
    head = re.match(rb"\s*(\d{1,15})\s+(\d{1,15})(?!\d)(?:[ \t]+\d+)?", body)
    if not head:
        raise damaged(name, "the header does not say how many vertices and faces there are")
    V, F = int(head.group(1)), int(head.group(2))
    promise = f"it promises {V} vertices and {F} faces, but"
    body = body[head.end() :]
    if len(body) < V + F:  # a row takes two bytes and more
        raise damaged(name, f"{promise} is only {len(data)} bytes long")
    formats.check_places(name, len(data), V, F, text=True)
    counts = words_per_line(body)
    if len(counts) < V + F:
        raise damaged(name, f"{promise} has only {len(counts)} lines of them")
    widths, sizes = counts[:V], counts[V : V + F]
    if V and widths.min() < 3:
        raise damaged(name, "a vertex has fewer than 3 coordinates")
    rows, faces = np.split(numbers(name, body), [widths.sum()])
    at = 6 if b"N" in kind else 3
    colors = None
    if b"C" in kind and V and widths.min() >= at + 3:
        colors = formats.painted(columns(rows, widths, at, min(at + 4, int(widths.min()))))
    verts = columns(rows, widths, 0, 3) if V else np.empty((0, 3))
    if F == 0:
        return Raw(verts, NO_FACES, colors)
    starts = np.cumsum(sizes) - sizes
    corners = faces[starts]
    if not ((corners >= 0) & (corners < sizes)).all():
        raise damaged(name, "a face has fewer corners than it says")
    many = corners.astype(np.int64)
    formats.check_places(name, len(data), V, max(int(many.sum()) - 2 * F, 0), text=True)
    return Raw(verts, formats.fan(formats.indices(name, faces[formats.runs(starts + 1, many)]), many), colors)


def write_off(path: Path, shape: Shape) -> None:
    """Positions with every digit that they have; colors as COFF."""
    verts = shape.verts_or_nan
    rows = verts if shape.colors is None else np.hstack([verts, shape.colors])
    lines = ["OFF" if shape.colors is None else "COFF", f"{shape.V} {shape.F} 0"]
    lines += [" ".join(map(repr, row)) for row in rows.tolist()]
    lines += [f"3 {a} {b} {c}" for a, b, c in shape.faces.tolist()]
    path.write_text("\n".join([*lines, ""]))


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
    formats.check_places(name, len(data), len(counts), text=True)
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
    return Raw(columns(numbers(name, text), counts, 0, least)[:, places], NO_FACES)


def _without_header(text: bytes) -> tuple[bytes, list[bytes]]:
    """The text behind its first lines of words, and the last of these: a name for each column."""
    labels: list[bytes] = []
    while found := _WORDS.match(text):
        line, text = found[2], (found[1] or b"") + text[found.end() :]
        split = next((mark for mark in (b";", b",", b"\t") if mark in line), None)
        labels = [cell.strip(b" \t/").lower() for cell in line.strip(b"/ ").split(split)]
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
    """An npy array (N, 3) of points, or (N, 6) with normals, which are ignored."""
    array = read_npy(path)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{path.name} does not hold an array of numbers", "save points as an (N, 3) array")
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        hint = "points are an array of (N, 3), or (N, 6)"
        raise InputError(f"{path.name} holds an array of {array.shape}, not a point cloud", hint)
    formats.check_places(path.name, len(data), len(array))
    return Raw(np.array(array[:, :3], np.float64), NO_FACES)


def write_points(path: Path, shape: Shape) -> None:
    """An npy array (N, 3) of float64."""
    with path.open("wb") as file:
        np.save(file, shape.verts_or_nan, allow_pickle=False)
