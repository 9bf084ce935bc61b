"""A texture transferred from one shape to another along a map: the parts put together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance
from meshmatch.shapes.formats import Textured
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


def check_bake_options(options: BakeOptions) -> None:
    """Refuse sizes that are out of range, and choices that contradict each other (`OptionError`)."""
    for name in ("size", "samples", "padding", "workers"):
        if not isinstance(getattr(options, name), Integral):
            raise OptionError(f"{name} must be an integer, not {getattr(options, name)!r}")
    if options.workers < 1:
        raise OptionError(f"workers must be 1 or more, not {options.workers}")
    if options.fill and options.blank is not None:
        raise OptionError("fill and blank contradict each other", "choose one of them")
    if not 16 <= options.size <= LARGEST:
        raise OptionError(f"a texture has 16 to {LARGEST} texels a side, not {options.size}", "1024 or 2048 suit most")
    if not 1 <= options.samples <= 8:
        raise OptionError(f"a texel takes 1 to 8 samples each way, not {options.samples}", "2 or 3 suit most")
    if not 0 <= options.padding <= options.size // 4:
        raise OptionError(
            f"padding of {options.padding} texels does not go with {options.size}", f"choose 0 to {options.size // 4}"
        )


def transfer_texture(
    source: Shape,
    look: Appearance,
    target: Shape,
    back: VertexMap,
    atlas: Atlas,
    options: BakeOptions = BakeOptions(),  # frozen
    progress: Callable[[float], None] = lambda share: None,
) -> BakedMesh:
    """Bake the look of a source for a target mesh.

    Parameters
    ----------
    look : Appearance
        Of the source's file (`load_appearance`).
    back : VertexMap
        From target to source (`meshmatch.maps.build`, or `meshmatch.transfer.mapped_mesh`).
    atlas : Atlas
        Of the target (`meshmatch.transfer.unwrap.atlas_of`), for the size and padding of `options`.
    progress
        Is called with the share that is done.

    Raises
    ------
    OptionError
        Sizes that are out of range.
    """
    check_bake_options(options)
    walker = walker_of(source)
    sampler = MaterialSampler(_with_faces(look, source), walker)
    uv = atlas.uv
    if target.invalid is not None:  # faces with a corner that has no position
        valid = ~target.invalid[target.faces].any(axis=1)
        target, uv = Shape(target.verts, target.faces[valid], target.name), uv[valid]
    baked = bake(sampler, walker, target, back, uv, options, progress)
    mesh = Textured(target.verts, target.faces, uv, baked.alpha, baked.cutoff)
    return BakedMesh(mesh, baked)


def colors_of_vertices(source: Shape, look: Appearance, target: Shape, back: VertexMap) -> Floats:
    """(V_tgt, 4) linear colours and alpha of a target's vertices or points, as wide as the gaps between them."""
    walker = walker_of(source)
    sampler = MaterialSampler(_with_faces(look, source), walker)
    points, start = images_of(walker, back)
    place, weights, _ = walker.closest(points.T.astype(np.float32, order="C"), start.astype(np.int32))
    reach = np.sqrt(target.vertex_areas / max(target.area, 1e-300)).astype(np.float32)
    return sampler.colors(place, weights, sampler.footprint(place, reach)).T.astype(np.float64)


def _with_faces(look: Appearance, source: Shape) -> Appearance:
    """The look; that of a cloud with each point as a face."""
    if not source.is_cloud:
        return look
    return Appearance(look.materials, np.zeros(source.V, np.int64), np.zeros((source.V, 3, 2)), look.colors)
