"""From the network's fit to the surface: the refinement of one fit's node vectors.

The prior keeps the deformation gradient at every gradient point near a rotated copy of the network's own, R_g F_g(network)
with R_g the best local rotation: the surface may bend to meet the samples but not stretch along itself, which Chamfer
distance and normals cannot see.
"""

from __future__ import annotations

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit_config import NodeRefineConfig
from meshmatch.fitting.solve.driver import Problem, minimise
from meshmatch.fitting.solve.priors import RotatedReference
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import Landmarks, terms_of
from meshmatch.geometry.oriented import OrientedPoints


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
    prior = RotatedReference(system.deformation_gradient(vectors))
    problem = Problem(system=system, terms=terms_of(samples, config, landmarks), schedule=config.schedule)
    return minimise(problem, prior, vectors)
