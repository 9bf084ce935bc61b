"""Tracking a beating heart: a heart of the benchmark contracts, twists and sways; each frame is remeshed differently.

The motion is an analytic function of position, so that the path of every point is known. The tracked points are the
template's vertices as fitted to the first frame. The second difference of a path is what a strain curve would show as noise;
the ideal is the second difference of the true path. Lengths are in millimetres.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Option

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.collections.collection import Collection
from meshmatch.collections.motion import area_strain
from meshmatch.experiments import runner
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.footpoints import Surface
from meshmatch.outputs import make_folder
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape

SHRINK, TWIST, SHORTEN, SWAY = 0.22, 25.0, 0.12, 6.0
"""Maximum contraction of the walls, twist in degrees, shortening along the axis, and sway in millimetres."""
COLUMNS = {
    "frames": "way", "mean": "mean:.2f", "95 %": "high:.2f", "second difference": "second:.3f", "of the truth": "times:.2f",
    "area strain": "strain:.3f",
}  # fmt: skip


def move_heart(verts: Float[Floats, "V 3"], phase: float) -> Float[Floats, "V 3"]:
    """Return the points of a heart at a phase of its beat, in radians."""
    center = verts.mean(axis=0)
    axes = np.linalg.svd(verts - center, full_matrices=False)[2]
    along, left, front = (
        (verts - center) @ axes.T[:, 0],
        (verts - center) @ axes.T[:, 1],
        (verts - center) @ axes.T[:, 2],
    )
    share = along / np.ptp(along)
    strong, late = (0.5 * (1 - np.cos(phase - delay)) for delay in (0.0, 0.35))
    turn = np.radians(2 * TWIST) * late * share
    narrow = 1 - SHRINK * strong * (0.6 + 0.4 * np.sin(2 * np.pi * share + 1))
    moved = [
        along * (1 - SHORTEN * strong),
        narrow * (np.cos(turn) * left - np.sin(turn) * front)
        + SWAY * np.sin(phase) * np.exp(-(((share - 0.2) / 0.3) ** 2)),
        narrow * (np.sin(turn) * left + np.cos(turn) * front),
    ]
    return np.asarray(np.stack(moved, axis=1) @ axes + center)


def write_frames(folder: Path, heart: Shape, count: int, seed: int) -> Float[Floats, "T V 3"]:
    """Write the frames of one beat, ``frame1.ply`` to ``frameT.ply``; return the heart's vertices at each frame."""
    make_folder(folder)
    rng = np.random.default_rng(seed)
    true = np.stack([move_heart(heart.verts, 2 * np.pi * k / count) for k in range(count)])
    for number, verts in enumerate(true):
        order = rng.permutation(heart.V)
        faces = np.argsort(order)[heart.faces][rng.permutation(heart.F)]
        frame = decimate(Shape(verts[order], faces), int(heart.F * rng.uniform(0.55, 0.7)))
        save_shape(folder / f"frame{number + 1}.ply", frame)
    return true


def paths_of(points: Float[Floats, "N 3"], heart: Shape, true: Float[Floats, "T V 3"]) -> Float[Floats, "T N 3"]:
    """Return the true paths of points on the first frame."""
    unit = float(np.sqrt(heart.area))
    foot = Surface(true[0] / unit, heart.faces).query(points / unit)
    return np.stack([interpolate(verts, heart.faces[foot.face], foot.barycentric) for verts in true])


def row(
    way: str, found: Float[Floats, "T N 3"], true: Float[Floats, "T N 3"], faces: Int[Ints, "F 3"]
) -> dict[str, Any]:
    """Return a table row: distances of tracked points from their true paths, roughness of the paths, and strain errors."""
    off = np.linalg.norm(found - true, axis=2)[1:]
    rough, aim = (
        float(np.linalg.norm(np.roll(each, 1, 0) - 2 * each + np.roll(each, -1, 0), axis=2).mean())
        for each in (found, true)
    )
    strains = [np.stack([area_strain(verts, each[0], faces) for verts in each[1:]]) for each in (found, true)]
    return {
        **{"way": way, "mean": float(off.mean()), "high": float(np.quantile(off, 0.95))},
        **{"second": rough, "times": rough / aim, "strain": float(np.nanmean(np.abs(strains[0] - strains[1])))},
    }


def track_template(fits: Path, work: Path, way: str) -> tuple[Floats, Ints]:
    """Return the template's vertices on every frame, smoothed as ``way`` says, and its faces."""
    with tempfile.TemporaryDirectory(dir=work) as folder:
        out = Path(folder, "points")
        Collection(fits).export(out, suffix=".npz", smooth=way == "--smooth", cycle=way == "--cycle")
        with np.load(out / "coords.npz") as arrays:
            return arrays["points"], arrays["faces"]


@runner.command
def main(
    data: runner.Data = runner.DATA,
    heart: Annotated[str, Option(help="a heart of the benchmark")] = "heart01",
    frames: Annotated[int, Option(min=5)] = 20,
    work: runner.Work = None,
    threads: runner.Threads = 1,
    seed: runner.Seed = 0,
) -> runner.Report:
    shape = load_shape(data / "heart" / f"{heart}.ply")
    with tempfile.TemporaryDirectory() as temporary:
        place = work or Path(temporary)
        true = write_frames(place / "frames", shape, frames, seed)
        began = runner.cpu_seconds()
        Collection(place / "fits", workers=1).fit(place / "frames", model="none", sequence=True)
        cpu = runner.cpu_seconds() - began
        rows = []
        for way in ("as fitted", "--smooth", "--cycle"):
            points, faces = track_template(place / "fits", place, way)
            rows.append(row(way, points, paths_of(points[0], shape, true), faces))
    note = f"{frames} frames fitted in {cpu:.0f} CPU s (less where fits were reused)"
    return runner.Report(
        {"rows": rows, "cpu": round(cpu, 1)}, [runner.table("A beating heart, tracked", rows, COLUMNS)], [note]
    )
