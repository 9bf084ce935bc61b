"""Bars: as long as their numbers say, all of them in the picture."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.render.bars import Bar, draw_bars

STRONG = (0, 114, 178)


def read(path: Path) -> np.ndarray:
    """(H, W, 3) integers."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"), int)


def strong_pixels(path: Path) -> np.ndarray:
    """(H,) how many pixels of each row have the strong colour."""
    return (np.abs(read(path) - STRONG).max(2) < 12).sum(1)


def test_bars_are_as_long_as_their_numbers(tmp_path: Path) -> None:
    bars = [Bar("a", 30.0, "30 cm", True), Bar("b", 10.0, "10 cm, 2 failed", True), Bar("c", 5.0, mark=4.0)]
    draw_bars({"first: 3 of 5 pairs": bars, "none": []}, tmp_path / "a.png", "error, cm")
    rows = strong_pixels(tmp_path / "a.png")
    lengths = sorted(set(rows[rows > 20].tolist()))
    assert max(lengths) == pytest.approx(3 * min(lengths), rel=0.03)
    one = len(read(tmp_path / "a.png"))
    draw_bars({"first": bars, "second": bars}, tmp_path / "b.png", "error, cm")
    assert len(read(tmp_path / "b.png")) > one + 3 * 20


def test_a_bar_beyond_the_axis_is_broken_off(tmp_path: Path) -> None:
    long, short = Bar("a", 400.0, "400", True), Bar("b", 20.0, "20", True)
    draw_bars({"one": [long, short]}, tmp_path / "a.png", "cm", limit=20.0)
    draw_bars({"one": [Bar("a", 20.0, "400", True), short]}, tmp_path / "b.png", "cm", limit=20.0)
    broken, whole = (strong_pixels(tmp_path / name) for name in ("a.png", "b.png"))
    changed = broken != whole
    assert changed.sum() > 10 and (broken[changed] < whole[changed]).all()
    assert whole.max() - 40 < broken[changed].max()
    with pytest.raises(OptionError, match="axis"):
        draw_bars({"one": [long]}, tmp_path / "c.png", "cm", limit=0.0)


def test_long_names_stay_in_the_picture(tmp_path: Path) -> None:
    draw_bars({"x" * 300: [Bar("name " * 40, 0.0, "words " * 40, True)]}, tmp_path / "a.png", "é ü")
    pixels = read(tmp_path / "a.png")
    assert (pixels[:, :3] > 240).all() and (pixels[:, -3:] > 240).all()


@pytest.mark.parametrize(
    ("groups", "name"),
    [
        ({}, "a.png"),
        ({"a": []}, "a.png"),
        ({"a": [Bar("a", -1.0)]}, "a.png"),
        ({"a": [Bar("a", float("nan"))]}, "a.png"),
        ({"a": [Bar("a", 1.0, mark=float("inf"))]}, "a.png"),
        ({"a": [Bar("a", 1.0)]}, "a.jpg"),
    ],
)
def test_what_cannot_be_drawn_is_told(tmp_path: Path, groups, name: str) -> None:
    with pytest.raises(OptionError):
        draw_bars(groups, tmp_path / name, "cm")
    assert not list(tmp_path.iterdir())
