"""Landmarks in files: tables of vertices or positions, JSON, MeshLab's picked points, 3D Slicer's markups, the .pts and
.tps of landmark editors, the text of Amira and of Morphologika. What a file says of each point is read here;
`meshmatch.transfer.landmarks` puts it on a shape.

3D Slicer writes points and meshes in one of two frames, which differ in the signs of x and y, and says which: LPS or RAS.
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
from meshmatch.shapes.tables import DECIMAL_COMMA, is_missing, is_number, number, read_table

Space = Literal["", "LPS", "RAS"]
Kind = Literal["vertex", "face", "position", "missing"]
# One as a file has it: name; vertex, face and barycentric, or position. What is missing is None or nan.
Record = dict[str, Any]
Markup = tuple[int, str]
"""The number of a list of 3D Slicer that a point is in, and what the list is."""
_POINTS = "Fiducial"
_BY_POINTS = ("Line", "Angle", "Curve", "ClosedCurve")  # lists that their points say all about
_LARGEST_PP = 10_000_000
_HEAD = 4096  # bytes of a mesh's file within which 3D Slicer says its frame
_RECORD = 1200  # bytes of memory that a landmark takes while it is read
_ABSENT = 9999.0  # all three coordinates, in a .pts file: the point is missing
_PLACES = ({"vertex"}, {"x", "y", "z"}, {"face", "w0", "w1", "w2"})
_NAMES = ("name", "label", "landmark", "id")
_SPACES: dict[str, Space] = {"0": "RAS", "RAS": "RAS", "1": "LPS", "LPS": "LPS"}
_FCSV_COLUMNS = "id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID"


@dataclass(frozen=True)
class Place:
    """What a file says of one landmark."""

    name: str
    kind: Kind
    where: Any  # a vertex; a face and three weights; three coordinates; why it is missing
    markup: Markup = (0, _POINTS)


@dataclass(frozen=True)
class LandmarkFile:
    """What a file of landmarks holds."""

    places: tuple[Place, ...]
    has_names: bool  # names are the file's, else they are numbers
    space: Space  # the frame, where 3D Slicer says it
    turned: str  # what to say where x and y changed signs, because the mesh is in the other frame; else empty


def mesh_space(path: str | Path) -> Space:
    """The frame that 3D Slicer wrote into the header of a mesh's file; "" if it is not said. Label maps are read in LPS."""
    if suffix_of(Path(path)) in LABEL_MAP_SUFFIXES:
        return "LPS"
    try:
        with Path(path).open("rb") as file:
            found = re.search(rb"SPACE=(LPS|RAS)\b", file.read(_HEAD))
    except OSError:
        return ""
    return _SPACES[found[1].decode()] if found else ""


def read_landmark_file(path: Path, shape: str = "", space: Space = "") -> LandmarkFile:
    """The landmarks in a file, by its suffix (see `LANDMARK_READERS`).

    Parameters
    ----------
    path
        The file.
    shape
        The name of the shape that they are on: a .tps file may hold landmarks of several.
    space
        The frame that 3D Slicer gave the shape's file (`mesh_space`): landmarks in its other frame are turned.

    Raises
    ------
    InputError, ValueError
        The file holds no landmarks, or some that cannot be read.
    """
    reader = LANDMARK_READERS[path.suffix.lower()]
    records = reader(path, Path(shape.removesuffix(".gz")).stem) if reader in READERS_OF_SEVERAL else reader(path)
    if not records:
        raise InputError(f"{path.name} holds no landmark")
    if len(spaces := {_SPACES.get(str(record.get("space")), "") for record in records}) > 1:
        raise InputError("its markups are in several coordinate systems", "save each list in a file of its own")
    (own,), turned = spaces, ""
    if own and space and own != space:
        turned = f"{path.name} is in {own}, {shape} is in {space}: x and y change their signs"
    named = [not is_missing(str(record.get("name") or "")) for record in records]
    places = tuple(
        replace(_place(record, k, bool(turned)), markup=record.get("markup", (0, _POINTS)))
        for k, record in enumerate(records)
    )
    return LandmarkFile(places, all(named), own, turned)


def _place(record: Record, number: int, turned: bool) -> Place:
    given = record.get("name")
    name = one_line(str(number if given in (None, "") else given))
    face, weights, vertex = record.get("face"), record.get("barycentric"), record.get("vertex")
    if face is not None and face != -1 and weights is not None:
        return Place(name, "face", (_whole(face, name), _three(weights, name)))
    if not (vertex is None or vertex == -1 or vertex != vertex):
        return Place(name, "vertex", _whole(vertex, name))
    if record.get("position") is not None:
        x, y, z = _three(record["position"], name)
        if any(each != each for each in (x, y, z)):
            return Place(name, "missing", " has no position")
        return Place(name, "position", [-x, -y, z] if turned else [x, y, z])
    if not {"vertex", "position"} & set(record):
        raise InputError(f"landmark {name} has no vertex and no position")
    return Place(name, "missing", " is vertex -1" if vertex == -1 else " has no vertex and no position")


def one_line(name: str) -> str:
    """A name as files have it: without line ends and other marks that are not printed, and with single spaces."""
    words = "".join(c if c.isprintable() else " " for c in name)
    return plain_text(" ".join(words.split()))


def _whole(value: Any, name: str) -> int:
    if isinstance(value, bool) or int(value) != value or abs(int(value)) >= 2**62:
        raise InputError(f"landmark {name}: {str(value)[:40]} is not the number of a vertex or face")
    return int(value)


def _three(values: Any, name: str) -> list[float]:
    if not isinstance(values, list) or len(values) != 3:
        comma = DECIMAL_COMMA if isinstance(values, list) and len(values) == 6 else ""
        raise InputError(f"landmark {name}: three numbers are needed, not {str(values)[:40]}", comma)
    return [number(value) if isinstance(value, str) else float("nan" if value is None else value) for value in values]


def _read_npy(path: Path) -> list[Record]:
    array = read_npy(path)
    check_memory(path.name, path.stat().st_size, _RECORD * len(array) if array.ndim else 0)
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
    """A row for each: a vertex, three coordinates, or these behind a name; or columns that are named, of which one may
    name the specimen.
    """
    if path.suffix.lower() == ".txt" and (text := read_text(path, _RECORD)).lstrip().startswith("["):
        return _morphologika(text, shape)
    table = read_table(path, comments="ends" if path.suffix.lower() == ".txt" else "lines", whole=True)
    rows = table.rows()
    if not rows:
        return []
    check_memory(path.name, path.stat().st_size, _RECORD * len(rows))
    head = _columns(rows[0])
    said = _columns(next(csv.reader([table.comment.replace(";", ",").replace("\t", ",")]), []))
    if head:
        rows = rows[1:]
    elif said and len(said) == len(rows[0]):
        head = said
    else:
        head = _usual_columns(rows[0])
        numbers = [k for k, name in enumerate(head) if name != "name"]
        if len(rows) > 1 and not any(is_number(rows[0][k]) for k in numbers):
            rows = rows[1:] if all(is_number(rows[1][k]) for k in numbers) else rows  # names of other columns
    if "specimen" in head:
        at = head.index("specimen")
        specimens = list(dict.fromkeys(row[at] for row in rows))
        chosen = specimens[_chosen([{each} for each in specimens], shape)]
        rows = [row for row in rows if row[at] == chosen]
    own = next((name for name in _NAMES if name in head), "")
    counted = [k for k, name in enumerate(head) if name in ("x", "y", "z", "w0", "w1", "w2")]
    table.check_marks([[row[k] for k in counted] for row in rows])
    records = []
    for row in rows:
        cell = dict(zip(head, row, strict=True))
        value = {name: number(cell[name]) for name in cell if any(name in place for place in _PLACES)}
        record: Record = {"name": cell.get(own)}
        # The most exact of what a row has: a face with weights, then a vertex, then a position.
        if {"face", "w0", "w1", "w2"} <= set(value) and value["face"] >= 0:
            record |= {"face": value["face"], "barycentric": [value[name] for name in ("w0", "w1", "w2")]}
        if "vertex" in value:
            record["vertex"] = value["vertex"]
        if {"x", "y", "z"} <= set(value):
            record["position"] = [value[axis] for axis in "xyz"]
        records.append(record)
    return records


def _columns(row: Sequence[str]) -> list[str]:
    """The names of columns in small letters, if a row holds those of a place."""
    names = [cell.strip().lower() for cell in row]
    return names if any(place <= set(names) for place in _PLACES) else []


def _usual_columns(row: Sequence[str]) -> list[str]:
    width = len(row)
    if width not in (1, 2, 3, 4) or (width == 2 and row[0].lstrip("-").isdigit()):
        comma = f"; {DECIMAL_COMMA}" if all(cell.lstrip("-").isdigit() for cell in row[-2:]) else ""
        problem = "its first row names no columns"
        raise InputError(problem, f"name them: name,vertex or name,x,y,z{comma}")
    return {1: ["vertex"], 2: ["name", "vertex"], 3: ["x", "y", "z"], 4: ["name", "x", "y", "z"]}[width]


def _read_json(path: Path) -> list[Record]:
    found = read_json(path)
    if isinstance(found, dict) and isinstance(found.get("markups"), list):
        return _markups(path, found["markups"])
    if isinstance(found, dict) and isinstance(found.get("landmarks"), list | dict):
        found = found["landmarks"]
    if isinstance(found, dict | list):
        check_memory(path.name, path.stat().st_size, _RECORD * len(found))
    if isinstance(found, dict):
        return [{"name": name, **_record(value)} for name, value in found.items()]
    if isinstance(found, list):
        return [_record(value) for value in found]
    raise InputError("it holds no list of landmarks")


def _record(value: Any) -> Record:
    """A vertex, a position or a description."""
    if isinstance(value, dict):
        axes = {key.lower(): value[key] for key in value}
        if {"x", "y", "z"} <= set(axes) and "position" not in value:
            return value | {"position": [axes[axis] for axis in "xyz"]}
        return value
    return {"vertex" if isinstance(value, int | float) else "position": value}


def _markups(path: Path, lists: list[Any]) -> list[Record]:
    """The control points of 3D Slicer's markups."""
    records: list[Record] = []
    for list_number, markup in enumerate(lists):
        points = markup.get("controlPoints", []) if isinstance(markup, dict) else None  # a region has none
        if not isinstance(points, list) or not all(isinstance(point, dict) for point in points):
            raise InputError("its markups hold no list of control points")
        check_memory(path.name, path.stat().st_size, _RECORD * (len(records) + len(points)))
        space = _SPACES.get(str(markup.get("coordinateSystem", "")).upper(), "") if points else ""
        kind = markup["type"] if markup.get("type") in _BY_POINTS else _POINTS
        common = {"space": space, "markup": (list_number, kind)}
        for point in points:
            is_set = point.get("positionStatus", "defined") == "defined"
            position = point.get("position") if is_set else None
            records.append({"name": point.get("label"), "position": position or None, **common})
    return records


def _read_fcsv(path: Path) -> list[Record]:
    """3D Slicer's fiducials: comments say the frame and the columns."""
    text = read_text(path, _RECORD)
    space = re.search(r"^#\s*CoordinateSystem\s*=\s*(\w+)", text, re.MULTILINE)
    if space and space[1].upper() not in _SPACES:
        raise InputError(f"its coordinate system is {space[1][:20]}, not LPS or RAS")
    columns = re.search(r"^#\s*columns\s*=\s*(.+)$", text, re.MULTILINE)
    names = columns[1] if columns else _FCSV_COLUMNS
    mark = ";" if ";" in names else ","
    head = [name.strip() for name in names.split(mark)]
    if not {"x", "y", "z"} <= set(head):
        raise InputError("its columns have no x, y and z")
    records: list[dict[str, Any]] = []
    lines = (line for line in text.splitlines() if line.strip(" \t;,") and not line.startswith("#"))
    for row in csv.reader(lines, delimiter=mark):
        cell = dict(zip(head, row, strict=False))  # later columns may be left out
        if len(row) == len(head) + 3 and mark == ",":
            raise InputError(
                f"landmark {len(records)} has {len(row)} cells, but there are {len(head)} columns", DECIMAL_COMMA
            )
        name = cell.get("label") or cell.get("id")
        position = [number(cell.get(axis, "")) for axis in "xyz"]
        records.append({"name": name, "position": position, "space": _SPACES[space[1].upper()] if space else ""})
    return records


def _read_pts(path: Path) -> list[Record]:
    """Points a line, with or without a name before the three coordinates, among lines that count them."""
    records = []
    for line in read_text(path, _RECORD).splitlines():
        words = re.sub(r"[,;](?=\s|$)|\t", " ", line).split()
        counts = len(words) == 1 and (words[0].isdigit() or words[0] in "{}")
        declares = words and re.fullmatch(r"(version|n_points|points|dim|landmarks)\b.*", line.strip(), re.IGNORECASE)
        if not words or words[0].startswith(("#", "//")) or counts or declares:
            continue
        if len(words) not in (3, 4) or not all(map(is_number, words[-3:])):
            flat = len(words) == 2 and all(map(is_number, words))
            problem = "its points lie in a plane" if flat else f"{line.strip()[:40]!r} is not a point"
            raise InputError(problem, "a point a line: x y z, or name x y z")
        position = [number(word) for word in words[-3:]]
        missing = all(abs(each) == _ABSENT for each in position)
        name = words[0] if len(words) == 4 else None
        records.append({"name": name, "position": None if missing else position})
    return records


def _read_tps(path: Path, shape: str) -> list[Record]:
    """Landmarks of one specimen (LM3=), then the points of its curves; of several, those of the shape's name."""
    specimens: list[tuple[list[list[float]], dict[str, str]]] = []
    for line in read_text(path, _RECORD).splitlines():
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
            specimens[-1][0].append(_three(words, str(len(specimens[-1][0]))))
    if not specimens:
        return []
    points, facts = specimens[_chosen([{facts.get("ID", ""), facts.get("IMAGE", "")} for _, facts in specimens], shape)]
    scale = number(facts.get("SCALE", "1"))
    return [{"position": [scale * each for each in point]} for point in points]


def _morphologika(text: str, shape: str) -> list[Record]:
    """Landmarks of one specimen of Morphologika's file: sections behind words in brackets, the points of all in one."""
    sections: dict[str, list[str]] = {}
    for line in filter(None, map(str.strip, text.splitlines())):
        if line.startswith("["):
            found = sections.setdefault(line.strip("[]").lower(), [])
        else:
            found.append(line)
    counts = [sections.get(name, [""])[:1] for name in ("individuals", "landmarks", "dimensions")]
    if not all(each and each[0].isdecimal() for each in counts):
        raise InputError("it does not say how many individuals, landmarks and dimensions it has")
    S, L, dimensions = (int(each[0]) for each in counts)
    if dimensions != 3:
        raise InputError(f"its landmarks have {dimensions} dimensions", "those of a shape have three")
    points = [line.split() for line in sections.get("rawpoints", []) if not line.startswith("'")]
    if S == 0 or len(points) != S * L:
        raise InputError(f"it has {len(points)} points, not {L} landmarks of {S} individuals")
    names = sections.get("names", [])
    first = L * _chosen([{name} for name in names] if len(names) == S else [set()] * S, shape)
    return [{"position": _three(words, str(k))} for k, words in enumerate(points[first : first + L])]


def _chosen(ids: Sequence[Collection[str]], shape: str) -> int:
    """Which of the specimens a shape is, by what each is called: as the shape, or as its file with a suffix."""
    own = [0] if len(ids) == 1 else []
    for part in ("name", "stem"):
        called = [{getattr(PureWindowsPath(name), part) for name in names} for names in ids]
        own = own or [k for k, names in enumerate(called) if shape and shape in names]
    if len(own) != 1:
        problem = f"it holds landmarks of {len(ids)} shapes, {len(own)} of them of {shape or 'this one'}"
        raise InputError(problem, "call each specimen as the file of its shape, or save each in a file of its own")
    return own[0]


def _read_amira(path: Path) -> list[Record]:
    """The points of Amira and Avizo: a header declares how many, and which section of the data they are in."""
    text = read_text(path, _RECORD)
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
    return [{"position": _three(line.split(), str(k))} for k, line in enumerate(points)]


def _read_pp(path: Path) -> list[Record]:
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
    records: list[Record] = []
    for point in root.iter("point"):
        is_placed = point.get("active", "1") != "0"  # else it is the name of a template's point that nobody has placed
        position = [number(point.get(axis, "")) for axis in "xyz"] if is_placed else None
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

READERS_OF_SEVERAL = (_read_tps, _read_table)  # those that take the name of one specimen as well


def tps_lines(specimens: Mapping[str, Floats]) -> Iterable[str]:
    """The lines of a .tps file, from the positions (L, 3) of each specimen's landmarks; nan is written as NA."""
    for name, points in specimens.items():
        yield f"LM3={len(points)}"
        yield from map(_three_words, points.tolist())
        yield f"ID={one_line(name)}"


def morphologika_lines(specimens: Mapping[str, Floats]) -> Iterable[str]:
    """The lines of Morphologika's text, from the positions (L, 3) of each specimen's landmarks; nan is written as NA."""
    names = [one_line(name) for name in specimens]
    length = len(next(iter(specimens.values())))
    yield from ("[individuals]", str(len(names)), "[landmarks]", str(length), "[dimensions]", "3", "[names]", *names)
    yield "[rawpoints]"
    for name, points in zip(names, specimens.values(), strict=True):
        yield f"'{name}"
        yield from map(_three_words, points.tolist())


def _three_words(position: Sequence[float]) -> str:
    """As R, with its package geomorph, reads a position, and one that is missing."""
    return " ".join("NA" if math.isnan(each) else repr(each) for each in position)


def fcsv_lines(points: Iterable[tuple[str, Sequence[float], float]], space: Space) -> Iterable[str]:
    """The lines of 3D Slicer's fiducials, from names, positions and confidences, in a frame. The format knows of none that
    are missing: 3D Slicer leaves out lines without a position, which those of nan are.
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
    """3D Slicer's markups (.mrk.json), from names, positions and confidences, in a frame; in the lists that they come from,
    such as curves. A position that is nan is undefined.
    """
    controls: list[dict[str, Any]] = []
    for k, (name, position, confidence) in enumerate(points, 1):
        controls.append({"id": str(k), "label": name, "description": _description(confidence)})
        is_set = not any(map(math.isnan, position))
        controls[-1] |= {"position": list(position)} if is_set else {}  # 3D Slicer refuses a file with an empty one
        controls[-1]["positionStatus"] = "defined" if is_set else "undefined"
    schema = "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    pairs = zip(lists or [(0, _POINTS)] * len(controls), controls, strict=True)
    markups = [
        {"type": kind, "coordinateSystem": space, "controlPoints": [control for _, control in own]}
        for (_, kind), own in groupby(pairs, key=lambda pair: pair[0])
    ]
    return {"@schema": f"{schema}markups-schema-v1.0.3.json#", "markups": markups}
