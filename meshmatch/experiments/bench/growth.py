"""Scaling of each step's cost with the number of parts, holes, names, materials, images or joints of a file.

Files and shapes with 100, 1,000 and 10,000 of each are generated, and reading, repairing or transferring them is timed in
CPU seconds. The exponent is that of a power law through the two largest counts: 1 is linear, 2 quadratic. Constant costs
lower the exponents, so that only rows of at least some seconds are informative.
"""

from __future__ import annotations

import base64
import io
import json
import math
import tempfile
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL import Image
from typer import Option

from meshmatch.arrays import Floats, Ints
from meshmatch.experiments import runner
from meshmatch.fitting.fitter import boundary_length
from meshmatch.maps.parts import match_parts
from meshmatch.maps.places import Places
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf_attributes import read_skin
from meshmatch.shapes.hidden_faces import remove_hidden_faces
from meshmatch.shapes.repair import repair
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.textured_files import load_appearance
from meshmatch.transfer.attributes import pull_labels
from meshmatch.transfer.landmarks import at_vertices, push_landmarks
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import MaterialSampler

Step = Callable[[], object]


def grid(side: int) -> tuple[Floats, Ints]:
    """Build a square of 2 (side - 1)^2 triangles; the two triangles of a cell are consecutive."""
    across, up = np.meshgrid(np.arange(side), np.arange(side))
    at = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    verts = np.stack([across, up, 0.1 * np.sin(across)], axis=2).reshape(-1, 3).astype(float)
    return verts, np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def loose(n: int, gap: float = 0.0) -> Shape:
    """Build n triangles of a square without shared vertices, each shrunk about its centroid by the fraction ``gap``."""
    verts, faces = grid(math.isqrt(n // 2) + 2)
    corners = verts[faces[:n]]
    middle = corners.mean(axis=1, keepdims=True)
    return Shape((middle + (1 - gap) * (corners - middle)).reshape(-1, 3), np.arange(3 * n).reshape(-1, 3))


def repair_and_check(shape: Shape) -> object:
    """Repair a shape and run the checks that precede a fit."""
    clean = repair(shape).shape
    return boundary_length(clean), remove_hidden_faces(clean)


def holes(n: int, _: Path) -> Step:
    """Repair and check a square with n holes, one in each block of three by three cells."""
    side = 3 * math.isqrt(n - 1) + 4
    verts, faces = grid(side)
    cell = np.arange(len(faces)) // 2
    row, column = np.divmod(cell, side - 1)
    hole = (row % 3 == 1) & (column % 3 == 1)
    return lambda: repair_and_check(Shape(verts, faces[~hole]))


def parts_to_parts(n: int, _: Path) -> Step:
    """Match the parts of four plates, each with a quarter of n separate triangles that map near themselves."""
    verts, faces = grid(6)
    small = loose(max(n // 4, 1), 0.5)
    pieces = [(verts + np.array([0, 0, 9 * k]), faces) for k in range(4)]
    pieces += [(0.05 * small.verts + np.array([0, 0, 9 * k]), small.faces) for k in range(4)]
    starts = np.cumsum([0, *(len(piece) for piece, _ in pieces)])
    points = np.concatenate([piece for piece, _ in pieces]).astype(np.float32)
    corners = np.concatenate([own + start for (_, own), start in zip(pieces, starts, strict=False)]).astype(np.int32)
    zeros, stands = np.zeros(len(points), np.float32), np.arange(len(points), dtype=np.int32)

    def places(name: str, moved: float) -> Places:
        at = points + np.float32(moved)
        return Places(
            name=name,
            hash=name,
            template_hash="",
            resting=at,
            height=zeros,
            distance=zeros,
            moved=None,
            spread=None,
            stands=stands,
            faces=corners,
            fitted=np.ones(len(corners), bool),
            verdict="good",
        )

    source, target = places("a", 0.0), places("b", 0.01)
    return lambda: match_parts(source, target, target.nearest(source.resting))


def scene(path: Path, nodes: list[dict[str, Any]], **more: Any) -> Path:
    """Write a glTF whose nodes share one triangle."""
    values = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4"), np.array([[0, 0], [1, 0], [0, 1]], "<f4")
    bones, weights = np.zeros((3, 4), "<u1"), np.tile(np.array([1, 0, 0, 0], "<f4"), (3, 1))
    data = b"".join(array.tobytes() for array in (*values, bones, weights))
    kinds = ((5126, "VEC3"), (5126, "VEC2"), (5121, "VEC4"), (5126, "VEC4"))
    starts = np.cumsum([0, 36, 24, 12]).tolist()
    record = {
        "asset": {"version": "2.0"},
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}}]}],
        "accessors": [
            {"bufferView": 0, "byteOffset": start, "componentType": kind, "count": 3, "type": width}
            for start, (kind, width) in zip(starts, kinds, strict=True)
        ],
        "bufferViews": [{"buffer": 0, "byteLength": len(data)}],
        "buffers": [{"byteLength": len(data), "uri": _uri("application/octet-stream", data)}],
    }
    path.write_text(json.dumps(record | more))
    return path


@cache
def png() -> bytes:
    """An image of one red texel."""
    data = io.BytesIO()
    Image.new("RGB", (1, 1), "red").save(data, "png")
    return data.getvalue()


def _uri(kind: str, data: bytes) -> str:
    """Encode data as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def nodes(n: int, folder: Path) -> Step:
    """Read a scene of n nodes with the same name, selected by a pattern."""
    made = [{"mesh": 0, "name": "same", "translation": [float(k), 0, 0]} for k in range(n)]
    path = scene(folder / "nodes.gltf", made)
    return lambda: load_shape(path, only="s*e")


def chain(n: int, folder: Path) -> Step:
    """Read a chain of nodes, all of which are joints with the same name and draw a mesh."""
    made: list[dict[str, Any]] = [{"mesh": 0, "skin": 0, "name": "same", "children": [k + 1]} for k in range(n)]
    made[-1].pop("children")
    path = scene(folder / "chain.gltf", made, skins=[{"joints": list(range(n))}])

    def read() -> object:
        return load_shape(path), read_skin(path, path.read_bytes())

    return read


def morphs(n: int, folder: Path) -> Step:
    """Read a mesh with n morph targets."""
    mesh = {"primitives": [{"attributes": {"POSITION": 0}, "targets": [{"POSITION": 0}] * n}], "weights": [0.0] * n}
    path = scene(folder / "morphs.gltf", [{"mesh": 0}], meshes=[mesh])
    return lambda: load_shape(path)


def images(n: int, folder: Path) -> Step:
    """Sample a scene with a mesh, a material and an image for each node."""
    attributes = {"POSITION": 0, "TEXCOORD_0": 1}
    path = scene(
        folder / "images.gltf",
        [{"mesh": k, "translation": [float(k), 0, 0]} for k in range(n)],
        meshes=[{"primitives": [{"attributes": attributes, "material": k}]} for k in range(n)],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(n)],
        textures=[{"source": k} for k in range(n)],
        images=[{"uri": _uri("image/png", png())} for _ in range(n)],
    )
    return lambda: sample_colors(path)


def materials(n: int, folder: Path) -> Step:
    """Sample an obj with n materials that share an image; each triangle is a chart."""
    path, shape = folder / "materials.obj", loose(n, 0.1)
    (folder / "m.png").write_bytes(png())
    (folder / "m.mtl").write_text("".join(f"newmtl m{k}\nKd 1 0 0\nmap_Kd m.png\n" for k in range(n)))
    rows = [f"v {x} {y} {z}" for x, y, z in shape.verts.tolist()] + ["vt 0 0", "vt 1 0", "vt 0 1"]
    rows += [f"g g{k}\nusemtl m{k}\nf {3 * k + 1}/1 {3 * k + 2}/2 {3 * k + 3}/3" for k in range(n)]
    path.write_text("\n".join(["mtllib m.mtl", *rows, ""]))
    return lambda: sample_colors(path)


def sample_colors(path: Path) -> object:
    """Read a file with its appearance and sample the color at the centroid of each face."""
    shape = load_shape(path)
    sampler = MaterialSampler(load_appearance(path, shape), SurfaceWalker(shape))
    third = np.full((3, shape.F), 1 / 3, np.float32)
    return sampler.colors(np.arange(shape.F), third, np.ones(shape.F, np.float32))


def labels(n: int, _: Path) -> Step:
    """Transfer n labels of vertices."""
    verts, faces = grid(math.isqrt(n) + 2)
    shape = Shape(verts, faces)
    return lambda: pull_labels(VertexMap.identity(shape), shape, np.minimum(np.arange(shape.V), n - 1))


def landmarks(n: int, _: Path) -> Step:
    """Transfer n landmarks."""
    verts, faces = grid(math.isqrt(n) + 2)
    shape = Shape(verts, faces)
    return lambda: push_landmarks(VertexMap.identity(shape), shape, shape, at_vertices(shape, np.arange(n)))


STEPS: dict[str, Callable[[int, Path], Step]] = {
    "parts": lambda n, _: lambda: repair_and_check(loose(n, 0.1)),
    "parts to parts": parts_to_parts,
    "boundary loops": holes,
    "duplicate vertices": lambda n, _: lambda: repair_and_check(loose(n)),
    "nodes and names": nodes,
    "joints in a chain": chain,
    "morph targets": morphs,
    "images": images,
    "materials and charts": materials,
    "labels": labels,
    "landmarks": landmarks,
}
COUNTS = 100, 1_000, 10_000
COLUMNS = {"many": "step", "100": "100:.3f", "1,000": "1000:.3f", "10,000": "10000:.3f", "exponent": "exponent:.2f"}


@runner.command
def main(
    steps: Annotated[str, Option(help=f"of {', '.join(STEPS)}")] = ",".join(STEPS),
    most: Annotated[int, Option(min=1_000, help="leave out larger counts")] = 10_000,
) -> runner.Report:
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in runner.track(runner.split_names(steps, STEPS, "step"), "running"):
            row: dict[str, Any] = {"step": name}
            STEPS[name](10, Path(folder))()  # warm-up: imports and caches are not counted
            for count in [count for count in COUNTS if count <= most]:
                step = STEPS[name](count, Path(folder))
                began = time.process_time()
                step()
                row[str(count)] = round(time.process_time() - began, 4)
            before, last = [max(row[str(count)], 1e-4) for count in COUNTS if count <= most][-2:]
            row["exponent"] = round(math.log10(last / before), 2)
            rows.append(row)
    return runner.Report({"rows": rows}, [runner.table("Seconds of CPU", rows, COLUMNS)])
