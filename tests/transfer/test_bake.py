"""Textures carried from one shape to another."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from meshmatch.errors import OptionError
from meshmatch.geometry.triangles import closest_on_triangles
from meshmatch.maps.footpoints import Surface
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.colors import to_linear, to_srgb
from meshmatch.shapes.shape import Shape
from meshmatch.transfer import texel_colors
from meshmatch.transfer.bake import Baked, BakeOptions, colors_of_vertices, transfer_texture
from meshmatch.transfer.texels import draw_triangles
from meshmatch.transfer.unwrap import Atlas, atlas_of, unwrapped
from tests.conftest import icosphere
from tests.maps.solids import grid
from tests.shapes.painted import CORNERS, FACES, UV, quarters
from tests.transfer.known import split

SQUARE = Shape(CORNERS, FACES, "square")
OWN = UV[FACES]
SMALL = BakeOptions(size=32, padding=2, workers=1)


def wearing(image: np.ndarray, uv: np.ndarray = OWN, **rest: object) -> Appearance:
    """One material on all faces."""
    return Appearance((Material(image=image, **rest),), np.zeros(len(uv), np.int64), uv)  # type: ignore[arg-type]


def noise(size: int, seed: int = 0) -> np.ndarray:
    image = np.random.default_rng(seed).integers(0, 256, (size, size, 4), dtype=np.uint8)
    image[..., 3] = 255
    return image


def worn(
    source: Shape,
    look: Appearance,
    target: Shape,
    back: VertexMap | None = None,
    uv: np.ndarray | None = None,
    choices: BakeOptions = SMALL,
) -> Baked:
    atlas = atlas_of(target, None, choices.size, choices.padding) if uv is None else Atlas(uv, True)
    back = VertexMap.identity(target) if back is None else back
    return transfer_texture(source, look, target, back, atlas, choices)


def nearest_map(a: Shape, b: Shape) -> VertexMap:
    """From a to b by the closest points that face the same way."""
    unit = np.sqrt(b.area)
    found = Surface(b.verts / unit, b.faces, b.vertex_normals).query(a.verts / unit, a.vertex_normals)
    return VertexMap.between(a, b, found.vertex, face=found.face, barycentric=found.barycentric)


@cache
def charted(size: int, padding: int, splits: int = 3) -> np.ndarray:
    """An atlas of a sphere."""
    return unwrapped(icosphere(splits), size, padding)


# Same in, same out


@pytest.mark.parametrize("samples", [1, 2, 3])
def test_a_texture_carried_to_itself_is_the_same_to_the_last_bit(samples: int) -> None:
    image = noise(32)
    found = worn(SQUARE, wearing(image), SQUARE, uv=OWN, choices=replace(SMALL, samples=samples))
    np.testing.assert_array_equal(found.image, image)
    assert (found.material.alpha, found.used, found.low, found.torn) == ("opaque", 1.0, 0.0, 0.0)


def test_two_triangles_with_several_threads_and_parts(sphere: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    uv = charted(64, 2)
    look = wearing(noise(64), uv)
    one = worn(sphere, look, sphere, uv=uv, choices=replace(SMALL, size=64))
    monkeypatch.setattr("meshmatch.transfer.bake._CHUNK", 100)
    many = worn(sphere, look, sphere, uv=uv, choices=replace(SMALL, size=64, workers=3))
    np.testing.assert_array_equal(one.image, many.image)


def test_one_color_stays_one_color_whatever_the_map(sphere: Shape, torus: Shape) -> None:
    rng = np.random.default_rng(4)
    face, weights = rng.integers(0, sphere.F, torus.V), rng.dirichlet((1, 1, 1), torus.V)
    wild = VertexMap.between(torus, sphere, sphere.faces[face, 0], face=face, barycentric=weights)
    image = np.full((16, 16, 4), (200, 100, 50, 255), np.uint8)
    found = worn(sphere, wearing(image, charted(64, 1)), torus, wild)
    assert (found.image == (200, 100, 50, 255)).all()


# Against the slow way


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(N, 3) light of an image at places (N, 2)."""
    height, width = image.shape[:2]
    x, y = (uv * [width, height] - 0.5).T
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    total = np.zeros((len(uv), 3))
    for i in (0, 1):
        for j in (0, 1):
            share = np.abs(1 - i - (x - left)) * np.abs(1 - j - (y - top))
            total += share[:, None] * to_linear(image[(top + j) % height, (left + i) % width, :3] / 255.0)
    return total


def smooth(size: int) -> np.ndarray:
    """A picture that changes slowly, everywhere in another way."""
    y, x = np.mgrid[:size, :size] / size
    waves = [np.sin(6 * x + 2 * y), np.sin(5 * y - 3 * x), np.cos(7 * x * y)]
    image = np.full((size, size, 4), 255, np.uint8)
    image[..., :3] = np.round(127.5 + 120 * np.stack(waves, axis=-1))
    return image


def test_texels_against_a_slow_oracle(sphere: Shape, make_sphere: Callable[[int], Shape]) -> None:
    """From a fine sphere to a coarse one: a triangle of the target covers many of the source."""
    coarse = make_sphere(1)
    look, uv = wearing(smooth(64), charted(64, 2)), charted(48, 2, 1)
    back = nearest_map(coarse, sphere)
    image = worn(sphere, look, coarse, back, uv, replace(SMALL, size=48, samples=1)).image
    faces = draw_triangles(uv * 48, 48)[0]
    row, column = np.argwhere(faces >= 0)[::7].T
    face = faces[row, column]
    matrices = np.concatenate([uv[face].swapaxes(1, 2) * 48, np.ones((len(face), 1, 3))], axis=1)
    weights = np.linalg.solve(matrices, np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)[..., None])
    points = np.einsum("nk,nkd->nd", weights[..., 0], back.points(sphere)[coarse.faces[face]])
    laid = []
    for point in points:  # the closest of all triangles
        held = closest_on_triangles(np.tile(point, (sphere.F, 1)), *sphere.verts[sphere.faces].swapaxes(0, 1))
        gap = np.linalg.norm(np.einsum("nk,nkd->nd", held, sphere.verts[sphere.faces]) - point, axis=1)
        laid.append(held[gap.argmin()] @ look.uv[gap.argmin()])
    assert len(laid) > 50
    off = np.abs(255 * to_srgb(bilinear(smooth(64), np.array(laid))) - image[row, column, :3]).max(axis=1)
    # the source's own padding is made up: near its seams the last texel differs from the slow way's
    assert np.mean(off < 3) > 0.9
    assert np.median(off) < 1


def test_a_finer_mesh_of_the_same_surface_shows_the_same(sphere: Shape) -> None:
    fine, _, back = split(sphere)
    own = charted(64, 2)
    # the middle of an edge has the mean of its ends' coordinates, in each of the faces beside it
    a, b, c = own[:, 0], own[:, 1], own[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    uv = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    image = noise(64)
    found = worn(sphere, wearing(image, own), fine, back, uv, replace(SMALL, size=64, samples=1))
    inside = draw_triangles(uv * 64, 64)[0] >= 0
    assert (np.abs(found.image[inside].astype(int) - image[inside]).max(axis=1) <= 2).mean() > 0.98


# Seams


def islands(uv: np.ndarray, size: int) -> np.ndarray:
    """Bright charts on black, nothing painted past their edges."""
    image = noise(size, 5)
    image[..., :3] = 150 + image[..., :3] // 3
    image[draw_triangles(uv * size, size)[0] < 0] = (0, 0, 0, 255)
    return image


def surface_light(image: np.ndarray, uv: np.ndarray, level: int) -> np.ndarray:
    """What a viewer shows of mip level `level` along all edges of all triangles: (N,) darkest channel."""
    light = to_linear(image[..., :3] / 255.0)
    for _ in range(level):
        light = (light[0::2, 0::2] + light[1::2, 0::2] + light[0::2, 1::2] + light[1::2, 1::2]) / 4
    share = np.linspace(0, 1, 9)[:, None, None, None]
    points = (uv * (1 - share) + np.roll(uv, -1, axis=1) * share).reshape(-1, 2) * len(light) - 0.5
    low = np.floor(points).astype(int)
    part = points - low
    total = np.zeros(len(points))
    for i in (0, 1):
        for j in (0, 1):
            weight = abs(1 - i - part[:, 0]) * abs(1 - j - part[:, 1])
            column, row = (np.clip(low[:, k] + d, 0, len(light) - 1) for k, d in ((0, i), (1, j)))
            total += weight * light[row, column].min(axis=1)
    return total


@pytest.mark.parametrize("size", [32, 128])  # smaller and larger than the source
def test_no_background_along_any_seam_at_any_mip_level(sphere: Shape, size: int) -> None:
    uv = charted(64, 1)
    look = wearing(islands(uv, 64), uv)
    target = Shape(sphere.verts[:, [1, 2, 0]], sphere.faces)  # turned: its charts lie elsewhere
    back = nearest_map(target, sphere)
    new = unwrapped(target, size, 4)
    padded = worn(sphere, look, target, back, new, replace(SMALL, size=size, padding=4))
    bare = worn(sphere, look, target, back, new, replace(SMALL, size=size, padding=0))
    least = to_linear(148 / 255)
    for level in range(5):
        assert surface_light(padded.image, new, level).min() > least
        assert surface_light(bare.image, new, level).min() < 0.6 * least  # the check sees a seam
    assert (bare.image[draw_triangles(new * size, size)[0] < 0] == 0).all()


def test_both_sides_of_a_new_seam_show_the_same(sphere: Shape) -> None:
    """A seam runs through a smooth picture: seen from both sides, its colors must agree."""
    y = sphere.verts
    colors = np.concatenate([0.5 + 0.4 * np.sin(4 * y), np.ones((sphere.V, 1))], axis=1)
    look = Appearance((Material(),), np.zeros(sphere.F, np.int64), np.zeros((sphere.F, 3, 2)), colors)
    uv = charted(256, 4)
    found = worn(sphere, look, sphere, uv=uv, choices=replace(SMALL, size=256))
    ends = np.sort(sphere.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    light = bilinear(found.image, ((uv + np.roll(uv, -1, axis=1)) / 2).reshape(-1, 2))  # in the middle of each edge
    order = np.lexsort(ends.T)
    one, two = to_srgb(light[order]).reshape(-1, 2, 3).swapaxes(0, 1)
    assert (ends[order][0::2] == ends[order][1::2]).all()
    assert 255 * np.abs(one - two).max() < 2.5


def test_a_source_without_padding_is_not_darker_at_its_seams(sphere: Shape) -> None:
    uv = charted(64, 1)
    plain = islands(uv, 64)
    plain[draw_triangles(uv * 64, 64)[0] >= 0] = (220, 220, 220, 255)
    found = worn(sphere, wearing(plain, uv), sphere, uv=charted(32, 2))
    assert found.image[..., :3].min() >= 219


def test_coordinates_are_not_interpolated_across_the_sources_seams() -> None:
    """Two triangles whose pieces lie at opposite ends of the picture, with a trap between them."""
    image = np.zeros((16, 16, 4), np.uint8)
    image[...] = (255, 0, 255, 255)  # the trap
    image[:, :4] = (255, 200, 0, 255)
    image[:, -4:] = (0, 200, 255, 255)
    narrow = OWN * (0.2, 1.0)
    narrow[1] += (0.8, 0.0)
    found = worn(SQUARE, wearing(image, narrow), SQUARE, uv=OWN)
    assert (found.image[..., 1] > 190).all()
    assert (np.abs(found.image[20, 20].astype(int) - (255, 200, 0, 255)) <= 1).all()
    assert (np.abs(found.image[4, 4].astype(int) - (0, 200, 255, 255)) <= 1).all()


# Materials


def test_several_materials_with_images_factors_and_vertex_colors() -> None:
    red = np.full((4, 4, 4), (255, 0, 0, 255), np.uint8)
    materials = (Material("a", red, factor=(0.5, 1, 1, 1)), Material("b", factor=(0.0, 0.25, 1.0, 1.0)))
    colors = np.tile([1.0, 1.0, 0.5, 1.0], (4, 1))
    look = Appearance(materials, np.array([0, 1]), OWN, colors)
    found = worn(SQUARE, look, SQUARE, uv=OWN).image
    np.testing.assert_array_equal(found[25, 25], [round(255 * float(to_srgb(0.5))), 0, 0, 255])
    blue = [0, round(255 * float(to_srgb(0.25))), round(255 * float(to_srgb(0.5))), 255]
    np.testing.assert_array_equal(found[5, 5], blue)


@pytest.mark.parametrize(
    ("names", "called"), [(("skin", "skin"), "skin"), (("skin", "cloth"), "square"), (("", ""), "square")]
)
def test_one_material_of_several_is_called_as_the_target(names: tuple[str, str], called: str) -> None:
    look = Appearance(tuple(Material(name, noise(4)) for name in names), np.array([0, 1]), OWN)
    assert worn(SQUARE, look, replace(SQUARE, name="square.ply"), uv=OWN).material.name == called


def test_materials_that_share_an_image_share_what_is_known_of_it() -> None:
    """Each half of the picture lies under another material: neither may take the other's for background."""
    image = quarters(32)
    two = (Material("a", image), Material("b", image, factor=(1.0, 1.0, 1.0, 1.0)))
    found = worn(SQUARE, Appearance(two, np.array([0, 1]), OWN), SQUARE, uv=OWN, choices=replace(SMALL, samples=1))
    np.testing.assert_array_equal(found.image, image)


@pytest.mark.parametrize("wrap", ["repeat", "mirror", "clamp"])
def test_a_tiled_picture(wrap: str) -> None:
    """Coordinates from -1 to 1: four times the quarters, by the rule of the sampler."""
    image = quarters(8)
    uv = OWN * 2.0 - 1.0
    found = worn(SQUARE, wearing(image, uv, wrap=(wrap, wrap)), SQUARE, uv=OWN, choices=replace(SMALL, samples=1))
    red, green, blue, white = (tuple(image[y, x, :3].tolist()) for y, x in ((0, 0), (0, 7), (7, 0), (7, 7)))
    want = {
        "repeat": [[red, green, red, green], [blue, white, blue, white]] * 2,
        "mirror": [
            [white, blue, blue, white], [green, red, red, green],
            [green, red, red, green], [white, blue, blue, white],
        ],
        "clamp": [[red, red, red, green]] * 3 + [[blue, blue, blue, white]],
    }[wrap]  # fmt: skip
    got = [[tuple(found.image[8 * y + 4, 8 * x + 4, :3].tolist()) for x in range(4)] for y in range(4)]
    assert got == want


def test_many_fine_stripes_become_grey_not_noise() -> None:
    image = np.zeros((256, 256, 4), np.uint8)
    image[..., 3] = 255
    image[::2, :, :3] = 255
    for samples in (1, 2, 4):
        found = worn(SQUARE, wearing(image), SQUARE, uv=OWN, choices=replace(SMALL, samples=samples)).image
        assert (np.abs(found[..., :3].astype(int) - 188) <= 2).all()


def test_a_seam_of_the_source_is_smoothed_by_more_samples() -> None:
    materials = (Material("a", factor=(1.0, 1.0, 1.0, 1.0)), Material("b", factor=(0.0, 0.0, 0.0, 1.0)))
    look = Appearance(materials, np.array([0, 1]), OWN)
    kinds = []
    for samples in (1, 2, 4):
        found = worn(SQUARE, look, SQUARE, uv=OWN, choices=replace(SMALL, samples=samples)).image
        kinds.append(len(np.unique(found[..., 0])))
        across = np.array([1 - np.fliplr(to_linear(found[..., 0] / 255.0)).trace() / 32])
        assert 0 <= across[0] <= 1
    assert kinds[0] == 2 and kinds[0] < kinds[1] <= kinds[2]


# Alpha


def test_alpha_is_kept_and_the_color_of_holes_is_not() -> None:
    image = np.zeros((32, 32, 4), np.uint8)
    image[...] = (255, 0, 255, 0)
    image[8:24, 8:24] = (0, 100, 200, 255)
    image[12:20, 12:20, 3] = 100
    found = worn(SQUARE, wearing(image, alpha="blend"), SQUARE, uv=OWN)
    assert found.material.alpha == "blend"
    np.testing.assert_array_equal(found.image[..., 3], image[..., 3])
    assert (found.image[8:24, 8:24, :3] == (0, 100, 200)).all()
    assert found.image[..., 0].max() <= 1  # the invisible magenta stays out
    assert worn(SQUARE, wearing(image), SQUARE, uv=OWN).image[..., 3].min() == 255


def test_thresholds_of_alpha() -> None:
    image = np.full((32, 32, 4), (10, 20, 30, 90), np.uint8)
    one = worn(SQUARE, wearing(image, alpha="mask", cutoff=0.25), SQUARE, uv=OWN)
    assert (one.material.alpha, one.material.cutoff) == ("mask", 0.25)
    assert (one.image[..., 3] == 90).all()
    a, b = Material("a", image, alpha="mask", cutoff=0.25), Material("b", image, alpha="mask", cutoff=0.6)
    two = worn(SQUARE, Appearance((a, b), np.array([0, 1]), OWN), SQUARE, uv=OWN)
    assert (two.material.alpha, two.material.cutoff) == ("mask", 0.5)
    assert two.image[25, 25, 3] == 255 and two.image[5, 5, 3] == 0  # decided by each material's own threshold
    glass = Material("c", image, alpha="blend")
    three = worn(SQUARE, Appearance((glass, b), np.array([0, 1]), OWN), SQUARE, uv=OWN)
    assert three.material.alpha == "blend"
    assert three.image[25, 25, 3] == 90 and three.image[5, 5, 3] == 0
    solid = Material("d", image)
    four = worn(SQUARE, Appearance((glass, solid), np.array([0, 1]), OWN), SQUARE, uv=OWN)
    assert four.image[25, 25, 3] == 90 and four.image[5, 5, 3] == 255
    five = worn(SQUARE, Appearance((glass, solid), np.array([1, 1]), OWN), SQUARE, uv=OWN)
    assert (four.material.alpha, five.material.alpha) == ("blend", "opaque")
    clear = np.full((32, 32, 4), 255, np.uint8)
    assert worn(SQUARE, wearing(clear, alpha="mask"), SQUARE, uv=OWN).material.alpha == "opaque"


# LowConfidence


def doubtful() -> VertexMap:
    """Of the square to itself; the corner (1, 1) is a guess."""
    return replace(VertexMap.identity(SQUARE), confidence=np.float32([1, 1, 0, 1]))


def test_doubt_is_reported_and_kept_left_blank_or_filled() -> None:
    image = noise(32)
    look = wearing(image)
    kept = worn(SQUARE, look, SQUARE, doubtful(), OWN)
    # confidence is 1 - x in one triangle and 1 - y in the other: less than 0.3 near the corner (1, 1)
    assert kept.low == pytest.approx(2 * 0.3**2 / 2, abs=0.02)
    np.testing.assert_array_equal(kept.image, image)
    corner, far = kept.image[1, 30], kept.image[28, 3]

    blank = worn(SQUARE, look, SQUARE, doubtful(), OWN, replace(SMALL, blank=(1.0, 0.0, 0.0, 1.0)))
    assert blank.image[1, 30].tolist() == [255, 0, 0, 255] and blank.material.alpha == "opaque"
    np.testing.assert_array_equal(blank.image[28, 3], far)
    hole = worn(SQUARE, look, SQUARE, doubtful(), OWN, replace(SMALL, blank=(0.0, 0.0, 0.0, 0.0)))
    assert hole.material.alpha == "mask"
    assert hole.image[1, 30, 3] == 0 and hole.image[28, 3, 3] == 255
    glass = worn(SQUARE, look, SQUARE, doubtful(), OWN, replace(SMALL, blank=(0.0, 0.0, 0.0, 0.4)))
    assert glass.material.alpha == "blend" and glass.image[1, 30, 3] == 102

    filled = worn(SQUARE, look, SQUARE, doubtful(), OWN, replace(SMALL, fill=True))
    assert (filled.image[1, 30] != corner).any()
    np.testing.assert_array_equal(filled.image[28, 3], far)
    assert worn(SQUARE, look, SQUARE, doubtful(), OWN, replace(SMALL, min_confidence=0.0)).low == 0.0


def test_filling_takes_the_colors_around() -> None:
    image = np.full((32, 32, 4), (0, 0, 255, 255), np.uint8)
    image[:12, 20:] = (255, 0, 0, 255)  # what is in doubt is red
    for padding in (0, 2):
        choices = replace(SMALL, fill=True, padding=padding, min_confidence=0.5)
        found = worn(SQUARE, wearing(image), SQUARE, doubtful(), OWN, choices).image
        assert found[0, 31].tolist() == [0, 0, 255, 255]


# Maps that tear


def strips() -> tuple[Shape, Appearance]:
    """Three squares in a row, red, green and blue."""
    x = np.arange(4.0)
    verts = np.concatenate([np.stack([x, 0 * x, 0 * x], 1), np.stack([x, 0 * x + 1, 0 * x], 1)])
    faces = np.concatenate([[[k, k + 1, k + 5], [k, k + 5, k + 4]] for k in range(3)])
    colors = ((1.0, 0, 0, 1), (0, 1.0, 0, 1), (0, 0, 1.0, 1))
    materials = tuple(Material(factor=color) for color in colors)  # type: ignore[arg-type]
    look = Appearance(materials, np.repeat([0, 1, 2], 2), np.zeros((6, 3, 2)))
    return Shape(verts, faces, "strips"), look


def torn_case() -> tuple[Shape, VertexMap, np.ndarray]:
    """A fine sheet whose left half lies on red and whose right half lies on blue: one column is torn."""
    target = grid(12, 12, 1 / 12, "sheet")
    left = target.verts[:, 0] < 0.5
    x, y = np.where(left, target.verts[:, 0], target.verts[:, 0] - 0.45), target.verts[:, 1]
    upper = y > x
    weights = np.where(upper[:, None], np.stack([1 - y, x, y - x], 1), np.stack([1 - x, x - y, y], 1))
    face = np.where(left, 0, 4) + upper
    source = strips()[0]
    back = VertexMap.between(target, source, source.faces[face, 0], face=face, barycentric=weights)
    return target, back, (target.verts[:, :2] * [1, -1] + [0, 1])[target.faces]


def test_nothing_is_smeared_where_a_map_tears(monkeypatch: pytest.MonkeyPatch) -> None:
    source, look = strips()
    target, back, uv = torn_case()
    found = worn(source, look, target, back, uv, replace(SMALL, size=96))
    assert found.torn == pytest.approx(1 / 12, abs=1e-9)
    assert found.image[..., 1].max() == 0  # what lies between is nowhere to be seen
    assert (found.image[40, 10, :3] == (255, 0, 0)).all() and (found.image[40, 90, :3] == (0, 0, 255)).all()
    monkeypatch.setattr(texel_colors, "_STRETCH", 1e9)
    smeared = worn(source, look, target, back, uv, replace(SMALL, size=96))
    assert smeared.image[..., 1].max() == 255  # the check sees a smear


def test_a_texture_goes_on_up_to_the_cut() -> None:
    """Beside a tear each side continues as it would have: no patch of one color around a vertex."""
    source, _ = strips()
    target, back, uv = torn_case()
    x = np.mgrid[:64, :192][1]
    image = np.zeros((64, 192, 4), np.uint8)
    image[..., 0], image[..., 1], image[..., 3] = x, 0, 255
    laid = source.verts[:, :2][source.faces] / (3.0, 1.0)
    laid[..., 1] = 1 - laid[..., 1]
    look = wearing(image, laid, wrap=("clamp", "clamp"))
    found = worn(source, look, target, back, uv, replace(SMALL, size=96, samples=1)).image
    steps = np.diff(found[48, :, 0].astype(int))
    cut = int(steps.argmax())
    assert 40 <= cut <= 48 and steps[cut] > 40
    assert (np.delete(steps, cut) >= 0).all() and (np.delete(steps, cut) <= 2).all()
    before = found[48, cut - 6 : cut + 1, 0].astype(int)
    assert before[-1] - before[0] >= 3  # it has not stopped


# Clouds, colors, oddities


def test_a_cloud_as_source(sphere: Shape) -> None:
    colors = np.concatenate([(sphere.verts + 1) / 2, np.ones((sphere.V, 1))], axis=1)
    cloud = Shape(sphere.verts, np.empty((0, 3), int), "cloud", colors)
    look = Appearance((Material(),), np.empty(0, np.int64), np.empty((0, 3, 2)), colors)
    back = VertexMap.between(sphere, cloud, np.arange(sphere.V))
    uv = charted(64, 2)
    found = worn(cloud, look, sphere, back, uv, replace(SMALL, size=64))
    face = draw_triangles(uv * 64, 64)[0]
    rows = np.argwhere(face >= 0)
    middle = sphere.verts[sphere.faces[face[face >= 0]]].mean(axis=1)
    seen = to_linear(found.image[rows[:, 0], rows[:, 1], :3] / 255.0)
    assert np.abs(seen - (middle + 1) / 2).max() < 0.12


def test_points_get_colors(sphere: Shape) -> None:
    image = smooth(64)
    look = wearing(image, charted(64, 2))
    fine, _, back = split(sphere)
    cloud = Shape(fine.verts, np.empty((0, 3), int), "cloud")
    at = replace(back, source_hash=cloud.hash)
    found = colors_of_vertices(sphere, look, cloud, at)
    assert found.shape == (fine.V, 4)
    held = back.face >= 0
    want = bilinear(image, np.einsum("nk,nkd->nd", back.barycentric[held], look.uv[back.face[held]]))
    assert np.abs(to_srgb(found[held, :3]) - to_srgb(want)).mean() < 0.01
    np.testing.assert_allclose(found, colors_of_vertices(sphere, look, fine, back), atol=0.03)


@pytest.mark.parametrize("slant", [0.0, 0.3])
def test_a_ramp_along_a_line_of_the_image_is_not_mixed_with_the_rest(slant: float) -> None:
    """Coordinates on one line, as of an image of heights, between two columns of texels: triangles hold none of them."""
    height = np.linspace(0.1, 0.9, 9)
    verts = np.column_stack([np.tile([0.0, 0.1], 9), np.repeat(height, 2), np.zeros(18)])
    faces = np.array([[k, k + 1, k + 2] if k % 2 == 0 else [k + 1, k, k + 2] for k in range(16)])
    uv = np.column_stack([0.5 + slant * (verts[:, 1] - 0.5), verts[:, 1]])[faces]
    image = np.full((64, 64, 4), 255, np.uint8)
    image[..., :3] = np.linspace(0, 255, 64).astype(np.uint8)[:, None, None]
    look, strip = wearing(image, uv), Shape(verts, faces)
    found = to_srgb(colors_of_vertices(strip, look, strip, VertexMap.identity(strip))[:, 0])
    assert found == pytest.approx(verts[:, 1], abs=0.02)


def test_fine_detail_becomes_a_mean_at_a_sparse_point() -> None:
    image = np.zeros((64, 64, 4), np.uint8)
    image[..., 3] = 255
    image[::2, :, :3] = 255
    found = colors_of_vertices(SQUARE, wearing(image), SQUARE, VertexMap.identity(SQUARE))
    np.testing.assert_allclose(found[:, :3], 0.5, atol=0.02)


def test_a_corner_without_a_place_takes_its_faces_along() -> None:
    verts = np.concatenate([CORNERS, [[9.0, 9, 9]]])
    target = Shape(verts, np.concatenate([FACES, [[0, 4, 1]]]), "nan", invalid=np.array([0, 0, 0, 0, 1], bool))
    uv = np.concatenate([OWN, np.zeros((1, 3, 2))])
    back = VertexMap.between(target, SQUARE, [0, 1, 2, 3, 0])
    made = transfer_texture(SQUARE, wearing(noise(32)), target, back, Atlas(uv, True), SMALL)
    np.testing.assert_array_equal(made.image, noise(32))


@pytest.mark.parametrize(
    "change",
    [
        *[{"size": 8}, {"size": 8193}, {"size": "8"}, {"samples": 0}, {"samples": 9}, {"samples": 1.5}],
        *[{"padding": -1}, {"padding": 9}, {"workers": 0}, {"fill": True, "blank": (0, 0, 0, 0)}],
    ],
)
def test_choices_that_cannot_be(change: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match=next(iter(change))):
        replace(SMALL, **change)


def test_progress_goes_from_nothing_to_all() -> None:
    told: list[float] = []
    transfer_texture(
        SQUARE, wearing(noise(32)), SQUARE, VertexMap.identity(SQUARE), Atlas(OWN, True), SMALL, told.append
    )
    assert told == sorted(told) and told[-1] == 1.0
