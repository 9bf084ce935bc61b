"""The standard test splits of remeshed people and animals, as reported by most papers; the data must be obtained.

Folders have the usual layout, ``FAUST_r/off/*.off`` and ``FAUST_r/corres/*.vts``: line k of a shape's list is the vertex,
counted from 1, of point k, which all shapes of the set share.

- FAUST_r: the last 20 shapes (tr_reg_080 to 099); SCAPE_r: the last 20 (mesh052 to 071).
- SHREC19_r: the pairs of ``corres/I_J.map`` without shape 40, which is partial: from J to I, as usual; line k is the vertex
  of J for vertex k of I.
- SMAL_r: the shapes listed in ``test_cat.txt``.
- TOPKIDS: every shape to the first, kid00; line k of ``corres/NAME_ref.vts`` is the vertex of kid00 for vertex k.
- iso, qes, mc, dense, cloud: the last 20 shapes of FAUST, remeshed or sampled in five ways to measure the effect of
  discretization (Sharp et al. 2021), each to FAUST's first, ``discretization/tr_reg_000.ply``; line k of
  ``discretization/iso/tr_reg_iso_080.txt`` is its vertex, counted from 0, for vertex k of the ply of the same name.

In the other sets all ordered pairs of different shapes count. The error is the geodesic distance on the target between the
matched and the true vertex, in units of sqrt(area), times 100: the mean over points, then over pairs. Confidence intervals
are 95 %, by bootstrap over shapes. No shape of these sets was used to train the models that are shipped.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.matcher import Matcher
from meshmatch.arrays import Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.pairs import match_by_fits, match_directly
from meshmatch.experiments.bench.scores import TruthDistances
from meshmatch.experiments.bench.sets import Pair, Shapes
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.models.registry import NO_MODEL
from meshmatch.shapes.files import load_shape

REMESHED = ("iso", "qes", "mc", "dense", "cloud")
MODELS = {"FAUST_r": "human", "SCAPE_r": "human", "SHREC19_r": "human", "SMAL_r": "quadruped", "TOPKIDS": "human"}
MODELS |= dict.fromkeys(REMESHED, "human")
_REFERENCES = {"TOPKIDS": "kid00"} | dict.fromkeys(REMESHED, "tr_reg_000")
_TEST = {"FAUST_r": range(80, 100), "SCAPE_r": range(52, 72)}  # numbers of the shapes
_PARTIAL_SHAPE, _TEST_LIST, _REMESHED = "40", "test_cat.txt", "discretization"
_N_RESAMPLES = 2000
_COLUMNS = {
    "set": "set",
    "model": "model",
    "shapes": "shapes:d",
    "pairs": "pairs:d",
    "mean": "mean:.2f",
    "95 %": "interval",
}
_COLUMNS |= {
    "median pair": "median:.2f",
    "worst": "worst:.1f",
    "over 10": "off:.1%",
    "CPU s a pair": "cpu:.2f",
    "minutes": "minutes:.1f",
}


@dataclass(frozen=True, eq=False)
class Split:
    """Shapes, pairs and ground truth of a split.

    Parameters
    ----------
    shapes, pairs : shapes by name, and ordered pairs of names
    points : for each shape, the vertices (N,) of corresponding points; with a reference, the reference's vertex for each
        vertex
    reference : the shape that is the target of all pairs; empty if there is none
    partners : for each pair, the source's vertex (V,) for each vertex of the target; empty if ``points`` is the truth
    """

    shapes: Shapes
    pairs: Sequence[Pair]
    points: Mapping[str, Int[Ints, " N"]]
    reference: str = ""
    partners: Mapping[Pair, Int[Ints, " V"]] = field(default_factory=dict)

    def source_points(self, pair: Pair) -> Int[Ints, " N"]:
        """Return the source's vertices whose true partners are ``target_points(target)``, in the same order."""
        return self.partners[pair] if self.partners else self.points[pair[0]]

    def target_points(self, target: str) -> Int[Ints, " N"]:
        """Return the vertices of a target that are true partners."""
        everywhere = self.partners or target == self.reference
        return np.arange(self.shapes[target].V) if everywhere else self.points[target]


def split_of(name: str, data: Path) -> Split:
    """Load a published split.

    Raises
    ------
    InputError
        The folder or a list is missing, or a list does not match its shape.
    """
    reference = _REFERENCES.get(name, "")
    if name in REMESHED:
        folder = data / _REMESHED
        files = {path.stem: path for path in runner.files_in(folder / name, "*.ply")} | {
            reference: folder / f"{reference}.ply"
        }
        lists = {each: (folder / name / f"{each}.txt", 0) for each in files}
        names = list(files)
    else:
        folder = data / name
        files = {path.stem: path for path in sorted(runner.files_in(folder / "off", "*.off"), key=_number)}
        names = _names_in_split(name, folder, list(files))
        lists = {each: (folder / "corres" / f"{each}{'_ref' if reference else ''}.vts", 1) for each in names}
    if missing := [each for each in names if each not in files]:
        raise InputError(f"{folder / 'off'} has no {missing[0]}.off")
    shapes = {each: load_shape(files[each]) for each in names}
    if name == "SHREC19_r":
        return _load_pair_maps(shapes, folder / "corres")
    points = {}
    for each in names:
        if each == reference:
            continue
        points[each] = vertices_in(*lists[each])
        within = shapes[reference or each].V
        if points[each].min() < 0 or points[each].max() >= within:
            raise InputError(f"{lists[each][0].parent}: the list of {each} names vertices that are not there")
        if reference and len(points[each]) != shapes[each].V:
            raise InputError(f"{lists[each][0].parent}: the list of {each} has not one line for each of its vertices")
    if reference:
        return Split(shapes, [(each, reference) for each in points], points, reference)
    if len({len(each) for each in points.values()}) > 1:
        raise InputError(f"{folder / 'corres'}: the lists are of different length")
    return Split(shapes, list(permutations(names, 2)), points)


def _load_pair_maps(shapes: Shapes, folder: Path) -> Split:
    """Load the pairs of a folder's files ``I_J.map``, from J to I, without the partial shape."""
    partners: dict[Pair, Int[Ints, " V"]] = {}
    for path in runner.files_in(folder, "*.map"):
        target, _, source = path.stem.partition("_")
        if _PARTIAL_SHAPE in (source, target):
            continue
        if missing := [each for each in (source, target) if each not in shapes]:
            raise InputError(f"{path.name} is of a shape that is not there: {missing[0] or 'its name is no pair'}")
        found = partners[source, target] = vertices_in(path, 1)
        if len(found) != shapes[target].V or found.min() < 0 or found.max() >= shapes[source].V:
            problem = f"{path} does not list a vertex of {source} for each of {target}"
            raise InputError(problem, "counted from 1, one a line")
    return Split(shapes, list(partners), {}, partners=partners)


def _number(path: Path) -> tuple[int, str]:
    """Sort key: the digits of a file's name as a number, then the name."""
    digits = "".join(letter for letter in path.stem if letter.isdigit())
    return int(digits or 0), path.stem


def _names_in_split(name: str, folder: Path, names: list[str]) -> list[str]:
    if name in _TEST:
        return names[-len(_TEST[name]) :]
    if name == "SHREC19_r":
        return [each for each in names if each != _PARTIAL_SHAPE]
    if name == "TOPKIDS":
        return [_REFERENCES[name], *(each for each in names if each != _REFERENCES[name])]
    try:
        return (folder / _TEST_LIST).read_text("utf-8").split()
    except OSError as error:
        raise InputError(
            f"{folder} has no {_TEST_LIST}", "it names the shapes of the test split, one a line"
        ) from error


def not_published(name: str, shapes: Sequence[str]) -> str:
    """Return a warning if these are not the published test shapes of a set; empty if they are."""
    numbers = _TEST.get(name, ())
    if not numbers or [_number(Path(each))[0] for each in shapes] == list(numbers):
        return ""
    these = f"these {len(shapes)}: {shapes[0]} to {shapes[-1]}"
    return f"the published split of {name} is {numbers[0]:03d} to {numbers[-1]:03d}, not {these}"


def vertices_in(path: Path, first: int) -> Int[Ints, " N"]:
    """Read vertex ids, one per line, counted from ``first`` in the file; return them counted from 0."""
    try:
        found = np.loadtxt(path, ndmin=1)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}", f"it lists vertices, counted from {first}, one a line") from error
    if found.ndim != 1 or not len(found) or (found != found.astype(np.int64)).any():
        raise InputError(f"{path} is no list of vertices", f"it lists vertices, counted from {first}, one a line")
    return found.astype(np.int64) - first


def errors_of(split: Split, indices: Mapping[Pair, Int[Ints, " V"]], cache: Path | None) -> dict[Pair, Floats]:
    """Compute errors at all points of every pair, in units of sqrt(area), times 100."""
    found: dict[Pair, Floats] = {}
    for target in runner.track(sorted({pair[1] for pair in indices}), "measuring"):
        mine = [pair for pair in indices if pair[1] == target]
        distances = TruthDistances(split.shapes[target], split.target_points(target), cache)
        if target != split.reference:
            at = distances.errors([indices[pair][split.source_points(pair)] for pair in mine])
            found |= {pair: 100 * each.astype(np.float64) for pair, each in zip(mine, at, strict=True)}
            continue
        for pair in mine:
            asked = np.unique(split.points[pair[0]])
            rows = distances.of(asked)[np.searchsorted(asked, split.points[pair[0]]), indices[pair]]
            found[pair] = 100 * rows.astype(np.float64)
    return found


def interval_over_shapes(means: Mapping[Pair, float], seed: int = 0) -> tuple[float, float]:
    """Compute the 95 % bootstrap interval, over shapes, of the mean over pairs."""
    names = sorted({name for pair in means for name in pair})
    a, b = np.array([[names.index(name) for name in pair] for pair in means]).T
    values = np.array(list(means.values()))
    rng, drawn = np.random.default_rng(seed), []
    for _ in range(_N_RESAMPLES):
        times = np.bincount(rng.integers(len(names), size=len(names)), minlength=len(names))
        # A target common to all pairs, such as a reference, is not resampled.
        weight = times[a] * np.where(len(set(b)) == 1, 1, times[b])
        if weight.sum():
            drawn.append(float(weight @ values / weight.sum()))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def row_of(name: str, model: str, split: Split, errors: Mapping[Pair, Floats], cpu: float) -> dict[str, Any]:
    """Compute the table row of a set."""
    means = {pair: float(each.mean()) for pair, each in errors.items()}
    values, (low, high) = np.array(list(means.values())), interval_over_shapes(means)
    row = {"set": name, "model": model, "shapes": len({each for pair in means for each in pair}), "pairs": len(means)}
    row |= {"mean": float(values.mean()), "low": low, "high": high, "interval": f"{low:.2f} to {high:.2f}"}
    row |= {"median": float(np.median(values)), "worst": float(values.max()), "cpu": cpu}
    return row | {"off": float(np.mean([(each > 10).mean() for each in errors.values()]))}


@runner.command
def main(
    data: Annotated[Path, Option(help="folder that contains the sets' folders")],
    sets: Annotated[str, Option(help=f"of {', '.join(MODELS)}; default: those in the folder")] = "",
    model: Annotated[str | None, Option(help="default: human, or quadruped; or none")] = None,
    limit_pairs: runner.LimitPairs = None,
    cache: runner.Cache = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    there = [name for name in MODELS if (data / (f"{_REMESHED}/{name}" if name in REMESHED else name)).is_dir()]
    names = runner.split_names(sets, MODELS, "set") or there
    if not names:
        raise InputError(f"{data} has none of {', '.join(MODELS)}", "docs/datasets.md says how they are laid out")
    rows = []
    for name in names:
        began = time.perf_counter()
        split, chosen = split_of(name, data), model or MODELS[name]
        if words := not_published(name, list(split.shapes)):
            runner.log(f"warning: {words}")
        pairs = runner.evenly_spread(list(split.pairs), limit_pairs)
        runner.log(f"{name}: {len(split.shapes)} shapes, {len(pairs)} pairs")
        matcher = Matcher(chosen, FitConfig(seed=seed), threads)
        if chosen == NO_MODEL:
            found = match_directly(matcher, split.shapes, pairs, name)
        else:
            used = {each for pair in pairs for each in pair}
            found = match_by_fits(
                matcher, {each: split.shapes[each] for each in split.shapes if each in used}, pairs, name
            )[1]
        errors = errors_of(split, {pair: each.map.index for pair, each in found.items()}, cache)
        cpu = float(np.mean([each.seconds for each in found.values()]))
        rows.append(row_of(name, chosen, split, errors, cpu) | {"minutes": (time.perf_counter() - began) / 60})
    return runner.Report({"rows": rows}, [runner.table("Standard splits, error x 100 / sqrt(area)", rows, _COLUMNS)])
