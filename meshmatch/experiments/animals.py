"""Four-legged animals through a template of one of them.

The benchmark's animals (cats, dogs, cows, hippos, horses) stand in different poses and are turned every way. One is the
template; a model is trained on all of them without correspondence, or, with --points N, with N known points on each.
Then every ordered pair is matched (or some, evenly spread: --limit-shapes, --limit-pairs), and every landmark counts. The
error is the Euclidean distance on the target between the matched and the true point, in units of sqrt(area), times 100.
Beside it: rigid alignment and the nearest vertex. Animals are trained and measured on the same shapes: a registration of
a collection.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.arrays import Ints
from meshmatch.errors import InputError
from meshmatch.experiments import category, runner
from meshmatch.experiments.category import Maps, Shapes
from meshmatch.experiments.sets import load_folder
from meshmatch.outputs import make_folder
from meshmatch.shapes.sampling import farthest_points
from meshmatch.templates.make import NodeConfig

TRUTH = ".landmarks.npy"
RIGHT = 0.15
"""In units of sqrt(area): further off is another limb."""
_KINDS = {
    "dog": ("dog", "wolf", "fox", "inuit"),
    "cat": ("lion", "cougar", "tiger"),
    "cow": ("cow",),
    "hippo": ("hippo",),
}


def kind_of(name: str) -> str:
    """What kind of animal a file's name says it is; "other" where it says nothing."""
    words = name.lower()
    return next((kind for kind, signs in _KINDS.items() if any(sign in words for sign in signs)), "other")


def animal_errors(shapes: Shapes, truth: Mapping[str, Ints], maps: Maps) -> dict[str, Any]:
    """Errors at all landmarks: over pairs, the share further off than `RIGHT`, and by kinds."""
    means, lost = [], []
    kinds: dict[str, list[float]] = defaultdict(list)
    for (source, target), found in maps.items():
        shape = shapes[target]
        off = shape.verts[found.index[truth[source]]] - shape.verts[truth[target]]
        error = np.linalg.norm(off, axis=1) / np.sqrt(shape.area)
        means.append(100 * float(error.mean()))
        lost.append(float((error > RIGHT).mean()))
        same = kind_of(source) == kind_of(target) != "other"
        kinds[f"{kind_of(source)} to {kind_of(target)}" if same else "across"].append(means[-1])
    return {
        "pairs": len(means),
        "mean_x100": round(float(np.mean(means)), 4),
        "median_pair_x100": round(float(np.median(means)), 4),
        "lost": round(float(np.mean(lost)), 4),
        **{name: round(float(np.mean(values)), 4) for name, values in sorted(kinds.items())},
    }


def save_known_points(folder: Path, truth: Mapping[str, Ints], shapes: Shapes, template: str, count: int) -> None:
    """The same ``count`` landmarks of every animal, far apart on the template, as files for `prepare`."""
    make_folder(folder)
    at = farthest_points(shapes[template].verts[truth[template]], count)
    for name, ids in truth.items():
        np.save(folder / f"{name}.npy", ids[at].astype(np.int64))


@runner.command
def main(
    data: runner.Data = runner.DATA,
    template: Annotated[str, Option(help="which animal")] = "dog_alph",
    points: Annotated[int, Option(min=0, help="known points on each animal")] = 0,
    limit_pairs: runner.LimitPairs = None,
    limit_shapes: Annotated[int | None, Option(min=2, help="N of the animals are measured")] = None,
    minutes: category.Minutes = 15,
    steps: category.Steps = 2000,
    nodes: category.Nodes = 320,
    radius: category.Radius = 0.13,
    work: category.Work = None,
    threads: runner.Threads = 2,
    seed: runner.Seed = 0,
) -> runner.Report:
    shapes, truth = load_folder(data / "animal", TRUTH)
    if template not in shapes:
        raise InputError(f"there is no animal '{template}'", f"choose from {', '.join(shapes)}")
    names = list(shapes)
    count = limit_shapes or len(names)
    measured = {names[k]: shapes[names[k]] for k in np.linspace(0, len(names) - 1, count).astype(int)}
    pairs = category.ordered_pairs(measured, limit_pairs)
    errors = partial(animal_errors, shapes, truth)
    rows = [{"method": category.RIGID, **errors(category.nearest_maps(measured, "rigid", "area", pairs))}]
    how = {"minutes": minutes, "steps": steps, "threads": threads, "seed": seed}
    with category.training_in(work, nodes=nodes, radius=radius, **how) as training:
        landmarks = training.work / "points" if points else None
        if landmarks is not None:
            save_known_points(landmarks, truth, shapes, template, points)
        config = NodeConfig("geodesic", nodes, radius, 0.03, seed=seed)
        model, went = category.trained(
            data / "animal", training, config, how="rigid", scale="area", template=template, landmarks=landmarks
        )
        rows += category.compared(model, measured, category.network_and_nodes(seed), pairs, errors)[0]
    columns = {"method": "method", "pairs": "pairs:d", "mean": "mean_x100:.1f"}
    columns |= {"median pair": "median_pair_x100:.1f", "lost": "lost:.0%"}
    columns |= {kind: f"{kind}:.1f" for kind in rows[0] if kind == "across" or " to " in kind}
    title = "Animals: Euclidean error x 100 / sqrt(area)"
    return runner.Report({"training": went, "rows": rows}, [runner.table(title, rows, columns)])


if __name__ == "__main__":
    sys.exit(main())
