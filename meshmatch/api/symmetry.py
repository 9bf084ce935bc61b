"""`find_symmetry`: map a nearly symmetric shape to itself, each vertex to its mirror counterpart."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

import numpy as np

from meshmatch.api.inputs import check_config, checked_threads, repair_or_raise
from meshmatch.api.results import maps_of_fits
from meshmatch.arrays import Float, Floats, ShortRepr
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search.planes import MirrorPlane
from meshmatch.fitting.self_symmetry import match_to_mirror_image, mirror_image
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit, worker_slot


@dataclass(frozen=True, eq=False, repr=False)
class Symmetry(ShortRepr):
    """The result of `find_symmetry`.

    Attributes
    ----------
    map
        From the shape to itself: ``map.index[i]`` is the mirror counterpart of vertex i. It has a verdict and confidence.
    normal
        (3,) unit normal of the plane of symmetry, which brings the shape nearest to its mirror image.
    offset
        The plane consists of the points x with x . normal = offset, in the unit of the file.
    displacement
        (V, 3) vector from the mirror image of a vertex's counterpart to the vertex; nan where the shape has no surface.
    along_normal
        (V,) component of ``displacement`` along the outward normal: positive where the shape extends farther out than at
        the counterpart.
    seconds
        Wall time.
    notes
        Repairs of the shape before fitting.

    Examples
    --------
    >>> found = meshmatch.find_symmetry("templates/samples/laughing.ply")
    >>> print(found.map.verdict, found.normal, found.offset)
    """

    map: VertexMap
    normal: Float[Floats, " 3"]
    offset: float
    displacement: Float[Floats, "V 3"]
    along_normal: Float[Floats, " V"]
    seconds: float
    notes: tuple[str, ...]


def find_symmetry(
    shape: ShapeLike,
    *,
    config: FitConfig | None = None,
    threads: int | None = None,
    progress: ProgressCallback | None = None,
) -> Symmetry:
    """Find the mirror counterpart of each vertex of a nearly symmetric shape: a head, a skull, a bird.

    The shape is matched to its mirror image, starting from the planes that bring most of its surface near to itself. No
    model and no other shape is needed. For a collection of nearly symmetric shapes, see `measure_asymmetry`.

    Parameters
    ----------
    shape
        A mesh, as in `match`.
    config
        Only its seed is used.
    threads
        How many fits are made at once; 2 by default.
    progress
        Called with the stage, the name of the shape and the share of the stage that is done (0..1).

    Returns
    -------
    Symmetry
        The map to the counterparts, and the plane. The verdict of the map is rarely good for a shape that is not nearly
        symmetric in any plane.

    Raises
    ------
    MeshmatchError
        The shape cannot be read, is a point cloud, or has large parts far apart.

    Examples
    --------
    >>> found = meshmatch.find_symmetry("templates/samples/laughing.ply")
    >>> across = found.map.index  # of each vertex, the one on the other side
    """
    began, config, count = time.monotonic(), config or FitConfig(), checked_threads(threads)
    check_config(config)
    original = as_shape(shape)
    clean = repair_or_raise(original)
    with thread_limit(1), worker_slot(threading.Semaphore(count)):
        plane, found = match_to_mirror_image(clean.shape, config, progress)
    image = replace(clean, shape=mirror_image(plane, clean.shape), original=mirror_image(plane, original))
    fits = replace(found.source, repaired=clean), replace(found.target, repaired=image)
    with thread_limit(1):
        to_image = maps_of_fits(fits, fits, count)[0]
    across = VertexMap.between(
        original,
        original,
        to_image.index,
        face=to_image.face,
        barycentric=to_image.barycentric[:, ::-1],  # faces of the image turn the other way
        confidence=to_image.confidence,
        verdict=to_image.verdict,
        reasons=to_image.reasons,
    )
    plane, displacement = _fit_plane(original, across)
    return Symmetry(
        map=across,
        normal=plane.normal,
        offset=plane.offset,
        displacement=displacement,
        along_normal=np.einsum("vi,vi->v", displacement, original.vertex_normals),
        seconds=time.monotonic() - began,
        notes=clean.notes,
    )


def _fit_plane(shape: Shape, across: VertexMap) -> tuple[MirrorPlane, Float[Floats, "V 3"]]:
    """Fit the plane of symmetry to counterparts; also return the displacements (V, 3) from their mirror images."""
    counterparts = across.apply(shape.verts_or_nan)
    known = np.isfinite(counterparts).all(axis=1) & np.isfinite(shape.verts_or_nan).all(axis=1)
    plane = MirrorPlane.between(shape.verts[known], counterparts[known], shape.vertex_areas[known])
    return plane, shape.verts_or_nan - plane.reflect(counterparts)
