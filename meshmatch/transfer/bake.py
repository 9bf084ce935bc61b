"""Texture baking: the color of every texel of the target's atlas, taken from the corresponding point of the source.

A texel is a point of a triangle of the target. The map gives the triangle's corners on the source; the point between these
images walks onto the source's surface (`meshmatch.transfer.surface_walk`), and the face where it ends gives its texture
coordinates, which are therefore never interpolated across seams of the source. Colors are averaged in linear light.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bools, Floats, Floats32, Ints, Ints32, UInts8
from meshmatch.errors import OptionError
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.scalars import is_integer
from meshmatch.shapes.appearance import Alpha, Appearance, BakedMaterial, Finish, Layer, Pixels
from meshmatch.shapes.colors import linear_to_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.threads import parallel_map
from meshmatch.transfer.layers import ColorPainter, NormalPainter, Painter, Samples, SurfacePainter, painted_bytes
from meshmatch.transfer.surface_walk import PointWalker, SurfaceWalker
from meshmatch.transfer.texel_colors import MaterialSampler, TexelLocator, edge_bends, image_points
from meshmatch.transfer.texels import borders_another, draw_triangles, fill, grow
from meshmatch.transfer.unwrap import Atlas

_MAX_SIZE = 8192  # texels along a side
# Texels past a seam that continue the surface; further out they take the nearest mean (see `fill`).
_OVERHANG = 2
# A texel that covers more texels of the source than this is supersampled.
_MAX_FOOTPRINT = 1.25
# Places that share a point of the image are found at the second size and compared at the size of a texel of an image of
# the first size; their colors are alike if they differ by no more than the last number (of 255).
_COMPARE_SIZE, _SEARCH_SIZE, _MAX_DIFFERENCE = 128, 1024, 32
_CHUNK = 1 << 16
_BAND_TEXELS = 1 << 22  # texels that are painted together
_N_PARTS = 16  # parts of an image in which its texels are counted, to save memory


@dataclass(frozen=True)
class BakeOptions:
    """Options of baking a texture.

    Attributes
    ----------
    size
        Texels along each side.
    samples
        A texel that covers a seam or much detail of the source is averaged over ``samples x samples`` points; others are
        sampled once.
    padding
        Texels between charts of new texture coordinates; 0 also leaves the texels past the seams empty.
    min_confidence
        Confidence (0..1) below which a texel is not trusted.
    fill
        Fill in such texels from their neighbours in the texture.
    blank
        Or give them one color: sRGB and alpha, in 0..1.
    workers
        Number of threads.
    tiles
        Whether coordinates in several tiles (UDIM) get an image each, as an obj can have; else they are moved into one.

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
            ("size", 16, _MAX_SIZE, "1024 or 2048 suit most"),
            ("samples", 1, 8, "2 or 3 suit most"),
            ("padding", 0, _MAX_SIZE // 4, "8 suits most"),
            ("workers", 1, 4096, "one for each core is enough"),
        ):
            value = getattr(self, name)
            if not is_integer(value, low) or value > high:
                raise OptionError(f"{name} must be an integer from {low} to {high}, not {value!r}", hint)
        if self.padding > self.size // 4:
            problem = f"padding of {self.padding} texels is not possible with {self.size}"
            raise OptionError(problem, f"choose 0 to {self.size // 4}")
        if self.fill and self.blank is not None:
            raise OptionError("fill and blank contradict each other", "choose one of them")


@dataclass(frozen=True, eq=False)
class Baked:
    """A baked material, with shares (0..1) of what was baked."""

    material: BakedMaterial
    used: float  # share of its texels that lie on the surface
    low: float  # share of the surface where the map's confidence is low
    torn: float  # share of the surface on triangles where the map is discontinuous

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
    """Bake the appearance of the source's file (`load_appearance`) onto a target mesh.

    ``back`` maps target to source; ``atlas`` is `atlas_of` the target for the options' size and padding. ``progress`` is
    called with the finished share. With the map ``forward`` from source to target, images of triangles bend (`edge_bends`).
    """
    walker, look = _prepare_source(source, look)
    uv = atlas.uv
    bends = None if forward is None else edge_bends(source, target, forward, back)
    if target.invalid is not None:  # faces with a corner that has no position
        valid = target.valid_faces
        target, uv = Shape(target.verts, target.faces[valid], target.name), uv[valid]
        bends = None if bends is None else bends[valid]
    locator = TexelLocator(walker, target, back, uv * options.size, bends)
    face_at = draw_triangles(uv * options.size, options.size)[0]
    inside = face_at >= 0
    grow(face_at, _OVERHANG if options.padding else 0)
    color = ColorPainter(look, walker)
    painters: dict[Layer, Painter] = {} if look.finish is None else _build_painters(look.finish, walker, locator, uv)
    (image, *others), low = _paint([color, *painters.values()], locator, face_at.reshape(-1), options, progress)
    untrusted = _share_of_surface(target, face_at, inside, low.reshape(inside.shape))
    painted = face_at.reshape(-1) >= 0
    del face_at  # saves four bytes per texel
    alpha = _fill_and_blank(image, painted, low, options, color.sampler.alpha)
    for other, painter in zip(others, painters.values(), strict=True):
        _fill(other, _byte_weights(painted & ~low if options.fill else painted), options, painter.linear)
    for each in (image, *others):
        if options.padding == 0:
            each[~inside] = 0
        elif alpha == "opaque" or each is not image:
            each[..., 3] = 255
    progress(1.0)
    torn = float(target.face_areas[locator.discontinuous].sum()) / max(target.area, 1e-300)
    name = _name_of(look) or Path(target.name).stem
    plain = BakedMaterial(image, alpha, color.sampler.cutoff, name)
    material = _apply_finish(plain, look, dict(zip(painters, others, strict=True)))
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
    """Bake an atlas of several tiles (UDIM) as `transfer_texture` does.

    Returns the material of each tile; and one with the images of the first tile, the most general alpha mode of all, and
    the shares of all tiles together.
    """
    tiles = atlas.tiles
    assert tiles is not None
    numbers = np.unique(tiles).tolist()
    baked: list[Baked] = []
    for k, tile in enumerate(numbers):
        report = _sub_progress(progress, k / len(numbers), (k + 1) / len(numbers))
        baked.append(transfer_texture(source, look, target, back, atlas.of_tile(tile), options, report, forward))
    area = np.array([target.face_areas[tiles == tile].sum() for tile in numbers])
    low = float(np.dot(area, [each.low for each in baked]) / max(area.sum(), 1e-300))
    alpha = max((each.material.alpha for each in baked), key=("opaque", "mask", "blend").index)
    first = replace(baked[0].material, alpha=alpha)
    whole = Baked(first, float(np.mean([each.used for each in baked])), low, baked[0].torn)
    return whole, {tile: each.material for tile, each in zip(numbers, baked, strict=True)}


def contradicting_share(source: Shape, look: Appearance, target: Shape, back: VertexMap, atlas: Atlas) -> float:
    """Share of faces with other colors than the face at the same place in the image.

    By area, of the faces that share their place in the image with another one.
    """
    walker, look = _prepare_source(source, look)
    locator, sampler = TexelLocator(walker, target, back, atlas.uv * _COMPARE_SIZE), MaterialSampler(look, walker)
    face_at = draw_triangles(atlas.uv * _SEARCH_SIZE, _SEARCH_SIZE)[0]
    center = atlas.uv.mean(axis=1)
    column, row = np.minimum(center * _SEARCH_SIZE, _SEARCH_SIZE - 1).astype(np.int64).T
    other_face = face_at[row, column]
    is_separate = (target.faces[:, :, None] != target.faces[other_face][:, None, :]).all(axis=(1, 2))
    face = np.flatnonzero((other_face >= 0) & is_separate & target.valid_faces & (target.face_areas > 0)).astype(
        np.int32
    )
    if not len(face):
        return 0.0
    x, y = (center[face] * _COMPARE_SIZE).astype(np.float32).T
    one, other = (
        linear_to_bytes(sampler.colors(place, weights, sampler.footprint(place, locator.reach.take(each)))[:3]).astype(
            int
        )
        for each in (face, other_face[face])
        for _, place, weights in [locator.locate(each, x, y)]
    )
    differ = np.abs(one - other).max(axis=0) > _MAX_DIFFERENCE
    return float(target.face_areas[face[differ]].sum() / target.face_areas[face].sum())


def _name_of(look: Appearance) -> str:
    """The name of the material if all faces have the same, else empty."""
    names = {look.materials[k].name for k in np.unique(look.material).tolist()}
    return names.pop() if len(names) == 1 else ""


def _build_painters(finish: Finish, walker: SurfaceWalker, locator: TexelLocator, uv: Floats) -> dict[Layer, Painter]:
    """Painters of those layers of a finish that need an image."""
    found: dict[Layer, Painter] = {}
    for layer in finish.images:
        if layer == "normal":
            found[layer] = NormalPainter(finish.layers[layer], walker, locator, uv)
        else:
            found[layer] = (
                SurfacePainter(finish, walker) if layer == "surface" else ColorPainter(finish.layers[layer], walker)
            )
    return found


def _apply_finish(plain: BakedMaterial, look: Appearance, images: dict[Layer, Pixels]) -> BakedMaterial:
    """Add a finish to a baked material: images, or numbers where these are the same on all faces."""
    finish = look.finish
    if finish is None:
        return plain
    material = replace(plain, double_sided=finish.double_sided, unlit=finish.unlit, normal=images.get("normal"))
    if "surface" in images:
        material = replace(material, surface=images["surface"], occluded=finish.occluded, roughness=1.0, metal=1.0)
    if finish.even:
        _, roughness, metal, _ = _factor(finish.layers["surface"])
        material = replace(material, even="surface" in images, roughness=roughness, metal=metal)
    if "glow" in images:
        return replace(material, glow=images["glow"], light=(finish.light,) * 3)
    if "glow" in finish.layers:
        red, green, blue = (finish.light * share for share in _factor(finish.layers["glow"])[:3])
        return replace(material, light=(red, green, blue))
    return material


def _factor(layer: Appearance) -> tuple[float, float, float, float]:
    """The factor of a layer that is the same on all faces."""
    return layer.materials[int(layer.material[0]) if len(layer.material) else 0].factor


def colors_of_vertices(source: Shape, look: Appearance, target: Shape, back: VertexMap) -> Floats:
    """(V_target, 4) linear colors and alpha of a target's vertices or points, averaged over the area of each."""
    walker, look = _prepare_source(source, look)
    sampler = MaterialSampler(look, walker)
    points, start = image_points(walker, back)
    place, weights, _ = walker.closest(points.T.astype(np.float32, order="C"), start.astype(np.int32))
    reach = np.sqrt(target.vertex_areas / max(target.area, 1e-300)).astype(np.float32)
    return sampler.colors(place, weights, sampler.footprint(place, reach)).T.astype(np.float64)


def _prepare_source(source: Shape, look: Appearance) -> tuple[SurfaceWalker, Appearance]:
    """A walker on the source, and its appearance by the walker's faces; in a cloud each point is a face."""
    if source.is_cloud:
        plain = Appearance(look.materials, np.zeros(source.V, np.int64), np.zeros((source.V, 3, 2)), look.colors)
        return PointWalker(source), plain
    return SurfaceWalker(source), look


def _paint(
    painters: Sequence[Painter],
    locator: TexelLocator,
    face_at: Ints32,
    options: BakeOptions,
    progress: Callable[[float], None],
) -> tuple[list[Pixels], Bools]:
    """Images, painted where a triangle lies on a texel (N,); and (N,) texels of low confidence."""
    size = options.size
    images = [np.zeros((size * size, 4), np.uint8) for _ in painters]
    low = np.zeros(size * size, bool)
    rows = max(_BAND_TEXELS // size, 1)
    for top in range(0, size, rows):
        lines = slice(top, min(top + rows, size))
        report = _sub_progress(progress, lines.start / size, lines.stop / size)
        _paint_rows(painters, locator, face_at, options, lines, images, low, report)
    return [image.reshape(size, size, 4) for image in images], low


def _sub_progress(progress: Callable[[float], None], begin: float, end: float) -> Callable[[float], None]:
    """A callback for a part of the work that reports progress of the whole."""
    return lambda share: progress(begin + (end - begin) * share)


def _paint_rows(
    painters: Sequence[Painter],
    locator: TexelLocator,
    face_at: Ints32,
    options: BakeOptions,
    rows: slice,
    images: Sequence[Pixels],
    low: Bools,
    progress: Callable[[float], None],
) -> None:
    """Paint some rows of the images; memory is only needed for these."""
    size = options.size
    samplers = [sampler for painter in painters for sampler in painter.samplers]
    above, below = max(rows.start - 1, 0), min(rows.stop + 1, size)  # with the adjacent rows, to detect seams
    offset, N = above * size, (below - above) * size
    chart, start_face, is_coarse = (np.full(N, -1, np.int32), np.full(N, -1, np.int32), np.zeros(N, bool))
    texels = offset + np.flatnonzero(face_at[offset : below * size] >= 0)
    inner = (texels >= rows.start * size) & (texels < rows.stop * size)

    def locate_texels(at: Ints) -> tuple[Ints32, Floats32, Ints32, Floats32]:
        face = face_at[at]
        row, column = np.divmod(at, size)
        weights, place, source_weights = locator.locate(
            face, (column + 0.5).astype(np.float32), (row + 0.5).astype(np.float32)
        )
        chart[at - offset], start_face[at - offset] = samplers[0].chart[place], place
        return face, weights, place, source_weights

    def paint_once(at: Ints) -> None:
        face, weights, place, source_weights = locate_texels(at)
        low[at] = locator.confidence(face, weights) < options.min_confidence
        samples = Samples(face, weights, place, source_weights, locator.reach.take(face))
        for image, painter in zip(images, painters, strict=True):
            image[at] = painted_bytes(painter, painter.sample(samples))
        footprint = np.max([sampler.footprint(place, samples.reach) for sampler in samplers], axis=0)
        is_coarse[at - offset] = footprint > _MAX_FOOTPRINT

    grid = (np.arange(options.samples, dtype=np.float32) + np.float32(0.5)) / options.samples
    steps = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)

    def paint_supersampled(at: Ints) -> None:
        row, column = (part.astype(np.float32) for part in np.divmod(at, size))
        face, start = face_at[at], start_face[at - offset]
        means = [_AlphaMean(len(at)) for _ in painters]
        for right, down in steps:
            weights, place, source_weights = locator.locate(face, column + right, row + down, start)
            narrow = locator.reach.take(face) / np.float32(options.samples)
            samples = Samples(face, weights, place, source_weights, narrow)
            for mean, painter in zip(means, painters, strict=True):
                mean.add(painter.sample(samples))
        for image, mean, painter in zip(images, means, painters, strict=True):
            image[at] = painted_bytes(painter, mean.result())

    def run(work: Callable[[Ints], object], chosen: Ints, done: float, share: float) -> None:
        parts, finished = [chosen[k : k + _CHUNK] for k in range(0, len(chosen), _CHUNK)], count(1)

        def report(part: Ints) -> None:
            work(part)
            progress(done + share * next(finished) / len(parts))

        parallel_map(report, parts, threads=options.workers)

    run(paint_once, texels[inner], 0.0, 0.5)
    if options.samples > 1:  # at seams, and where a texel covers much detail of the source
        run(locate_texels, texels[~inner], 0.5, 0.0)
        several = is_coarse | borders_another(chart.reshape(-1, size)).reshape(-1)
        chosen = offset + np.flatnonzero(several)
        run(paint_supersampled, chosen[(chosen >= rows.start * size) & (chosen < rows.stop * size)], 0.5, 0.45)


class _AlphaMean:
    """Running mean of amounts and alpha (4, N), with colors weighted by alpha."""

    def __init__(self, N: int) -> None:
        self.total, self.unweighted, self.count = np.zeros((4, N), np.float32), np.zeros((3, N), np.float32), 0

    def add(self, values: Floats32) -> None:
        self.unweighted += values[:3]
        values[:3] *= values[3]
        self.total += values
        self.count += 1

    def result(self) -> Floats32:
        share = self.total[3]
        self.total[:3] = np.where(
            share > 0, self.total[:3] / np.where(share > 0, share, 1), self.unweighted / self.count
        )
        self.total[3] /= self.count
        return self.total


def _fill_and_blank(image: Pixels, painted: Bools, low: Bools, options: BakeOptions, alpha: Alpha) -> Alpha:
    """Fill in unpainted texels, apply the options for low confidence, and return the alpha mode of the result."""
    pixels = image.reshape(-1, 4)
    known = painted & ~low if options.fill or options.blank is not None else painted
    weight = _byte_weights(known)
    if alpha != "opaque":
        np.minimum(weight, np.maximum(pixels[:, 3], 1), out=weight)
    _fill(image, weight, options)
    if options.blank is not None:
        red, green, blue, share = np.round(255 * np.array(options.blank)).astype(np.uint8).tolist()
        pixels[low, 3] = share
        if share:  # transparent texels keep the surrounding colors, for the filters of viewers
            pixels[low, :3] = (red, green, blue)
        if share < 255 and low.any() and alpha == "opaque":
            return "blend" if share else "mask"
    # Nothing transparent left (such as hair that was excluded): opaque, or viewers would sort the surface as glass.
    return "opaque" if (pixels[painted, 3] == 255).all() else alpha


def _byte_weights(known: Bools) -> UInts8:
    """255 for known texels, 0 for others."""
    return np.multiply(known, 255, dtype=np.uint8)


def _fill(image: Pixels, weight: UInts8, options: BakeOptions, linear: bool = False) -> None:
    """Fill in the texels of an image whose weight (N,) is 0, if the options ask for that."""
    if options.padding or options.fill:
        fill(image, weight.reshape(image.shape[:2]), linear)


def _share_of_surface(target: Shape, face_at: Ints32, inside: Bools, low: Bools) -> float:
    """Share of the target's area on texels that are `low` (H, W), counted per triangle over texels that are `inside`."""
    n_texels, n_low = np.zeros(target.F, np.int64), np.zeros(target.F, np.int64)
    for face, is_inside, is_low in zip(
        *(np.array_split(each, _N_PARTS) for each in (face_at, inside, low)), strict=True
    ):
        n_texels += np.bincount(face[is_inside], minlength=target.F)
        n_low += np.bincount(face[is_inside & is_low], minlength=target.F)
    some = n_texels > 0
    area = target.face_areas[some]
    return float((area * n_low[some] / n_texels[some]).sum() / max(area.sum(), 1e-300))
