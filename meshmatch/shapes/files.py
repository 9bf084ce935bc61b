"""Shapes from files and to files: one function each way, the format by suffix.

Every vertex that the file lists stays, in the file's order, because a map has to answer for each of them:
nothing is merged, split or dropped here (see `meshmatch.shapes.repair` for that). Polygons become fans of
triangles.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import plain_text, replace_on_success
from meshmatch.shapes.formats import Raw, gltf, gltf_out, obj, off, ply, points, stl
from meshmatch.shapes.paths import existing, read_bytes
from meshmatch.shapes.shape import Shape

_READERS: dict[str, Callable[[Path, bytes], Raw]] = {
    ".ply": ply.read,
    ".obj": obj.read,
    ".off": off.read,
    ".stl": stl.read,
    ".glb": gltf.read,
    ".gltf": gltf.read,
    ".xyz": points.read_xyz,
    ".npy": points.read_npy,
}
_WRITERS: dict[str, Callable[[Path, Shape], None]] = {
    ".ply": ply.write,
    ".obj": obj.write,
    ".off": off.write,
    ".stl": stl.write,
    ".glb": gltf_out.write,
    ".xyz": points.write_xyz,
    ".npy": points.write_npy,
}
SUFFIXES = tuple(_READERS)
"""The suffixes that `load_shape` knows; `save_shape` writes all of them but .gltf."""


def load_shape(path: str | Path) -> Shape:
    """Read a mesh or a point cloud as it is: all vertices, in file order, in the file's frame and unit.

    A vertex whose position is not a number is kept in its place and marked in `Shape.invalid`; its `verts`
    row is then the centroid of the others. The scene of a glb or gltf is one shape: its meshes one after the
    other, each where the scene puts it. An stl has no shared vertices: every corner of every triangle is a
    vertex, 3 F of them.

    Raises
    ------
    InputError
        The file is missing, empty, cut short, of an unknown kind, or holds no usable vertex.
    """
    path = existing(Path(path), suffixes=SUFFIXES)
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        raise InputError(
            f"{path.name}: unsupported file format {suffix or '(no suffix)'}", f"meshmatch reads {', '.join(SUFFIXES)}"
        )
    data = read_bytes(path)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN and huge numbers are judged below
        raw = _READERS[suffix](path, data)
    return Shape.with_invalid(raw.verts, raw.faces, plain_text(path.name), raw.colors)


def check_suffix(path: Path) -> str:
    """The suffix in lower case; `OptionError` if shapes are not written with it."""
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise OptionError(f"cannot write a shape as {suffix or '(no suffix)'}", f"choose one of {', '.join(_WRITERS)}")
    return suffix


def save_shape(path: str | Path, shape: Shape) -> None:
    """Write a shape, in the format that the suffix names. The file appears whole or not at all.

    ply, obj, off, xyz and npy keep every bit of the positions; stl and glb hold 32-bit floats, and stl no
    shared vertices. Colours go into ply, obj, off and glb. An invalid vertex is written as nan where the
    format allows (all but stl and glb, which take its stand-in).

    Raises
    ------
    OptionError
        The suffix is not one that can be written, or holds no clouds (stl) or no faces (xyz, npy).
    OutputError
        The folder is missing or cannot be written.
    """
    path = Path(path)
    suffix = check_suffix(path)
    if suffix == ".stl" and shape.is_cloud:
        raise OptionError("an stl file cannot hold a point cloud", "choose .ply, .xyz or .npy")
    if suffix in (".xyz", ".npy") and not shape.is_cloud:
        raise OptionError(f"a {suffix} file cannot hold faces", "choose .ply, .obj, .off, .stl or .glb")
    with replace_on_success(path) as temporary:
        _WRITERS[suffix](temporary, shape)
