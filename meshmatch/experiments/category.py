"""What the benchmarks of categories without correspondence share: prepare, train, fit all, map all pairs."""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.fitting.agree import agreed_fits
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.maps.build import build_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.pipeline import read_model, usable
from meshmatch.shapes.align import Align, align
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig, Strategy
from meshmatch.templates.prepare import PrepareConfig, prepare
from meshmatch.templates.registered import frame_of
from meshmatch.templates.unregistered import Scale, unit_frame
from meshmatch.training.recipes import clouds, small_data
from meshmatch.training.train import CardFacts, train

Pair = tuple[str, str]
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Training:
    """How a benchmark learns: minutes and steps at most, nodes of the template and their radius (units of sqrt(area)),
    and the folder in which the prepared shapes and the model are kept."""

    work: Path
    minutes: float
    steps: int
    threads: int
    seed: int
    nodes: int
    radius: float

    def inside(self, name: str) -> Training:
        """The same in a folder of this one's."""
        return replace(self, work=self.work / name)


def options_of_training(
    program: str, words: str | None, *, minutes: float, steps: int, nodes: int, radius: float
) -> argparse.ArgumentParser:
    """The options that all of these benchmarks have, with their defaults."""
    parser = argparse.ArgumentParser(
        f"python -m meshmatch.experiments.{program}",
        description=words,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--minutes", type=float, default=minutes, help="of training at most: %(default)s")
    parser.add_argument("--steps", type=int, default=steps, help="of training: %(default)s")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nodes", type=int, default=nodes, help="of the template: %(default)s")
    parser.add_argument(
        "--radius", type=float, default=radius, help="of a node, units of sqrt(area): %(default)s"
    )
    parser.add_argument(
        "--work", type=Path, help="keep what was prepared and trained here, and go on from it"
    )
    return parser


@contextmanager
def training_of(parser: argparse.ArgumentParser, options: argparse.Namespace) -> Iterator[Training]:
    """What was asked for; where no folder was, one that is there for the time."""
    if options.steps < 1 or options.minutes <= 0 or options.threads < 1 or options.seed < 0:
        parser.error("steps and threads of 1 or more, minutes above 0 and a seed of 0 or more are needed")
    with tempfile.TemporaryDirectory() as temporary:
        names = ("minutes", "steps", "threads", "seed", "nodes", "radius")
        yield Training(options.work or Path(temporary), **{name: getattr(options, name) for name in names})


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
    training: Training,
    *,
    how: Align,
    scale: Scale,
    tell: Tell,
    strategy: Strategy = "uniform",
    depth: float = 0.03,
    landmarks: str | None = None,
    template: str | None = None,
    stiffness: float = 1.0,
) -> tuple[Path, dict[str, Any]]:
    """Prepare a folder and learn from it as `meshmatch train` does; the model's folder, and how that went."""
    began = time.monotonic()
    tell("preparing")
    work = training.work
    config = NodeConfig(strategy, training.nodes, training.radius, depth, seed=training.seed)
    chosen = PrepareConfig(config, template=template, align=how, scale=scale, landmarks=landmarks)
    made = prepare(folder, work / "prepared", chosen)
    prepared = time.monotonic() - began
    plain = small_data() if frame_of(work / "prepared") else clouds()
    asked = {name: getattr(training, name) for name in ("steps", "minutes", "threads", "seed")}
    model = train(
        work / "model",
        shapes=work / "prepared",
        recipe=plain.changed(**asked),
        facts=CardFacts(folder.name, folder.name, stiffness=stiffness),
        report=lambda now: tell(f"training: step {now.step} of {now.steps}"),
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
        fits[name] = Fitter(loaded, config).fit(usable(shape).shape)
    return fits


def spread_pairs(shapes: Mapping[str, Shape], limit: int | None = None) -> list[Pair]:
    """All ordered pairs, or so many of them, evenly spread."""
    every = list(permutations(shapes, 2))
    if limit is None or limit >= len(every):
        return every
    return [every[k] for k in np.linspace(0, len(every) - 1, limit).astype(int)]


def map_all(
    model: Path,
    shapes: Mapping[str, Shape],
    fits: Mapping[str, Fit],
    config: FitConfig,
    tell: Tell,
    pairs: Sequence[Pair] | None = None,
) -> dict[Pair, VertexMap]:
    """Maps of all ordered pairs, or of some, through fits that all agree on how the template stretches."""
    loaded = read_model(model)
    tell("agreeing")
    clean = [usable(shape).shape for shape in shapes.values()]
    agreed = dict(zip(shapes, agreed_fits(loaded, clean, list(fits.values()), config), strict=True))
    maps = {}
    for source, target in pairs or spread_pairs(shapes):
        tell(f"mapping {source} to {target}")
        maps[source, target] = build_map(
            usable(shapes[source]), agreed[source], usable(shapes[target]), agreed[target]
        )
    return maps


def nearest_all(
    shapes: Mapping[str, Shape], how: Align, scale: Scale, tell: Tell, pairs: Sequence[Pair] | None = None
) -> dict[Pair, tuple[np.ndarray, np.ndarray]]:
    """For all ordered pairs, or for some, rigid alignment and the nearest vertex: index (V_src,) and a confidence from
    the distance.

    The source is scaled and centred like the target, and turned to it as ``how`` says.
    """
    frames = {name: unit_frame(shape, scale, 0.5) for name, shape in shapes.items()}
    seen, places = {}, {}
    for name, shape in shapes.items():
        samples = sample_surface(shape, 2400, np.random.default_rng(0))
        seen[name] = samples.in_frame(frames[name])
        places[name] = frames[name].apply(shape.verts)
    trees = {name: cKDTree(points) for name, points in places.items()}
    found = {}
    for source, target in pairs or spread_pairs(shapes):
        tell(f"aligning {source} to {target}")
        best = align(seen[source], seen[target], how)[0]
        moved = best.pose.to_local(places[source])
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
