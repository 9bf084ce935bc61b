"""Vertex colours: mixed as light. A `Shape` has them as screens show them (sRGB), whatever its file has."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import InputError
from meshmatch.maps import table_files
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import to_linear, to_srgb
from meshmatch.transfer.value_files import Values, save_values

CHANNELS = ("red", "green", "blue", "alpha")
_SHAPES, _TABLES = (".ply", ".glb", ".obj", ".off"), (".npy", ".csv")


def of_shape(shape: Shape) -> Values:
    """Light (V, 4) of the vertices of a shape, alpha last.

    Raises
    ------
    InputError
        It has no vertex colours.
    """
    if shape.colors is None:
        raise InputError(
            f"{shape.name} has no vertex colours",
            "give numbers with --values, or carry its texture: meshmatch transfer-texture",
        )
    return Values(light(shape.colors), CHANNELS)


def light(colors: Floats) -> Floats:
    """Light of colours (..., 3 or 4) as screens show them; alpha is left as it is."""
    return np.concatenate([to_linear(colors[..., :3]), colors[..., 3:]], axis=-1)


def check_suffix(path: Path) -> None:
    """Refuse a suffix that cannot hold vertex colours (`OptionError`)."""
    table_files.check_suffix(path, (*_SHAPES, *_TABLES), "vertex colours")


def save(path: Path, shape: Shape, amounts: Floats) -> None:
    """Write `shape` with vertex colours from light (V, 4); or the colours alone, as screens have them."""
    check_suffix(path)
    amounts = np.clip(np.nan_to_num(amounts), 0.0, 1.0)
    seen = np.concatenate([to_srgb(amounts[:, :3]), amounts[:, 3:]], axis=1)
    if path.suffix.lower() in _TABLES:
        save_values(path, Values(seen, CHANNELS), shape)
        return
    save_shape(path, Shape(shape.verts, shape.faces, shape.name, seen, shape.invalid))
