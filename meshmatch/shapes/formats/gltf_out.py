"""Writing glTF 2.0, binary (glb): one node, one mesh, one primitive, and its morph targets; a texture is laid on by
`meshmatch.shapes.formats.gltf_dressed`.

Positions are 32-bit floats, with about seven digits. Those of a shape that lies far from the origin, as a scan in
coordinates of a country does, are written from a center near it; the center is the node's translation, in all its digits.

Specification: Khronos glTF 2.0.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import OutputError
from meshmatch.geometry.triangles import dot, same_rows, vertex_normals
from meshmatch.shapes.colors import light
from meshmatch.shapes.formats import as_float32
from meshmatch.shapes.shape import Shape

# Coincident vertices whose normals are further than this cosine (32 degrees) from their mean are an edge of the shape,
# not a seam; a cube stays one. Set by hand.
_SHARP = 0.85
_FAR = 8.0  # three of the 24 bits of a float
_POINTS, _TRIANGLES = 0, 4
_FLOAT, _UNSIGNED = 5126, 5125
_LARGEST = 2**32 - 1
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
"""Of accessors, by the numbers in a row."""
VERTICES, INDICES = 34962, 34963
"""The targets of buffer views that hold attributes of vertices, and triangles."""


def write(path: Path, shape: Shape) -> None:
    """A mesh or a cloud, see `glb_of`."""
    path.write_bytes(glb_of(shape))


def glb_of(shape: Shape, turn: Float[Floats, "3 3"] | None = None) -> bytes:
    """A mesh or a cloud; 32-bit floats, 32-bit indices, linear vertex colors. Its node makes the turn."""
    attributes = {"POSITION": shape.verts}
    if not shape.is_cloud:
        attributes["NORMAL"] = smooth_normals(shape.verts, shape.faces)
    if shape.colors is not None:
        attributes["COLOR_0"] = light(shape.colors)
    return _glb(Path(shape.name).stem, attributes, shape.faces, turn=turn)


def write_morphs(
    path: Path, shape: Shape, targets: Mapping[str, Float[Floats, "V 3"]], seconds: Float[Floats, " T"] | None = None
) -> None:
    """A mesh with morph targets by name: where its vertices are when the target's weight is 1. All weights are 0.

    With ``seconds`` a clip shows the shape at the first of these, and then each target; at one more the shape again.
    """
    normals = smooth_normals(shape.verts, shape.faces)
    moves = {
        name: {"POSITION": verts - shape.verts, "NORMAL": smooth_normals(verts, shape.faces) - normals}
        for name, verts in targets.items()
    }
    attributes = {"POSITION": shape.verts, "NORMAL": normals}
    keys = None
    if seconds is not None:  # at each key one target, or none
        weights = np.eye(len(targets) + 1)[:, 1:]
        keys = seconds, np.concatenate([weights, weights[:1]])[: len(seconds)]
    path.write_bytes(_glb(Path(shape.name).stem, attributes, shape.faces, moves, keys=keys))


def center_of(verts: Float[Floats, "V 3"]) -> Float[Floats, " 3"]:
    """The point that positions should be measured from to keep their digits as 32-bit floats.

    The origin, unless it is over `_FAR` times further from the middle of the shape than most of its vertices are; else a
    point in the middle of them. The middle is the median, which a stray vertex does not move. Its coordinates are rounded
    to a power of two near the size of the shape, so that positions that were 32-bit floats lose nothing.
    """
    middle = np.median(verts, axis=0)
    size = float(np.median(np.abs(verts - middle).max(axis=1)))
    if float(np.abs(middle).max()) <= _FAR * size:
        return np.zeros(3)
    step = 2.0 ** np.floor(np.log2(size)) if size > 0 else 0.0
    return np.asarray(np.round(middle / step) * step if step > 0 else middle)


def _glb(
    name: str,
    attributes: dict[str, Floats],
    faces: Ints,
    moves: Mapping[str, dict[str, Floats]] | None = None,
    turn: Float[Floats, "3 3"] | None = None,
    keys: tuple[Float[Floats, " T"], Float[Floats, "T M"]] | None = None,
) -> bytes:
    """Arrays one after the other, each at a multiple of four bytes, behind what describes them.

    ``keys`` are seconds, and the weights of all moves at each.
    """
    center = center_of(attributes["POSITION"])
    attributes = attributes | {"POSITION": attributes["POSITION"] - center}
    arrays: list[NDArray[Any]] = [as_float32(values, ".glb") for values in attributes.values()]
    primitive: dict[str, Any] = {"attributes": {key: k for k, key in enumerate(attributes)}, "mode": _POINTS}
    if len(faces):
        primitive |= {"mode": _TRIANGLES, "indices": len(arrays)}
        arrays.append(faces.astype("<u4").reshape(-1, 1))
    places = [0]  # positions need their box
    mesh: dict[str, Any] = {"primitives": [primitive], "name": name}
    if moves:
        primitive["targets"] = []
        mesh |= {"weights": [0.0] * len(moves), "extras": {"targetNames": list(moves)}}
    for move in (moves or {}).values():
        places.append(len(arrays))
        primitive["targets"].append({key: len(arrays) + k for k, key in enumerate(move)})
        arrays += [as_float32(values, ".glb") for values in move.values()]
    drawn = len(arrays)
    if keys is not None:
        places.append(drawn)
        arrays += [as_float32(values.reshape(-1, 1), ".glb") for values in keys]
    chunks = [values.tobytes() for values in arrays]
    padded = [chunk + b"\0" * (-len(chunk) % 4) for chunk in chunks]
    starts = np.cumsum([0, *map(len, padded)]).tolist()
    views: list[dict[str, Any]] = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(chunk)}
        for chunk, start in zip(chunks, starts, strict=False)
    ]
    accessors: list[dict[str, Any]] = []
    for k, values in enumerate(arrays):
        whole = values.dtype.kind == "u"
        if k < drawn:
            views[k]["target"] = INDICES if whole else VERTICES
        kinds = {"componentType": _UNSIGNED if whole else _FLOAT, "type": TYPES[values.shape[1]]}
        accessors.append({"bufferView": k, **kinds, "count": len(values)})
    for k in places:
        accessors[k] |= {"min": arrays[k].min(0).tolist(), "max": arrays[k].max(0).tolist()}
    document = {"asset": {"version": "2.0", "generator": "meshmatch"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    node: dict[str, Any] = {"mesh": 0, "name": name}
    if turn is not None:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn, turn @ center
        node["matrix"] = matrix.T.ravel().tolist()
    elif center.any():
        node["translation"] = center.tolist()
    document |= {"nodes": [node], "meshes": [mesh]}
    if keys is not None:
        channel = {"sampler": 0, "target": {"node": 0, "path": "weights"}}
        sampler = {"input": drawn, "output": drawn + 1, "interpolation": "LINEAR"}
        document["animations"] = [{"name": name or "sequence", "channels": [channel], "samplers": [sampler]}]
    document |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": starts[-1]}]}
    return packed(name, document, padded)


def packed(name: str, document: dict[str, Any], chunks: Sequence[bytes]) -> bytes:
    """The glb of what describes a file, and the bytes of its one buffer, in multiples of four.

    `OutputError` where it would be larger than a glb can be.
    """
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    held = sum(map(len, chunks))
    size = 28 + len(text) + held
    if size > _LARGEST:
        raise OutputError(f"{name} becomes larger than a glb can be (4 GiB)", "decimate it first")
    head = b"glTF" + np.array([2, size, len(text)], "<u4").tobytes() + b"JSON"
    return b"".join([head, text, np.array([held], "<u4").tobytes(), b"BIN\0", *chunks])


def smooth_normals(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, "V 3"]:
    """Unit vertex normals; vertices at one place, as seams have them, share theirs unless they meet at an edge.

    A vertex without a face gets the z axis: glTF wants unit length everywhere.
    """
    twin = same_rows(verts)
    own, shared = vertex_normals(verts, faces), vertex_normals(verts, twin[faces])[twin]
    normals = np.where((dot(own, shared) > _SHARP)[:, None], shared, own)
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals
