"""Maps from files and to files, by suffix. Write then read gives the same value, as far as the format carries
it.

=====  ===========================================================================================
.npy   ``index`` before_agreement: int64 ``(V_src,)``, 0-based
.txt   ``index`` before_agreement: one number a line, 0-based, no header
.csv   a row per source vertex: source_vertex, target_vertex, face, w0, w1, w2, confidence
.npz   everything
.mat   everything, and ``matlab_index`` = index + 1 for programs that count from 1
.json  everything, in words
=====  ===========================================================================================
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError, MeshmatchError, OptionError
from meshmatch.maps.mat_file import read_mat
from meshmatch.maps.vertex_map import DIRECTION, UNKNOWN, VertexMap
from meshmatch.outputs import replace_on_success
from meshmatch.shapes.array_files import read_npy, read_npz
from meshmatch.shapes.shape import Shape

CSV_COLUMNS = ("source_vertex", "target_vertex", "face", "w0", "w1", "w2", "confidence")
_ARRAYS = ("index", "face", "barycentric", "confidence")
_WORDS = ("source", "target", "verdict", "source_hash", "target_hash")
_COUNTS = ("source_vertices", "target_vertices")
_KNOWN = (*_ARRAYS, *_WORDS, *_COUNTS, "reasons")
_FORMAT = "meshmatch map 1"


def save_map(path: str | Path, vertex_map: VertexMap) -> None:
    """Write a map in the format of the suffix, whole or not at all.

    Raises
    ------
    OptionError
        Unsupported suffix; see `meshmatch.maps.MAP_SUFFIXES`.
    OutputError
        The file cannot be written.
    """
    path = Path(path)
    write = _FORMATS[check_suffix(path)][0]
    with replace_on_success(path) as temporary:
        write(temporary, vertex_map)


def check_suffix(path: str | Path) -> str:
    """The suffix in small letters, if maps have it; `OptionError` otherwise. Cheap: ask before
    work.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _FORMATS:
        raise OptionError(
            f"{Path(path).name}: a map cannot be kept as '{suffix or 'a file without a suffix'}'",
            f"end the name in one of {' '.join(_FORMATS)}",
        )
    return suffix


def load_map(path: str | Path, source: Shape | None = None, target: Shape | None = None) -> VertexMap:
    """Read a map, and check it against the shapes if they are given (`VertexMap.for_shapes`).

    What the file does not contain is filled in from the shapes (names, counts, hashes) or stays unknown.

    Raises
    ------
    InputError
        The file is missing or damaged, or holds no map; or the map was made for other shapes, or runs from
        `target` to `source`.
    OptionError
        Unsupported suffix; see `meshmatch.maps.MAP_SUFFIXES`.
    """
    path = Path(path)
    suffix = check_suffix(path)
    if not path.is_file():
        raise InputError(f"there is no file {path}" if not path.exists() else f"{path} is not a file")
    if path.stat().st_size == 0:
        raise InputError(f"{path.name} is empty", "the program that wrote it may have failed")
    try:
        found = _FORMATS[suffix][1](path)
    except MeshmatchError as error:
        told = error.message.removeprefix(path.name).lstrip()
        raise InputError(f"{path.name}: {told}", error.hint) from error
    except Exception as error:  # every format's library has its own family of errors for damaged files
        raise InputError(
            f"{path.name} does not hold a map that can be read: {error}",
            "is it damaged, or of another format?",
        ) from error
    return found.for_shapes(source, target, path.name)


def _record(m: VertexMap) -> dict[str, Any]:
    fields = {name: getattr(m, name) for name in (*_ARRAYS, *_WORDS, *_COUNTS)}
    return {"format": _FORMAT, "direction": DIRECTION, **fields, "reasons": list(m.reasons)}


def _from_record(record: dict[str, Any]) -> VertexMap:
    if "index" not in record:
        raise InputError("there is no 'index' in it", f"a map holds an array 'index': {DIRECTION}")
    return VertexMap(**{"source": "", "target": "", **{k: v for k, v in record.items() if k in _KNOWN}})


def _bare(index: NDArray[Any]) -> VertexMap:
    if index.ndim == 2 and 1 in index.shape:
        index = index.reshape(-1)
    return VertexMap("", "", index)


def _write_npy(path: Path, m: VertexMap) -> None:
    # Here and below open files, not paths: given a path such as a.NPY numpy writes a.NPY.npy.
    with path.open("wb") as file:
        np.save(file, m.index, allow_pickle=False)


def _read_npy(path: Path) -> VertexMap:
    return _bare(read_npy(path))


def _write_txt(path: Path, m: VertexMap) -> None:
    path.write_text("\n".join(map(str, m.index.tolist())) + "\n", encoding="ascii")


def _read_txt(path: Path) -> VertexMap:
    return _bare(np.loadtxt(path, dtype=np.int64, ndmin=1, encoding="utf-8"))


def _write_npz(path: Path, m: VertexMap) -> None:
    record = {name: np.asarray(value) for name, value in _record(m).items()}
    record["reasons"] = np.array(list(m.reasons), dtype=np.str_)
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **record)


def _read_npz(path: Path) -> VertexMap:
    record: dict[str, Any] = dict(read_npz(path, _KNOWN))
    if not record:
        raise InputError(f"it holds none of {', '.join(_ARRAYS)}", f"'index' is needed: {DIRECTION}")
    for name in _WORDS:
        record[name] = str(record.get(name, "")) or ("unknown" if name == "verdict" else "")
    for name in _COUNTS:
        record[name] = int(record.get(name, UNKNOWN))
    record["reasons"] = tuple(str(reason) for reason in np.ravel(record.get("reasons", ())))
    return _from_record(record)


def _write_csv(path: Path, m: VertexMap) -> None:
    # str() of a float is the shortest text that reads back as the same float.
    columns: list[list[Any]] = [list(range(m.source_vertices)), m.index.tolist(), m.face.tolist()]
    columns += [m.barycentric[:, k].tolist() for k in range(3)]
    columns.append(_short(m.confidence))
    with path.open("w", encoding="ascii", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(CSV_COLUMNS)
        writer.writerows(zip(*columns, strict=True))


def _read_csv(path: Path) -> VertexMap:
    with path.open(encoding="utf-8-sig", newline="") as file:
        names = [name.strip() for name in next(csv.reader(file))]
        if "target_vertex" not in names:
            raise InputError("there is no column 'target_vertex'", f"the columns are {','.join(CSV_COLUMNS)}")
        table = np.loadtxt(file, delimiter=",", ndmin=2)
    column = {name: table[:, k] for k, name in enumerate(names)}
    order = column.get("source_vertex", np.arange(len(table)))
    if not np.array_equal(order, np.arange(len(table))):
        raise InputError(
            "the rows are not the source's vertices 0, 1, 2, ... in order", "sort it, one row for each"
        )
    record: dict[str, Any] = {"index": column["target_vertex"]}
    record |= {name: column[name] for name in ("face", "confidence") if name in column}
    if {"w0", "w1", "w2"} <= set(names):
        record["barycentric"] = np.column_stack([column[name] for name in ("w0", "w1", "w2")])
    return _from_record(record)


def _write_json(path: Path, m: VertexMap) -> None:
    record = _record(m)
    record |= {name: record[name].tolist() for name in ("index", "face", "barycentric")}
    record["confidence"] = _short(m.confidence)
    path.write_text(json.dumps(record, allow_nan=False) + "\n", encoding="utf-8")


def _read_json(path: Path) -> VertexMap:
    record = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(record, list):
        return _bare(np.array(record))
    return _from_record(record)


def _write_mat(path: Path, m: VertexMap) -> None:
    from scipy.io import savemat

    record = _record(m)
    record["matlab_index"] = m.index + 1
    record["reasons"] = np.array(list(m.reasons), dtype=object)
    with path.open("wb") as file:
        savemat(file, record, oned_as="column")
        file.seek(0)  # the first 116 bytes are free text; the time in it would make every file differ
        file.write(f"MATLAB 5.0 MAT-file, {_FORMAT}".encode("ascii").ljust(116))


def _read_mat(path: Path) -> VertexMap:
    record: dict[str, Any] = dict(read_mat(path.read_bytes(), _KNOWN))
    for name in ("index", "face", "confidence"):
        if name in record:
            record[name] = np.ravel(record[name])
    for name in _WORDS:
        record[name] = str(record.get(name, "")) or ("unknown" if name == "verdict" else "")
    for name in _COUNTS:
        record[name] = int(np.ravel(record.get(name, UNKNOWN))[0])
    reasons = record.get("reasons", ())
    record["reasons"] = tuple(reasons) if isinstance(reasons, list) else ()
    return _from_record(record)


def _short(values: NDArray[np.float32]) -> list[float]:
    text: list[float] = values.astype(np.str_).astype(np.float64).tolist()
    return text


_FORMATS: dict[str, tuple[Callable[[Path, VertexMap], None], Callable[[Path], VertexMap]]] = {
    ".npy": (_write_npy, _read_npy),
    ".npz": (_write_npz, _read_npz),
    ".csv": (_write_csv, _read_csv),
    ".txt": (_write_txt, _read_txt),
    ".mat": (_write_mat, _read_mat),
    ".json": (_write_json, _read_json),
}
