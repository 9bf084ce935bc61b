"""Shapes from what users hold: paths, arrays, and meshes of other libraries."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape


@runtime_checkable
class HasVertices(Protocol):
    """A mesh or a point cloud of another library: ``vertices`` (V, 3) and, for a mesh, ``faces`` (F, 3)."""

    @property
    def vertices(self) -> ArrayLike: ...


ShapeLike: TypeAlias = Shape | str | Path | NDArray[np.generic] | tuple[ArrayLike, ArrayLike] | HasVertices
"""A shape; its file; points (N, 3); vertices and faces, ((V, 3), (F, 3)); or an object with ``vertices``."""

_HINT = "pass a path, a Shape, (vertices, faces), an (N, 3) array, or an object with .vertices and .faces"


def as_shape(source: ShapeLike, name: str = "") -> Shape:
    """The shape that is meant: a `Shape` as it is, a file read, everything else copied.

    Parameters
    ----------
    source
        A path; a `Shape`; a pair of vertices (V, 3) and triangles (F, 3); an array (N, 3) of points; or an object
        with ``vertices`` and, unless it is a cloud, ``faces`` (trimesh) or ``triangles`` (Open3D). Vertex colours of
        a `trimesh.Trimesh` are kept.
    name : str
        For messages, where the source has no name of its own.

    Raises
    ------
    InputError
        The file cannot be read, or the source is none of these.
    """
    if isinstance(source, Shape):
        return source
    if isinstance(source, str | os.PathLike):
        return load_shape(os.fspath(source))
    if isinstance(source, HasVertices):
        faces = getattr(source, "faces", getattr(source, "triangles", None))
        return _from_arrays(source.vertices, faces, name, _trimesh_colors(source))
    if isinstance(source, tuple | list) and len(source) == 2 and _is_table(source[0]):
        return _from_arrays(source[0], source[1], name)
    if hasattr(source, "__array__") or isinstance(source, tuple | list):
        return _from_arrays(source, None, name)
    raise InputError(f"cannot make a shape of {type(source).__name__}", _HINT)


def as_shapes(sources: Sequence[ShapeLike]) -> list[Shape]:
    """The shapes that are meant, see `as_shape`.

    Raises
    ------
    InputError
        As `as_shape`; or a single shape instead of a list.
    """
    if isinstance(sources, str | os.PathLike | Shape | HasVertices) or not isinstance(sources, Iterable):
        raise InputError(f"expected a list of shapes, not {type(sources).__name__}", "write [shape]")
    if isinstance(sources, tuple) and len(sources) == 2 and np.asarray(sources[1]).dtype.kind in "iu":
        raise InputError("expected a list of shapes, not one mesh", "write [(vertices, faces)]")
    return [as_shape(source) for source in sources]


def _is_table(values: Any) -> bool:
    try:
        return np.ndim(values) == 2
    except ValueError:  # rows of different lengths
        return False


def _from_arrays(verts: Any, faces: Any, name: str, colors: Any = None) -> Shape:
    try:
        verts = np.array(verts, np.float64)
        faces = np.empty((0, 3), np.int64) if faces is None else np.asarray(faces)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name or 'the shape'}: not an array of numbers ({error})", _HINT) from error
    if verts.ndim != 2 or verts.shape[1] != 3:
        raise InputError(f"{name or 'the shape'}: vertices must be an array of (V, 3), not {verts.shape}", _HINT)
    return Shape.with_invalid(verts, faces, name, colors)


def _trimesh_colors(mesh: Any) -> Any:
    visual: Any = getattr(mesh, "visual", None)
    if getattr(visual, "kind", None) != "vertex":
        return None
    colors = np.asarray(visual.vertex_colors, np.float64)
    return colors / 255.0 if len(colors) else None  # a trimesh.PointCloud without colours has an empty table
