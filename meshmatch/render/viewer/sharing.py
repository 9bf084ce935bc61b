"""The look of one shape, carried by the map so that both wear it."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import InputError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.viewer.looks import Looks
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.bake import BakeOptions
from meshmatch.transfer.texture import colors_of_vertices, transfer_texture
from meshmatch.transfer.unwrap import atlas_of

TEXELS = 1024
"""Width and height of a texture that is baked for a page."""
MOST_FACES = 40_000
"""A finer mesh wears colours of vertices: they show nearly as much, and it is unwrapped for a minute."""


def share_look(
    shapes: tuple[Shape, Shape],
    own: tuple[Appearance | None, Appearance | None],
    there: VertexMap,
    back: VertexMap,
    *,
    coordinates: tuple[Floats | None, Floats | None] = (None, None),
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
        (F, 3, 2) texture coordinates of both files, which are baked to where they serve.
    """
    first, second = own
    if first is not None:
        worn = _carried(first, shapes[0], shapes[1], back, coordinates[1], workers)
        return Looks("source", (first, worn), second)
    if second is not None:
        worn = _carried(second, shapes[1], shapes[0], there, coordinates[0], workers)
        return Looks("target", (worn, second))
    return None


def _carried(
    look: Appearance, owner: Shape, wearer: Shape, back: VertexMap, coordinates: Floats | None, workers: int
) -> Appearance:
    """A look of `owner` on `wearer`, by a map from `wearer` to `owner`: baked, or as colours of vertices."""
    if look.textured and 0 < wearer.F <= MOST_FACES:
        choices = BakeOptions(size=TEXELS, padding=4, workers=workers)
        try:
            atlas = atlas_of(wearer, coordinates, choices.size, choices.padding)
            baked = transfer_texture(owner, look, wearer, back, atlas, choices).baked
        except InputError:  # no surface to speak of, or none that can be unwrapped
            pass
        else:
            material = Material("", baked.image, wrap=("clamp", "clamp"), alpha=baked.alpha, cutoff=baked.cutoff)
            return Appearance((material,), np.zeros(wearer.F, np.int64), atlas.uv)
    colors = colors_of_vertices(owner, look, wearer, back)
    return Appearance((Material(),), np.zeros(wearer.F, np.int64), np.zeros((wearer.F, 3, 2)), colors)
