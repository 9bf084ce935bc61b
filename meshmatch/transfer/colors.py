"""Vertex colours: mixed as light. A `Shape` has them as screens show them (sRGB), whatever its file has."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.maps import table_files
from meshmatch.shapes.colors import to_linear, to_srgb
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.value_files import Values, parse_blank, save_values

_SHAPES, _TABLES = (".ply", ".glb", ".obj", ".off"), (".npy", ".csv")
check_suffix = partial(table_files.check_suffix, suffixes=(*_SHAPES, *_TABLES), what="vertex colours")


def light_of(shape: Shape, colors: ArrayLike | None = None) -> Float[Floats, "V 4"]:
    """Light of the vertices of a shape, from its own colours or from others (V, 3 or 4) as screens show them.

    `InputError` if it has no vertex colours; or not one for each vertex, within 0..1.
    """
    if colors is None:
        if shape.colors is None:
            raise InputError(
                f"{shape.name or 'the source'} has no vertex colours",
                "give numbers with --values, or transfer its texture: meshmatch transfer-texture",
            )
        return light(shape.colors)
    table = checked(np.asarray(colors, np.float64))
    if len(table) != shape.V or table.ndim != 2:
        raise InputError(f"colours must be an array of ({shape.V}, 3 or 4), not {table.shape}")
    return light(np.column_stack([table, np.ones(len(table))])[:, :4])


def checked(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """The same colours; `OptionError` where they are not 3 or 4 numbers within 0..1."""
    if colors.ndim == 0 or colors.shape[-1] not in (3, 4) or not ((colors >= 0) & (colors <= 1)).all():
        raise OptionError(
            "a colour has 3 or 4 numbers within 0..1: red, green, blue and alpha", "such as 0.5,0.5,0.5 or #808080"
        )
    return colors


def light(colors: Float[Floats, "*N C"]) -> Float[Floats, "*N C"]:
    """Light of colours (..., 3 or 4) as screens show them; alpha is left as it is."""
    return np.concatenate([to_linear(colors[..., :3]), colors[..., 3:]], axis=-1)


def seen(amounts: Float[Floats, "V 4"]) -> Float[Floats, "V 4"]:
    """Colours as screens show them (sRGB, 0..1) of light; nan is black."""
    amounts = np.clip(np.nan_to_num(amounts), 0.0, 1.0)
    return np.concatenate([to_srgb(amounts[:, :3]), amounts[:, 3:]], axis=1)


def parse_color(text: str | None) -> tuple[float, float, float, float] | None:
    """The colour and alpha (sRGB, 0..1) that a text such as #808080 means; `OptionError` if it means none."""
    if text is None:
        return None
    red, green, blue, alpha = checked(parse_blank(text, 4)).tolist()
    return red, green, blue, alpha


def save(path: Path, shape: Shape, colors: Float[Floats, "V 4"]) -> None:
    """Write `shape` with vertex colours as screens show them; or the colours alone."""
    if check_suffix(path) in _TABLES:
        save_values(path, Values(colors, ("red", "green", "blue", "alpha")), shape)
    else:
        save_shape(path, Shape(shape.verts, shape.faces, shape.name, colors, shape.invalid))
