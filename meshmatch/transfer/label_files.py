"""Labels of vertices or faces, from files and to files. A label is a whole number or a word.

=====  =======================================================================================
.npy   (N,) int64, or text
.txt   a label a line
.csv   ``vertex,label`` or ``face,label``, a row each
.json  ``{"on": "vertices", "labels": [...]}``
.ply   the shape with a property ``label`` on vertices or faces and a colour each (written only)
=====  =======================================================================================

JSON may also be a bare list, or name the parts: ``{"left hand": [17, 18, ...], ...}``.
"""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from meshmatch.arrays import Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.outputs import plain_text
from meshmatch.shapes.array_files import read_npy
from meshmatch.shapes.palette import label_colors
from meshmatch.shapes.paths import existing
from meshmatch.shapes.shape import Shape

On = Literal["vertices", "faces"]
Label = int | str
LABEL_SUFFIXES = (".npy", ".csv", ".txt", ".json", ".ply")
_HINT = "one label for each vertex or each face of the source, in the order of its file"
_FORMAT = "meshmatch labels 1"


@dataclass(frozen=True, eq=False)
class Labels:
    """Which label each vertex or face has.

    Parameters
    ----------
    codes : (N,) int64
        A place in `names`; -1 for none.
    names : tuple of int, or of str
        The labels themselves, all of one kind, none twice.
    on : {"vertices", "faces"}
    """

    codes: Ints
    names: tuple[Label, ...]
    on: On

    @property
    def are_words(self) -> bool:
        """True if labels are text."""
        return any(isinstance(name, str) for name in self.names)

    def check_blank(self, text: str) -> Label:
        """The label that `text` names, of the kind that these are; `OptionError` if it cannot be one."""
        if self.are_words:
            return text
        try:
            return int(text)
        except ValueError:
            raise OptionError(
                f"--blank {text}: labels are whole numbers here", "such as --blank -1"
            ) from None


def named(codes: Ints, given: Labels, on: On, blank: str | None) -> Labels:
    """Labels of a target by the names of `given`. Entries without one get `blank`; if that is not given, -1
    among numbers, and an empty word among words.
    """
    empty: Label = given.check_blank(blank) if blank is not None else ("" if given.are_words else -1)
    if (codes >= 0).all():
        return Labels(codes, given.names, on)
    names = given.names if empty in given.names else (*given.names, empty)
    return Labels(np.where(codes < 0, names.index(empty), codes), names, on)


def load_labels(path: str | Path, shape: Shape, on: On | None = None) -> Labels:
    """Read labels of the vertices or faces of `shape`.

    Parameters
    ----------
    on : optional
        What they belong to; told by their count if not given.

    Raises
    ------
    InputError
        The file is missing or damaged, or its count fits neither vertices nor faces.
    OptionError
        The count fits both, and neither the file nor `on` says which.
    """
    path = existing(Path(path), _HINT)
    suffix = path.suffix.lower()
    values: Any
    said: str | None = None
    if suffix == ".npy":
        values = read_npy(path)
        if values.dtype.kind not in "iufbU" or values.ndim != 1:
            raise InputError(
                f"{path.name} holds an array of {values.shape} {values.dtype}, not labels", _HINT
            )
        values = values.tolist()
    elif suffix == ".txt":
        values = _lines(path)
    elif suffix == ".csv":
        values, said = _read_csv(path, shape)
    elif suffix == ".json":
        values, said = _read_json(path, shape, on)
    else:
        raise InputError(
            f"{path.name}: labels are not read from '{suffix}' files", "choose .npy, .csv, .txt or .json"
        )
    if on is not None and said is not None and on != said:
        raise OptionError(f"{path.name} says that it holds labels of {said}, not of {on}", "leave out --on")
    return _labels(path.name, values, _belongs(path.name, len(values), shape, on or said))


def _belongs(name: str, count: int, shape: Shape, on: str | None) -> On:
    """Vertices or faces, by what was said and by the count."""
    owner = shape.name or "the source"
    fits = [kind for kind, size in (("vertices", shape.V), ("faces", shape.F)) if size == count]
    if on is None and len(fits) == 2:
        raise OptionError(
            f"{name} has {count} labels, and {owner} as many vertices as faces",
            "say which with --on vertices or --on faces",
        )
    if not fits or (on is not None and on not in fits):
        raise InputError(
            f"{name} has {count} labels, but {owner} has {shape.V} vertices and {shape.F} faces"
            + (f": they cannot be of its {on}" if on else ""),
            _HINT,
        )
    return "faces" if (on or fits[0]) == "faces" else "vertices"


def _labels(name: str, values: list[Any], on: On) -> Labels:
    whole = [_whole(value) for value in values]
    cells: list[Label | None] = []
    if all(value is not None or _missing(raw) for value, raw in zip(whole, values, strict=True)):
        cells = list(whole)
    else:
        for raw in values:
            if not isinstance(raw, str | int | float | None):
                raise InputError(f"{name}: a label is a whole number or a word, not {str(raw)[:40]!r}", _HINT)
            if isinstance(raw, float):
                raise InputError(
                    f"{name}: {raw} is no label", "numbers between labels go with transfer-color"
                )
            word = plain_text(" ".join(str(raw).split()))  # one line each
            cells.append(None if raw is None or raw == "" else word)
    names = tuple(sorted({cell for cell in cells if cell is not None}))
    place = {label: k for k, label in enumerate(names)}
    codes = np.array([-1 if cell is None else place[cell] for cell in cells], np.int64)
    if not names:
        raise InputError(f"{name} holds no label at all", _HINT)
    return Labels(codes, names, on)


def _whole(value: Any) -> int | None:
    """A whole number, also one written as text or with a decimal point."""
    try:
        if isinstance(value, str):
            return int(value)
        return int(value) if float(value) == int(value) else None
    except (ValueError, TypeError, OverflowError):
        return None


def _missing(value: Any) -> bool:
    return value is None or value == "" or value != value


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path.name} is not text: {error}", _HINT) from error


def _lines(path: Path) -> list[str]:
    return [line.strip() for line in _text(path).rstrip().splitlines()]


def _read_csv(path: Path, shape: Shape) -> tuple[list[str], str | None]:
    try:
        rows = [[cell.strip() for cell in row] for row in csv.reader(_text(path).splitlines()) if row]
    except csv.Error as error:
        raise InputError(f"{path.name} is not a csv file: {error}", _HINT) from error
    if not rows or len({len(row) for row in rows}) != 1:
        raise InputError(f"{path.name}: its rows are not equally long", "one row each: vertex,label")
    head = [cell.lower() for cell in rows[0]]
    said = {"vertex": "vertices", "face": "faces"}.get(head[0])
    named = said is not None or "label" in head
    counts = (shape.V, shape.F)
    if named or (len(rows) - 1 in counts and len(rows) not in counts):
        rows = rows[1:]
    column = head.index("label") if named and "label" in head else len(head) - 1
    if len(head) > 2 and not (named and "label" in head):
        raise InputError(f"{path.name} has {len(head)} columns and none is called label", "use vertex,label")
    numbered = said is not None or (len(head) == 2 and column == 1)
    if numbered and [row[0] for row in rows] != [str(k) for k in range(len(rows))]:
        raise InputError(f"{path.name}: its rows are not 0, 1, 2, ... in order", "sort it, one row for each")
    return [row[column] for row in rows], said


def _read_json(path: Path, shape: Shape, on: On | None) -> tuple[list[Any], str | None]:
    try:
        record = json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name} is not JSON: {error}", _HINT) from error
    if isinstance(record, list):
        return record, None
    if not isinstance(record, dict):
        raise InputError(f"{path.name} holds no list of labels", _HINT)
    if isinstance(record.get("labels"), list) and set(record) - {"labels"} <= {"format", "on", "shape"}:
        said = record.get("on")
        if said not in (None, "vertices", "faces"):
            raise InputError(f"{path.name}: labels are on vertices or on faces, not on {said!r}")
        return record["labels"], said
    return _parts(path.name, record, shape, on), on or "vertices"


def _parts(name: str, record: dict[str, Any], shape: Shape, on: On | None) -> list[Any]:
    """Labels from lists of the members of each part. Where two parts share a member the first keeps it."""
    size = shape.F if on == "faces" else shape.V
    labels: list[Any] = [None] * size
    for part, members in record.items():
        whole = isinstance(members, list) and all(type(member) is int for member in members)
        if not whole or (members and not 0 <= min(members) <= max(members) < size):
            raise InputError(
                f"{name}: '{part[:40]}' is no list of {on or 'vertices'} of {shape.name or 'the source'}",
                f"its {on or 'vertices'} are 0 to {size - 1}",
            )
        for member in members:
            labels[member] = part if labels[member] is None else labels[member]
    return labels


def check_labels_suffix(path: Path) -> None:
    """Refuse a suffix that cannot hold labels (`OptionError`)."""
    if path.suffix.lower() not in LABEL_SUFFIXES:
        raise OptionError(
            f"{path.name}: labels cannot be kept as '{path.suffix or 'a file without a suffix'}'",
            f"end the name in one of {' '.join(LABEL_SUFFIXES)}",
        )


def save_labels(path: Path, labels: Labels, shape: Shape) -> None:
    """Write labels of `shape`; see the module for the formats. All codes must have a name.

    Raises
    ------
    OptionError
        The suffix is none of `LABEL_SUFFIXES`.
    """
    check_labels_suffix(path)
    suffix = path.suffix.lower()
    cells = [labels.names[code] for code in labels.codes.tolist()]
    if suffix == ".npy":
        kind = np.str_ if labels.are_words else np.int64
        with path.open("wb") as file:
            np.save(file, np.array(cells, kind), allow_pickle=False)
    elif suffix == ".txt":
        path.write_text("".join(f"{cell}\n" for cell in cells), encoding="utf-8")
    elif suffix == ".csv":
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(["vertex" if labels.on == "vertices" else "face", "label"])
            writer.writerows(enumerate(cells))
    elif suffix == ".json":
        record = {"format": _FORMAT, "on": labels.on, "shape": shape.name, "labels": cells}
        path.write_text(json.dumps(record, ensure_ascii=False) + "\n", encoding="utf-8")
    else:
        _write_ply(path, labels, shape)


def _write_ply(path: Path, labels: Labels, shape: Shape) -> None:
    """Whole numbers as they are; words by their number, which comments in the header explain."""
    from meshmatch.shapes.formats import ply

    numbers = list(range(len(labels.names))) if labels.are_words else [int(name) for name in labels.names]
    if max(numbers) >= 2**31 or min(numbers) < -(2**31):
        raise OptionError(
            f"{path.name}: a ply file holds labels of 32 bits alone", "choose .npy, .csv or .json"
        )
    used = np.array(numbers, np.int32)
    comments = [f"label {k} {name}" for k, name in enumerate(labels.names)] if labels.are_words else []
    known = [k if name not in ("", -1) else -1 for k, name in enumerate(labels.names)]
    colors = np.rint(255 * label_colors(known)).astype(np.uint8)[labels.codes]
    columns: dict[str, Any] = {"label": used[labels.codes]}
    columns |= {channel: colors[:, k] for k, channel in enumerate(("red", "green", "blue"))}
    plain = Shape(shape.verts, shape.faces, shape.name, None, shape.invalid)
    if labels.on == "vertices":
        ply.write(path, plain, vertex=columns, comments=comments)
    else:
        ply.write(path, plain, face=columns, comments=comments)
