"""Implicit surfaces: DIF-Net's pointwise deformation beside the reduced field, on generated chairs, tables and planes.

For each kind both learn the same shapes with the same template, correction, losses, batches and steps
(`meshmatch.implicit`); only the deformation differs, and that the reduced field has energies (volume, rigidity,
also between codes) which are cheap for it. `published` is DIF-Net with its own sizes, terms, weights and rate,
`published-reduced` the same with the reduced field and its energies. Measured on the shapes of the training, whose parts are
known:

reconstruction: Chamfer distance (both ways, mean, % of the longest side) and IoU of the insides;
labels: part IoU where each point of one shape takes the part of the nearest point of another on the template, by position
alone and with normals, over pairs of 64 of the shapes;
interpolation: how far the surface's motion is from even, |f(t+h) - 2 f(t) + f(t-h)| on the surface at t (% of the longest
side), its part of the motion |f(t+h) - f(t-h)| / 2; how far volume is from going evenly (%); pieces that a surface has;
mean volume and rigidity energies of the deformation on the surfaces; CPU seconds of a training step.

With --seeds both are trained as often on the same shapes, and a number is the mean over trainings, with its standard
deviation. What is finished is kept in --work, and trainings go on from their checkpoints. --picture draws figure 12:
shapes between two, colored by how far the deformation moves each point to the template.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.arrays import Floats, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.charts import stacked
from meshmatch.experiments.makers.furniture import KINDS, furniture
from meshmatch.experiments.paper.part_transfer import mean_overlap
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.implicit.fit import ImplicitFit
from meshmatch.implicit.model import ImplicitModel, load_implicit, nearest_on_template
from meshmatch.implicit.network import ImplicitConfig
from meshmatch.implicit.samples import ImplicitSamples, read_implicit_samples
from meshmatch.implicit.training import AS_PUBLISHED, DIF_NET, TRAINING, train_implicit
from meshmatch.models.card import IMPLICIT
from meshmatch.outputs import make_folder
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.training.loop import TrainConfig

METHODS = {"DIF-Net": "pointwise", "reduced": "mls", "published": "published", "published-reduced": "published-mls"}
"""And what their folders are called."""
FRAMES = 5
_POINTS = 2000
_LABELLED, _PAIRS = 64, 50  # shapes whose points have labels, and pairs of them for each that is compared
_COMPARED = ("chamfer", "label_iou", "facing_iou", "bend")
_MOVED = 0.25  # of the cube's half side: the last color


def prepared(work: Path, kind: str, shapes: int, seed: int) -> Path:
    """A folder with the meshes of a kind, made where they are missing."""
    folder = work / "shapes" / kind
    make_folder(folder)
    for number in range(shapes):
        file = folder / f"{kind}{number:04d}.ply"
        if not file.is_file():
            save_shape(file, furniture(kind, seed, number).mesh())
    return folder


def trained(folder: Path, samples: ImplicitSamples, config: ImplicitConfig, training: TrainConfig) -> ImplicitModel:
    """The model of a folder, trained to the end."""
    checkpoint = folder / "checkpoint" / "last.safetensors"
    if not (folder / IMPLICIT).is_file() or checkpoint.is_file():
        train_implicit(folder, samples, config=config, training=training,
                       report=lambda now: runner.tell(f"{folder.name}: {now.words}"))  # fmt: skip
        checkpoint.unlink()  # finished: what is left is the model
    return load_implicit(folder)


def learned(model: ImplicitModel, number: int) -> ImplicitFit:
    """A shape of the training."""
    return model.known(model.card.shapes[number])


def chamfer(a: Floats, b: Floats) -> float:
    """Mean distance to the nearest point of the other set, of both ways."""
    return float(0.5 * (cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean()))


def reconstruction(model: ImplicitModel, kind: str, numbers: list[int], seed: int) -> dict[str, float]:
    """Mean errors of the surfaces of some shapes."""
    found = []
    for number in numbers:
        truth, rng = furniture(kind, seed, number), np.random.default_rng(number)
        shape = learned(model, number)
        drawn = sample_surface(model.surface(shape), 5 * _POINTS, rng).points
        distance = chamfer(drawn, truth.sample(5 * _POINTS, rng)[0])
        anywhere = rng.uniform(-1, 1, (20_000, 3))
        inside = truth.field(shape.frame.undo(anywhere)) < 0
        ours = model.distance(anywhere, shape.code)[0] < 0
        side = float(np.ptp(truth.surface.verts, axis=0).max())
        found.append((100 * distance / side, np.count_nonzero(inside & ours) / np.count_nonzero(inside | ours)))
    return dict(zip(("chamfer", "iou"), np.mean(found, 0).tolist(), strict=True))


Labelled = dict[int, tuple[Floats, Floats, Ints]]
"""Points of shapes by their numbers, with normals and parts."""


def labelled_points(kind: str, numbers: list[int], seed: int) -> Labelled:
    """Points of the surfaces of some shapes."""
    return {k: furniture(kind, seed, k).sample(_POINTS, np.random.default_rng(k)) for k in numbers}


def label_transfer(model: ImplicitModel, points: Labelled, pairs: list[tuple[int, int]]) -> dict[str, float]:
    """Part IoU through the template, of the parts that both shapes have: by position, with normals too as `match` does, and
    by position where nothing is deformed.
    """
    shapes = {k: learned(model, k) for k in points}
    places = {k: model.to_template(points[k][0], shapes[k]) for k in points}
    cubes = {k: shapes[k].frame.apply(points[k][0]) for k in points}
    found = []
    for a, b in pairs:
        (_, m, labels), (_, n, truth) = points[a], points[b]
        common = np.intersect1d(labels, truth).tolist()
        known, asked = np.isin(labels, common), np.isin(truth, common)
        row = []
        for at, share in ((places, 0), (places, 1), (cubes, 0)):
            index = nearest_on_template(at[b][asked], at[a][known], share * n[asked], share * m[known])
            row.append(mean_overlap(labels[known][index], truth[asked]))
        found.append(row)
    return dict(zip(("label_iou", "facing_iou", "undeformed_iou"), np.mean(found, 0).tolist(), strict=True))


def interpolation(model: ImplicitModel, pairs: list[tuple[int, int]]) -> dict[str, float]:
    """Mean measures of the way between two shapes, in the cube, where the longest side is 1.7."""
    times, found = np.linspace(0, 1, FRAMES), []
    step = 100 / 1.7
    for pair in pairs:
        coded = [model.blend(learned(model, pair[0]), learned(model, pair[1]), float(time)) for time in times]
        shapes = [model.surface(each) for each in coded]
        solids = [trimesh.Trimesh(shape.verts, shape.faces, process=False) for shape in shapes]
        volumes = np.array([solid.volume / each.frame.scale**3 for solid, each in zip(solids, coded, strict=True)])
        even = volumes[0] + times * (volumes[-1] - volumes[0])
        rows = []
        for k in range(1, FRAMES - 1):
            drawn = sample_surface(shapes[k], _POINTS, np.random.default_rng(k)).points
            points = np.clip(coded[k].frame.apply(drawn), -1, 1)
            before, here, after = (model.distance(points, coded[j].code)[0] for j in (k - 1, k, k + 1))
            bent, moved = np.abs(after - 2 * here + before).mean(), 0.5 * np.abs(after - before).mean()
            with torch.no_grad():
                F = model.network(torch.from_numpy(points).float()[None], coded[k].code[None]).F
            energies = float(volume_energy(F).mean()), float(arap_energy(F).mean())
            rows.append((step * bent, bent / moved, shapes[k].face_parts.max() + 1, *energies))
        found.append((*np.mean(rows, 0), 100 * np.abs(volumes / even - 1).mean()))
    names = ("bend", "bend_share", "pieces", "volume_energy", "arap_energy", "volume_change")
    return dict(zip(names, np.mean(found, 0).tolist(), strict=True))


def means(trainings: list[dict[str, Any]]) -> dict[str, Any]:
    """Means over trainings, the standard deviations of those that are compared, and the numbers of each."""
    names = [name for name in trainings[0] if name != "asked"]
    values = {name: [float(each[name]) for each in trainings] for name in names}
    spread = {f"{name}_sd": float(np.std(values[name], ddof=1)) for name in _COMPARED if len(trainings) > 1}
    return {name: float(np.mean(values[name])) for name in names} | spread | {"trainings": values}


def pairs_of(shapes: int, count: int, seed: int) -> list[tuple[int, int]]:
    """Different shapes, drawn once for all methods."""
    rng = np.random.default_rng([seed, 12])
    return [tuple(rng.choice(shapes, 2, replace=False).tolist()) for _ in range(count)]


def moved_colors(model: ImplicitModel, coded: ImplicitFit, shape: Shape) -> Floats:
    """How far the deformation moves each vertex: white is not at all, dark red far."""
    points = np.clip(coded.frame.apply(shape.verts), -1, 1)
    far = np.clip(np.linalg.norm(model.to_template(shape.verts, coded) - points, axis=1) / _MOVED, 0, 1)[:, None]
    stops = np.array([[0.93, 0.93, 0.90], [0.98, 0.72, 0.35], [0.70, 0.10, 0.15]])
    return np.where(
        far < 0.5, stops[0] + 2 * far * (stops[1] - stops[0]), stops[1] + (2 * far - 1) * (stops[2] - stops[1])
    )


def draw(path: Path, models: Mapping[tuple[str, str], ImplicitModel], pair: tuple[int, int]) -> None:
    """Figure 12: a row for each kind and method."""
    rows = []
    for (kind, method), model in models.items():
        panels = []
        for time_ in np.linspace(0, 1, 6).tolist():
            coded = model.blend(learned(model, pair[0]), learned(model, pair[1]), time_)
            shape = model.surface(coded, resolution=96)
            colors = moved_colors(model, coded, shape)
            panels.append(Panel(shape, colors, f"{kind}, {method}" if time_ == 0 else f"{time_:.1f}"))
        tilt = 35.0 if kind == "plane" else 14.0
        rows.append((panels, Look((1500, 260), up="y", front="z", turn=30.0, tilt=tilt)))
    stacked(rows, path)


@runner.command
def main(
    work: Annotated[Path, Option(help="where finished work is kept")] = Path("runs/implicit"),
    kinds: Annotated[str, Option(help=f"of {', '.join(KINDS)}")] = ",".join(KINDS),
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = "DIF-Net,reduced",
    shapes: Annotated[int, Option(min=4, help="of each kind")] = 500,
    steps: Annotated[int, Option(min=1)] = 1000,
    seeds: Annotated[int, Option(min=1, help="trainings of each, on the same shapes")] = 1,
    compared: Annotated[int, Option(min=1, help="shapes reconstructed, and pairs of interpolations")] = 6,
    picture: Annotated[Path | None, Option(help="figure 12, a PNG")] = None,
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    rows: list[dict[str, Any]] = []
    models: dict[tuple[str, str], ImplicitModel] = {}
    for kind in runner.names_of(kinds, KINDS, "kind"):
        samples = read_implicit_samples(prepared(work, kind, shapes, seed), seed)
        chosen = runner.spread(range(shapes), _LABELLED)
        points = labelled_points(kind, chosen, seed)
        pairs = [(chosen[a], chosen[b]) for a, b in pairs_of(len(chosen), _PAIRS * compared, seed)]
        for method in runner.names_of(methods, METHODS, "method"):
            published = method.startswith("published")
            config = replace(
                DIF_NET if published else ImplicitConfig(), field="mls" if method.endswith("reduced") else "pointwise"
            )
            usual = AS_PUBLISHED if published else TRAINING
            trainings = []
            for number in range(seed, seed + seeds):
                training = replace(usual, steps=steps, seed=number, checkpoint_minutes=1.0)
                folder = work / f"{kind}-{METHODS[method]}-{number}"
                model = trained(folder, samples, config, training)
                models.setdefault((kind, method), model)
                asked = {"shapes": shapes, "steps": steps, "compared": compared, "seed": seed}

                def measure() -> dict[str, float]:
                    runner.tell(f"measuring {folder.name}")  # noqa: B023
                    return {
                        **reconstruction(model, kind, runner.spread(range(shapes), compared), seed),  # noqa: B023
                        **label_transfer(model, points, pairs),  # noqa: B023
                        **interpolation(model, pairs_of(shapes, compared, seed + 1)),  # noqa: B023
                    }

                trainings.append(runner.once(folder / "measured.json", asked, measure))
            rows.append({"kind": kind, "method": method, **means(trainings)})
    if picture is not None:
        draw(picture, models, pairs_of(shapes, compared, seed + 1)[0])
    columns = {
        **{"kind": "kind", "deformation": "method", "Chamfer %": "chamfer:.3f", "IoU": "iou:.3f"},
        **{"label IoU": "label_iou:.3f", "with normals": "facing_iou:.3f", "undeformed": "undeformed_iou:.3f"},
        **{"bend %": "bend:.3f", "of motion": "bend_share:.3f", "volume %": "volume_change:.2f"},
        **{"pieces": "pieces:.1f", "(det F-1)^2": "volume_energy:.3f", "|F'F-I|": "arap_energy:.3f"},
    }
    title = f"Implicit surfaces, {shapes} shapes of a kind, {steps} steps, {seeds} training{'s' * (seeds > 1)} of each"
    tables = [runner.table(title, rows, columns)]
    if seeds > 1:
        deviations = {"kind": "kind", "deformation": "method"} | {name: f"{name}_sd:.3f" for name in _COMPARED}
        tables.append(runner.table("Standard deviations over trainings", rows, deviations))
    return runner.Report({"rows": rows}, tables)
