"""Landmark files: tables of vertices or positions, JSON, MeshLab's picked points, 3D Slicer's markups, the .pts and
.tps files of landmark editors, the text formats of Amira and Morphologika.

Files are parsed here; `meshmatch.transfer.landmarks` places the landmarks on a shape. 3D Slicer names the frame of
points and meshes in their files: LPS or RAS, which differ in the signs of x and y.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path, PureWindowsPath
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import InputError
from meshmatch.outputs import plain_text
from meshmatch.shapes.input_files import (
    LABEL_MAP_SUFFIXES,
    check_memory,
    read_bytes,
    read_json,
    read_npy,
    read_text,
    suffix_of,
)
from meshmatch.shapes.tables import DECIMAL_COMMA, is_missing, is_number, parse_number, read_table

Space = Literal["", "LPS", "RAS"]
Kind = Literal["vertex", "face", "position", "missing"]
# A landmark in a file: name; vertex, face and barycentric, or position. Missing values are None or nan.
Record = dict[str, Any]
Markup = tuple[int, str]
"""Number of the 3D Slicer list that a point belongs to, and the type of the list."""
_POINT_LIST = "Fiducial"
_POINT_DEFINED = ("Line", "Angle", "Curve", "ClosedCurve")  # list types that are defined by their points alone
_MAX_PP_BYTES = 10_000_000
_HEADER_BYTES = 4096  # bytes at the start of a mesh file that may contain 3D Slicer's frame
_RECORD_BYTES = 1200  # bytes of memory per landmark while reading
_ABSENT = 9999.0  # value of all three coordinates of a missing point in a .pts file
_PLACE_COLUMNS = ({"vertex"}, {"x", "y", "z"}, {"face", "w0", "w1", "w2"})
_NAME_COLUMNS = ("name", "label", "landmark", "id")
_SPACES: dict[str, Space] = {"0": "RAS", "RAS": "RAS", "1": "LPS", "LPS": "LPS"}
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"


@dataclass(frozen=True)
class Place:
    """One landmark as given in a file."""

    name: str
    kind: Kind
    where: Any  # a vertex; a face and three weights; three coordinates; or why it is missing
    markup: Markup = (0, _POINT_LIST)


@dataclass(frozen=True)
class LandmarkFile:
    """The contents of a landmark file."""

    places: tuple[Place, ...]
    has_names: bool  # whether the file has names; otherwise the names are numbers
    space: Space  # the frame, if 3D Slicer wrote one
    turned: str  # message if x and y changed signs because the mesh is in the other frame; else empty


def mesh_space(path: str | Path) -> Space:
    """The frame in the header of a mesh file that 3D Slicer wrote, else ""; label maps are read in LPS."""
    if suffix_of(Path(path)) in LABEL_MAP_SUFFIXES:
        return "LPS"
    try:
        with Path(path).open("rb") as file:
            found = re.search(rb"SPACE=(LPS|RAS)\b", file.read(_HEADER_BYTES))
    except OSError:
        return ""
    return _SPACES[found[1].decode()] if found else ""


def read_landmark_file(path: Path, shape: str = "", space: Space = "") -> LandmarkFile:
    """Read the landmarks of a file, with the reader for its suffix (see `LANDMARK_READERS`).

    Parameters
    ----------
    path
        The file.
    shape
        Name of the shape that they belong to: some formats hold landmarks of several specimens.
    space
        The frame of the shape's file (`mesh_space`): landmarks in the other frame are converted.

    Raises
    ------
    InputError, ValueError
        The file has no landmarks, or some that cannot be read.
    """
    reader = LANDMARK_READERS[path.suffix.lower()]
    records = reader(path, Path(shape.removesuffix(".gz")).stem) if reader in SPECIMEN_READERS else reader(path)
    if not records:
        raise InputError(f"{path.name} holds no landmark")
    if len(spaces := {_SPACES.get(str(record.get("space")), "") for record in records}) > 1:
        raise InputError("its markups are in several coordinate systems", "save each list in a file of its own")
    (file_space,), turned = spaces, ""
    if file_space and space and file_space != space:
        turned = f"{path.name} is in {file_space}, {shape} is in {space}: x and y change their signs"
    has_name = [not is_missing(str(record.get("name") or "")) for record in records]
    places = tuple(
        replace(_parse_place(record, k, bool(turned)), markup=record.get("markup", (0, _POINT_LIST)))
        for k, record in enumerate(records)
    )
    return LandmarkFile(places, all(has_name), file_space, turned)


def _parse_place(record: Record, number: int, turned: bool) -> Place:
    raw_name = record.get("name")
    name = one_line_name(str(number if raw_name in (None, "") else raw_name))
    face, weights, vertex = record.get("face"), record.get("barycentric"), record.get("vertex")
    if face is not None and face != -1 and weights is not None:
        return Place(name, "face", (_parse_index(face, name), _parse_three(weights, name)))
    if not (vertex is None or vertex == -1 or vertex != vertex):
        return Place(name, "vertex", _parse_index(vertex, name))
    if record.get("position") is not None:
        x, y, z = _parse_three(record["position"], name)
        if any(each != each for each in (x, y, z)):
            return Place(name, "missing", " has no position")
        return Place(name, "position", [-x, -y, z] if turned else [x, y, z])
    if not {"vertex", "position"} & set(record):
        raise InputError(f"landmark {name} has no vertex and no position")
    return Place(name, "missing", " is vertex -1" if vertex == -1 else " has no vertex and no position")


def one_line_name(name: str) -> str:
    """A name as files can hold it: on one line, without unprintable characters, and with single spaces."""
    words = "".join(c if c.isprintable() else " " for c in name)
    return plain_text(" ".join(words.split()))


def _parse_index(value: Any, name: str) -> int:
    if isinstance(value, bool) or int(value) != value or abs(int(value)) >= 2**62:
        raise InputError(f"landmark {name}: {str(value)[:40]} is not the number of a vertex or face")
    return int(value)


def _parse_three(values: Any, name: str) -> list[float]:
    if not isinstance(values, list) or len(values) != 3:
        comma = DECIMAL_COMMA if isinstance(values, list) and len(values) == 6 else ""
        raise InputError(f"landmark {name}: three numbers are needed, not {str(values)[:40]}", comma)
    return [
        parse_number(value) if isinstance(value, str) else float("nan" if value is None else value) for value in values
    ]


def _read_npy(path: Path) -> list[Record]:
    array = read_npy(path)
    check_memory(path.name, path.stat().st_size, _RECORD_BYTES * len(array) if array.ndim else 0)
    if array.dtype.kind in "fiu" and array.ndim == 2 and array.shape[1] == 3:
        return [{"position": row} for row in array.astype(np.float64).tolist()]
    flat = array[:, 0] if array.ndim == 2 and array.shape[1] == 1 else array
    with np.errstate(invalid="ignore"):
        is_list = (
            flat.dtype.kind in "fiu" and flat.ndim == 1 and bool((np.isnan(flat) | (flat == np.round(flat))).all())
        )
    if not is_list or not len(flat):
        shape = " x ".join(map(str, array.shape))
        problem = f"it holds no landmarks, but {shape} numbers of type {array.dtype}"
        raise InputError(
            problem, "either a list of vertices (-1: missing), or x, y and z of every point (nan: missing)"
        )
    return [{"vertex": vertex} for vertex in flat.tolist()]


def _read_table(path: Path, shape: str) -> list[Record]:
    """Landmarks of a table: rows of a vertex or three coordinates, with or without a name; or named columns.

    One of the named columns may name the specimen.
    """
    if path.suffix.lower() == ".txt" and (text := read_text(path, _RECORD_BYTES)).lstrip().startswith("["):
        return _morphologika_records(text, shape)
    table = read_table(path, comments="ends" if path.suffix.lower() == ".txt" else "lines", whole=True)
    rows = table.rows()
    if not rows:
        return []
    check_memory(path.name, path.stat().st_size, _RECORD_BYTES * len(rows))
    head = _named_columns(rows[0])
    comment_columns = _named_columns(next(csv.reader([table.comment.replace(";", ",").replace("\t", ",")]), []))
    if head:
        rows = rows[1:]
    elif comment_columns and len(comment_columns) == len(rows[0]):
        head = comment_columns
    else:
        head = _default_columns(rows[0])
        numbers = [k for k, name in enumerate(head) if name != "name"]
        if len(rows) > 1 and not any(is_number(rows[0][k]) for k in numbers):
            rows = rows[1:] if all(is_number(rows[1][k]) for k in numbers) else rows  # unknown column names
    if "specimen" in head:
        specimen_column = head.index("specimen")
        specimens = list(dict.fromkeys(row[specimen_column] for row in rows))
        chosen = specimens[_find_index([{each} for each in specimens], shape)]
        rows = [row for row in rows if row[specimen_column] == chosen]
    name_column = next((name for name in _NAME_COLUMNS if name in head), "")
    numeric = [k for k, name in enumerate(head) if name in ("x", "y", "z", "w0", "w1", "w2")]
    table.check_decimal_marks([[row[k] for k in numeric] for row in rows])
    records = []
    for row in rows:
        cell = dict(zip(head, row, strict=True))
        value = {name: parse_number(cell[name]) for name in cell if any(name in place for place in _PLACE_COLUMNS)}
        record: Record = {"name": cell.get(name_column)}
        # Use the most precise of a row: a face with weights, then a vertex, then a position.
        if {"face", "w0", "w1", "w2"} <= set(value) and value["face"] >= 0:
            record |= {"face": value["face"], "barycentric": [value[name] for name in ("w0", "w1", "w2")]}
        if "vertex" in value:
            record["vertex"] = value["vertex"]
        if {"x", "y", "z"} <= set(value):
            record["position"] = [value[axis] for axis in "xyz"]
        records.append(record)
    return records


def _named_columns(row: Sequence[str]) -> list[str]:
    """The column names of a row in lower case, if they include those of a place; else an empty list."""
    names = [cell.strip().lower() for cell in row]
    return names if any(place <= set(names) for place in _PLACE_COLUMNS) else []


def _default_columns(row: Sequence[str]) -> list[str]:
    """The columns of a table without column names, by its width."""
    width = len(row)
    if width not in (1, 2, 3, 4) or (width == 2 and row[0].lstrip("-").isdigit()):
        comma = f"; {DECIMAL_COMMA}" if all(cell.lstrip("-").isdigit() for cell in row[-2:]) else ""
        problem = "its first row names no columns"
        raise InputError(problem, f"name them: name,vertex or name,x,y,z{comma}")
    return {1: ["vertex"], 2: ["name", "vertex"], 3: ["x", "y", "z"], 4: ["name", "x", "y", "z"]}[width]


def _read_json(path: Path) -> list[Record]:
    content = read_json(path)
    if isinstance(content, dict) and isinstance(content.get("markups"), list):
        return _markup_records(path, content["markups"])
    if isinstance(content, dict) and isinstance(content.get("landmarks"), list | dict):
        content = content["landmarks"]
    if isinstance(content, dict | list):
        check_memory(path.name, path.stat().st_size, _RECORD_BYTES * len(content))
    if isinstance(content, dict):
        return [{"name": name, **_json_record(value)} for name, value in content.items()]
    if isinstance(content, list):
        return [_json_record(value) for value in content]
    raise InputError("it holds no list of landmarks")


def _json_record(value: Any) -> Record:
    """A landmark of a JSON file: a vertex, a position or an object."""
    if isinstance(value, dict):
        axes = {key.lower(): value[key] for key in value}
        if {"x", "y", "z"} <= set(axes) and "position" not in value:
            return value | {"position": [axes[axis] for axis in "xyz"]}
        return value
    return {"vertex" if isinstance(value, int | float) else "position": value}


def _markup_records(path: Path, lists: list[Any]) -> list[Record]:
    """The control points of 3D Slicer's markups."""
    records: list[Record] = []
    for list_number, markup in enumerate(lists):
        points = markup.get("controlPoints", []) if isinstance(markup, dict) else None  # regions have no control points
        if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
            raise InputError("its markups hold no list of control points")
        check_memory(path.name, path.stat().st_size, _RECORD_BYTES * (len(records) + len(points)))
        space = _SPACES.get(str(markup.get("coordinateSystem", "")).upper(), "") if points else ""
        kind = markup["type"] if markup.get("type") in _POINT_DEFINED else _POINT_LIST
        common = {"space": space, "markup": (list_number, kind)}
        for point in points:
            is_set = point.get("positionStatus", "defined") == "defined"
            position = point.get("position") if is_set else None
            records.append({"name": point.get("label"), "position": position or None, **common})
    return records


def _read_fcsv(path: Path) -> list[Record]:
    """3D Slicer's fiducials; comments name the frame and the columns."""
    text = read_text(path, _RECORD_BYTES)
    space = re.search(r"^#\s*CoordinateSystem\s*=\s*(\w+)", text, re.MULTILINE)
    if space and space[1].upper() not in _SPACES:
        raise InputError(f"its coordinate system is {space[1][:20]}, not LPS or RAS")
    columns = re.search(r"^#\s*columns\s*=\s*(.+)$", text, re.MULTILINE)
    names = columns[1] if columns else _FCSV_COLUMNS
    delimiter = ";" if ";" in names else ","
    head = [name.strip() for name in names.split(delimiter)]
    if not {"x", "y", "z"} <= set(head):
        raise InputError("its columns have no x, y and z")
    records: list[dict[str, Any]] = []
    lines = (line for line in text.splitlines() if line.strip(" \t;,") and not line.startswith("#"))
    for row in csv.reader(lines, delimiter=delimiter):
        cell = dict(zip(head, row, strict=False))  # trailing columns may be omitted
        if len(row) == len(head) + 3 and delimiter == ",":
            raise InputError(
                f"landmark {len(records)} has {len(row)} cells, but there are {len(head)} columns", DECIMAL_COMMA
            )
        name = cell.get("label") or cell.get("id")
        position = [parse_number(cell.get(axis, "")) for axis in "xyz"]
        records.append({"name": name, "position": position, "space": _SPACES[space[1].upper()] if space else ""})
    return records


def _read_pts(path: Path) -> list[Record]:
    """One point per line, three coordinates with or without a name before them; lines with counts are skipped."""
    records = []
    for line in read_text(path, _RECORD_BYTES).splitlines():
        words = re.sub(r"[,;](?=\s|$)|\t", " ", line).split()
        is_count = len(words) == 1 and (words[0].isdigit() or words[0] in "{}")
        is_header = words and re.fullmatch(r"(version|n_points|points|dim|landmarks)\b.*", line.strip(), re.IGNORECASE)
        if not words or words[0].startswith(("#", "//")) or is_count or is_header:
            continue
        if len(words) not in (3, 4) or not all(map(is_number, words[-3:])):
            is_planar = len(words) == 2 and all(map(is_number, words))
            problem = "its points lie in a plane" if is_planar else f"{line.strip()[:40]!r} is not a point"
            raise InputError(problem, "a point a line: x y z, or name x y z")
        position = [parse_number(word) for word in words[-3:]]
        missing = all(abs(each) == _ABSENT for each in position)
        name = words[0] if len(words) == 4 else None
        records.append({"name": name, "position": None if missing else position})
    return records


def _read_tps(path: Path, shape: str) -> list[Record]:
    """Landmarks of one specimen (LM3=), then the points of its curves; of several, those of the shape's name."""
    specimens: list[tuple[list[list[float]], dict[str, str]]] = []
    for line in read_text(path, _RECORD_BYTES).splitlines():
        key, has_value, value = (part.strip() for part in line.partition("="))
        key = key.upper()
        if key == "LM" or key == "LM3":
            specimens.append(([], {}))
        elif not line.strip():
            continue
        elif not specimens:
            raise InputError(f"it begins with {line.strip()[:40]!r}", "landmarks begin with LM3= and their number")
        elif has_value:
            specimens[-1][1][key] = value
        else:
            words = line.split()
            if len(words) == 2:
                raise InputError("its landmarks lie in a plane", "those of a shape have three coordinates: LM3=")
            specimens[-1][0].append(_parse_three(words, str(len(specimens[-1][0]))))
    if not specimens:
        return []
    points, meta = specimens[_find_index([{meta.get("ID", ""), meta.get("IMAGE", "")} for _, meta in specimens], shape)]
    scale = parse_number(meta.get("SCALE", "1"))
    return [{"position": [scale * each for each in point]} for point in points]


def _morphologika_records(text: str, shape: str) -> list[Record]:
    """Landmarks of one specimen of a Morphologika file: sections with names in brackets, one with all points."""
    sections: dict[str, list[str]] = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        if line.startswith("["):
            section = sections.setdefault(line.strip("[]").lower(), [])
        else:
            section.append(line)
    sizes = [sections.get(name, [""])[:1] for name in ("individuals", "landmarks", "dimensions")]
    if not all(each and each[0].isdecimal() for each in sizes):
        raise InputError("it does not say how many individuals, landmarks and dimensions it has")
    S, L, dimensions = (int(each[0]) for each in sizes)
    if dimensions != 3:
        raise InputError(f"its landmarks have {dimensions} dimensions", "those of a shape have three")
    points = [line.split() for line in sections.get("rawpoints", []) if not line.startswith("'")]
    if S == 0 or len(points) != S * L:
        raise InputError(f"it has {len(points)} points, not {L} landmarks of {S} individuals")
    names = sections.get("names", [])
    first = L * _find_index([{name} for name in names] if len(names) == S else [set()] * S, shape)
    return [{"position": _parse_three(words, str(k))} for k, words in enumerate(points[first : first + L])]


def _find_index(ids: Sequence[Collection[str]], shape: str) -> int:
    """Index of the specimen whose names include that of the shape, or of its file with a suffix."""
    matches = [0] if len(ids) == 1 else []
    for part in ("name", "stem"):
        labels = [{getattr(PureWindowsPath(name), part) for name in names} for names in ids]
        matches = matches or [k for k, names in enumerate(labels) if shape and shape in names]
    if len(matches) != 1:
        problem = f"it holds landmarks of {len(ids)} shapes, {len(matches)} of them of {shape or 'this one'}"
        raise InputError(problem, "call each specimen as the file of its shape, or save each in a file of its own")
    return matches[0]


def _read_amira(path: Path) -> list[Record]:
    """Landmarks of Amira and Avizo; the header declares their number and their section."""
    text = read_text(path, _RECORD_BYTES)
    header, *sections = re.split(r"^@(\d+)[ \t]*$", text, flags=re.MULTILINE)
    count = re.search(r"\bdefine\s+Markers\s+(\d+)", header)
    declared = re.findall(r"\bMarkers\s*\{\s*(?:float|double)\[3\][^}]*\}[ =]*@(\d+)", header)
    if count is None or not declared:
        raise InputError("it is not the text of a set of landmarks", "save it in Amira as LandmarkSet Ascii")
    if len(declared) > 1:
        raise InputError(f"it holds {len(declared)} sets of landmarks", "save each set in a file of its own")
    points = dict(zip(sections[::2], sections[1::2], strict=True)).get(declared[0], "").strip().splitlines()
    if len(points) != int(count[1]):
        raise InputError(f"it has {len(points)} landmarks, but declares {count[1][:20]}")
    return [{"position": _parse_three(line.split(), str(k))} for k, line in enumerate(points)]


def _read_pp(path: Path) -> list[Record]:
    data = read_bytes(path)
    if len(data) > _MAX_PP_BYTES:
        raise InputError(f"it is too large: over {_MAX_PP_BYTES // 10**6} MB", "landmarks are a few named points")
    if b"<!ENTITY" in data:
        raise InputError("it defines XML entities, which a file of picked points has no use for")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise InputError(f"it is not XML: {error}") from error
    if root.tag != "PickedPoints":
        raise InputError(f"it is not a file of MeshLab's picked points: its root is '{root.tag}'")
    records: list[Record] = []
    for point in root.iter("point"):
        is_placed = point.get("active", "1") != "0"  # otherwise it is an unplaced point of a template
        position = [parse_number(point.get(axis, "")) for axis in "xyz"] if is_placed else None
        records.append({"name": point.get("name"), "position": position})
    return records


LANDMARK_READERS: Mapping[str, Callable[..., list[Record]]] = {
    ".csv": _read_table,
    ".json": _read_json,
    ".pp": _read_pp,
    ".fcsv": _read_fcsv,
    ".pts": _read_pts,
    ".tps": _read_tps,
    ".landmarkascii": _read_amira,
    ".txt": _read_table,
    ".npy": _read_npy,
}

SPECIMEN_READERS = (_read_tps, _read_table)  # readers that also take the name of a specimen


def tps_lines(specimens: Mapping[str, Floats]) -> Iterable[str]:
    """Lines of a .tps file from the landmark positions (L, 3) of each specimen; nan is written as NA."""
    for name, points in specimens.items():
        yield f"LM3={len(points)}"
        yield from map(_format_three, points.tolist())
        yield f"ID={one_line_name(name)}"


def morphologika_lines(specimens: Mapping[str, Floats]) -> Iterable[str]:
    """Lines of a Morphologika file from the landmark positions (L, 3) of each specimen; nan is written as NA."""
    names = [one_line_name(name) for name in specimens]
    length = len(next(iter(specimens.values())))
    yield from ("[individuals]", str(len(names)), "[landmarks]", str(length), "[dimensions]", "3", "[names]", *names)
    yield "[rawpoints]"
    for name, points in zip(names, specimens.values(), strict=True):
        yield f"'{name}"
        yield from map(_format_three, points.tolist())


def _format_three(position: Sequence[float]) -> str:
    """Coordinates as the R package geomorph reads them, with NA for a missing position."""
    return " ".join("NA" if math.isnan(each) else repr(each) for each in position)


def fcsv_lines(points: Iterable[tuple[str, Sequence[float], float]], space: Space) -> Iterable[str]:
    """Lines of a 3D Slicer fiducials file, from names, positions and confidences, in a frame.

    The format cannot mark missing points: 3D Slicer skips lines without a position, which nan is written as.
    """
    yield "# Markups fiducial file version = 4.11"
    yield f"# CoordinateSystem = {space}"
    yield f"# columns = {_FCSV_COLUMNS}"
    for k, (name, (x, y, z), confidence) in enumerate(points, 1):
        xyz = ["", "", ""] if math.isnan(x + y + z) else [repr(x), repr(y), repr(z)]
        label = '"' + name.replace('"', '""') + '"' if set(name) & set('",') else name
        yield f"{k},{','.join(xyz)},0.0,0.0,0.0,1.0,1,1,0,{label},{_description(confidence)},"


def _description(confidence: float) -> str:
    return "" if math.isnan(confidence) else f"confidence {confidence:.3g}"


def markups_record(
    points: Iterable[tuple[str, Sequence[float], float]], space: Space, lists: Sequence[Markup] = ()
) -> dict[str, Any]:
    """3D Slicer markups (.mrk.json), from names, positions and confidences, in a frame, in one list or in ``lists``.

    A position that is nan is undefined.
    """
    controls: list[dict[str, Any]] = []
    for k, (name, position, confidence) in enumerate(points, 1):
        controls.append({"id": str(k), "label": name, "description": _description(confidence)})
        is_set = not any(map(math.isnan, position))
        controls[-1] |= {"position": list(position)} if is_set else {}  # 3D Slicer rejects an empty position
        controls[-1]["positionStatus"] = "defined" if is_set else "undefined"
    schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    pairs = zip(lists or [(0, _POINT_LIST)] * len(controls), controls, strict=True)
    markups = [
        {"type": kind, "coordinateSystem": space, "controlPoints": [control for _, control in members]}
        for (_, kind), members in groupby(pairs, key=lambda pair: pair[0])
    ]
    return {"@schema": f"{schema}markups-schema-v1.0.3.json#", "markups": markups}
