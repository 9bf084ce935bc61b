"""Joints of a fit that bend the wrong way: if a body is fitted back to front, its knees bend forward."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats
from meshmatch.fitting.solve.priors import signed_svd
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.templates.template import Template

# Labels of the parts above and below each knee. In the axes of a human template (y up, z to the front) a shin points down.
_KNEES = (("left thigh", "left shin"), ("right thigh", "right shin"))
_DOWN, _FRONT = np.array([0.0, -1.0, 0.0]), 2


def knees_forward(
    system: NodeSystem, vectors: Float[Floats, "K 3"], template: Template, shown: Bool[Bools, " V"] | None = None
) -> float:
    """Largest angle (degrees) by which a knee bends forward; 0 if none does, or if the template has no knees.

    If only some vertices are ``shown``, a knee is ignored unless more than half of its thigh and of its shin is.
    """
    names, labels = template.label_names or (), np.asarray(template.labels)[system.gradient_points]
    seen = np.ones(len(labels), bool) if shown is None else shown[system.gradient_points]
    gradient, most = system.deformation_gradient(vectors), 0.0
    for above, below in _KNEES:
        if above not in names or below not in names:
            continue
        masks = [labels == names.index(name) for name in (above, below)]
        parts = [gradient[each] for each in masks]
        if all(len(part) and seen[each].mean() > 0.5 for part, each in zip(parts, masks, strict=True)):
            left, _, right = signed_svd(np.stack([part.mean(0) for part in parts]))
            thigh, shin = left @ right  # the rotations nearest to both
            direction = thigh.T @ shin @ _DOWN
            most = max(most, float(np.degrees(np.arcsin(np.clip(direction[_FRONT], -1, 1)))))
    return most
