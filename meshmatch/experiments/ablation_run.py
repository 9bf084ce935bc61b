"""One output folder of the ablations: what is asked, what is there, and measuring what is missing."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from meshmatch.errors import OptionError, TemplateError
from meshmatch.experiments.ablation_cells import CODED, TABLE4, VIEWS, Known, all_cells, cells_of
from meshmatch.experiments.cell_errors import (
    METHODS,
    Measure,
    Subject,
    chosen_names,
    errors_of,
    oriented,
    subject,
)
from meshmatch.experiments.cell_files import keep, once, recall
from meshmatch.experiments.cell_training import is_trained, train_cell
from meshmatch.experiments.cells import BASE, Cell, Setting
from meshmatch.experiments.descent import LINES, descend
from meshmatch.experiments.distances import default_folder
from meshmatch.experiments.iterations import memory, timed
from meshmatch.experiments.protocols import BenchSet, load_set
from meshmatch.experiments.report import circumstances
from meshmatch.geometry.frames import Frame
from meshmatch.models.registry import find_model
from meshmatch.models.trained import TrainedModel
from meshmatch.pipeline import read_model

BODIES = 5
"""How many bodies figure 6 is measured on."""


class Run:
    """One output folder and what is asked of it; each method measures what is not there yet."""

    def __init__(self, options: argparse.Namespace, console: Console) -> None:
        self.options, self.console = options, console
        sizes = options.identities, options.batch, options.code, options.width
        self.setting = Setting(options.preset, options.folder, *sizes, options.threads)
        self.measure = Measure(shapes=options.shapes, code_steps=options.code_steps)
        self.folder: Path = options.output
        self.views = asked_views(options.tables, options.figures)
        repeated = [cell for view in known_views(options.repeated.split(",")) for cell in cells_of(view)]
        self.cells = all_cells(self.views, options.seeds, repeated)
        self.sets = [name for name in options.sets.split(",") if name]
        self.benches = [] if options.show else [load_set(name, options.data) for name in self.sets]
        self._subjects: dict[str, list[Subject]] = {}

    def now(self) -> list[Cell]:
        """The cells that this run is to measure.

        Raises
        ------
        OptionError
            A name that no cell of the views has.
        """
        names = [name for name in self.options.cells.split(",") if name]
        there = {cell.name: cell for cell in self.cells}
        for name in names:
            if name not in there:
                raise OptionError(f"these views have no cell {name!r}", f"they have {', '.join(there)}")
        return [there[name] for name in names] or self.cells

    def asked(self, cell: Cell, **more: Any) -> dict[str, Any]:
        """The question that a cell's file answers."""
        return {"cell": asdict(cell), "setting": asdict(self.setting), **more}

    def place(self, cell: Cell) -> Path:
        """The folder of a cell."""
        return self.folder / cell.name

    def train(self, cell: Cell) -> dict[str, Any]:
        """How its training went; {"skipped": why} where nodes cannot be laid."""
        path, model = self.place(cell) / "trained.json", self.place(cell) / "model"
        steps = 0 if by_time(cell) else int(self.train(BASE)["steps"])
        budget: dict[str, Any] = {"steps": steps} if steps else {"minutes": self.options.minutes}

        def measured() -> dict[str, Any]:
            words = ", ".join(f"{value:g} {name}" for name, value in budget.items())
            self.console.print(f"training {cell.name}: {words}", highlight=False)
            try:
                found = train_cell(cell, self.setting, model, **budget)
            except TemplateError as error:
                found = {"skipped": error.message}
            return {**self._here(), **found}

        return once(path, self.asked(cell, **budget), measured)

    def measure_errors(self, cell: Cell, trained: dict[str, Any]) -> None:
        """Errors on every set after every refinement that belongs to the cell."""
        if "skipped" in trained:
            return
        for bench in self.benches:
            missing = [how for how in methods_of(cell) if self.error(cell, bench.name, how, trained) is None]
            if not missing:
                continue
            if not is_trained(self.place(cell) / "model", trained):
                raise OptionError(
                    f"{self.place(cell)} has lost its model", "remove that folder to train the cell again"
                )
            self.console.print(f"measuring {cell.name} on {bench.name}", highlight=False)
            model, subjects = read_model(self.place(cell) / "model"), self.subjects(bench)
            found = errors_of(model, cell, subjects, self.options.model, missing, self.measure)
            for how, record in found.items():
                question = self._error_question(bench.name, how, trained)
                keep(self._error_path(cell, bench.name, how), question, {**self._here(), **record})

    def error(self, cell: Cell, where: str, how: str, trained: dict[str, Any]) -> dict[str, Any] | None:
        """What is known of a cell's error on a set after a refinement."""
        return recall(self._error_path(cell, where, how), self._error_question(where, how, trained))

    def _error_path(self, cell: Cell, where: str, how: str) -> Path:
        return self.place(cell) / f"error-{where}-{how}.json"

    def _error_question(self, where: str, how: str, trained: dict[str, Any]) -> dict[str, Any]:
        words = {"set": where, "method": how, "reference": self._reference()}
        return {"model": trained.get("model"), "measure": asdict(self.measure), **words}

    def subjects(self, bench: BenchSet) -> list[Subject]:
        """The shapes on which a set's errors are measured, in the orientation that the reference model finds."""
        if bench.name not in self._subjects:
            names, how = chosen_names(bench, self.measure), self.options.model
            asked = {"shapes": names, "seed": self.measure.seed, "reference": self._reference()}

            def measured() -> dict[str, Any]:
                self.console.print(f"orienting {len(names)} shapes of {bench.name}", highlight=False)
                frames = {name: oriented(bench.seen(name), how, self.measure) for name in names}
                return {"frames": {name: _words(frame) for name, frame in frames.items()}}

            frames = once(self.folder / f"frames-{bench.name}.json", asked, measured)["frames"]
            cache = self.options.cache or default_folder()
            self._subjects[bench.name] = [
                subject(bench, name, Frame(**frames[name]), self.measure, cache) for name in names
            ]
        return self._subjects[bench.name]

    def _reference(self) -> str:
        return find_model(self.options.model)[1].weights_sha256

    def cost(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Times and memory of the iterations of table 4's cells."""
        if "table4" not in self.views or not self.options.rounds:
            return {}, {}
        cells, rounds = cells_of("table4"), self.options.rounds

        def taking_turns() -> dict[str, Any]:
            self.console.print(f"timing {len(cells)} cells side by side", highlight=False)
            return {**self._here(), "cells": timed(self.setting, cells, rounds)}

        def alone(cell: Cell) -> dict[str, Any]:
            return {**self._here(), **memory(self.setting, cell)}

        asked = {"cells": [asdict(cell) for cell in cells], "setting": asdict(self.setting), "rounds": rounds}
        times = self._answer(self.folder / "times.json", asked, taking_turns)
        grown = {}
        for cell in cells:
            found = self._answer(self.place(cell) / "memory.json", self.asked(cell), partial(alone, cell))
            if found is not None:
                grown[cell.name] = found
        return {} if times is None else times["cells"], grown

    def _answer(
        self, path: Path, asked: dict[str, Any], measure: Callable[[], dict[str, Any]]
    ) -> dict[str, Any] | None:
        """What a file answers, measured if it must be and may be."""
        return recall(path, asked) if self.options.show else once(path, asked, measure)

    def descent(self, trained: dict[Cell, dict[str, Any]]) -> dict[str, Any] | None:
        """Figure 6, if it was asked for and its cells are there."""
        if "figure6" not in self.views or not {BASE, CODED} <= trained.keys():
            return None
        digests = [trained[cell].get("model") for cell in (BASE, CODED)]
        asked: dict[str, Any] = {"models": digests, "measure": asdict(self.measure), "bodies": BODIES}
        asked["steps"] = [line.steps for line in LINES]

        def measured() -> dict[str, Any]:
            self.console.print("measuring figure 6", highlight=False)
            models: dict[Cell, TrainedModel] = {
                cell: read_model(self.place(cell) / "model") for cell in (BASE, CODED)
            }
            return {**self._here(), "lines": descend(models, self.setting, self.measure, BODIES)}

        return self._answer(self.folder / "figure6.json", asked, measured)

    def known(self) -> Known:
        """What is there."""
        trained, errors, steps = {}, {}, 0
        for cell in self.cells:
            budget = {"minutes": self.options.minutes} if by_time(cell) else {"steps": steps}
            found = recall(self.place(cell) / "trained.json", self.asked(cell, **budget))
            if found is None:
                continue
            trained[cell] = found
            steps = found["steps"] if cell == BASE else steps
            for name in self.sets:
                for how in METHODS:
                    record = self.error(cell, name, how, found)
                    if record is not None:
                        errors[cell, name, how] = record
        times, grown = self.cost()
        return Known(trained, errors, times, grown, self.descent(trained))

    def _here(self) -> dict[str, Any]:
        return circumstances(self.setting.threads, 1)


def by_time(cell: Cell) -> bool:
    """Whether its budget is time: where representations and constraints, which differ in cost, are compared.

    All others, which are compared for what they learn, take as many steps as the base does in that time.
    """
    return replace(cell, field=BASE.field, constraint=BASE.constraint, seed=BASE.seed) == BASE


def methods_of(cell: Cell) -> tuple[str, ...]:
    """With which refinements a cell is measured, whatever its seed: the paper's; those of tables 4 and 5 where they look."""
    alike = replace(cell, seed=BASE.seed)
    if alike == BASE:
        return ("code", "none", "chamfer", "nodes")
    nodes = cell.field != "pointwise" and cell.constraint in TABLE4 and alike in cells_of("table4")
    return ("code", "nodes") if nodes else ("code",)


def _words(frame: Frame) -> dict[str, Any]:
    return {"scale": frame.scale, "rotation": frame.rotation.tolist(), "center": frame.center.tolist()}


def asked_views(tables: str, figures: str) -> list[str]:
    """Views by the numbers of tables and figures, in the order of `VIEWS`.

    Raises
    ------
    OptionError
        There is no such view.
    """
    asked = [f"table{number}" for number in tables.split(",") if number]
    asked += [f"figure{number}" for number in figures.split(",") if number]
    return known_views(asked)


def known_views(asked: Sequence[str]) -> list[str]:
    """The views of these names, in the order of `VIEWS`; an empty name is none.

    Raises
    ------
    OptionError
        There is no such view.
    """
    for view in asked:
        if view and view not in VIEWS:
            raise OptionError(f"there is no {view}", f"choose from {', '.join(VIEWS)}")
    return [view for view in VIEWS if view in asked]
