"""Real chairs, tables and planes through implicit models of generated ones: keypoints of one shape found on another.

The models are those that `python -m meshmatch.experiments.implicit` trained (--work names the same folder). Each of the
benchmark's shapes (SHREC'07), turned to stand as the generated ones do, gets its code by `fit_implicit`; every ordered pair
is matched through the template, and measured at the keypoints as in `experiments.segments`, tables in the numbering that
suits a pair best as well. Beside the two deformations: the same shapes in the cube, undeformed.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.experiments import category, runner
from meshmatch.experiments.furniture import KINDS
from meshmatch.experiments.implicit import METHODS
from meshmatch.experiments.part_transfer import real_errors, real_shapes
from meshmatch.experiments.segments import RIGHT
from meshmatch.implicit.codes import fit_implicit
from meshmatch.implicit.model import ImplicitFit, ImplicitModel, load_implicit, nearest_on_template
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

COLUMNS = {
    **{"kind": "kind", "deformation": "method", "mean": "mean:.3f", "median": "median:.3f"},
    **{f"within {RIGHT:g}": "arrived:.1%", "best numbering": "renumbered_arrived:.1%", "IoU": "iou:.2f"},
    **{"AUC": "confidence_auc:.2f", "residual %": "residual:.2f", "missed": "missed:.1%", "invented": "invented:.1%"},
    **{"good, fair, poor": "verdicts", "s a fit": "seconds:.1f"},
}


def undeformed(source: Shape, target: Shape, a: ImplicitFit, b: ImplicitFit) -> VertexMap:
    """To the nearest vertex in the cube, normals counted as `ImplicitModel.match` counts them."""
    from_a, from_b = a.frame.apply(source.verts), b.frame.apply(target.verts)
    index = nearest_on_template(from_a, from_b, source.vertex_normals, target.vertex_normals)
    return VertexMap.between(source, target, index)


def measure(kind: str, models: dict[str, ImplicitModel], data: Path, steps: int, seed: int) -> list[dict[str, Any]]:
    """A row for each model, and one for no deformation."""
    shapes, keypoints = real_shapes(kind, data)
    pairs = category.ordered_pairs(shapes)
    rows = []
    fits: dict[str, ImplicitFit] = {}
    for method, model in models.items():
        began = time.process_time()
        fits = {
            name: fit_implicit(model, shape, steps=steps, seed=seed)
            for name, shape in runner.track(shapes.items(), f"{kind}, {method}")
        }
        seconds = (time.process_time() - began) / len(shapes)
        maps = {(a, b): model.match(fits[a], fits[b], shapes[a], shapes[b]) for a, b in pairs}
        verdicts = [fit.verdict for fit in fits.values()]
        numbers = {
            key: float(np.mean([getattr(fit, key) for fit in fits.values()]))
            for key in ("residual", "missed", "invented")
        }
        words = ", ".join(str(verdicts.count(word)) for word in ("good", "fair", "poor"))
        rows.append({"kind": kind, "method": method, **real_errors(kind, shapes, keypoints, maps), **numbers})
        rows[-1] |= {"verdicts": words, "seconds": seconds}
        runner.tell(f"{kind}, {method}: {rows[-1]['arrived']:.1%} within {RIGHT:g}")
    maps = {(a, b): undeformed(shapes[a], shapes[b], fits[a], fits[b]) for a, b in pairs}
    return [*rows, {"kind": kind, "method": "none", **real_errors(kind, shapes, keypoints, maps)}]


@runner.command
def main(
    data: runner.Data = runner.DATA,
    work: Annotated[Path, Option(help="where `experiments.implicit` keeps its models")] = Path("runs/implicit"),
    kinds: Annotated[str, Option(help=f"of {', '.join(KINDS)}")] = ",".join(KINDS),
    methods: Annotated[str, Option(help=f"of {', '.join(METHODS)}")] = "DIF-Net,reduced",
    steps: Annotated[int, Option(min=1, help="on the code of a shape")] = 200,
    model_seed: Annotated[int, Option(min=0, help="of the trainings")] = 0,
    seed: runner.Seed = 0,
    threads: runner.Threads = 1,
) -> runner.Report:
    rows = []
    for kind in runner.names_of(kinds, KINDS, "kind"):
        models = {
            method: load_implicit(work / f"{kind}-{METHODS[method]}-{model_seed}")
            for method in runner.names_of(methods, METHODS, "method")
        }
        about = {key: (model.card.weights_sha256, steps, seed) for key, model in models.items()}
        kept = work / f"real-{kind}.json"
        found = runner.once(kept, {"models": str(about)}, lambda: {"rows": measure(kind, models, data, steps, seed)})  # noqa: B023
        rows += found["rows"]
    title = f"Real shapes through implicit models of generated ones, {steps} steps on the code, all pairs"
    return runner.Report({"rows": rows}, [runner.table(title, rows, COLUMNS)])


if __name__ == "__main__":
    sys.exit(main())
