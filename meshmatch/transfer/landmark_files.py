"""Landmarks from files and to files.

=====  =======================================================================================
.csv   a row each: name,vertex,x,y,z,face,w0,w1,w2,confidence
.json  ``{"landmarks": [{"name": ..., "vertex": ..., "position": [...], ...}, ...]}``
.pp    MeshLab's picked points: names and positions
=====  =======================================================================================

Read is whatever says where a landmark is: a vertex; or a face with weights; or a position, which then stands for
the nearest point of the surface. Also a plain list of vertices, .txt or .npy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from meshmatch.errors import InputError
from meshmatch.maps.pairs import load_points
from meshmatch.maps.table_files import (
    check_suffix,
    read_by_suffix,
    read_json,
    read_rows,
    short_floats,
    write_json,
    write_rows,
)
from meshmatch.outputs import plain_text
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.landmarks import Landmarks, at_faces, at_points, at_vertices, joined

COLUMNS = ("name", "vertex", "x", "y", "z", "face", "w0", "w1", "w2", "confidence")
LANDMARK_SUFFIXES = (".csv", ".json", ".pp")
_FORMAT = "meshmatch landmarks 1"
_HINT = "a row each: name,vertex or name,x,y,z; or MeshLab's .pp, or .json"


@dataclass(frozen=True)
class _Entry:
    """One landmark as a file has it: one of the three places is given."""

    name: str
    vertex: int | None = None
    face: int | None = None
    weights: tuple[float, ...] = ()
    position: tuple[float, ...] = ()


def load_landmarks(path: str | Path, shape: Shape) -> tuple[Landmarks, float]:
    """Read landmarks of `shape`, in the order of the file.

    Returns
    -------
    landmarks : Landmarks
    distance : float
        The largest from a position in the file to the surface; 0 if there are none.

    Raises
    ------
    InputError
        The file is missing or damaged, holds no landmark, or one that is not on `shape`.
    """
    readers: dict[str, Callable[[Path], tuple[Landmarks, float]]] = {
        ".csv": lambda path: _on_shape(_read_csv(path), shape),
        ".json": lambda path: _on_shape(_read_json(path), shape),
        ".pp": lambda path: _on_shape(_read_pp(path), shape),
        ".txt": lambda path: (at_vertices(shape, load_points(path)), 0.0),
        ".npy": lambda path: (at_vertices(shape, load_points(path)), 0.0),
    }
    return read_by_suffix(path, readers, "landmarks", _HINT)


def _on_shape(entries: Sequence[_Entry], shape: Shape) -> tuple[Landmarks, float]:
    """Landmarks in the order of the entries; and the largest distance of a position from the surface."""
    if not entries:
        raise InputError("it holds no landmark")
    kinds = np.array([0 if e.vertex is not None else 1 if e.face is not None else 2 for e in entries])
    parts: list[Landmarks] = []
    largest = 0.0
    for kind in (0, 1, 2):
        own = [entry for entry, its in zip(entries, kinds, strict=True) if its == kind]
        if not own:
            continue
        names = tuple(entry.name for entry in own)
        if kind == 0:
            parts.append(at_vertices(shape, np.array([entry.vertex for entry in own]), names))
        elif kind == 1:
            weights = np.array([entry.weights for entry in own])
            parts.append(at_faces(shape, np.array([entry.face for entry in own]), weights, names))
        else:
            found, distance = at_points(shape, np.array([entry.position for entry in own]), names)
            parts.append(found)
            largest = float(distance.max())
    # They were joined kind by kind: back to the order of the file.
    return joined(parts).rows(np.argsort(np.argsort(kinds, kind="stable"))), largest


def _read_csv(path: Path) -> list[_Entry]:
    rows = [row for row in read_rows(path) if not row[0].startswith("#")]
    if not rows:
        return []
    head = [cell.lower() for cell in rows[0]]
    if {"vertex"} <= set(head) or {"x", "y", "z"} <= set(head) or {"face", "w0", "w1", "w2"} <= set(head):
        rows = rows[1:]
    else:
        width = len(head)
        if width not in (1, 2, 3, 4) or (width == 2 and _is_whole(head[0])):
            raise InputError("its first row names no columns")
        head = {1: ["vertex"], 2: ["name", "vertex"], 3: ["x", "y", "z"], 4: ["name", "x", "y", "z"]}[width]
    entries = []
    for number, row in enumerate(rows):
        if len(row) != len(head):
            raise InputError(f"row {number} has {len(row)} cells, not {len(head)}")
        cell = dict(zip(head, row, strict=True))
        record: dict[str, Any] = {"name": cell.get("name") or str(number)}
        # The most exact of what a row has: a face with weights, then a vertex, then a position.
        if cell.get("face", "") not in ("", "-1") and {"w0", "w1", "w2"} <= set(cell):
            record["face"] = int(cell["face"])
            record["barycentric"] = [float(cell[name]) for name in ("w0", "w1", "w2")]
        elif cell.get("vertex", "") != "":
            record["vertex"] = int(cell["vertex"])
        else:
            record["position"] = [float(cell.get(axis, "nan")) for axis in "xyz"]
        entries.append(_entry(record, number))
    return entries


def _is_whole(text: str) -> bool:
    return text.lstrip("-").isdigit()


def _read_json(path: Path) -> list[_Entry]:
    record = read_json(path)
    if isinstance(record, dict) and isinstance(record.get("landmarks"), list | dict):
        record = record["landmarks"]
    if isinstance(record, dict):
        return [_named(name, value, k) for k, (name, value) in enumerate(record.items())]
    if not isinstance(record, list):
        raise InputError("it holds no list of landmarks")
    return [_entry(item, k) if isinstance(item, dict) else _named(str(k), item, k) for k, item in enumerate(record)]


def _named(name: str, value: Any, number: int) -> _Entry:
    """A vertex, a position or a description under a name."""
    if isinstance(value, dict):
        return _entry({"name": name, **value}, number)
    return _entry({"name": name, "vertex" if isinstance(value, int) else "position": value}, number)


def _entry(record: dict[str, Any], number: int) -> _Entry:
    words = "".join(c if c.isprintable() else " " for c in str(record.get("name") or number))
    name = plain_text(" ".join(words.split()))
    face, weights = record.get("face"), record.get("barycentric")
    if face is not None and face != -1 and weights is not None:
        return _Entry(name, face=_whole(face, name), weights=_three(weights, name))
    if record.get("vertex") is not None:
        return _Entry(name, vertex=_whole(record["vertex"], name))
    if record.get("position") is not None:
        return _Entry(name, position=_three(record["position"], name))
    raise InputError(f"landmark {name} has no place")


def _whole(value: Any, name: str) -> int:
    if isinstance(value, bool) or int(value) != value or abs(int(value)) >= 2**62:
        raise InputError(f"landmark {name}: {str(value)[:40]} is not the number of a vertex or face")
    return int(value)


def _three(values: Any, name: str) -> tuple[float, ...]:
    if not isinstance(values, list) or len(values) != 3:
        raise InputError(f"landmark {name}: three numbers are needed, not {str(values)[:40]}")
    return tuple(float(value) for value in values)


def _read_pp(path: Path) -> list[_Entry]:
    data = path.read_bytes()
    if b"<!ENTITY" in data:
        raise InputError("it defines XML entities, which a file of picked points has no use for")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(f"it is not XML: {error}") from error
    if root.tag != "PickedPoints":
        raise InputError(f"it is not a file of MeshLab's picked points: its root is '{root.tag}'")
    entries: list[_Entry] = []
    for point in root.iter("point"):
        if point.get("active", "1") == "0":
            continue  # a name of a template that nobody has placed
        record = {"name": point.get("name"), "position": [float(point.get(axis, "nan")) for axis in "xyz"]}
        entries.append(_entry(record, len(entries)))
    return entries


def check_landmarks_suffix(path: Path) -> str:
    """The suffix, if it is one of `LANDMARK_SUFFIXES`; `OptionError` otherwise."""
    return check_suffix(path, LANDMARK_SUFFIXES, "landmarks")


def save_landmarks(path: Path, landmarks: Landmarks) -> None:
    """Write landmarks; see the module for the formats.

    Raises
    ------
    OptionError
        The suffix is not one of `LANDMARK_SUFFIXES`.
    """
    suffix = check_landmarks_suffix(path)
    columns = (landmarks.vertex, landmarks.points, landmarks.face, landmarks.barycentric)
    rows = list(
        zip(landmarks.names, *(column.tolist() for column in columns), short_floats(landmarks.confidence), strict=True)
    )
    if suffix == ".csv":
        cells = (
            [name, vertex, *xyz, face, *weights, confidence] for name, vertex, xyz, face, weights, confidence in rows
        )
        write_rows(path, COLUMNS, cells)
        return
    if suffix == ".json":
        keys = ("name", "vertex", "position", "face", "barycentric", "confidence")
        records = [dict(zip(keys, row, strict=True)) for row in rows]
        write_json(path, {"format": _FORMAT, "landmarks": records}, indent=1)
        return
    root = ElementTree.Element("PickedPoints")
    for name, _, (x, y, z), *_ in rows:
        place = {"x": repr(x), "y": repr(y), "z": repr(z), "name": name, "active": "1"}
        ElementTree.SubElement(root, "point", place)
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    path.write_text(f"<!DOCTYPE PickedPoints>\n{text}\n", encoding="utf-8")
