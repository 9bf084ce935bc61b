"""Noise of meshes: it is found where it hides the surface, and smoothed away without the surface shrinking."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from meshmatch.shapes.denoise import coherence, remove_noise
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape


def ball(noise: float, splits: int = 4) -> Shape:
    mesh = trimesh.creation.icosphere(splits)
    steps = noise * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    return Shape(mesh.vertices + steps, np.asarray(mesh.faces), "ball")


def test_coherence() -> None:
    assert coherence(ball(0.0)) > 0.99
    assert 0.2 < coherence(ball(0.1)) < 0.5
    box = trimesh.creation.box()  # three faces at right angles around a corner
    assert coherence(Shape(box.vertices, box.faces)) == pytest.approx(3**-0.5, abs=0.1)


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_what_shows_the_surface_is_left(noise: float) -> None:
    shape = ball(noise)
    assert remove_noise(shape) == (shape, 0)
    assert repair(shape).shape is shape


def test_noise_is_smoothed_away() -> None:
    """Three times the area of the ball, and afterwards the ball's; the vertices keep their places around it."""
    shape = ball(0.12)
    assert shape.area > 2.5 * 4 * np.pi
    done = repair(shape)
    assert done.notes == (next(note for note in done.notes if note.startswith("smoothed")),)
    assert coherence(done.shape) >= 0.94
    assert done.shape.area == pytest.approx(4 * np.pi, rel=0.25)
    assert np.linalg.norm(done.shape.verts, axis=1).mean() == pytest.approx(1.0, abs=0.05)
    still = ball(0.0)
    off = cKDTree(still.verts).query(done.shape.verts)[0]
    assert off.mean() < 0.7 * cKDTree(still.verts).query(shape.verts)[0].mean()
    assert np.array_equal(done.original_to_repaired, np.arange(shape.V))


def test_plain_solids_keep_their_corners() -> None:
    box = trimesh.creation.box()
    many = [box.copy().apply_translation([3 * k, 0, 0]) for k in range(40)]
    joined = trimesh.util.concatenate(many)
    done = repair(Shape(joined.vertices, np.asarray(joined.faces)))
    assert np.array_equal(done.shape.verts, joined.vertices)


def test_a_large_plain_part_does_not_make_a_body_noisy() -> None:
    """Whose few corners have most of the area: a floor of a scan, a crate that somebody sits on."""
    body, crate = ball(0.0), trimesh.creation.box(extents=(9, 3, 9))
    verts = np.concatenate([body.verts, np.asarray(crate.vertices) - [0, 2.4, 0]])
    both = Shape(verts, np.concatenate([body.faces, np.asarray(crate.faces) + body.V]), "seated")
    assert repair(both).shape.V == both.V and not any("smoothed" in note for note in repair(both).notes)
    noisy = ball(0.12)
    both = Shape(np.concatenate([noisy.verts, verts[body.V :]]), both.faces, "noisy and seated")
    assert any("smoothed" in note for note in repair(both).notes)
