"""Write glTF 2.0, binary (glb): one node, one mesh, one primitive, and its morph targets.

`meshmatch.shapes.formats.gltf_materials` adds textures. Positions are 32-bit floats, with about seven digits. Those of a
shape far from the origin, such as a scan in national grid coordinates, are written relative to a center near it; the center
is the node's translation, in full precision.

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
from meshmatch.shapes.colors import srgb_to_linear_alpha
from meshmatch.shapes.formats import as_float32
from meshmatch.shapes.shape import Shape

# Coincident vertices whose normals differ from their mean by more than this cosine (32 degrees) lie on a sharp edge, not
# on a seam, so that a cube keeps its edges. Set by hand.
_MIN_SEAM_COSINE = 0.85
_FAR = 8.0  # a distance of this many sizes costs three of the 24 bits of a float
_POINTS, _TRIANGLES = 0, 4
_FLOAT, _UNSIGNED = 5126, 5125
_MAX_BYTES = 2**32 - 1
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
"""Types of accessors, by the number of components."""
VERTICES, INDICES = 34962, 34963
"""Targets of buffer views that contain vertex attributes, and vertex indices."""


def write(path: Path, shape: Shape) -> None:
    """Write a mesh or a point cloud, see `glb_of`."""
    path.write_bytes(glb_of(shape))


def glb_of(shape: Shape, turn: Float[Floats, "3 3"] | None = None) -> bytes:
    """Return a mesh or a point cloud as a glb: 32-bit floats, 32-bit indices, linear vertex colors.

    ``turn`` is the rotation of its node.
    """
    attributes = {"POSITION": shape.verts}
    if not shape.is_cloud:
        attributes["NORMAL"] = smooth_normals(shape.verts, shape.faces)
    if shape.colors is not None:
        attributes["COLOR_0"] = srgb_to_linear_alpha(shape.colors)
    return _glb(Path(shape.name).stem, attributes, shape.faces, turn=turn)


def write_morphs(
    path: Path, shape: Shape, targets: Mapping[str, Float[Floats, "V 3"]], seconds: Float[Floats, " T"] | None = None
) -> None:
    """Write a mesh with morph targets, given by name as the vertex positions at weight 1; all weights are initially 0.

    With ``seconds``, an animation shows the shape at the first of these times, then one target per time; a last time,
    after those of all targets, shows the shape again.
    """
    normals = smooth_normals(shape.verts, shape.faces)
    moves = {
        name: {"POSITION": verts - shape.verts, "NORMAL": smooth_normals(verts, shape.faces) - normals}
        for name, verts in targets.items()
    }
    attributes = {"POSITION": shape.verts, "NORMAL": normals}
    keys = None
    if seconds is not None:  # each key shows one target, or none
        weights = np.eye(len(targets) + 1)[:, 1:]
        keys = seconds, np.concatenate([weights, weights[:1]])[: len(seconds)]
    path.write_bytes(_glb(Path(shape.name).stem, attributes, shape.faces, moves, keys=keys))


def choose_origin(verts: Float[Floats, "V 3"]) -> Float[Floats, " 3"]:
    """Choose the origin for positions so that 32-bit floats keep their digits.

    This is (0, 0, 0), unless it is over `_FAR` times further from the median of the vertices than most vertices are; else
    a point near the median, which is robust to stray vertices. Its coordinates are multiples of a power of two near the
    size of the shape, so that positions that were 32-bit floats lose no bits.
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
    """Build a glb: the JSON description, then all arrays, each aligned to four bytes.

    ``moves`` are morph targets by name: displacements of positions and normals. ``keys`` are the times of an animation in
    seconds, and the weights of all targets at each.
    """
    center = choose_origin(attributes["POSITION"])
    attributes = attributes | {"POSITION": attributes["POSITION"] - center}
    arrays: list[NDArray[Any]] = [as_float32(values, ".glb") for values in attributes.values()]
    primitive: dict[str, Any] = {"attributes": {key: k for k, key in enumerate(attributes)}, "mode": _POINTS}
    if len(faces):
        primitive |= {"mode": _TRIANGLES, "indices": len(arrays)}
        arrays.append(faces.astype("<u4").reshape(-1, 1))
    bounded = [0]  # glTF requires the bounds of positions and times
    mesh: dict[str, Any] = {"primitives": [primitive], "name": name}
    if moves:
        primitive["targets"] = []
        mesh |= {"weights": [0.0] * len(moves), "extras": {"targetNames": list(moves)}}
    for move in (moves or {}).values():
        bounded.append(len(arrays))
        primitive["targets"].append({key: len(arrays) + k for k, key in enumerate(move)})
        arrays += [as_float32(values, ".glb") for values in move.values()]
    n_vertex_arrays = len(arrays)
    if keys is not None:
        bounded.append(n_vertex_arrays)
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
        is_integer = values.dtype.kind == "u"
        if k < n_vertex_arrays:
            views[k]["target"] = INDICES if is_integer else VERTICES
        kinds = {"componentType": _UNSIGNED if is_integer else _FLOAT, "type": TYPES[values.shape[1]]}
        accessors.append({"bufferView": k, **kinds, "count": len(values)})
    for k in bounded:
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
        sampler = {"input": n_vertex_arrays, "output": n_vertex_arrays + 1, "interpolation": "LINEAR"}
        document["animations"] = [{"name": name or "sequence", "channels": [channel], "samplers": [sampler]}]
    document |= {"accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": starts[-1]}]}
    return pack_glb(name, document, padded)


def pack_glb(name: str, document: dict[str, Any], chunks: Sequence[bytes]) -> bytes:
    """Assemble a glb from its JSON description and the chunks of its only buffer, each a multiple of four bytes long.

    `OutputError` if it exceeds the size limit of a glb.
    """
    text = json.dumps(document, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    n_bytes = sum(map(len, chunks))
    size = 28 + len(text) + n_bytes
    if size > _MAX_BYTES:
        raise OutputError(f"{name} becomes larger than a glb can be (4 GiB)", "decimate it first")
    head = b"glTF" + np.array([2, size, len(text)], "<u4").tobytes() + b"JSON"
    return b"".join([head, text, np.array([n_bytes], "<u4").tobytes(), b"BIN\0", *chunks])


def smooth_normals(verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, "V 3"]:
    """Compute unit vertex normals; coincident vertices, as at seams, share a normal unless they lie on a sharp edge.

    A vertex without a face gets the z axis, since glTF requires unit length everywhere.
    """
    representative = same_rows(verts)
    separate, shared = vertex_normals(verts, faces), vertex_normals(verts, representative[faces])[representative]
    normals = np.where((dot(separate, shared) > _MIN_SEAM_COSINE)[:, None], shared, separate)
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)
    return normals
