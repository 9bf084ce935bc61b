"""How true the truth is: ``python -m meshmatch.experiments.truth --data ../shared/bench``.

The true points of SHREC'19 come from a template that was registered to every shape. Some of its shapes are poses of one
person from a set whose meshes all have the same vertices, in the same order, so that on them the right partner of every
vertex is known beyond that. The distance between what the two truths say is the error that a perfect map would be
charged with. Shapes are taken for such poses if they have equally many vertices, and vertices that are neighbours on
one are neighbours on the others.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial import cKDTree

from meshmatch.errors import InputError
from meshmatch.experiments.distances import TruthDistances, default_folder
from meshmatch.experiments.protocols import SET_NAMES, BenchSet, load_set
from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

_ASKED, _NEAR = 200, 5  # vertices that are asked for so many neighbours
_NEAR_SHARE = 0.5  # of the distance of any two vertices, below which neighbours are near


def same_order(a: Shape, b: Shape) -> bool:
    """Whether two shapes have the same vertices in the same order: neighbours of one are neighbours on the other."""
    if a.V != b.V:
        return False
    asked = np.linspace(0, a.V - 1, min(_ASKED, a.V)).astype(np.int64)
    near = cKDTree(a.verts).query(a.verts[asked], min(_NEAR + 1, a.V))[1][:, 1:]
    other = np.roll(asked, len(asked) // 3)
    apart = np.linalg.norm(b.verts[near] - b.verts[asked][:, None], axis=2)
    usual = np.linalg.norm(b.verts[other] - b.verts[asked], axis=1)
    return bool(np.median(apart) < _NEAR_SHARE * np.median(usual))


def groups(bench: BenchSet) -> list[list[str]]:
    """Shapes of a set that have the same vertices in the same order, in groups of at least two."""
    found: list[list[str]] = []
    for name in bench.shapes:
        home = next((group for group in found if same_order(bench.shape(group[0]), bench.shape(name))), None)
        if home is None:
            found.append([name])
        else:
            home.append(name)
    return [group for group in found if len(group) > 1]


def run(bench: BenchSet, cache: Path) -> dict[str, Any]:
    """Measure, print a table and a JSON line; the line's record is returned too.

    Raises
    ------
    InputError
        No two shapes of the set have the same vertices.
    """
    set_threads(1)
    alike = groups(bench)
    if not alike:
        raise InputError(f"no two shapes of {bench.name} have the same vertices in the same order")
    table = Table(
        title=f"{bench.name}: its truth against vertices in the same order, cm", title_justify="left"
    )
    for name in ("shapes", "pairs", "mean", "median", "best pair", "worst pair", f"over {LOST_CM:g} cm"):
        table.add_column(name, justify="left" if name == "shapes" else "right")
    rows = []
    for group in alike:
        pairs = list(permutations(group, 2))
        errors = [
            CM_PER_UNIT
            * TruthDistances(bench.shape(b), bench.landmarks(b), cache).errors([bench.landmarks(a)])[0]
            for a, b in track(pairs, "measuring", console=Console(stderr=True))
        ]
        joined, means = np.concatenate(errors), [float(values.mean()) for values in errors]
        lost = float((joined > LOST_CM).mean())
        median = float(np.median(joined))
        numbers = (float(joined.mean()), median, min(means), max(means))
        table.add_row(
            ", ".join(group), str(len(pairs)), *(f"{x:.2f}" for x in numbers), f"{100 * lost:.1f} %"
        )
        keys = ("mean_cm", "median_cm", "best_pair_cm", "worst_pair_cm")
        rows.append(
            {
                "shapes": group,
                "pairs": len(pairs),
                **dict(zip(keys, numbers, strict=True)),
                "share_over_15cm": lost,
            }
        )
    wide_console().print(table)
    whole = {"benchmark": "truth", **circumstances(threads=1, jobs=1), "set": bench.name, "groups": rows}
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run it; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.truth", description=__doc__)
    parser.add_argument("--set", default="shrec19", choices=SET_NAMES)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--cache", type=Path, help="folder of kept geodesic distances")
    options = parser.parse_args(words)
    return status_of(lambda: run(load_set(options.set, options.data), options.cache or default_folder()))


if __name__ == "__main__":
    sys.exit(main())
