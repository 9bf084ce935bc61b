"""Shapes from what users hold (files, arrays, meshes of other libraries), and to files; the format by suffix.

Every vertex that a file lists stays, in the file's order, because a map has to answer for each of them: nothing is
merged, split or dropped here (see `meshmatch.shapes.repair` for that). Polygons become triangles.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import Float, Floats, off_torch
from meshmatch.errors import InputError, OptionError, warn
from meshmatch.outputs import as_path, plain_text, replace_on_success
from meshmatch.shapes.colors import INVISIBLE
from meshmatch.shapes.formats import NO_FACES, Raw, gltf, gltf_out, obj, off, plain, ply, stl
from meshmatch.shapes.input_files import existing, read_bytes
from meshmatch.shapes.other_libraries import HINT, arrays_of, as_faces
from meshmatch.shapes.shape import Shape

_FORMATS: dict[str, tuple[Callable[[Path, bytes], Raw], Callable[[Path, Shape], None] | None]] = {
    ".ply": (ply.read, ply.write),
    ".obj": (obj.read, obj.write),
    ".off": (off.read, off.write),
    ".stl": (stl.read, stl.write),
    ".glb": (gltf.read, gltf_out.write),
    ".gltf": (gltf.read, None),
    ".xyz": (plain.read_xyz, plain.write_xyz),
    ".pcd": (ply.read_pcd, None),
    ".npy": (plain.read_points, plain.write_points),
}
_WRITERS = {suffix: write for suffix, (_, write) in _FORMATS.items() if write is not None}
SUFFIXES = tuple(_FORMATS)
"""The suffixes that `load_shape` knows; `save_shape` writes all of them but .gltf and .pcd."""


def load_shape(path: str | Path, *, only: str | Sequence[str] = (), without: str | Sequence[str] = ()) -> Shape:
    """Read a mesh or a point cloud as it is: all vertices, in file order, in the file's frame and unit.

    A vertex whose position is not a number is kept in its place and marked in `Shape.invalid`; its `verts` row is then
    the centroid of the others. The scene of a glb or gltf is one shape: its meshes one after the other, each where the
    scene puts it. An stl has no shared vertices: every corner of every triangle is a vertex, 3 F of them.

    Of a scene's meshes ``only`` those of these names, or all ``without`` those, are to be trusted: the vertices of the
    others have weight 0, so that no fit looks at them, and keep their places. A name is that of a mesh or its node, and may
    hold ``*`` and ``?``; upper and lower case count the same.

    `InputError`: the file is missing, empty, cut short, of an unknown kind, or holds no usable vertex; or no mesh of it has
    a name that is given.
    """
    return load_shapes([path], only=only, without=without)[0]


def load_shapes(
    paths: Sequence[str | Path], *, only: str | Sequence[str] = (), without: str | Sequence[str] = ()
) -> list[Shape]:
    """Read shapes as `load_shape` does. A shape whose scene lacks a name is not asked for it, but one must have it.

    Errors are those of `load_shape`.
    """
    chosen, left_out = ([names] if isinstance(names, str) else list(names) for names in (only, without))
    found = [_read(path) for path in paths]
    for pattern in (*chosen, *left_out):
        if not any(_has(raw, pattern) for _, raw in found):
            files = " or ".join(shape.name for shape, _ in found)
            known = ", ".join(dict.fromkeys(names[0] for _, raw in found for names, _ in raw.meshes if names))
            if not any(raw.meshes for _, raw in found):
                raise InputError(f"{files} names no meshes to choose from", "meshes of .glb and .gltf files have names")
            raise InputError(f"no mesh of {files} is called {pattern[:80]!r}", f"there are: {known[:200] or 'none'}")
    shapes = []
    for shape, raw in found:
        own = [[pattern for pattern in names if _has(raw, pattern)] for names in (chosen, left_out)]
        shapes.append(replace(shape, weights=_chosen(shape.name, raw, *own)) if any(own) else shape)
    return shapes


def _read(path: str | Path) -> tuple[Shape, Raw]:
    path = existing(as_path(path), suffixes=SUFFIXES)
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        unknown = f"{path.name}: unsupported file format {suffix or '(no suffix)'}"
        raise InputError(unknown, f"meshmatch reads {', '.join(SUFFIXES)}")
    data = read_bytes(path)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN and huge numbers are judged below
        raw = _FORMATS[suffix][0](path, data)
    name = plain_text(path.name)
    return Shape.with_invalid(raw.verts, raw.faces, name, _visible(name, raw.colors)), raw


def _visible(name: str, colors: Floats | None) -> Floats | None:
    """Colors of vertices; opaque where they are all transparent, which is never meant."""
    if colors is None or len(colors) == 0 or colors[:, 3].max() >= INVISIBLE:
        return colors
    warn(f"the colors of {name} are transparent at every vertex; they are read as opaque")
    return np.insert(colors[:, :3], 3, 1.0, axis=1)


def mesh_names(path: str | Path) -> dict[str, int]:
    """Names of a scene's meshes, as ``only`` and ``without`` of `load_shape` know them, and how many vertices each has; none
    for formats without names. Errors are those of `load_shape`.
    """
    path = existing(as_path(path), suffixes=SUFFIXES)
    if path.suffix.lower() not in (".glb", ".gltf"):
        return {}
    found: dict[str, int] = {}
    for names, count in gltf.read(path, read_bytes(path)).meshes:
        label = names[0] if names else "(no name)"
        found[label] = found.get(label, 0) + count
    return found


def _has(raw: Raw, pattern: str) -> bool:
    return any(_called(names, pattern) for names, _ in raw.meshes)


def _called(names: tuple[str, ...], pattern: str) -> bool:
    return any(fnmatchcase(each.lower(), pattern.lower()) for each in names)


def _chosen(name: str, raw: Raw, only: Sequence[str], without: Sequence[str]) -> Float[Floats, " V"]:
    """1 for the vertices of the meshes that are to be trusted, 0 for all others."""
    kept = [
        (not only or any(_called(names, each) for each in only)) and not any(_called(names, each) for each in without)
        for names, _ in raw.meshes
    ]
    if not any(kept):
        raise InputError(f"no mesh of {name} is left", "choose fewer meshes to leave out")
    return np.repeat(np.array(kept, float), [count for _, count in raw.meshes])


def check_suffix(path: Path) -> str:
    """The suffix in lower case; `OptionError` if shapes are not written with it."""
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise OptionError(f"cannot write a shape as {suffix or '(no suffix)'}", f"choose one of {', '.join(_WRITERS)}")
    return suffix


def save_shape(path: str | Path, shape: ShapeLike) -> None:
    """Write a shape, in the format that the suffix names. The file appears whole or not at all.

    ply, obj, off, xyz and npy keep every bit of the positions; stl and glb hold 32-bit floats, and stl no
    shared vertices. Colors go into ply, obj, off and glb. An invalid vertex is written as nan where the
    format allows (all but stl and glb, which take its stand-in).

    `OptionError`: the suffix is not one that can be written, or holds no clouds (stl) or no faces (xyz, npy).
    `InputError`: as `as_shape`. `OutputError`: the folder is missing or cannot be written.
    """
    path, shape = as_path(path), as_shape(shape)
    suffix = check_suffix(path)
    if suffix == ".stl" and shape.is_cloud:
        raise OptionError("an stl file cannot hold a point cloud", "choose .ply, .xyz or .npy")
    if suffix in (".xyz", ".npy") and not shape.is_cloud:
        raise OptionError(f"a {suffix} file cannot hold faces", "choose .ply, .obj, .off, .stl or .glb")
    with replace_on_success(path) as temporary:
        _WRITERS[suffix](temporary, shape)


@runtime_checkable
class HasVertices(Protocol):
    """A mesh or a point cloud of another library: ``vertices`` (V, 3) and, for a mesh, ``faces`` (F, 3)."""

    @property
    def vertices(self) -> ArrayLike: ...


@runtime_checkable
class HasPoints(Protocol):
    """A mesh or a point cloud of a library that calls its vertices ``points``."""

    @property
    def points(self) -> ArrayLike: ...


ShapeLike: TypeAlias = Shape | str | Path | NDArray[np.generic] | tuple[ArrayLike, ArrayLike] | HasVertices | HasPoints
"""A shape; its file; points (N, 3); vertices and faces, ((V, 3), (F, 3)); or an object of another library."""


def as_shape(source: ShapeLike, name: str = "") -> Shape:
    """The shape that is meant: a `Shape` as it is, a file read, everything else copied.

    Read are meshes and clouds of trimesh (its scenes as one shape, each mesh where its node puts it), Open3D, vedo, PyVista,
    meshio, PyMeshLab and PyTorch3D (one at a time), and other objects with ``vertices`` or ``points`` and ``faces`` or
    ``triangles``; with vertex colors of trimesh and Open3D. Polygons become fans of triangles. Tensors of torch are copied
    from whatever device they are on, without their gradient; masked values are invalid positions. Faces may be floats if
    they are whole numbers. What connects its points in another way (volumes, lines, strips) is refused, and never taken
    for a cloud. `name` is for messages, where the source has none of its own.

    `InputError`: the file cannot be read, or the source is none of these.
    """
    if isinstance(source, Shape):
        return source
    if isinstance(source, str | os.PathLike):
        return load_shape(os.fspath(source))
    found = None if isinstance(source, np.ndarray | tuple | list) else arrays_of(source, name)
    if found is not None:
        return _from_arrays(found.verts, found.faces, name, found.colors)
    if isinstance(source, tuple | list) and len(source) == 2 and _is_table(source[0]):
        return _from_arrays(source[0], as_faces(source[1], name or "the shape"), name)
    if hasattr(source, "__array__") or isinstance(source, tuple | list):
        return _from_arrays(source, None, name)
    raise InputError(f"cannot make a shape of {type(source).__name__}", HINT)


def as_shapes(sources: Sequence[ShapeLike]) -> list[Shape]:
    """The shapes that are meant, see `as_shape`; `InputError` also for a single shape instead of a list."""
    single = isinstance(sources, str | os.PathLike | Shape | HasVertices | HasPoints)
    if single or not isinstance(sources, Iterable):
        raise InputError(f"expected a list of shapes, not {type(sources).__name__}", "write [shape]")
    if isinstance(sources, tuple) and len(sources) == 2 and _are_whole(sources[1]):
        raise InputError("expected a list of shapes, not one mesh", "write [(vertices, faces)]")
    return [as_shape(source) for source in sources]


def _is_table(values: Any) -> bool:
    try:
        return np.ndim(off_torch(values)) == 2
    except (TypeError, ValueError):  # rows of different lengths
        return False


def _are_whole(values: Any) -> bool:
    try:
        return np.asarray(off_torch(values)).dtype.kind in "iu"
    except (TypeError, ValueError):
        return False


def _from_arrays(verts: Any, faces: Any, name: str, colors: Any = None) -> Shape:
    label = name or "the shape"
    try:
        verts = np.ma.asanyarray(verts) if isinstance(verts, np.ma.MaskedArray) else np.asarray(off_torch(verts))
        if verts.dtype.kind == "c":
            raise TypeError("complex ones have two parts")
        verts = verts.astype(np.float64)  # a copy
        if isinstance(verts, np.ma.MaskedArray):
            verts = verts.filled(np.nan)
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: not an array of numbers ({error})", HINT) from error
    if verts.ndim == 3 and verts.shape[2] == 3:
        raise InputError(f"{label}: vertices are a batch of {verts.shape}, not (V, 3)", "pass one of them: vertices[0]")
    if verts.ndim != 2 or verts.shape[1] != 3:
        raise InputError(f"{label}: vertices must be an array of (V, 3), not {verts.shape}", HINT)
    faces = NO_FACES if faces is None else faces
    if len(faces) and np.min(faces) == 1 and np.max(faces) == len(verts):
        raise InputError(f"{label}: faces count vertices from 1 to {len(verts)}", "subtract 1: the first vertex is 0")
    return Shape.with_invalid(np.array(verts), faces, name, colors)
