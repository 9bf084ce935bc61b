"""Procrustes analysis of variance: how much of the variation of shapes the terms of a linear model explain, and where.

Sums of squares are sequential: each term is given those before it. A term is tested by permuting the residuals of the
model of the terms before it (RRPP: Collyer, Sekora and Adams, Heredity 115 (2015)). Effect sizes are standard scores of F
in its permutation distribution after a power transformation to normality (Box and Cox, JRSS B 26 (1964); Collyer and
Adams, Methods Ecol. Evol. 9 (2018)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, Ints32, set_read_only
from meshmatch.collections.covariates import DesignTerm
from meshmatch.collections.permutation import PlaceTests, orders, permuted, run_tests, whitened
from meshmatch.errors import InputError

_MIN_INDEPENDENT = 1e-7  # as a share of a column's length; a smaller rest counts as explained by earlier columns
_MIN_SCATTER = 1e-20  # as a share of the total scatter; less is rounding
_POWERS = -5.0, 5.0  # range of the Box-Cox power


@dataclass(frozen=True, eq=False)
class Effect:
    """The effect of a term of a linear model on the shapes, given the terms before it.

    Attributes
    ----------
    name : name of the term
    df : degrees of freedom
    ss : sum of squares over the shapes, each the mean over the surface, in squared units of the atlas
    ms : mean square, ``ss / df``
    r2 : share of the total sum of squares
    f : ``ms`` over the mean square of the residuals of the whole model
    z : effect size: standard score of F in its permutation distribution, after a transformation to normality
    p : share of the permutations with an F as large; nan, like ``z``, if the blocks leave nothing to permute
    coefficients : names of the C coefficients
    change : (C, V, 3) displacement of the surface by one unit of a number, or from the first category to another, in the
        frame and unit of the atlas
    along_normal : (C, V) the same along the normal of the atlas's mean; outwards is positive
    places : F at each vertex, and its p-values; None if nothing can be permuted
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
        """Smallest family-wise corrected p-value of any vertex; nan if nothing can be permuted."""
        return float("nan") if self.places is None else float(self.places.p_corrected.min())


@dataclass(frozen=True, eq=False)
class Variances:
    """The table of an analysis of variance: effects, residuals and total.

    ``permutations`` is their number, ``exact`` says whether these are all possible ones, and ``seed`` is the seed of random
    ones.
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
    """Orthonormal directions (S, R) that span the mean, then the terms in order."""

    directions: Float[Floats, "S R"]
    term: Int[Ints, " R"]  # number of the term that adds the direction; -1 for the mean
    within: Bool[Bools, " R"]  # whether the direction varies within a block


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
    """Run a Procrustes analysis of variance.

    Parameters
    ----------
    points : (S, M) coordinates of the shapes in any orthonormal frame
    offsets : (S, V, 3) displacements of their vertices
    terms : terms of the model, in order
    normals : (V, 3) unit normals of the mean
    along : whether to test displacements along the normals at vertices, rather than in all (whitened) directions
    blocks : (S,) number of each shape's block; shapes are exchanged only within blocks
    permutations : number of permutations
    seed : seed of random permutations

    Raises
    ------
    InputError
        A term adds nothing to those before it, no residual is left, or the blocks leave nothing to exchange.
    """
    S = len(points)
    groups = np.zeros(S, np.int64) if blocks is None else np.unique(blocks, return_inverse=True)[1]
    basis = _basis(terms, groups)
    residual_df = S - basis.directions.shape[1]
    if residual_df < 1:
        raise InputError(
            f"{S} shapes leave nothing to test a model of {S - residual_df} coefficients by", "leave out terms"
        )
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
        f = (ss / df) / max(left / residual_df, _MIN_SCATTER * total)
        z = p = float("nan")
        places = None
        if basis.within[own].any():
            overall = _test(points[:, None], basis, k, residual_df, order)
            z, p = _effect_size(overall.largest), float(overall.p[0])
            values = np.einsum("svi,vi->sv", offsets, normals)[:, :, None] if along else offsets
            places = _test(values, basis, k, residual_df, order, whiten=not along)
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
                change=set_read_only(change),
                along_normal=set_read_only(np.einsum("cvi,vi->cv", change, normals)),
                places=places,
            )
        )
    return Variances(tuple(effects), residual_df, left, S - 1, total, len(order), exact, seed)


def _test(
    values: Float[Floats, "S N D"],
    basis: _Basis,
    term: int,
    residual_df: int,
    order: Int[Ints32, "P S"],
    whiten: bool = False,
) -> PlaceTests:
    """Test F of a term at N places, by permuting the residuals of the terms before it."""
    before = basis.directions[:, basis.term < term]
    left = values - np.tensordot(before, np.tensordot(before.T, values, 1), 1)
    scale = np.sqrt(np.square(left).sum(axis=(0, 2)).max()) or 1.0
    left /= scale
    if whiten:
        left = whitened(left)
    # Directions that are constant within blocks were removed above; no permutation brings them back.
    used = (basis.term >= term) | basis.within
    df = int((basis.term == term).sum())
    own = np.flatnonzero(basis.term[used] == term)

    def statistic(along: Floats, total: Floats) -> Floats:
        remaining = np.maximum(total - along.sum(axis=1), _MIN_SCATTER + 1e-12 * total)
        return np.asarray(along[:, own].sum(axis=1) / df * residual_df / remaining)

    return run_tests(left, permuted(basis.directions[:, used], order), statistic)


def _basis(terms: Sequence[DesignTerm], groups: Int[Ints, " S"]) -> _Basis:
    """Orthonormalise the columns of the terms in order; ``groups`` are the blocks."""
    S = len(groups)
    found, number = np.full((S, 1), 1 / np.sqrt(S)), [-1]
    for k, term in enumerate(terms):
        columns = term.columns - term.columns.mean(axis=0)
        columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        for _ in range(2):  # twice, to remove rounding errors
            columns = columns - found @ (found.T @ columns)
        sides, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        new = sides[:, sizes > _MIN_INDEPENDENT]
        if not new.shape[1]:
            raise InputError(f"{term.name} adds nothing to the terms before it", "leave it out")
        found = np.concatenate([found, new], axis=1)
        number += [k] * new.shape[1]
    counts = np.bincount(groups)
    means = np.stack([np.bincount(groups, column) / counts for column in found.T], axis=1)
    return _Basis(found, np.array(number), np.abs(found - means[groups]).max(axis=0) > 1e-9)


def _coefficients(terms: Sequence[DesignTerm], offsets: Float[Floats, "S V 3"]) -> Float[Floats, "C V 3"]:
    """Least-squares coefficients of the last term, in a model of these terms and the mean."""
    columns = np.concatenate([np.ones((len(offsets), 1)), *(term.columns for term in terms)], axis=1)
    size = np.linalg.norm(columns, axis=0)
    solved = np.linalg.pinv(columns / size, rcond=_MIN_INDEPENDENT) / size[:, None]
    return np.asarray(np.tensordot(solved[-terms[-1].columns.shape[1] :], offsets, 1))


def _effect_size(values: Float[Floats, " P"]) -> float:
    """Standard score of the first value among all, after the Box-Cox transformation that makes them most normal."""
    from scipy.optimize import minimize_scalar

    logs = np.log(np.maximum(values / values.mean(), 1e-12)) if values.mean() > 0 else np.zeros(len(values))
    if not np.ptp(logs) > 1e-9:
        return float("nan")

    def transformed(power: float) -> Floats:
        return np.asarray(np.expm1(power * logs) / power if abs(power) > 1e-6 else logs)

    def negative_log_likelihood(power: float) -> float:
        return float(len(logs) / 2 * np.log(transformed(power).var()) - (power - 1) * logs.sum())

    normal = transformed(float(minimize_scalar(negative_log_likelihood, bounds=_POWERS, method="bounded").x))
    return float((normal[0] - normal.mean()) / normal.std())
