"""Reading and writing of labels of vertices or faces: "Data on a shape" in docs/formats.md.

A label is a whole number or a word. Shape files with labels, .ply and .vtp, are written only.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import Int, Ints, ShortRepr
from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import plain_text
from meshmatch.shapes import tables
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.input_files import read_json, read_npy, read_text
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import is_missing, is_number, parse_number, read_table, unquoted

On = Literal["vertices", "faces"]
Label = int | str
LABEL_SUFFIXES = (".npy", ".csv", ".txt", ".json", ".ply", ".vtp")
check_labels_suffix = partial(tables.check_suffix, suffixes=LABEL_SUFFIXES, what="labels")
_AS_FLOAT = re.compile(r"[+-]?[0-9]+[.,][0-9]*(?:[eE][+-]?[0-9]+)?")
_HINT = "one label for each vertex or triangle of the source, in the order of its file; polygons are fans of triangles"


@dataclass(frozen=True, eq=False, repr=False)
class Labels(ShortRepr):
    """Labels of the vertices or faces of a shape."""

    codes: Int[Ints, " N"]  # index into `names`; -1 for none
    names: tuple[Label, ...]  # the labels, all of one type, without duplicates
    on: On

    @property
    def values(self) -> NDArray[np.generic]:
        """(N,) label of each vertex or face; -1 or an empty word for none."""
        table = np.array([*self.names, "" if self.are_words else -1])
        return table[self.codes]

    @property
    def are_words(self) -> bool:
        """Whether labels are text."""
        return any(isinstance(name, str) for name in self.names)

    def check_blank(self, text: str) -> Label:
        """The label in `text`, of the type of these labels; `OptionError` if it cannot be one."""
        if self.are_words:
            return text
        if (number := _parse_whole(text)) is None:
            raise OptionError(f"--blank {text}: labels are whole numbers here", "such as --blank -1")
        return number


def name_labels(codes: Ints, given: Labels, on: On, blank: str | None) -> Labels:
    """Labels of a target, with the names of `given`; others become `blank`, by default -1 among numbers, "" among words."""
    empty: Label = given.check_blank(blank) if blank is not None else ("" if given.are_words else -1)
    if (codes >= 0).all():
        return Labels(codes, given.names, on)
    names = given.names if empty in given.names else (*given.names, empty)
    return Labels(np.where(codes < 0, names.index(empty), codes), names, on)


def load_labels(path: str | Path, shape: Shape, on: On | None = None) -> Labels:
    """Labels of the vertices or faces of `shape`; decided by their number, unless the file or `on` says which. `InputError`
    if the number fits neither, `OptionError` if it fits both.
    """
    readers = {
        ".npy": lambda path: (_check_list(read_npy(path)), None),
        ".csv": lambda path: _read_csv(path, (shape.V, shape.F)),
        ".txt": lambda path: _read_txt(path, (shape.V, shape.F)),
        ".json": lambda path: _read_json(path, shape, on),
    }
    values, written = tables.read_by_suffix(path, readers, "labels", _HINT)
    name = Path(path).name
    if on is not None and written is not None and on != written:
        raise OptionError(f"{name} says that it holds labels of {written}, not of {on}", "leave out --on")
    return _parse_labels(name, values, shape, on or written)


def labels_of(values: ArrayLike, shape: Shape) -> Labels:
    """Labels of the vertices or faces of `shape`, from an array of whole numbers or words; see `load_labels`."""
    return _parse_labels("the array", _check_list(np.asarray(values)), shape, None)


def _check_list(array: NDArray[Any]) -> list[Any]:
    if array.ndim != 1 or array.dtype.kind not in "iufbUO":
        raise InputError(f"labels must be a list of (N,), not an array of {array.shape} {array.dtype}", _HINT)
    labels: list[Any] = array.tolist()
    return labels


def _parse_labels(name: str, values: Sequence[Any], shape: Shape, on: str | None) -> Labels:
    """Labels from entries of a file or an array. Empty entries and nan are no labels; nor is NA among numbers."""
    sizes: dict[On, int] = {"vertices": shape.V, "faces": shape.F}
    fits = [kind for kind, size in sizes.items() if size == len(values) and on in (None, kind)]
    owner = shape.name or "the source"
    if len(fits) == 2:
        problem = f"{name} has {len(values)} labels, and {owner} as many vertices as faces"
        raise OptionError(problem, "say which with --on vertices or --on faces")
    if not fits:
        asked = f": they cannot be of its {on}" if on else ""
        problem = f"{name} has {len(values)} labels, but {owner} has {shape.V} vertices and {shape.F} faces{asked}"
        raise InputError(problem, _HINT)
    cells: list[Any] = [_parse_whole(value) for value in values]
    others = [raw for cell, raw in zip(cells, values, strict=True) if cell is None and not _is_missing(raw)]
    if others or all(cell is None for cell in cells):
        _check_decimals(name, others)
        cells = [_word(name, raw) for raw in values]
    names = tuple(sorted({cell for cell in cells if cell is not None}))
    if not names:
        raise InputError(f"{name} holds no label at all", _HINT)
    place = {label: k for k, label in enumerate(names)} | {None: -1}
    return Labels(np.array([place[cell] for cell in cells], np.int64), names, fits[0])


def _is_missing(value: Any) -> bool:
    """Whether an entry is no label, in a list whose other labels are numbers."""
    return value is None or value != value or (isinstance(value, str) and is_missing(value))


def _parse_whole(value: Any) -> int | None:
    """A whole number, also as text in plain digits or with a decimal point, as NumPy and pandas write it; else None."""
    try:
        if isinstance(value, str):
            if re.fullmatch(r"\s*[+-]?[0-9]+\s*", value):
                return int(value)
            if not _AS_FLOAT.fullmatch(value.strip()):
                return None
            value = parse_number(value)
        return int(value) if isinstance(value, int) or float(value) == int(value) else None
    except (ValueError, TypeError, OverflowError):
        return None


def _check_decimals(name: str, others: Sequence[Any]) -> None:
    """Raise `InputError` if the labels that are not whole numbers are all numbers with a decimal comma."""
    if others and all(isinstance(raw, str) and "," in raw and is_number(raw) for raw in others):
        problem = f"{name}: {others[0]} is not a label: a number with a decimal comma, or two columns?"
        raise InputError(problem, "for two columns, vertex and label: put semicolons between them, or name them")


def _word(name: str, raw: Any) -> str | None:
    """A text label on one line; None if it is empty."""
    if isinstance(raw, float):
        raise InputError(f"{name}: {raw} is not a label", "transfer-color interpolates numbers")
    if not isinstance(raw, str | int | None):
        raise InputError(f"{name}: a label is a whole number or a word, not {str(raw)[:40]!r}", _HINT)
    return None if raw in (None, "") else plain_text(" ".join(str(raw).split()))


def _read_csv(path: Path, counts: tuple[int, int]) -> tuple[list[str], str | None]:
    return _from_rows(read_table(path, blanks=False, comments="", whole=True).rows(), counts)


def _read_txt(path: Path, counts: tuple[int, int]) -> tuple[list[str], str | None]:
    """One label per line, whatever it is; or two columns, if the first is named vertex or face or counts the lines."""
    lines = [line.strip() for line in read_text(path, 480).rstrip().splitlines()]
    for separator in ("\t", ";", ",", None):
        rows = [[unquoted(cell.strip()) for cell in line.split(separator, 1)] for line in lines]
        if all(len(row) == 2 for row in rows):
            numbers = [row[0] for row in rows[_owner_of_header(rows[0]) is not None :]]
            if _owner_of_header(rows[0]) or (len(rows) > 2 and tables.is_numbered(numbers)):
                return _from_rows(rows, counts)
    quoted = all(unquoted(line) != line for line in lines)
    return _from_rows([[unquoted(line) if quoted else line] for line in lines], counts)


def _owner_of_header(head: list[str]) -> On | None:
    """Whether the first column numbers vertices or faces, by its name in a table of several columns; else None."""
    owners: dict[str, On] = {"vertex": "vertices", "face": "faces"}
    return owners.get(head[0].lower().lstrip("# ")) if len(head) > 1 else None


def _from_rows(rows: list[list[str]], counts: tuple[int, int]) -> tuple[list[str], str | None]:
    """The labels in a table, and what they belong to if its header says so."""
    if not rows:
        raise InputError("it holds no label at all")
    head, written = [cell.lower() for cell in rows[0]], _owner_of_header(rows[0])
    has_names = written is not None or (len(head) > 1 and "label" in head)
    if has_names or (len(rows) - 1 in counts and len(rows) not in counts):
        rows = rows[1:]
    column = head.index("label") if "label" in head else len(head) - 1
    if len(head) > 2 and "label" not in head:
        raise InputError(f"it has {len(head)} columns and none is called label", "use vertex,label")
    if re.fullmatch(r"(vertex|face)\W+label", head[0]):
        raise InputError(f"{rows[0][0]!r} names two columns", "put a comma, a semicolon or a tab between columns")
    if head == ["", "label"] and tables.is_numbered(["0", *(row[0] for row in rows)]):
        return [row[1] for row in rows], written  # R's row numbers
    if written is not None or (len(head) == 2 and column == 1):
        tables.check_numbered([row[0] for row in rows])
    return [row[column] for row in rows], written


def _read_json(path: Path, shape: Shape, on: On | None) -> tuple[list[Any], str | None]:
    record = read_json(path)
    if isinstance(record, list):
        return record, None
    if not isinstance(record, dict):
        raise InputError("it holds no list of labels")
    if isinstance(record.get("labels"), list) and set(record) - {"labels"} <= {"format", "on", "shape"}:
        written = record.get("on")
        if written not in (None, "vertices", "faces"):
            raise InputError(f"labels are on vertices or on faces, not on {written!r}")
        return record["labels"], written
    # Lists of the members of each part. A member of several parts belongs to the first.
    members_are = on or "vertices"
    labels: list[Any] = [None] * (shape.F if on == "faces" else shape.V)
    for part, members in record.items():
        whole = isinstance(members, list) and all(type(member) is int for member in members)
        if not whole or (members and not 0 <= min(members) <= max(members) < len(labels)):
            problem = f"'{part[:40]}' is not a list of {members_are} of {shape.name or 'the source'}"
            raise InputError(problem, f"its {members_are} are 0 to {len(labels) - 1}")
        for member in members:
            labels[member] = part if labels[member] is None else labels[member]
    return labels, members_are


def save_labels(path: Path, labels: Labels, shape: Shape, file: Path | None = None) -> bool:
    """Write labels of `shape`, each with a name; a .ply or .vtp ``file`` that it was read from keeps all its other data.

    Returns whether other data could be kept. `OptionError` for a suffix that is not one of `LABEL_SUFFIXES`, or for a number
    too large for the format.
    """
    suffix = check_labels_suffix(path)
    largest = {".npy": 2**63, ".ply": 2**31, ".vtp": 2**63}.get(suffix)
    if largest and not labels.are_words and any(not -largest <= int(name) < largest for name in labels.names):
        bits = largest.bit_length()
        raise OptionError(f"{path.name}: this format holds labels of at most {bits} bits", "choose .csv or .json")
    cells = [labels.names[code] for code in labels.codes.tolist()]
    if suffix == ".npy":
        tables.write_npy(path, np.array(cells, np.str_ if labels.are_words else np.int64))
    elif suffix == ".txt":
        path.write_text("".join(f"{cell}\n" for cell in cells), encoding="utf-8")
    elif suffix == ".csv":
        tables.write_rows(path, ["vertex" if labels.on == "vertices" else "face", "label"], enumerate(cells))
    elif suffix == ".json":
        record = {"format": "meshmatch labels 1", "on": labels.on, "shape": shape.name, "labels": cells}
        tables.write_json(path, record)
    else:
        return _write_shape(path, labels, shape, suffix, file)
    return True


def _write_shape(path: Path, labels: Labels, shape: Shape, suffix: str, file: Path | None) -> bool:
    """Write a shape file. Whole numbers are written unchanged; words as numbers, which comments in the header explain."""
    from meshmatch.shapes.formats import ply, vtk, vtk_xml
    from meshmatch.shapes.formats.ply_edit import PlyFile
    from meshmatch.shapes.formats.vtp_edit import VtpFile

    numbers = [k if labels.are_words else int(name) for k, name in enumerate(labels.names)]
    comments = [f"label {k} {name}" for k, name in enumerate(labels.names)] if labels.are_words else []
    known = [k if name not in ("", -1) else -1 for k, name in enumerate(labels.names)]
    colors = np.rint(255 * label_colors(known)).astype(np.uint8)[labels.codes]
    plain = Shape(shape.verts, shape.faces, shape.name, None, shape.invalid)
    if suffix == ".vtp":
        wide = max(map(abs, numbers)) >= 2**31
        arrays = {"label": np.array(numbers, np.int64 if wide else np.int32)[labels.codes], "Colors": colors}
        of_points, of_faces = (arrays, {}) if labels.on == "vertices" else ({}, arrays)
        as_vtp = VtpFile.of(file, shape, faces=labels.on == "faces")
        if as_vtp is not None:
            path.write_bytes(as_vtp.with_arrays(of_points, of_faces, comments))
        else:
            kept = {name: each for name, each in vtk_xml.point_arrays(file).items() if name not in arrays}
            vtk.write_vtp(path, plain, {**kept, **of_points}, of_faces, comments)
        return as_vtp is not None
    columns: dict[str, Any] = {"label": np.array(numbers, np.int32)[labels.codes]}
    columns |= {channel: colors[:, k] for k, channel in enumerate(("red", "green", "blue"))}
    where: Any = {"vertex": columns, "face": {}} if labels.on == "vertices" else {"vertex": {}, "face": columns}
    as_ply = PlyFile.of(file, shape, faces=labels.on == "faces")
    if as_ply is not None:
        path.write_bytes(as_ply.with_columns(comments=comments, **where))
    else:
        ply.write(path, plain, comments=comments, **where)
    return as_ply is not None
