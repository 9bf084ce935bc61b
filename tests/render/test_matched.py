"""A picture of a map: the target wears the colours of the places that are matched to it."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.maps.evaluate import CM_PER_UNIT, Errors
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render import matched
from meshmatch.render.colors import position_colors
from meshmatch.render.matched import (
    carried_colors,
    confidence_panels,
    error_panels,
    match_panels,
    render_match,
)
from meshmatch.render.picture import Look
from meshmatch.render.scales import UNKNOWN, Scale
from meshmatch.shapes.shape import Shape


def turned(shape: Shape, degrees: float, name: str) -> Shape:
    a = np.radians(degrees)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return Shape(3 * shape.verts @ about_y.T + 7, shape.faces, name)


def test_identity_brings_every_colour_to_its_place(cube: Shape) -> None:
    colors = position_colors(cube)
    carried = carried_colors(colors, VertexMap.identity(cube), cube, cube)
    assert np.allclose(carried, colors)


def test_colours_go_from_source_to_target(sphere: Shape) -> None:
    order = np.random.default_rng(0).permutation(sphere.V)
    place = np.argsort(order)
    shuffled = Shape(sphere.verts[order], place[sphere.faces], "shuffled")
    colors = position_colors(sphere)
    found = VertexMap.between(sphere, shuffled, place)
    assert carried_colors(colors, found, sphere, shuffled) == pytest.approx(colors[order])


def test_where_nothing_is_matched_to_the_target_is_grey(sphere: Shape) -> None:
    upper = sphere.verts[:, 1] > 0.2
    kept = sphere.faces[upper[sphere.faces].all(axis=1)]
    used = np.unique(kept)
    place = np.zeros(sphere.V, int)
    place[used] = np.arange(len(used))
    half = Shape(sphere.verts[used], place[kept], "half")
    found = VertexMap.between(half, sphere, used)
    colors = carried_colors(np.tile([1.0, 0, 0], (half.V, 1)), found, half, sphere)
    grey = (colors == UNKNOWN).all(axis=1)
    assert not grey[used].any()
    assert grey[sphere.verts[:, 1] < -0.2].all()


def test_both_shapes_are_seen_from_the_same_side(torus: Shape) -> None:
    other = turned(torus, 40.0, "other")
    found = VertexMap.between(torus, other, np.arange(torus.V))
    panels = match_panels(torus, other, found)
    here, there = (np.asarray(panel.rotation) for panel in panels)
    seen = [torus.verts @ here.T, (other.verts - 7) @ there.T / 3]
    assert seen[0] == pytest.approx(seen[1], abs=1e-6)
    assert [panel.label for panel in panels] == [torus.name, "other"]
    chosen = match_panels(torus, other, found, look=Look(up="z", front="x"))
    assert all(np.array_equal(panel.rotation, [[0, 1, 0], [0, 0, 1], [1, 0, 0]]) for panel in chosen)
    given = (np.eye(3), np.diag([-1.0, 1, -1]))
    kept = match_panels(torus, other, found, given, ("a", "b"))
    assert [panel.label for panel in kept] == ["a", "b"]
    assert all(np.array_equal(panel.rotation, turn) for panel, turn in zip(kept, given, strict=True))


def test_doubt_is_dark(sphere: Shape) -> None:
    confidence = np.where(sphere.verts[:, 0] > 0, 1.0, 0.2)
    found = VertexMap.between(sphere, sphere, np.arange(sphere.V), confidence=confidence)
    panels, scale = confidence_panels(sphere, sphere, found)
    assert (scale.low, scale.high) == (0, 1)
    for panel in panels:
        light = np.asarray(panel.colors).sum(axis=1)
        assert light[sphere.verts[:, 0] > 0.1].min() > light[sphere.verts[:, 0] < -0.1].max() + 0.5


def test_errors_at_all_vertices_are_painted(sphere: Shape) -> None:
    known = np.arange(sphere.V), np.arange(sphere.V)
    values = np.linspace(0, 0.05, sphere.V)
    panels, scale = error_panels(sphere, sphere, VertexMap.identity(sphere), known, Errors(values))
    assert "cm" in scale.title
    assert scale.high == pytest.approx(0.05 * CM_PER_UNIT, abs=2)
    for panel in panels:
        assert panel.points is None
        assert np.asarray(panel.colors) == pytest.approx(scale.colors(values * CM_PER_UNIT), abs=0.02)
    assert not scale.unknown


def test_errors_at_a_few_points_are_balls_where_they_are(sphere: Shape) -> None:
    known = np.array([5, 9, 5]), np.array([100, 200, 300])
    found = VertexMap.identity(sphere)
    panels, scale = error_panels(
        sphere, sphere, found, known, Errors([0.1, 0.3, 0.5]), "x100", ("a", "b"), (0.0, 40.0)
    )
    assert (scale.low, scale.high) == (0, 40)
    assert "sqrt(area)" in scale.title
    assert np.array_equal(panels[0].points, sphere.verts[[5, 9]])
    assert np.array_equal(panels[1].points, sphere.verts[[100, 200, 300]])
    assert np.asarray(panels[0].point_colors) == pytest.approx(scale.colors([30.0, 30.0]), abs=0.02)  # a mean
    assert [panel.label for panel in panels] == ["a", "b"]


def test_between_close_points_errors_are_painted_and_far_from_them_grey(sphere: Shape) -> None:
    left = np.flatnonzero(sphere.verts[:, 0] < 0.3)[::2]
    values = np.where(sphere.verts[left, 1] > 0, 0.04, 0.0)
    panels, scale = error_panels(sphere, sphere, VertexMap.identity(sphere), (left, left), Errors(values))
    colors = np.asarray(panels[0].colors)
    grey = (colors == UNKNOWN).all(axis=1)
    assert scale.unknown
    assert grey[sphere.verts[:, 0] > 0.8].all()
    assert not grey[sphere.verts[:, 0] < 0.2].any()
    high = (sphere.verts[:, 1] > 0.3) & (sphere.verts[:, 0] < 0.1)
    assert colors[high] == pytest.approx(scale.colors(np.full(high.sum(), 0.04 * CM_PER_UNIT)), abs=0.02)
    assert np.array_equal(panels[1].colors, panels[0].colors)


def test_errors_and_matches_become_pictures(
    sphere: Shape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Look | None] = []
    monkeypatch.setattr(matched, "render_shapes", lambda panels, path, look: looks.append(look))
    render_match(sphere, sphere, VertexMap.identity(sphere), tmp_path / "m.png")
    points = np.arange(3), np.arange(3)
    found = VertexMap.identity(sphere)
    matched.render_errors(
        sphere, sphere, found, points, Errors([0.0, 0.1, 0.2]), tmp_path / "e.png", unit="x100"
    )
    assert looks[0] is None
    assert looks[1] is not None
    assert isinstance(looks[1].legend, Scale)


def test_a_map_to_another_shape_is_refused(cube: Shape, sphere: Shape, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="leads to"):
        render_match(cube, sphere, VertexMap.identity(cube), tmp_path / "p.png")
    assert list(tmp_path.iterdir()) == []
