"""A second look through a mirror: where a category's template is symmetric, so is every question about a shape.

The network has no symmetry built in, so it may see a raised left arm and miss a right one. Asked about the mirrored
samples, its answer mirrored back is another interpretation of the same pose.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats
from meshmatch.errors import TemplateError
from meshmatch.fields.shape_functions import ShapeFunctions
from meshmatch.fitting.system import node_system
from meshmatch.models.trained import TrainedModel, once_per_model

# Left and right are exchanged in the template frame, where bodies face along z and stand along y.
_FLIP = np.array([-1.0, 1.0, 1.0])
# Every mirrored vertex of a symmetric template is this near to another one (units of sqrt(area)). Set by hand.
_SYMMETRIC = 0.01
_RIDGE = 1e-6  # of the least squares, against the mean diagonal


@dataclass(frozen=True, eq=False)
class Mirror:
    """The plane x = 0 of a symmetric template.

    Parameters
    ----------
    exchange : (K, K)
        Takes node vectors to those that move the template as these move its mirror image, up to the flip.
    """

    exchange: Float[Floats, "K K"]

    def points(self, points: Float[Floats, "N 3"]) -> Float[Floats, "N 3"]:
        """Points of the mirrored shape, in the core frame."""
        return points * _FLIP

    def vectors(self, vectors: Float[Floats, "K 3"]) -> Float[Floats, "K 3"]:
        """Node vectors of the mirrored deformation: x moves to M f(M x) where f moved it before."""
        return self.exchange @ vectors * _FLIP


@once_per_model
def mirror_of(model: TrainedModel) -> Mirror | None:
    """The mirror of a model's template; None where it is not symmetric, or its field has no nodes."""
    template = model.template
    verts = np.asarray(template.shape.verts)
    distance = cKDTree(np.asarray(template.dense.verts)).query(verts * _FLIP)[0]
    if not model.has_nodes or distance.max() > _SYMMETRIC:
        return None
    try:
        there = model.field(verts * _FLIP)
    except TemplateError:  # the mirrored side has too few nodes
        return None
    here = node_system(model).field
    assert isinstance(here, ShapeFunctions) and isinstance(there, ShapeFunctions)
    phi, across = _dense(here.phi), _dense(there.phi)
    square = phi.T @ phi
    square += _RIDGE * np.trace(square) / len(square) * np.eye(len(square))
    return Mirror(np.asarray(np.linalg.solve(square, phi.T @ across), np.float64))


def _dense(phi: Any) -> Floats:
    return np.asarray(phi if isinstance(phi, np.ndarray) else phi.toarray(), dtype=float)
