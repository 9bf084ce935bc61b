"""Edit a glTF file: keep its content, add to it, and write it as one glb.

The bytes of its binary chunk keep their offsets; buffers and images in other files are appended, so that the glb is
self-contained.
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
from meshmatch.shapes.formats.gltf import INSTANCES, MAX_ORIGINS, ORIGINS, Document, digest, is_embedded
from meshmatch.shapes.formats.gltf_compressed import COMPONENTS
from meshmatch.shapes.formats.gltf_prune import prune, unused
from meshmatch.shapes.formats.gltf_write import INDICES, TYPES, VERTICES, pack_glb
from meshmatch.shapes.shape import Shape

_COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
_IMAGES = {b"\x89PNG": "image/png", b"\xff\xd8\xff": "image/jpeg", b"RIFF": "image/webp", b"\xabKTX": "image/ktx2"}


class Editor:
    """An editable copy of a document. ``json`` may be changed freely; `add_array` adds arrays."""

    def __init__(self, document: Document) -> None:
        self.name, self.json = document.name, copy.deepcopy(document.json)
        self._chunks: list[bytes] = []
        self._size = 0
        self._uses = Counter(node["mesh"] for node in document.nodes if "mesh" in node)
        files: dict[str | int, int] = {}  # a thousand buffers, or images, may refer to one file
        starts = []
        for k, buffer in enumerate(self.json.get("buffers", [])):
            uri = buffer.get("uri", "")
            source = k if not uri or is_embedded(uri) else uri
            if source not in files:
                files[source] = self._append(document.buffer(k))
            starts.append(files[source])
        for view in self.json.get("bufferViews", []):
            start = starts[view["buffer"]]
            view["buffer"] = 0
            if start:
                view["byteOffset"] = view.get("byteOffset", 0) + start
        views: dict[str, tuple[int, str]] = {}
        for image in self.json.get("images", []):
            uri = image.get("uri")
            if uri is not None and not is_embedded(uri):
                if uri not in views:
                    data = document.resource(uri)
                    mime = next((mime for magic, mime in _IMAGES.items() if data.startswith(magic)), "image/png")
                    views[uri] = self.add_view(data), mime
                del image["uri"]
                image["bufferView"], mime = views[uri]
                image.setdefault("mimeType", mime)

    def _append(self, data: bytes) -> int:
        """Append data, padded to four bytes; return its start offset, a multiple of four."""
        start = self._size
        padded = data + b"\0" * (-len(data) % 4)
        self._chunks.append(padded)
        self._size += len(padded)
        return start

    def add_buffer(self, other: Editor) -> None:
        """Append the data of another editor, and shift the offsets of the other's buffer views accordingly."""
        start = self._append(b"".join(other._chunks))
        for view in other.json.get("bufferViews", []):
            view["byteOffset"] = view.get("byteOffset", 0) + start

    def draw(self, document: Document, node: int) -> None:
        """Make a node a root of the scene."""
        self._scene(document).setdefault("nodes", []).append(node)

    def _scene(self, document: Document) -> dict[str, Any]:
        """Return the default scene; create one if the document has none."""
        if not self.json.get("scenes"):
            self.json |= {"scenes": [{"nodes": document.roots()}], "scene": 0}
        scene: dict[str, Any] = self.json["scenes"][self.json.get("scene", 0)]
        return scene

    def add_view(self, data: bytes, target: int | None = None) -> int:
        """Add a buffer view with this data; return its number."""
        view = {"buffer": 0, "byteOffset": self._append(data), "byteLength": len(data)}
        return self.add("bufferViews", view if target is None else view | {"target": target})

    def add(self, kind: str, entry: dict[str, Any]) -> int:
        """Append an entry to a top-level list of the document ("nodes", "meshes", "skins", ...); return its number."""
        self.json.setdefault(kind, []).append(entry)
        return len(self.json[kind]) - 1

    def add_array(self, values: NDArray[Any], *, bounds: bool = False, target: int | None = None) -> int:
        """Add an accessor for values (N,) or (N, width), float32 or integers of up to 32 bits; return its number.

        With ``bounds`` it has their minimum and maximum, which glTF requires for positions and times.
        """
        table = np.ascontiguousarray(values).reshape(len(values), -1)
        component_type = _COMPONENTS[table.dtype.str[1:]]
        entry: dict[str, Any] = {
            "bufferView": self.add_view(table.astype(table.dtype.newbyteorder("<")).tobytes(), target)
        }
        entry |= {"componentType": component_type, "count": len(table), "type": TYPES[table.shape[1]]}
        if bounds:
            entry |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        return self.add("accessors", entry)

    def add_rows(self, document: Document, number: int, rows: Int[Ints, " N"]) -> int:
        """Add an accessor with the given rows of a vertex accessor of the document, in its data type; return its number."""
        old = document.json["accessors"][number]
        values = document.accessor(number, whole=True)[rows].astype(COMPONENTS[old["componentType"]])
        size = values.shape[1] * values.itemsize
        stride = size + -size % 4  # vertex attributes must be aligned to four bytes
        table = np.zeros((len(values), stride), np.uint8)
        table[:, :size] = np.ascontiguousarray(values).view(np.uint8)
        view = self.add_view(table.tobytes(), VERTICES)
        if stride > size:
            self.json["bufferViews"][view]["byteStride"] = stride
        kept = {key: old[key] for key in ("componentType", "type", "normalized", "min", "max", "name") if key in old}
        return self.add("accessors", kept | {"bufferView": view, "count": len(values)})

    def add_indices(self, faces: Int[Ints, "F 3"], V: int) -> int:
        """Add an accessor for triangles among V vertices; return its number."""
        return self.add_array(faces.astype("<u2" if V < 65_535 else "<u4").reshape(-1), target=INDICES)

    def turn(self, document: Document, rotation: Float[Floats, "3 3"]) -> None:
        """Rotate the scene by a new root node above all others."""
        scene = self._scene(document)
        node = self.add_node("upright", Rotation.from_matrix(rotation).as_quat(), np.zeros(3))
        self.json["nodes"][node]["children"], scene["nodes"] = scene["nodes"], [node]

    def add_sparse(self, values: Float[NDArray[np.float32], "V D"], *, bounds: bool = False) -> int:
        """Like `add_array`, for rows that are mostly zero: only nonzero rows are stored where that takes less space."""
        rows = np.flatnonzero(values.any(axis=1))
        numbers = rows.astype("<u2" if len(values) <= 2**16 else "<u4")
        if numbers.nbytes + values[rows].nbytes + 64 > values.nbytes:  # 64 bytes for two more views
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
        """Return the mesh of a node for editing; it is copied first if other nodes draw it as well."""
        node = self.json["nodes"][number]
        if self._uses[node["mesh"]] > 1:
            self._uses[node["mesh"]] -= 1
            old = node["mesh"]
            node["mesh"] = self.add("meshes", copy.deepcopy(self.json["meshes"][old]))
            gltf_vrm.copy_mesh(self.json, old, node["mesh"])
            self._uses[node["mesh"]] = 1
        mesh: dict[str, Any] = self.json["meshes"][node["mesh"]]
        return mesh

    def add_node(self, name: str, rotation: Float[Floats, " 4"], translation: Float[Floats, " 3"]) -> int:
        """Add a node without a parent; return its number. The rotation is a quaternion x, y, z, w."""
        entry: dict[str, Any] = {"name": name} if name else {}
        if np.any(translation):
            entry["translation"] = translation.tolist()
        if not np.array_equal(rotation, (0, 0, 0, 1)):
            entry["rotation"] = rotation.tolist()
        return self.add("nodes", entry)

    def prune(self, document: Document) -> None:
        """Remove everything that was used in the document but is unused now, and its data."""
        if not prune(self.json, unused(document.json)):
            return
        views = self.json.get("bufferViews", [])
        spans = {(view.get("byteOffset", 0), view["byteLength"]) for view in views}
        if sum(length for _, length in spans) > self._size:  # views overlap
            return
        all_data = b"".join(self._chunks)
        self._chunks, self._size = [], 0
        places: dict[tuple[int, int], int] = {}
        for start, length in sorted(spans):
            shift = start % 4  # keeps the alignment of accessors
            places[start, length] = self._append(bytes(shift) + all_data[start : start + length]) + shift
        for view in views:
            view["byteOffset"] = places[view.get("byteOffset", 0), view["byteLength"]]

    def to_bytes(self) -> bytes:
        """Return the glb; `OutputError` if it exceeds the size limit of a glb."""
        if self._size:
            self.json["buffers"] = [{"byteLength": self._size}]
        return pack_glb(self.name, self.json, self._chunks)


def record_source_mesh(glb: bytes, of: Shape) -> bytes:
    """Record in a glb the mesh it was made from; see `Shape.made_of`.

    The glb is returned unchanged unless its first vertices are those of the mesh, in order, followed only by copies of
    them or by other meshes; its faces are checked for this.
    """
    document = Document(Path("made.glb"), glb)
    faces = document.faces()
    leading = faces[: of.F]
    if len(leading) < of.F or not ((leading == of.faces) | (leading >= of.V)).all():
        return glb
    editor = Editor(document)
    asset = editor.json["asset"]
    record = {"made_of": [of.hash, *of.made_of][:MAX_ORIGINS], "faces": digest(faces)}
    asset["extras"] = (asset["extras"] if isinstance(asset.get("extras"), dict) else {}) | {ORIGINS: record}
    return editor.to_bytes()


def drawn_nodes(document: Document) -> dict[int, dict[int, dict[str, Any]]]:
    """Nodes that draw something, in scene order; for each, the primitives that it draws, by their number in the mesh.

    `InputError` if the scene uses GPU instancing.
    """
    number_of = {id(part): k for mesh in document.json["meshes"] for k, part in enumerate(mesh["primitives"])}
    found: dict[int, dict[int, dict[str, Any]]] = {}
    for number, part, _ in document.primitives():
        if INSTANCES in document.nodes[number].get("extensions", {}):
            message = f"{document.name} draws copies of one mesh ({INSTANCES}), which cannot move apart"
            raise InputError(message, "export each copy as an object of its own")
        found.setdefault(number, {})[number_of[id(part)]] = part
    return found


def vertex_frames(document: Document, number: int, part: dict[str, Any]) -> Float[Floats, "V 3 3"]:
    """Linear maps, at each vertex of a primitive, that take directions to scene coordinates: by its skin or its node."""
    V, matrix = document.count(part["attributes"]["POSITION"]), document.world[number]
    axes = [document.to_scene(number, part, np.tile(axis, (V, 1)), matrix) for axis in np.eye(4)[:3]]
    return np.stack(axes, axis=2)
