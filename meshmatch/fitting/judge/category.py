"""Coarse classification: the residual of each model's unrefined prediction.

If it is inconclusive, as for a robot or for a cloud with many outliers, a full fit decides. The residual is that of a
complete shape; a high residual of a part says little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from meshmatch.derived import derived
from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.judge.reasons import Verdict
from meshmatch.fitting.search.frames import frames_to_try, scan_frame
from meshmatch.fitting.search.predictor import Predictor, best_first
from meshmatch.fitting.search.task import without_outliers
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map

MAX_KNOWN_RESIDUAL = 0.0485
"""Largest residual (units of sqrt(area)) of a shape that the model knows. The benchmark's bodies, scans and animals have
0.046 at most, its hearts and furniture 0.051 at least (docs/results.md)."""
MAX_CERTAIN_RESIDUAL, MIN_FOREIGN_RESIDUAL = 0.0465, 0.062
"""Residuals between these limits are inconclusive, for robots as for aeroplanes with wings like arms: a full fit decides,
see `is_of_category`."""
MAX_UNRIVALLED_RESIDUAL = 0.042
"""Residuals up to this need no comparison with other models: those of other categories were 0.0439 at least
(docs/results.md)."""
MIN_CATEGORY_TRUST = 0.7
"""Least trust of a full fit that puts a shape into the category. For a mesh and a template with limbs, any fit that is
not poor does: limbless templates fit many shapes (the head model can fit a heart fairly), and people fit clouds of
aeroplanes fairly."""
# Largest isoperimetric quotient of a template with limbs: people have 0.08, hands 0.12, animals 0.15, heads 0.27.
_MAX_LIMBED_QUOTIENT = 0.2
_SAMPLES, _RANKING_SAMPLES = 2048, 768  # samples for the residual, and for ranking orientations


def category_samples(shape: Shape, seed: int = 0) -> OrientedPoints:
    """Samples of a repaired shape for `category_residual`, in the frame of its file; the same for all models."""
    return sample_surface(without_outliers(shape), _SAMPLES, np.random.default_rng(seed))


def category_residual(model: TrainedModel, shape: Shape, samples: OrientedPoints, config: FitConfig) -> float:
    """Mean distance, both ways and normals included, between a shape and a model's unrefined template.

    It is in units of sqrt(area). ``samples`` are the shape's `category_samples`; of ``config`` only seed and device are
    used. All orientations are tried, as the category does not depend on the axes that the user gives.
    """
    config = replace(config, up=None, front=None, copies=16, hypotheses=3)
    rng = np.random.default_rng(config.seed)
    placed = samples.in_frame(scan_frame(model, without_outliers(shape)))
    ranking_samples, predictor = placed.first(_RANKING_SAMPLES), Predictor.of(model, rng, config.device, mirrored=False)
    starts = [(ranking_samples, pose) for pose in frames_to_try(model, ranking_samples, config, shape.upright)]
    best = best_first(predictor.fit_all(starts, rounds=1, draws=1))[0]
    return predictor.fit(placed, best.pose, draws=1).residual


class CategoryResiduals:
    """`category_residual` of several repaired shapes under several models, which are loaded when needed.

    ``found`` (M, S) is infinite where a model is damaged or cannot process a shape, and where it has not been asked.
    """

    def __init__(
        self, models: Sequence[Callable[[], TrainedModel]], shapes: Sequence[Shape], configs: Sequence[FitConfig]
    ) -> None:
        self._models, self._shapes, self._configs = models, shapes, configs
        self._samples = parallel_map(category_samples, shapes, [config.seed for config in configs])
        self.found = np.full((len(models), len(shapes)), np.inf)

    def ask(self, rows: Iterable[int], numbers: Iterable[int]) -> None:
        """Compute the residuals for some models (``rows``) and some shapes (``numbers``)."""
        entries = [(row, number) for row in rows for number in numbers]
        for place, value in zip(entries, parallel_map(lambda entry: self._read(*entry), entries), strict=True):
            self.found[place] = value

    def _read(self, row: int, number: int) -> float:
        try:
            model = self._models[row]()
            return category_residual(model, self._shapes[number], self._samples[number], self._configs[number])
        except OptionError:  # a missing device fails for all models
            raise
        except MeshmatchError:  # also for a damaged model, which `meshmatch models list` reports
            return np.inf


@derived
def has_limbs(model: TrainedModel) -> bool:
    """Whether a model's template is far from round: the isoperimetric quotient 36 pi V^2 / A^3 is 1 for a ball.

    Cones to the origin close its holes.
    """
    shape = model.template.shape
    volume = np.linalg.det(shape.verts[shape.faces]).sum() / 6
    return bool(36 * np.pi * volume**2 / shape.area**3 <= _MAX_LIMBED_QUOTIENT)


class Judged(Protocol):
    """The properties of a fit that decide."""

    @property
    def partial(self) -> bool: ...
    @property
    def verdict(self) -> Verdict: ...
    @property
    def trust(self) -> float: ...


def needs_a_fit(residual: float) -> bool:
    """Whether a residual alone does not decide if a shape is of a category."""
    return MAX_CERTAIN_RESIDUAL < residual <= MIN_FOREIGN_RESIDUAL


def is_of_category(model: TrainedModel, shape: Shape, residual: float, fit: Judged | None) -> bool:
    """Whether a shape is of a model's category, by its residual, and by its ``fit`` if it `needs_a_fit`.

    A fit as a part adds nothing to the residual.
    """
    if fit is None:
        return residual <= MAX_CERTAIN_RESIDUAL
    if fit.partial:
        return residual <= MAX_KNOWN_RESIDUAL
    clear = has_limbs(model) and not shape.is_cloud
    return fit.verdict != "poor" and (fit.trust >= MIN_CATEGORY_TRUST or clear)
