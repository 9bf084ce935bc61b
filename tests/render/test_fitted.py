"""A template over a shape, and a template's nodes."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.render import fitted
from meshmatch.render.fitted import distances, fit_panels, nodes_panel, render_fit
from meshmatch.render.picture import Look
from meshmatch.render.scales import Scale
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.template import load_template


def slow_distance(point: np.ndarray, shape: Shape) -> float:
    """To the nearest of many points on every triangle."""
    s, t = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)))
    inside = s + t <= 1 + 1e-9
    weights = np.stack([1 - s - t, s, t], axis=1)[inside]
    surface = np.einsum("wk,fkc->fwc", weights, shape.verts[shape.faces]).reshape(-1, 3)
    return float(np.linalg.norm(surface - point, axis=1).min())


def test_distances_are_to_the_surface_and_not_to_its_vertices(cube: Shape) -> None:
    points = np.array([[0.5, 0.5, 1.25], [0.3, 0.6, 0.5], [2.0, 2.0, 2.0], [0.5, -0.1, 0.9]])
    shape = Shape(points, None)
    found = distances(shape, cube)
    assert found == pytest.approx([0.25, 0.3, np.sqrt(3), 0.1])
    assert found == pytest.approx([slow_distance(point, cube) for point in points], abs=0.01)


def test_a_vertex_without_a_position_has_no_distance(cube: Shape) -> None:
    shape = Shape(cube.verts, cube.faces, invalid=np.arange(8) == 3)
    found = distances(shape, cube)
    assert np.isnan(found[3])
    assert np.nanmax(found) == pytest.approx(0, abs=1e-12)


def test_two_layers_and_their_distance(
    sphere: Shape, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    larger = Shape(1.5 * sphere.verts, sphere.faces)
    panels, scale = fit_panels(sphere, larger, np.eye(3), "ball", (0.0, 1.0))
    assert panels[0].over is larger
    assert "ball" in panels[0].label
    assert np.asarray(panels[1].colors) == pytest.approx(scale.colors(np.full(sphere.V, 0.5)), abs=0.03)
    assert all(np.array_equal(panel.rotation, np.eye(3)) for panel in panels)
    looks: list[Look] = []
    monkeypatch.setattr(fitted, "render_shapes", lambda panels, path, look: looks.append(look))
    render_fit(sphere, larger, tmp_path / "p.png", rotation=np.eye(3))
    assert isinstance(looks[0].legend, Scale)


def test_nodes_shine_through_the_template() -> None:
    template = load_template(bundled_folder() / "human" / "human-T.safetensors")
    panel = nodes_panel(template)
    assert np.array_equal(panel.points, template.nodes)
    assert panel.glass
    assert panel.label == f"human-T: {template.K} nodes"
    assert nodes_panel(template, "x").label == "x"
