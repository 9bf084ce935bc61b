"""Which way up a shape is shown, and from which side."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.facing import guess_rotation, rotation_by_map, rotation_like, snap_upright
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import load_template
from tests.conftest import icosphere
from tests.render.test_picture import box

AXES = {sign + name: (-1 if sign else 1) * np.eye(3)[k] for k, name in enumerate("xyz") for sign in ("", "-")}


def joined(*parts: Shape) -> Shape:
    starts = np.cumsum([0, *(part.V for part in parts[:-1])])
    return Shape(
        np.concatenate([part.verts for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
    )


def body() -> Shape:
    """A standing template: y up, z to the front, the left hand at +x."""
    return load_template(bundled_folder() / "human" / "human-A.safetensors").shape


def moved(shape: Shape, rotation: np.ndarray) -> Shape:
    return Shape(17 * shape.verts @ rotation.T + [3.0, -90, 1], shape.faces, shape.name)


@pytest.mark.parametrize("up", AXES)
@pytest.mark.parametrize("front", AXES)
def test_named_axes_are_taken_as_they_are(up: str, front: str) -> None:
    shape = box((1, 1.1, 1.2))
    if up[-1] == front[-1]:
        with pytest.raises(OptionError, match="the same axis"):
            guess_rotation(shape, up, front)
        return
    rotation = guess_rotation(shape, up, front)
    assert rotation @ AXES[up] == pytest.approx([0, 1, 0])
    assert rotation @ AXES[front] == pytest.approx([0, 0, 1])
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_an_invalid_axis_is_refused() -> None:
    for words in ({"up": "w"}, {"front": "up"}, {"up": ""}, {"front": "xx"}):
        with pytest.raises(OptionError, match="invalid axis"):
            guess_rotation(box((1, 1, 1)), **words)


def test_a_block_shows_its_broad_side_with_y_or_its_length_up() -> None:
    assert guess_rotation(box((1, 1, 1)))[1].tolist() == [0, 1, 0]
    assert np.array_equal(guess_rotation(box((0.5, 0.3, 1.8))), [[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    assert guess_rotation(box((1, 2, 3)), front="z")[1].tolist() == [0, 1, 0]
    flat = guess_rotation(box((0.2, 1, 1)))
    assert np.abs(flat[2]).tolist() == [1, 0, 0]


@pytest.mark.parametrize("degrees", [0.0, 100.0, 215.0])
@pytest.mark.parametrize("up", ["x", "y", "z"])
def test_a_body_faces_the_viewer_however_it_stands_in_its_file(up: str, degrees: float) -> None:
    a = np.radians(degrees)
    spin = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    to_file = np.roll(np.eye(3), "yzx".index(up), axis=0)  # y becomes the file's up
    turn = to_file @ spin
    shape = moved(body(), turn)
    rotation = guess_rotation(shape)
    assert rotation @ turn @ [0, 1, 0] == pytest.approx([0, 1, 0], abs=1e-9)
    assert (rotation @ turn @ [0, 0, 1])[2] > np.cos(np.radians(25))
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_a_body_as_a_cloud_and_a_body_without_a_place_somewhere() -> None:
    shape = body()
    assert guess_rotation(Shape(shape.verts, None))[2, 2] > 0.9
    verts = np.concatenate([shape.verts, [[900.0, 900, 900]]])
    broken = Shape(verts, shape.faces, invalid=np.arange(len(verts)) == shape.V)
    assert guess_rotation(broken) == pytest.approx(guess_rotation(shape))
    assert guess_rotation(Shape(verts[broken.invalid == 0], None)) == pytest.approx(  # type: ignore[index]
        guess_rotation(Shape(verts, None, invalid=broken.invalid))
    )


@pytest.mark.parametrize("name", ["climber.ply", "dancer.ply"])
def test_the_samples_stand_upright(name: str) -> None:
    shape = load_shape(bundled_folder() / "samples" / name)
    height = shape.verts @ guess_rotation(shape)[1]
    assert np.ptp(height) > 0.95 * np.ptp(shape.verts, axis=0).max()


def test_what_would_fall_over_lies() -> None:
    """A quadruped, long along x: it does not stand on its tail."""
    trunk = box((2.0, 0.5, 0.5), (0, 1.0, 0))
    legs = [box((0.15, 0.8, 0.15), (x, 0.4, z)) for x in (-0.8, 0.8) for z in (-0.15, 0.15)]
    head = box((0.4, 0.3, 0.3), (1.3, 1.3, 0))
    animal = joined(trunk, *legs, head)
    assert guess_rotation(animal)[1].tolist() == [0, 1, 0]


def test_another_shape_is_seen_from_the_same_side(torus: Shape) -> None:
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    seen = torus.verts @ guess_rotation(torus).T
    other = moved(torus, turn)
    rotation = rotation_like(other, other.verts, seen)
    there = (other.verts - other.verts.mean(axis=0)) @ rotation.T / 17
    assert there == pytest.approx(seen - seen.mean(axis=0), abs=1e-9)


def test_dense_vertices_do_not_turn_the_other_shape_around() -> None:
    """A hand has many vertices and little surface: where it goes says little about the side."""
    hand = icosphere(3)
    trunk = box((1.0, 3.0, 0.6))
    stretched, folded = (
        joined(trunk, Shape(0.05 * hand.verts + [side * 1.5, 0.5, 0.4], hand.faces)) for side in (1.0, -1.0)
    )
    same = VertexMap.between(stretched, folded, np.arange(stretched.V))
    assert rotation_by_map(stretched, folded, same, np.eye(3))[2, 2] > 0.9


def test_arms_that_cross_do_not_turn_the_other_shape_around() -> None:
    """They have much surface, far from the middle; but their normals look to all sides."""
    trunk, arm, place = box((1.0, 3.0, 0.6)), box((2.0, 0.4, 0.4)), np.array([2.0, 0.5, 0.0])
    left, right = Shape(arm.verts + place, arm.faces), Shape(arm.verts + place * [-1, 1, 1], arm.faces)
    stretched, folded = joined(joined(trunk, left), right), joined(joined(trunk, right), left)
    same = VertexMap.between(stretched, folded, np.arange(stretched.V))
    assert rotation_like(folded, folded.verts, stretched.verts, stretched.vertex_areas)[2, 2] < 0
    assert rotation_by_map(stretched, folded, same, np.eye(3))[2, 2] > 0.9
    inside_out = Shape(folded.verts, folded.faces[:, ::-1])
    assert rotation_by_map(stretched, inside_out, replace(same, target_faces=None), np.eye(3))[2, 2] > 0.9


def test_a_standing_body_stays_upright_beside_one_that_leans() -> None:
    shape = body()
    b = np.radians(20)
    leaning = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    rotation = rotation_like(shape, shape.verts, shape.verts @ leaning.T)
    assert rotation == pytest.approx(np.eye(3), abs=1e-6)


def rotation_about(axis: list[float], degrees: float) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(np.radians(degrees) * np.array(axis)).as_matrix())


def test_the_frame_of_a_torso_that_leans_is_made_upright() -> None:
    frame = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]])  # z up, x to the front
    leaning = rotation_about([1, 0, 0], 25) @ frame
    assert snap_upright(leaning) == pytest.approx(frame)
    turned = rotation_about([0, 1, 0], 40) @ frame
    assert snap_upright(rotation_about([0, 0, 1], -20) @ turned)[1] == pytest.approx([0, 0, 1])
    assert snap_upright(turned) == pytest.approx(turned)
    for lying in (rotation_about([1, 0, 0], 44) @ frame, rotation_about([0, 0, 1], 40) @ frame):
        assert np.array_equal(snap_upright(lying), lying)  # between two axes: as the fit says
    assert snap_upright(-np.diag([-1.0, 1, 1])) == pytest.approx(-np.diag([-1.0, 1, 1]))


def test_a_map_to_one_point_says_nothing_about_the_side(torus: Shape) -> None:
    points = np.tile(torus.verts[:1], (9, 1))
    assert np.array_equal(rotation_like(torus, points, torus.verts[:9]), guess_rotation(torus))


def test_real_bodies_face_the_viewer(bench: Path) -> None:
    """SCAPE lies along x in its files, and faces -z; FAUST stands along y and faces z."""
    for name, up, front in (("scape/mesh000.ply", 0, None), ("faust/tr_reg_000.ply", 1, [0, 0, 1])):
        rotation = guess_rotation(load_shape(bench / name))
        assert rotation[1] == pytest.approx(np.eye(3)[up])
        if front is not None:
            assert rotation[2] @ front > 0.9
