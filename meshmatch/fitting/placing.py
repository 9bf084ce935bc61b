"""How a category wants its shapes placed before they are fitted; its card says it, as its folder was prepared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from meshmatch.fitting.orientation import Hypothesis
from meshmatch.fitting.scan import Scan
from meshmatch.shapes.align import ALIGNS, Oriented, align
from meshmatch.shapes.shape import Frame, Shape
from meshmatch.templates.gather import SCALES, template_radius, template_samples, unit_frame

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

_TURNS = 4  # orientations that a fit tries where the alignment has to search


def scan_frame(model: TrainedModel, shape: Shape) -> Frame:
    """The frame in which the model knows shapes, before they are turned: of area 1, or of the template's radius."""
    scale = next(kind for kind in SCALES if kind == model.card.frame["scale"])  # the card knows no other
    return unit_frame(shape, scale, template_radius(model.template))


def placed(model: TrainedModel, scan: Scan) -> list[Hypothesis] | None:
    """Core frames to try where the category's orientation is not searched by its network; None where it is."""
    how = next((how for how in ALIGNS if how == model.card.frame["orientation"]), None)
    if how is None:
        return None
    if how == "none":
        return [Hypothesis(np.eye(3), np.zeros(3), 1.0)]
    found = align(Oriented(scan.points, scan.normals), template_samples(model.template), how, _TURNS)
    return [Hypothesis(each.rotation, each.centre, 1.0 / len(found)) for each in found]
