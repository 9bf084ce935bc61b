"""Which shapes of a folder are registered: every file has the vertices and triangles of the template's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from meshmatch.arrays import Float, Floats, Floats32, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.frames import kabsch
from meshmatch.shapes.align import Align
from meshmatch.shapes.repair import Repaired
from meshmatch.templates.template import Template
from meshmatch.templates.unregistered import read_prepared

SMALL_DATA = 100
"""Fewer registered shapes than this are learned by a network that finds no orientation: the card says it. Set by hand."""

_ALIKE = 30.0  # degrees: registered shapes that are turned less stand alike; set by hand


def same_faces(like: Repaired, found: list[Repaired]) -> bool:
    """Whether all files have one file's vertex count and triangles."""
    first = like.original
    return not first.is_cloud and all(
        clean.original.V == first.V and np.array_equal(clean.original.faces, first.faces) for clean in found
    )


def registered_stack(
    first: Repaired, found: list[Repaired], vertices: Int[Ints, " V"], notes: list[str]
) -> Float[Floats32, "N V 3"]:
    """Vertices of the shapes that share the first one's connectivity; N = 0 unless all of them do."""
    complete = []
    for clean in found if same_faces(first, found) else ():
        invalid = clean.original.invalid
        if invalid is None or not invalid[vertices].any():
            complete.append(clean.original.verts[vertices])
        else:
            notes.append(f"{clean.original.name}: not among the registered shapes, vertices lack a position")
    if len(complete) < 2:
        return np.zeros((0, len(vertices), 3), np.float32)
    chosen = np.stack(complete)
    # Centred before the numbers become short: a scan in a surveyor's coordinates would lose its digits.
    return (chosen - chosen.mean(1, keepdims=True)).astype(np.float32)


def rotation_range(stack: Float[Floats32, "N V 3"], like: Float[Floats, "V 3"]) -> Align:
    """How far registered shapes are turned to the template's vertices; "none" of many, unasked."""
    if len(stack) >= SMALL_DATA:
        return "none"
    cosines = [(np.trace(kabsch(like, verts.astype(np.float64)).rotation) - 1) / 2 for verts in stack]
    return "near" if min(cosines) > np.cos(np.radians(_ALIKE)) else "rigid"


def is_registered(folder: str | Path) -> bool:
    """Whether the shapes of a prepared folder share one connectivity; True where it is not such a folder."""
    try:
        return read_prepared(folder).get("registered") is not False
    except (OSError, ValueError):
        return True  # whoever reads it as registered reports what is wrong with it


def frame_of(folder: str | Path) -> dict[str, str] | None:
    """What a card says of orientation and scale for a prepared folder of small data; None for all others, and for
    shapes of equal radii, as registered shapes are learned at equal areas."""
    try:
        words = read_prepared(folder)
        if not words["registered"] or words["scale"] != "area" or len(words["names"]) >= SMALL_DATA:
            return None
        return {"orientation": str(words["align"]), "scale": "area"}
    except (OSError, ValueError, KeyError, TypeError):
        return None  # whoever reads its shapes reports what is wrong with the folder


def read_registered(folder: str | Path, template: Template) -> Float[Floats32, "N V 3"]:
    """Registered shapes of a prepared folder.

    Raises
    ------
    InputError
        Not a prepared folder, prepared for another template or scale, or its shapes are not registered.
    """
    folder = Path(folder)
    try:
        words = read_prepared(folder)
        shapes = load_file(folder / "shapes.safetensors")["verts"]
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise InputError(f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first") from error
    if words.get("template") != template.hash:
        raise InputError(f"{folder} was prepared for another template", "prepare it again")
    if words.get("scale", "area") != "area":
        raise InputError(
            f"{folder} was prepared with --scale {words['scale']}, but registered shapes are learned at equal areas",
            "prepare it with --scale area, or learn without correspondence (--unsupervised)",
        )
    if not len(shapes):
        raise InputError(
            f"the shapes of {folder} do not share one connectivity",
            "learn without correspondence (--unsupervised); registered means the same triangles in every file",
        )
    return shapes
