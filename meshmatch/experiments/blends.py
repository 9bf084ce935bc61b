"""What lies between two codes.

For pairs of a set, the codes that each network has for the two shapes are blended at a quarter, a half and three
quarters, and decoded. Deviations from the volume and rigidity that the two ends have, blended (`Deviation`), say how
true the shapes between are; the residual of the network's own fits says what the ends cost. All models see the same
pairs. --ways codes,field measures the program's other way to blend beside it, which needs no training for it.

--bodies N also measures what the decoder alone answers, to the codes of so many generated bodies that no training drew
and between them: the energies that `meshmatch train --blend` weighs. The difference from the fits, which blending adds,
is the leftover; error is that of the code's answer, and of the network's after its corrections.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from typer import BadParameter, Option

from meshmatch.api.inputs import as_model, validated
from meshmatch.experiments import runner
from meshmatch.experiments.bench_methods import OurMethod
from meshmatch.experiments.sets import BenchSet, load_set
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.fitting.blend import WAYS, Blend, Way
from meshmatch.fitting.fit import Fit
from meshmatch.generators.bodies import human_source
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.training.losses import distance
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import build_dataset, build_loss_points

TIMES = (0.25, 0.5, 0.75)
_PEOPLE = 64
DEVIATIONS = ("volume", "arap", "template_volume", "template_arap")


def measure(bench: BenchSet, model: str, ways: list[Way], limit: int, seed: int) -> list[dict[str, Any]]:
    """For each way mean deviations between the ends of ``limit`` pairs, also at each time; mean residual of the ends."""
    loaded, method = as_model(model), OurMethod(model, "none", seed)
    fits: dict[str, Fit] = {}
    shapes = {}
    found: dict[Way, list[list[list[float]]]] = {way: [] for way in ways}
    pairs = runner.spread(bench.pairs, limit)
    for pair in runner.track(pairs, model):
        for name in pair:
            if name not in fits:
                shapes[name] = validated(bench.shape(name)).shape
                fits[name] = method.fit(shapes[name])
        for way in ways:
            blend = Blend(loaded, [fits[n] for n in pair], None, [shapes[n] for n in pair], way)
            deviations = [blend.deviation(time, blend.vectors(time)) for time in TIMES]
            found[way].append([[getattr(each, name) for name in DEVIATIONS] for each in deviations])
    rows = []
    for way in ways:
        means = np.mean(found[way], axis=0)  # times, deviations
        rows.append(
            {
                **{"model": model, "way": way, "pairs": f"{len(pairs)} of {len(bench.pairs)}"},
                **dict(zip(DEVIATIONS, means.mean(0).tolist(), strict=True)),
                "residual": float(np.mean([fit.residual for fit in fits.values()])),
                "at": {
                    str(time): dict(zip(DEVIATIONS, row, strict=True))
                    for time, row in zip(TIMES, means.tolist(), strict=True)
                },
            }
        )
    return rows


@torch.inference_mode()
def decoded(model: str, bodies: int, seed: int) -> dict[str, float]:
    """Energies of a decoder's answers to codes of unseen bodies and between two, errors and leftovers in cm.

    Raises
    ------
    OptionError
        The model's template is not made from the body model.
    """
    loaded = as_model(model)
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
        F = torch.cat([points.field.deformation_gradient(each) for each in answers])
        energies[f"{name}_volume"] = float(volume_energy(F).mean())
        energies[f"{name}_arap"] = float(arap_energy(F).mean())
    return energies | {
        "leftover_cm": CM_PER_UNIT * float(distance(points.moved(fits), points.moved(ends))),
        "code_error_cm": CM_PER_UNIT * float(distance(points.moved(ends), batch.targets)),
        "corrected_error_cm": CM_PER_UNIT * float(distance(points.moved(fits), batch.targets)),
    }


@runner.command
def main(
    models: Annotated[str, Option(help="names or folders, with commas")] = "human",
    ways: Annotated[str, Option(help=f"of {', '.join(WAYS)}")] = "codes",
    set: Annotated[str, Option(help="of the benchmark")] = "scape",
    limit_pairs: Annotated[int, Option(min=1)] = 30,
    bodies: Annotated[int, Option(min=0, help="generated, 2 or more")] = 0,
    data: runner.Data = runner.DATA,
    seed: runner.Seed = 0,
) -> runner.Report:
    if bodies == 1:
        raise BadParameter("between fewer than two bodies there is nothing")
    asked: list[Way] = runner.names_of(ways, WAYS, "way to blend")  # type: ignore[assignment]
    bench, named = load_set(set, data), models.split(",")
    rows = [row for model in named for row in measure(bench, model, asked, limit_pairs, seed)]
    short = [row | {"model": Path(row["model"]).name} for row in rows]
    columns = {"model": "model", "blended": "way", "pairs": "pairs"}
    columns |= {name.replace("_", " "): f"{name}:.4f" for name in (*DEVIATIONS, "residual")}
    tables = [runner.table(f"Between two shapes, {bench.name}", short, columns)]
    alone = [{"model": model, **decoded(model, bodies, seed)} for model in named] if bodies else []
    if alone:
        columns = {"model": "model"} | {name.replace("_", " "): f"{name}:.4f" for name in list(alone[0])[1:]}
        tables.append(runner.table(f"The decoder alone, {bodies} bodies", alone, columns))
    return runner.Report({"times": TIMES, "models": rows, "decoded": alone}, tables)


if __name__ == "__main__":
    sys.exit(main())
