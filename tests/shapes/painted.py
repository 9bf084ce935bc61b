"""Files with textures, made by hand: a square of two triangles, and pictures of a few pixels."""

import base64
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

# Counter-clockwise from the origin; the texture coordinates of glTF, v down: (x, 1 - y).
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def quarters(size: int = 2) -> np.ndarray:
    """A picture of four flat quarters: red, green over blue, white."""
    four = np.array([[[255, 0, 0, 255], [0, 255, 0, 255]], [[0, 0, 255, 255], [255, 255, 255, 255]]], np.uint8)
    return four.repeat(size // 2, axis=0).repeat(size // 2, axis=1)


def encoded(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    out = BytesIO()
    Image.fromarray(pixels if kind == "PNG" else pixels[..., :3]).save(out, kind, quality=95)
    return out.getvalue()


def write_square_obj(path: Path, mtl: str | None = "square.mtl", vt: bool = True) -> None:
    """The square as an obj; vt has v up, so it equals x, y."""
    lines = [] if mtl is None else [f"mtllib {mtl}"]
    lines += [f"v {x} {y} {z}" for x, y, z in CORNERS]
    lines += [f"vt {x} {y}" for x, y, _ in CORNERS]
    lines += ["usemtl paint"]
    lines += ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"] if vt else ["f 1 2 3", "f 1 3 4"]
    path.write_text("\n".join([*lines, ""]))


def write_gltf(
    path: Path,
    *,
    primitives: list[dict[str, Any]] | None = None,
    images: list[bytes | str] = (),  # type: ignore[assignment]
    embed: bool = True,
    **rest: Any,
) -> None:
    """Squares as a glb or gltf, one node each, the k-th moved k to the right.

    A primitive may have `material`, `uv` (4, 2) or None, `uv1`, `colors` (4, n). Images are bytes, kept in the
    buffer (`embed`) or as data URIs, or URIs themselves. `rest` goes into the document as it is.
    """
    parts: list[bytes] = []
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []

    def view(data: bytes) -> int:
        views.append({"buffer": 0, "byteOffset": sum(map(len, parts)), "byteLength": len(data)})
        parts.append(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    def array(values: np.ndarray, kind: str, component: int) -> int:
        accessors.append({"bufferView": view(values.tobytes()), "componentType": component, "type": kind,
                          "count": len(values)})  # fmt: skip
        return len(accessors) - 1

    meshes = []
    for own in primitives if primitives is not None else [{}]:
        attributes = {"POSITION": array(CORNERS.astype("<f4"), "VEC3", 5126)}
        if own.get("uv", UV) is not None:
            attributes["TEXCOORD_0"] = array(np.asarray(own.get("uv", UV), "<f4"), "VEC2", 5126)
        if "uv1" in own:
            attributes["TEXCOORD_1"] = array(np.asarray(own["uv1"]).astype("<f4"), "VEC2", 5126)
        if "colors" in own:
            colors = np.asarray(own["colors"]).astype("<f4")
            attributes["COLOR_0"] = array(colors, f"VEC{colors.shape[1]}", 5126)
        entry: dict[str, Any] = {
            "attributes": attributes,
            "indices": array(FACES.ravel().astype("<u4"), "SCALAR", 5125),
        }
        if "material" in own:
            entry["material"] = own["material"]
        meshes.append({"primitives": [entry]})
    listed = []
    for image in images:
        if isinstance(image, str):
            listed.append({"uri": image})
        elif embed:
            listed.append({"bufferView": view(image), "mimeType": "image/png"})
        else:
            listed.append({"uri": "data:image/png;base64," + base64.b64encode(image).decode()})
    body = b"".join(parts)
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": k, "translation": [k, 0, 0]} for k in range(len(meshes))],
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    if listed:
        document["images"] = listed
        document["textures"] = [{"source": k} for k in range(len(listed))]
        document["materials"] = [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(len(listed))
        ]
    document |= rest
    if path.suffix == ".gltf":
        document["buffers"][0]["uri"] = "data:;base64," + base64.b64encode(body).decode()
        path.write_text(json.dumps(document))
        return
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = b"glTF" + np.array([2, 28 + len(text) + len(body), len(text)], "<u4").tobytes() + b"JSON"
    path.write_bytes(head + text + np.array([len(body)], "<u4").tobytes() + b"BIN\0" + body)
