"""A fit in the template's full resolution."""

from __future__ import annotations

import numpy as np
import torch

from meshmatch.errors import OptionError
from meshmatch.fields.mls import build_field
from meshmatch.fitting.fit import Fit
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template


def dense_shape(template: Template, fit: Fit) -> Shape:
    """The template's dense mesh under a fit's node vectors, in the frame and unit of the shape's file.

    Raises
    ------
    OptionError
        The fit is of another template.
    TemplateError
        A vertex of the dense mesh has too few nodes in reach.
    """
    if fit.template_hash != template.hash:
        raise OptionError(
            f"the fit is of another template ({fit.template_hash}, not {template.hash})",
            "use the template of the model that made the fit",
        )
    verts = np.asarray(template.dense.verts)
    field = build_field(verts, template.nodes, template.radius)
    moved = verts + (field.phi.double() @ torch.from_numpy(np.array(fit.vectors))).numpy()
    return Shape(fit.frame.undo(moved), template.dense.faces, template.name)
