"""Shapes without correspondence: brought to one frame and sampled, with the landmarks that are known on them.

Landmarks are points that are known on each of a folder's shapes, in one order.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress
from meshmatch.shapes.input_files import read_npy
from meshmatch.shapes.normalise import Align, align, residual, sqrt_area_frame, unit_sphere_frame
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepared_folder import Scale, ShapeSamples
from meshmatch.templates.template import Template

MAX_RESIDUAL = 0.12
"""Mean distance (units of sqrt(area), normals included) from which two aligned shapes differ in kind. Set by hand."""
_MIN_SAMPLES, _MAX_SAMPLES = 1024, 4096  # of a shape
_ALL_SAMPLES = 200_000  # of a folder
_COMPARED = 40  # shapes among which the medoid is looked for


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
        part = sample_surface(shape, 800, np.random.default_rng(seed)).in_frame(unit_frame(shape, scale, 0.5))
        aligned.append(part.to_local(align(part, aligned[0], how)[0].pose) if aligned else part)
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
    """Bring every shape to the template's frame and sample it: samples, the frame of every shape (file to template),
    and the residual of every aligned shape against the template.

    A shape's landmarks are in its file's frame, NaN where missing; those of the template are in the template's.
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


def read_landmarks(file: Path, clean: Repaired) -> Float[Floats, "L 3"]:
    """Landmarks of a shape, in its file's frame; NaN for a missing one.

    The file holds vertices (L,), -1 for a missing one, or positions (L, 3); `InputError` if it cannot be read, or names
    a vertex that is not there.
    """
    try:
        if file.suffix == ".npy":
            values = read_npy(file)
        else:
            delimiter = "," if "," in file.read_text(encoding="utf-8") else None
            with warnings.catch_warnings():  # of a file without numbers, which is refused below
                warnings.simplefilter("ignore", UserWarning)
                values = np.asarray(np.loadtxt(file, delimiter=delimiter))
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the landmarks {file.name}", "numbers, one point a line") from error
    if values.ndim == 2 and values.shape[1] == 3 and values.dtype.kind in "fiu":
        return values.astype(np.float64)
    numbers = values.dtype.kind in "fiu" and values.ndim == 1 and len(values)
    if not numbers or not np.array_equal(values, np.round(values)):
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

    `OptionError` if none of the shapes has one.
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
