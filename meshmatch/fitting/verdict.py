"""Good, fair or poor: how a fit is judged, and what is forgiven a cloud for being sparse and noisy."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.fit import Reason, Verdict
from meshmatch.fitting.network_fit import two_way_residual, weighted_mean
from meshmatch.fitting.system import NodeSystem
from meshmatch.fitting.task import Registration
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# Mean two-way residuals (units of sqrt(area)) up to which a fit is called good, and fair; that of a part is one way, for
# what is not visible adds nothing to it. Set by hand.
GOOD_RESIDUAL, FAIR_RESIDUAL, PART_RESIDUAL = 0.0285, 0.031, 0.027
# Plates, folds and hard edges turn normals away where places are right. A fit of a mesh is fair up to the first of these
# residuals where this share of the shape is so near to the template, and of the template's vertices so near to the shape
# (units of sqrt(area)). Set by hand, by right and wrong fits of generated characters and of the benchmark's bodies.
SNUG_RESIDUAL = 0.043
_SNUG_SHARE, _SNUG_SHAPE, _SNUG_TEMPLATE = 0.97, 0.035, 0.029
# Further from the other surface than this (units of sqrt(area)), a point of shape or template is without counterpart.
_REACH = 0.06
# A template vertex is visible if a sample is this near, and if the nearest sample belongs this near to the vertex on the
# resting template (units of sqrt(area)). Set by hand.
_NEAR, _HOME = 0.06, 0.06
# Shares without counterpart up to which a fit is good, and fair. Set by hand.
_GOOD_SHARE, _FAIR_SHARE = 0.02, 0.06
# More noise than this (units of sqrt(area), 3.4 cm on a person) is a wrong fit rather than noise.
_MAX_NOISE = 0.025


def judge_registration(found: Registration, partial: bool) -> tuple[Verdict, tuple[Reason, ...]]:
    """Verdict on a registration and the reasons; see `judge`."""
    task, vectors = found.task, found.candidate.vectors
    allowance = 0.0
    if task.shape.is_cloud:
        allowance = cloud_allowance(task.system, found.local, task.shape.V, vectors, task.config.seed)
    hidden = None
    if partial:
        hidden = 1 - area_share(task.system, visible_vertices(task.system, found.local, vectors))
    return judge(found.candidate.residual, found.local, found.surface.points, allowance, partial, hidden)


def judge(
    residual: float,
    local: OrientedPoints,
    points: Float[Floats, "V 3"],
    allowance: float = 0.0,
    partial: bool = False,
    hidden: float | None = None,
) -> tuple[Verdict, tuple[Reason, ...]]:
    """Verdict on a fit and the reasons.

    Parameters
    ----------
    residual : of the fit, `two_way_residual`, or `one_way_residual` of a part
    local : samples of the shape in the core frame
    points : (V, 3) template vertices as fitted, core frame
    allowance : the part of the residual that the shape itself explains (see `cloud_allowance`); squares add up
    partial : the shape shows a part only: template without surface is as expected, and such a fit is fair at best
    hidden : of a part, the share (0..1) of the template that it does not show, where known better than by distance
    """
    good, fair = (PART_RESIDUAL, PART_RESIDUAL) if partial else (GOOD_RESIDUAL, FAIR_RESIDUAL)
    reasons = []
    excess = unexplained(residual, allowance)
    if excess > good:
        words = f"template and shape stay {100 * excess:.1f} % of sqrt(area) apart on average"
        reasons.append(Reason("residual", words))
    gap = cKDTree(points).query(local.points)[0]
    if not partial and local.signed and fair < excess <= SNUG_RESIDUAL:
        other = cKDTree(local.points).query(points)[0]
        near = float(weighted_mean(gap <= _SNUG_SHAPE, local.weights)), float((other <= _SNUG_TEMPLATE).mean())
        fair = excess if min(near) >= _SNUG_SHARE else fair
    missed = float(weighted_mean(gap > _REACH, local.weights))
    if missed > _GOOD_SHARE:
        reasons.append(Reason("unreached", f"{100 * missed:.0f} % of the shape is not reached by the template"))
    empty = empty_share(local, points)
    if partial:
        lost = empty if hidden is None else hidden
        words = f"taken for a part: {100 * lost:.0f} % of the template has no counterpart"
        reasons.append(Reason("part", words))
        empty = 0.0
    if empty > _GOOD_SHARE:
        words = f"{100 * empty:.0f} % of the template lies where the shape has no surface"
        reasons.append(Reason("empty", words))
    if excess > fair or missed > _FAIR_SHARE or empty > _FAIR_SHARE:
        return "poor", tuple(reasons)
    return ("fair" if reasons else "good"), tuple(reasons)


def unexplained(residual: float, allowance: float) -> float:
    """What is left of a residual where squares add up."""
    return float(np.sqrt(max(residual**2 - allowance**2, 0.0)))


def empty_share(local: OrientedPoints, points: Float[Floats, "V 3"]) -> float:
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
    return unexplained(expected, clear)


def visible_vertices(system: NodeSystem, local: OrientedPoints, vectors: Float[Floats, "K 3"]) -> Bool[Bools, " V"]:
    """Whether samples (core frame) show each vertex of the template as fitted.

    Vertices beyond a cut have the edge of the samples near by, but the edge belongs elsewhere on the template.
    """
    surface = system.surface(vectors)
    local = local.facing(surface)
    distance, nearest = local.tree.query(surface.features)
    home = surface.tree.query(local.features)[1]
    away = np.linalg.norm(system.verts[home[nearest]] - system.verts, axis=1)
    return np.asarray((distance < _NEAR) & (away < _HOME))


def area_share(system: NodeSystem, vertices: Bool[Bools, " V"]) -> float:
    """Share (0..1) of the resting template's area around some vertices."""
    area = Shape(system.verts, system.faces).vertex_areas
    return float(area[vertices].sum() / area.sum())
