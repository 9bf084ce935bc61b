"""What the experiments on categories without correspondence share: prepare, train, fit all, map all pairs, measure."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import as_model, validated
from meshmatch.arrays import Int, Ints
from meshmatch.experiments.bench.sets import Pair
from meshmatch.experiments.runner import tell, track
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.maps.build import build_map
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.picture import Look, Panel, render_shapes
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.normalise import Align, align
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepare import PrepareConfig, prepare
from meshmatch.templates.prepared_folder import frame_of
from meshmatch.templates.template import Scale, unit_frame
from meshmatch.training.recipes import clouds, small_data
from meshmatch.training.train import CardFacts, train

Maps = Mapping[Pair, VertexMap]
Shapes = Mapping[str, Shape]
RIGID = "rigid alignment, nearest vertex"

Minutes = Annotated[float, Option(min=0.001, help="of training at most")]
Steps = Annotated[int, Option(min=1, help="of training")]
Work = Annotated[Path | None, Option(help="keep what was prepared and trained here, and go on from it")]


@dataclass(frozen=True)
class Training:
    """How an experiment learns: minutes and steps at most, and the folder where prepared shapes and model are kept."""

    work: Path
    minutes: float
    steps: int
    threads: int
    seed: int


@contextmanager
def training_in(work: Path | None, **how: Any) -> Iterator[Training]:
    """A training in a folder; where none is given, in one that is there for the time."""
    with tempfile.TemporaryDirectory() as temporary:
        yield Training(work or Path(temporary), **how)


def trained(
    folder: Path, training: Training, nodes: NodeConfig, *, how: Align, scale: Scale, stiffness: float = 1.0
) -> tuple[Path, dict[str, Any]]:
    """Prepare a folder and learn from it as `meshmatch train` does; the model's folder, and how that went."""
    began = time.monotonic()
    work, name = training.work, folder.name
    tell(f"preparing {name}")
    chosen = PrepareConfig(nodes, align=how, scale=scale)
    made = prepare(folder, work / "prepared", chosen)
    prepared = time.monotonic() - began
    plain = small_data() if frame_of(work / "prepared") else clouds()
    asked = {key: getattr(training, key) for key in ("steps", "minutes", "threads", "seed")}
    model = train(
        work / "model",
        shapes=work / "prepared",
        recipe=plain.changed(**asked),
        facts=CardFacts(name, name, stiffness=stiffness),
        report=lambda now: tell(f"training {name}: step {now.step} of {now.steps}"),
    )
    card = json.loads((model / "card.json").read_text(encoding="utf-8"))
    notes = (note.removeprefix("template: ") for note in made.notes if note.startswith("template: "))
    return model, {
        "template": next(notes).split(",")[0],
        "prepare_seconds": round(prepared, 1),
        **{key: card[key] for key in ("training_minutes", "steps")},
        "distance": card["metrics"]["validation"]["distance"],
    }


def ordered_pairs(shapes: Shapes, limit: int | None = None) -> list[Pair]:
    """All ordered pairs, or so many of them, evenly spread."""
    every = list(permutations(shapes, 2))
    if limit is None or limit >= len(every):
        return every
    return [every[k] for k in np.linspace(0, len(every) - 1, limit).astype(int)]


def fitted_maps(
    model: Path, shapes: Shapes, config: FitConfig, pairs: Sequence[Pair]
) -> tuple[dict[Pair, VertexMap], dict[str, str]]:
    """Maps of pairs through fits that all agree on how the template stretches, and the verdict of each fit."""
    loaded = as_model(model)
    fitter = Fitter(loaded, config)
    fits = [fitter.fit(validated(shape).shape) for shape in track(shapes.values(), "fitting")]
    verdicts: dict[str, str] = {name: fit.verdict for name, fit in zip(shapes, fits, strict=True)}
    clean = [validated(shape) for shape in shapes.values()]
    agreed = agreed_fits(loaded, [each.shape for each in clean], fits, config)
    places = {name: Places.of(part, fit) for name, part, fit in zip(shapes, clean, agreed, strict=True)}
    maps = {(a, b): build_map(places[a], places[b]) for a, b in track(pairs, "mapping")}
    return maps, verdicts


def compared(
    model: Path,
    shapes: Shapes,
    configs: Mapping[str, FitConfig],
    pairs: Sequence[Pair],
    errors: Callable[[Maps], Mapping[str, Any]],
) -> tuple[list[dict[str, Any]], Maps]:
    """A row of errors for each way to refine, and the maps of the last one."""
    rows: list[dict[str, Any]] = []
    maps: Maps = {}
    for label, config in configs.items():
        began = time.monotonic()
        maps, verdicts = fitted_maps(model, shapes, config, pairs)
        found = {"method": label, **errors(maps), "verdicts": verdicts}
        rows.append(found | {"seconds": round(time.monotonic() - began, 1)})
    return rows, maps


def network_and_nodes(seed: int) -> dict[str, FitConfig]:
    """The two ways that all experiments compare: the network alone, and nodes refined."""
    return {
        "network alone": FitConfig(seed=seed, refine="none", partial="no"),
        "nodes refined": FitConfig(seed=seed, partial="no"),
    }


def nearest_maps(shapes: Shapes, how: Align, scale: Scale, pairs: Sequence[Pair]) -> dict[Pair, VertexMap]:
    """Rigid alignment and the nearest vertex, with a confidence from the distance.

    The source is scaled and centered like the target, and turned to it as ``how`` says.
    """
    frames = {name: unit_frame(shape, scale, 0.5) for name, shape in shapes.items()}
    seen, places = {}, {}
    for name, shape in shapes.items():
        samples = sample_surface(shape, 2400, np.random.default_rng(0))
        seen[name] = samples.in_frame(frames[name])
        places[name] = frames[name].apply(shape.verts)
    trees = {name: cKDTree(points) for name, points in places.items()}
    found = {}
    for a, b in track(pairs, "aligning"):
        best = align(seen[a], seen[b], how)[0]
        distance, index = trees[b].query(best.pose.to_local(places[a]))
        found[a, b] = VertexMap.between(shapes[a], shapes[b], index, confidence=np.exp(-distance / 0.03))
    return found


def carried_picture(
    path: Path, look: Look, shapes: Shapes, labels: Int[Ints, " V"], onto: Mapping[str, VertexMap], first: str
) -> None:
    """One shape's labels in colors, and the same on others as maps onto it carry them, gray where not confident."""
    colors = label_colors(np.arange(int(labels.max()) + 1))
    panels = [Panel(shapes[first], colors[labels], label=f"{first}: labeled")]
    for name, found in onto.items():
        share = np.clip(found.confidence, 0, 1)[:, None]
        mixed = share * colors[labels[found.index]] + (1 - share) * 0.85
        panels.append(Panel(shapes[name], mixed, label=f"on {name}"))
    render_shapes(panels, path, look)
