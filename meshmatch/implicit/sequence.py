"""Surfaces on the way between two shapes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.implicit.codes import fit_implicit
from meshmatch.implicit.model import ImplicitFit, ImplicitModel, check_resolution, load_implicit
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, save_shape
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False)
class ImplicitSequence:
    """Surfaces, each with its own vertices, and their times: 0 is the first shape and 1 the last one."""

    times: tuple[float, ...]
    shapes: tuple[Shape, ...]
    fits: tuple[ImplicitFit, ImplicitFit]


def implicit_sequence(
    model: ImplicitModel | str | Path,
    source: ShapeLike,
    target: ShapeLike,
    frames: int = 9,
    *,
    times: tuple[float, float] = (0.0, 1.0),
    resolution: int = 64,
    seed: int = 0,
    progress: ProgressCallback | None = None,
) -> ImplicitSequence:
    """Surfaces from one shape to another, by their codes in an implicit model.

    Surfaces go from the place and size of the one file to those of the other.

    Parameters
    ----------
    model
        The model or its folder.
    source
        As in `fit_implicit`.
    target
        As in `fit_implicit`.
    frames
        How many, at even times.
    times
        Of the first and the last surface, from -1 to 2.
    resolution
        As in `ImplicitModel.surface`.
    seed
        Of both codes.
    progress
        As in `match`.

    Returns
    -------
    ImplicitSequence
        The surfaces and both fits.

    Raises
    ------
    MeshmatchError
        As for `fit_implicit` and `ImplicitModel.surface`.
    OptionError
        Fewer than two frames, or times out of range.

    Examples
    --------
    >>> sequence = meshmatch.implicit_sequence("chair-model", "a.ply", "b.ply", frames=5)
    >>> surfaces = [step.shape for step in sequence.steps]
    >>> meshmatch.save_shape("half-way.ply", surfaces[2])
    """
    start, stop = times
    if frames < 2 or not -1 <= start < stop <= 2:
        hint = "at least two, and times from -1 to 2, the earlier first"
        raise OptionError(f"there is no sequence of {frames} surfaces from time {start:g} to {stop:g}", hint)
    check_resolution(resolution)
    model = model if isinstance(model, ImplicitModel) else load_implicit(model)
    a, b = (fit_implicit(model, shape, seed=seed, progress=progress) for shape in (source, target))
    moments, shapes = np.linspace(start, stop, frames).tolist(), []
    for number, moment in enumerate(moments):
        shapes.append(model.surface(model.blend(a, b, moment), resolution))
        if progress is not None:
            progress("surfaces", "sequence", (number + 1) / frames)
    return ImplicitSequence(tuple(moments), tuple(shapes), (a, b))


def save_implicit_sequence(folder: Path, result: ImplicitSequence, kind: str = "ply") -> None:
    """Write each surface, ``frame-000.ply`` ..., and a list of them with their times, ``frames.json``."""
    frames = []
    for number, (time, shape) in enumerate(zip(result.times, result.shapes, strict=True)):
        name = f"frame-{number:03d}.{kind}"
        save_shape(folder / name, shape)
        frames.append({"file": name, "time": round(time, 9), "vertices": shape.V})
    (folder / "frames.json").write_text(json.dumps({"frames": frames}, indent=1) + "\n", encoding="utf-8")
