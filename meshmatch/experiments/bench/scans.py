"""Scans: fitted, measured and drawn.

Fits the model's template to every file, prints how well it fits, and with -o draws each scan beside the fitted template,
both in the colors of the template's parts: a lost or swapped limb shows at once. Of files there is no truth. --simulated
makes scans of generated bodies instead (`meshmatch.experiments.makers.simulated_scans`): these may be shown, and the
error of the fitted template is known.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from scipy.spatial import cKDTree
from typer import Argument, Option

from meshmatch.api.matching import Matcher
from meshmatch.api.results import shape_of
from meshmatch.arrays import Int, Ints
from meshmatch.errors import OptionError
from meshmatch.experiments import runner
from meshmatch.experiments.makers.simulated_scans import simulated_scans
from meshmatch.fitting.fit import Fit
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.maps.footpoints import template_footpoints
from meshmatch.outputs import make_folder
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look, render_shapes
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.shape import Shape

_IN_A_PICTURE = 5
_FAR_CM = 5.0
COLUMNS = {"scan": "scan", "vertices": "vertices:d", "verdict": "verdict", "mean": "distance_cm:.2f"}
COLUMNS |= {f"over {_FAR_CM:g} cm": "share_over_5cm:.1%", "error": "error_cm:.2f", "seconds": "seconds:.1f"}


def scan_panels(name: str, fit: Fit, labels: Int[Ints, " V_template"]) -> list[Panel]:
    """A scan, colored by the parts where its vertices belong, and the template fitted to it."""
    shape = shape_of(fit).shape
    belongs = template_footpoints(shape, fit)[1]
    part = labels[cKDTree(fit.resting).query(belongs)[1]]
    fitted, turn = Shape(fit.points_in_file, fit.shape.faces, name), fit.frame.turn
    return [
        Panel(shape, label_colors(part), name, sharp=True, rotation=turn),
        Panel(fitted, label_colors(labels), fit.verdict, sharp=True, rotation=turn),
    ]


def fit_error(fit: Fit, body: Shape) -> float:
    """Mean distance of the fitted template's vertices from those of the body that was scanned, cm at 1.9 m2 of skin."""
    off = np.linalg.norm(fit.frame.undo(fit.points) - body.verts, axis=1).mean()
    return float(off / np.sqrt(body.area) * CM_PER_UNIT)


@runner.command
def main(
    files: Annotated[list[Path] | None, Argument(help="scans")] = None,
    output: Annotated[Path | None, Option("-o", "--output", help="folder of the pictures; none: draw nothing")] = None,
    simulated: Annotated[int, Option(min=0, help="so many scans of generated bodies")] = 0,
    model: runner.Model = "human",
    seed: runner.Seed = 0,
) -> runner.Report:
    if not files and not simulated:
        raise OptionError("there is nothing to fit", "name scans, or ask for --simulated ones")
    if output is not None:
        make_folder(output)
    matcher = Matcher(model, FitConfig(seed=seed))
    labels = np.asarray(matcher.model.template.labels)
    scans: list[tuple[str, Path | Shape, Shape | None]] = [(path.stem, path, None) for path in files or ()]
    scans += [(scan.name, scan, body) for body, scan in simulated_scans(simulated, seed)] if simulated else []
    rows, panels = [], []
    for name, scan, body in runner.track(scans, "fitting"):
        fit = matcher.fit(scan)
        gap = CM_PER_UNIT * np.asarray(fit.vertex_distance)
        row = {
            **{"scan": name, "verdict": fit.verdict, "reasons": list(fit.reasons), "vertices": len(gap)},
            **{"distance_cm": float(gap.mean()), "share_over_5cm": float((gap > _FAR_CM).mean())},
            "seconds": round(fit.seconds, 1),
        }
        if body is not None:
            row["error_cm"] = fit_error(fit, body)
        rows.append(row)
        panels += scan_panels(name, fit, labels)
    pictures = []
    for number, first in enumerate(range(0, len(panels) if output is not None else 0, 2 * _IN_A_PICTURE)):
        pictures.append(Path(output or ".") / f"scans-{number + 1}.png")
        render_shapes(panels[first : first + 2 * _IN_A_PICTURE], pictures[-1], Look())
    title = "Scans: distance of their vertices from the template, cm"
    return runner.Report({"scans": rows, "pictures": pictures}, [runner.table(title, rows, COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
