"""A picture of a map: the source wears the colours of the places that it is matched to."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.colors import position_colors
from meshmatch.render.matched import carried_colors, render_match
from meshmatch.shapes.shape import Shape


def test_identity_carries_every_colour_to_its_place(cube: Shape) -> None:
    colors = position_colors(cube)
    assert np.array_equal(carried_colors(colors, VertexMap.identity(cube), cube), colors)


def test_colours_are_carried_from_target_to_source(cube: Shape) -> None:
    three = Shape(np.eye(3), np.array([[0, 1, 2]]), "three")
    colors = position_colors(cube)
    found = VertexMap.between(three, cube, [7, 0, 3])
    assert np.array_equal(carried_colors(colors, found, cube), colors[[7, 0, 3]])


def test_inside_a_face_colours_are_mixed(cube: Shape) -> None:
    one = Shape(np.array([[0.0, 0, 0]]), np.empty((0, 3), int), "one")
    weights = np.array([[0.5, 0.25, 0.25]])
    found = VertexMap.between(one, cube, [cube.faces[4, 0]], face=np.array([4]), barycentric=weights)
    colors = np.zeros((8, 3))
    colors[cube.faces[4]] = np.eye(3)
    assert np.allclose(carried_colors(colors, found, cube), weights)


def test_a_map_to_another_shape_is_refused(cube: Shape, sphere: Shape, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="leads to"):
        render_match(cube, sphere, VertexMap.identity(cube), tmp_path / "p.png")
    assert list(tmp_path.iterdir()) == []
