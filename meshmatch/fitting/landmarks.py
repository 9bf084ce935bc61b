"""Where on the template a pair of known points belongs."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.fitting.fit import Fit
from meshmatch.templates.template import Template


def template_vertices(template: Template, fits: list[Fit], places: list[np.ndarray]) -> np.ndarray:
    """Template vertices (N,) for N points given on several fitted shapes (file frames).

    Each fit answers with the template vertex nearest to the point; the vertex nearest to the mean of the
    answers on the resting template is taken, so no shape's fit decides alone.
    """
    verts = template.shape.verts
    answers = [
        verts[cKDTree(fit.points).query(fit.frame.apply(place))[1]]
        for fit, place in zip(fits, places, strict=True)
    ]
    return cKDTree(verts).query(np.mean(answers, axis=0))[1].astype(np.int64)
