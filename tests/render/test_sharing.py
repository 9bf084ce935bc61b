"""One look on two shapes: what a page shows under Texture."""

from collections.abc import Callable

import numpy as np
import pytest

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.viewer import looks as module
from meshmatch.render.viewer.looks import Looks, share_look
from meshmatch.shapes.appearance import Appearance, Material, vertex_colors_alone
from meshmatch.shapes.colors import to_srgb
from meshmatch.shapes.shape import Shape
from tests.render.pairs import Pair, bump, shuffled_pair


@pytest.fixture(scope="module")
def pair(make_sphere: Callable[[int], Shape]) -> Pair:
    found = shuffled_pair(bump(make_sphere(3)))
    sure = {"confidence": np.ones(found.source.V, np.float32)}
    there = VertexMap.between(found.source, found.target, found.there.index, **sure)
    return Pair(found.source, found.target, there, VertexMap.between(found.target, found.source, found.back.index))


def height(shape: Shape) -> np.ndarray:
    low, high = shape.bounds[:, 1]
    return (shape.verts[:, 1] - low) / (high - low)


@pytest.fixture(scope="module")
def textured(pair: Pair) -> Appearance:
    """Redder with height, from texture coordinates that know the height alone."""
    pixels = np.full((4, 256, 4), 255, np.uint8)
    pixels[..., 0], pixels[..., 1:3] = np.arange(256), 40
    up = height(pair.source)[pair.source.faces]
    uv = np.stack([(up * 255 + 0.5) / 256, np.full_like(up, 0.5)], axis=2)
    material = Material("height", pixels, wrap=("clamp", "clamp"))
    return Appearance((material,), np.zeros(pair.source.F, np.int64), uv)


def colored(shape: Shape) -> Appearance:
    red = np.stack([height(shape), *[np.full(shape.V, 0.2)] * 2, np.ones(shape.V)], axis=1)
    return vertex_colors_alone(Shape(shape.verts, shape.faces, shape.name, red))


def check_reds(looks: Looks | None, side: int, shape: Shape, expected: np.ndarray, most: float = 0.06) -> Looks:
    """The red of each vertex in what a shape wears, at the nearest texel."""
    assert looks is not None
    worn = looks.shown[side]
    if worn.colors is not None:
        seen = to_srgb(worn.colors[:, 0])
    else:
        (material,) = worn.materials
        assert material.image is not None and material.image.shape == (module.TEXELS, module.TEXELS, 4)
        column, row = (worn.uv.reshape(-1, 2) * module.TEXELS).astype(int).clip(0, module.TEXELS - 1).T
        seen = np.empty(shape.V)
        seen[shape.faces.ravel()] = material.image[row, column, 0] / 255
    assert np.abs(seen - expected).max() < most
    return looks


def test_a_texture_is_baked_for_the_other_mesh(pair: Pair, textured: Appearance) -> None:
    """With new coordinates, or with the wearer's own where they serve."""
    there, expected = (pair.source, pair.target), height(pair.source)[pair.back.index]
    looks = check_reds(share_look(there, (textured, None), pair.there, pair.back), 1, pair.target, expected)
    assert (looks.side, looks.own) == ("source", None)
    assert looks.shown[0] is textured
    own = looks.shown[1].uv[:, :, ::-1]  # an atlas, but another one
    again = share_look(there, (textured, None), pair.there, pair.back, coordinates=(None, own), workers=2)
    assert np.allclose(check_reds(again, 1, pair.target, expected).shown[1].uv, own)


def test_a_source_without_a_look_wears_the_targets(pair: Pair, textured: Appearance) -> None:
    looks = share_look((pair.target, pair.source), (None, textured), pair.back, pair.there)
    check_reds(looks, 0, pair.target, height(pair.source)[pair.back.index])
    assert looks is not None
    assert (looks.side, looks.own) == ("target", None)
    assert looks.shown[1] is textured


def test_two_looks_are_both_kept_and_none_is_none(pair: Pair, textured: Appearance) -> None:
    other = colored(pair.target)
    looks = share_look((pair.source, pair.target), (textured, other), pair.there, pair.back)
    assert looks is not None
    assert looks.own is other
    assert looks.words == {"look": {"kind": "texture", "side": "source"}, "own": True}
    assert [name for name, _ in looks.of(0)] == ["look", "own"]
    assert looks.of(0)[1][1] is textured
    assert looks.of(1)[1][1] is other
    assert share_look((pair.source, pair.target), (None, None), pair.there, pair.back) is None


@pytest.mark.parametrize("cloud", [False, True])
def test_colors_of_vertices_are_carried_as_such(pair: Pair, cloud: bool) -> None:
    source = Shape(pair.source.verts, None if cloud else pair.source.faces, "source")
    there = VertexMap.between(source, pair.target, pair.there.index)
    back = VertexMap.between(pair.target, source, pair.back.index)
    looks = share_look((source, pair.target), (colored(source), None), there, back)
    check_reds(looks, 1, pair.target, height(source)[pair.back.index], 0.01)
    assert looks is not None and looks.words["look"] == {"kind": "colors", "side": "source"}


@pytest.mark.parametrize("why", ["cloud", "fine"])
def test_where_nothing_can_be_baked_vertices_have_colors(
    pair: Pair, textured: Appearance, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_FACES", 100 if why == "fine" else 10**6)
    other = Shape(pair.target.verts, pair.target.faces if why == "fine" else None, "other")
    back = VertexMap.between(other, pair.source, pair.back.index)
    there = VertexMap.between(pair.source, other, pair.there.index)
    looks = share_look((pair.source, other), (textured, None), there, back)
    check_reds(looks, 1, other, height(pair.source)[pair.back.index], 0.05)
    assert looks is not None and not looks.shown[1].textured
