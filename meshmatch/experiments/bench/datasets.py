"""Check a folder of evaluation data: one line for each set, and what is wrong with it.

docs/datasets.md says where the sets come from and how they are laid out. Every shape is read and must have triangles; the
vertices named by its ground truth must exist; all shapes of a set must have the same number of landmarks. The exit status
is 1 if a set is incomplete. A set may have more or other shapes than the published numbers used; "published" is their count.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from typer import Argument, Option

from meshmatch.errors import InputError, MeshmatchError
from meshmatch.experiments import runner
from meshmatch.experiments.bench.sets import OUTLIERS_FILE, SET_NAMES, load_clouds, load_set
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape

HINT = "docs/datasets.md says where each set comes from and how it is laid out"
COLUMNS = {"set": "set", "shapes": "shapes:d", "published": "published:d", "vertices": "vertices:>", "faces": "faces:>"}
COLUMNS |= {"truth": "truth", "pairs": "pairs:d", "found": "state"}


@dataclass(frozen=True)
class Layout:
    """Layout of the folder of a set.

    Parameters
    ----------
    published : number of shapes used for docs/results.md
    suffix : suffix of each shape's ground truth file; empty if there is none
    columns : columns of that file: 1 for a vertex per landmark, 2 for a row per vertex
    words : description of the ground truth, unless it is the number of landmarks
    """

    published: int
    suffix: str = ""
    columns: int = 1
    words: str = "none"


LAYOUTS = {
    "shrec19": Layout(18, ".landmarks.npy"),
    "scape": Layout(20, words="vertex i is vertex i"),
    "faust": Layout(30, ".landmarks.npy"),
    "faust_scans": Layout(10),
    "heart": Layout(10, ".truth.npy", 2, "every vertex"),
    **dict.fromkeys(("chair", "table", "plane"), Layout(10, ".keypoints.npy")),
    "animal": Layout(32, ".landmarks.npy"),
}
"""Layouts of the sets that are folders of ply files."""
TEXTURED = ("Rogue.glb", "Rogue_Hooded.glb", "spot_triangulated.obj")


def checked_truth(path: Path, layout: Layout, shape: Shape) -> int:
    """Check the ground truth of a shape and return its number of rows: one for each landmark, or for each vertex.

    Raises
    ------
    InputError
        The file is missing, is not an integer array of the right shape, or names a vertex that does not exist.
    """
    try:
        truth = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}") from error
    rows = truth.shape[0] if truth.ndim else 0
    wanted = (shape.V, layout.columns) if layout.columns > 1 else (rows,)
    if truth.dtype.kind not in "iu" or not rows or truth.shape != wanted:
        raise InputError(f"{path} holds {truth.dtype} {truth.shape}, not integers {wanted if rows else '(N,)'}")
    if layout.columns == 1 and (truth.min() < 0 or truth.max() >= shape.V):
        raise InputError(f"{path} names vertex {truth.max()} of {shape.V}")
    return rows


def check_shapes(name: str, layout: Layout, folder: Path) -> dict[str, Any]:
    """Check a folder of ply files and return its table row; "pairs" is None without a protocol for pairs."""
    files = runner.files_in(folder / name, "*.ply")
    shapes = [load_shape(file) for file in runner.track(files, name)]
    if flat := [file.name for file, shape in zip(files, shapes, strict=True) if shape.is_cloud]:
        raise InputError(f"{folder / name / flat[0]} has no faces")
    words, counts = layout.words, {shape.V for shape in shapes} if name == "scape" else set()
    if layout.suffix:
        truths = [file.with_name(file.stem + layout.suffix) for file in files]
        marks = [checked_truth(path, layout, shape) for path, shape in zip(truths, shapes, strict=True)]
        if layout.columns == 1:
            words, counts = f"{marks[0]:,} landmarks", set(marks)
    if len(counts) > 1:
        raise InputError(f"shapes in {folder / name} have different numbers of landmarks: {_range(counts)}")
    return row_of(shapes, words) | {"pairs": len(load_set(name, folder).pairs) if name in SET_NAMES else None}


def row_of(shapes: Collection[Shape], truth: str) -> dict[str, Any]:
    """Summarise shapes: their number, and the ranges of their vertices and faces."""
    sizes = {"vertices": _range(each.V for each in shapes), "faces": _range(each.F for each in shapes)}
    return {"shapes": len(shapes), **sizes, "truth": truth}


def check_textured(folder: Path) -> dict[str, Any]:
    """Check the textured shapes and return their table row."""
    paths = [folder / "textured" / name for name in TEXTURED]
    if missing := [path for path in paths if not path.is_file()]:
        raise InputError(f"there is no {missing[0]}")
    return row_of([load_shape(path) for path in paths], "none")


def _range(numbers: Iterable[int]) -> str:
    least, *_, most = sorted([*numbers] * 2)
    return f"{least:,}" if least == most else f"{least:,} to {most:,}"


CHECKS: dict[str, tuple[int, Callable[[Path], dict[str, Any]]]] = {
    **{name: (layout.published, partial(check_shapes, name, layout)) for name, layout in LAYOUTS.items()},
    OUTLIERS_FILE: (30, lambda folder: row_of(load_clouds(folder).values(), "row i is row i")),
    "textured": (3, check_textured),
}
"""For each set, the number of shapes used for the published numbers, and the function that checks it."""


@runner.command
def main(
    data: Annotated[Path, Argument(help="folder of the evaluation data")] = runner.DATA,
    sets: Annotated[str, Option(help=f"of {', '.join(CHECKS)}")] = ",".join(CHECKS),
) -> runner.Report:
    rows: list[dict[str, Any]] = []
    wrong: list[str] = []
    for name in runner.split_names(sets, CHECKS, "set"):
        published, look = CHECKS[name]
        row = {"set": name, "published": published}
        try:
            rows.append(row | look(data) | {"state": "complete"})
        except MeshmatchError as error:
            rows.append(row | {"state": "lacks something", "problem": error.message})
            wrong.append(error.message)
    stopped = None
    if wrong:
        stopped = InputError(f"{len(wrong)} of {len(rows)} sets lack something: {'; '.join(wrong)}", HINT)
    return runner.Report({"sets": rows}, [runner.table(str(data), rows, COLUMNS)], stopped=stopped)
