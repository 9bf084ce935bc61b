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

from meshmatch.arrays import Bools, Float, Floats, Floats32, Ints, Ints32
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Alpha, Pixels
from meshmatch.shapes.colors import bytes_of
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.material_sampler import MaterialSampler
from meshmatch.transfer.pyramid import fill
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_locator import TexelLocator
from meshmatch.transfer.texels import beside_another, faces_on, grown

# So many texels past a seam show the surface that goes on there; further out, the nearest mean (see `pyramid`).
_OVERHANG = 2
# Texels that cover more than this of the source's are sampled several times.
_COARSE = 1.25
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
        Texels between charts of a new atlas; 0 also leaves the texels past the seams empty.
    min_confidence : float
        Texels with less are of low confidence.
    fill : bool
        Give those the colours of their neighbours in the atlas.
    blank : 4 numbers, optional
        Give them this colour: sRGB and alpha in 0..1.
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
        Shares of the surface of low confidence, and on triangles where the map is discontinuous.
    """

    image: Pixels
    alpha: Alpha
    cutoff: float
    used: float
    low: float
    torn: float


def bake(
    sampler: MaterialSampler,
    walker: SurfaceWalker,
    target: Shape,
    back: VertexMap,
    uv: Float[Floats, "F 3 2"],
    options: BakeOptions,
    progress: Callable[[float], None] = lambda share: None,
) -> Baked:
    """Paint an atlas of the target.

    Parameters
    ----------
    sampler, walker
        Of the source.
    back : VertexMap
        From target to source.
    uv : (F, 3, 2) float64
        The target's atlas: u to the right, v down, within 0..1, without overlaps.
    progress
        Is called with the share that is done.
    """
    size = options.size
    locator = TexelLocator(walker, target, back, uv * size)
    inside = faces_on(uv * size, size)[0]
    on = grown(inside, _OVERHANG if options.padding else 0).reshape(-1)
    texels = np.flatnonzero(on >= 0)
    pixels = np.zeros((size * size, 4), np.uint8)
    chart = np.full(size * size, -1, np.int32)
    hint = np.full(size * size, -1, np.int32)
    coarse = np.zeros(size * size, bool)
    low = np.zeros(size * size, bool)

    def first(at: Ints) -> None:
        face = on[at]
        row, column = np.divmod(at, size)
        weights, place, held = locator.locate(face, (column + 0.5).astype(np.float32), (row + 0.5).astype(np.float32))
        low[at] = locator.confidence(face, weights) < options.min_confidence
        footprint = sampler.footprint(place, locator.reach.take(face))
        _store(pixels, at, sampler.colors(place, held, footprint))
        chart[at], hint[at], coarse[at] = sampler.chart[place], place, footprint > _COARSE

    grid = (np.arange(options.samples, dtype=np.float32) + np.float32(0.5)) / options.samples
    steps = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)

    def again(at: Ints) -> None:
        row, column = (part.astype(np.float32) for part in np.divmod(at, size))
        face, start = on[at], hint[at]
        total, plain = np.zeros((4, len(at)), np.float32), np.zeros((3, len(at)), np.float32)
        for right, down in steps:
            _, place, held = locator.locate(face, column + right, row + down, start)
            narrow = locator.reach.take(face) / np.float32(options.samples)
            seen = sampler.colors(place, held, sampler.footprint(place, narrow))
            plain += seen[:3]
            seen[:3] *= seen[3]  # transparent samples do not count for the colour
            total += seen
        share = total[3]
        total[:3] = np.where(share > 0, total[:3] / np.where(share > 0, share, 1), plain / len(steps))
        total[3] /= len(steps)
        _store(pixels, at, total)

    done = 0.0
    with ThreadPoolExecutor(options.workers) as pool:
        for work, share, which in ((first, 0.5, lambda: texels), (again, 0.45, lambda: _several(chart, coarse, size))):
            if work is again and options.samples == 1:
                break
            chosen = which()
            parts = [chosen[k : k + _CHUNK] for k in range(0, len(chosen), _CHUNK)]
            for count, _ in enumerate(pool.map(work, parts)):
                progress(done + share * (count + 1) / len(parts))
            done += share
    image = pixels.reshape(size, size, 4)
    held = (inside >= 0).reshape(-1)
    low_share = _share_of_surface(target, inside, low)
    alpha = _fill_and_blank(image, on >= 0, low, options, sampler.alpha)
    if options.padding == 0:
        pixels[~held] = 0
    elif alpha == "opaque":
        pixels[:, 3] = 255
    progress(1.0)
    torn = float(target.face_areas[locator.discontinuous].sum()) / max(target.area, 1e-300)
    return Baked(image, alpha, sampler.cutoff, float(held.mean()), low_share, torn)


def _several(chart: Ints32, coarse: Bools, size: int) -> Ints:
    """Texels that need more than one sample: at seams, or where they cover much of the source's."""
    return np.flatnonzero(coarse | beside_another(chart.reshape(size, size)).reshape(-1))


def _store(pixels: Pixels, at: Ints, colors: Floats32) -> None:
    out = np.empty((len(at), 4), np.uint8)
    for k in range(3):
        out[:, k] = bytes_of(colors[k])
    out[:, 3] = np.round(np.clip(colors[3], 0, 1) * 255)
    pixels[at] = out


def _fill_and_blank(image: Pixels, painted: Bools, low: Bools, options: BakeOptions, alpha: Alpha) -> Alpha:
    """Fill in what is not painted, treat low confidence as the options say, and return what alpha then means."""
    pixels = image.reshape(-1, 4)
    size = image.shape[0]
    known = painted & ~low if options.fill or options.blank is not None else painted
    weight = known.astype(np.float32)
    if alpha != "opaque":
        weight *= np.maximum(pixels[:, 3], 1) / np.float32(255)
    if options.padding or options.fill:
        fill(image, weight.reshape(size, size))
    if options.blank is not None:
        red, green, blue, share = np.round(255 * np.array(options.blank)).astype(np.uint8).tolist()
        pixels[low, 3] = share
        if share:  # what is transparent keeps the colours around it, for the filters of viewers
            pixels[low, :3] = (red, green, blue)
        if share < 255 and low.any():
            return "mask" if alpha == "opaque" and share == 0 else "blend" if alpha == "opaque" else alpha
    return alpha


def _share_of_surface(target: Shape, inside: Ints32, low: Bools) -> float:
    """How much of the target's area has the texels that are `low`."""
    flat = inside.reshape(-1)
    held = flat >= 0
    count = np.bincount(flat[held], minlength=target.F)
    part = np.bincount(flat[held & low], minlength=target.F)
    some = count > 0
    area = target.face_areas
    return float((area[some] * part[some] / count[some]).sum() / max(area[some].sum(), 1e-300))
