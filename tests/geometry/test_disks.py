"""Pieces of surfaces laid flat: one to one, even, and found again."""

import numpy as np
import pytest
from scipy.spatial import Delaunay
from trimesh.creation import cylinder, icosphere

from meshmatch.arrays import Floats, Ints
from meshmatch.geometry.disks import Disk, _squared_stretch, edge_connected_patches, locate_points, mean_values

BALL = icosphere(4)


def turned(places: Floats, corners: Ints) -> float:
    a, b, c = (places[corners[:, k]] for k in range(3))
    first, second = b - a, c - a
    return float((first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] <= 0).mean())


def areas(points: Floats, corners: Ints) -> Floats:
    a, b, c = (np.pad(points, ((0, 0), (0, 3 - points.shape[1])))[corners[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def cap(height: float) -> Disk:
    """The ball above a height."""
    disk = Disk.of(BALL.faces, np.flatnonzero(BALL.vertices[BALL.faces, 2].min(axis=1) > height))
    assert disk is not None
    return disk


def test_a_triangle_without_area_on_either_side() -> None:
    """Three vertices at one place, held at one place: nothing is divided by nothing, which stopped the evening."""
    disk = cap(0.5)
    verts, a, at = BALL.vertices.copy(), disk.rim[0], disk.rim
    rim = np.column_stack([np.cos(angle := np.linspace(0, 2 * np.pi, len(at), endpoint=False)), np.sin(angle)])
    face = disk.corners[(disk.corners == a).any(axis=1)][0]
    verts[disk.vertices[face]] = verts[disk.vertices[a]]
    squared, turned_over = _squared_stretch(verts[disk.vertices], np.zeros((len(disk.vertices), 2)), disk.corners, 1.0)
    assert np.isfinite(squared).all() and turned_over.all()
    assert disk.laid_flat(verts, rim) is not None


@pytest.mark.parametrize("height", [0.5, 0.0, -0.8])
def test_no_triangle_turns_over_on_a_circle(height: float) -> None:
    disk = cap(height)
    places = disk.laid_flat(BALL.vertices)
    assert places is not None and turned(places, disk.corners) == 0
    np.testing.assert_allclose(np.linalg.norm(places[disk.rim], axis=1), np.linalg.norm(places[disk.rim[0]]))
    flat, own = areas(places, disk.corners), areas(BALL.vertices[disk.vertices], disk.corners)
    ratio = flat / own * own.sum() / flat.sum()
    assert np.quantile(ratio, 0.02) > 0.1  # without evening the pole of the largest has 0.01


def test_a_border_that_is_given_is_kept_clockwise_as_well() -> None:
    disk = cap(0.3)
    places = disk.laid_flat(BALL.vertices)
    assert places is not None
    mirrored = places[disk.rim] * [-1, 1]
    again = disk.laid_flat(BALL.vertices, mirrored, side=-1.0)
    assert again is not None
    np.testing.assert_array_equal(again[disk.rim], mirrored)
    assert turned(again * [-1, 1], disk.corners) == 0
    np.testing.assert_allclose(again * [-1, 1], places, atol=0.02)


def test_what_is_no_disk() -> None:
    assert Disk.of(BALL.faces, np.arange(len(BALL.faces))) is None  # closed
    tube = cylinder(1.0, 3.0, sections=24)
    side = np.flatnonzero(np.abs(tube.face_normals[:, 2]) < 0.5)
    assert Disk.of(tube.faces, side) is None  # two borders
    two = np.concatenate([np.flatnonzero(sign * BALL.vertices[BALL.faces, 2].min(axis=1) > 0.9) for sign in (1, -1)])
    assert Disk.of(BALL.faces, two) is None
    fan = np.array([[0, 1, 2], [0, 3, 4]])
    assert Disk.of(fan, np.arange(2)) is None  # they hang together at a point
    turned_back = np.array([[0, 1, 2], [0, 1, 3]])
    assert Disk.of(turned_back, np.arange(2)) is None  # neighbours that run different ways


def test_holes_are_closed_within_the_zone() -> None:
    middle = BALL.vertices[BALL.faces].mean(axis=1)
    ring, zone = (middle[:, 2] > 0.2) & (middle[:, 2] < 0.9), middle[:, 2] > 0.0
    (found,) = edge_connected_patches(BALL.faces, ring, zone)
    assert set(found) == set(np.flatnonzero(middle[:, 2] > 0.2))
    (alone,) = edge_connected_patches(BALL.faces, ring, ring)
    assert set(alone) == set(np.flatnonzero(ring))
    ends = np.abs(middle[:, 2]) > 0.9
    assert sorted(len(each) for each in edge_connected_patches(BALL.faces, ends, ends)) == [ends.sum() // 2] * 2
    assert edge_connected_patches(BALL.faces, np.zeros(len(middle), bool), np.zeros(len(middle), bool)) == []


def test_points_are_found_where_they_lie() -> None:
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(200, 2))
    corners = Delaunay(places).simplices
    weights = rng.dirichlet(np.ones(3), 100)
    face = rng.integers(0, len(corners), 100)
    points = (places[corners[face]] * weights[:, :, None]).sum(axis=1)
    found, at, inside = locate_points(places, corners, points)
    assert inside.all()
    assert not locate_points(places, corners, points + 2)[2].any()
    np.testing.assert_allclose((places[corners[found]] * at[:, :, None]).sum(axis=1), points, atol=1e-9)
    assert at.min() >= 0 and (found == face).mean() > 0.95


def test_means_of_neighbours_keep_what_is_flat() -> None:
    """Mean value coordinates reproduce linear functions, of triangles of any shape."""
    rng = np.random.default_rng(0)
    inner = rng.uniform(0.1, 0.9, (30, 2))
    places = np.concatenate([np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]]), inner])
    verts = np.column_stack([places, np.zeros(len(places))])
    weights = mean_values(verts, Delaunay(places).simplices)[4:]
    assert weights.data.min() > 0
    means = (weights @ verts) / weights.sum(axis=1)[:, None]
    np.testing.assert_allclose(means, verts[4:], atol=1e-9)


def test_vertices_at_one_place_are_laid_flat_as_well() -> None:
    """As files have them along seams: an edge without length, and triangles without area."""
    verts = BALL.vertices.copy()
    disk = cap(0.5)
    inner = np.setdiff1d(np.arange(len(disk.vertices)), disk.rim)
    first, second = disk.corners[np.isin(disk.corners, inner).all(axis=1)][0, :2]
    verts[disk.vertices[first]] = verts[disk.vertices[second]]
    places = disk.laid_flat(verts)
    assert places is not None and np.isfinite(places).all()
    assert turned(places, disk.corners) < 0.02
    assert disk.laid_flat(np.zeros_like(verts)) is None
