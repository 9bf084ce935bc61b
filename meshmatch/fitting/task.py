"""What a fit in progress is about, and what it has found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.initial_frames import scan_frame
from meshmatch.fitting.network_fit import Candidate, Predictor
from meshmatch.fitting.samples import Landmarks, take_samples, without_outliers
from meshmatch.fitting.system import NodeSystem
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape


@dataclass(frozen=True, eq=False)
class FitTask:
    """One shape that is to be fitted.

    Attributes
    ----------
    model : TrainedModel
    config : FitConfig
        For this model and the noise of this shape.
    predictor : Predictor
        The model's network, with the random numbers of this task.
    shape : Shape
        Repaired, in its file's frame.
    roughness : float
        Of the shape without outliers (0..1, see `Shape.roughness`).
    frame : Frame
        From the file to the frame of the samples: area about 1, centroid 0.
    samples : OrientedPoints
        Of the shape without outliers.
    landmarks : (template vertices (N,), positions (N, 3) in the file), optional
    progress : Progress
    """

    model: TrainedModel
    config: FitConfig
    predictor: Predictor
    shape: Shape
    roughness: float
    frame: Frame
    samples: OrientedPoints
    landmarks: Landmarks | None
    progress: Progress

    @classmethod
    def of(
        cls,
        model: TrainedModel,
        config: FitConfig,
        shape: Shape,
        landmarks: Landmarks | None = None,
        progress: Progress | None = None,
    ) -> FitTask:
        """The task for a repaired shape, sampled in the frame in which the model knows shapes."""
        config = config.for_noise(shape.roughness)
        rng = np.random.default_rng(config.seed)
        clean = without_outliers(shape)
        frame, samples = take_samples(clean, config.samples, rng, scan_frame(model, clean))
        return cls(
            model=model,
            config=config,
            predictor=Predictor.of(model, rng),
            shape=shape,
            roughness=clean.roughness,
            frame=frame,
            samples=samples,
            landmarks=landmarks,
            progress=progress or Progress(),
        )

    @property
    def system(self) -> NodeSystem:
        """The least-squares system of the model's template."""
        return self.predictor.system

    @property
    def coarse(self) -> OrientedPoints:
        """The first samples, for screening."""
        return self.samples.first(self.config.coarse_samples)

    def rescaled(self, scale: float, samples: OrientedPoints) -> FitTask:
        """The same task with lengths divided by ``scale``, and with the samples that are left in that frame."""
        frame = self.frame.compose(Frame(scale, np.eye(3), np.zeros(3)))
        return replace(self, frame=frame, samples=samples)


@dataclass(frozen=True, eq=False)
class Registration:
    """A candidate that a task ended with.

    Attributes
    ----------
    task : FitTask
        Frame and samples in the size that was found.
    candidate : Candidate
    share : float
        How much of the whole surface (0..1) the shape is taken to show.
    """

    task: FitTask
    candidate: Candidate
    share: float = 1.0

    @cached_property
    def core_frame(self) -> Frame:
        """From the file to the core frame."""
        return self.task.frame.compose(self.candidate.pose.frame)

    @cached_property
    def local(self) -> OrientedPoints:
        """The samples in the core frame."""
        return self.task.samples.to_local(self.candidate.pose)

    @cached_property
    def surface(self) -> OrientedPoints:
        """The template's vertices and normals as fitted, core frame."""
        return self.task.system.surface(self.candidate.vectors)
