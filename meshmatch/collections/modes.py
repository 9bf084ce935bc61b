"""Principal components (modes of variation) of superimposed shapes.

For up to 3,000 shapes they are computed from the S x S matrix of inner products; for more, by a randomised SVD, which
reads all shapes several times but does not need that matrix.

Sources: Cootes et al., Active shape models, CVIU 61 (1995). With outliers: spherical principal components, Locantore et
al., Robust principal component analysis for functional data, Test 8 (1999). Randomised SVD: Halko et al., Finding structure
with randomness, SIAM Review 53 (2011), algorithm 4.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.collections.superimpose import Shapes, Superimposed, iter_blocks
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import squared_lengths

_MIN_SHARE = 1e-12  # variances below this share of the largest are rounding
_ROUNDING = 1e-24  # variances below this share of the squared size are rounding
_MAD_TO_SD = 1.482602218505602  # standard deviation over median absolute deviation, of a normal distribution
_MAX_ROUNDS = 500
Found = TypeVar("Found", "Components", "Principal")
_MAX_EXACT = 3000  # shapes; for more, the modes are computed by randomised SVD
_OVERSAMPLING, _PASSES = 20, 4  # directions in addition to the requested ones; subspace iterations


@dataclass(frozen=True, eq=False)
class Components:
    """Center and modes of S shapes, as in `Atlas`; the center is an offset from the consensus."""

    center: Float[Floats, "V 3"]
    modes: Float[Floats, "M V 3"]
    deviations: Float[Floats, " M"]
    scores: Float[Floats, "S M"]
    total: float


def compute_modes(shapes: Shapes, alignment: Superimposed, max_modes: int, robust: bool = False) -> Components:
    """Compute the center and at most ``max_modes`` modes of shapes; `InputError` if they are all the same."""
    if len(shapes) > _MAX_EXACT:
        return _compute_by_sketch(shapes, alignment, max_modes, robust)
    products = inner_products(shapes, alignment)
    found = _require_modes(principal_components(products, max_modes, robust, rounding_variance(alignment)), robust)
    sums = weighted_sums(shapes, alignment, np.concatenate([found.center[None], found.modes]))
    centered = products - found.center @ products
    scores = centered @ found.modes.T / found.deviations
    return Components(sums[0], sums[1:], found.deviations, scores, found.total)


def rounding_variance(alignment: Superimposed) -> float:
    """Variance below which shapes differ only by rounding."""
    return _ROUNDING * float(alignment.weights @ squared_lengths(alignment.consensus))


def _require_modes(found: Found, robust: bool) -> Found:
    """Return the components if there are any, else raise `InputError`."""
    if not len(found.deviations):
        what = "most of the shapes do not differ" if robust else "the shapes do not differ"
        raise InputError(what, "leave out --robust" if robust else "an atlas is made of different shapes")
    return found


def _compute_by_sketch(shapes: Shapes, alignment: Superimposed, max_modes: int, robust: bool) -> Components:
    """Compute modes by randomised SVD.

    The consensus serves as the center: up to rounding it is the mean, or the spatial median if ``robust``.
    """
    S, N, min_variance = len(shapes), alignment.consensus.size, rounding_variance(alignment)
    shrink = np.ones(S)
    power = 0.0
    for rows, points in iter_blocks(shapes):
        squared = squared_lengths(_weighted_offsets(points, alignment))
        power += float(squared.sum())
        if robust:
            shrink[rows] = np.where(squared > min_variance, 1 / np.sqrt(np.maximum(squared, min_variance)), 0)
    width = min(max_modes + _OVERSAMPLING, N, S)
    sides = np.random.default_rng(0).standard_normal((N, width))
    for _ in range(_PASSES):
        image = np.zeros((N, width))
        for rows, points in iter_blocks(shapes):
            part = shrink[rows, None] * _weighted_offsets(points, alignment)
            image += part.T @ (part @ sides)
        sides = np.linalg.qr(image)[0]
    raw = np.concatenate([_weighted_offsets(points, alignment) @ sides for _, points in iter_blocks(shapes)])
    _, sizes, turn = np.linalg.svd(shrink[:, None] * raw, full_matrices=False)
    turn = turn[np.square(sizes) > _MIN_SHARE * np.square(sizes[0])]
    raw = raw @ turn.T
    deviations, order = _order_modes(raw, robust, min_variance)
    total = float(np.square(deviations).sum()) if robust else power / (S - 1)
    order = order[:max_modes]
    modes = (sides @ turn[order].T).T.reshape(len(order), *alignment.consensus.shape) / np.sqrt(alignment.weights)[
        :, None
    ]
    scores = raw[:, order] / deviations[order]
    return _require_modes(
        Components(np.zeros_like(alignment.consensus), modes, deviations[order], scores, total), robust
    )


@dataclass(frozen=True, eq=False)
class Principal:
    """Center and modes as linear combinations of S shapes, each less the consensus.

    ``center`` (S,) and ``modes`` (M, S) are the coefficients. ``deviations`` (M,) are the standard deviations along the
    modes, in the unit of the shapes, the largest first; ``total`` is the variance along all modes, kept or not.
    """

    center: Float[Floats, " S"]
    modes: Float[Floats, "M S"]
    deviations: Float[Floats, " M"]
    total: float


def inner_products(shapes: Shapes, alignment: Superimposed) -> Float[Floats, "S S"]:
    """Inner products of aligned shapes, each less the consensus: means over the surface, in squared units of the shapes."""
    count = len(shapes)
    found = np.empty((count, count))
    for rows, points in iter_blocks(shapes):
        own = _weighted_offsets(points, alignment)
        for columns, others in iter_blocks(shapes):
            if columns.start < rows.start:
                continue
            found[rows, columns] = own @ (own if columns == rows else _weighted_offsets(others, alignment)).T
            found[columns, rows] = found[rows, columns].T
    return found


def _weighted_offsets(points: Float[Floats, "B V 3"], alignment: Superimposed) -> Float[Floats, "B N"]:
    """Offsets of shapes from the consensus, times the square roots of the weights, with N = 3 V."""
    offset = (alignment.align(points) - alignment.consensus) * np.sqrt(alignment.weights)[:, None]
    return offset.reshape(len(points), -1)


def weighted_sums(shapes: Shapes, alignment: Superimposed, shares: Float[Floats, "M S"]) -> Float[Floats, "M V 3"]:
    """Linear combinations of aligned shapes, each less the consensus."""
    total = np.zeros((len(shares), *alignment.consensus.shape))
    for rows, points in iter_blocks(shapes):
        total += np.tensordot(shares[:, rows], alignment.align(points) - alignment.consensus, 1)
    return total


def principal_components(
    products: Float[Floats, "S S"], max_modes: int, robust: bool = False, min_variance: float = 0.0
) -> Principal:
    """Compute at most ``max_modes`` modes from inner products of shapes, those of the largest variance.

    Modes with a variance of ``min_variance`` or less are dropped. ``robust``: the center is the spatial median, and the
    modes are spherical principal components: those of the directions from the center, so that distant shapes count no
    more than others. Standard deviations are then estimated from median absolute deviations, and modes along which most
    shapes do not differ are dropped.
    """
    S = len(products)
    center = _spatial_median(products) if robust else np.full(S, 1 / S)
    centered = products - center @ products
    centered = centered - (centered @ center)[:, None]  # products of shapes less their center
    distances = np.sqrt(np.maximum(np.diag(centered), 0))
    near = distances > 1e-9 * distances.max()
    shrink = np.where(near, 1 / np.where(near, distances, 1), 0) if robust else np.ones(S)
    sizes, sides = np.linalg.eigh(shrink[:, None] * centered * shrink)
    kept = np.flatnonzero(sizes > _MIN_SHARE * sizes[-1])[::-1]
    shares = (sides[:, kept] * shrink[:, None] / np.sqrt(sizes[kept])).T
    scores = centered @ shares.T
    deviations, order = _order_modes(scores, robust, min_variance)
    total = float(np.square(deviations).sum())
    order = order[:max_modes]
    shares = shares[order] - shares[order].sum(axis=1)[:, None] * center
    return Principal(center, shares, deviations[order], total)


def _order_modes(
    scores: Float[Floats, "S M"], robust: bool, min_variance: float
) -> tuple[Float[Floats, " M"], Int[Ints, " K"]]:
    """Standard deviations of scores along all modes, and the modes to keep, largest first."""
    if robust:
        deviations = _MAD_TO_SD * np.median(np.abs(scores - np.median(scores, axis=0)), axis=0)
    else:
        deviations = np.sqrt(np.sum(np.square(scores), axis=0) / (len(scores) - 1))
    order = np.argsort(-deviations, kind="stable")
    variances = np.square(deviations[order])
    order = order[variances > max(min_variance, _MIN_SHARE * variances.max(initial=0.0))]
    return deviations, order


def _spatial_median(products: Float[Floats, "S S"]) -> Float[Floats, " S"]:
    """Coefficients of the shapes in their spatial median, the point with the least sum of distances (Weiszfeld 1937)."""
    S = len(products)
    center = np.full(S, 1 / S)
    scale = np.sqrt(np.maximum(np.diag(products).max(), 1e-300))
    for _ in range(_MAX_ROUNDS):
        squared = np.diag(products) - 2 * products @ center + center @ products @ center
        trust = 1 / np.maximum(np.sqrt(np.maximum(squared, 0)), 1e-9 * scale)
        new = trust / trust.sum()
        change = np.abs(new - center).max()
        center = new
        if change < 1e-12:
            break
    return center


def outward_signs(
    modes: Float[Floats, "M V 3"], mean: Float[Floats, "V 3"], weights: Float[Floats, " V"]
) -> Float[Floats, " M"]:
    """Signs (M,) that make each mode enlarge the mean, or its largest entry positive if it does not change the size."""
    growth = np.einsum("mvi,v,vi->m", modes, weights, mean, optimize=True)
    flat = modes.reshape(len(modes), -1)
    largest = flat[np.arange(len(flat)), np.abs(flat).argmax(axis=1)]
    size = np.sqrt(weights @ np.square(mean).sum(axis=1))
    return np.asarray(np.where(np.abs(growth) > 1e-6 * size, np.sign(growth), np.sign(largest)))
