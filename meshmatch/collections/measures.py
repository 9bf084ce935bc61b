"""Quality of an atlas by its number of modes: compactness, generalisation and specificity.

Source: Davies, Learning shape: optimal models for analysing natural variability (2002). Distances between corresponding
points favour consistently wrong correspondences, as errors that all shapes share go unnoticed. Distances between surfaces,
which do not depend on correspondences, are therefore given as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.modes import inner_products, principal_components, rounding_variance, weighted_sums
from meshmatch.collections.superimpose import Shapes, Superimposed
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.shape import Shape

COUNTS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
"""Numbers of modes to measure, in addition to the largest possible one."""
MAX_FOLDS = 100
"""Largest number of folds: with more shapes than this, several are left out at a time."""
MAX_SHAPES = 1000
"""Largest number of shapes to measure; of a larger collection, a random sample of this size stands for all."""
_POINTS = 300  # points per surface from which distances to another surface are measured
_MAX_CACHED = 100  # surfaces in memory
_GENERALISATION_TIME = 0.6  # share of the run time, for progress
_NEAREST = 2  # shapes nearest by points to a random shape, to which its surface distance is measured


@dataclass(frozen=True, eq=False, repr=False)
class Measures(ShortRepr):
    """The three measures for K numbers of modes; distances are means over the surface, in the unit of the shapes.

    Attributes
    ----------
    counts : (K,) numbers of modes
    compactness : (K,) share of the variance that these modes explain
    generalisation : (K,) distance of a left-out shape from its reconstruction by the modes, between corresponding points
    generalisation_error : (K,) its standard error, over the shapes
    generalisation_surface : (K,) the same distance between surfaces, the mean of both directions
    specificity : (K,) distance of a random shape from the nearest shape of the collection, between corresponding points
    specificity_error : (K,) its standard error, over the random shapes
    specificity_surface : (K,) the same distance between surfaces, the mean of both directions
    samples, seed : number of random shapes, and their random seed
    left_out : number of shapes left out at a time: 1 except for large collections
    """

    counts: Int[Ints, " K"]
    compactness: Float[Floats, " K"]
    generalisation: Float[Floats, " K"]
    generalisation_error: Float[Floats, " K"]
    generalisation_surface: Float[Floats, " K"]
    specificity: Float[Floats, " K"]
    specificity_error: Float[Floats, " K"]
    specificity_surface: Float[Floats, " K"]
    samples: int
    seed: int
    left_out: int


def measure_atlas(
    atlas: Atlas,
    points: Shapes,
    *,
    surfaces: Sequence[Shape] | None = None,
    samples: int = 50,
    seed: int = 0,
    progress: ProgressCallback | None = None,
) -> Measures:
    """Measure compactness, generalisation and specificity of an atlas, on the shapes that it was built from.

    Of more than 1,000 shapes, a random 1,000 are measured. Each is left out in turn, or one of 100 folds if there are more
    than 100 shapes; the mean and the modes are computed from the others, and the shape is aligned with that mean. The
    surface of a random shape is compared with those of the two shapes that are nearest by points.

    Parameters
    ----------
    atlas
        The atlas.
    points
        (S, V, 3) vertices of the shapes that it was built from.
    surfaces
        The original shapes, each in the frame of its points, to measure surface distances to; by default the registered
        shapes.
    samples
        Number of random shapes, whose scores are drawn from a normal distribution.
    seed
        Random seed.
    progress
        As in `match`.

    Returns
    -------
    Measures
        The measures for each number of modes.

    Raises
    ------
    InputError
        The shapes are not those of the atlas, or fewer than four.
    OptionError
        Fewer than two random shapes.

    Examples
    --------
    >>> base = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> shapes = [base.verts * [1, height, 1] for height in (0.9, 1.0, 1.1, 1.2)]
    >>> meshmatch.measure_atlas(meshmatch.Atlas.of(shapes, base.faces), shapes, samples=2)
    """
    S = len(points)
    if S != len(atlas.names) or (surfaces is not None and len(surfaces) != S):
        raise InputError(f"the atlas is of {len(atlas.names)} shapes, not of {S}", "give those that it was made of")
    if samples < 2:
        raise OptionError(f"specificity needs two random shapes or more, not {samples}", "50 are usual")
    if S > MAX_SHAPES:
        some = np.sort(np.random.default_rng(seed).permutation(S)[:MAX_SHAPES]).tolist()
        atlas = replace(atlas, names=tuple(atlas.names[k] for k in some), scores=atlas.scores[some])
        points = [points[k] for k in some]
        surfaces = None if surfaces is None else [surfaces[k] for k in some]
        S = MAX_SHAPES
    if S < 4:
        raise InputError(f"the measures of an atlas need four shapes or more, not {S}")
    folds = np.array_split(np.random.default_rng(seed).permutation(S), min(S, MAX_FOLDS))
    max_modes = min(len(atlas.modes), S - 1 - len(folds[0]))
    counts = np.array(
        sorted({*(count for count in COUNTS if count <= max_modes), min(max_modes, COUNTS[-1])}), np.int64
    )
    collection = _AtlasWithShapes(atlas, points, surfaces, seed)

    def report(done: float) -> None:
        if progress is not None:
            progress("measures", "atlas", done)

    general = np.empty((2, S, len(counts)))
    for number, out in enumerate(folds):
        general[:, out] = collection.generalisation(out, counts)
        report(_GENERALISATION_TIME * (number + 1) / len(folds))
    special = np.empty((2, samples, len(counts)))
    draws = np.random.default_rng(seed).standard_normal((samples, len(atlas.modes)))
    for number, draw in enumerate(draws):
        special[:, number] = collection.specificity(draw, counts)
        report(_GENERALISATION_TIME + (1 - _GENERALISATION_TIME) * (number + 1) / samples)
    means = [found.mean(axis=0) for found in (*general, *special)]
    errors = [found.std(axis=0, ddof=1) / np.sqrt(len(found)) for found in (general[0], special[0])]
    return Measures(
        counts, atlas.compactness[counts - 1], means[0], errors[0], means[1], means[2], errors[1], means[3],
        samples, seed, len(folds[0]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Surface:
    """The surface of an aligned shape, some of its vertices, and the share of the surface around each."""

    surface: MappedMesh
    points: Float[Floats, "N 3"]
    share: Float[Floats, " N"]


class _AtlasWithShapes:
    """An atlas with the shapes that it was built from, and their inner products."""

    def __init__(self, atlas: Atlas, points: Shapes, surfaces: Sequence[Shape] | None, seed: int) -> None:
        self._atlas, self._shapes, self._surfaces = atlas, points, surfaces
        self._products = inner_products(points, atlas.laid)
        rows = np.random.default_rng(seed).permutation(len(atlas.mean))[:_POINTS]
        self._cached_surface = lru_cache(maxsize=_MAX_CACHED)(lambda row: self._surface_of(row, atlas.laid))
        self._sample_rows, self._sample_weights = rows, atlas.weights[rows] / atlas.weights[rows].sum()

    def generalisation(self, out: Int[Ints, " B"], counts: Int[Ints, " K"]) -> Float[Floats, "2 B K"]:
        """Distances of left-out shapes from their reconstructions, between points (row 0) and surfaces (row 1).

        ``out`` are the rows of the shapes to leave out; the model is built from all others.
        """
        atlas, S = self._atlas, len(self._shapes)
        remaining = np.setdiff1d(np.arange(S), out)
        found = principal_components(
            self._products[np.ix_(remaining, remaining)], int(counts[-1]), atlas.robust, rounding_variance(atlas.laid)
        )
        shares = np.zeros((1 + len(found.modes), S))
        shares[:, remaining] = np.concatenate([found.center[None], found.modes])
        sums = weighted_sums(self._shapes, atlas.laid, shares)
        alignment = replace(atlas.laid, consensus=atlas.mean + sums[0])
        distances = np.empty((2, len(out), len(counts)))
        for number, row in enumerate(out.tolist()):
            known, real = self._aligned(row, alignment), self._surface_of(row, alignment)
            scores = np.einsum("mvi,v,vi->m", sums[1:], atlas.weights, known - alignment.consensus, optimize=True)
            for column, count in enumerate(counts.tolist()):
                reconstruction = alignment.consensus + np.tensordot(scores[:count], sums[1 : 1 + count], 1)
                distances[:, number, column] = (
                    self._point_distance(reconstruction, known),
                    self._surface_distance(reconstruction, real),
                )
        return distances

    def specificity(self, draw: Float[Floats, " M"], counts: Int[Ints, " K"]) -> Float[Floats, "2 K"]:
        """Distances of a random shape from the nearest shape, between points (row 0) and surfaces (row 1).

        ``draw`` are its scores, of which the first 1, 2, ... are used.
        """
        atlas = self._atlas
        own = atlas.scores * atlas.deviations
        distances = np.empty((2, len(counts)))
        for column, count in enumerate(counts.tolist()):
            reconstruction = atlas.mean + atlas.offsets(draw[None, :count])[0]
            # Squared distances over the surface: within the span of these modes, and orthogonal to it.
            along = np.square(own[:, :count] - draw[:count] * atlas.deviations[:count]).sum(axis=1)
            squared = along + np.diag(self._products) - np.square(own[:, :count]).sum(axis=1)
            near = np.argsort(squared)[: 2 * _NEAREST].tolist()
            own_points = [self._point_distance(reconstruction, self._aligned(row, atlas.laid)) for row in near]
            distances[0, column] = min(own_points)
            best = [near[k] for k in np.argsort(own_points)[:_NEAREST]]
            distances[1, column] = min(
                self._surface_distance(reconstruction, self._cached_surface(row)) for row in best
            )
        return distances

    def _aligned(self, row: int, alignment: Superimposed) -> Floats:
        """The aligned vertices of a shape."""
        return np.asarray(alignment.align(np.asarray(self._shapes[row], np.float64)[None])[0])

    def _surface_of(self, row: int, alignment: Superimposed) -> _Surface:
        """The aligned surface of a shape: of the original one if there are originals."""
        if self._surfaces is None:
            known = self._aligned(row, alignment)
            return _Surface(
                MappedMesh.of(Shape(known, self._atlas.faces)), known[self._sample_rows], self._sample_weights
            )
        poses = alignment.poses(np.asarray(self._shapes[row], np.float64)[None])
        own = self._surfaces[row]
        shape = Shape(poses.apply(own.verts[None])[0], own.faces)
        rows = np.linspace(0, shape.V - 1, min(shape.V, _POINTS)).astype(np.int64)
        share = shape.vertex_areas[rows] / shape.vertex_areas[rows].sum()
        return _Surface(MappedMesh.of(shape), shape.verts[rows], share)

    def _point_distance(self, reconstruction: Floats, known: Floats) -> float:
        """Mean distance between corresponding points, over the surface."""
        return float(self._atlas.weights @ np.linalg.norm(reconstruction - known, axis=1))

    def _surface_distance(self, reconstruction: Floats, real: _Surface) -> float:
        """Mean distance of points of each surface from the other, averaged over both directions."""
        there = real.surface.query(reconstruction[self._sample_rows]).distance @ self._sample_weights
        back = MappedMesh.of(Shape(reconstruction, self._atlas.faces)).query(real.points).distance @ real.share
        return float(there + back) / 2
