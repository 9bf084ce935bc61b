"""How thick a surface is: diameters of balls inside it that touch its vertices."""

import numpy as np

from meshmatch.geometry.inscribed import inscribed_diameters
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere


def test_a_ball_and_a_tube_are_as_thick_as_they_are(torus: Shape) -> None:
    ball = icosphere(3)
    found = inscribed_diameters(30.0 * ball.verts, ball.faces)
    assert (np.abs(found - 60.0) < 3.0).all()
    around = np.hypot(*torus.verts[:, :2].T) if np.ptp(torus.verts[:, 2]) < np.ptp(torus.verts[:, 0]) else None
    assert around is not None
    tube = np.ptp(torus.verts[:, 2])
    assert (np.abs(inscribed_diameters(torus.verts, torus.faces) - tube) < 0.1 * tube).all()


def test_of_two_ends_the_thin_one_is_thin() -> None:
    ball = icosphere(3)
    verts = ball.verts * [1.0, 0.2, 1.0]
    flat = np.abs(ball.verts[:, 1]) > 0.95
    assert np.abs(inscribed_diameters(verts, ball.faces)[flat] - 0.4).max() < 0.04


def test_a_sheet_and_loose_vertices_have_no_thickness() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5]])
    assert np.isnan(inscribed_diameters(corners, np.array([[0, 1, 2], [0, 2, 3]]))).all()
    assert np.isnan(inscribed_diameters(corners, np.empty((0, 3), np.int64))).all()
