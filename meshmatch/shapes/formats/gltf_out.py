"""Writing glTF 2.0, binary (glb): one node, one mesh, one primitive, and its texture within the file.

Specification: Khronos glTF 2.0.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.topology import same_rows
from meshmatch.geometry.triangles import dot, vertex_normals
from meshmatch.shapes.colors import to_linear
from meshmatch.shapes.formats import Textured
from meshmatch.shapes.shape import Shape

_POINTS, _TRIANGLES = 0, 4
_FLOAT, _UNSIGNED = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_LINEAR, _LINEAR_MIPS = 9729, 9987
# Coincident vertices whose normals are further than this cosine (32 degrees) from their mean are an edge of the shape,
# not a seam; a cube stays one. Set by hand.
_SHARP = 0.85
_WRAPS = {"repeat": 10497, "clamp": 33071, "mirror": 33648}


class _Buffer:
    """Arrays and images one after the other, each at a multiple of four bytes, and what describes them."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.at = 0

    def view(self, data: bytes, **rest: Any) -> int:
        """The number of a new view of `data`."""
        self.views.append({"buffer": 0, "byteOffset": self.at, "byteLength": len(data), **rest})
        self.parts.append(data + b"\0" * (-len(data) % 4))
        self.at += len(self.parts[-1])
        return len(self.views) - 1

    def array(self, values: NDArray[Any], kind: str, target: int = _VERTICES, box: bool = False) -> int:
        """The number of a new accessor of (N, width) floats, or of (N,) whole numbers; positions need their box."""
        component = _UNSIGNED if values.dtype.kind == "u" else _FLOAT
        entry: dict[str, Any] = {"componentType": component, "type": kind, "count": len(values)}
        if box:
            entry |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        self.accessors.append({"bufferView": self.view(values.tobytes(), target=target), **entry})
        return len(self.accessors) - 1


def write(path: Path, shape: Shape) -> None:
    """A mesh or a cloud; 32-bit floats, 32-bit indices, linear vertex colours."""
    buffer = _Buffer()
    attributes = {"POSITION": buffer.array(shape.verts.astype("<f4"), "VEC3", box=True)}
    if not shape.is_cloud:
        attributes["NORMAL"] = buffer.array(smooth_normals(shape.verts, shape.faces).astype("<f4"), "VEC3")
    if shape.colors is not None:
        light = np.concatenate([to_linear(shape.colors[:, :3]), shape.colors[:, 3:]], axis=1)
        attributes["COLOR_0"] = buffer.array(light.astype("<f4"), "VEC4")
    primitive: dict[str, Any] = {"attributes": attributes, "mode": _POINTS if shape.is_cloud else _TRIANGLES}
    if not shape.is_cloud:
        primitive["indices"] = buffer.array(shape.faces.astype("<u4").reshape(-1), "SCALAR", _INDICES)
    _write(path, shape.name, primitive, buffer, {})


def write_textured(path: Path, name: str, mesh: Textured, png: bytes) -> None:
    """A mesh that wears one image (a PNG): the first vertices are those of the shape, copies for seams follow.

    The material is plain paint (metallic 0, roughness 1), seen from both sides; the sampler asks for mip levels.
    """
    vertex, uv, faces = split_at_seams(mesh)
    buffer = _Buffer()
    primitive = {
        "attributes": {
            "POSITION": buffer.array(mesh.verts[vertex].astype("<f4"), "VEC3", box=True),
            "NORMAL": buffer.array(smooth_normals(mesh.verts, mesh.faces)[vertex].astype("<f4"), "VEC3"),
            "TEXCOORD_0": buffer.array(uv.astype("<f4"), "VEC2"),
        },
        "indices": buffer.array(faces.astype("<u4").reshape(-1), "SCALAR", _INDICES),
        "material": 0,
        "mode": _TRIANGLES,
    }
    image = buffer.view(png)
    material: dict[str, Any] = {
        "name": name,
        "doubleSided": True,
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0},
    }
    if mesh.alpha != "opaque":
        material["alphaMode"] = mesh.alpha.upper()
    if mesh.alpha == "mask":
        material["alphaCutoff"] = mesh.cutoff
    wrap = {"wrapS": _WRAPS[mesh.wrap], "wrapT": _WRAPS[mesh.wrap]}
    look = {
        "materials": [material],
        "textures": [{"sampler": 0, "source": 0}],
        "images": [{"bufferView": image, "mimeType": "image/png", "name": name}],
        "samplers": [{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPS, **wrap}],
    }
    _write(path, name, primitive, buffer, look)


def smooth_normals(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, "V 3"]:
    """Unit vertex normals; vertices at one place, as seams have them, share theirs unless they meet at an edge.

    A vertex without a face gets the z axis: glTF wants unit length everywhere.
    """
    twin = same_rows(verts)
    own, shared = vertex_normals(verts, faces), vertex_normals(verts, twin[faces])[twin]
    normals = np.where((dot(own, shared) > _SHARP)[:, None], shared, own)
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals


def split_at_seams(mesh: Textured) -> tuple[Int[Ints, " N"], Float[Floats, "N 2"], Int[Ints, "F 3"]]:
    """Vertices with one pair of coordinates each: which vertex of the mesh each is, coordinates, and faces over them.

    The first V are those of the mesh in their order (zero coordinates where no face uses one); then come the copies
    that seams need. Coordinates that are one 32-bit float are one.
    """
    V = len(mesh.verts)
    corner = mesh.faces.reshape(-1)
    pairs = np.ascontiguousarray(mesh.uv.reshape(-1, 2).astype("<f4") + np.float32(0))  # no -0
    order = np.lexsort((pairs[:, 1], pairs[:, 0], corner))
    fresh_vertex = np.diff(corner[order], prepend=-1) != 0
    fresh = fresh_vertex.copy()
    fresh[1:] |= (pairs[order][1:] != pairs[order][:-1]).any(axis=1)
    copies = fresh & ~fresh_vertex
    number = np.where(fresh_vertex, corner[order], V - 1 + np.cumsum(copies))
    new = np.empty(len(corner), np.int64)
    new[order] = number[fresh][np.cumsum(fresh) - 1]
    uv = np.zeros((V + int(copies.sum()), 2), np.float64)
    uv[new] = pairs
    return np.concatenate([np.arange(V), corner[order][copies]]), uv, new.reshape(-1, 3)


def _write(path: Path, name: str, primitive: dict[str, Any], buffer: _Buffer, rest: dict[str, Any]) -> None:
    document = {
        "asset": {"version": "2.0", "generator": "meshmatch"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"primitives": [primitive], "name": name}],
        **rest,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.at}],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = b"glTF" + np.array([2, 28 + len(text) + buffer.at, len(text)], "<u4").tobytes() + b"JSON"
    path.write_bytes(b"".join([head, text, np.array([buffer.at], "<u4").tobytes(), b"BIN\0", *buffer.parts]))
