"""Landmark files of a folder's shapes: points that are known on each of them, in one order."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.repair import Repaired


def read_landmarks(file: Path, clean: Repaired) -> Float[Floats, "L 3"]:
    """Landmarks of a shape, in its file's frame; NaN for a missing one.

    The file holds vertices (L,), -1 for a missing one, or positions (L, 3).

    Raises
    ------
    InputError
        The file cannot be read, or names a vertex that is not there.
    """
    try:
        if file.suffix == ".npy":
            values = read_npy(file)
        else:
            delimiter = "," if "," in file.read_text(encoding="utf-8") else None
            with warnings.catch_warnings():  # of a file without numbers, which is refused below
                warnings.simplefilter("ignore", UserWarning)
                values = np.loadtxt(file, delimiter=delimiter)
        values = np.asarray(values)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the landmarks {file.name}", "numbers, one point a line") from error
    if values.ndim == 2 and values.shape[1] == 3 and values.dtype.kind in "fiu":
        return values.astype(np.float64)
    numbers = values.dtype.kind in "fiu" and values.ndim == 1
    if not numbers or not len(values) or not np.array_equal(values, np.round(values)):
        raise InputError(
            f"{file.name} holds no landmarks",
            "either one vertex a line (-1: missing), or x, y and z of a point on each line",
        )
    outside = values[(values < -1) | (values >= clean.original.V)]
    if len(outside):
        raise InputError(
            f"{file.name} names vertex {outside[0]:.0f}, but {clean.original.name} has {clean.original.V}",
            "vertices are counted from 0; -1 is a missing one",
        )
    points = clean.shape.verts[clean.original_to_repaired[values.astype(np.int64)]].copy()
    points[values < 0] = np.nan
    return points


def find_landmarks(where: str | Path | None, folder: Path, files: Sequence[Path]) -> list[Path | None]:
    """The landmark file of every shape: in a folder of their own, or beside the shapes with a suffix.

    Raises
    ------
    OptionError
        None of the shapes has one.
    """
    if where is None:
        return [None] * len(files)
    place, suffixes = folder, [str(where)]
    if Path(where).is_dir():
        place, suffixes = Path(where), [".landmarks.npy", ".npy", ".landmarks.txt", ".txt"]
    found = []
    for file in files:
        names = (place / f"{file.stem}{suffix}" for suffix in suffixes)
        found.append(next((name for name in names if name.is_file() and name != file), None))
    if not any(found):
        raise OptionError(
            f"no shape of {folder} has landmarks at {where}",
            "give a folder of NAME.npy files, or their suffix beside the shapes, such as .landmarks.npy",
        )
    return found
