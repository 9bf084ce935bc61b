"""glTF 2.0, binary (glb) and text (gltf): read the triangles and points of a scene in scene coordinates.

Specification: Khronos glTF 2.0. A skinned mesh is posed by its joints as the file places them (sections 3.7.3 and 5.28),
so that it fits other objects attached to the same joints. Animations and morph targets are ignored;
`meshmatch.shapes.formats.gltf_attributes` reads materials and weights, `meshmatch.shapes.formats.gltf_write` writes files.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from meshmatch import blender
from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.errors import InputError, warn
from meshmatch.outputs import plain_text
from meshmatch.shapes.colors import to_srgb
from meshmatch.shapes.companions import find_companion
from meshmatch.shapes.formats import (
    COORDINATES,
    NO_FACES,
    WRONG_SUFFIX,
    Raw,
    check_element_count,
    concatenate_colors,
    damaged,
    fan,
    strips,
)
from meshmatch.shapes.formats.gltf_compressed import COMPONENTS, DRACO, MESHOPT, WIDTHS, decompress
from meshmatch.shapes.input_files import check_text_size, parse_json, read_bytes

COMPRESSED = (DRACO, *MESHOPT)
INSTANCES, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
# Extensions that a file may require: those that are read, and those that affect neither geometry nor base color.
_KNOWN = ("KHR_mesh_quantization", INSTANCES, _VISIBILITY)
_HARMLESS = re.compile(
    r"[A-Z0-9]+_(?:materials?|textures?|lights?|techniques?|animations?|audio|xmp|node_hover|node_select|interactiv)\w*|"
    r"EXT_(?:structural_metadata|mesh_features|instance_features)|FB_ngon_encoding|MSFT_lod|VRM(?:C_\w+)?"
)
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
SUFFIXES = (".glb", ".gltf", ".vrm", *blender.SUFFIXES)
"""Suffixes of files in this format: a vrm is a glb with a character, and Blender converts other formats to glb."""
MAX_NODES = 100_000
"""Maximum number of nodes of a scene, and of mesh instances plus primitives that it draws: each takes up to 0.1 ms."""
ORIGINS, MAX_ORIGINS = "meshmatch", 16
"""Key in the extras of the asset under which a file records the hashes of its source meshes, and their maximum number."""
T = TypeVar("T")


def read(path: Path, data: bytes) -> Raw:
    """Read all triangles and points of the scene, one primitive after the other, parent nodes before their children."""
    return parse_document(path, data, "scene makes", Document.scene)


def digest(faces: Int[Ints, "F 3"]) -> str:
    """Hash triangles to 16 hexadecimal digits."""
    return hashlib.sha256(np.ascontiguousarray(faces, np.int64).data if len(faces) else b"").hexdigest()[:16]


def parse_document(path: Path, data: bytes, what: str, reader: Callable[[Document], T]) -> T:
    """Parse a file and return what `reader` extracts from it; a malformed JSON description raises `InputError`.

    `what` begins the error message, such as "scene makes". Checking values for NaN and inf is left to the caller.
    """
    try:
        with np.errstate(all="ignore"):
            return reader(Document(path, data))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
        raise damaged(path.name, f"its {what} no sense: {_describe_error(error)}") from error


def _describe_error(error: Exception) -> str:
    """Describe the defect of a file, given the exception that reading its JSON description raised."""
    if isinstance(error, KeyError):
        return f"{error} is missing"
    if isinstance(error, IndexError):
        return "a number in it refers to nothing that the file has"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, ValueError) and str(error):
        return str(error)
    return "a value in it is of the wrong kind"


class Document:
    """A parsed glTF file; buffers are read on demand."""

    def __init__(self, path: Path, data: bytes) -> None:
        self.path, self.name = path, path.name
        self.body, self.size = b"", len(data)
        if data[:4] == b"glTF":
            data = self._chunks(data)
        elif path.suffix.lower() != ".gltf":
            raise InputError(
                f"{self.name} is not a {path.suffix[1:].lower()} file: it does not begin with 'glTF'",
                "does the suffix fit?",
            )
        try:
            check_text_size(self.name, data)
            self.json = parse_json(self.name, data)
        except ValueError as error:
            raise damaged(self.name, "its description is not JSON") from error
        if not isinstance(self.json, dict) or "asset" not in self.json:
            raise InputError(f"{self.name} is not a glTF file", WRONG_SUFFIX)
        if str(self.json["asset"].get("version", "")).split(".")[0] != "2":
            raise InputError(f"{self.name} is not glTF version 2", "export it as glTF 2.0")
        required = self.json.get("extensionsRequired", [])
        for extension in required:
            if extension not in (*_KNOWN, *COMPRESSED) and not _HARMLESS.fullmatch(extension):
                unknown = f"{self.name} requires the glTF extension {extension[:80]}, which meshmatch does not read"
                raise InputError(unknown, "export it as plain glTF 2.0")
        self.nodes = self.json.get("nodes", [])
        self.buffers: dict[int, bytes] = {}
        self.world: dict[int, Floats] = {}
        self.hidden: set[int] = set()
        self._skinning_matrices: dict[
            int, Floats
        ] = {}  # cached: a thousand meshes may share one skin of a thousand joints
        self._is_mirrored: dict[int, bool] = {}
        self._sparse_limit: int | None = None
        if compressed := {each for each in required if each in COMPRESSED}:
            self.buffers |= decompress(self.name, self.size, self.json, self.buffer, compressed)

    def _compressed(self, extension: str) -> InputError:
        return InputError(f"{self.name} is compressed ({extension})", "export it without mesh compression")

    def _chunks(self, data: bytes) -> bytes:
        """Return the JSON chunk of a glb; the binary chunk is stored in `body`."""
        version, length, size = np.frombuffer(data[4:16].ljust(12, b"\0"), "<u4").tolist()
        if version != 2:
            raise InputError(f"{self.name} is glb version {version}", "export it as glTF 2.0")
        if length > len(data) or 20 + size > len(data):
            raise damaged(self.name, f"it should be {max(length, 20 + size)} bytes long, but is only {len(data)}")
        rest = data[20 + size :]
        if rest[4:8] == b"BIN\0":
            self.body = rest[8 : 8 + int.from_bytes(rest[:4], "little")]
        return data[20 : 20 + size]

    def scene(self) -> Raw:
        """Read the whole scene: geometry, colors, skinned vertices and mesh names."""
        verts: list[Floats] = []
        faces: list[Ints] = [NO_FACES]
        colors: list[Floats | None] = []
        skinned: list[Bools] = []
        meshes: list[tuple[tuple[str, ...], int]] = []
        n_elements = n_verts = 0
        # A scene may instance one mesh a thousand times, so that a small file can declare any number of vertices.
        for node, primitive, matrix in self.primitives():
            vertices = self.count(primitive["attributes"]["POSITION"])
            corners = self.count(primitive["indices"]) if "indices" in primitive else vertices
            thirds = 1 if primitive.get("mode", _TRIANGLES) in (_STRIP, _FAN) else 3
            n_elements += vertices + (corners // thirds if primitive.get("mode", _TRIANGLES) != _POINTS else 0)
            check_element_count(self.name, self.size, n_elements)
            positions = self.scene_positions(node, primitive, matrix)
            triangles = self.drawn_triangles(node, primitive, matrix)
            if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(positions)):
                raise damaged(self.name, f"a face refers to vertex {int(triangles.max())} of {len(positions)}")
            faces.append(triangles + n_verts)
            verts.append(positions)
            colors.append(self.colors(primitive))
            meshes.append((self._names(node), len(positions)))
            skinned.append(
                np.full(len(positions), "skin" in self.nodes[node] and "JOINTS_0" in primitive["attributes"])
            )
            n_verts += len(positions)
        self._warn_of_hidden()
        if not verts:
            raise InputError(f"{self.name} holds no triangles and no points", "is there a mesh in its scene?")
        painted = concatenate_colors(colors, [len(positions) for positions in verts])
        if painted is not None:
            painted[:, :3] = to_srgb(painted[:, :3])
        is_skinned = np.concatenate(skinned)
        triangles = np.vstack(faces)
        skin, made_of = is_skinned if is_skinned.any() else None, self.source_hashes(triangles)
        return Raw(np.vstack(verts), triangles, painted, skin, tuple(meshes), made_of)

    def faces(self) -> Int[Ints, "F 3"]:
        """Read only the triangles of `scene`."""
        found, n_verts = [NO_FACES], 0
        for node, primitive, matrix in self.primitives():
            found.append(self.drawn_triangles(node, primitive, matrix) + n_verts)
            n_verts += self.count(primitive["attributes"]["POSITION"])
        return np.vstack(found)

    def source_hashes(self, faces: Int[Ints, "F 3"]) -> tuple[str, ...]:
        """Hashes of the meshes that this file records as its vertex-by-vertex sources.

        Empty if there are none, or if the faces have changed since the record was written.
        """
        extras = self.json["asset"].get("extras")
        record = extras.get(ORIGINS) if isinstance(extras, dict) else None
        made_of = record.get("made_of") if isinstance(record, dict) else None
        if not isinstance(record, dict) or not isinstance(made_of, list) or record.get("faces") != digest(faces):
            return ()
        return tuple(str(each) for each in made_of[:MAX_ORIGINS])

    def _names(self, number: int) -> tuple[str, ...]:
        """Names of a node and of its mesh, without duplicates and empty ones."""
        node = self.nodes[number]
        found = node.get("name"), self.json["meshes"][node["mesh"]].get("name")
        return tuple(dict.fromkeys(plain_text(name) for name in found if isinstance(name, str) and name))

    def _warn_of_hidden(self) -> None:
        """Warn about meshes that are skipped because the file marks them as invisible."""
        hidden = [node for node in self.world if node in self.hidden and "mesh" in self.nodes[node]]
        if hidden:
            names = ", ".join(dict.fromkeys(next(iter(self._names(node)), f"node {node}") for node in hidden))
            warn(f"{self.name} hides {len(hidden)} of its meshes, which are left out: {names[:200]}")

    def primitives(self) -> Iterator[tuple[int, dict[str, Any], Float[Floats, "4 4"]]]:
        """Yield (node number, primitive, (4, 4) matrix to the scene) of all that is drawn except lines, in scene order."""
        n_drawn = 0
        for node in self._walk():
            if "mesh" not in self.nodes[node] or node in self.hidden:
                continue
            for matrix in self._instance_matrices(node):
                n_drawn += 1
                self._check_node_count(n_drawn)
                for primitive in self.json["meshes"][self.nodes[node]["mesh"]]["primitives"]:
                    n_drawn += 1
                    self._check_node_count(n_drawn)
                    is_drawn = primitive.get("mode", _TRIANGLES) in (_POINTS, _TRIANGLES, _STRIP, _FAN)
                    if is_drawn and "POSITION" in primitive.get("attributes", {}):  # without positions nothing is drawn
                        yield node, primitive, matrix

    def _instance_matrices(self, number: int) -> Iterator[Float[Floats, "4 4"]]:
        """Yield the (4, 4) matrices to the scene of a node's mesh: one, or one per GPU instance."""
        world = self.world[number]
        attributes = self.nodes[number].get("extensions", {}).get(INSTANCES, {}).get("attributes", {})
        keys = [key for key in ("TRANSLATION", "ROTATION", "SCALE") if key in attributes]
        if not keys:
            yield world
            return
        self._check_node_count(max(self.count(attributes[key]) for key in keys))
        for rows in zip(*(self.accessor(attributes[key]) for key in keys), strict=True):
            yield world @ local_matrix({key.lower(): row for key, row in zip(keys, rows, strict=True)})

    def _check_node_count(self, number: int) -> None:
        if number > MAX_NODES:
            message = f"the scene of {self.name} has over {MAX_NODES} nodes, or parts of meshes"
            raise InputError(message, "join its meshes before it is exported")

    def uses_instancing(self) -> bool:
        """Whether any node draws several instances of its mesh (`INSTANCES`)."""
        return any(INSTANCES in self.nodes[node].get("extensions", {}) for node, _, _ in self.primitives())

    def content_beyond_triangles(self) -> list[str]:
        """Kinds of content besides the triangles of one mesh with one material, in words ("normals", "skins", ...)."""
        parts = [part for mesh in self.json.get("meshes", []) for part in mesh["primitives"]]
        present = {
            "nodes": len(self.nodes) > 1,
            "materials": len(self.json.get("materials", [])) > 1,
            COORDINATES: any("TEXCOORD_0" in part.get("attributes", {}) for part in parts),
            "normals": any("NORMAL" in part.get("attributes", {}) for part in parts),
            "skins": bool(self.json.get("skins")),
            "clips": bool(self.json.get("animations")),
            "morph targets": any("targets" in part for part in parts),
        }
        return [word for word, is_present in present.items() if is_present]

    def roots(self) -> list[int]:
        """Numbers of the root nodes of the scene."""
        scenes = self.json.get("scenes")
        if scenes:
            return list(scenes[self.json.get("scene", 0)].get("nodes", []))
        return sorted(set(range(len(self.nodes))) - {c for n in self.nodes for c in n.get("children", [])})

    def _walk(self) -> list[int]:
        """Return all node numbers depth first, parents before children; fills `world` and `hidden`."""
        self.world, self.hidden = {}, set()
        stack = [(node, np.eye(4)) for node in reversed(self.roots())]
        while stack:
            self._check_node_count(len(self.world))
            node, parent = stack.pop()
            if node in self.world:
                raise damaged(self.name, f"node {node} has two parents")
            self.world[node] = parent @ local_matrix(self.nodes[node])
            shown = self.nodes[node].get("extensions", {}).get(_VISIBILITY, {}).get("visible", True)
            if shown is False or node in self.hidden:
                self.hidden |= {node, *self.nodes[node].get("children", [])}
            stack += [(child, self.world[node]) for child in reversed(self.nodes[node].get("children", []))]
        return list(self.world)

    def scene_positions(self, number: int, primitive: dict[str, Any], matrix: Floats) -> Floats:
        """(V, 3) positions of a primitive's vertices in scene coordinates; `matrix` is that of its node or instance."""
        for extension in primitive.get("extensions", {}):  # uncompressed data may be present as well
            if not _HARMLESS.fullmatch(extension) and not self._has_data(primitive["attributes"]["POSITION"]):
                raise self._compressed(extension)
        positions = self.accessor(primitive["attributes"]["POSITION"])
        return self.to_scene(number, primitive, np.hstack([positions, np.ones((len(positions), 1))]), matrix)

    def to_scene(
        self, number: int, primitive: dict[str, Any], vectors: Float[Floats, "V 4"], matrix: Float[Floats, "4 4"]
    ) -> Float[Floats, "V 3"]:
        """Transform per-vertex vectors of a primitive to scene coordinates.

        `vectors` are homogeneous: positions (fourth component 1) or directions (0). They are moved by the skin of the
        node (linear blend skinning), or by `matrix` where there is no skin or the weights are all 0.
        """
        node = self.nodes[number]
        unskinned = np.asarray(vectors @ matrix.T)[:, :3]
        if "skin" not in node or "JOINTS_0" not in primitive["attributes"]:
            return unskinned
        matrices = self.skinning_matrices(node["skin"])
        blended, total = np.zeros((len(vectors), 4)), np.zeros((len(vectors), 1))
        for joints, weights in self.influences(primitive):
            for column in range(4):
                weight = weights[:, column : column + 1]
                blended += weight * np.einsum("vij,vj->vi", matrices[joints[:, column].astype(np.int64)], vectors)
                total += weight
        return np.where(total > 0, blended[:, :3] / np.where(total > 0, total, 1.0), unskinned)

    def skinning_matrices(self, number: int) -> Floats:
        """(J, 4, 4) skinning matrices of a skin: joint world matrix times inverse bind matrix."""
        if number not in self._skinning_matrices:
            skin = self.json["skins"][number]
            matrices = np.stack([self.world[joint] for joint in skin["joints"]])
            if "inverseBindMatrices" in skin:
                inverse = self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
                if len(inverse) < len(matrices):  # a single one would be broadcast
                    raise ValueError(f"skin {number} has fewer inverse bind matrices than joints")
                matrices = matrices @ inverse[: len(matrices)]
            self._skinning_matrices[number] = matrices
        return self._skinning_matrices[number]

    def influences(self, primitive: dict[str, Any]) -> Iterator[tuple[Float[Floats, "V 4"], Float[Floats, "V 4"]]]:
        """Yield joint numbers (indices into the skin's joints) and their weights per vertex, four at a time."""
        attributes = primitive["attributes"]
        for k in range(8):
            if f"JOINTS_{k}" not in attributes:
                return
            numbers = self.accessor(attributes[f"JOINTS_{k}"], whole=True)
            yield numbers, self.accessor(attributes[f"WEIGHTS_{k}"])

    def is_mirrored(self, number: int, primitive: dict[str, Any], matrix: Floats) -> bool:
        """Whether the node, or most joints of its skin, mirrors a primitive, which flips its triangles (section 3.7.4)."""
        skin = self.nodes[number].get("skin")
        if skin is None or "JOINTS_0" not in primitive["attributes"]:
            return bool(np.linalg.det(matrix[:3, :3]) < 0)
        if skin not in self._is_mirrored:
            self._is_mirrored[skin] = bool((np.linalg.det(self.skinning_matrices(skin)[:, :3, :3]) < 0).mean() > 0.5)
        return self._is_mirrored[skin]

    def drawn_triangles(self, number: int, primitive: dict[str, Any], matrix: Floats) -> Int[Ints, "F 3"]:
        """Triangles of a primitive, counterclockwise seen from outside in scene coordinates."""
        found = self.triangles(primitive)
        return found[:, ::-1] if self.is_mirrored(number, primitive, matrix) else found

    def triangles(self, primitive: dict[str, Any]) -> Int[Ints, "F 3"]:
        """Triangles of a primitive, oriented as in the file."""
        mode = primitive.get("mode", _TRIANGLES)
        if mode == _POINTS:
            return NO_FACES
        if "indices" in primitive:
            corners = self.accessor(primitive["indices"], whole=True).astype(np.int64).ravel()
        else:
            corners = np.arange(self.count(primitive["attributes"]["POSITION"]))
        if mode == _TRIANGLES:
            return corners[: len(corners) // 3 * 3].reshape(-1, 3)
        return (fan if mode == _FAN else strips)(corners, np.array([len(corners)]))

    def colors(self, primitive: dict[str, Any]) -> Float[Floats, "V 4"] | None:
        """(V, 4) linear RGB and alpha of a primitive's vertices (`COLOR_0`, section 3.9.2); None if there are none."""
        if "COLOR_0" not in primitive["attributes"]:
            return None
        values = self.accessor(primitive["attributes"]["COLOR_0"])
        out = np.ones((len(values), 4))
        out[:, : values.shape[1]] = np.clip(np.nan_to_num(values), 0.0, 1.0)
        return out

    def _has_data(self, number: int) -> bool:
        return any(key in self.json["accessors"][number] for key in ("bufferView", "sparse"))

    def count(self, number: int) -> int:
        """Number of elements of an accessor."""
        return int(self.json["accessors"][number]["count"])

    def accessor(self, number: int, whole: bool = False) -> Float[Floats, "count width"]:
        """(count, width) values of an accessor; normalised integers are scaled to 0..1 or -1..1 unless `whole`."""
        accessor = self.json["accessors"][number]
        count, width = int(accessor["count"]), WIDTHS[accessor["type"]]
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        if "bufferView" in accessor:
            values = self._view(accessor, count, width, kind)
        else:  # a sparse accessor without base values starts from zeros
            if self._sparse_limit is None:
                with_data = [k for k in range(len(self.json.get("buffers", []))) if self._has_buffer(k)]
                self._sparse_limit = sum(len(self.buffer(k)) for k in with_data)
            if not 0 <= count <= max(self._sparse_limit, 1):
                raise damaged(self.name, f"it promises {count} values that it does not hold")
            values = np.zeros((count, width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, n_sparse = sparse["indices"], int(sparse["count"])
            rows = self._view(where, n_sparse, 1, np.dtype(COMPONENTS[where["componentType"]]))
            values = values.copy()
            values[rows[:, 0]] = self._view(sparse["values"], n_sparse, width, kind)
        out = values.astype(np.float64)
        if accessor.get("normalized") and not whole and kind.kind in "iu":
            out = np.maximum(out / np.iinfo(kind).max, -1.0)
        return out

    def _view(self, entry: dict[str, Any], count: int, width: int, kind: np.dtype[Any]) -> NDArray[Any]:
        """(count, width) values at the buffer view and byte offset that an accessor entry refers to."""
        view, offset = self.json["bufferViews"][entry["bufferView"]], entry.get("byteOffset", 0)
        for extension in COMPRESSED:
            if extension in view.get("extensions", {}) and not self._has_buffer(view["buffer"]):
                raise self._compressed(extension)
        data = self.buffer(view["buffer"])
        start = view.get("byteOffset", 0) + offset
        row = width * kind.itemsize
        stride = view.get("byteStride", 0) or row
        end = start + stride * (count - 1) + row if count else start
        if min(start, count, offset) < 0 or stride < row or end > len(data):
            raise damaged(self.name, f"it needs {end} bytes of data, but holds {len(data)}")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def view_bytes(self, number: int) -> bytes:
        """All bytes of a buffer view, such as an encoded image."""
        size = int(self.json["bufferViews"][number]["byteLength"])
        return self._view({"bufferView": number}, size, 1, np.dtype("u1")).tobytes()

    def _has_buffer(self, number: int) -> bool:
        """Whether a buffer has data: the fallback buffer of a compressed file may have none."""
        buffer = self.json["buffers"][number]
        fallback = any(buffer.get("extensions", {}).get(each, {}).get("fallback") for each in COMPRESSED)
        return "uri" in buffer or (number == 0 and bool(self.body) and not fallback)

    def buffer(self, number: int) -> bytes:
        """Return the data of a buffer; `InputError` if it is missing."""
        if number not in self.buffers:
            uri = self.json["buffers"][number].get("uri")
            if uri is None and number:
                raise damaged(self.name, f"its buffer {number} has no data")
            self.buffers[number] = self.body if uri is None else self.resource(uri)
            self.size += 0 if uri is None or is_embedded(uri) else len(self.buffers[number])
        return self.buffers[number]

    def resource(self, uri: str) -> bytes:
        """Return the bytes of a URI: embedded data, or a file in the folder of the glTF file."""
        if is_embedded(uri):
            try:
                return _decode_data_uri(uri)
            except (binascii.Error, ValueError) as error:
                raise damaged(self.name, "its embedded data is not base64") from error
        file = find_companion(self.path.parent, uri, uri=True)
        if file is None:
            missing = f"{self.name} needs the file {uri[:200]}, which is not in its folder"
            raise InputError(missing, "copy it to the folder of the gltf")
        return read_bytes(file)


def is_embedded(uri: str) -> bool:
    """Whether a URI embeds its data (`data:`)."""
    return uri[:5].lower() == "data:"


def _decode_data_uri(uri: str) -> bytes:
    """Decode a data URI: base64 (padding optional, standard or URL-safe alphabet), or percent-encoded bytes."""
    kind, comma, text = uri[5:].partition(",")
    if not comma:
        raise ValueError("it has no comma")
    data = unquote_to_bytes(text)
    if not kind.lower().rstrip().endswith("base64"):
        return data
    data = b"".join(data.translate(bytes.maketrans(b"-_", b"+/")).split()).rstrip(b"=")
    return base64.b64decode(data + b"=" * (-len(data) % 4), validate=True)


def local_matrix(node: dict[str, Any]) -> Floats:
    """(4, 4) local matrix of a node: its column-major `matrix`, or its translation, rotation (x y z w) and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), np.float64)
    norm = x * x + y * y + z * z + w * w
    s = 2.0 / norm if norm > 0 else 0.0
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
