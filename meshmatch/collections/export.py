"""Export the registered meshes of a collection to files for ParaView, 3D Slicer, R and other programs."""

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

from meshmatch.api.upright import upright_rotation_of_fit
from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.collections.covariates import SIZE, Covariates, covariates
from meshmatch.collections.motion import area_strain, smooth_frames
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
from meshmatch.shapes.formats.gltf_write import write_morphs
from meshmatch.shapes.formats.vtk import write_vtk, write_vtp
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import write_rows
from meshmatch.templates.template import Template
from meshmatch.transfer.value_files import Values, load_values

Place = Literal["files", "template"]
"""Coordinates of exported meshes: those of the shapes' files, or all aligned with the template's axes and center."""
MESHES, TABLES = (".ply", ".vtp", ".vtk", ".obj", ".off", ".stl", ".glb"), (".csv", ".npz")
ORIGINALS = (".vtp", ".vtk")
_MAX_CLIP_VERTS = 4_000_000  # vertices of all frames of an animated file, which must fit into memory
_FRAME_RATE = 24.0  # frames per second, Blender's default, so that each file is one frame there


@dataclass(frozen=True)
class Exported:
    """What `Collection.export` wrote.

    Attributes
    ----------
    files
        Names of the files in the folder.
    count
        Number of shapes.
    vertices
        Number of vertices of each.
    left_out
        Names of shapes with poor fits, which were not written.
    """

    files: tuple[str, ...]
    count: int
    vertices: int
    left_out: tuple[str, ...]


@dataclass(frozen=True)
class Export:
    """Options of an export; `OptionError` for invalid combinations.

    Attributes
    ----------
    suffix
        Suffix of a mesh for each shape, or of one table of all coordinates.
    place
        Coordinates, see `Place`.
    original
        Write the original shapes, with values at their vertices, instead of the registered meshes.
    values
        A file of values of the template's vertices, to add to the original shapes.
    metadata
        A table with a row for each shape, to add to metadata.csv.
    smooth
        Smooth the frames of sequences in time.
    cycle
        Smooth in time, as a cycle: the last frame is followed by the first.
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
            raise OptionError("values go with the original meshes", "add --original (`original`)")

    def into(self, output: str | Path) -> Export:
        """Return self; `OptionError` if the output folder has the suffix of a file, probably by mistake."""
        path = as_path(output)
        if (ending := path.suffix.lower()) in (*MESHES, *TABLES) and not path.is_dir():
            what = f"{path.name} must be a folder, but is named like a file"
            raise OptionError(what, f"name the folder {path.stem}, and the files --format {ending}")
        return self


@dataclass(frozen=True, eq=False)
class Fits:
    """The fits to export: names of shapes, functions that give the fit and the places of each, their files, the template.

    ``sequence``: shapes of a folder are frames, and ``names`` are sorted by folder, then in natural order. ``times`` are
    the indices of all frames in their sequences, including those that are not exported.
    """

    names: Sequence[str]
    fit_of: Callable[[str], Fit]
    places_of: Callable[[str], Places]
    files: Mapping[str, str]
    template: Template
    sequence: bool
    times: Mapping[str, int] = field(default_factory=dict)


def mesh_of(fit: Fit, place: Place) -> Shape:
    """The registered mesh of a fit, in the unit of the shape's file."""
    return fit.shape if place == "files" else Shape(fit.points * fit.frame.scale, fit.faces)


def export(
    output: str | Path, fits: Fits, how: Export, mean: Superimposed | None, progress: ProgressCallback | None = None
) -> list[str]:
    """Write a mesh for each name, or one table of all coordinates, into a new folder; return the names of the files.

    Original shapes are compared with ``mean``, if given. `OutputError` if the folder is not empty or cannot be written.
    """
    names, metadata = fits.names, _Metadata()
    values = None if how.values is None else load_values(how.values, fits.template.shape)
    table = None if how.metadata is None else covariates(how.metadata, names, np.full(len(names), np.nan))

    rotations: dict[str, Floats | None] = {}

    def orientation_key(name: str) -> str:
        return folder_of(name) if fits.sequence else name  # all frames like the first one

    def fitted_meshes() -> Iterator[tuple[str, Shape]]:
        for number, name in enumerate(names):
            fit = fits.fit_of(name)
            metadata.add(name, fit)
            if how.place == "files":
                is_upright = Path(fits.files.get(name, "")).suffix.lower() in gltf.SUFFIXES
                rotations.setdefault(orientation_key(name), None if is_upright else upright_rotation_of_fit(fit))
            yield name, mesh_of(fit, how.place)
            if progress is not None:
                progress("exporting", name, (number + 1) / len(names))

    def meshes() -> Iterator[tuple[str, Shape]]:
        return _smooth_in_time(fitted_meshes(), fits, how.cycle) if how.smooth or how.cycle else fitted_meshes()

    is_moving = fits.sequence and how.place == "files" and not how.original

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
                if is_moving:
                    own |= _motions(names, points, own["faces"])
                np.savez(folder / files[0], allow_pickle=False, **own, **metadata.arrays())
        else:
            first: dict[str, Shape] = {}
            for name, shape in meshes():
                files.append(f"{name}{how.suffix}")
                make_folder((folder / files[-1]).parent)
                if how.original:
                    shape = _read_original(fits.files.get(name), fits.places_of(name))
                    arrays = _values_on_original(fits, name, shape, mean, values)
                    (write_vtp if how.suffix == ".vtp" else write_vtk)(folder / files[-1], shape, arrays)
                elif is_moving and how.suffix in ORIGINALS:
                    began = first.setdefault(folder_of(name), shape).verts
                    (write_vtp if how.suffix == ".vtp" else write_vtk)(
                        folder / files[-1], shape, _motion(shape.verts, began, shape.faces)
                    )
                else:
                    save_upright(folder / files[-1], shape, rotations.get(orientation_key(name)))
            if fits.sequence and how.suffix == ".vtp":
                files += _write_series(folder, names)
            if fits.sequence and how.suffix == ".glb":
                files += _write_clips(folder, fits, how.cycle)
        if how.suffix in TABLES or table is not None:
            files.append("metadata.csv")
            metadata.write(folder / files[-1], table)
        return files


def _smooth_in_time(meshes: Iterator[tuple[str, Shape]], fits: Fits, cycle: bool) -> Iterator[tuple[str, Shape]]:
    """Yield the frames of each sequence, smoothed in time; ``meshes`` are read once, in order."""
    moments = Counter(map(folder_of, fits.times))
    for folder, own in groupby(fits.names, folder_of):
        names = list(own)
        faces: list[Ints] = []

        def read(_: int, faces: list[Ints] = faces) -> Floats:
            shape = next(meshes)[1]
            faces.append(shape.faces)
            return shape.verts

        with load_points(len(names), fits.template.shape.V, read) as points:
            frames = smooth_frames(points, faces[0], [fits.times[name] for name in names], cycle, moments[folder])
            for name, verts, own_faces in zip(names, frames, faces, strict=True):
                yield name, Shape(verts, own_faces, name)


def _motion(verts: Floats, first: Floats, faces: Int[Ints, "F 3"]) -> dict[str, np.ndarray]:
    """Displacement and area strain of a frame since the first one of its sequence."""
    return {"displacement": verts - first, "area_strain": area_strain(verts, first, faces)}


def _motions(names: Sequence[str], points: Floats, faces: Int[Ints, "F 3"]) -> dict[str, np.ndarray]:
    """Displacement and area strain of all frames, stacked."""
    first = {folder_of(name): k for k, name in reversed(list(enumerate(names)))}
    found = [_motion(own, points[first[folder_of(name)]], faces) for name, own in zip(names, points, strict=True)]
    return {title: np.stack([each[title] for each in found]) for title in found[0]}


class _Metadata:
    """Properties of the exported shapes, collected for metadata.csv."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.sizes: list[float] = []
        self.mirrored: list[bool] = []
        self.verdicts: list[str] = []

    def add(self, name: str, fit: Fit) -> None:
        """Append a shape."""
        points = fit.points * fit.frame.scale
        self.names.append(name)
        self.sizes.append(float(np.linalg.norm(points - points.mean(axis=0))))
        self.mirrored.append(fit.frame.mirrored)
        self.verdicts.append(fit.verdict)

    def arrays(self) -> dict[str, np.ndarray]:
        """The properties that go into an .npz file."""
        return {"centroid_size": np.array(self.sizes), "mirrored": np.array(self.mirrored)}

    def write(self, path: Path, table: Covariates | None) -> None:
        """Write a row for each shape: its properties, then the cells of the user's table."""
        own = {"name": self.names, "centroid_size": self.sizes, "mirrored": [int(each) for each in self.mirrored]}
        own["verdict"] = self.verdicts
        if units := mixed_units(self.names, self.sizes):
            warn(units)
        more = {} if table is None else {title: cells for title, cells in table.cells.items() if title not in own}
        if table is not None and (lost := [title for title in table.cells if title in own]):
            warn(f"metadata.csv has columns of its own called {', '.join(lost)}; those of the table are left out")
        if set(more.get(SIZE, ())) == {"nan"}:  # a placeholder that was filled in because the table has no sizes
            del more[SIZE]
        write_rows(path, [*own, *more], zip(*own.values(), *more.values(), strict=True))


def _read_original(file: str | None, places: Places) -> Shape:
    """Read the original shape of a fit; `InputError` if its file has changed or is not known."""
    if file is None:
        raise InputError(f"fits.csv does not say which file {places.name} was", "run `meshmatch fit` again")
    shape = load_shape(file)
    if shape.hash != places.hash:
        raise InputError(f"{file} has changed since it was fitted", "run `meshmatch fit` again")
    return shape


def _values_on_original(
    fits: Fits, name: str, shape: Shape, mean: Superimposed | None, values: Values | None
) -> dict[str, np.ndarray]:
    """Values at the vertices of an original shape.

    These are the distance and displacement from the mean (in the axes and unit of the file), the thickness of meshes,
    labels of the template's parts, and the user's values of the template.
    """
    fit, template = fits.fit_of(name), fits.template
    foot = fits.places_of(name).on(template.shape)
    arrays: dict[str, np.ndarray] = {}
    if mean is not None:
        own = fit.points * fit.frame.scale
        there = mean.poses(own[None]).undo(mean.consensus[None])[0]  # the mean, aligned with this shape
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
    """Write a ParaView collection (.pvd) of the frames of each folder; return the names of the files."""
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
    """Write the frames of each folder as one animated .glb, made of the files written before; return the names."""
    files, taken, moments = [], set(fits.names), Counter(map(folder_of, fits.times))
    for where, own in groupby(fits.names, folder_of):
        names = list(own)
        if len(names) < 2:
            continue
        if len(names) * fits.template.shape.V > _MAX_CLIP_VERTS:
            warn(f"{where or 'the sequence'} is too large for one animated .glb; ParaView plays the frames as .vtp")
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
        seconds = (np.array(times) - times[0]) / _FRAME_RATE
        write_morphs(folder / files[-1], replace(first, name=where or "sequence"), targets, seconds)
    return files


def _write_table(path: Path, meshes: Iterator[tuple[str, Shape]]) -> None:
    """Write a row for each shape: its name, then x, y and z of vertex 0, of vertex 1, ... (for `geomorph::arrayspecs`)."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        for number, (name, shape) in enumerate(meshes):
            if number == 0:
                rows.writerow(["name", *(f"{axis}{vertex}" for vertex in range(shape.V) for axis in "xyz")])
            rows.writerow([name, *_format_coordinates(shape.verts)])


def _format_coordinates(verts: Float[Floats, "V 3"]) -> list[str]:
    return [repr(each) for each in verts.ravel().tolist()]
