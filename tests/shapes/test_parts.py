"""The parts of a mesh have numbers that do not depend on the file, and what may be an object of its own is found."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from meshmatch.errors import InputError
from meshmatch.shapes.files import load_shape, load_shapes, save_shape
from meshmatch.shapes.parts import Parts, are_separate, candidate_sets, leave_out
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.growth import grows_with_size
from tests.shapes.scenes import beside, box, chair, coat, eyes, floor, moved, pack, pedestal, sample, second, together


@pytest.fixture
def three() -> Shape:
    """Boxes of 6, 24 and 54 units of area, in that order, and a vertex that no face uses."""
    boxes = [box([5 * k, 0, 0], [5 * k + size, size, size]) for k, size in enumerate((1.0, 2.0, 3.0))]
    found = together("three", *boxes)
    return Shape(np.concatenate([found.verts, [[9.0, 9, 9]]]), found.faces, "three.ply")


def test_the_largest_part_is_number_one(three: Shape) -> None:
    parts = Parts.of(three)
    assert len(parts) == 3
    assert np.allclose(parts.areas, [54, 24, 6])
    assert np.allclose(parts.shares, np.array([54, 24, 6]) / 84)
    assert parts.number[[0, 400, 800, -1]].tolist() == [3, 2, 1, 0]
    assert np.array_equal(parts.bounds[1], [[5, 0, 0], [7, 2, 2]])
    assert parts.counts.sum() == three.V - 1
    assert parts.share([1, 3]) == pytest.approx(60 / 84) and parts.others([2]) == (1, 3)


def test_numbers_are_those_of_an_independent_reading() -> None:
    body = sample("dancer")
    scene = together("scene", body, floor(body), chair(beside(body)))
    pieces = trimesh.Trimesh(scene.verts, scene.faces, process=False).split(only_watertight=False)
    parts = Parts.of(scene)
    assert np.allclose(parts.areas, sorted((piece.area for piece in pieces), reverse=True))
    for number in range(1, len(parts) + 1):  # what a face holds together is in one part
        assert (parts.number[scene.faces[parts.faces == number]] == number).all()


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl", ".glb"])
def test_numbers_are_the_same_in_every_format(three: Shape, tmp_path: Path, suffix: str) -> None:
    """An stl has no shared vertices; its corners are joined first."""
    save_shape(tmp_path / f"a{suffix}", Shape(three.verts[:-1], three.faces))
    found = Parts.of(load_shape(tmp_path / f"a{suffix}"))
    assert np.allclose(found.areas, Parts.of(three).areas)
    assert np.allclose(found.bounds, Parts.of(three).bounds, atol=1e-5)


def test_equal_parts_are_numbered_in_the_order_of_the_file() -> None:
    same = [box([3.0 * k, 0, 0], [3.0 * k + 1, 1, 1]) for k in (2, 0, 1)]
    parts = Parts.of(together("same", *same))
    assert parts.bounds[:, 0, 0].tolist() == [6, 0, 3]


def test_broken_faces_and_clouds_have_no_part(cube: Shape) -> None:
    assert len(Parts.of(Shape(cube.verts, np.empty((0, 3), np.int64)))) == 0
    verts = np.concatenate([cube.verts, cube.verts + 5, [[np.nan] * 3]])
    faces = np.concatenate([cube.faces, cube.faces + 8, [[0, 8, 16], [0, 0, 8]]])  # neither joins the cubes
    parts = Parts.of(Shape.with_invalid(verts, faces, "broken"))
    assert len(parts) == 2 and parts.number.tolist() == [1] * 8 + [2] * 8 + [0]


BODY = "climber"


def test_a_body_is_found_beside_other_things() -> None:
    """The first try is the body and nothing else: part 0 of what is put together here."""
    body = sample(BODY)
    for name, others in {
        "floor": [floor(body)],
        "hall": [floor(body, 14.0)],
        "pedestal": [pedestal(body)],
        "pedestal on a floor": [pedestal(body), moved(floor(body), [0, 0, -0.5])],
        "pack": [pack(body)],
        "chair": [chair(beside(body))],
        "far chair": [chair(beside(body, 2.0))],
        "room": [floor(body, 4.0), chair(beside(body)), chair(beside(body, -1.5)), pack(body)],
    }.items():
        parts = Parts.of(together(name, body, *others))
        assert candidate_sets(parts)[0] == {parts.number[0]}, name


def test_what_belongs_to_a_body_stays_with_it() -> None:
    body = sample(BODY)
    dressed = together("dressed", body, coat(body), eyes(body))
    for others in ([floor(body)], [pedestal(body)], [chair(beside(body, 0.5))]):
        parts = Parts.of(together("scene", dressed, *others))
        first = candidate_sets(parts)[0]
        assert first == set(parts.number[: dressed.V].tolist())
        assert len(first) == 4


def test_two_bodies_are_two_tries() -> None:
    one = sample(BODY)
    parts = Parts.of(together("two", one, second(one), floor(one, 4.0)))
    numbers = {frozenset([int(parts.number[0])]), frozenset([int(parts.number[one.V])])}
    found = set(candidate_sets(parts))
    assert numbers <= found
    a, b = numbers
    assert are_separate(parts, a, b) and not are_separate(parts, a, a | b)
    dressed = Parts.of(together("dressed", one, coat(one)))
    assert not are_separate(dressed, frozenset([1]), frozenset([2]))  # a coat is around its body


def test_thousands_of_parts_make_few_tries_at_once() -> None:
    body = sample(BODY)

    def prepared(count: int) -> Callable[[], tuple[Parts, list[frozenset[int]]]]:
        rng = np.random.default_rng(count)
        place = body.bounds.mean(0) + rng.uniform(-2, 2, (count, 1, 3))
        loose = Shape(
            (place + 0.01 * rng.standard_normal((count, 3, 3))).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)
        )

        def work() -> tuple[Parts, list[frozenset[int]]]:
            parts = Parts.of(together("loose", body, loose))
            found = list(candidate_sets(parts))
            assert len(parts) == count + 1 and 1 <= len(found) <= 6
            assert any(1 in each and len(each) < 0.2 * count for each in found)
            return parts, found

        return work

    grows_with_size(prepared, 24_000)


def test_one_part_leaves_nothing_to_try(sphere: Shape) -> None:
    assert candidate_sets(Parts.of(sphere)) == []


def test_parts_are_left_out_and_keep_their_places(three: Shape) -> None:
    rest = leave_out(three, [1, 3])
    assert rest.weights is not None and rest.weights.sum() == Parts.of(three).counts[1] + 1
    clean = repair(rest)
    assert clean.shape.area == pytest.approx(24) and len(clean.original_to_repaired) == three.V
    assert np.array_equal(Parts.of(rest).number, Parts.of(three).number)
    assert leave_out(three, []) is three


@pytest.mark.parametrize(
    ("choice", "area"),
    [({"only": 2}, 24), ({"only": "2"}, 24), ({"only": [1, "3"]}, 60), ({"without": 1}, 30),
     ({"only": [1, 2], "without": [1]}, 24)],
)  # fmt: skip
def test_parts_are_chosen_by_number(three: Shape, tmp_path: Path, choice: dict[str, int], area: float) -> None:
    for suffix in (".ply", ".stl"):
        save_shape(tmp_path / f"three{suffix}", three)
        chosen = load_shape(tmp_path / f"three{suffix}", **choice)
        assert chosen.V == load_shape(tmp_path / f"three{suffix}").V
        assert repair(chosen).shape.area == pytest.approx(area, rel=1e-6)


def named(path: Path, **meshes: Shape) -> Path:
    scene = trimesh.Scene()
    for name, shape in meshes.items():
        scene.add_geometry(shape.to_trimesh(), geom_name=name, node_name=name)
    path.write_bytes(scene.export(file_type="glb"))
    return path


def test_names_and_numbers_mix_and_a_name_goes_first(tmp_path: Path) -> None:
    small, middle, large = (box([4.0 * k, 0, 0], [4.0 * k + k, k, k]) for k in (1, 2, 3))
    path = named(tmp_path / "a.glb", hat=small, head=middle, body=large)
    both = load_shape(path, only=["hat", 1])
    assert both.weights is not None
    assert np.array_equal(both.weights > 0, np.isin(Parts.of(both).number, [1, 3]))
    path = named(tmp_path / "b.glb", **{"2": small, "head": middle, "body": large})
    assert repair(load_shape(path, only=2)).shape.area == pytest.approx(6, rel=1e-5)  # the mesh of that name


def test_wrong_numbers_are_told(three: Shape, tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    save_shape(tmp_path / "three.ply", three)
    save_shape(tmp_path / "ball.ply", make_sphere(2))
    save_shape(tmp_path / "cloud.xyz", Shape(make_sphere(2).verts, np.empty((0, 3), np.int64)))
    for wrong in ("4", "0", "99999999999999999999999"):
        with pytest.raises(InputError, match=r"three\.ply has no part") as caught:
            load_shape(tmp_path / "three.ply", only=wrong)
        assert "number of parts: three.ply: 3" in caught.value.hint
    with pytest.raises(InputError, match=r"cloud\.xyz has no part 1"):
        load_shape(tmp_path / "cloud.xyz", only=1)
    with pytest.raises(InputError, match=r"no part of three\.ply is left") as caught:
        load_shape(tmp_path / "three.ply", without=[1, 2, 3])
    assert caught.value.hint == "choose fewer parts to leave out"
    with pytest.raises(InputError, match=r"no part of ball\.ply is left") as caught:  # only the other's was meant
        load_shapes([tmp_path / "three.ply", tmp_path / "ball.ply"], without=1)
    assert "every file that has such a part: choose with --only" in caught.value.hint
    # of two files, one that lacks the number is not asked for it
    first, second = load_shapes([tmp_path / "three.ply", tmp_path / "ball.ply"], only=2)
    assert first.weights is not None and second.weights is None


def test_the_ground_of_two_triangles_has_no_base_of_its_own() -> None:
    """Rounding may put all of it above the plane through its own samples."""
    ball = icosphere(2)
    for seed in (127, 132, 170):
        rng = np.random.default_rng(seed)
        k = rng.uniform(1, 50)
        corners = np.array([[-k, -1, -k], [k, -1, -k], [k, -1, k], [-k, -1, k]])
        verts = np.concatenate([ball.verts, corners]) + k * rng.normal(size=3)
        faces = np.concatenate([ball.faces, ball.V + np.array([[0, 1, 2], [0, 2, 3]])])
        assert len(Parts.of(Shape(verts, faces), bases=True)) == 2
