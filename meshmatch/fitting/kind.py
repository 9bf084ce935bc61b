"""Of what kind a shape is, read coarsely: how near a model's network alone brings its template to the shape.

What reads strangely, such as a robot or a cloud with many outliers, is fitted: where the fit can be trusted, it is of the
kind. A reading takes the shape for complete: of a part a high one says little.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.initial_frames import frames_to_try, scan_frame
from meshmatch.fitting.network_fit import Predictor, best_first
from meshmatch.fitting.task import without_outliers
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel, once_per_model
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

KNOWN = 0.0485
"""Readings up to this (units of sqrt(area)) are of a shape that the model knows. The benchmark's bodies, scans and animals
have 0.046 at most, its hearts and furniture 0.051 at least (docs/results.md)."""
FAMILIAR, STRANGE = 0.0465, 0.062
"""Between these a shape may be a strange one of the kind, such as a robot, or none, such as an aeroplane with wings for
arms: a fit tells, see `told`."""
SURE = 0.042
"""Up to this a reading needs no other model's beside it: another kind's were 0.0439 at least (docs/results.md)."""
BELONGS = 0.7
"""Trust from which on such a fit tells the kind; of a mesh, and a template with limbs, any that is not poor. A head has
none, so that much is like it: a fair fit of it can be of a heart. Clouds of aeroplanes have fair fits of people."""
# Isoperimetric quotient of a template up to which it has limbs: people have 0.08, hands 0.12, animals 0.15, heads 0.27.
_LIMBED = 0.2
_SAMPLES, _THIN = 2048, 768  # how many the reading is of, and how many rank the orientations


def kind_samples(shape: Shape, seed: int = 0) -> OrientedPoints:
    """Samples of a repaired shape for `read_kind`, in the frame of its file; the same for all models."""
    return sample_surface(without_outliers(shape), _SAMPLES, np.random.default_rng(seed))


def read_kind(model: TrainedModel, shape: Shape, samples: OrientedPoints, config: FitConfig) -> float:
    """Mean distance both ways, normals included, of a shape and the model's unrefined template (units of sqrt(area)).

    ``samples`` are `kind_samples` of the shape; of ``config`` the seed and the device count. A shape is of its kind whatever
    axes its user names, so all orientations are tried.
    """
    config = replace(config, up=None, front=None, copies=16, hypotheses=3)
    rng = np.random.default_rng(config.seed)
    placed = samples.in_frame(scan_frame(model, without_outliers(shape)))
    thin, predictor = placed.first(_THIN), Predictor.of(model, rng, config.device, mirrored=False)
    starts = [(thin, pose) for pose in frames_to_try(model, thin, config)]
    best = best_first(predictor.fit_all(starts, rounds=1, draws=1))[0]
    return predictor.fit(placed, best.pose, draws=1).residual


@once_per_model
def has_limbs(model: TrainedModel) -> bool:
    """Whether a model's template is far from round: 36 pi V^2 / A^3 is 1 for a ball. Cones to the center close its holes."""
    shape = model.template.shape
    volume = np.linalg.det(shape.verts[shape.faces]).sum() / 6
    return bool(36 * np.pi * volume**2 / shape.area**3 <= _LIMBED)


def told(
    model: TrainedModel, shape: Shape, reading: float, config: FitConfig, progress: ProgressCallback | None
) -> tuple[bool, Fit | None]:
    """Whether a shape is known to be of a model's kind, and the fit of one that reads strangely, which had to tell.

    The fit is made as ``config`` says, with refined nodes; one of a part tells nothing that the reading does not.
    """
    if not FAMILIAR < reading <= STRANGE:
        return reading <= FAMILIAR, None
    fit = Fitter(model, replace(config, refine="nodes"), progress).fit(shape)
    if fit.partial:
        return reading <= KNOWN, fit
    clear = has_limbs(model) and not shape.is_cloud
    return fit.verdict != "poor" and (fit.trust >= BELONGS or clear), fit
