"""Hand-made files with textures: a square of two triangles, and images of a few pixels."""

import base64
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

# Counter-clockwise from the origin. Texture coordinates as in glTF, v down: (x, 1 - y).
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def quarters(size: int = 2) -> np.ndarray:
    """An image of four uniform quarters: red and green above blue and white."""
    four = np.array([[[255, 0, 0, 255], [0, 255, 0, 255]], [[0, 0, 255, 255], [255, 255, 255, 255]]], np.uint8)
    return four.repeat(size // 2, axis=0).repeat(size // 2, axis=1)


def encoded(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    out = BytesIO()
    Image.fromarray(pixels if kind == "PNG" else pixels[..., :3]).save(out, kind, quality=95)
    return out.getvalue()


def write_square_obj(path: Path, mtl: str | None = "square.mtl", vt: bool = True) -> None:
    """Write the square as an obj; vt has v up, so it equals x, y."""
    lines = [] if mtl is None else [f"mtllib {mtl}"]
    lines += [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += [f"vt {x} {y}" for x, y, _ in CORNERS]
    lines += ["usemtl paint"]
    lines += ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"] if vt else ["f 1 2 3", "f 1 3 4"]
    path.write_text("\n".join([*lines, ""]))


def write_document(
    path: Path, document: dict[str, Any], *arrays: np.ndarray, file: str = "", normalized: int = -1
) -> None:
    """Write a glb or gltf; array k is accessor k and view k of one buffer.

    The buffer of a gltf is embedded, or in the separate ``file`` in the same folder.
    """
    kinds = {"float32": 5126, "int16": 5122, "uint8": 5121, "uint16": 5123, "uint32": 5125}
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    body = b""
    for k, array in enumerate(arrays):
        width = 1 if array.ndim == 1 else array.shape[1]
        kind = {1: "SCALAR", 16: "MAT4"}.get(width, f"VEC{width}")
        accessors.append({"bufferView": k, "componentType": kinds[array.dtype.name], "count": len(array), "type": kind})
        if (
            kind in ("SCALAR", "VEC3") and array.dtype.kind == "f" and np.isfinite(array).all()
        ):  # required for times and positions
            rows = array.reshape(len(array), -1)
            accessors[k] |= {"min": rows.min(0).tolist(), "max": rows.max(0).tolist()}
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": array.nbytes})
        body += array.tobytes() + b"\0" * (-array.nbytes % 4)
    if normalized >= 0:
        accessors[normalized]["normalized"] = True
    buffer: dict[str, Any] = {"byteLength": len(body)}
    if path.suffix == ".gltf":
        buffer["uri"] = file or "data:;base64," + base64.b64encode(body).decode()
    made = {"asset": {"version": "2.0"}, "bufferViews": views, "accessors": accessors, "buffers": [buffer]} | document
    if file:
        (path.parent / file).write_bytes(body)
    if path.suffix == ".gltf":
        path.write_text(json.dumps(made))
        return
    path.write_bytes(glb(made, body))


def glb(document: dict[str, Any], body: bytes) -> bytes:
    """Encode a document and its buffer as a glb as it is, even if validators would warn."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = b"glTF" + np.array([2, 28 + len(text) + len(body), len(text)], "<u4").tobytes() + b"JSON"
    return head + text + np.array([len(body)], "<u4").tobytes() + b"BIN\0" + body


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Split a glb into its document and its buffer."""
    end = 20 + int.from_bytes(data[12:16], "little")
    return json.loads(data[20:end]), data[end + 8 :]


def write_gltf(
    path: Path,
    *,
    primitives: list[dict[str, Any]] | None = None,
    images: list[bytes | str] = (),  # type: ignore[assignment]
    embed: bool = True,
    **rest: Any,
) -> None:
    """Write squares as a glb or gltf, one node each, the k-th moved k to the right.

    A primitive may have `material`, `uv` (4, 2) or None, `uv1`, `colors` (4, n). Images are bytes, stored in the buffer
    (`embed`) or as data URIs, or they are URIs. `rest` is added to the document.
    """
    arrays: list[np.ndarray] = []

    def array(values: Any, kind: str = "<f4") -> int:
        arrays.append(np.asarray(values).astype(kind))
        return len(arrays) - 1

    meshes = []
    for own in primitives if primitives is not None else [{}]:
        attributes = {"POSITION": array(CORNERS)}
        if own.get("uv", UV) is not None:
            attributes["TEXCOORD_0"] = array(own.get("uv", UV))
        attributes |= {
            key: array(own[name]) for name, key in (("uv1", "TEXCOORD_1"), ("colors", "COLOR_0")) if name in own
        }
        entry: dict[str, Any] = {"attributes": attributes, "indices": array(FACES.ravel(), "<u4")}
        meshes.append({"primitives": [entry | ({"material": own["material"]} if "material" in own else {})]})
    listed: list[dict[str, Any]] = []
    for image in images:
        if isinstance(image, str):
            listed.append({"uri": image})
        elif embed:
            listed.append({"bufferView": array(np.frombuffer(image, "u1"), "u1"), "mimeType": "image/png"})
        else:
            listed.append({"uri": "data:image/png;base64," + base64.b64encode(image).decode()})
    document: dict[str, Any] = {
        "nodes": [{"mesh": k, "translation": [k, 0, 0]} for k in range(len(meshes))],
        "meshes": meshes,
    }
    if listed:
        textures = [{"source": k} for k in range(len(listed))]
        materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(len(listed))]
        document |= {"images": listed, "textures": textures, "materials": materials}
    write_document(path, document | rest, *arrays)
