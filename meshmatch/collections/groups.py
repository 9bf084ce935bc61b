"""Permutation tests of differences between two groups of shapes, at every vertex and overall.

Source: Hotelling, The generalization of Student's ratio (1931); for the tests see `permutation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Literal

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, ShortRepr, set_read_only
from meshmatch.collections.permutation import TIE_TOLERANCE, check_permutations, run_tests, whitened
from meshmatch.errors import OptionError
from meshmatch.scalars import check_seed

Statistic = Literal["normal", "hotelling"]
STATISTICS: tuple[Statistic, ...] = ("normal", "hotelling")
_CHUNK = 2_000_000  # array elements processed at a time


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(ShortRepr):
    """Differences between two groups of shapes, A and B.

    Attributes
    ----------
    kind : the statistic: "normal" (squared t of displacements along the normal) or "hotelling" (Hotelling's T squared)
    difference : (V, 3) mean of B less mean of A, in the frame and unit of the atlas
    along_normal : (V,) the difference along the normal of the atlas's mean; positive where B lies further out
    statistic : (V,) the statistic at each vertex
    p : (V,) p-values: share of the labellings whose statistic is as large at the vertex
    p_corrected : (V,) p-values corrected for family-wise error: share whose largest statistic anywhere is as large
    p_fdr : (V,) p-values adjusted for the false discovery rate (Benjamini and Hochberg)
    p_overall : p-value of any difference: share of the labellings whose means are as far apart over the surface
    labellings : number of labellings (permutations of the group labels), the given one included
    exact : whether these are all possible labellings
    seed : seed of random labellings
    counts : number of shapes in A, and in B
    """

    kind: Statistic
    difference: Float[Floats, "V 3"]
    along_normal: Float[Floats, " V"]
    statistic: Float[Floats, " V"]
    p: Float[Floats, " V"]
    p_corrected: Float[Floats, " V"]
    p_fdr: Float[Floats, " V"]
    p_overall: float
    labellings: int
    exact: bool
    seed: int
    counts: tuple[int, int]


def compare_groups(
    offsets: Float[Floats, "S V 3"],
    in_second: Bool[Bools, " S"],
    normals: Float[Floats, "V 3"],
    weights: Float[Floats, " V"],
    *,
    kind: Statistic = "normal",
    permutations: int = 10_000,
    seed: int = 0,
) -> Comparison:
    """Compare two groups of aligned shapes, given as ``offsets`` from any common shape; see `Comparison`.

    The ``normals`` have unit length, and the ``weights`` of the vertices sum to 1. All labellings are used if there are at
    most ``permutations`` of them, else ``permutations`` random ones and the given one.

    `OptionError`: a group of fewer than two shapes, too few shapes for Hotelling's statistic, or no permutations.
    """
    if kind not in STATISTICS:
        raise OptionError(f"invalid statistic {kind!r}", f"choose one of {', '.join(STATISTICS)}")
    check_permutations(permutations)
    check_seed(seed)
    S = len(offsets)
    second = int(in_second.sum())
    if min(second, S - second) < 2:
        raise OptionError("a group needs two shapes or more", "add names to its list")
    if kind == "hotelling" and S < 6:
        raise OptionError(f"{S} shapes are too few for Hotelling's statistic", "it needs six in both groups together")
    labels, exact = _labellings(in_second, permutations, seed)
    # Coefficients of the shapes in "mean of B less mean of A", one row per labelling.
    coefficients = np.where(labels, 1 / second, -1 / (S - second))
    centered = offsets - offsets.mean(axis=0)
    values = centered if kind == "hotelling" else np.einsum("svi,vi->sv", centered, normals)[:, :, None]
    unit = coefficients * np.sqrt(second * (S - second) / S)

    def statistic(along: Floats, total: Floats) -> Floats:
        """Compute T squared from the projection on the labelling alone.

        The scatter within groups is the total scatter, which whitening made the identity, less a rank-1 term along the
        labelling; its inverse follows by Sherman and Morrison (1950).
        """
        return np.asarray((S - 2) * along[:, 0] / np.maximum(1 - along[:, 0], 1e-12))

    step = max(1, _CHUNK // S)
    found = run_tests(whitened(values), (unit[low : low + step, None] for low in range(0, len(unit), step)), statistic)
    products = np.einsum("svi,v,tvi->st", centered, weights, centered, optimize=True)
    gaps = np.einsum("ps,st,pt->p", coefficients, products, coefficients, optimize=True)
    difference = np.tensordot(coefficients[0], offsets, 1)
    return Comparison(
        kind, set_read_only(difference), set_read_only(np.einsum("vi,vi->v", difference, normals)),
        set_read_only(found.statistic), set_read_only(found.p), set_read_only(found.p_corrected), set_read_only(found.p_fdr),
        float((gaps >= gaps[0] * (1 - TIE_TOLERANCE)).mean()), len(labels), exact, seed, (S - second, second),
    )  # fmt: skip


def _labellings(in_second: Bool[Bools, " S"], max_count: int, seed: int) -> tuple[Bool[Bools, "P S"], bool]:
    """Labellings of the shapes, True for the second group, the given one first; and whether these are all there are."""
    S, second = len(in_second), int(in_second.sum())
    if comb(S, second) <= max_count:
        rows = [np.isin(np.arange(S), chosen) for chosen in combinations(range(S), second)]
        others = [row for row in rows if not np.array_equal(row, in_second)]
        return np.stack([in_second, *others]), True
    random = np.random.default_rng(seed)
    return np.stack([in_second, *(random.permutation(in_second) for _ in range(max_count))]), False
