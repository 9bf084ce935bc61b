"""Which shapes of a folder are mirror images of the others: left hands among right ones.

Every shape and its mirror image are aligned with some of the others; how much nearer one of the two lies is evidence that
both shapes are of one side, or not. The sides that agree best with all the evidence are the leading eigenvector of its
matrix. Where shapes are nearly symmetric, or the evidence contradicts itself, there are no sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from meshmatch.arrays import Bool, Bools
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.progress import Progress
from meshmatch.shapes.normalise import align
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Scale, unit_frame
from meshmatch.threads import parallel_map

_COMPARED = 6  # shapes with which each is compared
_SAMPLES = 300
_MIRROR = np.array([-1.0, 1.0, 1.0])
# Set by hand, on generated hands and on shapes without sides.
_ASYMMETRIC = 0.6  # residual of a shape and its own mirror image, against that of two shapes
_CLEAR = 0.05  # mean logarithm of how much nearer one side lies: 0.12 for hands
_CONSISTENT = 0.9  # share of the evidence that agrees with the sides: posed animals reach 0.75, hands 0.99


def mirrored(shape: Shape) -> Shape:
    """The mirror image of a shape in the plane x = 0, facing out."""
    return replace(shape, verts=shape.verts * _MIRROR, faces=shape.faces[:, ::-1])


def other_side(shapes: Sequence[Repaired], scale: Scale, seed: int, progress: Progress) -> Bool[Bools, " N"]:
    """Which of the shapes are mirror images of most: none of them where shapes have no sides."""
    N = len(shapes)
    nobody = np.zeros(N, bool)
    if N < 3:
        return nobody
    parts = [_samples(each.shape, scale, [seed, number]) for number, each in enumerate(shapes)]
    images = [mirror_image(part) for part in parts]
    compared = np.unique(np.linspace(0, N - 1, min(N, _COMPARED)).astype(int))
    own = [align(images[k], parts[k], "rigid")[0].residual for k in compared]
    evidence, apart = np.zeros((N, N)), []
    for done, i in enumerate((*compared, *np.setdiff1d(np.arange(N), compared))):
        for j in compared:
            if i == j or evidence[i, j]:
                continue
            same, other = (align(part, parts[j], "rigid")[0].residual for part in (parts[i], images[i]))
            evidence[i, j] = evidence[j, i] = np.log(other / same)
            apart.append(min(same, other))
        if done + 1 == len(compared) and np.median(own) < _ASYMMETRIC * np.median(apart):
            return nobody
        progress((done + 1) / N)
    among = evidence[np.ix_(compared, compared)]
    sides = np.ones(N)
    sides[compared] = np.where(np.linalg.eigh(among)[1][:, -1] < 0, -1.0, 1.0)
    votes = evidence[:, compared] @ sides[compared]
    sides = np.where(votes < 0, -1.0, 1.0)
    found = np.abs(evidence[:, compared])
    if (votes * sides).sum() < _CONSISTENT * found.sum() or found.sum() < _CLEAR * np.count_nonzero(found):
        return nobody
    return np.asarray(sides < 0) if (sides < 0).sum() <= N / 2 else np.asarray(sides > 0)


def is_other_side(shape: Repaired, others: Sequence[Repaired], scale: Scale, seed: int) -> bool:
    """Whether a shape is the mirror image of what some shapes of one side are."""
    part = _samples(shape.shape, scale, [seed, len(others)])
    image, evidence = mirror_image(part), 0.0
    for number in np.unique(np.linspace(0, len(others) - 1, min(len(others), _COMPARED)).astype(int)):
        one = _samples(others[number].shape, scale, [seed, int(number)])
        same, other = (align(each, one, "rigid")[0].residual for each in (part, image))
        evidence += float(np.log(other / same))
    return evidence < 0


def apart(source: Shape, target: Shape, seed: int) -> tuple[float, float]:
    """How far apart a source and a target lie, turned as they fit best, and a source and the mirror image of the target; in
    units of sqrt(area), normals included."""
    one, other = (_samples(shape, "area", [seed, number]) for number, shape in enumerate((source, target)))
    same, image = parallel_map(lambda each: align(each, one, "rigid")[0].residual, (other, mirror_image(other)))
    return same, image


def laid_mirrored(shape: Shape, seed: int) -> Shape:
    """The mirror image of a shape as it lies nearest to the shape, its vertices in their order, facing out."""
    frame = unit_frame(shape, "area", 0.5)
    part = _samples(shape, "area", [seed])
    pose = align(part, mirror_image(part), "rigid")[0].pose
    laid = frame.undo(pose.to_world(frame.apply(shape.verts) * _MIRROR))
    return Shape(laid, shape.faces[:, ::-1])


def _samples(shape: Shape, scale: Scale, seed: list[int]) -> OrientedPoints:
    return sample_surface(shape, _SAMPLES, np.random.default_rng(seed)).in_frame(unit_frame(shape, scale, 0.5))


def mirror_image(part: OrientedPoints) -> OrientedPoints:
    """Points of the mirror image in the plane x = 0."""
    return OrientedPoints(part.points * _MIRROR, part.normals * _MIRROR, part.signed, part.weights)
