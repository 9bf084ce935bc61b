"""A sequence of shapes between two or more."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from meshmatch.api.direct import direct_notes, fit_to_first
from meshmatch.api.inputs import UnknownKindsError, configs_for, usable
from meshmatch.api.matcher import Matcher
from meshmatch.api.matching import matcher_for
from meshmatch.api.results import shape_of
from meshmatch.api.upright import turn_of_fit
from meshmatch.arrays import Brief, Floats
from meshmatch.errors import OptionError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.blend import WAYS, Blend, Deviation, Way
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.maps.deformed import surface_rotations
from meshmatch.maps.footpoints import Surface, SurfaceBinding, in_core_frame
from meshmatch.models.registry import AUTO, NO_MODEL
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import folder_on_success
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shapes
from meshmatch.shapes.moved_files import MovedFile
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit

if TYPE_CHECKING:
    from meshmatch.api.implicit import ImplicitMatcher
    from meshmatch.implicit.fit import ImplicitFit
    from meshmatch.implicit.model import ImplicitModel

Mesh = Literal["source", "template"]
Place = Literal["auto", "files", "source"]
EARLIEST, LATEST = -1.0, 2.0  # times between which a sequence may run
FORMATS = ("ply", "obj", "off", "glb")  # of the files in a folder
_HAIR = 1e-9
_ALIKE = 1.5  # sizes of files in one unit differ by less


@dataclass(frozen=True)
class InterpolationOptions:
    """What a sequence of shapes shows.

    Attributes
    ----------
    start
        Time of the first shape, from -1 to 2; beyond 0 and 1 the motion is extrapolated.
    stop
        Time of the last shape.
    mesh
        Whose mesh moves: the first shape's own ("source") or the model's ("template").
    way
        What is blended: the rotation and stretch of the "field" everywhere, or the network's "codes".
    place
        Where the shapes lie, see `Interpolation`; "auto" is "files" where their sizes differ by less than a half.
    resolution
        Of an implicit model's surfaces: cells along each side of the cube, an even number from 8 to 512.

    Raises
    ------
    OptionError
        A choice is unknown, or a time out of range.

    Examples
    --------
    >>> options = meshmatch.InterpolationOptions(start=-0.2, stop=1.2, mesh="template")
    >>> shapes = ["templates/samples/dancer.ply", "templates/samples/climber.ply"]
    >>> sequence = meshmatch.interpolate(shapes, frames=8, options=options)
    """

    start: float = 0.0
    stop: float = 1.0
    mesh: Mesh = "source"
    way: Way = "field"
    place: Place = "auto"
    resolution: int = 64

    def __post_init__(self) -> None:
        for name in ("start", "stop"):
            if not isinstance(value := getattr(self, name), Real):
                raise OptionError(f"{name} must be a number, not {value!r}", "the source is at 0 and the target at 1")
        if not EARLIEST <= self.start < self.stop <= LATEST:
            times = f"times go from {EARLIEST:g} to {LATEST:g}, the earlier first"
            hint = f"the source is at 0 and the target at 1; {times}"
            raise OptionError(f"a sequence cannot run from {self.start:g} to {self.stop:g}", hint)
        for name, choices in {"mesh": get_args(Mesh), "way": WAYS, "place": get_args(Place)}.items():
            if getattr(self, name) not in choices:
                raise OptionError(f"invalid {name} {getattr(self, name)!r}", f"choose one of {', '.join(choices)}")


@dataclass(frozen=True, eq=False, repr=False)
class Step(Brief):
    """A shape of a sequence, at 0 the source, at 1 the target; ``rotation`` (3, 3) leads to the axes of the template. An
    implicit model knows neither that nor a deviation.
    """

    time: float
    shape: Shape
    deviation: Deviation | None = None
    rotation: np.ndarray | None = None

    @property
    def record(self) -> dict[str, float]:
        """Time and deviations, or the number of vertices where shapes share none, for JSON."""
        if self.deviation is None:
            return {"time": round(self.time, 9), "vertices": self.shape.V}
        return {"time": round(self.time, 9)} | {key: round(value, 6) for key, value in asdict(self.deviation).items()}


@dataclass(frozen=True, eq=False)
class Interpolation:
    """A sequence of shapes with the same vertices and faces; by an implicit model, each has its own.

    Attributes
    ----------
    steps
        Time, shape and deviation of each frame.
    fits
        Fits of the first shape, of those on the way, and of the last.
    times
        When each of these shapes is met.
    place
        From where the first file has the shape to where the last has it ("files"), or all in the frame and unit of the
        first ("source").
    to_target
        Mean distance of the moved vertices at time 1 to the last shape's surface, in units of sqrt(area); None by an
        implicit model.
    seconds
        Wall time.
    notes
        What repair did.

    Examples
    --------
    >>> sequence = meshmatch.interpolate(["templates/samples/dancer.ply", "templates/samples/climber.ply"], frames=3)
    >>> half_way = sequence.steps[1].shape
    >>> meshmatch.save_shape("half-way.ply", half_way)
    """

    steps: tuple[Step, ...]
    fits: tuple[Fit | ImplicitFit, ...]
    times: tuple[float, ...]
    place: Place
    to_target: float | None
    seconds: float
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        way = f"{len(self.steps)} frames, {len(self.fits)} fits"
        return f"Interpolation({way}, {self.place!r}, {self.seconds:.1f} s, {len(self.notes)} notes)"


def interpolate(
    shapes: Sequence[ShapeLike],
    frames: int = 9,
    *,
    options: InterpolationOptions | None = None,
    model: str | Path | TrainedModel | ImplicitModel = AUTO,
    config: FitConfig | Sequence[FitConfig] | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> Interpolation:
    """The shapes between two shapes: from the first at time 0 to the last at time 1.

    Parameters
    ----------
    shapes
        At least two, each as in `match`; those in between are passed at even times.
    frames
        How many shapes to make, at least 2, at even times.
    options
        Times, mesh, method and placement of the sequence.
    model
        As in `match`.
    config
        As in `match`; a sequence has one for each shape.
    threads
        As in `match`.
    progress
        As in `match`.

    Returns
    -------
    Interpolation
        Its ``steps`` have a time and a shape each; all shapes share vertices and faces.

    Raises
    ------
    MeshmatchError
        A shape cannot be read or fitted, the model is unknown, or choices contradict each other.

    Examples
    --------
    >>> shapes = ["templates/samples/dancer.ply", "templates/samples/climber.ply"]
    >>> sequence = meshmatch.interpolate(shapes, frames=5)
    >>> [step.shape.verts for step in sequence.steps]  # (V, 3) each
    """
    began = time.monotonic()
    options = options or InterpolationOptions()
    matcher = matcher_for(model, None, threads, progress)
    loaded = as_shapes(shapes) if isinstance(matcher, Matcher) else []
    for count, what in ((len(shapes), "two shapes to go between"), (frames, "two shapes to make")):
        if not isinstance(count, Integral):
            raise OptionError(f"the number of shapes to make must be an integer, not {count!r}", "give 2 or more")
        if count < 2:
            raise OptionError(f"a sequence needs at least {what}, not {count}", "give two or more")
    if not isinstance(matcher, Matcher):
        return _surfaces(matcher, shapes, frames, options, config)
    configs = configs_for(config or matcher.config, len(loaded))
    try:
        if model == NO_MODEL:
            registered = _registered_directly(matcher, loaded, configs, options, unknown=False)
        else:
            registered = _registered(matcher, loaded, configs)
    except UnknownKindsError:
        registered = _registered_directly(matcher, loaded, configs, options, unknown=True)
    fits = registered.fits
    with thread_limit(1):
        repaired = [shape_of(fit).shape for fit in fits]
        blend = Blend(registered.mover, fits, None, repaired, options.way)
        steps, place, distance = _steps(blend, fits, np.linspace(options.start, options.stop, frames), options, matcher)
    return Interpolation(
        steps, tuple(fits), tuple(blend.times.tolist()), place, distance, time.monotonic() - began, registered.notes
    )


@dataclass(frozen=True, eq=False)
class _Registered:
    """Fits of one template, what moves it, and what is to be said of the shapes."""

    fits: list[Fit]
    mover: TrainedModel | NodeSystem
    notes: tuple[str, ...]


def _registered(matcher: Matcher, shapes: Sequence[Shape], configs: Sequence[FitConfig]) -> _Registered:
    """By a model. `UnknownKindsError` where the shapes should choose it, and none knows them."""
    fits = matcher.fit_all(shapes, configs)
    notes = tuple(dict.fromkeys(note for fit in fits for note in fit.notes))
    with thread_limit(1):
        repaired = [shape_of(fit).shape for fit in fits]
        return _Registered(agreed_fits(matcher.model, repaired, fits, configs[0]), matcher.model, notes)


def _registered_directly(
    matcher: Matcher,
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    options: InterpolationOptions,
    unknown: bool,
) -> _Registered:
    """The first shape is the template of all; `OptionError` for a choice that needs a model."""
    if options.mesh == "template":
        raise OptionError("without a model there is no template", "leave out the mesh: that of the first shape moves")
    if options.way == "codes":
        raise OptionError("without a model there are no codes", "leave out the blend: the field is blended")
    clean = [usable(shape) for shape in shapes]
    fits, found = fit_to_first(clean, configs, matcher.threads, matcher.progress)
    return _Registered(fits, found.system, direct_notes(clean, configs, unknown))


def _surfaces(
    matcher: ImplicitMatcher,
    shapes: Sequence[ShapeLike],
    frames: int,
    options: InterpolationOptions,
    config: FitConfig | Sequence[FitConfig] | None,
) -> Interpolation:
    """By the codes of an implicit model: each shape has a surface of its own."""
    from meshmatch.api.implicit import refuse_changed
    from meshmatch.implicit.model import check_resolution

    began = time.monotonic()
    refuse_changed(options, ("start", "stop", "resolution"))
    check_resolution(options.resolution)
    if len(shapes) != 2:
        raise OptionError("an implicit model passes no shapes on the way", "give two shapes")
    moments = np.linspace(options.start, options.stop, frames).tolist()
    fits = matcher.fit_all(shapes, config)
    steps = []
    for number, moment in enumerate(moments):
        with thread_limit(1):
            blended = matcher.model.blend(fits[0], fits[1], moment)
            steps.append(Step(moment, matcher.model.surface(blended, options.resolution)))
        if matcher.progress is not None:
            matcher.progress("surfaces", "sequence", (number + 1) / frames)
    notes = (*fits[0].notes, *fits[1].notes)
    return Interpolation(tuple(steps), tuple(fits), (0.0, 1.0), "files", None, time.monotonic() - began, notes)


def _steps(
    blend: Blend, fits: Sequence[Fit], moments: Floats, options: InterpolationOptions, matcher: Matcher
) -> tuple[tuple[Step, ...], Place, float]:
    """The shapes, where they lie, and how far the mesh is from the target at time 1."""
    binding = None
    if options.mesh == "source":
        binding = SurfaceBinding(shape_of(fits[0]), fits[0], blend.turns(fits[0].vectors), matcher.threads)
    place, mirrored = options.place, any(fit.frame.mirrored for fit in fits)
    if place == "auto":  # files of different units have no place in common
        sizes = [fit.frame.scale for fit in fits]
        place = "files" if max(sizes) < _ALIKE * min(sizes) and not mirrored else "source"
    elif place == "files" and mirrored:
        hint = "leave out the place: the sequence then stays with the source, and ends as the target's mirror image"
        raise OptionError("one of the shapes fits as a mirror image, so no motion leads from file to file", hint)

    def seen(moment: float) -> tuple[np.ndarray, np.ndarray]:
        """Node vectors and carried vertices, core frame."""
        vectors = blend.vectors(moment)
        points = blend.points(vectors)
        return vectors, points if binding is None else binding.at(points, blend.turns(vectors))

    def step(number: int, moment: float) -> Step:
        vectors, verts = seen(moment)
        frame = blend.frame(moment) if place == "files" else fits[0].frame
        name = f"{number:03d}"
        placed = frame.undo(verts)
        if binding is not None and moment == blend.times[0]:  # rounding aside it is where it was
            placed = shape_of(fits[0]).original.verts
        shape = Shape(placed, fits[0].shape.faces, name) if binding is None else binding.shape(placed, name)
        if matcher.progress is not None:
            matcher.progress("frames", "sequence", (number + 1) / len(moments))
        return Step(moment, shape, blend.deviation(moment, vectors), frame.turn)

    for met in blend.times:  # which rounding may have missed by a hair
        moments[np.abs(moments - met) < _HAIR] = met
    steps = tuple(step(number, moment) for number, moment in enumerate(moments.tolist()))
    target, last = shape_of(fits[-1]).shape, seen(1.0)[1]
    own, normals = in_core_frame(target, fits[-1])
    found = Surface(own, target.faces, np.zeros_like(normals)).query(last, np.zeros_like(last))
    return steps, place, float(found.distance.mean())


def save_folder(path: str | Path, result: Interpolation, kind: str = "ply", original: Path | None = None) -> list[str]:
    """Write each shape of a sequence into a new folder, ``frame-000.ply`` ..., and a list of them, ``frames.json``; the
    names of the files in order. ``original`` is the file whose mesh moves, which they are like but for positions. A glb
    stands along y as the first shape does. `OptionError` for another format; `OutputError` where the folder is not empty,
    or cannot be written.
    """
    if kind not in FORMATS:
        raise OptionError(f"shapes of a sequence are not written as {kind}", f"choose {', '.join(FORMATS)}")
    names = [f"frame-{number:03d}.{kind}" for number in range(len(result.steps))]
    fit = result.fits[0]
    began = shape_of(fit).original if isinstance(fit, Fit) else None
    turn = None if began is None or began.upright else turn_of_fit(fit)
    with folder_on_success(path) as folder:
        plans = MovedFile.planned_all([folder / name for name in names], original)
        for plan, step in zip(plans, result.steps, strict=True):
            turns = np.broadcast_to(np.eye(3), (step.shape.V, 3, 3))
            if plan.turns_normals and began is not None:
                turns = surface_rotations(began.verts, step.shape.verts, began.faces)
            plan.make_folders()
            plan.write(plan.files, step.shape, turns, turn=turn)
        frames = [{"file": name} | step.record for name, step in zip(names, result.steps, strict=True)]
        words = {"times_of_the_shapes": list(result.times), "place": result.place, "frames": frames}
        (folder / "frames.json").write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
    return names
