"""Features of a fit, and the probability of a right fit that they give.

The distance between template and shape is not enough: a template can be crushed onto a plane, or put both legs onto one.
Each feature alone errs; together they give the probability that a fit is right, which means that its points are within 8 cm
of their true positions on average, on a person. The weights come from a logistic regression on right and wrong fits with
known truth, which are not those of the measurements in docs/results.md.
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

# A point of shape or template that is farther than this from the other surface (units of sqrt(area)) has no counterpart.
_MAX_GAP = 0.06
# More noise than this (units of sqrt(area), 3.4 cm on a person) indicates a wrong fit rather than noise.
_MAX_NOISE = 0.025
_DISCONTINUITY_SAMPLES = 4096  # samples that suffice to measure discontinuities
_MIN_SHORTENING = 0.2  # stronger shortening counts as a discontinuity
_MIN_STRETCH_SPREAD = 0.2  # smaller values of the feature are raised to this
_MIN_SPREAD = 0.01  # smaller values of the feature are raised to this
# Residual (units of sqrt(area)) of even a right fit of a figure built of many solids, which a skin cannot follow; and the
# numbers of parts of equal area between which it grows from 0 to this. The residual is the maximum-likelihood estimate from
# right and upside-down fits of robots, and fits of solids and of furniture in pieces, none of them from docs/results.md.
# The numbers are set by hand.
_MULTIPART_RESIDUAL, _FEW_PARTS, _MANY_PARTS = 0.033, 2.0, 8.0
_FLIPPED_IF_UNSIGNED = 0.015  # assumed share for clouds, whose normals have no sign
# Features that decide alone, and what each of them adds to the logit of a wrong fit. Limits are set by hand between right
# and wrong fits of `experiments.bench.campaign`: knees that bend forward (degrees; 16 at most if right, 31 to 74 for bodies
# fitted back to front), separate pieces of a part next to the template (2 and 4 % of its surface), and the share of a
# part's border that was not cut (1 % if right and fair, 41 to 82 % for limbs fitted as more than that).
_LOGIT_ALONE = 8.0
_MAX_FORWARD, _MAX_ASTRAY, _MAX_UNCUT = 27.0, 0.03, 0.3
# A piece lies next to the template if its mean distance is larger than this (units of sqrt(area), 3 cm on a person).
_MIN_ASIDE = 0.022
_MIN_HIDDEN_PIECE = 0.05  # hidden pieces with a smaller share of the area, in ears or between fingers, were not cut off
# A border that is farther than this from an edge of the shape (units of sqrt(area)) is not a cut.
_MAX_CUT_DISTANCE = 0.12


@dataclass(frozen=True, kw_only=True)
class FitFeatures:
    """Features that distinguish right fits from wrong ones.

    Attributes
    ----------
    residual : mean distance between template and shape, normals included, without what the noise of a cloud or the parts of
        a figure explain (subtracted in quadrature; units of sqrt(area))
    uncovered_shape : share (0..1) of the shape that the template does not reach
    uncovered_template : share (0..1) of the template where the shape has no surface; 0 for a part
    discontinuous : share (0..1) of neighbouring samples whose template points are farther apart than local shortening
        explains
    stretch : root mean square of the logarithms of the template's stretches
    stretch_spread : median over the template of the difference between the logarithm of the stretch and its mean over the
        body part; differences of proportions cancel, so short legs are as good as long ones
    flipped : share (0..1) of the shape that faces the other way than the template
    partial : whether the shape was fitted as a part
    hidden : share (0..1) of the template that a part does not show
    astray : share (0..1) of a part's surface in separate pieces next to the template
    uncut : share (0..1) by length of the border between shown and hidden template where the shape has no edge
    forward : largest angle in degrees by which a knee bends forward
    spread : distance between the fit and the network's predictions for tilted copies (units of sqrt(area)), see
        `Predictor.spread`
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
        """Inputs of the logistic regression, scaled so that the doubt grows about linearly.

        ``uncovered_template``, ``stretch``, ``flipped`` and ``partial`` did not improve it; ``inverted`` was not tried.
        """
        return (
            100 * self.residual,
            float(np.sqrt(10 * min(self.uncovered_shape, 0.2))),
            float(np.log(self.discontinuous + 0.003)),
            float(np.log(max(self.stretch_spread, _MIN_STRETCH_SPREAD))),
            self.hidden,
            float(np.log(max(self.spread, _MIN_SPREAD))),
        )

    @property
    def alone(self) -> tuple[bool, bool, bool]:
        """Whether ``astray``, ``uncut`` and ``forward``, which decide alone, each speak against the fit."""
        return self.astray > _MAX_ASTRAY, self.uncut > _MAX_UNCUT, self.forward > _MAX_FORWARD

    def p_correct(self, calibration: Calibration = CALIBRATION) -> float:
        """Probability (0..1) that the fit is right."""
        logit = calibration.offset + np.dot(calibration.weights, self.values()) + _LOGIT_ALONE * sum(self.alone)
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
    """Compute the features of a fit.

    ``local`` are samples of the shape in the core frame, and ``parts`` the body parts of the template's vertices.
    ``spread_at`` gives the spread over some vertices; without it, or if no vertex is shown, a typical value is assumed.
    ``connected`` is the number of the connected part of the shape for each sample, if there are several.
    """
    shown = visible_vertices(system, local, vectors)
    surface = system.surface(vectors)
    gap, nearest = cKDTree(surface.points).query(local.points)
    first_samples = local.first(_DISCONTINUITY_SAMPLES)
    gradient = system.deformation_gradient(vectors)
    stretches = log_stretch(gradient)
    flipped = (surface.normals[nearest] * local.normals).sum(1) < 0
    unreached = gap > _MAX_GAP
    if partial:  # the template may be cut: samples at its rim may lie beyond its end
        unreached &= ~system.rim[nearest]
    return FitFeatures(
        residual=residual,
        uncovered_shape=float(weighted_mean(unreached, local.weights)),
        uncovered_template=0.0 if partial else uncovered_share(local, surface.points),
        discontinuous=discontinuous_share(
            system, neighbours(first_samples, connected), first_samples, vectors, shortening(system, gradient)
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
    """Median norm of the differences between the logarithms of stretches and the means of their body parts."""
    member = np.eye(int(parts.max()) + 1)[parts]
    means = np.einsum("gp,gij->pij", member, stretches) / np.maximum(member.sum(0), 1)[:, None, None]
    return float(np.median(np.linalg.norm(stretches - means[parts], axis=(1, 2))))


def shortening(system: NodeSystem, gradient: Float[Floats, "G 3 3"]) -> Float[Floats, " V"]:
    """Smallest factor by which a line on the template's surface is shortened at each vertex, over all directions.

    Computed from the deformation ``gradient`` at the gradient points, and clipped to the range from `_MIN_SHORTENING` to 1.
    """
    points = system.gradient_points
    normals = system.normals(system.verts)[points]
    along = gradient - (gradient @ normals[:, :, None]) @ normals[:, None]  # restricted to the tangent plane
    a, b, c = gradient.transpose(2, 0, 1)
    x, y, z = normals.T[:, :, None]
    area = np.linalg.norm(x * np.cross(b, c) + y * np.cross(c, a) + z * np.cross(a, b), axis=1)
    half = 0.5 * np.square(along).sum((1, 2))  # half the sum of the two squared stretches, whose product is area^2
    least = np.sqrt(np.maximum(half - np.sqrt(np.maximum(half**2 - area**2, 0.0)), 0.0))
    near = cKDTree(system.verts[points]).query(system.verts)[1]
    return np.asarray(np.clip(least, _MIN_SHORTENING, 1.0)[near])


def astray_share(
    connected: Int[Ints, " P"], gap: Float[Floats, " P"], weights: Float[Floats, " P"] | None = None
) -> float:
    """Share (0..1) of samples on connected parts that lie next to the template.

    A part does if the mean distance (``gap``) of its samples to the template is large.
    """
    weight = np.bincount(connected, weights)
    mean = np.bincount(connected, gap if weights is None else weights * gap) / np.maximum(weight, 1e-300)
    return float(weight[mean > _MIN_ASIDE].sum() / weight.sum())


def uncut_share(
    system: NodeSystem, local: OrientedPoints, vectors: Float[Floats, "K 3"], edges: Float[Floats, "N 3"]
) -> float:
    """Share (0..1) by length of the border of the shown template that is far from all open ``edges`` of the shape.

    ``edges`` are midpoints in the core frame. Where the border is far from them, the template continues although nothing
    was cut off. Small hidden pieces are ignored. The share is 0 if the shape has no open edges.
    """
    shown, faces = visible_vertices(system, local, vectors), system.faces
    sides = edges_of(faces).vertices
    inside = sides[~shown[sides].any(1)]
    piece = connected_components(coo_matrix((np.ones(len(inside)), inside.T), (len(shown),) * 2), directed=False)[1]
    area = np.where(shown, 0.0, vertex_areas(system.verts, faces))
    hidden = (np.bincount(piece, area) > _MIN_HIDDEN_PIECE * area.sum())[piece] & ~shown
    border = sides[hidden[sides].any(1) & shown[sides].any(1)]
    if not len(border) or not len(edges):
        return 0.0
    length = edge_lengths(system.verts, border)
    middles = system.surface(vectors).points[border].mean(1)
    return float(length[cKDTree(edges).query(middles)[0] > _MAX_CUT_DISTANCE].sum() / length.sum())


def subtract_in_quadrature(residual: float, allowance: float) -> float:
    """sqrt(residual^2 - allowance^2), or 0."""
    return float(np.sqrt(max(residual**2 - allowance**2, 0.0)))


def uncovered_share(local: OrientedPoints, points: Float[Floats, "V 3"]) -> float:
    """Share (0..1) of the fitted template's vertices without any of the shape nearby."""
    return float((cKDTree(local.points).query(points)[0] > _MAX_GAP).mean())


def cloud_allowance(
    system: NodeSystem, local: OrientedPoints, V: int, vectors: Float[Floats, "K 3"], seed: int = 0
) -> float:
    """The residual that even a right fit has because of a cloud's noise and sparsity, for a cloud of V points.

    It adds to the residual of a clean mesh in quadrature.

    The fitted template is sampled twice: as densely and noisily as the cloud, with normals estimated likewise; and as a
    mesh. The noise is estimated by the median distance of the cloud from the template's tangent planes, which a misplaced
    limb does not change.
    """
    fitted = system.surface(vectors)
    nearest = cKDTree(fitted.points).query(local.points)[1]
    height = np.abs(((local.points - fitted.points[nearest]) * fitted.normals[nearest]).sum(1))
    noise = min(1.4826 * float(np.median(height)), _MAX_NOISE)  # standard deviation of a Gaussian with this median
    rng = np.random.default_rng(seed)
    surface = Shape(fitted.points, system.faces)
    mesh_samples = sample_surface(surface, len(local.points), rng)
    drawn = sample_surface(surface, min(V, len(local.points)), rng).points
    cloud = Shape(drawn + noise * rng.standard_normal(drawn.shape), np.empty((0, 3), np.int64))
    cloud_residual = two_way_residual(system, OrientedPoints(cloud.verts, cloud.vertex_normals, signed=False), vectors)
    mesh_residual = two_way_residual(system, mesh_samples, vectors)
    return subtract_in_quadrature(cloud_residual, mesh_residual)


def multipart_allowance(shape: Shape, shown: Shape) -> float:
    """The residual that even a right fit has on a mesh of several connected parts; it adds in quadrature.

    Only faces that are visible count: ``shown`` is the same mesh without hidden faces.
    """
    area = np.bincount(shape.vertex_parts[shown.faces[:, 0]], shown.face_areas)
    number = area.sum() ** 2 / np.square(area).sum()  # number of parts of equal area with the same sum of squares
    return _MULTIPART_RESIDUAL * float(np.sqrt(np.clip((number - _FEW_PARTS) / (_MANY_PARTS - _FEW_PARTS), 0, 1)))


def connected_parts(shape: Shape, samples: OrientedPoints) -> Int[Ints, " P"] | None:
    """Number of the connected part for each sample of a mesh; None for a cloud, and if there is only one part."""
    return shape.vertex_parts[samples.vertex] if isinstance(samples, Samples) and shape.face_parts.any() else None
