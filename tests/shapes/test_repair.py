"""Repair: each fault by hand, and the one law: every original vertex has an answer, and it is the nearest."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.geometry.triangles import edges_of, is_watertight, normalized, same_rows
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.repair import Repaired, oriented_outwards, repair
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.transfer.rigs import write_tube


def join(*shapes: Shape, **more: object) -> Shape:
    offsets = np.cumsum([0, *[s.V for s in shapes]])
    faces = [s.faces + o for s, o in zip(shapes, offsets[:-1], strict=True)]
    return Shape(np.vstack([s.verts for s in shapes]), np.vstack(faces), "joined", **more)


def move(shape: Shape, by: object, scale: float = 1.0) -> Shape:
    return Shape(shape.verts * scale + np.asarray(by), shape.faces, shape.name)


def box() -> Shape:
    made = trimesh.creation.box(bounds=[[0, 0, 0], [1, 1, 1]])
    return Shape(made.vertices, made.faces)


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


Fault = tuple[Shape, tuple[int, int], tuple[str, ...]]


def faults() -> dict[str, Fault]:
    """Shapes, the vertices and faces that are left of them, and what is said."""
    ball, cube = icosphere(2), box()
    a, b, _ = ball.faces[0]
    flap = [[a, b, ball.V], [a, ball.V, b]]  # twice the same triangle, either way round, standing on an edge
    many = [[0, 0, 1], [5, 5, 5], *cube.faces[[3, 7]], *cube.faces[[4], [[1, 2, 0]]]]
    front = np.array([[0, 1, 2], [0, 2, 3]])
    tiny = cube.verts[0] + [[1e-7, 0, 0], [0, -1e-7, 0]]
    zeros = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [0, 1, -0.0], [-1, 0, 0]]
    crumb, three_open = icosphere(0), "3 open edges (the surface has holes or a border)"
    return {
        "open border": (Shape(ball.verts, ball.faces[1:]), (ball.V, ball.F - 1), (three_open,)),
        "unused vertices": (
            Shape(np.vstack([[[3.0, 0, 0]], ball.verts, [[0, 0, -2]]]), ball.faces + 1),
            (ball.V, ball.F),
            ("2 vertices that no face uses dropped",),
        ),
        "flat and repeated faces": (
            Shape(cube.verts, np.vstack([cube.faces, many])),
            (8, 12),
            ("2 faces without area dropped", "3 duplicate faces dropped"),
        ),
        "one corner in common": (join(cube, move(cube, [1, 1, 1])), (16, 24), ("2 separate parts kept",)),
        "a flap": (
            Shape(np.vstack([ball.verts, [[1.2, 1.2, 1.2]]]), np.vstack([ball.faces, flap])),
            (ball.V, ball.F),
            ("2 duplicate faces dropped",),
        ),
        "a sheet of two sides": (
            Shape([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.vstack([front, front[:, ::-1]])),
            (4, 2),
            ("2 duplicate faces dropped", "4 open edges"),
        ),
        "stray parts": (
            join(move(crumb, [0, 3, 0], 0.01), ball, move(crumb, [0, 0, 5], 0.05)),
            (ball.V, ball.F),
            ("2 outlier parts dropped (40 faces)",),
        ),
        "two objects": (
            join(ball, move(ball, [10, 0, 0], 0.8)),
            (2 * ball.V, 2 * ball.F),
            ("2 separate parts kept", "1 part of these lies far from the rest, 39% of the area"),
        ),
        "parts in a row": (
            join(*[move(crumb, [2.1 * k, 0, 0]) for k in range(8)]),
            (8 * crumb.V, 8 * crumb.F),
            ("8 separate parts kept",),
        ),
        "a fin": (
            Shape(np.vstack([cube.verts, [[0.5, 0.5, 3]]]), np.vstack([cube.faces, [[1, 3, 8]]])),
            (9, 13),
            ("2 open edges", "1 non-manifold edge (more than two faces meet there), left as they are"),
        ),
        "one triangle": (Shape(np.eye(3), [[0, 1, 2]]), (3, 1), (three_open,)),
        "negative zeros": (Shape(zeros, [[0, 1, 2], [3, 4, 5]]), (4, 2), ("2 vertices merged", "4 open edges")),
        "a tiny face": (Shape(np.vstack([cube.verts, tiny]), [*cube.faces, [0, 8, 9]]), (10, 13), ("3 open edges",)),
    }


@pytest.mark.parametrize("case", faults())
def test_what_is_wrong_is_dropped_and_said(case: str) -> None:
    shape, (V, F), notes = faults()[case]
    done = repair(shape)
    assert (done.shape.V, done.shape.F) == (V, F)
    assert len(done.notes) == len(notes)
    assert all(said.startswith(note) for said, note in zip(done.notes, notes, strict=True))
    assert done.far_parts == (case == "two objects")
    check_answers(shape, done)


def sheet(bump: float = 0.0) -> Shape:
    x, y = np.meshgrid(np.linspace(0, 1, 12), np.linspace(0, 1, 12))
    z = bump * np.random.default_rng(0).normal(size=x.shape)
    a = np.arange(144).reshape(12, 12)
    a, b, c, d = (q.ravel() for q in (a[:-1, :-1], a[:-1, 1:], a[1:, 1:], a[1:, :-1]))
    faces = np.vstack([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Shape(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces)


def turns() -> dict[str, tuple[Shape, object]]:
    """Shapes as they should be, and which of their faces are turned round."""
    ball, flat = icosphere(2), sheet()
    hollow = join(ball, Shape(ball.verts * 0.8, ball.faces[:, ::-1]))
    both = join(ball, move(ball, [2, 0, 0], 0.8))
    cup = Shape(ball.verts, ball.faces[ball.verts[ball.faces].mean(axis=1)[:, 2] > 0])
    return {
        "some": (ball, np.random.default_rng(0).random(ball.F) < 0.3),
        "most": (ball, slice(50, None)),
        "all": (ball, slice(None)),
        "all, far away": (move(ball, [100, 100, 100]), slice(None)),
        "of an inner wall none": (hollow, []),
        "one of an outer wall": (hollow, [5]),
        "most of a smaller part": (both, slice(ball.F + 50, None)),
        "of a sheet none": (flat, []),
        "of the other side none": (Shape(flat.verts, flat.faces[:, ::-1]), []),
        "of a rough sheet none": (sheet(1e-3), []),
        "of a bent sheet none": (Shape(flat.verts + 0.5 * flat.verts[:, :1] ** 2 * [0.0, 0, 1], flat.faces), []),
        "one of a sheet": (flat, [7]),
        "three of a sheet": (flat, [0, 1, 2]),
        "all of a cup": (cup, slice(None)),
        **{f"of a cup at {z} none": (move(cup, [0, 0, z]), []) for z in (-100, 0, 100)},
    }


@pytest.mark.parametrize("case", turns())
def test_faces_end_as_they_should_be(case: str) -> None:
    right, wrong = turns()[case]
    faces = right.faces.copy()
    faces[wrong] = faces[wrong][:, ::-1]
    given = Shape(right.verts, faces)
    done = repair(given)
    np.testing.assert_allclose(
        normalized(done.shape.face_vectors), normalized(Shape(right.verts, right.faces).face_vectors), atol=1e-9
    )
    turned = int((faces != right.faces).any(axis=1).sum())
    told = [note for note in done.notes if "turned" in note]
    assert told == ([] if not turned else ["turned all faces: the shape was inside out"] if turned == right.F else
                    [f"{turned} face{'s' if turned > 1 else ''} turned to face the same way as the others"])  # fmt: skip
    check_answers(given, done)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_sliver_without_height_is_dropped_at_any_scale(cube: Shape, scale: float) -> None:
    line = np.array([[2, 0, 0], [3, 1, 1], [4, 2, 2], [2.5, 0, 0.001]])
    verts = np.vstack([cube.verts, line]) * scale
    done = repair(Shape(verts, np.vstack([cube.faces, [[8, 9, 10], [8, 0, 11]]])))
    assert "1 face without area dropped" in done.notes
    assert done.shape.F == 13  # the thin one that has some height stays


def edges_split_at_their_ends(ball: Shape, edges: int, apart: float) -> Shape:
    """Some edges of a closed shape get a vertex beside their first end: two needles each."""
    verts, faces, touched = [*ball.verts], [list(face) for face in ball.faces], set[int]()
    for k, (a, b, c) in enumerate(ball.faces.tolist()):
        other = next(j for j, face in enumerate(ball.faces.tolist()) if {a, b} <= {*face} and c not in face)
        if len(verts) == ball.V + edges or touched & {*ball.faces[k], *ball.faces[other]}:
            continue
        touched |= {*ball.faces[k], *ball.faces[other]}
        d, m = next(v for v in ball.faces[other] if v not in (a, b)), len(verts)
        verts.append(ball.verts[a] + apart * (ball.verts[b] - ball.verts[a]))
        faces[k], faces[other] = [m, b, c], [b, m, d]
        faces += [[a, m, c], [m, a, d]]
    return Shape(verts, faces)


@pytest.mark.parametrize("apart", [0.0, 1e-14])
def test_edges_without_length_are_collapsed_and_the_surface_stays_closed(apart: float) -> None:
    ball = icosphere(2)
    given = edges_split_at_their_ends(ball, 9, apart)
    assert is_watertight(given.faces)
    assert given.V == ball.V + 9
    done = repair(given)
    assert (done.shape.V, done.shape.F) == (ball.V, ball.F)
    assert is_watertight(done.shape.faces)
    assert done.notes == ("9 edges without length collapsed", "18 faces without area dropped")
    check_answers(given, done)


def test_a_vertex_far_away_does_not_make_all_edges_short() -> None:
    ball = icosphere(2)
    given = Shape(np.vstack([ball.verts, [[1e12, 0, 0]]]), np.vstack([ball.faces, [[0, 1, ball.V]]]))
    assert repair(given).shape.V >= ball.V


def with_a_cone(shape: Shape, length: float, wide: float) -> Shape:
    """A sphere of radius 1 whose vertex nearest to the pole is drawn out, and those around it moved nearer or apart."""
    tip = int(shape.verts[:, 2].argmax())
    around = np.setdiff1d(shape.faces[(shape.faces == tip).any(axis=1)], tip)
    verts = shape.verts.copy()
    verts[around, :2] = wide * normalized(verts[around, :2])
    verts[tip] = [0, 0, 1 + length]
    return Shape(verts, shape.faces, "cone")


@pytest.mark.parametrize("length", [3.0, 30.0, 1e30])
def test_a_spike_is_dropped_and_answered_by_a_neighbour(sphere: Shape, length: float) -> None:
    """Which would make a body the speck at the end of a needle."""
    spiked = with_a_cone(sphere, length, 0.1)
    tip = int(spiked.verts[:, 2].argmax())
    done = repair(spiked)
    assert done.notes[:2] == (
        "1 vertex far from all others dropped (spikes)",
        f"{(spiked.faces == tip).any(axis=1).sum()} faces at these vertices dropped",
    )
    assert done.shape.V == sphere.V - 1 and done.shape.diagonal < 4
    answer = done.kept_vertex[done.original_to_repaired[tip]]
    assert answer in spiked.faces[(spiked.faces == tip).any(axis=1)]


@pytest.mark.parametrize(("length", "wide"), [(1.2, 0.1), (3.0, 0.9)])
def test_a_horn_or_a_hat_is_no_spike(sphere: Shape, length: float, wide: float) -> None:
    assert not repair(with_a_cone(sphere, length, wide)).notes


def test_a_thin_stick_with_an_end_is_no_spike(sphere: Shape) -> None:
    """As of a lollipop: few vertices, but more than one at its end."""
    top = int(sphere.verts[:, 2].argmax())
    near = np.setdiff1d(sphere.faces[(sphere.faces == top).any(axis=1)], top)
    corners = np.argsort(np.arctan2(*sphere.verts[near, :2].T))
    ring = sphere.verts[near[corners]] * [0.1, 0.1, 1]
    N, verts = len(ring), np.concatenate([sphere.verts, ring + np.array([0, 0, 9])])
    verts[near[corners]] = ring
    first, k = near[corners], np.arange(N)
    sides = np.concatenate(
        [np.stack([first, first[k - 1], sphere.V + k], 1), np.stack([first[k - 1], sphere.V + k - 1, sphere.V + k], 1)]
    )
    stick = Shape(verts, np.concatenate([sphere.faces, sides]), "lollipop")
    assert not any("spike" in note for note in repair(stick).notes)


def test_seams_are_merged_and_every_copy_answered(tmp_path: Path, torus: Shape) -> None:
    save_shape(tmp_path / "t.stl", torus)
    soup = load_shape(tmp_path / "t.stl")
    done = repair(soup)
    assert (done.shape.V, done.shape.F) == (torus.V, torus.F)
    assert is_watertight(done.shape.faces)
    assert done.notes == (f"{3 * torus.F - torus.V:,} vertices merged with another at the same position",)
    check_answers(soup, done)


def test_shape_made_of_small_parts_is_not_taken_apart(make_sphere: Callable[[int], Shape]) -> None:
    ball = make_sphere(1)
    golden = np.arange(60) * np.pi * (3 - 5**0.5)
    height = 1 - (np.arange(60) + 0.5) / 30
    ring = np.sqrt(1 - height**2)
    around = 1.12 * np.stack([ring * np.cos(golden), ring * np.sin(golden), height], axis=1)
    beads = [move(ball, p, 0.1) for p in around]  # each with 1 % of the ball's area, together 60 %
    done = repair(join(ball, *beads, move(ball, [3, 0, 0], 0.1)))
    assert done.notes == ("1 outlier part dropped (80 faces)", "61 separate parts kept")


@pytest.mark.parametrize("kind", ["box", "turned box", "hull"])
def test_a_plain_hull_of_all_the_rest_is_left_out(kind: str, torus: Shape) -> None:
    """A bounding box or collision shape, which is larger than what it holds."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    hull = trimesh.creation.box(extents=np.ptp(torus.verts, axis=0))
    if kind == "hull":
        hull = trimesh.creation.icosphere(0, radius=1.3 * np.linalg.norm(torus.verts, axis=1).max())
    around = Shape(np.asarray(hull.vertices), np.asarray(hull.faces))
    turn = turn if kind == "turned box" else np.eye(3)
    done = repair(Shape(join(torus, around).verts @ turn, join(torus, around).faces))
    assert (done.shape.V, done.notes[0]) == (torus.V, f"1 outlier part dropped ({around.F} faces)")


def ground(half: float, height: float = -1.0) -> Shape:
    corners = half * np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) + [0, height, 0]
    return Shape(corners, np.array([[0, 1, 2], [0, 2, 3]]))


@pytest.mark.parametrize("half", [2.5, 99.0])
def test_a_flat_ground_is_left_out(sphere: Shape, half: float) -> None:
    """Turned anyhow, and below several parts."""
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    hat = move(sphere, [0, 1.2, 0], 0.5)
    scene = join(sphere, hat, ground(half))
    done = repair(Shape(scene.verts @ turn, scene.faces))
    assert done.shape.V == 2 * sphere.V and done.notes[0] == "1 outlier part dropped (2 faces)"


def test_a_plate_that_is_no_ground_is_kept(sphere: Shape) -> None:
    """A table top, as large as what carries it; and a sheet that something passes through."""
    legs = [Shape(sphere.verts * [0.1, 0.5, 0.1] + [x, -0.5, z], sphere.faces) for x in (-2, 2) for z in (-2, 2)]
    for plates in (join(*legs, ground(2.5, 0.1)), join(sphere, ground(3.0, 0.0))):
        assert repair(plates).shape.V == plates.V


def test_boxes_in_boxes_end_soon(sphere: Shape) -> None:
    boxes = [Shape((2 + k) * (box().verts - 0.5), box().faces) for k in range(2000)]
    assert repair(join(sphere, *boxes)).shape.V > sphere.V


def test_what_only_looks_like_a_hull_a_ground_or_a_spike_is_kept(sphere: Shape) -> None:
    """Something plain as large as a body that sticks out of it, a plate beside one, a sheet of two pieces, a short thorn."""
    corners = 1.05 * np.concatenate([np.eye(3), -np.eye(3)])
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    flat = Shape(sphere.verts * [1, 0, 1], sphere.faces)
    for shape in (join(sphere, Shape(corners, faces)), join(sphere, move(ground(2.5), [3, 0, 0]))):
        assert repair(shape).shape.V == shape.V
    assert not any("outlier" in note for note in repair(join(flat, ground(1.0, 0.0))).notes)
    thorn = with_a_cone(sphere, 1.2, 0.005)
    near = thorn.faces[(thorn.faces == thorn.verts[:, 2].argmax()).any(axis=1)]
    verts = thorn.verts.copy()
    verts[np.setdiff1d(near, thorn.verts[:, 2].argmax()), 2] = 1.4
    assert not any("spike" in note for note in repair(Shape(verts, thorn.faces)).notes)


def test_a_body_beside_something_plain_and_huge_is_no_dirt(sphere: Shape) -> None:
    """Such as a wall with a niche for it, also of several parts; but a bolt is dirt beside a table."""
    block = Shape(99 * (box().verts - [0.5, 1, 0.5]) + [0, -1, 0], box().faces)
    hat, crate = move(sphere, [0, 1.2, 0], 0.5), Shape(9 * (box().verts - 0.5) + [9, 0, 0], box().faces)
    for bodies, parts in ((join(sphere, block), 2), (join(sphere, hat, block), 3), (join(sphere, crate, block), 3)):
        done = repair(bodies)
        assert done.shape.V == bodies.V and f"{parts} separate parts kept" in done.notes
    panels = [Shape(9 * (box().verts - 0.5) * [1, 1, 0.1] + [0, 0, 9 * k], box().faces) for k in range(3)]
    bolts = [move(sphere, [k, 5, 0], 0.1) for k in range(4)]
    assert "4 outlier parts dropped (5,120 faces)" in repair(join(*panels, *bolts)).notes


def test_what_holds_something_else_is_kept(sphere: Shape) -> None:
    """A box beside a body, one that it sticks out of, a round hull, and a box around nothing much."""
    wide = Shape(10 * (box().verts - 0.5), box().faces)
    for shape in (
        join(sphere, move(wide, [6, 0, 0], 0.2)),
        join(sphere, Shape(wide.verts * [0.5, 0.1, 0.5], wide.faces)),
        join(sphere, Shape(3 * sphere.verts, sphere.faces)),
        join(Shape(0.5 * wide.verts, wide.faces), wide),
    ):
        assert not any("12 faces" in note or "outlier" in note for note in repair(shape).notes)


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
    for name in ("shrec19/15.ply", "heart/heart02.ply"):
        shape = load_shape(bench / name)
        done = repair(shape)
        assert done.notes
        assert not edges_of(done.shape.faces).disagreeing.any()
        np.testing.assert_array_equal(done.original_to_repaired[done.kept_vertex], np.arange(done.shape.V))
        moved = np.linalg.norm(done.shape.verts[done.original_to_repaired] - shape.verts, axis=1)
        assert moved.max() < 0.2 * shape.diagonal
    cow = load_shape(bench / "textured" / "spot_triangulated.obj")
    assert repair(cow).shape is cow
    rogue = repair(load_shape(bench / "textured" / "Rogue.glb"))
    assert rogue.shape.V < 3200  # of 5901: seams merged


def test_small_parts_that_joints_move_are_no_dirt() -> None:
    """Such as the shells of a robot's fingers; what is as small and hangs from nothing is."""
    ball, finger = icosphere(3), move(icosphere(1), [1.2, 0, 0], 0.03)
    dirt = move(finger, [0, 1.3, 0])
    bound = np.repeat([True, True, False], [ball.V, finger.V, dirt.V])
    done = repair(join(ball, finger, dirt, skinned=bound))
    assert done.notes[0] == "1 outlier part dropped (80 faces)"
    assert done.shape.V == ball.V + finger.V
    assert repair(join(ball, finger, dirt)).shape.V == ball.V


def test_the_meshes_of_what_is_dropped_are_named() -> None:
    ball, dirt = icosphere(3), move(icosphere(1), (3, 0, 0), 0.05)
    named = (("head", ball.V), ("eye", dirt.V), ("", dirt.V), ("eye", dirt.V), ("tooth", dirt.V))
    shape = join(ball, dirt, move(dirt, (0, 1, 0)), move(dirt, (0, 2, 0)), move(dirt, (0, 3, 0)), meshes=named)
    assert repair(shape).notes[0] == "4 outlier parts dropped (320 faces of eye, tooth)"
    assert repair(join(ball, dirt, meshes=named)).notes[0] == "1 outlier part dropped (80 faces)"  # of another shape


def test_a_scene_names_its_meshes(tmp_path: Path) -> None:
    write_tube(tmp_path / "tube.glb")
    shape = load_shape(tmp_path / "tube.glb")
    assert shape.meshes == (("tube", shape.V),)
    save_shape(tmp_path / "tube.ply", shape)
    assert load_shape(tmp_path / "tube.ply").meshes == ()


def test_faces_turned_outwards_and_nothing_else() -> None:
    ball = icosphere(2)
    assert oriented_outwards(ball) is ball
    apart = Shape(
        ball.verts[ball.faces.ravel()], np.arange(3 * ball.F).reshape(-1, 3)
    )  # open everywhere but for its place
    for shape in (ball, apart):
        for wrong in (np.arange(shape.F), np.arange(0, shape.F, 3)):
            faces = shape.faces.copy()
            faces[wrong] = faces[wrong][:, ::-1]
            found = oriented_outwards(Shape(shape.verts, faces))
            assert np.array_equal(np.sort(found.faces, axis=1), np.sort(faces, axis=1))
            assert np.allclose(found.face_vectors, shape.face_vectors)
    cloud = Shape(ball.verts, np.empty((0, 3), np.int64))
    assert oriented_outwards(cloud) is cloud


def test_what_hangs_from_a_character_is_named() -> None:
    ball, sword = icosphere(3), move(icosphere(1), (0, 1.1, 0), 0.5)
    shape = join(
        ball, sword, meshes=(("body", ball.V), ("sword", sword.V)), skinned=np.arange(ball.V + sword.V) < ball.V
    )
    assert repair(shape).notes[0] == "sword has no skin, as weapons have: --without (without=) leaves parts out"
    chosen = replace(shape, weights=np.ones(shape.V))
    assert not any("skin" in note for each in (chosen, replace(shape, skinned=None)) for note in repair(each).notes)
