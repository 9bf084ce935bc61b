"""A mesh that lies near a scan, on its surface."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.arrays import Floats
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.wrap import wrap_onto
from tests.conftest import icosphere
from tests.transfer.worn import LENGTH, RADIUS, bent, rod, tube


def waved(points: Floats) -> Floats:
    """Thicker and thinner along a rod."""
    size = 1 + 0.15 * np.sin(3 * np.pi * points[:, 1])
    return points * np.stack([size, np.ones_like(size), size], axis=1)


@pytest.fixture(scope="module")
def scan() -> Shape:
    fine = tube(RADIUS, LENGTH, 64, 161, "scan", closed=True)
    return replace(fine, verts=bent(waved(fine.verts)))


def none(shape: Shape) -> np.ndarray:
    return np.zeros(shape.V, bool)


def test_it_lies_on_the_scan_and_folds_nowhere(scan: Shape) -> None:
    base = rod()
    found = wrap_onto(base, bent(base.verts) + 0.01, scan, none(base))
    assert np.quantile(found.distance, 0.95) < 0.005 * RADIUS
    assert found.distance.max() < 0.05 * RADIUS
    # where each vertex should be, but for sliding along the surface
    assert np.linalg.norm(found.verts - bent(waved(base.verts)), axis=1).mean() < 0.1 * RADIUS
    before = replace(base, verts=bent(waved(base.verts)))
    after = replace(base, verts=found.verts)
    same = np.einsum("fi,fi->f", before.face_vectors, after.face_vectors)
    assert (same > 0).all()


def test_a_part_of_a_scan_leaves_the_rest_near(scan: Shape) -> None:
    """Of the upper half nothing was scanned: what belongs there is not drawn to the rim."""
    base = rod()
    half = replace(scan, faces=scan.faces[(scan.verts[scan.faces, 1] < 0).all(axis=1)])
    found = wrap_onto(base, bent(base.verts), half, none(base))
    upper = base.verts[:, 1] > 0.3
    assert np.linalg.norm(found.verts - bent(base.verts), axis=1)[upper].max() < 0.3 * RADIUS
    assert np.quantile(found.distance[base.verts[:, 1] < -0.1], 0.9) < 0.02 * RADIUS


def test_free_parts_keep_their_shape_and_follow(scan: Shape) -> None:
    """A ball inside of the rod, which nothing holds, and a patch of the rod itself."""
    body = rod()
    ball = icosphere(2)
    ball = replace(ball, verts=0.05 * ball.verts + [0.0, 0.5, 0.0])
    base = Shape(np.concatenate([body.verts, ball.verts]), np.concatenate([body.faces, ball.faces + body.V]), "base")
    free = np.arange(base.V) >= body.V
    found = wrap_onto(base, bent(base.verts), scan, free)
    inside = found.verts[body.V :]
    center = inside.mean(axis=0)
    radius = np.linalg.norm(inside - center, axis=1)
    assert np.ptp(radius) < 1e-6
    assert np.linalg.norm(center - bent(np.array([[0.0, 0.5, 0.0]]))) < 0.2 * RADIUS
    assert found.distance[: body.V].mean() < 0.01 * RADIUS
    without = wrap_onto(base, bent(base.verts), scan, none(base))
    assert np.ptp(np.linalg.norm(without.verts[body.V :] - center, axis=1)) > 1e-3
    # a patch that is free follows its surroundings, but not the surface
    patch = np.abs(body.verts[:, 1]) < 0.12
    patched = wrap_onto(body, bent(body.verts), scan, patch)
    assert patched.distance[~patch].mean() < 0.01 * RADIUS
    assert (
        patched.distance[patch].mean() > 2 * wrap_onto(body, bent(body.verts), scan, none(body)).distance[patch].mean()
    )


def test_a_cloud_can_be_wrapped(scan: Shape) -> None:
    base = rod()
    cloud = Shape(scan.verts, np.empty((0, 3), np.int64), "cloud")
    found = wrap_onto(base, bent(base.verts), cloud, none(base))
    assert np.quantile(found.distance, 0.95) < 0.15 * RADIUS
