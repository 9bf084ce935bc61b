"""What is in doubt: left blank, filled in from the neighbours, or kept; and how much that is."""

import numpy as np
import pytest
from scipy.sparse import csr_array

from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import largest_weights
from meshmatch.transfer.low_confidence import (
    LowConfidence,
    diffuse,
    face_graph,
    nearest_known,
    replace_low_labels,
    replace_low_values,
    replace_low_weights,
    vertex_graph,
)
from tests.maps.solids import grid

SHEET = grid(4, 10)  # 5 rows of 11 vertices


def test_a_line_is_filled_with_what_lies_between() -> None:
    """Known at both ends, three unknown between them: the straight line."""
    pairs = np.array([[0, 1], [1, 2], [2, 3], [3, 4]])
    graph = csr_array((np.ones(8), np.concatenate([pairs, pairs[:, ::-1]]).T), shape=(5, 5))
    known = np.array([True, False, False, False, True])
    out, filled = diffuse(graph, known, np.array([[0.0], [9], [9], [9], [8]]))
    assert np.allclose(out.ravel(), [0, 2, 4, 6, 8])
    assert filled.tolist() == [False, True, True, True, False]


def test_nearer_neighbours_count_more() -> None:
    graph = csr_array(np.array([[0, 1.0, 0], [1.0, 0, 3.0], [0, 3.0, 0]]))
    out, _ = diffuse(graph, np.array([True, False, True]), np.array([[0.0], [0], [4]]))
    assert np.allclose(out.ravel(), [0, 1, 4])


def test_the_nearest_known_one_along_the_graph() -> None:
    graph = vertex_graph(SHEET)
    known = np.zeros(SHEET.V, bool)
    known[[0, 10]] = True
    nearest = nearest_known(graph, known)
    assert nearest[:5].tolist() == [0] * 5
    assert nearest[6:11].tolist() == [10] * 5
    assert set(nearest) == {0, 10}


def test_what_is_out_of_reach_stays() -> None:
    two = Shape(np.concatenate([SHEET.verts, SHEET.verts + 100]), np.concatenate([SHEET.faces, SHEET.faces + SHEET.V]))
    known = np.arange(two.V) < 5
    out, filled = diffuse(vertex_graph(two), known, np.arange(two.V, dtype=float)[:, None])
    assert filled.sum() == SHEET.V - 5
    assert np.array_equal(out[SHEET.V :, 0], np.arange(SHEET.V, two.V))
    assert (nearest_known(vertex_graph(two), np.zeros(two.V, bool)) == -1).all()


def test_a_seam_is_no_border() -> None:
    """Two sheets that meet along vertices at the same places, as a texture seam leaves them."""
    left, right = grid(2, 3), grid(2, 3)
    verts = np.concatenate([left.verts, right.verts + np.array([3, 0, 0])])
    both = Shape(verts, np.concatenate([left.faces, right.faces + left.V]))
    known = np.arange(both.V) < left.V
    assert (nearest_known(vertex_graph(both), known) >= 0).all()
    of_faces = nearest_known(face_graph(both), np.arange(both.F) < left.F)
    assert (of_faces >= 0).all()


def test_faces_are_neighbours_across_edges() -> None:
    graph = face_graph(SHEET).toarray() > 0
    for i, j in zip(*np.nonzero(graph), strict=True):
        assert len(set(SHEET.faces[i]) & set(SHEET.faces[j])) == 2
    assert graph.sum() == 2 * (3 * SHEET.F - 2 * (4 + 10)) / 2


def test_a_cloud_has_neighbours_too() -> None:
    cloud = Shape(SHEET.verts, np.empty((0, 3), int))
    known = SHEET.verts[:, 0] < 3
    out, filled = diffuse(vertex_graph(cloud), known, np.where(known, 5.0, 0.0)[:, None])
    assert np.allclose(out, 5)
    assert filled.sum() == (~known).sum()


def test_filling_is_smooth_and_keeps_what_is_sure() -> None:
    truth = SHEET.verts[:, 0]
    confidence = np.where((truth > 2) & (truth < 8), 0.1, 0.9)
    spoiled = np.where(confidence < 0.5, -50.0, truth)
    out, doubt = replace_low_values(spoiled, confidence < 0.5, SHEET, fill=True)
    assert doubt == LowConfidence(SHEET.V, 25, 0, 25)
    assert np.array_equal(out[confidence > 0.5], truth[confidence > 0.5])
    assert np.abs(out - truth).max() < 0.8
    assert (np.diff(out.reshape(5, 11), axis=1) > 0.5).all()
    assert out.shape == truth.shape


@pytest.mark.parametrize(("blank", "shown"), [(np.nan, np.nan), (-7.0, -7.0)])
def test_blank_values(blank: float, shown: float) -> None:
    confidence = np.where(np.arange(SHEET.V) < 4, 0.0, 1.0)
    out, doubt = replace_low_values(SHEET.verts, confidence < 0.3, SHEET, blank=blank)
    assert doubt == LowConfidence(SHEET.V, 4, 4, 0)
    assert np.array_equal(out[:4], np.full((4, 3), shown), equal_nan=True)
    assert np.array_equal(out[4:], SHEET.verts[4:])


def test_values_are_kept_if_nothing_is_asked_for() -> None:
    out, doubt = replace_low_values(SHEET.verts, np.zeros(SHEET.V) < 0.3, SHEET)
    assert np.array_equal(out, SHEET.verts)
    assert doubt == LowConfidence(SHEET.V, SHEET.V)


@pytest.mark.parametrize("fill", [False, True])
def test_what_one_column_lacks_says_nothing_of_the_others(fill: bool) -> None:
    values = SHEET.verts.copy()
    values[::3, 1], values[:, 2] = np.nan, np.nan
    low = np.arange(SHEET.V) == 7
    out, doubt = replace_low_values(values, low, SHEET, None if fill else -1.0, fill)
    assert np.array_equal(out[~low, 0], SHEET.verts[~low, 0])
    known = ~low & (np.arange(SHEET.V) % 3 > 0)
    assert np.array_equal(out[known, 1], SHEET.verts[known, 1]) and np.isfinite(out[:, 1]).all()
    if fill:
        assert abs(out[7, 0] - SHEET.verts[7, 0]) < 0.5 and np.isnan(out[:, 2]).all()
        assert doubt.filled == (~known).sum()
    else:
        assert (out[~known, 1] == -1).all() and (out[:, 2] == -1).all() and out[7, 0] == -1
    assert doubt.low == SHEET.V


def test_labels_are_filled_by_the_nearest_never_by_a_mean() -> None:
    labels = np.where(SHEET.verts[:, 0] < 5, 0, 6)
    confidence = np.where(np.abs(SHEET.verts[:, 0] - 5) < 2, 0.0, 1.0)
    spoiled = np.where(confidence > 0, labels, 3)
    out, doubt = replace_low_labels(spoiled, confidence < 0.3, SHEET, blank=False, fill=True, on_faces=False)
    assert set(out) == {0, 6}
    sure = SHEET.verts[:, 0] != 5
    assert np.array_equal(out[sure], labels[sure])
    assert doubt.filled == doubt.low == 15


def test_labels_of_faces_are_filled_across_edges() -> None:
    middle = SHEET.verts[SHEET.faces].mean(axis=1)
    labels = np.where(middle[:, 1] < 2, 0, 1)
    confidence = np.where(np.abs(middle[:, 0] - 5) < 0.5, 0.0, 1.0)
    spoiled = np.where(confidence > 0, labels, 9)
    out, _ = replace_low_labels(spoiled, confidence < 0.3, SHEET, blank=False, fill=True, on_faces=True)
    assert np.array_equal(out, labels)


def test_blank_labels_and_kept_ones() -> None:
    labels = np.array([0, 1, -1, 0] + [0] * (SHEET.V - 4))
    confidence = np.array([0.0, 1, 1, 1] + [1] * (SHEET.V - 4))
    out, doubt = replace_low_labels(labels, confidence < 0.3, SHEET, blank=True, fill=False, on_faces=False)
    assert out[:4].tolist() == [-1, 1, -1, 0]
    assert doubt == LowConfidence(SHEET.V, 2, 2, 0)
    out, doubt = replace_low_labels(labels, confidence < 0.3, SHEET, blank=False, fill=False, on_faces=False)
    assert np.array_equal(out, labels)
    assert doubt == LowConfidence(SHEET.V, 2, 1, 0)


def test_weights_are_filled_and_still_sum_to_one() -> None:
    rng = np.random.default_rng(0)
    weights = largest_weights(csr_array(rng.random((SHEET.V, 6))), 4)
    confidence = np.where(SHEET.verts[:, 0] > 6, 0.0, 1.0)
    out, doubt = replace_low_weights(weights, confidence < 0.3, SHEET, True, 3)
    assert doubt.filled == doubt.low == 20
    assert np.diff(out.indptr).max() <= 4
    low = confidence == 0
    assert np.diff(out.indptr)[low].max() <= 3
    assert np.allclose(np.asarray(out.sum(axis=1)), 1)
    same = replace_low_weights(weights, confidence < 0.3, SHEET, False, 3)
    assert same[0] is weights
    assert same[1] == LowConfidence(SHEET.V, 20)


def test_vertices_without_weights_get_their_neighbours() -> None:
    dense = np.zeros((SHEET.V, 2))
    dense[:, 1] = 1
    dense[13] = 0
    out, doubt = replace_low_weights(csr_array(dense), np.ones(SHEET.V) < 0.3, SHEET, True, 4)
    assert doubt == LowConfidence(SHEET.V, 1, 0, 1)
    assert np.allclose(out.toarray(), [[0, 1]] * SHEET.V)


def test_what_is_filled_in_lies_between_what_is_known_to_the_last_bit() -> None:
    """Colors must stay within 0..1, and labels' shares too: the solver alone ends a rounding error beyond."""
    sheet = grid(4, 40)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        bent = Shape(sheet.verts + rng.uniform(-0.45, 0.45, sheet.verts.shape) * [1, 1, 0], sheet.faces)
        known = rng.random(sheet.V) < 0.5
        values = np.where(sheet.verts[:, :1] < 20, 0.1, 0.7)
        out, filled = diffuse(vertex_graph(bent), known, values)
        assert 0.1 <= out[filled].min() <= out[filled].max() <= 0.7
