"""Meshes and clouds of other libraries as arrays, recognised by their attributes: none of the libraries is imported.

Supported are trimesh (also its scenes), Open3D, vedo, PyVista, meshio, PyMeshLab, PyTorch3D, and any object with
vertices and faces under the usual names. Objects that connect their points in an unknown way are refused: they must not
silently become clouds.
"""

from __future__ import annotations

import re
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Int, Ints, to_numpy
from meshmatch.errors import InputError, warn
from meshmatch.shapes.formats import (
    concatenate_colors,
    concatenated_ranges,
    fan,
    rgba_from_channels,
    vertex_colors_from_faces,
)
from meshmatch.shapes.formats.polygons import triangles_of

HINT = "pass a path, a Shape, (vertices, faces), an (N, 3) array, or an object with .vertices and .faces"
_SURFACE = "pass its surface, such as (points, triangles)"
_VTK_FACES, _VTK_IGNORED = (5, 7, 9), (0, 1, 2, 3, 4)  # triangles, polygons, quads; empty cells, points and lines
_MESHIO_FACES = re.compile("triangle|quad|polygon[0-9]*")
_MESHIO_IGNORED = "vertex|line[0-9]*"
_UNSUPPORTED_LINKS = (
    "strips",
    "lines",
    "polygons",
    "polys",
    "tris",
    "tetras",
    "tets",
    "simplices",
    "indices",
    "connectivity",
    "cells_dict",
    "edges",
    "halfedges",
    "entities",
    "elements",
    "regions",
)
"""Attributes with which libraries connect vertices in ways that are not supported."""


class _Polygons(NamedTuple):
    """Corners of polygons in one array, and the number of corners of each."""

    corners: Ints
    sizes: Ints


class Arrays(NamedTuple):
    """Arrays of an object, unchecked."""

    verts: Any
    faces: Any = None
    colors: Float[Floats, "V 4"] | None = None


def arrays_of(source: Any, name: str) -> Arrays | None:
    """Vertices, faces and colors of a mesh or cloud of another library; None for any other object.

    `InputError` for unsupported geometry: volumes, lines, several meshes at once.
    """
    label = name or f"the {type(source).__name__}"
    if callable(getattr(source, "to_legacy", None)):  # Open3D's tensor geometry
        source = source.to_legacy()
    if hasattr(source, "graph") and isinstance(getattr(source, "geometry", None), dict):
        return _scene(source, label)
    if callable(getattr(source, "verts_packed", None)) or callable(getattr(source, "points_packed", None)):
        return _batch(source, label)
    if callable(getattr(source, "vertex_matrix", None)) and callable(getattr(source, "face_matrix", None)):
        points = source.vertex_matrix()
        return Arrays(points, _triangles(points, _rows(source.face_matrix(), label), label))
    points = _get_value(source, "vertices", "points")
    if points is None:
        return None
    return Arrays(points, _triangles(points, _faces(source, label), label), _colors(source, label))


def as_faces(values: Any, points: Any, label: str) -> Any:
    """Faces as an array (F, 3) if possible: lists of polygons are triangulated, whole numbers become integers.

    `InputError` for faces with four corners, which may be quads or tetrahedra, and for anything else that is not an
    array.
    """
    if values is None:
        return None
    if _is_ragged(values):
        return _triangles(points, _polygons(values, label), label)
    array = _array(values, label)
    if array.ndim == 2 and array.shape[1] == 4:
        hint = f"split quads into triangles, or pass them as lists; of tetrahedra, {_SURFACE}"
        raise InputError(f"{label}: faces have four corners, which may be quads or tetrahedra", hint)
    return _as_indices(array, label)


def _triangles(points: Any, faces: Any, label: str) -> Any:
    """Faces as triangles; polygons are triangulated as in files if their vertices are points in space."""
    if not isinstance(faces, _Polygons):
        return faces
    verts = _array(points, label)
    if verts.ndim != 2 or verts.shape[1] != 3 or verts.dtype.kind not in "fiu":
        return fan(faces.corners, faces.sizes)  # refused later
    return faces.corners[triangles_of(label, verts.astype(np.float64), faces.corners, faces.sizes)]


def _get_value(source: Any, *names: str) -> Any:
    """The first of these attributes that an object has; methods, as in older libraries, are called."""
    for name in names:
        value = getattr(source, name, None)
        if callable(value):
            try:
                value = value()
            except TypeError:  # it needs arguments
                value = None
        if value is not None:
            return value
    return None


def _array(values: Any, label: str) -> np.ndarray:
    try:
        return np.asarray(to_numpy(values))
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: not an array of numbers ({error})", HINT) from error


def _as_indices(values: np.ndarray, label: str) -> np.ndarray:
    """Vertex indices as integers; `InputError` for fractions and text."""
    if values.dtype.kind == "f" and np.array_equal(values, np.round(values)) and (np.abs(values) < 2**53).all():
        return values.astype(np.int64)
    if values.size and values.dtype.kind not in "iu":
        raise InputError(f"{label}: faces must be integers, not {values.dtype}", "each names three vertices, from 0")
    return values


def _is_filled(values: Any) -> bool:
    """Whether an attribute is not empty."""
    return hasattr(values, "__len__") and len(values) > 0


def _is_ragged(values: Any) -> bool:
    """Whether these are lists of different lengths."""
    if not isinstance(values, list | tuple) or not values or not all(hasattr(each, "__len__") for each in values):
        return False
    return len({len(each) for each in values}) > 1


def _polygons(values: Any, label: str) -> _Polygons:
    """Polygons from lists of corners, or from rows with the same number of corners."""
    if isinstance(values, np.ndarray) and values.ndim == 2:
        sizes, corners = np.full(len(values), values.shape[1]), values.reshape(-1)
    else:
        sizes = np.array([len(each) for each in values], np.int64)
        rows = (each if isinstance(each, list | tuple) else np.atleast_1d(_array(each, label)) for each in values)
        flat = list(chain.from_iterable(rows))
        if any(isinstance(each, list | tuple | np.ndarray) for each in flat):
            raise InputError(f"{label}: each face must be a list of vertices", HINT)
        corners = _array(flat, label)
    return _Polygons(_as_indices(corners, label).astype(np.int64), sizes)


def _split_flat(values: np.ndarray, label: str) -> tuple[Ints, Ints]:
    """Start and number of the corners of each cell in a flat VTK list: a count, then as many corners, for each cell."""
    starts, position = [], 0
    flat = values.tolist()
    while position < len(flat):
        starts.append(position + 1)
        if flat[position] < 0 or position + flat[position] >= len(flat):
            raise InputError(f"{label}: its flat list of faces does not consist of counts and corners", HINT)
        position += flat[position] + 1
    begins = np.array(starts, np.int64)
    return begins, values[begins - 1].astype(np.int64)


def _flat_polygons(values: np.ndarray, label: str, chosen: Bools | None = None) -> _Polygons:
    """Polygons from a flat VTK list, or from the chosen cells of it."""
    starts, sizes = _split_flat(_as_indices(values, label), label)
    if chosen is not None:
        if len(chosen) != len(starts):
            raise InputError(f"{label} has {len(starts)} cells and {len(chosen)} types of cells", HINT)
        starts, sizes = starts[chosen], sizes[chosen]
    return _Polygons(values[concatenated_ranges(starts, sizes)].astype(np.int64), sizes)


def _faces(source: Any, label: str) -> Any:
    """The faces of an object, triangles or polygons; None if it is a cloud."""
    types = _get_value(source, "celltypes", "cell_types_array")
    cells = _get_value(source, "cells")
    if types is not None:
        return _grid(cells, np.asarray(types), label)
    faces = _get_value(source, "faces", "triangles")
    if _is_filled(faces):
        return _rows(faces, label)
    if _is_filled(cells):
        return _cells(source, cells, label)
    for name in _UNSUPPORTED_LINKS:
        links = getattr(source, name, None)
        if not callable(links) and _is_filled(links):
            hint = "pass its .triangulate()" if name == "strips" else _SURFACE
            raise InputError(f"{label} connects its points by .{name}, which is not read", hint)
    vtk = type(getattr(source, "dataset", None)).__name__  # vedo meshes have a .dataset
    if (faces is None and getattr(source, "n_cells", None)) or vtk not in ("NoneType", "vtkPolyData"):
        raise InputError(f"{label} is a grid, not a surface", "pass its surface, such as .extract_surface()")
    return None


def _rows(faces: Any, label: str) -> Any:
    """Faces from an attribute of that name: triangles, quads, lists of polygons, or a flat VTK list."""
    if _is_ragged(faces):
        return _polygons(faces, label)
    array = _array(faces, label)
    if array.ndim == 1:
        return _flat_polygons(array, label)
    if array.ndim == 2 and array.shape[1] > 3:
        return _polygons(array, label)
    return _as_indices(array, label)


def _grid(cells: Any, types: Ints, label: str) -> _Polygons | None:
    """The faces of a VTK grid; `InputError` if it has volumes."""
    if not np.isin(types, _VTK_FACES + _VTK_IGNORED).all():
        raise InputError(f"{label} is made of volumes or of curved cells", "pass its surface, .extract_surface()")
    chosen = np.isin(types, _VTK_FACES)
    if not chosen.any():
        return None
    if isinstance(cells, list | tuple):
        return _polygons([cell for cell, wanted in zip(cells, chosen, strict=True) if wanted], label)
    return _flat_polygons(_array(cells, label), label, chosen)


def _cells(source: Any, cells: Any, label: str) -> Any:
    """The faces among cells: blocks of one type each (meshio), or lists of corners (vedo)."""
    blocks = cells.items() if isinstance(cells, dict) else cells
    pairs = [pair for pair in map(_as_block, blocks) if pair is not None]
    if pairs and len(pairs) == len(blocks):
        parts = [_polygons(data, label) for kind, data in pairs if _MESHIO_FACES.fullmatch(kind) and len(data)]
        ignored = "vertex" if not parts else _MESHIO_IGNORED  # next to faces, lines are feature edges
        unsupported = [kind for kind, _ in pairs if not (_MESHIO_FACES.fullmatch(kind) or re.fullmatch(ignored, kind))]
        if unsupported:
            hint = "pass its surface, such as (mesh.points, mesh.cells_dict['triangle'])"
            raise InputError(f"{label} has cells of type {unsupported[0]}, of which no surface is made", hint)
        return _Polygons(*(np.concatenate(each) for each in zip(*parts, strict=True))) if parts else None
    if not _is_ragged(cells):
        array = _array(cells, label)
        surface = type(getattr(source, "dataset", None)).__name__ == "vtkPolyData"  # vedo: these are faces
        if array.ndim == 1:
            raise InputError(f"{label} connects its points by .cells without their types", _SURFACE)
        if array.ndim == 2 and array.shape[1] > 3 and not surface:
            raise InputError(f"{label}: its cells may be faces or volumes", _SURFACE)
        return _rows(array, label)
    return _polygons(cells, label)


def _as_block(block: Any) -> tuple[str, Any] | None:
    """Type and corners of a block of cells of one type; None for anything else."""
    if isinstance(block, tuple) and len(block) == 2 and isinstance(block[0], str):
        return block
    kind = getattr(block, "type", None)
    return (kind, block.data) if isinstance(kind, str) and hasattr(block, "data") else None


def _scene(scene: Any, label: str) -> Arrays:
    """The meshes of a trimesh scene, one after the other, each where its node places it."""
    verts: list[Floats] = []
    faces: list[Int[Ints, "F 3"]] = []
    colors: list[Float[Floats, "V 4"] | None] = []
    start = 0
    for node in scene.graph.nodes_geometry:
        matrix, geometry = scene.graph[node]
        part = arrays_of(scene.geometry[geometry], f"{geometry} of {label}")
        if part is None:
            raise InputError(f"{geometry} of {label} is no mesh", HINT)
        points = np.asarray(part.verts, np.float64)
        verts.append(points @ np.asarray(matrix)[:3, :3].T + np.asarray(matrix)[:3, 3])
        if part.faces is not None and len(part.faces):
            corners = np.asarray(part.faces, np.int64) + start
            faces.append(corners[:, ::-1] if np.linalg.det(np.asarray(matrix)[:3, :3]) < 0 else corners)
        colors.append(part.colors)
        start += len(points)
    if not verts:
        raise InputError(f"{label} is a scene without meshes", HINT)
    joined = concatenate_colors(colors, [len(own) for own in verts])
    return Arrays(np.concatenate(verts), np.concatenate(faces) if faces else None, joined)


def _batch(source: Any, label: str) -> Arrays:
    """The single mesh or cloud of a PyTorch3D batch."""
    if len(source) != 1:
        raise InputError(f"{label} is a batch of {len(source)} shapes", "pass one of them: shapes[0]")
    if callable(getattr(source, "verts_packed", None)):
        points = source.verts_packed()
        return Arrays(points, _triangles(points, _rows(source.faces_packed(), label), label))
    return Arrays(source.points_packed())


def _colors(source: Any, label: str) -> Float[Floats, "V 4"] | None:
    """Vertex colors of trimesh and Open3D; means of the surrounding face colors if trimesh has these."""
    visual: Any = getattr(source, "visual", None)
    if getattr(visual, "kind", None) == "face":
        warn(f"{label} has colors of faces: each vertex gets the mean of those around it")
        corner_colors = np.repeat(np.asarray(visual.face_colors, np.float64) / 255.0, 3, axis=0)
        return vertex_colors_from_faces(len(source.vertices), np.asarray(source.faces).ravel(), corner_colors)
    if getattr(visual, "kind", None) == "vertex" and len(visual.vertex_colors):  # trimesh clouds have none
        return np.asarray(visual.vertex_colors, np.float64) / 255.0
    for has, name in (("has_vertex_colors", "vertex_colors"), ("has_colors", "colors")):
        if callable(getattr(source, has, None)) and getattr(source, has)():
            return rgba_from_channels(np.asarray(getattr(source, name), np.float64))
    return None
