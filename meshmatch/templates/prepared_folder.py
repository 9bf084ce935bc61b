"""Contents of a prepared folder for one template: samples and landmarks of all shapes, and registered shapes.

Shapes are registered if every file has the template's vertices and triangles in the same order. Landmarks are corresponding
points on the shapes of a folder, in the same order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open

from meshmatch.arrays import Float, Floats, Floats32, Int, Ints, ShortRepr
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.outputs import as_path
from meshmatch.progress import Progress
from meshmatch.shapes.alignment import ALIGNS, Align, align, alignment_residual
from meshmatch.shapes.input_files import read_json
from meshmatch.shapes.landmark_files import LANDMARK_READERS, Space, read_landmark_file
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.tables import read_by_suffix
from meshmatch.templates.mirror_images import mirror_image
from meshmatch.templates.template import SCALES, Scale, Template, template_radius, template_samples, unit_frame

T = TypeVar("T")
SMALL_DATA = 100
"""With fewer registered shapes than this, networks do not learn orientation, as their cards say. Set by hand."""
MAX_RESIDUAL = 0.12
"""Mean distance (units of sqrt(area), normals included) above which two aligned shapes differ in kind. Set by hand."""
_MIN_SAMPLES, _MAX_SAMPLES = 1024, 4096  # per shape
_ALL_SAMPLES = 200_000  # per folder
_MAX_CANDIDATES = 40  # maximum number of candidates for the medoid
_MAX_TILT = 30.0  # degrees: registered shapes rotated by less have the same orientation; set by hand
_SAME_TEMPLATE = "prepare it again, with `meshmatch prepare --template` and the options of the other folder"
_LANDMARKS_HINT = "either one vertex a line (-1: missing), or x, y and z of a point on each line"
ARRAYS = ("points", "normals", "landmarks", "template_landmarks")


@dataclass(frozen=True, eq=False)
class ShapeSamples:
    """Samples of N shapes in the template's frame, and their landmarks."""

    points: Float[Floats32, "N P 3"]  # in random order
    normals: Float[Floats32, "N P 3"]
    landmarks: Float[Floats32, "N L 3"]  # NaN where a shape lacks one; L may be 0
    template_landmarks: Int[Ints, " L"]  # vertices of the template's low resolution
    align: Align  # how every shape was aligned to the template
    scale: Scale


@dataclass(frozen=True, eq=False, repr=False)
class RegisteredShapes(ShortRepr):
    """N shapes on the vertices of a template, in its orientation, from fits with or without a trained model.

    ``orientation`` is the range of rotations of fits without a model, and ``mirror`` whether some were mirrored; both are
    for the card of a model that is trained on the shapes.

    `InputError` if the number of vertices is not the template's, or coordinates are not finite.
    """

    template: Template
    verts: Float[Floats, "N V 3"]
    name: str  # of the collection
    model: str  # name or folder of the model, or "none"
    orientation: Align | None = None
    mirror: bool = False

    def __post_init__(self) -> None:
        V, shape = self.template.shape.V, np.shape(self.verts)
        if len(shape) != 3 or shape[1:] != (V, 3) or not np.isfinite(self.verts).all():
            raise InputError(
                f"{self.name}: shapes of {V} vertices with finite coordinates are needed, (N, {V}, 3), not {shape}",
                "take those of `Collection.to_learn`",
            )


def same_faces(like: Repaired, found: list[Repaired]) -> bool:
    """Whether all shapes have the vertex count and triangles of one."""
    first = like.original
    return not first.is_cloud and all(
        clean.original.V == first.V and np.array_equal(clean.original.faces, first.faces) for clean in found
    )


def registered_stack(
    first: Repaired, found: list[Repaired], vertices: Int[Ints, " V"], notes: list[str]
) -> Float[Floats32, "N V 3"]:
    """Stack the vertices of shapes that share the first one's connectivity; N = 0 unless all shapes do.

    Shapes in which vertices lack a position are left out, with a note.
    """
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
    # Centred before conversion to float32, in which coordinates far from the origin would lose precision.
    return np.asarray((chosen - chosen.mean(1, keepdims=True)).astype(np.float32))


def rotation_range(stack: Float[Floats32, "N V 3"], like: Float[Floats, "V 3"]) -> Align:
    """How registered shapes have to be aligned with the template's vertices ``like``: "near" or "rigid".

    For `SMALL_DATA` shapes or more "none", without a computation.
    """
    if len(stack) >= SMALL_DATA:
        return "none"
    cosines = [(np.trace(kabsch(like, verts.astype(np.float64)).rotation) - 1) / 2 for verts in stack]
    return "near" if min(cosines) > np.cos(np.radians(_MAX_TILT)) else "rigid"


def medoid(shapes: Sequence[Repaired], how: Align, scale: Scale, seed: int, either_side: bool = False) -> int:
    """Index of the shape with the smallest mean distance to the others, after alignment; a mesh, if there is one.

    Of many shapes only some are compared. With ``either_side``, shapes are mirrored where that brings them nearer to the
    first.
    """
    pool = [k for k, one in enumerate(shapes) if not one.shape.is_cloud] or list(range(len(shapes)))
    pool = [pool[k] for k in np.unique(np.linspace(0, len(pool) - 1, min(len(pool), _MAX_CANDIDATES)).astype(int))]
    aligned: list[OrientedPoints] = []
    for k in pool:
        shape = shapes[k].shape
        part = sample_surface(shape, 800, np.random.default_rng(seed)).in_frame(unit_frame(shape, scale, 0.5))
        if aligned:
            sides = [part, mirror_image(part)] if either_side else [part]
            found = [align(side, aligned[0], how)[0] for side in sides]
            nearest = int(np.argmin([each.residual for each in found]))
            part = sides[nearest].to_local(found[nearest].pose)
        aligned.append(part)
    distance = np.zeros((len(aligned), len(aligned)))
    for i, j in combinations(range(len(aligned)), 2):
        distance[i, j] = distance[j, i] = alignment_residual(aligned[j], aligned[i])
    return pool[int(distance.sum(1).argmin())]


def collect_samples(
    template: Template,
    shapes: Sequence[Repaired],
    landmarks: Sequence[Float[Floats, "L 3"] | None],
    template_landmarks: Float[Floats, "L 3"] | None,
    turns: Sequence[Float[Floats, "3 3"] | None],
    how: Align,
    scale: Scale,
    seed: int,
    progress: Progress,
) -> tuple[ShapeSamples, list[Frame], list[float]]:
    """Align all shapes to the template and sample them.

    ``turns`` are rotations from files to the template, where known. Landmarks of shapes are in the frames of their files,
    NaN where missing; those of the template are in its frame. Returns the samples, the frame of each shape (file to
    template), and its residual against the template.
    """
    target, radius = template_samples(template), template_radius(template)
    P = int(np.clip(_ALL_SAMPLES // len(shapes), _MIN_SAMPLES, _MAX_SAMPLES))
    rng = np.random.default_rng(seed)
    places = np.zeros((0, 3)) if template_landmarks is None else template_landmarks
    points, normals, frames, residuals = [], [], [], []
    known = np.full((len(shapes), len(places), 3), np.nan, np.float32)
    for number, (one, marks, turn) in enumerate(zip(shapes, landmarks, turns, strict=True)):
        frame = unit_frame(one.shape, scale, radius)
        frame = frame if turn is None else replace(frame, rotation=turn)
        part = sample_surface(one.shape, P, rng).in_frame(frame)
        best = align(part, target, how if turn is None else "near")[0]
        part = part.to_local(best.pose)
        points.append(part.points)
        normals.append(part.normals)
        frames.append(frame.compose(best.pose.frame))
        residuals.append(best.residual)
        if len(places) and marks is not None:
            known[number] = frames[-1].apply(marks)
        progress((number + 1) / len(shapes))
    vertices = np.linalg.norm(template.shape.verts - places[:, None], axis=2).argmin(1).astype(np.int64)
    stack = [np.stack(each).astype(np.float32) for each in (points, normals)]
    return ShapeSamples(stack[0], stack[1], known, vertices, how, scale), frames, residuals


@dataclass(frozen=True, eq=False)
class KnownPoints:
    """Landmarks of a shape, in its file's frame."""

    points: Float[Floats, "L 3"]  # NaN for a missing one
    names: tuple[str, ...]  # () if the file has none


def read_landmarks(file: Path, clean: Repaired) -> Float[Floats, "L 3"]:
    """Read the landmarks of a shape, in its file's frame, NaN where missing; see `read_known_points`."""
    return read_known_points(file, clean).points


def read_known_points(file: Path, clean: Repaired, space: Space = "") -> KnownPoints:
    """Read the landmarks of a shape: vertices, points of faces, or positions, in any supported format.

    Parameters
    ----------
    file
        The file of landmarks.
    clean
        The shape, repaired; vertices and faces are those of its file.
    space
        The frame that 3D Slicer gave the shape's file (`mesh_space`).

    Raises
    ------
    InputError
        The file cannot be read, or names a vertex or face that does not exist.
    """
    readers = dict.fromkeys(LANDMARK_READERS, lambda path: read_landmark_file(path, clean.original.name, space))
    found = read_by_suffix(file, readers, "landmarks", _LANDMARKS_HINT)
    if found.turned:
        warn(found.turned)
    original, points = clean.original, np.full((len(found.places), 3), np.nan)
    for k, place in enumerate(found.places):
        if place.kind == "position":
            points[k] = place.where
        elif place.kind != "missing":
            limit = original.F if place.kind == "face" else original.V
            number = place.where[0] if place.kind == "face" else place.where
            if not 0 <= number < limit:
                problem = f"{file.name} names {place.kind} {number}, but {original.name} has {limit}"
                raise InputError(problem, "they are counted from 0; vertex -1 is a missing one")
            corners = original.faces[number] if place.kind == "face" else [number]
            weights = place.where[1] if place.kind == "face" else [1.0]
            points[k] = weights @ clean.shape.verts[clean.original_to_repaired[corners]]
    return KnownPoints(points, tuple(place.name for place in found.places) if found.has_names else ())


def sort_by_name(known: Sequence[KnownPoints | None]) -> list[Float[Floats, "L 3"] | None]:
    """Sort the landmarks of shapes by name, in the order of first occurrence, NaN where missing.

    Unless all shapes with landmarks have unique names and share some, landmarks are returned in the order of their files.
    """
    named = [one for one in known if one is not None]
    together = set.intersection(*(set(one.names) for one in named)) if named else set()
    if not together or any(len(set(one.names)) < len(one.names) for one in named):
        return [None if one is None else one.points for one in known]
    order = list(dict.fromkeys(name for one in named for name in one.names))
    found: list[Float[Floats, "L 3"] | None] = []
    for one in known:
        place = {} if one is None else dict(zip(one.names, one.points, strict=True))
        rows = np.array([place.get(name, np.full(3, np.nan)) for name in order])
        found.append(None if one is None else rows)
    return found


def find_landmarks(where: str | Path | None, folder: Path, files: Sequence[Path]) -> list[Path | None]:
    """Find the landmark file of every shape: in the folder ``where``, or next to the shape with the suffix ``where``.

    None where a shape has no such file; `OptionError` if no shape has one.
    """
    if where is None:
        return [None] * len(files)
    place, suffixes = folder, [str(where)]
    if Path(where).is_dir():
        kinds = (".npy", ".txt", ".csv", ".mrk.json", ".json", ".fcsv", ".pp", ".pts", ".tps", ".landmarkAscii")
        place, suffixes = Path(where), [stem + kind for kind in kinds for stem in (".landmarks", "")]
    found = []
    for file in files:
        names = (place / f"{file.stem}{suffix}" for suffix in suffixes)
        found.append(next((name for name in names if name.is_file() and name != file), None))
    if not any(found):
        hint = "give a folder of NAME.npy files, or their suffix beside the shapes, such as .landmarks.npy"
        raise OptionError(f"no shape of {folder} has landmarks at {where}", hint)
    return found


def read_samples(folder: str | Path, template: Template) -> ShapeSamples:
    """Read the samples of a prepared folder; `InputError` if it is not one, or was prepared for another template."""

    def samples(arrays: dict[str, np.ndarray], words: dict[str, str]) -> ShapeSamples:
        found = ShapeSamples(
            **{name: arrays[name] for name in ARRAYS},
            align=next(how for how in ALIGNS if how == words["align"]),
            scale=next(kind for kind in SCALES if kind == words["scale"]),
        )
        N, P, _ = found.points.shape
        fits = found.normals.shape == (N, P, 3) and found.landmarks.shape[::2] == (N, 3)
        at = found.template_landmarks
        if not fits or len(at) != found.landmarks.shape[1] or (len(at) and at.max() >= template.shape.V):
            raise KeyError("arrays that do not belong together")
        return found

    return _read_arrays(as_path(folder), "points", template, samples)[1]


def read_registered(folder: str | Path, template: Template) -> Float[Floats32, "N V 3"]:
    """Read the registered shapes of a prepared folder.

    `InputError` if it is not one, was prepared for another template or scale, or its shapes are not registered.
    """
    words, shapes = _read_arrays(as_path(folder), "shapes", template, lambda arrays, _: arrays["verts"])
    if words.get("scale", "area") != "area":
        problem = (
            f"{folder} was prepared with --scale {words['scale']}, but registered shapes are learned at equal areas"
        )
        raise InputError(problem, "prepare it with --scale area, or learn without correspondence (--unsupervised)")
    if not len(shapes):
        hint = "learn without correspondence (--unsupervised); registered means the same triangles in every file"
        raise InputError(f"the shapes of {folder} do not share one connectivity", hint)
    return shapes


def prepared_facts(folder: str | Path) -> dict[str, Any]:
    """Read what ``prepared.json`` says of a prepared folder; `InputError` if the folder is not one."""
    try:
        return _read_facts(folder)
    except (OSError, ValueError) as error:
        raise _not_prepared(folder) from error


def check_prepared(folder: str | Path) -> None:
    """Raise `InputError` unless `prepare` made the folder."""
    prepared_facts(as_path(folder))


def is_registered(folder: str | Path) -> bool:
    """Whether the shapes of a prepared folder share one connectivity; True if it is not a prepared folder."""
    try:
        return _read_facts(folder).get("registered") is not False
    except (OSError, ValueError):
        return True  # reading the registered shapes then reports the error


def card_frame(folder: str | Path) -> dict[str, str] | None:
    """Card entry ``frame`` for models trained on a prepared folder with fewer than `SMALL_DATA` registered shapes.

    None for all other folders, including those scaled to equal radii: registered shapes are learned at equal areas.
    """
    try:
        facts = _read_facts(folder)
        if not facts["registered"] or facts["scale"] != "area" or len(facts["names"]) >= SMALL_DATA:
            return None
        return {"orientation": str(facts["align"]), "scale": "area"}
    except (OSError, ValueError, KeyError, TypeError):
        return None  # reading the shapes then reports the error


def has_sides(folder: str | Path) -> bool:
    """Whether shapes of a prepared folder were mirrored, so that shapes of the category have two sides."""
    try:
        return bool(_read_facts(folder).get("mirrored"))
    except (OSError, ValueError):
        return False  # reading the shapes then reports the error


def _read_arrays(
    folder: Path, name: str, template: Template, build: Callable[[dict[str, np.ndarray], dict[str, str]], T]
) -> tuple[dict[str, Any], T]:
    """Read ``prepared.json``, and build an object from the arrays and metadata of one of the folder's files."""
    try:
        facts = _read_facts(folder)
        with safe_open(str(folder / f"{name}.safetensors"), framework="np") as file:
            arrays = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (it is no dictionary)
            found = build(arrays, file.metadata() or {})
    except (OSError, ValueError, KeyError, StopIteration, SafetensorError) as error:
        raise _not_prepared(folder) from error
    if facts.get("template") != template.hash:
        raise InputError(f"{folder} was prepared for another template", _SAME_TEMPLATE)
    return facts, found


def _not_prepared(folder: str | Path) -> InputError:
    return InputError(f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first")


def _read_facts(folder: str | Path) -> dict[str, Any]:
    """Read ``prepared.json``; `ValueError` if it is missing, or not a JSON object."""
    try:
        facts = read_json(Path(folder) / "prepared.json")
    except InputError as error:
        raise ValueError(error.message) from error
    if not isinstance(facts, dict):
        raise ValueError("not an object")
    return facts
