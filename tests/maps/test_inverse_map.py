"""Maps turned round."""

from dataclasses import replace

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.maps.mapped_mesh import invert_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.conftest import icosphere
from tests.maps.solids import grid
from tests.transfer.known import split

COARSE = Shape(icosphere(1).verts, icosphere(1).faces, "coarse.ply")
FINE, FORWARD, BACK = split(COARSE, "fine.ply")


@pytest.fixture(scope="module")
def dancer() -> Shape:
    return load_shape(bundled_folder() / "samples" / "dancer.ply")


def test_the_identity_turned_round_is_the_identity(sphere: Shape) -> None:
    back = invert_map(VertexMap.identity(sphere), sphere, sphere)
    assert np.array_equal(back.index, np.arange(sphere.V))
    assert (back.confidence == 1).all()
    assert np.array_equal(back.points(sphere), sphere.verts)


def test_an_identity_written_with_faces_is_one_too(sphere: Shape) -> None:
    """The short cut for identities is not taken here: the search itself must find every vertex."""
    face = np.zeros(sphere.V, np.int64)
    face[sphere.faces[::-1].ravel()] = np.repeat(np.arange(sphere.F)[::-1], 3)
    weights = (sphere.faces[face] == np.arange(sphere.V)[:, None]).astype(float)
    written = VertexMap.between(sphere, sphere, np.arange(sphere.V), face=face, barycentric=weights)
    back = invert_map(written, sphere, sphere)
    assert np.array_equal(back.points(sphere), sphere.verts)
    assert (back.confidence == 1).all()


@pytest.mark.parametrize("coarse", ["sphere", "dancer"])
def test_a_finer_copy_finds_its_exact_places(coarse: str, dancer: Shape) -> None:
    shape = COARSE if coarse == "sphere" else dancer
    fine, forward, known = split(shape)
    back = invert_map(forward, shape, fine)
    assert np.abs(back.points(shape) - known.points(shape)).max() < 1e-9 * shape.diagonal
    assert back.confidence.min() > 0.999
    assert (back.source, back.target) == (fine.name, shape.name)
    assert (back.source_hash, back.target_hash) == (fine.hash, shape.hash)


def test_a_coarser_copy_takes_its_own_vertices() -> None:
    back = invert_map(BACK, FINE, COARSE)
    assert np.array_equal(back.index, np.arange(COARSE.V))
    assert np.abs(back.points(FINE) - COARSE.verts).max() < 1e-12


def test_where_vertices_pile_up_the_middle_one_is_taken(sphere: Shape) -> None:
    """A bare list of vertices puts a patch of a fine source on each vertex of a coarse target."""
    index = np.linalg.norm(sphere.verts[:, None] - COARSE.verts, axis=2).argmin(axis=1)
    back = invert_map(VertexMap("", "", index), sphere, COARSE)
    away = np.linalg.norm(back.points(sphere) - COARSE.verts, axis=1)
    patch = np.linalg.norm(sphere.verts - COARSE.verts[index], axis=1).max()
    assert patch > 0.25
    assert away.max() < 0.5 * patch


def test_what_nothing_maps_onto_has_no_confidence(sphere: Shape) -> None:
    upper = np.flatnonzero(sphere.verts[:, 2] > 0.1)
    kept = np.isin(sphere.faces, upper).all(axis=1)
    number = np.cumsum(np.isin(np.arange(sphere.V), upper)) - 1
    half = Shape(sphere.verts[upper], number[sphere.faces[kept]], "half")
    back = invert_map(VertexMap.between(half, sphere, upper), half, sphere)
    assert back.confidence[upper].min() > 0.999
    assert back.confidence[sphere.verts[:, 2] < -0.5].max() < 0.01
    assert np.array_equal(back.points(half)[upper], half.verts)


def test_a_triangle_torn_between_two_places_carries_nothing(torus: Shape) -> None:
    """One vertex mapped to the far side would stretch its triangles through the middle, past other vertices."""
    index = np.arange(torus.V)
    far = int(np.argmax(np.linalg.norm(torus.verts - torus.verts[0], axis=1)))
    index[0] = far
    back = invert_map(VertexMap.between(torus, torus, index), torus, torus)
    rest = np.setdiff1d(np.arange(torus.V), [0, far])
    assert np.array_equal(back.index[rest], rest)
    own = np.linalg.norm(back.points(torus)[0] - torus.verts[0])
    assert own < 0.2  # its neighbours' side of the tear, not the far one
    assert back.confidence[0] < 1


def shell(splits: int) -> Shape:
    """Two concentric spheres that face away from each other, a fiftieth of the radius apart."""
    ball = icosphere(splits)
    verts = np.concatenate([ball.verts, 0.98 * ball.verts])
    return Shape(verts, np.concatenate([ball.faces, ball.faces[:, ::-1] + ball.V]), f"shell{splits}")


def test_the_sheet_that_faces_the_same_way_wins() -> None:
    """Faces of a coarse source cut through both sheets: distance alone would choose the wrong one."""
    source, target = shell(1), shell(3)
    few, many = source.V // 2, target.V // 2
    index = np.concatenate([np.arange(few), many + np.arange(few)])  # a finer sphere begins with the coarser
    back = invert_map(VertexMap.between(source, target, index), source, target)
    assert ((back.index < few) == (np.arange(target.V) < many)).all()


def test_small_pieces_on_the_wrong_sheet_ask_their_neighbours() -> None:
    """A few vertices of a sheet lie on another sheet that faces the same way: their neighbours know better."""
    sheet = grid(8, 8, 1 / 8)
    half = sheet.V
    verts = np.concatenate([sheet.verts + np.array([0, 0, 2.0]), sheet.verts])
    source = Shape(verts, np.concatenate([sheet.faces, sheet.faces + half]), "two")  # both face up
    index = np.arange(source.V)
    # On the target the sheets nearly touch, and a dent brings one vertex of the upper down to the lower.
    flat = source.verts * [1, 1, 0.01]
    flat[40, 2] = 0.0
    target = Shape(flat, source.faces, "touching")
    back = invert_map(VertexMap.between(source, target, index, confidence=np.full(source.V, 0.99)), source, target)
    assert ((back.index < half) == (index < half)).all()


def test_clouds_take_the_nearest_mapped_point(sphere: Shape) -> None:
    points = Shape(sphere.verts, np.empty((0, 3), int), "points")
    some = np.arange(0, sphere.V, 2)
    fewer = Shape(sphere.verts[some], np.empty((0, 3), int), "fewer")
    back = invert_map(VertexMap.between(fewer, points, some), fewer, points)
    nearest = np.linalg.norm(points.verts[:, None] - fewer.verts, axis=2)
    assert np.allclose(np.linalg.norm(back.points(fewer) - points.verts, axis=1), nearest.min(axis=1))
    assert (back.face == -1).all()
    assert back.confidence.min() > 0.5  # gaps between points are no reason for doubt


def test_a_vertex_without_a_position_carries_no_confidence(sphere: Shape) -> None:
    invalid = np.zeros(sphere.V, bool)
    invalid[5] = True
    broken = Shape(sphere.verts, sphere.faces, "broken", None, invalid)
    forward = VertexMap.between(sphere, broken, np.arange(sphere.V))
    back = invert_map(forward, sphere, broken)
    assert back.confidence[5] == 0
    assert np.delete(back.confidence, 5).min() > 0.99


def test_verdict_reasons_and_low_confidence_are_carried_back() -> None:
    doubtful = replace(FORWARD, verdict="poor", reasons=("it is upside down",), confidence=np.full(COARSE.V, 0.6))
    back = invert_map(doubtful, COARSE, FINE)
    assert (back.verdict, back.reasons) == ("poor", ("it is upside down",))
    assert np.allclose(back.confidence, 0.6, atol=0.01)


def test_two_poses_of_one_mesh_are_told_apart_by_their_hashes() -> None:
    posed = Shape(COARSE.verts * [1, 2, 1], COARSE.faces, "posed.ply")
    there = VertexMap.between(COARSE, posed, np.arange(COARSE.V))
    assert there.for_shapes(COARSE, posed) is not None
    with pytest.raises(InputError, match=r"wrong way: from coarse\.ply to posed\.ply"):
        there.for_shapes(posed, COARSE)


def test_uncertain_vertices_do_not_count_among_several() -> None:
    """Three points in a row meet on one vertex: the middle one is a guess, so it is not the one in the middle."""
    none = np.empty((0, 3), int)
    row = Shape(np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0]]), none, "row")
    pair = Shape(np.array([[0.0, 0, 0], [5, 0, 0]]), none, "pair")
    for guess, chosen in ((0.1, 0), (1.0, 1)):
        forward = VertexMap.between(row, pair, [0, 0, 0, 1], confidence=[1.0, guess, 0.9, 1.0])
        assert invert_map(forward, row, pair).index.tolist() == [chosen, 3]
