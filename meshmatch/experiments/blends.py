"""What lies between two codes: ``python -m meshmatch.experiments.blends --models human,./trained-with-blend``.

For pairs of a set, the codes that each network has for the two shapes are blended at a quarter, a half and three
quarters, and decoded. Deviations from the volume and rigidity that the two ends have, blended (`Deviation`), say how
true the shapes between are; the residual of the network's own fits says what the ends cost. All models see the same
pairs. ``--ways codes,field`` measures the program's other way to blend beside it, which needs no training for it.

``--bodies N`` also measures what the decoder alone answers, to the codes of so many generated bodies that no training
drew and between them: the energies that `meshmatch train --blend` weighs. The difference from the fits, which blending
adds, is the leftover; error is that of the code's answer, and of the network's after its corrections.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from rich.table import Table

from meshmatch.errors import OptionError
from meshmatch.experiments.bench import chosen_pairs
from meshmatch.experiments.protocols import SET_NAMES, BenchSet, load_set
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.fields.energies import arap_energy, volume_energy
from meshmatch.fitting.blend import WAYS, Blend, Way
from meshmatch.fitting.fit import Fit
from meshmatch.maps.evaluate import SKIN_M2
from meshmatch.pipeline import read_model, register, usable
from meshmatch.threads import set_threads
from meshmatch.training.bodies import human_source
from meshmatch.training.losses import distance
from meshmatch.training.scans import ScanConfig
from meshmatch.training.setup import build_dataset, build_loss_points

TIMES = (0.25, 0.5, 0.75)
_PEOPLE = 64
DEVIATIONS = ("volume", "arap", "template_volume", "template_arap")


def measure(
    bench: BenchSet, model: str, *, limit: int, seed: int, ways: Sequence[Way] = ("codes",)
) -> dict[Way, dict[str, Any]]:
    """By way: mean deviations between the ends of ``limit`` pairs, also at each time; the mean residual of the ends."""
    loaded = read_model(model)
    fits: dict[str, Fit] = {}
    shapes = {}
    rows: dict[Way, list[list[list[float]]]] = {way: [] for way in ways}
    pairs = chosen_pairs(bench, limit)
    for pair in track(pairs, model, console=Console(stderr=True)):
        for name in pair:
            if name not in fits:
                shapes[name] = usable(bench.shape(name)).shape
                fits[name] = register(shapes[name], model=model, refine="none", seed=seed)
        for way in ways:
            blend = Blend(loaded, [fits[n] for n in pair], None, [shapes[n] for n in pair], way)
            found = [blend.deviation(time, blend.vectors(time)) for time in TIMES]
            rows[way].append([[getattr(each, name) for name in DEVIATIONS] for each in found])
    residual = float(np.mean([fit.residual for fit in fits.values()]))
    answers = {}
    for way in ways:
        means = np.mean(rows[way], axis=0)  # times, deviations
        answers[way] = {
            "pairs": len(pairs),
            "of": len(bench.pairs),
            **dict(zip(DEVIATIONS, means.mean(0).tolist(), strict=True)),
            "residual": residual,
            "at": {
                str(time): dict(zip(DEVIATIONS, row, strict=True))
                for time, row in zip(TIMES, means.tolist(), strict=True)
            },
        }
    return answers


@torch.inference_mode()
def decoded(model: str, bodies: int, seed: int) -> dict[str, float]:
    """Energies of a decoder's answers to codes of unseen bodies and between two, errors and leftovers in cm.

    Raises
    ------
    OptionError
        The model's template is not made from the body model.
    """
    loaded = read_model(model)
    template, network = loaded.template, loaded.network
    source = human_source(template, _PEOPLE, loaded.card.seed + 1 + seed)
    points = build_loss_points(template, loaded.card.field["kernel"], network)
    batch = build_dataset(template, source, network, ScanConfig(), bodies, 1, seed)[0]
    codes = network.encoder(batch.encode_features)
    ends, fits = network.decoder(codes), network(batch.points)
    others = codes.roll(bodies // 2, 0)
    between = [network.decoder((1 - time) * codes + time * others) for time in TIMES]
    energies = {}
    for name, answers in (("ends", [ends]), ("between", between)):
        F = torch.cat([points.deformation_gradient(each) for each in answers])
        energies[f"{name}_volume"] = float(volume_energy(F).mean())
        energies[f"{name}_arap"] = float(arap_energy(F).mean())
    cm = 100 * SKIN_M2**0.5
    return energies | {
        "leftover_cm": cm * float(distance(points.moved(fits), points.moved(ends))),
        "code_error_cm": cm * float(distance(points.moved(ends), batch.targets)),
        "corrected_error_cm": cm * float(distance(points.moved(fits), batch.targets)),
    }


def run(
    bench: BenchSet,
    models: Sequence[str],
    *,
    limit: int,
    seed: int,
    ways: Sequence[Way] = ("codes",),
    bodies: int = 0,
) -> dict[str, Any]:
    """Measure every model, print a table and a JSON line; the line's record is returned too."""
    set_threads(1)
    found = {model: measure(bench, model, limit=limit, seed=seed, ways=ways) for model in models}
    table = Table(title=f"Between two shapes, {bench.name}", title_justify="left")
    for name in ("model", "blended"):
        table.add_column(name)
    names = (*DEVIATIONS, "residual")
    for name in ("pairs", *names):
        table.add_column(name.replace("_", " "), justify="right")
    for model, answers in found.items():
        for way, row in answers.items():
            pairs = f"{row['pairs']} of {row['of']}"
            table.add_row(Path(model).name, way, pairs, *(f"{row[n]:.4f}" for n in names))
    wide_console().print(table)
    alone = {model: decoded(model, bodies, seed) for model in models} if bodies else {}
    if alone:
        table = Table(title=f"The decoder alone, {bodies} bodies", title_justify="left")
        table.add_column("model")
        for name in next(iter(alone.values())):
            table.add_column(name.replace("_", " "), justify="right")
        for model, values in alone.items():
            table.add_row(Path(model).name, *(f"{value:.4f}" for value in values.values()))
        wide_console().print(table)
    whole = {
        "benchmark": "blends",
        **circumstances(threads=1, jobs=1),
        "set": bench.name,
        "times": list(TIMES),
        "seed": seed,
        "models": found,
        "bodies": bodies,
        "decoded": alone,
    }
    print(json.dumps(whole), flush=True)
    return whole


def known_ways(words: str) -> list[Way]:
    """Ways with commas; `OptionError` where one is none."""
    named = {str(way): way for way in WAYS}
    asked = list(dict.fromkeys(words.split(",")))
    for word in asked:
        if word not in named:
            raise OptionError(f"no way {word!r} to blend", f"choose from {', '.join(WAYS)}")
    return [named[word] for word in asked]


def main(words: Sequence[str] | None = None) -> int:
    """Run it; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.blends", description=__doc__)
    parser.add_argument("--models", default="human", help="names or folders, with commas; %(default)s")
    parser.add_argument("--ways", default="codes", help=f"some of {', '.join(WAYS)}; %(default)s")
    parser.add_argument("--set", default="scape", choices=SET_NAMES)
    parser.add_argument("--limit-pairs", type=int, default=30, metavar="N")
    parser.add_argument(
        "--bodies", type=int, default=0, metavar="N", help="generated, 2 or more; %(default)s"
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    if options.bodies < 0 or options.bodies == 1:
        parser.error("between fewer than two bodies there is nothing")

    def work() -> None:
        ways = known_ways(options.ways)  # before anything is read
        bench, models = load_set(options.set, options.data), options.models.split(",")
        run(bench, models, limit=options.limit_pairs, seed=options.seed, ways=ways, bodies=options.bodies)

    return status_of(work)


if __name__ == "__main__":
    sys.exit(main())
