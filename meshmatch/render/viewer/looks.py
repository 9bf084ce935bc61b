"""What two shapes wear in a page: the look that one has in its file, and the same carried to the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats
from meshmatch.render.viewer.drawn import Drawn
from meshmatch.render.viewer.packing import to_bytes
from meshmatch.render.viewer.skins import make_skin
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.colors import LINEAR_OF_BYTE, to_srgb
from meshmatch.shapes.shape import Shape

SideName = Literal["source", "target"]


@dataclass(frozen=True, eq=False)
class Looks:
    """One look on two shapes.

    Parameters
    ----------
    side : {"source", "target"}
        Whose look it is.
    worn : (Appearance, Appearance)
        Of source and target; one of them is carried.
    own : Appearance, optional
        What the other one has in its own file.
    """

    side: SideName
    worn: tuple[Appearance, Appearance]
    own: Appearance | None = None

    @property
    def words(self) -> dict[str, Any]:
        """What the page's buttons and legend say."""
        textured = self.worn[0 if self.side == "source" else 1].textured
        kind = "texture" if textured else "colours"
        return {"look": {"kind": kind, "side": self.side}, "own": self.own is not None}

    def of(self, k: int) -> list[tuple[str, Appearance]]:
        """The looks of one shape (0 the source, 1 the target), each with its name in the page."""
        found = [("look", self.worn[k])]
        if self.own is not None:
            itself = k == (0 if self.side == "source" else 1)
            found.append(("own", self.worn[k] if itself else self.own))
        return found


def dress(look: Appearance, shape: Shape, part: Drawn) -> tuple[dict[str, NDArray[Any]], dict[str, Any] | None]:
    """Arrays and words of a look on what is drawn of a shape.

    A skin where there is an image and the triangles are the file's own; else ``paint`` (N, 3), a colour for each
    vertex that is drawn, without words.
    """
    if len(part.file_face) and (look.textured or len(look.materials) > 1):
        skin = make_skin(look, part.faces, part.file_face)
        return skin.arrays, skin.words
    return {"paint": to_bytes(vertex_paint(look, shape)[part.vertex])}, None


def vertex_paint(look: Appearance, shape: Shape) -> Floats:
    """(V, 3) the colour at each vertex as screens show it: of the last of its faces, at the nearest texel."""
    light = np.ones((shape.V, 3)) if look.colors is None else np.array(look.colors[:, :3])
    for k, material in enumerate(look.materials):
        face = np.flatnonzero(look.material == k)
        if not len(face) and shape.F:
            continue
        corner = shape.faces[face].reshape(-1) if shape.F else np.arange(shape.V)
        seen = np.tile(np.array(material.factor[:3]), (len(corner), 1))
        if material.image is not None:
            height, width = material.image.shape[:2]
            uv = look.uv[face].reshape(-1, 2)
            column, row = (
                np.floor(_wrapped(uv[:, axis], material.wrap[axis]) * size).astype(np.int64).clip(0, size - 1)
                for axis, size in ((0, width), (1, height))
            )
            seen *= LINEAR_OF_BYTE[material.image[row, column, :3]]
        at, last = np.unique(corner[::-1], return_index=True)
        light[at] *= seen[::-1][last]
    return to_srgb(light)


def _wrapped(values: Floats, wrap: str) -> Floats:
    if wrap == "repeat":
        return np.asarray(values % 1.0)
    if wrap == "mirror":
        return np.asarray(1.0 - np.abs(values % 2.0 - 1.0))
    return np.clip(values, 0.0, 1.0)
