"""Models of generated furniture: what is drawn of it to learn from, labelled templates, and trainings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.api.inputs import as_model
from meshmatch.arrays import Float, Floats, Floats32, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.templates.template import Template, template_radius, unit_frame
from meshmatch.training.recipes import Recipe
from meshmatch.training.train import CardFacts, train_model

_POINTS = 2048  # of each training shape
_COARSE = 64  # voxels along a training shape
_COMPARED, _CANDIDATES, _OTHERS = 128, 24, 200  # points and shapes, where these are compared to choose templates
_TEMPLATE_POINTS = 4000


@dataclass(frozen=True)
class Learned:
    """Generated shapes to learn from: points (N, P, 3) with normals and parts, around their centers, of radius 1."""

    points: Float[Floats32, "N P 3"]
    normals: Float[Floats32, "N P 3"]
    parts: Int[Ints, "N P"]


def learned_shapes(kind: str, count: int, seed: int, kept: Path) -> Learned:
    """Samples of the first ``count`` generated shapes, drawn once and kept in a file."""
    if kept.is_file():
        with np.load(kept) as arrays:
            if len(arrays["points"]) == count:
                return Learned(**arrays)
    points, normals, parts = [], [], []
    for number in runner.track(range(count), kind):
        made = furniture(kind, seed, number)
        mesh = made.mesh(_COARSE)
        drawn = sample_surface(mesh, _POINTS, np.random.default_rng([seed, number]))
        points.append(unit_frame(mesh, "sphere", 1.0).apply(drawn.points).astype(np.float32))
        normals.append(drawn.normals.astype(np.float32))
        parts.append(made.parts_at(drawn.points))
    found = Learned(np.stack(points), np.stack(normals), np.stack(parts))
    np.savez(kept, **vars(found))
    return found


def chosen_templates(shapes: Learned, parts: int, count: int) -> list[int]:
    """Numbers of the shapes that together lie nearest to all others, the best first; the first one has all parts."""
    some = shapes.points[:, :_COMPARED].astype(np.float64)
    trees = [cKDTree(each) for each in some]
    others = range(min(_OTHERS, len(some)))
    whole = [k for k, each in enumerate(shapes.parts) if len(np.unique(each)) == parts]
    pool = np.unique([*whole[:_CANDIDATES], *range(min(_CANDIDATES, len(some)))])
    apart = np.array([[_apart(some[k], trees[k], some[n], trees[n]) for n in others] for k in pool])
    chosen: list[int] = []
    nearest = np.full(len(others), np.inf)
    for place in range(min(count, len(pool))):
        cost = np.minimum(apart, nearest).mean(1)
        if place == 0:
            cost = np.where(np.isin(pool, whole), cost, np.inf) if whole else cost
        best = int(cost.argmin())
        chosen.append(int(pool[best]))
        nearest = np.minimum(nearest, apart[best])
    return chosen


def _apart(a: Floats, tree_a: cKDTree, b: Floats, tree_b: cKDTree) -> float:
    return float(tree_b.query(a)[0].mean() + tree_a.query(b)[0].mean())


def cloud_template(kind: str, seed: int, number: int) -> Template:
    """The paper's: a labelled point cloud with 300 nodes whose reach is a fifth of its diameter."""
    points, _, parts = furniture(kind, seed, number).sample(_TEMPLATE_POINTS, np.random.default_rng([seed, number, 1]))
    cloud = Shape(points, np.empty((0, 3), np.int64), f"{kind}{number}")

    def made(radius: float) -> Template:
        nodes = NodeConfig("uniform", 300, radius, 0.03, seed=seed)
        return make_template(cloud, cloud.name, nodes, labels=parts, label_names=KINDS[kind])

    return made(0.2 * 2 * template_radius(made(0.3)))


def mesh_template(kind: str, seed: int, number: int) -> Template:
    """Ours: a labelled mesh with 320 nodes of reach 0.2 sqrt(area)."""
    made = furniture(kind, seed, number)
    mesh = made.surface
    nodes = NodeConfig("uniform", 320, 0.2, 0.03, seed=seed)
    return make_template(mesh, f"{kind}{number}", nodes, labels=made.parts_at(mesh.verts), label_names=KINDS[kind])


def learn(folder: Path, template: Template, shapes: Learned, recipe: Recipe) -> TrainedModel:
    """A model of one template, trained or read; its folder goes on where it was stopped."""
    radius = np.float32(template_radius(template))
    none = np.zeros((len(shapes.points), 0, 3), np.float32)
    samples = ShapeSamples(radius * shapes.points, shapes.normals, none, np.zeros(0, np.int64), "none", "sphere")
    card = folder / "card.json"
    if not card.is_file() or as_model(folder).card.steps < recipe.train.steps:
        facts = CardFacts(folder.name, template.name, data="generated shapes", licence="Apache-2.0")
        train_model(
            template, samples, folder, recipe, facts, report=lambda now: runner.tell(f"{folder.name}: {now.words}")
        )
    return as_model(folder)
