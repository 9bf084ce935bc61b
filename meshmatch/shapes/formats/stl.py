"""STL through trimesh, binary and text. It has no shared vertices: every corner of a triangle is a vertex of its own."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np

from meshmatch.shapes.formats import Raw, damaged
from meshmatch.shapes.shape import Shape


def read(path: Path, data: bytes) -> Raw:
    """3 F vertices, three for each triangle, in the file's order; several solids one after the other."""
    from trimesh.exchange.stl import load_stl  # 0.7 s to import: only where it is needed

    try:
        found = load_stl(BytesIO(data))
        solids = found["geometry"].values() if "geometry" in found else [found]
        verts = np.concatenate([np.asarray(one["vertices"], np.float64)[one["faces"]] for one in solids])
    except Exception as error:  # of whatever kind: trimesh has no class for damaged files
        raise damaged(path.name, "its triangles cannot be read, or it is not an stl file") from error
    verts = verts.reshape(-1, 3)
    return Raw(verts, np.arange(len(verts)).reshape(-1, 3))


def write(path: Path, shape: Shape) -> None:
    """Binary, 32-bit floats."""
    from trimesh.exchange.stl import export_stl

    path.write_bytes(export_stl(shape.to_trimesh()))
