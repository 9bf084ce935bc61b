"""Strays, holes and tears in skin weights."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import joint_table
from meshmatch.transfer.clean_weights import clean_weights, find_uncovered, make_rigid
from tests.transfer.rigs import AROUND, tube, weights_of


@pytest.fixture
def good() -> np.ndarray:
    return weights_of(tube().verts[:, 1])


def cleaned(weights: np.ndarray, shape: Shape) -> np.ndarray:
    return clean_weights(csr_array(weights), shape).toarray()


def test_clean_weights_stay(good: np.ndarray) -> None:
    assert np.allclose(cleaned(good, tube()), good)


def test_a_stray_follows_what_is_around_it(good: np.ndarray) -> None:
    """Four neighbours near the bottom that go with the foot."""
    some = np.array([3, 4, 5]) * AROUND + 7
    torn = good.copy()
    torn[some] = [0, 0, 1]
    assert np.allclose(cleaned(torn, tube()), good, atol=1e-6)


def test_another_part_of_the_mesh_keeps_its_joint(good: np.ndarray) -> None:
    """An eye is small, and far from where most of the head's weights are."""
    shape = tube()
    eye = Shape(0.02 * shape.verts + [0, 0.1, 0.4], shape.faces)
    both = Shape(np.concatenate([shape.verts, eye.verts]), np.concatenate([shape.faces, eye.faces + shape.V]))
    weights = np.concatenate([good, np.tile([0.0, 0, 1], (eye.V, 1))])
    assert np.allclose(cleaned(weights, both), weights)


def test_holes_are_filled_from_their_surroundings(good: np.ndarray) -> None:
    holes = good.copy()
    holes[np.array([2, 3]) * AROUND + 3] = 0
    assert np.allclose(cleaned(holes, tube()), good, atol=1e-6)


def test_what_is_unknown_is_filled_from_its_surroundings(good: np.ndarray) -> None:
    shape, wrong = tube(), good.copy()
    unknown = shape.verts[:, 1] < 0.4
    wrong[unknown] = [0, 0, 1]  # too many for strays
    assert not np.allclose(cleaned(wrong, shape), good, atol=1e-6)
    assert np.allclose(clean_weights(csr_array(wrong), shape, unknown=unknown).toarray(), good, atol=1e-6)
    everything = np.ones(shape.V, bool)  # says nothing
    assert np.allclose(clean_weights(csr_array(good), shape, unknown=everything).toarray(), good, atol=1e-6)


def test_what_lies_off_the_source_s_surface() -> None:
    shape = tube()
    off = np.arange(shape.V) < AROUND
    target = Shape(shape.verts * np.where(off[:, None], [1.2, 1, 1.2], 1), shape.faces)
    assert np.array_equal(find_uncovered(target, shape.verts, shape.faces), off)
    assert not find_uncovered(target, 1.2 * shape.verts, shape.faces).any()  # a map that is off nearly everywhere


def test_a_part_without_weights_goes_with_the_nearest(good: np.ndarray) -> None:
    shape = tube()
    verts = np.concatenate([shape.verts, shape.verts + np.array([1.0, 0, 0])])
    both = Shape(verts, np.concatenate([shape.faces, shape.faces + shape.V]))
    weights = np.concatenate([good, np.zeros_like(good)])
    found = cleaned(weights, both)
    assert np.allclose(found.sum(axis=1), 1)
    assert found[shape.V :, 0].min() == 0 and found[shape.V + 1, 0] == 1


def test_tears_are_smoothed_and_seams_stay_closed() -> None:
    shape = tube()
    lower = shape.verts[:, 1] < 1
    hard = np.stack([lower, ~lower], axis=1).astype(float)
    found = cleaned(hard, shape)
    edges = shape.edges.vertices
    assert np.abs(hard[edges[:, 0]] - hard[edges[:, 1]]).sum(axis=1).max() == 2
    assert np.abs(found[edges[:, 0]] - found[edges[:, 1]]).sum(axis=1).max() < 1
    far = np.abs(shape.verts[:, 1] - 1) > 0.3
    assert np.array_equal(found[far], hard[far])
    # cut along the side: vertices at one place are two, with other weights each
    seam = np.arange(41) * AROUND
    twice = shape.faces.copy()
    right = (shape.verts[shape.faces].mean(axis=1)[:, 0] < 0)[:, None] & np.isin(twice, seam)
    twice[right] = shape.V + twice[right] // AROUND
    cut = Shape(np.concatenate([shape.verts, shape.verts[seam]]), twice)
    weights = np.concatenate([hard, hard[seam][::-1]])
    found = cleaned(weights, cut)
    assert np.allclose(found[seam], found[shape.V :])


def test_what_is_rigid_goes_with_one_joint(good: np.ndarray) -> None:
    group, nothing = np.arange(100, 400), np.zeros(0, np.int64)
    found = make_rigid(csr_array(good), [(group, nothing)]).toarray()
    assert np.array_equal(found[group], np.tile(np.eye(3)[good[group].sum(axis=0).argmax()], (300, 1)))
    beside = np.flatnonzero(good[:, 2] == 1)
    assert not np.isin(beside, group).any()
    assert np.array_equal(make_rigid(csr_array(good), [(group, beside)]).toarray()[group], np.tile([0, 0, 1], (300, 1)))
    assert np.array_equal(np.delete(found, group, 0), np.delete(good, group, 0))


def test_the_table_of_joints() -> None:
    joints, shares = joint_table(csr_array([[0.2, 0, 0.8], [0, 0, 0], [0, 1.0, 0]]))
    assert joints.tolist() == [[2, 0], [0, 0], [1, 0]]
    assert np.allclose(shares, [[0.8, 0.2], [0, 0], [1, 0]])
