"""Charts: marks are where their numbers say, files are the same each time, and what cannot be drawn is refused."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError, OutputError
from meshmatch.maps.evaluate import X100, Errors
from meshmatch.render import charts
from meshmatch.render.charts import (
    Dots,
    draw_curves,
    draw_dots,
    draw_histogram,
    draw_lines,
    draw_losses,
    draw_panels,
    draw_scree,
)
from tests.render.spots import middle, spots

STEPS = list(range(50, 2050, 50))
LINE = {"a": ((1, 2), (1, 2))}


def test_values_and_places_are_where_they_should_be(tmp_path: Path) -> None:
    lines = {"two": ((0, 2), (2, 2)), "one": ((1.0,), (1.0,)), "zero": ((2.0,), (0.0,))}
    draw_lines(lines, tmp_path / "a.png", "time", "cm", {0.0: "a", 2.0: "b"})
    two, one, zero = (spots(tmp_path / "a.png", k, right=1.0) for k in range(3))
    assert middle(two)[1] - middle(one)[1] == pytest.approx(middle(one)[1] - middle(zero)[1], abs=3)
    assert middle(two)[0] == pytest.approx(middle(one)[0], abs=3)


def test_long_and_strange_names_stay_in_the_picture(tmp_path: Path) -> None:
    words = ["x" * 300, "$name$ " * 40, "漢字 \n é \x00"]
    draw_lines(dict.fromkeys(words, LINE["a"]), tmp_path / "a.png", words[0], words[1], {1: words[0]})
    with Image.open(tmp_path / "a.png") as image:
        pixels = np.asarray(image.convert("RGB"), int)
    assert (pixels[:, :2] > 240).all() and (pixels[:, -2:] > 240).all()


def test_letters_of_other_languages_are_kept(tmp_path: Path) -> None:
    charts = []
    for number, label in enumerate(("Größe, размер", "Gro\u0308ße, размер", "Grosse, ??????")):
        draw_lines(LINE, tmp_path / f"{number}.svg", label, "cm", {})
        charts.append((tmp_path / f"{number}.svg").read_bytes())
    assert charts[0] == charts[1] != charts[2]


def test_marks_that_turn_text_around_are_not_drawn(tmp_path: Path) -> None:
    charts = []
    for number, label in enumerate(("a\u202eb", "a?b")):
        draw_lines(LINE, tmp_path / f"{number}.svg", label, "cm", {})
        charts.append((tmp_path / f"{number}.svg").read_bytes())
    assert charts[0] == charts[1]


def test_a_curve_rises_where_the_errors_are(tmp_path: Path) -> None:
    errors = {"good": Errors(np.full(50, 0.01)), "bad": Errors(np.full(50, 0.05))}
    draw_curves(errors, tmp_path / "cm.png", 10.0, unit=X100)
    draw_curves(errors, tmp_path / "far.png", 20.0, unit=X100)
    at = []
    for name, number in (("cm.png", 0), ("cm.png", 1), ("far.png", 1)):
        points = spots(tmp_path / name, number, right=1.0)
        half_way = np.abs(points[:, 1] - middle(points)[1]) < 0.2 * np.ptp(points[:, 1])
        at.append(float(points[half_way, 0].mean()))
    assert (at[1] - at[0]) / (at[2] - at[0]) == pytest.approx((0.5 - 0.1) / (0.25 - 0.1), rel=0.05)
    draw_curves(errors, tmp_path / "body.png", 10.0)
    assert (tmp_path / "body.png").read_bytes() != (tmp_path / "cm.png").read_bytes()
    for curves, rest in (({}, {}), (errors, {"limit": 0})):
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
    draw_losses(
        tmp_path / "e.png", STEPS, {"total": [0.1] * 40, "error_corrected": falling}, {}
    )  # the total stands below
    line, flat = (spots(tmp_path / "e.png", k, top=0.0, right=0.7) for k in (0, 1))
    assert np.ptp(flat[:, 1]) <= 4 < np.ptp(line[:, 1]) and flat[:, 1].max() < line[:, 1].min()
    draw_losses(tmp_path / "v.png", STEPS, {"total": falling}, {50: 0.02, 1000: 0.02, 2000: 0.02})
    dots = spots(tmp_path / "v.png", 0, top=0.0, right=0.81)
    thick = np.flatnonzero(np.bincount(dots[:, 0]) > 8)
    assert thick.min() < 150 and thick.max() > 600 and ((thick > 350) & (thick < 500)).any()


def test_what_is_not_a_loss_is_left_out(tmp_path: Path) -> None:
    values = [0.5, float("nan"), 0.0, -1.0, float("inf"), 0.1]
    draw_losses(tmp_path / "l.png", [1, 2, 3, 4, 5, 6], {"total": values, "none": [0.0] * 6}, {})
    assert len(spots(tmp_path / "l.png", 0)) > 100
    draw_losses(tmp_path / "many.png", [7], {f"term {k}": [1.0 + k] for k in range(23)}, {})
    for terms in ({}, {"total": [0.0, float("nan")]}):
        with pytest.raises(OptionError, match="no losses"):
            draw_losses(tmp_path / "none.png", [1, 2], terms, {})
    assert not (tmp_path / "none.png").exists()


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_the_same_numbers_give_the_same_file(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    draw_lines(LINE, tmp_path / f"a{suffix}", "steps", "cm", {})
    monkeypatch.setitem(matplotlib.rcParams, "lines.linewidth", 9.0)  # as a user's matplotlibrc may have it
    before = dict(matplotlib.rcParams)
    draw_lines(LINE, tmp_path / f"b{suffix.upper()}", "steps", "cm", {})
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix.upper()}").read_bytes()
    assert dict(matplotlib.rcParams) == before
    start = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[suffix]
    assert (tmp_path / f"a{suffix}").read_bytes().startswith(start)


def test_a_file_that_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OptionError, match="unsupported chart format"):
        draw_lines(LINE, tmp_path / "a.jpg", "steps", "cm", {})
    with pytest.raises(OutputError, match="no folder"):
        draw_lines(LINE, tmp_path / "no" / "a.png", "steps", "cm", {})
    monkeypatch.setattr(charts, "find_spec", lambda _: None)
    with pytest.raises(OptionError, match="charts need matplotlib") as told:
        draw_lines(LINE, tmp_path / "a.png", "steps", "cm", {})
    assert told.value.hint == "pip install 'meshmatch[plots]'"
    assert not list(tmp_path.iterdir())


def test_charts_beside_one_another(tmp_path: Path) -> None:
    charts = {
        "first": ("m", {"a": ((1, 2, 4), (1, 2, 4))}),
        "second": ("s", {"a": ((1, 4), (3, 3)), "b": ((4,), (1.5,))}),
    }
    draw_panels(charts, tmp_path / "a.png", "modes")
    line = spots(tmp_path / "a.png", 0, right=0.5)
    slope, start = np.polyfit(line[:, 0], line[:, 1], 1)
    assert slope > 0.3
    assert np.abs(line[:, 1] - (slope * line[:, 0] + start)).max() < 9
    with Image.open(tmp_path / "a.png") as image:
        middle_column = image.width / 2
    assert middle(spots(tmp_path / "a.png", 1, right=1.0))[0] > middle_column


def test_a_histogram_is_high_where_many_are(tmp_path: Path) -> None:
    draw_histogram(tmp_path / "h.png", [1.0] * 2 + [4.0] * 6, "mm", "shapes", {4.0: "far"})
    with Image.open(tmp_path / "h.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    blue = (pixels[..., 2] - pixels[..., 0] > 80).sum(axis=0)
    wide = np.flatnonzero(blue > 10)
    left, right = np.array_split(blue[wide], 2)
    assert right.max() == pytest.approx(3 * left.max(), rel=0.05)


def test_dots_have_the_colors_and_hulls_of_their_groups(tmp_path: Path) -> None:
    x, y = [0.0, 1.0, 0.0, 1.0, 3.0, 4.0, 3.0, 4.0, 2.0], [0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 0.5]
    groups = [*"aaaa", *"bbbb", ""]
    dots = Dots(x, y, "PC1", "PC2", {8: "odd"})
    draw_dots(tmp_path / "a.png", [dots], groups, hulls=True)
    a, b = (spots(tmp_path / "a.png", k, top=0.0, right=0.72) for k in (0, 1))
    across, up = middle(b) - middle(a)
    assert across / up == pytest.approx(1.5, rel=0.05)  # one scale
    draw_dots(tmp_path / "b.png", [Dots(x, y, "size", "score")] * 2, groups, hulls=False)
    line = spots(tmp_path / "b.png", 1, top=0.0, right=0.45)
    assert line[:, 1].max() > spots(tmp_path / "b.png", 0, top=0.0, right=0.45)[:, 1].max()
    for groups in (["a"], ["a", "a"], ["", ""], ["b", "a", "a"]):  # no area, no line
        some = Dots([1.0] * len(groups), [2.0] * len(groups), "", "")
        draw_dots(tmp_path / "c.svg", [some], groups, hulls=True)
        draw_dots(tmp_path / "c.pdf", [some], groups, hulls=False)


def test_pictures_stand_at_the_ends_of_the_axes(tmp_path: Path) -> None:
    """Each in a color of its own, off the dots, in the order of the ends."""
    inks = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 0, 255]], np.uint8)
    ends = [(f"end {k}", np.tile(np.append(ink, np.uint8(255)), (40, 40, 1))) for k, ink in enumerate(inks)]
    heights = []
    for y in ([0.0, 2.0, 1.0], [0.0, 1.0, 0.5], [0.0, 1e-6, 5e-7]):
        dots = Dots([0.0, 1.0, 2.0], y, "PC1 (62.3 %), unit of the files", "PC2", {}, ends)
        draw_dots(tmp_path / "a.png", [dots], ["a", "a", "a"], hulls=True)
        with Image.open(tmp_path / "a.png") as image:
            pixels = np.asarray(image.convert("RGB"), int)
        found = [np.argwhere(np.abs(pixels - ink).max(axis=2) < 8) for ink in inks]
        assert all(len(place) > 60**2 for place in found)
        low, high, down, up = (place.mean(axis=0) for place in found)
        places = spots(tmp_path / "a.png", 0, top=0.0, right=1.0)  # column and row of the dots
        assert low[1] < high[1] and low[0] == pytest.approx(high[0], abs=2)
        assert up[0] < down[0] and up[1] == pytest.approx(down[1], abs=2)
        lowest = len(pixels) - places[:, 1].min()  # spots count rows upwards
        assert min(found[0][:, 0]) > lowest and max(found[2][:, 1]) < places[:, 0].min()
        heights.append(len(pixels))
    assert heights[0] > heights[1] == heights[2]  # no taller than dots, pictures and words need
    draw_dots(tmp_path / "a.svg", [dots], ["a", "a", "a"], hulls=True)
    assert (tmp_path / "a.svg").read_text().count("<image") == 4
    draw_dots(tmp_path / "a.pdf", [dots], ["a", "a", "a"], hulls=True)
    assert (tmp_path / "a.pdf").read_bytes().count(b"/Subtype /Image") >= 4


def test_a_scree_stands_beside_a_broken_stick(tmp_path: Path) -> None:
    draw_scree(tmp_path / "a.png", [0.75, 0.25], 2)  # the pieces of a stick broken once are 3/4 and 1/4 long
    bars = spots(tmp_path / "a.png", 0, top=0.0, right=1.0)
    stick = spots(tmp_path / "a.png", 1, top=0.2, right=1.0)
    ends = [bars[bars[:, 0] < 0.3 * bars[:, 0].max()], bars[bars[:, 0] > 0.9 * bars[:, 0].max()]]
    assert ends[0][:, 1].max() > 2 * ends[1][:, 1].max() - 60
    assert stick[stick[:, 0].argmax(), 1] == pytest.approx(ends[1][:, 1].max(), abs=12)
