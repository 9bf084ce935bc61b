"""Read Meta's Momentum Human Rig (MHR, Apache-2.0): bodies whose shapes were learned from scans.

Two files of its release are read: ``lod3.fbx`` (mesh, blend shapes, skeleton, skin weights; binary FBX) and
``compact_v6_1.model`` (how parameters move joints, and their limits; text). Frame: y up, facing +z, the left hand at +x. The
files are in centimetres, everything here in metres.
"""

from __future__ import annotations

import re
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import interpolate

MESH, PARAMETERS = "lod3.fbx", "compact_v6_1.model"
_MAX_BYTES = 256 << 20  # size of a file, and total size of its arrays
_MAX_DEPTH = 16  # nesting of nodes
_SCALARS = {"Y": "<h", "C": "<?", "I": "<i", "F": "<f", "D": "<d", "L": "<q"}
_ARRAYS = {"f": "<f4", "d": "<f8", "i": "<i4", "l": "<i8", "b": "?"}
_CHANNELS = {"tx": 0, "ty": 1, "tz": 2, "sc": 3}
_TERM = re.compile(r"\s*([-+]?[0-9.]+(?:e[-+]?\d+)?)\s*\*\s*(\w+)\s*")
_LIMIT = re.compile(r"limit\s+(\w+)\s+minmax\s+\[\s*([-+0-9.e]+)\s*,\s*([-+0-9.e]+)\s*\]")


class Node(NamedTuple):
    """A node of an FBX file; its properties are numbers, bytes or arrays."""

    name: str
    properties: list[Any]
    children: list[Node]

    def all(self, name: str) -> list[Node]:
        return [child for child in self.children if child.name == name]

    def value(self, name: str) -> Any:
        """First property of the first child with this name; `LookupError` if there is none."""
        return self.all(name)[0].properties[0]

    @property
    def label(self) -> str:
        """Name of an object."""
        return str(self.properties[1].split(b"\0")[0].decode())


@dataclass(frozen=True, eq=False)
class MomentumRig:
    """A body in its rest pose, in metres, with blend shapes, skeleton and skin weights.

    ``shapes`` are offsets of the vertices: 20 of the body, 20 of the head, 5 of the hands, then expressions. ``shifts`` and
    ``turns`` are the translation and rotation of each joint relative to its parent. ``scales`` are the effects of the
    parameters of bone lengths on each joint: a translation (metres) and an exponent of two of its scale. ``limits`` are the
    least and largest values of the parameters.
    """

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    shapes: Float[Floats, "S V 3"]
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    shifts: Float[Floats, "J 3"]
    turns: Float[Floats, "J 3 3"]
    weights: Float[Floats, "V J"]
    parameters: tuple[str, ...]
    scales: Float[Floats, "P J 4"]
    limits: Float[Floats, "P 2"]

    def frames(
        self, values: Float[Floats, "B P"], bent: Float[Floats, " J"] | None = None
    ) -> tuple[Float[Floats, "B J 3 3"], Float[Floats, "B J 3"]]:
        """Axes (including scale) and positions of the joints for parameters of bone lengths.

        The bodies are at rest, or have joints ``bent`` about their own z, as fingers bend (radians).
        """
        turns = self.turns
        if bent is not None:
            turns = turns @ np.stack([rotation_from_euler(np.array([0.0, 0.0, angle])) for angle in bent])
        change = np.einsum("bp,pjc->bjc", values, self.scales)
        axes, places = np.empty((*change.shape[:2], 3, 3)), np.empty((*change.shape[:2], 3))
        for joint, parent in enumerate(self.parents):
            shift = self.shifts[joint] + change[:, joint, :3]
            axes_in_parent = turns[joint] * np.exp2(change[:, joint, 3])[:, None, None]
            if parent < 0:
                axes[:, joint], places[:, joint] = axes_in_parent, shift
            else:
                axes[:, joint] = axes[:, parent] @ axes_in_parent
                places[:, joint] = np.einsum("bij,bj->bi", axes[:, parent], shift) + places[:, parent]
        return axes, places


@dataclass(frozen=True, eq=False)
class Scanned:
    """Bodies with shapes learned from scans, as a share of generated people, on the T vertices of a template.

    Each template vertex lies in the rig's triangle ``corners``, with barycentric ``weights``.
    """

    rig: MomentumRig
    corners: Int[Ints, "T 3"]
    weights: Float[Floats, "T 3"]
    share: float = 0.5

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise OptionError(f"a share must be from 0 to 1, not {self.share:g}")

    def place(self, values: Float[Floats, "V D"]) -> Float[Floats, "T D"]:
        """Interpolate values of the rig's vertices to those of the template."""
        return interpolate(values, self.corners, self.weights)


def read_momentum_rig(folder: str | Path) -> MomentumRig:
    """Read a Momentum rig from its two files.

    Parameters
    ----------
    folder
        Folder with ``lod3.fbx`` and ``compact_v6_1.model``.

    Returns
    -------
    MomentumRig
        The rig, in metres.

    Raises
    ------
    InputError
        A file is missing or has other contents.
    """
    folder = Path(folder)
    hint = "the folder needs lod3.fbx and compact_v6_1.model of a release of github.com/facebookresearch/MHR"
    raw = []
    for name in (MESH, PARAMETERS):
        try:
            if (folder / name).stat().st_size > _MAX_BYTES:
                raise InputError(f"{folder / name} is too large", hint)
            raw.append((folder / name).read_bytes())
        except OSError as error:
            raise InputError(f"{folder / name} cannot be read: {error.strerror}", hint) from error
    try:
        mesh = _mesh_and_skeleton(read_fbx(raw[0]))
    except (LookupError, ValueError, TypeError, AttributeError, struct.error, zlib.error) as error:
        raise InputError(f"{folder / MESH} is not the mesh of a Momentum rig", hint) from error
    try:
        text = raw[1].decode()
        parameters, scales, limits = _bone_lengths(text, mesh["joints"])
    except (LookupError, ValueError) as error:
        raise InputError(f"{folder / PARAMETERS} does not describe the parameters of that rig", hint) from error
    return MomentumRig(**mesh, parameters=parameters, scales=scales, limits=limits)


def read_fbx(data: bytes) -> Node:
    """Parse a binary FBX file into a nameless root node; `ValueError` or `struct.error` if it is invalid."""
    if not data.startswith(b"Kaydara FBX Binary"):
        raise ValueError("no binary FBX file")
    is_64_bit = struct.unpack_from("<I", data, 23)[0] >= 7500
    return Node("", [], _Reader(data, "<QQQB" if is_64_bit else "<IIIB").nodes(27, len(data), 0))


class _Reader:
    """Parser of FBX nodes, with a limit on the total size of the arrays."""

    def __init__(self, data: bytes, head: str) -> None:
        self._data, self._head, self._bytes_left = data, struct.Struct(head), _MAX_BYTES

    def nodes(self, at: int, stop: int, depth: int) -> list[Node]:
        nodes_read: list[Node] = []
        while at + self._head.size <= stop:
            end, count, length, name = self._head.unpack_from(self._data, at)
            if end == 0:
                break
            start = at + self._head.size + name
            if not (start + length <= end <= stop and depth < _MAX_DEPTH and count <= length):
                raise ValueError("a node that ends nowhere")
            properties = self._properties(start, start + length, count)
            label = self._data[start - name : start].decode()
            nodes_read.append(Node(label, properties, self.nodes(start + length, end, depth + 1)))
            at = end
        return nodes_read

    def _properties(self, at: int, stop: int, count: int) -> list[Any]:
        values: list[Any] = []
        for _ in range(count):
            kind, at = chr(self._data[at]), at + 1
            if kind in _SCALARS:
                values += struct.unpack_from(_SCALARS[kind], self._data, at)
                at += struct.calcsize(_SCALARS[kind])
            elif kind in "SR":
                (size,) = struct.unpack_from("<I", self._data, at)
                values.append(self._data[at + 4 : at + 4 + size])
                at += 4 + size
            else:
                length, packed, size = struct.unpack_from("<III", self._data, at)
                values.append(
                    self._array(self._data[at + 12 : at + 12 + size], np.dtype(_ARRAYS[kind]), length, packed)
                )
                at += 12 + size
            if at > stop:
                raise ValueError("a property that ends nowhere")
        return values

    def _array(self, raw: bytes, dtype: np.dtype[Any], length: int, packed: int) -> np.ndarray:
        size = length * dtype.itemsize
        self._bytes_left -= size
        if self._bytes_left < 0:
            raise ValueError("more than a rig has")
        if packed:
            raw = zlib.decompressobj().decompress(raw, size) if size else b""
        return np.frombuffer(raw, dtype, length)


def _mesh_and_skeleton(file: Node) -> dict[str, Any]:
    """The fields of a `MomentumRig` that the FBX file contains; `LookupError` and others if one is missing."""
    objects = file.all("Objects")[0].children
    links = [tuple(link.properties[1:3]) for link in file.all("Connections")[0].children if link.properties[0] == b"OO"]

    def objects_of(name: str, kind: bytes) -> list[Node]:
        return [each for each in objects if each.name == name and each.properties[2] == kind]

    mesh = objects_of("Geometry", b"Mesh")[0]
    verts = np.asarray(mesh.value("Vertices"), np.float64).reshape(-1, 3)
    corners = np.asarray(mesh.value("PolygonVertexIndex"), np.int64)
    faces = np.where(corners < 0, ~corners, corners).reshape(-1, 3)
    if not (corners.reshape(-1, 3)[:, 2] < 0).all() or faces.max() >= len(verts):
        raise ValueError("triangles only")
    blends = sorted(objects_of("Geometry", b"Shape"), key=lambda each: int(each.label.split("_")[1]))
    shapes = np.zeros((len(blends), *verts.shape))
    for row, each in zip(shapes, blends, strict=True):
        row[each.value("Indexes")] = np.asarray(each.value("Vertices")).reshape(-1, 3)

    bones = [each for each in objects if each.name == "Model" and each.properties[2] in (b"Root", b"LimbNode")]
    number = {bone.properties[0]: index for index, bone in enumerate(bones)}
    parent = {child: above for child, above in links if child in number and above in number}
    parents = tuple(number[parent[each]] if each in parent else -1 for each in number)
    if any(above >= cluster_node for cluster_node, above in enumerate(parents)):
        raise ValueError("parents come first")
    shifts, turns = np.zeros((len(bones), 3)), np.tile(np.eye(3), (len(bones), 1, 1))
    for index, bone in enumerate(bones):
        settings = {each.properties[0]: each.properties[4:7] for each in bone.all("Properties70")[0].children}
        shifts[index] = settings.get(b"Lcl Translation", (0, 0, 0))
        turns[index] = rotation_from_euler(np.radians(settings.get(b"PreRotation", (0, 0, 0))))

    clusters = {each.properties[0]: each for each in objects_of("Deformer", b"Cluster")}
    weights = np.zeros((len(verts), len(bones)))
    for bone, cluster in links:
        if cluster in clusters and bone in number and clusters[cluster].all("Indexes"):
            cluster_node = clusters[cluster]
            weights[cluster_node.value("Indexes"), number[bone]] = cluster_node.value("Weights")
    weights /= weights.sum(1, keepdims=True)
    if not np.isfinite(weights).all():
        raise ValueError("a vertex that no joint moves")
    return {
        "verts": verts / 100, "faces": faces, "shapes": shapes / 100, "parents": parents, "shifts": shifts / 100,
        "turns": turns, "weights": weights, "joints": tuple(bone.label for bone in bones),
    }  # fmt: skip


def rotation_from_euler(angles: Float[Floats, " 3"]) -> Float[Floats, "3 3"]:
    """Matrix of rotations about x, then y, then z, in radians."""
    (a, b, c), (d, e, f) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, a, -d], [0, d, a]])
    about_y = np.array([[b, 0, e], [0, 1, 0], [-e, 0, b]])
    about_z = np.array([[c, -f, 0], [f, c, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x)


def _bone_lengths(
    text: str, joints: tuple[str, ...]
) -> tuple[tuple[str, ...], Float[Floats, "P J 4"], Float[Floats, "P 2"]]:
    """Names, effects and limits of the variable parameters of bone lengths, whose names start with ``scale_``."""
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    limits = {
        name: (float(low), float(high)) for name, low, high in (m.groups() for m in map(_LIMIT.match, lines) if m)
    }
    names = tuple(name for name, (low, high) in limits.items() if name.startswith("scale_") and low < high)
    if not names:
        raise ValueError("no bone length varies")
    scales = np.zeros((len(names), len(joints), 4))
    for line in lines:
        left, _, right = line.partition("=")
        joint, _, channel = left.strip().partition(".")
        if channel not in _CHANNELS:
            continue
        for factor, name in _TERM.findall(right):
            if name in names:
                unit = 1.0 if channel == "sc" else 0.01
                scales[names.index(name), joints.index(joint), _CHANNELS[channel]] += float(factor) * unit
    return names, scales, np.array([limits[name] for name in names])
