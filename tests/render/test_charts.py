"""Charts: marks are where their numbers say, files are the same each time, and what cannot be drawn is refused."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError, OutputError
from meshmatch.maps.evaluate import Errors
from meshmatch.render import charts
from meshmatch.render.charts import COLORS, Bar, Chart, Line, draw_bars, draw_curves, draw_lines, draw_losses

STEPS = list(range(50, 2050, 50))


def spots(path: Path, number: int, left: float = 0.0, top: float = 0.15, right: float = 0.78) -> np.ndarray:
    """(N, 2) x to the right and y upwards of the pixels in a line's color, within these shares of the picture (where
    no legend is).
    """
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB"), int)
    wanted = [int(COLORS[number][k : k + 2], 16) for k in (1, 3, 5)]
    rows, columns = np.nonzero(np.abs(pixels - wanted).max(2) < 16)
    inside = (rows > top * len(pixels)) & (columns > left * pixels.shape[1]) & (columns < right * pixels.shape[1])
    return np.stack([columns, len(pixels) - rows], 1)[inside]


def middle(points: np.ndarray) -> np.ndarray:
    return (points.min(0) + points.max(0)) / 2


def test_values_and_places_are_where_they_should_be(tmp_path: Path) -> None:
    lines = {"two": Line((0, 2), (2, 2)), "one": Line((1.0,), (1.0,)), "zero": Line((2.0,), (0.0,))}
    draw_lines([Chart("time", lines, marks={0.0: "a", 2.0: "b"})], tmp_path / "a.png", "cm")
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


def test_a_curve_rises_where_the_errors_are(tmp_path: Path) -> None:
    errors = {"good": Errors(np.full(50, 0.01)), "bad": Errors(np.full(50, 0.05))}
    draw_curves(errors, tmp_path / "cm.png", 10.0, unit="x100")
    draw_curves(errors, tmp_path / "far.png", 20.0, unit="x100")
    at = []
    for name, number in (("cm.png", 0), ("cm.png", 1), ("far.png", 1)):
        points = spots(tmp_path / name, number, right=1.0)
        half_way = np.abs(points[:, 1] - middle(points)[1]) < 0.2 * np.ptp(points[:, 1])
        at.append(float(points[half_way, 0].mean()))
    assert (at[1] - at[0]) / (at[2] - at[0]) == pytest.approx((0.5 - 0.1) / (0.25 - 0.1), rel=0.05)
    draw_curves(errors, tmp_path / "body.png", 10.0)
    assert (tmp_path / "body.png").read_bytes() != (tmp_path / "cm.png").read_bytes()
    for curves, rest in (({}, {}), (errors, {"limit": 0}), (errors, {"unit": "inch"})):
        with pytest.raises(OptionError, match="a curve needs"):
            draw_curves(curves, tmp_path / "no.png", **rest)


def test_a_loss_that_falls_evenly_is_a_straight_line(tmp_path: Path) -> None:
    falling = [0.5 * 0.9**k for k in range(40)]
    draw_losses(tmp_path / "l.png", STEPS, {"total": falling, "flat": [0.1] * 40}, {})
    line, flat = (spots(tmp_path / "l.png", k, top=0.0) for k in (0, 1))
    slope, start = np.polyfit(line[:, 0], line[:, 1], 1)
    assert slope < -0.3
    assert np.abs(line[:, 1] - (slope * line[:, 0] + start)).max() < 6
    assert np.ptp(flat[:, 1]) <= 4 and flat[:, 1].max() < line[:, 1].min()  # terms stand below
    draw_losses(tmp_path / "v.png", STEPS, {"total": falling}, {50: 0.02, 1000: 0.02, 2000: 0.02})
    dots = spots(tmp_path / "v.png", 0, top=0.0, right=0.81)
    thick = np.flatnonzero(np.bincount(dots[:, 0]) > 8)
    assert thick.min() < 150 and thick.max() > 600 and ((thick > 350) & (thick < 500)).any()


def test_what_is_not_a_loss_is_left_out(tmp_path: Path) -> None:
    values = [0.5, float("nan"), 0.0, -1.0, float("inf"), 0.1]
    draw_losses(tmp_path / "l.png", [1, 2, 3, 4, 5, 6], {"total": values, "none": [0.0] * 6}, {})
    assert len(spots(tmp_path / "l.png", 0)) > 100
    draw_losses(tmp_path / "one.png", [7], {"total": [0.5]}, {})
    draw_losses(tmp_path / "many.png", [1, 2], {f"term {k}": [1.0, 2.0 + k] for k in range(23)}, {})
    for terms in ({}, {"total": [0.0, float("nan")]}):
        with pytest.raises(OptionError, match="no losses"):
            draw_losses(tmp_path / "none.png", [1, 2], terms, {})
    assert not (tmp_path / "none.png").exists()


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


def test_long_and_strange_names_stay_in_the_picture(tmp_path: Path) -> None:
    words = ["x" * 300, "$name$ " * 40, "漢字 \n é \x00"]
    draw_bars({words[0]: [Bar(word, 1.0, words[1], True) for word in words]}, tmp_path / "a.png", words[2])
    line = Line((1, 2), (1, 2))
    draw_lines([Chart(words[0], dict.fromkeys(words, line), marks={1: words[0]})], tmp_path / "b.png", words[1])
    for name in ("a.png", "b.png"):
        with Image.open(tmp_path / name) as image:
            pixels = np.asarray(image.convert("RGB"), int)
        assert (pixels[:, :2] > 240).all() and (pixels[:, -2:] > 240).all()


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_the_same_numbers_give_the_same_file(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    chart = Chart("steps", {"a": Line((1, 2), (1, 2), (0.1, 0.1))})
    import matplotlib

    draw_lines([chart], tmp_path / f"a{suffix}", "cm")
    monkeypatch.setitem(matplotlib.rcParams, "lines.linewidth", 9.0)  # as a user's matplotlibrc may have it
    before = dict(matplotlib.rcParams)
    draw_lines([chart], tmp_path / f"b{suffix.upper()}", "cm")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix.upper()}").read_bytes()
    assert dict(matplotlib.rcParams) == before
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix]
    assert (tmp_path / f"a{suffix}").read_bytes().startswith(start)


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


def test_a_file_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chart = Chart("steps", {"a": Line((1, 2), (1, 2))})
    with pytest.raises(OptionError, match="unsupported chart format"):
        draw_lines([chart], tmp_path / "a.jpg", "cm")
    with pytest.raises(OutputError, match="no folder"):
        draw_lines([chart], tmp_path / "no" / "a.png", "cm")
    monkeypatch.setattr(charts, "find_spec", lambda _: None)
    with pytest.raises(OptionError, match="charts need matplotlib") as told:
        draw_lines([chart], tmp_path / "a.png", "cm")
    assert told.value.hint == "pip install 'meshmatch[plots]'"
    assert not list(tmp_path.iterdir())
