"""Terms of the least squares: what pulls template vertices to their targets.

Every term is quadratic once its pairs and robust weights are frozen for a step (iteratively reweighted least squares).
Pairs of nearest points are weighted by the function of Geman and McClure, as in robust variants of iterative closest
points. A new term is a class with the one method of `Term`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias

import numpy as np
from scipy.sparse import csc_matrix

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.fitting.fit_config import Pairing
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints, feature_tree, with_normals
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import row_sums, vertex_areas
from meshmatch.shapes.rims import RimPoints, rim_edges

_MIN_OUTWARD_COSINE = 0.2  # between the outward directions of two paired points on rims
_MAX_SHARERS = 16  # maximum number of template vertices that share a point

Landmarks = tuple[Int[Ints, " N"], Float[Floats, "N 3"]]
"""Template vertices and their target positions."""
Quadratic = tuple[Float[Floats, "V 6"], Float[Floats, "V 3"]]
"""Upper triangles (V, 6) of H_p and right-hand sides H_p s_p (V, 3) of template vertices p, see `NodeSystem.solve`."""


OneSided: TypeAlias = Literal[False, True, "strictly"]


class Term(Protocol):
    """Something that pulls on template vertices."""

    def quadratic(self, system: NodeSystem, vectors: Float[Floats, "K 3"], scale: float) -> Quadratic:
        """The quadratic form of the term about the current node vectors.

        ``scale`` is that of robust weights (units of sqrt(area)).
        """


@dataclass(frozen=True, eq=False)
class PairTerm:
    """Pairs of template vertices and samples. The weights sum to about one and are proportional to those of the samples.

    If pairs are ``one_sided``, the samples show a part of the shape: template vertices without a sample nearby are left to
    the prior. If they are "strictly" so, only samples search for partners: nothing is pulled to the border of a cut shape,
    and samples beyond the rim of a cut template have no partner.
    """

    samples: OrientedPoints  # core frame
    config: Pairing
    one_sided: OneSided = False

    def quadratic(self, system: NodeSystem, vectors: Float[Floats, "K 3"], scale: float) -> Quadratic:
        surface, shared = system.surface(vectors), self.config.shared
        if shared <= 0:
            return _nearest_pairs(system, self.samples, surface, scale, self.config, self.one_sided)
        far_weights, far_pulls = _shared_pairs(system, self.samples, surface, scale, self.config)
        if shared >= 1:
            return far_weights, far_pulls
        weights, pulls = _nearest_pairs(system, self.samples, surface, scale, self.config, self.one_sided)
        return (1 - shared) * weights + shared * far_weights, (1 - shared) * pulls + shared * far_pulls


@dataclass(frozen=True, eq=False)
class GoalTerm:
    """Pulls each template vertex to a point of its own (V, 3), core frame, with robust weights; for proposals."""

    goals: Float[Floats, "V 3"]

    def quadratic(self, system: NodeSystem, vectors: Float[Floats, "K 3"], scale: float) -> Quadratic:
        area = vertex_areas(system.verts, system.faces)
        weight = area / area.sum() * robust_weight(system.moved(vectors) - self.goals, scale)
        weights = weight[:, None] * np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])
        return weights, weight[:, None] * self.goals


@dataclass(frozen=True, eq=False)
class LandmarkTerm:
    """Pulls template vertices (N,) to positions (N, 3) in the core frame, all with the same weight."""

    landmarks: Landmarks
    weight: float

    def quadratic(self, system: NodeSystem, vectors: Float[Floats, "K 3"], scale: float) -> Quadratic:
        (at, position), V = self.landmarks, len(system.verts)
        weights, pulls = np.zeros((V, 6)), np.zeros((V, 3))
        np.add.at(weights, (at[:, None], np.array([0, 3, 5])), self.weight)
        np.add.at(pulls, at, self.weight * position)
        return weights, pulls


@dataclass(frozen=True, eq=False)
class RimTerm:
    """Holds the rim of an open template on that of an open shape; the rim may slide along itself.

    Pairs of surface points do not do this, as they leave free the plane in which a rim would move.
    """

    rim: RimPoints  # of the shape, core frame
    width: float  # a rim has the weight of a strip of surface with this width
    outward_weight: float  # weight of outward directions against positions in the search for pairs

    def quadratic(self, system: NodeSystem, vectors: Float[Floats, "K 3"], scale: float) -> Quadratic:
        moved, rim, corners = system.moved(vectors), self.rim, system.rim_corners
        length, out, _ = rim_edges(moved, corners)
        vertex, at = np.unique(corners[:, :2].T.ravel(), return_inverse=True)
        lengths = np.bincount(at, np.tile(length / 2, 2))
        outward = _sums(at, np.tile(out * length[:, None], (2, 1)).T, len(vertex))
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-20)

        own_features = with_normals(moved[vertex], outward, self.outward_weight)
        rim_features = with_normals(rim.points, rim.outward, self.outward_weight)
        to_rim, to_template = cKDTree(rim_features).query(own_features)[1], cKDTree(own_features).query(rim_features)[1]
        at = np.concatenate([np.arange(len(vertex)), to_template])
        to = np.concatenate([to_rim, np.arange(len(rim_features))])
        share = np.concatenate([lengths, np.full(len(rim_features), lengths.sum() / len(rim_features))])
        weight = 0.5 * self.width * share * robust_weight(moved[vertex[at]] - rim.points[to], scale)
        weight *= row_sums(outward[at] * rim.outward[to]) > _MIN_OUTWARD_COSINE
        across = np.concatenate([rim.outward[to], np.cross(rim.outward, rim.along)[to]])
        point = np.tile(rim.points[to], (2, 1))
        return _point_to_plane_sums(np.tile(vertex[at], 2), point, across, np.tile(weight, 2), 0.0, len(moved))


def terms_of(
    samples: OrientedPoints, config: Pairing, landmarks: Landmarks | None = None, one_sided: OneSided = False
) -> list[Term]:
    """The terms that pull the template onto samples in the core frame and, if there are any, to landmarks."""
    pairs = PairTerm(samples, config, one_sided)
    return [pairs] if landmarks is None else [pairs, LandmarkTerm(landmarks, config.landmark_weight)]


def _nearest_pairs(
    system: NodeSystem,
    samples: OrientedPoints,
    surface: OrientedPoints,
    scale: float,
    config: Pairing,
    one_sided: OneSided,
) -> Quadratic:
    """Pairs with the nearest point of similar normal, in both directions, with half of the weight each."""
    moved, normals = surface.points, surface.normals
    features = with_normals(moved, normals, config.pair_normals)
    to_samples = samples.weighted_tree(config.pair_normals).query(features)[1]
    partner, partner_normal = samples.points.take(to_samples, 0), samples.normals.take(to_samples, 0)
    area = vertex_areas(moved, system.faces)
    forward = area / area.sum() * robust_weight(moved - partner, scale)
    forward *= row_sums(normals * partner_normal) > config.normal_cosine
    if one_sided == "strictly":
        forward *= 0.0
    elif one_sided:
        forward *= np.linalg.norm(moved - partner, axis=1) < 3 * scale

    thinned = samples.thinned(config.back_points)
    to_template = feature_tree(features).query(with_normals(thinned.points, thinned.normals, config.pair_normals))[1]
    back = robust_weight(moved.take(to_template, 0) - thinned.points, scale) / len(thinned.points)
    back *= row_sums(normals.take(to_template, 0) * thinned.normals) > config.normal_cosine
    if one_sided == "strictly":
        back *= ~system.rim[to_template]
    if samples.weights is not None and thinned.weights is not None:
        forward *= samples.weights[to_samples]
        back *= thinned.weights

    at = np.concatenate([np.arange(len(moved)), to_template])
    point = np.concatenate([partner, thinned.points])
    normal = np.concatenate([partner_normal, thinned.normals])
    weight = 0.5 * np.concatenate([forward, back])
    return _point_to_plane_sums(at, point, normal, weight, config.point_share, len(moved))


def _shared_pairs(
    system: NodeSystem, samples: OrientedPoints, surface: OrientedPoints, scale: float, config: Pairing
) -> Quadratic:
    """Pairs of every sample with all of the template from where noise may have moved it.

    This is the expectation step of a mixture of Gaussians at the template's vertices, as in Coherent Point Drift (Myronenko
    and Song, TPAMI 2010). The template does not search for samples, as among noisy points one is always close by.
    Directions across the surface are the template's own.
    """
    thinned, moved = samples.thinned(config.back_points), surface.points
    V = len(moved)
    distance, at = cKDTree(moved).query(thinned.points, min(_MAX_SHARERS, V))
    distance, at = distance.reshape(len(thinned.points), -1), at.reshape(len(thinned.points), -1)
    further = np.square(distance) - np.square(distance[:, :1])  # so that the nearest vertex always has weight
    share = vertex_areas(moved, system.faces)[at] * np.exp(-0.5 * further / config.spread**2)
    share /= np.maximum(share.sum(1, keepdims=True), 1e-300)
    share *= 1.0 / np.square(1.0 + np.square(distance[:, :1] / scale)) / len(thinned.points)
    if thinned.weights is not None:
        share *= thinned.weights[:, None]
    # As normals are the template's, all pulls on a vertex can be summed first.
    column_starts = np.arange(0, share.size + 1, share.shape[1])
    shares = csc_matrix((share.reshape(-1), at.reshape(-1), column_starts), (V, len(share)))
    total, pull = np.asarray(shares @ np.ones(len(share))), np.asarray(shares @ thinned.points)
    mean = pull / np.maximum(total, 1e-300)[:, None]
    return _point_to_plane_sums(np.arange(V), mean, surface.normals, total, config.point_share, V)


def _point_to_plane_sums(
    at: Int[Ints, " N"],
    point: Float[Floats, "N 3"],
    normal: Float[Floats, "N 3"],
    weight: Float[Floats, " N"],
    share: float,
    V: int,
) -> Quadratic:
    """Sums of w (n n^T + share I) for each template vertex, and of its products with the points."""
    axes, places = np.ascontiguousarray(normal.T), np.ascontiguousarray(point.T)
    x, y, z = axes
    entries = x * x + share, x * y, x * z, y * y + share, y * z, z * z + share
    along = row_sums(normal * point)
    pulls = (axis * along + share * place for axis, place in zip(axes, places, strict=True))
    return _sums(at, (entry * weight for entry in entries), V), _sums(at, (weight * pull for pull in pulls), V)


def _sums(at: Int[Ints, " N"], columns: Iterable[Float[Floats, " N"]], V: int) -> Float[Floats, "V D"]:
    """Sums of D columns at each vertex."""
    return np.stack([np.bincount(at, column, V) for column in columns], 1).astype(np.float64, copy=False)


def robust_weight(offset: Float[Floats, "N 3"], scale: float) -> Float[Floats, " N"]:
    """Geman and McClure's weights for offset vectors."""
    return 1.0 / np.square(1.0 + row_sums(np.square(offset)) / scale**2)
