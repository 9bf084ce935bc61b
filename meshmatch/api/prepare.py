"""`meshmatch prepare` as a library: shapes made ready for training, with a template for them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.api.inputs import MINIMUM_FACES, MINIMUM_POINTS
from meshmatch.arrays import Bool, Bools, Brief, Float, Floats, Floats32, Int, Ints
from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.fitting.direct import MIRROR
from meshmatch.fitting.kind_templates import mean_shape, template_of, with_more_nodes
from meshmatch.fitting.solve.viscous import ViscousConfig
from meshmatch.fitting.usual import FEWEST, believed, have_sides
from meshmatch.fitting.without_model import Standing, fit_turned, standing
from meshmatch.geometry.trees import cKDTree
from meshmatch.outputs import as_path, folder_on_success, make_folder
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.decimate import Quality, decimate
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape, save_shape
from meshmatch.shapes.input_files import suffix_of
from meshmatch.shapes.landmark_files import mesh_space
from meshmatch.shapes.normalise import Align, Mirroring, sqrt_area_frame
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.templates import prepared_folder
from meshmatch.templates.make import LOW_FACES, NodeConfig, low_mesh, make_template
from meshmatch.templates.prepared_folder import MAX_RESIDUAL, find_landmarks
from meshmatch.templates.sides import is_other_side, mirrored, other_side
from meshmatch.templates.template import Scale, Template, save_arrays, save_template
from meshmatch.threads import parallel_map

_ARRAYS = tuple(f"{name}.safetensors" for name in ("template", "points", "shapes"))
_WRITTEN = (*_ARRAYS, "normalised", "prepared.json", "nodes.png")
_MOST_SIDES = 200  # shapes among which sides are looked for: it takes a second or two a shape
_AVERAGED = 60  # of which the mean is made
_MOST_ALIKE = 0.8  # so many stand as the template does, or none is turned as if they did; set by hand


@dataclass(frozen=True, repr=False)
class PrepareConfig(Brief):
    """How shapes are prepared.

    The template is a shape of the folder, by its name, or any file; by default the first mesh where all are registered,
    else the medoid: the shape that lies nearest to all others; or, of five or more that stand alike, the mean of those
    that the medoid was fitted to. Shapes are turned to it by `align`, by default "rigid"; of registered ones
    correspondence says whether they stand alike, which is "near"; of a hundred or more it is not asked, which is "none".
    """

    nodes: NodeConfig = field(default_factory=lambda: NodeConfig(strategy="geodesic"))
    faces: int = LOW_FACES  # triangles of the low resolution
    decimate: Quality = "fast"  # how it is made, see `meshmatch.shapes.decimate.decimate`
    template: str | Path | None = None
    align: Align | None = None
    scale: Scale = "area"  # which size of every shape is made that of the template
    mirror: Mirroring = "auto"  # mirror those of the other side than most, or than a named template; or never
    landmarks: str | Path | None = None  # a folder or suffix: where they are, see `find_landmarks`
    labels: Int[Ints, " V"] | None = None  # part of every vertex of a single shape's file, from 0; for "parts"


@dataclass(frozen=True, eq=False, repr=False)
class Prepared(Brief):
    """The template, and the shapes that share its connectivity (or none)."""

    template: Template
    shapes: Float[Floats32, "N V 3"]  # its vertices on each, in own axes and unit, centered; N = 0 if not registered
    names: tuple[str, ...]  # files of the shapes
    notes: tuple[str, ...]  # what was found and done
    align: Align = "none"  # how shapes were turned to the template
    mirrored: tuple[str, ...] = ()  # names of those that were mirrored
    landmarks: int = 0  # how many points are known on each


def prepare(
    shapes: str | Path,
    output: str | Path,
    config: PrepareConfig | None = None,
    progress: ProgressCallback | None = None,
) -> Prepared:
    """Check, normalise and decimate every shape of a folder and make a template for them; or a template of one shape.

    Writes ``template.safetensors`` and, of a folder, ``shapes.safetensors`` (registered shapes), ``points.safetensors``
    (samples of all shapes in the template's frame), ``normalised/NAME.ply`` and ``prepared.json``. The folder appears
    whole or not at all; one that an earlier call wrote is replaced. Shapes are registered if all have the vertex count
    and triangles of the template's file.

    Parameters
    ----------
    shapes
        A folder of shapes, or one file.
    output
        A new folder, or one that this wrote before.
    config
        Template, nodes and decimation.
    progress
        As in `match`.

    Returns
    -------
    Prepared
        The folder, its template, and notes on files that cannot be read.

    Raises
    ------
    InputError
        No shape is usable, or the template is nothing like the shapes.
    OptionError
        There are no landmarks where they should be, or choices do not go together.
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
    clean = _template_file(shapes)
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
    none = np.zeros((0, made.shape.V, 3), np.float32)
    return Prepared(made, none, (shapes.name,), tuple(clean.notes))


def _prepare_folder(folder: Path, output: Path, config: PrepareConfig, progress: Progress) -> Prepared:
    notes: list[str] = []
    found, marks = _read_shapes(folder, config, notes, progress.between(0.0, 0.5))
    named = _named_template(folder, config, found)
    chosen, why = _chosen(named, config, found)
    stood = _standing(chosen, config, found, progress.between(0.5, 0.6))
    if stood is None:
        flags = _other_side(found, config, named, progress.between(0.5, 0.6))
        turns: list[Float[Floats, "3 3"] | None] = [None] * len(found)
    else:
        flags, turns = stood.turned(config.mirror != "no", others_than_most=named is None)
    _mirror_some(found, marks, flags, notes)
    if named is None and flags.any():  # of one side, another may lie nearest to all
        chosen, why = _chosen(None, config, found)
        turns = _turned_to(chosen, turns)
    first, own = (found[chosen], chosen) if isinstance(chosen, int) else (chosen, None)
    low = low_mesh(first.shape, config.faces, config.decimate)
    vertices = first.kept_vertex[low[0]]
    stack = prepared_folder.registered_stack(first, found, vertices, notes)
    registered = len(stack) > 0
    found_how = prepared_folder.rotation_range(stack, first.original.verts[vertices]) if registered else "rigid"
    how: Align = config.align or found_how
    name = folder.resolve().name
    made, source = make_template(first.shape, name, config.nodes, low=low), first.original.name
    middle = stood is not None and named is None
    if middle:
        made, count = _in_the_middle(made, found, turns, config.nodes, progress.between(0.6, 0.8))
        source = f"the mean of {count} shapes, on the vertices of {source}" if count else source
    if named is None:
        notes.append(f"template: {source}{why}")
    made = replace(made, source=f"{source} of {folder.name}")
    template_marks = None
    if config.landmarks is not None:
        template_marks = _template_landmarks(first, None if own is None else marks[own], marks)
        template_marks = made.shape.verts[cKDTree(first.shape.verts[low[0]]).query(template_marks)[1]]
    samples, frames, residuals = prepared_folder.collect_samples(
        *(made, found, marks, template_marks, turns, how, config.scale, config.nodes.seed),
        progress.between(0.8 if middle else 0.6, 1.0),
    )
    if not registered and np.median(residuals) > MAX_RESIDUAL:
        far = f"aligned, they lie {100 * np.median(residuals):.0f} % of sqrt(area) apart"
        hint = "name one of the shapes with --template, or try another --align or --scale"
        raise InputError(f"most shapes of the folder do not resemble the template {name}: {far}", hint)
    stems = [Path(clean.original.name).stem for clean in found]
    make_folder(output / "normalised")
    for clean, stem, frame, residual in zip(found, stems, frames, residuals, strict=True):
        label = stem if stems.count(stem) == 1 else clean.original.name
        large = clean.shape.F > config.faces
        small = decimate(clean.shape, config.faces, config.decimate) if large else clean.shape
        normal = Shape(frame.apply(small.verts), small.faces, small.name)
        save_shape(output / "normalised" / f"{label}.ply", normal)
        if residual > MAX_RESIDUAL and not registered:
            apart = f"aligned, it lies {100 * residual:.0f} % of sqrt(area) away"
            notes.append(f"{clean.original.name} differs much from the template: {apart}")
    save_template(made, output / "template.safetensors")
    arrays = {name: getattr(samples, name) for name in prepared_folder.ARRAYS}
    save_arrays(output / "points.safetensors", arrays, {"align": samples.align, "scale": samples.scale})
    save_arrays(output / "shapes.safetensors", {"verts": stack})
    names = tuple(clean.original.name for clean in found)
    turned = tuple(name for name, flag in zip(names, flags, strict=True) if flag)
    words: dict[str, Any] = {"names": names, "registered": registered, "notes": notes, "template": made.hash}
    words |= {"source": source, "align": how, "scale": config.scale, "mirrored": turned}
    words["landmarks"] = samples.landmarks.shape[1]
    words["frames"] = [{"scale": f.scale, "rotation": f.rotation.tolist(), "center": f.center.tolist()} for f in frames]
    words |= {"apart": [round(residual, 5) for residual in residuals], "config": asdict(config.nodes)}
    (output / "prepared.json").write_text(json.dumps(words, indent=1), encoding="utf-8")
    return Prepared(made, stack, names, tuple(notes), how, turned, samples.landmarks.shape[1])


def _read_shapes(
    folder: Path, config: PrepareConfig, notes: list[str], progress: Progress
) -> tuple[list[Repaired], list[Float[Floats, "L 3"] | None]]:
    """The usable shapes of a folder, repaired, and the landmarks of each."""
    files = sorted(path for path in folder.glob("*") if suffix_of(path) in PLAIN_SUFFIXES)
    landmark_files = find_landmarks(config.landmarks, folder, files)
    pairs = [pair for pair in zip(files, landmark_files, strict=True) if pair[0] not in landmark_files]
    if not pairs:
        raise InputError(f"no shapes in {folder}", f"files that end in {', '.join(PLAIN_SUFFIXES)} are read")
    inside = (path for path in folder.glob("[!.]*/**/*") if suffix_of(path) in PLAIN_SUFFIXES)
    if deeper := {path.relative_to(folder).parts[0] for path in inside}:
        notes.append(f"left out, for they lie in folders of {folder.name}: shapes of {', '.join(sorted(deeper))}")
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
    return found, prepared_folder.in_one_order(known)


@dataclass(frozen=True, eq=False)
class _Stood:
    """How each shape, and its mirror image, stands to a template that is only turned."""

    plain: Sequence[Standing]
    image: Sequence[Standing]

    def turned(
        self, mirror: bool, others_than_most: bool
    ) -> tuple[Bool[Bools, " N"], list[Float[Floats, "3 3"] | None]]:
        """Which shapes are to be mirrored: those of the other side than the template, or than most; and then how each is
        turned to the template, which may be among them. None where a shape stands otherwise."""
        leads = np.log([other.stretch / one.stretch for one, other in zip(self.plain, self.image, strict=True)])
        flags = (leads < 0) & (mirror and have_sides(leads.tolist()))
        found = [other if flag else one for one, other, flag in zip(self.plain, self.image, flags, strict=True)]
        turns = [each.frame.rotation if each.alike else None for each in found]
        if others_than_most and flags.sum() > len(flags) / 2:
            return ~flags, [None if turn is None else MIRROR.rotation @ turn @ MIRROR.rotation for turn in turns]
        return flags, turns


def _turned_to(chosen: int | Repaired, turns: list[Float[Floats, "3 3"] | None]) -> list[Float[Floats, "3 3"] | None]:
    """Rotations of shapes to one of them, from those to another; none where its own is not known."""
    own = turns[chosen] if isinstance(chosen, int) else None
    return [None if own is None or each is None else own.T @ each for each in turns]


def _standing(
    chosen: int | Repaired, config: PrepareConfig, found: list[Repaired], progress: Progress
) -> _Stood | None:
    """How shapes stand to the template; None where they need not be turned, or stand otherwise."""
    N = len(found)
    whole = found[chosen].shape if isinstance(chosen, int) else chosen.shape
    if config.align not in (None, "rigid") or whole.is_cloud or not FEWEST <= N <= _MOST_SIDES:
        return None
    if prepared_folder.same_faces(found[0], found):
        return None
    template, others = template_of(whole, whole.name, ViscousConfig()), 0
    stood: list[list[Standing]] = []
    for each in found:
        sides = [each.shape, mirrored(each.shape)]
        stood.append(parallel_map(lambda shape: standing(template, shape, config.nodes.seed), sides))
        others += not any(side.alike for side in stood[-1])
        if others > (1 - _MOST_ALIKE) * N:
            return None
        progress(len(stood) / N)
    return _Stood([plain for plain, _ in stood], [image for _, image in stood])


def _other_side(
    found: list[Repaired], config: PrepareConfig, named: Repaired | int | None, progress: Progress
) -> Bool[Bools, " N"]:
    """Which shapes are of the other side than most, or than the ``named`` template (a shape, or the number of one), as they
    lie."""
    if config.mirror == "no" or len(found) > _MOST_SIDES or prepared_folder.same_faces(found[0], found):
        return np.zeros(len(found), bool)
    flags = other_side(found, config.scale, config.nodes.seed, progress)
    if flags.any() and named is not None:
        if isinstance(named, int):
            other = bool(flags[named])
        else:
            one_side = [clean for clean, flag in zip(found, flags, strict=True) if not flag]
            other = is_other_side(named, one_side, config.scale, config.nodes.seed)
        flags = flags ^ other
    return flags


def _mirror_some(
    found: list[Repaired], marks: list[Float[Floats, "L 3"] | None], flags: Bool[Bools, " N"], notes: list[str]
) -> None:
    """Mirror some shapes, in place, with their landmarks."""
    for number in np.flatnonzero(flags):
        found[number] = repair(mirrored(found[number].original))
        if (known := marks[number]) is not None:
            marks[number] = known * [-1, 1, 1]
    if flags.any():
        names = [clean.original.name for clean, flag in zip(found, flags, strict=True) if flag]
        shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        notes.append(f"{len(names)} of {len(found)} shapes are mirror images of the others, and were mirrored: {shown}")


def _template_file(path: Path) -> Repaired:
    """The shape of a file, repaired, if a template can be made of it; `InputError` otherwise."""
    try:
        return _check_size(repair(load_shape(path)))
    except InputError as error:
        if path.name in error.message:
            raise
        raise InputError(f"{path.name} cannot be a template: {error.message}", error.hint) from error


def _named_template(folder: Path, config: PrepareConfig, found: list[Repaired]) -> Repaired | int | None:
    """The template that the config names: the number of one of the shapes that were found, or a shape of its own."""
    if config.template is None:
        return None
    path = Path(config.template)
    same = path.is_file() and path.resolve().parent == folder.resolve()
    wanted = {str(config.template)} | ({path.name} if same else set())
    for number, clean in enumerate(found):
        if wanted & {clean.original.name, Path(clean.original.name).stem}:
            return number
    return _template_file(path)


def _chosen(named: Repaired | int | None, config: PrepareConfig, found: list[Repaired]) -> tuple[int | Repaired, str]:
    """The template's shape, or its number if it is one of those that were found; and why it was chosen."""
    if named is not None:
        return named, ""
    number = next((k for k, clean in enumerate(found) if not clean.shape.is_cloud), 0)
    if len(found) == 1 or prepared_folder.same_faces(found[number], found):
        return number, ""
    number = prepared_folder.medoid(found, config.align or "rigid", config.scale, config.nodes.seed)
    return number, ", which lies nearest to all others on average"


def _in_the_middle(
    template: Template,
    found: list[Repaired],
    turns: list[Float[Floats, "3 3"] | None],
    nodes: NodeConfig,
    progress: Progress,
) -> tuple[Template, int]:
    """A template of the same vertices in the middle of the shapes that stand as it does, and of how many; the same where
    none of them is fitted."""
    viscous, fits = ViscousConfig(seed=nodes.seed), []
    finer = with_more_nodes(template, viscous)
    alike = [(clean.shape, turn) for clean, turn in zip(found, turns, strict=True) if turn is not None]
    some = np.unique(np.linspace(0, len(alike) - 1, min(len(alike), _AVERAGED)).astype(int))
    for shape, turn in (alike[number] for number in some):
        fits.append(fit_turned(finer, shape, turn, viscous))
        progress(len(fits) / len(some))
    sound = believed(fits)
    if not sound:
        return template, 0
    mean = Shape(mean_shape(finer, sound), template.shape.faces)
    low = np.arange(mean.V), np.asarray(mean.faces)
    return make_template(mean, template.name, nodes, low=low), len(sound)


def _template_landmarks(
    first: Repaired, own: Float[Floats, "L 3"] | None, marks: list[Float[Floats, "L 3"] | None]
) -> Float[Floats, "L 3"]:
    """Landmarks of the template's shape, if all shapes have as many; `InputError` otherwise."""
    sizes = {len(each) for each in marks if each is not None}
    if len(sizes) > 1:
        problem = f"landmark files of {min(sizes)} and of {max(sizes)} points"
        raise InputError(problem, "row k is the same point on every shape: write -1 where it is missing")
    if own is None or not np.isfinite(own).all():
        problem = f"the template {first.original.name} has no landmarks, or not all of them"
        raise InputError(problem, "choose with --template a shape of the folder on which every landmark is known")
    return own


def _check_size(clean: Repaired) -> Repaired:
    """The same shape, if there is enough of it to learn from; `InputError` otherwise."""
    shape = clean.shape
    if shape.is_cloud and shape.V < MINIMUM_POINTS:
        places = "place" if shape.V == 1 else "places"
        raise InputError(f"it has points in only {shape.V} {places}", f"at least {MINIMUM_POINTS} are needed")
    if not shape.is_cloud and shape.F < MINIMUM_FACES:
        triangles = "triangle" if shape.F == 1 else "triangles"
        raise InputError(f"it has only {shape.F} usable {triangles}", f"at least {MINIMUM_FACES} are needed")
    sqrt_area_frame(shape)  # refuses a shape without area
    return clean
