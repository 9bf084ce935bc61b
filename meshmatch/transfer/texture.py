"""A texture carried from one shape to another along a map: the parts put together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.formats.textured import Textured
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.bake import Baked, BakeOptions, bake
from meshmatch.transfer.material_sampler import MaterialSampler
from meshmatch.transfer.surface_walk import walker_of
from meshmatch.transfer.texel_locator import images_of
from meshmatch.transfer.unwrap import Atlas

LARGEST = 8192
"""Texels along a side."""


@dataclass(frozen=True, eq=False)
class BakedMesh:
    """The target with its texture, ready to be written (`meshmatch.shapes.textured_files`)."""

    mesh: Textured
    baked: Baked


def check_bake_options(choices: BakeOptions) -> None:
    """Refuse sizes that cannot be (`OptionError`)."""
    if not 16 <= choices.size <= LARGEST:
        raise OptionError(
            f"a texture has 16 to {LARGEST} texels a side, not {choices.size}", "1024 or 2048 suit most"
        )
    if not 1 <= choices.samples <= 8:
        raise OptionError(f"a texel takes 1 to 8 samples each way, not {choices.samples}", "2 or 3 suit most")
    if not 0 <= choices.padding <= choices.size // 4:
        raise OptionError(
            f"padding of {choices.padding} texels does not go with {choices.size}",
            f"choose 0 to {choices.size // 4}",
        )


def transfer_texture(
    source: Shape,
    look: Appearance,
    target: Shape,
    back: VertexMap,
    atlas: Atlas,
    choices: BakeOptions = BakeOptions(),  # noqa: B008  # frozen
    tell: Callable[[float], None] = lambda share: None,
) -> BakedMesh:
    """Bake the look of a source for a target mesh.

    Parameters
    ----------
    look : Appearance
        Of the source's file (`load_appearance`).
    back : VertexMap
        From target to source (`pipeline.carry(...).back`).
    atlas : Atlas
        Of the target (`meshmatch.transfer.unwrap.atlas_of`), for the size and padding of `choices`.
    tell : callable
        Gets the share that is done.

    Raises
    ------
    OptionError
        Sizes that are out of range.
    """
    check_bake_options(choices)
    ground = walker_of(source)
    coat = MaterialSampler(_of_faces(look, source), ground)
    uv = atlas.uv
    if target.invalid is not None:  # a face with a corner nowhere is no face
        sound = ~target.invalid[target.faces].any(axis=1)
        target, uv = Shape(target.verts, target.faces[sound], target.name), uv[sound]
    baked = bake(coat, ground, target, back, uv, choices, tell)
    mesh = Textured(target.verts, target.faces, uv, baked.alpha, baked.cutoff)
    return BakedMesh(mesh, baked)


def colors_of_vertices(source: Shape, look: Appearance, target: Shape, back: VertexMap) -> Floats:
    """(V_tgt, 4) linear colours and alpha of a target's vertices or points, as wide as the gaps between them."""
    ground = walker_of(source)
    coat = MaterialSampler(_of_faces(look, source), ground)
    points, start = images_of(ground, back)
    place, weights, _ = ground.closest(points.T.astype(np.float32, order="C"), start.astype(np.int32))
    reach = np.sqrt(target.vertex_areas / max(target.area, 1e-300)).astype(np.float32)
    return coat.colors(place, weights, coat.footprint(place, reach)).T.astype(np.float64)


def _of_faces(look: Appearance, source: Shape) -> Appearance:
    """The look; that of a cloud with each point as a face."""
    if not source.is_cloud:
        return look
    return Appearance(look.materials, np.zeros(source.V, np.int64), np.zeros((source.V, 3, 2)), look.colors)
