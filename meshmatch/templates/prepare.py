"""`meshmatch prepare`: a folder of shapes made ready for training, with a template for them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from meshmatch.errors import InputError, MeshmatchError
from meshmatch.outputs import make_folder, replace_on_success
from meshmatch.shapes.align import Align
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import SUFFIXES, load_shape, save_shape
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.triangulate import triangulate_cloud
from meshmatch.templates.make import LOW_FACES, low_resolution, make_template
from meshmatch.templates.nodes import NodeConfig
from meshmatch.templates.registered import registered_stack, same_faces, turned
from meshmatch.templates.template import Template, save_template
from meshmatch.templates.unregistered import (
    STRANGE,
    Scale,
    find_known,
    gather,
    most_typical,
    prepared_words,
    read_known,
    save_gathered,
)

MINIMUM_FACES = 50
MINIMUM_POINTS = 100


@dataclass(frozen=True, eq=False)
class Prepared:
    """A folder made ready: the template, and the shapes that share its connectivity (or none).

    shapes : float32 array (N, V, 3), template vertices on every shape, its own axes and unit, centred;
    empty if the folder's meshes are not registered. names : their files. notes : what was found and done.
    align : how shapes were turned to the template. landmarks : how many points are known on each.
    """

    template: Template
    shapes: np.ndarray
    names: tuple[str, ...]
    notes: tuple[str, ...]
    align: Align = "none"
    landmarks: int = 0


def prepare_folder(
    folder: str | Path,
    output: str | Path,
    config: NodeConfig,
    *,
    template: str | Path | None = None,
    faces: int = LOW_FACES,
    align: Align | None = None,
    scale: Scale = "area",
    landmarks: str | Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Prepared:
    """Check, normalise and decimate every shape of a folder and lay a template for them.

    Writes ``template.safetensors``, ``shapes.safetensors`` (registered shapes), ``points.safetensors`` (samples of
    all shapes in the template's frame), ``normalised/NAME.ply`` and, last, ``prepared.json``. Shapes are registered if
    all have the vertex count and triangles of the template's file.

    Parameters
    ----------
    template : name or path, optional
        A shape of the folder, by its name, or any file. By default the first mesh where all are registered, else the
        shape that lies nearest to all others.
    align : {"none", "near", "rigid"}, optional
        How shapes are turned to the template; by default "rigid". Of registered ones correspondence says whether
        they stand alike, which is "near"; of `FEW` or more it is not asked, which is "none".
    scale : {"area", "sphere"}
        Which size of every shape is made that of the template.
    landmarks : folder or suffix, optional
        Where the known points of shapes are, see `meshmatch.templates.unregistered`.

    Raises
    ------
    InputError
        No usable shape in the folder (files that cannot be read are named in the notes instead), or a template that
        is nothing like the shapes.
    OptionError
        No landmarks where they should be.
    OutputError
        The output folder cannot be written.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES)
    known_files = find_known(landmarks, folder, files)
    files = [path for path in files if path not in known_files]
    known_files = find_known(landmarks, folder, files)
    if not files:
        raise InputError(f"no shapes in {folder}", f"files that end in {', '.join(SUFFIXES)} are read")
    make_folder(output / "normalised")
    tell = progress or (lambda done, total: None)
    found: list[Repaired] = []
    known: list[np.ndarray | None] = []
    stems: list[str] = []
    notes: list[str] = []
    for number, path in enumerate(files):
        try:
            clean = _enough(repair(load_shape(path)))
        except MeshmatchError as error:
            notes.append(f"{path.name} left out: {error.message}")
        else:
            notes += [f"{path.name}: {note}" for note in clean.notes]
            found.append(clean)
            points_file = known_files[number]
            known.append(None if points_file is None else read_known(points_file, clean))
            stems.append(path.stem)
        tell(number + 1, 2 * len(files))
    if not found:
        raise InputError(f"no shape in {folder} could be used", notes[0])
    first, own = _template_shape(folder, template, found, scale, align, config.seed, notes)
    low = _low(first, faces)
    stack = registered_stack(first, found, first.kept_vertex[low[0]], notes)
    registered = len(stack) > 0
    how: Align = align or (
        turned(stack, first.original.verts[first.kept_vertex[low[0]]]) if registered else "rigid"
    )
    name = folder.resolve().name
    made = make_template(first.shape, name, config, source=f"{first.original.name} of {folder.name}", low=low)
    gathered, frames, far = gather(
        made,
        found,
        known,
        _template_known(first, own, known, landmarks, made, low),
        how,
        scale,
        config.seed,
        lambda done: tell(len(files) + done * len(files) // len(found), 2 * len(files)),
        strict=not registered,
    )
    for clean, stem, frame, distance in zip(found, stems, frames, far, strict=True):
        label = stem if stems.count(stem) == 1 else clean.original.name
        small = clean.shape if clean.shape.F <= faces else decimate(clean.shape, faces)
        normal = Shape(frame.apply(small.verts), small.faces, small.name)
        save_shape(output / "normalised" / f"{label}.ply", normal)
        if distance > STRANGE and not registered:
            notes.append(f"{clean.original.name} is not much like the template: {100 * distance:.0f} % apart")
    save_template(made, output / "template.safetensors")
    save_gathered(gathered, output / "points.safetensors")
    with replace_on_success(output / "shapes.safetensors") as temporary:
        save_file({"verts": stack}, temporary)
    names = tuple(clean.original.name for clean in found)
    words = {
        "names": names,
        "registered": registered,
        "notes": notes,
        "template": made.hash,
        "source": first.original.name,
        "align": how,
        "scale": scale,
        "landmarks": gathered.landmarks.shape[1],
        "frames": [
            {"scale": f.scale, "rotation": f.rotation.tolist(), "center": f.center.tolist()} for f in frames
        ],
        "apart": [round(distance, 5) for distance in far],
        "config": asdict(config),
    }
    with replace_on_success(output / "prepared.json") as temporary:
        Path(temporary).write_text(json.dumps(words, indent=1), encoding="utf-8")
    return Prepared(made, stack, names, tuple(notes), how, gathered.landmarks.shape[1])


def template_shape(path: str | Path) -> Repaired:
    """The shape of a file, repaired, if a template can be made of it; `InputError` otherwise."""
    try:
        return _enough(repair(load_shape(path)))
    except InputError as error:
        if Path(path).name in error.message:
            raise
        raise InputError(f"{Path(path).name} cannot be a template: {error.message}", error.hint) from error


def _template_shape(
    folder: Path,
    wanted: str | Path | None,
    found: list[Repaired],
    scale: Scale,
    how: Align | None,
    seed: int,
    notes: list[str],
) -> tuple[Repaired, int | None]:
    """The template's shape, and its number if it is one of those that were found."""
    if wanted is not None:
        for number, clean in enumerate(found):
            if str(wanted) in (clean.original.name, Path(clean.original.name).stem):
                return clean, number
        path = Path(wanted)
        same = path.is_file() and path.resolve().parent == folder.resolve()
        for number, clean in enumerate(found if same else ()):
            if clean.original.name == path.name:
                return clean, number
        return template_shape(path), None
    number = next((k for k, clean in enumerate(found) if not clean.shape.is_cloud), 0)
    if len(found) > 1 and not same_faces(found[number], found):
        number = most_typical(found, how or "rigid", scale, seed)
        notes.append(f"template: {found[number].original.name}, which lies nearest to all others on average")
    else:
        notes.append(f"template: {found[number].original.name}")
    return found[number], number


def _low(first: Repaired, faces: int) -> tuple[np.ndarray, np.ndarray]:
    return (
        triangulate_cloud(first.shape, faces) if first.shape.is_cloud else low_resolution(first.shape, faces)
    )


def _template_known(first, own, known, landmarks, made, low) -> np.ndarray | None:
    """Known points (L, 3) on the template, in its frame; None if there are none at all."""
    if landmarks is None:
        return None
    sizes = {len(places) for places in known if places is not None}
    if len(sizes) > 1:
        raise InputError(
            f"landmark files of {min(sizes)} and of {max(sizes)} points",
            "row k is the same point on every shape: write -1 where it is missing",
        )
    places = known[own] if own is not None else None
    if places is None or not np.isfinite(places).all():
        raise InputError(
            f"the template {first.original.name} has no landmarks, or not all of them",
            "choose with --template a shape of the folder on which every landmark is known",
        )
    # the way from the template's file to its frame, read off two of its vertices' places
    frame = sqrt_area_frame(Shape(first.shape.verts[low[0]], low[1], made.name))
    return frame.apply(places)


def _enough(clean: Repaired) -> Repaired:
    """The same shape, if there is enough of it to learn from; `InputError` otherwise."""
    shape = clean.shape
    if shape.is_cloud and shape.V < MINIMUM_POINTS:
        places = "place" if shape.V == 1 else "places"
        raise InputError(f"it has points in only {shape.V} {places}", f"at least {MINIMUM_POINTS} are needed")
    if not shape.is_cloud and shape.F < MINIMUM_FACES:
        raise InputError(f"it has only {shape.F} usable triangles", f"at least {MINIMUM_FACES} are needed")
    sqrt_area_frame(shape)
    return clean


def read_registered(folder: str | Path, template: Template) -> np.ndarray:
    """Registered shapes (N, V, 3) of a prepared folder.

    Raises
    ------
    InputError
        Not a prepared folder, prepared for another template or scale, or its shapes are not registered.
    """
    folder = Path(folder)
    try:
        words = prepared_words(folder)
        shapes = load_file(folder / "shapes.safetensors")["verts"]
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise InputError(
            f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first"
        ) from error
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
