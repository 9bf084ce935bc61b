"""Landmarks (named points on a shape): pushing forward along a map, reading and writing. "Data on a shape" in
docs/formats.md describes the files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, ShortRepr
from meshmatch.errors import InputError, warn
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.folds import normals_or_zeros
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import MappedMesh, discontinuous_faces
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes import tables
from meshmatch.shapes.landmark_files import (
    LANDMARK_READERS,
    SPECIMEN_READERS,
    LandmarkFile,
    Markup,
    Space,
    fcsv_lines,
    markups_record,
    morphologika_lines,
    read_landmark_file,
    tps_lines,
)
from meshmatch.shapes.shape import Shape

# A landmark farther from the surface than this, in diagonals of the shape, belongs to another shape.
_MAX_DISTANCE = 0.25
_FAR = 0.02  # distance, in the same unit, that is worth a warning
_OTHER_FRAME = np.array([-1.0, -1.0, 1.0])  # from LPS to RAS, or back (3D Slicer)
# Landmarks are in the other frame if they lie farther from the surface than this, in its diagonals, and this many times
# nearer after the change.
_MIN_DISTANCE, _MIN_RATIO = 0.01, 4.0
LANDMARK_SUFFIXES = (".csv", ".json", ".pp", ".fcsv", ".mrk.json", ".tps")
check_landmarks_suffix = partial(tables.check_suffix, suffixes=LANDMARK_SUFFIXES, what="landmarks")
check_table_suffix = partial(
    tables.check_suffix, suffixes=(".csv", ".tps", ".txt", ".npz"), what="a table of landmarks"
)
_MAX_LISTED = 5  # names in a message
_HINT = "a row each: name,vertex or name,x,y,z; MeshLab's .pp, 3D Slicer's .mrk.json or .fcsv, .pts, .tps, .json"


@dataclass(frozen=True, eq=False, repr=False)
class Landmarks(ShortRepr):
    """Named points on a shape, in its frame and unit. Missing ones have position nan, and vertex and face -1."""

    names: tuple[str, ...]
    points: Float[Floats, "N 3"]
    vertex: Int[Ints, " N"]  # the vertex itself, or the heaviest corner of the face
    face: Int[Ints, " N"]  # -1 where the point is the vertex itself (always on a cloud)
    barycentric: Float[Floats, "N 3"]  # weights of the face's corners; (1, 0, 0) where the face is -1
    confidence: Float[Floats, " N"]  # 0 (a guess) to 1 (certain)
    notes: tuple[str, ...] = ()  # what was left out or converted when they were read
    lists: tuple[Markup, ...] = ()  # 3D Slicer's list of each, such as a curve; empty for other files

    @property
    def missing(self) -> Bool[Bools, " N"]:
        """(N,) which landmarks are missing on the shape."""
        return np.asarray(np.isnan(self.points).any(axis=1))

    def without(self, lost: Bool[Bools, " N"]) -> Landmarks:
        """A copy with some landmarks (N,) missing; their confidence is kept."""
        nans = np.where(lost[:, None], np.nan, 0.0)
        vertex, face = np.where(lost, -1, self.vertex), np.where(lost, -1, self.face)
        points, weights = self.points + nans, self.barycentric + nans
        return replace(self, points=points, vertex=vertex, face=face, barycentric=weights)


def at_vertices(shape: Shape, vertex: Int[Ints, " N"], names: tuple[str, ...] = ()) -> Landmarks:
    """Landmarks at vertices (N,) of `shape`; `InputError` for a vertex that does not exist."""
    vertex = np.asarray(vertex, np.int64)
    N, count_text = len(vertex), f"{shape.name or 'the source'} has {shape.V} vertices"
    hint = "vertices are counted from 0; are they landmarks of the source?"
    _check_none((vertex < 0) | (vertex >= shape.V), names, lambda k: f" is vertex {vertex[k]}, but {count_text}", hint)
    return _on_surface(shape, names, vertex, np.full(N, -1), np.tile([1.0, 0.0, 0.0], (N, 1)))


def at_points(
    shape: Shape, points: Float[Floats, "N 3"], names: tuple[str, ...] = ()
) -> tuple[Landmarks, Float[Floats, " N"]]:
    """Landmarks at the points of a surface (or cloud) nearest to given points of its frame, and the distances (N,).

    `InputError` if a point is not finite, or is far from the shape.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    usable = (np.abs(points) < 1e60).all(axis=1)
    _check_none(~usable, names, lambda k: f" has no position: {points[k].tolist()}")
    places = MappedMesh.of(shape).query(points)
    too_far = places.distance > _MAX_DISTANCE * max(shape.diagonal, 1e-30)
    there = f"{shape.name or 'the source'}, whose diagonal is {shape.diagonal:.4g}"
    hint = "landmarks must be in the frame and unit of the source's file"
    _check_none(too_far, names, lambda k: f" lies {places.distance[k]:.4g} away from {there}", hint)
    return _on_surface(shape, names, places.vertex, places.face, places.barycentric), places.distance


def at_faces(
    shape: Shape, face: Int[Ints, " N"], barycentric: Float[Floats, "N 3"], names: tuple[str, ...] = ()
) -> Landmarks:
    """Landmarks in faces, at barycentric weights; `InputError` for a face that does not exist, or invalid weights."""
    face, weights = np.asarray(face, np.int64), np.asarray(barycentric, np.float64).reshape(-1, 3)
    count_text = f"{shape.name or 'the source'} has {shape.F} faces"
    hint = "faces are counted from 0; are they landmarks of the source?"
    _check_none((face < 0) | (face >= shape.F), names, lambda k: f" is in face {face[k]}, but {count_text}", hint)
    hint = "the weights of a face's corners are 0 or more, and sum to 1"
    negative, sums = (weights < -1e-9).any(axis=1), weights.sum(axis=1)
    _check_none(negative, names, lambda k: f": one of its weights {weights[k].tolist()} is negative", hint)
    _check_none(
        ~(np.abs(sums - 1.0) < 1e-4), names, lambda k: f": its weights {weights[k].tolist()} do not sum to 1", hint
    )
    weights = np.clip(weights, 0.0, None)
    weights /= weights.sum(axis=1, keepdims=True)
    return _on_surface(shape, names, shape.faces[face, weights.argmax(axis=1)], face, weights)


def _check_none(bad: ArrayLike, names: tuple[str, ...], why: Callable[[int], str], hint: str = "") -> None:
    """Raise `InputError` for the first bad landmark, if there is one."""
    for k in np.flatnonzero(bad)[:1].tolist():
        raise InputError(f"landmark {names[k] if names else k}{why(k)}", hint)


def _on_surface(
    shape: Shape, names: tuple[str, ...], vertex: Ints, face: Ints, weights: Floats, confidence: Floats | None = None
) -> Landmarks:
    """Landmarks at these places, named by number if ``names`` is empty."""
    points = interpolate(shape.verts, corners_of(shape.faces, face, vertex), weights)
    names = names or tuple(str(k) for k in range(len(vertex)))
    return Landmarks(names, points, vertex, face, weights, np.ones(len(vertex)) if confidence is None else confidence)


def join_landmarks(parts: Sequence[Landmarks], order: Ints | None = None) -> Landmarks:
    """Concatenate landmarks of one shape, then reorder them."""
    names = [name for part in parts for name in part.names]
    order = np.arange(len(names)) if order is None else order
    fields = ("points", "vertex", "face", "barycentric", "confidence")
    points, vertex, face, weights, confidence = (
        np.concatenate([getattr(part, field) for part in parts])[order] for field in fields
    )
    return Landmarks(tuple(names[k] for k in order.tolist()), points, vertex, face, weights, confidence)


def push_landmarks(forward: VertexMap, source: Shape, target: Shape, landmarks: Landmarks) -> Landmarks:
    """Landmarks of the source on the surface of the target, along a map from source to target.

    A point of a face goes to the surface point nearest to the mean of its corners' images; where the map is discontinuous,
    to the image of its heaviest corner. Missing landmarks stay missing.
    """
    vertex_of = landmarks.vertex
    vertex, face, weights = forward.index[vertex_of], forward.face[vertex_of], forward.barycentric[vertex_of]
    confidence = forward.confidence[vertex_of].astype(np.float64)
    inside = np.flatnonzero((landmarks.face >= 0) & (landmarks.barycentric.max(axis=1) < 1.0 - 1e-9))
    if len(inside):
        inside = inside[~discontinuous_faces(forward, source, target)[landmarks.face[inside]]]
    if len(inside):
        corners = source.faces[landmarks.face[inside]]
        share = landmarks.barycentric[inside]
        facing = interpolate(normals_or_zeros(target), forward.index[corners], share)
        places = MappedMesh.of(target).query(interpolate(forward.points(target), corners, share), facing)
        vertex[inside], face[inside], weights[inside] = places.vertex, places.face, places.barycentric
        confidence[inside] = np.einsum("nk,nk->n", share, forward.confidence[corners])
    pushed = _on_surface(target, landmarks.names, vertex, face, weights, np.clip(confidence, 0, 1))
    return replace(pushed, lists=landmarks.lists).without(landmarks.missing)


def load_landmarks(path: str | Path, shape: Shape, space: Space = "") -> tuple[Landmarks, float]:
    """Read landmarks of `shape` from a file.

    Parameters
    ----------
    path
        The file; see `meshmatch.shapes.landmark_files.LANDMARK_READERS` for the suffixes.
    shape
        The shape that they are on.
    space
        The frame that 3D Slicer gave the shape's file (`mesh_space`); landmarks in its other frame are converted. Where it
        is unknown, landmarks that state their frame are converted if only that brings them onto the surface.

    Returns
    -------
    tuple[Landmarks, float]
        Landmarks in the order of the file, without missing ones, which `Landmarks.notes` lists; and the largest distance
        of a position from the surface.

    Raises
    ------
    InputError
        The file contains no landmark, or one is not on `shape`.
    """

    def read(path: Path) -> tuple[Landmarks, float]:
        found = read_landmark_file(path, shape.name, space)
        return _on_shape(found if space else _in_frame_of_shape(shape, found, path.name), shape)

    return tables.read_by_suffix(path, dict.fromkeys(LANDMARK_READERS, read), "landmarks", _HINT)


def landmarks_with_warnings(path: str | Path, shape: Shape, space: Space = "") -> Landmarks:
    """As `load_landmarks`, with warnings about landmarks that are missing, converted, or far from the surface, and about
    names of several landmarks.
    """
    landmarks, furthest = load_landmarks(path, shape, space)
    for note in landmarks.notes:
        warn(note)
    if repeated := _repeated_names(landmarks.names):
        warn(f"{Path(path).name} has several landmarks of one name: {_listed(repeated)}")
    warn_if_far(shape, furthest)
    return landmarks


def known_pairs(
    files: tuple[Path, Path], shapes: tuple[Shape, Shape], spaces: Sequence[Space] = ("", "")
) -> tuple[Int[Ints, " N"], Int[Ints, " N"]]:
    """Pair the landmarks of two shapes by name, or in order where no name occurs in both files; for ground truth.

    Returns the vertices nearest to each pair. `InputError` as in `load_landmarks`; landmarks in only one file are left out
    with a warning.
    """
    read = [landmarks_with_warnings(*each) for each in zip(files, shapes, spaces, strict=True)]
    rows = [{name: row for row, name in enumerate(each.names)} for each in read]
    if repeated := {name for each in read for name in _repeated_names(each.names)}:
        warn(f"names of several landmarks are left out: {_listed(sorted(repeated))}")
        rows = [{name: row for name, row in each.items() if name not in repeated} for each in rows]
    if both := [name for name in rows[0] if name in rows[1]]:
        for k in range(2):
            if unmatched := [name for name in rows[k] if name not in rows[1 - k]]:
                warn(f"{files[k].name}: {files[1 - k].name} has no {_listed(unmatched)}: left out")
        first, second = (each.vertex[[row[name] for name in both]] for each, row in zip(read, rows, strict=True))
        return first, second
    if len(read[0].names) != len(read[1].names):
        counts = " and ".join(f"{len(each.names)} in {file.name}" for each, file in zip(read, files, strict=True))
        raise InputError(f"no landmark is in both files by its name: {counts}", "give the same names in both")
    warn(f"{files[0].name} and {files[1].name} have no name in common: their landmarks are paired in order")
    return read[0].vertex, read[1].vertex


def _repeated_names(names: Sequence[str]) -> list[str]:
    """Names that occur more than once."""
    return [name for name, count in Counter(names).items() if count > 1]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:_MAX_LISTED]) + ", ..." * (len(names) > _MAX_LISTED)


def warn_if_far(shape: Shape, furthest: float) -> None:
    """Warn if the landmark farthest from the shape is clearly not on it."""
    if furthest > _FAR * shape.diagonal:
        share = f"{100 * furthest / shape.diagonal:.0f} % of its diagonal"
        name = shape.name or "the source"
        warn(f"a landmark lies {furthest:.4g} from {name}, {share}: the nearest point of the surface is used")


def _in_frame_of_shape(shape: Shape, found: LandmarkFile, name: str) -> LandmarkFile:
    """Convert landmarks that state a frame of 3D Slicer, for a mesh that states none, to the other frame if that brings them
    onto the mesh's surface.
    """
    positions = np.array([place.where for place in found.places if place.kind == "position"], np.float64)
    if not found.space or not len(positions) or not (np.abs(positions) < 1e60).all():
        return found
    unchanged, turned = (
        MappedMesh.of(shape).query(points).distance.max() for points in (positions, positions * _OTHER_FRAME)
    )
    if unchanged < _MIN_DISTANCE * shape.diagonal or unchanged < _MIN_RATIO * turned:
        return found
    places = tuple(
        replace(place, where=(place.where * _OTHER_FRAME).tolist()) if place.kind == "position" else place
        for place in found.places
    )
    why = f"{name} is in {found.space}: x and y change their signs, because its landmarks then lie on {shape.name}"
    return replace(found, places=places, turned=why)


def _on_shape(found: LandmarkFile, shape: Shape) -> tuple[Landmarks, float]:
    """Landmarks in the order of the file; and the largest distance of a position from the surface."""
    notes, missing = [found.turned] if found.turned else [], []
    by_kind: dict[str, list[tuple[int, str, Any]]] = {}
    for k, place in enumerate(found.places):
        if place.kind == "missing":
            missing.append(f"landmark {place.name}{place.where}")
        else:
            by_kind.setdefault(place.kind, []).append((k, place.name, place.where))
    if missing:
        message = missing[0] + (f", and {len(missing) - 1} more are missing" if len(missing) > 1 else "")
        if not by_kind:
            raise InputError(message)
        notes.append(f"{message}: left out")
    parts: list[Landmarks] = []
    rows: list[int] = []
    largest = 0.0
    for kind, own in by_kind.items():
        numbers, names, where = zip(*own, strict=True)
        rows += numbers
        if kind == "vertex":
            parts.append(at_vertices(shape, np.array(where), names))
        elif kind == "face":
            face, weights = (np.array(each) for each in zip(*where, strict=True))
            parts.append(at_faces(shape, face, weights, names))
        else:
            on_surface, distance = at_points(shape, np.array(where), names)
            parts.append(on_surface)
            largest = float(distance.max())
    lists = tuple(place.markup for place in found.places if place.kind != "missing")
    return replace(join_landmarks(parts, np.argsort(rows)), notes=tuple(notes), lists=lists), largest


def save_landmarks(path: Path, landmarks: Landmarks, space: Space = "LPS", name: str = "", specimen: str = "") -> None:
    """Write landmarks, and which are missing; `OptionError` if the suffix is not one of `LANDMARK_SUFFIXES`.

    `space` is the frame to state in a file for 3D Slicer (.fcsv, .mrk.json), which takes a mesh that states none to be in
    LPS. `name` is the final name of the file, where `path` is temporary. `specimen` is the shape's name in a .tps file, by
    default the file's.
    """
    suffix = check_landmarks_suffix(path)
    columns = (landmarks.vertex, landmarks.points, landmarks.face, landmarks.barycentric)
    confidence = tables.short_floats(landmarks.confidence)
    rows = list(zip(landmarks.names, *(column.tolist() for column in columns), confidence, strict=True))
    points = zip(landmarks.names, landmarks.points.tolist(), landmarks.confidence.tolist(), strict=True)
    missing = landmarks.missing.tolist()
    if suffix == ".tps":
        save_specimens(path, {specimen or Path(name or path.name).stem: landmarks.points}, landmarks.names)
    elif suffix == ".fcsv":
        path.write_text("\n".join(fcsv_lines(points, space)) + "\n", encoding="utf-8")
    elif (name or path.name).lower().endswith(".mrk.json"):
        tables.write_json(path, markups_record(points, space, landmarks.lists), indent=1)
    elif suffix == ".csv":
        cells = [[name, vertex, *xyz, face, *weights, trust] for name, vertex, xyz, face, weights, trust in rows]
        cells = [[own[0], *[""] * 8, own[-1]] if lost else own for own, lost in zip(cells, missing, strict=True)]
        tables.write_rows(path, ["name", "vertex", "x", "y", "z", "face", "w0", "w1", "w2", "confidence"], cells)
    elif suffix == ".json":
        keys = ("name", "vertex", "position", "face", "barycentric", "confidence")
        records = [dict(zip(keys, row, strict=True)) for row in rows]
        nowhere = dict.fromkeys(keys[1:-1])
        records = [record | nowhere if lost else record for record, lost in zip(records, missing, strict=True)]
        tables.write_json(path, {"format": "meshmatch landmarks 1", "landmarks": records}, indent=1)
    else:
        root = ElementTree.Element("PickedPoints")
        for (name, _, xyz, *_), lost in zip(rows, missing, strict=True):
            # MeshLab has the points of a template that are not placed yet.
            x, y, z = ("0", "0", "0") if lost else map(repr, xyz)
            ElementTree.SubElement(root, "point", x=x, y=y, z=z, name=name, active="0" if lost else "1")
        ElementTree.indent(root, " ")
        text = ElementTree.tostring(root, encoding="unicode")
        path.write_text(f"<!DOCTYPE PickedPoints>\n{text}\n", encoding="utf-8")


def landmark_positions(path: Path) -> Float[Floats, "L 3"]:
    """(L, 3) positions of landmarks in a file that `save_landmarks` wrote, possibly edited since; nan for missing ones."""

    def read(path: Path) -> Floats:
        reader = LANDMARK_READERS[path.suffix.lower()]
        records = reader(path, "") if reader in SPECIMEN_READERS else reader(path)
        return np.array([record.get("position") or [np.nan] * 3 for record in records], np.float64).reshape(-1, 3)

    return tables.read_by_suffix(path, dict.fromkeys(LANDMARK_READERS, read), "landmarks", _HINT)


def relative_size(points: Float[Floats, "L 3"], others: Float[Floats, "L 3"]) -> float:
    """Size of a set of landmarks relative to the same ones on another shape; 0 if fewer than two are on both."""
    both = np.isfinite(points + others).all(axis=1)
    size, other = (
        np.linalg.norm(each[both] - each[both].mean(axis=0)) if both.any() else 0.0 for each in (points, others)
    )
    return float(size / other) if other > 0 else 0.0


def save_specimens(path: Path, specimens: Mapping[str, Float[Floats, "L 3"]], names: Sequence[str]) -> None:
    """Write one table of the same landmarks on several specimens, for R and other programs.

    The suffix is .csv (specimen,landmark,x,y,z), .tps, .txt (Morphologika) or .npz (points (S, L, 3), specimens, landmarks),
    else `OptionError`; `InputError` if a specimen has more or fewer landmarks. Missing ones are empty cells in .csv, NA in
    .tps and .txt, nan in .npz.
    """
    suffix = check_table_suffix(path)
    for specimen, points in specimens.items():
        if len(points) != len(names):
            problem = f"{specimen} has {len(points)} landmarks, and there are {len(names)}"
            raise InputError(problem, "remove its file of landmarks, and give the same command")
    if suffix == ".npz":
        points = np.stack(list(specimens.values()))
        tables.write_npz(path, {"points": points, "specimens": list(specimens), "landmarks": list(names)})
    elif suffix == ".csv":
        each = ((specimen, zip(names, points.tolist(), strict=True)) for specimen, points in specimens.items())
        rows = (
            [specimen, name, *("" if np.isnan(each) else each for each in xyz)]
            for specimen, landmarks in each
            for name, xyz in landmarks
        )
        tables.write_rows(path, ["specimen", "landmark", "x", "y", "z"], rows)
    else:
        lines = tps_lines(specimens) if suffix == ".tps" else morphologika_lines(specimens)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
