"""Baking: for every texel of the target's atlas the color of its place on the source.

A texel is a point of a triangle of the target. The map says where the triangle's corners lie on the source; the
point between these images slides onto the source (`meshmatch.transfer.surface_walk`), and the face that it ends on gives
its texture coordinates: they are never interpolated across the source's seams. Colors are averaged as light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from numbers import Integral
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bools, Floats, Floats32, Ints, Ints32, UInts8
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Alpha, Appearance, BakedMaterial, Finish, Layer, Pixels
from meshmatch.shapes.colors import bytes_of
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map
from meshmatch.transfer.layers import ColorPainter, NormalPainter, Painter, Spots, SurfacePainter, painted_bytes
from meshmatch.transfer.surface_walk import PointWalker, SurfaceWalker
from meshmatch.transfer.texel_colors import MaterialSampler, TexelLocator, bends_of, images_of
from meshmatch.transfer.texels import beside_another, faces_on, fill, grow
from meshmatch.transfer.unwrap import Atlas

_LARGEST = 8192  # texels along a side
# So many texels past a seam show the surface that goes on there; further out, the nearest mean (see `fill`).
_OVERHANG = 2
# A texel that covers more than this many of the source's is sampled several times.
_COARSE = 1.25
# Where several places have one place in the image, they are compared at the size of a texel of so small an image, and
# found in one of that size; their colors are alike if they differ by no more than so many steps of 255.
_GLANCE, _SEARCH, _ALIKE = 128, 1024, 32
_CHUNK = 1 << 16
_BAND = 1 << 22  # texels that are painted together
_PIECES = 16  # of an image, in which its texels are counted


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
    tiles
        Whether coordinates in several tiles (UDIM) get an image each, as an obj can have; else they are brought into one.

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
    tiles: bool = True

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
    forward: VertexMap | None = None,
) -> Baked:
    """Bake the look of a source's file (`load_appearance`) for a target mesh, along a map from target to source, into
    an atlas (`atlas_of`) for the options' size and padding; `progress` is called with the share that is done, and
    where the map `forward` from source to target is given, images of triangles bend as it says.
    """
    walker, look = _arranged(source, look)
    uv = atlas.uv
    bends = None if forward is None else bends_of(source, target, forward, back)
    if target.invalid is not None:  # faces with a corner that has no position
        valid = target.valid_faces
        target, uv = Shape(target.verts, target.faces[valid], target.name), uv[valid]
        bends = None if bends is None else bends[valid]
    locator = TexelLocator(walker, target, back, uv * options.size, bends)
    on = faces_on(uv * options.size, options.size)[0]
    inside = on >= 0
    grow(on, _OVERHANG if options.padding else 0)
    color = ColorPainter(look, walker)
    painters: dict[Layer, Painter] = {} if look.finish is None else _painters(look.finish, walker, locator, uv)
    (image, *others), low = _painted([color, *painters.values()], locator, on.reshape(-1), options, progress)
    untrusted = _share_of_surface(target, on, inside, low.reshape(inside.shape))
    painted = on.reshape(-1) >= 0
    del on  # four bytes a texel
    alpha = _fill_and_blank(image, painted, low, options, color.sampler.alpha)
    for other, painter in zip(others, painters.values(), strict=True):
        _fill(other, _weights(painted & ~low if options.fill else painted), options, painter.linear)
    for each in (image, *others):
        if options.padding == 0:
            each[~inside] = 0
        elif alpha == "opaque" or each is not image:
            each[..., 3] = 255
    progress(1.0)
    torn = float(target.face_areas[locator.discontinuous].sum()) / max(target.area, 1e-300)
    name = _name_of(look) or Path(target.name).stem
    plain = BakedMaterial(image, alpha, color.sampler.cutoff, name)
    material = _finished(plain, look, dict(zip(painters, others, strict=True)))
    return Baked(material, float(inside.mean()), untrusted, torn)


def transfer_tiles(
    source: Shape,
    look: Appearance,
    target: Shape,
    back: VertexMap,
    atlas: Atlas,
    options: BakeOptions = BakeOptions(),  # frozen
    progress: Callable[[float], None] = lambda share: None,
    forward: VertexMap | None = None,
) -> tuple[Baked, dict[int, BakedMaterial]]:
    """The same for an atlas of several tiles (UDIM): a material for each, and one with the images of the first that says
    what alpha means in any, with shares of all.
    """
    tiles = atlas.tiles
    assert tiles is not None
    numbers = np.unique(tiles).tolist()
    baked: list[Baked] = []
    for k, tile in enumerate(numbers):
        report = _within(progress, k / len(numbers), (k + 1) / len(numbers))
        baked.append(transfer_texture(source, look, target, back, atlas.of_tile(tile), options, report, forward))
    area = np.array([target.face_areas[tiles == tile].sum() for tile in numbers])
    low = float(np.dot(area, [each.low for each in baked]) / max(area.sum(), 1e-300))
    alpha = max((each.material.alpha for each in baked), key=("opaque", "mask", "blend").index)
    first = replace(baked[0].material, alpha=alpha)
    whole = Baked(first, float(np.mean([each.used for each in baked])), low, baked[0].torn)
    return whole, {tile: each.material for tile, each in zip(numbers, baked, strict=True)}


def contradicted(source: Shape, look: Appearance, target: Shape, back: VertexMap, atlas: Atlas) -> float:
    """The share of the surface that has its places in the image together with others, and looks otherwise than these."""
    walker, look = _arranged(source, look)
    locator, sampler = TexelLocator(walker, target, back, atlas.uv * _GLANCE), MaterialSampler(look, walker)
    on = faces_on(atlas.uv * _SEARCH, _SEARCH)[0]
    center = atlas.uv.mean(axis=1)
    column, row = np.minimum(center * _SEARCH, _SEARCH - 1).astype(np.int64).T
    held = on[row, column]
    apart = (target.faces[:, :, None] != target.faces[held][:, None, :]).all(axis=(1, 2))
    face = np.flatnonzero((held >= 0) & apart & target.valid_faces & (target.face_areas > 0)).astype(np.int32)
    if not len(face):
        return 0.0
    x, y = (center[face] * _GLANCE).astype(np.float32).T
    one, other = (
        bytes_of(sampler.colors(place, weights, sampler.footprint(place, locator.reach.take(each)))[:3]).astype(int)
        for each in (face, held[face])
        for _, place, weights in [locator.locate(each, x, y)]
    )
    differ = np.abs(one - other).max(axis=0) > _ALIKE
    return float(target.face_areas[face[differ]].sum() / target.face_areas[face].sum())


def _name_of(look: Appearance) -> str:
    """The name of the material, if there is one for all faces."""
    names = {look.materials[k].name for k in np.unique(look.material).tolist()}
    return names.pop() if len(names) == 1 else ""


def _painters(finish: Finish, walker: SurfaceWalker, locator: TexelLocator, uv: Floats) -> dict[Layer, Painter]:
    """What paints the layers of a finish that need an image."""
    found: dict[Layer, Painter] = {}
    for layer in finish.images:
        if layer == "normal":
            found[layer] = NormalPainter(finish.layers[layer], walker, locator, uv)
        else:
            found[layer] = (
                SurfacePainter(finish, walker) if layer == "surface" else ColorPainter(finish.layers[layer], walker)
            )
    return found


def _finished(plain: BakedMaterial, look: Appearance, images: dict[Layer, Pixels]) -> BakedMaterial:
    """A baked material with the finish of a look: images, and numbers where those of all faces are the same."""
    finish = look.finish
    if finish is None:
        return plain
    made = replace(plain, double_sided=finish.double_sided, unlit=finish.unlit, normal=images.get("normal"))
    if "surface" in images:
        made = replace(made, surface=images["surface"], occluded=finish.occluded, roughness=1.0, metal=1.0)
    if finish.even:
        _, roughness, metal, _ = _factor(finish.layers["surface"])
        made = replace(made, even="surface" in images, roughness=roughness, metal=metal)
    if "glow" in images:
        return replace(made, glow=images["glow"], light=(finish.light,) * 3)
    if "glow" in finish.layers:
        red, green, blue = (finish.light * share for share in _factor(finish.layers["glow"])[:3])
        return replace(made, light=(red, green, blue))
    return made


def _factor(layer: Appearance) -> tuple[float, float, float, float]:
    """That of all faces."""
    return layer.materials[int(layer.material[0]) if len(layer.material) else 0].factor


def colors_of_vertices(source: Shape, look: Appearance, target: Shape, back: VertexMap) -> Floats:
    """(V_tgt, 4) linear colors and alpha of a target's vertices or points, as wide as the gaps between them."""
    walker, look = _arranged(source, look)
    sampler = MaterialSampler(look, walker)
    points, start = images_of(walker, back)
    place, weights, _ = walker.closest(points.T.astype(np.float32, order="C"), start.astype(np.int32))
    reach = np.sqrt(target.vertex_areas / max(target.area, 1e-300)).astype(np.float32)
    return sampler.colors(place, weights, sampler.footprint(place, reach)).T.astype(np.float64)


def _arranged(source: Shape, look: Appearance) -> tuple[SurfaceWalker, Appearance]:
    """A source and its look, ready to be looked up; each point of a cloud is a face."""
    if source.is_cloud:
        plain = Appearance(look.materials, np.zeros(source.V, np.int64), np.zeros((source.V, 3, 2)), look.colors)
        return PointWalker(source), plain
    return SurfaceWalker(source), look


def _painted(
    painters: Sequence[Painter],
    locator: TexelLocator,
    on: Ints32,
    options: BakeOptions,
    progress: Callable[[float], None],
) -> tuple[list[Pixels], Bools]:
    """The images, painted where a triangle lies on a texel (N,), and the texels (N,) of low confidence."""
    size = options.size
    images = [np.zeros((size * size, 4), np.uint8) for _ in painters]
    low = np.zeros(size * size, bool)
    rows = max(_BAND // size, 1)
    for top in range(0, size, rows):
        lines = slice(top, min(top + rows, size))
        report = _within(progress, lines.start / size, lines.stop / size)
        _paint_rows(painters, locator, on, options, lines, images, low, report)
    return [image.reshape(size, size, 4) for image in images], low


def _within(progress: Callable[[float], None], begin: float, end: float) -> Callable[[float], None]:
    """The progress of a part of the work, as that of the whole."""
    return lambda share: progress(begin + (end - begin) * share)


def _paint_rows(
    painters: Sequence[Painter],
    locator: TexelLocator,
    on: Ints32,
    options: BakeOptions,
    rows: slice,
    images: Sequence[Pixels],
    low: Bools,
    progress: Callable[[float], None],
) -> None:
    """Paint some rows of the images, which takes memory for these alone."""
    size = options.size
    samplers = [sampler for painter in painters for sampler in painter.samplers]
    above, below = max(rows.start - 1, 0), min(rows.stop + 1, size)  # rows beside, to know where seams are
    offset, many = above * size, (below - above) * size
    chart, hint, coarse = np.full(many, -1, np.int32), np.full(many, -1, np.int32), np.zeros(many, bool)
    texels = offset + np.flatnonzero(on[offset : below * size] >= 0)
    inner = (texels >= rows.start * size) & (texels < rows.stop * size)

    def placed(at: Ints) -> tuple[Ints32, Floats32, Ints32, Floats32]:
        face = on[at]
        row, column = np.divmod(at, size)
        weights, place, held = locator.locate(face, (column + 0.5).astype(np.float32), (row + 0.5).astype(np.float32))
        chart[at - offset], hint[at - offset] = samplers[0].chart[place], place
        return face, weights, place, held

    def first(at: Ints) -> None:
        face, weights, place, held = placed(at)
        low[at] = locator.confidence(face, weights) < options.min_confidence
        spots = Spots(face, weights, place, held, locator.reach.take(face))
        for image, painter in zip(images, painters, strict=True):
            image[at] = painted_bytes(painter, painter.seen(spots))
        footprint = np.max([sampler.footprint(place, spots.reach) for sampler in samplers], axis=0)
        coarse[at - offset] = footprint > _COARSE

    grid = (np.arange(options.samples, dtype=np.float32) + np.float32(0.5)) / options.samples
    steps = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)

    def again(at: Ints) -> None:
        row, column = (part.astype(np.float32) for part in np.divmod(at, size))
        face, start = on[at], hint[at - offset]
        means = [_Mean(len(at)) for _ in painters]
        for right, down in steps:
            weights, place, held = locator.locate(face, column + right, row + down, start)
            narrow = locator.reach.take(face) / np.float32(options.samples)
            spots = Spots(face, weights, place, held, narrow)
            for mean, painter in zip(means, painters, strict=True):
                mean.add(painter.seen(spots))
        for image, mean, painter in zip(images, means, painters, strict=True):
            image[at] = painted_bytes(painter, mean.result())

    def run(work: Callable[[Ints], object], chosen: Ints, done: float, share: float) -> None:
        parts, finished = [chosen[k : k + _CHUNK] for k in range(0, len(chosen), _CHUNK)], count(1)

        def report(part: Ints) -> None:
            work(part)
            progress(done + share * next(finished) / len(parts))

        parallel_map(report, parts, threads=options.workers)

    run(first, texels[inner], 0.0, 0.5)
    if options.samples > 1:  # at seams, and where a texel covers much of the source's
        run(placed, texels[~inner], 0.5, 0.0)
        several = coarse | beside_another(chart.reshape(-1, size)).reshape(-1)
        chosen = offset + np.flatnonzero(several)
        run(again, chosen[(chosen >= rows.start * size) & (chosen < rows.stop * size)], 0.5, 0.45)


class _Mean:
    """The mean of amounts and alpha (4, N); transparent ones do not count for the color."""

    def __init__(self, N: int) -> None:
        self.total, self.plain, self.count = np.zeros((4, N), np.float32), np.zeros((3, N), np.float32), 0

    def add(self, seen: Floats32) -> None:
        self.plain += seen[:3]
        seen[:3] *= seen[3]
        self.total += seen
        self.count += 1

    def result(self) -> Floats32:
        share = self.total[3]
        self.total[:3] = np.where(share > 0, self.total[:3] / np.where(share > 0, share, 1), self.plain / self.count)
        self.total[3] /= self.count
        return self.total


def _fill_and_blank(image: Pixels, painted: Bools, low: Bools, options: BakeOptions, alpha: Alpha) -> Alpha:
    """Fill in what is not painted, treat low confidence as the options say, and return what alpha then means."""
    pixels = image.reshape(-1, 4)
    known = painted & ~low if options.fill or options.blank is not None else painted
    weight = _weights(known)
    if alpha != "opaque":
        np.minimum(weight, np.maximum(pixels[:, 3], 1), out=weight)
    _fill(image, weight, options)
    if options.blank is not None:
        red, green, blue, share = np.round(255 * np.array(options.blank)).astype(np.uint8).tolist()
        pixels[low, 3] = share
        if share:  # what is transparent keeps the colors around it, for the filters of viewers
            pixels[low, :3] = (red, green, blue)
        if share < 255 and low.any() and alpha == "opaque":
            return "blend" if share else "mask"
    # Where nothing of it is transparent, such as hair that was left out, a body is no glass: viewers would sort it.
    return "opaque" if (pixels[painted, 3] == 255).all() else alpha


def _weights(known: Bools) -> UInts8:
    """All, or nothing."""
    return np.multiply(known, 255, dtype=np.uint8)


def _fill(image: Pixels, weight: UInts8, options: BakeOptions, linear: bool = False) -> None:
    """Fill in the texels of an image whose weight (N,) is 0, where the options ask for that."""
    if options.padding or options.fill:
        fill(image, weight.reshape(image.shape[:2]), linear)


def _share_of_surface(target: Shape, on: Ints32, inside: Bools, low: Bools) -> float:
    """How much of the target's area has texels that are `low` (H, W), by the triangle on each that is `inside`."""
    count, part = np.zeros(target.F, np.int64), np.zeros(target.F, np.int64)
    for face, within, unsure in zip(*(np.array_split(each, _PIECES) for each in (on, inside, low)), strict=True):
        count += np.bincount(face[within], minlength=target.F)
        part += np.bincount(face[within & unsure], minlength=target.F)
    some = count > 0
    area = target.face_areas[some]
    return float((area * part[some] / count[some]).sum() / max(area.sum(), 1e-300))
