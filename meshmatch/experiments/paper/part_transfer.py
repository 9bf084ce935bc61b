"""Segmentation transfer learned from generated shapes, as section 1.4.2 of the paper's supplement describes it.

500 generated tables, planes or chairs (`experiments.makers.furniture`) are learned without correspondence. "paper": a
labelled point cloud is the template (300 nodes, reach 0.2 of its diameter), the paper's network with the weights of its
table 2 on plain Chamfer distances, 200 steps on the code of a new shape. "ours": labelled meshes are the templates, the
default network for small data, node vectors refined; the template with the smallest residual is taken.

Two tests on what no training saw. Held-out generated shapes: each point takes the label of the nearest point of the fitted
template; intersection over union of the parts that a shape has, its mean over shapes.
The real ones of the benchmark (SHREC'07): every ordered pair is matched through the template
and measured as in `experiments.bench.keypoints`.

The work folder keeps everything, and the same command goes on from it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.arrays import Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench import category
from meshmatch.experiments.bench.category import Shapes
from meshmatch.experiments.bench.keypoints import KEYPOINTS, RIGHT, keypoint_errors, mean_overlap, stood_alike
from meshmatch.experiments.bench.sets import Pair, load_folder
from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.experiments.makers.furniture_models import (
    chosen_templates,
    cloud_template,
    learn,
    learned_shapes,
    mesh_template,
)
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.fitting.search.latent import LatentRefineConfig
from meshmatch.geometry.oriented import OrientedPoints
from meshmatch.maps.build import build_map
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from meshmatch.training.recipes import clouds, paper_clouds

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


def by_models(models: Sequence[TrainedModel], config: FitConfig) -> Labeller:
    """Each point takes the label of the nearest point of the template that fits best."""

    def labels(shape: Shape, points: OrientedPoints) -> Int[Ints, " N"]:
        fits = [Fitter(model, config).fit(shape) for model in models]
        best = min(range(len(models)), key=lambda k: fits[k].residual)
        return models[best].template.labels[cKDTree(fits[best].points_in_file).query(points.points)[1]]

    return labels


def part_overlap(give: Labeller, kind: str, numbers: range, seed: int) -> dict[str, Any]:
    """Mean overlap of the parts of held-out shapes with those that their points are given."""
    shares: list[float] = []
    each: dict[int, list[float]] = {}
    began = time.monotonic()
    for number in runner.track(numbers, "generated"):
        made = furniture(kind, seed, number)
        points, normals, truth = made.sample(3000, np.random.default_rng([seed, number, 2]))
        found = give(made.surface, OrientedPoints(points, normals))
        shares.append(mean_overlap(found, truth, np.ones(len(points))))
        for part in np.unique(truth):
            ours, theirs = found == part, truth == part
            each.setdefault(int(part), []).append(float((ours & theirs).sum() / (ours | theirs).sum()))
    names = {KINDS[kind][part]: float(np.mean(values)) for part, values in sorted(each.items())}
    seconds = (time.monotonic() - began) / max(len(numbers), 1)
    return {"generated_iou": float(np.mean(shares)), "parts_iou": names, "fit_seconds": seconds}


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
    pairs = category.ordered_pairs(real)
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


if __name__ == "__main__":
    sys.exit(main())
