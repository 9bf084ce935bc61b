"""Read and write maps; the suffix selects the format. A map survives writing and reading, as far as the format stores it.

=====  ===========================================================================================
.npy   ``index`` alone: int64 ``(V_source,)``, 0-based
.txt   ``index`` alone: one number a line, 0-based, no header
.csv   a row per source vertex: source_vertex, target_vertex, face, w0, w1, w2, confidence
.npz   everything
.mat   everything, and ``matlab_index`` = index + 1 for programs that count from 1
.json  everything, as text
=====  ===========================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.maps import MAP_SUFFIXES
from meshmatch.maps.mat_file import read_mat
from meshmatch.maps.vertex_map import DIRECTION, UNKNOWN, VertexMap, check_map
from meshmatch.outputs import replace_on_success
from meshmatch.shapes import tables
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.input_files import check_memory, read_bytes, read_json, read_npy, read_npz
from meshmatch.shapes.tables import as_whole_numbers, read_table

CSV_COLUMNS = ("source_vertex", "target_vertex", "face", "w0", "w1", "w2", "confidence")
_ARRAY_FIELDS = ("index", "face", "barycentric", "confidence")
_TEXT_FIELDS = ("source", "target", "verdict", "source_hash", "target_hash", "source_up", "target_up")
_COUNT_FIELDS = ("source_vertices", "target_vertices")
_ALL_FIELDS = (*_ARRAY_FIELDS, *_TEXT_FIELDS, *_COUNT_FIELDS, "reasons")
_FORMAT = "meshmatch map 1"
_MATLAB_INDEX = "matlab_index"
_BYTES_PER_VERTEX = 140  # memory needed while a map is read
check_suffix = partial(tables.check_suffix, suffixes=MAP_SUFFIXES, what="maps")


def save_map(path: str | Path, vertex_map: VertexMap) -> None:
    """Write a map atomically, in the format that the suffix names.

    Parameters
    ----------
    path
        Output file; see `meshmatch.maps.MAP_SUFFIXES`.
    vertex_map
        The map.

    Raises
    ------
    OptionError
        The suffix is not supported.
    InputError
        ``vertex_map`` is not a `VertexMap`.
    OutputError
        The file cannot be written.

    Examples
    --------
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> found = meshmatch.VertexMap.identity(dancer)
    >>> meshmatch.save_map("itself.csv", found)
    """
    check_map(vertex_map)
    write = _FORMATS[check_suffix(path)][0]
    with replace_on_success(path) as temporary:
        write(temporary, vertex_map)


def load_map(path: str | Path, source: ShapeLike | None = None, target: ShapeLike | None = None) -> VertexMap:
    """Read a map and, if shapes are given, check it against them (`VertexMap.for_shapes`).

    Parameters
    ----------
    path
        File whose suffix names the format, see `meshmatch.maps.MAP_SUFFIXES`.
    source
        Supplies name, vertex count and hash that the file lacks.
    target
        Supplies the same for the target, and its faces.

    Returns
    -------
    VertexMap
        From source to target.

    Raises
    ------
    InputError
        The file is missing or damaged, or contains no map; or the map was made for other shapes, or runs from `target`
        to `source`.
    OptionError
        The suffix is not supported.

    Examples
    --------
    >>> climber, dancer = "templates/samples/climber.ply", "templates/samples/dancer.ply"
    >>> meshmatch.save_map("map.npz", meshmatch.match(climber, dancer).map)
    >>> meshmatch.load_map("map.npz", climber, dancer).verdict
    """
    check_suffix(path)
    readers = dict.fromkeys(_FORMATS, _read)
    found = tables.read_by_suffix(path, readers, "maps", f"a map holds an array 'index': {DIRECTION}")
    source = None if source is None else as_shape(source)
    target = None if target is None else as_shape(target)
    return found.for_shapes(source, target, Path(path).name)


def _read(path: Path) -> VertexMap:
    record = _FORMATS[path.suffix.lower()][1](path)
    if not isinstance(record, dict) or "index" not in record:
        raise InputError("there is no 'index' in it")
    texts = {name: [record.get(name, "")] for name in _TEXT_FIELDS} | {"reasons": list(record.get("reasons", ()))}
    if odd := [name for name, found in texts.items() if not all(isinstance(each, str) for each in found)]:
        raise InputError(f"'{odd[0]}' is not text")
    others = sum(np.size(record[name]) for name in _ARRAY_FIELDS if isinstance(record.get(name), np.ndarray | list))
    check_memory(path.name, path.stat().st_size, _BYTES_PER_VERTEX * np.size(record["index"]) + 16 * others)
    return VertexMap(**{"source": "", "target": "", **{k: v for k, v in record.items() if k in _ALL_FIELDS}})


def _to_record(m: VertexMap) -> dict[str, Any]:
    fields = {name: getattr(m, name) for name in (*_ARRAY_FIELDS, *_TEXT_FIELDS, *_COUNT_FIELDS)}
    return {"format": _FORMAT, "direction": DIRECTION, **fields, "reasons": list(m.reasons)}


def _unpack_scalars(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Replace arrays of one element by the texts and counts in them."""
    values = dict(arrays)
    for name in _TEXT_FIELDS:
        values[name] = str(values.get(name, "")) or ("unknown" if name == "verdict" else "")
    for name in _COUNT_FIELDS:
        values[name] = int(np.ravel(values.get(name, UNKNOWN))[0])
    return values


def _index_record(index: NDArray[Any]) -> dict[str, Any]:
    return {"index": index.reshape(-1) if index.ndim == 2 and 1 in index.shape else index}


def _write_txt(path: Path, m: VertexMap) -> None:
    path.write_text("\n".join(map(str, m.index.tolist())) + "\n", encoding="ascii")


def _read_txt(path: Path) -> dict[str, Any]:
    return _index_record(as_whole_numbers(read_table(path, comments="ends", whole=True).numbers()[1]))


def _write_npz(path: Path, m: VertexMap) -> None:
    tables.write_npz(path, _to_record(m) | {"reasons": np.array(m.reasons, dtype=np.str_)})


def _read_npz(path: Path) -> dict[str, Any]:
    record = _unpack_scalars(read_npz(path, _ALL_FIELDS))
    return record | {"reasons": tuple(str(reason) for reason in np.ravel(record.get("reasons", ())))}


def _write_csv(path: Path, m: VertexMap) -> None:
    columns: list[list[Any]] = [list(range(m.source_vertices)), m.index.tolist(), m.face.tolist()]
    columns += [*m.barycentric.T.tolist(), tables.short_floats(m.confidence)]
    tables.write_rows(path, CSV_COLUMNS, zip(*columns, strict=True))


def _read_csv(path: Path) -> dict[str, Any]:
    names, table = read_table(path, whole=True).numbers()
    if not names and table.shape[1] == 1:
        return _index_record(table)
    column = {name.lower(): table[:, k] for k, name in enumerate(names)}
    if "target_vertex" not in column:
        raise InputError("there is no column 'target_vertex'", f"the columns are {','.join(CSV_COLUMNS)}")
    if "source_vertex" in column:
        tables.check_numbered(column["source_vertex"])
    record = {name: column[name] for name in column if name in ("face", "confidence")}
    record["index"] = column["target_vertex"]
    if {"w0", "w1", "w2"} <= set(column):
        record["barycentric"] = np.column_stack([column[name] for name in ("w0", "w1", "w2")])
    return record


def _write_json(path: Path, m: VertexMap) -> None:
    record = _to_record(m)
    record |= {name: record[name].tolist() for name in ("index", "face", "barycentric")}
    tables.write_json(path, record | {"confidence": tables.short_floats(m.confidence)})


def _read_json(path: Path) -> Any:
    record = read_json(path)
    return _index_record(np.array(record)) if isinstance(record, list) else record


def _write_mat(path: Path, m: VertexMap) -> None:
    from scipy.io import savemat

    record = _to_record(m) | {_MATLAB_INDEX: m.index + 1, "reasons": np.array(list(m.reasons), dtype=object)}
    with path.open("wb") as file:
        savemat(file, record, oned_as="column")  # type: ignore[arg-type]  # files serve as well
        file.seek(0)  # the first 116 bytes are free text; the time in it would make every file differ
        file.write(f"MATLAB 5.0 MAT-file, {_FORMAT}".encode("ascii").ljust(116))


def _read_mat(path: Path) -> dict[str, Any]:
    record = _unpack_scalars(read_mat(read_bytes(path), (*_ALL_FIELDS, _MATLAB_INDEX)))
    from_one = record.pop(_MATLAB_INDEX, None)
    if isinstance(from_one, np.ndarray):
        if "index" not in record:
            return _index_record(from_one - 1)
        if not np.array_equal(np.ravel(from_one), np.ravel(record["index"]) + 1):
            hint = f"save one of the two; {_MATLAB_INDEX} alone is read as well"
            raise InputError(f"its {_MATLAB_INDEX} is not index + 1", hint)
    reasons = record.get("reasons", ())
    record["reasons"] = tuple(reasons) if isinstance(reasons, list) else ()
    return record | {name: np.ravel(record[name]) for name in ("index", "face", "confidence") if name in record}


_FORMATS: dict[str, tuple[Callable[[Path, VertexMap], None], Callable[[Path], Any]]] = {
    ".npy": (lambda path, m: tables.write_npy(path, m.index), lambda path: _index_record(read_npy(path))),
    ".npz": (_write_npz, _read_npz),
    ".csv": (_write_csv, _read_csv),
    ".txt": (_write_txt, _read_txt),
    ".mat": (_write_mat, _read_mat),
    ".json": (_write_json, _read_json),
}
