"""Texture from one RGB-D cloud to another: the paper's section 6.1 and figure 13, on simulated clouds with a known answer.

Generated people in sampled poses and coloured clothes, none of whom a training of the released model drew, are seen by
one, two or four cameras (`experiments.makers.rgbd_clouds` says how), written as .pcd (the source) and .ply (the target), and
read again. The colours of the source go to the points of the target: to the same person in another pose, and to another
person.

- geometry: distance (cm) of the source point that each target point is matched to from the place on the source's true
  surface where the target point belongs; the points' own noise, about 1 cm, counts.
- colour: root of the mean squared error over points and channels, in bytes (0..255), against the colour of that place.

Both are means over pairs, with a 95 % bootstrap interval over pairs. Only points count whose place the source shows (a
point of it lies within 3 cm): elsewhere there is nothing to carry; ``colour, all`` counts every point of the body. Points
that fly, and points of no body, are in the clouds but have no answer.

- truth: the source point nearest to the right place: the least that is possible.
- ours: `meshmatch.transfer_colors`. coded: 3D-CODED (--coded, a folder of `experiments.paper.learned_baselines`), its code
  searched by the Chamfer distance, then the nearest point; --coded-by names a model that tells it the orientation. rigid:
  scaled by area, all orientations tried, nearest point.

Clouds, and the results of each pair and method, are kept in the output folder; the same command goes on from there.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.api.matching import Matcher
from meshmatch.api.transfer import transfer_colors
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench.methods import Coded, Registration
from meshmatch.experiments.makers.rgbd_clouds import Body, Camera, Cloud, draw_bodies, save_pcd, scan
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.models.registry import find_model
from meshmatch.outputs import make_folder
from meshmatch.shapes.files import load_shape, save_shape

NAMES = {"rigid": "rigid, nearest", "coded": "3D-CODED", "ours": "ours", "truth": "the true partner"}
TARGETS = ("same", "other")
_SHOWN = 0.03  # metres
_LOST_CM = 15.0
_DRAWS = 10_000
Carried = tuple[Float[Floats, "N 3"], Int[Ints, " N"]]
"""Colours of the target's points (sRGB, 0..1), and the source point that each is matched to."""
COLUMNS = {
    **{"views": "views:d", "target": "target", "method": "method", "pairs": "pairs:d"},
    **{"colour RMS": "color", "colour, all": "color_all_mean:.1f", "geometry cm": "cm", "median": "median_cm_mean:.1f"},
    **{f"over {_LOST_CM:g} cm": "lost_mean:.1%", "shown": "shown_mean:.0%", "s": "seconds_mean:.1f"},
}


@dataclass(frozen=True, eq=False)
class Case:
    """Two clouds with their files, and the source's body, whose triangles the target's body shares."""

    name: str
    source: Cloud
    target: Cloud
    body: Body
    source_file: Path
    target_file: Path

    @property
    def right(self) -> Float[Floats, "N 3"]:
        """Where the points of the target belong on the source's body; nothing of use for points of no body."""
        return self.target.on(self.body.faces, self.body.verts)

    def colored(self, index: Int[Ints, " N"]) -> Carried:
        """The target with the colours of these points of the source."""
        assert self.source.shape.colors is not None
        return self.source.shape.colors[index, :3], index


def by_rigid(case: Case, seed: int) -> Carried:
    """Rigid alignment without what repair takes for outliers, and the nearest point."""
    source, target = (validated(load_shape(file)) for file in (case.source_file, case.target_file))
    method = Registration("rigid", None, seed)
    found = method.map(target.shape, method.fit(target.shape), source.shape, method.fit(source.shape))
    return case.colored(source.kept_vertex[found.index[target.original_to_repaired]])


def by_coded(case: Case, method: Coded, fits: dict[Path, Fit]) -> Carried:
    """3D-CODED, from the target to the source; each cloud is fitted once."""
    for file in (case.source_file, case.target_file):
        if file not in fits:
            fits[file] = method.fit(load_shape(file))
    source, target = fits[case.source_file], fits[case.target_file]
    return case.colored(method.map(case.target.shape, target, case.source.shape, source).index)


def by_us(case: Case, matcher: Matcher) -> Carried:
    """The product's own call."""
    found = transfer_colors(case.source_file, case.target_file, matcher)
    return found.data[:, :3], found.maps.backward.index


def by_truth(case: Case) -> Carried:
    """The point of the source's body nearest to where each target point belongs."""
    real = np.flatnonzero(case.source.face >= 0)
    return case.colored(real[cKDTree(case.source.shape.verts[real]).query(case.right)[1]])


def measure(case: Case, carried: Carried) -> dict[str, float]:
    """Errors of one pair."""
    of_body = np.flatnonzero(case.target.face >= 0)
    right, verts = case.right[of_body], case.source.shape.verts
    goal = case.target.on(case.body.faces, case.body.colors)[of_body]
    shown = cKDTree(verts[case.source.face >= 0]).query(right)[0] < _SHOWN
    off = 255 * (carried[0][of_body] - goal)
    cm = 100 * np.linalg.norm(verts[carried[1][of_body]] - right, axis=1)
    return {
        "color": float(np.sqrt(np.square(off[shown]).mean())),
        "color_all": float(np.sqrt(np.square(off).mean())),
        **{"mean_cm": float(cm[shown].mean()), "median_cm": float(np.median(cm[shown]))},
        **{"lost": float((cm[shown] > _LOST_CM).mean()), "shown": float(shown.mean())},
    }


def interval(values: Sequence[float], seed: int = 0) -> tuple[float, float]:
    """95 % of the means of as many values drawn with replacement."""
    drawn = np.random.default_rng(seed).choice(np.asarray(values, float), (_DRAWS, len(values)))
    low, high = np.quantile(drawn.mean(1), [0.025, 0.975])
    return float(low), float(high)


def summed(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over pairs, and intervals in words and numbers."""
    row: dict[str, Any] = {"pairs": len(results)}
    for key in ("color", "color_all", "mean_cm", "median_cm", "lost", "shown", "seconds"):
        row[f"{key}_mean"] = float(np.mean([each[key] for each in results]))
    for key, words in (("color", "color"), ("mean_cm", "cm")):
        low, high = row[f"{key}_interval"] = interval([each[key] for each in results])
        row[words] = f"{row[f'{key}_mean']:.1f} ({low:.1f} to {high:.1f})"
    return row


def cases_of(folder: Path, bodies: tuple[Body, Body, Body], number: int, views: int, seed: int) -> list[Case]:
    """Both pairs of a person; clouds are written where they are not."""
    clouds, files = [], []
    for place, (body, role) in enumerate(zip(bodies, ("source", *TARGETS), strict=True)):
        cloud = scan(body, views, 1000 * seed + 100 * number + 10 * views + place)
        file = folder / f"{number}-{role}-{views}{'.ply' if place else '.pcd'}"
        if not file.is_file():
            (save_shape if place else save_pcd)(file, cloud.shape)
        clouds.append(cloud)
        files.append(file)
    source, *targets = zip(clouds, files, strict=True)
    return [Case(file.stem, source[0], cloud, bodies[0], source[1], file) for cloud, file in targets]


@runner.command
def main(
    output: Annotated[Path, Option("-o", "--output", help="folder of clouds and results")] = Path("out/rgbd"),
    pairs: Annotated[int, Option(min=1, help="people, each with two targets")] = 6,
    views: Annotated[str, Option(help="how many cameras: numbers with commas")] = "1,2,4",
    methods: Annotated[str, Option(help=f"of {', '.join(NAMES)}")] = ",".join(NAMES),
    coded: Annotated[str | None, Option(help="a model folder of experiments.paper.learned_baselines")] = None,
    coded_steps: Annotated[int, Option(min=1, help="of its search over codes")] = 200,
    coded_by: Annotated[str, Option(help="a model that finds the orientation for it; none by default")] = "",
    model: runner.Model = "human",
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    asked, notes = runner.names_of(methods, NAMES, "method"), []
    numbers = [str(k) for k in range(1, 13)]
    counts = [int(each) for each in runner.names_of(views, numbers, "number of views")]
    ways: dict[str, Callable[[Case], Carried]] = {
        **{"truth": by_truth, "rigid": partial(by_rigid, seed=seed)},
        "ours": partial(by_us, matcher=Matcher(model, FitConfig(seed=seed), threads)),
    }
    settings: dict[str, Any] = {"ours": find_model(model)[1].weights_sha256}
    if coded is not None:
        ways["coded"] = partial(by_coded, method=Coded(coded, coded_steps, seed, coded_by), fits={})
        settings["coded"] = [find_model(coded)[1].weights_sha256, coded_steps, coded_by]
    elif "coded" in asked:
        asked.remove("coded")
        notes.append("3D-CODED is left out: give --coded MODEL, made by experiments.paper.learned_baselines coded")
    make_folder(output)
    bodies = draw_bodies(pairs, seed)

    def answer(case: Case, method: str) -> dict[str, Any]:
        runner.tell(f"{case.name}: {NAMES[method]}")
        began = time.perf_counter()
        carried = ways[method](case)
        seconds = round(time.perf_counter() - began, 2)
        np.save(output / f"{case.name}-{method}.npy", np.rint(255 * carried[0]).astype(np.uint8))
        return {**measure(case, carried), "seconds": seconds, **runner.circumstances(threads)}

    found: dict[tuple[int, str, str], list[dict[str, Any]]] = {}
    for count, number in product(counts, range(pairs)):
        cases = cases_of(output, bodies[number], number, count, seed)
        for (target, case), method in product(zip(TARGETS, cases, strict=True), asked):
            key = {"camera": vars(Camera()), "seed": seed, "people": pairs, "settings": settings.get(method)}
            file = output / f"{case.name}-{method}.json"
            result = runner.once(file, key, partial(answer, case, method))
            found.setdefault((count, target, method), []).append(result)
    order = sorted(found, key=lambda key: (key[0], TARGETS.index(key[1]), asked.index(key[2])))
    rows = [
        {"views": count, "target": target, "method": NAMES[method], **summed(found[count, target, method])}
        for count, target, method in order
    ]
    title = "Colours from cloud to cloud, in bytes; 95 % intervals over pairs"
    return runner.Report({"rows": rows}, [runner.table(title, rows, COLUMNS)], notes)


if __name__ == "__main__":
    sys.exit(main())
