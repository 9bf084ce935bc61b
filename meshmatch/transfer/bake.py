"""Baking: for every texel of the target's atlas the color of its place on the source.

A texel is a point of a triangle of the target. The map says where the triangle's corners lie on the source; the
point between these images slides onto the source (`meshmatch.transfer.surface_walk`), and the face that it ends on gives
its texture coordinates: they are never interpolated across the source's seams. Colors are averaged as light.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from numbers import Integral

import numpy as np

from meshmatch.arrays import Bools, Floats, Floats32, Ints, Ints32
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Alpha, Appearance, BakedMaterial, Pixels
from meshmatch.shapes.colors import bytes_of
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map
from meshmatch.transfer.surface_walk import PointWalker, SurfaceWalker
from meshmatch.transfer.texel_colors import MaterialSampler, TexelLocator, images_of
from meshmatch.transfer.texels import beside_another, faces_on, fill, grown
from meshmatch.transfer.unwrap import Atlas

_LARGEST = 8192  # texels along a side
# So many texels past a seam show the surface that goes on there; further out, the nearest mean (see `fill`).
_OVERHANG = 2
# A texel that covers more than this many of the source's is sampled several times.
_COARSE = 1.25
_CHUNK = 1 << 16


@dataclass(frozen=True)
class BakeOptions:
    """How a texture is baked.

    Attributes
    ----------
    size
        Texels along each side.
    samples
        A texel that covers a seam or much detail of the source is averaged over ``samples x samples`` points; others
        need one.
    padding
        Texels between charts of new texture coordinates; 0 also leaves the texels past the seams empty.
    min_confidence
        Confidence (0..1) below which a texel is not trusted.
    fill
        Give such texels the colors of their neighbours in the texture.
    blank
        Or one color: sRGB and alpha, in 0..1.
    workers
        Threads.

    Raises
    ------
    OptionError
        A size is out of range, or choices contradict each other.

    Examples
    --------
    >>> options = meshmatch.BakeOptions(size=1024, blank=(0.5, 0.5, 0.5, 1.0))
    >>> dancer, climber = "templates/samples/dancer-textured.glb", "templates/samples/climber.ply"
    >>> meshmatch.transfer_texture(dancer, climber, options=options).save("dressed.glb")
    """

    size: int = 2048
    samples: int = 2
    padding: int = 8
    min_confidence: float = 0.3
    fill: bool = False
    blank: tuple[float, float, float, float] | None = None
    workers: int = 2

    def __post_init__(self) -> None:
        for name, low, high, hint in (
            ("size", 16, _LARGEST, "1024 or 2048 suit most"),
            ("samples", 1, 8, "2 or 3 suit most"),
            ("padding", 0, _LARGEST // 4, "8 suits most"),
            ("workers", 1, 4096, "one for each core is enough"),
        ):
            value = getattr(self, name)
            if not isinstance(value, Integral) or not low <= int(value) <= high:
                raise OptionError(f"{name} must be an integer from {low} to {high}, not {value!r}", hint)
        if self.padding > self.size // 4:
            problem = f"padding of {self.padding} texels is not possible with {self.size}"
            raise OptionError(problem, f"choose 0 to {self.size // 4}")
        if self.fill and self.blank is not None:
            raise OptionError("fill and blank contradict each other", "choose one of them")


@dataclass(frozen=True, eq=False)
class Baked:
    """A finished material."""

    material: BakedMaterial
    used: float  # share of its texels that lie on the surface
    low: float  # share of the surface that is of low confidence
    torn: float  # share on triangles where the map is discontinuous

    @property
    def image(self) -> Pixels:
        """(size, size, 4) colors and alpha."""
        return self.material.color


def transfer_texture(
    source: Shape,
    look: Appearance,
    target: Shape,
    back: VertexMap,
    atlas: Atlas,
    options: BakeOptions = BakeOptions(),  # frozen
    progress: Callable[[float], None] = lambda share: None,
) -> Baked:
    """Bake the look of a source's file (`load_appearance`) for a target mesh, along a map from target to source, into
    an atlas (`atlas_of`) for the options' size and padding; `progress` is called with the share that is done.
    """
    walker, sampler = _arranged(source, look)
    uv = atlas.uv
    if target.invalid is not None:  # faces with a corner that has no position
        valid = target.valid_faces
        target, uv = Shape(target.verts, target.faces[valid], target.name), uv[valid]
    locator = TexelLocator(walker, target, back, uv * options.size)
    inside = faces_on(uv * options.size, options.size)[0]
    on = grown(inside, _OVERHANG if options.padding else 0)
    image, low = _painted(sampler, locator, on.reshape(-1), options, progress)
    alpha = _fill_and_blank(image, on.reshape(-1) >= 0, low, options, sampler.alpha)
    if options.padding == 0:
        image[inside < 0] = 0
    elif alpha == "opaque":
        image[..., 3] = 255
    progress(1.0)
    torn = float(target.face_areas[locator.discontinuous].sum()) / max(target.area, 1e-300)
    material = BakedMaterial(image, alpha, sampler.cutoff, _name_of(look))
    return Baked(material, float((inside >= 0).mean()), _share_of_surface(target, inside.reshape(-1), low), torn)


def _name_of(look: Appearance) -> str:
    """The name of the material, if there is one for all faces."""
    names = {look.materials[k].name for k in np.unique(look.material).tolist()}
    return names.pop() if len(names) == 1 else ""


def colors_of_vertices(source: Shape, look: Appearance, target: Shape, back: VertexMap) -> Floats:
    """(V_tgt, 4) linear colors and alpha of a target's vertices or points, as wide as the gaps between them."""
    walker, sampler = _arranged(source, look)
    points, start = images_of(walker, back)
    place, weights, _ = walker.closest(points.T.astype(np.float32, order="C"), start.astype(np.int32))
    reach = np.sqrt(target.vertex_areas / max(target.area, 1e-300)).astype(np.float32)
    return sampler.colors(place, weights, sampler.footprint(place, reach)).T.astype(np.float64)


def _arranged(source: Shape, look: Appearance) -> tuple[SurfaceWalker, MaterialSampler]:
    """A source and its look, ready to be looked up; each point of a cloud is a face."""
    walker = PointWalker(source) if source.is_cloud else SurfaceWalker(source)
    if source.is_cloud:
        look = Appearance(look.materials, np.zeros(source.V, np.int64), np.zeros((source.V, 3, 2)), look.colors)
    return walker, MaterialSampler(look, walker)


def _painted(
    sampler: MaterialSampler, locator: TexelLocator, on: Ints32, options: BakeOptions, progress: Callable[[float], None]
) -> tuple[Pixels, Bools]:
    """The image, painted where a triangle lies on a texel (N,), and the texels (N,) of low confidence."""
    size = options.size
    pixels = np.zeros((size * size, 4), np.uint8)
    chart, hint = np.full(size * size, -1, np.int32), np.full(size * size, -1, np.int32)
    coarse, low = np.zeros(size * size, bool), np.zeros(size * size, bool)

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
            seen[:3] *= seen[3]  # transparent samples do not count for the color
            total += seen
        share = total[3]
        total[:3] = np.where(share > 0, total[:3] / np.where(share > 0, share, 1), plain / len(steps))
        total[3] /= len(steps)
        _store(pixels, at, total)

    def run(work: Callable[[Ints], None], chosen: Ints, done: float, share: float) -> None:
        parts, finished = [chosen[k : k + _CHUNK] for k in range(0, len(chosen), _CHUNK)], count(1)

        def report(part: Ints) -> None:
            work(part)
            progress(done + share * next(finished) / len(parts))

        parallel_map(report, parts, threads=options.workers)

    run(first, np.flatnonzero(on >= 0), 0.0, 0.5)
    if options.samples > 1:  # at seams, and where a texel covers much of the source's
        several = coarse | beside_another(chart.reshape(size, size)).reshape(-1)
        run(again, np.flatnonzero(several), 0.5, 0.45)
    return pixels.reshape(size, size, 4), low


def _store(pixels: Pixels, at: Ints, colors: Floats32) -> None:
    pixels[at, :3] = bytes_of(colors[:3]).T
    pixels[at, 3] = np.round(np.clip(colors[3], 0, 1) * 255)


def _fill_and_blank(image: Pixels, painted: Bools, low: Bools, options: BakeOptions, alpha: Alpha) -> Alpha:
    """Fill in what is not painted, treat low confidence as the options say, and return what alpha then means."""
    pixels = image.reshape(-1, 4)
    known = painted & ~low if options.fill or options.blank is not None else painted
    weight = known.astype(np.float32)
    if alpha != "opaque":
        weight *= np.maximum(pixels[:, 3], 1) / np.float32(255)
    if options.padding or options.fill:
        fill(image, weight.reshape(image.shape[:2]))
    if options.blank is not None:
        red, green, blue, share = np.round(255 * np.array(options.blank)).astype(np.uint8).tolist()
        pixels[low, 3] = share
        if share:  # what is transparent keeps the colors around it, for the filters of viewers
            pixels[low, :3] = (red, green, blue)
        if share < 255 and low.any() and alpha == "opaque":
            return "blend" if share else "mask"
    return alpha


def _share_of_surface(target: Shape, inside: Ints32, low: Bools) -> float:
    """How much of the target's area has the texels (N,) that are `low`, by the triangle on each."""
    held = inside >= 0
    count = np.bincount(inside[held], minlength=target.F)
    part = np.bincount(inside[held & low], minlength=target.F)
    some = count > 0
    area = target.face_areas[some]
    return float((area * part[some] / count[some]).sum() / max(area.sum(), 1e-300))
