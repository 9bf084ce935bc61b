"""How true the truth of SHREC'19 is, and what maps are charged for it.

The set's true points come from a template (SMPL) registered to every shape. Where more is known (see
`meshmatch.experiments.truths`), this prints

- for shapes with the same triangles, on all their ordered pairs: the error that the set charges a perfect map with (which
  sends vertex i to vertex i), the one that it charges our maps with, and the error of our maps against that identity; and
  how much either truth stretches distances of 8 to 20 cm, where the truth of one person in two poses should not;
- the same for the shape that is the template itself, whose truth is its own order;
- how far the landmarks of one shape are from the consensus of the others;
- on which parts of the body the error of the set's truth lies;
- the pairs of the protocol, with the set's truth and with the best that is known.

Every shape is fitted once; every landmark counts.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.api.results import shape_of
from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.bench import Maps, Method, OurMethod
from meshmatch.experiments.scores import summary
from meshmatch.experiments.sets import BenchSet, Pair, load_set
from meshmatch.experiments.truths import Truths, consensus_points
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import Refine
from meshmatch.maps.evaluate import CM_PER_UNIT, LOST_CM, Errors
from meshmatch.maps.footpoints import template_footpoints
from meshmatch.templates.template import Template

SAME_PERSON = {"shrec19": (("33", "35", "37", "39"),)}
"""Within groups of the same triangles, poses of one person: here SCAPE's man (33 is its mesh012, 35 its mesh030)."""
STRETCHED_CM = (8.0, 20.0)
_MARKS = 300  # landmarks between which distances are compared
COLUMNS = {
    **{"shapes": "names", "pairs": "pairs:d", "wound alike": "alike:.1%"},
    **{
        "perfect map, charged": "perfect_cm:.2f",
        "median": "perfect_median_cm:.2f",
        "worst pair": "perfect_worst_cm:.2f",
    },
    **{"ours, charged": "charged_cm:.2f", "ours, true": "true_cm:.2f", "true median": "true_median_cm:.2f"},
    **{f"over {LOST_CM:g} cm": "true_over_15cm:.1%"},
    **{"stretch, identity": "stretch_identity:.1%", "the set's": "stretch_set:.1%"},
}
PROTOCOL = {"truth": "kind", "pairs": "pairs:d", "the set's": "charged_cm:.2f", "median": "charged_median_cm:.2f"}
PROTOCOL |= {
    "best known": "true_cm:.2f",
    "true median": "true_median_cm:.2f",
    f"over {LOST_CM:g} cm": "true_over_15cm:.2%",
}
PARTS = {"part": "part", "cm": "cm:.1f", "of the landmarks": "landmarks:.0%", "of the sum": "sum:.0%"}
OTHERS = {"shape": "name", "rms cm": "rms_cm:.2f", "median cm": "median_cm:.2f"}


@dataclass(frozen=True, eq=False)
class Measured:
    """Fits of all shapes, our map of every pair, and its errors by the set's truth."""

    fits: dict[str, Any]
    maps: dict[Pair, Ints]
    charged: dict[Pair, Errors]


def matched(truths: Truths, method: Method, pairs: Sequence[Pair]) -> Measured:
    """Fit every shape of some pairs once, map and measure each pair; one that fails counts as a map to vertex 0."""
    bench, fits, maps = truths.bench, {}, {}
    shapes = {name: bench.seen(name) for name in dict.fromkeys(name for pair in pairs for name in pair)}
    for name in runner.track(list(shapes), "fitting"):
        fits[name] = method.fit(shapes[name])
    for a, b in runner.track(pairs, "mapping"):
        try:
            maps[a, b] = method.map(shapes[a], fits[a], shapes[b], fits[b]).index
        except MeshmatchError:
            maps[a, b] = np.zeros(shapes[a].V, dtype=np.int64)
    charged = {
        (a, b): _errors(truths, b, bench.landmarks(b), maps[a, b][bench.landmarks(a)])
        for a, b in runner.track(pairs, "by the set's truth")
    }
    return Measured(fits, maps, charged)


def _errors(truths: Truths, name: str, right: Int[Ints, " N"], said: Int[Ints, " N"]) -> Errors:
    return Errors(truths.distances(name).between(right, said).astype(np.float32))


def true_errors(truths: Truths, maps: Maps, pairs: Sequence[Pair]) -> dict[Pair, Errors]:
    """Errors of maps against the best truth that is known of each pair."""
    found = {}
    for pair in runner.track(pairs, "by the best truth"):
        here, there, _ = truths.of_pair(pair)
        found[pair] = _errors(truths, pair[1], there, maps[pair][here])
    return found


def perfect_errors(truths: Truths, pairs: Sequence[Pair]) -> dict[Pair, Errors]:
    """What the set charges the map with that sends vertex i to vertex i."""
    bench = truths.bench
    return {
        (a, b): _errors(truths, b, bench.landmarks(b), bench.landmarks(a)) for a, b in runner.track(pairs, "its truth")
    }


def stretch(truths: Truths, pairs: Sequence[Pair]) -> tuple[float, float]:
    """Mean |log| of the factor by which identity, and the set's truth, change distances of `STRETCHED_CM`."""
    bench = truths.bench
    marks = np.unique(np.linspace(0, len(bench.landmarks(pairs[0][0])) - 1, _MARKS).astype(np.int64))
    low, high = (cm / CM_PER_UNIT for cm in STRETCHED_CM)
    ids = {name: bench.landmarks(name)[marks] for name in dict.fromkeys(name for pair in pairs for name in pair)}
    rows = {  # all landmarks of the group at once on each shape
        name: truths.distances(name).among(np.concatenate(list(ids.values()))) for name in runner.track(ids, "stretch")
    }
    part = {name: slice(k * len(marks), (k + 1) * len(marks)) for k, name in enumerate(ids)}
    found: list[list[float]] = [[], []]
    for a, b in pairs:
        before = rows[a][part[a], part[a]]
        near = (before > low) & (before < high)
        for truth, of in enumerate((a, b)):
            after = np.maximum(rows[b][part[of], part[of]], 1e-3)  # landmarks may share a vertex
            found[truth].append(float(np.abs(np.log(after[near] / before[near])).mean()))
    return float(np.mean(found[0])), float(np.mean(found[1]))


def group_row(truths: Truths, names: Sequence[str], perfect: Mapping[Pair, Errors], run: Measured) -> dict[str, Any]:
    """What the two truths say on all ordered pairs of shapes with the same triangles."""
    pairs = list(permutations(names, 2))
    alike = [truths.wound_alike(pair) for pair in pairs]
    charged = summary([perfect[pair] for pair in pairs])
    errors = true_errors(truths, run.maps, pairs)
    identity, own = stretch(truths, pairs)
    return {
        **{"names": ", ".join(names), "shapes": list(names), "pairs": len(pairs), "alike": float(np.mean(alike))},
        **{"perfect_cm": charged["mean_cm"], "perfect_median_cm": charged["median_cm"]},
        "perfect_worst_cm": max(perfect[pair].mean_cm for pair in pairs),
        "perfect_over_15cm": charged["share_over_15cm"],
        **_both({pair: run.charged[pair] for pair in pairs}, errors),
        **{"stretch_identity": identity, "stretch_set": own},
    }


def _both(charged: Mapping[Pair, Errors], true: Mapping[Pair, Errors]) -> dict[str, float]:
    """Our errors by the set's truth, and by a better one."""
    theirs, better = summary(list(charged.values())), summary(list(true.values()))
    return {
        **{"charged_cm": theirs["mean_cm"], "charged_median_cm": theirs["median_cm"]},
        **{"true_cm": better["mean_cm"], "true_median_cm": better["median_cm"]},
        "true_over_15cm": better["share_over_15cm"],
    }


def template_row(truths: Truths, name: str) -> dict[str, Any]:
    """How far the landmarks of the template's own shape are from the vertices of their number."""
    landmarks = truths.bench.landmarks(name)
    numbers = np.arange(len(landmarks))
    errors = _errors(truths, name, landmarks, numbers)
    return {
        **{"names": f"{name} (the template)", "shapes": [name], "pairs": 0},
        **{"perfect_cm": errors.mean_cm, "perfect_median_cm": errors.median_cm},
        "own_number": float((landmarks == numbers).mean()),
    }


def consensus_row(truths: Truths, name: str) -> dict[str, Any]:
    """Straight distances of a shape's landmarks from the consensus of the others of its group, cm."""
    shape = truths.bench.shape(name)
    off = shape.verts[truths.bench.landmarks(name)] - consensus_points(truths, name)
    cm = np.linalg.norm(off, axis=1) / np.sqrt(shape.area) * CM_PER_UNIT
    return {"name": name, "rms_cm": float(np.sqrt((cm**2).mean())), "median_cm": float(np.median(cm))}


def part_rows(
    bench: BenchSet, errors: Mapping[Pair, Errors], fits: Mapping[str, Any], template: Template
) -> list[dict[str, Any]]:
    """Where errors lie: by the part of the fitted template that a landmark of the source is on, both sides together."""
    labels, by_part = np.asarray(template.labels), defaultdict(list)
    names = np.array([name.removeprefix("left ").removeprefix("right ") for name in template.label_names])
    parts = {}
    for name in dict.fromkeys(source for source, _ in errors):
        fit = fits[name]
        if isinstance(fit, Fit):
            belongs = template_footpoints(shape_of(fit).shape, fit)[1]
            part = names[labels[cKDTree(fit.resting).query(belongs)[1]]]
            kept = shape_of(fit).kept_vertex
            whole = np.full(bench.shape(name).V, "", dtype=part.dtype)
            whole[kept] = part
            parts[name] = whole[bench.landmarks(name)]
    for (source, _), each in errors.items():
        for part in np.unique(parts[source]) if source in parts else ():
            by_part[str(part)].append(each.cm[parts[source] == part])
    joined = {part: np.concatenate(several).astype(np.float64) for part, several in by_part.items()}
    count, total = sum(map(len, joined.values())), sum(values.sum() for values in joined.values())
    rows = [
        {"part": part, "cm": values.mean(), "landmarks": len(values) / count, "sum": values.sum() / total}
        for part, values in joined.items()
    ]
    return sorted(rows, key=lambda row: -row["cm"])


def protocol_rows(truths: Truths, run: Measured) -> list[dict[str, Any]]:
    """The set's own pairs, by how much is known of their truth, and all together."""
    pairs = list(truths.bench.pairs)
    better, kinds = true_errors(truths, run.maps, pairs), defaultdict(list)
    for pair in pairs:
        kinds[str(truths.of_pair(pair)[2])].append(pair)
    kinds["all"] = pairs
    return [
        {
            **{"kind": kind, "pairs": len(some)},
            **_both({pair: run.charged[pair] for pair in some}, {pair: better[pair] for pair in some}),
        }
        for kind, some in kinds.items()
    ]


def measure(bench: BenchSet, method: Method, template: Template | None) -> dict[str, list[dict[str, Any]]]:
    """All tables of a set, as rows.

    Raises
    ------
    InputError
        Nothing is known beyond the set's own truth.
    """
    truths = Truths(bench)
    if not truths.groups and not truths.templates:
        raise InputError(
            f"no two shapes of {bench.name} have the same triangles", "nothing better than its truth is known"
        )
    inside = [pair for group in truths.groups for pair in permutations(group, 2)]
    run = matched(truths, method, list(dict.fromkeys([*bench.pairs, *inside])))
    perfect = perfect_errors(truths, inside)
    rows = []
    for group in truths.groups:
        rows.append(group_row(truths, group, perfect, run))
        for names in SAME_PERSON.get(bench.name, ()):
            if set(names) < set(group):
                rows.append(group_row(truths, names, perfect, run))
    rows += [template_row(truths, name) for name in truths.templates]
    large = [name for group in truths.groups if len(group) > 2 for name in group]
    return {
        "groups": rows,
        "consensus": [consensus_row(truths, name) for name in large],
        "parts": [] if template is None else part_rows(bench, perfect, run.fits, template),
        "protocol": protocol_rows(truths, run),
    }


@runner.command
def main(
    set: Annotated[str, Option(help="of the benchmark")] = "shrec19",
    data: runner.Data = runner.DATA,
    model: runner.Model = "human",
    refine: Refine = "nodes",
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    method = OurMethod(model, refine, seed, threads=threads)
    found = measure(load_set(set, data), method, as_model(model).template)
    titles = {
        "groups": ("its truth, and ours, against vertices in the same order, cm", COLUMNS),
        "consensus": ("landmarks of one shape against the mean of the others'", OTHERS),
        "parts": ("where the truth is off, mean of a perfect map's error", PARTS),
        "protocol": ("our maps of its pairs, by its truth and by the best that is known, cm", PROTOCOL),
    }
    drawn = [
        runner.table(f"{set}: {words}", found[key], columns) for key, (words, columns) in titles.items() if found[key]
    ]
    return runner.Report(found, drawn)


if __name__ == "__main__":
    sys.exit(main())
