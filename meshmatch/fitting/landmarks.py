"""Known pairs of points: where on the template they belong, and fits that honour them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fit_shape import fit_shape
from meshmatch.shapes.repair import Repaired
from meshmatch.templates.template import Template

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel


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


def honour_pairs(
    model: TrainedModel,
    clean: list[Repaired],
    fits: list[Fit],
    landmarks: tuple[np.ndarray, np.ndarray],
    config: FitConfig,
) -> tuple[list[Fit], list[tuple[np.ndarray, np.ndarray]]]:
    """Fit again with known pairs.

    A pair is carried to the template through the first fits; the template point between the two answers is
    then pulled to the landmark on both shapes.

    Parameters
    ----------
    clean : the two repaired shapes
    landmarks : vertices (N,) of the source's file, vertices (N,) of the target's

    Returns
    -------
    fits : list of Fit
    known : list of (template vertices (N,), their places (N, 3) in the shape's file), for each shape

    Raises
    ------
    OptionError
        Not pairs of vertices, or a vertex that a shape does not have.
    """
    places = []
    for part, chosen in zip(clean, landmarks, strict=True):
        chosen = np.asarray(chosen, np.int64)
        if chosen.ndim != 1 or len(chosen) == 0 or chosen.min() < 0:
            raise OptionError("landmarks must be lists of vertex numbers", "one pair of vertices a line")
        if chosen.max() >= len(part.original_to_repaired):
            raise OptionError(
                f"landmark vertex {chosen.max()} is not on {part.shape.name}, which has "
                f"{len(part.original_to_repaired)} vertices",
                "numbers start at 0; the source comes first",
            )
        places.append(part.shape.verts[part.original_to_repaired[chosen]])
    if len(places[0]) != len(places[1]):
        raise OptionError("landmarks must come in pairs", "one pair of vertices a line")
    at = template_vertices(model.template, fits, places)
    known = [(at, place) for place in places]
    return [
        fit_shape(model, part.shape, config, pairs) for part, pairs in zip(clean, known, strict=True)
    ], known
