"""What lies across from what: on a creature whose left half is known to be the mirror image of its right one."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import meshmatch
from meshmatch.api.symmetry import Symmetry
from meshmatch.fitting.search.planes import MirrorPlane, mirror_planes
from meshmatch.fitting.self_symmetry import mirror_image
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.mirror_images import mirrored

LIMBS = (((1, 0.3, 0.2), 0.9, 0.05), ((0.5, -1, 0.3), 1.2, 0.04), ((0, 0.7, 1), 0.8, 0.06))
BUMP = np.array([0.75, 0.2, -0.7]) / np.linalg.norm([0.75, 0.2, -0.7])
TURN, SIZE, MOVED = Rotation.from_euler("xyz", [0.4, -0.9, 1.3]), 50.0, np.array([30.0, -80.0, 12.0])
HEIGHT = 0.1


def radius(way: np.ndarray, bump: float = HEIGHT) -> np.ndarray:
    """Of the creature in some directions: the same across x = 0, but for a bump."""
    found = np.full(len(way), 0.6) + bump * np.exp(-(1 - way @ BUMP) / 0.03)
    for direction, length, width in LIMBS:
        for side in (1, -1) if direction[0] else (1,):
            unit = np.array(direction) * [side, 1, 1] / np.linalg.norm(direction)
            found += length * np.exp(-(1 - way @ unit) / width)
    return found


def creature() -> tuple[Shape, np.ndarray, np.ndarray]:
    """Turned, in a file of its own; where the counterpart of each vertex is; and the directions of the vertices."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    way = np.asarray(ball.vertices) @ Rotation.from_euler("z", 0.2).as_matrix()  # triangles are not symmetric
    across = way * [-1, 1, 1]
    place = [SIZE * TURN.apply(each * radius(each)[:, None]) + MOVED for each in (way, across)]
    return Shape(place[0], np.asarray(ball.faces), "creature"), place[1], way


@pytest.fixture(scope="module")
def found() -> Symmetry:
    return meshmatch.find_symmetry(creature()[0], threads=1)


def test_counterparts_lie_across_the_plane(found: Symmetry) -> None:
    shape, truth, _ = creature()
    arrived = found.map.apply(shape.verts)
    off = np.linalg.norm(arrived - truth, axis=1) / np.sqrt(shape.area)
    assert found.map.verdict == "good"
    assert off.mean() < 0.015 and np.quantile(off, 0.99) < 0.06
    normal = TURN.apply([1.0, 0, 0])
    assert abs(found.normal @ normal) > np.cos(np.radians(1))
    assert found.offset == pytest.approx(found.normal @ MOVED, abs=0.01 * SIZE)
    again = found.map.apply(arrived)
    assert np.linalg.norm(again - shape.verts, axis=1).mean() < 0.02 * np.sqrt(shape.area)  # what lies across from that


def test_what_is_not_symmetric_is_found_where_it_is(found: Symmetry) -> None:
    _, _, way = creature()
    bump, across = way @ BUMP > 0.99, way @ (BUMP * [-1, 1, 1]) > 0.99
    assert found.along_normal[bump].max() == pytest.approx(HEIGHT * SIZE, rel=0.3)
    assert found.along_normal[across].min() == pytest.approx(-HEIGHT * SIZE, rel=0.3)
    elsewhere = (way @ BUMP < 0.8) & (way @ (BUMP * [-1, 1, 1]) < 0.8)
    assert np.abs(found.along_normal[elsewhere]).mean() < 0.1 * HEIGHT * SIZE
    normals = creature()[0].vertex_normals
    assert np.allclose(np.einsum("vi,vi->v", found.displacement, normals), found.along_normal)


def test_clouds_are_refused() -> None:
    with pytest.raises(meshmatch.MeshmatchError, match="has no faces"):
        meshmatch.find_symmetry(Shape(creature()[0].verts, np.empty((0, 3), np.int64), "cloud"))


def test_planes_are_those_of_the_shape() -> None:
    shape = creature()[0]
    frame = sqrt_area_frame(shape)
    samples = sample_surface(Shape(frame.apply(shape.verts), shape.faces), 1500, np.random.default_rng(0))
    planes = mirror_planes(samples, 3)
    assert abs(planes[0].normal @ TURN.apply([1.0, 0, 0])) > np.cos(np.radians(2))
    assert [each.share for each in planes] == sorted((each.share for each in planes), reverse=True)
    assert planes[0].share > 1.2 * planes[1].share


def test_a_plane_is_found_between_mirror_images() -> None:
    plane = MirrorPlane(np.array([0.6, 0.8, 0.0]), 2.0)
    points = np.random.default_rng(1).normal(size=(20, 3))
    images = plane.reflect(points)
    assert np.allclose(plane.reflect(images), points)
    assert np.allclose(plane.turn(points), images - plane.reflect(np.zeros((1, 3))))
    again = MirrorPlane.between(points, images, np.ones(20))
    assert again.is_like(plane, np.cos(1e-4), 1e-9)
    assert cKDTree(again.reflect(points)).query(images)[0].max() < 1e-9


def test_mirror_images_keep_vertices_without_a_position() -> None:
    shape = Shape.with_invalid(np.array([[np.nan] * 3, [1, 0, 0], [0, 2, 0], [0, 0, 3]]), np.array([[1, 2, 3]]), "torn")
    plane = MirrorPlane(np.array([1.0, 0, 0]), 0.0)
    for image in (mirror_image(plane, shape), mirrored(shape)):
        np.testing.assert_array_equal(image.verts_or_nan, shape.verts_or_nan * [-1, 1, 1])
        np.testing.assert_array_equal(image.faces, [[3, 2, 1]])
