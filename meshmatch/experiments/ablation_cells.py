"""Which cells each of the paper's tables and figures looks at, and what is known of a cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from meshmatch.experiments.cells import BASE, Cell
from meshmatch.fields.choice import FIELDS
from meshmatch.templates.nodes import STRATEGIES

TABLE4 = ("none", "vol+arap", "vol+arap+Z")
GRID = (
    (100, 0.5),
    (300, 0.2),
    (300, 0.5),
    (900, 0.1),
    (900, 0.2),
    (900, 0.5),
    (2700, 0.07),
    (2700, 0.2),
    (2700, 0.5),
)
POSES = ("T", "A", "I")
SHAPES = (250, 500, 1000, 2000)
SUPERVISED = (50, 100, 1000)
CODED = replace(BASE, field="pointwise", constraint="none")
"""3D-CODED as a cell."""

VIEWS = ("table4", "table5", "figure9", "figure10", "figure8", "table7", "table6", "figure6")
"""In the order in which their cells are trained."""


def cells_of(view: str) -> list[Cell]:
    """The cells of a view, the base first where it is one of them."""
    if view == "table4":
        return [replace(BASE, field=field, constraint=each) for each in reversed(TABLE4) for field in FIELDS]
    if view == "table5":
        return [BASE, *(replace(BASE, constraint=each) for each in ("none", "arap", "vol", "vol+arap"))]
    if view == "table6":
        grid = [replace(BASE, nodes=K, radius=r) for K, r in GRID]
        return [BASE, *(cell for cell in grid if cell != BASE), replace(BASE, kernel="cubic")]
    if view == "table7":
        return [replace(BASE, strategy=how, pose=pose) for pose in POSES[:2] for how in STRATEGIES]
    if view == "figure8":
        return [replace(BASE, pose=pose) for pose in POSES]
    if view == "figure9":
        return [replace(BASE, shapes=count) for count in reversed(SHAPES)]
    if view == "figure10":
        return [replace(BASE, supervised=count) for count in reversed(SUPERVISED)]
    return [BASE, CODED]


def all_cells(views: Sequence[str], seeds: int = 1, repeated: Sequence[Cell] = ()) -> list[Cell]:
    """Every cell of some views once; last, those of ``repeated`` with other seeds."""
    cells = [cell for view in VIEWS if view in views for cell in cells_of(view)]
    again = [replace(cell, seed=seed) for seed in range(1, seeds) for cell in repeated if cell in cells]
    return list(dict.fromkeys([*cells, *again]))


@dataclass(frozen=True)
class Known:
    """What was measured, by cell: ``trained`` as `train_cell` tells it or {"skipped": why}; ``errors`` by set and method.

    Parameters
    ----------
    trained : {cell: record}
    errors : {(cell, set, method): record}
    times, memory : {cell name: record}
    descent : what `meshmatch.experiments.descent` found, if it was measured
    """

    trained: Mapping[Cell, dict[str, Any]]
    errors: Mapping[tuple[Cell, str, str], dict[str, Any]]
    times: Mapping[str, dict[str, Any]]
    memory: Mapping[str, dict[str, Any]]
    descent: dict[str, Any] | None = None

    def error(self, cell: Cell, where: str, method: str = "code", what: str = "mean_cm") -> list[float]:
        """Errors in cm of a cell and its repetitions with other seeds; ``where`` is a set, or "held out".

        ``what`` is "mean_cm", or on a set "median_cm".
        """
        alike = sorted((each for each in self.trained if replace(each, seed=0) == cell), key=lambda c: c.seed)
        if where == "held out":
            records = [self.trained[each].get("held_out_cm") for each in alike]
        else:
            records = [self.errors.get((each, where, method), {}).get(what) for each in alike]
        return [record for record in records if record is not None]
