"""What the benchmarks of categories without correspondence share: prepare, train, fit all, map all pairs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fit_shape import fit_shape as lay_template
from meshmatch.maps.build import build_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.pipeline import read_model, usable
from meshmatch.shapes.align import Align, Oriented, align
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.gather import Scale, read_gathered, unit_frame
from meshmatch.templates.nodes import NodeConfig
from meshmatch.templates.prepare import prepare_folder
from meshmatch.templates.template import load_template
from meshmatch.training.unsupervised import cloud_recipe, train_clouds

Pair = tuple[str, str]
Tell = Callable[[str], None]


def load_category(folder: Path, ending: str) -> tuple[dict[str, Shape], dict[str, np.ndarray]]:
    """Shapes of a folder and what is true of each, by name.

    Raises
    ------
    InputError
        The folder is not there, or a shape lacks its truth.
    """
    files = sorted(folder.glob("*.ply"))
    if not files:
        raise InputError(f"no shapes in {folder}", "--data names the folder that holds the benchmark")
    missing = [file.name for file in files if not file.with_name(file.stem + ending).is_file()]
    if missing:
        raise InputError(f"{missing[0]} has no {ending}")
    truth = {file.stem: np.load(file.with_name(file.stem + ending), allow_pickle=False) for file in files}
    return {file.stem: load_shape(file) for file in files}, truth


def trained(
    folder: Path,
    work: Path,
    *,
    minutes: float,
    steps: int,
    how: Align,
    scale: Scale,
    threads: int,
    seed: int,
    tell: Tell,
    nodes: NodeConfig | None = None,
    landmarks: str | None = None,
    template: str | None = None,
) -> tuple[Path, dict[str, Any]]:
    """Prepare a folder and learn from it without correspondence; the model's folder, and how that went."""
    began = time.monotonic()
    tell("preparing")
    config = nodes or NodeConfig(strategy="geodesic", seed=seed)
    made = prepare_folder(
        folder, work / "prepared", config, template=template, align=how, scale=scale, landmarks=landmarks
    )
    prepared = time.monotonic() - began
    plain = cloud_recipe()
    recipe = replace(
        plain, train=replace(plain.train, steps=steps, minutes=minutes, threads=threads, seed=seed)
    )
    laid = load_template(work / "prepared" / "template.safetensors")
    model = train_clouds(
        laid,
        read_gathered(work / "prepared", laid),
        work / "model",
        recipe=recipe,
        name=folder.name,
        category=folder.name,
        progress=lambda now: tell(f"training: step {now.step} of {now.steps}"),
    )
    card = json.loads((model / "card.json").read_text(encoding="utf-8"))
    notes = (note.removeprefix("template: ") for note in made.notes if note.startswith("template: "))
    return model, {
        "template": template or next(notes).split(",")[0],
        "prepare_seconds": round(prepared, 1),
        "training_minutes": card["training_minutes"],
        "steps": card["steps"],
        "distance": card["metrics"]["validation"]["distance"],
    }


def fit_all(model: Path, shapes: Mapping[str, Shape], config: FitConfig, tell: Tell) -> dict[str, Fit]:
    """Every shape fitted."""
    loaded = read_model(model)
    fits = {}
    for name, shape in shapes.items():
        tell(f"fitting {name}")
        fits[name] = lay_template(loaded, usable(shape).shape, config)
    return fits


def map_all(
    model: Path, shapes: Mapping[str, Shape], fits: Mapping[str, Fit], config: FitConfig, tell: Tell
) -> dict[Pair, VertexMap]:
    """Maps of all ordered pairs, through fits that all agree on how the template stretches."""
    loaded = read_model(model)
    tell("agreeing")
    clean = [usable(shape).shape for shape in shapes.values()]
    agreed = dict(zip(shapes, agreed_fits(loaded, clean, list(fits.values()), config), strict=True))
    maps = {}
    for source, target in permutations(shapes, 2):
        tell(f"mapping {source} to {target}")
        maps[source, target] = build_map(
            usable(shapes[source]), agreed[source], usable(shapes[target]), agreed[target]
        )
    return maps


def nearest_all(
    shapes: Mapping[str, Shape], how: Align, scale: Scale, tell: Tell
) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
    """For all ordered pairs rigid alignment and the nearest vertex: index (V_src,) and a confidence from the distance.

    The source is scaled and centred like the target, and turned to it as ``how`` says.
    """
    frames = {name: unit_frame(shape, scale, 0.5) for name, shape in shapes.items()}
    seen, places = {}, {}
    for name, shape in shapes.items():
        samples = sample_surface(shape, 2400, np.random.default_rng(0))
        seen[name] = Oriented(frames[name].apply(samples.points), samples.normals)
        places[name] = frames[name].apply(shape.verts)
    trees = {name: cKDTree(points) for name, points in places.items()}
    found = {}
    for source, target in permutations(shapes, 2):
        tell(f"aligning {source} to {target}")
        best = align(seen[source], seen[target], how)[0]
        moved = (places[source] - best.centre) @ best.rotation
        distance, index = trees[target].query(moved)
        found[source, target] = (index, np.exp(-distance / 0.03))
    return found


def area_under_curve(score: Sequence[float] | np.ndarray, right: Sequence[bool] | np.ndarray) -> float:
    """Chance that a right answer has a higher score than a wrong one (ties count half); nan if one kind lacks."""
    from scipy.stats import rankdata

    values, truth = np.asarray(score, float), np.asarray(right, bool)
    good, bad = int(truth.sum()), int((~truth).sum())
    if not good or not bad:
        return float("nan")
    ranks = rankdata(values)
    return float((ranks[truth].sum() - good * (good + 1) / 2) / (good * bad))
