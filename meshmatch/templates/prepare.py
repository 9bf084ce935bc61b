"""`meshmatch prepare`: a template bundle from one shape, and a folder of shapes made ready for training."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file
from scipy.spatial import cKDTree

from meshmatch.errors import InputError, MeshmatchError, TemplateError
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import SUFFIXES, load_shape, save_shape
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig, choose_nodes
from meshmatch.templates.template import Template, save_template

LOW_FACES = 10_000


@dataclass(frozen=True, eq=False)
class Prepared:
    """A folder made ready: the template, and the shapes that share its connectivity (or none).

    shapes : float32 array (N, V, 3), template vertices on every shape, its own frame and unit;
    empty if the folder's meshes are not registered. names : their files. notes : what was found and done.
    """

    template: Template
    shapes: np.ndarray
    names: tuple[str, ...]
    notes: tuple[str, ...]


def low_resolution(shape: Shape, faces: int = LOW_FACES) -> tuple[np.ndarray, np.ndarray]:
    """Decimate onto a subset of the shape's own vertices: kept indices (V,), faces (F, 3).

    Whatever belongs to a vertex (weights, labels, positions on registered shapes) is then kept by indexing.
    """
    if shape.F <= faces:
        return np.arange(shape.V), np.asarray(shape.faces)
    small = decimate(shape, faces)
    nearest = cKDTree(shape.verts).query(small.verts)[1]
    keep, renumbered = np.unique(nearest, return_inverse=True)
    corners = renumbered.reshape(-1)[small.faces]
    a, b, c = corners.T
    return keep, corners[(a != b) & (b != c) & (c != a)]


def make_template(
    shape: Shape,
    name: str,
    config: NodeConfig,
    *,
    labels: np.ndarray | None = None,
    label_names: Sequence[str] = (),
    core: np.ndarray | None = None,
    pose: str = "",
    source: str = "",
    licence: str = "",
    low: tuple[np.ndarray, np.ndarray] | None = None,
) -> Template:
    """Template bundle of a mesh.

    Parameters
    ----------
    shape : Shape
        Mesh of the resting category, any unit; becomes the dense mesh.
    labels : int array (V,), optional
        Part of every vertex of ``shape``; a single part where not given.
    core : int array, optional
        Vertices of ``shape`` that fix the category's frame; all where not given.
    low : (kept vertices, faces), optional
        A low resolution made before (see :func:`low_resolution`).

    Raises
    ------
    TemplateError
        If nodes cannot support every vertex.
    InputError
        If the shape has no faces.
    """
    if shape.is_cloud:
        raise InputError(f"{shape.name} has no faces", "a template is a triangle mesh")
    keep, faces = low_resolution(shape) if low is None else low
    small = Shape(shape.verts[keep], faces, name)
    frame = sqrt_area_frame(small)
    small = Shape(frame.apply(small.verts), faces, name)
    parts = np.zeros(shape.V, np.int64) if labels is None else np.asarray(labels, np.int64)
    if parts.shape != (shape.V,) or parts.min() < 0:
        raise TemplateError(
            f"{len(parts)} labels for {shape.V} vertices of {shape.name}", "one label a vertex, from 0"
        )
    names = tuple(label_names) or tuple(f"part {n}" for n in range(int(parts.max()) + 1))
    in_core = np.ones(shape.V, bool) if core is None else np.isin(np.arange(shape.V), core)
    return Template(
        name=name,
        shape=small,
        dense=Shape(frame.apply(shape.verts), shape.faces, name),
        nodes=choose_nodes(small, config, None if labels is None else parts[keep]),
        radius=config.radius,
        labels=parts[keep],
        label_names=names,
        core=np.flatnonzero(in_core[keep]),
        pose=pose,
        source=source,
        licence=licence,
    )


def prepare_folder(
    folder: str | Path,
    output: str | Path,
    config: NodeConfig,
    *,
    template: str | Path | None = None,
    faces: int = LOW_FACES,
    progress: Callable[[int, int], None] | None = None,
) -> Prepared:
    """Check, normalise and decimate every shape of a folder and lay a template for them.

    Writes ``template.safetensors``, ``shapes.safetensors`` (registered shapes), ``normalised/NAME.ply`` and, last,
    ``prepared.json``. Shapes are registered if all have the template file's vertex count and triangles.

    Raises
    ------
    InputError
        No usable shape in the folder; files that cannot be read are named in the notes instead.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"no shapes in {folder}", f"files that end in {', '.join(SUFFIXES)} are read")
    shapes: list[Shape] = []
    notes: list[str] = []
    (output / "normalised").mkdir(parents=True, exist_ok=True)
    for number, path in enumerate(files):
        try:
            shape = load_shape(path)
            clean = repair(shape)
        except MeshmatchError as error:
            notes.append(f"{path.name} left out: {error.message}")
            continue
        notes += [f"{path.name}: {note}" for note in clean.notes]
        shapes.append(shape)
        fixed = clean.shape
        small = fixed if fixed.is_cloud or fixed.F <= faces else decimate(fixed, faces)
        frame = sqrt_area_frame(small)
        save_shape(
            output / "normalised" / f"{path.stem}.ply",
            Shape(frame.apply(small.verts), small.faces, path.stem),
        )
        if progress is not None:
            progress(number + 1, len(files))
    if not shapes:
        raise InputError(f"no shape in {folder} could be used", notes[0])
    first = load_shape(template) if template is not None else shapes[0]
    made = make_template(
        first, folder.name, config, source=f"{first.name} of {folder.name}", low=low_resolution(first, faces)
    )
    same = [s for s in shapes if s.V == first.V and np.array_equal(s.faces, first.faces)]
    keep = low_resolution(first, faces)[0]
    registered = len(same) == len(shapes) and len(shapes) > 1
    stack = (
        np.stack([s.verts[keep] for s in same]).astype(np.float32)
        if registered
        else np.zeros((0, len(keep), 3), np.float32)
    )
    save_template(made, output / "template.safetensors")
    with replace_on_success(output / "shapes.safetensors") as temporary:
        save_file({"verts": stack}, temporary)
    names = tuple(s.name for s in shapes)
    words = {
        "names": names,
        "registered": registered,
        "notes": notes,
        "template": made.hash,
        "config": asdict(config),
    }
    with replace_on_success(output / "prepared.json") as temporary:
        Path(temporary).write_text(json.dumps(words, indent=1))
    return Prepared(made, stack, names, tuple(notes))


def read_registered(folder: str | Path, template: Template) -> np.ndarray:
    """Registered shapes (N, V, 3) of a prepared folder.

    Raises
    ------
    InputError
        Not a prepared folder, prepared for another template, or its shapes are not registered.
    """
    folder = Path(folder)
    try:
        words = json.loads((folder / "prepared.json").read_text())
        shapes = load_file(folder / "shapes.safetensors")["verts"]
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise InputError(
            f"{folder} is not a prepared folder", "run `meshmatch prepare FOLDER -o OUT` first"
        ) from error
    if words.get("template") != template.hash:
        raise InputError(f"{folder} was prepared for another template", "prepare it again")
    if not len(shapes):
        raise InputError(
            f"the shapes of {folder} do not share one connectivity",
            "training needs registered meshes: the same vertices and triangles in every file",
        )
    return shapes
