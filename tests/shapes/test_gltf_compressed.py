"""Compressed glTF files are read as the same file without compression, where the libraries are there."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import gltf, gltf_compressed
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.textured_files import load_coordinates
from tests.transfer.rigs import tube

MESHOPT = "EXT_meshopt_compression"
DRACO = "KHR_draco_mesh_compression"


def write(path: Path, data: bytes, extension: str, **document: Any) -> Path:
    """A glb that requires an extension."""
    head = {"asset": {"version": "2.0"}, "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}
    head |= {"extensionsUsed": [extension], "extensionsRequired": [extension]} | document
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    sizes = np.array([2, 28 + len(text) + len(data), len(text)], "<u4").tobytes()
    path.write_bytes(b"glTF" + sizes + b"JSON" + text + np.array([len(data)], "<u4").tobytes() + b"BIN\0" + data)
    return path


def draco_file(path: Path, cut: int = 0) -> Path:
    DracoPy = pytest.importorskip("DracoPy")
    shape = tube()
    uv = np.stack([shape.verts[:, 0], shape.verts[:, 1]], axis=1)
    data = DracoPy.encode(
        shape.verts.astype(np.float32), shape.faces.astype(np.uint32), tex_coord=uv, quantization_bits=20
    )
    mesh = DracoPy.decode(data)
    ids = {each["attribute_type"]: each["unique_id"] for each in mesh.attributes}
    V, F = len(mesh.points), len(mesh.faces)
    packed = {"bufferView": 0, "attributes": {"POSITION": ids[0], "TEXCOORD_0": ids[3]}}
    primitive = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "extensions": {DRACO: packed}}
    accessors = [
        {"componentType": 5126, "count": V + (1 if cut < 0 else 0), "type": "VEC3", "min": [9] * 3, "max": [9] * 3},
        {"componentType": 5126, "count": V, "type": "VEC2"},
        {"componentType": 5123, "count": 3 * F, "type": "SCALAR"},
    ]
    data = data[: len(data) - max(cut, 0)]
    views, buffers = [{"buffer": 0, "byteLength": len(data)}], [{"byteLength": len(data)}]
    meshes = [{"primitives": [primitive]}]
    return write(path, data, DRACO, meshes=meshes, accessors=accessors, bufferViews=views, buffers=buffers)


def meshopt_file(path: Path, cut: int = 0, count: int | None = None) -> Path:
    meshoptimizer = pytest.importorskip("meshoptimizer")
    shape = tube()
    corners = shape.faces.astype(np.uint32).ravel()
    packed = meshoptimizer.encode_vertex_buffer(shape.verts.astype(np.float32), shape.V, 12)
    indexed = meshoptimizer.encode_index_buffer(corners, len(corners), shape.V)
    packed, indexed = bytes(packed), bytes(indexed)
    data = packed + b"\0" * (-len(packed) % 4) + indexed

    def view(start: int, size: int, stride: int, many: int, mode: str) -> dict[str, Any]:
        inside = {"buffer": 0, "byteOffset": start, "byteLength": size - cut, "byteStride": stride, "count": many}
        plain = {"buffer": 1, "byteLength": many * stride} | ({"byteStride": stride} if mode == "ATTRIBUTES" else {})
        return plain | {"extensions": {MESHOPT: inside | {"mode": mode}}}

    V = shape.V if count is None else count
    box = {"min": shape.verts.min(axis=0).tolist(), "max": shape.verts.max(axis=0).tolist()}
    views = [view(0, len(packed), 12, V, "ATTRIBUTES")]
    views.append(view(len(packed) + (-len(packed) % 4), len(indexed), 4, len(corners), "TRIANGLES"))
    accessors = [
        {"bufferView": 0, "componentType": 5126, "count": V, "type": "VEC3"} | box,
        {"bufferView": 1, "componentType": 5125, "count": len(corners), "type": "SCALAR"},
    ]
    buffers = [{"byteLength": len(data)}, {"byteLength": 10**6, "extensions": {MESHOPT: {"fallback": True}}}]
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}]
    return write(path, data, MESHOPT, meshes=meshes, accessors=accessors, bufferViews=views, buffers=buffers)


def triangles(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Corners of triangles, in an order of their own: compression changes that of vertices and faces."""
    rolled = verts[faces].round(4) + 0.0
    starts = np.lexsort(rolled.transpose(2, 0, 1)[::-1], axis=-1)[:, 0]
    rolled = np.stack([np.roll(each, -start, axis=0) for each, start in zip(rolled, starts, strict=True)])
    flat = rolled.reshape(len(rolled), -1)
    return flat[np.lexsort(flat.T[::-1])]


@pytest.mark.parametrize("make", [draco_file, meshopt_file])
def test_a_compressed_file_is_the_same_shape(tmp_path: Path, make: Any) -> None:
    path = make(tmp_path / "a.glb")
    shape, before = load_shape(path), tube()
    np.testing.assert_allclose(triangles(shape.verts, shape.faces), triangles(before.verts, before.faces), atol=2e-4)
    if make is draco_file:
        uv = load_coordinates(path, shape)
        assert uv is not None
        np.testing.assert_allclose(uv, shape.verts[shape.faces][..., :2], atol=1e-3)


@pytest.mark.parametrize("make", [draco_file, meshopt_file])
def test_what_is_written_of_it_needs_no_library(tmp_path: Path, make: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make(tmp_path / "a.glb")
    shape = load_shape(path)
    glb = gltf.parse_document(path, read_bytes(path), "scene makes", lambda document: Editor(document).to_bytes())
    (tmp_path / "b.glb").write_bytes(glb)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    plain = load_shape(tmp_path / "b.glb")
    np.testing.assert_array_equal(plain.verts, shape.verts)
    np.testing.assert_array_equal(plain.faces, shape.faces)
    assert b"compression" not in glb
    if make is draco_file:  # of the numbers as they are now
        box = gltf.Document(tmp_path / "b.glb", glb).json["accessors"][0]
        np.testing.assert_array_equal([box["min"], box["max"]], [plain.verts.min(0), plain.verts.max(0)])


def test_weights_sum_to_one_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounded to few bits they do not."""
    rounded = {"0 WEIGHTS_0": np.float32([[0.5, 0.25, 0, 0]]), "0 WEIGHTS_1": np.float32([[0.5, 0, 0, 0]])}
    monkeypatch.setattr(gltf_compressed, "_decode_in_subprocess", lambda *_: rounded)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: True)
    ids = {"WEIGHTS_0": 0, "WEIGHTS_1": 1}
    primitive = {"attributes": dict(ids), "extensions": {DRACO: {"bufferView": 0, "attributes": ids}}}
    accessors = [{"componentType": 5126, "count": 1, "type": "VEC4"} for _ in ids]
    document: dict[str, Any] = {"meshes": [{"primitives": [primitive]}], "accessors": accessors}
    document |= {"bufferViews": [{"buffer": 0, "byteLength": 4}], "buffers": [{"byteLength": 4}]}
    made = gltf_compressed.decompress("a.glb", 100, document, lambda _: b"1234", {DRACO})
    np.testing.assert_allclose(np.frombuffer(made[1], "<f4"), np.array([2, 1, 0, 0, 2, 0, 0, 0]) / 5)


@pytest.mark.parametrize("make", [draco_file, meshopt_file])
def test_damaged_data_is_one_line(tmp_path: Path, make: Any) -> None:
    with pytest.raises(InputError, match="cannot be decoded"):
        load_shape(make(tmp_path / "a.glb", 40))


def test_a_promise_that_is_not_kept_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="promises"):
        load_shape(draco_file(tmp_path / "a.glb", -1))
    with pytest.raises(InputError, match="promises too much"):
        load_shape(meshopt_file(tmp_path / "b.glb", 0, 80_000_000))


def draco_document(count: int, primitives: int = 1, size: int = 4) -> dict[str, Any]:
    """The description of points that are compressed, in primitives that share their data."""
    packed = {"bufferView": 0, "attributes": {"POSITION": 0}}
    alike = [{"attributes": {"POSITION": 0}, "extensions": {DRACO: dict(packed)}} for _ in range(primitives)]
    document: dict[str, Any] = {"meshes": [{"primitives": alike}], "buffers": [{"byteLength": size}]}
    document["accessors"] = [{"componentType": 5126, "count": count, "type": "VEC3"}]
    return document | {"bufferViews": [{"buffer": 0, "byteLength": size}]}


def asked(monkeypatch: pytest.MonkeyPatch, document: dict[str, Any], size: int = 4) -> list[Any]:
    """The questions to the decoder about a file; it answers with zeros."""
    questions = []

    def answer(_: str, jobs: list[dict[str, Any]], data: list[bytes]) -> dict[str, Any]:
        questions.append((jobs, data))
        return {f"{k} {name}": np.zeros(n, "f4") for k, job in enumerate(jobs) for name, n in job["sizes"].items()}

    monkeypatch.setattr(gltf_compressed, "_decode_in_subprocess", answer)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: True)
    gltf_compressed.decompress("a.glb", size, document, lambda _: b"1" * size, {DRACO})
    return questions


def test_data_that_primitives_share_is_decoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    document = draco_document(3, 300)
    [(jobs, data)] = asked(monkeypatch, document)
    assert len(jobs) == len(data) == 1
    assert len(document["bufferViews"]) == 2
    assert not any(each["extensions"] for each in document["meshes"][0]["primitives"])


def test_overlapping_data_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    size = 4_000_000
    document = draco_document(3, 300, size)
    document["bufferViews"] = [{"buffer": 0, "byteLength": size - k} for k in range(300)]
    for k, each in enumerate(document["meshes"][0]["primitives"]):
        each["extensions"][DRACO]["bufferView"] = k
    with pytest.raises(InputError, match="promises too much"):
        asked(monkeypatch, document, size)


def test_more_points_than_a_file_may_have_are_not_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="vertices and faces"):
        asked(monkeypatch, draco_document(5_000_000))
    with pytest.raises(InputError, match="negative"):
        asked(monkeypatch, draco_document(-5))


def test_what_is_not_promised_is_not_sent_back(tmp_path: Path) -> None:
    DracoPy = pytest.importorskip("DracoPy")
    data = DracoPy.encode(np.zeros((1000, 3), np.float32), preserve_order=True)
    path = write(tmp_path / "a.glb", data, DRACO, **draco_document(3, 1, len(data)))
    with pytest.raises(InputError, match="decoded: it promises 9 numbers of POSITION, and holds 3000"):
        load_shape(path)


def test_an_unknown_filter_is_refused_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: True)
    inside = {"buffer": 0, "byteLength": 4, "byteStride": 4, "count": 1, "mode": "ATTRIBUTES", "filter": "COLOR"}
    view = {"buffer": 0, "byteLength": 4, "extensions": {"KHR_meshopt_compression": inside}}
    document = {"bufferViews": [view], "buffers": [{"byteLength": 4}]}
    path = write(tmp_path / "a.glb", b"1234", "KHR_meshopt_compression", **document)
    with pytest.raises(InputError, match="filter COLOR") as caught:
        load_shape(path)
    assert "without mesh compression" in caught.value.hint


@pytest.mark.parametrize("extension", [DRACO, MESHOPT, "KHR_meshopt_compression"])
def test_without_the_library_the_line_names_it(tmp_path: Path, extension: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    path = write(tmp_path / "a.glb", b"", extension)
    with pytest.raises(InputError, match=rf"compressed \({extension}\), which needs") as caught:
        load_shape(path)
    assert "meshmatch[compressed]" in caught.value.hint
