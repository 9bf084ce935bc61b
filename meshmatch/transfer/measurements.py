"""Measurements of a shape, such as girths and lengths, that are defined by landmarks of another: their files, and how they
are taken. "Measurements" in docs/measurements.md says what each kind is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from meshmatch.arrays import Bool, Bools, Brief, Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import squared_lengths
from meshmatch.shapes import tables
from meshmatch.shapes.faces import seams
from meshmatch.shapes.input_files import read_json
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.landmarks import Landmarks, at_faces, joined

MeasurementKind = Literal["distance", "girth", "angle"]
_LANDMARKS = {"distance": "two landmarks or more", "girth": "three landmarks", "angle": "three landmarks"}
_HINT = "a row each: name,kind,landmark,landmark,...; the kinds are distance, girth and angle"
_SPACING = 1 / 64  # of a girth: so far apart its points lie at most
_ENOUGH = 0.75  # share of a girth's points that must be trusted
MEASUREMENT_SUFFIXES = (".csv", ".json")
check_measurements_suffix = partial(tables.check_suffix, suffixes=MEASUREMENT_SUFFIXES, what="measurements")


@dataclass(frozen=True)
class Measurement:
    """What is measured between which landmarks.

    Attributes
    ----------
    name
        Such as "waist girth".
    kind
        ``distance``: along straight lines from landmark to landmark, two or more. ``girth``: around what the first landmark
        lies on, in the plane through it that the line from the second to the third is perpendicular to, as a tape lies.
        ``angle``: at the second of three, in degrees.
    landmarks
        Their names.

    Examples
    --------
    >>> meshmatch.Measurement("waist girth", "girth", ("waist", "crotch", "crown"))
    """

    name: str
    kind: MeasurementKind
    landmarks: tuple[str, ...]

    def __post_init__(self) -> None:
        if self.kind not in get_args(MeasurementKind):
            raise InputError(f"measurement {self.name}: {self.kind!r} is no kind of measurement", _HINT)
        count = len(self.landmarks)
        if count < 2 or (self.kind != "distance" and count != 3):
            raise InputError(f"measurement {self.name}: {self.kind} needs {_LANDMARKS[self.kind]}, not {count}", _HINT)


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Brief):
    """What was measured on a shape.

    Attributes
    ----------
    names
        Of N measurements.
    kinds
        ``distance``, ``girth`` or ``angle``.
    values
        (N,) in the unit of the shape's file; angles in degrees. What lies where the shape is missing is nan.
    confidence
        (N,) of the map where each was taken, from 0 (a guess) to 1 (certain); nan where that is not known.
    lines
        The points, (M, 3) each, that a measurement leads through, in the frame of the file; of a girth a closed line.

    Examples
    --------
    >>> found = meshmatch.measure("body", "templates/samples/dancer.ply").data
    >>> dict(zip(found.names, found.values))
    """

    names: tuple[str, ...]
    kinds: tuple[MeasurementKind, ...]
    values: Float[Floats, " N"]
    confidence: Float[Floats, " N"]
    lines: tuple[Float[Floats, "M 3"], ...]


@dataclass(frozen=True, eq=False)
class MeasuringPoints:
    """The points of a shape by which measurements are taken: what another shape needs is where they are on it."""

    shape: Shape
    measurements: tuple[Measurement, ...]
    points: Landmarks  # on the shape; of all, one after the other
    ends: Int[Ints, " N"]  # where those of each end

    @classmethod
    def of(cls, shape: Shape, landmarks: Landmarks, measurements: Sequence[Measurement]) -> MeasuringPoints:
        """On the shape whose landmarks they are defined by; `InputError` for a landmark that is not one of these."""
        row = {name: k for k, name in enumerate(landmarks.names)}
        surface, parts = _Surface(shape), []
        for each in measurements:
            for name in each.landmarks:
                if name not in row:
                    near = get_close_matches(name, row, 1)
                    hint = f"did you mean {near[0]!r}?" if near else f"there are {', '.join(list(row)[:8])}"
                    raise InputError(f"measurement {each.name}: no landmark is called {name!r}", hint)
            rows = np.array([row[name] for name in each.landmarks])
            own = joined([landmarks], rows)
            parts.append(surface.loop(own.points, each.name) if each.kind == "girth" else own)
        ends = np.cumsum([len(part.names) for part in parts])
        return cls(shape, tuple(measurements), joined(parts), ends)

    def taken(self, places: Landmarks, minimum: float = 0.0) -> Measurements:
        """By where the points are on a shape; what is less confident than the minimum is not trusted."""
        values, confidence, lines = [], [], []
        for each, begin, end in zip(self.measurements, [0, *self.ends[:-1]], self.ends, strict=True):
            points, sure = places.points[begin:end], places.confidence[begin:end]
            trusted = ~(sure < minimum) & np.isfinite(points).all(axis=1)  # unknown confidence is none
            missing = trusted.mean() < (_ENOUGH if each.kind == "girth" else 1.0)
            value, line = (np.nan, np.empty((0, 3))) if missing else _MEASURE[each.kind](points[trusted])
            values.append(value)
            confidence.append(float(sure.mean()))
            lines.append(line)
        names, kinds = zip(*((each.name, each.kind) for each in self.measurements), strict=True)
        return Measurements(names, kinds, np.array(values), np.array(confidence), tuple(lines))


def load_measurements(path: str | Path) -> tuple[Measurement, ...]:
    """The measurements that a table defines, a row each: a name, a kind, and the names of landmarks.

    Raises
    ------
    InputError
        It is not such a table, or two are of one name.
    """
    return tables.read_by_suffix(path, {".csv": _read, ".txt": _read}, "measurements", _HINT)


def _read(path: Path) -> tuple[Measurement, ...]:
    rows = tables.read_table(path).rows()
    if rows and len(rows[0]) > 1 and rows[0][1].lower() == "kind":
        rows = rows[1:]
    found = []
    for name, kind, *landmarks in rows if rows and len(rows[0]) > 2 else ():
        found.append(Measurement(name, kind.lower(), tuple(each for each in landmarks if each)))  # type: ignore[arg-type]
    return each_once(found)


def each_once(measurements: Sequence[Measurement]) -> tuple[Measurement, ...]:
    """The same; `InputError` where two are of one name, or there are none."""
    seen: set[str] = set()
    for each in measurements:
        if not isinstance(each, Measurement):
            raise InputError(
                f"{type(each).__name__} is no measurement", "pass meshmatch.Measurement, or a table's path"
            )
        if each.name in seen:
            raise InputError(f"two measurements are called {each.name!r}", "give each a name of its own")
        seen.add(each.name)
    if not seen:
        raise InputError("there is nothing to measure", _HINT)
    return tuple(measurements)


def save_measurements(path: Path, found: Measurements) -> None:
    """Write a .csv with a row for each, or a .json, which also has the lines; `OptionError` for another suffix."""
    sure = tables.short_floats(found.confidence)
    values = [None if value != value else value for value in found.values.tolist()]
    rows = list(zip(found.names, found.kinds, values, sure, strict=True))
    if check_measurements_suffix(path) == ".csv":
        cells = [["" if cell is None else cell for cell in row] for row in rows]
        tables.write_rows(path, ["name", "kind", "value", "confidence"], cells)
        return
    keys = ("name", "kind", "value", "confidence", "line")
    lines = (line.tolist() for line in found.lines)
    records: list[dict[str, Any]] = [
        dict(zip(keys, (*row, line), strict=True)) for row, line in zip(rows, lines, strict=True)
    ]
    tables.write_json(path, {"format": "meshmatch measurements 1", "measurements": records}, indent=1)


def measured_values(path: Path) -> dict[str, float]:
    """What a file that `save_measurements` wrote says, by name; nan where something is missing."""
    if path.suffix.lower() == ".json":
        records = tables.read_by_suffix(path, {".json": _read_json}, "measurements", _HINT)
        return {str(each["name"]): float("nan" if each["value"] is None else each["value"]) for each in records}
    rows = tables.read_by_suffix(path, {".csv": lambda path: tables.read_table(path).rows()}, "measurements", _HINT)
    return {name: tables.number(value) for name, _, value, *_ in rows[1:]}


def _read_json(path: Path) -> list[dict[str, Any]]:
    return list(read_json(path)["measurements"])


class _Surface:
    """The faces of a shape, cut by planes."""

    def __init__(self, shape: Shape) -> None:
        self.shape, self.rows = shape, np.flatnonzero(shape.valid_faces)
        self.faces = shape.faces[self.rows]

    @cached_property
    def twin(self) -> Int[Ints, " V"]:
        """The vertex to use instead of each where the file has copies along seams."""
        return seams(self.shape.verts, self.faces)

    def loop(self, points: Float[Floats, "3 3"], name: str) -> Landmarks:
        """Points along the line in which the plane through the first point, perpendicular to the way from the second to the
        third, cuts the surface: of the pieces of that line the one nearest to the point. `InputError` if there is none.
        """
        (at, start, end), verts = points, self.shape.verts
        if not len(self.faces):
            raise InputError(
                f"measurement {name}: a girth needs a surface, and {self.shape.name or 'the shape'} has none"
            )
        if not np.linalg.norm(end - start) > 0:
            raise InputError(
                f"measurement {name}: its second and third landmark are one point, which gives no direction"
            )
        height = (verts - at) @ (end - start)
        upper = height[self.faces] > 0
        cut = np.flatnonzero(upper.any(axis=1) & ~upper.all(axis=1))
        if not len(cut):
            raise InputError(f"measurement {name}: the plane through its first landmark does not cut the surface")
        corners, upper, rows = self.faces[cut], upper[cut], np.arange(len(cut))
        alone = np.where(upper.sum(axis=1) == 1, upper.argmax(axis=1), (~upper).argmax(axis=1))
        tip = corners[rows, alone]
        weights, keys = np.zeros((len(cut), 2, 3)), np.empty((len(cut), 2), np.int64)
        for side in range(2):  # the two edges of a face that the plane cuts
            other = (alone + 1 + side) % 3
            far = corners[rows, other]
            share = height[tip] / (height[tip] - height[far])
            weights[rows, side, alone], weights[rows, side, other] = 1 - share, share
            edge = np.sort(np.stack([self.twin[tip], self.twin[far]]), axis=0)
            keys[:, side] = edge[0] * self.shape.V + edge[1]
        pieces = np.einsum("nsk,nkd->nsd", weights, verts[corners])
        own = np.flatnonzero(_in_one_line(keys, _nearest(pieces, at)))
        row, along = _evenly(np.sqrt(squared_lengths(pieces[own, 1] - pieces[own, 0])))
        ends = weights[own[row]]
        found = (1 - along)[:, None] * ends[:, 0] + along[:, None] * ends[:, 1]
        return at_faces(self.shape, self.rows[cut[own[row]]], found)


def _in_one_line(ends: Int[Ints, "N 2"], first: int) -> Bool[Bools, " N"]:
    """(N,) which pieces of lines, by the numbers of their ends, hang together with one of them."""
    number = np.unique(ends, return_inverse=True)[1].reshape(-1, 2)
    count = int(number.max()) + 1
    graph = coo_array((np.ones(len(number), np.int8), (number[:, 0], number[:, 1])), shape=(count, count))
    line = connected_components(graph, directed=False)[1][number[:, 0]]
    return np.asarray(line == line[first])


def _evenly(lengths: Float[Floats, " N"]) -> tuple[Int[Ints, " M"], Float[Floats, " M"]]:
    """Points on pieces of a line of these lengths: on which each is, and where from 0 to 1; the ends of each piece, and more
    on long ones.
    """
    most = max(float(lengths.sum()) * _SPACING, 1e-300)
    steps = np.maximum(np.ceil(lengths / most).astype(np.int64), 1)
    row = np.repeat(np.arange(len(lengths)), steps + 1)
    first = np.cumsum(steps + 1) - steps - 1
    return row, (np.arange(len(row)) - first[row]) / steps[row]


def _nearest(pieces: Float[Floats, "N 2 3"], point: Float[Floats, " 3"]) -> int:
    """Which of these pieces of lines is nearest to a point."""
    begin, way = pieces[:, 0], pieces[:, 1] - pieces[:, 0]
    share = np.einsum("nd,nd->n", point - begin, way) / np.maximum(squared_lengths(way), 1e-300)
    return int(squared_lengths(begin + np.clip(share, 0, 1)[:, None] * way - point).argmin())


def _distance(points: Float[Floats, "N 3"]) -> tuple[float, Floats]:
    return float(np.sqrt(squared_lengths(np.diff(points, axis=0))).sum()), points


def _angle(points: Float[Floats, "3 3"]) -> tuple[float, Floats]:
    first, second = points[0] - points[1], points[2] - points[1]
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))), points


def _girth(points: Float[Floats, "N 3"]) -> tuple[float, Floats]:
    """Around points that lie nearly in one plane, as a tape lies: the convex hull, in the plane nearest to them."""
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle, full_matrices=False)[2][:2]
    flat = (points - middle) @ axes.T
    try:
        line = flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):  # they lie in one line: there and back
        line = flat[[int(flat[:, 0].argmin()), int(flat[:, 0].argmax())]]
    length = np.sqrt(squared_lengths(np.roll(line, -1, axis=0) - line)).sum()
    return float(length), middle + np.concatenate([line, line[:1]]) @ axes


_MEASURE = {"distance": _distance, "angle": _angle, "girth": _girth}
