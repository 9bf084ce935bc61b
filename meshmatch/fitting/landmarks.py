"""Known pairs of points: where on the template they belong, and fits that hold them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.samples import Landmarks
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.repair import Repaired
from meshmatch.templates.template import Template

_HINT = "one target vertex for each source vertex, both counted from 0"


def template_vertices(
    template: Template, fits: Sequence[Fit], places: Sequence[Float[Floats, "N 3"]]
) -> Int[Ints, " N"]:
    """Template vertices for N points given on several fitted shapes (file frames).

    Each fit answers with the template vertex nearest to the point; the vertex nearest to the mean of the
    answers on the resting template is taken, so no shape's fit decides alone.
    """
    verts = template.shape.verts
    answers = [
        verts[cKDTree(fit.points).query(fit.frame.apply(place))[1]] for fit, place in zip(fits, places, strict=True)
    ]
    return cKDTree(verts).query(np.mean(answers, axis=0))[1].astype(np.int64)


def landmark_places(clean: Sequence[Repaired], landmarks: Sequence[ArrayLike]) -> list[Float[Floats, "N 3"]]:
    """Where the landmarks of two shapes lie, in the frames of their files.

    Raises
    ------
    OptionError
        Not pairs of vertices, or a vertex that a shape does not have.
    """
    if len(landmarks) != 2:
        raise OptionError(f"landmarks must be two lists of vertices, not {len(landmarks)}", _HINT)
    places = [_places(part, chosen) for part, chosen in zip(clean, landmarks, strict=True)]
    if len(places[0]) != len(places[1]):
        raise OptionError("landmarks must come in pairs", _HINT)
    return places


def fits_with_landmarks(
    model: TrainedModel,
    clean: Sequence[Repaired],
    fits: Sequence[Fit],
    landmarks: tuple[Ints, Ints],
    configs: Sequence[FitConfig],
) -> tuple[list[Fit], list[Landmarks]]:
    """Fit two shapes again with known pairs.

    A pair is carried to the template through the first fits; the template point between the two answers is
    then pulled to the landmark on both shapes.

    Parameters
    ----------
    clean : the two repaired shapes
    landmarks : vertices (N,) of the source's file, vertices (N,) of the target's
    configs : one for each shape

    Returns
    -------
    fits : list of Fit
    known : list of (template vertices (N,), their places (N, 3) in the shape's file), for each shape

    Raises
    ------
    OptionError
        Not pairs of vertices, or a vertex that a shape does not have.
    """
    places = landmark_places(clean, landmarks)
    at = template_vertices(model.template, fits, places)
    known = [(at, place) for place in places]
    found = [
        Fitter(model, config).fit(part.shape, held) for config, part, held in zip(configs, clean, known, strict=True)
    ]
    return found, known


def _places(part: Repaired, vertices: ArrayLike) -> Float[Floats, "N 3"]:
    """Where vertices of a shape's file lie."""
    chosen = np.asarray(vertices)
    if chosen.ndim != 1 or len(chosen) == 0 or chosen.dtype.kind not in "iu" or chosen.min() < 0:
        raise OptionError("landmarks must be lists of vertex numbers", _HINT)
    if chosen.max() >= len(part.original_to_repaired):
        raise OptionError(
            f"landmark vertex {chosen.max()} is not on {part.shape.name}, which has "
            f"{len(part.original_to_repaired)} vertices",
            "numbers start at 0; the source comes first",
        )
    return part.shape.verts[part.original_to_repaired[chosen]]
