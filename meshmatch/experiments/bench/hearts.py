"""Ten hearts.

The four-chamber hearts of the benchmark were decimated independently. Models are trained on them as anybody would train
one on a folder (`meshmatch prepare`, `meshmatch train`), and then all ordered pairs are matched. Where two hearts kept a
vertex of the same original mesh the truth is known exactly; only these vertices count, about a fifth of each. The error
is the Euclidean distance on the target between the matched and the true vertex (walls are thin, and the surface's own
distance between two points of a wall may be long), in units of sqrt(area), times 100; beside it the share of points in
the right chamber.

- registered: six hearts get the vertices and triangles of one of them, through the vertices that the truth knows, and
  are learned as registered meshes. The other four (--unseen), the last by name, are seen by no training; pairs of these
  alone have a column of their own. Here training has seen the truth of six. --measure unseen fits and matches these four
  alone, which is quicker.
- unregistered: all ten as they are, without correspondence. Trained and measured on the same ten: a registration of a
  collection, not a test of what a model knows of hearts it never saw. It has seen no truth.

Beside them: rigid alignment and the nearest vertex. Collections without a model are `experiments.bench.collections`.
"""

from __future__ import annotations

import sys
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.interpolate import RBFInterpolator
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments import runner
from meshmatch.experiments.bench import category
from meshmatch.experiments.bench.category import Maps, Shapes
from meshmatch.experiments.bench.sets import load_folder
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.footpoints import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import make_folder
from meshmatch.render.picture import Look
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import medoid

TRUTH = ".truth.npy"
WAYS = ("unregistered", "registered")
_NEAR = 40  # known vertices that say where another one goes
Truth = Mapping[str, Int[Ints, "V 2"]]
"""For each shape and vertex: the vertex of the original mesh, and the chamber."""


def heart_errors(shapes: Shapes, truth: Truth, maps: Maps, unseen: Collection[str] = ()) -> dict[str, Any]:
    """Errors at the vertices whose partner is known: over pairs, and the share of right chambers.

    ``unseen_x100`` is the mean over pairs of ``unseen`` shapes alone, None without such pairs; ``across_x100`` the part
    of the errors along the target's normals: the rest is sliding along the surface.
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
    strange = [mean for pair, mean in means.items() if set(pair) <= set(unseen)]
    return {
        **{"pairs": len(means), "mean_x100": round(float(np.mean(list(means.values()))), 4)},
        **{"worst_pair_x100": round(means[worst], 4), "worst_pair": list(worst)},
        "across_x100": round(float(np.mean(across)), 4),
        "right_chamber": round(float(np.mean(chambers)), 4),
        "unseen_pairs": len(strange),
        "unseen_x100": round(float(np.mean(strange)), 4) if strange else None,
    }


def registered(
    template: Shape, ids: Int[Ints, " V"], target: Shape, target_ids: Int[Ints, " V_tgt"]
) -> Float[Floats, "V 3"]:
    """Where the vertices of one heart lie on another, by the vertices of the original mesh (ids) that both kept.

    Between these the displacement is a thin plate spline's, and then the nearest place of the target's surface that
    faces the same way is taken.
    """
    _, ours, theirs = np.intersect1d(ids, target_ids, return_indices=True)
    small, large = float(np.sqrt(template.area)), float(np.sqrt(target.area))
    verts, there = template.verts / small, target.verts / large
    spline = RBFInterpolator(verts[ours], there[theirs] - verts[ours], neighbors=min(_NEAR, len(ours)))
    moved = verts + spline(verts)
    surface = Surface(there, target.faces, vertex_normals(there, target.faces))
    foot = surface.query(moved, vertex_normals(moved, template.faces))
    return np.asarray(large * foot.values(target.faces, there))


def save_registered(folder: Path, shapes: Shapes, truth: Truth, template: str, names: Sequence[str]) -> None:
    """Some hearts as meshes with the vertices and triangles of one of them, a file for each."""
    make_folder(folder)
    first, ids = shapes[template], truth[template][:, 0]
    for name in names:
        verts = first.verts if name == template else registered(first, ids, shapes[name], truth[name][:, 0])
        save_shape(folder / f"{name}.ply", Shape(verts, first.faces, name))


@runner.command
def main(
    data: runner.Data = runner.DATA,
    ways: Annotated[str, Option(help=f"of {', '.join(WAYS)}")] = ",".join(WAYS),
    unseen: Annotated[int, Option(min=0, help="hearts kept from `registered`")] = 4,
    measure: Annotated[Literal["all", "unseen"], Option(help="which hearts are fitted")] = "all",
    stiffness: Annotated[float, Option(min=1e-9, help="as in meshmatch train")] = 0.05,
    picture: Annotated[Path | None, Option(help="draw one heart's chambers on the others")] = None,
    minutes: category.Minutes = 25,
    steps: category.Steps = 3000,
    nodes: category.Nodes = 600,
    radius: category.Radius = 0.1,
    work: category.Work = None,
    threads: runner.Threads = 2,
    seed: runner.Seed = 0,
) -> runner.Report:
    asked = runner.names_of(ways, WAYS, "way")
    folder = data / "heart"
    shapes, truth = load_folder(folder, TRUTH)
    template = list(shapes)[medoid([validated(shape) for shape in shapes.values()], "near", "area", seed)]
    others = [name for name in shapes if name != template]
    strange = others[len(others) - unseen :]
    measured = {name: shapes[name] for name in (strange if measure == "unseen" else shapes)}
    pairs = category.ordered_pairs(measured)
    errors = partial(heart_errors, shapes, truth, unseen=strange)
    # walls that touch move together; less than the radius that suits a body
    config = NodeConfig("uniform", nodes, radius, 0.01, seed=seed)
    rigid = category.nearest_maps(measured, "near", "area", pairs)
    rows = [{"method": category.RIGID, **errors(rigid)}]
    went, notes = {}, list[str]()
    maps: Maps = {}
    how = {"minutes": minutes, "steps": steps, "threads": threads, "seed": seed}
    with category.training_in(work, nodes=nodes, radius=radius, **how) as training:
        for way in asked:
            here = training.inside(way)
            source = folder
            if way == "registered":
                source = here.work / "shapes"
                save_registered(source, shapes, truth, template, [n for n in shapes if n not in strange])
            model, went[way] = category.trained(
                source, here, config, how="near", scale="area", template=template, stiffness=stiffness
            )
            found, maps = category.compared(
                model, measured, category.network_and_nodes(seed, f"{way}, "), pairs, errors
            )
            rows += found
    columns = {"method": "method", "pairs": "pairs:d", "mean": "mean_x100:.2f"}
    columns |= {"worst pair": "worst_pair_x100:.2f", "right chamber": "right_chamber:.1%"}
    columns |= {f"pairs of {len(strange)} unseen": "unseen_x100:.2f"}
    if picture is not None and maps:
        first, *rest = measured
        sure = {n: VertexMap.between(shapes[n], shapes[first], maps[n, first].index) for n in rest[:5]}
        category.carried_picture(picture, Look(up="z", front="-y"), shapes, truth[first][:, 1], sure, first)
        notes.append(f"wrote {picture}")
    record = {"template": template, "unseen": strange, "training": went, "rows": rows}
    return runner.Report(record, [runner.table("Hearts: Euclidean error x 100 / sqrt(area)", rows, columns)], notes)


if __name__ == "__main__":
    sys.exit(main())
