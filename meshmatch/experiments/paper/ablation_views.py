"""The paper's tables and figures as data: the runs that each one shows, and the paper's numbers.

A run is one training, with a value for everything that the paper varies. All tables and figures are views of the same runs,
most of which differ from `BASE` in one setting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from meshmatch.fields.shape_functions import FIELDS, FieldName
from meshmatch.geometry.kernels import Kernel
from meshmatch.templates.make import STRATEGIES, Strategy

TABLE3 = "vol+arap+Z of table 3"
"""The weights for interpolation; all other constraints have the weights of table 1."""
CONSTRAINTS = ("none", "arap", "vol", "vol+arap", "vol+arap+Z")
PAPER_SETS = ("shrec19", "scape-pcn")
HELD_OUT = "held out"
HEAVY = "-heavy"
POSES = ("T", "A", "I", f"T{HEAVY}")
"""Poses of the template; the last one has the shape of heavier people."""


@dataclass(frozen=True)
class Run:
    """One training.

    Parameters
    ----------
    field, kernel : deformation field and its kernel
    constraint : one of `CONSTRAINTS`, or `TABLE3`
    nodes, radius : K, and r in the paper's unit
    strategy : method to choose nodes
    pose : pose of the template, one of `POSES`
    shapes : number of training shapes
    supervised : number of template points with supervision
    steps : training steps; 0 for the number of the command
    """

    field: FieldName = "mls"
    constraint: str = "vol+arap+Z"
    nodes: int = 300
    radius: float = 0.2
    strategy: Strategy = "parts"
    pose: str = "T"
    shapes: int = 2000
    supervised: int = 1000
    kernel: Kernel = "smooth"
    steps: int = 0
    seed: int = 0

    @property
    def name(self) -> str:
        """Name of the run's folder: the settings that differ from the base."""
        parts = [
            f"{each.name}-{getattr(self, each.name)}".replace("+", "-").replace(" ", "-").lower()
            for each in fields(self)
            if getattr(self, each.name) != each.default
        ]
        return ".".join(parts) or "base"


BASE = Run()
CODED = replace(BASE, field="pointwise", constraint="none")
"""3D-CODED as a run."""


@dataclass(frozen=True)
class Row:
    """A row of a view: labels ("{rule}" stands for the strategy that was used in the end), the run, the paper's errors in cm
    on `PAPER_SETS`, and the refinement."""

    words: tuple[str, ...]
    run: Run
    paper: tuple[float, float] | None = None
    method: str = "code"


@dataclass(frozen=True)
class View:
    """A table or figure: title, headings of the labels, and rows."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[Row, ...]

    @property
    def runs(self) -> list[Run]:
        """The runs without duplicates, the base first."""
        return sorted(dict.fromkeys(row.run for row in self.rows), key=lambda run: run != BASE)


_PAPER4 = {
    "none": {"pointwise": (7.4, 13.7), "rbf": (8.5, 9.9), "mls": (7.7, 9.8)},
    "vol+arap": {"pointwise": (7.1, 12.6), "rbf": (8.0, 9.1), "mls": (5.2, 7.0)},
    "vol+arap+Z": {"pointwise": (9.1, 14.8), "rbf": (8.1, 9.3), "mls": (4.8, 6.6)},
}
_PAPER5 = {
    **{"none": (7.7, 9.8), "arap": (6.9, 10.2), "vol": (7.3, 8.7), "vol+arap": (5.2, 7.0)},
    "vol+arap+Z": (4.8, 6.6),
}
_PAPER5_TEST = (
    ("none", "no refinement", (7.9, 12.5)),
    ("chamfer", "Chamfer alone", (5.0, 6.7)),
    ("code", "Chamfer, volume, arap", (4.8, 6.6)),
)
_PAPER6 = {
    (100, 0.5): (6.8, 8.2),
    (300, 0.2): (4.8, 6.6), (300, 0.5): (5.4, 7.6),
    (900, 0.1): (5.4, 7.0), (900, 0.2): (6.4, 8.7), (900, 0.5): (6.5, 8.8),
    (2700, 0.07): (6.2, 9.8), (2700, 0.2): (6.5, 9.6), (2700, 0.5): (6.5, 10.1),
}  # fmt: skip
_PAPER7 = {
    ("parts", "T"): (4.8, 6.6), ("parts", "A"): (5.1, 7.4),
    ("spectral", "T"): (4.8, 6.6), ("spectral", "A"): (5.1, 7.3),
    ("geodesic", "T"): (5.0, 6.9), ("geodesic", "A"): (5.2, 7.4),
    ("uniform", "T"): (5.1, 6.9), ("uniform", "A"): (5.9, 9.5),
}  # fmt: skip
LENGTHS = (1_000, 3_000, 10_000, 30_000)
"""Training steps at which convergence is checked."""
PAPER_MS = {
    "pointwise": {"none": 32.0, "vol+arap": 250.4, "vol+arap+Z": 4098.3},
    "rbf": {"none": 8.0, "vol+arap": 8.2, "vol+arap+Z": 12.6},
    "mls": {"none": 7.8, "vol+arap": 8.0, "vol+arap+Z": 12.1},
}
"""Milliseconds of an iteration in the paper's table 4, on an A100."""
TABLE4 = tuple(_PAPER4)
GRID = tuple(replace(BASE, nodes=K, radius=r) for K, r in _PAPER6)


def _numbers(name: str, counts: Sequence[int]) -> tuple[Row, ...]:
    """Rows of ours and of 3D-CODED for several values of a setting; both see the same number of scans."""
    return tuple(
        Row((str(count), label), replace(run, **{name: count}))  # type: ignore[arg-type]
        for label, run in (("ours", BASE), ("3D-CODED", CODED))
        for count in counts
    )


VIEWS = {
    "length": View(
        "Length of training",
        ("constraint",),
        tuple(
            Row((each,), replace(BASE, constraint=each, steps=steps))
            for steps in LENGTHS
            for each in ("none", BASE.constraint)
        ),
    ),
    "table4": View(
        "Table 4",
        ("constraint", "field"),
        tuple(
            Row((each, field), replace(BASE, field=field, constraint=each), _PAPER4[each][field])
            for each in TABLE4
            for field in FIELDS
        ),
    ),
    "table5": View(
        "Table 5",
        ("when", "regularisers"),
        (
            *(Row(("training", each), replace(BASE, constraint=each), paper) for each, paper in _PAPER5.items()),
            *(Row(("test time", words), BASE, paper, how) for how, words, paper in _PAPER5_TEST),
        ),
    ),
    "figure9": View("Figure 9", ("training shapes", "method"), _numbers("shapes", (250, 500, 1000, 2000))),
    "figure10": View("Figure 10", ("supervised points", "method"), _numbers("supervised", (50, 100, 1000))),
    "figure8": View(
        "Figure 8", ("template", "nodes by"), tuple(Row((pose, "{rule}"), replace(BASE, pose=pose)) for pose in POSES)
    ),
    "table7": View(
        "Table 7",
        ("nodes by", "template"),
        tuple(
            Row(("{rule}", pose), replace(BASE, strategy=how, pose=pose), _PAPER7[how, pose])
            for how in STRATEGIES
            for pose in "TA"
        ),
    ),
    "table6": View(
        "Table 6",
        ("K", "r", "nodes by", "kernel"),
        (
            *(
                Row((str(run.nodes), f"{run.radius:g}", "{rule}", "smooth"), run, paper)
                for run, paper in zip(GRID, _PAPER6.values(), strict=True)
            ),
            Row(("300", "0.2", "{rule}", "cubic"), replace(BASE, kernel="cubic")),
        ),
    ),
}
"""All views, in the order in which their runs are trained."""


def all_runs(views: Sequence[str], seeds: int = 1, repeated: Sequence[str] = ()) -> list[Run]:
    """All runs of the given views without duplicates, followed by those of the ``repeated`` views with other seeds."""
    runs = list(dict.fromkeys(run for view in VIEWS if view in views for run in VIEWS[view].runs))
    repeated_runs = dict.fromkeys(run for view in VIEWS if view in repeated for run in VIEWS[view].runs)
    repetitions = [replace(run, seed=seed) for seed in range(1, seeds) for run in repeated_runs if run in runs]
    return [*runs, *repetitions]


def methods_of(run: Run) -> tuple[str, ...]:
    """Refinements with which a run is evaluated: the paper's, and for the base those of table 5."""
    return ("code", "none", "chamfer") if replace(run, seed=BASE.seed) == BASE else ("code",)


@dataclass(frozen=True)
class Measurements:
    """Measurements: ``trained`` has the results of `train_run`, or {"skipped": reason}; ``errors`` are by run, set and
    method; ``times`` of an iteration are by the name of the run.
    """

    trained: Mapping[Run, Mapping[str, Any]]
    errors: Mapping[tuple[Run, str, str], Mapping[str, Any]]
    times: Mapping[str, Mapping[str, Any]]

    def rule(self, run: Run) -> str:
        """Strategy by which the nodes were chosen in the end."""
        return str(self.trained.get(run, {}).get("rule", run.strategy))

    def records(self, run: Run, where: str, method: str | None = None) -> list[Mapping[str, Any]]:
        """Records of a run and its repetitions with other seeds: on a set after a refinement (by default the first of
        `methods_of`), or on held-out shapes."""
        repetitions = sorted((each for each in self.trained if replace(each, seed=0) == run), key=lambda r: r.seed)
        if where == HELD_OUT:
            summaries = [self.trained[each] for each in repetitions]
            return [
                {"mean_cm": summary["held_out_cm"], "pair_cm": summary.get("bodies_cm")}
                for summary in summaries
                if "steps" in summary
            ]
        refinement = method or methods_of(run)[0]
        return [
            self.errors[each, where, refinement] for each in repetitions if (each, where, refinement) in self.errors
        ]

    def error(self, run: Run, where: str, method: str | None = None, what: str = "mean_cm") -> list[float]:
        """Errors in cm of a run and its repetitions; ``what`` is "mean_cm", or on a set "median_cm"."""
        return [record[what] for record in self.records(run, where, method)]
