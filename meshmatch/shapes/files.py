"""Read shapes from files, arrays and meshes of other libraries, and write them to files.

The suffix determines the format. All vertices of a file are kept, in the file's order, because a map must answer for
each of them: nothing is merged, split or dropped here (`meshmatch.shapes.repair` does that). Polygons are triangulated.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch import blender
from meshmatch.arrays import Bool, Bools, Float, Floats, TensorLike, as_numbers, to_numpy
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.outputs import as_path, plain_text, replace_on_success
from meshmatch.shapes import tables
from meshmatch.shapes.colors import INVISIBLE
from meshmatch.shapes.formats import (
    NO_FACES,
    Raw,
    gltf,
    gltf_write,
    label_maps,
    obj,
    off,
    ply,
    point_files,
    stl,
    vtk,
    vtk_xml,
)
from meshmatch.shapes.input_files import LABEL_MAP_SUFFIXES, check_input_file, read_bytes, suffix_of
from meshmatch.shapes.other_libraries import HINT, arrays_of, as_faces
from meshmatch.shapes.parts import Parts
from meshmatch.shapes.shape import Shape

_FORMATS: dict[str, tuple[Callable[[Path, bytes], Raw], Callable[[Path, Shape], None] | None]] = {
    ".ply": (ply.read, ply.write),
    ".obj": (obj.read, obj.write),
    ".off": (off.read, off.write),
    ".stl": (stl.read, stl.write),
    ".glb": (gltf.read, gltf_write.write),
    **dict.fromkeys(gltf.SUFFIXES[1:], (gltf.read, None)),
    ".xyz": (point_files.read_xyz, point_files.write_xyz),
    ".pcd": (ply.read_pcd, None),
    ".npy": (point_files.read_points, point_files.write_points),
    ".vtk": (vtk.read, vtk.write_vtk),
    ".vtp": (vtk_xml.read, vtk.write_vtp),
    ".vtu": (vtk_xml.read, None),
    **dict.fromkeys(LABEL_MAP_SUFFIXES, (label_maps.read, None)),
}
_WRITERS = {suffix: write for suffix, (_, write) in _FORMATS.items() if write is not None}
SUFFIXES = tuple(_FORMATS)
"""Suffixes that `load_shape` reads."""
PLAIN_SUFFIXES = tuple(suffix for suffix in SUFFIXES if suffix not in blender.SUFFIXES)
"""Suffixes that need no Blender; only these are searched for in folders."""
check_suffix = partial(tables.check_suffix, suffixes=_WRITERS, what="shapes")
_CLOUD_SUFFIXES = (".xyz", ".npy")  # formats without faces

_MAX_LISTED = 10  # maximum number of labels in a message

Choice: TypeAlias = str | int | Sequence[str | int]
"""Meshes of a scene by name, or parts of a mesh by number: one or several."""


def load_shape(path: str | Path, *, only: Choice = (), without: Choice = ()) -> Shape:
    """Read a mesh or a point cloud without changes: all vertices, in file order.

    A vertex whose position is not finite keeps its place and is marked in `Shape.invalid`. The scene of a glb or gltf
    is one shape: its meshes one after the other, each where the scene places it. An stl has no shared vertices: every
    corner of every triangle is a vertex, 3 F of them.

    Parameters
    ----------
    path
        Its suffix determines the format.
    only
        Parts or, of a scene, meshes to fit; the vertices of all others get weight 0, so that fits ignore them, but they
        keep their places. A name is that of a mesh or its node and may contain ``*`` and ``?``; case is ignored. A
        number is that of a part, see `meshmatch info`.
    without
        The opposite: parts or meshes to ignore.

    Returns
    -------
    Shape
        In the file's frame and unit.

    Raises
    ------
    InputError
        The file is missing, empty, truncated, of an unknown format, or has no usable vertex; or none of its meshes has
        a given name.

    Examples
    --------
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> dancer.verts, dancer.faces  # (V, 3) unit of the file, (F, 3)
    >>> dressed = meshmatch.load_shape("templates/samples/dancer-textured.glb")
    """
    return load_shapes([path], only=only, without=without)[0]


def load_shapes(paths: Sequence[str | Path], *, only: Choice = (), without: Choice = ()) -> list[Shape]:
    """Read shapes as `load_shape` does; each name and number must occur in at least one of them.

    A shape that lacks a name or number ignores it. Errors are those of `load_shape`.
    """
    names = [[each] if isinstance(each, str | int) else list(each) for each in (only, without)]
    chosen, left_out = ([str(name) for name in each] for each in names)
    loaded = [_read(path) for path in paths]
    if not (chosen or left_out):
        for shape, raw in loaded:
            if len(raw.meshes) > 1 and _is_label_map(shape):
                labels = ", ".join(" or ".join(names) for names, _ in raw.meshes[:_MAX_LISTED])
                suffix = f" and {len(raw.meshes) - _MAX_LISTED} more" if len(raw.meshes) > _MAX_LISTED else ""
                warn(
                    f"{shape.name} holds {len(raw.meshes)} labels, and all are read: {labels}{suffix}; choose with --only"
                )
        return [shape for shape, _ in loaded]
    named_shapes = [_NamedShape(shape, raw.meshes) for shape, raw in loaded]
    for pattern in (*chosen, *left_out):
        if all(each.select(pattern) is None for each in named_shapes):
            raise _unknown_name(pattern, named_shapes)
    hint = (
        "a selection applies to every file that has such a part: choose with --only instead" if len(paths) > 1 else ""
    )
    return [each.weighted(chosen, left_out, hint) for each in named_shapes]


@dataclass(frozen=True, eq=False)
class _NamedShape:
    """A shape, and the names of its scene's meshes."""

    shape: Shape
    meshes: tuple[tuple[tuple[str, ...], int], ...]

    @cached_property
    def parts(self) -> Parts:
        return Parts.of(self.shape, bases=True)

    @cached_property
    def _connected_parts(self) -> Parts:
        """The connected parts, with the bases that they are fused with."""
        return Parts.of(self.shape) if self.parts.bases else self.parts

    def select(self, pattern: str) -> Bool[Bools, " V"] | None:
        """The vertices of the meshes that match a name, or of the part with a number; None if there is none.

        Numbers of a label map are labels only.
        """
        is_match = [any(fnmatchcase(each.lower(), pattern.lower()) for each in names) for names, _ in self.meshes]
        if any(is_match):
            return np.repeat(np.array(is_match), [count for _, count in self.meshes])
        if _is_label_map(self.shape):
            return None
        if pattern.isdecimal() and len(pattern) < 10 and 0 < int(pattern) <= len(self.parts):
            parts = self._connected_parts if int(pattern) <= len(self._connected_parts) else self.parts
            return np.asarray(parts.number == int(pattern))
        return None

    def weighted(self, only: Sequence[str], without: Sequence[str], hint: str = "") -> Shape:
        """The shape with weight 1 at selected vertices, and 0 at all others; ``hint`` is for an error if none is left."""
        selected, excluded = (
            [own for each in names if (own := self.select(each)) is not None] for names in (only, without)
        )
        if not selected and not excluded:
            return self.shape
        is_fitted = np.any(selected, axis=0) if selected else np.ones(self.shape.V, bool)
        if excluded:
            is_fitted = is_fitted & ~np.any(excluded, axis=0)
        if not (is_fitted if self.shape.is_cloud else is_fitted[self.shape.faces]).any():
            noun, nouns = ("mesh", "meshes") if self.meshes else ("part", "parts")
            raise InputError(f"no {noun} of {self.shape.name} is left", hint or f"choose fewer {nouns} to leave out")
        return replace(self.shape, weights=is_fitted.astype(float))


def _is_label_map(shape: Shape) -> bool:
    return suffix_of(Path(shape.name)) in LABEL_MAP_SUFFIXES


def _unknown_name(pattern: str, named_shapes: Sequence[_NamedShape]) -> InputError:
    files = " or ".join(each.shape.name for each in named_shapes)
    noun = "label" if any(_is_label_map(each.shape) for each in named_shapes) else "mesh"
    if pattern.isdecimal() and noun == "mesh":
        last = ", ".join(f"{each.shape.name}: {len(each.parts)}" for each in named_shapes)
        return InputError(f"{files} has no part {pattern[:20]}", f"number of parts: {last}; see `meshmatch info`")
    names = ", ".join(dict.fromkeys(names[0] for each in named_shapes for names, _ in each.meshes if names))
    if not any(each.meshes for each in named_shapes):
        hint = "meshes of .glb and .gltf files have names; of others choose parts by number, see `meshmatch info`"
        return InputError(f"{files} names no meshes to choose from", hint)
    return InputError(f"no {noun} of {files} is called {pattern[:80]!r}", f"there are: {names[:200] or 'none'}")


def _read(path: str | Path) -> tuple[Shape, Raw]:
    path = check_input_file(as_path(path), suffixes=SUFFIXES)
    suffix = suffix_of(path)
    if suffix not in _FORMATS:
        unknown = f"{path.name}: unsupported file format {suffix or '(no suffix)'}"
        raise InputError(unknown, f"meshmatch reads {', '.join(SUFFIXES)}")
    data = read_bytes(path)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN and huge numbers are handled below
        raw = _FORMATS[suffix][0](path, data)
    name = plain_text(path.name)
    shape = Shape.with_invalid(raw.verts, raw.faces, name, _visible(name, raw.colors))
    if suffix in gltf.SUFFIXES:
        shape = replace(shape, skinned=raw.skinned, upright=True, made_of=raw.made_of)
    if raw.meshes:
        shape = replace(shape, meshes=tuple((names[0] if names else "", count) for names, count in raw.meshes))
    return shape, raw


def _visible(name: str, colors: Floats | None) -> Floats | None:
    """Vertex colors; made opaque if all of them are transparent, which is never intended."""
    if colors is None or len(colors) == 0 or colors[:, 3].max() >= INVISIBLE:
        return colors
    warn(f"the colors of {name} are transparent at every vertex; they are read as opaque")
    return np.insert(colors[:, :3], 3, 1.0, axis=1)


def list_meshes(path: str | Path) -> list[tuple[str, int]]:
    """Names and numbers of vertices of a scene's meshes or a label map's labels, in the order of the vertices.

    The names are those that ``only`` and ``without`` of `load_shape` accept; formats without names give an empty list.
    Errors are those of `load_shape`.
    """
    path = check_input_file(as_path(path), suffixes=SUFFIXES)
    suffix = suffix_of(path)
    if suffix not in (*gltf.SUFFIXES, *LABEL_MAP_SUFFIXES):
        return []
    meshes = _FORMATS[suffix][0](path, read_bytes(path)).meshes
    return [(names[0] if names else "(no name)", count) for names, count in meshes]


def check_mesh_suffix(path: str | Path) -> str:
    """As `check_suffix`; `OptionError` also for a format without faces."""
    suffix = check_suffix(path)
    if suffix in _CLOUD_SUFFIXES:
        hint = f"choose one of {' '.join(each for each in _WRITERS if each not in _CLOUD_SUFFIXES)}"
        raise OptionError(f"a {suffix} file cannot hold faces", hint)
    return suffix


def save_shape(path: str | Path, shape: ShapeLike) -> None:
    """Write a shape in the format of the suffix. The file appears completely or not at all.

    All formats but stl and glb keep every bit of the positions; these have 32-bit floats, and stl no shared vertices.
    Colors are written except in stl, xyz and npy. An invalid vertex is written as nan where the format allows it (all
    but stl and glb, which get its stand-in position).

    Parameters
    ----------
    path
        The output.
    shape
        As in `match`.

    Raises
    ------
    OptionError
        The suffix cannot be written, or cannot hold clouds (stl) or faces (xyz, npy).
    InputError
        It is not a shape.
    OutputError
        The folder is missing or cannot be written.

    Examples
    --------
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> meshmatch.save_shape("dancer.obj", dancer)
    >>> meshmatch.save_shape("triangle.stl", (np.eye(3), [[0, 1, 2]]))
    """
    path, shape = as_path(path), as_shape(shape)
    suffix = (check_suffix if shape.is_cloud else check_mesh_suffix)(path)
    if suffix == ".stl" and shape.is_cloud:
        raise OptionError("an stl file cannot hold a point cloud", "choose .ply, .xyz or .npy")
    with replace_on_success(path) as temporary:
        _WRITERS[suffix](temporary, shape)


def save_upright(path: Path, shape: Shape, turn: Float[Floats, "3 3"] | None) -> bool:
    """As `save_shape`, but in a glb a node with the rotation ``turn`` makes y the up axis; return whether there is one."""
    turned = path.suffix.lower() == ".glb" and turn is not None and not np.array_equal(turn, np.eye(3))
    if turned:
        with replace_on_success(path) as temporary:
            temporary.write_bytes(gltf_write.glb_of(shape, turn))
    else:
        save_shape(path, shape)
    return turned


def as_gltf_scene(source: ShapeLike, shape: Shape) -> tuple[Path, bytes, bool]:
    """A shape as an editable glTF scene: a path, its content, and whether it is the shape's own glTF file.

    Otherwise it is a new glb with one mesh.
    """
    file = as_path(source) if isinstance(source, str | Path) else None
    if file is not None and file.suffix.lower() in gltf.SUFFIXES:
        return file, read_bytes(file), True
    return Path(shape.name or "target").with_suffix(".glb"), gltf_write.glb_of(shape), False


@runtime_checkable
class HasVertices(Protocol):
    """A mesh or point cloud of another library: ``vertices`` (V, 3) and, for a mesh, ``faces`` (F, 3)."""

    @property
    def vertices(self) -> ArrayLike: ...


@runtime_checkable
class HasPoints(Protocol):
    """A mesh or point cloud of a library that calls its vertices ``points``."""

    @property
    def points(self) -> ArrayLike: ...


Rows: TypeAlias = ArrayLike | TensorLike
"""Vertices or faces, as arrays, lists or tensors."""
ShapeLike: TypeAlias = (
    Shape | str | Path | NDArray[np.generic] | TensorLike | tuple[Rows, Rows] | HasVertices | HasPoints
)
"""A shape; its file; points (N, 3); vertices and faces, ((V, 3), (F, 3)); or an object of another library."""


def as_shape(source: ShapeLike, name: str = "") -> Shape:
    """Convert to a `Shape`: a `Shape` is returned as it is, a file is read, everything else is copied.

    Supported are meshes and clouds of trimesh (a scene becomes one shape, each mesh where its node places it), Open3D,
    vedo, PyVista, meshio, PyMeshLab and PyTorch3D (one at a time), and other objects with ``vertices`` or ``points``
    and ``faces`` or ``triangles``; with vertex colors for trimesh and Open3D. Polygons are triangulated, as those of
    files are. Torch tensors are copied from any device, without their gradient; masked values are invalid positions.
    Faces may be floats if they are whole numbers. Objects that connect their points in other ways (volumes, lines,
    strips) are refused rather than read as clouds. `name` is for messages if the source has no name.

    `InputError`: the file cannot be read, or the source is none of these.
    """
    if isinstance(source, Shape):
        return source
    if isinstance(source, str | os.PathLike):
        return load_shape(os.fspath(source))
    if isinstance(own := getattr(source, "shape", None), Shape):  # a fit has points, but in its own frame
        raise InputError(f"cannot make a shape of {type(source).__name__}", f"pass its .shape, {own.V} vertices")
    arrays = None if isinstance(source, np.ndarray | tuple | list) else arrays_of(source, name)
    if arrays is not None:
        return _from_arrays(arrays.verts, arrays.faces, name, arrays.colors)
    if isinstance(source, tuple | list) and len(source) == 2 and _array(source[0]).ndim in (2, 3):
        return _from_arrays(source[0], as_faces(source[1], source[0], name or "the shape"), name)
    if hasattr(source, "__array__") or isinstance(source, tuple | list):
        return _from_arrays(source, None, name)
    raise InputError(f"cannot make a shape of {type(source).__name__}", HINT)


def as_shapes(sources: Sequence[ShapeLike]) -> list[Shape]:
    """Convert a list with `as_shape`; `InputError` also for a single shape instead of a list."""
    check_is_list(sources)
    return [as_shape(source) for source in sources]


def check_is_list(sources: object) -> None:
    """`InputError` for a single shape, or anything else that is not a list."""
    single = isinstance(sources, str | os.PathLike | Shape | HasVertices | HasPoints)
    if single or not isinstance(sources, Iterable):
        raise InputError(f"expected a list of shapes, not {type(sources).__name__}", "write [shape]")
    if isinstance(sources, tuple) and len(sources) == 2 and _array(sources[1]).dtype.kind in "iu":
        raise InputError("expected a list of shapes, not one mesh", "write [(vertices, faces)]")


def _array(values: Any) -> NDArray[Any]:
    """The values as an array; an empty one if they do not form one, such as rows of different lengths."""
    try:
        return np.asarray(to_numpy(values))
    except (TypeError, ValueError):
        return np.empty(0)


def _from_arrays(verts: Any, faces: Any, name: str, colors: Any = None) -> Shape:
    label = name or "the shape"
    if isinstance(verts, np.ma.MaskedArray):
        verts = np.ma.filled(verts.astype(np.float64), np.nan)
    verts = as_numbers(verts, f"{label}: vertices")
    if verts.ndim == 3 and verts.shape[2] == 3:
        raise InputError(f"{label}: vertices are a batch of {verts.shape}, not (V, 3)", "pass one of them: vertices[0]")
    if verts.ndim != 2 or verts.shape[1] != 3:
        raise InputError(f"{label}: vertices must be an array of (V, 3), not {verts.shape}", HINT)
    faces = NO_FACES if faces is None else faces
    if len(faces) and np.min(faces) == 1 and np.max(faces) == len(verts):
        raise InputError(f"{label}: faces count vertices from 1 to {len(verts)}", "subtract 1: the first vertex is 0")
    return Shape.with_invalid(np.array(verts), faces, name, colors)
