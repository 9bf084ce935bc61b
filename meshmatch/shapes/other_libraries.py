"""Meshes and clouds of other libraries as arrays, known by their attributes: none of the libraries is imported.

Read are trimesh (also its scenes), Open3D, vedo, PyVista, meshio, PyMeshLab, PyTorch3D, and whatever has vertices and
faces by the usual names. An object that connects its points in a way that is not known here is refused: it must never
become a cloud without a word.
"""

from __future__ import annotations

import re
from itertools import chain
from typing import Any, NamedTuple

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Int, Ints, off_torch
from meshmatch.errors import InputError, warn
from meshmatch.shapes.formats import colors_of_faces, fan, joined_colors, painted, runs
from meshmatch.shapes.formats.polygons import triangles_of

HINT = "pass a path, a Shape, (vertices, faces), an (N, 3) array, or an object with .vertices and .faces"
_SURFACE = "pass its surface, such as (points, triangles)"
_VTK_FACES, _VTK_LOOSE = (5, 7, 9), (0, 1, 2, 3, 4)  # triangles, polygons, quads; nothing, points and lines
_MESHIO_FACES = re.compile("triangle|quad|polygon[0-9]*")
_MESHIO_LOOSE = "vertex|line[0-9]*"
_OTHER_LINKS = (
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
"""Attributes by which libraries connect vertices in ways that are not read."""


class _Polygons(NamedTuple):
    """Corners of polygons, one after the other, and how many each has."""

    corners: Ints
    sizes: Ints


class Arrays(NamedTuple):
    """What an object holds, unchecked."""

    verts: Any
    faces: Any = None
    colors: Float[Floats, "V 4"] | None = None


def arrays_of(source: Any, name: str) -> Arrays | None:
    """Vertices, faces and colors of a mesh or cloud of another library; None if it is no such object.

    `InputError` where it is one that is not read: volumes, lines, several meshes at once.
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
    points = _value(source, "vertices", "points")
    if points is None:
        return None
    return Arrays(points, _triangles(points, _faces(source, label), label), _colors(source, label))


def as_faces(values: Any, points: Any, label: str) -> Any:
    """Faces of vertices as an array (F, 3) where that can be: polygons in lists are split into triangles, whole numbers are
    taken for integers.

    `InputError` for faces of four corners, which may be quads or tetrahedra, and for anything else that is no array.
    """
    if values is None:
        return None
    if _ragged(values):
        return _triangles(points, _polygons(values, label), label)
    found = _array(values, label)
    if found.ndim == 2 and found.shape[1] == 4:
        hint = f"split quads into triangles, or pass them as lists; of tetrahedra, {_SURFACE}"
        raise InputError(f"{label}: faces have four corners, which may be quads or tetrahedra", hint)
    return _whole(found, label)


def _triangles(points: Any, faces: Any, label: str) -> Any:
    """Faces, those that are polygons split into triangles: as files are, where their vertices are points in space."""
    if not isinstance(faces, _Polygons):
        return faces
    verts = _array(points, label)
    if verts.ndim != 2 or verts.shape[1] != 3 or verts.dtype.kind not in "fiu":
        return fan(faces.corners, faces.sizes)  # refused later
    return faces.corners[triangles_of(label, verts.astype(np.float64), faces.corners, faces.sizes)]


def _value(source: Any, *names: str) -> Any:
    """The first attribute of these names that an object has; what older libraries have as methods is called."""
    for name in names:
        found = getattr(source, name, None)
        if callable(found):
            try:
                found = found()
            except TypeError:  # it wants arguments
                found = None
        if found is not None:
            return found
    return None


def _array(values: Any, label: str) -> np.ndarray:
    try:
        return np.asarray(off_torch(values))
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: not an array of numbers ({error})", HINT) from error


def _whole(values: np.ndarray, label: str) -> np.ndarray:
    """Numbers of vertices as integers; `InputError` for fractions, and words."""
    if values.dtype.kind == "f" and np.array_equal(values, np.round(values)) and (np.abs(values) < 2**53).all():
        return values.astype(np.int64)
    if values.size and values.dtype.kind not in "iu":
        raise InputError(f"{label}: faces must be integers, not {values.dtype}", "each names three vertices, from 0")
    return values


def _some(values: Any) -> bool:
    """Whether an attribute holds anything."""
    return hasattr(values, "__len__") and len(values) > 0


def _ragged(values: Any) -> bool:
    """Whether these are lists of different lengths."""
    if not isinstance(values, list | tuple) or not values or not all(hasattr(each, "__len__") for each in values):
        return False
    return len({len(each) for each in values}) > 1


def _polygons(values: Any, label: str) -> _Polygons:
    """Polygons of lists of corners, or of rows with the same number of corners."""
    if isinstance(values, np.ndarray) and values.ndim == 2:
        sizes, corners = np.full(len(values), values.shape[1]), values.reshape(-1)
    else:
        sizes = np.array([len(each) for each in values], np.int64)
        rows = (each if isinstance(each, list | tuple) else np.atleast_1d(_array(each, label)) for each in values)
        flat = list(chain.from_iterable(rows))
        if any(isinstance(each, list | tuple | np.ndarray) for each in flat):
            raise InputError(f"{label}: each face must be a list of vertices", HINT)
        corners = _array(flat, label)
    return _Polygons(_whole(corners, label).astype(np.int64), sizes)


def _counted(values: np.ndarray, label: str) -> tuple[Ints, Ints]:
    """Where the corners of each cell begin, and how many there are, in VTK's flat lists: a count, then so many corners."""
    starts, at = [], 0
    flat = values.tolist()
    while at < len(flat):
        starts.append(at + 1)
        if flat[at] < 0 or at + flat[at] >= len(flat):
            raise InputError(f"{label}: its flat list of faces does not consist of counts and corners", HINT)
        at += flat[at] + 1
    begins = np.array(starts, np.int64)
    return begins, values[begins - 1].astype(np.int64)


def _flat_polygons(values: np.ndarray, label: str, chosen: Bools | None = None) -> _Polygons:
    """Polygons of VTK's flat list, or of the chosen cells of it."""
    starts, sizes = _counted(_whole(values, label), label)
    if chosen is not None:
        if len(chosen) != len(starts):
            raise InputError(f"{label} has {len(starts)} cells and {len(chosen)} types of cells", HINT)
        starts, sizes = starts[chosen], sizes[chosen]
    return _Polygons(values[runs(starts, sizes)].astype(np.int64), sizes)


def _faces(source: Any, label: str) -> Any:
    """The faces of an object, triangles or polygons, None if it is a cloud."""
    types = _value(source, "celltypes", "cell_types_array")
    cells = _value(source, "cells")
    if types is not None:
        return _grid(cells, np.asarray(types), label)
    faces = _value(source, "faces", "triangles")
    if _some(faces):
        return _rows(faces, label)
    if _some(cells):
        return _cells(source, cells, label)
    for name in _OTHER_LINKS:
        links = getattr(source, name, None)
        if not callable(links) and _some(links):
            hint = "pass its .triangulate()" if name == "strips" else _SURFACE
            raise InputError(f"{label} connects its points by .{name}, which is not read", hint)
    vtk = type(getattr(source, "dataset", None)).__name__  # of vedo
    if (faces is None and getattr(source, "n_cells", None)) or vtk not in ("NoneType", "vtkPolyData"):
        raise InputError(f"{label} is a grid, not a surface", "pass its surface, such as .extract_surface()")
    return None


def _rows(faces: Any, label: str) -> Any:
    """Faces by that name: triangles, quads, lists of polygons, or VTK's flat list."""
    if _ragged(faces):
        return _polygons(faces, label)
    found = _array(faces, label)
    if found.ndim == 1:
        return _flat_polygons(found, label)
    if found.ndim == 2 and found.shape[1] > 3:
        return _polygons(found, label)
    return _whole(found, label)


def _grid(cells: Any, types: Ints, label: str) -> _Polygons | None:
    """The faces of a VTK grid, if it has no volumes."""
    if not np.isin(types, _VTK_FACES + _VTK_LOOSE).all():
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
    pairs = [pair for pair in map(_block, blocks) if pair is not None]
    if pairs and len(pairs) == len(blocks):
        parts = [_polygons(data, label) for kind, data in pairs if _MESHIO_FACES.fullmatch(kind) and len(data)]
        loose = "vertex" if not parts else _MESHIO_LOOSE  # beside faces, lines are their features
        wrong = [kind for kind, _ in pairs if not (_MESHIO_FACES.fullmatch(kind) or re.fullmatch(loose, kind))]
        if wrong:
            hint = "pass its surface, such as (mesh.points, mesh.cells_dict['triangle'])"
            raise InputError(f"{label} has cells of type {wrong[0]}, of which no surface is made", hint)
        return _Polygons(*(np.concatenate(each) for each in zip(*parts, strict=True))) if parts else None
    if not _ragged(cells):
        found = _array(cells, label)
        surface = type(getattr(source, "dataset", None)).__name__ == "vtkPolyData"  # vedo: these are faces
        if found.ndim == 1:
            raise InputError(f"{label} connects its points by .cells without their types", _SURFACE)
        if found.ndim == 2 and found.shape[1] > 3 and not surface:
            raise InputError(f"{label}: its cells may be faces or volumes", _SURFACE)
        return _rows(found, label)
    return _polygons(cells, label)


def _block(block: Any) -> tuple[str, Any] | None:
    """Type and corners of a block of cells of one type; None if it is something else."""
    if isinstance(block, tuple) and len(block) == 2 and isinstance(block[0], str):
        return block
    kind = getattr(block, "type", None)
    return (kind, block.data) if isinstance(kind, str) and hasattr(block, "data") else None


def _scene(scene: Any, label: str) -> Arrays:
    """The meshes of a trimesh scene, one after the other, each where its node puts it."""
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
    joined = joined_colors(colors, [len(own) for own in verts])
    return Arrays(np.concatenate(verts), np.concatenate(faces) if faces else None, joined)


def _batch(source: Any, label: str) -> Arrays:
    """The one mesh or cloud of PyTorch3D's batches."""
    if len(source) != 1:
        raise InputError(f"{label} is a batch of {len(source)} shapes", "pass one of them: shapes[0]")
    if callable(getattr(source, "verts_packed", None)):
        points = source.verts_packed()
        return Arrays(points, _triangles(points, _rows(source.faces_packed(), label), label))
    return Arrays(source.points_packed())


def _colors(source: Any, label: str) -> Float[Floats, "V 4"] | None:
    """Colors of the vertices, as trimesh and Open3D have them; the mean of those around where trimesh has them of faces."""
    visual: Any = getattr(source, "visual", None)
    if getattr(visual, "kind", None) == "face":
        warn(f"{label} has colors of faces: each vertex gets the mean of those around it")
        own = np.repeat(np.asarray(visual.face_colors, np.float64) / 255.0, 3, axis=0)
        return colors_of_faces(len(source.vertices), np.asarray(source.faces).ravel(), own)
    if getattr(visual, "kind", None) == "vertex" and len(visual.vertex_colors):  # a cloud of trimesh has none
        return np.asarray(visual.vertex_colors, np.float64) / 255.0
    for has, name in (("has_vertex_colors", "vertex_colors"), ("has_colors", "colors")):
        if callable(getattr(source, has, None)) and getattr(source, has)():
            return painted(np.asarray(getattr(source, name), np.float64))
    return None
