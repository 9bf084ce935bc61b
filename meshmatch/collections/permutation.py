"""Permutation tests at every vertex, with corrections for multiple comparisons.

Sources: permutation of residuals of a reduced model: Freedman and Lane, J. Business Econ. Stat. 1 (1983), Collyer et al.,
Heredity 115 (2015); family-wise errors by the largest statistic of each permutation: Westfall and Young,
Resampling-based multiple testing (1993), Nichols and Holmes, Human Brain Mapping 15 (2002); false discovery rate:
Benjamini and Hochberg, JRSS B 57 (1995).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import permutations, product
from math import factorial

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, Ints32
from meshmatch.errors import OptionError
from meshmatch.scalars import is_integer

_CHUNK = 2_000_000  # array elements processed at a time
_MAX_ELEMENTS = 200_000_000  # permutations times shapes
TIE_TOLERANCE = 1e-9
"""Relative difference of statistics up to which they count as equal: it may be rounding."""
_MIN_SCATTER = 1e-12  # as a share of the largest scatter at a vertex; directions with less count as flat


@dataclass(frozen=True, eq=False)
class PlaceTests:
    """Results of a permutation test at N places, with P labellings (permutations, the given one first).

    Attributes
    ----------
    statistic : (N,) the statistic of the given labelling
    p : (N,) p-values: share of the labellings whose statistic is as large at the place
    p_corrected : (N,) p-values corrected for family-wise error: share whose largest statistic anywhere is as large
    p_fdr : (N,) p-values adjusted for the false discovery rate (Benjamini and Hochberg)
    largest : (P,) the largest statistic of each labelling
    """

    statistic: Float[Floats, " N"]
    p: Float[Floats, " N"]
    p_corrected: Float[Floats, " N"]
    p_fdr: Float[Floats, " N"]
    largest: Float[Floats, " P"]


def check_permutations(count: object) -> None:
    """Raise `OptionError` unless the number of permutations is an integer of 1 or more."""
    if not is_integer(count):
        raise OptionError(
            f"the number of permutations must be a whole number, not {count!r}", "1,000 or more are usual"
        )
    if count < 1:
        raise OptionError("a permutation test needs at least one permutation", "1,000 or more are usual")


def orders(groups: Int[Ints, " S"], max_count: int, seed: int) -> tuple[Int[Ints32, "P S"], bool]:
    """Permutations of S shapes within groups, the identity first; and whether these are all there are.

    All permutations if there are at most ``max_count``, else ``max_count`` random ones and the identity. `OptionError` if
    these need too much memory.
    """
    count = 1
    for size in np.bincount(groups).tolist():
        count *= factorial(size) if size < 20 and count <= max_count else max_count + 1
    place = np.argsort(groups, kind="stable")
    if count <= max_count and count * len(groups) <= _MAX_ELEMENTS:
        members = np.split(place, np.flatnonzero(np.diff(groups[place])) + 1)
        found = np.empty((count, len(groups)), np.int32)
        for row, each in enumerate(product(*(permutations(some.tolist()) for some in members))):
            found[row, place] = [k for some in each for k in some]
        return found, True
    random = np.random.default_rng(seed)
    if max_count * len(groups) > _MAX_ELEMENTS:
        hint = f"at most {_MAX_ELEMENTS // len(groups):,}"
        raise OptionError(f"{max_count:,} permutations of {len(groups)} shapes are too many", hint)
    found = np.empty((max_count + 1, len(groups)), np.int32)
    found[0] = np.arange(len(groups))
    step = max(1, _CHUNK // len(groups))
    for low in range(1, max_count + 1, step):
        keys = groups + random.random((min(step, max_count + 1 - low), len(groups)))
        found[low : low + step, place] = np.argsort(keys, axis=1)
    return found, False


def permuted(basis: Float[Floats, "S R"], order: Int[Ints32, "P S"]) -> Iterator[Float[Floats, "B R S"]]:
    """Yield a basis with its rows in each of the orders, in blocks.

    Indexing applies the inverse permutations, which are equally all of them or random.
    """
    step = max(1, _CHUNK // max(1, basis.size))
    for low in range(0, len(order), step):
        yield basis[order[low : low + step]].transpose(0, 2, 1)


def whitened(values: Float[Floats, "S N D"]) -> Float[Floats, "S N D"]:
    """Whiten values of mean 0 at each place, so that their scatter is the same in all directions (1, or 0 if flat)."""
    size, axes = np.linalg.eigh(np.einsum("sni,snj->nij", values, values))
    known = size > _MIN_SCATTER * np.maximum(size[:, -1:], 1e-300)  # a flat direction shows no differences
    factors = np.where(known, 1 / np.sqrt(np.where(known, size, 1)), 0)
    return np.asarray((values.transpose(1, 0, 2) @ (axes * factors[:, None])).transpose(1, 0, 2))


def run_tests(
    values: Float[Floats, "S N D"],
    bases: Iterable[Float[Floats, "B R S"]],
    statistic: Callable[[Float[Floats, "B R N"], Float[Floats, " N"]], Float[Floats, "B N"]],
) -> PlaceTests:
    """Test the values of S shapes at N places, such as displacements, against labels of the shapes.

    ``bases`` yields R orthonormal directions for each labelling, in blocks of B, the given labelling first. ``statistic``
    computes the statistic (B, N) from squared projections on the directions (B, R, N) and total squares (N,), both summed
    over D.
    """
    S, N, D = values.shape
    own = np.empty(N)
    n_as_large = np.zeros(N)
    largest: list[Floats] = []
    total = np.square(values).sum(axis=(0, 2))
    for rows in bases:
        B, R, _ = rows.shape
        block_largest = np.zeros(B)
        step = max(1, _CHUNK // (B * R * D))
        for low in range(0, N, step):
            part = slice(low, low + step)
            along = rows.reshape(B * R, S) @ values[:, part].reshape(S, -1)
            found = statistic(np.square(along.reshape(B, R, -1, D)).sum(axis=3), total[part])
            if not largest:
                own[part] = found[0]
            n_as_large[part] += (found >= own[part] * (1 - TIE_TOLERANCE)).sum(axis=0)
            np.maximum(block_largest, found.max(axis=1), out=block_largest)
        largest.append(block_largest)
    all_largest = np.concatenate(largest)
    above = len(all_largest) - np.searchsorted(np.sort(all_largest), own * (1 - TIE_TOLERANCE), side="left")
    p = n_as_large / len(all_largest)
    from scipy.stats import false_discovery_control

    return PlaceTests(own, p, above / len(all_largest), np.asarray(false_discovery_control(p)), all_largest)
