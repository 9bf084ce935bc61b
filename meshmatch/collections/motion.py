"""The frames of a sequence, smoothed in time, and how they move.

Fits of frames lie on their surfaces, but slide along them, each in its own way. Paths are smoothed by least squares with a
penalty on second differences (Whittaker 1923), whose weight is the one that best predicts each frame from the others
(cross-validation; the generalised one would hold a first or last frame to its own noise). The motion is a sum of principal
components, and each has a weight of its own: a beat stands out of the noise, and needs little. From the first component on
that may as well move evenly, the rest is taken for noise. Then each vertex is put back onto the surface of its frame: how
that moves was measured, and stays as it is.
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
_WEIGHTS = 10.0 ** np.arange(-4, 7.1, 0.25)  # of second differences, from hardly any to an even motion
_NONE = 1e-12  # of the energy of a motion: a component that has less is rounding
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
    some, others = rough[known], rough[~known]  # what is missing moves freely
    rough = some[:, known] - some[:, ~known] @ np.linalg.solve(others[:, ~known], others[:, known])
    eigenvalues, vectors = np.linalg.eigh(rough)
    kept = 1 / (1 + np.outer(_WEIGHTS, np.maximum(eigenvalues, 0.0)))  # of each eigenvector, by each weight
    held = kept @ np.square(vectors).T  # how much of each frame is its own, by each weight
    found = mean = np.full((count, count), 1 / count)
    moved, rest = paths - mean @ paths, np.eye(count) - mean
    energies, components = np.linalg.eigh(moved @ moved.T)
    for component in components.T[energies > _NONE * energies[-1]][::-1]:
        own = vectors.T @ component
        missed = (((1 - kept) * own) @ vectors.T) / np.maximum(1 - held, _NONE)  # of each frame, by the others
        best = int(np.square(missed).sum(axis=1).argmin())
        if best == len(kept) - 1:
            break
        found = found + np.outer(vectors @ (kept[best] * own), component)
        rest = rest - np.outer(component, component)
    return np.asarray(found + (vectors * kept[-1]) @ vectors.T @ rest)


def _onto(
    points: Float[Floats, "V 3"], own: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], first: Float[Floats, "V 3"]
) -> Float[Floats, "V 3"]:
    """Points on the surface of a frame, each near its vertex: among sheets that touch, on its own."""
    unit = float(np.sqrt(triangle_areas(own, faces).sum()))
    normals = vertex_normals(own, faces)
    foot = Surface(own / unit, faces, normals, first / unit).query(points / unit, normals, resting=first / unit)
    return interpolate(own, faces[foot.face], foot.barycentric)
