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

Every shape is fitted once. Every landmark counts; --landmarks looks at some of them, evenly spread, in less time. What is
measured on each target is kept in --work: a stopped command goes on with the next one.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import as_model
from meshmatch.api.results import shape_of
from meshmatch.arrays import Ints
from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.bench import Maps
from meshmatch.experiments.bench_methods import Method, OurMethod
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
_MARKS = 120  # landmarks between which distances are compared
_FAR = 2.0  # no distance counts as stretched by more than so many times the longest, or the shortest, that is compared
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


Question = tuple[Literal["charged", "true", "perfect"], Pair]
Found = Mapping[Question, Errors]


@dataclass(frozen=True)
class Kept:
    """The folder of finished work, and the choices that it depends on."""

    folder: Path
    asked: Mapping[str, Any]
    threads: int = 1

    def once(self, name: str, measure: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
        """What was measured, now or before."""

        def measured() -> dict[str, Any]:
            return {"here": runner.circumstances(self.threads), "found": measure()}

        return dict(runner.once(self.folder / f"{name}.json", self.asked, measured)["found"])


def mapped(bench: BenchSet, method: Method, fit: Callable[[str], Any], pairs: Sequence[Pair]) -> dict[Pair, Ints]:
    """Maps of some pairs; one that fails counts as a map to vertex 0."""
    maps = {}
    for a, b in pairs:
        fits = fit(a), fit(b)
        source, target = bench.seen(a), bench.seen(b)
        try:
            maps[a, b] = method.map(source, fits[0], target, fits[1]).index
        except MeshmatchError:
            maps[a, b] = np.zeros(source.V, dtype=np.int64)
    return maps


def errors_at(truths: Truths, target: str, maps: Maps, inside: Sequence[Pair]) -> dict[Question, Errors]:
    """Errors of our maps to a target by the set's truth ("charged") and by the best that is known ("true"); on the pairs of
    shapes with the same triangles also what the set charges the map with that sends vertex i to vertex i ("perfect").
    """
    asked: dict[Question, tuple[Ints, Ints]] = {}
    for pair, index in maps.items():
        here, there, _ = truths.of_pair(pair)
        asked["charged", pair] = truths.landmarks(target), index[truths.landmarks(pair[0])]
        asked["true", pair] = there, index[here]
    for pair in inside:
        asked["perfect", pair] = truths.landmarks(target), truths.landmarks(pair[0])
    right, said = (np.concatenate([both[side] for both in asked.values()]) for side in (0, 1))
    far = truths.distances(target).between(right, said)  # all questions at once share their rows
    parts = np.split(far, np.cumsum([len(both[0]) for both in asked.values()])[:-1])
    return {question: Errors(part.astype(np.float32)) for question, part in zip(asked, parts, strict=True)}


def stretch(truths: Truths, pairs: Sequence[Pair]) -> dict[str, float]:
    """Mean |log| of the factor by which identity, and the set's truth, change distances of `STRETCHED_CM`."""
    low, high = (cm / CM_PER_UNIT for cm in STRETCHED_CM)
    names = list(dict.fromkeys(name for pair in pairs for name in pair))
    ids = {name: np.array(runner.spread(truths.landmarks(name).tolist(), _MARKS)) for name in names}
    rows = {  # all landmarks of the group at once on each shape
        name: truths.distances(name).among(np.concatenate(list(ids.values())), _FAR * high)
        for name in runner.track(names, "stretch")
    }
    size = len(ids[names[0]])
    part = {name: slice(k * size, (k + 1) * size) for k, name in enumerate(names)}
    found: list[list[float]] = [[], []]
    for a, b in pairs:
        before = rows[a][part[a], part[a]]
        near = (before > low) & (before < high)
        for truth, of in enumerate((a, b)):
            after = np.clip(rows[b][part[of], part[of]], low / _FAR, _FAR * high)  # landmarks may share a vertex
            found[truth].append(float(np.abs(np.log(after[near] / before[near])).mean()))
    return {"stretch_identity": float(np.mean(found[0])), "stretch_set": float(np.mean(found[1]))}


def group_row(truths: Truths, names: Sequence[str], found: Found, kept: Kept) -> dict[str, Any]:
    """What the two truths say on all ordered pairs of shapes with the same triangles."""
    pairs = list(permutations(names, 2))
    perfect = summary([found["perfect", pair] for pair in pairs])
    return {
        **{"names": ", ".join(names), "shapes": list(names), "pairs": len(pairs)},
        "alike": float(np.mean([truths.wound_alike(pair) for pair in pairs])),
        **{"perfect_cm": perfect["mean_cm"], "perfect_median_cm": perfect["median_cm"]},
        "perfect_worst_cm": max(found["perfect", pair].mean_cm for pair in pairs),
        "perfect_over_15cm": perfect["share_over_15cm"],
        **_both(found, pairs),
        **kept.once(f"stretch-{'-'.join(names)}", partial(stretch, truths, pairs)),
    }


def _both(found: Found, pairs: Sequence[Pair]) -> dict[str, float]:
    """Our errors by the set's truth, and by a better one."""
    theirs, better = (summary([found[kind, pair] for pair in pairs]) for kind in ("charged", "true"))
    return {
        **{"charged_cm": theirs["mean_cm"], "charged_median_cm": theirs["median_cm"]},
        **{"true_cm": better["mean_cm"], "true_median_cm": better["median_cm"]},
        "true_over_15cm": better["share_over_15cm"],
    }


def template_row(truths: Truths, name: str) -> dict[str, Any]:
    """How far the landmarks of the template's own shape are from the vertices of their number."""
    landmarks, numbers = truths.landmarks(name), truths.known(name)[0]
    errors = Errors(truths.distances(name).between(landmarks, numbers).astype(np.float32))
    return {
        **{"names": f"{name} (the template)", "shapes": [name], "pairs": 0},
        **{"perfect_cm": errors.mean_cm, "perfect_median_cm": errors.median_cm},
        "own_number": float((landmarks == numbers).mean()),
    }


def consensus_row(truths: Truths, name: str) -> dict[str, Any]:
    """Straight distances of a shape's landmarks from the consensus of the others of its group, cm."""
    shape = truths.bench.shape(name)
    off = shape.verts[truths.landmarks(name)] - consensus_points(truths, name)
    cm = np.linalg.norm(off, axis=1) / np.sqrt(shape.area) * CM_PER_UNIT
    return {"name": name, "rms_cm": float(np.sqrt((cm**2).mean())), "median_cm": float(np.median(cm))}


def parts_at(truths: Truths, name: str, fit: Any, template: Template | None) -> list[str]:
    """The part of the fitted template that each landmark of a shape is on, both sides together; none where that is not
    known.
    """
    if template is None or not isinstance(fit, Fit):
        return []
    names = np.array([each.removeprefix("left ").removeprefix("right ") for each in template.label_names])
    belongs = template_footpoints(shape_of(fit).shape, fit)[1]
    part = names[np.asarray(template.labels)[cKDTree(fit.resting).query(belongs)[1]]]
    whole = np.full(truths.bench.shape(name).V, "", dtype=part.dtype)
    whole[shape_of(fit).kept_vertex] = part
    return list(whole[truths.landmarks(name)].tolist())


def part_rows(errors: Mapping[Pair, Errors], known: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Where errors lie: by the part that a landmark of the source is on."""
    by_part, parts = defaultdict(list), {name: np.array(each) for name, each in known.items() if each}
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


def protocol_rows(truths: Truths, found: Found) -> list[dict[str, Any]]:
    """The set's own pairs, by how much is known of their truth, and all together."""
    kinds = defaultdict(list)
    for pair in truths.bench.pairs:
        kinds[str(truths.of_pair(pair)[2])].append(pair)
    kinds["all"] = list(truths.bench.pairs)
    return [{"kind": kind, "pairs": len(some), **_both(found, some)} for kind, some in kinds.items()]


def measured(
    truths: Truths, method: Method, template: Template | None, inside: Sequence[Pair], kept: Kept
) -> tuple[dict[Question, Errors], dict[str, list[str]]]:
    """All errors, and the parts at the landmarks of the shapes of ``inside``; one target's after the other's."""
    bench, pairs = truths.bench, list(dict.fromkeys([*truths.bench.pairs, *inside]))
    fit = cache(lambda name: method.fit(bench.seen(name)))

    def at(target: str) -> dict[str, Any]:
        maps = mapped(bench, method, fit, [pair for pair in pairs if pair[1] == target])
        mine = [pair for pair in inside if pair[1] == target]
        errors: dict[str, dict[str, list[float]]] = defaultdict(dict)
        for (kind, (source, _)), each in errors_at(truths, target, maps, mine).items():
            errors[kind][source] = each.values.tolist()
        return {"errors": errors, "parts": parts_at(truths, target, fit(target), template) if mine else []}

    found: dict[Question, Errors] = {}
    parts = {}
    for target in runner.track(list(dict.fromkeys(target for _, target in pairs)), "measuring"):
        record = kept.once(target, partial(at, target))
        parts[target] = record["parts"]
        for kind, by_source in record["errors"].items():
            found |= {(kind, (name, target)): Errors(np.array(each)) for name, each in by_source.items()}
    return found, parts


def measure(truths: Truths, method: Method, template: Template | None, kept: Kept) -> dict[str, list[dict[str, Any]]]:
    """All tables of a set, as rows.

    Raises
    ------
    InputError
        Nothing is known beyond the set's own truth.
    OptionError
        What is kept was measured with other choices.
    """
    bench = truths.bench
    if not truths.groups and not truths.templates:
        raise InputError(
            f"no two shapes of {bench.name} have the same triangles", "nothing better than its truth is known"
        )
    inside = [pair for group in truths.groups for pair in permutations(group, 2)]
    found, parts = measured(truths, method, template, inside, kept)
    rows = []
    for group in truths.groups:
        rows.append(group_row(truths, group, found, kept))
        for names in SAME_PERSON.get(bench.name, ()):
            if set(names) < set(group):
                rows.append(group_row(truths, names, found, kept))
    rows += [kept.once(f"template-{name}", partial(template_row, truths, name)) for name in truths.templates]
    large = [name for group in truths.groups if len(group) > 2 for name in group]
    return {
        "groups": rows,
        "consensus": [consensus_row(truths, name) for name in large],
        "parts": part_rows({pair: found["perfect", pair] for pair in inside}, parts),
        "protocol": protocol_rows(truths, found),
    }


@runner.command
def main(
    set: Annotated[str, Option(help="of the benchmark")] = "shrec19",
    data: runner.Data = runner.DATA,
    model: runner.Model = "human",
    refine: Refine = "nodes",
    seed: runner.Seed = 0,
    landmarks: Annotated[int | None, Option(min=2, help="of each shape, evenly spread; by default all")] = None,
    work: Annotated[Path, Option(help="where finished work is kept")] = Path("runs/truth"),
    threads: runner.Threads = 1,
) -> runner.Report:
    method, trained = OurMethod(model, refine, seed, threads=threads), as_model(model)
    asked = {"set": set, "model": trained.card.weights_sha256, "refine": refine, "seed": seed, "landmarks": landmarks}
    kept = Kept(work / (set if landmarks is None else f"{set}-{landmarks}"), asked, threads)
    found = measure(Truths(load_set(set, data), landmarks), method, trained.template, kept)
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
