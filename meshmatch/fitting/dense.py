"""A fit in the template's full resolution."""

from __future__ import annotations

import numpy as np

from meshmatch.errors import OptionError
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
    if fit.template_hash != template.hash:
        raise OptionError(
            f"the fit is of another template ({fit.template_hash}, not {template.hash})",
            "use the model that made the fit",
        )
    verts = np.asarray(template.dense.verts)
    moved = verts + model.field(verts).displaced(fit.vectors)
    return Shape(fit.frame.undo(moved), template.dense.faces, template.name)
