"""The paper's figures 4 to 7, drawn, with the numbers behind them.

- 4: area distortion of the three representations of a field. Above, an arm pulled by the same handles; below, one body
  that nobody learned from, fitted with each.
- 5: the same body fitted after different regularisers.
- 6: bodies as a trained model's network fits them, and after both refinements.
- 7: what the rules for nodes look at, a node that they refuse, and the three stages of choosing; drawn with the templates'
  own radius (0.13), and counted with the paper's too: 0.2 of each template's diameter, as in table 7.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.charts import stacked
from meshmatch.experiments.makers.human_bodies import diameter, unseen_bodies
from meshmatch.experiments.paper.ablation_errors import Measure
from meshmatch.experiments.paper.ablation_views import BASE
from meshmatch.experiments.paper.figure_fields import (
    CONSTRAINTS,
    FIT_COLUMNS,
    OFF,
    PULL_COLUMNS,
    REFINED_COLUMNS,
    SCALE,
    Direct,
    direct_fits,
    pull,
    refinements,
)
from meshmatch.fields.shape_functions import FIELDS, FieldName
from meshmatch.outputs import make_folder
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look
from meshmatch.render.scales import CLAY
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import STRATEGIES, NodeConfig, choose_nodes, edge_graph, judged, spectral_clusters
from meshmatch.templates.template import Template, read_template

FIGURES = ("4", "5", "6", "7")
_FRONT = Look(turn=0.0, tilt=4.0)
_REFINED = 2  # bodies of figure 6


KEPT, REFUSED, NODE = (0.20, 0.55, 0.80), (0.85, 0.15, 0.12), (0.86, 0.30, 0.12)
NODE_COLUMNS = {"template": "template", "radius": "radius:.3f", "candidates": "candidates:d"}
NODE_COLUMNS |= {"refused by parts": "parts:.1%", "spectral": "spectral:.1%", "geodesic": "geodesic:.1%"}
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


def dotted(
    shape: Shape, points: Float[Floats, "N 3"], dots: Any, label: str, colors: Any = None, radius: float = 0.02
) -> Panel:
    """A shape with points in one color or one of each; seen through where it has no colors of its own."""
    each = np.broadcast_to(dots, (len(points), 3))
    solid = colors is not None
    return Panel(
        shape, colors, label, sharp=solid, glass=not solid, points=points, point_colors=each, point_radius=radius
    )


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
        dotted(
            shape,
            shape.verts[found.own[bad]][None],
            NODE,
            "fifths of the diameter from one vertex",
            label_colors(bands),
        ),
        dotted(shape, found.points[bad][None], NODE, "what one refused node would move", colors),
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
    both = np.r_[every, np.flatnonzero(bad)]
    marked = np.where(bad[both][:, None], REFUSED, KEPT)
    panels = [
        dotted(shape, found.points[every], KEPT, f"{len(bad):,} candidates", radius=0.006),
        dotted(shape, found.points[both], marked, f"{bad.sum():,} refused by parts", radius=0.006),
        dotted(shape, nodes, NODE, f"{len(nodes)} nodes", radius=0.012),
    ]
    numbers = {"template": template.name, "radius": config.radius, "candidates": len(bad), "refused": int(bad.sum())}
    numbers["by distance"] = len(chosen)
    return panels, numbers | {"added where vertices lacked nodes": len(nodes) - len(chosen), "nodes": len(nodes)}


def figure_7(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Both templates' segmentations, and the stages on one of them; what the rules refuse by the radius that is drawn, and
    by the paper's of each template."""
    templates = [read_template(name) for name in ("human-T", "human-A")]
    configs = [replace(NodeConfig(), K=300, radius=template.reach) for template in templates]
    rows, bad = [], []
    for template, config in zip(templates, configs, strict=True):
        panels, numbers = segmentations(template, config)
        rows.append((panels, _FRONT))
        bad.append(numbers)
    panels, steps = stages(templates[1], configs[1])
    stacked([*rows, (panels, _FRONT)], path)
    shares = [
        refusals(template, replace(config, radius=each))
        for template, config in zip(templates, configs, strict=True)
        for each in dict.fromkeys((config.radius, BASE.radius * diameter(template.shape)))
    ]
    return {"refused": shares, "bad": bad, "stages": [steps]}


TITLES = {
    "pull": ("Figure 4, an arm pulled by the same handles: change of triangles (log2 of area)", PULL_COLUMNS),
    "fits 4": ("Figure 4, one body fitted with each field", FIT_COLUMNS),
    "fits 5": ("Figure 5, one body fitted after each loss", FIT_COLUMNS),
    "refined": ("Figure 6, bodies fitted by the network, and refined", REFINED_COLUMNS),
    "refused": ("Figure 7, candidates that the rules refuse by the radius drawn, and by the paper's", NODE_COLUMNS),
}


@runner.command
def main(
    figures: Annotated[str, Option(help=f"of {', '.join(FIGURES)}")] = ",".join(FIGURES),
    pictures: Annotated[Path, Option(help="folder of paper-figure-N.png")] = Path("docs/images"),
    model: Annotated[str, Option(help="whose fits figure 6 shows")] = "human",
    code_steps: Annotated[int, Option(min=1, help="of the search over codes")] = 60,
    steps: Annotated[int, Option(min=1, help="of Adam, without a network")] = 400,
    seed: runner.Seed = 4,
) -> runner.Report:
    wanted = runner.names_of(figures, FIGURES, "figure")
    make_folder(pictures)
    template, how = read_template("human-T"), Direct(steps=steps)
    bodies = (
        unseen_bodies(template, _REFINED, seed=seed) if {"4", "5", "6"} & set(wanted) else np.empty((_REFINED, 0, 3))
    )
    found: dict[str, list[dict[str, Any]]] = {}
    for name in wanted:
        path = pictures / f"paper-figure-{name}.png"
        if name == "7":
            found |= figure_7(path)
        elif name == "6":
            refined = refinements(as_model(model), list(bodies), Measure(code_steps=code_steps, seed=seed))
            found["refined"] = [row for each in refined for row in each.rows]
            stacked(
                [(each.panels, replace(_FRONT, legend=OFF if each is refined[-1] else None)) for each in refined], path
            )
        else:
            cases: list[tuple[FieldName, str, str]] = [(field, "vol+arap", field) for field in FIELDS]
            if name == "5":
                cases = [("mls", constraint, constraint) for constraint in CONSTRAINTS]
            below = direct_fits(cases, template, bodies[0], how)
            found[f"fits {name}"] = below.rows
            rows = [(below.panels, replace(_FRONT, legend=SCALE))]
            if name == "4":
                above = pull(template, "smooth", 0)
                found["pull"] = above.rows
                rows = [(above.panels, _FRONT), *rows]
            stacked(rows, path)
    drawn = [runner.table(words, found[key], columns) for key, (words, columns) in TITLES.items() if key in found]
    notes = [f"wrote {pictures / f'paper-figure-{name}.png'}" for name in wanted]
    notes += [str(row) for key in ("bad", "stages") for row in found.get(key, ())]
    return runner.Report(found, drawn, notes)
