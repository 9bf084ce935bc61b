"""Attributes in Python: from a map at hand, as files and as arrays; nothing is fitted."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import meshmatch
from meshmatch import ConfidenceRule
from meshmatch.api import matching
from meshmatch.api.results import MapPair
from meshmatch.api.transfer import have_same_faces
from meshmatch.errors import InputError, MeshmatchError, MeshmatchWarning, OptionError
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.picture import Look
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from tests.conftest import icosphere
from tests.transfer.known import split


@pytest.fixture(autouse=True)
def no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def begun(*_: object, **__: object) -> None:
        raise AssertionError("a fit began")

    monkeypatch.setattr(matching.Matcher, "_fit_all", begun)


def test_a_map_at_hand_is_turned_round() -> None:
    coarse = icosphere(1)
    fine, forward, back = split(coarse)
    maps = meshmatch.find_maps(coarse, fine, forward)
    assert maps.match is None
    assert np.array_equal(maps.forward.index, forward.index)
    assert np.allclose(maps.backward.points(coarse), back.points(coarse), atol=1e-12)
    assert meshmatch.find_maps(coarse, fine, maps) is maps
    assert meshmatch.find_maps(coarse, fine, lambda source, target: MapPair(source, target, forward)).match is None


def test_two_poses_of_a_mesh_need_no_match(pair: tuple[Shape, Shape, VertexMap]) -> None:
    sphere, other, true = pair
    maps = meshmatch.find_maps(sphere, other)
    for found in (maps.forward, maps.backward):
        np.testing.assert_array_equal(found.index, true.index)
        assert found.verdict == "unknown" and np.isnan(found.confidence).all()
    values = np.arange(float(sphere.V))
    np.testing.assert_array_equal(meshmatch.transfer_values(sphere, other, values).data, values)
    for collapsed in (np.ones_like(sphere.verts), sphere.verts * [1, 0, 0]):  # to a point, to a line
        for pair in (
            (sphere, Shape(collapsed, sphere.faces, "flat")),
            (Shape(collapsed, sphere.faces, "flat"), sphere),
        ):
            with pytest.raises(InputError, match="flat has no surface area"):
                meshmatch.find_maps(*pair)
    assert not have_same_faces(sphere, Shape(other.verts, np.roll(other.faces, 1, axis=1)))
    assert not have_same_faces(Shape(sphere.verts, sphere.faces[:0]), Shape(other.verts, other.faces[:0]))


def test_shapes_and_map_may_be_files(tmp_path: Path) -> None:
    save_shape(tmp_path / "a.ply", icosphere(1))
    a = load_shape(tmp_path / "a.ply")
    save_shape(tmp_path / "b.ply", split(a)[0])
    fine, forward, _ = split(a)
    save_map(tmp_path / "ab.npy", forward)
    maps = meshmatch.find_maps(tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "ab.npy")
    assert (maps.backward.source, maps.backward.target) == ("b.ply", "a.ply")
    assert maps.backward.source_vertices == fine.V
    with pytest.raises(InputError, match=r"ab\.npy runs the wrong way: from a\.ply to b\.ply"):
        meshmatch.find_maps(tmp_path / "b.ply", tmp_path / "a.ply", tmp_path / "ab.npy")


@pytest.fixture
def pair() -> tuple[Shape, Shape, VertexMap]:
    """A sphere, the same one turned, moved and twice as large, and the true map."""
    sphere = icosphere(3)
    other = Shape(2.0 * sphere.verts @ TURN.T + 7.0, sphere.faces, "other")
    return sphere, other, VertexMap.between(sphere, other, np.arange(sphere.V), verdict="good")


TURN = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def test_directions_turn_with_the_surface(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    result = meshmatch.transfer_values(source, target, source.vertex_normals, found, directions=True)
    assert np.allclose(result.data, target.vertex_normals, atol=1e-6)
    field = np.cross(source.vertex_normals, [0.0, 0, 1])  # along the surface, of any length
    turned = meshmatch.transfer_values(source, target, field, found, directions=True).data
    length = np.linalg.norm(field, axis=1)
    long = length > 0.1
    assert np.allclose(turned[long], (field @ TURN.T)[long] / length[long, None], atol=1e-3)
    # as plain numbers they stay as they are
    assert np.allclose(meshmatch.transfer_values(source, target, field, found).data, field)


def test_a_mirrored_surface_is_no_rotation(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, _, _ = pair
    mirrored = Shape(source.verts * [-1.0, 1, 1], source.faces[:, ::-1], "mirrored")
    found = VertexMap.between(source, mirrored, np.arange(source.V))
    result = meshmatch.transfer_values(source, mirrored, source.vertex_normals, found, directions=True)
    assert np.einsum("ni,ni->n", result.data, mirrored.vertex_normals).min() > 0.8


def test_arrays_of_all_kinds(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    V = source.V
    colors = np.random.default_rng(0).random((V, 3))
    assert np.allclose(meshmatch.transfer_colors(source, target, found, colors=colors).data[:, :3], colors)
    words = np.where(source.verts[:, 0] > 0, "left", "right")
    labels = meshmatch.transfer_labels(source, target, words, found)
    assert np.array_equal(labels.data.values, words)
    assert labels.low.low == 0
    of_faces = meshmatch.transfer_labels(source, target, words, found, to="faces")
    assert np.allclose(of_faces.confidence, labels.confidence[target.faces].mean(axis=1))
    weights = np.eye(3)[np.arange(V) % 3]
    assert np.allclose(meshmatch.transfer_weights(source, target, weights, found).data.matrix.toarray(), weights)
    points = meshmatch.transfer_landmarks(source, target, [3, 5], found).data
    assert np.allclose(points.points, target.verts[[3, 5]])
    places = meshmatch.transfer_landmarks(source, target, source.verts[[3, 5]], found).data
    assert np.allclose(places.points, points.points)


def test_landmarks_that_are_not_trusted_are_missing(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    unsure = replace(found, confidence=np.where(np.arange(source.V) == 5, 0.2, 0.9))
    moved = meshmatch.transfer_landmarks(source, target, [3, 5], unsure)
    assert moved.data.missing.tolist() == [False, True]
    assert moved.confidence == pytest.approx([0.9, 0.2])
    assert (moved.low.low, moved.low.blank) == (1, 1)
    every = meshmatch.transfer_landmarks(source, target, [3, 5], unsure, rule=meshmatch.ConfidenceRule(0))
    assert np.allclose(every.data.points, target.verts[[3, 5]])


def test_what_is_not_trusted_is_kept_filled_or_blank(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, _ = pair
    confidence = np.ones(source.V, np.float32)
    confidence[10] = 0.1
    doubtful = VertexMap.between(source, target, np.arange(source.V), confidence=confidence)
    values = source.verts[:, 0].copy()
    values[10] = 99.0

    def at_ten(**rule: object) -> float:
        result = meshmatch.transfer_values(source, target, values, doubtful, rule=ConfidenceRule(**rule))  # type: ignore[arg-type]
        assert result.low.low == 1
        return float(result.data[10])

    assert at_ten() == 99.0
    assert at_ten(blank=-1.0) == -1.0
    assert abs(at_ten(fill=True) - source.verts[10, 0]) < 0.05
    with pytest.raises(OptionError, match="contradict"):
        ConfidenceRule(fill=True, blank=0.0)
    for minimum in (2.0, "a"):
        with pytest.raises(OptionError, match=r"lies in 0\.\.1"):
            ConfidenceRule(minimum=minimum)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("call", "words", "told"),
    [
        ("transfer_values", (np.zeros(5),), r"values must be an array of \(642,\)"),
        ("transfer_values", (np.zeros((642, 2, 2)),), "values must be an array"),
        ("transfer_labels", (np.zeros(7, int),), "7 labels"),
        ("transfer_weights", (-np.ones((642, 2)),), "negative"),
        ("transfer_values", (["a"] * 642,), "values must be numbers"),
        ("transfer_landmarks", ([642],), "landmark 0 is vertex 642"),
        ("transfer_landmarks", ([[1.0, 2.0]],), "landmarks cannot be an array"),
        ("transfer_values", (1j * np.ones(642),), "values must be numbers"),
    ],
)
def test_what_does_not_belong_to_the_source(
    pair: tuple[Shape, Shape, VertexMap], call: str, words: tuple[object, ...], told: str
) -> None:
    source, target, found = pair
    with pytest.raises(MeshmatchError, match=told):
        getattr(meshmatch, call)(source, target, *words, found)


def test_directions_are_checked_before_the_shapes_are_matched(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, _ = pair
    with pytest.raises(InputError, match=r"directions must be an array of \(642, 3\), not \(642, 2\)"):
        meshmatch.transfer_values(
            source, target, np.zeros((642, 2)), lambda *_: pytest.fail("matched"), directions=True
        )


@pytest.mark.parametrize("influences", [0, 1.5, "4"])
def test_influences_are_counted(pair: tuple[Shape, Shape, VertexMap], influences: Any) -> None:
    source, target, found = pair
    with pytest.raises(OptionError, match="influences must be an integer of 1 or more"):
        meshmatch.transfer_weights(source, target, np.ones((642, 2)), found, influences=influences)


def test_colors_that_are_not_there(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    with pytest.raises(InputError, match="has no vertex colors"):
        meshmatch.transfer_colors(source, target, found)
    with pytest.raises(OptionError, match="3 or 4 numbers within"):
        meshmatch.transfer_colors(source, target, found, colors=np.full((source.V, 3), 2.0))


def test_a_texture_is_baked_and_saved(pair: tuple[Shape, Shape, VertexMap], tmp_path: Path) -> None:
    source, target, found = pair
    red = Shape(source.verts, source.faces, "red", np.tile([1.0, 0, 0, 1], (source.V, 1)))
    options = meshmatch.BakeOptions(size=64)
    seen: list[tuple[str, float]] = []
    result = meshmatch.transfer_texture(
        red, target, found, options=options, progress=lambda stage, name, share: seen.append((stage, share))
    )
    assert list(dict.fromkeys(stage for stage, _ in seen)) == ["texture coordinates", "baking"]
    shares = [share for stage, share in seen if stage == "texture coordinates"]
    assert shares == sorted(shares) and (shares[0], shares[-1]) == (0.0, 1.0) and len(set(shares)) > 8
    assert result.baked.image.shape == (64, 64, 4)
    assert (np.median(result.baked.image.reshape(-1, 4), axis=0)[:3] == [255, 0, 0]).all()
    result.save(tmp_path / "b.glb")
    assert load_shape(tmp_path / "b.glb").V >= target.V
    with pytest.raises(OptionError, match="cannot write a texture"):
        result.save(tmp_path / "b.ply")


def test_evaluate_takes_arrays(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    result = meshmatch.evaluate(found, source, target, np.arange(source.V))
    assert result.errors is not None and result.errors.mean == 0
    two = meshmatch.evaluate(found, source, target, ([1, 2], [1, 2]))
    assert two.errors is not None and len(two.errors.values) == 2
    with pytest.raises(InputError, match="the truth has"):
        meshmatch.evaluate(found, source, target, ([1, 2], [1]))


def test_pictures_and_pages(pair: tuple[Shape, Shape, VertexMap], tmp_path: Path) -> None:
    source, target, found = pair
    look = Look(size=(160, 100))
    plain = meshmatch.picture([source, target], tmp_path / "two.png", look=look, names=["one", "other"])
    assert plain == (160, 100)
    for number, given in enumerate(
        ({"match": found}, {"values": [source.verts[:, 0]] * 2}, {"labels": [[0] * 642] * 2})
    ):
        meshmatch.picture([source, target], tmp_path / f"{number}.png", look=look, **given)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="match and values do not go together"):
        meshmatch.picture([source, target], tmp_path / "no.png", match=found, values=[[0.0] * 642] * 2)
    with pytest.raises(OptionError, match="2 shapes need as many values, not 1"):
        meshmatch.picture([source, target], tmp_path / "no.png", values=[[0.0] * 642])
    page = meshmatch.view(source, target, tmp_path / "ab.html", found)
    assert page.size == (tmp_path / "ab.html").stat().st_size
    assert not (tmp_path / "no.png").exists()


@pytest.mark.parametrize("wrong", [3, np.zeros(642, int), "fit"])
def test_what_is_no_map_is_refused(pair: tuple[Shape, Shape, VertexMap], wrong: Any) -> None:
    source, target, found = pair
    with pytest.raises(MeshmatchError):
        meshmatch.transfer_values(source, target, np.zeros(642), wrong)
    with pytest.raises(MeshmatchError):
        meshmatch.evaluate(wrong, source, target)
    with pytest.raises(InputError, match="truth"):
        meshmatch.evaluate(found, source, target, np.full(642, 0.5))


def test_maps_found_for_other_shapes_are_refused(pair: tuple[Shape, Shape, VertexMap], cube: Shape) -> None:
    source, target, found = pair
    maps = meshmatch.find_maps(source, target, found)
    with pytest.raises(InputError):
        meshmatch.transfer_values(cube, target, np.zeros(cube.V), maps)


def test_blanks_that_do_not_fit(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    for blank in ("red", (1.0, 2.0, 3.0)):
        with pytest.raises(MeshmatchError, match="blank"):
            meshmatch.transfer_values(source, target, np.zeros(642), found, rule=ConfidenceRule(blank=blank))
    doubtful = VertexMap.between(source, target, found.index, confidence=np.zeros(source.V, np.float32))
    painted = meshmatch.transfer_colors(
        source, target, doubtful, colors=np.ones((642, 3)), rule=ConfidenceRule(blank=(1.0, 0.0, 0.0))
    )
    assert np.allclose(painted.data[painted.confidence < 0.3], [1, 0, 0, 1]) and painted.low.blank
    with pytest.raises(OptionError, match="edges"):
        meshmatch.transfer_labels(source, target, np.zeros(642, int), found, to="edges")  # type: ignore[arg-type]


def test_textures_that_cannot_be_baked(pair: tuple[Shape, Shape, VertexMap]) -> None:
    source, target, found = pair
    with pytest.raises(InputError, match="neither a texture nor colors"):
        meshmatch.transfer_texture(source, target, found)
    with pytest.raises(OptionError, match="invalid uv"):
        meshmatch.transfer_texture(source, target, found, uv="bogus")  # type: ignore[arg-type]
    for choice in ({"workers": 0}, {"fill": True, "blank": (0.0, 0.0, 0.0, 1.0)}, {"size": 0}):
        with pytest.raises(OptionError):
            meshmatch.transfer_texture(source, target, found, options=meshmatch.BakeOptions(**choice))  # type: ignore[arg-type]


def test_pictures_and_pages_that_cannot_be(pair: tuple[Shape, Shape, VertexMap], tmp_path: Path) -> None:
    source, target, found = pair
    file = tmp_path / "a.png"
    for shapes, choice, told in (
        (source, {}, "a list of shapes"),
        ("a.ply", {}, "a list of shapes"),
        ((source.verts, source.faces), {}, "a list of shapes"),
        ([source], {"values": [np.zeros(3)]}, "values of .* must be an array"),
        ([source], {"values": [["a"] * 642]}, "must be numbers"),
    ):
        with pytest.raises(MeshmatchError, match=told):
            meshmatch.picture(shapes, file, **choice)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match=r"^a\.jpg: a picture is a PNG"):
        meshmatch.picture([source], tmp_path / "a.jpg")
    with pytest.raises(InputError, match="expected a path, not NoneType"):
        meshmatch.picture([source], None)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="two names"):
        meshmatch.view(source, target, tmp_path / "a.html", found, names=["one"])
    with pytest.raises(OptionError, match="threads"):
        meshmatch.view(source, target, tmp_path / "a.html", found, threads=0)
    assert not list(tmp_path.iterdir())


def test_distances_of_surfaces_are_in_the_unit_of_the_file(sphere: Shape) -> None:
    """Two spheres 5 mm apart, in millimetres and turned inside; of a part and of a cloud only from there."""
    one, other = (Shape(radius * sphere.verts, sphere.faces) for radius in (100.0, 105.0))
    found = meshmatch.measure_distance(one, other)
    assert found.mean == pytest.approx(5.0, rel=0.01) and found.most == pytest.approx(5.0, rel=0.01)
    assert str(found) == "surfaces lie 5 apart on average, 5 at most, in the unit of the file"
    as_person = meshmatch.measure_distance(one, other, unit="cm")
    assert as_person.mean == pytest.approx(5.0 * 100 * np.sqrt(1.9 / other.area), rel=0.01)
    assert str(as_person).endswith("at most, on a body of 1.9 square metres of skin")
    assert meshmatch.measure_distance(one, other, unit="x100").as_dict()["unit"] == "x100"
    half = Shape(one.verts, one.faces[one.verts[one.faces].mean(1)[:, 0] > 0])
    assert meshmatch.measure_distance(half, other).most > 50
    for part in (meshmatch.measure_distance(half, other, one_way=True), meshmatch.measure_distance(half.verts, other)):
        assert part.most == pytest.approx(5.0, rel=0.01)
    turn, k = 2 * np.pi * np.arange(40) / 40, np.arange(40)
    rim, after, fan = np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1), (k + 1) % 40, np.zeros(38, int)
    sides = [[k, after, k + 40], [after, after + 40, k + 40]]
    ends = [[fan, k[2:], k[1:-1]], [fan + 40, k[1:-1] + 40, k[2:] + 40]]
    cut = Shape(
        np.concatenate([rim, rim + np.array([0, 0, 3])]),
        np.concatenate([np.stack(each, axis=1) for each in sides + ends]),
    )
    fine = trimesh.Trimesh(cut.verts, cut.faces).subdivide().subdivide()
    many = Shape(np.asarray(fine.vertices), np.asarray(fine.faces, np.int64))
    assert meshmatch.measure_distance(many, cut).most < 1e-9  # its ends are flat, of triangles that reach far
    with pytest.raises(InputError, match="no faces"):
        meshmatch.measure_distance(one, other.verts)
    with pytest.raises(OptionError, match="invalid unit"):
        meshmatch.measure_distance(one, other, unit="mm")  # type: ignore[arg-type]


def test_landmarks_that_are_missing_or_off_the_surface_are_told(
    pair: tuple[Shape, Shape, VertexMap], tmp_path: Path
) -> None:
    sphere, other, true = pair
    file = tmp_path / "marks.json"
    file.write_text('{"first": 3, "gone": -1, "second": 5}')
    with pytest.warns(MeshmatchWarning, match="landmark gone is vertex -1: left out"):
        found = meshmatch.transfer_landmarks(sphere, other, file, true).data
    assert found.names == ("first", "second")
    with pytest.warns(MeshmatchWarning, match="the nearest point of the surface is used"):
        meshmatch.transfer_landmarks(sphere, other, 1.2 * sphere.verts[:2], true)
