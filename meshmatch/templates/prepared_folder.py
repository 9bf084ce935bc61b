"""What a prepared folder holds: registered shapes, and samples of all shapes, for one template.

Shapes are registered if every file has the vertices and triangles of the template's.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import numpy as np
from safetensors import SafetensorError, safe_open

from meshmatch.arrays import Float, Floats, Floats32, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.frames import kabsch
from meshmatch.shapes.normalise import ALIGNS, Align
from meshmatch.shapes.repair import Repaired
from meshmatch.templates.template import Template, save_arrays

T = TypeVar("T")
Scale = Literal["area", "sphere"]
SCALES: tuple[Scale, ...] = get_args(Scale)
SMALL_DATA = 100
"""Fewer registered shapes than this are learned by a network that finds no orientation: the card says it. Set by hand."""
_ALIKE = 30.0  # degrees: registered shapes that are turned less stand alike; set by hand
_ARRAYS = ("points", "normals", "landmarks", "template_landmarks")


@dataclass(frozen=True, eq=False)
class ShapeSamples:
    """Samples of N shapes in the template's frame, and the landmarks that are known on them."""

    points: Float[Floats32, "N P 3"]  # in random order
    normals: Float[Floats32, "N P 3"]
    landmarks: Float[Floats32, "N L 3"]  # NaN where a shape lacks one; L may be 0
    template_landmarks: Int[Ints, " L"]  # vertices of the template's low resolution
    align: Align  # how every shape was brought to the template's frame
    scale: Scale


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


def save_samples(samples: ShapeSamples, path: Path) -> None:
    """Write the arrays as one safetensors file."""
    arrays = {name: getattr(samples, name) for name in _ARRAYS}
    save_arrays(path, arrays, {"align": samples.align, "scale": samples.scale})


def read_samples(folder: str | Path, template: Template) -> ShapeSamples:
    """Samples of a prepared folder; `InputError` if it is none, or was prepared for another template."""

    def samples(arrays: dict[str, np.ndarray], words: dict[str, str]) -> ShapeSamples:
        found = ShapeSamples(
            **{name: arrays[name] for name in _ARRAYS},
            align=next(how for how in ALIGNS if how == words["align"]),
            scale=next(kind for kind in SCALES if kind == words["scale"]),
        )
        N, P, _ = found.points.shape
        fits = found.normals.shape == (N, P, 3) and found.landmarks.shape[::2] == (N, 3)
        at = found.template_landmarks
        if not fits or len(at) != found.landmarks.shape[1] or (len(at) and at.max() >= template.shape.V):
            raise KeyError("arrays that do not belong together")
        return found

    return _read(Path(folder), "points", template, samples)[1]


def read_registered(folder: str | Path, template: Template) -> Float[Floats32, "N V 3"]:
    """Registered shapes of a prepared folder; `InputError` if it is none, was prepared for another template or scale, or
    its shapes are not registered.
    """
    words, shapes = _read(Path(folder), "shapes", template, lambda arrays, _: arrays["verts"])
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


def is_registered(folder: str | Path) -> bool:
    """Whether the shapes of a prepared folder share one connectivity; True where it is not such a folder."""
    try:
        return _facts(folder).get("registered") is not False
    except (OSError, ValueError):
        return True  # whoever reads it as registered reports what is wrong with it


def frame_of(folder: str | Path) -> dict[str, str] | None:
    """What a card says of orientation and scale for a prepared folder of small data; None for all others, and for
    shapes of equal radii, as registered shapes are learned at equal areas."""
    try:
        words = _facts(folder)
        if not words["registered"] or words["scale"] != "area" or len(words["names"]) >= SMALL_DATA:
            return None
        return {"orientation": str(words["align"]), "scale": "area"}
    except (OSError, ValueError, KeyError, TypeError):
        return None  # whoever reads its shapes reports what is wrong with the folder


def _read(
    folder: Path, name: str, template: Template, build: Callable[[dict[str, np.ndarray], dict[str, str]], T]
) -> tuple[dict[str, Any], T]:
    """What ``prepared.json`` says, and what is built of the arrays and words of one of the folder's files."""
    try:
        facts = _facts(folder)
        with safe_open(str(folder / f"{name}.safetensors"), framework="np") as file:
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (it is no dictionary)
            found = build(arrays, file.metadata() or {})
    except (OSError, ValueError, KeyError, StopIteration, SafetensorError) as error:
        raise InputError(f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first") from error
    if facts.get("template") != template.hash:
        raise InputError(f"{folder} was prepared for another template", "prepare it again")
    return facts, found


def _facts(folder: str | Path) -> dict[str, Any]:
    """What ``prepared.json`` says; `OSError` or `ValueError` if it is missing, or not a JSON object."""
    words = json.loads((Path(folder) / "prepared.json").read_text(encoding="utf-8"))
    if not isinstance(words, dict):
        raise ValueError("not an object")
    return words
