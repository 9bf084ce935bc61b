"""Editing a glTF file: what is in it stays as it is, something is added, and it becomes one glb.

The bytes of its binary chunk keep their places; buffers and images in other files are put behind them, so that the glb
needs no other file.
"""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OutputError
from meshmatch.shapes.formats.gltf import Document, embedded

_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_IMAGES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX": "image/ktx2"}
_LARGEST = 2**32 - 1
VERTICES = 34962
"""The target of a buffer view that holds attributes of vertices."""


class Editor:
    """A copy of a document that can grow. ``json`` may be changed at will; arrays are added with `add_array`."""

    def __init__(self, document: Document) -> None:
        self.name, self.json = document.name, copy.deepcopy(document.json)
        self._chunks: list[bytes] = []
        self._size = 0
        files: dict[str, int] = {}  # a thousand buffers, or images, may name one file
        starts = []
        for k, buffer in enumerate(self.json.get("buffers", [])):
            uri = buffer.get("uri", "")
            if uri not in files or embedded(uri):
                files[uri] = self._append(document.buffer(k))
            starts.append(files[uri])
        for view in self.json.get("bufferViews", []):
            start = starts[view["buffer"]]
            view["buffer"] = 0
            if start:
                view["byteOffset"] = view.get("byteOffset", 0) + start
        views: dict[str, tuple[int, str]] = {}
        for image in self.json.get("images", []):
            uri = image.get("uri")
            if uri is not None and not embedded(uri):
                if uri not in views:
                    data = document.resource(uri)
                    kind = next((kind for magic, kind in _IMAGES.items() if data.startswith(magic)), "image/png")
                    views[uri] = self._add_view(data), kind
                del image["uri"]
                image["bufferView"], kind = views[uri]
                image.setdefault("mimeType", kind)

    def _append(self, data: bytes) -> int:
        """Where the data begins, a multiple of four."""
        start = self._size
        padded = data + b"\0" * (-len(data) % 4)
        self._chunks.append(padded)
        self._size += len(padded)
        return start

    def _add_view(self, data: bytes, target: int | None = None) -> int:
        view = {"buffer": 0, "byteOffset": self._append(data), "byteLength": len(data)}
        return self.add("bufferViews", view if target is None else view | {"target": target})

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """The number of a new node, mesh, skin or whatever else the document lists."""
        self.json.setdefault(kind, []).append(entry)
        return len(self.json[kind]) - 1

    def add_array(self, values: NDArray[Any], *, bounds: bool = False, target: int | None = None) -> int:
        """The number of a new accessor for values (N,) or (N, width): float32, or integers of up to 32 bits.

        With ``bounds`` it says between which values they lie, as positions and times must.
        """
        table = np.ascontiguousarray(values).reshape(len(values), -1)
        kind = _COMPONENTS[table.dtype.str[1:]]
        entry: dict[str, Any] = {
            "bufferView": self._add_view(table.astype(table.dtype.newbyteorder("<")).tobytes(), target)
        }
        entry |= {"componentType": kind, "count": len(table), "type": _TYPES[table.shape[1]]}
        if bounds:
            entry |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def add_node(self, name: str, rotation: Float[Floats, " 4"], translation: Float[Floats, " 3"]) -> int:
        """The number of a new node, which hangs from nothing yet; the rotation is x, y, z, w."""
        entry: dict[str, Any] = {"name": name} if name else {}
        if np.any(translation):
            entry["translation"] = translation.tolist()
        if not np.array_equal(rotation, (0, 0, 0, 1)):
            entry["rotation"] = rotation.tolist()
        return self.add("nodes", entry)

    def to_bytes(self) -> bytes:
        """The glb. `OutputError` where it would be larger than a glb can be."""
        if self._size:
            self.json["buffers"] = [{"byteLength": self._size}]
        text = json.dumps(self.json, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        size = 28 + len(text) + self._size
        if size > _LARGEST:
            raise OutputError(f"{self.name} becomes larger than a glb can be (4 GiB)", "decimate it first")
        head = b"glTF" + np.array([2, size, len(text)], "<u4").tobytes() + b"JSON"
        return b"".join([head, text, np.array([self._size], "<u4").tobytes(), b"BIN\0", *self._chunks])
