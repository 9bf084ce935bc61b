"""What the weights of the paper's table 3, which are meant for interpolation, do to blends of codes.

Small networks (`ablation_training`) are trained from the beginning without regularisers, with the weights of table 1 and
with those of table 3. They encode bodies of people that nobody learned from. Halfway between the codes of every two
neighbours in a batch, and at the codes themselves, the deformation gradient F is asked for its energies, without weights:
(det F - 1)^2 for volume, |F^T F - I| for rigidity; mean over the template. A body has energies of its own, for it is not the
template: the path is better than its ends where the energies halfway are lower. Held out is the mean distance of the
template's points from where they belong, in cm at 1.9 m2 of skin.
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
from meshmatch.experiments.paper.ablation_training import STRAINED, Setting, pool_of, train_run
from meshmatch.experiments.paper.ablation_views import BASE, TABLE3, Run
from meshmatch.fields.field import arap_energy, volume_energy
from meshmatch.training.train import build_loss_points

WEIGHTS = {"none": "none", "table 1 without blends": "vol+arap", "table 1": "vol+arap+Z", "table 3": TABLE3}
_COLUMNS = {"weights": "weights", "steps": "steps:d", "held out": "held_out_cm:>"}
_COLUMNS |= {f"{name}, {where}": f"{name}_{key}:>" for name in ("volume", "rigidity") for key, where in (
    ("ends", "at codes"), ("halfway", "halfway"))}  # fmt: skip


@torch.no_grad()
def energies(model: Any, run: Run, setting: Setting) -> dict[str, float]:
    """Mean energies at the codes of held-out bodies and halfway between those of neighbours."""
    network = model.network.eval()
    points = build_loss_points(model.template, setting.recipe(run).kernel, network, gradients=STRAINED)
    code = network.encoder(pool_of(setting, run.pose).held_out.encode_features)
    found: dict[str, float] = {}
    for where, at in (("ends", code), ("halfway", 0.5 * (code + code.roll(1, 0)))):
        F = points.field.deformation_gradient(network.decoder(at))
        found |= {f"volume_{where}": float(volume_energy(F).mean()), f"rigidity_{where}": float(arap_energy(F).mean())}
    return found


def row_of(words: str, runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over seeds, and how far apart they are."""
    row: dict[str, Any] = {"weights": words, "steps": runs[0]["steps"]}
    for name in runs[0]:
        if name.startswith(("held", "volume", "rigidity")):
            values = [each[name] for each in runs]
            spread = f" ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else ""
            row[name] = f"{np.mean(values):.3g}{spread}"
    return row


@runner.command
def main(
    steps: Annotated[int, Option(min=1, help="of every training")] = 10_000,
    seeds: Annotated[int, Option(min=1, help="trainings with the same weights")] = 3,
    work: runner.Work = None,
    threads: runner.Threads = 1,
) -> runner.Report:
    setting, rows = Setting(threads), []
    every: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        place = work or Path(temporary)
        for words, constraint in WEIGHTS.items():
            every[words] = []
            for seed in range(seeds):
                run = replace(BASE, constraint=constraint, seed=seed)

                def measure(run: Run = run) -> dict[str, Any]:
                    runner.tell(f"training {run.name}: {steps} steps")
                    trained = train_run(run, setting, place / run.name / "model", steps)
                    return {**trained, **energies(as_model(place / run.name / "model"), run, setting)}

                asked = {"run": asdict(run), "setting": asdict(setting), "steps": steps}
                every[words].append(runner.once(place / run.name / "measured.json", asked, measure))
            rows.append(row_of(words, every[words]))
    return runner.Report({"rows": every}, [runner.table("Energies of blended codes", rows, _COLUMNS)])
