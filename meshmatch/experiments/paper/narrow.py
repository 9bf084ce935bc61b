"""Matching errors of the paper's own network, made narrower and trained for longer.

It is trained on a fixed pool of scanned bodies, without rotations about the vertical axis, with which it hardly learns
(`stalling`). Shapes have area 1, as orientation and size are given in the evaluation: those of the fit of one model
(--model). All other settings are the preset's: dropout, batch norms, loss, weights, batch and rate. Errors are in cm at
1.9 m2 of skin: held out, of bodies that were not used in training; on sets, before and after the paper's search over codes,
on all ordered pairs of some shapes.

The model and the results are kept in the folder of --work: an interrupted command continues with what is missing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.experiments import runner
from meshmatch.experiments.bench.sets import CLOUD_SET, load_set
from meshmatch.experiments.paper.ablation_errors import Measure, build_subject, chosen_names, errors_of, find_core_frame
from meshmatch.experiments.paper.ablation_views import BASE
from meshmatch.experiments.paper.stalling import Change, encoder_of, predict_held_out, scans_of, train_network
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.registry import load_model
from meshmatch.outputs import make_folder
from meshmatch.templates.template import Template, read_template
from meshmatch.threads import set_threads
from meshmatch.training.facts import CardFacts
from meshmatch.training.train import export

CHANGE = Change(yaw=False)
SETS, METHODS = ("shrec19", CLOUD_SET), {"none": "the network alone", "code": "search over codes"}
_N_CHECKS = 20  # number of evaluations during training
_COLUMNS = {"set": "set", "refined by": "refined", "mean cm": "mean_cm:.2f", "median cm": "median_cm:.2f"}
_COLUMNS |= {"over 15 cm": "share_over_15cm:.1%"}


def trained(folder: Path, template: Template, narrow: int, steps: int, bodies: int, seed: int) -> dict[str, Any]:
    """Train, write a model folder, and return a summary."""
    scans = scans_of(template, bodies, sphere=False)
    learned = train_network(CHANGE, template, scans, narrow, steps, seed, max(steps // _N_CHECKS, 1))
    predicted, truth = predict_held_out(learned.trainer.model, learned.points, scans, CHANGE)
    held_out = float((predicted - truth).norm(dim=-1).mean())
    make_folder(folder)
    facts = CardFacts("narrow", "human", f"{bodies} bodies, scanned once", licence="")
    export(learned.trainer, template, folder, learned.recipe, facts, held_out)
    return {
        **{"steps": steps, "held_out": CM_PER_UNIT * held_out, "curve": learned.curve},
        **{"at_work": sum(learned.at_work) / len(learned.at_work), "cpu_ms": 1e3 * learned.seconds / steps},
    }


@runner.command
def main(
    steps: Annotated[int, Option(min=20, help="training steps")] = 10_000,
    narrow: Annotated[int, Option(min=1, max=16, help="factor by which the network is narrower than the paper's")] = 4,
    bodies: Annotated[int, Option(min=1, help="number of training bodies")] = 1000,
    shapes: Annotated[int, Option(min=2, help="shapes of each set, of which all pairs are measured")] = 18,
    model: runner.Model = "human",
    data: runner.Data = runner.DATA,
    cache: runner.Cache = None,
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    set_threads(threads)
    template, run, measure, rows = read_template("human-T-300"), BASE, Measure(shapes=shapes), []
    with tempfile.TemporaryDirectory() as temporary:
        work_folder = work or Path(temporary)
        folder, asked = work_folder / "model", {"narrow": narrow, "steps": steps, "bodies": bodies, "seed": seed}
        summary = runner.cached_in(
            work_folder, "trained", asked, lambda: trained(folder, template, narrow, steps, bodies, seed)
        )
        trained_model = load_model(folder, encoder=encoder_of(CHANGE, 1024 // narrow))
        for name in SETS:
            bench = load_set(name, data)
            subjects = [
                build_subject(bench, each, find_core_frame(bench.seen(each), model, measure), measure, cache)
                for each in chosen_names(bench, measure)
            ]
            for how, refined in METHODS.items():
                runner.log(f"{name}: {refined}")
                rows.append(
                    {"set": name, "refined": refined, **errors_of(trained_model, run, subjects, model, how, measure)}
                )
    title = f"The paper's network, {narrow} times narrower, after {steps} steps"
    notes = [
        f"{summary['held_out']:.2f} cm held out, {summary['at_work']:.2f} at work, {summary['cpu_ms']:.0f} CPU ms a step"
    ]
    return runner.Report({"rows": rows, "trained": summary}, [runner.table(title, rows, _COLUMNS)], notes)
