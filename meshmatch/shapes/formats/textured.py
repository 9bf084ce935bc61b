"""A mesh that wears one image, ready to be written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints


@dataclass(frozen=True, eq=False)
class Textured:
    """Geometry and texture coordinates of one surface, and how its image is laid on.

    Parameters
    ----------
    verts : (V, 3) float64
        Units of the file.
    faces : (F, 3) int64
    uv : (F, 3, 2) float64
        Of each corner: u to the right, v down.
    alpha : {"opaque", "mask", "blend"}
    cutoff : float
        The threshold of "mask".
    wrap : {"clamp", "repeat"}
        What lies outside 0..1.
    """

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    uv: Float[Floats, "F 3 2"]
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    cutoff: float = 0.5
    wrap: Literal["clamp", "repeat"] = "clamp"


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
    group = np.cumsum(fresh) - 1
    new = np.empty(len(corner), np.int64)
    new[order] = number[fresh][group]
    uv = np.zeros((V + int(copies.sum()), 2), np.float64)
    uv[new] = pairs
    return np.concatenate([np.arange(V), corner[order][copies]]), uv, new.reshape(-1, 3)
