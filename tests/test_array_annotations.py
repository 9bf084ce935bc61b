"""The check of array annotations sees what is wrong, and is on."""

from __future__ import annotations

import numpy as np
import pytest
from jaxtyping import TypeCheckError, jaxtyped

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import triangle_areas
from tests.array_annotations import checked


@jaxtyped(typechecker=checked)
def corners(
    verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], weights: Float[Floats, " V"] | None = None
) -> tuple[Float[Floats, "F 3 3"], int]:
    return (verts[faces] if len(faces) != 2 else verts), len(verts)


def test_sizes_and_types_are_checked_and_none_may_be_none() -> None:
    verts, faces = np.zeros((4, 3)), np.zeros((1, 3), int)
    corners(verts, faces)
    corners(verts, faces, np.zeros(4))
    for wrong in ((verts[:, :2], faces), (verts, faces.astype(float)), (verts, faces, np.zeros(5))):
        with pytest.raises(TypeCheckError, match="checking the parameters"):
            corners(*wrong)
    with pytest.raises(TypeCheckError, match="checking the return value"):
        corners(verts, np.zeros((2, 3), int))


def test_the_package_is_checked() -> None:
    with pytest.raises(TypeCheckError):
        triangle_areas(np.zeros((4, 2)), np.zeros((1, 3), np.int64))
