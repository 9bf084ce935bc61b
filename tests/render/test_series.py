"""Diagrams: points where their numbers say, error bars as long as they are."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.render.series import Panel, Series, draw_series

BLUE, ORANGE = (0, 114, 178), (213, 94, 0)


def spots(path: Path, color: tuple[int, int, int], top: int = 70) -> np.ndarray:
    """(N, 2) row and column of the pixels of a colour below the legend."""
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"), int)
    rows, columns = np.nonzero(np.abs(pixels - color).max(2) < 25)
    return np.stack([rows, columns], 1)[rows >= top]


def test_twice_the_value_is_twice_as_high(tmp_path: Path) -> None:
    one = {"a": Series((1.0,), (5.0,)), "b": Series((1.0,), (10.0,))}
    draw_series([Panel("steps", one, (1.0,))], tmp_path / "a.png", "cm")
    low, high = (spots(tmp_path / "a.png", color)[:, 0].mean() for color in (BLUE, ORANGE))
    bottom = 460 - 62
    assert bottom - high == pytest.approx(2 * (bottom - low), rel=0.02)


def test_places_by_ratio_and_zero_at_the_left(tmp_path: Path) -> None:
    def share(by_ratio: bool, x: tuple[float, ...]) -> float:
        path = tmp_path / "b.png"
        lines = {"a": Series((x[0], x[2]), (5.0, 5.0)), "b": Series((x[1],), (9.0,))}
        draw_series([Panel("steps", lines, (), by_ratio)], path, "cm")
        ends, middle = spots(path, BLUE)[:, 1], spots(path, ORANGE)[:, 1]
        return float((middle.mean() - ends.min()) / (ends.max() - ends.min()))

    assert share(True, (1.0, 10.0, 100.0)) == pytest.approx(0.5, abs=0.02)
    assert share(False, (1.0, 10.0, 100.0)) == pytest.approx(0.095, abs=0.02)
    assert share(True, (0.0, 10.0, 10.0)) > 0.9


def test_bars_are_as_long_as_their_numbers_say(tmp_path: Path) -> None:
    tall = {"a": Series((1.0,), (5.0,), (3.0,)), "b": Series((2.0,), (5.0,), (1.5,))}
    draw_series([Panel("steps", tall)], tmp_path / "c.png", "cm")
    long, short = (np.ptp(spots(tmp_path / "c.png", color)[:, 0]) for color in (BLUE, ORANGE))
    assert long == pytest.approx(2 * short, rel=0.05)


def test_a_name_has_one_colour_in_all_panels(tmp_path: Path) -> None:
    first = Panel("steps", {"a": Series((1.0, 2.0), (1.0, 2.0)), "b": Series((1.0,), (2.0,))})
    second = Panel("seconds", {"b": Series((1.0, 2.0), (1.0, 2.0))})
    draw_series([first, second], tmp_path / "d.png", "cm")
    assert (spots(tmp_path / "d.png", ORANGE)[:, 1] > 520).any()
    assert not (spots(tmp_path / "d.png", BLUE)[:, 1] > 520).any()


@pytest.mark.parametrize(
    ("lines", "name"),
    [
        ({}, "a.png"),
        ({"a": Series((), ())}, "a.png"),
        ({"a": Series((1.0,), (1.0, 2.0))}, "a.png"),
        ({"a": Series((1.0,), (1.0,), (1.0, 2.0))}, "a.png"),
        ({"a": Series((1.0,), (float("nan"),))}, "a.png"),
        ({"a": Series((1.0,), (-1.0,))}, "a.png"),
        ({"a": Series((1.0,), (1.0,))}, "a.jpg"),
        ({str(k): Series((1.0,), (1.0,)) for k in range(5)}, "a.png"),
    ],
)
def test_what_cannot_be_drawn(lines: dict[str, Series], name: str, tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        draw_series([Panel("steps", lines)], tmp_path / name, "cm")
    assert not list(tmp_path.iterdir())
