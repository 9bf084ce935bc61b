"""Ablations of the paper.

Tables 4 (representations and constraints: errors and cost), 5 (regularisers), 6 (nodes and radius, kernel), 7 (choice of
nodes); figures 8 (template pose), 9 (training shapes), 10 (supervised points). All are views of one set of runs. Each run
is trained once, from scratch, and evaluated on held-out shapes and on pairs of the benchmark's sets. All runs have the same
number of --steps. The view "length" shows convergence: it trains with and without constraints for 1,000 to 30,000 steps.

Results are kept in the output folder, so that an interrupted command continues with what is missing. A file from --save has
the results of all runs whose errors are complete, without weights; --rows continues from it in another folder. --show
measures nothing and shows the existing results.

The titles of tables state the budget. Errors are in cm at 1.9 m2 of skin. Held out: the mean distance of the template's
points from their correct places, without refinement. On a set: the geodesic error after the search over codes with the
run's own regularisers, on all ordered pairs of some shapes. The paper's numbers are from long trainings on an A100, and for
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
    build_subject,
    chosen_names,
    errors_of,
    find_core_frame,
)
from meshmatch.experiments.paper.ablation_results import claims, claims_table, tables
from meshmatch.experiments.paper.ablation_training import Loss, Setting, time_iterations, train_run
from meshmatch.experiments.paper.ablation_views import VIEWS, Measurements, Run, all_runs, methods_of
from meshmatch.geometry.frames import Frame
from meshmatch.models.registry import find_model


@dataclass(frozen=True)
class Study:
    """Settings of the study, with results cached in the output folder; each method measures what is missing.

    ``earlier`` are results of an earlier run, by the names of their files in its folder; ``rows`` are the results that were
    requested and are available.
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

    def metadata(self) -> dict[str, Any]:
        """Metadata of a measurement."""
        return runner.run_metadata(self.setting.threads)

    @cached_property
    def reference(self) -> str:
        """Hash of the weights of the reference model, which determines orientations."""
        return find_model(self.model)[1].weights_sha256

    def get_or_measure(
        self, path: Path, asked: dict[str, Any], measure: Callable[[], dict[str, Any]]
    ) -> dict[str, Any] | None:
        """Return a cached result, or measure it; None if it is missing and ``show`` is set."""
        name = path.relative_to(self.folder).as_posix()
        if name in self.earlier and not path.is_file():
            result: dict[str, Any] | None = runner.check_cached(self.earlier[name], asked, f"{name} of --rows")
        else:
            result = runner.read_cached(path, asked) if self.show else runner.cached(path, asked, measure)
        if result is not None:
            self.rows[name] = result
        return result

    def train(self, run: Run) -> dict[str, Any] | None:
        """Train a run and return its summary; {"skipped": reason} if its nodes cannot be placed."""
        steps = run.steps or self.steps

        def measure() -> dict[str, Any]:
            runner.log(f"training {run.name}: {steps} steps")
            try:
                summary = train_run(run, self.setting, self.folder / run.name / "model", steps)
            except TemplateError as error:
                summary = {"skipped": error.message}
            return {**self.metadata(), **summary}

        asked = {"run": asdict(run), "setting": asdict(self.setting), "steps": steps}
        return self.get_or_measure(self.folder / run.name / "trained.json", asked, measure)

    def errors(self, run: Run, trained: dict[str, Any]) -> dict[tuple[Run, str, str], dict[str, Any]]:
        """Errors of a run on every set, after each of its refinements.

        Raises
        ------
        OptionError
            A result is missing, and so is the model that is needed to measure it.
        """
        errors_by_set: dict[tuple[Run, str, str], dict[str, Any]] = {}
        folder = self.folder / run.name
        for bench in self.benches if "skipped" not in trained else ():
            for method in (each for each in methods_of(run) if each in self.methods):

                def measure(bench: BenchSet = bench, method: str = method) -> dict[str, Any]:
                    if not (folder / "model").is_dir():
                        hint = "train it again: remove that folder, and its rows from the file of --rows"
                        raise OptionError(f"{folder} lacks its model", hint)
                    runner.log(f"measuring {run.name} on {bench.name}: {method}")
                    model, subjects = as_model(folder / "model"), self.subjects(bench)
                    return {**self.metadata(), **errors_of(model, run, subjects, self.model, method, self.measure)}

                asked = {"model": trained.get("model"), "measure": asdict(self.measure), "set": bench.name}
                asked |= {"method": method, "reference": self.reference}
                if (
                    result := self.get_or_measure(folder / f"error-{bench.name}-{method}.json", asked, measure)
                ) is not None:
                    errors_by_set[run, bench.name, method] = result
        return errors_by_set

    @cached_property
    def _subjects(self) -> dict[str, list[Subject]]:
        return {}

    def frames(self, bench: BenchSet) -> dict[str, Any] | None:
        """Core frames of the evaluated shapes of a set, found by the reference model."""
        names = chosen_names(bench, self.measure)

        def measure() -> dict[str, Any]:
            runner.log(f"orienting {len(names)} shapes of {bench.name}")
            return {
                "frames": {name: asdict(find_core_frame(bench.seen(name), self.model, self.measure)) for name in names}
            }

        asked = {"shapes": names, "seed": self.measure.seed, "reference": self.reference}
        return self.get_or_measure(self.folder / f"frames-{bench.name}.json", asked, measure)

    def subjects(self, bench: BenchSet) -> list[Subject]:
        """The evaluated shapes of a set, in the core frames that the reference model found."""
        if bench.name not in self._subjects:
            frames = (self.frames(bench) or {}).get("frames", {})
            self._subjects[bench.name] = [
                build_subject(bench, name, Frame(**frame), self.measure, self.cache) for name, frame in frames.items()
            ]
        return self._subjects[bench.name]

    def cost(self, rounds: int) -> dict[str, Any]:
        """Times of the iterations of table 4's runs."""
        runs = VIEWS["table4"].runs

        def measure() -> dict[str, Any]:
            runner.log(f"timing {len(runs)} runs side by side")
            return {**self.metadata(), "times": time_iterations(self.setting, runs, rounds)}

        asked = {"runs": [asdict(run) for run in runs], "setting": asdict(self.setting), "rounds": rounds}
        times = self.get_or_measure(self.folder / "times.json", asked, measure)
        return {} if times is None else times["times"]

    def measure_all(self, runs: Sequence[Run], views: Sequence[str], rounds: int) -> Measurements:
        """Measure what is missing and return all results; with 0 steps nothing is trained."""
        trained: dict[Run, dict[str, Any]] = {}
        errors: dict[tuple[Run, str, str], dict[str, Any]] = {}
        for run in runs if self.steps else ():
            if (summary := self.train(run)) is not None:
                trained[run] = summary
                errors |= self.errors(run, summary)
        for bench in self.benches if errors else ():
            self.frames(bench)
        return Measurements(trained, errors, self.cost(rounds) if "table4" in views and rounds else {})

    def finished(self, measured: Measurements) -> dict[str, Any]:
        """Earlier and new results, except for runs with missing errors, which would need the weights to be completed."""
        incomplete = {
            run.name
            for run, summary in measured.trained.items()
            for bench in self.benches if "skipped" not in summary
            for how in methods_of(run) if how in self.methods and (run, bench.name, how) not in measured.errors
        }  # fmt: skip
        rows = {**self.earlier, **self.rows}
        return {name: row for name, row in rows.items() if name.partition("/")[0] not in incomplete}

    def budget(self) -> str:
        """Description of the budget for the titles of tables."""
        parts = [f"{self.steps} steps of every run", f"{self.setting.loss} loss"]
        if self.setting.batch:
            parts.append(f"batches of {self.setting.batch}")
        parts.append(f"{self.measure.code_steps} steps on the code")
        return ", ".join([*parts, f"the pairs of {self.measure.shapes} shapes of a set"])


def saved_rows(path: Path) -> dict[str, Any]:
    """Read the ``rows`` of a file of results.

    Raises
    ------
    InputError
        There are none.
    """
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["values"]["rows"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise InputError(f"{path} holds no rows of ablations", "name a file that --save wrote") from error


@runner.command
def main(
    output: Annotated[Path, Option(help="folder of the results")],
    views: Annotated[str, Option(help=f"views to measure, from {', '.join(VIEWS)}")] = ",".join(VIEWS),
    steps: Annotated[int, Option(min=0, help="training steps of a run; 0: only table 4's cost")] = 300,
    seeds: Annotated[int, Option(min=1, help="trainings of each run in the repeated views")] = 1,
    repeated: Annotated[str, Option(help="views to repeat with several seeds; may be empty")] = "table4",
    rounds: Annotated[int, Option(min=0, help="timed iterations of table 4's runs")] = 5,
    sets: Annotated[str, Option(help="sets to measure errors on; may be empty")] = f"shrec19,{CLOUD_SET}",
    shapes: Annotated[int, Option(min=2, help="shapes of each set, of which all pairs are measured")] = 6,
    code_steps: Annotated[int, Option(min=1, help="steps of the search over codes")] = 100,
    methods: Annotated[str, Option(help="refinements to measure, in views that have several")] = ",".join(METHODS),
    batch: Annotated[int | None, Option(min=1, help="shapes in a step; 32 by default")] = None,
    loss: Annotated[Loss, Option(help="the paper's squared distances and weights, or ours")] = "paper",
    threads: runner.Threads = 1,
    model: runner.Model = "human",
    data: runner.Data = runner.DATA,
    cache: runner.Cache = None,
    rows: Annotated[Path | None, Option(help="file from --save, whose results are not measured again")] = None,
    show: Annotated[bool, Option("--show", help="measure nothing, show existing results")] = False,
) -> runner.Report:
    names = [name for name in VIEWS if name in runner.split_names(views, VIEWS, "view")]
    runs = all_runs(names, seeds, runner.split_names(repeated, VIEWS, "view"))
    benches = [load_set(name, data) for name in runner.split_names(sets, ALL_SETS, "set")]
    setting, measure = Setting(threads, batch, loss), Measure(shapes=shapes, code_steps=code_steps)
    method_names = runner.split_names(methods, METHODS, "method")
    earlier = saved_rows(rows) if rows else {}
    study = Study(output, setting, measure, steps, model, benches, cache, show, method_names, earlier)
    measured = study.measure_all(runs, names, rounds)
    set_names = [bench.name for bench in benches]
    tested_claims = claims(measured, set_names)
    missing = [run.name for run in runs if run not in measured.trained]
    record = {
        **{"setting": asdict(setting), "measure": asdict(measure)},
        **{"rows": study.finished(measured), "claims": [asdict(claim) for claim in tested_claims]},
    }
    result_tables = [*tables(measured, names, set_names, study.budget()), claims_table(tested_claims)]
    return runner.Report(record, result_tables, [f"Not measured: {', '.join(missing)}"] if missing else [])
