"""Repair: each fault by hand, and the one law: every original vertex has an answer, and it is the nearest."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.geometry.triangles import edges_of, is_watertight, same_rows, unit
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape


def join(*shapes: Shape, **more: object) -> Shape:
    offsets = np.cumsum([0, *[s.V for s in shapes]])
    faces = [s.faces + o for s, o in zip(shapes, offsets[:-1], strict=True)]
    return Shape(np.vstack([s.verts for s in shapes]), np.vstack(faces), "joined", **more)


def move(shape: Shape, by: object, scale: float = 1.0) -> Shape:
    return Shape(shape.verts * scale + np.asarray(by), shape.faces, shape.name)


def check_answers(original: Shape, done: Repaired) -> None:
    """Vertices are answered by the nearest repaired one, kept ones by themselves, faces by originals."""
    answer = done.original_to_repaired
    assert answer.shape == (original.V,)
    assert answer.min() >= 0
    assert answer.max() < done.shape.V
    np.testing.assert_array_equal(answer[done.kept_vertex], np.arange(done.shape.V))
    np.testing.assert_array_equal(done.shape.verts, original.verts[done.kept_vertex])
    assert (np.diff(done.kept_vertex) > 0).all()
    valid = np.ones(original.V, bool) if original.invalid is None else ~original.invalid
    found = np.linalg.norm(done.shape.verts[answer] - original.verts, axis=1)
    best = cKDTree(done.shape.verts).query(original.verts)[0]
    np.testing.assert_allclose(found[valid], best[valid], atol=1e-12)
    theirs = answer[original.faces[done.kept_face]]
    np.testing.assert_array_equal(np.sort(theirs, axis=1), np.sort(done.shape.faces, axis=1))


def test_fine_shape_is_returned_as_it_is(torus: Shape) -> None:
    done = repair(torus)
    assert done.shape is torus
    assert done.notes == ()
    np.testing.assert_array_equal(done.original_to_repaired, np.arange(torus.V))
    check_answers(torus, done)


def test_open_border_is_noted_and_left(torus: Shape) -> None:
    shape = Shape(torus.verts, torus.faces[1:])
    done = repair(shape)
    assert done.notes == ("3 open edges (the surface has holes or a border)",)
    np.testing.assert_array_equal(done.shape.faces, shape.faces)


def test_unused_vertices_are_dropped_and_answered(sphere: Shape) -> None:
    extra = np.array([[3.0, 0, 0], [0, 0, -2]])
    shape = Shape(np.vstack([extra[:1], sphere.verts, extra[1:]]), sphere.faces + 1)
    done = repair(shape)
    assert done.notes == ("2 vertices that no face uses dropped",)
    assert done.shape.V == sphere.V
    check_answers(shape, done)


def test_repeated_and_degenerate_faces_are_dropped(cube: Shape) -> None:
    flat = [[0, 0, 1], [5, 5, 5]]
    shape = Shape(cube.verts, np.vstack([cube.faces, flat, cube.faces[[3, 7]], cube.faces[[4], [[1, 2, 0]]]]))
    done = repair(shape)
    assert done.notes == ("2 faces without area dropped", "3 duplicate faces dropped")
    np.testing.assert_array_equal(done.shape.faces, cube.faces)
    check_answers(shape, done)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_sliver_without_height_is_dropped_at_any_scale(cube: Shape, scale: float) -> None:
    line = np.array([[2, 0, 0], [3, 1, 1], [4, 2, 2], [2.5, 0, 0.001]])
    verts = np.vstack([cube.verts, line]) * scale
    done = repair(Shape(verts, np.vstack([cube.faces, [[8, 9, 10], [8, 0, 11]]])))
    assert "1 face without area dropped" in done.notes
    assert done.shape.F == 13  # the thin one that has some height stays


def test_tiny_face_of_good_shape_is_kept(cube: Shape) -> None:
    tiny = cube.verts[0] + [[1e-7, 0, 0], [0, -1e-7, 0]]
    shape = Shape(np.vstack([cube.verts, tiny]), np.vstack([cube.faces, [[0, 8, 9]]]))
    assert repair(shape).shape.F == 13


def test_seams_are_merged_and_every_copy_answered(tmp_path: Path, torus: Shape) -> None:
    save_shape(tmp_path / "t.stl", torus)
    soup = load_shape(tmp_path / "t.stl")
    done = repair(soup)
    assert (done.shape.V, done.shape.F) == (torus.V, torus.F)
    assert is_watertight(done.shape.faces)
    assert done.notes == (f"{3 * torus.F - torus.V:,} vertices merged with another at the same position",)
    check_answers(soup, done)


def test_negative_zero_is_the_same_place() -> None:
    verts = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [0, 1, -0.0], [-1, 0, 0]]
    done = repair(Shape(verts, [[0, 1, 2], [3, 4, 5]]))
    assert done.shape.V == 4


def test_layers_that_merely_touch_stay_apart(cube: Shape) -> None:
    shape = join(cube, move(cube, [1, 1, 1]))  # they share the corner (1, 1, 1)
    done = repair(shape)
    assert done.shape.V == 16
    assert is_watertight(done.shape.faces)
    np.testing.assert_array_equal(done.original_to_repaired, np.arange(16))


def test_flap_is_removed_from_a_closed_surface(sphere: Shape) -> None:
    a, b, _ = sphere.faces[0]
    tip = sphere.V
    verts = np.vstack([sphere.verts, [[2, 2, 2]]])
    flap = [[a, b, tip], [a, tip, b]]  # twice the same triangle, either way round, standing on an edge
    shape = Shape(verts, np.vstack([sphere.faces, flap]))
    done = repair(shape)
    assert is_watertight(done.shape.faces)
    assert "2 duplicate faces dropped" in done.notes
    check_answers(shape, done)


def test_double_sided_sheet_keeps_one_side() -> None:
    verts = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    front = np.array([[0, 1, 2], [0, 2, 3]])
    done = repair(Shape(verts, np.vstack([front, front[:, ::-1]])))
    np.testing.assert_array_equal(done.shape.faces, front)
    assert done.shape.area == pytest.approx(1.0)


def test_small_stray_parts_are_dropped(sphere: Shape, make_sphere: Callable[[int], Shape]) -> None:
    crumb = make_sphere(0)
    shape = join(move(crumb, [0, 3, 0], 0.01), sphere, move(crumb, [0, 0, 5], 0.05))
    done = repair(shape)
    assert done.notes == ("2 outlier parts dropped (40 faces)",)
    assert done.shape.V == sphere.V
    assert done.far_parts == 0
    check_answers(shape, done)


def test_shape_made_of_small_parts_is_not_taken_apart(make_sphere: Callable[[int], Shape]) -> None:
    ball = make_sphere(1)
    golden = np.arange(60) * np.pi * (3 - 5**0.5)
    height = 1 - (np.arange(60) + 0.5) / 30
    ring = np.sqrt(1 - height**2)
    around = 1.12 * np.stack([ring * np.cos(golden), ring * np.sin(golden), height], axis=1)
    beads = [move(ball, p, 0.1) for p in around]  # each with 1 % of the ball's area, together 60 %
    done = repair(join(ball, *beads, move(ball, [3, 0, 0], 0.1)))
    assert done.notes == ("1 outlier part dropped (80 faces)", "61 separate parts kept")


def test_two_objects_in_one_file_are_kept_and_said(sphere: Shape) -> None:
    done = repair(join(sphere, move(sphere, [10, 0, 0], 0.8)))
    assert done.shape.V == 2 * sphere.V
    assert done.far_parts == 1
    assert done.notes[0] == "2 separate parts kept"
    assert done.notes[1].startswith("1 part of these lies far from the rest, 39% of the area")


def test_parts_in_a_row_are_one_object(sphere: Shape) -> None:
    done = repair(join(*[move(sphere, [2.1 * k, 0, 0]) for k in range(8)]))
    assert done.far_parts == 0
    assert done.notes == ("8 separate parts kept",)


def test_turned_faces_are_turned_back(torus: Shape) -> None:
    rng = np.random.default_rng(0)
    faces = torus.faces.copy()
    wrong = rng.random(torus.F) < 0.3
    faces[wrong] = faces[wrong][:, ::-1]
    done = repair(Shape(torus.verts, faces))
    np.testing.assert_allclose(unit(done.shape.face_vectors), unit(torus.face_vectors))
    assert done.notes == (f"{wrong.sum()} faces turned to face the same way as the others",)
    check_answers(Shape(torus.verts, faces), done)


def test_most_faces_turned_still_ends_outward(sphere: Shape) -> None:
    faces = sphere.faces.copy()
    faces[50:] = faces[50:][:, ::-1]
    done = repair(Shape(sphere.verts, faces))
    np.testing.assert_allclose(unit(done.shape.face_vectors), unit(sphere.face_vectors))


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_inside_out_shape_is_turned_as_a_whole(torus: Shape, shift: float) -> None:
    done = repair(Shape(torus.verts + shift, torus.faces[:, ::-1]))
    np.testing.assert_allclose(unit(done.shape.face_vectors), unit(torus.face_vectors), atol=1e-9)
    assert done.notes == ("turned all faces: the shape was inside out",)


def test_inner_wall_keeps_facing_inward(sphere: Shape) -> None:
    hollow = join(sphere, Shape(sphere.verts * 0.8, sphere.faces[:, ::-1]))
    assert repair(hollow).shape is not None
    np.testing.assert_array_equal(repair(hollow).shape.faces, hollow.faces)


def test_inner_wall_stays_when_the_outer_one_is_mended(sphere: Shape) -> None:
    hollow = join(sphere, Shape(sphere.verts * 0.8, sphere.faces[:, ::-1]))
    faces = hollow.faces.copy()
    faces[5] = faces[5][::-1]
    np.testing.assert_array_equal(repair(Shape(hollow.verts, faces)).shape.faces, hollow.faces)


def test_part_that_is_mostly_turned_ends_outward_beside_a_bigger_one(sphere: Shape) -> None:
    both = join(sphere, move(sphere, [2, 0, 0], 0.8))
    faces = both.faces.copy()
    faces[sphere.F + 50 :] = faces[sphere.F + 50 :][:, ::-1]
    np.testing.assert_allclose(unit(repair(Shape(both.verts, faces)).shape.face_vectors), unit(both.face_vectors))


def sheet(n: int = 12, bump: float = 0.0) -> Shape:
    x, y = np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n))
    z = bump * np.random.default_rng(0).normal(size=x.shape)
    a = np.arange(n * n).reshape(n, n)
    a, b, c, d = (q.ravel() for q in (a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1]))
    faces = np.vstack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Shape(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces)


@pytest.mark.parametrize("bump", [0.0, 1e-3])
def test_sheet_is_never_inside_out(bump: float) -> None:
    flat = sheet(bump=bump)
    for faces in (flat.faces, flat.faces[:, ::-1]):
        np.testing.assert_array_equal(repair(Shape(flat.verts, faces)).shape.faces, faces)


@pytest.mark.parametrize("wrong", [[0], [7], [0, 1, 2]])
def test_few_faces_of_a_sheet_are_turned_not_the_many(wrong: list[int]) -> None:
    faces = sheet().faces.copy()
    faces[wrong] = faces[wrong][:, ::-1]
    done = repair(Shape(sheet().verts, faces))
    np.testing.assert_allclose(unit(done.shape.face_vectors), unit(sheet().face_vectors))


@pytest.mark.parametrize("shift", [-100.0, 0.0, 100.0])
def test_open_cup_keeps_its_sides_wherever_it_stands(sphere: Shape, shift: float) -> None:
    cup = sphere.faces[sphere.verts[sphere.faces].mean(axis=1)[:, 2] > 0]
    done = repair(Shape(sphere.verts + np.array([0, 0, shift]), cup))
    np.testing.assert_allclose(unit(done.shape.face_vectors), unit(Shape(sphere.verts, cup).face_vectors), atol=1e-9)


def test_moebius_band_is_survived() -> None:
    n = 40
    t = np.arange(n) * 2 * np.pi / n
    rows = []
    for w in (-0.3, 0.3):
        r = 1 + w * np.cos(t / 2)
        rows.append(np.stack([r * np.cos(t), r * np.sin(t), w * np.sin(t / 2)], axis=1))
    a, b = np.arange(n), np.arange(n) + n
    c, d = np.append(a[1:], n), np.append(b[1:], 0)  # joined with a half turn
    shape = Shape(np.vstack(rows), np.vstack([np.stack([a, c, d], 1), np.stack([a, d, b], 1)]))
    done = repair(shape)
    assert done.shape.F == shape.F
    check_answers(shape, done)


def test_non_manifold_edges_are_said_and_left(cube: Shape) -> None:
    fin = Shape(np.vstack([cube.verts, [[0.5, 0.5, 3]]]), np.vstack([cube.faces, [[1, 3, 8]]]))
    done = repair(fin)
    assert done.shape.F == 13
    assert "1 non-manifold edge (more than two faces meet there), left as they are" in done.notes


def test_invalid_vertices_are_dropped_and_answered_by_a_neighbour(sphere: Shape) -> None:
    invalid = np.zeros(sphere.V + 1, bool)
    invalid[[7, 100, sphere.V]] = True
    verts = np.vstack([sphere.verts, [[0, 0, 0]]])
    verts[invalid] = 0.0
    shape = Shape(verts, sphere.faces, invalid=invalid)
    done = repair(shape)
    assert done.shape.V == sphere.V - 2
    assert done.shape.invalid is None
    assert done.notes[0] == "3 vertices without a usable position dropped"
    check_answers(shape, done)
    for vertex in (7, 100):
        ring = np.unique(sphere.faces[(sphere.faces == vertex).any(axis=1)])
        assert done.kept_vertex[done.original_to_repaired[vertex]] in ring[ring != vertex]
    assert done.kept_vertex[done.original_to_repaired[sphere.V]] == sphere.V - 1  # nearest in the file's order


def test_invalid_vertex_without_a_face_is_answered_in_file_order(cube: Shape) -> None:
    verts = np.insert(cube.verts, [3, 3, 3], 0.0, axis=0)  # numbers 3, 4 and 5
    invalid = np.isin(np.arange(11), [3, 4, 5])
    done = repair(Shape(verts, cube.faces + 3 * (cube.faces >= 3), invalid=invalid))
    np.testing.assert_array_equal(done.kept_vertex[done.original_to_repaired[[3, 5]]], [2, 6])


def test_nothing_left_is_an_input_error() -> None:
    line = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    with pytest.raises(InputError, match="no face with any area"):
        repair(Shape(line, [[0, 1, 2]]))
    with pytest.raises(InputError, match="no face with any area"):
        repair(Shape(line, [[0, 1, 2]], invalid=[True, False, False]))
    with pytest.raises(InputError, match="no vertex has a usable position"):
        repair(Shape(line, [], invalid=[True] * 3))


def test_one_triangle_is_a_shape() -> None:
    done = repair(Shape([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
    assert (done.shape.V, done.shape.F) == (3, 1)


def test_colors_follow_their_vertices(sphere: Shape) -> None:
    colors = np.random.default_rng(0).random((sphere.V + 1, 4))
    shape = Shape(np.vstack([[[9, 9, 9]], sphere.verts]), sphere.faces + 1, colors=colors)
    np.testing.assert_array_equal(repair(shape).shape.colors, colors[1:])


def test_cloud_loses_doubles_strays_and_nan(sphere: Shape) -> None:
    verts = np.vstack([sphere.verts, sphere.verts[:5], [[4, 0, 0]], [[0, 0, 0]]])
    invalid = np.zeros(len(verts), bool)
    invalid[-1] = True
    shape = Shape(verts, [], invalid=invalid)
    done = repair(shape)
    assert done.shape.is_cloud
    assert done.shape.V == sphere.V
    assert done.notes == (
        "1 vertex without a usable position dropped",
        "5 points merged with another at the same position",
        "1 outlier point far from all others dropped",
    )
    check_answers(shape, done)


def test_cloud_with_dense_and_thin_regions_keeps_all(sphere: Shape, torus: Shape) -> None:
    """Points that are merely further apart are no outliers."""
    rng = np.random.default_rng(0)
    u = rng.random(4000) ** 3  # density falls by a thousand along z
    angle = rng.random(4000) * 2 * np.pi
    points = np.stack([np.cos(angle), np.sin(angle), 4 * u], axis=1)
    assert repair(Shape(points, [])).shape.V >= 3995


def test_faces_are_answered_in_the_original_numbering(torus: Shape) -> None:
    """A point on a repaired face is the same point on the original one."""
    rng = np.random.default_rng(0)
    faces = torus.faces.copy()
    wrong = rng.random(torus.F) < 0.3
    faces[wrong] = faces[wrong][:, [1, 0, 2]]
    corners = torus.verts[faces].reshape(-1, 3)
    shape = Shape(
        np.vstack([[[0, 0, 9]], corners]), np.vstack([[[0, 0, 1]], np.arange(3 * torus.F).reshape(-1, 3) + 1])
    )
    done = repair(shape)
    face = rng.integers(done.shape.F, size=50)
    weights = rng.dirichlet(np.ones(3), 50)
    theirs, their_weights = done.original_face(face, weights)
    here = np.einsum("nk,nki->ni", weights, done.shape.verts[done.shape.faces[face]])
    there = np.einsum("nk,nki->ni", their_weights, shape.verts[shape.faces[theirs]])
    np.testing.assert_allclose(there, here, atol=1e-12)


def test_same_rows_against_the_slow_way() -> None:
    rng = np.random.default_rng(0)
    for rows in (rng.integers(0, 4, (300, 3)), rng.integers(0, 4, (300, 3)).astype(float), np.zeros((5, 3))):
        _, index, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        np.testing.assert_array_equal(same_rows(rows), index[inverse.ravel()])
    assert len(same_rows(np.zeros((0, 3)))) == 0


def test_same_rows_survives_a_collision(monkeypatch: pytest.MonkeyPatch) -> None:
    from meshmatch.geometry import triangles

    monkeypatch.setattr(triangles, "_hash", lambda rows: np.zeros(len(rows), np.uint64))
    rows = np.array([[2, 0, 0], [1, 0, 0], [2, 0, 0], [1, 0, 0]])
    np.testing.assert_array_equal(same_rows(rows), [0, 1, 0, 1])


def test_edges_by_hand(cube: Shape) -> None:
    assert edges_of(cube.faces).counts == (0, 0)
    assert len(edges_of(cube.faces).sizes) == 18
    assert not edges_of(cube.faces).disagreeing.any()
    turned = cube.faces.copy()
    turned[0] = turned[0][::-1]
    assert edges_of(turned).disagreeing.sum() == 3
    assert edges_of(cube.faces[:1]).counts == (3, 0)
    assert edges_of(np.array([[5, 2, 3], [2, 5, 9]])).open.tolist() == [[2, 3], [2, 9], [3, 5], [5, 9]]
    assert not is_watertight(cube.faces[1:])


def test_bench_shapes_are_repaired_and_answered(bench: Path) -> None:
    for name in ("shrec19/15.ply", "shrec19/31.ply", "faust_scans/test_scan_080.ply", "heart/heart02.ply"):
        shape = load_shape(bench / name)
        done = repair(shape)
        assert done.notes
        assert not edges_of(done.shape.faces).disagreeing.any() or "scan" in name
        np.testing.assert_array_equal(done.original_to_repaired[done.kept_vertex], np.arange(done.shape.V))
        moved = np.linalg.norm(done.shape.verts[done.original_to_repaired] - shape.verts, axis=1)
        assert moved.max() < 0.2 * shape.diagonal
    cow = load_shape(bench / "textured" / "spot_triangulated.obj")
    assert repair(cow).shape is cow
    rogue = repair(load_shape(bench / "textured" / "Rogue.glb"))
    assert rogue.shape.V < 3100  # of 5901: seams merged
