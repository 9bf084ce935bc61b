"""Modes of variation of shapes that lie over one another, from their inner products alone.

Source: Cootes et al., Active shape models, CVIU 61 (1995). With outliers: spherical principal components, Locantore et
al., Robust principal component analysis for functional data, Test 8 (1999).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.collections.superimpose import Shapes, Superimposed, blocks
from meshmatch.errors import InputError

_SMALLEST = 1e-12  # of the largest variance: less is rounding
_MAD = 1.482602218505602  # of a normal distribution, its deviation by its median absolute deviation
_ROUNDS = 500


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


def principal(products: Float[Floats, "S S"], most: int, robust: bool = False) -> Principal:
    """The modes of shapes with these inner products: at most ``most``, those along which they vary the most.

    ``robust``: the center is the spatial median, the modes are those of the directions in which the shapes lie from there
    (every shape counts the same, however far away), and deviations are median absolute ones, as of a normal
    distribution. Modes along which most shapes do not differ at all are then left out.

    `InputError` where the shapes are all the same.
    """
    S = len(products)
    center = _spatial_median(products) if robust else np.full(S, 1 / S)
    moved = products - center @ products
    moved = moved - (moved @ center)[:, None]  # products of shapes less their center
    apart = np.sqrt(np.maximum(np.diag(moved), 0))
    near = apart > 1e-9 * apart.max()
    if not apart.max() > 0:
        raise InputError("the shapes do not differ", "an atlas is made of different shapes")
    shrink = np.where(near, 1 / np.where(near, apart, 1), 0) if robust else np.ones(S)
    sizes, sides = np.linalg.eigh(shrink[:, None] * moved * shrink)
    kept = np.flatnonzero(sizes > _SMALLEST * sizes[-1])[::-1]
    shares = (sides[:, kept] * shrink[:, None] / np.sqrt(sizes[kept])).T
    scores = moved @ shares.T
    if robust:
        deviations = _MAD * np.median(np.abs(scores - np.median(scores, axis=0)), axis=0)
    else:
        deviations = np.sqrt(np.sum(np.square(scores), axis=0) / (S - 1))
    order = np.argsort(-deviations, kind="stable")
    order = order[deviations[order] > np.sqrt(_SMALLEST) * deviations.max()]
    if not len(order):
        raise InputError("most of the shapes do not differ", "leave out --robust")
    total = float(np.square(deviations).sum())
    order = order[:most]
    shares = shares[order] - shares[order].sum(axis=1)[:, None] * center
    return Principal(center, shares, deviations[order], total)


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
