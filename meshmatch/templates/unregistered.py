"""Shapes without correspondence: brought to one frame and sampled, with the landmarks that are known on them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from meshmatch.arrays import Float, Floats, Floats32, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.outputs import replace_on_success
from meshmatch.progress import Progress
from meshmatch.shapes.align import ALIGNS, Align, align, residual
from meshmatch.shapes.normalise import sqrt_area_frame, unit_sphere_frame
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

Scale = Literal["area", "sphere"]
SCALES: tuple[Scale, ...] = get_args(Scale)
MAX_RESIDUAL = 0.12
"""Mean distance (units of sqrt(area), normals included) from which two aligned shapes are of different kinds.

Set by hand."""

_MIN_SAMPLES, _MAX_SAMPLES = 1024, 4096  # of a shape
_ALL_SAMPLES = 200_000  # of a folder
_COMPARED = 40  # shapes among which the medoid is looked for


@dataclass(frozen=True, eq=False)
class ShapeSamples:
    """Samples of N shapes in the template's frame, and the landmarks that are known on them.

    points, normals : in random order
    landmarks : NaN where a shape lacks one; L may be 0
    template_landmarks : vertices of the template's low resolution
    align, scale : how every shape was brought to the template's frame
    """

    points: Float[Floats32, "N P 3"]
    normals: Float[Floats32, "N P 3"]
    landmarks: Float[Floats32, "N L 3"]
    template_landmarks: Int[Ints, " L"]
    align: Align
    scale: Scale


_ARRAYS = ("points", "normals", "landmarks", "template_landmarks")


def unit_frame(shape: Shape, scale: Scale, radius: float) -> Frame:
    """A shape's frame before it is turned: area 1, or the template's radius around its centroid.

    ``radius`` is the distance of the template's furthest vertex from its centroid, in the template's own unit.
    """
    if scale == "area":
        return sqrt_area_frame(shape)
    frame = unit_sphere_frame(shape)
    return Frame(frame.scale / radius, frame.rotation, frame.center)


def template_radius(template: Template) -> float:
    """Distance of the furthest vertex from the template's centroid."""
    return float(np.linalg.norm(template.shape.verts, axis=1).max())


def template_samples(template: Template, P: int = 3000, seed: int = 0) -> OrientedPoints:
    """What shapes are aligned to."""
    return sample_surface(template.shape, P, np.random.default_rng(seed))


def medoid(shapes: Sequence[Repaired], how: Align, scale: Scale, seed: int) -> int:
    """The shape with the smallest mean distance to all others, a mesh if there is one.

    Of many shapes some, evenly spread, are compared. They are aligned to the first of them for this.
    """
    pool = [k for k, one in enumerate(shapes) if not one.shape.is_cloud] or list(range(len(shapes)))
    pool = [pool[k] for k in np.unique(np.linspace(0, len(pool) - 1, min(len(pool), _COMPARED)).astype(int))]
    aligned: list[OrientedPoints] = []
    for k in pool:
        shape = shapes[k].shape
        samples = sample_surface(shape, 800, np.random.default_rng(seed))
        part = samples.in_frame(unit_frame(shape, scale, 0.5))
        if aligned:
            best = align(part, aligned[0], how)[0]
            part = part.to_local(best.pose)
        aligned.append(part)
    distance = np.zeros((len(aligned), len(aligned)))
    for i in range(len(aligned)):
        for j in range(i):
            distance[i, j] = distance[j, i] = residual(aligned[i], aligned[j])
    return pool[int(distance.sum(1).argmin())]


def collect_samples(
    template: Template,
    shapes: Sequence[Repaired],
    landmarks: Sequence[Float[Floats, "L 3"] | None],
    template_landmarks: Float[Floats, "L 3"] | None,
    how: Align,
    scale: Scale,
    seed: int,
    progress: Progress | None = None,
) -> tuple[ShapeSamples, list[Frame], list[float]]:
    """Bring every shape to the template's frame and sample it.

    Parameters
    ----------
    landmarks : for each shape its landmarks in its file's frame, NaN where missing; or None
    template_landmarks : the same landmarks in the template's frame

    Returns
    -------
    samples, frame of every shape (file to template), residual of every aligned shape against the template
    """
    progress = progress or Progress()
    target, radius = template_samples(template), template_radius(template)
    P = int(np.clip(_ALL_SAMPLES // len(shapes), _MIN_SAMPLES, _MAX_SAMPLES))
    rng = np.random.default_rng(seed)
    L = 0 if template_landmarks is None else len(template_landmarks)
    points, normals, known = [], [], np.full((len(shapes), L, 3), np.nan, np.float32)
    frames, residuals = [], []
    for number, (one, marks) in enumerate(zip(shapes, landmarks, strict=True)):
        frame = unit_frame(one.shape, scale, radius)
        part = sample_surface(one.shape, P, rng).in_frame(frame)
        best = align(part, target, how)[0]
        part = part.to_local(best.pose)
        points.append(part.points)
        normals.append(part.normals)
        frames.append(frame.compose(best.pose.frame))
        residuals.append(best.residual)
        if L and marks is not None:
            known[number] = frames[-1].apply(marks)
        progress((number + 1) / len(shapes))
    vertices = np.zeros(0, np.int64)
    if template_landmarks is not None:
        distance = np.linalg.norm(template.shape.verts[None] - template_landmarks[:, None], axis=2)
        vertices = distance.argmin(1).astype(np.int64)
    stack = [np.stack(each).astype(np.float32) for each in (points, normals)]
    return ShapeSamples(stack[0], stack[1], known, vertices, how, scale), frames, residuals


def save_samples(samples: ShapeSamples, path: str | Path) -> None:
    """Write the arrays as one safetensors file."""
    arrays = {name: np.ascontiguousarray(getattr(samples, name)) for name in _ARRAYS}
    with replace_on_success(path) as temporary:
        save_file(arrays, temporary, {"align": samples.align, "scale": samples.scale})


def read_samples(folder: str | Path, template: Template) -> ShapeSamples:
    """Samples of a prepared folder.

    Raises
    ------
    InputError
        Not a prepared folder, or prepared for another template.
    """
    path = Path(folder) / "points.safetensors"
    try:
        prepared = read_prepared(folder)
        arrays = load_file(path)
        with safe_open(str(path), framework="np") as file:
            words = file.metadata() or {}
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
    except (OSError, ValueError, KeyError, StopIteration, SafetensorError) as error:
        raise InputError(f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first") from error
    if prepared.get("template") != template.hash:
        raise InputError(f"{folder} was prepared for another template", "prepare it again")
    return found


def read_prepared(folder: str | Path) -> dict[str, Any]:
    """What ``prepared.json`` says.

    Raises
    ------
    OSError, ValueError
        It is missing, or not a JSON object.
    """
    words = json.loads((Path(folder) / "prepared.json").read_text(encoding="utf-8"))
    if not isinstance(words, dict):
        raise ValueError("not an object")
    return words
