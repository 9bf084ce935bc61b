"""Decode the compressed meshes of glTF files: Draco (KHR_draco_mesh_compression) and meshopt (EXT and KHR extension).

DracoPy and meshoptimizer decode them in a separate process with limited time and memory. The JSON description is then
rewritten to that of an uncompressed file; the decoded data becomes one more buffer.
"""

from __future__ import annotations

import importlib.util
import io
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.formats import check_element_count, damaged
from meshmatch.shapes.input_files import check_memory

DRACO = "KHR_draco_mesh_compression"
MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_FILTERS = ("NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL")
_STREAM = ("mode", "filter", "count", "byteStride")
_TIMEOUT_SECONDS, _MAX_MEMORY_BYTES = 300, 8 << 30
_PROGRAM = f"import sys; sys.path[:] = sys.argv[1:]; from {__name__} import main; main()"


def decompress(
    name: str, size: int, description: dict[str, Any], buffer: Callable[[int], bytes], extensions: set[str]
) -> dict[int, bytes]:
    """Decode all compressed data of a file and rewrite its JSON description in place to that of an uncompressed file.

    Parameters
    ----------
    name, size
        Name and number of bytes of the file.
    description
        Its JSON description.
    buffer
        Returns the bytes of a buffer, by its number.
    extensions
        The compression extensions that the file requires.

    Returns
    -------
    dict
        Data by number of buffer: the new one, and empty data for fallback buffers.

    Raises
    ------
    InputError
        The decoding library is not installed, or the data is damaged or declares too large a size.
    """
    for extension in sorted(extensions):
        library = "DracoPy" if extension == DRACO else "meshoptimizer"
        if importlib.util.find_spec(library) is None:
            hint = "pip install 'meshmatch[compressed]', or export it without mesh compression"
            raise InputError(f"{name} is compressed ({extension}), which needs {library}", hint)
    views = description.setdefault("bufferViews", [])
    compressed_views = [view for view in views if _meshopt(view)]
    meshes = description.get("meshes", [])
    primitives = [each for mesh in meshes for each in mesh["primitives"] if DRACO in each.get("extensions", {})]
    streams = [_meshopt(view) for view in compressed_views]
    distinct: dict[str, dict[str, Any]] = {}  # one primitive of each group that shares all its data
    for primitive in primitives:
        distinct.setdefault(
            json.dumps([primitive["extensions"][DRACO], _accessor_numbers(primitive)], sort_keys=True), primitive
        )
    jobs, pieces = _jobs(name, size, description, streams, list(distinct.values()))
    data = [buffer(number)[start : start + length] for number, start, length in pieces]
    decoded = _decode_in_subprocess(name, jobs, data) if jobs else {}
    buffers = description.setdefault("buffers", [])
    new_buffer = _Buffer(len(buffers))
    for k, view in enumerate(compressed_views):
        view.update(new_buffer.append(decoded[f"{k}"].tobytes()))
        view.pop("extensions")
    for k, primitive in enumerate(distinct.values(), len(compressed_views)):
        weights = [each for key, each in decoded.items() if key.startswith(f"{k} WEIGHTS_")]
        totals = np.sum([each.sum(axis=-1, keepdims=True) for each in weights], axis=0)
        for what, accessor in _accessors(description, primitive):
            values = decoded[f"{k} {what}"]
            if what.startswith("WEIGHTS_") and values.dtype.kind == "f":
                values = values / np.where(totals > 0, totals, 1.0)
            if values.size != _n_scalars(accessor):
                raise damaged(name, f"it promises {accessor['count']} values of {what}, but holds another number")
            table = values.astype(COMPONENTS[accessor["componentType"]]).reshape(accessor["count"], -1)
            accessor.pop("byteOffset", None)
            accessor["bufferView"] = len(views)
            if "min" in accessor and len(table):  # quantisation has changed the bounds
                accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
            views.append(new_buffer.append(table.tobytes()))
    for primitive in primitives:
        primitive["extensions"].pop(DRACO)
    for key in ("extensionsRequired", "extensionsUsed"):
        description[key] = [each for each in description.get(key, []) if each not in extensions]
        if not description[key]:
            del description[key]
    empty = {k: b"" for k, each in enumerate(buffers) if _pop_fallback(each)}
    if not new_buffer.size:
        return empty
    buffers.append({"byteLength": new_buffer.size})
    return empty | {new_buffer.number: b"".join(new_buffer.chunks)}


def _jobs(
    name: str, size: int, description: dict[str, Any], streams: list[Any], primitives: list[dict[str, Any]]
) -> tuple[list[dict[str, Any]], list[tuple[int, int, int]]]:
    """List the decoding jobs, and the distinct (buffer, start, length) pieces of data that they refer to by number.

    `InputError` if the declared sizes are invalid or too large.
    """
    for each in streams:
        if (kind := each.get("filter", "NONE")) not in _FILTERS:
            unread = f"{name} is compressed with the filter {str(kind)[:40]}, which meshmatch does not read"
            raise InputError(unread, "export it without mesh compression, or with EXT_meshopt_compression")
    pieces: dict[tuple[int, int, int], int] = {}  # numbers of the distinct pieces; many jobs may share one

    def piece(entry: dict[str, Any]) -> int:
        start, length = int(entry.get("byteOffset", 0)), int(entry["byteLength"])
        if min(start, length) < 0:
            raise damaged(name, "the offset or length of its compressed data is negative")
        return pieces.setdefault((entry["buffer"], start, length), len(pieces))

    jobs = [{key: each.get(key, "NONE") for key in _STREAM} | {"data": piece(each)} for each in streams]
    declared = [int(each["count"]) * int(each["byteStride"]) for each in streams]
    vertices = corners = 0
    for primitive in primitives:
        draco = primitive["extensions"][DRACO]
        sizes = {what: _n_scalars(each) for what, each in _accessors(description, primitive)}
        piece_number = piece(description["bufferViews"][draco["bufferView"]])
        jobs.append({"data": piece_number, "ids": draco["attributes"], "sizes": sizes})
        declared += [4 * each for each in sizes.values()]
        vertices += sizes.get("POSITION", 0) // 3
        corners += sizes.get("indices", 0)
    if min(declared, default=0) < 0:
        raise damaged(name, "it promises a negative count")
    check_element_count(name, size, vertices, corners // 3)
    check_memory(name, size, 4 * sum(declared))
    check_memory(name, size, 3 * sum(length for _, _, length in pieces))
    return jobs, list(pieces)


class _Buffer:
    """A buffer under construction."""

    def __init__(self, number: int) -> None:
        self.number, self.size = number, 0
        self.chunks: list[bytes] = []

    def append(self, values: bytes) -> dict[str, int]:
        """Append values, padded to four bytes; return the buffer view entries for them."""
        view = {"buffer": self.number, "byteOffset": self.size, "byteLength": len(values)}
        self.chunks.append(values + b"\0" * (-len(values) % 4))
        self.size += len(self.chunks[-1])
        return view


def _pop_fallback(buffer: dict[str, Any]) -> bool:
    """Whether a buffer was the data-less fallback of compressed data; removes the marking extension from it."""
    found = [buffer.get("extensions", {}).pop(each, {}) for each in MESHOPT]
    return "uri" not in buffer and any(each.get("fallback") for each in found)


def _meshopt(view: dict[str, Any]) -> Any:
    """The meshopt extension of a buffer view, or None."""
    return next((view["extensions"][each] for each in MESHOPT if each in view.get("extensions", {})), None)


def _accessor_numbers(primitive: dict[str, Any]) -> dict[str, int]:
    """Accessor numbers of the attributes and indices that a Draco primitive compresses, by name."""
    numbers = {name: primitive["attributes"][name] for name in primitive["extensions"][DRACO]["attributes"]}
    return numbers | ({"indices": primitive["indices"]} if "indices" in primitive else {})


def _accessors(description: dict[str, Any], primitive: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, number in _accessor_numbers(primitive).items():
        yield name, description["accessors"][number]


def _n_scalars(accessor: dict[str, Any]) -> int:
    """Number of scalars that an accessor declares, each of four bytes at most."""
    return int(accessor["count"]) * WIDTHS[accessor["type"]]


def _decode_in_subprocess(name: str, jobs: list[dict[str, Any]], data: list[bytes]) -> dict[str, NDArray[Any]]:
    """Run the jobs in a separate process and return the decoded arrays.

    Keys are "JOB" for meshopt (an array of bytes) and "JOB ATTRIBUTE" for Draco; sizes are as declared.
    """
    request = io.BytesIO()
    arrays = {f"data {k}": np.frombuffer(each, np.uint8) for k, each in enumerate(data)}
    np.savez(request, jobs=json.dumps(jobs), **arrays)  # type: ignore[arg-type]
    command = [sys.executable, "-I", "-c", _PROGRAM, *sys.path]
    try:
        result = subprocess.run(
            command, input=request.getvalue(), capture_output=True, timeout=_TIMEOUT_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        raise damaged(name, f"its compressed data cannot be decoded within {_TIMEOUT_SECONDS // 60} minutes") from None
    if result.returncode:
        lines = result.stderr.decode(errors="replace").strip().splitlines() or [f"status {result.returncode}"]
        raise damaged(name, f"its compressed data cannot be decoded: {lines[-1]}")
    with np.load(io.BytesIO(result.stdout), allow_pickle=False) as reply:
        return {key: reply[key] for key in reply}


def main() -> None:
    """Decode the jobs read from stdin as npz, and write the arrays to stdout as npz."""
    with suppress(ImportError, OSError, ValueError):  # the system has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY_BYTES, _MAX_MEMORY_BYTES))
    decoded: dict[str, NDArray[Any]] = {}
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as request:
        for k, job in enumerate(json.loads(str(request["jobs"]))):
            data = request[f"data {job.pop('data')}"].tobytes()
            if "ids" in job:
                decoded |= {f"{k} {name}": values for name, values in _decode_draco(data, **job).items()}
            else:
                decoded[f"{k}"] = _decode_meshopt(data, **job)
    np.savez(sys.stdout.buffer, **decoded)  # type: ignore[arg-type]


def _decode_draco(data: bytes, ids: dict[str, int], sizes: dict[str, int]) -> dict[str, NDArray[Any]]:
    import DracoPy

    mesh = DracoPy.decode(data)
    decoded: dict[str, NDArray[Any]] = {}
    for name, size in sizes.items():
        is_indices = name == "indices"
        values = getattr(mesh, "faces", ()) if is_indices else mesh.get_attribute_by_unique_id(ids[name])["data"]
        decoded[name] = np.asarray(values).ravel() if is_indices else np.asarray(values)
        if decoded[name].size != size:  # the caller expects exactly this size
            sys.exit(f"it promises {size} numbers of {name}, and holds {decoded[name].size}")
    return decoded


def _decode_meshopt(data: bytes, mode: str, filter: str, count: int, byteStride: int) -> NDArray[np.uint8]:
    import meshoptimizer

    if mode == "ATTRIBUTES":
        values = meshoptimizer.decode_vertex_buffer(count, byteStride, data, dtype=np.dtype(f"V{byteStride}"))
    else:
        decode = {"TRIANGLES": meshoptimizer.decode_index_buffer, "INDICES": meshoptimizer.decode_index_sequence}[mode]
        values = decode(count, byteStride, data)
    filters = {
        "NONE": lambda values, *_: values,
        "OCTAHEDRAL": meshoptimizer.decode_filter_oct,
        "QUATERNION": meshoptimizer.decode_filter_quat,
        "EXPONENTIAL": meshoptimizer.decode_filter_exp,
    }
    values = filters[filter](values, count, byteStride)
    return np.frombuffer(values.tobytes(), np.uint8)[: count * byteStride]
