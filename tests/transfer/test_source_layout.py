"""The layout of a source on a target."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.errors import InputError, OptionError
from meshmatch.geometry.triangles import planar_areas
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.source_layout import check_layout, source_layout
from meshmatch.transfer.surface_walk import SurfaceWalker
from meshmatch.transfer.texel_colors import find_charts
from meshmatch.transfer.unwrap import shared_texels, unwrapped
from tests.conftest import icosphere
from tests.shapes.painted import encoded, quarters, write_gltf
from tests.transfer.known import split

PICTURE = Material(image=quarters())
SMALL = meshmatch.BakeOptions(size=32, padding=1)


def looking(shape: Shape, uv: np.ndarray) -> Appearance:
    return Appearance((PICTURE,), np.zeros(shape.F, np.int64), uv)


@pytest.fixture(scope="module")
def ball() -> tuple[Shape, Appearance]:
    shape = icosphere(3)
    return shape, looking(shape, unwrapped(shape, 512, 8))


def nearest(target: Shape, source: Shape) -> VertexMap:
    """The foot of each vertex on the source, by a walk."""
    walker = SurfaceWalker(source)
    near = np.linalg.norm(target.verts[:, None] - source.verts[None], axis=2).argmin(axis=1)
    points = ((target.verts - walker.center) / walker.unit).T.astype(np.float32)
    face, weights, _ = walker.closest(points, walker.face_of_vertex[near].astype(np.int32))
    corner = source.faces[face, weights.argmax(axis=0)]
    return VertexMap.between(target, source, corner, face=face, barycentric=weights.T.astype(np.float64))


def test_on_the_source_itself_it_is_its_own(ball: tuple[Shape, Appearance]) -> None:
    shape, look = ball
    uv, charts = source_layout(shape, look, shape, VertexMap.identity(shape))
    assert np.abs(uv - look.uv).max() < 1e-4
    assert charts == len(np.unique(find_charts(SurfaceWalker(shape), look)))


def test_a_finer_mesh_gets_the_points_between(ball: tuple[Shape, Appearance]) -> None:
    shape, look = ball
    fine, _, back = split(shape)
    uv, _ = source_layout(shape, look, fine, back)
    assert uv.shape == (fine.F, 3, 2)
    assert planar_areas(uv).sum() == pytest.approx(planar_areas(look.uv).sum(), rel=1e-3)
    assert shared_texels(uv) < 1e-3


def test_no_triangle_spans_two_charts_of_the_source(ball: tuple[Shape, Appearance]) -> None:
    """Of another mesh on the same ball each triangle gets about the room that it deserves, and few texels two places."""
    shape, look = ball
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    other = Shape(shape.verts @ (turn * np.sign(np.linalg.det(turn))), shape.faces, "other")
    uv, _ = source_layout(shape, look, other, nearest(other, shape))
    density = np.sqrt(planar_areas(look.uv).sum() / shape.area)
    edges = np.linalg.norm(uv - np.roll(uv, -1, axis=1), axis=2)
    long = np.linalg.norm(other.verts[other.faces] - np.roll(other.verts[other.faces], -1, axis=1), axis=2)
    assert (edges < 2.5 * density * long).all()
    share = planar_areas(uv) / (density**2 * other.face_areas)
    assert np.quantile(share, 0.02) > 0.3 and share.max() < 4
    assert shared_texels(uv) < 0.05


def test_no_seam_crosses_a_polygon(ball: tuple[Shape, Appearance]) -> None:
    shape, look = ball
    polygons = np.arange(shape.F) // 2
    uv, _ = source_layout(shape, look, shape, VertexMap.identity(shape), polygons)
    for first, second in zip(range(0, shape.F, 2), range(1, shape.F, 2), strict=True):
        a, b = shape.faces[first].tolist(), shape.faces[second].tolist()
        for vertex in set(a) & set(b):
            assert np.abs(uv[first, a.index(vertex)] - uv[second, b.index(vertex)]).max() < 2e-3


def test_what_cannot_be_carried_over(ball: tuple[Shape, Appearance]) -> None:
    shape, look = ball
    identity = VertexMap.identity(shape)
    shifted = source_layout(shape, replace(look, uv=look.uv + np.array([3.0, -2.0])), shape, identity)[0]
    assert np.abs(shifted - look.uv).max() < 1e-4  # whole repeats change nothing
    with pytest.raises(InputError, match="reach over the edge of their image, as tiles do"):
        source_layout(shape, replace(look, uv=4 * look.uv), shape, identity)
    with pytest.raises(OptionError, match="no texture with coordinates"):
        check_layout(shape, replace(look, materials=(Material(),)))
    with pytest.raises(OptionError, match="no texture with coordinates"):
        check_layout(Shape(shape.verts, np.empty((0, 3), int)), look)


def test_images_that_lie_over_each_other_cannot_become_one(tmp_path: Path) -> None:
    """Two squares with the same coordinates in different images: one is red where the other is white."""
    path = tmp_path / "two.glb"
    images = [encoded(np.full((4, 4, 4), color, np.uint8)) for color in ([255, 0, 0, 255], [255, 255, 255, 255])]
    write_gltf(path, primitives=[{"material": 0}, {"material": 1}], images=images)
    shape = load_shape(path)
    with pytest.raises(OptionError, match=r"the layout of two.glb cannot be carried over: .* which look different"):
        meshmatch.transfer_texture(path, shape, VertexMap.identity(shape), uv="source", options=SMALL)
    same = [images[0], images[0]]
    write_gltf(path, primitives=[{"material": 0}, {"material": 1}], images=same)
    result = meshmatch.transfer_texture(path, shape, VertexMap.identity(shape), uv="source", options=SMALL)
    assert (result.baked.image == [255, 0, 0, 255]).all()
    assert "100.0 % of its texels have several places" in result.atlas.note
    pile = Shape(np.tile(shape.verts, (8, 1)), np.concatenate([shape.faces + k * shape.V for k in range(8)]), "pile")
    there = VertexMap.between(shape, pile, np.arange(shape.V))
    back = VertexMap.between(pile, shape, np.tile(np.arange(shape.V), 8))
    maps = meshmatch.MapPair(shape, pile, there, opposite=back)
    with pytest.raises(OptionError, match=r"it covers the image 16.0 times"):
        meshmatch.transfer_texture(path, pile, maps, uv="source", options=SMALL)
