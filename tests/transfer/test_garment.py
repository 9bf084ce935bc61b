"""What sits on one body, on another."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError, OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.garment import carry_garment
from tests.transfer.worn import LENGTH, RADIUS, bent, rod, same_numbers, sleeve, tube


def test_it_bends_with_the_body() -> None:
    body, cloth = rod(), sleeve()
    target = replace(body, verts=bent(body.verts))
    found = carry_garment(cloth, same_numbers(body, target), body, target)
    error = np.linalg.norm(found.verts - bent(cloth.verts), axis=1)
    assert error.mean() < 0.04 * RADIUS
    assert error.max() < 0.12 * RADIUS
    assert not len(found.sunk)
    # the top of the sleeve turns with the rod there
    top = found.turns[cloth.verts[:, 1] > 0.49].mean(axis=0)
    assert np.degrees(Rotation.from_matrix(top).magnitude()) == pytest.approx(np.degrees(0.5 * 0.6), abs=4)


def test_one_that_does_not_sit_on_the_body_is_known() -> None:
    body, cloth = rod(), sleeve()
    same = same_numbers(body, body)
    assert carry_garment(cloth, same, body, body).sits
    narrow = carry_garment(replace(cloth, verts=cloth.verts * [0.5, 1, 0.5]), same, body, body)
    assert not narrow.sits and narrow.below == 1 and narrow.far == 0
    wide = carry_garment(replace(cloth, verts=cloth.verts * [4, 1, 4]), same, body, body)
    assert not wide.sits and wide.below == 0 and wide.far > 0.9


def test_it_turns_and_grows_with_the_body_exactly() -> None:
    body, cloth = rod(), sleeve()
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0]).as_matrix()
    target = replace(body, verts=3.0 * body.verts @ turn.T + 5.0)
    found = carry_garment(cloth, same_numbers(body, target), body, target)
    assert np.allclose(found.verts, 3.0 * cloth.verts @ turn.T + 5.0, atol=1e-3)
    assert np.allclose(found.turns, turn, atol=1e-3)


def test_detail_stays_where_the_map_is_noisy() -> None:
    body, cloth = rod(), sleeve()
    rng = np.random.default_rng(0)
    beside = np.where(rng.random(body.V) < 0.3, rng.integers(0, body.V, body.V), np.arange(body.V))
    near = np.linalg.norm(body.verts[beside] - body.verts, axis=1) < 0.15
    wrong = replace(same_numbers(body, body), index=np.where(near, beside, np.arange(body.V)))
    exact, noisy = (carry_garment(cloth, way, body, body).verts for way in (same_numbers(body, body), wrong))
    assert np.allclose(exact, cloth.verts, atol=1e-3)
    edges = cloth.edges.vertices
    before, after = (np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in (cloth.verts, noisy))
    assert np.abs(after / before - 1).max() < 0.1


@pytest.mark.parametrize("inside_out", [False, True])
def test_what_would_sink_is_pushed_out(inside_out: bool) -> None:
    """From a prism of six sides to a round rod, which bulges between the prism's edges; whichever way faces run, which nodes
    of negative scale turn.
    """
    prism, round_rod = tube(RADIUS, LENGTH, 6, 41, "prism", closed=True), rod()
    if inside_out:
        prism, round_rod = (replace(each, faces=each.faces[:, ::-1]) for each in (prism, round_rod))
    ring = (24 * np.arange(41)[:, None] + 4 * np.arange(6)).ravel()
    found = VertexMap.between(prism, round_rod, np.append(ring, [round_rod.V - 2, round_rod.V - 1]))
    cloth = tube(1.0, 1.0, 24, 15, "cloth")
    angle = np.arctan2(cloth.verts[:, 0], cloth.verts[:, 2])
    flat = RADIUS * np.cos(np.pi / 6) / np.cos(angle % (np.pi / 3) - np.pi / 6) + 0.01
    cloth = replace(cloth, verts=cloth.verts * np.stack([flat, np.ones_like(flat), flat], axis=1))
    carried = carry_garment(cloth, found, prism, round_rod)
    radius = np.linalg.norm(carried.verts[:, [0, 2]], axis=1)
    assert radius.min() > RADIUS * np.cos(np.pi / 24)
    assert radius.max() < RADIUS + 0.02
    assert 0.2 * cloth.V < len(carried.pushed) <= cloth.V
    assert not len(carried.sunk)


def test_what_was_below_the_skin_stays_there() -> None:
    body = rod()
    inner = sleeve(-0.05)
    fat = replace(body, verts=body.verts * [1.3, 1.0, 1.3])
    carried = carry_garment(inner, same_numbers(body, fat), body, fat)
    assert (np.linalg.norm(carried.verts[:, [0, 2]], axis=1) < 1.25 * RADIUS).all()
    assert not len(carried.sunk)
    still = carry_garment(sleeve(0.0005), same_numbers(body, body), body, body)
    assert not len(still.pushed)


def test_seams_stay_closed() -> None:
    body, cloth = rod(), sleeve()
    corners = cloth.faces.ravel()
    soup = Shape(cloth.verts[corners], np.arange(len(corners)).reshape(-1, 3))
    target = replace(body, verts=bent(body.verts))
    whole, split = (carry_garment(each, same_numbers(body, target), body, target).verts for each in (cloth, soup))
    assert np.allclose(split, whole[corners], atol=1e-4)


def test_what_cannot_be_carried_is_refused() -> None:
    body, cloth = rod(), sleeve()
    far = replace(cloth, verts=100 * cloth.verts + 50)
    with pytest.raises(InputError, match="sleeve is not on rod") as caught:
        carry_garment(far, same_numbers(body, body), body, body)
    assert "unit" in caught.value.hint
    cloud = Shape(body.verts, np.empty((0, 3), np.int64), "points")
    with pytest.raises(InputError, match="points is a point cloud"):
        carry_garment(cloth, same_numbers(cloud, body), cloud, body)
    mirrored = replace(body, verts=body.verts * [-1, 1, 1], faces=body.faces[:, ::-1])
    with pytest.raises(OptionError, match="mirror image"):
        carry_garment(cloth, same_numbers(body, mirrored), body, mirrored)
    assert not len(carry_garment(cloth, same_numbers(body, cloud), body, cloud).pushed)
