"""Writing a textured OBJ: the mesh, its mtl, and the name of its image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshmatch.shapes.formats.textured import Textured


def write_textured(path: Path, mesh: Textured, mtl: str, material: str) -> None:
    """Vertices and faces exactly as they are, texture coordinates listed apart: seams split nothing.

    `mtl` is the name of the material file beside it, `material` that of the only material in it.
    """
    pairs = mesh.uv.reshape(-1, 2).astype("<f4")
    unique, index = np.unique(pairs, axis=0, return_inverse=True)
    lines = ["# meshmatch", f"mtllib {mtl}"]
    lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in mesh.verts.tolist()]
    lines += [f"vt {u!r} {1.0 - v!r}" for u, v in unique.astype(np.float64).round(8).tolist()]
    lines.append(f"usemtl {material}")
    table = np.stack([mesh.faces, index.reshape(-1, 3)], axis=2).reshape(-1, 6) + 1
    lines += [f"f {a}/{p} {b}/{q} {c}/{r}" for a, p, b, q, c, r in table.tolist()]
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", errors="surrogateescape")


def write_material(path: Path, material: str, image: str, mesh: Textured) -> None:
    """The mtl: plain paint in the colours of the image. No options of maps: not every reader knows them."""
    lines = ["# meshmatch", f"newmtl {material}", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 1"]
    lines.append(f"map_Kd {image}")
    if mesh.alpha != "opaque":
        lines.append(f"map_d {image}")
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", errors="surrogateescape")
