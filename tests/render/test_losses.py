"""Losses over the steps, as a picture."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError, OutputError
from meshmatch.render.losses import draw_losses, log_ticks
from meshmatch.render.scales import label_colors

STEPS = list(range(50, 2050, 50))


def inked(path: Path, number: int) -> np.ndarray:
    """Pixels (row, column) in the colour of a line, left of the legend."""
    with Image.open(path) as image:
        pixels = np.asarray(image, dtype=int)[:, :780]
    color = np.round(215 * label_colors([number])[0])
    return np.argwhere(np.abs(pixels - color).max(axis=2) <= 12)


def test_a_loss_that_falls_evenly_is_a_straight_line(tmp_path: Path) -> None:
    falling = [0.5 * 0.9**k for k in range(40)]
    draw_losses(tmp_path / "l.png", STEPS, {"total": falling, "flat": [0.1] * 40}, {})
    line, flat = inked(tmp_path / "l.png", 0), inked(tmp_path / "l.png", 1)
    slope, start = np.polyfit(line[:, 1], line[:, 0], 1)
    assert slope > 0.3
    assert np.abs(line[:, 0] - (slope * line[:, 1] + start)).max() < 4
    assert np.ptp(flat[:, 0]) <= 4


def test_validation_is_dots_at_its_steps(tmp_path: Path) -> None:
    draw_losses(tmp_path / "l.png", STEPS, {"total": [0.1] * 40}, {50: 0.02, 1000: 0.02, 2000: 0.02})
    dots = inked(tmp_path / "l.png", 1)
    thick = [column for column in range(95, 780) if (dots[:, 1] == column).sum() > 6]
    assert any(abs(column - (90 + 880 * 950 / 1950)) < 6 for column in thick)


def test_what_is_no_loss_is_left_out(tmp_path: Path) -> None:
    values = [0.5, float("nan"), 0.0, -1.0, float("inf"), 0.1]
    draw_losses(tmp_path / "l.png", [1, 2, 3, 4, 5, 6], {"total": values, "none": [0.0] * 6}, {})
    assert len(inked(tmp_path / "l.png", 0)) > 100
    draw_losses(tmp_path / "one.png", [7], {"total": [0.5]}, {})
    for terms in ({}, {"total": [0.0, float("nan")]}):
        with pytest.raises(OptionError, match="no losses"):
            draw_losses(tmp_path / "none.png", [1, 2], terms, {})
    with pytest.raises(OptionError, match="PNG"):
        draw_losses(tmp_path / "l.jpg", [1], {"total": [1.0]}, {})
    with pytest.raises(OutputError, match="no folder"):
        draw_losses(tmp_path / "no" / "l.png", [1], {"total": [1.0]}, {})
    assert {path.name for path in tmp_path.iterdir()} == {"l.png", "one.png"}


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (-2.1, -0.9, [0.01, 0.02, 0.05, 0.1]),
        (0.0, 0.75, [1, 2, 5]),
        (-3.0, 3.0, [1e-3, 1e-2, 1e-1, 1, 10, 100, 1000]),
        (0.81, 0.84, [6.7]),
    ],
)
def test_ticks_of_a_logarithmic_axis(low: float, high: float, ticks: list[float]) -> None:
    assert log_ticks(low, high) == pytest.approx(ticks)
    assert len(log_ticks(-150, 150)) <= 12
