"""Smooth the frames of a sequence in time, and measure their motion.

Fits of frames lie on the surfaces but slide along them, differently in each frame. Paths of vertices are smoothed by least
squares with a penalty on second differences (Whittaker 1923). The weight of the penalty is chosen by leave-one-out
cross-validation; generalised cross-validation would fit the noise of the first and last frames. The motion is split into
principal components, each with a weight of its own, as strong components such as a heart beat need little smoothing. From
the first component on for which the largest weight is best, all further components are treated as noise and get that
weight. Finally each vertex is projected back onto the surface of its frame, so that only sliding is removed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.geometry.triangles import interpolate, triangle_areas, vertex_areas, vertex_normals
from meshmatch.maps.footpoints import Surface

MIN_FRAMES, MAX_FRAMES = 5, 2000
"""Smallest and largest number of frames of a sequence that can be smoothed."""
_WEIGHTS = 10.0 ** np.arange(-4, 7.1, 0.25)  # weights of the penalty, from almost no smoothing to uniform motion
_MIN_ENERGY = 1e-12  # components with a smaller share of the energy are rounding
_SAMPLED = 1500  # vertices used to choose the weights


def smooth_frames(
    points: Float[Floats, "T V 3"], faces: Int[Ints, "F 3"], times: Sequence[int], cycle: bool = False, moments: int = 0
) -> Iterator[Float[Floats, "V 3"]]:
    """Yield the frames of a sequence with the paths of their vertices smoothed along their surfaces.

    ``times`` are the ascending indices of the T frames in the sequence, from 0; frames may be missing. ``cycle``: the
    last frame is followed by the first. ``moments``: length of the whole sequence, needed if the last frames are missing.

    `OptionError`: too few or too many frames.
    """
    count = max(moments, max(times) + 1)
    if len(points) < MIN_FRAMES or count > MAX_FRAMES:
        many = count if len(points) >= MIN_FRAMES else len(points)
        what = f"{many:,} frame{'s' * (many > 1)} of a sequence cannot be smoothed in time"
        raise OptionError(what, f"{MIN_FRAMES} to {MAX_FRAMES:,} can")
    known = np.isin(np.arange(count), times)
    some = np.linspace(0, points.shape[1] - 1, _SAMPLED).astype(np.int64)
    smooth = _best_filter(np.asarray(points[:, some], np.float64).reshape(len(points), -1), known, cycle)
    first = np.asarray(points[0], np.float64)
    for row, own in zip(smooth, points, strict=True):
        yield _project(np.tensordot(row, points, 1), np.asarray(own, np.float64), faces, first)


def area_strain(
    points: Float[Floats, "V 3"], first: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> Float[Floats, " V"]:
    """Relative growth of the area around each vertex since the first frame; nan where that area was 0."""
    before = vertex_areas(first, faces)
    grown = np.full(len(before), np.nan)
    np.divide(vertex_areas(points, faces) - before, before, out=grown, where=before > 0)
    return grown


def _best_filter(paths: Float[Floats, "T N"], known: Bool[Bools, " M"], cycle: bool) -> Float[Floats, "T T"]:
    """Compute the linear filter that smooths paths in time; ``known`` are the moments, of M, that have frames."""
    second = np.diff(np.eye(len(known)), 2, axis=0)
    if cycle:
        once = np.roll(np.eye(len(known)), 1, axis=1) - np.eye(len(known))
        second = once.T @ once
    rough, count = second.T @ second, len(paths)
    some, others = rough[known], rough[~known]  # eliminate missing frames, which move freely
    rough = some[:, known] - some[:, ~known] @ np.linalg.solve(others[:, ~known], others[:, known])
    eigenvalues, vectors = np.linalg.eigh(rough)
    responses = 1 / (1 + np.outer(_WEIGHTS, np.maximum(eigenvalues, 0.0)))  # response of each eigenvector, by weight
    leverage = responses @ np.square(vectors).T  # diagonal of the filter: each frame's influence on itself, by weight
    found = mean = np.full((count, count), 1 / count)
    moved, rest = paths - mean @ paths, np.eye(count) - mean
    energies, components = np.linalg.eigh(moved @ moved.T)
    for component in components.T[energies > _MIN_ENERGY * energies[-1]][::-1]:
        own = vectors.T @ component
        residuals = (((1 - responses) * own) @ vectors.T) / np.maximum(1 - leverage, _MIN_ENERGY)  # leave-one-out
        best = int(np.square(residuals).sum(axis=1).argmin())
        if best == len(responses) - 1:
            break
        found = found + np.outer(vectors @ (responses[best] * own), component)
        rest = rest - np.outer(component, component)
    return np.asarray(found + (vectors * responses[-1]) @ vectors.T @ rest)


def _project(
    points: Float[Floats, "V 3"], own: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], first: Float[Floats, "V 3"]
) -> Float[Floats, "V 3"]:
    """Project points onto the surface of a frame; among touching sheets, onto the vertex's own sheet.

    ``own`` are the vertices of the frame; ``first`` are those of the first frame, which tell sheets apart.
    """
    unit = float(np.sqrt(triangle_areas(own, faces).sum()))
    normals = vertex_normals(own, faces)
    foot = Surface(own / unit, faces, normals, first / unit).query(points / unit, normals, resting=first / unit)
    return interpolate(own, faces[foot.face], foot.barycentric)
