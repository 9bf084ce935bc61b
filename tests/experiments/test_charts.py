"""Charts of experiments: marks are where their numbers say, and what cannot be drawn is refused."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.experiments.bench.charts import Bar, Chart, Line, draw_bars, draw_lines, draw_stack
from tests.render.spots import middle, spots


def test_values_and_places_are_where_they_should_be(tmp_path: Path) -> None:
    lines = {
        "two": Line((0, 2), (2, 2)),
        "one": Line((1.0,), (1.0,)),
        "zero": Line((2.0,), (0.0,)),
        "roof": Line((1.0,), (3.0,)),
    }
    draw_lines([Chart("time", lines)], tmp_path / "a.png", "cm")
    two, one, zero = (spots(tmp_path / "a.png", k, right=1.0) for k in range(3))
    assert middle(two)[1] - middle(one)[1] == pytest.approx(middle(one)[1] - middle(zero)[1], abs=3)
    assert middle(two)[0] == pytest.approx(middle(one)[0], abs=3)


def test_places_by_ratio_and_zero_at_the_left(tmp_path: Path) -> None:
    def share(log: bool, x: tuple[float, float, float]) -> float:
        lines = {"ends": Line((x[0], x[2]), (5, 5)), "between": Line((x[1],), (5,)), "roof": Line((x[1],), (9,))}
        draw_lines([Chart("steps", lines, (), log)], tmp_path / "b.png", "cm")
        ends, between = (spots(tmp_path / "b.png", k, right=1.0)[:, 0] for k in (0, 1))
        return float((between.mean() - ends.min()) / np.ptp(ends))

    assert share(True, (1.0, 10.0, 100.0)) == pytest.approx(0.5, abs=0.02)
    assert share(False, (1.0, 10.0, 100.0)) == pytest.approx(0.1, abs=0.02)
    assert 0.2 < share(True, (0.0, 10.0, 100.0)) < 0.5


def test_bands_are_as_high_as_their_numbers_say(tmp_path: Path) -> None:
    def height(spread: float) -> int:
        lines = {"top": Line((0.0,), (10.0,)), "line": Line((0.0, 1.0), (5.0, 5.0), (spread, spread))}
        draw_lines([Chart("x", lines)], tmp_path / "c.png", "cm")
        with Image.open(tmp_path / "c.png") as image:
            pixels = np.asarray(image.convert("RGB"), int)
        column = pixels[100:-100, int(0.7 * pixels.shape[1])]
        return int((column[:, 0] - column[:, 2] > 20).sum())  # reddish: COLORS[1], or a little of it

    assert height(4.0) == pytest.approx(2 * height(2.0), rel=0.03)


def test_a_name_has_one_color_in_all_charts(tmp_path: Path) -> None:
    first = Chart("steps", {"a": Line((1, 2), (1, 2)), "b": Line((1,), (2,))})
    second = Chart("seconds", {"b": Line((1, 2), (1, 2))})
    draw_lines([first, second], tmp_path / "d.png", "cm")
    assert len(spots(tmp_path / "d.png", 1, left=0.52, right=1.0))
    assert not len(spots(tmp_path / "d.png", 0, left=0.52, right=1.0))


def lengths(path: Path) -> np.ndarray:
    """Widths in pixels of the emphasized bars, from top to bottom."""
    found = spots(path, 0, top=0.0, right=1.0)
    rows, counts = np.unique(found[:, 1], return_counts=True)
    breaks = np.flatnonzero(np.diff(rows) > 3) + 1
    return np.array([np.median(part) for part in np.split(counts, breaks)])[::-1]


def test_bars_are_as_long_as_their_numbers(tmp_path: Path) -> None:
    bars = [Bar("a", 30.0, "30 cm", True), Bar("b", 10.0, "10 cm, 2 failed", True), Bar("c", 5.0, mark=4.0)]
    draw_bars({"first: 3 of 5 pairs": bars, "none": []}, tmp_path / "a.png", "error, cm")
    long, short = lengths(tmp_path / "a.png")
    assert long == pytest.approx(3 * short, rel=0.03)
    draw_bars({"first": bars, "second": bars}, tmp_path / "b.png", "error, cm")
    assert len(lengths(tmp_path / "b.png")) == 4


def test_a_bar_beyond_the_axis_is_broken_off(tmp_path: Path) -> None:
    bars = [Bar("a", 400.0, "x", True), Bar("b", 20.0, "x", True)]
    draw_bars({"one": bars}, tmp_path / "a.png", "cm", limit=20.0)
    broken, whole = lengths(tmp_path / "a.png")
    assert 0.9 * whole < broken < whole
    with pytest.raises(OptionError, match="axis"):
        draw_bars({"one": bars}, tmp_path / "c.png", "cm", limit=0.0)


def test_a_stack_has_its_parts_end_to_end(tmp_path: Path) -> None:
    draw_stack({"import": 0.5, "load": 0.25, "nothing": 0.0}, tmp_path / "a.png", "seconds", ".2f")
    pixels = np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int)
    blue, orange = (np.abs(pixels - color).sum(2) < 6 for color in ((0, 114, 178), (213, 94, 0)))
    bar = int(blue.sum(1).argmax())  # the row of pixels with most of the first color
    assert np.flatnonzero(blue[bar]).max() < np.flatnonzero(orange[bar]).min()
    assert blue[bar].sum() == pytest.approx(2 * orange[bar].sum(), rel=0.05)
    for wrong in ({}, {"a": -1.0}, {"a": float("nan")}, {"a": 0.0}):
        with pytest.raises(OptionError, match="stacked"):
            draw_stack(wrong, tmp_path / "b.png", "seconds")


def test_long_and_strange_names_stay_in_the_picture(tmp_path: Path) -> None:
    words = ["x" * 300, "$name$ " * 40, "漢字 \n é \x00"]
    draw_bars({words[0]: [Bar(word, 1.0, words[1], True) for word in words]}, tmp_path / "a.png", words[2])
    line = Line((1, 2), (1, 2))
    draw_lines([Chart(words[0], dict.fromkeys(words, line))], tmp_path / "b.png", words[1])
    for name in ("a.png", "b.png"):
        with Image.open(tmp_path / name) as image:
            pixels = np.asarray(image.convert("RGB"), int)
        assert (pixels[:, :2] > 240).all() and (pixels[:, -2:] > 240).all()


@pytest.mark.parametrize(
    "lines",
    [
        {},
        {"a": Line((), ())},
        {"a": Line((1,), (1, 2))},
        {"a": Line((1,), (1,), (1, 2))},
        {"a": Line((1,), (float("nan"),))},
        {"a": Line((1,), (-1,))},
        {str(k): Line((1,), (1,)) for k in range(8)},
    ],
)
def test_lines_that_cannot_be_drawn(lines: dict[str, Line], tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        draw_lines([Chart("steps", lines)], tmp_path / "a.png", "cm")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "groups",
    [
        {},
        {"a": []},
        {"a": [Bar("a", -1.0)]},
        {"a": [Bar("a", float("nan"))]},
        {"a": [Bar("a", 1.0, mark=float("inf"))]},
    ],
)
def test_bars_that_cannot_be_drawn(groups: dict[str, list[Bar]], tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        draw_bars(groups, tmp_path / "a.png", "cm")
    assert not list(tmp_path.iterdir())
