"""What materials say besides color, on another shape: normals in its frames, roughness, metal, occlusion, light."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from meshmatch.geometry.triangles import cross_product, normalized
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Appearance, BakedMaterial, Finish, Layer, Material
from meshmatch.shapes.formats.gltf_write import smooth_normals
from meshmatch.shapes.formats.seams import split_at_seams, vertex_tangents
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.bake import BakeOptions, transfer_texture
from meshmatch.transfer.unwrap import Atlas, unwrapped
from tests.conftest import icosphere
from tests.shapes.painted import CORNERS, FACES, UV, quarters

SQUARE = Shape(CORNERS, FACES, "square")
SMALL = BakeOptions(size=32, padding=2, workers=1)


def flat(color: tuple[float, float, float], size: int = 8) -> np.ndarray:
    """One color all over."""
    image = np.full((size, size, 4), 255, np.uint8)
    image[..., :3] = np.round(255 * np.array(color))
    return image


def layer(image: np.ndarray | None, uv: np.ndarray, **rest: Any) -> Appearance:
    rest = {"linear": True} | rest
    return Appearance((Material("m", image, **rest),), np.zeros(len(uv), np.int64), uv)


def finished(uv: np.ndarray, layers: dict[Layer, Appearance], **rest: Any) -> Appearance:
    return replace(layer(quarters(8), uv, linear=False), finish=Finish(layers, **rest))


def baked(shape: Shape, look: Appearance, uv: np.ndarray, target: Shape | None = None) -> BakedMaterial:
    target = shape if target is None else target
    back = VertexMap.between(target, shape, np.arange(shape.V))
    return transfer_texture(shape, look, target, back, Atlas(uv, True), SMALL).material


TURNED, MIRRORED = UV[:, ::-1] * [1, -1] + [0, 1], UV * [-1, 1] + [1, 0]


@pytest.mark.parametrize(
    ("source", "target", "expected"),
    [
        (UV, UV, (0.6, 0.3)),
        (UV, TURNED, (-0.3, 0.6)),  # u runs down the square now, and v to the left
        (TURNED, UV, (0.3, -0.6)),
        (UV, MIRRORED, (-0.6, 0.3)),
        (MIRRORED, UV, (-0.6, 0.3)),
        (MIRRORED, TURNED, (-0.3, -0.6)),
    ],
)
def test_normals_turn_with_the_coordinates(
    source: np.ndarray, target: np.ndarray, expected: tuple[float, float]
) -> None:
    normal = np.array([0.6, 0.3, np.sqrt(1 - 0.45)])
    look = finished(source[FACES], {"normal": layer(flat(tuple(0.5 + 0.5 * normal)), source[FACES])})
    found = baked(SQUARE, look, target[FACES]).normal
    assert found is not None
    np.testing.assert_allclose(found[..., :2] / 127.5 - 1, np.full((32, 32, 2), expected), atol=0.02)


def in_space(shape: Shape, uv: np.ndarray, image: np.ndarray) -> np.ndarray:
    """(F, 3) the normals in space that a viewer makes of a normal map at the middle of each face."""
    vertex, coordinates, corners = split_at_seams(shape.V, shape.faces, uv)
    normals = smooth_normals(shape.verts, shape.faces)[vertex]
    tangents = vertex_tangents(shape.verts[vertex], normals, corners, coordinates)
    n, t, side = (each[corners].mean(axis=1) for each in (normals, tangents[:, :3], tangents[:, 3:]))
    middle = np.floor(uv.mean(axis=1) * image.shape[0]).astype(int)
    x, y, z = (image[middle[:, 1], middle[:, 0], :3] / 127.5 - 1).T[:, :, None]
    return normalized(x * t + y * side * cross_product(normalized(n), normalized(t)) + z * n)


def test_normals_look_the_same_in_another_atlas_and_pose() -> None:
    """On a turned ball of another atlas, whose charts may be mirrored, the light falls as before."""
    ball = icosphere(3)
    first, second = unwrapped(ball, 512, 4), unwrapped(Shape(ball.verts[:, [1, 2, 0]], ball.faces, "b"), 512, 4)
    y, x = np.mgrid[:512, :512] / 512
    bumps = normalized(np.stack([0.6 * np.sin(9 * x), 0.6 * np.cos(7 * y), np.ones_like(x)], -1).reshape(-1, 3))
    image = np.full((512, 512, 4), 255, np.uint8)
    image[..., :3] = np.round(127.5 + 127.5 * bumps.reshape(512, 512, 3))
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    other = Shape(3 * ball.verts @ turn.T, ball.faces, "turned")
    look = finished(first, {"normal": layer(image, first)})
    back = VertexMap.between(other, ball, np.arange(ball.V))
    found = transfer_texture(ball, look, other, back, Atlas(second, True), replace(SMALL, size=512)).material.normal
    assert found is not None
    before, after = in_space(ball, first, image) @ turn.T, in_space(other, second, found)
    off = np.degrees(np.arccos(np.clip(np.einsum("fi,fi->f", before, after), -1, 1)))
    assert np.median(off) < 2 and np.quantile(off, 0.95) < 8


def test_the_scale_of_a_normal_map_is_baked_in() -> None:
    look = finished(UV[FACES], {"normal": layer(flat((0.75, 0.5, 0.933)), UV[FACES], strength=2.0)})
    found = baked(SQUARE, look, UV[FACES]).normal
    assert found is not None
    slope = found[16, 16, :3] / 127.5 - 1
    assert slope[0] / slope[2] == pytest.approx(2 * 0.5 / 0.866, abs=0.03)


def test_surface_and_occlusion_share_an_image() -> None:
    """Roughness and metal times their factors; half the strength of occlusion keeps half of the light."""
    uv = UV[FACES]
    layers: dict[Layer, Appearance] = {
        "surface": layer(flat((0.1, 0.8, 0.6)), uv, factor=(1.0, 0.5, 0.5, 1.0)),
        "occlusion": layer(flat((0.2, 0, 0)), uv, strength=0.5),
    }
    made = baked(SQUARE, finished(uv, layers, double_sided=False), uv)
    assert made.surface is not None and made.occluded and not made.double_sided
    np.testing.assert_allclose(made.surface[16, 16, :3] / 255.0, (0.6, 0.4, 0.3), atol=0.005)
    assert (made.roughness, made.metal, made.normal, made.glow) == (1.0, 1.0, None, None)


def test_occlusion_leaves_roughness_and_metal_numbers() -> None:
    uv = UV[FACES]
    layers: dict[Layer, Appearance] = {
        "surface": layer(None, uv, factor=(1.0, 0.75, 0.25, 1.0)),
        "occlusion": layer(flat((0.2, 0, 0)), uv),
    }
    made = baked(SQUARE, finished(uv, layers), uv)
    assert made.surface is not None and made.occluded and made.even
    assert (made.roughness, made.metal, made.surface[16, 16, 0]) == (0.75, 0.25, 51)


def test_numbers_stay_numbers() -> None:
    uv = UV[FACES]
    layers: dict[Layer, Appearance] = {
        "normal": layer(None, uv, factor=(0.5, 0.5, 1.0, 1.0)),
        "surface": layer(None, uv, factor=(1.0, 0.25, 0.75, 1.0)),
        "occlusion": layer(None, uv),
        "glow": layer(None, uv, factor=(1.0, 0.5, 0.0, 1.0), linear=False),
    }
    made = baked(SQUARE, finished(uv, layers, light=4.0, unlit=True), uv)
    assert made.layers == () and made.unlit
    assert (made.roughness, made.metal, made.light) == (0.25, 0.75, (4.0, 2.0, 0.0))


def test_materials_that_differ_become_an_image() -> None:
    """Each face of the square has its own roughness and light."""
    uv, kinds = UV[FACES], np.array([0, 1])
    rough = [
        Material("a", None, (1.0, 1.0, 0.0, 1.0), linear=True),
        Material("b", None, (1.0, 0.2, 1.0, 1.0), linear=True),
    ]
    glow = [Material("a", None, (0.0, 0.0, 0.0, 1.0)), Material("b", None, (1.0, 0.0, 0.0, 1.0))]
    layers: dict[Layer, Appearance] = {
        "surface": Appearance(tuple(rough), kinds, np.zeros_like(uv)),
        "glow": Appearance(tuple(glow), kinds, np.zeros_like(uv)),
    }
    made = baked(SQUARE, finished(uv, layers, light=2.0), uv)
    assert made.surface is not None and made.glow is not None
    # the first triangle lies right and below in the image, the second left and above
    assert made.surface[28, 24, :3].tolist() == [255, 255, 0] and made.surface[4, 8, :3].tolist() == [255, 51, 255]
    assert made.glow[28, 24, :3].tolist() == [0, 0, 0] and made.glow[4, 8, :3].tolist() == [255, 0, 0]
    assert made.light == (2.0, 2.0, 2.0)
