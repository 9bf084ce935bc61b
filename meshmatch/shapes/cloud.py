"""What a point cloud does not say by itself: how much surface a point stands for, and which way that faces.

A cloud of more than `LARGEST` points is judged by a random part of it, so that a million points cost seconds.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Ints
from meshmatch.shapes.faces import agreeing_flips

LARGEST = 20_000
_CHUNK = 2**18


def local_areas(points: Float[Floats, "V 3"]) -> Float[Floats, " V"]:
    """Area that each point stands for, squared units.

    Among points scattered with density n over a surface, the disc that just holds a point's k nearest others has an
    area of k / n on average; so pi (r_1^2 + ... + r_k^2) / (1 + ... + k) is an unbiased estimate of 1 / n, the area per
    point. (r_k alone would not do: around the vertices of an even mesh the distances come in steps.) Noise makes r
    larger, by a nearly constant amount once r is well above it: where neighbourhoods are not flat, k grows to half a
    per cent of the points, and only the growth of r^2 from k / 3 to k counts. Where limbs are thinner than the
    neighbourhood the result is some per cent low (measured on bodies: -10 to +8 % of area).
    """
    if len(_part(points)) < 4:
        return np.zeros(len(points))
    part, distance, _, k, noise = _neighbourhoods(points)
    squared = distance**2
    discs = np.pi * squared[:, 1 : k + 1].sum(axis=1) / (0.5 * k * (k + 1))
    # a lone point far away stands for no more than its share
    discs = np.minimum(discs, 25.0 * np.median(discs))
    total = discs.sum()
    if noise > 0 and total > 0:
        growth = np.pi * (squared[:, k] - squared[:, k // 3]).mean() / (k - k // 3)
        discs *= np.clip(growth * len(part) / total, 0.2, 1.0) ** min(2.0 * noise, 1.0)
    if len(part) == len(points):
        return np.asarray(discs)
    shares = discs[_nearest(part, points)]
    return np.asarray(shares * (discs.sum() / shares.sum()) if shares.sum() > 0 else np.zeros(len(points)))


def estimate_normals(points: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
    """Unit normals: where the neighbourhood is thinnest.

    Signs are made to agree between neighbours (Hoppe et al. 1992, section 3.3), then each connected part is turned to
    face away from its own center; for an open or very noisy cloud that can be wrong, so treat the sign with care.
    """
    if len(_part(points)) < 4:
        return np.zeros((len(points), 3))
    part, _, index, k, _ = _neighbourhoods(points)
    found = np.linalg.eigh(_spread(part, index[:, : k + 1]))[1][:, :, 0]
    near = index[:, 1 : min(k, 8) + 1]
    pairs = np.stack([np.repeat(np.arange(len(part)), near.shape[1]), near.ravel()], axis=1)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    cosine = np.einsum("ni,ni->n", found[pairs[:, 0]], found[pairs[:, 1]])
    flip, component = agreeing_flips(len(part), pairs, cosine < 0, 1.0 - np.abs(cosine))
    found[flip] *= -1.0
    sizes = np.bincount(component)
    center = np.stack([np.bincount(component, weights=part[:, i]) for i in range(3)], axis=1) / sizes[:, None]
    away = np.einsum("ni,ni->n", part - center[component], found)
    found[np.bincount(component, weights=away)[component] < 0] *= -1.0
    return np.asarray(found if len(part) == len(points) else found[_nearest(part, points)])


def roughness(points: Float[Floats, "V 3"]) -> float:
    """How noisy a cloud is beside its spacing, 0..1: about 0 for a clean one, 1 for noise of 1 % of the diagonal."""
    return 0.0 if len(_part(points)) < 20 else _neighbourhoods(points)[4]


def outlier_points(points: Float[Floats, "V 3"], far: float = 3.0) -> Bool[Bools, " V"]:
    """True for a point that lies ``far`` times further from its neighbours than these from theirs, and than usual."""
    from meshmatch.geometry.trees import cKDTree

    part = _part(points)
    if len(part) < 20:
        return np.zeros(len(points), bool)
    tree = cKDTree(part)
    own_reach = tree.query(part, 9)[0][:, -1]  # 8 neighbours, and itself
    limit = far * np.median(own_reach)
    outlier = np.zeros(len(points), bool)
    for low in range(0, len(points), _CHUNK):  # nine distances of every point ask for much memory
        distance, index = tree.query(points[low : low + _CHUNK], 9)
        usual = np.median(own_reach[index[:, 1:]], axis=1)
        outlier[low : low + _CHUNK] = (distance[:, -1] > far * usual) & (distance[:, -1] > limit)
    return outlier


def on_a_line(points: Float[Floats, "V 3"]) -> bool:
    """Whether no point (V, 3) leaves one line by more than a billionth of its length."""
    away = points - points.mean(axis=0)
    _, length, _ = np.linalg.svd(away / max(np.abs(away).max(), 1e-300), full_matrices=False)
    return bool(length[1] <= 1e-9 * length[0])


def _part(points: Floats) -> Floats:
    """What stands for all points: a random part; where most of these lie on others, each place once, for a search among
    many at one place looks at all of them.
    """
    part = points
    if len(points) > LARGEST:
        part = points[np.sort(np.random.default_rng(0).choice(len(points), LARGEST, replace=False))]
    places = np.unique(part, axis=0)
    return places if 2 * len(places) < len(part) else part


def _neighbourhoods(points: Floats) -> tuple[Floats, Floats, Ints, int, float]:
    """The points to judge by; distance and index (P, k + 1) of their neighbours, themselves first; k; and how thick noise
    makes the cloud beside its spacing, in 0..1."""
    part = np.ascontiguousarray(_part(points), float)
    return part, *_neighbours(part.tobytes())


@lru_cache(maxsize=8)
def _neighbours(data: bytes) -> tuple[Floats, Ints, int, float]:
    """Of points as bytes, so that areas, normals and roughness of a cloud ask once: few, or many where there is noise."""
    from meshmatch.geometry.trees import cKDTree

    part = np.frombuffer(data).reshape(-1, 3)
    tree, most = cKDTree(part), min(max(len(part) // 200, 18), len(part) - 1)
    few = min(int(np.clip(len(part) // 100, 12, 18)), most)
    some = part[:: max(len(part) // 3000, 1)]
    values = np.linalg.eigvalsh(_spread(part, tree.query(some, min(12, most) + 1)[1]))
    thick = np.median(values[:, 0] / np.maximum(values[:, 1], np.maximum(1e-15 * values[:, 2], 1e-300)))
    # measured on bodies: below 0.15 without noise, 0.2 at noise of 0.3 % of the diagonal, 0.5 at 1 %
    blend = float(np.clip((thick - 0.15) / 0.35, 0.0, 1.0))
    k = max(round(few ** (1.0 - blend) * most**blend), min(3, most))
    distance, index = tree.query(part, k + 1)
    distance.flags.writeable = index.flags.writeable = False
    return distance, index, k, blend


def _spread(points: Floats, index: Ints) -> Floats:
    """(N, 3, 3) covariance of each neighbourhood."""
    local = points[index]
    local = local - local.mean(axis=1, keepdims=True)
    return np.asarray(local.transpose(0, 2, 1) @ local)


def _nearest(part: Floats, points: Floats) -> Ints:
    from meshmatch.geometry.trees import cKDTree

    return np.asarray(cKDTree(part).query(points)[1])
