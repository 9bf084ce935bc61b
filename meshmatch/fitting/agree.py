"""Two fits of one template that agree: what slides along one surface is held by the other.

A fit sees its own surface alone, so it is free to slide along it. Shapes of one kind, or one shape in two poses,
stretch the template alike: a few more Gauss-Newton steps on each fit pull its stretch at every strain point to the
mean of all. The mean is taken of logarithms, so that doubling and halving cancel. Pairs of points hold tighter
across the surface than along it, where the stretch has its say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fit_shape import node_system, take_samples
from meshmatch.fitting.nodes import NodeRefineConfig, add_landmarks, between, nearest_rotations, pair_terms
from meshmatch.fitting.scan import Scan
from meshmatch.fitting.system import NodeSystem
from meshmatch.shapes.shape import Shape

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

# Template vertices (N,) and where they belong (N, 3).
Landmarks = tuple[np.ndarray, np.ndarray]

_SMALLEST = 1e-3  # a stretch below it is taken for it: a logarithm must stay finite


@dataclass(frozen=True)
class AgreeConfig:
    """Steps, weight of the common stretch, robust scale (units of sqrt(area)), share of the pull along the surface, how
    many points of the scan are paired with the template, and how much these are shared (see `NodeRefineConfig`)."""

    steps: int = 8
    strain: float = 0.0004
    scale: float = 0.05
    point_share: float = 0.1
    back_points: int = 8000
    shared: float = 0.0

    def suited(self, roughness: float) -> AgreeConfig:
        """The same for a cloud of a ``roughness`` (0..1, see `Shape.roughness`): all points, shared, a stiffer template."""
        return replace(
            self,
            strain=between(self.strain, 20 * self.strain, roughness),
            point_share=between(self.point_share, max(self.point_share, 3.0), roughness),
            back_points=round(self.back_points * (1 + roughness)),
            shared=max(self.shared, roughness),
        )


def agreed_fits(
    model: TrainedModel,
    shapes: Sequence[Shape],
    fits: Sequence[Fit],
    config: FitConfig | None = None,
    landmarks: Sequence[Landmarks] | None = None,
    how: AgreeConfig | None = None,
) -> list[Fit]:
    """Let the fits of several repaired shapes agree on how the template stretches.

    Parameters
    ----------
    landmarks : optional, for each shape template vertices (N,) and positions (N, 3) in the shape's file frame
    how : by default as stiff as the model's card says

    Returns
    -------
    list of Fit
        Node vectors, points and vertex distances are new; residual and verdict stay those that each fit had alone.
        As given if one of them is poor, for it has nothing to say about the others, or if nodes are not refined
        (a pointwise model has none).
    """
    if any(fit.verdict == "poor" for fit in fits):
        return list(fits)
    config = (config or FitConfig()).possible(model)
    if config.refine != "nodes":
        return list(fits)
    system = node_system(model)
    scans = [_samples(shape, fit, config) for shape, fit in zip(shapes, fits, strict=True)]
    local = None
    if landmarks is not None:
        local = [(at, fit.frame.apply(place)) for (at, place), fit in zip(landmarks, fits, strict=True)]
    parts = [fit.partial for fit in fits]
    plain = AgreeConfig()
    how = how or replace(plain, strain=plain.strain * model.card.stiffness)
    refined = agree(
        system,
        scans,
        [fit.vectors for fit in fits],
        [how.suited(shape.roughness) for shape in shapes],
        config.nodes,
        local,
        parts,
    )
    agreed = []
    for shape, fit, vectors in zip(shapes, fits, refined, strict=True):
        points = system.moved(vectors)
        distance = cKDTree(points).query(fit.frame.apply(shape.verts))[0]
        agreed.append(replace(fit, vectors=vectors, points=points, vertex_distance=distance))
    return agreed


def _samples(shape: Shape, fit: Fit, config: FitConfig) -> Scan:
    """The samples that the fit has seen, in its core frame."""
    config = config.suited(shape.roughness)
    frame, scan = take_samples(shape, config.samples, np.random.default_rng(config.seed))
    return Scan(
        fit.frame.apply(frame.undo(scan.points)), scan.normals @ frame.rotation @ fit.frame.rotation.T
    )


def agree(
    system: NodeSystem,
    scans: Sequence[Scan],
    vectors: Sequence[np.ndarray],
    configs: Sequence[AgreeConfig],
    nodes: NodeRefineConfig,
    landmarks: Sequence[Landmarks] | None = None,
    partial: Sequence[bool] | None = None,
) -> list[np.ndarray]:
    """Refine the fits of several shapes together.

    Parameters
    ----------
    scans : samples of each shape in its core frame
    vectors : (K, 3) node vectors of each fit
    configs : one for each fit; they take as many steps as the first
    nodes : how pairs of points are found and weighed
    landmarks : optional, for each shape template vertices (N,) and positions (N, 3) in its core frame
    partial : optional, for each shape whether it shows a part only

    Returns
    -------
    list of (K, 3)
        Better node vectors, one for each shape.
    """
    refined = list(vectors)
    for _ in range(configs[0].steps):
        gradients = [system.deformation_gradient(each) for each in refined]
        common = mean_stretch(gradients)
        for number, (scan, F) in enumerate(zip(scans, gradients, strict=True)):
            one_sided = partial is not None and partial[number]
            config = configs[number]
            pairing = replace(
                nodes,
                point_share=config.point_share,
                back_points=config.back_points,
                shared=config.shared,
            )
            weights, pulls = pair_terms(system, scan, refined[number], config.scale, pairing, one_sided)
            if landmarks is not None:
                add_landmarks(weights, pulls, landmarks[number], nodes.landmark_weight)
            targets = nearest_rotations(F, common) @ common
            refined[number] = system.solve(
                weights, pulls, config.strain / len(F), targets, nodes.damping / system.K, refined[number]
            )
    return refined


def mean_stretch(gradients: Sequence[np.ndarray]) -> np.ndarray:
    """exp of the mean of the logarithms of the right stretches sqrt(F^T F); (G, 3, 3) of several (G, 3, 3)."""
    total = np.zeros_like(gradients[0])
    for F in gradients:
        squares, axes = np.linalg.eigh(F.transpose(0, 2, 1) @ F)
        logs = 0.5 * np.log(np.maximum(squares, _SMALLEST**2))
        total += (axes * logs[:, None, :]) @ axes.transpose(0, 2, 1)
    logs, axes = np.linalg.eigh(total / len(gradients))
    return (axes * np.exp(logs)[:, None, :]) @ axes.transpose(0, 2, 1)
