"""Wrapping an artist's topology onto other bodies, compared with the exact refit.

MakeHuman's alternative topologies (`.proxy`) bind each vertex to a triangle of its base mesh. The mesh of each generated
person is wrapped onto the next one, at rest and in a pose, whose remeshed body is the scan. Distances are in centimetres: of
each vertex from its position in the exact refit, and from the scan's surface; the exact refit is not exactly on it either.
"""

from __future__ import annotations

from typing import Annotated, Any, get_args

import numpy as np
from typer import Option

from meshmatch.api.wrap import wrap
from meshmatch.experiments import runner
from meshmatch.experiments.bench.garments import Bound, Pose, body_of, generate_people
from meshmatch.maps.mapped_mesh import MappedMesh

COLUMNS = {
    "topology": "topology", "pose": "pose", "pairs": "pairs:d", "mean cm": "mean_cm:.2f", "95 %": "high_cm:.2f",
    "to the scan": "scan_cm:.3f", "95 % ": "scan_high_cm:.2f", "worst": "scan_worst_cm:.1f",
    "exact refit": "truth_cm:.3f",
}  # fmt: skip


def _row(name: str, pose: str, centimeters: Any, pairs: int) -> dict[str, Any]:
    """Compute a table row from distances to the exact refit, to the scan, and of the exact refit to the scan."""
    away, scan, truth = centimeters
    return {
        **{"topology": name, "pose": pose, "pairs": pairs, "mean_cm": away.mean(), "high_cm": np.quantile(away, 0.95)},
        **{"scan_cm": scan.mean(), "scan_high_cm": np.quantile(scan, 0.95), "scan_worst_cm": scan.max()},
        "truth_cm": truth.mean(),
    }


@runner.command
def main(
    data: runner.Data = runner.DATA,
    poses: Annotated[str, Option(help=f"of {', '.join(get_args(Pose))}")] = ",".join(get_args(Pose)),
    count: Annotated[int, Option(min=2, help="generated people")] = 4,
    model: runner.Model = "human",
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    files = runner.files_in(data / "topologies", "*.proxy")
    crowd, faces = generate_people(count, seed)
    rows = []
    for pose in runner.split_names(poses, get_args(Pose), "pose"):
        for file in files:
            bound, found = Bound.read(file), []
            for k in runner.track(range(count), f"{file.stem}, {pose}"):
                source, target = crowd[k], crowd[(k + 1) % count]
                truth = target.worn_shape(bound, "rest" if pose == "rest" else "posed").verts
                scan = body_of(target.rest if pose == "rest" else target.posed, faces, f"person {k}", cut=True)
                wrapped = wrap(source.worn_shape(bound, "rest"), scan, model=model, threads=threads)
                away = np.linalg.norm(wrapped.shape.verts - truth, axis=1)
                found.append(100 * np.stack([away, wrapped.distance, MappedMesh.of(scan).query(truth).distance]))
            rows.append(_row(file.stem, pose, np.concatenate(found, axis=1), count))
    return runner.Report({"rows": rows}, [runner.table("Bodies in other topologies, wrapped", rows, COLUMNS)])
