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

from meshmatch.errors import InputError, MeshmatchError, OutputError, TemplateError
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import SUFFIXES, load_shape, save_shape
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig, choose_nodes
from meshmatch.templates.template import Template, save_template

LOW_FACES = 10_000


@dataclass(frozen=True, eq=False)
class Prepared:
    """A folder made ready: the template, and the shapes that share its connectivity (or none).

    shapes : float32 array (N, V, 3), template vertices on every shape, its own axes and unit, centred;
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
    if parts.shape != (shape.V,):
        raise TemplateError(
            f"{len(parts)} labels for {shape.V} vertices of {shape.name}", "one label a vertex, from 0"
        )
    if parts.min() < 0:
        raise TemplateError(f"{shape.name} has a label below 0: {parts.min()}", "count parts from 0")
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
    ``prepared.json``. The template is made from the template file, else from the first mesh, after repair. Shapes
    are registered if all have that file's vertex count and triangles.

    Raises
    ------
    InputError
        No usable shape in the folder; files that cannot be read are named in the notes instead.
    OutputError
        The output folder cannot be written.
    """
    folder, output = Path(folder), Path(output)
    files = sorted(p for p in folder.glob("*") if p.suffix.lower() in SUFFIXES)
    if not files:
        raise InputError(f"no shapes in {folder}", f"files that end in {', '.join(SUFFIXES)} are read")
    _make_folder(output / "normalised")
    found: list[Repaired] = []
    notes: list[str] = []
    stems = [path.stem for path in files]
    for number, path in enumerate(files):
        try:
            clean = repair(load_shape(path))
            normal = _normalised(clean.shape, faces)
        except MeshmatchError as error:
            notes.append(f"{path.name} left out: {error.message}")
        else:
            notes += [f"{path.name}: {note}" for note in clean.notes]
            found.append(clean)
            name = path.stem if stems.count(path.stem) == 1 else path.name
            save_shape(output / "normalised" / f"{name}.ply", normal)
        if progress is not None:
            progress(number + 1, len(files))
    if not found:
        raise InputError(f"no shape in {folder} could be used", notes[0])
    if template is not None:
        first = repair(load_shape(template))
    else:
        first = next((clean for clean in found if not clean.shape.is_cloud), found[0])
    low = low_resolution(first.shape, faces)
    name = folder.resolve().name
    made = make_template(first.shape, name, config, source=f"{first.original.name} of {folder.name}", low=low)
    stack = _registered(first, found, first.kept_vertex[low[0]], notes)
    save_template(made, output / "template.safetensors")
    with replace_on_success(output / "shapes.safetensors") as temporary:
        save_file({"verts": stack}, temporary)
    names = tuple(clean.original.name for clean in found)
    words = {
        "names": names,
        "registered": len(stack) > 0,
        "notes": notes,
        "template": made.hash,
        "config": asdict(config),
    }
    with replace_on_success(output / "prepared.json") as temporary:
        Path(temporary).write_text(json.dumps(words, indent=1), encoding="utf-8")
    return Prepared(made, stack, names, tuple(notes))


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the folder {folder}: {error.strerror}", "choose another folder"
        ) from error


def _normalised(shape: Shape, faces: int) -> Shape:
    """A shape of at most so many faces with area 1, centred."""
    small = shape if shape.is_cloud or shape.F <= faces else decimate(shape, faces)
    return Shape(sqrt_area_frame(small).apply(small.verts), small.faces, small.name)


def _registered(first: Repaired, found: list[Repaired], vertices: np.ndarray, notes: list[str]) -> np.ndarray:
    """Vertices (N, V, 3) of the shapes that share the first one's connectivity; N = 0 unless all of them do."""
    like = first.original
    same = all(
        clean.original.V == like.V and np.array_equal(clean.original.faces, like.faces) for clean in found
    )
    whole = []
    for clean in found if same and not like.is_cloud else ():
        invalid = clean.original.invalid
        if invalid is None or not invalid[vertices].any():
            whole.append(clean.original.verts[vertices])
        else:
            notes.append(f"{clean.original.name}: not among the registered shapes, vertices lack a position")
    if len(whole) < 2:
        return np.zeros((0, len(vertices), 3), np.float32)
    chosen = np.stack(whole)
    # Centred before the numbers become short: a scan in a surveyor's coordinates would lose its digits.
    return (chosen - chosen.mean(1, keepdims=True)).astype(np.float32)


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
