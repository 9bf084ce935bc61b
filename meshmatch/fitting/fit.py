"""The noun of this room: a template laid on one shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.geometry.frames import Frame
from meshmatch.shapes.repair import Repaired

# Mean two-way residual (units of sqrt(area)) up to which a fit is called good, and fair.
GOOD_RESIDUAL = 0.0285
FAIR_RESIDUAL = 0.031


@dataclass(frozen=True, eq=False)
class Fit:
    """A template moved onto one shape.

    Attributes
    ----------
    template_hash : str
        Which template: fits of two templates cannot be joined.
    frame : Frame
        From the shape's file to the core frame (template's orientation, area about 1).
    points : float64 array (V, 3)
        Template vertices (low resolution) on the shape, core frame.
    vectors : float64 array (K, 3)
        Node vectors, core frame.
    resting : float64 array (V, 3)
        The same vertices on the resting template, template frame.
    faces : int64 array (F, 3)
        The template's triangles.
    residual : float
        Mean normal-compatible distance between template and shape, both ways, in units of sqrt(area).
    vertex_distance : float64 array (V_shape,)
        Distance of every vertex of the shape to the template's surface, same unit.
    verdict : "good", "fair" or "poor"
    reasons : tuple of str
        What the verdict rests on where it is not good.
    up, front : str
        The axes of the file that the fit took for up and front, such as "+y" and "-z".
    seconds : float
    seed : int
    partial : bool
        The shape was taken for a part: the residual is from the shape to the template only.
    repaired : Repaired, optional
        The shape itself, with the way back to the vertices of its file.
    notes : tuple of str
        What was changed in the shape before fitting, and which choices were replaced.
    """

    template_hash: str
    frame: Frame
    points: np.ndarray
    vectors: np.ndarray
    resting: np.ndarray
    faces: np.ndarray
    residual: float
    vertex_distance: np.ndarray
    verdict: str
    reasons: tuple[str, ...]
    up: str
    front: str
    seconds: float
    seed: int
    partial: bool = False
    repaired: Repaired | None = None
    notes: tuple[str, ...] = ()

    @property
    def points_in_file(self) -> np.ndarray:
        """Template vertices (V, 3) in the frame and unit of the shape's file."""
        return self.frame.undo(self.points)


def axis_name(direction: np.ndarray) -> str:
    """The signed axis nearest to a direction (3,), such as "+y"."""
    axis = int(np.abs(direction).argmax())
    return ("+" if direction[axis] > 0 else "-") + "xyz"[axis]
