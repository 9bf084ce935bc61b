"""Features that tell right fits from wrong ones, and the probability of a right fit that they give.

What a fit says of itself is not only how near template and shape come: a template can be crushed onto a plane, or its legs
both onto one. Each sign alone errs; together they give the probability that a fit is right, that is to say that its
points are within 8 cm of where they belong on average, on a person. The weights are those of a logistic regression on
right and wrong fits whose truth is known, other ones than it is measured with (docs/results.md).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.fitting.judge.calibration import CALIBRATION, Calibration
from meshmatch.fitting.search.discontinuities import discontinuous_share, neighbours
from meshmatch.fitting.search.predictor import TYPICAL_SPREAD, two_way_residual, weighted_mean
from meshmatch.fitting.search.visibility import area_share, visible_vertices
from meshmatch.fitting.solve.agreement import log_stretch
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import edge_lengths, edges_of, vertex_areas
from meshmatch.shapes.sampling import Samples, sample_surface
from meshmatch.shapes.shape import Shape

# Further from the other surface than this (units of sqrt(area)), a point of shape or template is without counterpart.
_REACH = 0.06
# More noise than this (units of sqrt(area), 3.4 cm on a person) is a wrong fit rather than noise.
_MAX_NOISE = 0.025
_TEAR_SAMPLES = 4096  # enough to see tears
_SHORTEST = 0.2  # what is shortened more is torn
_EVEN = 0.2  # a stretch that varies less says no more
_LEAST_SPREAD = 0.01  # less of it says no more
# Residual (units of sqrt(area)) of even a right fit of a figure built of many solids, which no skin follows: the likeliest
# one, given right fits and upside-down ones of robots, and fits of solids and of furniture in pieces, that are not those of
# docs/results.md. Between so many parts of equal area and so many, set by hand, it grows to that.
_BUILT, _FEW, _MANY = 0.033, 2.0, 8.0
_FLIPPED_IF_UNSIGNED = 0.015  # normals of a cloud have no side: taken for a usual share
# Features that decide alone, and how much each adds to the logit of a wrong fit. Set by hand, between what right and
# wrong fits of `experiments.bench.campaign` have: knees that bend forward by so many degrees (16 at most where right, 31
# to 74 of bodies taken back to front), pieces of a part beside the template (2 and 4 % of its surface), and a border of
# what a part shows that is not cut (1 % where right and fair, 41 to 82 % of limbs taken for more).
_ALONE = 8.0
_FORWARD, _ASTRAY, _UNCUT = 27.0, 0.03, 0.3
_ASIDE = 0.022  # mean distance from the template (units of sqrt(area), 3 cm on a person) of a piece that is beside it
_ISLAND = 0.05  # what is hidden in pieces of less than this share of it, in ears and between fingers, was not cut off
_CUT = 0.12  # a border further from an edge of the shape than this (units of sqrt(area)) is not that of a cut


@dataclass(frozen=True, kw_only=True)
class FitFeatures:
    """What tells right fits from wrong ones.

    Attributes
    ----------
    residual : mean distance of template and shape, normals included, without what a cloud, or a figure of many solids,
        explains (units of sqrt(area))
    uncovered_shape : share (0..1) of the shape that the template does not reach
    uncovered_template : share (0..1) of the template where the shape has no surface; a part has none of it
    discontinuous : share (0..1) of neighbouring samples whose template points are farther apart than local shortening
        explains
    stretch : root mean square of the logarithms of the template's stretches
    stretch_spread : median over the template of how far the logarithm of the stretch there is from its mean over the body
        part, which proportions explain: short legs are no worse a sign than long ones
    flipped : share (0..1) of the shape that faces the other way than the template
    partial : whether the shape was taken for a part
    hidden : share (0..1) of the template that a part does not show
    astray : share (0..1) of a part's surface in separate pieces that lie beside the template
    uncut : share (0..1) of the border between what a part shows of the template and what it hides, by length, where the
        shape has no edge
    forward : degrees by which a knee bends forward, the one that does so most
    spread : how far the network's readings of tilted copies lie from the fit (units of sqrt(area)), see `Predictor.spread`
    inverted : share (0..1) of the template's vertices where the deformation folds, see `Regularity`
    """

    residual: float
    uncovered_shape: float = 0.0
    uncovered_template: float = 0.0
    discontinuous: float = 0.0
    stretch: float = 0.0
    stretch_spread: float = 0.0
    flipped: float = 0.0
    partial: bool = False
    hidden: float = 0.0
    astray: float = 0.0
    uncut: float = 0.0
    forward: float = 0.0
    spread: float = TYPICAL_SPREAD
    inverted: float = 0.0

    def values(self) -> tuple[float, ...]:
        """Numbers that grow about as the doubt does; ``uncovered_template``, ``stretch``, ``flipped`` and ``partial`` added
        nothing to them; ``inverted`` was not tried."""
        return (
            100 * self.residual,
            float(np.sqrt(10 * min(self.uncovered_shape, 0.2))),
            float(np.log(self.discontinuous + 0.003)),
            float(np.log(max(self.stretch_spread, _EVEN))),
            self.hidden,
            float(np.log(max(self.spread, _LEAST_SPREAD))),
        )

    @property
    def alone(self) -> tuple[bool, bool, bool]:
        """Whether each feature speaks that decides alone: ``astray``, ``uncut``, ``forward``."""
        return self.astray > _ASTRAY, self.uncut > _UNCUT, self.forward > _FORWARD

    def p_correct(self, calibration: Calibration = CALIBRATION) -> float:
        """Probability (0..1) that the fit is right."""
        logit = calibration.offset + np.dot(calibration.weights, self.values()) + _ALONE * sum(self.alone)
        return float(1 / (1 + np.exp(logit)))


def compute_features(
    system: NodeSystem,
    vectors: Float[Floats, "K 3"],
    local: OrientedPoints,
    residual: float,
    parts: Int[Ints, " V"],
    partial: bool = False,
    spread_at: Callable[[Bool[Bools, " V"]], float] | None = None,
    connected: Int[Ints, " P"] | None = None,
) -> FitFeatures:
    """The features of a fit; ``local`` are samples of the shape in the core frame, ``parts`` the body parts of the
    template's vertices, ``spread_at`` gives the spread over those that the shape shows (a usual one if there is no network),
    and ``connected`` numbers the connected part of the shape that each sample is on, where there are several.
    """
    shown = visible_vertices(system, local, vectors)
    surface = system.surface(vectors)
    gap, nearest = cKDTree(surface.points).query(local.points)
    some = local.first(_TEAR_SAMPLES)
    gradient = system.deformation_gradient(vectors)
    stretches = log_stretch(gradient)
    flipped = (surface.normals[nearest] * local.normals).sum(1) < 0
    unreached = gap > _REACH
    if partial:  # nothing is known of what lies beyond a template that is cut
        unreached &= ~system.rim[nearest]
    return FitFeatures(
        residual=residual,
        uncovered_shape=float(weighted_mean(unreached, local.weights)),
        uncovered_template=0.0 if partial else uncovered_share(local, surface.points),
        discontinuous=discontinuous_share(
            system, neighbours(some, connected), some, vectors, shortening(system, gradient)
        ),
        stretch=float(np.sqrt(np.square(stretches).sum((1, 2)).mean())),
        stretch_spread=stretch_spread_of(stretches, parts[system.gradient_points]),
        flipped=float(weighted_mean(flipped, local.weights)) if local.signed else _FLIPPED_IF_UNSIGNED,
        partial=partial,
        hidden=1 - area_share(system, shown) if partial else 0.0,
        astray=astray_share(connected, gap, local.weights) if partial and connected is not None else 0.0,
        spread=TYPICAL_SPREAD if spread_at is None or not shown.any() else spread_at(shown),
        inverted=system.regularity(vectors).inverted,
    )


def stretch_spread_of(stretches: Float[Floats, "G 3 3"], parts: Int[Ints, " G"]) -> float:
    """Median norm of the logarithms of stretches about the mean of their part."""
    member = np.eye(int(parts.max()) + 1)[parts]
    means = np.einsum("gp,gij->pij", member, stretches) / np.maximum(member.sum(0), 1)[:, None, None]
    return float(np.median(np.linalg.norm(stretches - means[parts], axis=(1, 2))))


def shortening(system: NodeSystem, gradient: Float[Floats, "G 3 3"]) -> Float[Floats, " V"]:
    """The share of its length that a line on the template's surface keeps around each vertex, in the direction in which it
    keeps least; from `_SHORTEST` to 1. By the deformation ``gradient`` at the gradient points.
    """
    points = system.gradient_points
    normals = system.normals(system.verts)[points]
    along = gradient - (gradient @ normals[:, :, None]) @ normals[:, None]  # of what lies in the surface
    a, b, c = gradient.transpose(2, 0, 1)
    x, y, z = normals.T[:, :, None]
    area = np.linalg.norm(x * np.cross(b, c) + y * np.cross(c, a) + z * np.cross(a, b), axis=1)
    half = 0.5 * np.square(along).sum((1, 2))  # of the sum of both squared stretches, whose product is the area's
    least = np.sqrt(np.maximum(half - np.sqrt(np.maximum(half**2 - area**2, 0.0)), 0.0))
    near = cKDTree(system.verts[points]).query(system.verts)[1]
    return np.asarray(np.clip(least, _SHORTEST, 1.0)[near])


def astray_share(
    connected: Int[Ints, " P"], gap: Float[Floats, " P"], weights: Float[Floats, " P"] | None = None
) -> float:
    """Share (0..1) of samples on connected parts that lie beside the template as a whole, by the ``gap`` to it of each."""
    weight = np.bincount(connected, weights)
    mean = np.bincount(connected, gap if weights is None else weights * gap) / np.maximum(weight, 1e-300)
    return float(weight[mean > _ASIDE].sum() / weight.sum())


def uncut_share(
    system: NodeSystem, local: OrientedPoints, vectors: Float[Floats, "K 3"], edges: Float[Floats, "N 3"]
) -> float:
    """Share (0..1) by length of the border of what samples show of the template that is far from all open ``edges`` of the
    shape (their middles, core frame): there the template goes on, and nothing was cut off. Small hidden pieces have none.
    """
    shown, faces = visible_vertices(system, local, vectors), system.faces
    sides = edges_of(faces).vertices
    inside = sides[~shown[sides].any(1)]
    piece = connected_components(coo_matrix((np.ones(len(inside)), inside.T), (len(shown),) * 2), directed=False)[1]
    area = np.where(shown, 0.0, vertex_areas(system.verts, faces))
    hidden = (np.bincount(piece, area) > _ISLAND * area.sum())[piece] & ~shown
    border = sides[hidden[sides].any(1) & shown[sides].any(1)]
    if not len(border) or not len(edges):
        return 0.0
    length = edge_lengths(system.verts, border)
    middles = system.surface(vectors).points[border].mean(1)
    return float(length[cKDTree(edges).query(middles)[0] > _CUT].sum() / length.sum())


def subtract_in_quadrature(residual: float, allowance: float) -> float:
    """What is left of a residual where squares add up."""
    return float(np.sqrt(max(residual**2 - allowance**2, 0.0)))


def uncovered_share(local: OrientedPoints, points: Float[Floats, "V 3"]) -> float:
    """Share (0..1) of the fitted template's vertices without any of the shape near."""
    return float((cKDTree(local.points).query(points)[0] > _REACH).mean())


def cloud_allowance(
    system: NodeSystem, local: OrientedPoints, V: int, vectors: Float[Floats, "K 3"], seed: int = 0
) -> float:
    """The part of the residual that even a right fit has on a cloud of V points as noisy as this one.

    Squares add up: that of a right fit is the root of the squares of this and of a clean mesh's.

    The fitted template itself is sampled, once as densely and noisily as the cloud, with normals estimated as the
    cloud's are, and once as a mesh is. The noise is read off the median distance of the cloud from the template's
    tangent planes, which a lost limb does not move.
    """
    fitted = system.surface(vectors)
    nearest = cKDTree(fitted.points).query(local.points)[1]
    height = np.abs(((local.points - fitted.points[nearest]) * fitted.normals[nearest]).sum(1))
    noise = min(1.4826 * float(np.median(height)), _MAX_NOISE)  # of a Gaussian with that median
    rng = np.random.default_rng(seed)
    surface = Shape(fitted.points, system.faces)
    clean = sample_surface(surface, len(local.points), rng)
    drawn = sample_surface(surface, min(V, len(local.points)), rng).points
    cloud = Shape(drawn + noise * rng.standard_normal(drawn.shape), np.empty((0, 3), np.int64))
    expected = two_way_residual(system, OrientedPoints(cloud.verts, cloud.vertex_normals, signed=False), vectors)
    clear = two_way_residual(system, clean, vectors)
    return subtract_in_quadrature(expected, clear)


def multipart_allowance(shape: Shape, shown: Shape) -> float:
    """The part of the residual that even a right fit has on a mesh of several connected parts; squares add up.

    Only those count that are ``shown``, the same mesh without the faces that are hidden.
    """
    area = np.bincount(shape.vertex_parts[shown.faces[:, 0]], shown.face_areas)
    number = area.sum() ** 2 / np.square(area).sum()  # of parts, were they alike
    return _BUILT * float(np.sqrt(np.clip((number - _FEW) / (_MANY - _FEW), 0, 1)))


def connected_parts(shape: Shape, samples: OrientedPoints) -> Int[Ints, " P"] | None:
    """Number of the connected part that each sample of a mesh is on; None where there is but one, and for a cloud."""
    return shape.vertex_parts[samples.vertex] if isinstance(samples, Samples) and shape.face_parts.any() else None
