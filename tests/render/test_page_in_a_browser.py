"""The page as people meet it, in headless Chromium. Skipped, with a reason, where there is none."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.viewer.looks import Looks
from meshmatch.render.viewer.page import write_page
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.shape import Shape
from tests.render.browser import PHONE, Opened, opened, unnamed_controls
from tests.render.pairs import Pair, bump, shuffled_pair

pytestmark = pytest.mark.slow
MODES = ["matches", "look", "own", "confidence", "plain"]


@pytest.fixture(scope="module")
def pair(make_sphere: Callable[[int], Shape]) -> Pair:
    return shuffled_pair(bump(make_sphere(2)), "stirred.ply", "fair", ("stirred.ply: the nose is <b>far</b>",), 0.2)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory, pair: Pair) -> Path:
    """A page with a texture on both shapes, and another that the target has itself."""
    path = tmp_path_factory.mktemp("page") / "page.html"
    pixels = np.full((32, 32, 4), 255, np.uint8)
    pixels[::2, :, 1:3] = 0
    pixels[:, ::2, 0] = 0

    def worn(shape: Shape, image: np.ndarray | None) -> Appearance:
        low, extent = shape.bounds[0], np.ptp(shape.verts, axis=0)
        uv = ((shape.verts - low) / extent)[shape.faces][..., :2]
        return Appearance((Material("m", image, (1.0, 0.6, 0.2, 1.0)),), np.zeros(shape.F, np.int64), uv)

    looks = Looks("source", (worn(pair.source, pixels), worn(pair.target, pixels)), worn(pair.target, None))
    write_page(path, pair.source, pair.target, pair.there, pair.back, looks=looks)
    return path


def far_apart(view: Opened, side: str, count: int, most: int = 6) -> list[int]:
    """Vertices that are seen and stand well apart on the screen."""
    places = [view.place(side, vertex) for vertex in range(count)]
    xy = np.array([[place["x"], place["y"]] for place in places])
    gap = np.linalg.norm(xy[:, None] - xy[None], axis=2) + 1e9 * np.eye(count)
    gap[:, [not place["seen"] for place in places]] = 1e9
    good = [k for k in np.argsort(-gap.min(axis=1)).tolist() if places[k]["seen"]]
    assert len(good) >= most
    return good[:most]


def mark(view: Opened, side: str) -> tuple[float, float] | None:
    """Where on the screen the ring of one side is drawn."""
    element = view.page.locator(f"#mark-{side} .ring")
    if not element.is_visible():
        return None
    box = element.bounding_box()
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


@pytest.mark.parametrize("side", ["source", "target"])
def test_a_point_under_the_mouse_lights_its_match(running: Any, file: Path, pair: Pair, side: str) -> None:
    found = pair.there if side == "source" else pair.back
    other = "target" if side == "source" else "source"
    with opened(running, file) as view:
        assert view.state()["shown"] is None
        assert mark(view, side) is None
        for vertex in far_apart(view, side, pair.source.V):
            at = view.place(side, vertex)
            view.page.mouse.move(at["x"], at["y"])
            shown = view.settled()["shown"]
            assert (shown["side"], shown["vertex"]) == (side, vertex)
            assert shown["match"] == found.index[vertex]
            assert shown["confidence"] == pytest.approx(found.confidence[vertex], abs=0.003)
            for where, number in ((side, vertex), (other, int(found.index[vertex]))):
                place, ring = view.place(where, number), mark(view, where)
                assert ring == pytest.approx((place["x"], place["y"]), abs=1.0)
                assert view.page.locator(f"#{where} input").input_value() == str(number)
            words = view.page.locator("#status").inner_text()
            assert f": vertex {vertex} of" in words
            assert f"→ vertex {found.index[vertex]} of" in words
        view.page.mouse.move(640, 5)
        assert view.settled()["shown"] is None
        assert mark(view, other) is None


def test_a_click_keeps_the_point_while_the_shape_turns(running: Any, file: Path, pair: Pair) -> None:
    with opened(running, file) as view:
        vertex = far_apart(view, "source", pair.source.V, 1)[0]
        at = view.place("source", vertex)
        view.page.mouse.click(at["x"], at["y"])
        view.page.mouse.move(640, 5)
        assert view.settled()["shown"]["vertex"] == vertex
        before = view.place("source", vertex), view.place("target", int(pair.there.index[vertex]))
        drag(view, 300, 400, 420, 400)
        after = view.place("source", vertex), view.place("target", int(pair.there.index[vertex]))
        assert view.state()["pin"] == {"side": "source", "row": vertex}  # a drag is no click
        assert abs(after[0]["x"] - before[0]["x"]) > 5
        # linked: the other view has turned as well; it leans a little, so not by just as many pixels
        assert after[1]["x"] - before[1]["x"] == pytest.approx(after[0]["x"] - before[0]["x"], rel=0.2)
        ring = mark(view, "source")
        assert ring is not None
        assert ring == pytest.approx((after[0]["x"], after[0]["y"]), abs=1.0)
        view.page.keyboard.press("Escape")
        assert view.settled()["shown"] is None


def drag(view: Opened, x: float, y: float, to_x: float, to_y: float) -> None:
    view.page.mouse.move(x, y)
    view.page.mouse.down()
    view.page.mouse.move((x + to_x) / 2, (y + to_y) / 2)
    view.page.mouse.move(to_x, to_y)
    view.page.mouse.up()
    view.page.mouse.move(640, 5)
    still = view.state()["frames"]
    for _ in range(200):  # until the swing has died down
        now = view.settled()["frames"]
        if now == still:
            return
        still = now
    pytest.fail("the view never comes to rest")


def test_views_that_are_not_linked_turn_alone(running: Any, file: Path) -> None:
    with opened(running, file) as view:
        view.page.get_by_role("button", name="Linked").click()
        assert view.state()["linked"] is False
        before = view.place("source", 5), view.place("target", 5)
        drag(view, 900, 400, 1000, 430)
        after = view.place("source", 5), view.place("target", 5)
        assert after[0]["x"] == pytest.approx(before[0]["x"], abs=1e-6)
        assert abs(after[1]["x"] - before[1]["x"]) > 1
        view.page.keyboard.press("l")
        assert view.state()["linked"] is True
        view.page.keyboard.press("r")
        view.settled()
        assert view.place("target", 5)["x"] == pytest.approx(before[1]["x"], abs=0.01)


def test_colors_and_wireframe_change_what_is_drawn(running: Any, file: Path, tmp_path: Path) -> None:
    with opened(running, file) as view:
        names = [label.inner_text() for label in view.page.locator("#modes label").all()]
        assert names == ["Matches", "Texture", "Original", "Confidence", "Plain"]
        pictures = []
        for k, mode in enumerate(MODES):
            view.page.locator("#modes label").nth(k).click()
            assert view.settled()["mode"] == mode
            assert view.page.locator("#modes input").nth(k).is_checked()
            pictures.append(panels(view, tmp_path / f"{mode}.png"))
            assert (saturation(pictures[-1][0]) < 0.1) == (mode == "plain")
        for k in range(len(MODES)):
            for other in range(k):
                for side in (0, 1):
                    same = np.abs(pictures[k][side].astype(int) - pictures[other][side]).mean() < 1
                    assert same == (side == 0 and {MODES[k], MODES[other]} == {"look", "own"})
        view.page.keyboard.press("w")
        assert view.page.locator("#wireframe").get_attribute("aria-pressed") == "true"
        wired = panels(view, tmp_path / "wire.png")
        assert all(a.mean() < b.mean() - 0.5 for a, b in zip(wired, pictures[-1], strict=True))
        view.page.locator("#wireframe").click()
        assert np.array_equal(panels(view, tmp_path / "plain.png")[0], pictures[-1][0])
        view.page.keyboard.press("1")
        assert view.settled()["mode"] == "matches"
        assert np.array_equal(panels(view, tmp_path / "again.png")[1], pictures[0][1])


def panels(view: Opened, path: Path) -> list[np.ndarray]:
    """Pixels of the middle of both panels, without words."""
    view.page.mouse.move(640, 5)
    with Image.open(view.picture(path)) as image:
        pixels = np.asarray(image.convert("RGB"))
    return [pixels[100:680, 30:620], pixels[100:680, 660:1250]]


def saturation(pixels: np.ndarray) -> float:
    spread = pixels.max(axis=2).astype(float) - pixels.min(axis=2)
    return float(np.quantile(spread, 0.95) / 255)


def test_a_turned_shape_stays_in_its_panel(running: Any, make_sphere: Callable[[int], Shape], tmp_path: Path) -> None:
    ball = make_sphere(2)
    wide = shuffled_pair(Shape(ball.verts * (2.0, 2.0, 0.3), ball.faces, "wide"))
    write_page(tmp_path / "page.html", wide.source, wide.target, wide.there, wide.back)
    with opened(running, tmp_path / "page.html") as view:
        box = view.page.locator("#source .view").bounding_box()
        for _ in range(9):
            for vertex in range(0, ball.V, 5):
                at = view.place("source", vertex)
                assert box["x"] < at["x"] < box["x"] + box["width"]
                assert box["y"] < at["y"] < box["y"] + box["height"]
            view.page.keyboard.press("ArrowRight")
            view.settled()


def test_a_vertex_can_be_typed(running: Any, file: Path, pair: Pair) -> None:
    with opened(running, file) as view:
        field = view.page.get_by_label("Vertex of the target, stirred.ply")
        field.fill("17")
        field.press("Enter")
        assert view.settled()["shown"]["match"] == pair.back.index[17]
        assert (
            view.page.locator("#announce")
            .inner_text()
            .endswith(f": vertex 17 of stirred.ply → vertex {pair.back.index[17]} of egg.ply")
        )
        for wrong in ("162", "-1", "1e3", "nose"):
            field.fill(wrong)
            field.press("Enter")
            assert view.page.locator("#status").inner_text() == ("\u2068stirred.ply\u2069 has the vertices 0 to 161.")
        field.fill("")
        field.press("Enter")
        assert view.settled()["shown"] is None


def test_keys_turn_and_zoom(running: Any, file: Path) -> None:
    with opened(running, file) as view:
        start = view.place("target", 3)
        view.page.locator("#source .view").focus()
        for key, undo in (("ArrowLeft", "ArrowRight"), ("ArrowUp", "ArrowDown"), ("+", "-")):
            view.page.keyboard.press(key)
            view.settled()
            moved = view.place("target", 3)
            assert abs(moved["x"] - start["x"]) + abs(moved["y"] - start["y"]) > 1
            view.page.keyboard.press(undo)
            view.settled()
            back = view.place("target", 3)
            assert (back["x"], back["y"]) == pytest.approx((start["x"], start["y"]), abs=0.01)


def test_help_and_verdict_open(running: Any, file: Path) -> None:
    with opened(running, file) as view:
        assert view.page.title() == "egg.ply → stirred.ply"
        assert view.page.locator("#verdict summary").inner_text() == "fair fit"
        view.page.locator("#verdict summary").click()
        assert view.page.locator("#reasons li").inner_text() == "stirred.ply: the nose is <b>far</b>"
        view.page.keyboard.press("Escape")
        assert not view.page.locator("#reasons").is_visible()
        view.page.keyboard.press("?")
        assert view.page.get_by_role("dialog", name="Help").is_visible()
        view.page.get_by_role("button", name="Close").click()
        assert not view.page.locator("#help").is_visible()


def test_everything_that_can_be_used_has_a_name(running: Any, file: Path) -> None:
    with opened(running, file) as view:
        assert unnamed_controls(view) == []


def test_a_finger_taps_on_a_phone(running: Any, file: Path, pair: Pair, artefacts: Path) -> None:
    with opened(running, file, **PHONE) as view:
        boxes = [view.page.locator(f"#{side}").bounding_box() for side in ("source", "target")]
        assert boxes[1]["y"] > boxes[0]["y"] + boxes[0]["height"]  # one above the other
        width = view.page.evaluate("document.documentElement.scrollWidth")
        assert width == 390  # nothing to scroll to the side
        vertex = far_apart(view, "target", pair.source.V, 1)[0]
        at = view.place("target", vertex)
        view.page.touchscreen.tap(at["x"], at["y"])
        assert view.settled()["pin"] == {"side": "target", "row": vertex}
        assert view.state()["shown"]["match"] == pair.back.index[vertex]
        assert "vertex" in view.page.locator("#status").inner_text()
        view.picture(artefacts / "viewer-phone.png")


def test_the_network_is_forbidden(running: Any, file: Path) -> None:
    with opened(running, file) as view:
        refused = view.page.evaluate("fetch('https://example.org/').then(() => 'went through', error => error.name)")
        assert refused == "TypeError"
        assert any("Content Security Policy" in line for line in view.said)
        view.said.clear()
        told = view.page.evaluate(  # later, when nobody but the page itself is asking
            "new Promise(r => setTimeout(() => { try { r(eval('1')) } catch (error) { r(error.name) } }))"
        )
        assert told == "EvalError"
        view.said.clear()


def test_points_on_either_side(running: Any, pair: Pair, tmp_path: Path) -> None:
    cloud = Shape(pair.source.verts, np.empty((0, 3), np.int64), "cloud.xyz")
    there = VertexMap.between(cloud, cloud, np.roll(np.arange(cloud.V), 1))
    back = VertexMap.between(cloud, cloud, np.roll(np.arange(cloud.V), -1))
    write_page(tmp_path / "page.html", cloud, cloud, there, back)
    with opened(running, tmp_path / "page.html") as view:
        assert not view.page.locator("#wireframe").is_visible()
        view.page.keyboard.press("w")
        assert view.state()["wireframe"] is False
        for side, found in (("source", there), ("target", back)):
            for vertex in far_apart(view, side, cloud.V, 3):
                at = view.place(side, vertex)
                view.page.mouse.move(at["x"], at["y"])
                shown = view.settled()["shown"]
                assert (shown["side"], shown["vertex"], shown["match"]) == (side, vertex, found.index[vertex])
        # The maps do not say how confident they are.
        assert view.page.locator("#status").inner_text().startswith("Confidence unknown")
        assert view.page.get_by_role("radio", name="Confidence").count() == 0
        drawn = panels(view, tmp_path / "points.png")
        assert saturation(drawn[0]) > 0.2


def test_a_coarser_mesh_keeps_the_numbers_of_the_file(
    running: Any, make_sphere: Callable[[int], Shape], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("meshmatch.render.viewer.page.MAX_VERTICES", 500)
    fine = shuffled_pair(bump(make_sphere(4)), "fine.ply")
    write_page(tmp_path / "page.html", fine.source, fine.target, fine.there, fine.back)
    with opened(running, tmp_path / "page.html") as view:
        assert "of 2,562 vertices" in view.page.locator("#target .count").inner_text()
        view.page.mouse.move(330, 400)
        shown = view.settled()["shown"]
        assert shown["match"] == fine.there.index[shown["vertex"]]
        field = view.page.get_by_label("Vertex of the source, egg.ply")
        for vertex in range(10):
            field.fill(str(vertex))
            field.press("Enter")
            if "not among" in view.page.locator("#status").inner_text():
                break
        else:
            pytest.fail("all of the first vertices are drawn")


def test_pictures_for_people(running: Any, file: Path, artefacts: Path) -> None:
    """Light and dark: kept, to be looked at; here only that they differ and show something."""
    means = []
    for scheme in ("light", "dark"):
        with opened(running, file, color_scheme=scheme) as view:
            view.page.mouse.move(300, 400)
            with Image.open(view.picture(artefacts / f"viewer-{scheme}.png")) as image:
                pixels = np.asarray(image.convert("RGB"))
            assert saturation(pixels) > 0.1
            means.append(pixels.mean())
    assert means[0] > 180
    assert means[1] < 90
