"""People who touch themselves: contacts, the surface around them, and true places where two parts meet."""

import numpy as np
import pytest
import torch

from meshmatch.experiments.makers.character_designs import people_in_contact, places_on
from meshmatch.experiments.makers.contact_poses import POSES, contact_depths, contact_poses, far_neighbours, skin_points
from meshmatch.experiments.makers.fused_surface import fused_surface, occupied
from meshmatch.generators.bodies import draw_identities, template_rig
from meshmatch.generators.figure import Figure, part
from meshmatch.geometry.triangles import face_parts, is_watertight
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import read_template
from tests.conftest import icosphere

RADIUS = 0.1


def balls(apart: float) -> Shape:
    """Two balls side by side, their middles so far apart."""
    one = icosphere(3)
    verts = np.concatenate([RADIUS * one.verts, RADIUS * one.verts + [apart, 0, 0]])
    return Shape(verts, np.concatenate([one.faces, one.faces + one.V]))


def volume(shape: Shape) -> float:
    a, b, c = (shape.verts[shape.faces[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def test_a_grid_knows_the_inside_of_balls_that_run_into_each_other() -> None:
    pair, step = balls(1.2 * RADIUS), 0.01
    low = np.array([-0.155, -0.155, -0.155])
    inside = occupied(pair, low, (45, 31, 31), step)
    points = low + step * np.stack(np.meshgrid(*(np.arange(n) for n in inside.shape), indexing="ij"), -1)
    from_middles = np.minimum(*(np.linalg.norm(points - [x, 0, 0], axis=-1) for x in (0, 1.2 * RADIUS)))
    sure = np.abs(from_middles - RADIUS) > 0.002  # triangles cut the ball's surface off
    assert np.array_equal(inside[sure], (from_middles < RADIUS)[sure])
    assert inside.any() and sure.mean() > 0.9


@pytest.mark.parametrize("gap", [-0.08, 0.008])
def test_balls_that_touch_become_one_surface(gap: float) -> None:
    pair = balls(2 * RADIUS + gap)
    fused = fused_surface(pair, 0.006)
    assert is_watertight(fused.faces) and face_parts(fused.faces, fused.V).max() == 0
    one = 4 / 3 * np.pi * RADIUS**3
    cap = np.pi * (gap / 2) ** 2 * (RADIUS + gap / 6) if gap < 0 else 0.0
    assert volume(fused) == pytest.approx(2 * one - 2 * cap, rel=0.03)


def test_of_balls_that_are_apart_the_surface_has_the_larger_part_alone() -> None:
    fused = fused_surface(balls(2 * RADIUS + 0.03), 0.006)
    assert np.ptp(fused.verts[:, 0]) == pytest.approx(2 * RADIUS, rel=0.03)


def test_where_two_parts_meet_the_place_is_on_the_part_whose_normal_is_alike() -> None:
    pair = balls(2 * RADIUS)  # (0.1, 0, 0) lies on both
    half = pair.V // 2
    moved = Shape(pair.verts + np.array([0.004, 0, 0]), pair.faces)
    near = np.flatnonzero(np.linalg.norm(pair.verts - [RADIUS, 0, 0], axis=1) < 0.03)
    found = places_on(pair, moved)[near]
    assert np.array_equal(found >= half, near >= half)
    assert {False, True} == set((near >= half).tolist())


def test_neighbours_are_far_along_the_body_and_depth_is_along_the_normal() -> None:
    rest, posed = balls(5 * RADIUS), balls(2 * RADIUS - 0.02)
    half = rest.V // 2
    other = far_neighbours(posed.verts, rest.verts)
    near = np.flatnonzero(np.abs(posed.verts[:, 0] - RADIUS) < 0.01)
    assert np.array_equal(other[near] >= half, near < half)
    assert other[np.argmin(posed.verts[:, 0])] == -1
    touches, depth = contact_depths(posed.verts, rest.verts, rest.faces)
    tip = int(np.argmax(np.where(np.arange(rest.V) < half, posed.verts[:, 0], -1)))
    assert depth[tip] == pytest.approx(0.02, abs=0.002)
    assert touches.any() and not touches[np.argmin(posed.verts[:, 0])]


@pytest.mark.slow
def test_hands_lie_on_what_they_are_to_touch_and_not_in_it() -> None:
    pytest.importorskip("anny")
    figure = Figure.of(template_rig(read_template("human-T"), 64, 1))
    names = ["hands on the face", "crossed legs, hands on the knees"]
    rest, heads = draw_identities(figure.rig, 2, torch.Generator().manual_seed(3))
    posed, points = contact_poses(figure, rest, heads, names, 3), skin_points(figure)
    hands = np.isin(figure.share.argmax(1), [part("hand", side) for side in "LR"])
    for verts, own, name in zip(posed.double().numpy(), rest.double().numpy(), names, strict=True):
        for one, two in POSES[name].touching[:2]:  # the hands'
            assert np.linalg.norm(verts[points[one]] - verts[points[two]]) < 0.06
        touches, depth = contact_depths(verts, own, figure.rig.faces.numpy())
        assert touches[hands].sum() > 10
        assert np.quantile(depth[hands], 0.98) < 0.01 and depth[hands].max() < 0.02


@pytest.mark.slow
def test_people_touch_themselves_and_their_fused_surface_has_places_on_the_body() -> None:
    pytest.importorskip("anny")
    template = read_template("human-T")
    plain, fused = (people_in_contact(template, 2, 0, "x", each) for each in (False, True))
    assert list(POSES)[1] == "hands on the face"
    for loose, one in zip(plain, fused, strict=True):
        assert np.array_equal(loose.body.verts, one.body.verts)
        away = np.linalg.norm(one.body.verts[one.places] - one.shape.verts, axis=1)
        assert np.quantile(away, 0.99) < 0.025 and away.max() < 0.05  # metres
        alike = (one.body.vertex_normals[one.places] * one.shape.vertex_normals).sum(1)
        assert (alike > 0).mean() > 0.999
        # What has become one has handles that the body had not.
        assert _euler(one.shape) < _euler(loose.shape)


def _euler(shape: Shape) -> int:
    edges = np.unique(np.sort(shape.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    return shape.V - len(edges) + shape.F
