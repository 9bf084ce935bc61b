"""The network's own fit: core frame, code, learned corrections, for every hypothesis of the orientation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from meshmatch.fitting.mirror import Mirror
from meshmatch.fitting.scan import Scan, with_normals
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.frames import kabsch
from meshmatch.models.deformer import Deformer

_VARIANT_POINTS = (700, 1400)


@dataclass(frozen=True, eq=False)
class Candidate:
    """One way to lay the template on a scan.

    rotation, center : the core frame, scan = R core + center
    vectors : (K, 3) node vectors in the core frame
    residual : mean normal-compatible distance, both ways, in units of sqrt(area)
    """

    rotation: np.ndarray
    center: np.ndarray
    vectors: np.ndarray
    residual: float


def two_way_residual(
    system: NodeSystem, scan: Scan, vectors: np.ndarray, stride: int = 2, cap: float = 0.1
) -> float:
    """Mean of the capped 6-D nearest-neighbour distances, template to scan and back.

    Every ``stride``-th point of both is asked for its neighbour.
    """
    moved = system.moved(vectors)
    normals = system.normals(moved)
    forward = _apart(scan.tree, moved[::stride], normals[::stride], scan.signed, cap)
    tree = cKDTree(with_normals(moved, normals))
    back = _apart(tree, scan.points[::stride], scan.normals[::stride], scan.signed, cap)
    return float(0.5 * forward.mean() + 0.5 * back.mean())


def one_way_residual(
    system: NodeSystem, scan: Scan, vectors: np.ndarray, stride: int = 2, cap: float = 0.1
) -> float:
    """Mean of the capped 6-D distances from every ``stride``-th scan point to the template."""
    moved = system.moved(vectors)
    tree = cKDTree(with_normals(moved, system.normals(moved)))
    back = _apart(tree, scan.points[::stride], scan.normals[::stride], scan.signed, cap)
    return float(back.mean())


def _apart(tree: cKDTree, points: np.ndarray, normals: np.ndarray, signed: bool, cap: float) -> np.ndarray:
    """(N,) capped 6-D distances to the nearest; to the nearer of both sides where normals have no sure sign."""
    apart = np.full(len(points), cap)
    for side in (1,) if signed else (1, -1):
        # A search without a bound visits every point of a tree that is far away.
        found = tree.query(with_normals(points, side * normals), distance_upper_bound=cap)[0]
        apart = np.minimum(apart, found)
    return apart


@torch.inference_mode()
def predict(
    model: Deformer, scan: Scan, draws: int, rng: np.random.Generator, points: int = 2048
) -> np.ndarray:
    """Mean prediction over several draws of points: node vectors (K, 3) for a scan in its core frame."""
    count = min(points, len(scan.points))
    chosen = np.stack([rng.choice(len(scan.points), count, replace=False) for _ in range(draws)])
    clouds = torch.from_numpy(scan.points[chosen]).float()
    return model(clouds).mean(0).double().numpy()


def lay_on(
    model: Deformer,
    system: NodeSystem,
    core: np.ndarray,
    scan: Scan,
    rotation: np.ndarray,
    center: np.ndarray,
    rng: np.random.Generator,
    rounds: int = 2,
    draws: int = 2,
    stride: int = 2,
) -> Candidate:
    """Predict, move the core frame to where the prediction puts the core, predict again.

    ``draws`` point samples are averaged each time; ``stride`` coarsens the residual.
    """
    for turn in range(rounds):
        local = scan.turned(rotation, center)
        vectors = predict(model, local, draws, rng)
        if turn < rounds - 1:
            step = kabsch(system.verts[core], system.moved(vectors)[core])
            rotation, center = rotation @ step.rotation, rotation @ step.center + center
    return Candidate(rotation, center, vectors, two_way_residual(system, local, vectors, stride))


@torch.inference_mode()
def variants(
    model: Deformer,
    system: NodeSystem,
    scan: Scan,
    coarse: Scan,
    candidate: Candidate,
    rng: np.random.Generator,
    count: int,
    degrees: float,
    mirror: Mirror | None = None,
) -> list[Candidate]:
    """Other readings of a hard pose: predictions from randomly tilted core frames, turned back.

    Where a limb could be one or the other, tilts and thinner samples tip the network either way, and the residual on the
    ``coarse`` scan (core frame, like ``scan``) tells which reading is right. With a ``mirror``, as many again are of the
    mirrored scan.
    """
    tilts = Rotation.from_rotvec(np.radians(degrees) * rng.standard_normal((count, 3))).as_matrix()

    def read(points: np.ndarray) -> list[np.ndarray]:
        back = []
        for number, tilt in enumerate(tilts):
            size = min(_VARIANT_POINTS[number % len(_VARIANT_POINTS)], len(points))
            cloud = points[rng.choice(len(points), size, replace=False)] @ tilt.T
            vectors = model(torch.from_numpy(cloud).float()[None])[0].double().numpy()
            back.append(model.turned(vectors, tilt))
        return back

    back = read(scan.points)
    if mirror is not None:
        back += [mirror.vectors(vectors) for vectors in read(mirror.points(scan.points))]
    return [
        Candidate(candidate.rotation, candidate.center, u, two_way_residual(system, coarse, u, 1))
        for u in back
    ]
