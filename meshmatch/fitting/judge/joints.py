"""Joints of a fit that bend as no joint does: of a body taken back to front, the knees bend forward."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.templates.template import Template

# Labels of the parts above and below a knee. In the axes of a human template (y up, z to the front) a shin points down.
_KNEES = (("left thigh", "left shin"), ("right thigh", "right shin"))
_DOWN, _FRONT = np.array([0.0, -1.0, 0.0]), 2


def knees_forward(system: NodeSystem, vectors: Float[Floats, "K 3"], template: Template) -> float:
    """How far (degrees) the knee bends forward that does so most; 0 where none does, or the template has no knees."""
    names, labels = template.label_names or (), np.asarray(template.labels)[system.gradient_points]
    gradient, most = system.deformation_gradient(vectors), 0.0
    for above, below in _KNEES:
        if above not in names or below not in names:
            continue
        thigh, shin = (gradient[labels == names.index(name)] for name in (above, below))
        if len(thigh) and len(shin):
            direction = nearest_rotation(thigh.mean(0)).T @ nearest_rotation(shin.mean(0)) @ _DOWN
            most = max(most, float(np.degrees(np.arcsin(np.clip(direction[_FRONT], -1, 1)))))
    return most


def nearest_rotation(matrix: Float[Floats, "3 3"]) -> Float[Floats, "3 3"]:
    """The rotation nearest to a matrix (least squares)."""
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right)
