"""Core frames in which a shape is tried: as the card says that its category is placed, as the user or the network says."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.orientation import axis_vector, forced_frames, propose, standing_grid, with_flips
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.models.trained import TrainedModel, once_per_model
from meshmatch.shapes.normalise import ALIGNS, align
from meshmatch.shapes.shape import Shape
from meshmatch.templates.prepared_folder import SCALES
from meshmatch.templates.unregistered import template_radius, template_samples, unit_frame

# All of these were set by hand.
_ALIGNED = 4  # orientations that are tried where the alignment has to search
_VOTERS = 2048  # samples that the aligner sees
# How far along its own up axis a body's core may lie from the middle of a part of it (units of sqrt(area)).
_ALONG = (-0.3, -0.15, 0.0, 0.15)
_OBEYS = 0.5  # cosine of the angle between an axis of a frame and the user's


def scan_frame(model: TrainedModel, shape: Shape) -> Frame:
    """The frame in which the model knows shapes, before they are turned: of area 1, or of the template's radius."""
    scale = next(kind for kind in SCALES if kind == model.card.frame["scale"])  # the card knows no other
    return unit_frame(shape, scale, template_radius(model.template))


def frames_to_try(model: TrainedModel, samples: OrientedPoints, config: FitConfig) -> list[RigidPose]:
    """Core frames to try: the category's, the aligner's (or a grid without one), or those that obey the user's axes."""
    frames = aligned_frames(model, samples)
    if frames is None and not model.inference.config.align_basis:
        frames = standing_grid(samples.points.mean(0))
    elif frames is None:
        points = samples.points[:_VOTERS]
        frames = with_flips(propose(model.inference, points, config.copies, config.hypotheses, config.seed))
    up, front = _axes(config)
    if up is None and front is None:
        return frames
    obeying = [
        pose
        for pose in frames
        if (up is None or pose.rotation[:, 1] @ up > _OBEYS) and (front is None or pose.rotation[:, 2] @ front > _OBEYS)
    ]
    return obeying or forced_frames(up, front)


def aligned_frames(model: TrainedModel, samples: OrientedPoints) -> list[RigidPose] | None:
    """Core frames of a category whose orientation its network does not search; None where it does."""
    how = next((how for how in ALIGNS if how == model.card.frame["orientation"]), None)
    if how is None:
        return None
    if how == "none":
        return [RigidPose.identity()]
    return [each.pose for each in align(samples, _template_samples(model), how, _ALIGNED)]


@once_per_model
def _template_samples(model: TrainedModel) -> OrientedPoints:
    return template_samples(model.template)


def frames_of_part(
    model: TrainedModel, samples: OrientedPoints, config: FitConfig, wide: bool
) -> tuple[list[RigidPose], list[RigidPose]]:
    """Core frames to try for a part, whose middle is not that of the whole, and which a vote seldom knows.

    Those of `frames_to_try`; and, the same for any samples, all turns about the user's axes, or, if the search is to be
    ``wide``, about the axes of the file, each with several places of the core along the body.
    """
    frames = frames_to_try(model, samples, config)
    if model.card.frame["orientation"] in ALIGNS:
        return frames, []
    up, front = _axes(config)
    if up is not None or front is not None:
        return frames, _along_body(forced_frames(up, front))
    if not wide:
        return frames, []
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return frames, _along_body([pose for axis in axes for pose in forced_frames(axis, None, 8)])


def _along_body(poses: list[RigidPose]) -> list[RigidPose]:
    """Every pose with its origin at several places along its own up axis."""
    return [RigidPose(pose.rotation, pose.center + away * pose.rotation[:, 1]) for pose in poses for away in _ALONG]


def _axes(config: FitConfig) -> tuple[Float[Floats, " 3"] | None, Float[Floats, " 3"] | None]:
    """The user's up and front."""
    up = None if config.up is None else axis_vector(config.up)
    return up, None if config.front is None else axis_vector(config.front)
