"""The check of array annotations sees what is wrong, and is on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import triangle_areas
from tests.array_annotations import checked


@checked
def corners(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], weights: Float[Floats, " V"] | None = None
) -> tuple[Float[Floats, "F 3 3"], int]:
    return (verts[faces] if len(faces) != 2 else verts), len(verts)


@checked
def turned(
    rotations: Float[Floats, "*B 3 3"], points: Float[Floats, "*#B 3"], other: Any = None
) -> Float[Floats, "... 3"]:
    return np.zeros(4) if other else np.einsum("...ij,...j->...i", rotations, points)


def test_sizes_and_types_are_checked_and_none_may_be_none() -> None:
    verts, faces = np.zeros((4, 3)), np.zeros((1, 3), int)
    corners(verts, faces)
    corners(verts, faces=faces, weights=np.zeros(4))
    for wrong in ((verts[:, :2], faces), (verts, faces.astype(float)), (verts, faces, np.zeros(5)), (verts[0], faces)):
        with pytest.raises(TypeError, match="parameter"):
            corners(*wrong)
    with pytest.raises(TypeError, match="parameter weights"):
        corners(verts, faces, weights=np.zeros(5))
    with pytest.raises(TypeError, match="parameter verts"):
        corners(None, faces)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="the result"):
        corners(verts, np.zeros((2, 3), int))


def test_axes_of_any_number_agree_or_are_broadcast() -> None:
    rotations = np.zeros((5, 2, 3, 3))
    for fine in ((5, 2, 3), (1, 2, 3), (3,)):
        turned(rotations, np.zeros(fine))
    for wrong in ((4, 2, 3), (7, 5, 2, 3), (5, 2, 4)):
        with pytest.raises(TypeError, match="parameter points"):
            turned(rotations, np.zeros(wrong))
    with pytest.raises(TypeError, match="the result"):
        turned(rotations, np.zeros(3), other=1)


def test_the_package_is_checked() -> None:
    with pytest.raises(TypeError, match="parameter"):
        triangle_areas(np.zeros((4, 2)), np.zeros((1, 3), np.int64))
