"""Interpolation: a sequence of shapes between two or more shapes."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from meshmatch.api.direct import direct_notes, fit_to_first
from meshmatch.api.inputs import UnknownKindsError, configs_for, repair_allowing_parts
from meshmatch.api.matcher import Matcher
from meshmatch.api.matching import matcher_for
from meshmatch.api.results import shape_of
from meshmatch.api.upright import upright_rotation_of_fit
from meshmatch.arrays import Floats, ShortRepr
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
from meshmatch.scalars import is_integer, is_number
from meshmatch.shapes.deformed_files import MovedFile
from meshmatch.shapes.files import ShapeLike, as_shapes
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit

if TYPE_CHECKING:
    from meshmatch.api.implicit import ImplicitMatcher
    from meshmatch.implicit.fit import ImplicitFit
    from meshmatch.implicit.model import ImplicitModel

Mesh = Literal["source", "template"]
Place = Literal["auto", "files", "source"]
EARLIEST, LATEST = -1.0, 2.0  # range of times
FORMATS = ("ply", "obj", "off", "glb")  # formats of the files in a folder
_TIME_TOLERANCE = 1e-9
_MAX_SIZE_RATIO = 1.5  # of shapes whose files are assumed to have the same unit


@dataclass(frozen=True)
class InterpolationOptions:
    """Options of `interpolate`.

    Attributes
    ----------
    start
        Time of the first frame, from -1 to 2; before 0 and after 1 the motion is extrapolated.
    stop
        Time of the last frame, after ``start`` and at most 2.
    mesh
        The mesh that moves: the mesh of the first shape ("source") or the model's template ("template").
    way
        What is blended: the local rotation and stretch of the deformation ("field"), or the network's latent codes
        ("codes").
    place
        Placement of the shapes, see `Interpolation`; "auto" is "files" if the sizes of the shapes differ by a factor of
        less than 1.5 and none is a mirror image, else "source".
    resolution
        For implicit models: grid cells along each side of the cube from which surfaces are extracted, an even number from
        8 to 512.

    Raises
    ------
    OptionError
        An option has an unknown value, or a time is out of range.

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
            if not is_number(value := getattr(self, name)):
                raise OptionError(f"{name} must be a number, not {value!r}", "the source is at 0 and the target at 1")
        if not EARLIEST <= self.start < self.stop <= LATEST:
            times = f"times go from {EARLIEST:g} to {LATEST:g}, the earlier first"
            hint = f"the source is at 0 and the target at 1; {times}"
            raise OptionError(f"a sequence cannot run from {self.start:g} to {self.stop:g}", hint)
        for name, choices in {"mesh": get_args(Mesh), "way": WAYS, "place": get_args(Place)}.items():
            if getattr(self, name) not in choices:
                raise OptionError(f"invalid {name} {getattr(self, name)!r}", f"choose one of {', '.join(choices)}")


@dataclass(frozen=True, eq=False, repr=False)
class Step(ShortRepr):
    """A frame of a sequence.

    ``time`` is 0 at the source and 1 at the target. ``rotation`` (3, 3) leads from the axes of the frame to those of the
    template. For an implicit model, ``rotation`` and ``deviation`` are None.
    """

    time: float
    shape: Shape
    deviation: Deviation | None = None
    rotation: np.ndarray | None = None

    @property
    def record(self) -> dict[str, float]:
        """Time and deviations for JSON; for an implicit model, time and the number of vertices."""
        if self.deviation is None:
            return {"time": round(self.time, 9), "vertices": self.shape.V}
        return {"time": round(self.time, 9)} | {key: round(value, 6) for key, value in asdict(self.deviation).items()}


@dataclass(frozen=True, eq=False)
class Interpolation:
    """The result of `interpolate`: a sequence of shapes with common vertices and faces.

    With an implicit model, each shape has its own vertices and faces.

    Attributes
    ----------
    steps
        The frames, each with ``time``, ``shape`` and ``deviation``.
    fits
        The fits of the given shapes, in order.
    times
        The time at which the sequence passes each of these shapes.
    place
        "files": positions move from those of the first file to those of the last; "source": all shapes are in the frame and
        unit of the first file.
    to_target
        Mean distance of the moved vertices at time 1 to the surface of the last shape, in units of sqrt(area); None for an
        implicit model.
    seconds
        Wall time.
    notes
        Repairs of the shapes and other notes on their fits.

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
    """Blend shapes into each other: a sequence from the first shape at time 0 to the last at time 1.

    Parameters
    ----------
    shapes
        At least two shapes, each as in `match`; those in between are passed at evenly spaced times.
    frames
        Number of shapes to make, at least 2, at evenly spaced times.
    options
        Times, mesh, method and placement of the sequence.
    model
        As in `match`.
    config
        How shapes are fitted: one for all shapes, or one for each.
    threads
        As in `match`.
    progress
        As in `match`.

    Returns
    -------
    Interpolation
        The sequence: each of its ``steps`` has a ``time`` and a ``shape``.

    Raises
    ------
    MeshmatchError
        A shape cannot be read or fitted, the model is unknown, or options contradict each other.

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
        if not is_integer(count):
            raise OptionError(f"the number of shapes to make must be an integer, not {count!r}", "give 2 or more")
        if count < 2:
            raise OptionError(f"a sequence needs at least {what}, not {count}", "give two or more")
    if not isinstance(matcher, Matcher):
        return _interpolate_implicit(matcher, shapes, frames, options, config)
    configs = configs_for(config or matcher.config, len(loaded))
    try:
        if model == NO_MODEL:
            registered = _register_directly(matcher, loaded, configs, options, unknown=False)
        else:
            registered = _register_with_model(matcher, loaded, configs)
    except UnknownKindsError:
        registered = _register_directly(matcher, loaded, configs, options, unknown=True)
    fits = registered.fits
    with thread_limit(1):
        repaired = [shape_of(fit).shape for fit in fits]
        blend = Blend(registered.mover, fits, None, repaired, options.way)
        steps, place, distance = _make_steps(
            blend, fits, np.linspace(options.start, options.stop, frames), options, matcher
        )
    return Interpolation(
        steps, tuple(fits), tuple(blend.times.tolist()), place, distance, time.monotonic() - began, registered.notes
    )


@dataclass(frozen=True, eq=False)
class _Registered:
    """Fits of one template, the model or node system that deforms it, and notes on the shapes."""

    fits: list[Fit]
    mover: TrainedModel | NodeSystem
    notes: tuple[str, ...]


def _register_with_model(matcher: Matcher, shapes: Sequence[Shape], configs: Sequence[FitConfig]) -> _Registered:
    """Fit the shapes with the matcher's model; `UnknownKindsError` if it is to be chosen and none knows the shapes."""
    fits = matcher.fit_all(shapes, configs)
    notes = tuple(dict.fromkeys(note for fit in fits for note in fit.notes))
    with thread_limit(1):
        repaired = [shape_of(fit).shape for fit in fits]
        return _Registered(agreed_fits(matcher.model, repaired, fits, configs[0]), matcher.model, notes)


def _register_directly(
    matcher: Matcher,
    shapes: Sequence[Shape],
    configs: Sequence[FitConfig],
    options: InterpolationOptions,
    unknown: bool,
) -> _Registered:
    """Fit the first shape, as the template, to all others; `OptionError` for options that need a model."""
    if options.mesh == "template":
        raise OptionError("without a model there is no template", "leave out the mesh: that of the first shape moves")
    if options.way == "codes":
        raise OptionError("without a model there are no codes", "leave out the blend: the field is blended")
    clean = [repair_allowing_parts(shape) for shape in shapes]
    fits, found = fit_to_first(clean, configs, matcher.threads, matcher.progress)
    return _Registered(fits, found.system, direct_notes(clean, configs, unknown))


def _interpolate_implicit(
    matcher: ImplicitMatcher,
    shapes: Sequence[ShapeLike],
    frames: int,
    options: InterpolationOptions,
    config: FitConfig | Sequence[FitConfig] | None,
) -> Interpolation:
    """Blend the latent codes of an implicit model and extract the surface of each frame."""
    from meshmatch.api.implicit import refuse_changed
    from meshmatch.implicit.model import check_resolution

    began = time.monotonic()
    refuse_changed(options, ("start", "stop", "resolution"))
    check_resolution(options.resolution)
    if len(shapes) != 2:
        raise OptionError("an implicit model blends exactly two shapes", "give two shapes")
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


def _make_steps(
    blend: Blend, fits: Sequence[Fit], moments: Floats, options: InterpolationOptions, matcher: Matcher
) -> tuple[tuple[Step, ...], Place, float]:
    """Make the frames; also return their placement, and the mean distance of the mesh at time 1 from the target."""
    binding = None
    if options.mesh == "source":
        binding = SurfaceBinding(shape_of(fits[0]), fits[0], blend.turns(fits[0].vectors), matcher.threads)
    place, mirrored = options.place, any(fit.frame.mirrored for fit in fits)
    if place == "auto":  # positions in files of different units are not comparable
        sizes = [fit.frame.scale for fit in fits]
        place = "files" if max(sizes) < _MAX_SIZE_RATIO * min(sizes) and not mirrored else "source"
    elif place == "files" and mirrored:
        hint = "leave out the place: the sequence then stays with the source, and ends as the target's mirror image"
        raise OptionError("one of the shapes fits as a mirror image, so no motion leads from file to file", hint)

    def blended(moment: float) -> tuple[np.ndarray, np.ndarray]:
        """Node vectors and moved vertices at a time, in the core frame."""
        vectors = blend.vectors(moment)
        points = blend.points(vectors)
        return vectors, points if binding is None else binding.at(points, blend.turns(vectors))

    def step(number: int, moment: float) -> Step:
        vectors, verts = blended(moment)
        frame = blend.frame(moment) if place == "files" else fits[0].frame
        name = f"{number:03d}"
        placed = frame.undo(verts)
        if binding is not None and moment == blend.times[0]:  # exactly the source, without rounding errors
            placed = shape_of(fits[0]).original.verts
        shape = Shape(placed, fits[0].shape.faces, name) if binding is None else binding.shape(placed, name)
        if matcher.progress is not None:
            matcher.progress("frames", "sequence", (number + 1) / len(moments))
        return Step(moment, shape, blend.deviation(moment, vectors), frame.turn)

    for key_time in blend.times:  # snap frames to the times of given shapes
        moments[np.abs(moments - key_time) < _TIME_TOLERANCE] = key_time
    steps = tuple(step(number, moment) for number, moment in enumerate(moments.tolist()))
    target, last = shape_of(fits[-1]).shape, blended(1.0)[1]
    own, normals = in_core_frame(target, fits[-1])
    found = Surface(own, target.faces, np.zeros_like(normals)).query(last, np.zeros_like(last))
    return steps, place, float(found.distance.mean())


def save_folder(path: str | Path, result: Interpolation, kind: str = "ply", original: Path | None = None) -> list[str]:
    """Write each shape of a sequence into a new folder.

    The folder gets ``frame-000.ply``, ... and ``frames.json``, which lists them with times and deviations. If ``original``
    is the file of the mesh that moves, the frames keep everything in it but the positions. In a glb, a node turns the shapes
    upright as the first shape stands.

    Parameters
    ----------
    path
        The new folder.
    result
        The sequence.
    kind
        Format of the files, one of `FORMATS`.
    original
        The file of the mesh that moves.

    Returns
    -------
    list of str
        The names of the files, in order.

    Raises
    ------
    OptionError
        The format is unknown.
    OutputError
        The folder is not empty, or cannot be written.
    """
    if kind not in FORMATS:
        raise OptionError(f"shapes of a sequence are not written as {kind}", f"choose {', '.join(FORMATS)}")
    names = [f"frame-{number:03d}.{kind}" for number in range(len(result.steps))]
    fit = result.fits[0]
    began = shape_of(fit).original if isinstance(fit, Fit) else None
    turn = None if began is None or began.upright else upright_rotation_of_fit(fit)
    with folder_on_success(path) as folder:
        plans = MovedFile.plan_all([folder / name for name in names], original)
        for plan, step in zip(plans, result.steps, strict=True):
            turns = np.broadcast_to(np.eye(3), (step.shape.V, 3, 3))
            if plan.rotates_normals and began is not None:
                turns = surface_rotations(began.verts, step.shape.verts, began.faces)
            plan.make_folders()
            plan.write(plan.files, step.shape, turns, turn=turn)
        frames = [{"file": name} | step.record for name, step in zip(names, result.steps, strict=True)]
        record = {"times_of_the_shapes": list(result.times), "place": result.place, "frames": frames}
        (folder / "frames.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return names
