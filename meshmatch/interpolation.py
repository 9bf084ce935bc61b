"""A sequence of shapes between two or more: the composer beside `pipeline`, for whom the fits are the way."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.blend import Blend, Deviation, Way
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, Partial, Refine
from meshmatch.fitting.fit_shape import fit_shape as lay_template
from meshmatch.maps.surface import Surface
from meshmatch.maps.template_footpoints import in_core_frame
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import folder_on_success
from meshmatch.pipeline import Progress, as_shape, read_model, refine_notes, usable
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads
from meshmatch.transfer.surface_binding import SurfaceBinding

Mesh = Literal["source", "template"]
Place = Literal["auto", "files", "source"]
MESHES: tuple[Mesh, ...] = get_args(Mesh)
PLACES: tuple[Place, ...] = get_args(Place)
EARLIEST, LATEST = -1.0, 2.0
"""Times between which a sequence may run: the source is at 0, the target at 1."""
FORMATS = ("ply", "obj", "off", "glb")
"""Of the files in a folder."""
LIST = "frames.json"
_HAIR = 1e-9
_ALIKE = 1.5  # sizes of files in one unit differ by less


@dataclass(frozen=True, eq=False)
class Step:
    """One shape of a sequence: the source at time 0, the target at 1.

    ``rotation`` (3, 3) leads into a frame with the template's axes, for pictures.
    """

    time: float
    shape: Shape
    deviation: Deviation
    rotation: np.ndarray

    @property
    def record(self) -> dict[str, Any]:
        """Time and deviations, for JSON."""
        return {"time": round(self.time, 9)} | {
            key: round(value, 6) for key, value in asdict(self.deviation).items()
        }


@dataclass(frozen=True, eq=False)
class Interpolation:
    """A sequence of shapes with the same vertices and faces.

    Attributes
    ----------
    steps : tuple of Step
    fits : tuple of Fit
        Of the source, of the shapes on the way, of the target.
    times : tuple of float
        When each of these is met.
    place : {"files", "source"}
        Where the shapes lie: from where the source's file has it to where the target's has it, or all in the frame and
        unit of the source.
    to_target : float
        Mean distance of the carried vertices at time 1 to the target's surface, in units of sqrt(area).
    seconds : float
    notes : tuple of str
        What repair did.
    """

    steps: tuple[Step, ...]
    fits: tuple[Fit, ...]
    times: tuple[float, ...]
    place: Place
    to_target: float
    seconds: float
    notes: tuple[str, ...]


def interpolate(
    source: Shape | str | Path,
    target: Shape | str | Path,
    frames: int = 9,
    *,
    through: Sequence[Shape | str | Path] = (),
    start: float = 0.0,
    stop: float = 1.0,
    mesh: Mesh = "source",
    way: Way = "field",
    place: Place = "auto",
    model: str | Path = "human",
    refine: Refine = "nodes",
    seed: int = 0,
    up: str | None = None,
    front: str | None = None,
    partial: Partial = "auto",
    workers: int = 2,
    progress: Progress | None = None,
) -> Interpolation:
    """Shapes between two: from the source at time 0 to the target at time 1.

    Parameters
    ----------
    frames : int
        How many shapes, at least 2, at even times from `start` to `stop`; beyond 0 and 1 the motion goes on.
    through : sequence of shapes
        Met on the way, at even times.
    mesh : {"source", "template"}
        Carry the source's own mesh, or the template's.
    way : {"field", "codes"}
        See `Blend`.
    place : {"auto", "files", "source"}
        See `Interpolation`; "auto" is "files" where their sizes differ by less than a half.

    The other parameters are those of `match`.

    Raises
    ------
    MeshmatchError
        The user's files or choices; see `meshmatch.errors`.
    """
    began = time.monotonic()
    check_bake_options(frames, start, stop, mesh, place)
    loaded = read_model(model)
    shapes = [as_shape(shape) for shape in (source, *through, target)]
    clean = [usable(shape) for shape in shapes]
    config = FitConfig(refine=refine, seed=seed, up=up, front=front, partial=partial)
    set_threads(1 if workers > 1 else workers)
    fits = _fits(loaded, clean, config, workers, progress)
    repaired = [part.shape for part in clean]
    fits = agreed_fits(loaded, repaired, fits, config)
    blend = Blend(loaded, fits, None, repaired, way)
    rider = (
        SurfaceBinding(clean[0], fits[0], blend.turns(fits[0].vectors), workers) if mesh == "source" else None
    )
    chosen = place if place != "auto" else _usual_place(fits)

    def seen(moment: float) -> tuple[np.ndarray, np.ndarray]:
        """Node vectors and carried vertices, core frame."""
        vectors = blend.vectors(moment)
        points = blend.points(vectors)
        return vectors, points if rider is None else rider.at(points, blend.turns(vectors))

    def step(number: int, moment: float) -> Step:
        vectors, verts = seen(moment)
        frame = blend.frame(moment) if chosen == "files" else fits[0].frame
        name = f"{number:03d}"
        placed = frame.undo(verts)
        shape = Shape(placed, fits[0].faces, name) if rider is None else rider.shape(placed, name)
        if progress is not None:
            progress("frames", "sequence", (number + 1) / frames)
        return Step(moment, shape, blend.deviation(moment, vectors), frame.rotation)

    moments = np.linspace(start, stop, frames)
    for met in blend.times:  # which rounding may have missed by a hair
        moments[np.abs(moments - met) < _HAIR] = met
    steps = tuple(step(number, moment) for number, moment in enumerate(moments.tolist()))
    notes = tuple(
        f"{shape.name}: {note}" for shape, part in zip(shapes, clean, strict=True) for note in part.notes
    )
    notes += refine_notes(loaded, refine)
    away = _distance(seen(1.0)[1], repaired[-1], fits[-1])
    times = tuple(blend.times.tolist())
    return Interpolation(steps, tuple(fits), times, chosen, away, time.monotonic() - began, notes)


def save_folder(path: str | Path, result: Interpolation, kind: str = "ply") -> list[str]:
    """Write each shape of a sequence into a new folder, and a list of them: ``frame-000.ply`` ..., ``frames.json``.

    Returns
    -------
    list of str
        The names of the shapes' files, in order.

    Raises
    ------
    OptionError
        The format is none of `FORMATS`.
    OutputError
        The folder holds something, or cannot be written.
    """
    if kind not in FORMATS:
        raise OptionError(f"shapes of a sequence are not written as {kind}", f"choose {', '.join(FORMATS)}")
    names = [f"frame-{number:03d}.{kind}" for number in range(len(result.steps))]
    with folder_on_success(path) as folder:
        for name, step in zip(names, result.steps, strict=True):
            save_shape(folder / name, step.shape)
        frames = [{"file": name} | step.record for name, step in zip(names, result.steps, strict=True)]
        words = {"times_of_the_shapes": list(result.times), "place": result.place, "frames": frames}
        (folder / LIST).write_text(json.dumps(words, indent=1) + "\n", encoding="utf-8")
    return names


def check_bake_options(frames: int, start: float, stop: float, mesh: str, place: str) -> None:
    """Refuse what no sequence can be made of (`OptionError`)."""
    if frames < 2:
        raise OptionError(f"{frames} shapes are no sequence", "ask for at least 2")
    if not EARLIEST <= start < stop <= LATEST:
        raise OptionError(
            f"a sequence cannot run from {start:g} to {stop:g}",
            f"the source is at 0 and the target at 1; times go from {EARLIEST:g} to {LATEST:g}, the earlier first",
        )
    if mesh not in MESHES:
        raise OptionError(f"no mesh {mesh!r} to carry", f"choose one of {', '.join(MESHES)}")
    if place not in PLACES:
        raise OptionError(f"no place {place!r}", f"choose one of {', '.join(PLACES)}")


def _usual_place(fits: Sequence[Fit]) -> Place:
    """Files of different units have no place in common."""
    sizes = [fit.frame.scale for fit in fits]
    return "files" if max(sizes) < _ALIKE * min(sizes) else "source"


def _fits(
    model: TrainedModel,
    clean: Sequence[Repaired],
    config: FitConfig,
    workers: int,
    progress: Progress | None,
) -> list[Fit]:
    """The template laid on each shape, some side by side."""
    stop = threading.Event()
    names = [part.shape.name for part in clean]
    labels = [
        f"{name} ({number + 1})" if names.count(name) > 1 else name for number, name in enumerate(names)
    ]

    def one(number: int) -> Fit:
        def tell(what: str, share: float) -> None:
            if stop.is_set():
                raise CancelledError
            if progress is not None:
                progress(what, labels[number], share)

        return lay_template(model, clean[number].shape, config, None, tell)

    with ThreadPoolExecutor(max(1, min(workers, len(clean)))) as pool:
        try:
            return list(pool.map(one, range(len(clean))))
        except BaseException:
            stop.set()  # Ctrl-C, or one fit failed: the others end at their next word
            raise


def _distance(verts: np.ndarray, target: Shape, fit: Fit) -> float:
    """Mean distance of vertices (N, 3) to a shape, in the core frame of its fit."""
    own, normals = in_core_frame(target, fit)
    found = Surface(own, target.faces, np.zeros_like(normals)).query(verts, np.zeros_like(verts))
    return float(found.distance.mean())
