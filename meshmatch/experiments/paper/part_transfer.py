"""Segmentation transfer learned from generated shapes, as section 1.4.2 of the paper's supplement describes it.

500 generated tables, planes or chairs (`experiments.makers.furniture`) are learned without correspondence. "paper": a
labelled point cloud is the template (300 nodes, reach 0.2 of its diameter), the paper's network with the weights of its
table 2 on plain Chamfer distances, 200 steps on the code of a new shape. "ours": labelled meshes are the templates, the
default network for small data, node vectors refined; the template with the smallest residual is taken.

Two tests on what no training saw. Held-out generated shapes: each point takes the label of the nearest point of the fitted
template; intersection over union of the parts that a shape has, its mean over shapes.
The real ones of the benchmark (SHREC'07): every ordered pair is matched through the template
and measured at semantic keypoints: a keypoint of one shape is matched to a place of another; the error is the distance
between that place and the true keypoint over the diagonal of the target's bounding box.

The work folder keeps everything, and the same command goes on from it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from typer import Option

from meshmatch.api.inputs import as_model, validated
from meshmatch.arrays import Float, Floats, Floats32, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.sets import Pair, Shapes, load_folder, ordered_pairs
from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import LatentRefineConfig
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.build import build_map
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.templates.template import Template, template_radius, unit_frame
from meshmatch.training.recipes import Recipe, clouds, paper_clouds
from meshmatch.training.train import CardFacts, train_model

KEYPOINTS = ".keypoints.npy"
RIGHT = 0.1
"""Share of the target's diagonal within which a keypoint has arrived."""
_POINTS = 2048  # of each training shape
_COARSE = 64  # voxels along a training shape
_COMPARED, _CANDIDATES, _OTHERS = 128, 24, 200  # points and shapes, where these are compared to choose templates
_TEMPLATE_POINTS = 4000
UPRIGHT = {
    "table": np.array([[-1, 0, 0], [0, 0, -1], [0, -1, 0]]),
    "plane": np.array([[0, -1, 0], [0, 0, 1], [-1, 0, 0]]),
    "chair": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
}
"""From the axes of each class's first real shape to those of generated ones: y up, z to the front."""
_PAPER = LatentRefineConfig(steps=200)
_UPRIGHT_ONCE: dict[str, Any] = {"partial": "no", "variants": 0, "finalists": 1, "samples": 4000}
"""Shapes are whole and stand upright: no other interpretation is tried."""
COLUMNS = {
    **{"class": "class", "method": "method", "generated IoU": "generated_iou:.3f"},
    **{"real: mean": "mean:.3f", "median": "median:.3f", f"within {RIGHT:g}": "arrived:.1%"},
    **{"IoU": "iou:.2f", "s a fit": "fit_seconds:.1f"},
}
METHODS = ("paper", "ours")
Labeller = Callable[[Shape, OrientedPoints], Int[Ints, " N"]]
"""Gives labels to points of a shape."""


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


def by_models(models: Sequence[TrainedModel], config: FitConfig) -> Labeller:
    """Each point takes the label of the nearest point of the template that fits best."""

    def labels(shape: Shape, points: OrientedPoints) -> Int[Ints, " N"]:
        fits = [Fitter(model, config).fit(shape) for model in models]
        best = min(range(len(models)), key=lambda k: fits[k].residual)
        return models[best].template.labels[cKDTree(fits[best].points_in_file).query(points.points)[1]]

    return labels


def part_overlap(give: Labeller, kind: str, numbers: range, seed: int) -> dict[str, Any]:
    """Mean overlap of the parts of held-out shapes with those that their points are given."""
    shapes = []
    began = time.monotonic()
    for number in runner.track(numbers, "generated"):
        made = furniture(kind, seed, number)
        points, normals, truth = made.sample(3000, np.random.default_rng([seed, number, 2]))
        shapes.append(overlaps(give(made.surface, OrientedPoints(points, normals)), truth))
    each = {part: [one[part] for one in shapes if part in one] for part in range(len(KINDS[kind]))}
    names = {KINDS[kind][part]: float(np.mean(values)) for part, values in each.items() if values}
    seconds = (time.monotonic() - began) / max(len(numbers), 1)
    return {
        "generated_iou": float(np.mean([np.mean(list(one.values())) for one in shapes])),
        "parts_iou": names,
        "fit_seconds": seconds,
    }


def best_maps(
    models: Sequence[TrainedModel], shapes: Shapes, config: FitConfig, pairs: Sequence[Pair]
) -> dict[Pair, VertexMap]:
    """Maps of pairs, each through the template that lies nearest to both shapes together."""
    clean = {name: validated(shape) for name, shape in shapes.items()}
    fits: list[dict[str, tuple[float, Places]]] = []  # residuals and places, by model and shape
    for model in models:
        raw = [Fitter(model, config).fit(each.shape) for each in runner.track(clean.values(), "fitting")]
        agreed = agreed_fits(model, [each.shape for each in clean.values()], raw, config)
        places = {name: (fit.residual, Places.of(clean[name], fit)) for name, fit in zip(clean, agreed, strict=True)}
        fits.append(places)
    found = {}
    for a, b in runner.track(pairs, "mapping"):
        best = min(fits, key=lambda each: each[a][0] + each[b][0])
        found[a, b] = build_map(best[a][1], best[b][1])
    return found


def real_shapes(kind: str, data: Path) -> tuple[dict[str, Shape], Mapping[str, Int[Ints, " N"]]]:
    """The benchmark's shapes of a class, standing like generated ones, and their keypoints."""
    shapes, keypoints = load_folder(data / kind, KEYPOINTS)
    turn = UPRIGHT[kind]
    stood = stood_alike(shapes, keypoints)
    return {name: Shape(each.verts @ turn.T, each.faces, each.name) for name, each in stood.items()}, keypoints


def stood_alike(shapes: Shapes, keypoints: Mapping[str, Int[Ints, " N"]]) -> dict[str, Shape]:
    """Every shape by the turn of a cube that brings its keypoints nearest to those of the first shape."""
    turns = Rotation.create_group("O").as_matrix()
    first = next(iter(shapes))
    like = _unit(shapes[first], keypoints[first])
    stood = {first: shapes[first]}
    for name, shape in list(shapes.items())[1:]:
        own = _unit(shape, keypoints[name])
        best = min(turns, key=lambda turn: float(np.square(own @ turn.T - like).sum()))
        stood[name] = Shape(shape.verts @ best.T, shape.faces, shape.name)
    return stood


def _unit(shape: Shape, keypoints: Int[Ints, " N"]) -> Float[Floats, "N 3"]:
    return (shape.verts[keypoints] - shape.bounds.mean(axis=0)) / shape.diagonal


def keypoint_errors(
    shapes: Shapes, keypoints: Mapping[str, Int[Ints, " N"]], maps: Mapping[Pair, VertexMap]
) -> dict[str, Any]:
    """Errors of maps at the keypoints, the share that arrived, and the overlap (IoU) of parts that maps carry."""
    errors, overlaps = [], []
    parts = {name: keypoint_parts(shape, keypoints[name]) for name, shape in shapes.items()}
    for (source, target), found in maps.items():
        labels = parts[target][found.index]
        overlaps.append(mean_overlap(labels, parts[source], shapes[source].vertex_areas))
        shape, at = shapes[target], keypoints[source]
        off = shape.verts[found.index[at]] - shape.verts[keypoints[target]]
        errors.append(np.linalg.norm(off, axis=1) / shape.diagonal)
    error = np.concatenate(errors)
    arrived = float((error < RIGHT).mean())
    record = {"pairs": len(maps), "mean": float(error.mean()), "median": float(np.median(error))}
    return record | {"arrived": arrived, "iou": float(np.mean(overlaps))}


def keypoint_parts(shape: Shape, keypoints: Int[Ints, " N"]) -> Int[Ints, " V"]:
    """The part of every vertex: the number of its nearest keypoint."""
    return np.asarray(cKDTree(shape.verts[keypoints]).query(shape.verts)[1])


def overlaps(
    found: Int[Ints, " V"], truth: Int[Ints, " V"], area: Float[Floats, " V"] | None = None
) -> dict[int, float]:
    """Intersection over union of labels with true ones, by true part; by the area of vertices, if that is given."""
    weight = np.ones(len(truth)) if area is None else area
    shares = {}
    for part in np.unique(truth).tolist():
        ours, theirs = found == part, truth == part
        shares[part] = float(weight[ours & theirs].sum() / weight[ours | theirs].sum())
    return shares


def mean_overlap(found: Ints, truth: Ints, area: Float[Floats, " V"] | None = None) -> float:
    """The mean over true parts."""
    return float(np.mean(list(overlaps(found, truth, area).values())))


@dataclass(frozen=True)
class Plan:
    """How much is learned and measured; see the options of the command."""

    work: Path
    data: Path
    count: int
    test: int
    steps: Mapping[str, int]
    templates: int
    threads: int
    seed: int


def measure(kind: str, plan: Plan, methods: Sequence[str]) -> list[dict[str, Any]]:
    """Train and measure one kind."""
    folder = plan.work / kind
    folder.mkdir(parents=True, exist_ok=True)
    shapes = learned_shapes(kind, plan.count, plan.seed, folder / "samples.npz")
    chosen = chosen_templates(shapes, len(KINDS[kind]), plan.templates)
    runner.tell(f"{kind}: templates {chosen}")
    held_out = range(plan.count, plan.count + plan.test)
    real, keypoints = real_shapes(kind, plan.data)
    pairs = ordered_pairs(real)
    rows = []
    for method in methods:
        size: dict[str, Any] = {"steps": plan.steps[method], "threads": plan.threads, "seed": plan.seed}
        if method == "paper":
            template = cloud_template(kind, plan.seed, chosen[0])
            models = [learn(folder / "paper", template, shapes, paper_clouds().changed(bf16=True, **size))]
            fits = {
                "paper, network alone": FitConfig(seed=plan.seed, refine="none", **_UPRIGHT_ONCE),
                "paper, 200 steps": FitConfig(seed=plan.seed, refine="latent", latent=_PAPER, **_UPRIGHT_ONCE),
            }
        else:
            models = [
                learn(folder / f"ours{k}", mesh_template(kind, plan.seed, k), shapes, clouds().changed(**size))
                for k in chosen
            ]
            fits = {"ours, nodes refined": FitConfig(seed=plan.seed, **_UPRIGHT_ONCE)}
        for name, config in fits.items():
            asked = {"count": plan.count, "test": plan.test, "templates": chosen, "steps": plan.steps[method]}
            asked["seed"] = plan.seed

            def both(models: list[TrainedModel] = models, config: FitConfig = config) -> dict[str, Any]:
                generated = part_overlap(by_models(models, config), kind, held_out, plan.seed)
                return generated | keypoint_errors(real, keypoints, best_maps(models, real, config, pairs))

            kept = folder / f"{name.replace(', ', '-').replace(' ', '-')}.json"
            minutes = sum(model.card.training_minutes for model in models)
            rows.append({"class": kind, "method": name, "minutes": minutes, **runner.once(kept, asked, both)})
            runner.tell(str({key: value for key, value in rows[-1].items() if isinstance(value, float)}))
    return rows


@runner.command
def main(
    data: runner.Data = runner.DATA,
    kinds: Annotated[str, Option(help=f"of {', '.join(KINDS)}")] = "table,plane,chair",
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = ",".join(METHODS),
    count: Annotated[int, Option(min=2, help="generated shapes to learn from")] = 500,
    test: Annotated[int, Option(min=1, help="held-out generated shapes")] = 25,
    paper_steps: Annotated[int, Option(min=1, help="of the paper's training")] = 200,
    steps: Annotated[int, Option(min=1, help="of ours")] = 600,
    templates: Annotated[int, Option(min=1, help="of ours; each has a model")] = 6,
    work: Annotated[Path, Option(help="what was trained and measured is kept here")] = Path("parts"),
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    chosen = runner.names_of(kinds, KINDS, "kind")
    ways = runner.names_of(methods, METHODS, "method")
    rows = []
    plan = Plan(work, data, count, test, {"paper": paper_steps, "ours": steps}, templates, threads, seed)
    for kind in chosen:
        rows += measure(kind, plan, ways)
    title = "Labels carried by models of generated shapes: held-out generated ones, and keypoints of real ones"
    return runner.Report({"rows": rows}, [runner.table(title, rows, COLUMNS)])
