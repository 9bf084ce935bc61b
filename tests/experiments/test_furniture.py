"""Generated chairs, tables and planes: watertight, of one piece, labelled, the same for the same seed."""

import numpy as np
import pytest

pytest.importorskip("skimage", reason="scikit-image is of the extra `bench`")

from meshmatch.errors import OptionError
from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.experiments.makers.furniture_solids import FLAT, Assembly, Rod, Slab, inside, plane
from meshmatch.geometry.triangles import face_parts, is_watertight

BALL = Rod(np.zeros((2, 3)), np.array([0.5, 0.5]))


def whole(*solids: Rod | Slab, fillet: float = 0.0) -> Assembly:
    return Assembly("test", ("one", "two"), tuple(enumerate(solids)), fillet)


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_are_watertight_of_one_piece_and_labelled(kind: str) -> None:
    seen = set()
    for number in range(6):
        made = furniture(kind, 0, number)
        shape = made.mesh(72)
        assert is_watertight(shape.faces)
        assert face_parts(shape.faces, shape.V).max() == 0
        parts = made.parts_at(shape.verts)
        assert {0, 1} <= set(parts) <= set(range(len(KINDS[kind])))
        assert volume(shape.verts, shape.faces) > 0
        seen.add(shape.V)
    assert len(seen) == 6


def volume(verts: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = verts[faces].transpose(1, 0, 2)
    return float((a * np.cross(b, c)).sum() / 6)


def test_the_same_seed_gives_the_same_shape() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    one, same = furniture("chair", 3, 7), furniture("chair", 3, 7)
    assert np.array_equal(one.field(points), same.field(points))
    for other in (furniture("chair", 3, 8), furniture("chair", 4, 7), furniture("table", 3, 7)):
        assert not np.array_equal(one.field(points), other.field(points))
    with pytest.raises(OptionError, match="unknown kind"):
        furniture("sofa", 0, 0)


def test_distances_of_a_ball_and_of_a_board() -> None:
    points = np.random.default_rng(1).normal(size=(300, 3))
    away = np.linalg.norm(points, axis=1) - 0.5
    assert np.abs(whole(BALL).field(points) - away).max() < 1e-12
    assert np.abs(whole(BALL).sdf(points) - away).max() < 2e-3
    board = Slab(np.zeros(3), FLAT, (1.0, 0.5), (0.1, 0.1), 20.0, edge=0.02)
    above = np.array([[0, 0.4, 0], [0.3, 0.1, 0.2], [0, 0, 0], [1.3, 0, 0]])
    assert np.allclose(whole(board).field(above), [0.3, 0, -0.1, 0.3], atol=0.002)
    assert np.allclose(whole(board).sdf(above), [0.3, 0, -0.1, 0.3], atol=0.01)


def test_a_union_is_round_where_solids_meet_and_knows_its_parts() -> None:
    post = Rod(np.array([[0.0, 0, 0], [0, 2, 0]]), np.array([0.2, 0.2]))
    sharp, soft = whole(BALL, post), whole(BALL, post, fillet=0.2)
    points = np.random.default_rng(2).normal(size=(500, 3))
    gap = sharp.field(points) - soft.field(points)
    assert gap.min() >= 0 and 0 < gap.max() <= 0.05 + 1e-12
    assert soft.parts_at(np.array([[0.5, 0, 0], [0, 2.0, 0]])).tolist() == [0, 1]
    where, normals, parts = soft.sample(500, np.random.default_rng(0))
    assert np.abs(soft.field(where)).max() < 0.03
    step = 0.02
    assert (soft.field(where + step * normals) > soft.field(where - step * normals)).all()
    assert set(parts) == {0, 1}


def test_boxes_hold_their_solids() -> None:
    slab = Slab(np.ones(3), plane([1, 1, 0], [0, 0, 1]), (1.0, 0.4), (0.1, 0.05), 6.0, 0.2, 0.05, 0.3, -0.5, 0.4)
    for solid in (slab, Rod(np.array([[0.0, 0, 0], [1, 2, 0.5]]), np.array([0.3, 0.1]))):
        low, high = solid.box
        points = np.random.default_rng(3).uniform(low - 1, high + 1, (4000, 3))
        held = points[solid.field(points) < 0]
        assert len(held) and (held >= low - 1e-9).all() and (held <= high + 1e-9).all()


def test_points_are_drawn_in_under_a_plate() -> None:
    plate = Slab(np.zeros(3), FLAT, (1.0, 0.5), (0.02, 0.02), 2.0)
    found = inside(np.array([[2.0, 7, 0], [0.1, 7, 0.1]]), plate, 0.8)
    assert np.allclose(found, [[0.8, 7, 0], [0.1, 7, 0.1]])
