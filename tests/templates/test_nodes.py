"""Control nodes: whatever the strategy, every vertex has four non-coplanar ones in reach, or an error names it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshmatch.errors import OptionError, TemplateError
from meshmatch.fields.shape_functions import build_field
from meshmatch.geometry.kernels import poorly_supported, support_pairs
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates import make
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.make import (
    STRATEGIES,
    NodeConfig,
    Strategy,
    choose_nodes,
    edge_graph,
    grow_radii,
    place_nodes,
    spectral_clusters,
)
from meshmatch.templates.template import Template, load_template


def unit_area(shape: Shape) -> Shape:
    return Shape(sqrt_area_frame(shape).apply(shape.verts), shape.faces, shape.name)


@pytest.fixture(scope="module")
def ring(torus: Shape) -> Shape:
    return unit_area(torus)


@pytest.fixture(scope="module")
def human() -> Template:
    return load_template(bundled_folder() / "human" / "human-T.safetensors")


def rejected_share(shape: Shape, config: NodeConfig, labels: np.ndarray | None = None) -> float:
    """Share (0..1) of the candidates that a strategy rejects, before it becomes milder where vertices go without."""
    samples, candidates = make._candidates(shape, config, noisy=False)
    return float(1 - next(make._allowed(shape, config, candidates, labels, samples)).mean())


def badly_held(verts: np.ndarray, nodes: np.ndarray, radius: float) -> list[int]:
    """The slow way: vertices whose nodes in reach do not span space."""
    bad = []
    for number, vertex in enumerate(verts):
        near = nodes[np.linalg.norm(nodes - vertex, axis=1) <= radius]
        if len(near) < 4 or np.linalg.matrix_rank(near - near[0], tol=1e-4) < 3:
            bad.append(number)
    return bad


def test_pairs_are_those_within_the_radius_by_hand() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    nodes = np.array([[0.5, 0, 0], [0, 1, 0]])
    row, column = support_pairs(points, nodes, np.array([0.5, 1.2]))
    assert row.tolist() == [0, 0, 1]
    assert column.tolist() == [0, 1, 0]
    assert support_pairs(points + 100, nodes, np.array([0.5, 1.2]))[0].shape == (0,)


def test_support_by_hand() -> None:
    corners = np.concatenate([np.zeros((1, 3)), np.eye(3)]) * 0.5
    inside, outside = np.full(3, 0.1), np.full(3, 9.0)
    assert poorly_supported(np.stack([inside, outside]), corners, 1.0).tolist() == [1]
    flat = corners * [1, 1, 0] + [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0.3, 0.3, 0]]
    assert poorly_supported(inside[None], flat, 1.0).tolist() == [0]  # four, but coplanar
    assert poorly_supported(inside[None], corners[:3], 1.0).tolist() == [0]  # three


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_vertex_of_a_ring_is_held(strategy: Strategy, ring: Shape) -> None:
    angle = np.arctan2(ring.verts[:, 1], ring.verts[:, 0])
    labels = ((angle + np.pi) / (2 * np.pi) * 8).astype(int) % 8
    config = NodeConfig(strategy=strategy, K=120, radius=0.2, clusters=8)
    nodes = choose_nodes(ring, config, labels)
    assert len(nodes) >= 120
    assert badly_held(ring.verts, nodes, 0.2) == []


def test_nodes_are_of_their_seed(ring: Shape) -> None:
    config = NodeConfig(strategy="uniform", K=120, radius=0.2)
    nodes = choose_nodes(ring, config)
    assert np.array_equal(nodes, choose_nodes(ring, config))
    assert not np.array_equal(nodes[:120], choose_nodes(ring, replace(config, seed=1))[:120])


@pytest.mark.parametrize(
    "strategy",
    [pytest.param(name, marks=pytest.mark.slow if name in ("uniform", "geodesic") else ()) for name in STRATEGIES],
)
def test_every_vertex_of_the_human_template_is_held(strategy: Strategy, human: Template) -> None:
    nodes = choose_nodes(human.shape, NodeConfig(strategy=strategy), human.labels)
    assert len(nodes) >= 320
    assert badly_held(human.shape.verts, nodes, 0.13) == []
    if strategy == "parts":  # the recipe of the template that ships
        assert np.allclose(nodes, human.nodes, atol=1e-9)


def test_nodes_lie_in_the_volume_near_the_surface(ring: Shape) -> None:
    nodes = choose_nodes(ring, NodeConfig(strategy="uniform", K=100, radius=0.2, depth=0.02))
    scale = np.sqrt((2 * np.pi) ** 2 * 1.0 * 0.4)  # of a torus of area 4 pi^2 R r
    around = np.hypot(nodes[:, 0], nodes[:, 1]) * scale - 1
    tube = np.hypot(around, nodes[:, 2] * scale)
    assert tube.max() < 0.401  # never outside
    assert tube.min() > 0.4 - 0.02 * scale - 0.01


def two_plates(gap: float) -> Shape:
    """A folded strip: two plates, close in space, joined along one far edge. Area about 1."""
    n, m = 30, 12
    s = np.linspace(0, 2, n)  # along the strip; the fold is at 1
    x = np.where(s < 1, s, 2 - s) * 0.9
    z = np.clip((s - 0.95) / 0.1, 0, 1) * gap
    verts = np.stack([np.repeat(x, m), np.tile(np.linspace(0, 0.55, m), n), np.repeat(z, m)], 1)
    a = np.arange(n * m).reshape(n, m)
    corners = (a[:-1, :-1], a[1:, :-1], a[1:, 1:], a[:-1, 1:])
    p, q, r, t = (c.reshape(-1) for c in corners)
    return Shape(verts, np.concatenate([np.stack([p, r, q], 1), np.stack([p, t, r], 1)]), "fold")


def test_geodesic_rejection_keeps_a_node_off_the_other_plate() -> None:
    fold = two_plates(0.2)
    far = fold.verts[:, 0] < 0.4
    below, above = far & (fold.verts[:, 2] < 0.01), far & (fold.verts[:, 2] > 0.19)

    def touching_both(strategy: Strategy) -> int:
        """Nodes that reach both plates far from the fold."""
        nodes = choose_nodes(fold, NodeConfig(strategy=strategy, K=60, radius=0.18, depth=0.08))
        assert badly_held(fold.verts, nodes, 0.18) == []
        reach = np.linalg.norm(fold.verts - nodes[:, None], axis=2) <= 0.18
        return int((reach[:, below].any(1) & reach[:, above].any(1)).sum())

    assert touching_both("uniform") > 10
    assert touching_both("geodesic") == 0


def test_the_geodesic_rule_is_about_pairs_by_hand() -> None:
    """A strip of length 10: a node in its middle reaches 1.5 both ways, so a pair 3 apart, though nothing 2 from itself."""
    x = np.linspace(0, 10, 101)
    verts = np.stack([np.repeat(x, 2), np.tile([0.0, 0.05], 101), np.zeros(202)], 1)
    a = np.arange(0, 200, 2)
    faces = np.concatenate([np.stack([a, a + 1, a + 2], 1), np.stack([a + 1, a + 3, a + 2], 1)])
    strip = Shape(verts, faces, "strip")
    shares = [rejected_share(strip, NodeConfig("geodesic", 60, radius, depth=0.0)) for radius in (0.9, 1.5)]
    assert shares[0] == 0.0  # pairs up to 1.8 apart, of the 2 that are allowed
    assert shares[1] > 0.8  # all but those at the ends, which reach one way


def test_what_rules_reject(ring: Shape) -> None:
    assert rejected_share(ring, NodeConfig("uniform", 60, 0.2)) == 0.0
    labels = (ring.verts[:, 0] > 0).astype(int)
    assert rejected_share(ring, NodeConfig("parts", 60, 0.2), labels) == 0.0  # both border on each other


def test_a_rejection_that_leaves_nothing_becomes_milder_or_names_the_vertices(monkeypatch: pytest.MonkeyPatch) -> None:
    fold, config = two_plates(0.1), NodeConfig(strategy="geodesic", K=60, radius=0.2, depth=0.0)
    laid = place_nodes(fold, config)
    assert badly_held(fold.verts, laid.nodes, 0.2) == [] and laid.taken < laid.refused
    monkeypatch.setattr("meshmatch.templates.make._GEODESIC_SHARES", (0.2,))
    with pytest.raises(TemplateError, match="vertices"):
        choose_nodes(fold, config)


def test_parts_keep_a_node_off_a_part_that_does_not_border(ring: Shape) -> None:
    """Eight sectors of the ring; a node reaches its own and their neighbours alone."""
    angle = np.arctan2(ring.verts[:, 1], ring.verts[:, 0])
    labels = ((angle + np.pi) / (2 * np.pi) * 12).astype(int) % 12

    def furthest(strategy: Strategy) -> int:
        nodes = choose_nodes(ring, NodeConfig(strategy=strategy, K=120, radius=0.2, depth=0.01), labels)
        reach = np.linalg.norm(ring.verts - nodes[:, None], axis=2) <= 0.2
        touched = [np.unique(labels[row]) for row in reach]
        return max(len(parts) for parts in touched)

    assert furthest("uniform") > 3
    assert furthest("parts") == 3


def test_an_edge_graph_by_hand() -> None:
    triangle = Shape(np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0]]), np.array([[0, 1, 2]]))
    assert np.allclose(edge_graph(triangle).toarray(), [[0, 3, 4], [3, 0, 5], [4, 5, 0]])


def test_spectral_clusters_tell_two_parts_apart(sphere: Shape) -> None:
    two = Shape(
        np.concatenate([sphere.verts, sphere.verts + 5]), np.concatenate([sphere.faces, sphere.faces + sphere.V])
    )
    labels = spectral_clusters(two, 2, np.random.default_rng(0))
    assert set(labels[: sphere.V]) != set(labels[sphere.V :])
    assert len(set(labels)) == 2


def test_spectral_clusters_are_of_the_first_four_eigenfunctions(sphere: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    """As in the paper, beside the constant one."""
    asked: list[int] = []
    solve = make.eigsh

    def counted(matrix: Any, count: int, *others: Any, **more: Any) -> Any:
        asked.append(count)
        return solve(matrix, count, *others, **more)

    monkeypatch.setattr(make, "eigsh", counted)
    spectral_clusters(sphere, 3, np.random.default_rng(0))
    assert asked == [1 + 4]


def test_spectral_clusters_are_all_used_and_connected_pieces(ring: Shape) -> None:
    labels = spectral_clusters(ring, 9, np.random.default_rng(0))
    assert labels.shape == (ring.V,)
    assert set(labels) == set(range(9))
    # around a ring the first functions are waves of the angle: a cluster spans a sector
    angle = np.exp(1j * np.arctan2(ring.verts[:, 1], ring.verts[:, 0]))
    spread = [1 - abs(angle[labels == part].mean()) for part in range(9)]
    assert max(spread) < 0.3


def test_farthest_points_in_any_dimension_by_hand() -> None:
    points = np.array([[0.0] * 5, [1.0] * 5, [10.0] * 5, [4.0] * 5])
    assert farthest_points(points, 3).tolist() == [0, 2, 3]
    assert farthest_points(points, 4).tolist() == [0, 2, 3, 1]


def test_vertices_out_of_reach_are_named(ring: Shape) -> None:
    with pytest.raises(TemplateError, match=r"\d+ vertices have fewer than four .* \(vertices \d+, ") as caught:
        choose_nodes(ring, NodeConfig(strategy="uniform", K=20, radius=0.02))
    assert "radius" in caught.value.hint
    named = [int(word) for word in caught.value.message.split("(vertices ")[1].split(", ")[:5]]
    assert all(0 <= vertex < ring.V for vertex in named)


def test_missing_vertices_are_completed(ring: Shape) -> None:
    """Far fewer nodes than are needed: more are added where vertices lack them, and only then."""
    nodes = choose_nodes(ring, NodeConfig(strategy="uniform", K=40, radius=0.2))
    assert 40 < len(nodes) < 200
    assert badly_held(ring.verts, nodes, 0.2) == []
    assert len(choose_nodes(ring, NodeConfig(strategy="uniform", K=200, radius=0.3))) == 200


def test_radii_grow_where_vertices_lack_nodes(ring: Shape) -> None:
    """Nodes stay as they are; no vertex is left, and the nodes that had no need to grow have not."""
    config = NodeConfig(strategy="uniform", K=40, radius=0.19, grow=True)
    laid = place_nodes(ring, config)
    assert len(laid.nodes) == 40
    assert isinstance(laid.radius, np.ndarray)
    assert laid.radius.min() == 0.19 and 0.19 < laid.radius.max() < 0.3
    assert len(badly_held(ring.verts, laid.nodes, 0.19)) > 0
    assert not len(poorly_supported(ring.verts, laid.nodes, laid.radius))
    build_field(ring.verts, laid.nodes, laid.radius, "smooth")
    # a field of the first radii is refused, and one step less of growth is too little somewhere
    smaller = np.maximum(0.19, laid.radius / 1.05)
    assert len(poorly_supported(ring.verts, laid.nodes, smaller))
    enough = place_nodes(ring, replace(config, K=200, radius=0.3))
    assert enough.radius == 0.3
    assert np.array_equal(enough.nodes, choose_nodes(ring, replace(config, K=200, radius=0.3, grow=False)))


def test_radii_grow_under_the_strategy_itself() -> None:
    """Where a strategy would become milder, growing keeps to it: all nodes are among those that it allows."""
    fold, config = two_plates(0.2), NodeConfig(strategy="geodesic", K=60, radius=0.18, depth=0.08)
    samples, candidates = make._candidates(fold, config, noisy=False)
    allowed = next(make._allowed(fold, config, candidates, None, samples))
    laid = place_nodes(fold, replace(config, grow=True))
    assert cKDTree(candidates[allowed]).query(laid.nodes)[0].max() == 0
    assert laid.refused == pytest.approx(1 - allowed.mean())
    assert 0.5 < laid.refused < 0.9 and laid.taken == laid.refused
    assert isinstance(laid.radius, np.ndarray)


def test_nodes_in_a_plane_cannot_grow_into_space() -> None:
    flat = np.concatenate([np.random.default_rng(0).random((30, 2)), np.zeros((30, 1))], 1)
    with pytest.raises(TemplateError, match=r"within twice 0\.1"):
        grow_radii(flat[:5], flat, 0.1)


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"strategy": "psychic"}, "unknown node strategy 'psychic'"),
        ({"K": 3}, "4 or more, not 3"),
        ({"K": 4.5}, "an integer of 4 or more, not 4.5"),
        ({"radius": 0.0}, "must lie above 0 and at most 1000, not 0"),
        ({"radius": 1e308}, "must lie above 0 and at most 1000"),
        ({"radius": -1.0}, "must lie above 0"),
        ({"radius": float("nan")}, "must lie above 0"),
        ({"radius": float("inf")}, "must lie above 0"),
        ({"depth": -0.1}, "0 or more"),
        ({"clusters": 0}, "at least one cluster"),
    ],
)
def test_impossible_choices_are_refused(values: dict, told: str) -> None:
    with pytest.raises(OptionError, match=told):
        NodeConfig(**values)


def test_parts_without_labels_are_refused(ring: Shape) -> None:
    with pytest.raises(OptionError, match="needs part labels") as caught:
        choose_nodes(ring, NodeConfig(strategy="parts", K=100, radius=0.2))
    assert "spectral" in caught.value.hint


def test_the_bundled_folder_is_there() -> None:
    assert (bundled_folder() / "samples").is_dir()
