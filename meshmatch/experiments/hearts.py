"""Ten hearts without correspondence: ``python -m meshmatch.experiments.hearts``.

The four-chamber hearts of the benchmark were decimated independently. A model is trained on them without
correspondence, as anybody would train one on a folder (`meshmatch prepare`, `meshmatch train`), and then all ordered
pairs are matched. Where two hearts kept a vertex of the same original mesh the truth is known exactly; only these
vertices count, about a fifth of each. The error is the Euclidean distance on the target between the matched and the
true vertex (walls are thin, and the surface's own distance between two points of a wall may be long), in units of
sqrt(area), times 100; beside it the share of points in the right chamber. Hearts are trained and measured on the same
ten: this is registration of a collection, not a test of what a model knows of unseen hearts.

Beside it: rigid alignment and the nearest vertex; and meshmonk (Apache-2.0), where it is installed (`pip install
meshmonk`): its viscoelastic registration of the same template, from the same alignment, with its defaults.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from meshmatch.config import set_threads
from meshmatch.errors import MeshmatchError
from meshmatch.experiments.adapters import viscoelastic
from meshmatch.experiments.category import Pair, Tell, fit_all, load_category, map_all, nearest_all, trained
from meshmatch.experiments.report import circumstances, explain, wide_console
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.pipeline import read_model
from meshmatch.render.picture import Look, Panel, render_shapes
from meshmatch.render.scales import label_colors
from meshmatch.shapes.shape import Frame, Shape
from meshmatch.templates.nodes import NodeConfig
from meshmatch.templates.template import Template

TRUTH = ".truth.npy"


def heart_errors(
    shapes: Mapping[str, Shape], truth: Mapping[str, np.ndarray], maps: Mapping[Pair, np.ndarray]
) -> dict[str, Any]:
    """Errors of index maps at the vertices whose partner is known: over pairs, and the share of right chambers."""
    means, chambers = {}, []
    for (source, target), index in maps.items():
        _, ours, theirs = np.intersect1d(truth[source][:, 0], truth[target][:, 0], return_indices=True)
        got, shape = index[ours], shapes[target]
        apart = np.linalg.norm(shape.verts[got] - shape.verts[theirs], axis=1)
        means[source, target] = 100 * float(apart.mean()) / float(np.sqrt(shape.area))
        chambers.append(float((truth[target][got, 1] == truth[source][ours, 1]).mean()))
    worst = max(means, key=lambda pair: means[pair])
    return {
        "pairs": len(means),
        "mean_x100": round(float(np.mean(list(means.values()))), 4),
        "worst_pair_x100": round(means[worst], 4),
        "worst_pair": list(worst),
        "right_chamber": round(float(np.mean(chambers)), 4),
    }


def meshmonk_maps(
    template: Template, shapes: Mapping[str, Shape], frames: Mapping[str, Frame], tell: Tell
) -> dict[Pair, np.ndarray] | None:
    """Maps through meshmonk's registrations of the template; None where it is not installed."""
    if find_spec("meshmonk") is None:
        return None
    ours = template.shape
    places = {}
    for name, shape in shapes.items():
        tell(f"meshmonk: {name}")
        turned = shape.vertex_normals @ frames[name].rotation.T
        found = viscoelastic(
            (ours.verts, ours.vertex_normals, ours.faces),
            (frames[name].apply(shape.verts), turned, shape.faces),
        )
        places[name] = frames[name].undo(found)
    return through(places, shapes)


def through(places: Mapping[str, np.ndarray], shapes: Mapping[str, Shape]) -> dict[Pair, np.ndarray]:
    """Maps through registered vertices: nearest of the source's, the same one on the target, nearest target vertex."""
    to = {name: cKDTree(places[name]).query(shape.verts)[1] for name, shape in shapes.items()}
    back = {name: cKDTree(shape.verts).query(places[name])[1] for name, shape in shapes.items()}
    return {(a, b): back[b][to[a]] for a in shapes for b in shapes if a != b}


def chamber_picture(
    shapes: Mapping[str, Shape],
    truth: Mapping[str, np.ndarray],
    maps: Mapping[Pair, np.ndarray],
    first: str,
    path: Path,
    others: int = 5,
) -> None:
    """One heart's chambers in colours, and the same colours on others as the maps carry them."""
    palette = label_colors(np.arange(int(truth[first][:, 1].max()) + 1))
    panels = [Panel(shapes[first], palette[truth[first][:, 1]], label=f"{first}: its chambers")]
    for name in [name for name in shapes if name != first][:others]:
        carried = truth[first][maps[name, first], 1]
        panels.append(Panel(shapes[name], palette[carried], label=f"on {name}"))
    render_shapes(panels, path, Look(up="z", front="-y"))


def _frames(work: Path) -> dict[str, Frame]:
    words = json.loads((work / "prepared" / "prepared.json").read_text(encoding="utf-8"))
    return {
        Path(name).stem: Frame(each["scale"], np.array(each["rotation"]), np.array(each["center"]))
        for name, each in zip(words["names"], words["frames"], strict=True)
    }


def run(
    *,
    data: Path,
    minutes: float,
    steps: int,
    threads: int,
    seed: int,
    nodes: int,
    radius: float,
    work: Path,
    picture: Path | None,
) -> dict[str, Any]:
    """Train, match, measure, print a table and a JSON line; the line's record is returned too."""
    set_threads(threads)
    shapes, truth = load_category(data / "heart", TRUTH)
    console = Console(stderr=True)
    results: dict[str, dict[str, Any]] = {}
    with console.status("hearts") as status:

        def tell(what: str) -> None:
            status.update(what)

        nearest = {pair: index for pair, (index, _) in nearest_all(shapes, "near", "area", tell).items()}
        results["rigid alignment, nearest vertex"] = heart_errors(shapes, truth, nearest)
        model, how = trained(
            data / "heart",
            work,
            minutes=minutes,
            steps=steps,
            how="near",
            scale="area",
            threads=threads,
            seed=seed,
            tell=tell,
            # walls that touch move together; half the radius that suits a body
            nodes=NodeConfig(strategy="uniform", K=nodes, radius=radius, depth=0.01, seed=seed),
        )
        template = read_model(model).template
        began = time.monotonic()
        monk = meshmonk_maps(template, shapes, _frames(work), tell)
        if monk is not None:
            results["meshmonk"] = heart_errors(shapes, truth, monk)
            results["meshmonk"]["seconds"] = round(time.monotonic() - began, 1)
        fits: dict[str, Fit] = {}
        maps: dict[Pair, np.ndarray] = {}
        for config, label in (
            (FitConfig(seed=seed, refine="none", partial="no"), "network alone"),
            (FitConfig(seed=seed, partial="no"), "network, nodes refined"),
        ):
            began = time.monotonic()
            fits = fit_all(model, shapes, config, tell)
            maps = {pair: found.index for pair, found in map_all(model, shapes, fits, config, tell).items()}
            results[label] = heart_errors(shapes, truth, maps)
            results[label]["seconds"] = round(time.monotonic() - began, 1)
            results[label]["verdicts"] = sorted(fit.verdict for fit in fits.values())
    table = Table(title="Hearts: Euclidean error x 100 / sqrt(area), all pairs", title_justify="left")
    for name in ("method", "mean", "worst pair", "right chamber"):
        table.add_column(name, justify="left" if name == "method" else "right")
    for name, each in results.items():
        numbers = f"{each['mean_x100']:.2f}", f"{each['worst_pair_x100']:.2f}"
        table.add_row(name, *numbers, f"{100 * each['right_chamber']:.1f} %")
    wide_console().print(table)
    if "meshmonk" not in results:
        console.print("meshmonk is not installed: its row is left out")
    if picture is not None:
        chamber_picture(shapes, truth, maps, next(iter(shapes)), picture)
        console.print(f"wrote {picture}")
    whole = {
        "benchmark": "hearts",
        **circumstances(threads=threads, jobs=1),
        "seed": seed,
        "training": how,
        "results": results,
    }
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.hearts", description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/bench"), help="the benchmark's data")
    parser.add_argument("--minutes", type=float, default=25.0, help="of training at most")
    parser.add_argument("--steps", type=int, default=3000, help="of training")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nodes", type=int, default=600, help="of the template")
    parser.add_argument("--radius", type=float, default=0.1, help="of a node, units of sqrt(area)")
    parser.add_argument("--work", type=Path, help="keep the prepared folder and the model here")
    parser.add_argument("--picture", type=Path, help="draw one heart's chambers on the others")
    options = parser.parse_args(words)
    if options.steps < 1 or options.minutes <= 0 or options.threads < 1 or options.seed < 0:
        parser.error("steps and threads of 1 or more, minutes above 0 and a seed of 0 or more are needed")
    try:
        with tempfile.TemporaryDirectory() as temporary:
            run(
                data=options.data,
                minutes=options.minutes,
                steps=options.steps,
                threads=options.threads,
                seed=options.seed,
                nodes=options.nodes,
                radius=options.radius,
                work=options.work or Path(temporary),
                picture=options.picture,
            )
    except MeshmatchError as error:
        explain(error)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
