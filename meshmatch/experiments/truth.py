"""How true the truth of SHREC'19 is.

Its true points come from a template that was registered to every shape. Some of its shapes are poses of one person from
a set whose meshes all have the same vertices, in the same order, so that on them the right partner of every vertex is
known beyond that. The distance between what the two truths say is the error that a perfect map would be charged with.
Shapes are taken for such poses if they have equally many vertices, and vertices that are neighbors on one are neighbors
on the others.
"""

from __future__ import annotations

import sys
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.scores import TruthDistances, summary
from meshmatch.experiments.sets import BenchSet, load_set
from meshmatch.maps.evaluate import LOST_CM, Errors
from meshmatch.shapes.shape import Shape

_ASKED, _NEAR = 200, 5  # vertices that are asked for so many neighbors
_NEAR_SHARE = 0.5  # of the distance of any two vertices, below which neighbors are near
COLUMNS = {
    **{"shapes": "names", "pairs": "pairs:d", "mean": "mean_cm:.2f", "median": "median_cm:.2f"},
    **{"best pair": "best_pair_cm:.2f", "worst pair": "worst_pair_cm:.2f"},
    f"over {LOST_CM:g} cm": "share_over_15cm:.1%",
}


def same_order(a: Shape, b: Shape) -> bool:
    """Whether two shapes have the same vertices in the same order: neighbors of one are neighbors on the other."""
    if a.V != b.V:
        return False
    asked = np.linspace(0, a.V - 1, min(_ASKED, a.V)).astype(np.int64)
    near = cKDTree(a.verts).query(a.verts[asked], min(_NEAR + 1, a.V))[1][:, 1:]
    other = np.roll(asked, len(asked) // 3)
    distance = np.linalg.norm(b.verts[near] - b.verts[asked][:, None], axis=2)
    usual = np.linalg.norm(b.verts[other] - b.verts[asked], axis=1)
    return bool(np.median(distance) < _NEAR_SHARE * np.median(usual))


def groups(bench: BenchSet) -> list[list[str]]:
    """Shapes of a set that have the same vertices in the same order, in groups of at least two.

    Raises
    ------
    InputError
        There is no such group.
    """
    found: list[list[str]] = []
    for name in bench.shapes:
        home = next((group for group in found if same_order(bench.shape(group[0]), bench.shape(name))), None)
        if home is None:
            found.append([name])
        else:
            home.append(name)
    found = [group for group in found if len(group) > 1]
    if not found:
        raise InputError(f"no two shapes of {bench.name} have the same vertices in the same order")
    return found


def measure(bench: BenchSet, group: list[str], cache: Path | None) -> dict[str, Any]:
    """The distance between the two truths on all ordered pairs of a group."""
    errors = []
    for a, b in runner.track(list(permutations(group, 2)), "measuring"):
        truth = TruthDistances(bench.shape(b), bench.landmarks(b), cache)
        errors.append(Errors(truth.errors([bench.landmarks(a)])[0]))
    means = [each.mean_cm for each in errors]
    return {
        **{"shapes": group, "names": ", ".join(group), "pairs": len(errors), **summary(errors)},
        **{"best_pair_cm": min(means), "worst_pair_cm": max(means)},
    }


@runner.command
def main(
    set: Annotated[str, Option(help="of the benchmark")] = "shrec19",
    data: runner.Data = runner.DATA,
    cache: runner.Cache = None,
) -> runner.Report:
    bench = load_set(set, data)
    rows = [measure(bench, group, cache) for group in groups(bench)]
    title = f"{set}: its truth against vertices in the same order, cm"
    return runner.Report({"groups": rows}, [runner.table(title, rows, COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
