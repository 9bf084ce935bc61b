"""Procrustes analysis of variance: how much of the variation of shapes the terms of a linear model explain, and where.

Sums of squares are sequential: each term is given those before it. A term is tested by permuting the residuals of the
model without it and without those behind it (RRPP: Collyer, Sekora and Adams, Heredity 115 (2015)); effect sizes are
deviations of F's distribution after the transformation that makes it most normal (Box and Cox, JRSS B 26 (1964); Collyer
and Adams, Methods Ecol. Evol. 9 (2018)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, Ints32, frozen
from meshmatch.collections.covariates import DesignTerm
from meshmatch.collections.permutation import PlaceTests, orders, permuted, tested, whitened
from meshmatch.errors import InputError

_INDEPENDENT = 1e-7  # of the length of a column: less is what earlier ones say
_NOTHING = 1e-20  # of the total scatter: less is rounding
_POWERS = -5.0, 5.0  # of the transformation


@dataclass(frozen=True, eq=False)
class Effect:
    """What a term of a model explains of the shapes, given the terms before it.

    Attributes
    ----------
    name : of the term
    df : degrees of freedom
    ss : sum of squares over the shapes, each the mean over the surface, in the squared unit of the atlas
    ms : ``ss / df``
    r2 : share of the total sum of squares
    f : ``ms`` by that of the residuals of the whole model
    z : effect size: deviations by which F lies above the mean of its distribution by chance, made normal
    p : share of the permutations with an F as large; nan, as ``z``, where blocks leave nothing to permute
    coefficients : what the C coefficients are called
    change : (C, V, 3) displacement of the surface by one unit, or from the first category to another, in the frame and unit
        of the atlas
    along_normal : (C, V) the same along the normal of the atlas's mean: outwards is positive
    places : F at each vertex, and its p-values; None where nothing can be permuted
    """

    name: str
    df: int
    ss: float
    ms: float
    r2: float
    f: float
    z: float
    p: float
    coefficients: tuple[str, ...]
    change: Float[Floats, "C V 3"]
    along_normal: Float[Floats, "C V"]
    places: PlaceTests | None

    @property
    def p_anywhere(self) -> float:
        """Smallest p-value of a vertex that holds for all vertices at once; nan where nothing can be permuted."""
        return float("nan") if self.places is None else float(self.places.p_corrected.min())


@dataclass(frozen=True, eq=False)
class Variances:
    """The table of an analysis of variance: its effects, what is left, and all; how many permutations there were, whether
    these are all that there are, and the seed of random ones.
    """

    effects: tuple[Effect, ...]
    residual_df: int
    residual_ss: float
    total_df: int
    total_ss: float
    permutations: int
    exact: bool
    seed: int


@dataclass(frozen=True, eq=False)
class _Basis:
    """Orthonormal directions (S, R) that the terms add one after the other, the mean first, and the term of each."""

    directions: Float[Floats, "S R"]
    term: Int[Ints, " R"]  # -1: the mean
    within: Bool[Bools, " R"]  # whether it differs within a block


def analyse(
    points: Float[Floats, "S M"],
    offsets: Float[Floats, "S V 3"],
    terms: Sequence[DesignTerm],
    normals: Float[Floats, "V 3"],
    *,
    along: bool = True,
    blocks: Int[Ints, " S"] | None = None,
    permutations: int = 1000,
    seed: int = 0,
) -> Variances:
    """Analyse shapes by their coordinates in any orthonormal frame (``points``), and their displacements at vertices.

    ``along``: test displacements along the ``normals``, else in all directions, these made equal. ``blocks`` are numbers of
    groups within which shapes are exchanged. `InputError` for terms that add nothing to those before, or models that leave
    no residual.
    """
    S = len(points)
    groups = np.zeros(S, np.int64) if blocks is None else np.unique(blocks, return_inverse=True)[1]
    basis = _basis(terms, groups)
    rest = S - basis.directions.shape[1]
    if rest < 1:
        raise InputError(f"{S} shapes leave nothing to test a model of {S - rest} coefficients by", "leave out terms")
    if not basis.within.any():
        raise InputError("the blocks leave nothing to exchange", "a term of the model has to differ within a block")
    order, exact = orders(groups, permutations, seed)
    squares = np.square(basis.directions.T @ points).sum(axis=1)
    total = float(np.square(points - points.mean(axis=0)).sum())
    left = max(total - float(squares[1:].sum()), 0.0)
    effects = []
    for k, term in enumerate(terms):
        own = basis.term == k
        df = int(own.sum())
        ss = float(squares[own].sum())
        f = (ss / df) / max(left / rest, _NOTHING * total)
        z = p = float("nan")
        places = None
        if basis.within[own].any():
            overall = _test(points[:, None], basis, k, rest, order)
            z, p = _effect_size(overall.largest), float(overall.p[0])
            values = np.einsum("svi,vi->sv", offsets, normals)[:, :, None] if along else offsets
            places = _test(values, basis, k, rest, order, white=not along)
        change = _coefficients(terms[: k + 1], offsets)
        effects.append(
            Effect(
                name=term.name,
                df=df,
                ss=ss,
                ms=ss / df,
                r2=ss / total,
                f=f,
                z=z,
                p=p,
                coefficients=term.coefficients,
                change=frozen(change),
                along_normal=frozen(np.einsum("cvi,vi->cv", change, normals)),
                places=places,
            )
        )
    return Variances(tuple(effects), rest, left, S - 1, total, len(order), exact, seed)


def _test(
    values: Float[Floats, "S N D"], basis: _Basis, term: int, rest: int, order: Int[Ints32, "P S"], white: bool = False
) -> PlaceTests:
    """F of a term for each permutation of the residuals that the terms before it leave."""
    before = basis.directions[:, basis.term < term]
    left = values - np.tensordot(before, np.tensordot(before.T, values, 1), 1)
    scale = np.sqrt(np.square(left).sum(axis=(0, 2)).max()) or 1.0
    left /= scale
    if white:
        left = whitened(left)
    # What is the same in a block, and was taken away, stays away in every order.
    used = (basis.term >= term) | basis.within
    df = int((basis.term == term).sum())
    own = np.flatnonzero(basis.term[used] == term)

    def statistic(along: Floats, total: Floats) -> Floats:
        remaining = np.maximum(total - along.sum(axis=1), _NOTHING + 1e-12 * total)
        return np.asarray(along[:, own].sum(axis=1) / df * rest / remaining)

    return tested(left, permuted(basis.directions[:, used], order), statistic)


def _basis(terms: Sequence[DesignTerm], groups: Int[Ints, " S"]) -> _Basis:
    S = len(groups)
    found, number = np.full((S, 1), 1 / np.sqrt(S)), [-1]
    for k, term in enumerate(terms):
        columns = term.columns - term.columns.mean(axis=0)
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        for _ in range(2):  # once more for what rounding left
            columns = columns - found @ (found.T @ columns)
        sides, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        new = sides[:, sizes > _INDEPENDENT]
        if not new.shape[1]:
            raise InputError(f"{term.name} says nothing that the terms before it do not", "leave it out")
        found = np.concatenate([found, new], axis=1)
        number += [k] * new.shape[1]
    counts = np.bincount(groups)
    means = np.stack([np.bincount(groups, column) / counts for column in found.T], axis=1)
    return _Basis(found, np.array(number), np.abs(found - means[groups]).max(axis=0) > 1e-9)


def _coefficients(terms: Sequence[DesignTerm], offsets: Float[Floats, "S V 3"]) -> Float[Floats, "C V 3"]:
    """Of the last term, in a model of these and the mean, by least squares."""
    columns = np.concatenate([np.ones((len(offsets), 1)), *(term.columns for term in terms)], axis=1)
    size = np.linalg.norm(columns, axis=0)
    solved = np.linalg.pinv(columns / size, rcond=_INDEPENDENT) / size[:, None]
    return np.asarray(np.tensordot(solved[-terms[-1].columns.shape[1] :], offsets, 1))


def _effect_size(values: Float[Floats, " P"]) -> float:
    """Deviations of the first value from the mean of all, after the power that makes them most normal."""
    from scipy.optimize import minimize_scalar

    logs = np.log(np.maximum(values / values.mean(), 1e-12)) if values.mean() > 0 else np.zeros(len(values))
    if not np.ptp(logs) > 1e-9:
        return float("nan")

    def powered(power: float) -> Floats:
        return np.asarray(np.expm1(power * logs) / power if abs(power) > 1e-6 else logs)

    def unlikely(power: float) -> float:
        return float(len(logs) / 2 * np.log(powered(power).var()) - (power - 1) * logs.sum())

    normal = powered(float(minimize_scalar(unlikely, bounds=_POWERS, method="bounded").x))
    return float((normal[0] - normal.mean()) / normal.std())
