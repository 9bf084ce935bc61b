"""How good an atlas is: compactness, generalisation and specificity, by its number of modes.

Source: Davies, Learning shape: optimal models for analysing natural variability (2002). Distances between corresponding
points praise wrong correspondences: what is wrong in the same way in all shapes looks like the truth. Distances to
surfaces do not know correspondences, and so are given beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from meshmatch.arrays import Brief, Float, Floats, Int, Ints
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.modes import inner_products, principal, rounding, weighted_sums
from meshmatch.collections.superimpose import Shapes, Superimposed
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.shape import Shape

COUNTS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89)
"""Numbers of modes that are measured, as far as there are so many, and the largest that can be."""
FOLDS = 100
"""Of more shapes than these, several are left out at a time."""
MOST_SHAPES = 1000
"""Of a larger collection so many random shapes are measured, as if they were all."""
_POINTS = 300  # of a surface whose distance to the other one is measured
_KEPT = 100  # surfaces in memory
_LONGER = 0.6  # of the time, for generalisation
_NEAREST = 2  # shapes of the collection, by their points, to which a random shape's distance is measured


@dataclass(frozen=True, eq=False, repr=False)
class Measures(Brief):
    """The three measures for K numbers of modes; distances are means over the surface, in the unit of the shapes.

    Attributes
    ----------
    counts : (K,) numbers of modes
    compactness : (K,) share of the variance that so many modes explain
    generalisation : (K,) distance of a shape that the modes do not know from what they make of it, between points
    generalisation_error : (K,) its standard error, over the shapes
    generalisation_surface : (K,) the same between surfaces, both ways
    specificity : (K,) distance of a random shape from the nearest shape of the collection, between points
    specificity_error : (K,) its standard error, over the random shapes
    specificity_surface : (K,) the same between surfaces, both ways
    samples, seed : how many random shapes, and with which random numbers
    left_out : how many shapes are left out at a time: 1 but for large collections
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
    """Measure an atlas on the shapes that it was made of: compactness, generalisation and specificity.

    Of more than 1,000 shapes so many are measured. They are left out one at a time, or of more than 100 in 100 parts;
    the mean and the modes are made of the others, and the shape is laid over that mean. Between surfaces a random shape
    is compared with the two nearest by points.

    Parameters
    ----------
    atlas
        The atlas.
    points
        (S, V, 3) the shapes that it was made of.
    surfaces
        The shapes themselves, each in the frame of its points, to compare with these rather than with the registered
        template.
    samples
        Random shapes with normal scores.
    seed
        Of the random shapes.
    progress
        As in `match`.

    Returns
    -------
    Measures
        For each number of modes.

    Raises
    ------
    InputError
        The shapes are not those of the atlas, or fewer than four: a model of what is left needs three.
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
    if S > MOST_SHAPES:
        some = np.sort(np.random.default_rng(seed).permutation(S)[:MOST_SHAPES]).tolist()
        atlas = replace(atlas, names=tuple(atlas.names[k] for k in some), scores=atlas.scores[some])
        points = [points[k] for k in some]
        surfaces = None if surfaces is None else [surfaces[k] for k in some]
        S = MOST_SHAPES
    if S < 4:
        raise InputError(f"the measures of an atlas need four shapes or more, not {S}")
    folds = np.array_split(np.random.default_rng(seed).permutation(S), min(S, FOLDS))
    most = min(len(atlas.modes), S - 1 - len(folds[0]))
    counts = np.array(sorted({*(count for count in COUNTS if count <= most), min(most, COUNTS[-1])}), np.int64)
    collection = _Collection(atlas, points, surfaces, seed)

    def told(done: float) -> None:
        if progress is not None:
            progress("measures", "atlas", done)

    general = np.empty((2, S, len(counts)))
    for number, out in enumerate(folds):
        general[:, out] = collection.generalisation(out, counts)
        told(_LONGER * (number + 1) / len(folds))
    special = np.empty((2, samples, len(counts)))
    draws = np.random.default_rng(seed).standard_normal((samples, len(atlas.modes)))
    for number, draw in enumerate(draws):
        special[:, number] = collection.specificity(draw, counts)
        told(_LONGER + (1 - _LONGER) * (number + 1) / samples)
    means = [found.mean(axis=0) for found in (*general, *special)]
    errors = [found.std(axis=0, ddof=1) / np.sqrt(len(found)) for found in (general[0], special[0])]
    return Measures(
        counts, atlas.compactness[counts - 1], means[0], errors[0], means[1], means[2], errors[1], means[3],
        samples, seed, len(folds[0]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Real:
    """A shape's surface, some points on it, and the share of the surface around each."""

    surface: MappedMesh
    points: Float[Floats, "N 3"]
    share: Float[Floats, " N"]


class _Collection:
    """An atlas, with the shapes that it was made of."""

    def __init__(self, atlas: Atlas, points: Shapes, surfaces: Sequence[Shape] | None, seed: int) -> None:
        self._atlas, self._shapes, self._surfaces = atlas, points, surfaces
        self._products = inner_products(points, atlas.laid)
        rows = np.random.default_rng(seed).permutation(len(atlas.mean))[:_POINTS]
        self._known = lru_cache(maxsize=_KEPT)(lambda row: self._real(row, atlas.laid))
        self._rows, self._share = rows, atlas.weights[rows] / atlas.weights[rows].sum()

    def generalisation(self, out: Int[Ints, " B"], counts: Int[Ints, " K"]) -> Float[Floats, "2 B K"]:
        """How far shapes are from what a model of all others makes of them, between points and between surfaces."""
        atlas, S = self._atlas, len(self._shapes)
        kept = np.setdiff1d(np.arange(S), out)
        found = principal(self._products[np.ix_(kept, kept)], int(counts[-1]), atlas.robust, rounding(atlas.laid))
        shares = np.zeros((1 + len(found.modes), S))
        shares[:, kept] = np.concatenate([found.center[None], found.modes])
        sums = weighted_sums(self._shapes, atlas.laid, shares)
        laid = replace(atlas.laid, consensus=atlas.mean + sums[0])
        apart = np.empty((2, len(out), len(counts)))
        for number, row in enumerate(out.tolist()):
            known, real = self._laid(row, laid), self._real(row, laid)
            scores = np.einsum("mvi,v,vi->m", sums[1:], atlas.weights, known - laid.consensus, optimize=True)
            for column, count in enumerate(counts.tolist()):
                made = laid.consensus + np.tensordot(scores[:count], sums[1 : 1 + count], 1)
                apart[:, number, column] = self._apart(made, known), self._between_surfaces(made, real)
        return apart

    def specificity(self, draw: Float[Floats, " M"], counts: Int[Ints, " K"]) -> Float[Floats, "2 K"]:
        """How far the shapes of random scores are from the nearest shape, between points and between surfaces."""
        atlas = self._atlas
        own = atlas.scores * atlas.deviations
        apart = np.empty((2, len(counts)))
        for column, count in enumerate(counts.tolist()):
            made = atlas.mean + atlas.offsets(draw[None, :count])[0]
            # Squared distances over the surface: along these modes, and across.
            along = np.square(own[:, :count] - draw[:count] * atlas.deviations[:count]).sum(axis=1)
            squared = along + np.diag(self._products) - np.square(own[:, :count]).sum(axis=1)
            near = np.argsort(squared)[: 2 * _NEAREST].tolist()
            own_points = [self._apart(made, self._laid(row, atlas.laid)) for row in near]
            apart[0, column] = min(own_points)
            best = [near[k] for k in np.argsort(own_points)[:_NEAREST]]
            apart[1, column] = min(self._between_surfaces(made, self._known(row)) for row in best)
        return apart

    def _laid(self, row: int, laid: Superimposed) -> Floats:
        """The points of a shape laid over the others."""
        return np.asarray(laid.align(np.asarray(self._shapes[row], np.float64)[None])[0])

    def _real(self, row: int, laid: Superimposed) -> _Real:
        """The surface of a shape laid over the others."""
        if self._surfaces is None:
            known = self._laid(row, laid)
            return _Real(MappedMesh.of(Shape(known, self._atlas.faces)), known[self._rows], self._share)
        poses = laid.poses(np.asarray(self._shapes[row], np.float64)[None])
        own = self._surfaces[row]
        shape = Shape(poses.apply(own.verts[None])[0], own.faces)
        rows = np.linspace(0, shape.V - 1, min(shape.V, _POINTS)).astype(np.int64)
        share = shape.vertex_areas[rows] / shape.vertex_areas[rows].sum()
        return _Real(MappedMesh.of(shape), shape.verts[rows], share)

    def _apart(self, made: Floats, known: Floats) -> float:
        return float(self._atlas.weights @ np.linalg.norm(made - known, axis=1))

    def _between_surfaces(self, made: Floats, real: _Real) -> float:
        """Mean distance of some points of each from the other's surface, the mean of both ways."""
        there = real.surface.query(made[self._rows]).distance @ self._share
        back = MappedMesh.of(Shape(made, self._atlas.faces)).query(real.points).distance @ real.share
        return float(there + back) / 2
