"""glTF 2.0, binary (glb) and text (gltf): the triangles and points of a scene, where the scene puts them.

Specification: Khronos glTF 2.0. A skinned mesh stands as its joints stand in the file (sections 3.7.3 and 5.28), so
that it fits whatever hangs from the same joints. Animations and morph targets are ignored; materials and weights are
read by `meshmatch.shapes.formats.gltf_attributes`, files written by `meshmatch.shapes.formats.gltf_out`.
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
from meshmatch.shapes.companions import beside
from meshmatch.shapes.formats import NO_FACES, WRONG_SUFFIX, Raw, check_places, damaged, fan, joined_colors, strips
from meshmatch.shapes.formats.gltf_compressed import COMPONENTS, DRACO, MESHOPT, WIDTHS, decompress
from meshmatch.shapes.input_files import check_text, json_of, read_bytes

COMPRESSED = (DRACO, *MESHOPT)
INSTANCES, _VISIBILITY = "EXT_mesh_gpu_instancing", "KHR_node_visibility"
# What a file may require: extensions that are read, and others that change neither what is drawn nor where.
_KNOWN = ("KHR_mesh_quantization", INSTANCES, _VISIBILITY)
_HARMLESS = re.compile(
    r"[A-Z0-9]+_(?:materials?|textures?|lights?|techniques?|animations?|audio|xmp|node_hover|node_select|interactiv)\w*|"
    r"EXT_(?:structural_metadata|mesh_features|instance_features)|FB_ngon_encoding|MSFT_lod|VRM(?:C_\w+)?"
)
_POINTS, _TRIANGLES, _STRIP, _FAN = 0, 4, 5, 6
SUFFIXES = (".glb", ".gltf", ".vrm", *blender.SUFFIXES)
"""Of files in this format: a vrm is a glb with a character, and Blender turns others into a glb."""
MOST_NODES = 100_000
"""Nodes of a scene, and primitives that it draws: each takes up to 0.1 ms."""
ORIGINS, MOST_ORIGINS = "meshmatch", 16
"""Where a file says what its mesh was made of: in the extras of its asset."""
Found = TypeVar("Found")


def read(path: Path, data: bytes) -> Raw:
    """All triangles and points of the scene, one primitive after the other, parents before children."""
    return understood(path, data, "scene makes", Document.scene)


def digest(faces: Int[Ints, "F 3"]) -> str:
    """16 hexadecimal digits that name these triangles."""
    return hashlib.sha256(np.ascontiguousarray(faces, np.int64).data if len(faces) else b"").hexdigest()[:16]


def understood(path: Path, data: bytes, what: str, reader: Callable[[Document], Found]) -> Found:
    """What a reader makes of a file; `InputError` for what a description that is not as it should be can cause. Numbers
    that are not finite are judged by who asked for them.
    """
    try:
        with np.errstate(all="ignore"):
            return reader(Document(path, data))
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError, OverflowError) as error:
        raise damaged(path.name, f"its {what} no sense: {_in_words(error)}") from error


def _in_words(error: Exception) -> str:
    """What is wrong with a description, of the error that reading it raised."""
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
    """A parsed file; its buffers are read when they are asked for."""

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
            check_text(self.name, data)
            self.json = json_of(self.name, data)
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
        self._bones: dict[int, Floats] = {}  # a thousand meshes may hang from one skin of a thousand joints
        self._mirrors: dict[int, bool] = {}
        self._bound: int | None = None
        if compressed := {each for each in required if each in COMPRESSED}:
            self.buffers |= decompress(self.name, self.size, self.json, self.buffer, compressed)

    def _compressed(self, extension: str) -> InputError:
        return InputError(f"{self.name} is compressed ({extension})", "export it without mesh compression")

    def _chunks(self, data: bytes) -> bytes:
        """The JSON chunk; the binary one is kept in `body`."""
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
        verts: list[Floats] = []
        faces: list[Ints] = [NO_FACES]
        colors: list[Floats | None] = []
        skinned: list[Bools] = []
        meshes: list[tuple[tuple[str, ...], int]] = []
        places = seen = 0
        # One mesh may stand in a scene a thousand times, so that a small file can promise any number.
        for node, primitive, place in self.primitives():
            vertices = self.count(primitive["attributes"]["POSITION"])
            corners = self.count(primitive["indices"]) if "indices" in primitive else vertices
            thirds = 1 if primitive.get("mode", _TRIANGLES) in (_STRIP, _FAN) else 3
            places += vertices + (corners // thirds if primitive.get("mode", _TRIANGLES) != _POINTS else 0)
            check_places(self.name, self.size, places)
            own = self.placed(node, primitive, place)
            triangles = self.drawn_triangles(node, primitive, place)
            if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(own)):
                raise damaged(self.name, f"a face refers to vertex {int(triangles.max())} of {len(own)}")
            faces.append(triangles + seen)
            verts.append(own)
            colors.append(self.colors(primitive))
            meshes.append((self._names(node), len(own)))
            skinned.append(np.full(len(own), "skin" in self.nodes[node] and "JOINTS_0" in primitive["attributes"]))
            seen += len(own)
        self._tell_hidden()
        if not verts:
            raise InputError(f"{self.name} holds no triangles and no points", "is there a mesh in its scene?")
        painted = joined_colors(colors, [len(own) for own in verts])
        if painted is not None:
            painted[:, :3] = to_srgb(painted[:, :3])
        bound = np.concatenate(skinned)
        triangles = np.vstack(faces)
        skin, made_of = bound if bound.any() else None, self.origins(triangles)
        return Raw(np.vstack(verts), triangles, painted, skin, tuple(meshes), made_of)

    def faces(self) -> Int[Ints, "F 3"]:
        """The triangles of `scene`, and nothing else of it."""
        found, seen = [NO_FACES], 0
        for node, primitive, place in self.primitives():
            found.append(self.drawn_triangles(node, primitive, place) + seen)
            seen += self.count(primitive["attributes"]["POSITION"])
        return np.vstack(found)

    def origins(self, faces: Int[Ints, "F 3"]) -> tuple[str, ...]:
        """Hashes of the meshes that this one says it was made of, vertex by vertex, unless its faces are others since."""
        extras = self.json["asset"].get("extras")
        said = extras.get(ORIGINS) if isinstance(extras, dict) else None
        made_of = said.get("made_of") if isinstance(said, dict) else None
        if not isinstance(said, dict) or not isinstance(made_of, list) or said.get("faces") != digest(faces):
            return ()
        return tuple(str(each) for each in made_of[:MOST_ORIGINS])

    def _names(self, number: int) -> tuple[str, ...]:
        """What a node and its mesh are called."""
        node = self.nodes[number]
        found = node.get("name"), self.json["meshes"][node["mesh"]].get("name")
        return tuple(dict.fromkeys(plain_text(name) for name in found if isinstance(name, str) and name))

    def _tell_hidden(self) -> None:
        """Say which meshes are left out because the file hides them."""
        hidden = [node for node in self.world if node in self.hidden and "mesh" in self.nodes[node]]
        if hidden:
            names = ", ".join(dict.fromkeys(next(iter(self._names(node)), f"node {node}") for node in hidden))
            warn(f"{self.name} hides {len(hidden)} of its meshes, which are left out: {names[:200]}")

    def primitives(self) -> Iterator[tuple[int, dict[str, Any], Float[Floats, "4 4"]]]:
        """Node, primitive and where it stands, of all that is drawn but lines, in the order of `scene`."""
        seen = 0
        for node in self._walk():
            if "mesh" not in self.nodes[node] or node in self.hidden:
                continue
            for place in self._places(node):
                seen += 1
                self._check_many(seen)
                for primitive in self.json["meshes"][self.nodes[node]["mesh"]]["primitives"]:
                    seen += 1
                    self._check_many(seen)
                    drawn = primitive.get("mode", _TRIANGLES) in (_POINTS, _TRIANGLES, _STRIP, _FAN)
                    if drawn and "POSITION" in primitive.get("attributes", {}):  # else there is nothing to draw
                        yield node, primitive, place

    def _places(self, number: int) -> Iterator[Float[Floats, "4 4"]]:
        """Where a node's mesh stands: once, or at each of its instances."""
        world = self.world[number]
        given = self.nodes[number].get("extensions", {}).get(INSTANCES, {}).get("attributes", {})
        keys = [key for key in ("TRANSLATION", "ROTATION", "SCALE") if key in given]
        if not keys:
            yield world
            return
        self._check_many(max(self.count(given[key]) for key in keys))
        for rows in zip(*(self.accessor(given[key]) for key in keys), strict=True):
            yield world @ local_matrix({key.lower(): row for key, row in zip(keys, rows, strict=True)})

    def _check_many(self, number: int) -> None:
        if number > MOST_NODES:
            many = f"the scene of {self.name} has over {MOST_NODES} nodes, or parts of meshes"
            raise InputError(many, "join its meshes before it is exported")

    def draws_copies(self) -> bool:
        """Whether a mesh stands in the scene many times, by one node (`INSTANCES`)."""
        return any(INSTANCES in self.nodes[node].get("extensions", {}) for node, _, _ in self.primitives())

    def beyond_triangles(self) -> list[str]:
        """What there is besides the triangles of one mesh and its material, in words."""
        parts = [part for mesh in self.json.get("meshes", []) for part in mesh["primitives"]]
        there = {
            "nodes": len(self.nodes) > 1,
            "materials": len(self.json.get("materials", [])) > 1,
            "normals": any("NORMAL" in part.get("attributes", {}) for part in parts),
            "skins": bool(self.json.get("skins")),
            "clips": bool(self.json.get("animations")),
            "morph targets": any("targets" in part for part in parts),
        }
        return [word for word, known in there.items() if known]

    def roots(self) -> list[int]:
        """The topmost nodes of the scene."""
        scenes = self.json.get("scenes")
        if scenes:
            return list(scenes[self.json.get("scene", 0)].get("nodes", []))
        return sorted(set(range(len(self.nodes))) - {c for n in self.nodes for c in n.get("children", [])})

    def _walk(self) -> list[int]:
        """Node numbers, depth first, parents before children; fills `world`."""
        self.world, self.hidden = {}, set()
        stack = [(node, np.eye(4)) for node in reversed(self.roots())]
        while stack:
            self._check_many(len(self.world))
            node, parent = stack.pop()
            if node in self.world:
                raise damaged(self.name, f"node {node} has two parents")
            self.world[node] = parent @ local_matrix(self.nodes[node])
            shown = self.nodes[node].get("extensions", {}).get(_VISIBILITY, {}).get("visible", True)
            if shown is False or node in self.hidden:
                self.hidden |= {node, *self.nodes[node].get("children", [])}
            stack += [(child, self.world[node]) for child in reversed(self.nodes[node].get("children", []))]
        return list(self.world)

    def placed(self, number: int, primitive: dict[str, Any], place: Floats) -> Floats:
        """(V, 3) positions in the scene."""
        for extension in primitive.get("extensions", {}):  # there may be plain data as well
            if not _HARMLESS.fullmatch(extension) and not self._has_data(primitive["attributes"]["POSITION"]):
                raise self._compressed(extension)
        positions = self.accessor(primitive["attributes"]["POSITION"])
        return self.moved(number, primitive, np.hstack([positions, np.ones((len(positions), 1))]), place)

    def moved(
        self, number: int, primitive: dict[str, Any], own: Float[Floats, "V 4"], place: Float[Floats, "4 4"]
    ) -> Float[Floats, "V 3"]:
        """What belongs to the vertices of a primitive, in the scene: positions (fourth number 1) or directions (0), moved by
        the skin of its node, or else by `place`.
        """
        node = self.nodes[number]
        hanging = np.asarray(own @ place.T)[:, :3]
        if "skin" not in node or "JOINTS_0" not in primitive["attributes"]:
            return hanging
        bones = self.bones(node["skin"])
        moved, total = np.zeros((len(own), 4)), np.zeros((len(own), 1))
        for joints, weights in self.influences(primitive):
            for column in range(4):
                weight = weights[:, column : column + 1]
                moved += weight * np.einsum("vij,vj->vi", bones[joints[:, column].astype(np.int64)], own)
                total += weight
        return np.where(total > 0, moved[:, :3] / np.where(total > 0, total, 1.0), hanging)

    def bones(self, number: int) -> Floats:
        """(J, 4, 4) where the joints of a skin put what hangs from each."""
        if number not in self._bones:
            skin = self.json["skins"][number]
            bones = np.stack([self.world[joint] for joint in skin["joints"]])
            if "inverseBindMatrices" in skin:
                inverse = self.accessor(skin["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
                bones = bones @ inverse[: len(bones)]
            self._bones[number] = bones
        return self._bones[number]

    def influences(self, primitive: dict[str, Any]) -> Iterator[tuple[Float[Floats, "V 4"], Float[Floats, "V 4"]]]:
        """Numbers of joints and their weights for each vertex, four at a time."""
        attributes = primitive["attributes"]
        for k in range(8):
            if f"JOINTS_{k}" not in attributes:
                return
            numbers = self.accessor(attributes[f"JOINTS_{k}"], whole=True)
            yield numbers, self.accessor(attributes[f"WEIGHTS_{k}"])

    def mirrors(self, number: int, primitive: dict[str, Any], place: Floats) -> bool:
        """Whether a node, or most joints of its skin, draws a primitive as in a mirror: its triangles turn over (3.7.4)."""
        skin = self.nodes[number].get("skin")
        if skin is None or "JOINTS_0" not in primitive["attributes"]:
            return bool(np.linalg.det(place[:3, :3]) < 0)
        if skin not in self._mirrors:
            self._mirrors[skin] = bool((np.linalg.det(self.bones(skin)[:, :3, :3]) < 0).mean() > 0.5)
        return self._mirrors[skin]

    def drawn_triangles(self, number: int, primitive: dict[str, Any], place: Floats) -> Int[Ints, "F 3"]:
        """The triangles of a primitive, counterclockwise from outside in the scene."""
        found = self.triangles(primitive)
        return found[:, ::-1] if self.mirrors(number, primitive, place) else found

    def triangles(self, primitive: dict[str, Any]) -> Int[Ints, "F 3"]:
        """Those of a primitive as the file has them."""
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
        """(V, 4) light and alpha of a primitive's vertices: `COLOR_0` is linear (section 3.9.2)."""
        if "COLOR_0" not in primitive["attributes"]:
            return None
        values = self.accessor(primitive["attributes"]["COLOR_0"])
        out = np.ones((len(values), 4))
        out[:, : values.shape[1]] = np.clip(np.nan_to_num(values), 0.0, 1.0)
        return out

    def _has_data(self, number: int) -> bool:
        return any(key in self.json["accessors"][number] for key in ("bufferView", "sparse"))

    def count(self, number: int) -> int:
        """How many values an accessor has."""
        return int(self.json["accessors"][number]["count"])

    def accessor(self, number: int, whole: bool = False) -> Float[Floats, "count width"]:
        """(count, width) values; whole numbers that stand for 0..1 or -1..1 are divided unless `whole`."""
        accessor = self.json["accessors"][number]
        count, width = int(accessor["count"]), WIDTHS[accessor["type"]]
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        if "bufferView" in accessor:
            values = self._view(accessor, count, width, kind)
        else:  # zeros, then filled sparsely
            if self._bound is None:
                held = [k for k in range(len(self.json.get("buffers", []))) if self._held(k)]
                self._bound = sum(len(self.buffer(k)) for k in held)
            if not 0 <= count <= max(self._bound, 1):
                raise damaged(self.name, f"it promises {count} values that it does not hold")
            values = np.zeros((count, width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            where, many = sparse["indices"], int(sparse["count"])
            rows = self._view(where, many, 1, np.dtype(COMPONENTS[where["componentType"]]))
            values = values.copy()
            values[rows[:, 0]] = self._view(sparse["values"], many, width, kind)
        out = values.astype(np.float64)
        if accessor.get("normalized") and not whole and kind.kind in "iu":
            out = np.maximum(out / np.iinfo(kind).max, -1.0)
        return out

    def _view(self, entry: dict[str, Any], count: int, width: int, kind: np.dtype[Any]) -> NDArray[Any]:
        """(count, width) values from the place in a buffer view that an entry names."""
        view, offset = self.json["bufferViews"][entry["bufferView"]], entry.get("byteOffset", 0)
        for extension in COMPRESSED:
            if extension in view.get("extensions", {}) and not self._held(view["buffer"]):
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
        """All bytes of a buffer view, as an image has them."""
        size = int(self.json["bufferViews"][number]["byteLength"])
        return self._view({"bufferView": number}, size, 1, np.dtype("u1")).tobytes()

    def _held(self, number: int) -> bool:
        """Whether the data of a buffer is anywhere: that of plain data beside compressed need not be."""
        buffer = self.json["buffers"][number]
        fallback = any(buffer.get("extensions", {}).get(each, {}).get("fallback") for each in COMPRESSED)
        return "uri" in buffer or (number == 0 and bool(self.body) and not fallback)

    def buffer(self, number: int) -> bytes:
        """The data of a buffer; `InputError` where it is missing."""
        if number not in self.buffers:
            uri = self.json["buffers"][number].get("uri")
            if uri is None and number:
                raise damaged(self.name, f"its buffer {number} has no data")
            self.buffers[number] = self.body if uri is None else self.resource(uri)
            self.size += 0 if uri is None or embedded(uri) else len(self.buffers[number])
        return self.buffers[number]

    def resource(self, uri: str) -> bytes:
        """What a URI names: data within it, or a file in the folder of this one."""
        if embedded(uri):
            try:
                return _data_of(uri)
            except (binascii.Error, ValueError) as error:
                raise damaged(self.name, "its embedded data is not base64") from error
        file = beside(self.path.parent, uri, uri=True)
        if file is None:
            missing = f"{self.name} needs the file {uri[:200]}, which is not in its folder"
            raise InputError(missing, "copy it beside the gltf")
        return read_bytes(file)


def embedded(uri: str) -> bool:
    """Whether a URI holds its data itself."""
    return uri[:5].lower() == "data:"


def _data_of(uri: str) -> bytes:
    """The data of a URI: base64, also without padding and in the alphabet of URLs, or else plain bytes."""
    kind, comma, text = uri[5:].partition(",")
    if not comma:
        raise ValueError("it has no comma")
    data = unquote_to_bytes(text)
    if not kind.lower().rstrip().endswith("base64"):
        return data
    data = b"".join(data.translate(bytes.maketrans(b"-_", b"+/")).split()).rstrip(b"=")
    return base64.b64decode(data + b"=" * (-len(data) % 4), validate=True)


def local_matrix(node: dict[str, Any]) -> Floats:
    """(4, 4) matrix of a node: given by columns, or translation, rotation (x y z w) and scale."""
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
