"""Compressed meshes of glTF files: KHR_draco_mesh_compression, EXT_meshopt_compression and KHR_meshopt_compression.

They are decoded by DracoPy and meshoptimizer, in a process of its own that may take only so much time and memory.

Afterwards the description is that of a file without compression: the decoded data is one more buffer.
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
_SECONDS, _MEMORY = 300, 8 << 30
_PROGRAM = f"import sys; sys.path[:] = sys.argv[1:]; from {__name__} import main; main()"


def decompress(
    name: str, size: int, description: dict[str, Any], buffer: Callable[[int], bytes], extensions: set[str]
) -> dict[int, bytes]:
    """Decode what a file of so many bytes has compressed by some extensions, and let its description forget that it was; the
    buffers that are new, or stand for nothing now.

    `InputError`: the library that decodes it is not installed, or the data is damaged or promises too much.
    """
    for extension in sorted(extensions):
        library = "DracoPy" if extension == DRACO else "meshoptimizer"
        if importlib.util.find_spec(library) is None:
            hint = "pip install 'meshmatch[compressed]', or export it without mesh compression"
            raise InputError(f"{name} is compressed ({extension}), which needs {library}", hint)
    views = description.setdefault("bufferViews", [])
    packed = [view for view in views if _meshopt(view)]
    meshes = description.get("meshes", [])
    primitives = [each for mesh in meshes for each in mesh["primitives"] if DRACO in each.get("extensions", {})]
    streams = [_meshopt(view) for view in packed]
    alike: dict[str, dict[str, Any]] = {}  # one of the primitives that say the same
    for primitive in primitives:
        alike.setdefault(json.dumps([primitive["extensions"][DRACO], _numbers(primitive)], sort_keys=True), primitive)
    jobs, pieces = _jobs(name, size, description, streams, list(alike.values()))
    data = [buffer(number)[start : start + length] for number, start, length in pieces]
    found = _decoded(name, jobs, data) if jobs else {}
    buffers = description.setdefault("buffers", [])
    made = _Buffer(len(buffers))
    for k, view in enumerate(packed):
        view.update(made.kept(found[f"{k}"].tobytes()))
        view.pop("extensions")
    for k, primitive in enumerate(alike.values(), len(packed)):
        weights = [each for key, each in found.items() if key.startswith(f"{k} WEIGHTS_")]
        totals = np.sum([each.sum(axis=-1, keepdims=True) for each in weights], axis=0)
        for what, accessor in _accessors(description, primitive):
            values = found[f"{k} {what}"]
            if what.startswith("WEIGHTS_") and values.dtype.kind == "f":
                values = values / np.where(totals > 0, totals, 1.0)
            if values.size != _size(accessor):
                raise damaged(name, f"it promises {accessor['count']} values of {what}, and holds others")
            table = values.astype(COMPONENTS[accessor["componentType"]]).reshape(accessor["count"], -1)
            accessor.pop("byteOffset", None)
            accessor["bufferView"] = len(views)
            if "min" in accessor and len(table):  # coarser numbers reach elsewhere
                accessor |= {"min": table.min(0).tolist(), "max": table.max(0).tolist()}
            views.append(made.kept(table.tobytes()))
    for primitive in primitives:
        primitive["extensions"].pop(DRACO)
    for key in ("extensionsRequired", "extensionsUsed"):
        description[key] = [each for each in description.get(key, []) if each not in extensions]
        if not description[key]:
            del description[key]
    empty = {k: b"" for k, each in enumerate(buffers) if _stands_in(each)}
    if not made.size:
        return empty
    buffers.append({"byteLength": made.size})
    return empty | {made.number: b"".join(made.chunks)}


def _jobs(
    name: str, size: int, description: dict[str, Any], streams: list[Any], primitives: list[dict[str, Any]]
) -> tuple[list[dict[str, Any]], list[tuple[int, int, int]]]:
    """What is to be decoded, and the buffer, start and length of the data, by number; `InputError` if that is too much."""
    for each in streams:
        if (kind := each.get("filter", "NONE")) not in _FILTERS:
            unread = f"{name} is compressed with the filter {str(kind)[:40]}, which meshmatch does not read"
            raise InputError(unread, "export it without mesh compression, or with EXT_meshopt_compression")
    pieces: dict[tuple[int, int, int], int] = {}  # of the buffers, numbered: many may need the same

    def piece(entry: dict[str, Any]) -> int:
        start, length = int(entry.get("byteOffset", 0)), int(entry["byteLength"])
        if min(start, length) < 0:
            raise damaged(name, "the place of its compressed data is negative")
        return pieces.setdefault((entry["buffer"], start, length), len(pieces))

    jobs = [{key: each.get(key, "NONE") for key in _STREAM} | {"data": piece(each)} for each in streams]
    promised = [int(each["count"]) * int(each["byteStride"]) for each in streams]
    vertices = corners = 0
    for primitive in primitives:
        said = primitive["extensions"][DRACO]
        sizes = {what: _size(each) for what, each in _accessors(description, primitive)}
        place = piece(description["bufferViews"][said["bufferView"]])
        jobs.append({"data": place, "ids": said["attributes"], "sizes": sizes})
        promised += [4 * each for each in sizes.values()]
        vertices += sizes.get("POSITION", 0) // 3
        corners += sizes.get("indices", 0)
    if min(promised, default=0) < 0:
        raise damaged(name, "it promises a negative count")
    check_element_count(name, size, vertices, corners // 3)
    check_memory(name, size, 4 * sum(promised))
    check_memory(name, size, 3 * sum(length for _, _, length in pieces))
    return jobs, list(pieces)


class _Buffer:
    """A buffer that grows."""

    def __init__(self, number: int) -> None:
        self.number, self.size = number, 0
        self.chunks: list[bytes] = []

    def kept(self, values: bytes) -> dict[str, int]:
        """Where the values are from now on."""
        place = {"buffer": self.number, "byteOffset": self.size, "byteLength": len(values)}
        self.chunks.append(values + b"\0" * (-len(values) % 4))
        self.size += len(self.chunks[-1])
        return place


def _stands_in(buffer: dict[str, Any]) -> bool:
    """Whether a buffer without data stood for what was compressed; it does no more."""
    found = [buffer.get("extensions", {}).pop(each, {}) for each in MESHOPT]
    return "uri" not in buffer and any(each.get("fallback") for each in found)


def _meshopt(view: dict[str, Any]) -> Any:
    return next((view["extensions"][each] for each in MESHOPT if each in view.get("extensions", {})), None)


def _numbers(primitive: dict[str, Any]) -> dict[str, int]:
    """The accessors of what a primitive of Draco holds, by name."""
    numbers = {name: primitive["attributes"][name] for name in primitive["extensions"][DRACO]["attributes"]}
    return numbers | ({"indices": primitive["indices"]} if "indices" in primitive else {})


def _accessors(description: dict[str, Any], primitive: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    for name, number in _numbers(primitive).items():
        yield name, description["accessors"][number]


def _size(accessor: dict[str, Any]) -> int:
    """How many numbers an accessor promises, each of four bytes at most."""
    return int(accessor["count"]) * WIDTHS[accessor["type"]]


def _decoded(name: str, jobs: list[dict[str, Any]], data: list[bytes]) -> dict[str, NDArray[Any]]:
    """What the other process answers: for each job an array of bytes, or one array for each attribute, of the size that is
    promised.
    """
    question = io.BytesIO()
    arrays = {f"data {k}": np.frombuffer(each, np.uint8) for k, each in enumerate(data)}
    np.savez(question, jobs=json.dumps(jobs), **arrays)  # type: ignore[arg-type]
    command = [sys.executable, "-I", "-c", _PROGRAM, *sys.path]
    try:
        done = subprocess.run(command, input=question.getvalue(), capture_output=True, timeout=_SECONDS, check=False)
    except subprocess.TimeoutExpired:
        raise damaged(name, f"its compressed data cannot be decoded within {_SECONDS // 60} minutes") from None
    if done.returncode:
        words = done.stderr.decode(errors="replace").strip().splitlines() or [f"status {done.returncode}"]
        raise damaged(name, f"its compressed data cannot be decoded: {words[-1]}")
    with np.load(io.BytesIO(done.stdout), allow_pickle=False) as answer:
        return {key: answer[key] for key in answer}


def main() -> None:
    """Answer the question on stdin."""
    with suppress(ImportError, OSError, ValueError):  # a system that has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    found: dict[str, NDArray[Any]] = {}
    with np.load(io.BytesIO(sys.stdin.buffer.read()), allow_pickle=False) as question:
        for k, job in enumerate(json.loads(str(question["jobs"]))):
            data = question[f"data {job.pop('data')}"].tobytes()
            if "ids" in job:
                found |= {f"{k} {name}": values for name, values in _draco(data, **job).items()}
            else:
                found[f"{k}"] = _of_meshopt(data, **job)
    np.savez(sys.stdout.buffer, **found)  # type: ignore[arg-type]


def _draco(data: bytes, ids: dict[str, int], sizes: dict[str, int]) -> dict[str, NDArray[Any]]:
    import DracoPy

    mesh = DracoPy.decode(data)
    found: dict[str, NDArray[Any]] = {}
    for name, size in sizes.items():
        faces = name == "indices"
        values = getattr(mesh, "faces", ()) if faces else mesh.get_attribute_by_unique_id(ids[name])["data"]
        found[name] = np.asarray(values).ravel() if faces else np.asarray(values)
        if found[name].size != size:  # who asked has no room for more
            sys.exit(f"it promises {size} numbers of {name}, and holds {found[name].size}")
    return found


def _of_meshopt(data: bytes, mode: str, filter: str, count: int, byteStride: int) -> NDArray[np.uint8]:
    import meshoptimizer

    if mode == "ATTRIBUTES":
        values = meshoptimizer.decode_vertex_buffer(count, byteStride, data, dtype=np.dtype(f"V{byteStride}"))
    else:
        read = {"TRIANGLES": meshoptimizer.decode_index_buffer, "INDICES": meshoptimizer.decode_index_sequence}[mode]
        values = read(count, byteStride, data)
    filters = {
        "NONE": lambda values, *_: values,
        "OCTAHEDRAL": meshoptimizer.decode_filter_oct,
        "QUATERNION": meshoptimizer.decode_filter_quat,
        "EXPONENTIAL": meshoptimizer.decode_filter_exp,
    }
    values = filters[filter](values, count, byteStride)
    return np.frombuffer(values.tobytes(), np.uint8)[: count * byteStride]
