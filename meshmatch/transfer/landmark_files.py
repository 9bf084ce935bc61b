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

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from meshmatch.errors import InputError, OptionError
from meshmatch.maps.pairs import load_points
from meshmatch.outputs import plain_text
from meshmatch.shapes.paths import existing
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
    path = existing(Path(path), _HINT)
    suffix = path.suffix.lower()
    if suffix in (".txt", ".npy"):
        return at_vertices(shape, load_points(path)), 0.0
    if suffix not in LANDMARK_SUFFIXES:
        raise InputError(
            f"{path.name}: landmarks are not read from '{suffix}' files", "choose .csv, .json, .pp or .txt"
        )
    try:
        entries = {".csv": _read_csv, ".json": _read_json, ".pp": _read_pp}[suffix](path)
    except InputError as error:
        raise InputError(f"{path.name}: {error.message}", error.hint or _HINT) from error
    except (ValueError, TypeError, KeyError, RecursionError, csv.Error, OverflowError) as error:
        raise InputError(f"{path.name} does not hold landmarks that can be read: {error}", _HINT) from error
    if not entries:
        raise InputError(f"{path.name} holds no landmark", _HINT)
    return _placed(entries, shape)


def _placed(entries: Sequence[_Entry], shape: Shape) -> tuple[Landmarks, float]:
    """On the shape, in the order of the entries; and the largest distance of a position."""
    parts: list[Landmarks] = []
    order: list[int] = []
    furthest = 0.0

    def some(chosen: list[int]) -> tuple[list[_Entry], tuple[str, ...]]:
        order.extend(chosen)
        own = [entries[k] for k in chosen]
        return own, tuple(entry.name for entry in own)

    numbers = range(len(entries))
    if vertices := [k for k in numbers if entries[k].vertex is not None]:
        own, names = some(vertices)
        parts.append(at_vertices(shape, np.array([entry.vertex for entry in own]), names))
    if faces := [k for k in numbers if entries[k].vertex is None and entries[k].face is not None]:
        own, names = some(faces)
        weights = np.array([entry.weights for entry in own])
        parts.append(at_faces(shape, np.array([entry.face for entry in own]), weights, names))
    if positions := [k for k in numbers if entries[k].vertex is None and entries[k].face is None]:
        own, names = some(positions)
        found, distance = at_points(shape, np.array([entry.position for entry in own]), names)
        parts.append(found)
        furthest = float(distance.max())
    together, back = joined(parts), np.argsort(order)
    arrays = [
        getattr(together, name)[back] for name in ("points", "vertex", "face", "barycentric", "confidence")
    ]
    return Landmarks(tuple(together.names[k] for k in back), *arrays), furthest


def _read_csv(path: Path) -> list[_Entry]:
    rows = [
        [cell.strip() for cell in row]
        for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
        if row and not row[0].startswith("#")
    ]
    if not rows:
        return []
    head = [cell.lower() for cell in rows[0]]
    if {"vertex"} <= set(head) or {"x", "y", "z"} <= set(head) or {"face", "w0", "w1", "w2"} <= set(head):
        rows = rows[1:]
    else:
        width = len(head)
        if width not in (1, 2, 3, 4) or (width == 2 and _is_whole(head[0])):
            raise InputError("its first row names no columns", _HINT)
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
    record = json.loads(path.read_text(encoding="utf-8-sig"))
    if isinstance(record, dict) and isinstance(record.get("landmarks"), list | dict):
        record = record["landmarks"]
    if isinstance(record, dict):
        return [_named(name, value, k) for k, (name, value) in enumerate(record.items())]
    if not isinstance(record, list):
        raise InputError("it holds no list of landmarks")
    return [
        _entry(item, k) if isinstance(item, dict) else _named(str(k), item, k)
        for k, item in enumerate(record)
    ]


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
    raise InputError(f"landmark {name} has no place", _HINT)


def _whole(value: Any, name: str) -> int:
    if isinstance(value, bool) or int(value) != value or abs(int(value)) >= 2**62:
        raise InputError(f"landmark {name}: {str(value)[:40]} is no number of a vertex or face")
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
        raise InputError(f"it is no file of MeshLab's picked points: its root is '{root.tag}'")
    entries: list[_Entry] = []
    for point in root.iter("point"):
        if point.get("active", "1") == "0":
            continue  # a name of a template that nobody has placed
        record = {
            "name": point.get("name"),
            "position": [float(point.get(axis, "nan")) for axis in "xyz"],
        }
        entries.append(_entry(record, len(entries)))
    return entries


def check_landmarks_suffix(path: Path) -> None:
    """Refuse a suffix that cannot hold landmarks (`OptionError`)."""
    if path.suffix.lower() not in LANDMARK_SUFFIXES:
        raise OptionError(
            f"{path.name}: landmarks cannot be kept as '{path.suffix or 'a file without a suffix'}'",
            f"end the name in one of {' '.join(LANDMARK_SUFFIXES)}",
        )


def save_landmarks(path: Path, landmarks: Landmarks) -> None:
    """Write landmarks; see the module for the formats.

    Raises
    ------
    OptionError
        The suffix is none of `LANDMARK_SUFFIXES`.
    """
    check_landmarks_suffix(path)
    suffix = path.suffix.lower()
    rows = list(
        zip(
            landmarks.names,
            landmarks.vertex.tolist(),
            landmarks.points.tolist(),
            landmarks.face.tolist(),
            landmarks.barycentric.tolist(),
            landmarks.confidence.astype(np.float32).astype(np.str_).tolist(),
            strict=True,
        )
    )
    if suffix == ".csv":
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(COLUMNS)
            writer.writerows(
                [name, vertex, *point, face, *weights, sure]
                for name, vertex, point, face, weights, sure in rows
            )
        return
    if suffix == ".json":
        keys = ("name", "vertex", "position", "face", "barycentric", "confidence")
        records = [dict(zip(keys, (*row[:5], float(row[5])), strict=True)) for row in rows]
        text = json.dumps({"format": _FORMAT, "landmarks": records}, ensure_ascii=False, indent=1)
        path.write_text(text + "\n", encoding="utf-8")
        return
    root = ElementTree.Element("PickedPoints")
    for name, _, (x, y, z), *_ in rows:
        place = {"x": repr(x), "y": repr(y), "z": repr(z), "name": name, "active": "1"}
        ElementTree.SubElement(root, "point", place)
    ElementTree.indent(root, " ")
    text = ElementTree.tostring(root, encoding="unicode")
    path.write_text(f"<!DOCTYPE PickedPoints>\n{text}\n", encoding="utf-8")
