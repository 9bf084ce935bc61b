"""Measurements of a shape, such as girths and lengths, defined by landmarks of another: their files, and how they are taken.

"Measurements" in docs/measurements.md describes the kinds.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, get_args
from unicodedata import normalize

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, ShortRepr
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import squared_lengths
from meshmatch.shapes import tables
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.input_files import read_json
from meshmatch.shapes.landmark_files import one_line_name
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.landmarks import Landmarks, at_faces, join_landmarks

MeasurementKind = Literal["distance", "girth", "angle"]
_LANDMARKS = {"distance": "two landmarks or more", "girth": "three landmarks", "angle": "three landmarks"}
_HINT = "a row each: name,kind,landmark,landmark,...; the kinds are distance, girth and angle"
_SPACING = 1 / 64  # maximum distance between points of a girth, as a share of it
_MIN_SHARE = 0.75  # share of a girth that must exist
_MAX_GAP = 1 / 5  # maximum distance between neighbours along a girth, as a share of it;
_MAX_GAP_STEPS = 4  # or in mean distances, if that is more, where the points of a cloud are sparse
_MIN_POINTS = 6  # points of a girth: the hull of fewer is shorter by five percent or more
_MAX_POINTS = 3_000_000  # of all girths together
_COLUMNS = ["name", "kind", "value", "confidence"]
MEASUREMENT_SUFFIXES = (".csv", ".json")
check_measurements_suffix = partial(tables.check_suffix, suffixes=MEASUREMENT_SUFFIXES, what="measurements")


@dataclass(frozen=True)
class Measurement:
    """A measurement between landmarks.

    Attributes
    ----------
    name
        Such as "waist girth".
    kind
        ``distance``: length of the polyline through two landmarks or more. ``girth``: length of a tape around the part that
        the first landmark lies on, in the plane through it perpendicular to the line from the second to the third.
        ``angle``: at the second of three landmarks, in degrees.
    landmarks
        Names of landmarks; numbers from 0, in order, for landmarks without names.

    Examples
    --------
    >>> meshmatch.Measurement("waist girth", "girth", ("waist", "crotch", "crown"))
    """

    name: str
    kind: MeasurementKind
    landmarks: tuple[str, ...]

    def __post_init__(self) -> None:
        if not self.name:
            raise InputError("a measurement has no name", _HINT)
        if self.kind not in get_args(MeasurementKind):
            raise InputError(f"measurement {self.name}: {self.kind!r} is no kind of measurement", _HINT)
        if isinstance(self.landmarks, str):
            raise InputError(f"measurement {self.name}: its landmarks are one word", f"pass ({self.landmarks!r}, ...)")
        # Numbers of landmarks, such as indices, are allowed too.
        object.__setattr__(self, "landmarks", tuple(map(str, self.landmarks)))
        if "" in self.landmarks:
            raise InputError(f"measurement {self.name}: one of its landmarks has no name", _HINT)
        count = len(self.landmarks)
        if count < 2 or (self.kind != "distance" and count != 3):
            raise InputError(f"measurement {self.name}: {self.kind} needs {_LANDMARKS[self.kind]}, not {count}", _HINT)


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(ShortRepr):
    """Results of measurements of a shape.

    Attributes
    ----------
    names
        Names of the N measurements.
    kinds
        ``distance``, ``girth`` or ``angle``.
    values
        (N,) in the unit of the shape's file, angles in degrees; nan where the shape is missing, or a map tears a girth.
    confidence
        (N,) confidence of the map, from 0 (a guess) to 1 (certain): for a girth the mean along it, else that of the least
        certain landmark; nan where it is unknown.
    lines
        Points (M, 3) of the line that each measurement follows, in the frame of the file; girths are closed.

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
    """The points of a shape that define its measurements. Their places on another shape give that shape's measurements."""

    shape: Shape
    measurements: tuple[Measurement, ...]
    points: Landmarks  # on the shape; those of all measurements, concatenated
    shares: Float[Floats, " P"]  # weight of each point within its measurement
    ends: Int[Ints, " N"]  # end of each measurement's points

    @classmethod
    def of(cls, shape: Shape, landmarks: Landmarks, measurements: Sequence[Measurement]) -> MeasuringPoints:
        """Find the points on the shape whose landmarks define the measurements; `InputError` for an unknown landmark, and
        for measurements that the shape does not allow.
        """
        names = _LandmarkIndex(landmarks)
        parts, order, shares = [landmarks], [], []
        surface, count = _Surface(shape), len(landmarks.names)
        for each in measurements:
            rows = names.rows(each)
            if each.kind == "girth":
                loop, share = surface.cross_section(landmarks.points[rows], each.name)
                parts.append(loop)
                rows = count + np.arange(len(share))
                count += len(share)
                if count > _MAX_POINTS:
                    raise InputError(
                        f"the girths up to {each.name} go through more than {_MAX_POINTS:,} points",
                        "measure fewer at a time, or by a source with fewer faces",
                    )
            else:
                share = np.full(len(rows), 1 / len(rows))
                if each.kind == "angle" and np.isnan(_angle(landmarks.points[rows])[0]):
                    raise InputError(
                        f"measurement {each.name}: two of its landmarks are one point, which makes no angle"
                    )
            order.append(rows)
            shares.append(share)
        ends = np.cumsum([len(rows) for rows in order])
        return cls(
            shape, tuple(measurements), join_landmarks(parts, np.concatenate(order)), np.concatenate(shares), ends
        )

    def taken(self, places: Landmarks, minimum: float = 0.0) -> Measurements:
        """Take the measurements at these places of the points; places with less confidence than ``minimum`` are ignored."""
        values, confidence, lines = [], [], []
        for each, begin, end in zip(self.measurements, [0, *self.ends[:-1]], self.ends, strict=True):
            points, confidences, shares = places.points[begin:end], places.confidence[begin:end], self.shares[begin:end]
            trusted = ~(confidences < minimum) & np.isfinite(points).all(axis=1)  # unknown confidence (nan) passes
            value, line = np.nan, np.empty((0, 3))
            if trusted.all() or (each.kind == "girth" and shares[trusted].sum() >= _MIN_SHARE):
                value, line = _MEASURE[each.kind](points[trusted])
            if each.kind == "girth" and _is_torn(points, trusted, self.points.face[begin:end], value):
                value = np.nan
            values.append(value)
            confidence.append(float(shares @ confidences if each.kind == "girth" else confidences.min()))
            lines.append(np.empty((0, 3)) if np.isnan(value) else line)
        names, kinds = zip(*((each.name, each.kind) for each in self.measurements), strict=True)
        return Measurements(names, kinds, np.array(values), np.array(confidence), tuple(lines))


def load_measurements(path: str | Path) -> tuple[Measurement, ...]:
    """Read measurements from a table, a row each: a name, a kind, and names of landmarks.

    Raises
    ------
    InputError
        It is not such a table, or two measurements have the same name.
    """
    return tables.read_by_suffix(path, {".csv": _read, ".txt": _read}, "measurements", _HINT)


def _read(path: Path) -> tuple[Measurement, ...]:
    rows = [[one_line_name(cell) for cell in row] for row in tables.read_table(path, blanks=False).rows(even=False)]
    if rows and rows[0][1:2] and rows[0][1].lower() == "kind":
        rows = rows[1:]
    measurements = []
    for row in rows:
        while row and not row[-1]:
            row.pop()
        if row:
            name, kind, *landmarks = [*row, ""] if len(row) < 2 else row
            measurements.append(Measurement(name, kind.lower(), tuple(landmarks)))  # type: ignore[arg-type]
    return check_unique(measurements)


def check_unique(measurements: Sequence[Measurement]) -> tuple[Measurement, ...]:
    """Measurements as a tuple; `InputError` where two have the same name, or there are none."""
    seen: set[str] = set()
    measurements = (measurements,) if isinstance(measurements, Measurement) else tuple(measurements)
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
    return measurements


def save_measurements(path: Path, found: Measurements) -> None:
    """Write a .csv with a row per measurement, or a .json, which includes the lines; `OptionError` for another suffix."""
    sure = tables.short_floats(found.confidence)
    values = [None if value != value else value for value in found.values.tolist()]
    rows = list(zip(found.names, found.kinds, values, sure, strict=True))
    if check_measurements_suffix(path) == ".csv":
        cells = [["" if cell is None else cell for cell in row] for row in rows]
        tables.write_rows(path, _COLUMNS, cells)
        return
    keys = (*_COLUMNS, "line")
    lines = (line.tolist() for line in found.lines)
    records: list[dict[str, Any]] = [
        dict(zip(keys, (*row, line), strict=True)) for row, line in zip(rows, lines, strict=True)
    ]
    tables.write_json(path, {"format": "meshmatch measurements 1", "measurements": records}, indent=1)


def measured_values(path: Path) -> dict[str, float]:
    """Values by name in a file that `save_measurements` wrote; nan for missing ones."""
    if path.suffix.lower() == ".json":
        records = tables.read_by_suffix(path, {".json": _read_json}, "measurements", _HINT)
        return {str(each["name"]): float("nan" if each["value"] is None else each["value"]) for each in records}
    rows = tables.read_by_suffix(path, {".csv": _read_csv}, "measurements", _HINT)
    return {name: tables.parse_number(value) for name, _, value, *_ in rows[1:]}


def _read_csv(path: Path) -> list[list[str]]:
    with path.open(encoding="utf-8", newline="") as file:  # names may contain other separators
        rows = list(csv.reader(file))
    return rows if rows[0] == _COLUMNS else tables.read_table(path).rows()


def _read_json(path: Path) -> list[dict[str, Any]]:
    return list(read_json(path)["measurements"])


class _LandmarkIndex:
    """Rows of landmarks by name, up to composition of letters (NFC) and spacing."""

    def __init__(self, landmarks: Landmarks) -> None:
        self.missing, self.row, self.ambiguous = landmarks.missing, dict[str, int](), set[str]()
        for k, name in enumerate(map(self._key, landmarks.names)):
            if self.row.setdefault(name, k) != k:
                self.ambiguous.add(name)

    @staticmethod
    def _key(name: str) -> str:
        return normalize("NFC", one_line_name(name))

    def rows(self, measurement: Measurement) -> Int[Ints, " N"]:
        """(N,) rows of a measurement's landmarks; `InputError` if a name is ambiguous or unknown, or a landmark missing."""
        found = []
        for name in map(self._key, measurement.landmarks):
            row, problem, hint = self.row.get(name), "", ""
            if row is None:
                similar = get_close_matches(name[:80], self.row, 1)
                hint = f"did you mean {similar[0]!r}?" if similar else f"there are {', '.join(list(self.row)[:8])}"
                problem = f"no landmark is called {name!r}"
            elif name in self.ambiguous:
                problem, hint = f"two landmarks are called {name!r}", "give each a name of its own"
            elif self.missing[row]:
                problem = f"landmark {name} is missing on the shape that has the landmarks"
            if row is None or problem:
                raise InputError(f"measurement {measurement.name}: {problem}", hint)
            found.append(row)
        return np.array(found)


class _Surface:
    """The valid faces of a shape, for cross sections."""

    def __init__(self, shape: Shape) -> None:
        self.shape, self.rows = shape, np.flatnonzero(shape.valid_faces)
        self.faces = shape.faces[self.rows]

    @cached_property
    def twin(self) -> Int[Ints, " V"]:
        """(V,) the vertex to use instead of each, where the file duplicates vertices along seams."""
        return seam_representatives(self.shape.verts, self.faces)

    def cross_section(self, points: Float[Floats, "3 3"], name: str) -> tuple[Landmarks, Float[Floats, " N"]]:
        """Cross section of the surface for a girth: in the plane through the first point, perpendicular to the direction
        from the second to the third, the connected line nearest to the first point.

        Returns points along it, and the share of its length that each stands for. `InputError` if there is none, or much of
        it is missing.
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
        tip_corner = np.where(upper.sum(axis=1) == 1, upper.argmax(axis=1), (~upper).argmax(axis=1))
        tip = corners[rows, tip_corner]
        weights, keys = np.zeros((len(cut), 2, 3)), np.empty((len(cut), 2), np.int64)
        for side in range(2):  # the two edges of a face that the plane cuts
            other = (tip_corner + 1 + side) % 3
            far = corners[rows, other]
            share = height[tip] / (height[tip] - height[far])
            weights[rows, side, tip_corner], weights[rows, side, other] = 1 - share, share
            edge = np.sort(np.stack([self.twin[tip], self.twin[far]]), axis=0)
            keys[:, side] = edge[0] * self.shape.V + edge[1]
        pieces = np.einsum("nsk,nkd->nsd", weights, verts[corners])
        line_pieces = np.flatnonzero(_connected_pieces(keys, _nearest_piece(pieces, at)))
        lengths = np.sqrt(squared_lengths(pieces[line_pieces, 1] - pieces[line_pieces, 0]))
        row, along, share = _sample_evenly(lengths)
        ends = weights[line_pieces[row]]
        weights_at_points = (1 - along)[:, None] * ends[:, 0] + along[:, None] * ends[:, 1]
        line = at_faces(self.shape, self.rows[cut[line_pieces[row]]], weights_at_points)
        if not lengths.sum() >= _MIN_SHARE * _girth(line.points)[0]:
            raise InputError(
                f"measurement {name}: more than a quarter of the girth is missing, because the surface is open there"
            )
        return line, share


def _connected_pieces(ends: Int[Ints, "N 2"], first: int) -> Bool[Bools, " N"]:
    """(N,) which line pieces, given by the numbers of their ends, are connected to piece `first`."""
    number = np.unique(ends, return_inverse=True)[1].reshape(-1, 2)
    count = int(number.max()) + 1
    graph = coo_array((np.ones(len(number), np.int8), (number[:, 0], number[:, 1])), shape=(count, count))
    line = connected_components(graph, directed=False)[1][number[:, 0]]
    return np.asarray(line == line[first])


def _sample_evenly(lengths: Float[Floats, " N"]) -> tuple[Int[Ints, " M"], Float[Floats, " M"], Float[Floats, " M"]]:
    """Sample a line of pieces with these lengths: the ends of each piece, and more points on long ones.

    Returns for each point its piece, its parameter on it (0 to 1), and the share of the line that it stands for.
    """
    lengths = lengths if lengths.any() else np.ones(len(lengths))  # all points coincide
    total = float(lengths.sum())
    steps = np.maximum(np.ceil(lengths / (total * _SPACING)).astype(np.int64), 1)
    row = np.repeat(np.arange(len(lengths)), steps + 1)
    first = np.cumsum(steps + 1) - steps - 1
    along = (np.arange(len(row)) - first[row]) / steps[row]
    halves = np.where((along == 0) | (along == 1), 1, 2)
    return row, along, halves * (lengths / (2 * steps * total))[row]


def _is_torn(points: Float[Floats, "N 3"], trusted: Bool[Bools, " N"], face: Int[Ints, " N"], girth: float) -> bool:
    """Whether neighbours along a girth, which are in one face, lie far apart, as by a map that leads to another limb; or
    whether it has too few distinct points.
    """
    pairs = np.flatnonzero((face[1:] == face[:-1]) & trusted[1:] & trusted[:-1])
    longest = float(squared_lengths(points[pairs + 1] - points[pairs]).max(initial=0.0)) ** 0.5
    n_distinct = len(np.unique(points[trusted], axis=0))
    return longest > girth * max(_MAX_GAP, _MAX_GAP_STEPS / max(n_distinct, 1)) or n_distinct < _MIN_POINTS


def _nearest_piece(pieces: Float[Floats, "N 2 3"], point: Float[Floats, " 3"]) -> int:
    """Index of the line piece nearest to a point."""
    begin, direction = pieces[:, 0], pieces[:, 1] - pieces[:, 0]
    share = np.einsum("nd,nd->n", point - begin, direction) / np.maximum(squared_lengths(direction), 1e-300)
    return int(squared_lengths(begin + np.clip(share, 0, 1)[:, None] * direction - point).argmin())


def _distance(points: Float[Floats, "N 3"]) -> tuple[float, Floats]:
    return float(np.sqrt(squared_lengths(np.diff(points, axis=0))).sum()), points


def _angle(points: Float[Floats, "3 3"]) -> tuple[float, Floats]:
    first, second = points[0] - points[1], points[2] - points[1]
    if not (first.any() and second.any()):
        return np.nan, points
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))), points


def _girth(points: Float[Floats, "N 3"]) -> tuple[float, Floats]:
    """Tape length around points that lie nearly in one plane: perimeter of their convex hull in the best-fitting plane."""
    center = points.mean(axis=0)
    axes = np.linalg.svd(points - center, full_matrices=False)[2][:2]
    flat = (points - center) @ axes.T
    try:
        line = flat[ConvexHull(flat).vertices]
    except (QhullError, ValueError):  # collinear points: there and back
        line = flat[[int(flat[:, 0].argmin()), int(flat[:, 0].argmax())]]
    length = np.sqrt(squared_lengths(np.roll(line, -1, axis=0) - line)).sum()
    return float(length), center + np.concatenate([line, line[:1]]) @ axes


_MEASURE = {"distance": _distance, "angle": _angle, "girth": _girth}
