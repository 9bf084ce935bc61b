"""Editing a glTF file: what is in it stays as it is, something is added, and it becomes one glb.

The bytes of its binary chunk keep their places; buffers and images in other files are put behind them, so that the glb
needs no other file.
"""

from __future__ import annotations

import copy
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.formats import gltf_vrm
from meshmatch.shapes.formats.gltf import INSTANCES, MAX_ORIGINS, ORIGINS, Document, digest, embedded
from meshmatch.shapes.formats.gltf_compressed import COMPONENTS
from meshmatch.shapes.formats.gltf_out import INDICES, TYPES, VERTICES, packed
from meshmatch.shapes.formats.gltf_prune import prune, unused
from meshmatch.shapes.shape import Shape

_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_IMAGES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX": "image/ktx2"}


class Editor:
    """A copy of a document that can grow. ``json`` may be changed at will; arrays are added with `add_array`."""

    def __init__(self, document: Document) -> None:
        self.name, self.json = document.name, copy.deepcopy(document.json)
        self._chunks: list[bytes] = []
        self._size = 0
        self._uses = Counter(node["mesh"] for node in document.nodes if "mesh" in node)
        files: dict[str | int, int] = {}  # a thousand buffers, or images, may name one file
        starts = []
        for k, buffer in enumerate(self.json.get("buffers", [])):
            uri = buffer.get("uri", "")
            own = k if not uri or embedded(uri) else uri
            if own not in files:
                files[own] = self._append(document.buffer(k))
            starts.append(files[own])
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
                    views[uri] = self.add_view(data), kind
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

    def add_buffer(self, other: Editor) -> None:
        """Put the data of another document behind this one's, and let its buffer views point there."""
        start = self._append(b"".join(other._chunks))
        for view in other.json.get("bufferViews", []):
            view["byteOffset"] = view.get("byteOffset", 0) + start

    def draw(self, document: Document, node: int) -> None:
        """Let a new node hang from nothing in the scene."""
        self._scene(document).setdefault("nodes", []).append(node)

    def _scene(self, document: Document) -> dict[str, Any]:
        """The scene that is drawn; a document need not have one."""
        if not self.json.get("scenes"):
            self.json |= {"scenes": [{"nodes": document.roots()}], "scene": 0}
        found: dict[str, Any] = self.json["scenes"][self.json.get("scene", 0)]
        return found

    def add_view(self, data: bytes, target: int | None = None) -> int:
        """The number of a new buffer view."""
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
            "bufferView": self.add_view(table.astype(table.dtype.newbyteorder("<")).tobytes(), target)
        }
        entry |= {"componentType": kind, "count": len(table), "type": TYPES[table.shape[1]]}
        if bounds:
            entry |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def add_rows(self, document: Document, number: int, rows: Int[Ints, " N"]) -> int:
        """The number of a new accessor of vertices: some rows of one of the document, as they are stored there."""
        old = document.json["accessors"][number]
        values = document.accessor(number, whole=True)[rows].astype(COMPONENTS[old["componentType"]])
        size = values.shape[1] * values.itemsize
        stride = size + -size % 4  # as vertices must be
        table = np.zeros((len(values), stride), np.uint8)
        table[:, :size] = np.ascontiguousarray(values).view(np.uint8)
        view = self.add_view(table.tobytes(), VERTICES)
        if stride > size:
            self.json["bufferViews"][view]["byteStride"] = stride
        kept = {key: old[key] for key in ("componentType", "type", "normalized", "min", "max", "name") if key in old}
        return self.add("accessors", kept | {"bufferView": view, "count": len(values)})

    def add_indices(self, faces: Int[Ints, "F 3"], V: int) -> int:
        """The number of a new accessor for triangles among V vertices."""
        return self.add_array(faces.astype("<u2" if V < 65_535 else "<u4").reshape(-1), target=INDICES)

    def turn(self, document: Document, rotation: Float[Floats, "3 3"]) -> None:
        """Turn the scene, by a node above all others."""
        scene = self._scene(document)
        node = self.add_node("upright", Rotation.from_matrix(rotation).as_quat(), np.zeros(3))
        self.json["nodes"][node]["children"], scene["nodes"] = scene["nodes"], [node]

    def add_sparse(self, values: Float[NDArray[np.float32], "V D"], *, bounds: bool = False) -> int:
        """The same for values that are mostly zeros: only the others are stored, where that takes less space."""
        rows = np.flatnonzero(values.any(axis=1))
        numbers = rows.astype("<u2" if len(values) <= 2**16 else "<u4")
        if numbers.nbytes + values[rows].nbytes + 64 > values.nbytes:  # there are two views to describe
            return self.add_array(values, bounds=bounds, target=VERTICES)
        entry: dict[str, Any] = {"componentType": 5126, "count": len(values), "type": TYPES[values.shape[1]]}
        if len(rows):
            indices = {
                "bufferView": self.add_view(numbers.tobytes()),
                "componentType": _COMPONENTS[numbers.dtype.str[1:]],
            }
            stored = {"bufferView": self.add_view(values[rows].astype("<f4").tobytes())}
            entry["sparse"] = {"count": len(rows), "indices": indices, "values": stored}
        if bounds:
            entry |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def own_mesh(self, number: int) -> dict[str, Any]:
        """The mesh of a node, which other nodes draw no more: it can be changed."""
        node = self.json["nodes"][number]
        if self._uses[node["mesh"]] > 1:
            self._uses[node["mesh"]] -= 1
            old = node["mesh"]
            node["mesh"] = self.add("meshes", copy.deepcopy(self.json["meshes"][old]))
            gltf_vrm.copy_mesh(self.json, old, node["mesh"])
            self._uses[node["mesh"]] = 1
        found: dict[str, Any] = self.json["meshes"][node["mesh"]]
        return found

    def add_node(self, name: str, rotation: Float[Floats, " 4"], translation: Float[Floats, " 3"]) -> int:
        """The number of a new node, which hangs from nothing yet; the rotation is x, y, z, w."""
        entry: dict[str, Any] = {"name": name} if name else {}
        if np.any(translation):
            entry["translation"] = translation.tolist()
        if not np.array_equal(rotation, (0, 0, 0, 1)):
            entry["rotation"] = rotation.tolist()
        return self.add("nodes", entry)

    def prune(self, document: Document) -> None:
        """Take out what was used in the document, and is not any more."""
        if not prune(self.json, unused(document.json)):
            return
        views = self.json.get("bufferViews", [])
        spans = {(view.get("byteOffset", 0), view["byteLength"]) for view in views}
        if sum(length for _, length in spans) > self._size:  # they lie over each other
            return
        whole = b"".join(self._chunks)
        self._chunks, self._size = [], 0
        places: dict[tuple[int, int], int] = {}
        for start, length in sorted(spans):
            shift = start % 4  # accessors are aligned within
            places[start, length] = self._append(bytes(shift) + whole[start : start + length]) + shift
        for view in views:
            view["byteOffset"] = places[view.get("byteOffset", 0), view["byteLength"]]

    def to_bytes(self) -> bytes:
        """The glb. `OutputError` where it would be larger than a glb can be."""
        if self._size:
            self.json["buffers"] = [{"byteLength": self._size}]
        return packed(self.name, self.json, self._chunks)


def remembering(glb: bytes, of: Shape) -> bytes:
    """A glb that says of what mesh it was made, if its first vertices are that mesh's, in their order, and what is behind
    them are copies of them, or other meshes.
    """
    document = Document(Path("made.glb"), glb)
    faces = document.faces()
    own = faces[: of.F]
    if len(own) < of.F or not ((own == of.faces) | (own >= of.V)).all():
        return glb
    editor = Editor(document)
    asset = editor.json["asset"]
    said = {"made_of": [of.hash, *of.made_of][:MAX_ORIGINS], "faces": digest(faces)}
    asset["extras"] = (asset["extras"] if isinstance(asset.get("extras"), dict) else {}) | {ORIGINS: said}
    return editor.to_bytes()


def drawn(document: Document) -> dict[int, dict[int, dict[str, Any]]]:
    """Nodes that draw something, in the order of the scene, with the numbers of the primitives that they draw."""
    place = {id(part): k for mesh in document.json["meshes"] for k, part in enumerate(mesh["primitives"])}
    found: dict[int, dict[int, dict[str, Any]]] = {}
    for number, part, _ in document.primitives():
        if INSTANCES in document.nodes[number].get("extensions", {}):
            copies = f"{document.name} draws copies of one mesh ({INSTANCES}), which cannot move apart"
            raise InputError(copies, "export each copy as an object of its own")
        found.setdefault(number, {})[place[id(part)]] = part
    return found


def frames_of(document: Document, number: int, part: dict[str, Any]) -> Float[Floats, "V 3 3"]:
    """What takes directions at each vertex of a primitive into the scene: its skin, or else its node."""
    V, place = document.count(part["attributes"]["POSITION"]), document.world[number]
    axes = [document.moved(number, part, np.tile(axis, (V, 1)), place) for axis in np.eye(4)[:3]]
    return np.stack(axes, axis=2)
