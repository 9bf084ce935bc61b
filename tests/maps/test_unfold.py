"""Maps without folds: what is turned over or crushed is laid out anew, and nothing else moves."""

import numpy as np
import pytest
import trimesh
from trimesh.creation import icosphere

from meshmatch.arrays import Ints
from meshmatch.geometry.disks import Disk
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.folds import Folds
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import MappedMesh, invert_map
from meshmatch.maps.unfold import _Images, _ratios, unfold, unfold_both_ways
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

MOVED = np.array([100, 300, 500])


def ball(subdivisions: int, turn: float = 0.3) -> Shape:
    mesh = icosphere(subdivisions)
    around = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    return Shape(mesh.vertices @ around.T * [1.0, 0.8, 1.3], mesh.faces)


def put(source: Shape, target: Shape, places: np.ndarray) -> VertexMap:
    foot = MappedMesh.of(target).query(places)
    rest = {"face": foot.face, "barycentric": foot.barycentric, "confidence": np.full(source.V, 0.5, np.float32)}
    return VertexMap.between(source, target, foot.vertex, **rest)


def folded(source: Shape, target: Shape, moved: Ints = MOVED) -> VertexMap:
    """The map to the closest point, but for vertices that are pulled across a neighbour."""
    return put(source, target, pulled(source, moved))


def pulled(source: Shape, moved: Ints) -> np.ndarray:
    places, edges = source.verts.copy(), source.edges.vertices
    for vertex in moved:
        other = edges[(edges == vertex).any(axis=1)][0].sum() - vertex
        places[vertex] += 1.8 * (source.verts[other] - source.verts[vertex])
    return places


def test_folds_are_opened_and_the_rest_stays() -> None:
    source, target = ball(3), ball(3, 0.0)
    before = folded(source, target)
    after = unfold(before, source, target)
    assert Folds.of(before, source, target).flipped > 0.003
    assert Folds.of(after, source, target) == Folds(0.0, 0.0, pytest.approx(1.0, abs=0.15))
    far = np.linalg.norm(source.verts[:, None] - source.verts[MOVED], axis=2).min(axis=1) > 0.8
    np.testing.assert_array_equal(after.points(target)[far], before.points(target)[far])
    right = put(source, target, source.verts).points(target)
    away = np.linalg.norm(after.points(target) - right, axis=1)
    assert away[MOVED].max() < 0.3 * np.linalg.norm(before.points(target) - right, axis=1)[MOVED].min()
    np.testing.assert_array_equal(after.confidence, before.confidence)


def test_both_ways_are_inverse_and_have_no_folds() -> None:
    source, target = ball(3), ball(3, 0.0)
    there, back = unfold_both_ways(folded(source, target), put(target, source, target.verts), source, target)
    for found, one, other in ((there, source, target), (back, target, source)):
        assert Folds.of(found, one, other) == Folds(0.0, 0.0, pytest.approx(1.0, abs=0.15))
    assert missed(there, back, source, target) < 0.05


def test_the_way_back_follows_what_is_laid_flat() -> None:
    source, target = ball(3), ball(3, 0.0)
    found = folded(source, target)
    back = invert_map(found, source, target)
    images = _Images(found, source, target, 1)
    images.opposite = _Images(back, target, source, 1)
    images.repeat(images.flatten, (1, 2))
    followed = images.opposite.map
    assert (followed.points(source) != back.points(source)).any(axis=1).mean() < 0.1
    assert missed(images.map, followed, source, target) < 0.5 * missed(images.map, back, source, target)
    assert Folds.of(followed, target, source) == Folds(0.0, 0.0, pytest.approx(1.0, abs=0.15))


def test_what_folds_the_way_back_more_is_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = ball(3), ball(3, 0.0)
    found = folded(source, target)
    images = _Images(found, source, target, 1)
    back = images.opposite = _Images(invert_map(found, source, target), target, source, 1)
    before = back.ratio.copy()
    followed = []

    def folds(rows, near, *_):
        followed.append(len(near))
        back.ratio[near] = -1.0

    monkeypatch.setattr(back, "_update_from", folds)
    images.repeat(images.flatten, (1, 2))
    np.testing.assert_array_equal(images.map.points(target), found.points(target))
    np.testing.assert_array_equal(back.ratio, before)
    assert followed and min(followed) > 0


def test_both_ways_are_the_same_in_either_order_however_a_file_stands_and_is_cut() -> None:
    source, target = ball(3), ball(4, 0.0)
    place = source.verts[100]
    near = np.linalg.norm(source.verts - place, axis=1, keepdims=True) < 0.3
    crushed = np.where(near, place + 0.02 * (source.verts - place), source.verts)  # beside its middle nothing is sound
    found, back = put(source, target, crushed), put(target, source, target.verts)
    there, again = unfold_both_ways(found, back, source, target)
    swapped = unfold_both_ways(back, found, target, source)
    for one, other in zip((again, there), swapped, strict=True):
        np.testing.assert_array_equal(one.face, other.face)
        np.testing.assert_array_equal(one.barycentric, other.barycentric)
    turn = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    corner = target.faces.ravel()  # each face has its own vertices, in the order of its corners
    cut = Shape(2 * target.verts[corner] @ turn.T, np.arange(3 * target.F).reshape(-1, 3))
    rest = {"face": found.face, "barycentric": found.barycentric, "confidence": found.confidence}
    onto = VertexMap.between(source, cut, 3 * found.face + found.barycentric.argmax(1), **rest)
    rest = {name: getattr(back, name)[corner] for name in ("face", "barycentric", "confidence")}
    off = VertexMap.between(cut, source, back.index[corner], **rest)
    there_cut, again_cut = unfold_both_ways(onto, off, source, cut)
    np.testing.assert_allclose(there_cut.points(cut), 2 * there.points(target) @ turn.T, atol=1e-9)
    np.testing.assert_allclose(again_cut.points(source), again.points(source)[corner], atol=1e-9)


def test_a_shape_and_its_mirror_image_have_one_pair_of_maps() -> None:
    source, target = ball(3), ball(3)
    target = Shape(target.verts * [-1, 1, 1], target.faces[:, ::-1])
    found, back = put(source, target, source.verts), put(target, source, target.verts)
    there, again = unfold_both_ways(found, back, source, target)
    for one, other in zip((again, there), unfold_both_ways(back, found, target, source), strict=True):
        np.testing.assert_array_equal(one.barycentric, other.barycentric)


def test_parts_that_touch_stay_apart() -> None:
    """Two closed parts have a wall in common, vertex for vertex; on the target they are apart."""
    part = trimesh.creation.box().subdivide().subdivide()
    faces = np.concatenate([part.faces, part.faces + len(part.vertices)])
    source, target = (
        Shape(np.concatenate([part.vertices, part.vertices + np.array([away, 0, 0])]), faces) for away in (1.0, 2.0)
    )
    found, back = (
        VertexMap.between(one, other, np.arange(one.V), confidence=np.ones(one.V))
        for one, other in ((source, target), (target, source))
    )
    for one, other in zip(unfold_both_ways(found, back, source, target), (target, source), strict=True):
        off = np.linalg.norm(one.points(other) - other.verts, axis=1)
        inside = (np.abs(part.vertices) < 0.5).sum(axis=1) > 1  # at the rim of the wall normals do not tell parts apart
        assert (off[np.tile(inside, 2)] < 1e-6).all()


def test_an_image_without_area_is_not_turned_over_by_rounding() -> None:
    verts, faces, up = np.eye(3), np.array([[0, 1, 2]]), np.tile([0, 0, 1.0], (3, 1))
    for angle in np.linspace(0.1, 6, 20):
        line = np.outer([0, 1, 1 / 3], [np.cos(angle), np.sin(angle), 0.3])
        assert _ratios(line, up, verts, faces) == 0


def missed(there: VertexMap, back: VertexMap, source: Shape, target: Shape) -> float:
    """How far from itself a vertex comes at most, there and back."""
    again = interpolate(back.points(source), corners_of(target.faces, there.face, there.index), there.barycentric)
    return float(np.linalg.norm(again - source.verts, axis=1).max())


def test_a_map_without_folds_is_the_same() -> None:
    source, target = ball(3), ball(2)
    found = put(source, target, source.verts)
    assert unfold(found, source, target) is found


def test_a_mirror_image_is_no_fold() -> None:
    source, target = ball(3), ball(3, 0.0)
    mirrored = Shape(target.verts * [-1, 1, 1], target.faces[:, ::-1])
    before = folded(source, target)
    found = VertexMap.between(source, mirrored, before.index, confidence=before.confidence)
    assert 0.003 < Folds.of(found, source, mirrored).flipped < 0.1
    assert Folds.of(unfold(found, source, mirrored), source, mirrored).flipped == 0


def test_vertices_at_one_place_move_together() -> None:
    source, target = ball(3), ball(3, 0.0)
    doubled = Shape(
        np.concatenate([source.verts, source.verts]), source.faces + source.V * (np.arange(source.F) % 2)[:, None]
    )
    before = folded(source, target)
    rest = {name: np.concatenate([getattr(before, name)] * 2) for name in ("face", "barycentric", "confidence")}
    found = VertexMap.between(doubled, target, np.tile(before.index, 2), **rest)
    points, used = unfold(found, doubled, target).points(target), np.unique(doubled.faces)
    right = np.tile(unfold(before, source, target).points(target), (2, 1))
    np.testing.assert_allclose(points[used], right[used], atol=1e-6)


def test_what_it_does_not_touch() -> None:
    source, target = ball(3), ball(3, 0.0)
    found = folded(source, target)
    cloud = Shape(source.verts, np.zeros((0, 3), int))
    of_cloud = VertexMap.between(cloud, target, found.index)
    assert unfold(of_cloud, cloud, target) is of_cloud
    rng = np.random.default_rng(0)  # folded everywhere: wrong as a whole
    wrong = VertexMap.between(source, target, rng.integers(0, target.V, source.V))
    assert unfold(wrong, source, target) is wrong


def test_large_meshes_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = ball(3), ball(3, 0.0)
    found = folded(source, target)
    monkeypatch.setattr("meshmatch.maps.unfold._MAX_VERTICES", 500)
    assert unfold(found, source, target) is found


@pytest.mark.parametrize("seed", range(4))
def test_nothing_becomes_worse(seed: int) -> None:
    """Of folds all over, which no rule opens as a whole, each part stays as it was unless it is better."""
    source, target = ball(3), ball(3, 0.0)
    noise = np.random.default_rng(seed).normal(scale=0.05, size=source.verts.shape)
    found = put(source, target, source.verts + noise)
    before, after = (Folds.of(each, source, target) for each in (found, unfold(found, source, target)))
    assert 0.02 < before.flipped + before.crushed < 0.2
    assert after.flipped + after.crushed < before.flipped + before.crushed


def test_what_does_not_become_better_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = ball(3), ball(3, 0.0)
    found = folded(source, target)
    monkeypatch.setattr(_Images, "_solve_poisson", lambda images, rows, laid: np.zeros((len(rows), 3)))
    smoothed = Folds.of(unfold(found, source, target), source, target)
    assert smoothed == Folds(0.0, 0.0, pytest.approx(1.0, abs=0.15))  # what cannot be laid out is smoothed
    monkeypatch.setattr("meshmatch.maps.unfold._SMOOTHING_RINGS", ())
    flat = Folds.of(unfold(found, source, target), source, target)
    assert flat == Folds(0.0, 0.0, pytest.approx(1.0, abs=0.15))  # or laid flat
    monkeypatch.setattr(Disk, "laid_flat", lambda *each: None)
    np.testing.assert_array_equal(unfold(found, source, target).points(target), found.points(target))


def test_where_the_map_tears_nothing_is_laid_out() -> None:
    source, target = ball(3), ball(3, 0.0)
    places = np.where(source.verts[:, 2:] > 0, -source.verts, source.verts)  # one half goes to the other side
    found = put(source, target, places)
    points = unfold(found, source, target).points(target)
    assert np.linalg.norm(points - found.points(target), axis=1).max() < 0.1


def test_folds_of_known_maps() -> None:
    flat = Shape(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert Folds.of(VertexMap.identity(flat), flat, flat) == Folds(0.0, 0.0, pytest.approx(1.0))
    long = Shape(flat.verts * [2, 0.5, 1], flat.faces)
    found = VertexMap.between(flat, long, np.arange(4))
    assert Folds.of(found, flat, long) == Folds(0.0, 0.0, pytest.approx(2.0))
    collapsed = Folds.of(VertexMap.between(flat, flat, np.array([0, 1, 2, 2])), flat, flat)
    assert (collapsed.flipped, collapsed.crushed) == (
        0.0,
        0.5,
    )  # one triangle has become a line, and is not turned over
    point = Folds.of(VertexMap.between(flat, flat, np.zeros(4, int)), flat, flat)
    assert (point.flipped, point.crushed) == (0.0, 1.0) and point.stretch > 1e6
    wide = Shape(flat.verts * [10, 10, 1], flat.faces)
    assert Folds.of(VertexMap.between(flat, wide, np.arange(4)), flat, wide).stretch == pytest.approx(1.0)
    small = Shape(np.concatenate([flat.verts, flat.verts[:3] * 0.1 + 5]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]]))
    share = flat.face_areas[0] / small.area
    into = VertexMap.between(Shape(flat.verts[:3], flat.faces[:1]), small, np.array([4, 5, 6]))
    assert Folds.of(into, Shape(flat.verts[:3], flat.faces[:1]), small).crushed == 1.0 and share > 0.4
    turned = VertexMap.between(flat, flat, np.array([0, 1, 2, 1]))  # the second triangle lies on the first
    assert Folds.of(turned, flat, flat).flipped == pytest.approx(0.5)


def test_triangles_without_height_do_not_keep_folds_shut() -> None:
    """As decimation leaves them on flat ground: a vertex in the middle of a side, and a triangle between it and the side."""
    target, plain = ball(3, 0.0), ball(3)
    some = plain.faces[::3]
    a, b, c = some.T
    middle = plain.V + np.arange(len(some))
    rng = np.random.default_rng(0)
    verts = np.concatenate([plain.verts, plain.verts[some[:, :2]].mean(1) + 1e-9 * rng.standard_normal((len(some), 3))])
    pieces = [np.stack(each, 1) for each in ((a, middle, c), (middle, b, c), (a, b, middle))]
    source = Shape(verts, np.concatenate([np.delete(plain.faces, np.s_[::3], axis=0), *pieces]))
    found = folded(source, target)
    before, after = (Folds.of(each, source, target) for each in (found, unfold(found, source, target)))
    assert before.flipped > 0.002
    assert after.flipped < 0.5 * before.flipped


def test_what_would_be_torn_from_its_surroundings_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, solved = icosphere(5), _Images._solve_poisson
    disc = Shape(mesh.vertices * [1.0, 1.0, 0.1], mesh.faces)
    away = np.linalg.norm(disc.verts[:, :2] - [0.5, 0], axis=1, keepdims=True)
    inward = np.clip((away - 0.2) / 0.2, 0.2, 1.0)  # one place on both sides is crushed
    places = np.where(away < 0.5, [0.5, 0, 0] + (disc.verts - [0.5, 0, 0]) * [1, 1, 0] * inward, disc.verts)
    places[:, 2] = disc.verts[:, 2]
    found = put(disc, disc, places)
    assert Folds.of(unfold(found, disc, disc), disc, disc).crushed < Folds.of(found, disc, disc).crushed
    for name in ("_SMOOTHING_RINGS", "_FLATTENING_RINGS", "_FINAL_RINGS"):
        monkeypatch.setattr(f"meshmatch.maps.unfold.{name}", ())
    # without a fold, but far away
    monkeypatch.setattr(_Images, "_solve_poisson", lambda *each: solved(*each) - [0.4, 0, 0])
    np.testing.assert_array_equal(unfold(found, disc, disc).points(disc), found.points(disc))


def test_faces_that_run_the_other_way_are_no_folds() -> None:
    """A file may turn a part of its faces inside out; what lies there is not turned over."""
    source, target = ball(3), ball(3, 0.0)
    faces = target.faces.copy()
    some = target.verts[faces].mean(axis=1)[:, 2] > 0.5
    faces[some] = faces[some][:, ::-1]
    mixed = Shape(target.verts, faces)
    found = put(source, mixed, source.verts)
    assert Folds.of(found, source, mixed).flipped < 0.001
    back = put(mixed, source, mixed.verts)
    assert Folds.of(back, mixed, source).flipped < 0.001


def test_seams_of_the_target_are_not_in_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """A textured glb has its vertices several times along the seams of its image."""
    source, target = ball(3), ball(3, 0.0)
    cut = Shape(target.verts[target.faces].reshape(-1, 3), np.arange(3 * target.F).reshape(-1, 3))
    whole = folded(source, target)
    found = put(source, cut, whole.points(target))
    for name in ("_POISSON_RINGS", "_SMOOTHING_RINGS"):
        monkeypatch.setattr(f"meshmatch.maps.unfold.{name}", ())
    assert Folds.of(found, source, cut).flipped > 0.003
    assert Folds.of(unfold(found, source, cut), source, cut).flipped == 0


def touching(subdivisions: int, turn: float = 0.0) -> tuple[Shape, Ints]:
    """Two halves of a ball, each closed by a wall that lies on the other's; and which half each vertex is of."""
    halves = [ball(subdivisions, turn).verts.copy() for _ in range(2)]
    for half, side in zip(halves, (1.0, -1.0), strict=True):
        half[:, 0] = side * np.maximum(side * half[:, 0], 0.0)
    faces = icosphere(subdivisions).faces
    shape = Shape(np.concatenate(halves), np.concatenate([faces, faces + len(halves[0])]))
    return shape, np.repeat([0, 1], len(halves[0]))


def test_no_image_leaves_its_part_where_another_one_touches_it() -> None:
    (source, own), (target, theirs) = touching(3, 0.3), touching(3)
    places = source.verts.copy()
    places[own == 0] *= [1.0, 0.9, 0.9]
    foot = MappedMesh.of(target).query(places, parts=own)
    rest = {"face": foot.face, "barycentric": foot.barycentric, "confidence": np.ones(source.V, np.float32)}
    before = VertexMap.between(source, target, foot.vertex, **rest)
    np.testing.assert_array_equal(theirs[before.index], own)
    there, back = unfold_both_ways(before, invert_map(before, source, target), source, target)
    np.testing.assert_array_equal(theirs[there.index], own)
    np.testing.assert_array_equal(own[back.index], theirs)
    alone = unfold(before, source, target)
    assert (alone.points(target) != before.points(target)).any()
    np.testing.assert_array_equal(theirs[alone.index], own)


def test_no_image_leaves_its_layer_while_folds_are_laid_out() -> None:
    """Of two layers that face alike, as a shirt and its lining, the means of images lie nearer to the inner one."""
    layers = [ball(3, turn).verts * size for turn in (0.3, 0.0) for size in (1.0, 1.002)]
    faces = icosphere(3).faces
    V = len(layers[0])
    twice = np.concatenate([faces, faces + V])
    source, target = (Shape(np.concatenate(each), twice) for each in (layers[:2], layers[2:]))
    layer = np.repeat([0, 1], V)
    foot = MappedMesh.of(target).query(pulled(source, MOVED + V), parts=layer)
    rest = {"face": foot.face, "barycentric": foot.barycentric, "confidence": np.ones(source.V, np.float32)}
    before = VertexMap.between(source, target, foot.vertex, **rest)
    after = unfold(before, source, target)
    assert Folds.of(before, source, target).flipped > 0.001
    assert Folds.of(after, source, target).flipped == 0
    np.testing.assert_array_equal(layer[after.index], layer)
