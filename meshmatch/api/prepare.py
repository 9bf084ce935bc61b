"""`prepare`: check and normalise shapes for training, and make a template for them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import MINIMUM_FACES, MINIMUM_POINTS
from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints, ShortRepr
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.direct import MIRROR
from meshmatch.fitting.kind_templates import mean_shape, template_of, with_more_nodes
from meshmatch.fitting.reference_statistics import MIN_FITS, drop_poor, have_sides
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.without_model import RigidAlignment, align_by_fits, fit_rotated
from meshmatch.geometry.trees import cKDTree
from meshmatch.outputs import as_path, folder_on_success, make_folder
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.alignment import Align, Mirroring, sqrt_area_frame
from meshmatch.shapes.decimate import Quality, decimate
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape, save_shape
from meshmatch.shapes.input_files import suffix_of
from meshmatch.shapes.landmark_files import mesh_space
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates import prepared_folder
from meshmatch.templates.make import LOW_FACES, NodeConfig, low_mesh, make_template
from meshmatch.templates.mirror_images import find_mirrored, is_mirrored, mirrored
from meshmatch.templates.prepared_folder import MAX_RESIDUAL, find_landmarks
from meshmatch.templates.template import Scale, Template, save_arrays, save_template
from meshmatch.threads import parallel_map

_ARRAYS = tuple(f"{name}.safetensors" for name in ("template", "points", "shapes"))
_WRITTEN = (*_ARRAYS, "normalised", "prepared.json", "nodes.png")
_MAX_SIDES = 200  # shapes of a folder up to which mirror images are searched: it takes a second or two per shape
_MAX_AVERAGED = 60  # shapes that are averaged
# Share of the shapes that must be in the template's pose, up to a rotation; else none is rotated to it. Set by hand.
_MIN_ALIKE = 0.8


@dataclass(frozen=True, repr=False)
class PrepareConfig(ShortRepr):
    """How shapes are prepared.

    Attributes
    ----------
    nodes
        How the nodes of the template are placed.
    faces
        Number of triangles after decimation.
    decimate
        How shapes are decimated, see `meshmatch.shapes.decimate.decimate`.
    template
        The template: the name of a shape in the folder, or any file. By default the first mesh if all shapes are registered,
        else the medoid, the shape nearest to all others; of five or more shapes in the same pose, the mean of those to
        which the medoid could be fitted, on its vertices.
    align
        How shapes are rotated to the template. By default "rigid"; for registered shapes "near" if their correspondence
        shows that they share an orientation, and "none" for a hundred or more of them.
    scale
        Which size of every shape is scaled to that of the template: the "area", or the radius around the centroid
        ("sphere").
    mirror
        Mirror shapes of the other side than most, or than a named template ("auto"); or never ("no").
    landmarks
        Folder or suffix of landmark files, see `find_landmarks`.
    labels
        (V,) part of every vertex in the file of a single shape, counted from 0; for the node strategy "parts".
    """

    nodes: NodeConfig = field(default_factory=lambda: NodeConfig(strategy="geodesic"))
    faces: int = LOW_FACES
    decimate: Quality = "fast"
    template: str | Path | None = None
    align: Align | None = None
    scale: Scale = "area"
    mirror: Mirroring = "auto"
    landmarks: str | Path | None = None
    labels: Int[Ints, " V"] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(ShortRepr):
    """The result of `prepare`: a template, and the registered shapes.

    Attributes
    ----------
    template
        The template.
    shapes
        (N, V, 3) the template's vertices on each registered shape, in its own axes and unit, centred; N = 0 unless all
        shapes are registered.
    names
        Names of the shapes' files.
    notes
        What was found and changed.
    align
        How shapes were rotated to the template.
    mirrored
        Names of the shapes that were mirrored.
    landmarks
        Number of known points on each shape.
    """

    template: Template
    shapes: Float[Floats32, "N V 3"]
    names: tuple[str, ...]
    notes: tuple[str, ...]
    align: Align = "none"
    mirrored: tuple[str, ...] = ()
    landmarks: int = 0


def prepare(
    shapes: str | Path,
    output: str | Path,
    config: PrepareConfig | None = None,
    progress: ProgressCallback | None = None,
) -> Prepared:
    """Prepare a folder of shapes for training, or make a template from a single shape.

    The shapes of a folder are checked, normalised, decimated and aligned with the template. The output is
    ``template.safetensors`` and, for a folder, ``shapes.safetensors`` (registered shapes), ``points.safetensors``
    (samples of all shapes in the template's frame), ``normalised/NAME.ply`` and ``prepared.json``. For a folder, the output
    is written completely or not at all, and replaces that of an earlier call. Shapes are registered if all have the vertex
    count and triangles of the template's file.

    Parameters
    ----------
    shapes
        A folder of shapes, or one file.
    output
        A new folder, or the output of an earlier call.
    config
        Template, nodes, alignment and decimation.
    progress
        As in `match`.

    Returns
    -------
    Prepared
        The template, the registered shapes, and notes, for example on files that cannot be read.

    Raises
    ------
    InputError
        No shape is usable, or most shapes do not resemble the template.
    OptionError
        Landmark files are missing, or options contradict each other.
    TemplateError
        The nodes do not reach every vertex.
    OutputError
        The folder cannot be written.

    Examples
    --------
    >>> prepared = meshmatch.prepare("my-shapes", "prepared")
    >>> meshmatch.train("my-model", shapes="prepared")
    >>> meshmatch.match("a.ply", "b.ply", model="./my-model")
    """
    shapes, output, config = as_path(shapes), as_path(output), config or PrepareConfig()
    if (config.nodes.strategy == "parts") != (config.labels is not None):
        raise OptionError("strategy 'parts' and labels need each other", "give both, or choose another strategy")
    if shapes.is_dir():
        if config.labels is not None:
            raise OptionError("labels are of one shape, not of a folder", "name the shape itself")
        if output.resolve() in (shapes.resolve(), *shapes.resolve().parents):
            raise OptionError(f"cannot prepare {shapes} into itself", "choose another folder with -o")
        make_folder(output.parent)
        stage = Progress(progress, shapes.name).stage("checking and aligning")
        with folder_on_success(output, replaces=_WRITTEN) as folder:
            return _prepare_folder(shapes, folder, config, stage)
    for name in ("template", "align", "landmarks"):
        if getattr(config, name) is not None:
            raise OptionError(f"{name} applies to a folder of shapes", "one shape is its own template")
    make_folder(output)
    clean = _read_template_shape(shapes)
    labels = config.labels
    if labels is not None:
        if len(labels) != clean.original.V:
            problem = f"there are {len(labels)} labels, but {clean.original.name} has {clean.original.V} vertices"
            raise InputError(problem, "give one label for every vertex of the file")
        labels = labels[clean.kept_vertex]
    low = low_mesh(clean.shape, config.faces, config.decimate)
    made = make_template(clean.shape, shapes.stem, config.nodes, labels=labels, low=low)
    made = replace(made, source=shapes.name)
    save_template(made, output / "template.safetensors")
    no_shapes = np.zeros((0, made.shape.V, 3), np.float32)
    return Prepared(made, no_shapes, (shapes.name,), tuple(clean.notes))


def _prepare_folder(folder: Path, output: Path, config: PrepareConfig, progress: Progress) -> Prepared:
    notes: list[str] = []
    found, landmarks = _read_shapes(folder, config, notes, progress.between(0.0, 0.5))
    named = _named_template(folder, config, found)
    chosen, why = _choose_template(named, config, found)
    orientations = _compare_orientations(chosen, config, found, progress.between(0.5, 0.6))
    if orientations is None:
        flags = _find_mirror_images(found, config, named, progress.between(0.5, 0.6))
        turns: list[Float[Floats, "3 3"] | None] = [None] * len(found)
    else:
        flags, turns = orientations.turned(config.mirror != "no", others_than_most=named is None)
    _mirror_flagged(found, landmarks, flags, notes)
    if named is None and flags.any():  # after mirroring, another shape may be the medoid
        chosen, why = _choose_template(None, config, found)
        turns = _turns_relative_to(chosen, turns)
    template_shape, own_index = (found[chosen], chosen) if isinstance(chosen, int) else (chosen, None)
    low = low_mesh(template_shape.shape, config.faces, config.decimate)
    vertices = template_shape.kept_vertex[low[0]]
    stack = prepared_folder.registered_stack(template_shape, found, vertices, notes)
    registered = len(stack) > 0
    default_align = (
        prepared_folder.rotation_range(stack, template_shape.original.verts[vertices]) if registered else "rigid"
    )
    align: Align = config.align or default_align
    name = folder.resolve().name
    made, source = make_template(template_shape.shape, name, config.nodes, low=low), template_shape.original.name
    use_mean = orientations is not None and named is None
    if use_mean:
        made, count = _mean_template(made, found, turns, config.nodes, progress.between(0.6, 0.8))
        source = f"the mean of {count} shapes, on the vertices of {source}" if count else source
    if named is None:
        notes.append(f"template: {source}{why}")
    made = replace(made, source=f"{source} of {folder.name}")
    template_landmarks = None
    if config.landmarks is not None:
        template_landmarks = _template_landmarks(
            template_shape, None if own_index is None else landmarks[own_index], landmarks
        )
        template_landmarks = made.shape.verts[cKDTree(template_shape.shape.verts[low[0]]).query(template_landmarks)[1]]
    samples, frames, residuals = prepared_folder.collect_samples(
        *(made, found, landmarks, template_landmarks, turns, align, config.scale, config.nodes.seed),
        progress.between(0.8 if use_mean else 0.6, 1.0),
    )
    if not registered and np.median(residuals) > MAX_RESIDUAL:
        distance_note = f"aligned, they lie {100 * np.median(residuals):.0f} % of sqrt(area) apart"
        hint = "name one of the shapes with --template, or try another --align or --scale"
        raise InputError(f"most shapes of the folder do not resemble the template {name}: {distance_note}", hint)
    stems = [Path(clean.original.name).stem for clean in found]
    make_folder(output / "normalised")
    for clean, stem, frame, residual in zip(found, stems, frames, residuals, strict=True):
        file_stem = stem if stems.count(stem) == 1 else clean.original.name
        is_large = clean.shape.F > config.faces
        decimated = decimate(clean.shape, config.faces, config.decimate) if is_large else clean.shape
        normalised = Shape(frame.apply(decimated.verts), decimated.faces, decimated.name)
        save_shape(output / "normalised" / f"{file_stem}.ply", normalised)
        if residual > MAX_RESIDUAL and not registered:
            distance = f"aligned, it lies {100 * residual:.0f} % of sqrt(area) away"
            notes.append(f"{clean.original.name} differs much from the template: {distance}")
    save_template(made, output / "template.safetensors")
    arrays = {name: getattr(samples, name) for name in prepared_folder.ARRAYS}
    save_arrays(output / "points.safetensors", arrays, {"align": samples.align, "scale": samples.scale})
    save_arrays(output / "shapes.safetensors", {"verts": stack})
    names = tuple(clean.original.name for clean in found)
    turned = tuple(name for name, flag in zip(names, flags, strict=True) if flag)
    record: dict[str, Any] = {"names": names, "registered": registered, "notes": notes, "template": made.hash}
    record |= {"source": source, "align": align, "scale": config.scale, "mirrored": turned}
    record["landmarks"] = samples.landmarks.shape[1]
    record["frames"] = [
        {"scale": f.scale, "rotation": f.rotation.tolist(), "center": f.center.tolist()} for f in frames
    ]
    record |= {"apart": [round(residual, 5) for residual in residuals], "config": asdict(config.nodes)}
    (output / "prepared.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    return Prepared(made, stack, names, tuple(notes), align, turned, samples.landmarks.shape[1])


def _read_shapes(
    folder: Path, config: PrepareConfig, notes: list[str], progress: Progress
) -> tuple[list[Repaired], list[Float[Floats, "L 3"] | None]]:
    """Read and repair the usable shapes of a folder, with the landmarks of each; add notes on the others."""
    files = sorted(path for path in folder.glob("*") if suffix_of(path) in PLAIN_SUFFIXES)
    landmark_files = find_landmarks(config.landmarks, folder, files)
    pairs = [pair for pair in zip(files, landmark_files, strict=True) if pair[0] not in landmark_files]
    if not pairs:
        raise InputError(f"no shapes in {folder}", f"files that end in {', '.join(PLAIN_SUFFIXES)} are read")
    nested = (path for path in folder.glob("[!.]*/**/*") if suffix_of(path) in PLAIN_SUFFIXES)
    if subfolders := {path.relative_to(folder).parts[0] for path in nested}:
        notes.append(
            f"left out, as subfolders of {folder.name} are not searched: shapes of {', '.join(sorted(subfolders))}"
        )
    found: list[Repaired] = []
    known: list[prepared_folder.KnownPoints | None] = []
    for number, (path, file) in enumerate(pairs):
        try:
            clean = _check_size(repair(load_shape(path)))
        except MeshmatchError as error:
            notes.append(f"{path.name} left out: {error.message}")
        else:
            notes += [f"{path.name}: {note}" for note in clean.notes]
            found.append(clean)
            space = mesh_space(path)
            known.append(None if file is None else prepared_folder.read_known_points(file, clean, space))
        progress((number + 1) / len(pairs))
    if not found:
        raise InputError(f"no shape in {folder} could be used", notes[0])
    return found, prepared_folder.sort_by_name(known)


@dataclass(frozen=True, eq=False)
class _Orientations:
    """How each shape, and its mirror image, is oriented relative to a template that is only rotated."""

    plain: Sequence[RigidAlignment]
    image: Sequence[RigidAlignment]

    def turned(
        self, mirror: bool, others_than_most: bool
    ) -> tuple[Bool[Bools, " N"], list[Float[Floats, "3 3"] | None]]:
        """Decide which shapes to mirror, and how each is then rotated to the template.

        Shapes of the other side than the template are mirrored; with ``others_than_most``, those of the other side than
        most shapes, which may include the template. A rotation is None if the shape is in another pose.
        """
        leads = np.log([other.stretch / one.stretch for one, other in zip(self.plain, self.image, strict=True)])
        flags = (leads < 0) & (mirror and have_sides(leads.tolist()))
        found = [other if flag else one for one, other, flag in zip(self.plain, self.image, flags, strict=True)]
        turns = [each.frame.rotation if each.alike else None for each in found]
        if others_than_most and flags.sum() > len(flags) / 2:
            return ~flags, [None if turn is None else MIRROR.rotation @ turn @ MIRROR.rotation for turn in turns]
        return flags, turns


def _turns_relative_to(
    chosen: int | Repaired, turns: list[Float[Floats, "3 3"] | None]
) -> list[Float[Floats, "3 3"] | None]:
    """Rotations of the shapes to the ``chosen`` one, given their rotations to the template; None where unknown."""
    own = turns[chosen] if isinstance(chosen, int) else None
    return [None if own is None or each is None else own.T @ each for each in turns]


def _compare_orientations(
    chosen: int | Repaired, config: PrepareConfig, found: list[Repaired], progress: Progress
) -> _Orientations | None:
    """Compare the orientations of the shapes with the template.

    Return None if no rotation is searched with these options and shapes, or if too many shapes are in another pose.
    """
    N = len(found)
    whole = found[chosen].shape if isinstance(chosen, int) else chosen.shape
    if config.align not in (None, "rigid") or whole.is_cloud or not MIN_FITS <= N <= _MAX_SIDES:
        return None
    if prepared_folder.same_faces(found[0], found):
        return None
    template, others = template_of(whole, whole.name, ViscousConfig()), 0
    orientations: list[list[RigidAlignment]] = []
    for each in found:
        sides = [each.shape, mirrored(each.shape)]
        orientations.append(parallel_map(lambda shape: align_by_fits(template, shape, config.nodes.seed), sides))
        others += not any(side.alike for side in orientations[-1])
        if others > (1 - _MIN_ALIKE) * N:
            return None
        progress(len(orientations) / N)
    return _Orientations([plain for plain, _ in orientations], [image for _, image in orientations])


def _find_mirror_images(
    found: list[Repaired], config: PrepareConfig, named: Repaired | int | None, progress: Progress
) -> Bool[Bools, " N"]:
    """Find mirror images by aligning the shapes.

    Return flags for the shapes of the other side than most, or than the ``named`` template (a shape, or the index of one).
    """
    if config.mirror == "no" or len(found) > _MAX_SIDES or prepared_folder.same_faces(found[0], found):
        return np.zeros(len(found), bool)
    flags = find_mirrored(found, config.scale, config.nodes.seed, progress)
    if flags.any() and named is not None:
        if isinstance(named, int):
            other = bool(flags[named])
        else:
            one_side = [clean for clean, flag in zip(found, flags, strict=True) if not flag]
            other = is_mirrored(named, one_side, config.scale, config.nodes.seed)
        flags = flags ^ other
    return flags


def _mirror_flagged(
    found: list[Repaired], marks: list[Float[Floats, "L 3"] | None], flags: Bool[Bools, " N"], notes: list[str]
) -> None:
    """Mirror the flagged shapes and their landmarks, in place, and add a note."""
    for number in np.flatnonzero(flags):
        found[number] = repair(mirrored(found[number].original))
        if (known := marks[number]) is not None:
            marks[number] = known * [-1, 1, 1]
    if flags.any():
        names = [clean.original.name for clean, flag in zip(found, flags, strict=True) if flag]
        shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        notes.append(f"{len(names)} of {len(found)} shapes are mirror images of the others, and were mirrored: {shown}")


def _read_template_shape(path: Path) -> Repaired:
    """Read and repair the shape of a template; `InputError` if no template can be made from it."""
    try:
        return _check_size(repair(load_shape(path)))
    except InputError as error:
        if path.name in error.message:
            raise
        raise InputError(f"{path.name} cannot be a template: {error.message}", error.hint) from error


def _named_template(folder: Path, config: PrepareConfig, found: list[Repaired]) -> Repaired | int | None:
    """The template that the config names: the index of one of the shapes found, or another shape; None without a name."""
    if config.template is None:
        return None
    path = Path(config.template)
    same = path.is_file() and path.resolve().parent == folder.resolve()
    wanted = {str(config.template)} | ({path.name} if same else set())
    for number, clean in enumerate(found):
        if wanted & {clean.original.name, Path(clean.original.name).stem}:
            return number
    return _read_template_shape(path)


def _choose_template(
    named: Repaired | int | None, config: PrepareConfig, found: list[Repaired]
) -> tuple[int | Repaired, str]:
    """Choose the template: the index of one of the shapes found, or the named shape; and a note on why."""
    if named is not None:
        return named, ""
    number = next((k for k, clean in enumerate(found) if not clean.shape.is_cloud), 0)
    if len(found) == 1 or prepared_folder.same_faces(found[number], found):
        return number, ""
    number = prepared_folder.medoid(found, config.align or "rigid", config.scale, config.nodes.seed)
    return number, ", which lies nearest to all others on average"


def _mean_template(
    template: Template,
    found: list[Repaired],
    turns: list[Float[Floats, "3 3"] | None],
    nodes: NodeConfig,
    progress: Progress,
) -> tuple[Template, int]:
    """Move the template's vertices to the mean of the shapes that are in its pose, up to a rotation.

    Return the new template and the number of shapes averaged; the same template and 0 if none can be fitted.
    """
    viscous, fits = ViscousConfig(seed=nodes.seed), []
    finer = with_more_nodes(template, viscous)
    alike = [(clean.shape, turn) for clean, turn in zip(found, turns, strict=True) if turn is not None]
    sampled = np.unique(np.linspace(0, len(alike) - 1, min(len(alike), _MAX_AVERAGED)).astype(int))
    for shape, turn in (alike[number] for number in sampled):
        fits.append(fit_rotated(finer, shape, turn, viscous))
        progress(len(fits) / len(sampled))
    sound = drop_poor(fits)
    if not sound:
        return template, 0
    mean = Shape(mean_shape(finer, sound), template.shape.faces)
    low = np.arange(mean.V), np.asarray(mean.faces)
    return make_template(mean, template.name, nodes, low=low), len(sound)


def _template_landmarks(
    first: Repaired, own: Float[Floats, "L 3"] | None, marks: list[Float[Floats, "L 3"] | None]
) -> Float[Floats, "L 3"]:
    """Landmarks of the template's shape; `InputError` if it lacks some, or the shapes have different numbers of them."""
    sizes = {len(each) for each in marks if each is not None}
    if len(sizes) > 1:
        problem = f"landmark files of {min(sizes)} and of {max(sizes)} points"
        raise InputError(problem, "row k is the same point on every shape: write -1 where it is missing")
    if own is None or not np.isfinite(own).all():
        problem = f"the template {first.original.name} has no landmarks, or not all of them"
        raise InputError(problem, "choose with --template a shape of the folder on which every landmark is known")
    return own


def _check_size(clean: Repaired) -> Repaired:
    """Return the shape; `InputError` if it has too few points or faces, or no area."""
    shape = clean.shape
    if shape.is_cloud and shape.V < MINIMUM_POINTS:
        places = "place" if shape.V == 1 else "places"
        raise InputError(f"it has points in only {shape.V} {places}", f"at least {MINIMUM_POINTS} are needed")
    if not shape.is_cloud and shape.F < MINIMUM_FACES:
        triangles = "triangle" if shape.F == 1 else "triangles"
        raise InputError(f"it has only {shape.F} usable {triangles}", f"at least {MINIMUM_FACES} are needed")
    sqrt_area_frame(shape)  # refuses a shape without area
    return clean
