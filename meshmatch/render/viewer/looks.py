"""The textures or colors that two shapes have on a page: those of one file, transferred by the map to the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.viewer.display_mesh import DisplayMesh
from meshmatch.render.viewer.packing import to_bytes
from meshmatch.render.viewer.skins import make_skin
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import LINEAR_OF_BYTE, to_srgb
from meshmatch.transfer.bake import BakeOptions
from meshmatch.transfer.texture import colors_of_vertices, transfer_texture
from meshmatch.transfer.unwrap import atlas_of

SideName = Literal["source", "target"]


TEXTURE_SIZE = 1024
"""Width and height of a texture that is baked for a page, in pixels."""
MAX_BAKED_FACES = 40_000
"""A finer mesh gets vertex colors instead: nearly as detailed, and unwrapping it would take a minute."""


@dataclass(frozen=True, eq=False)
class Looks:
    """One look on two shapes.

    Parameters
    ----------
    side
        Whose look it is.
    shared
        Of source and target; one of them was transferred.
    own
        What the other one has in its own file.
    """

    side: SideName
    shared: tuple[Appearance, Appearance]
    own: Appearance | None = None

    @property
    def words(self) -> dict[str, Any]:
        """For the page's buttons and legend."""
        textured = self.shared[0 if self.side == "source" else 1].textured
        kind = "texture" if textured else "colours"
        return {"look": {"kind": kind, "side": self.side}, "own": self.own is not None}

    def of(self, k: int) -> list[tuple[str, Appearance]]:
        """The looks of one shape (0 the source, 1 the target), each with its name in the page."""
        found = [("look", self.shared[k])]
        if self.own is not None:
            itself = k == (0 if self.side == "source" else 1)
            found.append(("own", self.shared[k] if itself else self.own))
        return found


def share_look(
    shapes: tuple[Shape, Shape],
    own: tuple[Appearance | None, Appearance | None],
    there: VertexMap,
    back: VertexMap,
    *,
    coordinates: tuple[Float[Floats, "F 3 2"] | None, Float[Floats, "G 3 2"] | None] = (None, None),
    workers: int = 1,
) -> Looks | None:
    """The source's look on both shapes; the target's if the source has none; None if neither has one.

    Parameters
    ----------
    own
        What source and target have in their files.
    there, back
        From source to target, and from target to source.
    coordinates
        Texture coordinates of both files, which are baked to where they are valid.
    workers
        Threads of the baking.
    """
    first, second = own
    if first is not None:
        other = _transferred(first, shapes[0], shapes[1], back, coordinates[1], workers)
        return Looks("source", (first, other), second)
    if second is not None:
        other = _transferred(second, shapes[1], shapes[0], there, coordinates[0], workers)
        return Looks("target", (other, second))
    return None


def _transferred(
    look: Appearance,
    owner: Shape,
    shape: Shape,
    back: VertexMap,
    coordinates: Float[Floats, "F 3 2"] | None,
    workers: int,
) -> Appearance:
    """A look of ``owner`` on ``shape``, by a map from ``shape`` to ``owner``: baked, or as vertex colors."""
    if look.textured and 0 < shape.F <= MAX_BAKED_FACES:
        choices = BakeOptions(size=TEXTURE_SIZE, padding=4, workers=workers)
        try:
            atlas = atlas_of(shape, coordinates, choices.size, choices.padding)
            baked = transfer_texture(owner, look, shape, back, atlas, choices).baked
        except InputError:  # no surface to speak of, or none that can be unwrapped
            pass
        else:
            material = Material(
                "", baked.image, wrap=("clamp", "clamp"), alpha=baked.alpha, cutoff=baked.cutoff
            )
            return Appearance((material,), np.zeros(shape.F, np.int64), atlas.uv)
    colors = colors_of_vertices(owner, look, shape, back)
    return Appearance((Material(),), np.zeros(shape.F, np.int64), np.zeros((shape.F, 3, 2)), colors)


def look_arrays(
    look: Appearance, shape: Shape, part: DisplayMesh
) -> tuple[dict[str, NDArray[Any]], dict[str, Any] | None]:
    """Arrays of a look on what is drawn of a shape, and what the page has to know about them.

    A skin where there is an image and the triangles are the file's own; otherwise ``paint`` (N, 3), a color for each
    drawn vertex, and None.
    """
    if len(part.file_face) and (look.textured or len(look.materials) > 1):
        return make_skin(look, part.faces, part.file_face)
    return {"paint": to_bytes(vertex_paint(look, shape)[part.vertex])}, None


def vertex_paint(look: Appearance, shape: Shape) -> Float[Floats, "V 3"]:
    """sRGB color at each vertex: of the last of its faces, at the nearest texel."""
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
