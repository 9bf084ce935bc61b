"""The frames of a sequence, smoothed in time, and how they move.

Fits of frames lie on their surfaces, but slide along them, each in its own way. The path of every vertex is smoothed:
least squares with a penalty on second differences (Whittaker 1923). Its weight is the one that best predicts frames that are
left out, by generalised cross-validation (Craven and Wahba, Numerische Mathematik 31, 1979). Then each vertex is put back
onto the surface of its frame: how that moves was measured, and stays as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.geometry.triangles import interpolate, triangle_areas, vertex_areas, vertex_normals
from meshmatch.maps.footpoints import Surface

LEAST, MOST = 5, 2000
"""Frames of a sequence that can be smoothed."""
_WEIGHTS = 10.0 ** np.arange(-3, 6.1, 0.25)  # of second differences: the best of them is taken
_ASKED = 1500  # vertices that are asked which is best


def smoothed(
    points: Float[Floats, "T V 3"], faces: Int[Ints, "F 3"], times: Sequence[int], cycle: bool = False, moments: int = 0
) -> Iterator[Float[Floats, "V 3"]]:
    """The frames of a sequence, one after the other, with the paths of their vertices smoothed along their surfaces.

    ``times`` are the places of the T frames in the sequence, from 0, ascending, where some may be missing. ``cycle``: the
    last frame is followed by the first. ``moments``: how many frames the whole sequence has, if its last are missing.

    `OptionError`: too few or too many frames.
    """
    count = max(moments, max(times) + 1)
    if len(points) < LEAST or count > MOST:
        many = count if len(points) >= LEAST else len(points)
        what = f"{many:,} frame{'s' * (many > 1)} of a sequence cannot be smoothed in time"
        raise OptionError(what, f"{LEAST} to {MOST:,} can")
    known = np.isin(np.arange(count), times)
    some = np.linspace(0, points.shape[1] - 1, _ASKED).astype(np.int64)
    smooth = _best_filter(np.asarray(points[:, some], np.float64).reshape(len(points), -1), known, cycle)
    first = np.asarray(points[0], np.float64)
    for row, own in zip(smooth, points, strict=True):
        yield _onto(np.tensordot(row, points, 1), np.asarray(own, np.float64), faces, first)


def area_strain(
    points: Float[Floats, "V 3"], first: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> Float[Floats, " V"]:
    """By how much of itself the surface around each vertex has grown since the first frame; nan where it had none."""
    before = vertex_areas(first, faces)
    grown = np.full(len(before), np.nan)
    np.divide(vertex_areas(points, faces) - before, before, out=grown, where=before > 0)
    return grown


def _best_filter(paths: Float[Floats, "T N"], known: Bool[Bools, " M"], cycle: bool) -> Float[Floats, "T T"]:
    """What makes smooth paths of paths that are known at some of M moments."""
    second = np.diff(np.eye(len(known)), 2, axis=0)
    if cycle:
        once = np.roll(np.eye(len(known)), 1, axis=1) - np.eye(len(known))
        second = once.T @ once
    rough, count = second.T @ second, len(paths)
    best, least = np.eye(count), np.inf
    for weight in _WEIGHTS:
        smooth = np.linalg.inv(np.diag(known.astype(float)) + weight * rough)[np.ix_(known, known)]
        left = 1 - np.trace(smooth) / count
        error = float(np.square(paths - smooth @ paths).mean()) / left**2
        if error < least:
            best, least = smooth, error
    return best


def _onto(
    points: Float[Floats, "V 3"], own: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], first: Float[Floats, "V 3"]
) -> Float[Floats, "V 3"]:
    """Points on the surface of a frame, each near its vertex: among sheets that touch, on its own."""
    unit = float(np.sqrt(triangle_areas(own, faces).sum()))
    normals = vertex_normals(own, faces)
    foot = Surface(own / unit, faces, normals, first / unit).query(points / unit, normals, resting=first / unit)
    return interpolate(own, faces[foot.face], foot.barycentric)
