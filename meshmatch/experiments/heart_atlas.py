"""Atlases of ten hearts by the registration that they are made of, measured on the hearts' own surfaces.

One heart, thinned, is the template of all, laid on each from the same alignment: by node vectors without any training
(`fitting.viscous`), by the same from the mean of these, by meshmonk with its defaults, and by the truth, which knows where
a fifth of the vertices are and lets a thin plate spline say where the others go (`experiments.hearts`). Hearts are scaled
to area 1; distances are means over the surface x 100, from hearts that were left out to what a model of the others makes
of them, and from random hearts to the nearest. Between points a registration is compared with itself; between surfaces
with the heart.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.api.inputs import validated
from meshmatch.arrays import Floats
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.atlas_files import Findings, write_folder
from meshmatch.collections.measures import Measures, measure_atlas
from meshmatch.experiments import category, runner
from meshmatch.experiments.classical_baselines import viscoelastic
from meshmatch.experiments.collection import aligned, system_of, thinned
from meshmatch.experiments.hearts import TRUTH, registered
from meshmatch.experiments.sets import load_folder
from meshmatch.fitting.viscous import ViscousConfig, viscous_vectors
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.outputs import make_folder
from meshmatch.render.facing import facing
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import low_mesh
from meshmatch.templates.prepared_folder import medoid

WAYS = ("nodes", "mean", "meshmonk", "truth")
Places = Mapping[str, Floats]


def by_nodes(thin: Shape, shapes: Mapping[str, Shape], config: ViscousConfig) -> Places:
    """The template's vertices on every heart, by node vectors."""
    system, found = system_of(thin, config), {}
    for name, shape in shapes.items():
        samples = sample_surface(shape, config.samples, np.random.default_rng(config.seed + 1))
        found[name] = thin.verts
        if name != thin.name:
            found[name] = system.moved(viscous_vectors(system, samples, config))
        runner.tell(f"nodes: {name}")
    return found


def by_mean(thin: Shape, shapes: Mapping[str, Shape], config: ViscousConfig) -> Places:
    """The same with the mean of these as the template, as `meshmatch fit --model none` does."""
    first = by_nodes(thin, shapes, config)
    mean = Atlas.of(np.stack([first[name] for name in shapes]), np.asarray(thin.faces), list(shapes)).mean
    return by_nodes(Shape(mean, thin.faces, "mean"), shapes, config)


def by_meshmonk(thin: Shape, shapes: Mapping[str, Shape]) -> Places:
    """The template's vertices on every heart, by meshmonk."""
    floating = thin.verts, vertex_normals(thin.verts, thin.faces), thin.faces
    found = {}
    for name, shape in shapes.items():
        target = shape.verts, shape.vertex_normals, shape.faces
        found[name] = thin.verts if name == thin.name else viscoelastic(floating, target)
        runner.tell(f"meshmonk: {name}")
    return found


def row(method: str, atlas: Atlas, found: Measures, seconds: float) -> dict[str, Any]:
    """A line of the table: measures with all modes that can be measured, in hundredths of sqrt(area)."""
    last = {
        f"{name}{kind}_x100": round(100 * float(getattr(found, name + kind)[-1]), 4)
        for name in ("generalisation", "specificity")
        for kind in ("", "_surface")
    }
    shares = {"modes": int(found.counts[-1]), "first_three": round(float(atlas.compactness[:3][-1]), 4)}
    return {"method": method, **shares, **last, "seconds": round(seconds, 1)}


@runner.command
def main(
    data: runner.Data = runner.DATA,
    ways: Annotated[str, Option(help=f"of {', '.join(WAYS)}")] = ",".join(WAYS),
    hearts: Annotated[int | None, Option(min=4, help="of them, evenly spread; by default all")] = None,
    work: category.Work = None,
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    asked = runner.names_of(ways, WAYS, "way")
    given, truth = load_folder(data / "heart", TRUTH)
    given = {name: given[name] for name in runner.spread(list(given), hearts)}
    template = list(given)[medoid([validated(shape) for shape in given.values()], "near", "area", seed)]
    shapes, config = aligned(given, template, seed), ViscousConfig(seed=seed)
    thin = thinned(shapes[template], config.faces)
    rows, notes = [], []
    for way in asked:
        began = time.monotonic()
        if way == "meshmonk" and find_spec("meshmonk") is None:
            notes.append("meshmonk is not installed: its row is left out")
            continue
        if way == "nodes":
            places = by_nodes(thin, shapes, config)
        elif way == "mean":
            places = by_mean(thin, shapes, config)
        elif way == "meshmonk":
            places = by_meshmonk(thin, shapes)
        else:
            keep, _ = low_mesh(shapes[template], config.faces)
            first, ids = shapes[template], truth[template][:, 0]
            places = {
                name: thin.verts if name == template else registered(first, ids, shape, truth[name][:, 0])[keep]
                for name, shape in shapes.items()
            }
        seconds = time.monotonic() - began
        points = np.stack([places[name] for name in shapes])
        atlas = Atlas.of(points, np.asarray(thin.faces), list(shapes))
        found = measure_atlas(atlas, points, surfaces=list(shapes.values()), seed=seed)
        rows.append(row(way, atlas, found, seconds))
        if work is not None:
            folder = Path(work) / way
            make_folder(folder)
            turn = facing(atlas.mean_shape, "z", "-y")
            title = f"{len(shapes)} hearts, registered by {way}"
            write_folder(folder, atlas, Findings(found, seed=seed), rotation=turn, title=title)
            notes.append(f"wrote {folder}")
    columns = {"registration": "method", "modes": "modes:d", "variance in three": "first_three:.1%"}
    for name in ("generalisation", "specificity"):
        columns |= {
            f"{name}, points": f"{name}_x100:.2f",
            "surfaces" + " " * (name[0] == "s"): f"{name}_surface_x100:.2f",
        }
    columns["seconds"] = "seconds:.0f"
    record = {"template": template, "hearts": list(shapes), "threads": threads, "rows": rows}
    return runner.Report(record, [runner.table("Atlases of hearts: distance x 100 / sqrt(area)", rows, columns)], notes)


if __name__ == "__main__":
    sys.exit(main())
