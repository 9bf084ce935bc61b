"""Area distortion of fields, and what the rules for nodes refuse, beside numbers that are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from meshmatch.experiments.paper.ablation_errors import Measure
from meshmatch.experiments.paper.figure_fields import (
    OFF,
    PULL,
    REFINED,
    Direct,
    change,
    direct_fits,
    fitted,
    pulled_by,
    pulled_nodes,
    refinements,
    template_frame,
)
from meshmatch.experiments.paper.figures import refusals, refused, worst_candidate
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, choose_nodes, edge_graph
from meshmatch.templates.template import Template, read_template
from tests.fitting.eggs import egg_model


@pytest.fixture(scope="module")
def template() -> Template:
    return read_template("human-T")


def test_change_of_triangles(cube: Shape) -> None:
    still, numbers = change(cube.verts, cube.verts, cube.faces)
    assert not still.any() and set(numbers.values()) == {0.0}
    twice, numbers = change(np.sqrt(2) * cube.verts, cube.verts, cube.faces)
    assert twice == pytest.approx(np.ones(12))
    assert (numbers["change"], numbers["over_quarter"], numbers["turned"]) == pytest.approx((1, 1, 0))
    _, numbers = change(
        cube.verts * [-1, 1, 1], cube.verts, cube.faces
    )  # mirrored: four of six sides face the wrong way
    assert numbers["turned"] == pytest.approx(4 / 6) and numbers["change"] == pytest.approx(0)
    long, _ = change(cube.verts * [4, 1, 1], cube.verts, cube.faces)
    assert sorted(set(long.round(6).tolist())) == [0.0, 2.0]


def test_handles_are_the_nodes_of_the_arm(template: Template) -> None:
    arm = pulled_nodes(template)
    assert 5 < arm.sum() < 60
    assert template.nodes[arm, 0].min() > template.nodes[~arm, 0].mean()  # the left is at +x
    for field in ("mls", "rbf"):
        verts, nodes = pulled_by(field, template, "smooth", 0)
        tip = template.shape.verts[:, 0].argmax()
        assert verts[tip] - template.shape.verts[tip] == pytest.approx(PULL, abs=0.01)
        assert np.linalg.norm(nodes - template.nodes - np.where(arm[:, None], PULL, 0), axis=1).mean() < 0.02
    assert pulled_by("rbf", template, "smooth", 0)[1] - template.nodes == pytest.approx(
        np.where(arm[:, None], PULL, 0), abs=1e-3
    )


def test_the_rules_refuse_what_the_choice_of_nodes_refuses(template: Template) -> None:
    config = NodeConfig(K=40, radius=0.2)
    found, rules, _ = refused(template, config)
    kept = found.points[~rules["parts"]]
    first = kept[farthest_points(kept, config.K)]
    assert choose_nodes(template.shape, config, template.labels)[: config.K] == pytest.approx(first)
    assert len(found.points) == len(found.own) == 30 * config.K
    assert not rules["uniform"].any()
    row = refusals(template, config)
    assert row["geodesic"] == pytest.approx(rules["geodesic"].mean()) and 0 < row["geodesic"] < 1
    # by pairs: what keeps within a fifth of the diameter of its own vertex may still join two points further apart
    graph = edge_graph(template.shape)
    ends = dijkstra(graph, indices=farthest_points(template.shape.verts, 40))
    limit = 0.2 * ends[np.isfinite(ends)].max()
    tree = cKDTree(template.shape.verts)
    for k in [*np.flatnonzero(rules["geodesic"])[:3], *np.flatnonzero(~rules["geodesic"])[:3]]:
        touched = tree.query_ball_point(found.points[k], 0.2)
        apart = dijkstra(graph, indices=touched)[:, touched].max()
        assert (apart > limit) == rules["geodesic"][k]


def test_the_worst_candidate_moves_strangers(template: Template) -> None:
    config = NodeConfig(K=20, radius=0.25)
    found, rules, _ = refused(template, config)
    worst, moved = worst_candidate(template, found, rules["parts"], 0.25)
    assert rules["parts"][worst]
    far = np.linalg.norm(template.shape.verts - found.points[worst], axis=1)
    assert np.array_equal(np.sort(moved), np.flatnonzero(far <= 0.25))
    assert len(np.unique(template.labels[moved])) > 2


def test_a_field_is_fitted_without_a_network(template: Template) -> None:
    """A still template and a moved one: where points are known exactly and nothing resists, the error goes away."""
    how = Direct(supervised=300, noise=0.0, steps=60, strained=50)
    body = 2 * template.shape.verts @ np.diag([-1.0, 1.0, -1.0]) + 5
    target = template_frame(template, body).apply(body)
    assert target == pytest.approx(template.shape.verts, abs=1e-6)
    bent = template.shape.verts * [1.0, 1.0, 1.0] + np.square(template.shape.verts[:, [1, 2, 0]]) * [0.1, 0.0, 0.0]
    off = np.linalg.norm(bent - template.shape.verts, axis=1).mean()
    drawn = direct_fits([("mls", "none", "free"), ("mls", "vol+arap", "stiff")], template, bent, how)
    free, stiff = drawn.rows
    assert free["error_cm"] < 0.2 * off * CM_PER_UNIT and len(drawn.panels) == 3
    assert stiff["error_cm"] != free["error_cm"] and abs(free["volume"]) < 0.1
    moved = fitted("pointwise", "vol", template, bent, replace(how, steps=2))
    assert moved.shape == bent.shape


def test_refinement_is_measured_and_colored_by_the_distance_from_the_truth() -> None:
    """Of a longer template, elsewhere: refined nodes come nearer, and every panel shows its own errors."""
    model = egg_model()
    body = model.template.shape.verts * [3.0, 3.6, 3.0] + 7
    (drawn,) = refinements(model, [body], Measure(samples=3000, code_steps=2))
    assert [row["what"] for row in drawn.rows] == [panel.label for panel in drawn.panels[1:]] == list(REFINED.values())
    errors = [row["error_cm"] for row in drawn.rows]
    assert errors[-1] < 0.7 * errors[0]
    for row, panel in zip(drawn.rows, drawn.panels[1:], strict=True):
        off = CM_PER_UNIT * np.linalg.norm(panel.shape.verts - drawn.panels[0].shape.verts, axis=1)
        assert off.mean() == pytest.approx(row["error_cm"], abs=1e-6) and row["far"] == (off > OFF.high).mean()
        assert panel.colors == pytest.approx(OFF.colors(off))
