"""The paper's own network, so many times narrower, trained for longer, and how well it matches.

It learns from bodies that are drawn and scanned once, without turns about the vertical, from which it hardly learns
(`stalling`), and of area 1, as the orientation and size of a shape are given when errors are measured: both are that of the
fit of one model (--model). Everything else of a training is the preset's: dropout, batch norms, loss, weights, batch and
rate. Errors in cm at 1.9 m2 of skin: held out, of bodies that it has not seen; on sets, of the network alone and after the
paper's search over codes, on all ordered pairs of some shapes.

The model lies in the folder of --work, and what was measured: a stopped command goes on with what is missing.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.experiments import runner
from meshmatch.experiments.bench.sets import CLOUD_SET, load_set
from meshmatch.experiments.paper.ablation_errors import Measure, chosen_names, errors_of, oriented, subject
from meshmatch.experiments.paper.ablation_views import BASE
from meshmatch.experiments.paper.stalling import Change, encoder_of, learn, scans_of, unseen
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.registry import load_model
from meshmatch.outputs import make_folder
from meshmatch.templates.template import Template, read_template
from meshmatch.threads import set_threads
from meshmatch.training.facts import CardFacts
from meshmatch.training.train import export

CHANGE = Change(yaw=False)
SETS, METHODS = ("shrec19", CLOUD_SET), {"none": "the network alone", "code": "search over codes"}
_ASKED = 20  # times on the way
_COLUMNS = {"set": "set", "refined by": "refined", "mean cm": "mean_cm:.2f", "median cm": "median_cm:.2f"}
_COLUMNS |= {"over 15 cm": "share_over_15cm:.1%"}


def trained(folder: Path, template: Template, narrow: int, steps: int, bodies: int, seed: int) -> dict[str, Any]:
    """Train, write a model folder, and say how it went."""
    scans = scans_of(template, bodies, sphere=False)
    learned = learn(CHANGE, template, scans, narrow, steps, seed, max(steps // _ASKED, 1))
    found, truth = unseen(learned.trainer.model, learned.points, scans, CHANGE)
    held_out = float((found - truth).norm(dim=-1).mean())
    make_folder(folder)
    facts = CardFacts("narrow", "human", f"{bodies} bodies, scanned once", licence="")
    export(learned.trainer, template, folder, learned.recipe, facts, held_out)
    return {
        **{"steps": steps, "held_out": CM_PER_UNIT * held_out, "curve": learned.curve},
        **{"at_work": sum(learned.at_work) / len(learned.at_work), "cpu_ms": 1e3 * learned.seconds / steps},
    }


@runner.command
def main(
    steps: Annotated[int, Option(min=20, help="of training")] = 10_000,
    narrow: Annotated[int, Option(min=1, max=16, help="by how much the network is narrower than the paper's")] = 4,
    bodies: Annotated[int, Option(min=1, help="that are learned from")] = 1000,
    shapes: Annotated[int, Option(min=2, help="of each set, whose pairs are measured")] = 18,
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
        place = work or Path(temporary)
        folder, asked = place / "model", {"narrow": narrow, "steps": steps, "bodies": bodies, "seed": seed}
        done = runner.at_work(place, "trained", asked, lambda: trained(folder, template, narrow, steps, bodies, seed))
        own = load_model(folder, encoder=encoder_of(CHANGE, 1024 // narrow))
        for name in SETS:
            bench = load_set(name, data)
            some = [
                subject(bench, each, oriented(bench.seen(each), model, measure), measure, cache)
                for each in chosen_names(bench, measure)
            ]
            for how, refined in METHODS.items():
                runner.tell(f"{name}: {refined}")
                rows.append({"set": name, "refined": refined, **errors_of(own, run, some, model, how, measure)})
    title = f"The paper's network, {narrow} times narrower, after {steps} steps"
    words = [f"{done['held_out']:.2f} cm held out, {done['at_work']:.2f} at work, {done['cpu_ms']:.0f} CPU ms a step"]
    return runner.Report({"rows": rows, "trained": done}, [runner.table(title, rows, _COLUMNS)], words)
