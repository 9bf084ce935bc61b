"""Labels of faces by a vote of the points in them."""

import numpy as np
import pytest

from meshmatch.maps.mapped_mesh import invert_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import lattice, pull_face_labels
from tests.conftest import icosphere
from tests.maps.solids import grid
from tests.transfer.known import split

COARSE = icosphere(2)
FINE, FORWARD, BACK = split(COARSE)


@pytest.mark.parametrize("rows", [1, 2, 4])
def test_the_points_of_a_face_are_spread_evenly(rows: int) -> None:
    points = lattice(rows)
    assert points.shape == (rows * rows, 3)
    assert np.allclose(points.sum(axis=1), 1)
    assert (points > 0).all()
    assert np.allclose(points.mean(axis=0), 1 / 3)
    assert len(np.unique(points.round(9), axis=0)) == rows * rows


def test_the_identity_carries_exactly_and_a_finer_copy_gets_each_face_four_times() -> None:
    labels = np.random.default_rng(0).integers(0, 7, COARSE.F)
    same = pull_face_labels(VertexMap.identity(COARSE), COARSE, COARSE, labels, on_faces=True)
    assert np.array_equal(same, labels)
    found = pull_face_labels(invert_map(FORWARD, COARSE, FINE), COARSE, FINE, labels, on_faces=True)
    assert np.array_equal(found, np.tile(labels, 4))


def test_a_coarser_copy_takes_the_vote_of_its_four_parts() -> None:
    """Three quarters of each face have one label, the middle has another that every corner misses."""
    labels = np.repeat([1, 1, 1, 0], COARSE.F)
    labels[:50] = 2  # and one part in four differs on some
    found = pull_face_labels(invert_map(BACK, FINE, COARSE), FINE, COARSE, labels, on_faces=True)
    assert (found == 1).all()


def test_a_large_face_asks_its_inside() -> None:
    """Its three corners agree, but most of it has another label."""
    n = 12
    sheet = grid(n, n)
    verts, faces = sheet.verts, sheet.faces
    ends = np.array([0, n, (n + 1) ** 2 - 1])
    large = Shape(verts[ends], np.array([[0, 1, 2]]), "large")
    labels = np.ones(sheet.V, int)
    near = np.linalg.norm(verts[:, None] - verts[ends], axis=2).min(axis=1) < 2.5
    labels[near] = 0
    back = VertexMap.between(large, sheet, ends)
    assert pull_face_labels(back, sheet, large, labels, on_faces=False).tolist() == [1]
    by_face = np.where(near[faces].any(axis=1), 0, 1)
    assert pull_face_labels(back, sheet, large, by_face, on_faces=True).tolist() == [1]


def test_labels_of_vertices_give_those_of_faces() -> None:
    labels = (COARSE.verts[:, 2] > 0).astype(int)
    found = pull_face_labels(VertexMap.identity(COARSE), COARSE, COARSE, labels, on_faces=False)
    votes = labels[COARSE.faces].sum(axis=1)
    assert np.array_equal(found, (votes >= 2).astype(int))


def test_a_cloud_labels_faces_too() -> None:
    points = Shape(COARSE.verts, np.empty((0, 3), int), "points")
    back = VertexMap.between(COARSE, points, np.arange(COARSE.V))
    labels = (COARSE.verts[:, 2] > 0).astype(int)
    found = pull_face_labels(back, points, COARSE, labels, on_faces=False)
    sure = np.abs(labels[COARSE.faces].sum(axis=1) - 1.5) > 1
    assert np.array_equal(found[sure], labels[COARSE.faces[sure, 0]])
    assert set(found) == {0, 1}


def test_a_torn_face_goes_with_its_corners(sphere: Shape) -> None:
    """Two of its corners lie together and one far off; the points between them belong to neither."""
    ring = np.unique(sphere.faces[(sphere.faces == 0).any(axis=1)])
    far = int(np.argmin(np.abs(sphere.verts @ sphere.verts[0] + 0.4)))
    index = np.arange(sphere.V)
    index[0] = far
    labels = np.full(sphere.V, 2)
    labels[ring], labels[far] = 0, 1
    back = VertexMap.between(sphere, sphere, index)
    found = pull_face_labels(back, sphere, sphere, labels, on_faces=False)
    assert (found[(sphere.faces == 0).any(axis=1)] == 0).all()


@pytest.mark.parametrize("on_faces", [False, True])
def test_what_has_no_label_stays_without(on_faces: bool) -> None:
    labels = np.full(COARSE.F if on_faces else COARSE.V, -1)
    found = pull_face_labels(VertexMap.identity(COARSE), COARSE, COARSE, labels, on_faces)
    assert (found == -1).all()
    labels[0] = 4
    some = pull_face_labels(VertexMap.identity(COARSE), COARSE, COARSE, labels, on_faces)
    assert set(some) == {-1, 4} if on_faces else {4} <= set(some) <= {-1, 4}
