"""Coarse classification: the residual of each model's unrefined prediction.

Where that is inconclusive, as of a robot or of a cloud with many outliers, a full fit decides. The residual is that of a
complete shape: of a part a high one says little.
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

KNOWN = 0.0485
"""Residuals up to this (units of sqrt(area)) are of a shape that the model knows. The benchmark's bodies, scans and animals
have 0.046 at most, its hearts and furniture 0.051 at least (docs/results.md)."""
FAMILIAR, STRANGE = 0.0465, 0.062
"""Residuals between these limits are inconclusive, for robots as for aeroplanes with wings like arms: a full fit decides,
see `is_of_category`."""
SURE = 0.042
"""Up to this a residual need not be compared with other models': those of other categories were 0.0439 at least
(docs/results.md)."""
BELONGS = 0.7
"""Trust from which on such a fit decides; for a mesh, and a template with limbs, every fit that is not poor does. Limbless
templates fit many shapes: the head model can fit a heart fairly. Clouds of aeroplanes have fair fits of people."""
# Isoperimetric quotient of a template up to which it has limbs: people have 0.08, hands 0.12, animals 0.15, heads 0.27.
_LIMBED = 0.2
_SAMPLES, _THIN = 2048, 768  # for the residual, and to rank the orientations


def category_samples(shape: Shape, seed: int = 0) -> OrientedPoints:
    """Samples of a repaired shape for `category_residual`, in the frame of its file; the same for all models."""
    return sample_surface(without_outliers(shape), _SAMPLES, np.random.default_rng(seed))


def category_residual(model: TrainedModel, shape: Shape, samples: OrientedPoints, config: FitConfig) -> float:
    """Mean distance both ways, normals included, of a shape and the model's unrefined template (units of sqrt(area)).

    ``samples`` are `category_samples` of the shape; of ``config`` the seed and the device count. A shape is of its category
    whatever axes its user names, so all orientations are tried.
    """
    config = replace(config, up=None, front=None, copies=16, hypotheses=3)
    rng = np.random.default_rng(config.seed)
    placed = samples.in_frame(scan_frame(model, without_outliers(shape)))
    thin, predictor = placed.first(_THIN), Predictor.of(model, rng, config.device, mirrored=False)
    starts = [(thin, pose) for pose in frames_to_try(model, thin, config, shape.upright)]
    best = best_first(predictor.fit_all(starts, rounds=1, draws=1))[0]
    return predictor.fit(placed, best.pose, draws=1).residual


class Readings:
    """`category_residual` of some repaired shapes by some models, which are loaded when they are asked.

    ``found`` (M, S) is infinite where a model is damaged or cannot see a shape, and where it was not asked.
    """

    def __init__(
        self, models: Sequence[Callable[[], TrainedModel]], shapes: Sequence[Shape], configs: Sequence[FitConfig]
    ) -> None:
        self._models, self._shapes, self._configs = models, shapes, configs
        self._samples = parallel_map(category_samples, shapes, [config.seed for config in configs])
        self.found = np.full((len(models), len(shapes)), np.inf)

    def ask(self, rows: Iterable[int], numbers: Iterable[int]) -> None:
        """Ask these models about these shapes."""
        at = [(row, number) for row in rows for number in numbers]
        for place, value in zip(at, parallel_map(lambda at: self._read(*at), at), strict=True):
            self.found[place] = value

    def _read(self, row: int, number: int) -> float:
        try:
            model = self._models[row]()
            return category_residual(model, self._shapes[number], self._samples[number], self._configs[number])
        except OptionError:  # a device that is not there: true of all models
            raise
        except MeshmatchError:  # also of a damaged model: `meshmatch models list` tells what is wrong with it
            return np.inf


@derived
def has_limbs(model: TrainedModel) -> bool:
    """Whether a model's template is far from round: 36 pi V^2 / A^3 is 1 for a ball. Cones to the center close its holes."""
    shape = model.template.shape
    volume = np.linalg.det(shape.verts[shape.faces]).sum() / 6
    return bool(36 * np.pi * volume**2 / shape.area**3 <= _LIMBED)


class Judged(Protocol):
    """What of a fit decides."""

    @property
    def partial(self) -> bool: ...
    @property
    def verdict(self) -> Verdict: ...
    @property
    def trust(self) -> float: ...


def needs_a_fit(residual: float) -> bool:
    """Whether a residual alone does not tell if a shape is of a category."""
    return FAMILIAR < residual <= STRANGE


def is_of_category(model: TrainedModel, shape: Shape, residual: float, fit: Judged | None) -> bool:
    """Whether a shape is of a model's category, by its residual, and by its ``fit`` where it `needs_a_fit`.

    A fit of a part tells nothing that the residual does not.
    """
    if fit is None:
        return residual <= FAMILIAR
    if fit.partial:
        return residual <= KNOWN
    clear = has_limbs(model) and not shape.is_cloud
    return fit.verdict != "poor" and (fit.trust >= BELONGS or clear)
