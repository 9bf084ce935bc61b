"""A fit in progress: its inputs, above all the samples, and its result."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from meshmatch.derived import derived
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.search.frames import scan_frame
from meshmatch.fitting.search.predictor import Candidate, Predictor
from meshmatch.fitting.solve.system import NodeSystem
from meshmatch.fitting.solve.terms import Landmarks
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel
from meshmatch.progress import Progress
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.cloud import outlier_points
from meshmatch.shapes.hidden_faces import remove_hidden_faces
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# An outlier is this many times as far from its neighbours as these are from theirs, see `outlier_points`. Set by hand.
_OUTLIER_RATIO = 1.3


@dataclass(frozen=True, eq=False, kw_only=True)
class FitTask:
    """One shape that is to be fitted, with everything that the fit needs."""

    model: TrainedModel
    config: FitConfig  # for this model and the noise of this shape
    predictor: Predictor  # runs the model's network, with this task's random generator
    shape: Shape  # repaired, in its file's frame
    roughness: float  # of the shape without outliers (0..1, see `Shape.roughness`)
    frame: Frame  # from the file to the frame of the samples: area about 1, centroid 0
    samples: OrientedPoints  # of the shape without outliers, for the network, which can handle hidden surface
    visible_samples: OrientedPoints  # of what is visible from outside, for everything but the network
    landmarks: Landmarks | None  # template vertices (N,), positions (N, 3) in the file
    progress: Progress

    @classmethod
    def of(
        cls,
        model: TrainedModel,
        config: FitConfig,
        shape: Shape,
        landmarks: Landmarks | None = None,
        progress: Progress | None = None,
        mirrored: bool = False,
    ) -> FitTask:
        """Create the task for a repaired shape or its mirror image, sampled in the frame that the model expects."""
        config = config.for_noise(shape.roughness)
        rng = np.random.default_rng(config.seed)
        clean = without_outliers(shape)
        frame, samples = take_samples(clean, config.samples, rng, scan_frame(model, clean, mirrored))
        predictor = Predictor.of(model, rng, config.device)
        visible = samples
        if (shown := without_interior(shape, predictor.system)) is not shape:
            visible = sample_surface(shown, config.samples, np.random.default_rng(config.seed)).in_frame(frame)
        progress = progress or Progress()
        return cls(
            model=model,
            config=config,
            predictor=predictor,
            shape=shape,
            roughness=clean.roughness,
            frame=frame,
            samples=samples,
            visible_samples=visible,
            landmarks=landmarks,
            progress=progress,
        )

    @property
    def system(self) -> NodeSystem:
        """The least-squares system of the model's template."""
        return self.predictor.system

    @property
    def coarse(self) -> OrientedPoints:
        """The first few samples, for screening."""
        return self.samples.first(self.config.coarse_samples)

    @property
    def on_visible_samples(self) -> FitTask:
        """The same task with the visible samples in place of all."""
        return replace(self, samples=self.visible_samples)

    def rescaled(self, scale: float, samples: OrientedPoints | None = None) -> FitTask:
        """The same task with lengths divided by ``scale``.

        ``samples``, already in the new scale, replace both sets of samples if they are given.
        """
        frame = self.frame.compose(Frame(scale, np.eye(3), np.zeros(3)))
        if samples is not None:
            return replace(self, frame=frame, samples=samples, visible_samples=samples)
        all_samples, visible = (
            replace(each, points=each.points / scale) for each in (self.samples, self.visible_samples)
        )
        return replace(self, frame=frame, samples=all_samples, visible_samples=visible)


@dataclass(frozen=True, eq=False)
class Registration:
    """The candidate that a task ended with; the task's frame and samples have the scale that the search found."""

    task: FitTask
    candidate: Candidate

    @cached_property
    def core_frame(self) -> Frame:
        """Frame from the shape's file to the core frame."""
        return self.task.frame.compose(self.candidate.pose.frame)

    @cached_property
    def local(self) -> OrientedPoints:
        """The samples in the core frame."""
        return self.task.samples.to_local(self.candidate.pose)

    @cached_property
    def surface(self) -> OrientedPoints:
        """Vertices and normals of the fitted template, core frame."""
        return self.task.system.surface(self.candidate.vectors)


@derived
def without_outliers(shape: Shape) -> Shape:
    """A cloud without its outliers; other shapes are returned unchanged.

    An outlier distorts the normals of its neighbours and can flip the signs of whole regions, and it counts as surface.
    """
    if not shape.is_cloud:
        return shape
    kept = ~outlier_points(shape.verts, _OUTLIER_RATIO)
    weights = None if shape.weights is None else shape.weights[kept]
    return shape if kept.all() else Shape(shape.verts[kept], shape.faces, shape.name, weights=weights)


def without_interior(shape: Shape, system: NodeSystem) -> Shape:
    """A mesh without faces that are hidden from outside, unless the template has hidden surface itself."""
    return remove_hidden_faces(shape) if system.shows_all else shape


def take_samples(
    shape: Shape, P: int, rng: np.random.Generator, frame: Frame | None = None
) -> tuple[Frame, OrientedPoints]:
    """Return a frame from a shape's file (by default to area 1, centroid 0), and P samples of the shape in that frame.

    Outliers of a cloud are not sampled; the normals of a cloud have no sign.
    """
    frame = sqrt_area_frame(shape) if frame is None else frame
    return frame, sample_surface(without_outliers(shape), P, rng).in_frame(frame)
