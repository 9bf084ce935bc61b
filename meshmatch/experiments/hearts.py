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
- collection: the same ten without any training: each is the template once, fitted to the others by node vectors, and
  of the maps through all of them the median counts (`experiments.collection`). It has seen no truth.
- meshmonk (Apache-2.0, pip install meshmonk): its viscoelastic registration of the same template, from the same
  alignment, with its defaults; zoomout: pyfmaps' ZoomOut (pip install 'meshmatch[bench]'), from
  descriptors alone, and from the nearest vertices of the rigid alignment; coded: 3D-CODED, a network at
  every point that learns the same ten by the Chamfer distance, and a search over its codes. Beside them all: rigid
  alignment and the nearest vertex.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.experiments import category, runner
from meshmatch.experiments.category import Maps, Shapes
from meshmatch.experiments.classical_baselines import ZoomOut, viscoelastic
from meshmatch.experiments.collection import collection_maps
from meshmatch.experiments.sets import Pair, load_folder
from meshmatch.fitting.fit_config import FitConfig, LatentRefineConfig
from meshmatch.fitting.viscous import ViscousConfig
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.footpoints import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.outputs import make_folder
from meshmatch.render.picture import Look
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepare import PrepareConfig, prepare
from meshmatch.templates.prepared_folder import medoid
from meshmatch.templates.template import Template

TRUTH = ".truth.npy"
WAYS = ("zoomout", "coded", "meshmonk", "unregistered", "collection", "registered")
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


def through(places: Mapping[str, Float[Floats, "V 3"]], shapes: Shapes) -> dict[Pair, VertexMap]:
    """Maps through registered vertices: nearest of the source's, the same one on the target, nearest target vertex."""
    to = {name: cKDTree(places[name]).query(shape.verts)[1] for name, shape in shapes.items()}
    back = {name: cKDTree(shape.verts).query(places[name])[1] for name, shape in shapes.items()}
    return {(a, b): VertexMap.between(shapes[a], shapes[b], back[b][to[a]]) for a, b in category.ordered_pairs(shapes)}


def meshmonk_places(
    template: Template, shapes: Shapes, frames: Mapping[str, Frame], kept: Path
) -> dict[str, Float[Floats, "V 3"]]:
    """Where meshmonk registers the template's vertices on each shape, a minute each, kept as files."""
    ours = template.shape
    make_folder(kept)
    places = {}
    for name, shape in shapes.items():
        file = kept / f"{name}-{template.hash}.npy"
        if not file.is_file():
            runner.tell(f"meshmonk: {name}")
            turned = shape.vertex_normals @ frames[name].rotation.T
            found = viscoelastic(
                (ours.verts, ours.vertex_normals, ours.faces), (frames[name].apply(shape.verts), turned, shape.faces)
            )
            np.save(file, frames[name].undo(found))
        places[name] = np.load(file, allow_pickle=False)
    return places


def by_zoomout(
    shapes: Shapes, pairs: Sequence[Pair], kept: Path, starts: Mapping[Pair, VertexMap] | None = None
) -> dict[Pair, VertexMap]:
    """Maps of pyfmaps' ZoomOut, from descriptors or from maps that are there, kept as files; a pair on which the library
    gives up is the map of everything to vertex 0."""
    method, fits = ZoomOut(), dict[str, Any]()
    make_folder(kept)
    maps = {}
    for a, b in runner.track(pairs, "ZoomOut"):
        file = kept / f"{a}-{b}.npy"
        if not file.is_file():
            fits |= {name: method.fit(shapes[name]) for name in (a, b) if name not in fits}
            try:
                start = None if starts is None else starts[a, b]
                index = method.map(shapes[a], fits[a], shapes[b], fits[b], start).index
            except InputError as error:
                runner.tell(f"{a} to {b}: {error.message}")
                index = np.zeros(shapes[a].V, np.int64)
            np.save(file, index)
        maps[a, b] = VertexMap.between(shapes[a], shapes[b], np.load(file, allow_pickle=False))
    return maps


def by_meshmonk(folder: Path, training: category.Training, nodes: NodeConfig, template: str, shapes: Shapes) -> Maps:
    """Maps through meshmonk's registrations of the template, prepared as for a training."""
    made = prepare(folder, training.work, PrepareConfig(nodes, template=template, align="near"))
    words = json.loads((training.work / "prepared.json").read_text(encoding="utf-8"))
    frames = {
        Path(name).stem: Frame(each["scale"], np.array(each["rotation"]), np.array(each["center"]))
        for name, each in zip(words["names"], words["frames"], strict=True)
    }
    return through(meshmonk_places(made.template, shapes, frames, training.work / "fits"), shapes)


@runner.command
def main(
    data: runner.Data = runner.DATA,
    ways: Annotated[str, Option(help=f"of {', '.join(WAYS)}")] = ",".join(WAYS),
    unseen: Annotated[int, Option(min=0, help="hearts kept from `registered`")] = 4,
    measure: Annotated[Literal["all", "unseen"], Option(help="which hearts are fitted")] = "all",
    rival_pairs: Annotated[int | None, Option(min=1, help="pairs of ZoomOut and 3D-CODED, evenly spread")] = None,
    coded_steps: Annotated[int, Option(min=1, help="of 3D-CODED's search over codes")] = 200,
    templates: Annotated[int | None, Option(min=1, help="of `collection`, evenly spread; by default all")] = None,
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
    few = runner.spread(pairs, rival_pairs)
    errors = partial(heart_errors, shapes, truth, unseen=strange)
    # walls that touch move together; less than the radius that suits a body
    config = NodeConfig("uniform", nodes, radius, 0.01, seed=seed)
    rigid = category.nearest_maps(measured, "near", "area", pairs)
    rows = [{"method": category.RIGID, **errors(rigid)}]
    went, notes = {}, []
    maps: Maps = {}
    how = {"minutes": minutes, "steps": steps, "threads": threads, "seed": seed}
    with category.training_in(work, nodes=nodes, radius=radius, **how) as training:
        for way in asked:
            here = training.inside(way)
            if way == "meshmonk":
                if find_spec("meshmonk") is None:
                    notes.append("meshmonk is not installed: its row is left out")
                    continue
                maps = by_meshmonk(folder, here, config, template, measured)
                rows.append({"method": way, **errors(maps)})
                continue
            if way == "zoomout":
                if find_spec("pyFM") is None:
                    notes.append("pyfmaps is not installed: the row of ZoomOut is left out")
                    continue
                rows.append({"method": "ZoomOut", **errors(by_zoomout(measured, few, here.work))})
                aligned = by_zoomout(measured, few, here.work / "aligned", rigid)
                rows.append({"method": "ZoomOut from the alignment", **errors(aligned)})
                continue
            if way == "coded":
                pointwise = replace(here, pointwise=True)
                model, went[way] = category.trained(
                    folder, pointwise, config, how="near", scale="area", template=template
                )
                latent = LatentRefineConfig(steps=coded_steps, volume=0.0, arap=0.0)
                search = FitConfig(seed=seed, refine="latent", partial="no", latent=latent)
                rows += category.compared(model, measured, {"3D-CODED": search}, few, errors)[0]
                continue
            if way == "collection":
                began = time.process_time()
                used = runner.spread(list(measured), templates)
                upright = template if template in measured else used[0]
                maps = collection_maps(measured, upright, ViscousConfig(seed=seed), here.work, used)
                spent = round((time.process_time() - began) / 60, 2)
                rows.append({"method": "collection, no training", **errors(maps), "cpu_minutes": spent})
                continue
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
