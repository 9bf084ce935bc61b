"""The paper's ablations: ``python -m meshmatch.experiments.ablations --output FOLDER --minutes 2``.

Tables 4 (representations and constraints: errors and cost), 5 (regularisers), 6 (nodes and radius, kernel), 7 (how nodes
are chosen); figures 6 (refinement), 8 (template pose), 9 (training shapes), 10 (supervised points). All are views of one
set of cells. Each cell is trained once, from the beginning, and measured on shapes that it has not seen and on pairs of
the benchmark's sets. Representations and constraints, which cost differently, have the same minutes (of the processor;
with a GPU on the clock); all other cells take as many steps as the base does in them.

What is measured lies in the output folder and is not measured again, so that a run that was stopped goes on with what is
missing; ``--show`` measures nothing and shows what is there. The tables say the budget. Errors are in cm at 1.9 m2 of
skin: *held out*, the mean distance of the template's points from where they belong, by the network alone; on a set, the
geodesic error after the search over codes with the cell's own regularisers, on all ordered pairs of some shapes. The
paper's numbers beside them are of long trainings on an A100 and of its own pairs.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from meshmatch.experiments.ablation_cells import Known
from meshmatch.experiments.ablation_figures import draw_views
from meshmatch.experiments.ablation_run import Run, by_time
from meshmatch.experiments.ablation_tables import TABLES
from meshmatch.experiments.cells import BASE, PRESETS
from meshmatch.experiments.orderings import Claim, claims
from meshmatch.experiments.protocols import CLOUD_SET
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.outputs import replace_on_success


def run(options: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Measure what is missing, print tables and orderings, draw figures, and a JSON line; its record is returned too."""
    here = Run(options, console)
    if options.minutes and not options.show:
        for cell in here.now():
            here.measure_errors(cell, here.train(cell))
    known = here.known()
    words = budget(here, known)
    out = wide_console()
    shown = [view for view in here.views if view in TABLES]
    tables = [table for view in shown for table in TABLES[view](known, here.sets, words)]
    for table in tables:
        out.print(table)
    found = claims(known, here.sets)
    told = [said(claim) for claim in found]
    for sentence in [*told, f"Budget: {words}"]:
        out.print(sentence, soft_wrap=True)
    if options.markdown is not None:
        with replace_on_success(options.markdown) as temporary:
            temporary.write_text(as_markdown(tables, found), encoding="utf-8")
    missing = [cell.name for cell in here.cells if cell not in known.trained]
    if missing and options.minutes:
        out.print(f"Not measured: {', '.join(missing)}", soft_wrap=True)
    drawn = draw_views(known, here.views, here.sets, options.pictures or options.output)
    for path in drawn:
        console.print(f"wrote {path}", highlight=False)
    record = {
        "benchmark": "ablations",
        **circumstances(options.threads, 1),
        "setting": asdict(here.setting),
        "measure": asdict(here.measure),
        "minutes": options.minutes,
        "cells": {cell.name: record for cell, record in known.trained.items()},
        "errors": {
            f"{cell.name} {name} {how}": r["mean_cm"] for (cell, name, how), r in known.errors.items()
        },
        "times": known.times,
        "memory": known.memory,
        "claims": [asdict(claim) for claim in found],
        "figure6": known.descent,
    }
    print(json.dumps(record), flush=True)
    return record


def as_markdown(tables: Sequence[Table], found: Sequence[Claim]) -> str:
    """The tables, each under its title, and the claims as two more: lines for docs/results.md."""
    grids = {
        str(table.title): [[str(c.header), *map(str, c.cells)] for c in table.columns] for table in tables
    }
    places = list(dict.fromkeys(claim.where for claim in found if claim.where))
    by_words: dict[str, dict[str, str]] = {}
    for claim in found:
        by_words.setdefault(claim.words, {})[claim.where] = _verdict(claim)
    costs = {words: held[""] for words, held in by_words.items() if "" in held}
    grids["What constraints cost"] = [["claim", *costs], ["here", *costs.values()]]
    errors = {words: held for words, held in by_words.items() if "" not in held}
    columns = [[place, *(held.get(place, "") for held in errors.values())] for place in places]
    grids["Orderings of errors"] = [["claim", *errors], *columns]
    lines = []
    for title, grid in grids.items():
        rows = [f"| {' | '.join(row)} |" for row in zip(*grid, strict=True)]
        lines += [title, "", rows[0], "|---" * len(grid) + "|", *rows[1:], ""]
    return "\n".join(lines)


def said(claim: Claim) -> str:
    """A line about a claim."""
    where = f"{claim.where}: " if claim.where else ""
    return f"{where}{claim.words}: {_verdict(claim)}"


def _verdict(claim: Claim) -> str:
    if claim.holds is None:
        return "not measured"
    numbers = ", ".join(f"{value:.2f}" for value in claim.numbers)
    return f"{'holds' if claim.holds else 'DOES NOT HOLD'} ({numbers})"


def budget(here: Run, known: Known) -> str:
    """What the numbers cost, in words."""
    clocks = {record["clock"] for record in known.trained.values() if "clock" in record}
    clock = "CPU " if clocks == {"processor"} else ""
    words = [f"{here.options.minutes:g} {clock}min of training a cell"]
    steps = known.trained.get(BASE, {}).get("steps")
    if steps and not all(by_time(cell) for cell in known.trained):
        words[0] += f" or the base's {steps} steps"
    words.append(f"preset {here.setting.preset}")
    words += [
        f"{here.measure.code_steps} steps on the code",
        f"the pairs of {here.measure.shapes} shapes of a set",
    ]
    words.append(f"{here.setting.threads} thread" + "s" * (here.setting.threads > 1))
    return ", ".join(words)


def options_of(words: Sequence[str] | None) -> argparse.Namespace:
    """What was asked for."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.ablations", description=__doc__)
    add = parser.add_argument
    add("--output", type=Path, required=True, metavar="FOLDER", help="of what is measured")
    add("--tables", default="4,5,6,7", help="of %(default)s; may be empty")
    add("--figures", default="6,8,9,10", help="of %(default)s; may be empty")
    add(
        "--minutes",
        type=float,
        default=2.0,
        help="of training a cell; 0 trains none, table 4 then has its cost alone",
    )
    add("--seeds", type=int, default=1, help="trainings of each cell of the views that are repeated")
    add(
        "--repeated",
        default="table4",
        metavar="VIEWS",
        help="which these are, such as table4,figure9: %(default)s; may be empty",
    )
    add(
        "--cells",
        default="",
        metavar="NAMES",
        help="measure these alone, and show what is there of the others",
    )
    add("--rounds", type=int, default=5, help="iterations of table 4's cells under the clock; 0 for none")
    add("--sets", default=f"shrec19,{CLOUD_SET}", help="on which errors are measured; may be empty")
    add(
        "--shapes",
        type=int,
        default=6,
        metavar="N",
        help="of each set, whose pairs are measured: %(default)s",
    )
    add("--code-steps", type=int, default=100, help="of the search over codes: %(default)s")
    add("--preset", default="small", choices=PRESETS, help="of the training: %(default)s")
    add("--folder", metavar="FOLDER", help="prepared shapes to learn from, in place of generated bodies")
    add("--identities", type=int, default=1024, help="of generated bodies: %(default)s")
    add("--batch", type=int, help="shapes in a batch, in place of the preset's")
    add("--code", type=int, help="numbers in a code, in place of the preset's")
    add("--width", type=int, help="of the network's layers, in place of the preset's")
    add("--threads", type=int, default=1)
    add("--model", default="human", help="which says the orientation of a set's shapes: %(default)s")
    add("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    add("--cache", type=Path, help="folder of kept geodesic distances")
    add("--markdown", type=Path, metavar="FILE", help="the tables and orderings again, for docs/results.md")
    add("--pictures", type=Path, metavar="FOLDER", help="of the figures; by default the output folder")
    add("--show", action="store_true", help="measure nothing, show what is there")
    options = parser.parse_args(words)
    if min(options.minutes, options.rounds) < 0 or min(options.seeds, options.threads) < 1:
        parser.error("minutes and rounds of 0 or more and seeds and threads of 1 or more are needed")
    if options.code_steps < 1 or options.shapes < 2:
        parser.error("at least one step on the code and two shapes are needed")
    return options


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    options = options_of(words)
    return status_of(lambda: run(options, Console(stderr=True)))


if __name__ == "__main__":
    sys.exit(main())
