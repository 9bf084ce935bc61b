"""Check the inputs of public functions: models, shapes, configs and landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Int, Ints, to_numpy
from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import landmark_places
from meshmatch.scalars import is_integer
from meshmatch.shapes.alignment import in_single_precision
from meshmatch.shapes.cloud import on_a_line
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.threads import MAX_THREADS

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

LandmarkPairs = tuple[ArrayLike, ArrayLike]
"""Corresponding points: vertices of the source (N,), vertices of the target (N,)."""
MINIMUM_FACES = 50
MINIMUM_POINTS = 100

THREADS = 2
"""Default number of threads: the two shapes of a match are fitted in parallel, each on one thread."""


class UnknownKindsError(InputError):
    """No installed model knows any of the shapes."""


def as_model(model: TrainedModel | str | Path) -> TrainedModel:
    """Return a model, loading it if it is given by name or folder.

    Loaded models are cached until their files change. `ModelError` if there is no such model, its files are damaged, or
    the argument has another type.
    """
    if not isinstance(model, str | Path):
        from meshmatch.models.trained import TrainedModel

        if not isinstance(model, TrainedModel):
            hint = "give its name, its folder, or what load_model returned"
            raise ModelError(f"expected a model, not {type(model).__name__}", hint)
        return model
    from meshmatch.models.registry import load_once

    return load_once(model)


def repair_or_raise(shape: Shape) -> Repaired:
    """Repair a shape, and raise `InputError` if it cannot be fitted.

    It then has too few faces or points, no surface area, or large parts far apart.
    """
    clean = repair_allowing_parts(shape)
    refuse_far_parts(clean)
    return clean


def refuse_far_parts(clean: Repaired) -> None:
    """Raise `InputError` for a shape with large parts far apart."""
    if clean.far_parts:
        problem = f"{clean.shape.name or 'the shape'} contains {clean.far_parts + 1} large parts far apart"
        hint = "save each object in a file of its own, or choose parts with --only (see `meshmatch info`)"
        raise InputError(problem, hint)


def repair_allowing_parts(shape: Shape) -> Repaired:
    """As `repair_or_raise`, but allow large parts far apart, for callers that can select parts."""
    clean = repair(shape)
    fixed = clean.shape
    name = shape.name or "the shape"
    if fixed.is_cloud and fixed.V < MINIMUM_POINTS:
        places = "position" if fixed.V == 1 else "positions"
        raise InputError(f"{name} has only {fixed.V} distinct point {places}", f"at least {MINIMUM_POINTS} are needed")
    if not fixed.is_cloud and fixed.F < MINIMUM_FACES:
        triangles = "triangle" if fixed.F == 1 else "triangles"
        raise InputError(f"{name} has only {fixed.F} usable {triangles}", f"at least {MINIMUM_FACES} are needed")
    if fixed.is_cloud and on_a_line(fixed.verts):
        raise InputError(f"{name} has no surface: all its points lie on a line", "is it a point cloud?")
    if not fixed.area > 0:
        raise InputError(f"{name} has no surface area", "are all its points the same, or on a line?")
    single = in_single_precision(fixed)
    return clean if single is fixed else replace(clean, shape=single)


def checked_threads(threads: int | None) -> int:
    """Return the number of threads, `THREADS` for None; `OptionError` unless it is an integer from 1 to 4096."""
    if threads is None:
        return THREADS
    if not is_integer(threads, 1) or threads > MAX_THREADS:
        raise OptionError(
            f"threads must be an integer from 1 to {MAX_THREADS}, not {threads!r}", "leave it out for the default"
        )
    return int(threads)


def check_config(config: object) -> None:
    """Raise `OptionError` unless a config is a `FitConfig`."""
    if not isinstance(config, FitConfig):
        hint = 'such as meshmatch.FitConfig(up="y")'
        raise OptionError(f"a config is a FitConfig, not {type(config).__name__}", hint)


def configs_for(config: FitConfig | Sequence[FitConfig], count: int) -> list[FitConfig]:
    """Return one config for each of ``count`` shapes; `OptionError` if their numbers differ."""
    configs = list(config) if isinstance(config, Sequence) else [config] * count
    if len(configs) != count:
        raise OptionError(f"{count} shapes need one FitConfig, or {count} of them, not {len(configs)}")
    for each in configs:
        check_config(each)
    return configs


def landmark_vertices(
    clean: Sequence[Repaired], landmarks: Sequence[ArrayLike], configs: Sequence[FitConfig] = ()
) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Return landmark pairs as two arrays of vertices.

    `OptionError` if a shape has no such vertex, or if a config does not refine nodes, which landmarks require.
    """
    for each in configs:
        if not each.moves_nodes:
            hint = "leave out the landmarks, or choose nodes"
            raise OptionError(f"landmarks need refine='nodes', not {each.refine!r}", hint)
    landmark_places(clean, landmarks)
    return np.asarray(to_numpy(landmarks[0])), np.asarray(to_numpy(landmarks[1]))
