"""Ten hearts: ``python -m meshmatch.experiments.hearts``.

The four-chamber hearts of the benchmark were decimated independently. Models are trained on them as anybody would train
one on a folder (`meshmatch prepare`, `meshmatch train`), and then all ordered pairs are matched. Where two hearts kept
a vertex of the same original mesh the truth is known exactly; only these vertices count, about a fifth of each. The
error is the Euclidean distance on the target between the matched and the true vertex (walls are thin, and the surface's
own distance between two points of a wall may be long), in units of sqrt(area), times 100; beside it the share of points
in the right chamber.

``registered``: six hearts get the vertices and triangles of one of them, through the vertices that the truth knows, and
are learned as registered meshes. The other four (``--unseen``), the last by name, are seen by no training; pairs of
these alone have a column of their own. Here training has seen the truth of six. ``--measure unseen`` fits and matches
these four alone, which is quicker.

``unregistered``: all ten as they are, without correspondence. Trained and measured on the same ten: a registration of a
collection, not a test of what a model knows of hearts it never saw. It has seen no truth.

``meshmonk``: a rival's way (Apache-2.0, `pip install meshmonk`): its viscoelastic registration of the same template,
from the same alignment, with its defaults. Beside them all: rigid alignment and the nearest vertex.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from meshmatch.errors import OptionError
from meshmatch.experiments.adapters import viscoelastic
from meshmatch.experiments.category import (
    Pair,
    Tell,
    Training,
    fit_all,
    load_category,
    map_all,
    nearest_all,
    options_of_training,
    trained,
    training_of,
)
from meshmatch.experiments.heart_truth import chamber_picture, heart_errors, save_registered, through
from meshmatch.experiments.report import columns, publish, status_of
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.frames import Frame
from meshmatch.outputs import make_folder
from meshmatch.pipeline import usable
from meshmatch.shapes.shape import Shape
from meshmatch.templates.nodes import NodeConfig
from meshmatch.templates.prepare import PrepareConfig, prepare
from meshmatch.templates.template import Template
from meshmatch.templates.unregistered import medoid
from meshmatch.threads import set_threads

TRUTH = ".truth.npy"
WAYS = ("meshmonk", "unregistered", "registered")


def meshmonk_maps(
    template: Template, shapes: Mapping[str, Shape], frames: Mapping[str, Frame], kept: Path, tell: Tell
) -> dict[Pair, np.ndarray]:
    """Maps through meshmonk's registrations of the template, a minute each, kept as files."""
    ours = template.shape
    make_folder(kept)
    places = {}
    for name, shape in shapes.items():
        tell(f"meshmonk: {name}")
        file = kept / f"{name}-{template.hash}.npy"
        if not file.is_file():
            turned = shape.vertex_normals @ frames[name].rotation.T
            found = viscoelastic(
                (ours.verts, ours.vertex_normals, ours.faces),
                (frames[name].apply(shape.verts), turned, shape.faces),
            )
            np.save(file, frames[name].undo(found))
        places[name] = np.load(file, allow_pickle=False)
    return through(places, shapes)


def prepared_frames(prepared: Path) -> dict[str, Frame]:
    """The way from each file of a prepared folder to its template's frame."""
    words = json.loads((prepared / "prepared.json").read_text(encoding="utf-8"))
    return {
        Path(name).stem: Frame(each["scale"], np.array(each["rotation"]), np.array(each["center"]))
        for name, each in zip(words["names"], words["frames"], strict=True)
    }


def run(
    ways: Sequence[str],
    training: Training,
    *,
    data: Path,
    unseen: int,
    stiffness: float,
    measure: str,
    picture: Path | None,
) -> dict[str, Any]:
    """Train, match, measure, print a table and a JSON line; the line's record is returned too."""
    if strangers := [way for way in ways if way not in WAYS]:
        raise OptionError(f"there is no way {strangers[0]!r}", f"choose from {', '.join(WAYS)}")
    set_threads(training.threads)
    shapes, truth = load_category(data / "heart", TRUTH)
    console = Console(stderr=True)
    results: dict[str, dict[str, Any]] = {}
    trainings: dict[str, Any] = {}
    maps: dict[Pair, np.ndarray] = {}
    with console.status("hearts") as status:

        def tell(what: str) -> None:
            status.update(what)

        clean = [usable(shape) for shape in shapes.values()]
        template = list(shapes)[medoid(clean, "near", "area", training.seed)]
        others = [name for name in shapes if name != template]
        strange = others[len(others) - unseen :]
        measured = {name: shapes[name] for name in (strange if measure == "unseen" else shapes)}
        nearest = {pair: index for pair, (index, _) in nearest_all(measured, "near", "area", tell).items()}
        results["rigid alignment, nearest vertex"] = heart_errors(shapes, truth, nearest, strange)
        for way in ways:
            if way == "meshmonk":
                if find_spec("meshmonk") is None:
                    console.print("meshmonk is not installed: its row is left out")
                    continue
                nodes = NodeConfig("uniform", training.nodes, training.radius, 0.01, seed=training.seed)
                place = training.work / "meshmonk"
                made = prepare(data / "heart", place, PrepareConfig(nodes, template=template, align="near"))
                maps = meshmonk_maps(made.template, measured, prepared_frames(place), place / "fits", tell)
                results["meshmonk"] = heart_errors(shapes, truth, maps, strange)
                continue
            folder, here = data / "heart", training.inside(way)
            if way == "registered":
                folder = here.work / "shapes"
                seen = [name for name in shapes if name not in strange]
                save_registered(folder, shapes, truth, template, seen)
            # walls that touch move together; less than the radius that suits a body
            model, how = trained(
                folder,
                here,
                how="near",
                scale="area",
                tell=tell,
                depth=0.01,
                template=template,
                stiffness=stiffness,
            )
            trainings[way] = how
            for refine in ("none", "nodes"):
                began = time.monotonic()
                config = FitConfig(seed=training.seed, refine=refine, partial="no")
                fits = fit_all(model, measured, config, tell)
                found = map_all(model, measured, fits, config, tell)
                maps = {pair: each.index for pair, each in found.items()}
                label = f"{way}, {'network alone' if refine == 'none' else 'nodes refined'}"
                results[label] = heart_errors(shapes, truth, maps, strange)
                results[label]["seconds"] = round(time.monotonic() - began, 1)
                results[label]["verdicts"] = sorted(fit.verdict for fit in fits.values())
    numbers = ["pairs", "mean", "worst pair", "right chamber", f"pairs of {len(strange)} unseen"]
    table = columns("Hearts: Euclidean error x 100 / sqrt(area)", ["method"], numbers)
    for label, each in results.items():
        alone = "-" if each["unseen_x100"] is None else f"{each['unseen_x100']:.2f}"
        shares = f"{each['worst_pair_x100']:.2f}", f"{100 * each['right_chamber']:.1f} %", alone
        table.add_row(label, str(each["pairs"]), f"{each['mean_x100']:.2f}", *shares)
    if picture is not None and maps:
        chamber_picture(measured, truth, maps, next(iter(measured)), picture)
        console.print(f"wrote {picture}")
    record = {
        "seed": training.seed,
        "template": template,
        "unseen": strange,
        "stiffness": stiffness,
        "training": trainings,
        "results": results,
    }
    return publish("hearts", table, record, threads=training.threads)


def main(words: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when it ran, 1 when the data or the choice stopped it."""
    parser = options_of_training("hearts", __doc__, minutes=25, steps=3000, nodes=600, radius=0.1)
    parser.add_argument("--ways", default=",".join(WAYS), help="%(default)s")
    parser.add_argument("--unseen", type=int, default=4, help="hearts kept from `registered`; %(default)s")
    parser.add_argument("--measure", choices=("all", "unseen"), default="all", help="%(default)s")
    parser.add_argument("--stiffness", type=float, default=0.05, help="as in meshmatch train; %(default)s")
    parser.add_argument("--picture", type=Path, help="draw one heart's chambers on the others")
    options = parser.parse_args(words)
    if options.unseen < (2 if options.measure == "unseen" else 0) or not options.stiffness > 0:
        parser.error("unseen hearts of 0 or more (2 to measure them) and a stiffness above 0 are needed")
    with training_of(parser, options) as training:
        return status_of(
            lambda: run(
                options.ways.split(","),
                training,
                data=options.data,
                unseen=options.unseen,
                stiffness=options.stiffness,
                measure=options.measure,
                picture=options.picture,
            )
        )


if __name__ == "__main__":
    sys.exit(main())
