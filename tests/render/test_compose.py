"""What pictures show: the target has the colors of the places matched to it, errors and distances are where they are."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.errors import InputError, OptionError
from meshmatch.maps.evaluate import CM_PER_UNIT, X100, Errors
from meshmatch.maps.mapped_mesh import invert_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render import compose
from meshmatch.render.compose import (
    Composition,
    compose_confidence,
    compose_errors,
    compose_fit,
    compose_match,
    compose_shapes,
    compose_values,
    distances,
    matched_colors,
    merge_labels,
)
from meshmatch.render.picture import Look
from meshmatch.render.scales import CLAY, Scale, position_colors
from meshmatch.shapes.colors import UNKNOWN
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import load_template
from meshmatch.transfer.label_files import Labels


def turned(shape: Shape, degrees: float, name: str) -> Shape:
    a = np.radians(degrees)
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    return Shape(3 * shape.verts @ about_y.T + 7, shape.faces, name)


def carried_colors(colors: np.ndarray, found: VertexMap, source: Shape, target: Shape) -> np.ndarray:
    return matched_colors(colors, found, invert_map(found, source, target), source)


def scale_of(shown: Composition) -> Scale:
    assert isinstance(shown.legend, Scale)
    return shown.legend


def test_colors_go_from_source_to_target(sphere: Shape) -> None:
    """Of the same sphere, its vertices in another order: the identity is one of them."""
    for order in (np.arange(sphere.V), np.random.default_rng(0).permutation(sphere.V)):
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
    panels = compose_match(torus, other, found).panels
    here, there = (np.asarray(panel.rotation) for panel in panels)
    seen = [torus.verts @ here.T, (other.verts - 7) @ there.T / 3]
    assert seen[0] == pytest.approx(seen[1], abs=1e-6)
    assert [panel.label for panel in panels] == [torus.name, "other"]
    chosen = compose_match(torus, other, found, look=Look(up="z", front="x")).panels
    assert all(np.array_equal(panel.rotation, [[0, 1, 0], [0, 0, 1], [1, 0, 0]]) for panel in chosen)
    given = (np.eye(3), np.diag([-1.0, 1, -1]))
    kept = compose_match(torus, other, found, given).named(("a", "b")).panels
    assert [panel.label for panel in kept] == ["a", "b"]
    assert all(np.array_equal(panel.rotation, turn) for panel, turn in zip(kept, given, strict=True))


@pytest.mark.parametrize("cloud", [False, True])
def test_what_fits_ignore_is_not_drawn(sphere: Shape, cloud: bool) -> None:
    """A floor may hide the body, and is so large that the body gets few of the colors."""
    size = 20 * sphere.diagonal
    floor = np.array([[-1.0, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]]) * size
    verts = np.concatenate([sphere.verts, floor])
    faces = np.concatenate([sphere.faces, sphere.V + np.array([[0, 1, 2], [0, 2, 3]])])
    on_floor = Shape(verts, faces[:0] if cloud else faces, weights=np.arange(len(verts)) < sphere.V)
    index = np.arange(on_floor.V) % sphere.V
    shown = compose_match(on_floor, sphere, VertexMap.between(on_floor, sphere, index))
    drawn, other = shown.panels
    assert shown.caption == "corresponding points in the same color, without what was left out"
    assert drawn.shape.diagonal == pytest.approx(sphere.diagonal) and drawn.shape.V == on_floor.V
    colors = position_colors(sphere, np.asarray(drawn.rotation))
    assert np.asarray(drawn.colors)[: sphere.V] == pytest.approx(colors)
    assert compose_match(sphere, sphere, VertexMap.identity(sphere)).caption == "corresponding points in the same color"
    assert other.shape is sphere


def test_doubt_is_dark(sphere: Shape) -> None:
    confidence = np.where(sphere.verts[:, 0] > 0, 1.0, 0.2)
    found = VertexMap.between(sphere, sphere, np.arange(sphere.V), confidence=confidence)
    shown = compose_confidence(sphere, sphere, found)
    panels, scale = shown.panels, scale_of(shown)
    assert (scale.low, scale.high) == (0, 1)
    for panel in panels:
        light = np.asarray(panel.colors).sum(axis=1)
        assert light[sphere.verts[:, 0] > 0.1].min() > light[sphere.verts[:, 0] < -0.1].max() + 0.5


def test_errors_at_all_vertices_are_painted(sphere: Shape) -> None:
    known = np.arange(sphere.V), np.arange(sphere.V)
    values = np.linspace(0, 0.05, sphere.V)
    shown = compose_errors(sphere, sphere, VertexMap.identity(sphere), known, Errors(values))
    panels, scale = shown.panels, scale_of(shown)
    assert "cm" in scale.title
    assert scale.high == pytest.approx(0.05 * CM_PER_UNIT, abs=2)
    for panel in panels:
        assert panel.points is None
        assert np.asarray(panel.colors) == pytest.approx(scale.colors(values * CM_PER_UNIT), abs=0.02)
    assert not scale.unknown


def test_errors_at_a_few_points_are_balls_where_they_are(sphere: Shape) -> None:
    known = np.array([5, 9, 5]), np.array([100, 200, 300])
    found = VertexMap.identity(sphere)
    shown = compose_errors(sphere, sphere, found, known, Errors([0.1, 0.3, 0.5]), X100, (0.0, 40.0))
    panels, scale = shown.panels, scale_of(shown)
    assert (scale.low, scale.high) == (0, 40)
    assert "sqrt(area)" in scale.title
    assert np.array_equal(panels[0].points, sphere.verts[[5, 9]])
    assert np.array_equal(panels[1].points, sphere.verts[[100, 200, 300]])
    assert np.asarray(panels[0].point_colors) == pytest.approx(scale.colors([30.0, 30.0]), abs=0.02)  # a mean


def test_between_close_points_errors_are_painted_and_far_from_them_grey(sphere: Shape) -> None:
    left = np.flatnonzero(sphere.verts[:, 0] < 0.3)[::2]
    values = np.where(sphere.verts[left, 1] > 0, 0.04, 0.0)
    shown = compose_errors(sphere, sphere, VertexMap.identity(sphere), (left, left), Errors(values))
    panels, scale = shown.panels, scale_of(shown)
    colors = np.asarray(panels[0].colors)
    grey = (colors == UNKNOWN).all(axis=1)
    assert scale.unknown
    assert grey[sphere.verts[:, 0] > 0.8].all()
    assert not grey[sphere.verts[:, 0] < 0.2].any()
    high = (sphere.verts[:, 1] > 0.3) & (sphere.verts[:, 0] < 0.1)
    assert colors[high] == pytest.approx(scale.colors(np.full(high.sum(), 0.04 * CM_PER_UNIT)), abs=0.02)
    assert np.array_equal(panels[1].colors, panels[0].colors)


def test_a_composition_is_rendered_with_its_legend(
    cube: Shape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Look] = []
    monkeypatch.setattr(compose, "render_shapes", lambda panels, path, look: looks.append(look))
    shown = compose_values([cube], [np.arange(8.0)], "height")
    shown.render(tmp_path / "p.png")
    shown.render(tmp_path / "p.png", Look(background="dark"))
    assert [look.legend for look in looks] == [shown.legend] * 2
    assert looks[1].background == "dark"
    assert [panel.label for panel in shown.named(["x"]).panels] == ["x"]


def test_a_map_to_another_shape_is_refused(cube: Shape, sphere: Shape) -> None:
    with pytest.raises(InputError, match="leads to"):
        compose_match(cube, sphere, VertexMap.identity(cube))


def test_distances_are_to_the_surface_and_not_to_its_vertices(cube: Shape) -> None:
    points = np.array([[0.5, 0.5, 1.25], [0.3, 0.6, 0.5], [2.0, 2.0, 2.0], [0.5, -0.1, 0.9]])
    shape = Shape(points, None)
    found = distances(shape, cube)
    assert found == pytest.approx([0.25, 0.3, np.sqrt(3), 0.1])
    broken = distances(Shape(cube.verts, cube.faces, invalid=np.arange(8) == 3), cube)
    assert np.isnan(broken[3])
    assert np.nanmax(broken) == pytest.approx(0, abs=1e-12)


def test_two_layers_and_their_distance(sphere: Shape) -> None:
    larger = Shape(1.5 * sphere.verts, sphere.faces)
    shown = compose_fit(Shape(sphere.verts, sphere.faces, "ball"), larger, np.eye(3), (0.0, 1.0))
    under, apart = shown.panels
    assert under.over is larger
    assert "ball" in under.label
    assert isinstance(shown.legend, Scale)
    assert np.asarray(apart.colors) == pytest.approx(shown.legend.colors(np.full(sphere.V, 0.5)), abs=0.03)
    assert all(np.array_equal(panel.rotation, np.eye(3)) for panel in shown.panels)
    assert shown.record["distance_mean"] == pytest.approx(0.5, abs=0.01)


def test_nodes_shine_through_the_template() -> None:
    template = load_template(bundled_folder() / "human" / "human-T.safetensors")
    (panel,) = compose_shapes([(template, None)]).panels
    assert np.array_equal(panel.points, template.nodes)
    assert panel.glass
    assert panel.label == f"human-T: {template.K} nodes"
    (panel,) = compose_shapes([(template, None)], plain=True).panels
    assert panel.points is None and (np.asarray(panel.colors) == CLAY).all()


def test_labels_of_several_shapes_share_one_list() -> None:
    one = Labels(np.array([1, 0, -1]), ("head", "10"), "vertices")
    other = Labels(np.array([0, 1]), ("2", "head"), "faces")
    codes, names = merge_labels([one, other])
    assert names == ["2", "10", "head"]
    assert [own.tolist() for own in codes] == [[1, 2, -1], [0, 2]]


@pytest.mark.parametrize("table", [np.full((8, 2), 0.5), np.full((8, 3), 2.0), np.zeros((8, 5))])
def test_values_that_are_neither_numbers_nor_colors(cube: Shape, table: np.ndarray) -> None:
    with pytest.raises(InputError, match="per vertex"):
        compose_values([cube], [table])
    with pytest.raises(OptionError, match="no scale"):
        compose_values([cube], [np.zeros((8, 3))], "title")
