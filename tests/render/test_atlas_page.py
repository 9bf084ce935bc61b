"""The page of a mean and its modes: what is in the file, and what its sliders do in headless Chromium (skipped without)."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.errors import OptionError
from meshmatch.render.viewer.single_pages import MAX_MODES, Varying, write_atlas_page
from meshmatch.shapes.shape import Shape
from tests.render.browser import PHONE, opened, unnamed_controls
from tests.render.pages import read

NAMES = ("a </script>", "b & c", "é")
SCORES = np.array([[-1.0, 0.5], [2.0, 0.0], [-4.0, 1.0]])


def varying(ball: Shape) -> Varying:
    """A ball that grows along y by 0.2 in the first mode, along x by 0.1 in the second."""
    modes = np.stack([ball.verts * [0, 0.2, 0], ball.verts * [0.1, 0, 0]])
    return Varying(ball, modes, np.array([0.8, 0.2]), SCORES, NAMES)


def test_the_mean_and_every_mode_are_in_the_page(tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    ball, path = make_sphere(1), tmp_path / "a.html"
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    size = write_atlas_page(path, varying(ball), rotation=turn, title="a & b")
    assert size == path.stat().st_size
    words, arrays = read(path).words, read(path).arrays
    place = arrays["position"].reshape(-1, 3) / 65535 + words["low"]
    assert np.abs(place * words["unit"] - ball.verts @ turn.T).max() < 1e-4
    assert words["unit"] == pytest.approx(2 * ball.verts[:, 1].max() * 1.4)  # at two standard deviations
    for mode, reach, true in zip(arrays["mode"].reshape(2, -1, 3), words["reach"], varying(ball).modes, strict=True):
        assert np.abs(mode / 32767 * reach * words["unit"] - true @ turn.T).max() < 1e-4
    assert np.allclose(arrays["score"].reshape(3, 2), SCORES)
    assert words["names"] == list(NAMES)
    assert words["kept"] == "100.0 % of the variance in 2 of 2 modes"
    again = tmp_path / "b.html"
    write_atlas_page(again, varying(ball), rotation=turn, title="a & b")
    assert again.read_bytes() == path.read_bytes()


def test_many_modes_and_vertices_are_fewer_on_the_page(tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    ball, path = make_sphere(3), tmp_path / "a.html"
    modes = np.random.default_rng(0).standard_normal((20, ball.V, 3))
    many = Varying(ball, modes, np.full(20, 0.05), np.zeros((1, 20)), ("a",))
    write_atlas_page(path, many, rotation=np.eye(3), most=200)
    words, arrays = read(path).words, read(path).arrays
    assert len(words["shares"]) == MAX_MODES
    assert "12 of 20 modes" in words["kept"]
    assert "of 642 vertices" in words["note"]
    assert len(arrays["mode"]) == MAX_MODES * len(arrays["position"])


@pytest.mark.parametrize("wrong", ["suffix", "cloud", "modes"])
def test_what_has_no_page(tmp_path: Path, make_sphere: Callable[[int], Shape], wrong: str) -> None:
    given = varying(make_sphere(1))
    mean = Shape(given.mean.verts, np.empty((0, 3), np.int64)) if wrong == "cloud" else given.mean
    modes = given.modes[:0] if wrong == "modes" else given.modes
    with pytest.raises(OptionError):
        write_atlas_page(
            tmp_path / ("a.txt" if wrong == "suffix" else "a.html"),
            Varying(mean, modes, given.shares, SCORES, NAMES),
            rotation=np.eye(3),
        )
    assert list(tmp_path.iterdir()) == []


def height(path: Path) -> int:
    """Rows of a picture in which the ball is: its middle differs from the corner of its panel."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    column = pixels[60:700, 480]
    return int((np.abs(column - column[2]).sum(axis=1) > 40).sum())


def test_sliders_change_the_shape(running: Any, tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    ball, path = make_sphere(3), tmp_path / "a.html"
    write_atlas_page(path, varying(ball), rotation=np.eye(3), title="balls")
    top = int(ball.verts[:, 1].argmax())
    with opened(running, path) as seen:
        mean = height(seen.picture(tmp_path / "0.png"))
        seen.page.evaluate("s = document.getElementById('mode-0'); s.value = 2; s.dispatchEvent(new Event('input'))")
        tall = height(seen.picture(tmp_path / "1.png"))
        assert tall == pytest.approx(1.4 * mean, rel=0.06)
        assert seen.page.inner_text("#score-0") == "2.00 sd"
        assert seen.state()["farthest"] == pytest.approx(0.4 * ball.verts[:, 1].max(), rel=1e-3)
        seen.page.select_option("#shape", "2")  # scores beyond the sliders are kept
        assert seen.state()["scores"] == [-4, 1]
        place = seen.page.evaluate("v => meshmatch.place(v)", top)
        assert place == pytest.approx((ball.verts[top] * [1.1, 1 - 0.8, 1]).tolist(), abs=2e-4)
        assert seen.page.inner_text("#score-0") == "−4.00 sd"
        seen.page.focus("#shape")
        seen.page.keyboard.press("m")
        assert seen.state()["scores"] == [-4, 1]  # a letter in the list of names is for the list
        seen.page.click("#mean")
        assert seen.state()["scores"] == [0, 0]
        assert height(seen.picture(tmp_path / "2.png")) == mean
        for vertex in (0, 7, 300):
            normal = seen.page.evaluate("v => meshmatch.normal(v)", vertex)
            assert normal == pytest.approx(ball.vertex_normals[vertex].tolist(), abs=1e-3)


def test_figures_are_on_the_page(running: Any, tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    path, red = tmp_path / "a.html", tmp_path / "red.png"
    Image.new("RGB", (60, 40), (255, 0, 0)).save(red)
    (tmp_path / "b.svg").write_text('<svg xmlns="http://www.w3.org/2000/svg" width="9" height="9"/>')
    shown = replace(varying(make_sphere(1)), figures=[red, tmp_path / "b.svg"])
    write_atlas_page(path, shown, rotation=np.eye(3), title="balls")
    with opened(running, path) as seen:
        assert unnamed_controls(seen) == []
        assert seen.page.locator("#figures img").evaluate_all("all => all.map(i => i.naturalWidth)") == [60, 9]
        seen.page.click("#figures button")
        pixels = np.asarray(Image.open(seen.picture(tmp_path / "1.png")).convert("RGB"))
        assert (pixels[:, 560:720] == [255, 0, 0]).all(axis=2).sum() == 60 * 40
        seen.page.keyboard.press("n")  # a letter behind the figure changes nothing
        assert seen.state()["scores"] == [0, 0]
        seen.page.click("#large button")
        seen.page.keyboard.press("n")
        assert any(seen.state()["scores"])


@pytest.mark.slow
def test_the_page_plays(running: Any, tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    path = tmp_path / "a.html"
    write_atlas_page(path, varying(make_sphere(2)), rotation=np.eye(3), title="balls")
    with opened(running, path) as seen:
        seen.page.click("#random")
        assert any(seen.settled()["scores"])
        assert seen.page.eval_on_selector("#shape", "e => e.selectedOptions[0].textContent") == "by the sliders"
        seen.page.focus("#mode-1")
        seen.page.keyboard.press("ArrowRight")
        assert seen.page.inner_text("#play") == "Play mode 2"
        seen.page.keyboard.press("k")
        before = seen.settled()["scores"]
        for _ in range(100):
            if abs(seen.settled()["scores"][1]) > 1:
                break
        after = seen.state()["scores"]
        assert abs(after[1]) > 1
        assert after[0] == before[0]
        seen.page.click("#play")
        assert not seen.settled()["playing"]


@pytest.mark.slow
def test_colors_are_the_distance(running: Any, tmp_path: Path, make_sphere: Callable[[int], Shape]) -> None:
    path = tmp_path / "a.html"
    write_atlas_page(path, varying(make_sphere(3)), rotation=np.eye(3))
    with opened(running, path) as seen:

        def top(name: str) -> np.ndarray:
            """The color near the top of the ball."""
            with Image.open(seen.picture(tmp_path / name)) as image:
                pixels = np.asarray(image.convert("RGB")).astype(int)[60:700, 480]
            rows = np.flatnonzero(np.abs(pixels - pixels[2]).sum(axis=1) > 40)
            return np.asarray(pixels[rows[0] + 12])

        seen.page.evaluate("meshmatch.setScore(0, 2)")
        far = top("0.png")
        seen.page.keyboard.press("c")
        plain = top("1.png")
        assert seen.page.locator("#legend").is_hidden()
        seen.page.keyboard.press("c")
        seen.page.evaluate("meshmatch.choose(-1)")
        near = top("2.png")
        assert far.sum() < near.sum() - 150  # dark is far
        assert np.ptp(plain) < 60  # clay


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_words_can_be_read(
    running: Any, tmp_path: Path, artefacts: Path, make_sphere: Callable[[int], Shape], scheme: str
) -> None:
    path = tmp_path / "a.html"
    write_atlas_page(path, varying(make_sphere(3)), rotation=np.eye(3), title="balls of three kinds")
    for name, options in {"desktop": {}, "phone": PHONE}.items():
        with opened(running, path, color_scheme=scheme, **options) as seen:
            seen.page.evaluate("meshmatch.choose(1)")
            seen.picture(artefacts / f"atlas-{scheme}-{name}.png")
            assert seen.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            for target in ("#title", "#shape", "#mode-0", "#score-1", "#play", "#high"):
                box = seen.page.locator(target).bounding_box()
                assert box["x"] >= 0 and box["x"] + box["width"] <= seen.page.viewport_size["width"], target
            assert unnamed_controls(seen) == []
