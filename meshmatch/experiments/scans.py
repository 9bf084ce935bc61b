"""Scans without a truth: ``python -m meshmatch.experiments.scans FILES... -o pictures``.

Lays the model's template on every file, prints how well it lies, and draws each scan beside the template on it, both in
the colours of the template's parts: a lost or swapped limb shows at once. Look at the pictures; there is nothing else.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.spatial import cKDTree

from meshmatch.experiments.report import circumstances, status_of, wide_console
from meshmatch.fitting.fit import Fit
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.maps.template_footpoints import template_footpoints
from meshmatch.outputs import make_folder
from meshmatch.pipeline import as_shape, read_model, register, usable
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.render.scales import label_colors
from meshmatch.shapes.shape import Shape
from meshmatch.threads import set_threads

_IN_A_PICTURE = 5
_FAR_CM = 5.0


def scan_panels(name: str, shape: Shape, fit: Fit, labels: np.ndarray) -> list[Panel]:
    """A scan, coloured by the parts (V_template,) where its vertices belong, and the template as it lies on it."""
    belongs = template_footpoints(shape, fit)[1]
    part = labels[cKDTree(fit.resting).query(belongs)[1]]
    laid = Shape(fit.frame.undo(fit.points), fit.faces, name)
    turn = fit.frame.rotation
    return [
        Panel(shape, label_colors(part), name, sharp=True, rotation=turn),
        Panel(laid, label_colors(labels), fit.verdict, sharp=True, rotation=turn),
    ]


def run(files: Sequence[Path], folder: Path, *, model: str, seed: int) -> dict[str, Any]:
    """Register, measure, draw; prints a table and a JSON line, whose record is returned too."""
    set_threads(1)
    make_folder(folder)
    template = read_model(model).template
    labels = np.asarray(template.labels)
    rows: dict[str, Any] = {}
    panels: list[Panel] = []
    for path in track(files, "fitting", console=Console(stderr=True)):
        shape = usable(as_shape(path)).shape
        fit = register(shape, model=model, seed=seed)
        gap = CM_PER_UNIT * np.asarray(fit.vertex_distance)
        rows[path.stem] = {
            "verdict": fit.verdict,
            "reasons": list(fit.reasons),
            "distance_cm": float(gap.mean()),
            "share_over_5cm": float((gap > _FAR_CM).mean()),
            "seconds": round(fit.seconds, 1),
        }
        panels += scan_panels(path.stem, shape, fit, labels)
    pictures = []
    for number, first in enumerate(range(0, len(panels), 2 * _IN_A_PICTURE)):
        pictures.append(folder / f"scans-{number + 1}.png")
        render_shapes(panels[first : first + 2 * _IN_A_PICTURE], pictures[-1], Look())
    table = Table(title="Scans: distance of their vertices from the template, cm", title_justify="left")
    for name in ("scan", "verdict", "mean", f"over {_FAR_CM:g} cm", "seconds"):
        table.add_column(name, justify="left" if name in ("scan", "verdict") else "right")
    for name, row in rows.items():
        numbers = (f"{row['distance_cm']:.2f}", f"{100 * row['share_over_5cm']:.1f} %", f"{row['seconds']}")
        table.add_row(name, row["verdict"], *numbers)
    wide_console().print(table)
    whole = {
        "benchmark": "scans",
        **circumstances(threads=1, jobs=1),
        "model": model,
        "seed": seed,
        "scans": rows,
        "pictures": [str(path) for path in pictures],
    }
    print(json.dumps(whole), flush=True)
    return whole


def main(words: Sequence[str] | None = None) -> int:
    """Run it; 0 when it ran, 1 when a file or the choice stopped it."""
    parser = argparse.ArgumentParser("python -m meshmatch.experiments.scans", description=__doc__)
    parser.add_argument("files", type=Path, nargs="+", help="scans")
    parser.add_argument("-o", "--output", type=Path, default=Path(), help="folder of the pictures")
    parser.add_argument("--model", default="human")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(words)
    return status_of(lambda: run(options.files, options.output, model=options.model, seed=options.seed))


if __name__ == "__main__":
    sys.exit(main())
