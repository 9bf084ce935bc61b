"""Meshes that a scene draws several times."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.api import results
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.copies import counterparts
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from tests.conftest import some_fit
from tests.transfer.rigs import tube

TURN = Rotation.from_euler("xyz", (20, 50, 70), degrees=True).as_matrix()


def scene(*moves: np.ndarray) -> Shape:
    """The tube as each of these matrices puts it, side by side, each a mesh of its own."""
    one = tube()
    verts = [one.verts @ move.T + [5.0 * k, 0, 0] for k, move in enumerate(moves)]
    faces = [(one.faces if np.linalg.det(move) > 0 else one.faces[:, ::-1]) + k * one.V for k, move in enumerate(moves)]
    meshes = tuple((f"tube {k}", one.V) for k in range(len(moves)))
    return Shape(np.concatenate(verts), np.concatenate(faces), "tubes.glb", meshes=meshes)


def lost(shape: Shape, *which: int) -> np.ndarray:
    return np.isin(np.arange(shape.V) // tube().V, which)


@pytest.mark.parametrize("move", [np.eye(3), 0.3 * TURN, TURN @ np.diag([-1.0, 1, 1])])
def test_a_copy_is_known_wherever_it_stands(move: np.ndarray) -> None:
    shape, V = scene(np.eye(3), move), tube().V
    np.testing.assert_array_equal(counterparts(shape, lost(shape, 1)), [*[-1] * V, *range(V)])
    np.testing.assert_array_equal(counterparts(shape, lost(shape, 0)), [*range(V, 2 * V), *[-1] * V])


def test_one_that_is_bent_is_no_copy() -> None:
    shape = scene(np.eye(3), np.eye(3))
    bent = shape.verts + np.where(lost(shape, 1)[:, None], np.square(shape.verts[:, 1:2]) * [0, 0, 0.1], 0)
    other = Shape(bent, shape.faces, meshes=shape.meshes)
    assert (counterparts(other, lost(other, 1)) == -1).all()


def test_a_shoe_is_no_copy_of_a_figure_in_two() -> None:
    """Two of three alike are kept, one is lost; of four, two: a pair in two places."""
    three, four = scene(*[np.eye(3)] * 3), scene(*[np.eye(3)] * 4)
    assert (counterparts(three, lost(three, 2)) == -1).all()
    V = tube().V
    np.testing.assert_array_equal(counterparts(four, lost(four, 2, 3))[2 * V :], np.arange(2 * V))


def test_counterparts_stand_for_what_was_left_out() -> None:
    shape = scene(np.eye(3), TURN)
    chosen = Shape(shape.verts, shape.faces, weights=1.0 * ~lost(shape, 1), meshes=shape.meshes)
    clean, V = repair(chosen), tube().V
    assert clean.copied is not None and np.array_equal(clean.copied, lost(shape, 1))
    np.testing.assert_array_equal(clean.original_to_repaired[V:], clean.original_to_repaired[:V])
    assert f"{V:,} vertices of copies elsewhere in the scene, matched like their originals" in clean.notes


def test_copies_have_the_images_of_their_original(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folds are removed from the image of the one that was fitted, and its copies follow."""
    shape, one = scene(np.eye(3), TURN), tube()
    V = one.V
    clean = repair(Shape(shape.verts, shape.faces, weights=1.0 * ~lost(shape, 1), meshes=shape.meshes))
    unfolded = np.random.default_rng(0).permutation(V)

    def unfold_pair(found: VertexMap, *_: object) -> tuple[VertexMap, VertexMap]:
        changed = VertexMap.between(shape, one, np.append(unfolded, found.index[V:]))
        return changed, VertexMap.between(one, shape, np.arange(V))

    monkeypatch.setattr(results, "unfold_pair", unfold_pair)
    fits = tuple(some_fit(one.verts, one.faces, repaired=part) for part in (clean, repair(one)))
    found, back = results.maps_of_fits(fits, fits, 1)
    np.testing.assert_array_equal(found.index, [*unfolded, *unfolded])
    assert back is not None and np.array_equal(back.index, np.arange(V))
