"""A mesh that rides on a fitted template."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.fitting.fit import Fit
from meshmatch.geometry.frames import Frame
from meshmatch.maps.footpoints import SurfaceBinding
from meshmatch.maps.places import Places
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere, some_fit

TURN = Rotation.from_euler("xyz", [20, 50, -30], degrees=True).as_matrix()
FRAME = Frame(2.5, TURN, np.array([7.0, -1, 4]))


def ball_fit(rider: Shape) -> Fit:
    """The unit sphere as the template, laid near a shape."""
    ball = icosphere(2)
    return some_fit(np.array(ball.verts), np.array(ball.faces), frame=FRAME, verts=rider.verts)


@pytest.fixture(scope="module")
def bumpy() -> Shape:
    """A sphere with bumps that the template does not have; two vertices at one place, one that no face uses, one nan."""
    ball = icosphere(3)
    rng = np.random.default_rng(0)
    verts = ball.verts * rng.uniform(0.95, 1.08, (ball.V, 1))
    verts = np.concatenate([verts, verts[:1], [[2.0, 0, 0], [0, 0, 0]]])
    faces = np.where(ball.faces == 0, np.where(np.arange(ball.F)[:, None] % 2, 0, ball.V), ball.faces)
    invalid = np.arange(len(verts)) == ball.V + 2
    colors = rng.uniform(0, 1, (len(verts), 4))
    return Shape(FRAME.undo(verts), faces, "bumpy", colors, invalid)


def turns(V: int, R: np.ndarray) -> np.ndarray:
    return np.repeat(R[None], V, 0)


def test_the_pose_of_the_fit_gives_back_the_shape(bumpy: Shape) -> None:
    fit = ball_fit(bumpy)
    own = Rotation.random(len(fit.points), random_state=np.random.default_rng(1)).as_matrix()
    rider = SurfaceBinding(repair(bumpy), fit, own)
    found = rider.shape(fit.frame.undo(rider.at(fit.points, own)), "again")
    assert np.abs(found.verts - bumpy.verts).max() < 1e-12 * bumpy.diagonal
    assert np.array_equal(found.faces, bumpy.faces)
    assert np.array_equal(found.colors, bumpy.colors)
    assert np.array_equal(found.invalid, bumpy.invalid)
    assert found.name == "again"


def test_it_goes_where_the_template_goes_and_turns_with_it(bumpy: Shape) -> None:
    fit = ball_fit(bumpy)
    V = len(fit.points)
    rider = SurfaceBinding(repair(bumpy), fit, turns(V, np.eye(3)))
    R, shift = Rotation.from_euler("y", 80, degrees=True).as_matrix(), np.array([0.3, 2, -1])
    found = rider.at(fit.points @ R.T + shift, turns(V, R))
    assert np.allclose(found, fit.frame.apply(bumpy.verts) @ R.T + shift)


def test_bumps_keep_their_height_where_the_template_grows(bumpy: Shape) -> None:
    fit = ball_fit(bumpy)
    rider = SurfaceBinding(repair(bumpy), fit, turns(len(fit.points), np.eye(3)))
    grown = rider.at(3 * fit.points, turns(len(fit.points), np.eye(3)))
    before = np.linalg.norm(fit.frame.apply(bumpy.verts[:642]), axis=1)
    # Facets of a sphere of 162 vertices lie up to 2 % below it, three times as much when it is three times as large.
    assert np.abs(np.linalg.norm(grown[:642], axis=1) - 2 - before).max() < 0.05


def test_twins_stay_together(bumpy: Shape) -> None:
    fit = ball_fit(bumpy)
    own = Rotation.random(len(fit.points), random_state=np.random.default_rng(2)).as_matrix()
    rider = SurfaceBinding(repair(bumpy), fit, turns(len(fit.points), np.eye(3)))
    found = rider.at(fit.points + 0.2 * own[:, 0], own)
    assert np.allclose(found[0], found[642])


def test_a_copy_goes_beside_what_it_is_a_copy_of(bumpy: Shape) -> None:
    """It belongs to the same places, and is as sure of them."""
    one = repair(bumpy).shape
    V, meshes = one.V, (("one", one.V), ("again", one.V))
    verts, faces = np.vstack([one.verts, one.verts + np.array([9.0, 0, 0])]), np.vstack([one.faces, one.faces + one.V])
    part = repair(Shape(verts, faces, weights=np.repeat([1.0, 0], V), meshes=meshes))
    fit = ball_fit(bumpy)
    places = Places.of(part, fit)
    np.testing.assert_array_equal(places.distance[V:], places.distance[:V])
    np.testing.assert_array_equal(places.stands[V:], places.stands[:V])
    rider = SurfaceBinding(part, fit, turns(len(fit.points), np.eye(3)))
    R = Rotation.from_euler("y", 80, degrees=True).as_matrix()
    found, before = rider.at(fit.points @ R.T, turns(len(fit.points), R)), fit.frame.apply(verts)
    np.testing.assert_allclose(found[:V], before[:V] @ R.T, atol=1e-12)
    np.testing.assert_allclose(found[V:] - found[:V], before[V:] - before[:V], atol=1e-12)
