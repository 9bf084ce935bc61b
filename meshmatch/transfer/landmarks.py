"""Landmarks, named points on a shape: pushed forward along a map, read from files and written: "Data on a shape" in
docs/formats.md says how.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Brief, Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps import table_files
from meshmatch.maps.vertex_map import VertexMap, corners_of
from meshmatch.outputs import plain_text
from meshmatch.shapes.input_files import read_bytes, read_json
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.mapped_mesh import MappedMesh, discontinuous_faces, known_normals

# A landmark this far from the surface, in diagonals of the shape, belongs to another shape.
_ELSEWHERE = 0.25
LANDMARK_SUFFIXES = (".csv", ".json", ".pp")
check_landmarks_suffix = partial(table_files.check_suffix, suffixes=LANDMARK_SUFFIXES, what="landmarks")
_LARGEST_PP = 10_000_000
_PLACES = ({"vertex"}, {"x", "y", "z"}, {"face", "w0", "w1", "w2"})
# One as a file has it: name; vertex, face and barycentric, or position. What is missing may be left out.
_Record = dict[str, Any]
_HINT = "a row each: name,vertex or name,x,y,z; or MeshLab's .pp, or .json"


@dataclass(frozen=True, eq=False, repr=False)
class Landmarks(Brief):
    """Named points on a shape, in its own frame and unit."""

    names: tuple[str, ...]
    points: Float[Floats, "N 3"]
    vertex: Int[Ints, " N"]  # the vertex itself, or the heaviest corner of the face
    face: Int[Ints, " N"]  # -1 where the point is the vertex itself (always on a cloud)
    barycentric: Float[Floats, "N 3"]  # weights of the face's corners; (1, 0, 0) where the face is -1
    confidence: Float[Floats, " N"]  # 0 (a guess) to 1 (certain)


def at_vertices(shape: Shape, vertex: Int[Ints, " N"], names: tuple[str, ...] = ()) -> Landmarks:
    """Landmarks that are vertices (N,) of `shape`; `InputError` for one that it does not have."""
    vertex = np.asarray(vertex, np.int64)
    N, held = len(vertex), f"{shape.name or 'the source'} has {shape.V} vertices"
    hint = "vertices are counted from 0; are they landmarks of the source?"
    _refuse((vertex < 0) | (vertex >= shape.V), names, lambda k: f" is vertex {vertex[k]}, but {held}", hint)
    return _on_surface(shape, names, vertex, np.full(N, -1), np.tile([1.0, 0.0, 0.0], (N, 1)))


def at_points(
    shape: Shape, points: Float[Floats, "N 3"], names: tuple[str, ...] = ()
) -> tuple[Landmarks, Float[Floats, " N"]]:
    """Landmarks at the points of a surface (or cloud) nearest to points of its frame, and how far these are from it;
    `InputError` if a point is not finite, or lies far from the shape.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    usable = (np.abs(points) < 1e60).all(axis=1)
    _refuse(~usable, names, lambda k: f" has no position: {points[k].tolist()}")
    places = MappedMesh.of(shape).query(points)
    elsewhere = places.distance > _ELSEWHERE * max(shape.diagonal, 1e-30)
    there = f"{shape.name or 'the source'}, whose size is {shape.diagonal:.4g}"
    hint = "landmarks must be in the frame and unit of the source's file"
    _refuse(elsewhere, names, lambda k: f" lies {places.distance[k]:.4g} away from {there}", hint)
    return _on_surface(shape, names, places.vertex, places.face, places.barycentric), places.distance


def at_faces(
    shape: Shape, face: Int[Ints, " N"], barycentric: Float[Floats, "N 3"], names: tuple[str, ...] = ()
) -> Landmarks:
    """Landmarks in faces, by weights of corners; `InputError` if there is no such face, or they do not sum to 1."""
    face, weights = np.asarray(face, np.int64), np.asarray(barycentric, np.float64).reshape(-1, 3)
    held = f"{shape.name or 'the source'} has {shape.F} faces"
    hint = "faces are counted from 0; are they landmarks of the source?"
    _refuse((face < 0) | (face >= shape.F), names, lambda k: f" is in face {face[k]}, but {held}", hint)
    hint = "the weights of a face's corners are 0 or more, and sum to 1"
    negative, sums = (weights < -1e-9).any(axis=1), weights.sum(axis=1)
    _refuse(negative, names, lambda k: f": one of its weights {weights[k].tolist()} is negative", hint)
    _refuse(~(np.abs(sums - 1.0) < 1e-4), names, lambda k: f": its weights {weights[k].tolist()} do not sum to 1", hint)
    weights = np.clip(weights, 0.0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    return _on_surface(shape, names, shape.faces[face, weights.argmax(axis=1)], face, weights)


def _refuse(bad: ArrayLike, names: tuple[str, ...], why: Callable[[int], str], hint: str = "") -> None:
    """`InputError` with the name of the first bad landmark, if there is one."""
    for k in np.flatnonzero(bad)[:1].tolist():
        raise InputError(f"landmark {names[k] if names else k}{why(k)}", hint)


def _on_surface(
    shape: Shape, names: tuple[str, ...], vertex: Ints, face: Ints, weights: Floats, confidence: Floats | None = None
) -> Landmarks:
    """Landmarks at these places, named by number unless they have names."""
    points = interpolate(shape.verts, corners_of(shape.faces, face, vertex), weights)
    names = names or tuple(str(k) for k in range(len(vertex)))
    return Landmarks(names, points, vertex, face, weights, np.ones(len(vertex)) if confidence is None else confidence)


def joined(parts: Sequence[Landmarks], order: Ints | None = None) -> Landmarks:
    """Landmarks of one shape, one after the other; then put into an order."""
    names = [name for part in parts for name in part.names]
    order = np.arange(len(names)) if order is None else order
    fields = ("points", "vertex", "face", "barycentric", "confidence")
    arrays = [np.concatenate([getattr(part, field) for part in parts])[order] for field in fields]
    return Landmarks(tuple(names[k] for k in order.tolist()), *arrays)


def push_landmarks(forward: VertexMap, source: Shape, target: Shape, landmarks: Landmarks) -> Landmarks:
    """Landmarks of the source on the surface of the target, along a map from source to target. A point of a face goes
    nearest to the mean of where its corners go; where the map is discontinuous there, with its heaviest corner.
    """
    at = landmarks.vertex
    vertex, face, weights = forward.index[at], forward.face[at], forward.barycentric[at]
    confidence = forward.confidence[at].astype(np.float64)
    inside = np.flatnonzero((landmarks.face >= 0) & (landmarks.barycentric.max(axis=1) < 1.0 - 1e-9))
    if len(inside):
        inside = inside[~discontinuous_faces(forward, source, target)[landmarks.face[inside]]]
    if len(inside):
        corners = source.faces[landmarks.face[inside]]
        share = landmarks.barycentric[inside]
        facing = interpolate(known_normals(target), forward.index[corners], share)
        places = MappedMesh.of(target).query(interpolate(forward.points(target), corners, share), facing)
        vertex[inside], face[inside], weights[inside] = places.vertex, places.face, places.barycentric
        confidence[inside] = np.einsum("nk,nk->n", share, forward.confidence[corners])
    return _on_surface(target, landmarks.names, vertex, face, weights, np.clip(confidence, 0, 1))


def load_landmarks(path: str | Path, shape: Shape) -> tuple[Landmarks, float]:
    """Landmarks of `shape`, in the order of the file, and the largest distance from a position to the surface;
    `InputError` if there is none, or one is not on `shape`.
    """
    readers = {".csv": _read_csv, ".json": _read_json, ".pp": _read_pp, ".txt": _read_vertices, ".npy": _read_vertices}
    on_shape = dict.fromkeys(readers, lambda path: _on_shape(readers[path.suffix.lower()](path), shape))
    return table_files.read_by_suffix(path, on_shape, "landmarks", _HINT)


def _on_shape(records: list[_Record], shape: Shape) -> tuple[Landmarks, float]:
    """Landmarks in the order of the records; and the largest distance of a position from the surface."""
    if not records:
        raise InputError("it holds no landmark")
    entries = [_named_place(record, k) for k, record in enumerate(records)]
    parts: list[Landmarks] = []
    rows: list[int] = []
    largest = 0.0
    for kind in ("vertex", "face", "position"):
        own = [(k, name, place) for k, (name, its, place) in enumerate(entries) if its == kind]
        if not own:
            continue
        numbers, names, places = zip(*own, strict=True)
        rows += numbers
        if kind == "vertex":
            parts.append(at_vertices(shape, np.array(places), names))
        elif kind == "face":
            face, weights = (np.array(each) for each in zip(*places, strict=True))
            parts.append(at_faces(shape, face, weights, names))
        else:
            found, distance = at_points(shape, np.array(places), names)
            parts.append(found)
            largest = float(distance.max())
    return joined(parts, np.argsort(rows)), largest


def _read_vertices(path: Path) -> list[_Record]:
    return [{"vertex": vertex} for vertex in table_files.load_points(path).tolist()]


def _read_csv(path: Path) -> list[_Record]:
    rows = [row for row in table_files.read_rows(path) if not row[0].startswith("#")]
    if not rows:
        return []
    head = [cell.lower() for cell in rows[0]]
    if any(place <= set(head) for place in _PLACES):
        rows = rows[1:]
    else:
        width = len(head)
        if width not in (1, 2, 3, 4) or (width == 2 and head[0].lstrip("-").isdigit()):
            raise InputError("its first row names no columns")
        head = {1: ["vertex"], 2: ["name", "vertex"], 3: ["x", "y", "z"], 4: ["name", "x", "y", "z"]}[width]
    records = []
    for number, row in enumerate(rows):
        if len(row) != len(head):
            raise InputError(f"row {number} has {len(row)} cells, not {len(head)}")
        cell = dict(zip(head, row, strict=True))
        record: _Record = {"name": cell.get("name")}
        # The most exact of what a row has: a face with weights, then a vertex, then a position.
        if cell.get("face", "") not in ("", "-1") and {"w0", "w1", "w2"} <= set(cell):
            record |= {"face": int(cell["face"]), "barycentric": [float(cell[name]) for name in ("w0", "w1", "w2")]}
        elif cell.get("vertex", "") != "":
            record["vertex"] = int(cell["vertex"])
        else:
            record["position"] = [float(cell.get(axis, "nan")) for axis in "xyz"]
        records.append(record)
    return records


def _read_json(path: Path) -> list[_Record]:
    found = read_json(path)
    if isinstance(found, dict) and isinstance(found.get("landmarks"), list | dict):
        found = found["landmarks"]
    if isinstance(found, dict):
        return [{"name": name, **_record(value)} for name, value in found.items()]
    if isinstance(found, list):
        return [_record(value) for value in found]
    raise InputError("it holds no list of landmarks")


def _record(value: Any) -> _Record:
    """A vertex, a position or a description."""
    return value if isinstance(value, dict) else {"vertex" if isinstance(value, int) else "position": value}


def _named_place(record: _Record, number: int) -> tuple[str, str, Any]:
    """The name, and a "vertex", a "face" with three weights, or a "position"."""
    words = "".join(c if c.isprintable() else " " for c in str(record.get("name") or number))
    name = plain_text(" ".join(words.split()))
    face, weights = record.get("face"), record.get("barycentric")
    if face is not None and face != -1 and weights is not None:
        return name, "face", (_whole(face, name), _three(weights, name))
    if record.get("vertex") is not None:
        return name, "vertex", _whole(record["vertex"], name)
    if record.get("position") is not None:
        return name, "position", _three(record["position"], name)
    raise InputError(f"landmark {name} has no place")


def _whole(value: Any, name: str) -> int:
    if isinstance(value, bool) or int(value) != value or abs(int(value)) >= 2**62:
        raise InputError(f"landmark {name}: {str(value)[:40]} is not the number of a vertex or face")
    return int(value)


def _three(values: Any, name: str) -> list[float]:
    if not isinstance(values, list) or len(values) != 3:
        raise InputError(f"landmark {name}: three numbers are needed, not {str(values)[:40]}")
    return [float(value) for value in values]


def _read_pp(path: Path) -> list[_Record]:
    data = read_bytes(path)
    if len(data) > _LARGEST_PP:
        raise InputError(f"it is too large: over {_LARGEST_PP // 10**6} MB", "landmarks are a few named points")
    if b"<!ENTITY" in data:
        raise InputError("it defines XML entities, which a file of picked points has no use for")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(f"it is not XML: {error}") from error
    if root.tag != "PickedPoints":
        raise InputError(f"it is not a file of MeshLab's picked points: its root is '{root.tag}'")
    return [
        {"name": point.get("name"), "position": [float(point.get(axis, "nan")) for axis in "xyz"]}
        for point in root.iter("point")
        if point.get("active", "1") != "0"  # the name of a template that nobody has placed
    ]


def save_landmarks(path: Path, landmarks: Landmarks) -> None:
    """Write landmarks; `OptionError` if the suffix is not one of `LANDMARK_SUFFIXES`."""
    suffix = check_landmarks_suffix(path)
    columns = (landmarks.vertex, landmarks.points, landmarks.face, landmarks.barycentric)
    sure = table_files.short_floats(landmarks.confidence)
    rows = list(zip(landmarks.names, *(column.tolist() for column in columns), sure, strict=True))
    if suffix == ".csv":
        cells = ([name, vertex, *xyz, face, *weights, trust] for name, vertex, xyz, face, weights, trust in rows)
        table_files.write_rows(path, ["name", "vertex", "x", "y", "z", "face", "w0", "w1", "w2", "confidence"], cells)
    elif suffix == ".json":
        keys = ("name", "vertex", "position", "face", "barycentric", "confidence")
        records = [dict(zip(keys, row, strict=True)) for row in rows]
        table_files.write_json(path, {"format": "meshmatch landmarks 1", "landmarks": records}, indent=1)
    else:
        root = ElementTree.Element("PickedPoints")
        for name, _, (x, y, z), *_ in rows:
            ElementTree.SubElement(root, "point", x=repr(x), y=repr(y), z=repr(z), name=name, active="1")
        ElementTree.indent(root, " ")
        text = ElementTree.tostring(root, encoding="unicode")
        path.write_text(f"<!DOCTYPE PickedPoints>\n{text}\n", encoding="utf-8")
