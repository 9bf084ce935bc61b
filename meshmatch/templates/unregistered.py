"""Shapes without correspondence: brought to one frame, sampled, and with the few points that are known on them."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.align import ALIGNS, Align, align, residual
from meshmatch.shapes.array_files import read_npy
from meshmatch.shapes.normalise import sqrt_area_frame, unit_sphere_frame
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

Scale = Literal["area", "sphere"]
SCALES: tuple[Scale, ...] = get_args(Scale)
STRANGE = 0.12
"""Mean distance (units of sqrt(area), normals included) from which two aligned shapes are of different kinds."""

_FEWEST, _MOST = 1024, 4096
_ALL = 200_000  # samples of a folder
_COMPARED = 40  # shapes among which the most typical one is looked for


@dataclass(frozen=True, eq=False)
class Gathered:
    """Samples of N shapes in the template's frame, and the points that are known on them.

    points, normals : float32 (N, P, 3), in random order
    landmarks : float32 (N, L, 3), not a number where a shape lacks one; L may be 0
    template_landmarks : int64 (L,) vertices of the template's low resolution
    align, scale : how every shape was brought to the template's frame
    """

    points: np.ndarray
    normals: np.ndarray
    landmarks: np.ndarray
    template_landmarks: np.ndarray
    align: Align
    scale: Scale


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
    samples = sample_surface(template.shape, P, np.random.default_rng(seed))
    return OrientedPoints(samples.points, samples.normals)


def most_typical(shapes: Sequence[Repaired], how: Align, scale: Scale, seed: int) -> int:
    """The shape that lies nearest to all others on average, a mesh if there is one.

    Of many shapes some, evenly spread, are compared. They are aligned to the first of them for this.
    """
    pool = [k for k, one in enumerate(shapes) if not one.shape.is_cloud] or list(range(len(shapes)))
    pool = [pool[k] for k in np.unique(np.linspace(0, len(pool) - 1, min(len(pool), _COMPARED)).astype(int))]
    seen: list[OrientedPoints] = []
    for k in pool:
        shape = shapes[k].shape
        samples = sample_surface(shape, 800, np.random.default_rng(seed))
        part = OrientedPoints(unit_frame(shape, scale, 0.5).apply(samples.points), samples.normals)
        if seen:
            best = align(part, seen[0], how)[0]
            part = part.to_local(best.pose)
        seen.append(part)
    apart = np.zeros((len(seen), len(seen)))
    for i in range(len(seen)):
        for j in range(i):
            apart[i, j] = apart[j, i] = residual(seen[i], seen[j])
    return pool[int(apart.sum(1).argmin())]


def gather(
    template: Template,
    shapes: Sequence[Repaired],
    known: Sequence[np.ndarray | None],
    template_known: np.ndarray | None,
    how: Align,
    scale: Scale,
    seed: int,
    tell: Callable[[int], None] = lambda done: None,
    strict: bool = True,
) -> tuple[Gathered, list[Frame], list[float]]:
    """Bring every shape to the template's frame and sample it.

    Parameters
    ----------
    known : for each shape (L, 3) known points in its file's frame, not a number where missing; or None
    template_known : (L, 3) the same points in the template's frame
    strict : refuse a template that is nothing like the shapes

    Returns
    -------
    gathered, frame of every shape (file to template), distance of every aligned shape from the template

    Raises
    ------
    InputError
        Most shapes are nothing like the template.
    """
    target, radius = template_samples(template), template_radius(template)
    P = int(np.clip(_ALL // len(shapes), _FEWEST, _MOST))
    rng = np.random.default_rng(seed)
    L = 0 if template_known is None else len(template_known)
    points, normals, landmarks = [], [], np.full((len(shapes), L, 3), np.nan, np.float32)
    frames, far = [], []
    for number, one in enumerate(shapes):
        frame = unit_frame(one.shape, scale, radius)
        samples = sample_surface(one.shape, P, rng)
        part = OrientedPoints(frame.apply(samples.points), samples.normals)
        best = align(part, target, how)[0]
        part = part.to_local(best.pose)
        points.append(part.points)
        normals.append(part.normals)
        frames.append(frame.compose(best.pose.frame))
        far.append(best.residual)
        places = known[number]
        if L and places is not None:
            landmarks[number] = frames[-1].apply(places)
        tell(number + 1)
    if strict and np.median(far) > STRANGE:
        raise InputError(
            f"most shapes of the folder are nothing like the template {template.name}: aligned, they lie "
            f"{100 * np.median(far):.0f} % of sqrt(area) apart",
            "name one of the shapes with --template, or try another --align or --scale",
        )
    at = np.zeros(0, np.int64)
    if template_known is not None:
        apart = np.linalg.norm(template.shape.verts[None] - template_known[:, None], axis=2)
        at = apart.argmin(1).astype(np.int64)
    stack = [np.stack(each).astype(np.float32) for each in (points, normals)]
    return Gathered(stack[0], stack[1], landmarks, at, how, scale), frames, far


def save_gathered(gathered: Gathered, path: str | Path) -> None:
    """Write the arrays as one safetensors file."""
    arrays = {
        "points": gathered.points,
        "normals": gathered.normals,
        "landmarks": gathered.landmarks,
        "template_landmarks": gathered.template_landmarks,
    }
    words: dict[str, str] = {"align": gathered.align, "scale": gathered.scale}
    with replace_on_success(path) as temporary:
        save_file({name: np.ascontiguousarray(a) for name, a in arrays.items()}, temporary, words)


def read_gathered(folder: str | Path, template: Template) -> Gathered:
    """Samples of a prepared folder.

    Raises
    ------
    InputError
        Not a prepared folder, or prepared for another template.
    """
    path = Path(folder) / "points.safetensors"
    try:
        words = prepared_words(folder)
        arrays = load_file(path)
        with safe_open(str(path), framework="np") as file:
            frame = file.metadata() or {}
        found = Gathered(
            **{name: arrays[name] for name in ("points", "normals", "landmarks", "template_landmarks")},
            align=next(how for how in ALIGNS if how == frame["align"]),
            scale=next(kind for kind in SCALES if kind == frame["scale"]),
        )
        N, P, _ = found.points.shape
        whole = found.normals.shape == (N, P, 3) and found.landmarks.shape[::2] == (N, 3)
        at = found.template_landmarks
        if not whole or len(at) != found.landmarks.shape[1] or (len(at) and at.max() >= template.shape.V):
            raise KeyError("arrays that do not belong together")
    except (OSError, ValueError, KeyError, StopIteration, SafetensorError) as error:
        raise InputError(
            f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first"
        ) from error
    if words.get("template") != template.hash:
        raise InputError(f"{folder} was prepared for another template", "prepare it again")
    return found


def prepared_words(folder: str | Path) -> dict[str, Any]:
    """What ``prepared.json`` says.

    Raises
    ------
    OSError, ValueError
        It is not there, or is no JSON object.
    """
    words = json.loads((Path(folder) / "prepared.json").read_text(encoding="utf-8"))
    if not isinstance(words, dict):
        raise ValueError("no object")
    return words


def is_registered(folder: str | Path) -> bool:
    """Whether the shapes of a prepared folder share one connectivity; True where it is no such folder."""
    try:
        return prepared_words(folder).get("registered") is not False
    except (OSError, ValueError):
        return True  # whoever reads it as registered says what is wrong with it


def read_known(file: Path, clean: Repaired) -> np.ndarray:
    """Known points (L, 3) of a shape, in its file's frame: vertices (L,), -1 for a missing one, or positions (L, 3).

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
            with warnings.catch_warnings():  # of a file without numbers, which is told below
                warnings.simplefilter("ignore", UserWarning)
                values = np.loadtxt(file, delimiter=delimiter)
        values = np.asarray(values)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the landmarks {file.name}", "numbers, one point a line") from error
    if values.ndim == 2 and values.shape[1] == 3 and values.dtype.kind in "fiu":
        return values.astype(np.float64)
    whole = values.dtype.kind in "fiu" and values.ndim == 1
    if not whole or not len(values) or not np.array_equal(values, np.round(values)):
        raise InputError(
            f"{file.name} holds no landmarks",
            "either one vertex a line (-1: missing), or x, y and z of a place on each line",
        )
    outside = values[(values < -1) | (values >= clean.original.V)]
    if len(outside):
        raise InputError(
            f"{file.name} names vertex {outside[0]:.0f}, but {clean.original.name} has {clean.original.V}",
            "vertices are counted from 0; -1 is a missing one",
        )
    index = clean.original_to_repaired[values.astype(np.int64)]
    places = clean.shape.verts[index].copy()
    places[values < 0] = np.nan
    return places


def find_known(landmarks: str | Path | None, folder: Path, files: Sequence[Path]) -> list[Path | None]:
    """The landmark file of every shape: in a folder of their own, or beside the shapes with a suffix.

    Raises
    ------
    OptionError
        None of the shapes has one.
    """
    if landmarks is None:
        return [None] * len(files)
    place, suffixes = folder, [str(landmarks)]
    if Path(landmarks).is_dir():
        place, suffixes = Path(landmarks), [".landmarks.npy", ".npy", ".landmarks.txt", ".txt"]
    found = []
    for file in files:
        names = (place / f"{file.stem}{suffix}" for suffix in suffixes)
        found.append(next((name for name in names if name.is_file() and name != file), None))
    if not any(found):
        raise OptionError(
            f"no shape of {folder} has landmarks at {landmarks}",
            "give a folder of NAME.npy files, or their ending beside the shapes, such as .landmarks.npy",
        )
    return found
