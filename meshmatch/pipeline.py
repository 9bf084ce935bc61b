"""The only composer: two files in, a map out. The command line and Python users take the same road."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.choices import Partial, Refine
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig, check_landmarks
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.landmarks import fits_with_landmarks
from meshmatch.maps.build import build_map
from meshmatch.maps.files import load_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.trained import TrainedModel, load_model
from meshmatch.shapes.cloud import on_a_line
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads
from meshmatch.transfer.inverse_map import invert_map

# What is going on, on which shape, and which share of it is done.
Progress = Callable[[str, str, float], None]
# Pairs of corresponding points: vertices of the source (N,), vertices of the target (N,).
LandmarkPairs = tuple[np.ndarray, np.ndarray]
MINIMUM_FACES = 50
MINIMUM_POINTS = 100


@dataclass(frozen=True, eq=False)
class MatchResult:
    """What `match` found: the map, both fits, the time in seconds, and what repair did to each shape."""

    map: VertexMap
    source_fit: Fit
    target_fit: Fit
    seconds: float
    notes: tuple[str, ...]


def match(
    source: Shape | str | Path,
    target: Shape | str | Path,
    *,
    model: str | Path = "human",
    refine: Refine = "nodes",
    seed: int = 0,
    up: str | None = None,
    front: str | None = None,
    partial: Partial = "auto",
    landmarks: LandmarkPairs | None = None,
    workers: int = 2,
    progress: Progress | None = None,
) -> MatchResult:
    """Match two shapes: for every vertex of the source its vertex on the target.

    Parameters
    ----------
    source, target : Shape or path
        Meshes of the model's category in any unit, turn and resolution.
    model : str
        Name in the registry, or a model folder.
    refine : {"nodes", "latent", "none"}
        Gauss-Newton on the nodes, the paper's search over codes, or the network alone.
    up, front : str, optional
        Axes of both files, such as "y" or "-z"; searched where not given.
    partial : {"auto", "yes", "no"}
        Whether a shape may be a part of a whole, such as a scan from one side: found out, tried for both, or never.
    landmarks : (source vertices (N,), target vertices (N,)), optional
        Known pairs, which the map then honours; only with the refinement "nodes".
    workers : int
        Threads; two fits run side by side.

    Returns
    -------
    MatchResult
        ``result.map.index[i]`` is the vertex of the target matched to vertex i of the source.

    Raises
    ------
    MeshmatchError
        The user's files or choices; see `meshmatch.errors`.
    """
    began = time.monotonic()
    loaded = read_model(model)
    shapes = [as_shape(source), as_shape(target)]
    clean = [usable(shape) for shape in shapes]
    config = FitConfig(refine=refine, seed=seed, up=up, front=front, partial=partial)
    if landmarks is not None and refine != "nodes":
        raise OptionError(
            f"landmarks are honoured by the refinement of nodes, not by {refine!r}",
            "leave out the landmarks, or choose nodes",
        )
    if landmarks is not None:
        check_landmarks(loaded)
    set_threads(1 if workers > 1 else workers)
    stop = threading.Event()
    names = _apart(shapes[0].name, shapes[1].name)

    def one(number: int) -> Fit:
        def tell(what: str, name: str, share: float) -> None:
            if stop.is_set():
                raise CancelledError
            if progress is not None:
                progress(what, names[number], share)

        return Fitter(loaded, config, tell).fit(clean[number].shape)

    with ThreadPoolExecutor(max(1, min(2, workers))) as pool:
        try:
            fits = list(pool.map(one, (0, 1)))
        except BaseException:
            stop.set()  # Ctrl-C, or one fit failed: the other one ends at its next word
            raise
    known = None
    if landmarks is not None:
        fits, known = fits_with_landmarks(loaded, clean, fits, landmarks, [config, config])
    alone = (fits[0], fits[1])
    fits = agreed_fits(loaded, [part.shape for part in clean], fits, config, known)
    found = build_map(clean[0], fits[0], clean[1], fits[1], workers=workers, before_agreement=alone)
    notes = tuple(
        f"{shape.name}: {note}" for shape, part in zip(shapes, clean, strict=True) for note in part.notes
    )
    notes += refine_notes(loaded, refine)
    return MatchResult(found, fits[0], fits[1], time.monotonic() - began, notes)


def refine_notes(model: TrainedModel, refine: Refine) -> tuple[str, ...]:
    """Words where another refinement is done than was asked for."""
    if FitConfig(refine=refine).for_model(model).refine == refine:
        return ()
    return (f"model {model.card.name} is pointwise and has no nodes: its code was refined instead",)


def register(
    shape: Shape | str | Path,
    *,
    model: str | Path = "human",
    refine: Refine = "nodes",
    seed: int = 0,
    up: str | None = None,
    front: str | None = None,
    partial: Partial = "auto",
    progress: Progress | None = None,
) -> Fit:
    """Lay the model's template on one shape; see `match` for the parameters."""
    shape = as_shape(shape)
    config = FitConfig(refine=refine, seed=seed, up=up, front=front, partial=partial)
    return Fitter(read_model(model), config, progress).fit(usable(shape).shape)


def fit_shape(shape: Shape, *, model: str | Path = "human", refine: Refine = "nodes", seed: int = 0) -> Fit:
    """`register` for shapes that are loaded already."""
    return register(shape, model=model, refine=refine, seed=seed)


def map_between(
    source: Shape,
    source_fit: Fit,
    target: Shape,
    target_fit: Fit,
    *,
    model: str | Path | None = None,
    workers: int = 1,
) -> VertexMap:
    """The map between two shapes that were fitted with the same model.

    Given the ``model``, the fits first agree on how the template stretches, as they do in `match` with refine="nodes";
    it is for fits refined in that way.
    """
    fits = [source_fit, target_fit]
    if model is not None:
        shapes = [usable(shape).shape for shape in (source, target)]
        fits = agreed_fits(read_model(model), shapes, fits, FitConfig(seed=source_fit.seed))
    alone = (source_fit, target_fit)
    return build_map(
        usable(source), fits[0], usable(target), fits[1], workers=workers, before_agreement=alone
    )


@dataclass(frozen=True, eq=False)
class CarryResult:
    """The two maps along which things are carried, and where they come from.

    Parameters
    ----------
    back : VertexMap
        From target to source: where on the source the value of each target vertex lies.
    forward : VertexMap
        From source to target: where each source vertex comes to lie.
    match : MatchResult, optional
        If the shapes were matched; None where a map was given.
    """

    back: VertexMap
    forward: VertexMap
    match: MatchResult | None


def carry(
    source: Shape | str | Path,
    target: Shape | str | Path,
    map: VertexMap | str | Path | None = None,
    *,
    model: str | Path = "human",
    refine: Refine = "nodes",
    seed: int = 0,
    up: str | None = None,
    front: str | None = None,
    workers: int = 2,
    progress: Progress | None = None,
) -> CarryResult:
    """The maps for carrying what lies on `source` to `target`.

    Parameters
    ----------
    map : VertexMap or path, optional
        A map from source to target that is at hand; it is checked and turned round. Without one the shapes are
        matched, and both maps come from the two fits. The other parameters are those of `match`, and only for
        that.

    Raises
    ------
    MeshmatchError
        As `match`; or `InputError` if the map was made for other shapes or runs the wrong way.
    """
    source, target = as_shape(source), as_shape(target)
    if map is not None:
        found = map if isinstance(map, VertexMap) else load_map(map)
        label = "the map" if isinstance(map, VertexMap) else Path(map).name
        forward = found.for_shapes(source, target, label)
        return CarryResult(invert_map(forward, source, target, workers), forward, None)
    result = match(
        source,
        target,
        model=model,
        refine=refine,
        seed=seed,
        up=up,
        front=front,
        workers=workers,
        progress=progress,
    )
    back = map_between(target, result.target_fit, source, result.source_fit, workers=workers)
    return CarryResult(back, result.map, result)


@lru_cache(maxsize=2)
def read_model(name: str | Path) -> TrainedModel:
    """Load a model once."""
    return load_model(name)


def as_shape(shape: Shape | str | Path) -> Shape:
    """A shape, loaded if it is a path."""
    return shape if isinstance(shape, Shape) else load_shape(shape)


@lru_cache(maxsize=2)
def usable(shape: Shape) -> Repaired:
    """Repair a shape and refuse what cannot be fitted.

    Raises
    ------
    InputError
        Too few faces or points, no extent, or two large parts far apart.
    """
    clean = repair(shape)
    fixed = clean.shape
    if fixed.is_cloud and fixed.V < MINIMUM_POINTS:
        places = "place" if fixed.V == 1 else "places"
        raise InputError(
            f"{shape.name} has points in only {fixed.V} {places}", f"at least {MINIMUM_POINTS} are needed"
        )
    if not fixed.is_cloud and fixed.F < MINIMUM_FACES:
        raise InputError(
            f"{shape.name} has only {fixed.F} usable triangles",
            f"at least {MINIMUM_FACES} are needed to see a shape",
        )
    if fixed.is_cloud and on_a_line(fixed.verts):
        raise InputError(
            f"{shape.name} has no surface: all its points lie on a line", "is it a cloud at all?"
        )
    if not fixed.area > 0:
        raise InputError(f"{shape.name} has no surface area", "are all its points the same, or on a line?")
    if clean.far_parts:
        raise InputError(
            f"{shape.name} holds {clean.far_parts + 1} large parts far apart",
            "save each object as a file of its own",
        )
    return clean


def _apart(source: str, target: str) -> tuple[str, str]:
    """Names to show, told apart where they are the same."""
    return (source, target) if source != target else (f"{source} (source)", f"{target} (target)")
