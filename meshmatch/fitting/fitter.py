"""Fit a model's template to shapes: samples, orientation, prediction, refinement, verdict."""

from __future__ import annotations

import time

import numpy as np

from meshmatch.fitting.fit import Fit, axis_name, vertex_distance
from meshmatch.fitting.fit_config import FitConfig, check_landmarks
from meshmatch.fitting.part import cost, fit_part
from meshmatch.fitting.refinement import REFINEMENTS, Refinement
from meshmatch.fitting.samples import Landmarks
from meshmatch.fitting.task import FitTask, Registration
from meshmatch.fitting.verdict import FAIR_RESIDUAL, empty_share, judge_registration
from meshmatch.fitting.whole import fit_whole
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.shape import Shape

# All of these were set by hand.
_EMPTY = 0.06  # a fit of the whole that leaves this share of the template without surface may be one of a part
_OPEN = 0.3  # so may a bad one of a mesh with a boundary of so many sqrt(area)
_CLOSER = 0.85  # a part is believed if its residual is that much smaller
_MISSING = 0.03  # and if it lacks that much of the surface


class Fitter:
    """Fits the template of one model. Nothing in it changes, so several threads can share one.

    Parameters
    ----------
    model : TrainedModel
        What depends on it alone is built once for all its fitters, also if threads ask for it at the same time.
    config : FitConfig, optional
    progress : callable, optional
        Called with (stage, name of the shape, share of the stage that is done); what it raises ends the fit.
    """

    def __init__(
        self, model: TrainedModel, config: FitConfig | None = None, progress: ProgressCallback | None = None
    ) -> None:
        self.model = model
        self.config = (config or FitConfig()).for_model(model)
        self.progress = progress

    def fit(self, shape: Shape, landmarks: Landmarks | None = None) -> Fit:
        """Fit the template to a repaired shape; to a cloud without its outliers.

        Parameters
        ----------
        shape : Shape
            In any unit, turn and resolution.
        landmarks : (template vertices (N,), positions (N, 3) in the shape's file), optional
            Held by a fit of the whole; parts are not tried then.

        Raises
        ------
        OptionError
            Invalid axes, or up and front along the same axis; landmarks for a model without nodes.
        """
        if landmarks is not None:
            check_landmarks(self.model)
        began = time.monotonic()
        progress = Progress(self.progress, shape.name)
        task = FitTask.of(self.model, self.config, shape, landmarks, progress)
        refinement = REFINEMENTS[task.config.refine]
        found, partial = fit_whole(task, refinement.whole), False
        if landmarks is None and _may_be_part(found, refinement):
            part = fit_part(task, refinement.part)
            partial = _is_part(part, found)
            found = part if partial else found
        return _as_fit(found, partial, began)


def _may_be_part(whole: Registration, refinement: Refinement) -> bool:
    """Whether a fit as a part is worth its time: asked for, or a bad fit of an open shape, or one that leaves it bare."""
    task = whole.task
    if task.config.partial != "auto":
        return task.config.partial == "yes"
    if not refinement.tries_parts:
        return False
    if not task.shape.is_cloud:
        if boundary_length(task.shape) < _OPEN * np.sqrt(task.shape.area):
            return False
        if whole.candidate.residual > FAIR_RESIDUAL:  # that of a cloud says how sparse and noisy it is
            return True
    return empty_share(whole.local, whole.surface.points) > _EMPTY


def _is_part(part: Registration, whole: Registration) -> bool:
    """Whether a fit as a part explains a shape better than one of the whole."""
    closer = cost(part.candidate.residual, part.share) < _CLOSER * whole.candidate.residual
    return closer and part.share < 1 - _MISSING


def _as_fit(found: Registration, partial: bool, began: float) -> Fit:
    task, frame, points = found.task, found.core_frame, found.surface.points
    verdict, reasons = judge_registration(found, partial)
    return Fit(
        template_hash=task.model.template.hash,
        frame=frame,
        points=points,
        vectors=found.candidate.vectors,
        resting=task.system.verts,
        faces=task.system.faces,
        residual=found.candidate.residual,
        vertex_distance=vertex_distance(points, frame.apply(task.shape.verts)),
        verdict=verdict,
        reasons=reasons,
        up=axis_name(frame.rotation[1]),
        front=axis_name(frame.rotation[2]),
        seconds=time.monotonic() - began,
        seed=task.config.seed,
        partial=partial,
    )


def boundary_length(shape: Shape) -> float:
    """Length of the edges with one face, in the unit of the file."""
    ends = shape.verts[shape.edges.vertices[shape.edges.sizes == 1]]  # N 2 3
    return float(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum())
