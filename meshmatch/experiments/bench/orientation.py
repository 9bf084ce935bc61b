"""The orientation of a shape, found by one model and told to a method that does not know it."""

from __future__ import annotations

from dataclasses import replace

from meshmatch.api.matching import Matcher
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.shape import Shape


def frame_by(model: str, shape: Shape, seed: int = 0) -> Frame:
    """The frame in which a model's unrefined fit sees a shape: area 1, upright (+y), facing forward (+z).

    `MeshmatchError` where there is no such model, or it cannot fit the shape.
    """
    return Matcher(model, FitConfig(refine="none", partial="no", seed=seed)).fit(shape).frame


def in_frame(shape: Shape, frame: Frame) -> Shape:
    """The same shape, vertex by vertex, in another frame than its file's."""
    return replace(shape, verts=frame.apply(shape.verts))


def upright(model: str, shape: Shape, seed: int = 0) -> Shape:
    """The same shape turned (and never mirrored) into the frame of a model's unrefined fit; errors as `frame_by`."""
    frame = frame_by(model, shape, seed)
    return in_frame(shape, replace(frame, rotation=frame.turn))
