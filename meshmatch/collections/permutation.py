"""Tests by permutation, at every vertex and of them all at once.

Sources: residuals of a reduced model are permuted: Freedman and Lane, J. Business Econ. Stat. 1 (1983), Collyer et al.,
Heredity 115 (2015); the largest statistic of each permutation: Westfall and Young, Resampling-based multiple testing
(1993), Nichols and Holmes, Human Brain Mapping 15 (2002); false discovery: Benjamini and Hochberg, JRSS B 57 (1995).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import permutations, product
from math import factorial

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, Ints32
from meshmatch.errors import OptionError

_CHUNK = 2_000_000  # numbers at a time
_LARGEST = 200_000_000  # numbers of all permutations
HAIR = 1e-9
"""Statistics of one labelling that rounding tells apart."""
_FLAT = 1e-12  # of the largest scatter at a vertex: directions of less have none


@dataclass(frozen=True, eq=False)
class PlaceTests:
    """The ``statistic`` (N,) at each place; the share of the labellings where it is as large there, ``p``, and anywhere,
    ``p_corrected``; ``p_fdr`` by which of the places found a share is found by chance; and the ``largest`` statistic of each
    labelling (P,), the given one first.
    """

    statistic: Float[Floats, " N"]
    p: Float[Floats, " N"]
    p_corrected: Float[Floats, " N"]
    p_fdr: Float[Floats, " N"]
    largest: Float[Floats, " P"]


def orders(groups: Int[Ints, " S"], most: int, seed: int) -> tuple[Int[Ints32, "P S"], bool]:
    """Orders of S shapes that leave each in its group, the given one first; and whether these are all there are.

    All of them where there are at most ``most``, else that many random ones and the given one; `OptionError` for too many.
    """
    count = 1
    for size in np.bincount(groups).tolist():
        count *= factorial(size) if size < 20 and count <= most else most + 1
    place = np.argsort(groups, kind="stable")
    if count <= most and count * len(groups) <= _LARGEST:
        members = np.split(place, np.flatnonzero(np.diff(groups[place])) + 1)
        found = np.empty((count, len(groups)), np.int32)
        for row, each in enumerate(product(*(permutations(some.tolist()) for some in members))):
            found[row, place] = [k for some in each for k in some]
        return found, True
    random = np.random.default_rng(seed)
    if most * len(groups) > _LARGEST:
        hint = f"at most {_LARGEST // len(groups):,}"
        raise OptionError(f"{most:,} permutations of {len(groups)} shapes are too many", hint)
    found = np.empty((most + 1, len(groups)), np.int32)
    found[0] = np.arange(len(groups))
    step = max(1, _CHUNK // len(groups))
    for low in range(1, most + 1, step):
        keys = groups + random.random((min(step, most + 1 - low), len(groups)))
        found[low : low + step, place] = np.argsort(keys, axis=1)
    return found, False


def permuted(basis: Float[Floats, "S R"], order: Int[Ints32, "P S"]) -> Iterator[Float[Floats, "B R S"]]:
    """A basis in each order of the shapes, some at a time; as the orders are all, or random, so are their inverses."""
    step = max(1, _CHUNK // max(1, basis.size))
    for low in range(0, len(order), step):
        yield basis[order[low : low + step]].transpose(0, 2, 1)


def whitened(values: Float[Floats, "S N D"]) -> Float[Floats, "S N D"]:
    """Values of mean 0 with their scatter at each place removed, so that all directions count the same."""
    size, axes = np.linalg.eigh(np.einsum("sni,snj->nij", values, values))
    known = size > _FLAT * np.maximum(size[:, -1:], 1e-300)  # in a direction in which nothing moves, nothing differs
    factors = np.where(known, 1 / np.sqrt(np.where(known, size, 1)), 0)
    return np.asarray((values.transpose(1, 0, 2) @ (axes * factors[:, None])).transpose(1, 0, 2))


def tested(
    values: Float[Floats, "S N D"],
    bases: Iterable[Float[Floats, "B R S"]],
    statistic: Callable[[Float[Floats, "B R N"], Float[Floats, " N"]], Float[Floats, "B N"]],
) -> PlaceTests:
    """Test values of S shapes at N places, such as their displacements, for something that labels of shapes say.

    ``bases`` are R orthonormal directions for each labelling, the given one first, some labellings at a time. The
    ``statistic`` is made of the squares along the directions (B, R, N), and of all squares (N,), summed over D.
    """
    S, N, D = values.shape
    own = np.empty(N)
    as_large = np.zeros(N)
    largest: list[Floats] = []
    total = np.square(values).sum(axis=(0, 2))
    for rows in bases:
        B, R, _ = rows.shape
        most = np.zeros(B)
        step = max(1, _CHUNK // (B * R * D))
        for low in range(0, N, step):
            part = slice(low, low + step)
            along = rows.reshape(B * R, S) @ values[:, part].reshape(S, -1)
            found = statistic(np.square(along.reshape(B, R, -1, D)).sum(axis=3), total[part])
            if not largest:
                own[part] = found[0]
            as_large[part] += (found >= own[part] * (1 - HAIR)).sum(axis=0)
            np.maximum(most, found.max(axis=1), out=most)
        largest.append(most)
    every = np.concatenate(largest)
    above = len(every) - np.searchsorted(np.sort(every), own * (1 - HAIR), side="left")
    p = as_large / len(every)
    from scipy.stats import false_discovery_control

    return PlaceTests(own, p, above / len(every), np.asarray(false_discovery_control(p)), every)
