"""Charts of experiments: marks are where their numbers say, and what cannot be drawn is refused."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.experiments.bench.charts import Chart, Line, draw_lines
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
