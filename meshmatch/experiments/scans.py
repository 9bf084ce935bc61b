"""Scans without a truth: fitted, measured and drawn.

Fits the model's template to every file, prints how well it fits, and draws each scan beside the fitted template, both in
the colors of the template's parts: a lost or swapped limb shows at once. Look at the pictures; there is nothing else.
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
from meshmatch.experiments import runner
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
COLUMNS = {"scan": "scan", "verdict": "verdict", "mean": "distance_cm:.2f"}
COLUMNS |= {f"over {_FAR_CM:g} cm": "share_over_5cm:.1%", "seconds": "seconds:.1f"}


def scan_panels(name: str, fit: Fit, labels: Int[Ints, " V_template"]) -> list[Panel]:
    """A scan, colored by the parts where its vertices belong, and the template fitted to it."""
    shape = shape_of(fit).shape
    belongs = template_footpoints(shape, fit)[1]
    part = labels[cKDTree(fit.resting).query(belongs)[1]]
    fitted = Shape(fit.frame.undo(fit.points), fit.faces, name)
    turn = fit.frame.rotation
    return [
        Panel(shape, label_colors(part), name, sharp=True, rotation=turn),
        Panel(fitted, label_colors(labels), fit.verdict, sharp=True, rotation=turn),
    ]


@runner.command
def main(
    files: Annotated[list[Path], Argument(help="scans")],
    output: Annotated[Path, Option("-o", "--output", help="folder of the pictures")] = Path(),
    model: runner.Model = "human",
    seed: runner.Seed = 0,
) -> runner.Report:
    make_folder(output)
    matcher = Matcher(model, FitConfig(seed=seed))
    labels = np.asarray(matcher.model.template.labels)
    rows, panels = [], []
    for path in runner.track(files, "fitting"):
        fit = matcher.fit(path)
        gap = CM_PER_UNIT * np.asarray(fit.vertex_distance)
        rows.append(
            {
                **{"scan": path.stem, "verdict": fit.verdict, "reasons": list(fit.reasons)},
                **{"distance_cm": float(gap.mean()), "share_over_5cm": float((gap > _FAR_CM).mean())},
                "seconds": round(fit.seconds, 1),
            }
        )
        panels += scan_panels(path.stem, fit, labels)
    pictures = []
    for number, first in enumerate(range(0, len(panels), 2 * _IN_A_PICTURE)):
        pictures.append(output / f"scans-{number + 1}.png")
        render_shapes(panels[first : first + 2 * _IN_A_PICTURE], pictures[-1], Look())
    title = "Scans: distance of their vertices from the template, cm"
    return runner.Report({"scans": rows, "pictures": pictures}, [runner.table(title, rows, COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
