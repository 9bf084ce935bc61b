"""Interpolation by radial basis functions: the multiquadric, and its closed-form gradient.

    u(x)      = sum_i (A^-1 U)_i phi(x, q_i),    A_ij = phi(q_i, q_j)
    phi(a, b) = sqrt(C + eps |a - b|^2),         C = 1, eps = 50

as the NeurIPS 2022 paper compares with. Shape functions are Phi(x) = A^-1 phi(x, .): the field passes through its node
vectors. They have no compact support, so that their matrices are dense; a rigid motion of the nodes is rigid nearly, not
exactly.
"""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import TemplateError
from meshmatch.fields.shape_functions import ShapeFunctions

CONSTANT, STEEPNESS = 1.0, 50.0
_MAX_CONDITION = 1e13
_BLOCK = 4096


def build_rbf(points: Float[Floats, "P 3"], nodes: Float[Floats, "K 3"]) -> ShapeFunctions:
    """Evaluate the shape functions and their gradient on fixed points.

    The paper's numbers are for shapes in the unit sphere, so lengths are measured in the largest distance of a node from
    the middle of all: the functions do not depend on the unit.

    Parameters
    ----------
    points, nodes
        In one unit and frame.

    Returns
    -------
    ShapeFunctions
        Dense float32; computed in float64.

    Raises
    ------
    TemplateError
        Two nodes (nearly) in one place.
    """
    points, nodes = np.asarray(points, np.float64), np.asarray(nodes, np.float64)
    unit = float(np.linalg.norm(nodes - nodes.mean(0), axis=1).max())
    q = nodes / unit
    among = multiquadric(q[:, None] - q)
    if not np.linalg.cond(among) < _MAX_CONDITION:
        raise TemplateError(
            "nodes lie too close together to interpolate between them", "use fewer nodes, or another field than rbf"
        )
    inverse = np.linalg.inv(among)
    phi = np.empty((len(points), len(q)), np.float32)
    gradient = np.empty((len(points), 3, len(q)), np.float32)
    for start in range(0, len(points), _BLOCK):
        here = slice(start, start + _BLOCK)
        offset = points[here, None] / unit - q  # P K 3
        value = multiquadric(offset)
        phi[here] = value @ inverse
        for k in range(3):
            gradient[here, k] = (STEEPNESS * offset[..., k] / value) @ inverse / unit
    return ShapeFunctions(phi, gradient.reshape(3 * len(points), len(q)))


def multiquadric(offset: Float[Floats, "*N 3"]) -> Float[Floats, "*N"]:
    """phi of offsets, in units of the nodes' radius."""
    return np.sqrt(CONSTANT + STEEPNESS * np.square(offset).sum(-1))
