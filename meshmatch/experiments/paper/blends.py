"""Effect on blends of codes of the weights in the paper's table 3, which are for interpolation.

Small networks (`ablation_training`) are trained from scratch without regularisers, with the weights of table 1 and with
those of table 3. They encode held-out bodies. At the codes, and halfway between those of neighbours in a batch, the
unweighted energies of the deformation gradient F are computed: (det F - 1)^2 for volume, |F^T F - I| for rigidity, as means
over the template. Bodies themselves have positive energies, as they differ from the template: a blend is better than its
ends if its energies are lower. Held out is the mean distance of the template's points from their correct places, in cm at
1.9 m2 of skin.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.experiments import runner
from meshmatch.experiments.paper.ablation_training import N_GRADIENT_POINTS, Setting, pool_of, train_run
from meshmatch.experiments.paper.ablation_views import BASE, TABLE3, Run
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.training.train import build_loss_points

WEIGHTS = {"none": "none", "table 1 without blends": "vol+arap", "table 1": "vol+arap+Z", "table 3": TABLE3}
_COLUMNS = {"weights": "weights", "steps": "steps:d", "held out": "held_out_cm:>"}
_COLUMNS |= {f"{name}, {where}": f"{name}_{key}:>" for name in ("volume", "rigidity") for key, where in (
    ("ends", "at codes"), ("halfway", "halfway"))}  # fmt: skip


@torch.no_grad()
def energies(model: Any, run: Run, setting: Setting) -> dict[str, float]:
    """Mean energies at the codes of held-out bodies, and halfway between those of neighbours in the batch."""
    network = model.network.eval()
    points = build_loss_points(model.template, setting.recipe(run).kernel, network, gradients=N_GRADIENT_POINTS)
    code = network.encoder(pool_of(setting, run.pose).held_out.encode_features)
    means: dict[str, float] = {}
    for where, codes in (("ends", code), ("halfway", 0.5 * (code + code.roll(1, 0)))):
        F = points.field.deformation_gradient(network.decoder(codes))
        means |= {f"volume_{where}": float(volume_energy(F).mean()), f"rigidity_{where}": float(arap_energy(F).mean())}
    return means


def row_of(label: str, runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Row of the table: means over seeds, with standard deviations."""
    row: dict[str, Any] = {"weights": label, "steps": runs[0]["steps"]}
    for name in runs[0]:
        if name.startswith(("held", "volume", "rigidity")):
            values = [each[name] for each in runs]
            spread = f" ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else ""
            row[name] = f"{np.mean(values):.3g}{spread}"
    return row


@runner.command
def main(
    steps: Annotated[int, Option(min=1, help="steps of every training")] = 10_000,
    seeds: Annotated[int, Option(min=1, help="number of trainings with the same weights")] = 3,
    work: runner.Work = None,
    threads: runner.Threads = 1,
) -> runner.Report:
    setting, rows = Setting(threads), []
    results: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = work or Path(temporary)
        for label, constraint in WEIGHTS.items():
            results[label] = []
            for seed in range(seeds):
                run = replace(BASE, constraint=constraint, seed=seed)

                def measure(run: Run = run) -> dict[str, Any]:
                    runner.log(f"training {run.name}: {steps} steps")
                    trained = train_run(run, setting, folder / run.name / "model", steps)
                    return {**trained, **energies(as_model(folder / run.name / "model"), run, setting)}

                asked = {"run": asdict(run), "setting": asdict(setting), "steps": steps}
                results[label].append(runner.cached(folder / run.name / "measured.json", asked, measure))
            rows.append(row_of(label, results[label]))
    return runner.Report({"rows": results}, [runner.table("Energies of blended codes", rows, _COLUMNS)])
