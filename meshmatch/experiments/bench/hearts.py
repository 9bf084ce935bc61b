"""Ten hearts.

The four-chamber hearts of the benchmark were decimated independently. A model is trained on them as anybody would train
one on a folder (`meshmatch prepare`, `meshmatch train`), and then all ordered pairs are matched. Where two hearts kept a
vertex of the same original mesh the truth is known exactly; only these vertices count, about a fifth of each. The error
is the Euclidean distance on the target between the matched and the true vertex (walls are thin, and the surface's own
distance between two points of a wall may be long), in units of sqrt(area), times 100; beside it the share of points in
the right chamber.

All ten are learned as they are, without correspondence: a registration of a collection, not a test of what a model knows
of hearts it never saw.

Beside them: rigid alignment and the nearest vertex. Collections without a model are `experiments.bench.collections`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.arrays import Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench import category
from meshmatch.experiments.bench.category import Maps, Shapes
from meshmatch.experiments.bench.sets import load_folder
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.picture import Look
from meshmatch.templates.make import NodeConfig

TRUTH = ".truth.npy"
Truth = Mapping[str, Int[Ints, "V 2"]]
"""For each shape and vertex: the vertex of the original mesh, and the chamber."""


def heart_errors(shapes: Shapes, truth: Truth, maps: Maps) -> dict[str, Any]:
    """Errors at the vertices whose partner is known: over pairs, and the share of right chambers.

    ``across_x100`` is the part of the errors along the target's normals: the rest is sliding along the surface.
    """
    means, chambers, across = {}, [], []
    for (source, target), found in maps.items():
        _, ours, theirs = np.intersect1d(truth[source][:, 0], truth[target][:, 0], return_indices=True)
        got, shape = found.index[ours], shapes[target]
        off = 100 * (shape.verts[got] - shape.verts[theirs]) / np.sqrt(shape.area)
        means[source, target] = float(np.linalg.norm(off, axis=1).mean())
        across.append(float(np.abs((off * shape.vertex_normals[theirs]).sum(1)).mean()))
        chambers.append(float((truth[target][got, 1] == truth[source][ours, 1]).mean()))
    worst = max(means, key=lambda pair: means[pair])
    return {
        **{"pairs": len(means), "mean_x100": round(float(np.mean(list(means.values()))), 4)},
        **{"worst_pair_x100": round(means[worst], 4), "worst_pair": list(worst)},
        "across_x100": round(float(np.mean(across)), 4),
        "right_chamber": round(float(np.mean(chambers)), 4),
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    stiffness: Annotated[float, Option(min=1e-9, help="as in meshmatch train")] = 0.05,
    picture: Annotated[Path | None, Option(help="draw one heart's chambers on the others")] = None,
    minutes: category.Minutes = 25,
    steps: category.Steps = 3000,
    work: category.Work = None,
    threads: runner.Threads = 2,
    seed: runner.Seed = 0,
) -> runner.Report:
    folder = data / "heart"
    shapes, truth = load_folder(folder, TRUTH)
    pairs = category.ordered_pairs(shapes)
    errors = partial(heart_errors, shapes, truth)
    # walls that touch move together; less than the radius that suits a body
    config = NodeConfig("uniform", 600, 0.1, 0.01, seed=seed)
    rows = [{"method": category.RIGID, **errors(category.nearest_maps(shapes, "near", "area", pairs))}]
    with category.training_in(work, minutes=minutes, steps=steps, threads=threads, seed=seed) as training:
        model, went = category.trained(folder, training, config, how="near", scale="area", stiffness=stiffness)
        found, maps = category.compared(model, shapes, category.network_and_nodes(seed), pairs, errors)
        rows += found
    columns = {"method": "method", "pairs": "pairs:d", "mean": "mean_x100:.2f"}
    columns |= {"worst pair": "worst_pair_x100:.2f", "right chamber": "right_chamber:.1%"}
    if picture is not None:
        first, *rest = shapes
        sure = {n: VertexMap.between(shapes[n], shapes[first], maps[n, first].index) for n in rest[:5]}
        category.carried_picture(picture, Look(up="z", front="-y"), shapes, truth[first][:, 1], sure, first)
    record = {"training": went, "rows": rows}
    return runner.Report(record, [runner.table("Hearts: Euclidean error x 100 / sqrt(area)", rows, columns)])


if __name__ == "__main__":
    sys.exit(main())
