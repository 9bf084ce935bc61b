"""Where two groups of shapes differ, and whether by more than chance: permutation tests at every vertex.

Source: Hotelling, The generalization of Student's ratio (1931); of the tests: `permutation`.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Literal

import numpy as np

from meshmatch.arrays import Bool, Bools, Brief, Float, Floats, frozen
from meshmatch.collections.permutation import HAIR, tested, whitened
from meshmatch.errors import OptionError

Statistic = Literal["normal", "hotelling"]
STATISTICS: tuple[Statistic, ...] = ("normal", "hotelling")
_CHUNK = 2_000_000  # numbers at a time


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Brief):
    """Where two groups of shapes, A and B, differ.

    Attributes
    ----------
    difference : (V, 3) mean of B less mean of A, in the frame and unit of the atlas
    along_normal : (V,) the same along the normal of the atlas's mean: positive where B lies further out
    statistic : (V,) squared t (normal displacement) or Hotelling's T squared (displacement), in ``kind``
    p : (V,) share of the labellings whose statistic is as large at this vertex
    p_corrected : (V,) share of the labellings whose largest statistic is as large: holds for all vertices at once
    p_fdr : (V,) Benjamini and Hochberg's, by which of the vertices found a share is found by chance
    p_overall : whether the groups differ at all: share of the labellings whose means are as far apart over the surface
    labellings : how many permutations of the group labels, the given one included; ``exact`` if these are all there are
    seed : of the random ones
    counts : shapes in A, and in B
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
    """Compare shapes of two groups by aligned ``offsets`` from anything common; see `Comparison`.

    The ``normals`` are of unit length, the ``weights`` of vertices sum to 1. All labellings are tried where there are at
    most ``permutations`` of them, else so many random ones.

    `OptionError`: a group of fewer than two shapes, too few shapes for Hotelling's statistic, no permutations.
    """
    if kind not in STATISTICS:
        raise OptionError(f"invalid statistic {kind!r}", f"choose one of {', '.join(STATISTICS)}")
    if permutations < 1:
        raise OptionError("a permutation test needs at least one permutation", "1,000 or more are usual")
    S = len(offsets)
    second = int(in_second.sum())
    if min(second, S - second) < 2:
        raise OptionError("a group needs two shapes or more", "add names to its list")
    if kind == "hotelling" and S < 6:
        raise OptionError(f"{S} shapes are too few for Hotelling's statistic", "it needs six in both groups together")
    labels, exact = _labellings(in_second, permutations, seed)
    # Shares of the shapes in "mean of B less mean of A", one row for each labelling.
    shares = np.where(labels, 1 / second, -1 / (S - second))
    moved = offsets - offsets.mean(axis=0)
    values = moved if kind == "hotelling" else np.einsum("svi,vi->sv", moved, normals)[:, :, None]
    unit = shares * np.sqrt(second * (S - second) / S)

    def statistic(along: Floats, total: Floats) -> Floats:
        """Scatter within the groups is the scatter of all, here 1 in every direction, less that along the labelling:
        the shares of the latter say all (Sherman and Morrison 1950)."""
        return np.asarray((S - 2) * along[:, 0] / np.maximum(1 - along[:, 0], 1e-12))

    step = max(1, _CHUNK // S)
    found = tested(whitened(values), (unit[low : low + step, None] for low in range(0, len(unit), step)), statistic)
    products = np.einsum("svi,v,tvi->st", moved, weights, moved, optimize=True)
    apart = np.einsum("ps,st,pt->p", shares, products, shares, optimize=True)
    difference = np.tensordot(shares[0], offsets, 1)
    return Comparison(
        kind, frozen(difference), frozen(np.einsum("vi,vi->v", difference, normals)), frozen(found.statistic),
        frozen(found.p), frozen(found.p_corrected), frozen(found.p_fdr), float((apart >= apart[0] * (1 - HAIR)).mean()),
        len(labels), exact, seed, (S - second, second),
    )  # fmt: skip


def _labellings(in_second: Bool[Bools, " S"], most: int, seed: int) -> tuple[Bool[Bools, "P S"], bool]:
    """Which shapes are in the second group, as given in the first row; and whether these are all there are."""
    S, second = len(in_second), int(in_second.sum())
    if comb(S, second) <= most:
        rows = [np.isin(np.arange(S), chosen) for chosen in combinations(range(S), second)]
        others = [row for row in rows if not np.array_equal(row, in_second)]
        return np.stack([in_second, *others]), True
    random = np.random.default_rng(seed)
    return np.stack([in_second, *(random.permutation(in_second) for _ in range(most))]), False
