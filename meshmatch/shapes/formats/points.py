"""Point clouds without a header to speak of: xyz text and NumPy arrays."""

import re
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError
from meshmatch.shapes.array_files import read_npy as read_array
from meshmatch.shapes.formats import NO_FACES, Raw, damaged
from meshmatch.shapes.formats.text import columns, numbers, words_per_line
from meshmatch.shapes.shape import Shape


def read_xyz(path: Path, data: bytes) -> Raw:
    """x y z at the start of each line, split by space, comma or semicolon; further columns are ignored."""
    name = path.name
    if b"\0" in data[:4096]:
        raise InputError(f"{name} is not a text file of points", "does the suffix fit the content?")
    text = data.translate(bytes.maketrans(b",;\r", b"  \n"))
    if b"#" in text:
        text = re.sub(rb"#[^\n]*", b"", text)
    counts = words_per_line(text)
    if len(counts) > 1 and counts[0] == 1 and text.split(None, 1)[0] == str(len(counts) - 1).encode():
        text, counts = text.split(None, 1)[1], counts[1:]  # a first line with the number of points
    if len(counts) == 0:
        raise InputError(f"{name} holds no points", "each line should be: x y z")
    if counts.min() < 3:
        short = int(np.flatnonzero(counts < 3)[0])
        raise damaged(name, f"point {short} has only {int(counts[short])} of 3 coordinates")
    return Raw(columns(numbers(name, text), counts, 0, 3), NO_FACES)


def read_npy(path: Path, data: bytes) -> Raw:
    """An array (N, 3) of points, or (N, 6) with normals, which are ignored."""
    name = path.name
    array = read_array(path)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} does not hold an array of numbers", "save points as an (N, 3) array")
    if array.ndim != 2 or array.shape[1] not in (3, 6):
        raise InputError(
            f"{name} holds an array of {array.shape}, not a point cloud", "points are an array of (N, 3), or (N, 6)"
        )
    return Raw(np.array(array[:, :3], np.float64), NO_FACES)


def write_xyz(path: Path, shape: Shape) -> None:
    """A line for each point, with every digit that it has."""
    path.write_text("".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in shape.verts_or_nan.tolist()))


def write_npy(path: Path, shape: Shape) -> None:
    """(N, 3) float64."""
    with path.open("wb") as file:
        np.save(file, shape.verts_or_nan, allow_pickle=False)
