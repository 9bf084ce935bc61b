"""Find the shapes of a folder that are mirror images of the others, such as left hands among right ones.

Every shape and its mirror image are aligned with some of the others; the difference of the residuals is evidence whether
the two shapes are of the same side. The assignment of sides that agrees best with all evidence is the leading eigenvector
of its matrix. If shapes are nearly symmetric, or the evidence is contradictory, no sides are assigned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshmatch.arrays import Bool, Bools
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress
from meshmatch.shapes.alignment import align
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Scale, unit_frame
from meshmatch.threads import parallel_map

_N_COMPARED = 6  # shapes with which each is compared
_N_SAMPLES = 300
_MIRROR = np.array([-1.0, 1.0, 1.0])
# Minima below which there are no sides. Set by hand, on generated hands and on shapes without sides.
_MIN_ASYMMETRY = 0.6  # residual between a shape and its mirror image, relative to that between two shapes
_MIN_LOG_RATIO = 0.05  # mean absolute logarithm of the ratio of the two residuals: 0.12 for hands
_MIN_CONSISTENCY = 0.9  # share of the evidence that agrees with the sides: posed animals reach 0.75, hands 0.99


def mirrored(shape: Shape) -> Shape:
    """Mirror a shape in the plane x = 0; faces are reversed so that normals still point outward."""
    return replace(shape, verts=shape.verts * _MIRROR, faces=shape.faces[:, ::-1])


def find_mirrored(shapes: Sequence[Repaired], scale: Scale, seed: int, progress: Progress) -> Bool[Bools, " N"]:
    """(N,) True for shapes that are mirror images of the majority; all False if the shapes have no sides."""
    N = len(shapes)
    none = np.zeros(N, bool)
    if N < 3:
        return none
    parts = [_sample_in_frame(each.shape, scale, [seed, number]) for number, each in enumerate(shapes)]
    images = [mirror_image(part) for part in parts]
    compared = np.unique(np.linspace(0, N - 1, min(N, _N_COMPARED)).astype(int))
    own_residuals = [align(images[k], parts[k], "rigid")[0].residual for k in compared]
    evidence, residuals = np.zeros((N, N)), []
    for done, i in enumerate((*compared, *np.setdiff1d(np.arange(N), compared))):
        for j in compared:
            if i == j or evidence[i, j]:
                continue
            residual, residual_mirrored = (align(part, parts[j], "rigid")[0].residual for part in (parts[i], images[i]))
            evidence[i, j] = evidence[j, i] = np.log(residual_mirrored / residual)
            residuals.append(min(residual, residual_mirrored))
        if done + 1 == len(compared) and np.median(own_residuals) < _MIN_ASYMMETRY * np.median(residuals):
            return none
        progress((done + 1) / N)
    matrix = evidence[np.ix_(compared, compared)]
    sides = np.ones(N)
    sides[compared] = np.where(np.linalg.eigh(matrix)[1][:, -1] < 0, -1.0, 1.0)
    votes = evidence[:, compared] @ sides[compared]
    sides = np.where(votes < 0, -1.0, 1.0)
    found = np.abs(evidence[:, compared])
    if (votes * sides).sum() < _MIN_CONSISTENCY * found.sum() or found.sum() < _MIN_LOG_RATIO * np.count_nonzero(found):
        return none
    return np.asarray(sides < 0) if (sides < 0).sum() <= N / 2 else np.asarray(sides > 0)


def is_mirrored(shape: Repaired, others: Sequence[Repaired], scale: Scale, seed: int) -> bool:
    """Whether a shape is a mirror image of the other shapes, which are all of one side."""
    part = _sample_in_frame(shape.shape, scale, [seed, len(others)])
    image, evidence = mirror_image(part), 0.0
    for number in np.unique(np.linspace(0, len(others) - 1, min(len(others), _N_COMPARED)).astype(int)):
        one = _sample_in_frame(others[number].shape, scale, [seed, int(number)])
        residual, residual_mirrored = (align(each, one, "rigid")[0].residual for each in (part, image))
        evidence += float(np.log(residual_mirrored / residual))
    return evidence < 0


def alignment_residuals(source: Shape, target: Shape, seed: int) -> tuple[float, float]:
    """Residuals of the best rigid alignments of a source with a target, and with the mirror image of the target.

    In units of sqrt(area), normals included.
    """
    one, other = (_sample_in_frame(shape, "area", [seed, number]) for number, shape in enumerate((source, target)))
    same, image = parallel_map(lambda each: align(each, one, "rigid")[0].residual, (other, mirror_image(other)))
    return same, image


def aligned_mirror_image(shape: Shape, seed: int) -> Shape:
    """Mirror image of a shape, rigidly aligned with the shape; same vertex order, normals outward."""
    frame = unit_frame(shape, "area", 0.5)
    part = _sample_in_frame(shape, "area", [seed])
    pose = align(part, mirror_image(part), "rigid")[0].pose
    laid = frame.undo(pose.to_world(frame.apply(shape.verts) * _MIRROR))
    return Shape(laid, shape.faces[:, ::-1])


def _sample_in_frame(shape: Shape, scale: Scale, seed: list[int]) -> OrientedPoints:
    return sample_surface(shape, _N_SAMPLES, np.random.default_rng(seed)).in_frame(unit_frame(shape, scale, 0.5))


def mirror_image(part: OrientedPoints) -> OrientedPoints:
    """Mirror points and normals in the plane x = 0."""
    return OrientedPoints(part.points * _MIRROR, part.normals * _MIRROR, part.signed, part.weights)
