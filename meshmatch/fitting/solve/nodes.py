"""Refinement of one fit's node vectors, from the network's prediction to the surface.

The prior keeps the deformation gradient at every gradient point near R_g F_g(network), the network's own gradient under the
best local rotation R_g. The surface may bend to meet the samples but cannot stretch along itself, which neither Chamfer
distance nor normals would notice.
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

    The deformation gradients of the initial vectors are the prior. Landmarks pull on the template.
    """
    prior = RotatedReference(system.deformation_gradient(vectors))
    problem = Problem(system=system, terms=terms_of(samples, config, landmarks), schedule=config.schedule)
    return minimise(problem, prior, vectors)
