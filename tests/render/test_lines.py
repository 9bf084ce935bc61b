"""A plot of lines: what is drawn where, and what cannot be drawn."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.render.lines import COLORS, _round_up, draw_lines


def rows_of(path: Path, color: str) -> tuple[np.ndarray, np.ndarray]:
    """Where a picture has very nearly a colour: rows and columns right of the axis and below the legend."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    wanted = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)])
    rows, columns = np.nonzero(np.abs(pixels - wanted).sum(axis=2) < 12)
    return rows[rows > 40], columns[rows > 40]


def test_lines_are_where_their_values_are(tmp_path: Path) -> None:
    path = tmp_path / "plot.png"
    draw_lines(path, [0, 1, 2], {"up": [0, 1, 2], "flat": [1, 1, 1]}, "time", {0.0: "a", 2.0: "b", 5.0: "c"})
    rows, columns = rows_of(path, COLORS[0])
    assert np.corrcoef(rows, columns)[0, 1] < -0.99  # rows count downwards
    flat, across = rows_of(path, COLORS[1])
    assert np.ptp(flat) < 12
    assert np.ptp(across) > 700
    assert abs(flat.mean() - (rows.min() + rows.max()) / 2) < 6  # 1 is half way to 2


def test_axes_end_at_round_numbers() -> None:
    ends = [_round_up(value) for value in (0.0332, 0.01, 1.01, 9.0, 0.0, 1e-9)]
    assert ends == pytest.approx([0.04, 0.01, 1.5, 10.0, 1e-6, 1e-6])


@pytest.mark.parametrize(
    ("name", "times", "lines"),
    [
        ("a.jpg", [0, 1], {"a": [0, 1]}),
        ("a.png", [0], {"a": [0]}),
        ("a.png", [0, 1], {}),
        ("a.png", [0, 1], {str(k): [0, 1] for k in range(5)}),
    ],
)
def test_what_is_no_plot(
    tmp_path: Path, name: str, times: list[float], lines: dict[str, list[float]]
) -> None:
    with pytest.raises(OptionError):
        draw_lines(tmp_path / name, times, lines, "time")
    assert list(tmp_path.iterdir()) == []
