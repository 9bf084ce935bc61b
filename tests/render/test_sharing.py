"""One look on two shapes: what a page shows under Texture."""

from collections.abc import Callable

import numpy as np
import pytest

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.viewer import looks as module
from meshmatch.render.viewer.looks import share_look, vertex_paint
from meshmatch.shapes.appearance import Appearance, Material, vertex_colors_alone
from meshmatch.shapes.shape import Shape
from tests.render.pairs import Pair, bump, stirred


@pytest.fixture(scope="module")
def pair(make_sphere: Callable[[int], Shape]) -> Pair:
    found = stirred(bump(make_sphere(3)))
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


def test_a_texture_is_baked_for_the_other_mesh(pair: Pair, textured: Appearance) -> None:
    looks = share_look((pair.source, pair.target), (textured, None), pair.there, pair.back)
    assert looks is not None
    assert (looks.side, looks.own) == ("source", None)
    assert looks.worn[0] is textured
    (material,) = looks.worn[1].materials
    assert material.image is not None
    assert material.image.shape == (module.TEXELS, module.TEXELS, 4)
    seen = vertex_paint(looks.worn[1], pair.target)[:, 0]
    assert np.abs(seen - height(pair.source)[pair.back.index]).max() < 0.06


def test_the_wearers_own_coordinates_are_used(pair: Pair, textured: Appearance) -> None:
    first = share_look((pair.source, pair.target), (textured, None), pair.there, pair.back)
    assert first is not None
    own = first.worn[1].uv[:, :, ::-1]  # an atlas, but another one
    again = share_look(
        (pair.source, pair.target), (textured, None), pair.there, pair.back, coordinates=(None, own), workers=2
    )
    assert again is not None
    assert np.allclose(again.worn[1].uv, own)
    seen = vertex_paint(again.worn[1], pair.target)[:, 0]
    assert np.abs(seen - height(pair.source)[pair.back.index]).max() < 0.06


def test_a_source_without_a_look_wears_the_targets(pair: Pair, textured: Appearance) -> None:
    looks = share_look((pair.target, pair.source), (None, textured), pair.back, pair.there)
    assert looks is not None
    assert (looks.side, looks.own) == ("target", None)
    assert looks.worn[1] is textured
    seen = vertex_paint(looks.worn[0], pair.target)[:, 0]
    assert np.abs(seen - height(pair.source)[pair.back.index]).max() < 0.06


def test_two_looks_are_both_kept(pair: Pair, textured: Appearance) -> None:
    other = colored(pair.target)
    looks = share_look((pair.source, pair.target), (textured, other), pair.there, pair.back)
    assert looks is not None
    assert looks.own is other
    assert looks.words == {"look": {"kind": "texture", "side": "source"}, "own": True}
    assert [name for name, _ in looks.of(0)] == ["look", "own"]
    assert looks.of(0)[1][1] is textured
    assert looks.of(1)[1][1] is other


def test_nothing_to_wear(pair: Pair) -> None:
    assert share_look((pair.source, pair.target), (None, None), pair.there, pair.back) is None


def test_colors_of_vertices_are_carried_as_such(pair: Pair) -> None:
    looks = share_look((pair.source, pair.target), (colored(pair.source), None), pair.there, pair.back)
    assert looks is not None
    assert looks.words["look"] == {"kind": "colors", "side": "source"}
    assert not looks.worn[1].textured
    seen = vertex_paint(looks.worn[1], pair.target)[:, 0]
    assert np.abs(seen - height(pair.source)[pair.back.index]).max() < 0.01


@pytest.mark.parametrize("why", ["cloud", "fine"])
def test_where_nothing_can_be_baked_vertices_have_colors(
    pair: Pair, textured: Appearance, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MOST_FACES", 100 if why == "fine" else 10**6)
    faces = pair.target.faces if why == "fine" else np.empty((0, 3), np.int64)
    other = Shape(pair.target.verts, faces, "other")
    back = VertexMap.between(other, pair.source, pair.back.index)
    there = VertexMap.between(pair.source, other, pair.there.index)
    looks = share_look((pair.source, other), (textured, None), there, back)
    assert looks is not None
    assert not looks.worn[1].textured
    seen = vertex_paint(looks.worn[1], other)[:, 0]
    assert np.abs(seen - height(pair.source)[pair.back.index]).max() < 0.05


def test_the_colors_of_a_cloud_are_carried(pair: Pair) -> None:
    cloud = Shape(pair.source.verts, np.empty((0, 3), np.int64), "cloud")
    there = VertexMap.between(cloud, pair.target, pair.there.index)
    back = VertexMap.between(pair.target, cloud, pair.back.index)
    looks = share_look((cloud, pair.target), (colored(cloud), None), there, back)
    assert looks is not None
    seen = vertex_paint(looks.worn[1], pair.target)[:, 0]
    assert np.abs(seen - height(pair.source)[pair.back.index]).max() < 0.01
