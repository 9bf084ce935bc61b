"""A page with a shape in motion: what is in the file, and how it moves in headless Chromium (skipped without)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.render.viewer.single_pages import write_motion
from meshmatch.shapes.shape import Shape
from tests.render.browser import opened
from tests.render.pages import read

TIMES = (0.0, 0.5, 2.0)


def grown(shape: Shape, *factors: float, colors: bool = False) -> list[Shape]:
    tint = np.tile([0.9, 0.1, 0.1, 1.0], (shape.V, 1)) if colors else None
    return [Shape(shape.verts * [1, factor, 1], shape.faces, "grown", tint) for factor in factors]


def test_every_frame_is_in_the_page(tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    ball, path = make_sphere(1), tmp_path / "a.html"
    frames = grown(ball, 1.0, 2.0, 0.5)
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    size = write_motion(path, frames, TIMES, rotation=turn, met={0.0: "a </script>", 9.0: "never"}, title="a & b")
    assert size == path.stat().st_size
    words, arrays = read(path).words, read(path).arrays
    assert (words["times"], words["met"]) == (list(TIMES), [[0.0, "a </script>"]])
    at = arrays["position"].reshape(3, ball.V, 3) / 65535 + words["low"]
    edge = 4.0  # the second frame is the largest, along y
    for place, frame in zip(at, frames, strict=True):
        assert np.abs(place * edge - frame.verts @ turn.T).max() < 1e-3
    assert np.array_equal(arrays["face"].reshape(-1, 3), ball.faces)
    normals = arrays["normal"].reshape(3, ball.V, 3) / 127
    assert np.abs(normals[0] - frames[0].vertex_normals @ turn.T).max() < 0.01
    again = tmp_path / "b.html"
    write_motion(again, frames, TIMES, rotation=turn, met={0.0: "a </script>", 9.0: "never"}, title="a & b")
    assert again.read_bytes() == path.read_bytes()


def test_own_colors_and_a_cloud(tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    ball = make_sphere(1)
    path = tmp_path / "a.html"
    write_motion(path, grown(ball, 1, 2, colors=True), (0, 1), rotation=np.eye(3))
    assert set(map(tuple, read(path).arrays["color"].reshape(-1, 3).tolist())) == {(230, 26, 26)}
    cloud = Shape(ball.verts, np.empty((0, 3), np.int64))
    write_motion(path, grown(cloud, 1, 2), (0, 1), rotation=np.eye(3))
    words, arrays = read(path).words, read(path).arrays
    assert words["cloud"]
    assert words["radius"] > 0
    assert len(arrays["face"]) == 0


def test_a_large_shape_is_drawn_coarser(tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    ball = make_sphere(3)
    path = tmp_path / "a.html"
    write_motion(path, grown(ball, 1, 2), (0, 1), rotation=np.eye(3), most=200)
    words, arrays = read(path).words, read(path).arrays
    assert len(arrays["position"]) <= 2 * 3 * 200
    assert "of 642 vertices" in words["note"]


@pytest.mark.parametrize("wrong", ["suffix", "one", "times", "faces"])
def test_what_is_no_motion(tmp_path: Path, make_sphere: Callable[[int], Shape], wrong: str) -> None:
    frames = grown(make_sphere(1), 1, 2)
    if wrong == "faces":
        frames[1] = make_sphere(2)
    if wrong == "one":
        frames = frames[:1]
    times = (0.0, 0.0) if wrong == "times" else (0.0, 1.0)[: len(frames)]
    with pytest.raises(OptionError):
        write_motion(tmp_path / ("a.txt" if wrong == "suffix" else "a.html"), frames, times, rotation=np.eye(3))
    assert list(tmp_path.iterdir()) == []


def height(path: Path) -> int:
    """Rows of a picture in which something red is."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    return int(((pixels[..., 0] - pixels[..., 1]) > 60).any(axis=1).sum())


@pytest.mark.slow
def test_the_slider_moves_it(running: Any, tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    path = tmp_path / "a.html"
    write_motion(path, grown(make_sphere(3), 1, 2, 1, colors=True), TIMES, rotation=np.eye(3), met={0.5: "tall"})
    with opened(running, path) as seen:
        small = height(seen.picture(tmp_path / "0.png"))
        assert seen.page.inner_text("#names") == "tall"
        slider = (
            "([t]) => { const s = document.getElementById('time'); s.value = t; s.dispatchEvent(new Event('input')) }"
        )
        seen.page.evaluate(slider, [0.5])
        tall = height(seen.picture(tmp_path / "1.png"))
        assert tall == pytest.approx(2 * small, rel=0.06)
        seen.page.evaluate(slider, [1.25])  # half way down again
        assert height(seen.picture(tmp_path / "2.png")) == pytest.approx(1.5 * small, rel=0.06)
        assert seen.state()["between"] == [1, 0.5]
        seen.page.keyboard.press("k")
        assert seen.state()["playing"]
        for _ in range(200):
            if seen.settled()["time"] > 1.5:
                break
        assert seen.state()["time"] > 1.5
        seen.page.click("#play")
        stopped = seen.settled()
        assert not stopped["playing"]
        assert seen.settled()["time"] == stopped["time"]
        seen.page.focus("#canvas")
        seen.page.keyboard.press("ArrowRight")
        seen.page.keyboard.press("+")
        larger = height(seen.picture(tmp_path / "3.png"))
        seen.page.keyboard.press("r")
        assert height(seen.picture(tmp_path / "4.png")) < larger
