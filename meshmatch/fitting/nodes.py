"""Gauss-Newton on the node vectors: from the network's fit to the surface.

Each step pairs template and scan both ways by normal-compatible neighbours, weighs the pairs robustly,
and solves one linear system. The prior keeps the deformation gradient at every strain point near a rotated
copy of the network's own, R_g F_g(network) with R_g the best local rotation: the surface may bend to meet
the scan but not stretch along it, which Chamfer and normals cannot see.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.scan import PAIR_WEIGHT, Scan, with_normals
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.triangles import vertex_areas

_SHARERS = 16  # vertices of the template that share a point, at most


@dataclass(frozen=True)
class NodeRefineConfig:
    """Schedule and weights of the node refinement; lengths in units of sqrt(area).

    From the first step to the last the strain weight and the robust scale fall geometrically. ``shared`` (0..1) is how
    much points of the scan pull at all of the template within about ``spread`` instead of at the nearest of it.
    """

    steps: int = 10
    strain_first: float = 0.003
    strain_last: float = 0.0001
    scale_first: float = 0.1
    scale_last: float = 0.03
    point_share: float = 0.3
    normal_cosine: float = 0.2
    back_points: int = 4000
    damping: float = 1e-4
    landmark_weight: float = 0.05
    shared: float = 0.0
    spread: float = 0.016

    def suited(self, roughness: float) -> NodeRefineConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`).

        Noise does not tell across from along, and asks for the mean of many points rather than for the nearest: a wider
        robust scale, a stiffer template, more points, shared pairs. Measured on bodies with noise of 1 % of the diagonal.
        """
        return replace(
            self,
            strain_last=between(self.strain_last, 10 * self.strain_last, roughness),
            scale_last=between(self.scale_last, 2 * self.scale_last, roughness),
            point_share=between(self.point_share, max(self.point_share, 1.0), roughness),
            back_points=round(between(self.back_points, 5 * self.back_points, roughness)),
            shared=max(self.shared, roughness),
        )


def between(low: float, high: float, share: float) -> float:
    """The number that lies at a ``share`` (0..1) of the way from one to another, by ratio."""
    return low if low <= 0 else low * (high / low) ** share


def refine_nodes(
    system: NodeSystem,
    scan: Scan,
    vectors: np.ndarray,
    config: NodeRefineConfig,
    landmarks: tuple[np.ndarray, np.ndarray] | None = None,
    one_sided: bool = False,
) -> np.ndarray:
    """Fit node vectors (K, 3) to a scan in the core frame; returns better node vectors.

    Parameters
    ----------
    landmarks : (template vertices (N,), positions (N, 3)), optional
        Pairs that the fit honours.
    one_sided : bool
        The scan is a part of the shape: template points without a partner are left to the prior.
    """
    start = system.deformation_gradient(vectors)
    for step in range(config.steps):
        t = step / max(config.steps - 1, 1)
        strain = config.strain_first ** (1 - t) * config.strain_last**t
        scale = config.scale_first ** (1 - t) * config.scale_last**t
        weights, pulls = pair_terms(system, scan, vectors, scale, config, one_sided)
        if landmarks is not None:
            add_landmarks(weights, pulls, landmarks, config.landmark_weight)
        targets = nearest_rotations(system.deformation_gradient(vectors), start) @ start
        share = 1.0 / len(targets)
        vectors = system.solve(weights, pulls, strain * share, targets, config.damping / system.K, vectors)
    return vectors


def nearest_rotations(F: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Rotations R_g (G, 3, 3) that bring start_g closest to F_g (orthogonal Procrustes)."""
    U, _, Vh = np.linalg.svd(F @ start.transpose(0, 2, 1))
    flip = np.linalg.det(U @ Vh)
    U[:, :, 2] *= flip[:, None]
    return U @ Vh


def pair_terms(
    system: NodeSystem,
    scan: Scan,
    vectors: np.ndarray,
    scale: float,
    config: NodeRefineConfig,
    one_sided: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Weights (V, 6) and pulls (V, 3) of the current pairs; the weights sum to about one."""
    moved = system.moved(vectors)
    normals = system.normals(moved)
    found = []
    if config.shared < 1:
        found.append(
            (1 - config.shared, _nearest_pairs(system, scan, moved, normals, scale, config, one_sided))
        )
    if config.shared > 0:
        found.append((config.shared, _shared_pairs(system, scan, moved, normals, scale, config)))
    if len(found) == 1:
        return found[0][1]
    (near, nearest), (far, shared) = found
    return near * nearest[0] + far * shared[0], near * nearest[1] + far * shared[1]


def _nearest_pairs(system, scan, moved, normals, scale, config, one_sided) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of what is nearest and faces the same way, in both directions, each with half of the weight."""
    V = len(moved)
    seen = with_normals(moved, normals, PAIR_WEIGHT)
    to_scan = scan.pair_tree.query(seen)[1]
    area = vertex_areas(moved, system.faces)
    forward = area / area.sum() * robust_weight(moved - scan.points[to_scan], scale)
    forward *= (normals * scan.normals[to_scan]).sum(1) > config.normal_cosine
    if one_sided:
        forward *= np.linalg.norm(moved - scan.points[to_scan], axis=1) < 3 * scale

    pick = _picked(scan, config)
    to_template = cKDTree(seen).query(with_normals(scan.points[pick], scan.normals[pick], PAIR_WEIGHT))[1]
    back = robust_weight(moved[to_template] - scan.points[pick], scale) / len(pick)
    back *= (normals[to_template] * scan.normals[pick]).sum(1) > config.normal_cosine

    at = np.concatenate([np.arange(V), to_template])
    point = np.concatenate([scan.points[to_scan], scan.points[pick]])
    normal = np.concatenate([scan.normals[to_scan], scan.normals[pick]])
    weight = 0.5 * np.concatenate([forward, back])
    return _accumulate(at, point, normal, weight, config.point_share, V)


def _shared_pairs(system, scan, moved, normals, scale, config) -> tuple[np.ndarray, np.ndarray]:
    """Every point of the scan pairs with all of the template from where noise may have brought it.

    The expectation step of a mixture of Gaussians at the template's vertices, as in *Coherent Point Drift* (TPAMI 2010).
    A template among noisy points always has one close by, so it does not ask which; and directions across are its own.
    """
    pick = _picked(scan, config)
    apart, at = cKDTree(moved).query(scan.points[pick], min(_SHARERS, len(moved)))
    apart, at = apart.reshape(len(pick), -1), at.reshape(len(pick), -1)
    closer = np.square(apart) - np.square(apart[:, :1])  # the nearest one always has its share
    share = vertex_areas(moved, system.faces)[at] * np.exp(-0.5 * closer / config.spread**2)
    share /= np.maximum(share.sum(1, keepdims=True), 1e-300)
    share *= 1.0 / np.square(1.0 + np.square(apart[:, :1] / scale)) / len(pick)
    at, share = at.reshape(-1), share.reshape(-1)
    V = len(moved)
    # Directions are the template's, so all that pulls at a vertex is summed before they are asked.
    total = np.bincount(at, share, V)
    point = np.repeat(scan.points[pick], apart.shape[1], axis=0)
    pull = np.stack([np.bincount(at, share * point[:, k], V) for k in range(3)], 1)
    mean = pull / np.maximum(total, 1e-300)[:, None]
    return _accumulate(np.arange(V), mean, normals, total, config.point_share, V)


def _picked(scan: Scan, config: NodeRefineConfig) -> np.ndarray:
    return np.arange(0, len(scan.points), max(1, len(scan.points) // config.back_points))


def _accumulate(at, point, normal, weight, share, V) -> tuple[np.ndarray, np.ndarray]:
    """Sum w (n n^T + share I) and its product with the point, per template vertex."""
    x, y, z = normal.T
    entries = (
        np.stack([x * x + share, x * y, x * z, y * y + share, y * z, z * z + share], 1) * weight[:, None]
    )
    along = (normal * point).sum(1, keepdims=True)
    pull = weight[:, None] * (normal * along + share * point)
    weights = np.stack([np.bincount(at, entries[:, k], V) for k in range(6)], 1)
    pulls = np.stack([np.bincount(at, pull[:, k], V) for k in range(3)], 1)
    return weights, pulls


def add_landmarks(
    weights: np.ndarray, pulls: np.ndarray, landmarks: tuple[np.ndarray, np.ndarray], weight: float
) -> None:
    """Add pairs of template vertices (N,) and positions (N, 3) to `pair_terms`, in place."""
    at, position = landmarks
    np.add.at(weights, (at[:, None], np.array([0, 3, 5])), weight)
    np.add.at(pulls, at, weight * position)


def robust_weight(offset: np.ndarray, scale: float) -> np.ndarray:
    """Geman-McClure weight of offsets (N, 3)."""
    return 1.0 / np.square(1.0 + np.square(offset).sum(1) / scale**2)
