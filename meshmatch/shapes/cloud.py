"""Surface area per point and normals of point clouds.

A cloud of more than `LARGEST` points is judged by a random subset of it, so that a million points take seconds.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.shapes.faces import agreeing_flips

LARGEST = 20_000
_CHUNK = 2**18


def local_areas(points: Float[Floats, "V 3"]) -> Float[Floats, " V"]:
    """Surface area that each point represents, in squared units.

    For points scattered with density n over a surface, the smallest disk with a point's k nearest neighbours has an area
    of k / n on average; so pi (r_1^2 + ... + r_k^2) / (1 + ... + k) is an unbiased estimate of 1 / n, the area per
    point. (r_k alone would not do: around the vertices of an even mesh the distances come in steps.) Noise makes r
    larger, by a nearly constant amount once r is well above it: where neighbourhoods are not flat, k grows to half a per
    cent of the points, and only the growth of r^2 from k / 3 to k counts. Where limbs are thinner than the neighbourhood
    the result is a few per cent too low (measured on bodies: -10 to +8 % of area).
    """
    if len(_subset(points)) < 4:
        return np.zeros(len(points))
    subset, distance, _, k, noise = _neighbourhoods(points)
    squared = distance**2
    disks = np.pi * squared[:, 1 : k + 1].sum(axis=1) / (0.5 * k * (k + 1))
    # limits the area of an isolated point
    disks = np.minimum(disks, 25.0 * np.median(disks))
    total = disks.sum()
    if noise > 0 and total > 0:
        growth = np.pi * (squared[:, k] - squared[:, k // 3]).mean() / (k - k // 3)
        disks *= np.clip(growth * len(subset) / total, 0.2, 1.0) ** min(2.0 * noise, 1.0)
    if len(subset) == len(points):
        return np.asarray(disks)
    shares = disks[_nearest(subset, points)]
    return np.asarray(shares * (disks.sum() / shares.sum()) if shares.sum() > 0 else np.zeros(len(points)))


def estimate_normals(points: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
    """Unit normals: the direction in which each neighbourhood is thinnest.

    Signs are made consistent between neighbours (Hoppe et al. 1992, section 3.3), then each connected part is oriented
    away from its own center. For an open or very noisy cloud the signs can be wrong.
    """
    if len(_subset(points)) < 4:
        return np.zeros((len(points), 3))
    subset, _, index, k, _ = _neighbourhoods(points)
    normals = np.linalg.eigh(_scatter(subset, index[:, : k + 1]))[1][:, :, 0]
    near = index[:, 1 : min(k, 8) + 1]
    pairs = np.stack([np.repeat(np.arange(len(subset)), near.shape[1]), near.ravel()], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    cosine = np.einsum("ni,ni->n", normals[pairs[:, 0]], normals[pairs[:, 1]])
    flip, component = agreeing_flips(len(subset), pairs, cosine < 0, 1.0 - np.abs(cosine))
    normals[flip] *= -1.0
    sizes = np.bincount(component)
    center = np.stack([np.bincount(component, weights=subset[:, i]) for i in range(3)], axis=1) / sizes[:, None]
    away = np.einsum("ni,ni->n", subset - center[component], normals)
    normals[np.bincount(component, weights=away)[component] < 0] *= -1.0
    return np.asarray(normals if len(subset) == len(points) else normals[_nearest(subset, points)])


def roughness(points: Float[Floats, "V 3"]) -> float:
    """Noise of a cloud relative to its point spacing, 0..1: about 0 without noise, 1 for noise of 1 % of the diagonal."""
    return 0.0 if len(_subset(points)) < 20 else _neighbourhoods(points)[4]


def outlier_points(points: Float[Floats, "V 3"], far: float = 3.0) -> Bool[Bools, " V"]:
    """Whether each point is ``far`` times farther from its neighbours than they are from theirs, and than is usual."""
    from meshmatch.geometry.trees import cKDTree

    subset = _subset(points)
    if len(subset) < 20:
        return np.zeros(len(points), bool)
    tree = cKDTree(subset)
    own_reach = tree.query(subset, 9)[0][:, -1]  # the point itself and 8 neighbours
    limit = far * np.median(own_reach)
    outlier = np.zeros(len(points), bool)
    for low in range(0, len(points), _CHUNK):  # in chunks: nine distances per point need much memory
        distance, index = tree.query(points[low : low + _CHUNK], 9)
        usual = np.median(own_reach[index[:, 1:]], axis=1)
        outlier[low : low + _CHUNK] = (distance[:, -1] > far * usual) & (distance[:, -1] > limit)
    return outlier


def on_a_line(points: Float[Floats, "V 3"]) -> bool:
    """Whether all points (V, 3) lie on one line, up to a billionth of its length."""
    centered = points - points.mean(axis=0)
    _, extents, _ = np.linalg.svd(centered / max(np.abs(centered).max(), 1e-300), full_matrices=False)
    return bool(extents[1] <= 1e-9 * extents[0])


def _subset(points: Floats) -> Floats:
    """A subset that represents all points: a random one if there are many.

    If most of these are duplicates, each position only once: a search among many coincident points looks at all of
    them.
    """
    part = points
    if len(points) > LARGEST:
        part = points[np.sort(np.random.default_rng(0).choice(len(points), LARGEST, replace=False))]
    places = np.unique(part, axis=0)
    return places if 2 * len(places) < len(part) else part


def _neighbourhoods(points: Floats) -> tuple[Floats, Floats, Ints, int, float]:
    """A subset of the points; distance and index (P, k + 1) of their neighbours, themselves first; k; the noise in 0..1."""
    part = np.ascontiguousarray(_subset(points), float)
    return part, *_neighbours(part.tobytes())


@lru_cache(maxsize=8)
def _neighbours(data: bytes) -> tuple[Floats, Ints, int, float]:
    """Neighbourhoods of points given as bytes, for the cache: areas, normals and roughness of a cloud share them.

    k is small without noise, and grows with it.
    """
    from meshmatch.geometry.trees import cKDTree

    part = np.frombuffer(data).reshape(-1, 3)
    tree, max_k = cKDTree(part), min(max(len(part) // 200, 18), len(part) - 1)
    min_k = min(int(np.clip(len(part) // 100, 12, 18)), max_k)
    sample = part[:: max(len(part) // 3000, 1)]
    values = np.linalg.eigvalsh(_scatter(part, tree.query(sample, min(12, max_k) + 1)[1]))
    thick = np.median(values[:, 0] / np.maximum(values[:, 1], np.maximum(1e-15 * values[:, 2], 1e-300)))
    # thickness measured on bodies: below 0.15 without noise, 0.2 with noise of 0.3 % of the diagonal, 0.5 with 1 %
    noise = float(np.clip((thick - 0.15) / 0.35, 0.0, 1.0))
    k = max(round(min_k ** (1.0 - noise) * max_k**noise), min(3, max_k))
    distance, index = tree.query(part, k + 1)
    distance.flags.writeable = index.flags.writeable = False
    return distance, index, k, noise


def _scatter(points: Floats, index: Ints) -> Floats:
    """(N, 3, 3) scatter matrix of each neighbourhood."""
    local = points[index]
    local = local - local.mean(axis=1, keepdims=True)
    return np.asarray(local.transpose(0, 2, 1) @ local)


def _nearest(part: Floats, points: Floats) -> Ints:
    from meshmatch.geometry.trees import cKDTree

    return np.asarray(cKDTree(part).query(points)[1])
