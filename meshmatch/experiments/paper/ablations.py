"""The paper's ablations.

Tables 4 (representations and constraints: errors and cost), 5 (regularisers), 6 (nodes and radius, kernel), 7 (how nodes
are chosen); figures 8 (template pose), 9 (training shapes), 10 (supervised points). All are views of one set of runs. Each
run is trained once, from the beginning, and measured on shapes that it has not seen and on pairs of the benchmark's sets.
All are trained for the same number of --steps; how many that should be, the view "length" says, which trains with and
without constraints for 1,000 to 30,000.

What is measured lies in the output folder and is not measured again, so that a stopped command goes on with what is
missing. A file that --save wrote holds the same of every run whose errors are all known, without weights: --rows goes on
with it in another folder. --show measures nothing and shows what is there.

The tables say the budget. Errors are in cm at 1.9 m2 of skin: held out, the mean distance of the template's points from
where they belong, by the network alone; on a set, the geodesic error after the search over codes with the run's own
regularisers, on all ordered pairs of some shapes. The paper's numbers beside them are of long trainings on an A100 and of
its own pairs.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.errors import InputError, OptionError, TemplateError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.sets import ALL_SETS, CLOUD_SET, BenchSet, load_set
from meshmatch.experiments.paper.ablation_errors import (
    METHODS,
    Measure,
    Subject,
    chosen_names,
    errors_of,
    oriented,
    subject,
)
from meshmatch.experiments.paper.ablation_results import claims, claims_table, tables
from meshmatch.experiments.paper.ablation_training import Loss, Setting, timed, train_run
from meshmatch.experiments.paper.ablation_views import VIEWS, Known, Run, all_runs, methods_of
from meshmatch.geometry.frames import Frame
from meshmatch.models.registry import find_model


@dataclass(frozen=True)
class Kept:
    """The output folder and what is asked of it; each method measures what is not there yet.

    ``earlier`` are rows that were measured before, by the names of their files in such a folder; ``rows`` all that were
    asked for and are there.
    """

    folder: Path
    setting: Setting
    measure: Measure
    steps: int
    model: str
    benches: Sequence[BenchSet]
    cache: Path | None
    show: bool
    methods: Sequence[str] = METHODS
    earlier: Mapping[str, Any] = field(default_factory=dict)
    rows: dict[str, Any] = field(default_factory=dict)

    def here(self) -> dict[str, Any]:
        """The circumstances of a measurement."""
        return runner.circumstances(self.setting.threads)

    @cached_property
    def reference(self) -> str:
        """What tells the weights of the model that says the orientation from others."""
        return find_model(self.model)[1].weights_sha256

    def answer(
        self, path: Path, asked: dict[str, Any], measured: Callable[[], dict[str, Any]]
    ) -> dict[str, Any] | None:
        """A kept result, measured if it must be and may be."""
        name = path.relative_to(self.folder).as_posix()
        if name in self.earlier and not path.is_file():
            found: dict[str, Any] | None = runner.as_asked(self.earlier[name], asked, f"{name} of --rows")
        else:
            found = runner.recall(path, asked) if self.show else runner.once(path, asked, measured)
        if found is not None:
            self.rows[name] = found
        return found

    def train(self, run: Run) -> dict[str, Any] | None:
        """How its training went; {"skipped": why} where nodes cannot be laid."""
        steps = run.steps or self.steps

        def measured() -> dict[str, Any]:
            runner.tell(f"training {run.name}: {steps} steps")
            try:
                found = train_run(run, self.setting, self.folder / run.name / "model", steps)
            except TemplateError as error:
                found = {"skipped": error.message}
            return {**self.here(), **found}

        asked = {"run": asdict(run), "setting": asdict(self.setting), "steps": steps}
        return self.answer(self.folder / run.name / "trained.json", asked, measured)

    def errors(self, run: Run, trained: dict[str, Any]) -> dict[tuple[Run, str, str], dict[str, Any]]:
        """Errors on every set after every refinement that belongs to the run.

        Raises
        ------
        OptionError
            Something is missing, and the model that it would be measured with.
        """
        found: dict[tuple[Run, str, str], dict[str, Any]] = {}
        folder = self.folder / run.name
        for bench in self.benches if "skipped" not in trained else ():
            for how in (each for each in methods_of(run) if each in self.methods):

                def measured(bench: BenchSet = bench, how: str = how) -> dict[str, Any]:
                    if not (folder / "model").is_dir():
                        hint = "train it again: remove that folder, and its rows from the file of --rows"
                        raise OptionError(f"{folder} has lost its model", hint)
                    runner.tell(f"measuring {run.name} on {bench.name}: {how}")
                    model, subjects = as_model(folder / "model"), self.subjects(bench)
                    return {**self.here(), **errors_of(model, run, subjects, self.model, how, self.measure)}

                asked = {"model": trained.get("model"), "measure": asdict(self.measure), "set": bench.name}
                asked |= {"method": how, "reference": self.reference}
                if (one := self.answer(folder / f"error-{bench.name}-{how}.json", asked, measured)) is not None:
                    found[run, bench.name, how] = one
        return found

    @cached_property
    def _subjects(self) -> dict[str, list[Subject]]:
        return {}

    def frames(self, bench: BenchSet) -> dict[str, Any] | None:
        """The orientation that the reference model finds of the shapes on which a set's errors are measured."""
        names = chosen_names(bench, self.measure)

        def measured() -> dict[str, Any]:
            runner.tell(f"orienting {len(names)} shapes of {bench.name}")
            return {"frames": {name: asdict(oriented(bench.seen(name), self.model, self.measure)) for name in names}}

        asked = {"shapes": names, "seed": self.measure.seed, "reference": self.reference}
        return self.answer(self.folder / f"frames-{bench.name}.json", asked, measured)

    def subjects(self, bench: BenchSet) -> list[Subject]:
        """The shapes on which a set's errors are measured, in the orientation that the reference model finds."""
        if bench.name not in self._subjects:
            frames = (self.frames(bench) or {}).get("frames", {})
            self._subjects[bench.name] = [
                subject(bench, name, Frame(**frame), self.measure, self.cache) for name, frame in frames.items()
            ]
        return self._subjects[bench.name]

    def cost(self, rounds: int) -> dict[str, Any]:
        """Times of the iterations of table 4's runs, which take turns."""
        runs = VIEWS["table4"].runs

        def measured() -> dict[str, Any]:
            runner.tell(f"timing {len(runs)} runs side by side")
            return {**self.here(), "times": timed(self.setting, runs, rounds)}

        asked = {"runs": [asdict(run) for run in runs], "setting": asdict(self.setting), "rounds": rounds}
        times = self.answer(self.folder / "times.json", asked, measured)
        return {} if times is None else times["times"]

    def known(self, runs: Sequence[Run], views: Sequence[str], rounds: int) -> Known:
        """What is there, after measuring what is missing; no runs are trained in 0 steps."""
        trained: dict[Run, dict[str, Any]] = {}
        errors: dict[tuple[Run, str, str], dict[str, Any]] = {}
        for run in runs if self.steps else ():
            if (found := self.train(run)) is not None:
                trained[run] = found
                errors |= self.errors(run, found)
        for bench in self.benches if errors else ():
            self.frames(bench)
        return Known(trained, errors, self.cost(rounds) if "table4" in views and rounds else {})

    def finished(self, known: Known) -> dict[str, Any]:
        """Earlier and new rows that need no weights to go on with: all but those of runs whose errors are not all there."""
        begun = {
            run.name
            for run, found in known.trained.items()
            for bench in self.benches if "skipped" not in found
            for how in methods_of(run) if how in self.methods and (run, bench.name, how) not in known.errors
        }  # fmt: skip
        rows = {**self.earlier, **self.rows}
        return {name: row for name, row in rows.items() if name.partition("/")[0] not in begun}

    def budget(self) -> str:
        """What the numbers cost, in words."""
        words = [f"{self.steps} steps of every run", f"{self.setting.loss} loss"]
        if self.setting.batch:
            words.append(f"batches of {self.setting.batch}")
        words.append(f"{self.measure.code_steps} steps on the code")
        return ", ".join([*words, f"the pairs of {self.measure.shapes} shapes of a set"])


def saved_rows(path: Path) -> dict[str, Any]:
    """Rows of a file of results.

    Raises
    ------
    InputError
        It holds none.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["values"]["rows"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path} holds no rows of ablations", "name a file that --save wrote") from error


@runner.command
def main(
    output: Annotated[Path, Option(help="folder of what is measured")],
    views: Annotated[str, Option(help=f"of {', '.join(VIEWS)}")] = ",".join(VIEWS),
    steps: Annotated[int, Option(min=0, help="of training a run; 0: table 4's cost alone")] = 300,
    seeds: Annotated[int, Option(min=1, help="trainings of each run of the views that are repeated")] = 1,
    repeated: Annotated[str, Option(help="which views these are; may be empty")] = "table4",
    rounds: Annotated[int, Option(min=0, help="iterations of table 4's runs under the clock")] = 5,
    sets: Annotated[str, Option(help="on which errors are measured; may be empty")] = f"shrec19,{CLOUD_SET}",
    shapes: Annotated[int, Option(min=2, help="of each set, whose pairs are measured")] = 6,
    code_steps: Annotated[int, Option(min=1, help="of the search over codes")] = 100,
    methods: Annotated[str, Option(help="refinements, where a view asks for them")] = ",".join(METHODS),
    batch: Annotated[int | None, Option(min=1, help="shapes of a step; 32 by default")] = None,
    loss: Annotated[Loss, Option(help="squared distances and the weights of the paper, or ours")] = "paper",
    threads: runner.Threads = 1,
    model: runner.Model = "human",
    data: runner.Data = runner.DATA,
    cache: runner.Cache = None,
    rows: Annotated[Path | None, Option(help="that --save wrote; what it holds counts as measured")] = None,
    show: Annotated[bool, Option("--show", help="measure nothing, show what is there")] = False,
) -> runner.Report:
    names = [name for name in VIEWS if name in runner.names_of(views, VIEWS, "view")]
    runs = all_runs(names, seeds, runner.names_of(repeated, VIEWS, "view"))
    benches = [load_set(name, data) for name in runner.names_of(sets, ALL_SETS, "set")]
    setting, measure = Setting(threads, batch, loss), Measure(shapes=shapes, code_steps=code_steps)
    wanted = runner.names_of(methods, METHODS, "method")
    earlier = saved_rows(rows) if rows else {}
    kept = Kept(output, setting, measure, steps, model, benches, cache, show, wanted, earlier)
    known = kept.known(runs, names, rounds)
    where = [bench.name for bench in benches]
    found = claims(known, where)
    missing = [run.name for run in runs if run not in known.trained]
    record = {
        **{"setting": asdict(setting), "measure": asdict(measure)},
        **{"rows": kept.finished(known), "claims": [asdict(claim) for claim in found]},
    }
    drawn = [*tables(known, names, where, kept.budget()), claims_table(found)]
    return runner.Report(record, drawn, [f"Not measured: {', '.join(missing)}"] if missing else [])
