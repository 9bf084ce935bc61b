"""In which frames a shape is looked at: as its category is placed (the card says it), as the user or the network says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from meshmatch.errors import OptionError
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.orientation import (
    Hypothesis,
    axis_vector,
    forced_frames,
    propose,
    standing_grid,
    with_flips,
)
from meshmatch.fitting.scan import Scan
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.align import ALIGNS, align
from meshmatch.shapes.shape import Shape
from meshmatch.templates.unregistered import SCALES, template_radius, template_samples, unit_frame

if TYPE_CHECKING:
    from meshmatch.models.trained import TrainedModel

_TURNS = 4  # orientations that a fit tries where the alignment has to search
# How far along its own up axis a body's core may lie from the middle of a part of it (units of sqrt(area)).
_ALONG = (-0.3, -0.15, 0.0, 0.15)


def scan_frame(model: TrainedModel, shape: Shape) -> Frame:
    """The frame in which the model knows shapes, before they are turned: of area 1, or of the template's radius."""
    scale = next(kind for kind in SCALES if kind == model.card.frame["scale"])  # the card knows no other
    return unit_frame(shape, scale, template_radius(model.template))


def placed(model: TrainedModel, scan: Scan) -> list[Hypothesis] | None:
    """Core frames to try where the category's orientation is not searched by its network; None where it is."""
    how = next((how for how in ALIGNS if how == model.card.frame["orientation"]), None)
    if how is None:
        return None
    if how == "none":
        return [Hypothesis(np.eye(3), np.zeros(3), 1.0)]
    found = align(OrientedPoints(scan.points, scan.normals), template_samples(model.template), how, _TURNS)
    return [Hypothesis(each.pose.rotation, each.pose.center, 1.0 / len(found)) for each in found]


def frames_to_try(model: TrainedModel, scan: Scan, config: FitConfig) -> list[Hypothesis]:
    """Core frames to try: the category's, the aligner's (or a grid where there is none), or those that obey the user's
    axes.

    Raises
    ------
    OptionError
        An axis that is none, or up and front along one axis.
    """
    given = placed(model, scan)
    if given is not None:
        voted = given
    elif model.network.aligner is None:
        voted = standing_grid(scan.points.mean(0))
    else:
        voted = with_flips(
            propose(model.network, scan.points[:2048], config.copies, config.hypotheses, config.seed)
        )
    if config.up is None and config.front is None:
        return voted
    up, front = _axes(config)
    obeying = [
        guess
        for guess in voted
        if (up is None or guess.rotation[:, 1] @ up > 0.5)
        and (front is None or guess.rotation[:, 2] @ front > 0.5)
    ]
    return obeying or forced_frames(up, front)


def frames_of_part(model: TrainedModel, scan: Scan, config: FitConfig, wide: bool) -> list[Hypothesis]:
    """Core frames to try for a part, whose middle is not that of the whole, and which a vote seldom knows.

    Besides those of `frames_to_try`: all turns about the user's axes, or, if the search is to be ``wide``, about the
    axes of the file; each with several places of the core along the body.
    """
    frames = frames_to_try(model, scan, config)
    if model.card.frame["orientation"] in ALIGNS:
        return frames
    up, front = _axes(config)
    if up is not None or front is not None:
        return frames + _along(forced_frames(up, front))
    if not wide:
        return frames
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return frames + _along([frame for axis in axes for frame in forced_frames(axis, None, 8)])


def _along(frames: list[Hypothesis]) -> list[Hypothesis]:
    """Every frame with its origin at several places along its own up axis."""
    return [
        Hypothesis(frame.rotation, frame.center + apart * frame.rotation[:, 1], frame.votes)
        for frame in frames
        for apart in _ALONG
    ]


def _axes(config: FitConfig) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The user's up and front."""
    up = axis_vector(config.up) if config.up else None
    front = axis_vector(config.front) if config.front else None
    if up is not None and front is not None and abs(up @ front) > 0.5:
        raise OptionError("up and front lie along the same axis", "choose two different axes")
    return up, front
