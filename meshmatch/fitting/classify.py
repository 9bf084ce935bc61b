"""Classification of a shape: by the residual of a model's prediction, and by a full fit where that is inconclusive."""

from __future__ import annotations

from dataclasses import replace

from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.judge.category import is_of_category, needs_a_fit
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.shape import Shape


def classify(
    model: TrainedModel, shape: Shape, residual: float, config: FitConfig, progress: ProgressCallback | None
) -> tuple[bool, Fit | None]:
    """Return whether a repaired shape is of a model's category, and the fit that decided this, if one was needed.

    ``residual`` is the shape's `category_residual`. A fit is made according to ``config``, with refined nodes.
    """
    fit = Fitter(model, replace(config, refine="nodes"), progress).fit(shape) if needs_a_fit(residual) else None
    return is_of_category(model, shape, residual, fit), fit
