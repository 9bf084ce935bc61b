"""The paper's table 4: ``python -m meshmatch.experiments.representations --output FOLDER``.

Three representations of a deformation (moving least squares, radial basis functions, a network at every point), each
trained without constraints, with volume and rigidity, and with these also between codes (Z).

- *Milliseconds of an iteration*: all cells side by side in one process, taking turns; medians.
- *Memory*: how far each cell's iterations, in a process of their own, make the resident set grow.
- *Error*, with ``--minutes``: every cell is trained for that long on a clock, and fitted to the benchmark's sets after
  ``--code-steps`` of the paper's refinement (the one that all three have). The budget is time, not steps: what is slow
  learns less.

Each cell is a file in the output folder; what is there is not measured again, so that a run that was stopped goes on
with the next cell. Times belong together and are all measured anew if one is missing. The table says the budget. The
paper's milliseconds are of an A100.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from meshmatch.errors import MeshmatchError, OptionError
from meshmatch.experiments.bench import chosen_pairs, run_set
from meshmatch.experiments.cell_files import claim, keep, read_cell
from meshmatch.experiments.distances import default_folder
from meshmatch.experiments.iterations import CONSTRAINTS, Cell, Setting, memory, timed
from meshmatch.experiments.protocols import BenchSet, load_set
from meshmatch.experiments.report import circumstances, explain, wide_console
from meshmatch.fields.choice import FIELDS
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fit_shape import fit_shape as lay_template
from meshmatch.fitting.latent import LatentRefineConfig
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.registry import CARD, read_card
from meshmatch.pipeline import map_between, read_model, usable
from meshmatch.shapes.shape import Shape
from meshmatch.training.run import train_model

PAPER_MS = {
    "pointwise": {"none": 32.0, "vol+arap": 250.4, "vol+arap+Z": 4098.3},
    "rbf": {"none": 8.0, "vol+arap": 8.2, "vol+arap+Z": 12.6},
    "mls": {"none": 7.8, "vol+arap": 8.0, "vol+arap+Z": 12.1},
}
"""Milliseconds of an iteration in the paper's table 4."""


@dataclass(frozen=True)
class CodeMatcher:
    """The pipeline with so many steps of the refinement of codes; none for 0."""

    model: str
    steps: int
    seed: int = 0

    def fit(self, shape: Shape) -> Fit:
        """Lay the model's template on a shape."""
        latent = LatentRefineConfig(steps=max(self.steps, 1))
        config = FitConfig(refine="latent" if self.steps else "none", seed=self.seed, latent=latent)
        return lay_template(read_model(self.model), usable(shape).shape, config)

    def map(self, source: Shape, source_fit: Fit, target: Shape, target_fit: Fit) -> VertexMap:
        """Join two fits."""
        return map_between(source, source_fit, target, target_fit)


@dataclass(frozen=True)
class Budget:
    """What a cell's error costs: minutes of training (0: none), steps on the code, sets and pairs of each (None: all)."""

    minutes: float = 0.0
    code_steps: int = 200
    sets: tuple[str, ...] = ()
    limit_pairs: int | None = None


def error_of(
    cell: Cell, setting: Setting, budget: Budget, benches: Sequence[BenchSet], folder: Path, cache: Path
) -> dict[str, Any]:
    """Train a cell for its minutes and measure it: held-out error of the network, error on each set in cm."""
    chosen = setting.recipe(cell)
    chosen = replace(chosen, train=replace(chosen.train, minutes=budget.minutes))
    template, source = setting.material()
    place = folder / "models" / cell.name
    name = cell.name.lower()
    # From the beginning, always: a training that was stopped would else get more than its minutes.
    train_model(template, source, place, recipe=chosen, name=name, data="as its cell", resume=False)
    card = read_card(place / CARD)
    matcher = CodeMatcher(str(place), budget.code_steps, setting.seed)
    sets = {}
    for bench in benches:
        pairs = chosen_pairs(bench, budget.limit_pairs)
        found = run_set(bench, matcher, pairs=pairs, cache=cache, threads=setting.threads)
        sets[bench.name] = {
            "mean_cm": found.scores.joined.mean_cm,
            "pairs": len(pairs),
            "of": len(bench.pairs),
            "failed": len(found.failed),
        }
    held_out = card.metrics["validation"]["distance"]
    return {"steps": card.steps, "validation": held_out, "sets": sets, "budget": asdict(budget)}


def run(
    cells: Sequence[Cell],
    setting: Setting,
    budget: Budget,
    folder: Path,
    *,
    rounds: int = 7,
    data: Path = Path("../shared/bench"),
    cache: Path | None = None,
) -> dict[str, Any]:
    """Measure what is missing, print the table and a JSON line; the line's record is returned too."""
    benches = [load_set(name, data) for name in budget.sets]
    claim(folder, setting)
    spent = json.loads(json.dumps(asdict(budget)))
    known = [read_cell(folder, cell).get("error") for cell in cells]
    if budget.minutes and any(error["budget"] != spent for error in known if error):
        raise OptionError(f"{folder} holds errors of another budget", "choose another --output")
    console = Console(stderr=True)
    with console.status("building networks") as status:
        if any("time" not in read_cell(folder, cell) for cell in cells):
            found = timed(
                setting, cells, rounds, lambda done: status.update(f"timing: round {done} of {rounds}")
            )
            for cell in cells:
                keep(folder, cell, time=found[cell.name], measured=circumstances(setting.threads, 1))
        for number, cell in enumerate(cells):
            if "memory" not in read_cell(folder, cell):
                status.update(f"memory: {cell.name}, {number + 1} of {len(cells)}")
                keep(folder, cell, memory=memory(setting, cell))
        for number, cell in enumerate(cells):
            if budget.minutes and "error" not in read_cell(folder, cell):
                status.update(f"training {cell.name}, {number + 1} of {len(cells)}: {budget.minutes:g} min")
                keep(
                    folder,
                    cell,
                    error=error_of(cell, setting, budget, benches, folder, cache or default_folder()),
                )
    records = {cell.name: read_cell(folder, cell) for cell in cells}
    wide_console().print(drawn(cells, records, setting, budget))
    whole = {
        "benchmark": "representations",
        **circumstances(setting.threads, 1),
        "setting": asdict(setting),
        "budget": asdict(budget),
        "times_as_slow": ratios({name: record["time"]["ms"] for name, record in records.items()}),
        "paper_times_as_slow": round(PAPER_MS["pointwise"]["vol+arap+Z"] / PAPER_MS["mls"]["vol+arap+Z"], 1),
        "cells": records,
    }
    print(json.dumps(whole), flush=True)
    return whole


def ratios(ms: dict[str, float]) -> dict[str, float]:
    """How many times as slow as moving least squares with the same constraints each cell is, where both are there."""
    slow = {}
    for constraint in CONSTRAINTS:
        reference = ms.get(Cell("mls", constraint).name)
        for field in FIELDS:
            name = Cell(field, constraint).name
            if reference and name in ms:
                slow[name] = round(ms[name] / reference, 2)
    return slow


def drawn(
    cells: Sequence[Cell], records: dict[str, dict[str, Any]], setting: Setting, budget: Budget
) -> Table:
    """The table."""
    chosen = setting.recipe(cells[0]).train
    shapes = f"{chosen.shapes} shapes a batch, {setting.threads} thread" + "s" * (setting.threads > 1)
    words = f"Representations: preset {setting.preset}, {shapes}"
    if budget.minutes:
        words += f"; errors after {budget.minutes:g} min of training, {budget.code_steps} steps on the code"
    table = Table(title=words, title_justify="left")
    for name in ("constraint", "field"):
        table.add_column(name)
    columns = ["ms", "times mls", "paper's ms", "paper's times", "MB"]
    if budget.minutes:
        columns += ["steps", "held out, % of sqrt(area)", *(f"{name}, cm" for name in budget.sets)]
    for name in columns:
        table.add_column(name, justify="right")
    slow = ratios({name: record["time"]["ms"] for name, record in records.items()})
    for cell in sorted(cells, key=lambda cell: CONSTRAINTS.index(cell.constraint)):
        record, paper = records[cell.name], PAPER_MS[cell.field][cell.constraint]
        times = paper / PAPER_MS["mls"][cell.constraint]
        here = f"{slow[cell.name]:.1f}" if cell.name in slow else ""
        row = [f"{record['time']['ms']:.1f}", here, f"{paper:.1f}", f"{times:.1f}"]
        row.append(f"{record['memory']['megabytes']:.0f}")
        if budget.minutes:
            error = record["error"]
            row += [str(error["steps"]), f"{100 * error['validation']:.2f}"]
            row += [f"{error['sets'][name]['mean_cm']:.2f}" for name in budget.sets]
        table.add_row(cell.constraint, cell.field, *row)
    return table


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.representations", description=__doc__)
    add = parser.add_argument
    add("--output", type=Path, required=True, metavar="FOLDER", help="of the cells' files")
    add("--fields", default=",".join(FIELDS), help="of %(default)s")
    add("--constraints", default=",".join(CONSTRAINTS), help="of %(default)s")
    add("--rounds", type=int, default=7, help="iterations of each cell under the clock")
    add("--minutes", type=float, default=0.0, help="of training for a cell's error; 0 measures none")
    add("--sets", default="shrec19,scape-pcn", help="on which errors are measured; may be empty")
    add("--limit-pairs", type=int, metavar="N", help="N pairs of each set, evenly spread")
    add("--code-steps", type=int, default=200, help="of the refinement before errors")
    add("--preset", default="paper", choices=("paper", "default"))
    add("--template", default="human-T", help="of generated bodies")
    add("--shapes", metavar="FOLDER", help="a prepared folder to train on instead of generated bodies")
    add("--identities", type=int, default=4096, help="of generated bodies")
    add("--batch", type=int, help="shapes in a batch")
    add("--width", type=int, help="of the network's layers")
    add("--code", type=int, help="numbers in a code")
    add("--threads", type=int, default=1)
    add("--seed", type=int, default=0)
    add("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    add("--cache", type=Path, help="folder of kept geodesic distances")
    chosen = parser.parse_args(words)
    if (
        min(chosen.rounds, chosen.threads, chosen.batch or 1) < 1
        or chosen.minutes < 0
        or chosen.code_steps < 0
    ):
        parser.error("counts must be 1 or more, minutes and steps 0 or more")
    fields, constraints = chosen.fields.split(","), chosen.constraints.split(",")
    if not set(fields) <= set(FIELDS) or not set(constraints) <= set(CONSTRAINTS):
        parser.error(f"fields are {', '.join(FIELDS)}; constraints {', '.join(CONSTRAINTS)}")
    cells = [Cell(field, constraint) for constraint in constraints for field in fields]
    setting = Setting(
        preset=chosen.preset,
        template=chosen.template,
        shapes=chosen.shapes,
        identities=chosen.identities,
        batch=chosen.batch,
        code=chosen.code,
        width=chosen.width,
        threads=chosen.threads,
        seed=chosen.seed,
    )
    sets = tuple(name for name in chosen.sets.split(",") if name) if chosen.minutes else ()
    budget = Budget(chosen.minutes, chosen.code_steps, sets, chosen.limit_pairs)
    try:
        run(
            cells,
            setting,
            budget,
            chosen.output,
            rounds=chosen.rounds,
            data=chosen.data,
            cache=chosen.cache,
        )
    except MeshmatchError as error:
        explain(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
