"""Samples of a shape, in the frame in which fitting begins."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.shapes.cloud import outlier_points
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

# Template vertices and where they belong.
Landmarks = tuple[Int[Ints, " N"], Float[Floats, "N 3"]]

# How much further than its neighbours from theirs an outlier is from its own, see `outlier_points`. Set by hand.
_OUTLIER_RATIO = 1.3


def without_outliers(shape: Shape) -> Shape:
    """A cloud without the points that lie apart from their neighbours; any other shape as it is.

    An outlier among neighbours bends their normals and turns the signs of whole regions, and it counts as surface.
    """
    outlier = outlier_points(shape.verts, _OUTLIER_RATIO) if shape.is_cloud else np.zeros(0, bool)
    return Shape(shape.verts[~outlier], shape.faces, shape.name) if outlier.any() else shape


def draw(samples: OrientedPoints, count: int, rng: np.random.Generator) -> Int[Ints, " N"]:
    """Numbers of at most ``count`` different samples, drawn evenly, or by their weights if they have some."""
    share = None if samples.weights is None else samples.weights / samples.weights.sum()
    available = len(samples.points) if share is None else np.count_nonzero(share)
    return rng.choice(len(samples.points), min(count, available), replace=False, p=share)


def take_samples(
    shape: Shape, P: int, rng: np.random.Generator, frame: Frame | None = None
) -> tuple[Frame, OrientedPoints]:
    """A frame from a shape's file (by default to area 1, centroid 0), and P samples of the shape in that frame.

    The outliers of a cloud are not drawn; the normals of a cloud are not signed.
    """
    frame = sqrt_area_frame(shape) if frame is None else frame
    return frame, sample_surface(without_outliers(shape), P, rng).in_frame(frame)
