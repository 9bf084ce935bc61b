"""Gauss-Newton on the node vectors: from the network's fit to the surface.

Each step pairs template and samples both ways by normal-compatible neighbours, weighs the pairs robustly (iteratively
reweighted least squares with Geman and McClure's function), and solves one linear system. The prior keeps the
deformation gradient at every strain point near a rotated copy of the network's own, R_g F_g(network) with R_g the best
local rotation: the surface may bend to meet the samples but not stretch along itself, which Chamfer distance and normals
cannot see.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.sparse import csc_matrix
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.fit_config import NodeRefineConfig
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals
from meshmatch.geometry.triangles import vertex_areas

_NEWTON_STEPS = 20  # at most: five are the rule, and convergence is quadratic
_SHARERS = 16  # vertices of the template that share a point, at most

# Template vertices and where they belong.
Landmarks = tuple[Int[Ints, " N"], Float[Floats, "N 3"]]
# Upper triangles H_p (V, 6) and right-hand sides H_p s_p (V, 3) of data terms, see `NodeSystem.solve`.
Terms = tuple[Float[Floats, "V 6"], Float[Floats, "V 3"]]


def refine_nodes(
    system: NodeSystem,
    samples: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    config: NodeRefineConfig,
    landmarks: Landmarks | None = None,
) -> Float[Floats, "K 3"]:
    """Fit node vectors to samples in the core frame.

    Deformation gradients of the vectors to start from are the prior. Landmarks are pairs that the fit holds.
    """
    start = system.deformation_gradient(vectors)
    for step in range(config.steps):
        t = step / max(config.steps - 1, 1)
        strain = config.strain_first ** (1 - t) * config.strain_last**t
        scale = config.scale_first ** (1 - t) * config.scale_last**t
        terms = pair_terms(system, samples, vectors, scale, config)
        if landmarks is not None:
            add_landmarks(terms, landmarks, config.landmark_weight)
        targets = nearest_rotations(system.deformation_gradient(vectors), start) @ start
        share = 1.0 / len(targets)
        vectors = system.solve(*terms, strain * share, targets, config.damping / system.K, vectors)
    return vectors


def nearest_rotations(F: Float[Floats, "G 3 3"], start: Float[Floats, "G 3 3"]) -> Float[Floats, "G 3 3"]:
    """Rotations R_g that bring start_g closest to F_g (orthogonal Procrustes).

    The orthogonal factor of F start^T by Newton's iteration with scaling (Higham, 1986), all matrices side by side: a
    sixth of the time of singular values, which remain for those that are nearly singular or turned inside out.
    """
    M = F @ start.transpose(0, 2, 1)
    X = np.ascontiguousarray(M.reshape(-1, 9).T)
    size = np.sqrt((X * X).sum(0))
    C = _cofactors(X)
    hard = (X[:3] * C[:3]).sum(0) <= 1e-4 * size**3
    X[:, hard] = np.eye(3).reshape(9, 1)
    for _ in range(_NEWTON_STEPS):
        C = _cofactors(X)
        det = (X[:3] * C[:3]).sum(0)
        scale = np.sqrt(np.sqrt((C * C).sum(0) / (X * X).sum(0)) / det)
        last, X = X, 0.5 * (scale * X + C / (scale * det))
        if not (np.abs(X - last) > 1e-8).any():
            break
    R = np.ascontiguousarray(X.T).reshape(-1, 3, 3)
    if hard.any():
        U, _, Vh = np.linalg.svd(M[hard])
        U[:, :, 2] *= np.linalg.det(U @ Vh)[:, None]
        R[hard] = U @ Vh
    return R


def _cofactors(X: Float[Floats, "9 G"]) -> Float[Floats, "9 G"]:
    a, b, c, d, e, f, g, h, i = X
    rows = (e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g, b * g - a * h)
    return np.stack([*rows, b * f - c * e, c * d - a * f, a * e - b * d])


def pair_terms(
    system: NodeSystem,
    samples: OrientedPoints,
    vectors: Float[Floats, "K 3"],
    scale: float,
    config: NodeRefineConfig,
    one_sided: bool = False,
) -> Terms:
    """Data terms of the current pairs; their weights sum to about one, and follow those of the samples.

    ``scale`` is that of the robust weight. Where pairs are ``one_sided``, the samples show a part of the shape: template
    vertices without a partner are left to the prior.
    """
    surface = system.surface(vectors)
    if config.shared <= 0:
        return _nearest_pairs(system, samples, surface, scale, config, one_sided)
    shared = _shared_pairs(system, samples, surface, scale, config)
    if config.shared >= 1:
        return shared
    nearest = _nearest_pairs(system, samples, surface, scale, config, one_sided)
    near, far = 1 - config.shared, config.shared
    return near * nearest[0] + far * shared[0], near * nearest[1] + far * shared[1]


def _nearest_pairs(
    system: NodeSystem,
    samples: OrientedPoints,
    surface: OrientedPoints,
    scale: float,
    config: NodeRefineConfig,
    one_sided: bool,
) -> Terms:
    """Pairs of what is nearest and faces the same way, in both directions, each with half of the weight."""
    moved, normals = surface.points, surface.normals
    features = with_normals(moved, normals, config.pair_normals)
    to_samples = samples.pair_tree(config.pair_normals).query(features)[1]
    partner, partner_normal = samples.points.take(to_samples, 0), samples.normals.take(to_samples, 0)
    area = vertex_areas(moved, system.faces)
    forward = area / area.sum() * robust_weight(moved - partner, scale)
    forward *= _row_sums(normals * partner_normal) > config.normal_cosine
    if one_sided:
        forward *= np.linalg.norm(moved - partner, axis=1) < 3 * scale

    some = samples.thinned(config.back_points)
    to_template = feature_tree(features).query(with_normals(some.points, some.normals, config.pair_normals))[1]
    back = robust_weight(moved.take(to_template, 0) - some.points, scale) / len(some.points)
    back *= _row_sums(normals.take(to_template, 0) * some.normals) > config.normal_cosine
    if samples.weights is not None and some.weights is not None:
        forward *= samples.weights[to_samples]
        back *= some.weights

    at = np.concatenate([np.arange(len(moved)), to_template])
    point = np.concatenate([partner, some.points])
    normal = np.concatenate([partner_normal, some.normals])
    weight = 0.5 * np.concatenate([forward, back])
    return _summed(at, point, normal, weight, config.point_share, len(moved))


def _shared_pairs(
    system: NodeSystem, samples: OrientedPoints, surface: OrientedPoints, scale: float, config: NodeRefineConfig
) -> Terms:
    """Every sample pairs with all of the template from where noise may have brought it.

    The expectation step of a mixture of Gaussians at the template's vertices, as in Coherent Point Drift (Myronenko and
    Song, TPAMI 2010). A template among noisy points always has one close by, so it does not ask which; and directions
    across are its own.
    """
    some, moved = samples.thinned(config.back_points), surface.points
    V = len(moved)
    distance, at = cKDTree(moved).query(some.points, min(_SHARERS, V))
    distance, at = distance.reshape(len(some.points), -1), at.reshape(len(some.points), -1)
    further = np.square(distance) - np.square(distance[:, :1])  # the nearest one always has its share
    share = vertex_areas(moved, system.faces)[at] * np.exp(-0.5 * further / config.spread**2)
    share /= np.maximum(share.sum(1, keepdims=True), 1e-300)
    share *= 1.0 / np.square(1.0 + np.square(distance[:, :1] / scale)) / len(some.points)
    if some.weights is not None:
        share *= some.weights[:, None]
    # Directions are the template's, so all that pulls at a vertex is summed before they are asked.
    begins = np.arange(0, share.size + 1, share.shape[1])
    shares = csc_matrix((share.reshape(-1), at.reshape(-1), begins), (V, len(share)))
    total, pull = shares @ np.ones(len(share)), shares @ some.points
    mean = pull / np.maximum(total, 1e-300)[:, None]
    return _summed(np.arange(V), mean, surface.normals, total, config.point_share, V)


def _summed(
    at: Int[Ints, " N"],
    point: Float[Floats, "N 3"],
    normal: Float[Floats, "N 3"],
    weight: Float[Floats, " N"],
    share: float,
    V: int,
) -> Terms:
    """Sum w (n n^T + share I) and its product with the point, per template vertex."""
    axes, places = np.ascontiguousarray(normal.T), np.ascontiguousarray(point.T)
    x, y, z = axes
    entries = x * x + share, x * y, x * z, y * y + share, y * z, z * z + share
    along = _row_sums(normal * point)
    pulls = (axis * along + share * place for axis, place in zip(axes, places, strict=True))
    return _sums(at, (entry * weight for entry in entries), V), _sums(at, (weight * pull for pull in pulls), V)


def _sums(at: Int[Ints, " N"], columns: Iterable[Float[Floats, " N"]], V: int) -> Float[Floats, "V D"]:
    """Sums at each vertex of D columns."""
    return np.stack([np.bincount(at, column, V) for column in columns], 1).astype(np.float64, copy=False)


def add_landmarks(terms: Terms, landmarks: Landmarks, weight: float) -> None:
    """Add pairs of template vertices (N,) and positions (N, 3) to data terms, in place."""
    (weights, pulls), (at, position) = terms, landmarks
    np.add.at(weights, (at[:, None], np.array([0, 3, 5])), weight)
    np.add.at(pulls, at, weight * position)


def robust_weight(offset: Float[Floats, "N 3"], scale: float) -> Float[Floats, " N"]:
    """Geman and McClure's weight of offsets."""
    return 1.0 / np.square(1.0 + _row_sums(np.square(offset)) / scale**2)


def _row_sums(rows: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
    """A quarter of the time of ``rows.sum(1)``, and the same bits."""
    return rows[:, 0] + rows[:, 1] + rows[:, 2]
