"""Values, labels and weights carried by hand-made maps: the laws that any map keeps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array

from meshmatch.maps.mapped_mesh import invert_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import largest_weights, most_votes, pull_labels, pull_values, pull_weights
from tests.conftest import icosphere
from tests.transfer.known import split

COARSE = icosphere(1)
FINE, FORWARD, BACK = split(COARSE)


def random_map(seed: int) -> VertexMap:
    """Anywhere on the coarse sphere: in faces, on edges and on vertices."""
    rng = np.random.default_rng(seed)
    face = rng.integers(-1, COARSE.F, FINE.V)
    weights = rng.dirichlet([0.5] * 3, FINE.V)
    weights[rng.random(FINE.V) < 0.2] = (0, 1, 0)
    weights[face < 0] = (1, 0, 0)
    corner = COARSE.faces[face, weights.argmax(axis=1)]
    index = np.where(face < 0, rng.integers(0, COARSE.V, FINE.V), corner)
    return VertexMap.between(FINE, COARSE, index, face=face, barycentric=weights)


def test_by_hand() -> None:
    triangle = Shape(np.eye(3), np.array([[0, 1, 2]]), "t")
    back = VertexMap.between(
        Shape(np.eye(3)[:2], np.empty((0, 3), int)),
        triangle,
        np.array([2, 0]),
        face=np.array([0, -1]),
        barycentric=np.array([[0.2, 0.3, 0.5], [1, 0, 0]]),
    )
    assert back.sparse().toarray().tolist() == [[0.2, 0.3, 0.5], [1, 0, 0]]
    assert np.allclose(pull_values(back, np.array([10.0, 20, 40])), [28, 10])
    assert pull_labels(back, triangle, np.array([1, 1, 0])).tolist() == [0, 1]  # one half each: the lower
    assert pull_labels(back, triangle, np.array([0, 0, 1])).tolist() == [0, 0]
    assert pull_labels(back, triangle, np.array([-1, 3, -1])).tolist() == [3, -1]
    assert pull_labels(back, triangle, np.array([7]), on_faces=True).tolist() == [7, 7]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.floats(-1e6, 1e6, allow_subnormal=False))
def test_constants_stay_constant_and_values_between_their_ends(seed: int, constant: float) -> None:
    back = random_map(seed)
    same = pull_values(back, np.full((COARSE.V, 2), constant))
    assert np.allclose(same, constant, rtol=1e-12, atol=1e-300)
    values = np.random.default_rng(seed).normal(size=COARSE.V)
    carried = pull_values(back, values)
    assert values.min() - 1e-12 <= carried.min() <= carried.max() <= values.max() + 1e-12


def test_the_identity_carries_exactly(sphere: Shape) -> None:
    rng = np.random.default_rng(0)
    same = VertexMap.identity(sphere)
    values = rng.normal(size=(sphere.V, 3))
    assert np.array_equal(pull_values(same, values), values)
    labels = rng.integers(-1, 6, sphere.V)
    assert np.array_equal(pull_labels(same, sphere, labels), labels)
    weights = largest_weights(csr_array(rng.random((sphere.V, 9))), 4)
    assert abs(pull_weights(same, weights) - weights).max() < 1e-15


def test_linear_values_are_carried_exactly_to_a_finer_copy() -> None:
    back = invert_map(FORWARD, COARSE, FINE)
    assert np.abs(pull_values(back, COARSE.verts) - FINE.verts).max() < 1e-12
    whole = pull_values(BACK, np.arange(COARSE.V, dtype=np.int32))
    assert whole.dtype == np.float64 and np.array_equal(whole[: COARSE.V], np.arange(COARSE.V))


def test_values_that_are_missing_do_not_spread() -> None:
    values = COARSE.verts[:, 0].copy()
    values[3] = np.nan
    carried = pull_values(BACK, values)
    share = BACK.sparse().toarray()[:, 3]
    assert np.array_equal(np.isnan(carried), share > 0.5)
    clean = share == 0
    assert np.array_equal(carried[clean], pull_values(BACK, COARSE.verts[:, 0])[clean])
    assert (share == 0.5).any()  # the middle of an edge takes the end that is there
    assert np.isinf(values).sum() == 0


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.booleans())
def test_a_label_is_never_invented(seed: int, on_faces: bool) -> None:
    labels = np.random.default_rng(seed).choice([0, 3, 40], COARSE.F if on_faces else COARSE.V)
    found = pull_labels(random_map(seed), COARSE, labels, on_faces)
    assert set(found) <= {0, 3, 40}
    alone = pull_labels(random_map(seed), COARSE, np.full_like(labels, 5), on_faces)
    assert (alone == 5).all()


def test_a_vertex_takes_the_label_of_most_area_around_it() -> None:
    """Of the faces at a vertex one, the largest, has its own label."""
    verts = np.array([[0, 0, 0], [3, 0, 0], [3, 3, 0], [0, 0.5, 0], [-0.5, 0, 0]], float)
    fan = Shape(verts, np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4]]), "fan")
    back = VertexMap("", "", np.array([0]))
    assert fan.face_areas.argmax() == 0
    assert pull_labels(back, fan, np.array([2, 1, 1]), on_faces=True).tolist() == [2]


def test_labels_there_and_back_mostly_return(sphere: Shape) -> None:
    fine, forward, _ = split(sphere)
    labels = (sphere.verts[:, 0] * 4).astype(int) + 4
    there = pull_labels(invert_map(forward, sphere, fine), sphere, labels)
    _, _, down = split(sphere)
    home = pull_labels(invert_map(down, fine, sphere), fine, there)
    assert (home == labels).mean() > 0.99
    assert (there[sphere.V :] != labels[0]).any()


def test_equal_votes_go_to_the_lowest_label() -> None:
    votes = csr_array(np.array([[0, 0.3, 0.1 + 0.2], [0, 0, 0], [1, 0, 2]]))
    assert most_votes(votes).tolist() == [1, -1, 2]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 6))
def test_weights_stay_sparse_and_sum_to_one(seed: int, most: int) -> None:
    rng = np.random.default_rng(seed)
    weights = largest_weights(csr_array(rng.random((COARSE.V, 12)) * (rng.random((COARSE.V, 12)) < 0.4)), 12)
    bare = np.flatnonzero(np.diff(weights.indptr) == 0)
    carried = pull_weights(random_map(seed), weights, most)
    count, total = np.diff(carried.indptr), np.asarray(carried.sum(axis=1)).ravel()
    assert count.max() <= most
    assert np.allclose(total[count > 0], 1, atol=1e-12)
    assert (carried.data > 0).all()
    if not len(bare):
        assert (count > 0).all()


def test_the_heaviest_joints_are_kept() -> None:
    weights = csr_array(np.array([[0.1, 0.4, 0.2, 0.3], [0, 0, 0, 1.0], [0, 0, 0, 0]]))
    kept = largest_weights(weights, 2).toarray()
    assert np.allclose(kept, [[0, 4 / 7, 0, 3 / 7], [0, 0, 0, 1], [0, 0, 0, 0]])


@pytest.mark.parametrize(("share", "known"), [(0.6, True), (0.4, False), (0.1, False)])
def test_a_value_is_known_by_at_least_half_of_its_weight(share: float, known: bool) -> None:
    triangle = Shape(np.eye(3), np.array([[0, 1, 2]]), "t")
    point = Shape(np.zeros((1, 3)), np.empty((0, 3), int))
    back = VertexMap.between(point, triangle, [0], face=[0], barycentric=[[share, 1 - share, 0]])
    found = pull_values(back, np.array([7.0, np.nan, 1.0]))
    assert np.allclose(found, [7.0 if known else np.nan], equal_nan=True)
