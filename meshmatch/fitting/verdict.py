"""Good, fair or poor: how a fit is judged, and what is forgiven a cloud for being sparse and noisy."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.fit import FAIR_RESIDUAL, GOOD_RESIDUAL
from meshmatch.fitting.network_fit import two_way_residual
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# More noise than this (units of sqrt(area), 3.4 cm on a person) is a wrong fit rather than noise.
_MOST_NOISE = 0.025
# One-way residual (units of sqrt(area)) of a part up to which it is called fair: what is not seen adds nothing to it.
PART_RESIDUAL = 0.027


def judge(
    residual: float,
    scan: Scan,
    points: np.ndarray,
    allowance: float = 0.0,
    partial: bool = False,
    unseen: float | None = None,
) -> tuple[str, tuple[str, ...]]:
    """Verdict on a fit and the reasons, in words.

    Parameters
    ----------
    residual : float
        `two_way_residual` of the fit.
    scan : Scan
        Samples of the shape in the core frame.
    points : (V, 3)
        Template vertices as fitted.
    allowance : float
        The part of the residual that the shape itself explains (see `cloud_allowance`); squares add up.
    partial : bool
        The shape shows a part only: template without surface is as expected, and such a fit is fair at best.
    unseen : float, optional
        Of a part, the share (0..1) of the template that it does not show, where that is known better than by distance.
    """
    reasons = []
    excess = unexplained(residual, allowance)
    if excess > (PART_RESIDUAL if partial else GOOD_RESIDUAL):
        reasons.append(f"template and shape stay {100 * excess:.1f} % of sqrt(area) apart on average")
    gap = cKDTree(points).query(scan.points)[0]
    missed = float((gap > 0.06).mean())
    if missed > 0.02:
        reasons.append(f"{100 * missed:.0f} % of the shape is not reached by the template")
    empty = empty_share(scan, points)
    if partial:
        lost = empty if unseen is None else unseen
        reasons.append(f"taken for a part: {100 * lost:.0f} % of the template has no counterpart")
        empty = 0.0
    if empty > 0.02:
        reasons.append(f"{100 * empty:.0f} % of the template lies where the shape has no surface")
    if excess > (PART_RESIDUAL if partial else FAIR_RESIDUAL) or missed > 0.06 or empty > 0.06:
        return "poor", tuple(reasons)
    return ("fair" if reasons else "good"), tuple(reasons)


def unexplained(residual: float, allowance: float) -> float:
    """What is left of a residual where squares add up."""
    return float(np.sqrt(max(residual**2 - allowance**2, 0.0)))


def empty_share(scan: Scan, points: np.ndarray) -> float:
    """Share (0..1) of the fitted template's vertices (V, 3) without any of the shape near."""
    return float((cKDTree(scan.points).query(points)[0] > 0.06).mean())


def cloud_allowance(system: NodeSystem, scan: Scan, V: int, vectors: np.ndarray, seed: int = 0) -> float:
    """The part of the residual that even a right fit has on a cloud of V points as noisy as this one.

    Squares add up: that of a right fit is the root of the squares of this and of a clean mesh's.

    The fitted template itself is sampled, once as densely and noisily as the cloud, with normals estimated as the
    cloud's are, and once as a mesh is. The noise is read off the median distance of the cloud from the template's
    tangent planes, which a lost limb does not move.
    """
    moved = system.moved(vectors)
    normals = system.normals(moved)
    near = cKDTree(moved).query(scan.points)[1]
    apart = np.abs(((scan.points - moved[near]) * normals[near]).sum(1))
    noise = min(1.4826 * float(np.median(apart)), _MOST_NOISE)
    rng = np.random.default_rng(seed)
    surface = Shape(moved, system.faces)
    clean = sample_surface(surface, len(scan.points), rng)
    rough = sample_surface(surface, min(V, len(scan.points)), rng).points
    cloud = Shape(rough + noise * rng.standard_normal(rough.shape), np.empty((0, 3), np.int64))
    expected = two_way_residual(system, Scan(cloud.verts, cloud.vertex_normals, signed=False), vectors)
    clear = two_way_residual(system, Scan(clean.points, clean.normals), vectors)
    return float(np.sqrt(max(expected**2 - clear**2, 0.0)))
