"""Baking: for every texel of the target's atlas the colour of its place on the source.

A texel is a point of a triangle of the target. The map says where the triangle's corners lie on the source; the
point between these images slides onto the source (`meshmatch.transfer.surface_walk`), and the face that it ends on says
its texture coordinates: they are never interpolated across the source's seams. Colours are averaged as light.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Floats
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Alpha
from meshmatch.shapes.images import Pixels
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import bytes_of
from meshmatch.transfer.material_sampler import MaterialSampler
from meshmatch.transfer.pyramid import fill
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_locator import TexelLocator
from meshmatch.transfer.texels import beside_another, faces_on, grown

# So many texels past a seam show the surface that goes on there; further out, the nearest mean (see `pyramid`).
_OVERHANG = 2
# Texels that cover more than this of the source's are sampled several times.
_WIDE = 1.25
_CHUNK = 1 << 16


@dataclass(frozen=True)
class BakeOptions:
    """How a texture is baked.

    Parameters
    ----------
    size : int
        Texels along each side.
    samples : int
        ``samples x samples`` points in a texel that covers a seam or much detail of the source; one elsewhere.
    padding : int
        0: nothing is painted past the seams.
    min_confidence : float
        Below this a texel is in doubt.
    fill : bool
        Give those in doubt the colours of their neighbours in the atlas.
    blank : 4 numbers, optional
        Give them this: sRGB and alpha in 0..1.
    workers : int
        Threads.
    """

    size: int = 2048
    samples: int = 2
    padding: int = 8
    min_confidence: float = 0.3
    fill: bool = False
    blank: tuple[float, float, float, float] | None = None
    workers: int = 2


@dataclass(frozen=True, eq=False)
class Baked:
    """A finished texture.

    Parameters
    ----------
    image : (size, size, 4) uint8
    alpha, cutoff
        What its alpha means.
    used : float
        Share of its texels that lie on the surface.
    low, torn : float
        Shares of the surface that are in doubt, and on triangles that the map tears apart.
    """

    image: Pixels
    alpha: Alpha
    cutoff: float
    used: float
    low: float
    torn: float


def bake(
    coat: MaterialSampler,
    walker: SurfaceWalker,
    target: Shape,
    back: VertexMap,
    uv: Floats,
    choices: BakeOptions,
    tell: Callable[[float], None] = lambda share: None,
) -> Baked:
    """Paint an atlas of the target.

    Parameters
    ----------
    coat, walker
        Of the source.
    back : VertexMap
        From target to source.
    uv : (F, 3, 2) float64
        The target's atlas: u to the right, v down, within 0..1, no two triangles on one place.
    tell : callable
        Gets the share that is done.
    """
    size = choices.size
    footing = TexelLocator(walker, target, back, uv * size)
    inside = faces_on(uv * size, size)[0]
    on = grown(inside, _OVERHANG if choices.padding else 0).reshape(-1)
    texels = np.flatnonzero(on >= 0)
    pixels = np.zeros((size * size, 4), np.uint8)
    chart = np.full(size * size, -1, np.int32)
    hint = np.full(size * size, -1, np.int32)
    wide = np.zeros(size * size, bool)
    low = np.zeros(size * size, bool)

    def first(at: NDArray[np.int64]) -> None:
        face = on[at]
        row, column = np.divmod(at, size)
        weights, place, held = footing.locate(
            face, (column + 0.5).astype(np.float32), (row + 0.5).astype(np.float32)
        )
        low[at] = footing.confidence(face, weights) < choices.min_confidence
        footprint = coat.footprint(place, footing.reach.take(face))
        _store(pixels, at, coat.colors(place, held, footprint))
        chart[at], hint[at], wide[at] = coat.chart[place], place, footprint > _WIDE

    grid = (np.arange(choices.samples, dtype=np.float32) + np.float32(0.5)) / choices.samples
    steps = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)

    def again(at: NDArray[np.int64]) -> None:
        row, column = (part.astype(np.float32) for part in np.divmod(at, size))
        face, start = on[at], hint[at]
        total, plain = np.zeros((4, len(at)), np.float32), np.zeros((3, len(at)), np.float32)
        for right, down in steps:
            _, place, held = footing.locate(face, column + right, row + down, start)
            narrow = footing.reach.take(face) / np.float32(choices.samples)
            seen = coat.colors(place, held, coat.footprint(place, narrow))
            plain += seen[:3]
            seen[:3] *= seen[3]  # a transparent sample says nothing about the colour
            total += seen
        share = total[3]
        total[:3] = np.where(share > 0, total[:3] / np.where(share > 0, share, 1), plain / len(steps))
        total[3] /= len(steps)
        _store(pixels, at, total)

    done = 0.0
    with ThreadPoolExecutor(choices.workers) as pool:
        for work, share, which in (
            (first, 0.5, lambda: texels),
            (again, 0.45, lambda: _several(chart, wide, size)),
        ):
            if work is again and choices.samples == 1:
                break
            chosen = which()
            parts = [chosen[k : k + _CHUNK] for k in range(0, len(chosen), _CHUNK)]
            for count, _ in enumerate(pool.map(work, parts)):
                tell(done + share * (count + 1) / len(parts))
            done += share
    image = pixels.reshape(size, size, 4)
    held = (inside >= 0).reshape(-1)
    doubted = _share_of_surface(target, inside, low)
    alpha = _settle(image, on >= 0, low, choices, coat.alpha)
    if choices.padding == 0:
        pixels[~held] = 0
    elif alpha == "opaque":
        pixels[:, 3] = 255
    tell(1.0)
    torn = float(target.face_areas[footing.torn].sum()) / max(target.area, 1e-300)
    return Baked(image, alpha, coat.cutoff, float(held.mean()), doubted, torn)


def _several(chart: NDArray[np.int32], wide: NDArray[np.bool_], size: int) -> NDArray[np.int64]:
    """Texels that one sample does not do justice to."""
    return np.flatnonzero(wide | beside_another(chart.reshape(size, size)).reshape(-1))


def _store(pixels: Pixels, at: NDArray[np.int64], colors: NDArray[np.float32]) -> None:
    out = np.empty((len(at), 4), np.uint8)
    for k in range(3):
        out[:, k] = bytes_of(colors[k])
    out[:, 3] = np.round(np.clip(colors[3], 0, 1) * 255)
    pixels[at] = out


def _settle(
    image: Pixels, painted: NDArray[np.bool_], low: NDArray[np.bool_], choices: BakeOptions, alpha: Alpha
) -> Alpha:
    """Fill in what is not painted, and do with what is in doubt as was chosen; what alpha then means."""
    pixels = image.reshape(-1, 4)
    size = image.shape[0]
    known = painted & ~low if choices.fill or choices.blank is not None else painted
    weight = known.astype(np.float32)
    if alpha != "opaque":
        weight *= np.maximum(pixels[:, 3], 1) / np.float32(255)
    if choices.padding or choices.fill:
        fill(image, weight.reshape(size, size))
    if choices.blank is not None:
        red, green, blue, share = np.round(255 * np.array(choices.blank)).astype(np.uint8).tolist()
        pixels[low, 3] = share
        if share:  # what cannot be seen keeps the colours around it, for the filters of viewers
            pixels[low, :3] = (red, green, blue)
        if share < 255 and low.any():
            return "mask" if alpha == "opaque" and share == 0 else "blend" if alpha == "opaque" else alpha
    return alpha


def _share_of_surface(target: Shape, inside: NDArray[np.int32], low: NDArray[np.bool_]) -> float:
    """How much of the target's area has the texels that are `low`."""
    flat = inside.reshape(-1)
    held = flat >= 0
    count = np.bincount(flat[held], minlength=target.F)
    part = np.bincount(flat[held & low], minlength=target.F)
    some = count > 0
    area = target.face_areas
    return float((area[some] * part[some] / count[some]).sum() / max(area[some].sum(), 1e-300))
