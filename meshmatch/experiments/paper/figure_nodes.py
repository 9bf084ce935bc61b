"""How nodes are chosen: the paper's figure 7 (segmentations, a node that moves two parts) and its three stages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.render.figures import Panel
from meshmatch.render.scales import CLAY
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import STRATEGIES, NodeConfig, choose_nodes, edge_graph, judged, spectral_clusters
from meshmatch.templates.template import Template

KEPT, REFUSED, NODE = (0.20, 0.55, 0.80), (0.85, 0.15, 0.12), (0.86, 0.30, 0.12)
COLUMNS = {"template": "template", "radius": "radius:.3f", "candidates": "candidates:d"}
COLUMNS |= {"refused by parts": "parts:.1%", "spectral": "spectral:.1%", "geodesic": "geodesic:.1%"}
SHARE = 0.2  # of the diameter along the surface, by which the third panel is coloured


@dataclass(frozen=True, eq=False)
class Candidates:
    """Where nodes may be: points below the surface, and the vertex each is next to."""

    points: Float[Floats, "N 3"]
    own: Int[Ints, " N"]


def bordering(shape: Shape, parts: Int[Ints, " V"]) -> Bool[Bools, "P P"]:
    """Which parts have an edge from one to the other; each has one to itself."""
    joined = np.eye(int(parts.max()) + 1, dtype=bool)
    joined[parts[shape.faces], parts[shape.faces[:, [1, 2, 0]]]] = True
    return np.asarray(joined | joined.T)


@cache
def refused(template: Template, config: NodeConfig) -> tuple[Candidates, dict[str, Bool[Bools, " N"]], Int[Ints, " V"]]:
    """Candidates of a template, which of them each rule refuses, and its spectral clusters."""
    shape = template.shape
    clusters = spectral_clusters(shape, config.clusters, np.random.default_rng(config.seed))
    rules: dict[str, Bool[Bools, " N"]] = {}
    for rule in STRATEGIES:
        points, own, kept = judged(shape, replace(config, strategy=rule), template.labels)
        rules[rule] = ~kept
    return Candidates(points, own), rules, clusters


def refusals(template: Template, config: NodeConfig) -> dict[str, Any]:
    """The shares of candidates that the rules refuse, as a row."""
    found, rules, _ = refused(template, config)
    shares = {name: float(mask.mean()) for name, mask in rules.items()}
    return {"template": template.name, "radius": config.radius, "candidates": len(found.points), **shares}


def worst_candidate(
    template: Template, found: Candidates, bad: Bool[Bools, " N"], radius: float
) -> tuple[int, Int[Ints, " M"]]:
    """The refused candidate that would move most vertices of parts that have no border with its own part, and all that
    it would move."""
    shape, labels = template.shape, template.labels
    joined, tree = bordering(shape, labels), cKDTree(shape.verts)
    strangers = np.zeros(len(bad), np.int64)
    for k in np.flatnonzero(bad).tolist():
        touched = tree.query_ball_point(found.points[k], radius)
        strangers[k] = (~joined[labels[found.own[k]], labels[touched]]).sum()
    worst = int(strangers.argmax())
    return worst, np.array(tree.query_ball_point(found.points[worst], radius))


def segmentations(template: Template, config: NodeConfig) -> tuple[list[Panel], dict[str, Any]]:
    """Parts, spectral clusters, how far one vertex is along the surface, and a candidate that would move two parts."""
    shape = template.shape
    found, rules, clusters = refused(template, config)
    bad, touched = worst_candidate(template, found, rules["parts"], config.radius)
    moved = np.zeros(shape.V, bool)
    moved[touched] = True
    colors = np.where(moved[:, None], label_colors(template.labels), CLAY)
    graph = edge_graph(shape)
    distance = dijkstra(graph, indices=found.own[bad])
    ends = dijkstra(graph, indices=farthest_points(shape.verts, 40))
    share = distance / ends[np.isfinite(ends)].max()
    bands = np.where(np.isfinite(share), np.floor(share / SHARE), 5).astype(np.int64)
    moved_parts = [template.label_names[k] for k in np.unique(template.labels[moved])]
    panels = [
        Panel(shape, label_colors(template.labels), f"{len(np.unique(template.labels))} parts", sharp=True),
        Panel(shape, label_colors(clusters), f"{clusters.max() + 1} spectral clusters", sharp=True),
        Panel(
            shape,
            label_colors(bands),
            "fifths of the diameter from one vertex",
            sharp=True,
            points=shape.verts[found.own[bad]][None],
            point_colors=[NODE],
            point_radius=0.02,
        ),
        Panel(
            shape,
            colors,
            "what one refused node would move",
            sharp=True,
            points=found.points[bad][None],
            point_colors=[NODE],
            point_radius=0.02,
        ),
    ]
    numbers = {"template": template.name, "radius": config.radius}
    return panels, numbers | {"node moves": moved_parts, "vertices": int(moved.sum())}


def stages(template: Template, config: NodeConfig) -> tuple[list[Panel], dict[str, Any]]:
    """Candidates below the surface; those the rule by parts keeps and refuses; the nodes, spread over what is kept."""
    shape = template.shape
    found, rules, _ = refused(template, config)
    bad = rules["parts"]
    nodes = choose_nodes(shape, config, template.labels)
    every = np.linspace(0, len(found.points) - 1, min(3000, len(found.points))).astype(np.int64)
    kept = np.flatnonzero(~bad)
    chosen = found.points[kept][farthest_points(found.points[kept], min(config.K, len(kept)))]
    panels = [
        Panel(
            shape,
            None,
            f"{len(bad):,} candidates",
            points=found.points[every],
            point_colors=np.tile(KEPT, (len(every), 1)),
            glass=True,
            point_radius=0.006,
        ),
        Panel(
            shape,
            None,
            f"{bad.sum():,} refused by parts",
            points=found.points[np.r_[every, np.flatnonzero(bad)]],
            point_colors=np.where(np.r_[bad[every], bad[bad]][:, None], REFUSED, KEPT),
            glass=True,
            point_radius=0.006,
        ),
        Panel(
            shape,
            None,
            f"{len(nodes)} nodes",
            points=nodes,
            point_colors=np.tile(NODE, (len(nodes), 1)),
            glass=True,
            point_radius=0.012,
        ),
    ]
    numbers = {"template": template.name, "radius": config.radius, "candidates": len(bad), "refused": int(bad.sum())}
    numbers["by distance"] = len(chosen)
    return panels, numbers | {"added where vertices lacked nodes": len(nodes) - len(chosen), "nodes": len(nodes)}


def config_of(template: Template, nodes: int = 300, radius: float | None = None) -> NodeConfig:
    """The configuration that a template's nodes are chosen with here: its own radius, or another."""
    return replace(NodeConfig(), K=nodes, radius=template.reach if radius is None else radius)
