"""A fit in the template's full resolution."""

from __future__ import annotations

import numpy as np

from meshmatch.fitting.fit import Fit
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape


def dense_shape(model: TrainedModel, fit: Fit) -> Shape:
    """The dense mesh of a model's template under a fit's node vectors, in the frame and unit of the shape's file.

    Raises
    ------
    OptionError
        The fit is of another template.
    TemplateError
        A vertex of the dense mesh has too few nodes in reach.
    """
    template = model.template
    fit.check_template(template.hash)
    verts = np.asarray(template.dense.verts)
    moved = verts + model.field(verts).displaced(fit.vectors)
    return Shape(fit.frame.undo(moved), template.dense.faces, template.name)
