"""The template on every shape of a collection as files: for ParaView, 3D Slicer, R and others."""

from __future__ import annotations

import csv
import html
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from meshmatch.api.upright import turn_of_fit
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.collections.covariates import SIZE, Covariates, covariates
from meshmatch.collections.motion import area_strain, smoothed
from meshmatch.collections.registered import load_points, mixed_units
from meshmatch.collections.sources import folder_of
from meshmatch.collections.superimpose import Superimposed
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.inscribed import inscribed_diameters
from meshmatch.geometry.triangles import vertex_normals
from meshmatch.maps.places import Places
from meshmatch.outputs import as_path, folder_on_success, make_folder
from meshmatch.progress import ProgressCallback
from meshmatch.shapes.files import load_shape, save_upright
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_out import write_morphs
from meshmatch.shapes.formats.vtk import write_vtk, write_vtp
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows
from meshmatch.templates.template import Template
from meshmatch.transfer.value_files import Values, load_values

Place = Literal["files", "template"]
"""Where exported meshes lie: where their files have the shapes, or all with the axes of the template, about its center."""
MESHES, TABLES = (".ply", ".vtp", ".vtk", ".obj", ".off", ".stl", ".glb"), (".csv", ".npz")
ORIGINALS = (".vtp", ".vtk")
_MOVING = 4_000_000  # vertices of all frames of one moving file, which are held while it is written
_RATE = 24.0  # frames a second, as Blender has them: so that each file is a frame there


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


@dataclass(frozen=True)
class Export:
    """How a collection is exported; `OptionError` for what cannot be.

    Attributes
    ----------
    suffix
        Of a mesh for each shape, or of one table of all coordinates.
    place
        Where the coordinates are.
    original
        Write the shapes themselves, with what is known of their vertices, instead of the template on each of them.
    values
        A file of numbers of the template's vertices that go with the shapes then.
    metadata
        A table with a row for each shape, which metadata.csv then has too.
    smooth
        Smooth the frames of sequences in time.
    cycle
        The same, and the last frame is followed by the first.
    """

    suffix: str = ""
    place: Place = "files"
    original: bool = False
    values: str | Path | None = None
    metadata: str | Path | None = None
    smooth: bool = False
    cycle: bool = False

    def __post_init__(self) -> None:
        suffix = f".{self.suffix.removeprefix('.').lower()}" if self.suffix else ".vtp" if self.original else ".ply"
        object.__setattr__(self, "suffix", suffix)
        if self.place not in get_args(Place):
            raise OptionError(f"invalid place {self.place!r}", f"choose one of {', '.join(get_args(Place))}")
        known = ORIGINALS if self.original else (*MESHES, *TABLES)
        if suffix not in known:
            what = "original" if self.original else "registered"
            raise OptionError(f"{what} meshes are not exported as {suffix[:20]}", f"choose one of {', '.join(known)}")
        if self.original and self.place != "files":
            raise OptionError("original meshes stay where their files have them", "leave the place out")
        if (self.smooth or self.cycle) and (self.original or self.place != "files"):
            what = "frames are smoothed as registered meshes, where their files have them"
            raise OptionError(what, "leave out the originals and the place")
        if self.values is not None and not self.original:
            raise OptionError("values go with the original meshes", "ask for these: original, --original")

    def into(self, output: str | Path) -> Export:
        """The same; `OptionError` for a folder that is named as one of the files would be."""
        path = as_path(output)
        if (ending := path.suffix.lower()) in (*MESHES, *TABLES) and not path.is_dir():
            what = f"{path.name} is to be a folder, and is named as a file"
            raise OptionError(what, f"name the folder {path.stem}, and the files --format {ending}")
        return self


@dataclass(frozen=True, eq=False)
class Fits:
    """What is exported: names of shapes, and what gives the fit, the places and the file of each; the template of all.

    ``sequence``: shapes of a folder are frames; ``names`` are those of one folder after the other then, in natural order.
    ``times`` are the places of all frames in their sequence, also of those that are not exported.
    """

    names: Sequence[str]
    fit_of: Callable[[str], Fit]
    places_of: Callable[[str], Places]
    files: Mapping[str, str]
    template: Template
    sequence: bool
    times: Mapping[str, int] = field(default_factory=dict)


def mesh_of(fit: Fit, place: Place) -> Shape:
    """The template as a fit has it, in the unit of the shape's file."""
    return fit.shape if place == "files" else Shape(fit.points * fit.frame.scale, fit.faces)


def export(
    output: str | Path, fits: Fits, how: Export, mean: Superimposed | None, progress: ProgressCallback | None = None
) -> list[str]:
    """Write a mesh for each name, or one table of all coordinates, into a new folder; the names of the files.

    ``mean`` is what the originals are compared with, where there is one. `OutputError` where the folder is not empty, or
    cannot be written.
    """
    names, facts = fits.names, _Facts()
    values = None if how.values is None else load_values(how.values, fits.template.shape)
    table = None if how.metadata is None else covariates(how.metadata, names, np.full(len(names), np.nan))

    turns: dict[str, Floats | None] = {}

    def stands_like(name: str) -> str:
        return folder_of(name) if fits.sequence else name  # frames as the first of them

    def plain() -> Iterator[tuple[str, Shape]]:
        for number, name in enumerate(names):
            fit = fits.fit_of(name)
            facts.add(name, fit)
            if how.place == "files":
                stands = Path(fits.files.get(name, "")).suffix.lower() in gltf.SUFFIXES
                turns.setdefault(stands_like(name), None if stands else turn_of_fit(fit))
            yield name, mesh_of(fit, how.place)
            if progress is not None:
                progress("exporting", name, (number + 1) / len(names))

    def meshes() -> Iterator[tuple[str, Shape]]:
        return _in_time(plain(), fits, how.cycle) if how.smooth or how.cycle else plain()

    moves = fits.sequence and how.place == "files" and not how.original

    with folder_on_success(output) as folder:
        files = []
        if how.suffix == ".csv":
            files.append("coords.csv")
            _write_table(folder / files[0], meshes())
        elif how.suffix == ".npz":
            files.append("coords.npz")
            each = meshes()
            with load_points(len(names), fits.template.shape.V, lambda number: next(each)[1].verts) as points:
                own = {"points": points, "faces": np.asarray(fits.template.shape.faces), "names": np.array(names)}
                if moves:
                    own |= _motions(names, points, own["faces"])
                np.savez(folder / files[0], allow_pickle=False, **own, **facts.arrays())
        else:
            first: dict[str, Shape] = {}
            for name, shape in meshes():
                files.append(f"{name}{how.suffix}")
                make_folder((folder / files[-1]).parent)
                if how.original:
                    shape = _original(fits.files.get(name), fits.places_of(name))
                    arrays = _on_original(fits, name, shape, mean, values)
                    (write_vtp if how.suffix == ".vtp" else write_vtk)(folder / files[-1], shape, arrays)
                elif moves and how.suffix in ORIGINALS:
                    began = first.setdefault(folder_of(name), shape).verts
                    (write_vtp if how.suffix == ".vtp" else write_vtk)(
                        folder / files[-1], shape, _motion(shape.verts, began, shape.faces)
                    )
                else:
                    save_upright(folder / files[-1], shape, turns.get(stands_like(name)))
            if fits.sequence and how.suffix == ".vtp":
                files += _write_series(folder, names)
            if fits.sequence and how.suffix == ".glb":
                files += _write_clips(folder, fits, how.cycle)
        if how.suffix in TABLES or table is not None:
            files.append("metadata.csv")
            facts.write(folder / files[-1], table)
        return files


def _in_time(meshes: Iterator[tuple[str, Shape]], fits: Fits, cycle: bool) -> Iterator[tuple[str, Shape]]:
    """The frames of each sequence, smoothed in time."""
    moments = Counter(map(folder_of, fits.times))
    for folder, own in groupby(fits.names, folder_of):
        names = list(own)
        faces: list[Ints] = []

        def read(_: int, faces: list[Ints] = faces) -> Floats:
            shape = next(meshes)[1]
            faces.append(shape.faces)
            return shape.verts

        with load_points(len(names), fits.template.shape.V, read) as points:
            frames = smoothed(points, faces[0], [fits.times[name] for name in names], cycle, moments[folder])
            for name, verts, own_faces in zip(names, frames, faces, strict=True):
                yield name, Shape(verts, own_faces, name)


def _motion(verts: Floats, first: Floats, faces: Int[Ints, "F 3"]) -> dict[str, np.ndarray]:
    """How a frame has moved since the first one of its sequence."""
    return {"displacement": verts - first, "area_strain": area_strain(verts, first, faces)}


def _motions(names: Sequence[str], points: Floats, faces: Int[Ints, "F 3"]) -> dict[str, np.ndarray]:
    """The same of all frames."""
    first = {folder_of(name): k for k, name in reversed(list(enumerate(names)))}
    found = [_motion(own, points[first[folder_of(name)]], faces) for name, own in zip(names, points, strict=True)]
    return {title: np.stack([each[title] for each in found]) for title in found[0]}


class _Facts:
    """What is known of each shape that was exported, for a table."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.sizes: list[float] = []
        self.mirrored: list[bool] = []
        self.verdicts: list[str] = []

    def add(self, name: str, fit: Fit) -> None:
        points = fit.points * fit.frame.scale
        self.names.append(name)
        self.sizes.append(float(np.linalg.norm(points - points.mean(axis=0))))
        self.mirrored.append(fit.frame.mirrored)
        self.verdicts.append(fit.verdict)

    def arrays(self) -> dict[str, np.ndarray]:
        return {"centroid_size": np.array(self.sizes), "mirrored": np.array(self.mirrored)}

    def write(self, path: Path, table: Covariates | None) -> None:
        """A row a shape: what is known, then the cells of the user's table."""
        own = {"name": self.names, "centroid_size": self.sizes, "mirrored": [int(each) for each in self.mirrored]}
        own["verdict"] = self.verdicts
        if units := mixed_units(self.names, self.sizes):
            warn(units)
        more = {} if table is None else {title: cells for title, cells in table.cells.items() if title not in own}
        if set(more.get(SIZE, ())) == {"nan"}:  # which a table without it has been given
            del more[SIZE]
        write_rows(path, [*own, *more], zip(*own.values(), *more.values(), strict=True))


def _original(file: str | None, places: Places) -> Shape:
    if file is None:
        raise InputError(f"fits.csv does not say which file {places.name} was", "run `meshmatch fit` again")
    shape = load_shape(file)
    if shape.hash != places.hash:
        raise InputError(f"{file} has changed since it was fitted", "run `meshmatch fit` again")
    return shape


def _on_original(
    fits: Fits, name: str, shape: Shape, mean: Superimposed | None, values: Values | None
) -> dict[str, np.ndarray]:
    """Numbers at the vertices of a shape's file: how far each lies from the mean, in the file's axes and unit; how thick a
    mesh is; parts of the template; other values of it.
    """
    fit, template = fits.fit_of(name), fits.template
    foot = fits.places_of(name).on(template.shape)
    arrays: dict[str, np.ndarray] = {}
    if mean is not None:
        own = fit.points * fit.frame.scale
        there = mean.poses(own[None]).undo(mean.consensus[None])[0]  # the mean, laid over this shape
        moved = own - there
        outwards = np.einsum("vi,vi->v", moved, vertex_normals(there, fit.faces))
        carried = foot.values(fit.faces, np.column_stack([outwards, moved @ fit.frame.rotation]))
        arrays |= {"distance_to_mean": carried[:, 0], "displacement": carried[:, 1:]}
    if not shape.is_cloud:
        arrays["thickness"] = inscribed_diameters(shape.verts, shape.faces[shape.valid_faces])
    if len(template.label_names) > 1:
        arrays["label"] = template.labels[foot.vertex]
    if values is not None:
        numbers = values.numbers.reshape(template.shape.V, -1)
        titles = values.names or tuple(f"value_{k}" for k in range(numbers.shape[1]))
        arrays |= dict(zip(titles, foot.values(fit.faces, numbers).T, strict=True))
    return arrays


def _write_series(folder: Path, names: Sequence[str]) -> list[str]:
    """ParaView's list of the frames of each folder, in their order."""
    frames: dict[str, list[str]] = {}
    for name in names:
        frames.setdefault(folder_of(name), []).append(name.rpartition("/")[2])
    files = []
    for where, own in frames.items():
        rows = [f'<DataSet timestep="{k}" file="{html.escape(name)}.vtp"/>' for k, name in enumerate(own)]
        head = '<VTKFile type="Collection" version="1.0" byte_order="LittleEndian"><Collection>'
        lines = ['<?xml version="1.0"?>', head, *rows, "</Collection></VTKFile>"]
        files.append(f"{where}/sequence.pvd".lstrip("/"))
        (folder / files[-1]).write_text("\n".join(lines) + "\n", encoding="utf-8")
    return files


def _write_clips(folder: Path, fits: Fits, cycle: bool) -> list[str]:
    """The frames of each folder as one mesh that moves, at their times; of what was written."""
    files, taken, moments = [], set(fits.names), Counter(map(folder_of, fits.times))
    for where, own in groupby(fits.names, folder_of):
        names = list(own)
        if len(names) < 2:
            continue
        if len(names) * fits.template.shape.V > _MOVING:
            warn(f"{where or 'the sequence'} is too large for one moving .glb; ParaView plays the frames as .vtp")
            continue
        title = f"{where}/sequence".lstrip("/")
        while title in taken:
            title += "-"
        files.append(f"{title}.glb")
        first, *others = (load_shape(folder / f"{name}.glb") for name in names)
        targets = {name.rpartition("/")[2]: each.verts for name, each in zip(names[1:], others, strict=True)}
        times = [fits.times[name] for name in names]
        if cycle:
            times.append(times[0] + moments[where])
        seconds = (np.array(times) - times[0]) / _RATE
        write_morphs(folder / files[-1], replace(first, name=where or "sequence"), targets, seconds)
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
