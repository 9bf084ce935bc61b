"""`wrap`: deform a base mesh onto the surface of a scan."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.api import matching
from meshmatch.api.inputs import LandmarkPairs
from meshmatch.api.results import MatchResult, MovedMesh
from meshmatch.api.skeletons import move_skeleton
from meshmatch.api.upright import turn_of_moved
from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.models.registry import AUTO
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.repair import oriented_outwards
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.wrap import wrap_onto

if TYPE_CHECKING:
    from meshmatch.implicit.model import ImplicitModel


@dataclass(frozen=True, eq=False, repr=False)
class WrapResult(MovedMesh):
    """The base mesh on the surface of the scan: the result of `wrap`.

    Attributes
    ----------
    shape
        The base in the frame and unit of the scan; vertices and faces in their original order.
    turns
        (V, 3, 3) rotation of the base at each vertex.
    distance
        (V,) distance of each vertex to the scan's surface, in the unit of the scan.
    free
        (V,) True for a vertex that kept its local shape and was not projected onto the scan.
    match
        The match of base and scan.
    seconds
        Wall time of the projection, excluding the match.
    original
        The base's file, if it was read from one.
    binding
        The base's skeleton, with joints that follow the skin around them; in a .glb it moves the mesh.
    turn
        (3, 3) rotation that makes y the up axis, as .glb requires; None if it is already, or the up axis is unknown.

    Examples
    --------
    >>> wrapped = meshmatch.wrap("templates/samples/dancer.ply", "templates/samples/climber.ply")
    >>> wrapped.distance.mean(), wrapped.distance.max()  # unit of the climber's file
    >>> wrapped.save("wrapped.ply")
    """

    distance: Float[Floats, " V"]
    free: Bool[Bools, " V"]
    match: MatchResult
    seconds: float

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import transfer_html
        from meshmatch.render.compose import compose_shapes

        apart = f"{float(self.distance.mean()):.3g} on average, {float(self.distance.max()):.3g} at most"
        draw = partial(compose_shapes, [(self.shape, None)], plain=True)
        return transfer_html("Wrap", self.match.map, draw, {"distance to the surface": apart})


def wrap(
    base: ShapeLike,
    scan: ShapeLike,
    *,
    free: ArrayLike = (),
    model: str | Path | TrainedModel | ImplicitModel = AUTO,
    config: FitConfig | Sequence[FitConfig] | None = None,
    landmarks: LandmarkPairs | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> WrapResult:
    """Deform a base mesh onto the surface of a scan; its vertices and faces keep their order.

    The shapes are matched and the base is deformed along the match. Its vertices are then projected onto the nearest points
    of the scan with similar normals, by a displacement field that is smooth at first and becomes finer.

    Parameters
    ----------
    base
        The mesh to deform.
    scan
        A mesh or point cloud of the same kind of shape.
    free
        (N,) vertices of the base that keep their local shape and follow those around them, such as eyes and the inside of
        a mouth. Vertices of weight 0 do so too.
    model
        As in `match`; implicit models are not supported.
    config
        As in `match`.
    landmarks
        As in `match`.
    threads
        As in `match`.
    progress
        As in `match`.

    Returns
    -------
    WrapResult
        The deformed base; ``save("wrapped.obj")`` writes it.

    Raises
    ------
    MeshmatchError
        The base is a point cloud, matches as a mirror image, or lacks a vertex in ``free``; or as for `match`.

    Examples
    --------
    >>> wrapped = meshmatch.wrap("templates/samples/dancer.ply", "templates/samples/climber.ply", free=[0, 1, 2])
    >>> wrapped.shape.verts  # (V, 3), on the climber
    """
    original = Path(base) if isinstance(base, str | Path) else None
    mesh, surface = as_shape(base, "base"), as_shape(scan, "scan")
    if mesh.is_cloud:
        raise OptionError(f"{mesh.name or 'the base'} has no faces, and only a mesh can be wrapped", "give a mesh")
    kept = _vertex_mask(mesh, free)
    if mesh.weights is not None:
        kept |= mesh.weights == 0
    found = matching.match(
        mesh, surface, model=model, config=config, landmarks=landmarks, threads=threads, progress=progress
    )  # fmt: skip
    began = time.monotonic()
    near = found.deformed_source()
    if not np.array_equal(near.faces, mesh.faces):
        hint = "mirror one of the files, or match without mirror images (--mirror no)"
        raise OptionError(f"{mesh.name or 'the base'} matches as a mirror image: it would be inside out", hint)
    with thread_limit(1):
        wrapped = wrap_onto(oriented_outwards(mesh), near.verts, oriented_outwards(surface), kept, found.threads)
    shape = replace(mesh, verts=wrapped.verts)
    binding = move_skeleton(original, shape, surface.upright)
    turn = turn_of_moved(mesh, shape.verts, surface, found.target_fit)
    seconds = time.monotonic() - began
    return WrapResult(
        shape, wrapped.turns, wrapped.distance, kept, found, seconds, original=original, binding=binding, turn=turn
    )


def _vertex_mask(base: Shape, numbers: ArrayLike) -> Bools:
    """(V,) mask of these vertices; `InputError` if one does not exist."""
    rows = np.asarray(numbers)
    if rows.size and (rows.ndim != 1 or rows.dtype.kind not in "iu" or rows.min() < 0 or rows.max() >= base.V):
        hint = f"{base.name or 'the base'} has vertices 0 to {base.V - 1}"
        raise InputError("free must be a list of numbers of vertices", hint)
    free = np.zeros(base.V, bool)
    free[rows.astype(np.int64)] = True
    return free
