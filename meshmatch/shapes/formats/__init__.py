"""One module per file format: bytes to plain arrays, and a `Shape` to bytes.

A map answers for every vertex of a file, so readers keep them all, in order, and never allocate what a header merely
promises. STL goes through trimesh. The other readers are our own, because of what trimesh 5.2 does (measured):

- ply: text takes 1.4 s instead of 0.4 s for 164,000 vertices; importing trimesh takes 0.7 s, and ply is what
  benchmarks and scans come in. Triangle strips become points, and 16-bit colours lose their upper byte.
- obj: a file with several materials becomes several meshes, each with all the vertices.
- off: vertex colours are lost, and a face that is cut short vanishes without a word.
- gltf: meshes come in another order than the scene's (`Rogue.glb`), skins are ignored, strips without indices fail.

Its writers round: ply to 32 bits, off to ten digits and obj to eight behind the point (1e-20 becomes 0), colours of
glb to 8 bits of linear light, too few for dark ones. Ours keep every bit of ply, off and obj positions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError


@dataclass(frozen=True, eq=False)
class Raw:
    """What a file says, unchecked: positions (V, 3), maybe NaN; faces (F, 3), sRGB colours (V, 4) in 0..1."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    colors: Float[Floats, "V 4"] | None = None


NO_FACES = np.empty((0, 3), np.int64)


def damaged(name: str, what: str) -> InputError:
    """The error for a file that does not hold what it promises."""
    return InputError(f"{name}: {what[:300]}", "the file is damaged or was cut short; export or download it again")


def fan(corners: Int[Ints, " N"], sizes: Int[Ints, " P"]) -> Int[Ints, "F 3"]:
    """Triangles (F, 3) of polygons: `corners` one polygon after the other, `sizes` how many each has.

    A polygon a b c d ... becomes a b c, a c d, ...; one of fewer than 3 corners becomes nothing.
    """
    if len(sizes) and (sizes == 3).all():
        return corners.reshape(-1, 3)
    starts = np.cumsum(sizes) - sizes
    triangles = np.maximum(sizes - 2, 0)
    first = np.repeat(starts, triangles)
    step = np.arange(len(first)) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([corners[first], corners[first + step + 1], corners[first + step + 2]], axis=1).reshape(-1, 3)
