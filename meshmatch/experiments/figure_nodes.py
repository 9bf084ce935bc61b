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
from meshmatch.shapes.sampling import farthest_points, sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, choose_nodes, edge_graph, spectral_clusters
from meshmatch.templates.template import Template

KEPT, REFUSED, NODE = (0.20, 0.55, 0.80), (0.85, 0.15, 0.12), (0.86, 0.30, 0.12)
COLUMNS = {"template": "template", "radius": "radius:.2f", "candidates": "candidates:d"}
COLUMNS |= {"refused by parts": "parts:.1%", "spectral": "spectral:.1%", "from own vertex": "geodesic:.1%"}
SHARE = 0.2  # of the diameter along the surface


@dataclass(frozen=True, eq=False)
class Candidates:
    """Where nodes may be: points below the surface, the vertex each is next to, and which vertices each would move."""

    points: Float[Floats, "N 3"]
    own: Int[Ints, " N"]
    touched: list[list[int]]


def candidates_of(shape: Shape, config: NodeConfig) -> Candidates:
    """The candidates of `meshmatch.templates.make.choose_nodes`."""
    rng = np.random.default_rng(config.seed)
    samples = sample_surface(shape, 30 * config.K, rng)
    points = samples.points - samples.normals * rng.uniform(0, config.depth, (len(samples.points), 1))
    own = shape.faces[samples.face, samples.barycentric.argmax(1)]
    return Candidates(points, own, list(cKDTree(shape.verts).query_ball_point(points, config.radius)))


def bordering(shape: Shape, parts: Int[Ints, " V"]) -> Bool[Bools, "P P"]:
    """Which parts have an edge from one to the other; each has one to itself."""
    joined = np.eye(int(parts.max()) + 1, dtype=bool)
    joined[parts[shape.faces], parts[shape.faces[:, [1, 2, 0]]]] = True
    return np.asarray(joined | joined.T)


def across_parts(shape: Shape, parts: Int[Ints, " V"], found: Candidates) -> Bool[Bools, " N"]:
    """Candidates that touch a part which has no border with their own."""
    joined = bordering(shape, parts)
    return np.array(
        [
            not joined[parts[own], np.unique(parts[hits])].all()
            for own, hits in zip(found.own, found.touched, strict=True)
        ]
    )


def far_along(shape: Shape, found: Candidates, share: float = SHARE) -> Bool[Bools, " N"]:
    """Candidates that touch a vertex further from their own, along the surface, than a share of the diameter.

    `meshmatch.templates.make` compares all pairs of the vertices that a node would move, which refuses more.
    """
    graph = edge_graph(shape)
    ends = dijkstra(graph, indices=farthest_points(shape.verts, 40))
    limit = share * ends[np.isfinite(ends)].max()
    owners, place = np.unique(found.own, return_inverse=True)
    reach = dijkstra(graph, indices=owners, limit=limit)
    return np.array([not np.isfinite(reach[at, hits]).all() for at, hits in zip(place, found.touched, strict=True)])


@cache
def refused(template: Template, config: NodeConfig) -> tuple[Candidates, dict[str, Bool[Bools, " N"]], Int[Ints, " V"]]:
    """Candidates of a template, which of them each rule refuses, and its spectral clusters."""
    shape = template.shape
    found = candidates_of(shape, config)
    clusters = spectral_clusters(shape, config.clusters, np.random.default_rng(config.seed))
    rules = {
        "parts": across_parts(shape, template.labels, found),
        "spectral": across_parts(shape, clusters, found),
        "geodesic": far_along(shape, found),
    }
    return found, rules, clusters


def refusals(template: Template, config: NodeConfig) -> dict[str, Any]:
    """The shares of candidates that the rules refuse, as a row."""
    found, rules, _ = refused(template, config)
    shares = {name: float(mask.mean()) for name, mask in rules.items()}
    return {"template": template.name, "radius": config.radius, "candidates": len(found.points), **shares}


def worst_candidate(template: Template, found: Candidates, bad: Bool[Bools, " N"]) -> int:
    """The refused candidate that would move most vertices of parts that have no border with its own part."""
    shape, labels = template.shape, template.labels
    joined = bordering(shape, labels)
    strangers = np.zeros(len(bad), np.int64)
    for k in np.flatnonzero(bad).tolist():
        strangers[k] = (~joined[labels[found.own[k]], labels[found.touched[k]]]).sum()
    return int(strangers.argmax())


def segmentations(template: Template, config: NodeConfig) -> tuple[list[Panel], dict[str, Any]]:
    """Parts, spectral clusters, how far one vertex is along the surface, and a candidate that would move two parts."""
    shape = template.shape
    found, rules, clusters = refused(template, config)
    bad = worst_candidate(template, found, rules["parts"])
    moved = np.zeros(shape.V, bool)
    moved[found.touched[bad]] = True
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
    return panels, {"template": template.name, "node moves": moved_parts, "vertices": int(moved.sum())}


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
    numbers = {"template": template.name, "candidates": len(bad), "refused": int(bad.sum()), "by distance": len(chosen)}
    return panels, numbers | {"added where vertices lacked nodes": len(nodes) - len(chosen), "nodes": len(nodes)}


def config_of(template: Template, nodes: int = 300, radius: float | None = None) -> NodeConfig:
    """The configuration that a template's nodes are chosen with here: its own radius, or another."""
    return replace(NodeConfig(), K=nodes, radius=template.reach if radius is None else radius)
