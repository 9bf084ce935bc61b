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

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.maps.table_files import (
    check_numbered,
    check_suffix,
    read_by_suffix,
    read_json,
    read_rows,
    read_text,
    write_json,
    write_npy,
    write_rows,
)
from meshmatch.outputs import plain_text
from meshmatch.shapes.array_files import read_npy
from meshmatch.shapes.palette import label_colors
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

    codes: Int[Ints, " N"]
    names: tuple[Label, ...]
    on: On

    @property
    def values(self) -> NDArray[np.generic]:
        """(N,) the label itself of each vertex or face; -1 or an empty word for none."""
        table = np.array([*self.names, "" if self.are_words else -1])
        return table[self.codes]

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
            raise OptionError(f"--blank {text}: labels are whole numbers here", "such as --blank -1") from None


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
        What they belong to; taken from their count if not given.

    Raises
    ------
    InputError
        The file is missing or damaged, or its count fits neither vertices nor faces.
    OptionError
        The count fits both, and neither the file nor `on` says which.
    """
    readers = {
        ".npy": lambda path: (_read_npy(path), None),
        ".csv": lambda path: _read_csv(path, (shape.V, shape.F)),
        ".txt": lambda path: ([line.strip() for line in read_text(path).rstrip().splitlines()], None),
        ".json": lambda path: _read_json(path, shape, on),
    }
    values, written = read_by_suffix(path, readers, "labels", _HINT)
    name = Path(path).name
    if on is not None and written is not None and on != written:
        raise OptionError(f"{name} says that it holds labels of {written}, not of {on}", "leave out --on")
    return _labels(name, values, _on(name, len(values), shape, on or written))


def labels_of(values: ArrayLike, shape: Shape, on: On | None = None) -> Labels:
    """Labels of the vertices or faces of `shape` from an array of whole numbers or words; see `load_labels`."""
    array = np.asarray(values)
    if array.ndim != 1 or array.dtype.kind not in "iufbUO":
        raise InputError(f"labels must be a list of (N,), not an array of {array.shape} {array.dtype}", _HINT)
    return _labels("the array", array.tolist(), _on("the array", len(array), shape, on))


def _on(name: str, count: int, shape: Shape, on: str | None) -> On:
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


def _labels(name: str, values: Sequence[Any], on: On) -> Labels:
    whole = [_whole(value) for value in values]
    cells: list[Label | None] = []
    if all(value is not None or _missing(raw) for value, raw in zip(whole, values, strict=True)):
        cells = list(whole)
    else:
        for raw in values:
            if isinstance(raw, float):
                raise InputError(f"{name}: {raw} is not a label", "transfer-color interpolates numbers")
            if not isinstance(raw, str | int | None):
                raise InputError(f"{name}: a label is a whole number or a word, not {str(raw)[:40]!r}", _HINT)
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
        if isinstance(value, str | int):
            return int(value)
        return int(value) if float(value) == int(value) else None
    except (ValueError, TypeError, OverflowError):
        return None


def _missing(value: Any) -> bool:
    return value is None or value == "" or value != value


def _read_npy(path: Path) -> list[Any]:
    values = read_npy(path)
    if values.dtype.kind not in "iufbU" or values.ndim != 1:
        raise InputError(f"it holds an array of {values.shape} {values.dtype}, not labels")
    labels: list[Any] = values.tolist()
    return labels


def _read_csv(path: Path, counts: tuple[int, int]) -> tuple[list[str], str | None]:
    rows = read_rows(path)
    if not rows or len({len(row) for row in rows}) != 1:
        raise InputError("its rows are not equally long", "one row each: vertex,label")
    head = [cell.lower() for cell in rows[0]]
    written = {"vertex": "vertices", "face": "faces"}.get(head[0])
    has_names = written is not None or "label" in head
    if has_names or (len(rows) - 1 in counts and len(rows) not in counts):
        rows = rows[1:]
    column = head.index("label") if "label" in head else len(head) - 1
    if len(head) > 2 and "label" not in head:
        raise InputError(f"it has {len(head)} columns and none is called label", "use vertex,label")
    if written is not None or (len(head) == 2 and column == 1):
        check_numbered([row[0] for row in rows])
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
    return _parts(record, shape, on), on or "vertices"


def _parts(record: dict[str, Any], shape: Shape, on: On | None) -> list[Any]:
    """Labels from lists of the members of each part. Where two parts share a member the first keeps it."""
    size = shape.F if on == "faces" else shape.V
    labels: list[Any] = [None] * size
    for part, members in record.items():
        whole = isinstance(members, list) and all(type(member) is int for member in members)
        if not whole or (members and not 0 <= min(members) <= max(members) < size):
            raise InputError(
                f"'{part[:40]}' is not a list of {on or 'vertices'} of {shape.name or 'the source'}",
                f"its {on or 'vertices'} are 0 to {size - 1}",
            )
        for member in members:
            labels[member] = part if labels[member] is None else labels[member]
    return labels


def check_labels_suffix(path: Path) -> str:
    """The suffix, if it is one of `LABEL_SUFFIXES`; `OptionError` otherwise."""
    return check_suffix(path, LABEL_SUFFIXES, "labels")


def save_labels(path: Path, labels: Labels, shape: Shape) -> None:
    """Write labels of `shape`; see the module for the formats. All codes must have a name.

    Raises
    ------
    OptionError
        The suffix is not one of `LABEL_SUFFIXES`, or a label is too large a number for the format.
    """
    suffix = check_labels_suffix(path)
    cells = [labels.names[code] for code in labels.codes.tolist()]
    if suffix == ".npy":
        if not labels.are_words:
            _check_range(path, labels, 64)
        write_npy(path, np.array(cells, np.str_ if labels.are_words else np.int64))
    elif suffix == ".txt":
        path.write_text("".join(f"{cell}\n" for cell in cells), encoding="utf-8")
    elif suffix == ".csv":
        write_rows(path, ["vertex" if labels.on == "vertices" else "face", "label"], enumerate(cells))
    elif suffix == ".json":
        write_json(path, {"format": _FORMAT, "on": labels.on, "shape": shape.name, "labels": cells})
    else:
        _write_ply(path, labels, shape)


def _check_range(path: Path, labels: Labels, bits: int) -> None:
    if any(not -(2 ** (bits - 1)) <= int(name) < 2 ** (bits - 1) for name in labels.names):
        raise OptionError(f"{path.name}: this format holds labels of at most {bits} bits", "choose .csv or .json")


def _write_ply(path: Path, labels: Labels, shape: Shape) -> None:
    """Whole numbers as they are; words by their number, which comments in the header explain."""
    from meshmatch.shapes.formats import ply

    if not labels.are_words:
        _check_range(path, labels, 32)
    numbers = range(len(labels.names)) if labels.are_words else [int(name) for name in labels.names]
    used = np.array(numbers, np.int32)
    comments = [f"label {k} {name}" for k, name in enumerate(labels.names)] if labels.are_words else []
    known = [k if name not in ("", -1) else -1 for k, name in enumerate(labels.names)]
    colors = np.rint(255 * label_colors(known)).astype(np.uint8)[labels.codes]
    columns: dict[str, Any] = {"label": used[labels.codes]}
    columns |= {channel: colors[:, k] for k, channel in enumerate(("red", "green", "blue"))}
    plain = Shape(shape.verts, shape.faces, shape.name, None, shape.invalid)
    where: Any = {"vertex" if labels.on == "vertices" else "face": columns}
    ply.write(path, plain, comments=comments, **where)
