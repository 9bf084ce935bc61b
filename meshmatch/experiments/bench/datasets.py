"""Check a folder of evaluation data: one line for each set, and what is wrong with it.

docs/datasets.md says where the sets come from and how they are laid out. Every shape is read; its triangles, and the
vertices that its truth names, must exist; all shapes of a set must have as many landmarks. Status 1 where a set lacks
something. A set may have more or other shapes than the published numbers are of, which stand beside.
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
    """How a set lies in its folder.

    Parameters
    ----------
    published : number of shapes that docs/results.md is of
    suffix : of the file of what is true of each shape; empty where there is none
    columns : of that file: 1 a vertex for each landmark, 2 a row for each vertex
    words : what is true, where not every shape's landmarks are counted
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
"""Folders of ply files."""
TEXTURED = ("Rogue.glb", "Rogue_Hooded.glb", "spot_triangulated.obj")


def checked_truth(path: Path, layout: Layout, shape: Shape) -> int:
    """Number of landmarks of a shape; of rows where each vertex has one.

    Raises
    ------
    InputError
        The file is not there, is no array of integers of the right shape, or names a vertex that the shape lacks.
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
    """What is in a folder of ply files; "pairs" where the benchmark has a protocol for it."""
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
    """What some shapes are like."""
    sizes = {"vertices": _range(each.V for each in shapes), "faces": _range(each.F for each in shapes)}
    return {"shapes": len(shapes), **sizes, "truth": truth}


def check_textured(folder: Path) -> dict[str, Any]:
    """The shapes with textures."""
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
"""By set: how many shapes the published numbers are of, and what looks at it."""


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
