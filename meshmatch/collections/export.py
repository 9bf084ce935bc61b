"""The template on every shape of a collection as files: for ParaView, 3D Slicer, R and others."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.collections.registered import held
from meshmatch.errors import OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.outputs import folder_on_success, make_folder
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape

Place = Literal["files", "template"]
"""Where exported meshes lie: where their files have the shapes, or all with the axes of the template, about its center."""
MESHES, TABLES = (".ply", ".vtp", ".vtk", ".obj", ".off", ".stl", ".glb"), (".csv", ".npz")


@dataclass(frozen=True)
class Exported:
    """What `Collection.export` wrote.

    Attributes
    ----------
    files
        Names in the folder.
    count
        How many shapes there are.
    vertices
        How many vertices each has.
    left_out
        Names of poor fits that were not written.
    """

    files: tuple[str, ...]
    count: int
    vertices: int
    left_out: tuple[str, ...]


def check_export(suffix: str, place: str) -> str:
    """A suffix with its dot; `OptionError` where nothing is exported in it, or the place is unknown."""
    suffix = f".{suffix.removeprefix('.').lower()}"
    if place not in get_args(Place):
        raise OptionError(f"invalid place {place!r}", f"choose one of {', '.join(get_args(Place))}")
    if suffix not in (*MESHES, *TABLES):
        hint = f"choose one of {', '.join((*MESHES, *TABLES))}"
        raise OptionError(f"registered meshes are not exported as {suffix[:20]}", hint)
    return suffix


def mesh_of(fit: Fit, place: Place) -> Shape:
    """The template as a fit has it, in the unit of the shape's file."""
    return fit.shape if place == "files" else Shape(fit.points * fit.frame.scale, fit.faces)


def export(
    output: str | Path,
    names: list[str],
    fit_of: Callable[[str], Fit],
    suffix: str,
    place: Place,
    progress: ProgressCallback | None = None,
) -> list[str]:
    """Write a mesh for each name, or one table of all coordinates, into a new folder; the names of the files.

    `OutputError` where the folder is not empty, or cannot be written.
    """

    def meshes() -> Iterator[tuple[str, Shape]]:
        for number, name in enumerate(names):
            yield name, mesh_of(fit_of(name), place)
            if progress is not None:
                progress("exporting", name, (number + 1) / len(names))

    with folder_on_success(output) as folder:
        if suffix == ".csv":
            _write_table(folder / "coords.csv", meshes())
            return ["coords.csv"]
        if suffix == ".npz":
            first = fit_of(names[0])
            each = meshes()
            with held(len(names), len(first.points), lambda number: next(each)[1].verts) as points:
                np.savez(folder / "coords.npz", points=points, faces=first.faces, names=np.array(names))
            return ["coords.npz"]
        files = []
        for name, shape in meshes():
            files.append(f"{name}{suffix}")
            make_folder((folder / files[-1]).parent)
            save_shape(folder / files[-1], shape)
        return files


def _write_table(path: Path, meshes: Iterator[tuple[str, Shape]]) -> None:
    """A row a shape: its name, then x, y and z of each vertex in turn, as `geomorph::arrayspecs` takes them apart."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        for number, (name, shape) in enumerate(meshes):
            if number == 0:
                rows.writerow(["name", *(f"{axis}{vertex}" for vertex in range(shape.V) for axis in "xyz")])
            rows.writerow([name, *_plain(shape.verts)])


def _plain(verts: Float[Floats, "V 3"]) -> list[str]:
    return [repr(each) for each in verts.ravel().tolist()]
