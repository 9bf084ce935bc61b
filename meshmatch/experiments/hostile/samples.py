"""Valid files of every kind that meshmatch reads, for `experiments.hostile` to damage."""

from __future__ import annotations

import base64
import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.sparse import csr_array

from meshmatch.experiments.hostile.learned import learned_samples
from meshmatch.maps import MAP_SUFFIXES
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.models.card import IMPLICIT, ImplicitCard, write_card
from meshmatch.models.checkpoint import save_weights as save_network
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.dressed_files import save_textured
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats import TexturedMesh
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.transfer.label_files import Labels, save_labels
from meshmatch.transfer.landmarks import at_vertices, save_landmarks
from meshmatch.transfer.value_files import Values, save_colors, save_values
from meshmatch.transfer.weight_files import SkinWeights, save_weights

LABEL_SUFFIXES = (".npy", ".txt", ".csv", ".json")
IMAGES = {"png": "PNG", "jpg": "JPEG", "webp": "WEBP", "bmp": "BMP", "tga": "TGA", "tif": "TIFF"}


@dataclass(frozen=True)
class Sample:
    """A folder with files of a family, possibly in subfolders; the first one is read, all may be damaged."""

    family: str
    folder: Path
    files: tuple[str, ...]


def small_shape() -> Shape:
    """A body of about a hundred vertices, with colors."""
    body = decimate(load_shape(bundled_folder() / "samples" / "climber.ply"), 200)
    colors = np.random.default_rng(0).random((body.V, 4))
    return Shape(body.verts, body.faces, "small.ply", colors)


def make_samples(folder: Path) -> list[Sample]:  # noqa: C901
    """Write all samples, each into its own folder, in a fixed order."""
    samples: list[Sample] = []
    shape = small_shape()
    colors = np.random.default_rng(7).random((shape.V, 4))
    cloud = Shape(shape.verts, np.empty((0, 3), np.int64), "cloud")

    def add(family: str, name: str, write: Callable[..., Any], *more: Any) -> None:
        sample_folder = folder / f"{len(samples):03d}-{family}"
        sample_folder.mkdir(parents=True)
        write(sample_folder / name, *more)
        others = sorted(set(os.listdir(sample_folder)) - {name})
        samples.append(Sample(family, sample_folder, (name, *others)))

    for suffix in (".ply", ".obj", ".off", ".stl", ".glb", ".vtk", ".vtp"):
        add("shapes", f"a{suffix}", lambda path: save_shape(path, shape))
    for suffix in (".xyz", ".npy", ".ply"):
        add("shapes", f"a{suffix}", lambda path: save_shape(path, cloud))
    for name, data in _texts().items():
        add("shapes", name, Path.write_bytes, data)
    head = b"FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 8\nHEIGHT 1\nPOINTS 8\nDATA binary\n"
    add("shapes", "a.pcd", Path.write_bytes, head + np.random.default_rng(6).random((8, 4)).astype("<f4").tobytes())
    add("shapes", "skin.gltf", lambda path: path.write_text(json.dumps(_skinned())))
    add("shapes", "apart.gltf", _write_apart)
    add("shapes", "scan.obj", _write_scan)
    for wedges in (False, True):
        add("shapes", "scan.ply", _write_textured_ply, wedges)
    paint = np.random.default_rng(0).integers(0, 256, (16, 16, 4)).astype(np.uint8)
    uv = np.random.default_rng(1).random((shape.F, 3, 2))
    for suffix in (".obj", ".glb"):
        add("shapes", f"a{suffix}", lambda path: save_textured(path, TexturedMesh(shape.verts, shape.faces, uv), paint))
    index = np.arange(shape.V)[::-1].copy()
    trust = np.linspace(0, 1, shape.V)
    metadata: dict[str, Any] = {"confidence": trust, "verdict": "fair", "reasons": ("it lies far",)}
    for suffix in MAP_SUFFIXES:
        add("maps", f"m{suffix}", lambda path: save_map(path, VertexMap.between(shape, shape, index, **metadata)))
    values = Values(np.random.default_rng(2).random((shape.V, 3)), ("a", "b", "c"))
    for suffix in (".npy", ".csv"):
        add("tables", f"v{suffix}", lambda path: save_values(path, values, shape))
    add("tables", "c.csv", lambda path: save_colors(path, shape, colors))
    commas = "".join(f"{k};{k / 7:.3f}\n".replace(".", ",") for k in range(shape.V))
    add("tables", "v.csv", Path.write_text, "vertex;a\n" + commas)
    add("lists", "p.txt", lambda path: path.write_text("# pairs\n" + "".join(f"{k} {k + 1}\n" for k in range(40))))
    add("lists", "p.npy", lambda path: np.save(path, np.arange(60).reshape(-1, 2)))
    add("known points", "k.npy", lambda path: np.save(path, shape.verts[:9]))
    add("known points", "k.txt", lambda path: np.savetxt(path, shape.verts[:9]))
    add("names", "pairs.txt", Path.write_text, "# source, target\negg 1,egg 2\negg0\tegg3\negg4 egg5\n")
    for suffix in (".txt", ".csv"):
        add("names", f"group{suffix}", Path.write_text, "egg0\negg1.ply\negg 2\n")
    for suffix in (".npz", ".json", ".csv"):
        add("poses", f"p{suffix}", _write_poses)
    points = np.random.default_rng(10).standard_normal((200, 3))  # in and around a ball, or on it
    length = np.linalg.norm(points, axis=1, keepdims=True)
    add("samples", "s.npz", lambda path: np.savez(path, points=points, distances=length[:, 0] - 1))
    add("samples", "s.npz", lambda path: np.savez(path, points=points / length, normals=points / length))
    for named in (False, True):
        names = ("arm", "leg", "head") if named else (3, 5, 9)
        labels = Labels(np.arange(shape.V) % 3, names, "vertices")
        for suffix in LABEL_SUFFIXES:
            add("labels", f"l{suffix}", save_labels, labels, shape)
    add("labels", "l.csv", Path.write_text, "vertex;label\n" + "".join(f"{k};{k % 3}\n" for k in range(shape.V)))
    add("labels", "l.txt", Path.write_text, "".join(f"{k % 3:.3e}\n" for k in range(shape.V)))
    matrix = csr_array(np.random.default_rng(3).dirichlet(np.ones(4), shape.V))
    for suffix in (".npz", ".json"):
        add("weights", f"w{suffix}", lambda path: save_weights(path, SkinWeights(matrix, tuple("abcd"))))
    for name in ("k.csv", "k.json", "k.pp", "k.fcsv", "k.mrk.json"):
        add("landmarks", name, save_landmarks, at_vertices(shape, np.arange(5), ("nose", "knee", "l", "r", "x")))
    lines = [" ".join(map(str, point)) for point in shape.verts[:4].tolist()]
    add("landmarks", "k.pts", Path.write_text, "version: 1\nn_points: 4\n{\n" + "\n".join(lines) + "\n}\n")
    add("landmarks", "k.tps", Path.write_text, "LM3=4\n" + "\n".join(lines) + "\nID=small\nSCALE=1\n")
    add("landmarks", "k.txt", Path.write_text, "".join(f"p\t{point}\n".replace(" ", "\t") for point in lines))
    add("landmarks", "k.npy", lambda path: np.save(path, np.append(shape.verts[:3], [[np.nan] * 3], axis=0)))
    for suffix, kind in IMAGES.items():
        add("images", f"i.{suffix}", Path.write_bytes, _image(paint, kind))
    built_in = bundled_folder() / "models" / "human"
    add("cards", "card.json", lambda path: shutil.copyfile(built_in / "card.json", path))
    add("cards", IMPLICIT, lambda path: write_card(_implicit(), path))
    state = {"a.weight": np.random.default_rng(4).random((4, 70)), "a.bias": np.zeros(4)}
    for storage in ("int8", "float16", "float32"):
        add("safetensors", "w.safetensors", lambda path, kind: save_network(state, path, storage=kind), storage)
    add("templates", "t.safetensors", lambda path: shutil.copyfile(built_in / "template.safetensors", path))
    for family, sample_folder, name in learned_samples(folder / "learned"):
        files = sorted(str(path.relative_to(sample_folder)) for path in sample_folder.rglob("*") if path.is_file())
        samples.append(Sample(family, sample_folder, (name, *(other for other in files if other != name))))
    return samples


def write_small_model(folder: Path) -> None:
    """Copy a bundled model."""
    built_in = bundled_folder() / "models" / "hand"
    shutil.copytree(built_in, folder)
    card = json.loads((built_in / "card.json").read_bytes()) | {"name": folder.name}
    (folder / "card.json").write_text(json.dumps(card), encoding="utf-8")


def _image(paint: np.ndarray, kind: str) -> bytes:
    out = BytesIO()
    options = {"compression": "tiff_lzw"} if kind == "TIFF" else {}
    Image.fromarray(paint[..., :3]).save(out, kind, **options)
    return out.getvalue()


def _implicit() -> ImplicitCard:
    return ImplicitCard(
        "chair", "chairs", {"field": "mls"}, ["a", "b"], [[1.0, 0, 0, 0], [2.0, 0, 0, 1.0]], "two chairs", "CC0-1.0", {},
        0, 1, 0.5, "ab" * 32, "2026-01-31",
    )  # fmt: skip


def _texts() -> dict[str, bytes]:
    """Files as only other programs write them: text, big-endian, strips, polygons, unusual colors and counts."""
    places = np.random.default_rng(5).random((9, 3))
    rows = "".join(" ".join(f"{x:.4f}" for x in row) + "\n" for row in places)
    head = "ply\nformat {} 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face 3\nproperty list uchar int vertex_indices\n"
    strips = "element tristrips {}\nproperty list int int vertex_indices\nend_header\n"
    painted = "property uchar diffuse_red\nproperty uchar diffuse_green\nproperty uchar diffuse_blue\n"
    mixed = "3 0 1 2\n4 2 3 4 5\n5 4 5 6 7 8\n"
    swapped = head.format("binary_big_endian") + faces + "end_header\n"
    big = b"".join(bytes([3]) + np.array([k, k + 1, k + 2], ">i4").tobytes() for k in range(3))
    corner = "0 0 0\n2 0 0\n2 2 0\n1 0.5 0\n0 2 0\n"  # corners of a concave polygon
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    triangles = np.zeros(3, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles["corners"] = places.reshape(3, 3, 3)
    stl = b"COLOR=\xff\0\0\xff".ljust(80, b"\0")
    texts = {
        "text.ply": head.format("ascii") + faces + "end_header\n" + rows + mixed,
        "strips.ply": head.format("ascii") + strips.format(1) + rows + "8 0 1 2 3 -1 4 5 6\n",
        "rows.ply": head.format("ascii") + strips.format(2) + rows + "4 0 1 2 3\n3 4 5 6\n",
        "indexes.ply": (head.format("ascii") + painted + faces + "end_header\n").replace("vertex_indices", "VertexIndexes")
        + rows.replace("\n", " 255 0 7\n") + mixed,
        "text.stl": f"solid k\u00f6rper\n{facet}{facet}",
        "concave.off": f"OFF\n5 1 0\n{corner}5 0 1 2 3 4 255 0 0\n",
        "polypaint.obj": re.sub("(?m)^(?=.)", "v ", corner) + "#MRGB " + "ffff0000" * 5 + "\nf 1 2 3 4 5\n",
        "comma.xyz": rows.replace(".", ","), "head.xyz": "//X Y Z R G B\n9\n" + rows.replace("\n", " 1 2 3\n"),
    }  # fmt: skip
    return {name: text.encode("utf-16" if name == "head.xyz" else "utf-8") for name, text in texts.items()} | {
        "big.ply": swapped.encode() + places.astype(">f4").tobytes() + big,
        "count.stl": stl + b"\0" * 4 + triangles.tobytes(),
        "tail.stl": stl + np.array(3, "<u4").tobytes() + triangles.tobytes() + b"a tail of other data",
    }  # fmt: skip


def _write_scan(path: Path) -> None:
    """Write an obj as scanning programs do: a path in a comment, opacity as Tr, names in another case."""
    path.with_name("Scan.MTL").write_text("# C:\\scan\\\nnewmtl skin\nTr 1\nd 1.0\nmap_Kd .\\K\u00f6 rper.PNG\n")
    path.with_name("k\u00f6 rper.png").write_bytes(_image(np.zeros((2, 2, 4), np.uint8), "PNG"))
    path.write_text(
        "\ufeff# D:\\\nmtllib scan.mtl\nv 0 0 0 \\\n 1 0 0\nv 2 0 0 1 0 0\nv 2 2 0 1 0 0\nv 1 0.5 0 1 0 0\nv 0 2 0 1 0 0\n"
        "vt 0 0\nvt 1 1\nusemtl Skin\nf 1/1 2/2 3/2 4/1 5/1\n"
    )


def _write_textured_ply(path: Path, wedges: bool) -> None:
    """Write a square with texture coordinates of corners or of vertices."""
    path.with_name("a b.png").write_bytes(_image(np.zeros((2, 2, 4), np.uint8), "PNG"))
    vertex_extra = "" if wedges else "property float s\nproperty float t\n"
    face_extra = "property list uchar float texcoord\nproperty int texnumber\n" if wedges else ""
    path.write_text(
        f"ply\nformat ascii 1.0\ncomment TextureFile A%20b.png\nelement vertex 4\nproperty double x\nproperty double y\n"
        f"property double z\n{vertex_extra}element face 2\nproperty list uchar int vertex_indices\n{face_extra}end_header\n"
        + "".join(f"{x} {y} 0{'' if wedges else f' {x} {y}'}\n" for x in (0, 1) for y in (0, 1))
        + "".join(f"3 {row}{' 6 0 0 1 0 0 1 0' if wedges else ''}\n" for row in ("0 2 1", "1 2 3"))
    )


def _write_poses(path: Path) -> None:
    joints, vectors = ["root", "head"], np.random.default_rng(9).uniform(-1, 1, (3, 2, 3))
    if path.suffix == ".npz":
        np.savez(path, joints=np.array(joints), rotations=vectors)
    elif path.suffix == ".json":
        path.write_text(json.dumps({"joints": joints, "rotations": vectors.tolist()}))
    else:
        rows = [[p, joint, *vectors[p, j]] for p in range(3) for j, joint in enumerate(joints)]
        path.write_text("pose,joint,x,y,z\n" + "".join(",".join(map(str, row)) + "\n" for row in rows))


def _write_apart(path: Path) -> None:
    """Write a gltf whose buffer and image are separate files."""
    gltf = _skinned()
    for part, name in ((gltf["buffers"][0], "apart.bin"), (gltf["images"][0], "apart.png")):
        path.with_name(name).write_bytes(base64.b64decode(part["uri"].partition("base64,")[2]))
        part["uri"] = name
    path.write_text(json.dumps(gltf))


def _skinned() -> dict[str, Any]:
    """A square with two joints and a texture, and a second mesh that is far away, instanced, and hidden."""
    parts = [
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4"), np.array([0, 1, 2, 1, 3, 2], "<u2"),
        np.array([[0, 1, 0, 0]] * 4, "<u2"), np.array([[0.75, 0.25, 0, 0]] * 4, "<f4"), np.ones((4, 3), "<f4"),
        np.array([[0, 0], [1, 0], [0, 1], [1, 1]], "<f4"), np.tile(np.eye(4, dtype="<f4").reshape(1, 16), (2, 1)),
    ]  # fmt: skip
    kinds, widths = {"float32": 5126, "uint16": 5123}, {2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
    accessors, views, data = [], [], b""
    for k, array in enumerate(parts):
        kind = "SCALAR" if array.ndim == 1 else widths[array.shape[1]]
        accessors.append({"bufferView": k, "count": len(array), "componentType": kinds[array.dtype.name], "type": kind})
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        data += array.tobytes() + b"\0" * (-array.nbytes % 4)
    image = base64.b64encode(_image(np.zeros((2, 2, 4), np.uint8), "PNG")).decode()
    texture = {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2], "rotation": 1}}}
    attributes = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3, "COLOR_0": 4, "TEXCOORD_0": 5}
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 2, 3, 4]}],
        "nodes": [
            {"name": "hip", "children": [1], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}, {"name": "knee"},
            {"name": "body", "mesh": 0, "skin": 0}, {"name": "stone", "mesh": 1, "translation": [5e5, 4e6, 1],
                "extensions": {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 0}}}},
            {"name": "ghost", "mesh": 1, "extensions": {"KHR_node_visibility": {"visible": False}}},
        ],
        "extensionsRequired": ["EXT_mesh_gpu_instancing", "KHR_materials_unlit"],
        "meshes": [
            {"name": "skin", "primitives": [{"attributes": attributes, "indices": 1, "material": 0}]},
            {"primitives": [{"attributes": {"POSITION": 0}, "mode": 5}]},
        ],
        "materials": [{"name": "m", "pbrMetallicRoughness": {"baseColorTexture": texture}, "alphaMode": "BLEND"}],
        "textures": [{"source": 0, "sampler": 0}], "samplers": [{"wrapS": 33071}],
        "images": [{"uri": f"data:image/png;base64,{image}"}],
        "skins": [{"joints": [1, 0], "inverseBindMatrices": 6}], "accessors": accessors, "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": f"data:;base64,{base64.b64encode(data).decode()}"}],
    }  # fmt: skip
