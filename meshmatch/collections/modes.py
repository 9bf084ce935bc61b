"""Modes of variation of shapes that lie over one another.

Of some thousands, from their inner products alone; of more, by a random sketch, for which the shapes are read a few times
and a matrix of all inner products, which grows with their square, is never made.

Sources: Cootes et al., Active shape models, CVIU 61 (1995). With outliers: spherical principal components, Locantore et
al., Robust principal component analysis for functional data, Test 8 (1999). The sketch: Halko et al., Finding structure
with randomness, SIAM Review 53 (2011), algorithm 4.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.collections.superimpose import Shapes, Superimposed, blocks
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import squared_lengths

_SMALLEST = 1e-12  # of the largest variance: less is rounding
_ROUNDING = 1e-24  # of the squared size: a smaller variance is rounding
_MAD = 1.482602218505602  # of a normal distribution, its deviation by its median absolute deviation
_ROUNDS = 500
Found = TypeVar("Found", "Components", "Principal")
_SKETCHED = 3000  # shapes; of more the modes are found by a sketch
_SPARE, _PASSES = 20, 4  # directions beside those that are asked for, and how often all shapes are read


@dataclass(frozen=True, eq=False)
class Components:
    """Center and modes of S shapes, see `Atlas` for their arrays; the center is an offset from the consensus."""

    center: Float[Floats, "V 3"]
    modes: Float[Floats, "M V 3"]
    deviations: Float[Floats, " M"]
    scores: Float[Floats, "S M"]
    total: float


def components(shapes: Shapes, laid: Superimposed, most: int, robust: bool = False) -> Components:
    """Center and modes of aligned shapes; `InputError` where they are all the same."""
    if len(shapes) > _SKETCHED:
        return _sketched(shapes, laid, most, robust)
    products = inner_products(shapes, laid)
    found = _some(principal(products, most, robust, rounding(laid)), robust)
    sums = weighted_sums(shapes, laid, np.concatenate([found.center[None], found.modes]))
    moved = products - found.center @ products
    scores = moved @ found.modes.T / found.deviations
    return Components(sums[0], sums[1:], found.deviations, scores, found.total)


def rounding(laid: Superimposed) -> float:
    """Variance below which shapes differ by rounding alone."""
    return _ROUNDING * float(laid.weights @ squared_lengths(laid.consensus))


def _some(found: Found, robust: bool) -> Found:
    """What was found, if there are modes (`InputError`)."""
    if not len(found.deviations):
        what = "most of the shapes do not differ" if robust else "the shapes do not differ"
        raise InputError(what, "leave out --robust" if robust else "an atlas is made of different shapes")
    return found


def _sketched(shapes: Shapes, laid: Superimposed, most: int, robust: bool) -> Components:
    """The consensus is the center here: it is the mean, or the spatial median, up to rounding."""
    S, N, least = len(shapes), laid.consensus.size, rounding(laid)
    shrink = np.ones(S)
    power = 0.0
    for rows, points in blocks(shapes):
        squared = squared_lengths(_weighted(points, laid))
        power += float(squared.sum())
        if robust:
            shrink[rows] = np.where(squared > least, 1 / np.sqrt(np.maximum(squared, least)), 0)
    width = min(most + _SPARE, N, S)
    sides = np.random.default_rng(0).standard_normal((N, width))
    for _ in range(_PASSES):
        image = np.zeros((N, width))
        for rows, points in blocks(shapes):
            part = shrink[rows, None] * _weighted(points, laid)
            image += part.T @ (part @ sides)
        sides = np.linalg.qr(image)[0]
    raw = np.concatenate([_weighted(points, laid) @ sides for _, points in blocks(shapes)])
    _, sizes, turn = np.linalg.svd(shrink[:, None] * raw, full_matrices=False)
    turn = turn[np.square(sizes) > _SMALLEST * np.square(sizes[0])]
    raw = raw @ turn.T
    deviations, order = _ordered(raw, robust, least)
    total = float(np.square(deviations).sum()) if robust else power / (S - 1)
    order = order[:most]
    modes = (sides @ turn[order].T).T.reshape(len(order), *laid.consensus.shape) / np.sqrt(laid.weights)[:, None]
    scores = raw[:, order] / deviations[order]
    return _some(Components(np.zeros_like(laid.consensus), modes, deviations[order], scores, total), robust)


@dataclass(frozen=True, eq=False)
class Principal:
    """Center and modes as sums of S shapes, each less the consensus: ``center`` (S,) and ``modes`` (M, S) are the shares.

    ``deviations`` (M,) are those of the scores along the modes, in the unit of the shapes, the largest first; ``total`` is
    the variance along all modes, also those that were not asked for.
    """

    center: Float[Floats, " S"]
    modes: Float[Floats, "M S"]
    deviations: Float[Floats, " M"]
    total: float


def inner_products(shapes: Shapes, laid: Superimposed) -> Float[Floats, "S S"]:
    """Of aligned shapes, each less the consensus: mean products over the surface, in squared units of the shapes."""
    count = len(shapes)
    found = np.empty((count, count))
    for rows, points in blocks(shapes):
        own = _weighted(points, laid)
        for columns, others in blocks(shapes):
            if columns.start < rows.start:
                continue
            found[rows, columns] = own @ (own if columns == rows else _weighted(others, laid)).T
            found[columns, rows] = found[rows, columns].T
    return found


def _weighted(points: Float[Floats, "B V 3"], laid: Superimposed) -> Float[Floats, "B N"]:
    offset = (laid.align(points) - laid.consensus) * np.sqrt(laid.weights)[:, None]
    return offset.reshape(len(points), -1)


def weighted_sums(shapes: Shapes, laid: Superimposed, shares: Float[Floats, "M S"]) -> Float[Floats, "M V 3"]:
    """Sums of aligned shapes, each less the consensus."""
    total = np.zeros((len(shares), *laid.consensus.shape))
    for rows, points in blocks(shapes):
        total += np.tensordot(shares[:, rows], laid.align(points) - laid.consensus, 1)
    return total


def principal(products: Float[Floats, "S S"], most: int, robust: bool = False, least: float = 0.0) -> Principal:
    """The modes of shapes with these inner products: at most ``most``, those along which they vary the most, none with a
    variance of ``least`` or less.

    ``robust``: the center is the spatial median, the modes are those of the directions in which the shapes lie from there
    (every shape counts the same, however far away), and deviations are median absolute ones, as of a normal
    distribution. Modes along which most shapes do not differ at all are then left out.
    """
    S = len(products)
    center = _spatial_median(products) if robust else np.full(S, 1 / S)
    moved = products - center @ products
    moved = moved - (moved @ center)[:, None]  # products of shapes less their center
    apart = np.sqrt(np.maximum(np.diag(moved), 0))
    near = apart > 1e-9 * apart.max()
    shrink = np.where(near, 1 / np.where(near, apart, 1), 0) if robust else np.ones(S)
    sizes, sides = np.linalg.eigh(shrink[:, None] * moved * shrink)
    kept = np.flatnonzero(sizes > _SMALLEST * sizes[-1])[::-1]
    shares = (sides[:, kept] * shrink[:, None] / np.sqrt(sizes[kept])).T
    scores = moved @ shares.T
    deviations, order = _ordered(scores, robust, least)
    total = float(np.square(deviations).sum())
    order = order[:most]
    shares = shares[order] - shares[order].sum(axis=1)[:, None] * center
    return Principal(center, shares, deviations[order], total)


def _ordered(scores: Float[Floats, "S M"], robust: bool, least: float) -> tuple[Float[Floats, " M"], Int[Ints, " K"]]:
    """Deviations of scores along modes, and which modes there are, the largest first."""
    if robust:
        deviations = _MAD * np.median(np.abs(scores - np.median(scores, axis=0)), axis=0)
    else:
        deviations = np.sqrt(np.sum(np.square(scores), axis=0) / (len(scores) - 1))
    order = np.argsort(-deviations, kind="stable")
    variances = np.square(deviations[order])
    order = order[variances > max(least, _SMALLEST * variances.max(initial=0.0))]
    return deviations, order


def _spatial_median(products: Float[Floats, "S S"]) -> Float[Floats, " S"]:
    """Shares of the point with the least sum of distances to the shapes (Weiszfeld 1937)."""
    S = len(products)
    center = np.full(S, 1 / S)
    scale = np.sqrt(np.maximum(np.diag(products).max(), 1e-300))
    for _ in range(_ROUNDS):
        squared = np.diag(products) - 2 * products @ center + center @ products @ center
        trust = 1 / np.maximum(np.sqrt(np.maximum(squared, 0)), 1e-9 * scale)
        new = trust / trust.sum()
        change = np.abs(new - center).max()
        center = new
        if change < 1e-12:
            break
    return center


def outward(
    modes: Float[Floats, "M V 3"], mean: Float[Floats, "V 3"], weights: Float[Floats, " V"]
) -> Float[Floats, " M"]:
    """Signs (M,) with which the modes make the mean larger; where they leave its size, with the largest entry positive."""
    growth = np.einsum("mvi,v,vi->m", modes, weights, mean, optimize=True)
    flat = modes.reshape(len(modes), -1)
    largest = flat[np.arange(len(flat)), np.abs(flat).argmax(axis=1)]
    size = np.sqrt(weights @ np.square(mean).sum(axis=1))
    return np.asarray(np.where(np.abs(growth) > 1e-6 * size, np.sign(growth), np.sign(largest)))
