"""Images in smaller sizes, and looking colors up in them."""

import numpy as np
import pytest

from meshmatch.shapes.appearance import Material, Wrap
from meshmatch.shapes.colors import BYTE_TO_LINEAR, to_linear, to_srgb
from meshmatch.transfer.texels import Pyramid, fill, wrap_index
from tests.shapes.painted import quarters


def look(pyramid: Pyramid, u: float, v: float, footprint: float = 0.0) -> list[float]:
    """Color and alpha in 0..1 at one place, as a screen shows it."""
    one = [np.array([x], np.float32) for x in (u, v, footprint)]
    found = pyramid.sample(*one)[:, 0].astype(float)
    return [*to_srgb(found[:3]).tolist(), float(found[3])]


def means(pixels: np.ndarray) -> list[np.ndarray]:
    """The mip levels that a viewer makes of a square image, as light: means of fours."""
    light = to_linear(pixels[..., :3] / 255.0)
    levels = [light]
    while len(light) > 1:
        light = (light[0::2, 0::2] + light[1::2, 0::2] + light[0::2, 1::2] + light[1::2, 1::2]) / 4
        levels.append(light)
    return levels


# Filling


def test_an_unknown_texel_takes_the_mean_of_its_three_neighbours_as_light() -> None:
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[0, 0, 0], pixels[0, 1, 0], pixels[1, 0, 0] = 255, 0, 255
    pixels[1, 1] = (1, 2, 3, 4)
    fill(pixels, np.array([[255, 255], [255, 0]], np.uint8))
    want = round(255 * float(to_srgb(2 / 3)))
    assert pixels[1, 1].tolist() == [want, 0, 0, 255]
    assert pixels[0].tolist() == [[255, 0, 0, 255], [0, 0, 0, 255]]  # what is known stays


@pytest.mark.parametrize("shape", [(8, 8), (7, 5), (1, 9), (1, 1)])
def test_one_color_stays_one_color(shape: tuple[int, int]) -> None:
    pixels = np.zeros((*shape, 4), np.uint8)
    weight = (np.random.default_rng(0).random(shape) < 0.3).astype(np.float32)
    weight[0, 0] = 1
    pixels[weight > 0] = (200, 100, 50, 255)
    levels = fill(pixels, weight)
    assert levels[0] is pixels
    assert levels[-1].shape == (1, 1, 4)
    for level in levels:
        assert (level == (200, 100, 50, 255)).all()


def test_nothing_known_leaves_everything() -> None:
    pixels = np.full((4, 4, 4), 9, np.uint8)
    fill(pixels, np.zeros((4, 4), np.uint8))
    assert (pixels == 9).all()


def test_no_mip_level_of_a_filled_image_shows_the_background() -> None:
    """Known texels are bright, the background is black: every texel of every level must stay bright."""
    rng = np.random.default_rng(3)
    pixels = np.zeros((64, 64, 4), np.uint8)
    known = np.zeros((64, 64), bool)
    for x, y in rng.integers(0, 56, (6, 2)):
        known[y : y + 7, x : x + 5] = True
    pixels[known] = np.concatenate([rng.integers(180, 256, (known.sum(), 3)), np.full((known.sum(), 1), 255)], 1)
    darkest = [level.min() for level in means(pixels)[:4]]
    assert max(darkest) < 0.1  # that is: unfilled it would show
    fill(pixels, 255 * known.astype(np.uint8))
    assert min(level.min() for level in means(pixels)) >= to_linear(178 / 255)


# Looking up


def test_texel_centres_give_their_texels() -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (5, 7, 4), dtype=np.uint8)
    image[..., 3] = 255
    pyramid = Pyramid(Material(image=image))
    for y in range(5):
        for x in range(7):
            found = look(pyramid, (x + 0.5) / 7, (y + 0.5) / 5)
            np.testing.assert_allclose(found, image[y, x] / 255, atol=1e-4)


def test_halfway_between_two_texels_is_half_the_light_of_both() -> None:
    image = np.array([[[255, 0, 0, 255], [0, 0, 255, 255]]], np.uint8)
    pyramid = Pyramid(Material(image=image, wrap=("clamp", "clamp")))
    half = float(to_srgb(0.5))
    np.testing.assert_allclose(look(pyramid, 0.5, 0.5), [half, 0, half, 1], atol=1e-4)
    np.testing.assert_allclose(look(pyramid, 0.0, 0.1), [1, 0, 0, 1], atol=1e-4)


@pytest.mark.parametrize(
    ("wrap", "u", "want"),
    [
        ("repeat", 1.25, "left"), ("repeat", -0.25, "right"), ("repeat", 0.0, "both"),
        ("clamp", 1.25, "right"), ("clamp", -3.0, "left"), ("clamp", 0.0, "left"),
        ("mirror", 1.25, "right"), ("mirror", -0.25, "left"), ("mirror", 1.75, "left"), ("mirror", 0.0, "left"),
    ],
)  # fmt: skip
def test_what_lies_outside_an_image(wrap: Wrap, u: float, want: str) -> None:
    image = np.array([[[255, 0, 0, 255], [0, 0, 255, 255]]], np.uint8)  # red on the left, blue on the right
    half = float(to_srgb(0.5))
    colors = {"left": [1, 0, 0, 1], "right": [0, 0, 1, 1], "both": [half, 0, half, 1]}
    across = Pyramid(Material(image=image, wrap=(wrap, "clamp")))
    np.testing.assert_allclose(look(across, u, 0.3), colors[want], atol=1e-4)
    down = Pyramid(Material(image=image.swapaxes(0, 1), wrap=("clamp", wrap)))
    np.testing.assert_allclose(look(down, 0.3, u), colors[want], atol=1e-4)


def test_wrapping_against_the_slow_way() -> None:
    index = np.arange(-20, 21)
    for size in (1, 3, 4):
        row = list(range(size))
        there_and_back = row + row[::-1]
        np.testing.assert_array_equal(wrap_index(index, size, "repeat"), [row[i % size] for i in index])
        np.testing.assert_array_equal(
            wrap_index(index, size, "mirror"), [there_and_back[i % (2 * size)] for i in index]
        )
        np.testing.assert_array_equal(wrap_index(index, size, "clamp"), [row[min(max(i, 0), size - 1)] for i in index])


def test_a_wide_step_sees_the_mean() -> None:
    image = np.zeros((4, 4, 4), np.uint8)
    image[..., 3] = 255
    image[::2, :, :3] = 255  # stripes
    pyramid = Pyramid(Material(image=image))
    half = float(to_srgb(0.5))
    for footprint in (2.0, 3.0, 4.0, 1000.0):
        np.testing.assert_allclose(look(pyramid, 0.3, 0.1, footprint), [half, half, half, 1], atol=3e-3)
    # between two levels: half of the logarithm is half of the way; at a center of the largest level
    want = float(to_srgb(0.5 * 1.0 + 0.5 * float(BYTE_TO_LINEAR[188])))
    assert look(pyramid, 0.125, 0.125, 2**0.5)[0] == pytest.approx(want, abs=5e-3)


def test_squares_where_a_file_wants_squares() -> None:
    sharp = Pyramid(Material(image=quarters(2), nearest=True))
    np.testing.assert_allclose(look(sharp, 0.49, 0.49), [1, 0, 0, 1], atol=1e-4)
    np.testing.assert_allclose(look(sharp, 0.51, 0.49), [0, 1, 0, 1], atol=1e-4)


def test_alpha_counts_unless_the_material_is_opaque() -> None:
    image = np.array([[[255, 0, 0, 0], [0, 0, 255, 128]]], np.uint8)
    assert look(Pyramid(Material(image=image)), 0.25, 0.5) == pytest.approx([1, 0, 0, 1], abs=1e-4)
    seen = Pyramid(Material(image=image, alpha="blend"))
    assert look(seen, 0.75, 0.5)[3] == pytest.approx(128 / 255)
    # nobody sees the red: it must not color its surroundings
    np.testing.assert_allclose(look(seen, 0.25, 0.5), [0, 0, 1, 0], atol=1e-4)
    assert look(seen, 0.5, 0.5, 8.0)[3] == pytest.approx(64 / 255, abs=3e-3)


def test_texels_off_the_surface_do_not_count() -> None:
    image = np.zeros((4, 4, 4), np.uint8)
    image[:2, :2] = (200, 150, 100, 255)
    known = image[..., 3] > 0
    pyramid = Pyramid(Material(image=image), known)
    for footprint in (0.0, 2.0, 16.0):
        np.testing.assert_allclose(look(pyramid, 0.5, 0.5, footprint)[:3], np.array([200, 150, 100]) / 255, atol=1e-4)
