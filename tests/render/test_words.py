"""Names and legends: what is written, and where."""

import numpy as np
import pytest
from PIL import Image

from meshmatch.render import scales as module
from meshmatch.render.picture import HEIGHT, lay_out
from meshmatch.render.scales import (
    Scale,
    Swatches,
    draw_legend,
    draw_text,
    fit_text,
    legend_height,
    readable,
    text_width,
)
from meshmatch.shapes.colors import label_colors

INK = (10, 20, 30)


@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("plain words 1.5", "plain words 1.5"),
        ("two\nlines\t", "two lines"),
        ("Körper", "Korper"),
        ("Größe, Łódź, Æsop", "Grosse, Lodz, AEsop"),
        ("e\u0301tude", "etude"),
        ("m²", "m2"),
        ("心臓", "??"),
        ("a\u200b\x07b", "a??b"),
        ("", ""),
    ],
)
def test_only_letters_that_the_font_has_are_written(given: str, shown: str) -> None:
    assert readable(given) == shown


def test_long_words_become_small_and_then_short() -> None:
    text, size = fit_text("a name", 20, 1000)
    assert (text, size) == ("a name", 20)
    text, size = fit_text("a name", 20, text_width("a name", 20) * 0.8)
    assert text == "a name"
    assert 9 < size < 20
    text, size = fit_text("beginning and some middle and the end" * 3, 20, 100)
    assert size <= 9
    assert text_width(text, size) <= 100
    assert text.startswith("beg")
    assert text.endswith("end")
    assert "…" in text
    assert text_width(*fit_text("w" * 10_000, 20, 100)) <= 100


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_letters_have_their_ink(mode: str) -> None:
    image = Image.new(mode, (60, 30), (255, 255, 255) if mode == "RGB" else (0, 0, 0, 0))
    draw_text(image, (30, 15), "HHH", 20, INK)
    pixels = np.asarray(image)
    solid = (pixels[..., :3] == INK).all(axis=2)
    assert solid.sum() > 30
    if mode == "RGBA":
        assert (pixels[solid][:, 3] > 0).all()
        assert (pixels[solid][:, 3] == 255).any()


def bar(scale: Scale, size: tuple[int, int] = (400, 100)) -> tuple[np.ndarray, list[tuple[str, float]]]:
    """The pixels of a legend, and its words with their x."""
    image = Image.new("RGB", size, "white")
    written: list[tuple[str, float]] = []
    real = module.draw_text
    try:
        module.draw_text = lambda image, place, text, *rest: written.append((text, place[0]))  # type: ignore[assignment]
        draw_legend(image, scale, 0, 16, INK)
    finally:
        module.draw_text = real
    return np.asarray(image), written


def test_a_bar_has_the_colors_of_its_numbers_above_them() -> None:
    scale = Scale(0, 5, "error (cm)")
    pixels, written = bar(scale)
    assert written[0] == ("error (cm)", 200)
    assert [text for text, _ in written[1:]] == ["0", "1", "2", "3", "4", "5"]
    places = np.array([x for _, x in written[1:]])
    assert np.diff(places) == pytest.approx(np.diff(places)[0])
    row = next(r for r in range(100) if np.ptp(pixels[r, 120:280], axis=1).max() > 100) + 5
    for value, x in zip((1, 2, 3, 4), places[1:5], strict=True):
        assert pixels[row, round(x)] / 255 == pytest.approx(scale.colors([value])[0], abs=0.02)
    colored = np.flatnonzero((pixels[row] < 250).any(axis=1))
    assert colored[0] == pytest.approx(places[0], abs=4)
    assert colored[-1] == pytest.approx(places[-1], abs=4)


def test_numbers_without_room_are_left_out() -> None:
    _, wide = bar(Scale(0, 123456), (400, 80))
    _, narrow = bar(Scale(0, 123456), (90, 80))
    assert len(narrow) < len(wide)
    assert narrow[0][0] == "0"


def test_what_has_no_value_is_in_the_legend() -> None:
    _, written = bar(Scale(0, 1, unknown=True), (600, 80))
    assert written[-1][0] == "no value"
    _, written = bar(Scale(0, 1), (600, 80))
    assert "no value" not in [text for text, _ in written]


def test_swatches_wrap_and_stay_inside() -> None:
    names = tuple(f"part number {k}" for k in range(9))
    colors = tuple(tuple(color) for color in label_colors(np.arange(9)).tolist())
    swatches = Swatches(names, colors, "parts")  # type: ignore[arg-type]
    height = legend_height(swatches, 300, 14)
    image = Image.new("RGB", (300, height), "white")
    draw_legend(image, swatches, 0, 14, INK)
    pixels = np.asarray(image).astype(int)
    for color in colors:
        same = np.abs(pixels - np.round(255 * np.array(color))).max(axis=2) <= 1
        assert same.sum() > 80
    inked = np.argwhere((pixels < 250).any(axis=2))
    assert inked[:, 1].min() >= 5
    assert inked[:, 1].max() < 295
    assert inked[:, 0].max() < height - 2
    assert legend_height(swatches, 900, 14) < height


def test_figures_stand_on_one_line_inside_the_margins() -> None:
    boxes = [np.array([[-0.3, -0.02], [0.2, 1.0]]), np.array([[-0.5, 0.0], [0.5, 0.7]])]
    for size in ((640, 400), (400, 640), (3000, 300), None):
        page = lay_out(boxes, True, Scale(0, 1, "x"), size)
        window = page.viewport
        if size is not None:
            assert (window.width, window.height) == size
        for box, foot in zip(boxes, page.feet, strict=True):
            left, right = ((foot + box[:, 0]) - window.left) / window.pixel
            bottom, top = (window.top - box[:, 1]) / window.pixel
            assert 0.02 * min(window.width, window.height) < left < right < window.width
            assert 0 < top < bottom < page.names[0, 1] < page.legend < window.height
        middles = (page.feet + [box[:, 0].mean() for box in boxes] - window.left) / window.pixel
        assert page.names[:, 0] == pytest.approx(middles)
        gaps = page.feet[1] + boxes[1][0, 0] - page.feet[0] - boxes[0][1, 0]
        assert gaps > 0.1
        assert (page.names[:, 1] == page.names[0, 1]).all()
        ends = page.names[:, :1] + 0.5 * page.room[:, None] * [-1, 1]
        assert ends[0, 0] > 0 and ends[0, 1] < ends[1, 0] and ends[1, 1] < window.width


def test_without_a_size_the_picture_takes_the_room_that_the_shapes_need() -> None:
    boxes = [[np.array([[-width / 2, 0.0], [width / 2, 1.0]])] for width in (0.1, 1.5, 9.0)]
    narrow, wide, very_wide = (lay_out(each, False, None, None).viewport for each in boxes)
    assert narrow.height == wide.height == HEIGHT > 1.4 * narrow.width
    assert wide.width == pytest.approx((1.5 * 0.91 + 0.09) * HEIGHT, abs=3)
    assert very_wide.width == 2000 and very_wide.height < 0.5 * HEIGHT


def test_a_larger_picture_is_the_same_picture() -> None:
    boxes = [np.array([[-0.3, 0.0], [0.2, 1.0]])]
    small, large = (lay_out(boxes, True, None, size) for size in ((300, 400), (1200, 1600)))
    assert small.viewport.pixel == pytest.approx(4 * large.viewport.pixel, rel=0.02)
    assert small.font_size == pytest.approx(large.font_size / 4, rel=0.02)
