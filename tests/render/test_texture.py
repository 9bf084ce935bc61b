"""Textures on triangles."""

import numpy as np
import pytest

from meshmatch.render.raster import Viewport, draw
from meshmatch.render.scene import Scene
from meshmatch.render.surface import TexturePaint, mesh_surface
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.colors import to_linear
from meshmatch.shapes.shape import Shape
from tests.shapes.painted import CORNERS, FACES, UV, quarters

SQUARE = Shape(CORNERS, FACES, "square")
PLACES = np.array([[0.25, 0.75], [0.75, 0.75], [0.25, 0.25], [0.75, 0.25]])  # x, y of the quarters
WHICH = np.array([1, 1, 1, 0])
QUARTERS = to_linear(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]]))


def weights_at(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Face and weights of places (N, 2) on the square."""
    face = (places[:, 1] > places[:, 0]).astype(int)
    corners = np.concatenate([CORNERS[FACES[face], :2].swapaxes(1, 2), np.ones((len(face), 1, 3))], axis=1)
    return face, np.linalg.solve(corners, np.column_stack([places, np.ones(len(face))])[..., None])[..., 0]


def look(*materials: Material, which: tuple[int, int] = (0, 0), colors: np.ndarray | None = None) -> Appearance:
    return Appearance(materials, np.array(which), UV[FACES], colors)


def paint(appearance: Appearance, footprint: float = 0.01, places: np.ndarray = PLACES) -> np.ndarray:
    face, weights = weights_at(places)
    return np.asarray(TexturePaint(appearance, SQUARE, 1.0)(face, weights, footprint))


def test_each_quarter_of_the_image_lies_where_it_should() -> None:
    found = paint(look(Material(image=quarters(64))))
    assert found[:, :3] == pytest.approx(QUARTERS, abs=1e-6)
    assert (found[:, 3] == 1).all()


def test_a_wide_footprint_takes_the_mean_in_light() -> None:
    found = paint(look(Material(image=quarters(64))), footprint=4.0)
    assert found[:, :3] == pytest.approx(np.tile(QUARTERS.mean(axis=0), (4, 1)), abs=0.02)


def test_factor_and_vertex_colors_multiply() -> None:
    colors = np.tile([0.5, 1.0, 1.0, 1.0], (4, 1))
    found = paint(look(Material(image=quarters(64), factor=(0.5, 0.25, 1.0, 1.0)), colors=colors))
    assert found[:, :3] == pytest.approx(QUARTERS * [0.25, 0.25, 1.0], abs=1e-6)
    plain = paint(look(Material(factor=(0.1, 0.2, 0.3, 1.0)), Material(factor=(1.0, 0, 0, 1)), which=(0, 1)))
    face, _ = weights_at(PLACES)
    wanted = np.array([[0.1, 0.2, 0.3], [1.0, 0, 0]])[face]
    assert plain[:, :3] == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize(
    ("alpha", "factor", "wanted"),
    [
        ("opaque", 0.0, [1, 1]),
        ("mask", 1.0, [1, 0]),
        ("mask", 0.7, [0, 0]),
        ("blend", 1.0, [1, 0]),
        ("blend", 0.3, [1, 0]),  # glass, not a hole
        ("blend", 0.01, [0, 0]),
    ],
)
def test_alpha_means_what_the_material_says(alpha: str, factor: float, wanted: list[int]) -> None:
    image = quarters(64)
    image[:, :32, 3], image[:, 32:, 3] = 153, 51
    material = Material(image=image, factor=(1.0, 1.0, 1.0, factor), alpha=alpha, cutoff=0.5)  # type: ignore[arg-type]
    assert paint(look(material))[:2, 3].tolist() == wanted
    faint = np.tile([1.0, 1.0, 1.0, factor], (4, 1))
    material = Material(image=image, alpha=alpha, cutoff=0.5)  # type: ignore[arg-type]
    assert paint(look(material, colors=faint))[:2, 3].tolist() == wanted


def test_the_middle_of_a_border_is_blended_by_many_rays() -> None:
    """A border of the image that runs along a slope through the pixels has no steps."""
    v, u = np.mgrid[0:512, 0:512] / 512
    image = np.zeros((512, 512, 4), np.uint8)
    image[...] = np.where((v + 0.1 * u < 0.5)[..., None], [255, 255, 255, 255], [0, 0, 0, 255])
    appearance = look(Material(image=image))
    surface = mesh_surface(CORNERS, FACES, TexturePaint(appearance, SQUARE, 1.0))
    light = draw(Scene([surface]), Viewport(40, 40, 0.0, 1.0, 0.025)).light[..., 0]
    share = (light - light.min()) / (light.max() - light.min())
    height = share.sum(axis=0)[2:38]
    assert height == pytest.approx(np.linspace(height[0], height[-1], 36), abs=0.25)
