"""The pictures of transfer-color, -labels, -weights, -landmarks and -texture."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.maps.files import load_map, save_map
from meshmatch.render import compose
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look
from meshmatch.render.scales import Scale, Swatches
from meshmatch.shapes.colors import UNKNOWN, label_colors
from meshmatch.shapes.files import load_shape, save_shape
from tests.cli.conftest import FakeMatching, Run, fake_fit, well
from tests.cli.test_transfer_verbs import OUTPUT, call, pair  # noqa: F401  (pair is a fixture)
from tests.shapes.painted import encoded, quarters, write_square_obj


class Drawn:
    """Stands for the renderer: keeps what it was given."""

    def __call__(self, panels: Any, path: Path, look: Look) -> None:
        self.panels: list[Panel] = list(panels)
        self.look = look
        path.write_bytes(b"a picture")


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    recorder = Drawn()
    monkeypatch.setattr(compose, "render_shapes", recorder)
    return recorder


@pytest.mark.parametrize("noun", OUTPUT)
def test_a_picture_of_both_shapes(run: Run, pair: Path, noun: str) -> None:  # noqa: F811
    answer = well(run(*call(f"{noun} --picture p.png --json")))
    assert answer.record["picture"] == "p.png"
    assert "drew p.png: both shapes with what was transferred" in answer.err
    with Image.open("p.png") as image:
        pixels = np.asarray(image)
    assert image.size[0] > image.size[1]
    left, right = np.split(pixels, [image.size[0] // 2], axis=1)
    assert (left < 240).any(axis=2).mean() > 0.1
    assert (right < 240).any(axis=2).mean() > 0.1
    assert run(*call(f"{noun} --json")).record["picture"] is None


def test_colors_and_numbers(run: Run, pair: Path, drawn: Drawn) -> None:  # noqa: F811
    well(run(*call("color --picture p.png")))
    a, b = load_shape("a.ply"), load_shape("b.ply")
    assert a.colors is not None
    assert np.asarray(drawn.panels[0].colors) == pytest.approx(a.colors[:, :3], abs=1e-6)
    assert np.asarray(drawn.panels[1].colors) == pytest.approx(b.verts / 2 + 0.5, abs=0.05)
    assert [panel.label for panel in drawn.panels] == ["a.ply", "b.ply"]
    well(run(*call("color --values values.npy --picture p.png", out="v.npy")))
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert scale.title == "values (the first of 3 numbers)"
    assert np.array_equal(drawn.panels[0].colors, scale.colors(a.verts[:, 0]))
    assert np.asarray(drawn.panels[1].colors) == pytest.approx(scale.colors(b.verts[:, 0]), abs=0.05)
    np.save("one.npy", a.verts[:, 1])
    well(run(*call("color --values one.npy --picture p.png", out="v.npy")))
    assert isinstance(drawn.look.legend, Scale)
    assert drawn.look.legend.title == "one"


@pytest.mark.parametrize("to", ["vertices", "faces"])
def test_labels_and_those_left_blank(run: Run, pair: Path, drawn: Drawn, to: str) -> None:  # noqa: F811
    a = load_shape("a.ply")
    unsure = np.where(a.verts[:, 0] > 0, 1.0, 0.1)
    save_map("ab.npz", replace(load_map("ab.npz"), confidence=unsure))
    well(run(*call(f"labels --to {to} --blank 9 --picture p.png")))
    legend = drawn.look.legend
    assert isinstance(legend, Swatches)
    assert legend.names == ("0", "1", "none")
    here, there = drawn.panels
    assert here.sharp
    assert np.asarray(here.colors)[load_shape("a.ply").verts[:, 2] > 0] == pytest.approx(label_colors([1] * 73))
    found = np.asarray(there.colors if to == "vertices" else there.face_colors)
    labels = np.load("out.npy")
    assert (found[labels == 9] == UNKNOWN).all()
    assert (labels == 9).any()
    assert found[labels == 0] == pytest.approx(label_colors(np.zeros((labels == 0).sum(), int)))


def test_weights_show_the_heaviest_joint(run: Run, pair: Path, drawn: Drawn) -> None:  # noqa: F811
    well(run(*call("weights --picture p.png")))
    assert isinstance(drawn.look.legend, Swatches)
    assert drawn.look.legend.names == ("up", "down")
    z = load_shape("b.ply").verts[:, 2]
    found = np.asarray(drawn.panels[1].colors)
    assert found[z > 0.1] == pytest.approx(label_colors(np.zeros((z > 0.1).sum(), int)))
    assert found[z < -0.1] == pytest.approx(label_colors(np.ones((z < -0.1).sum(), int)))


def test_landmarks_are_balls_of_one_color(run: Run, pair: Path, drawn: Drawn) -> None:  # noqa: F811
    well(run(*call("landmarks --picture p.png")))
    a = load_shape("a.ply")
    for panel in drawn.panels:
        assert np.asarray(panel.points) == pytest.approx(a.verts[[3, 7]], abs=1e-6)
        assert np.array_equal(panel.point_colors, label_colors([0, 1]))


def test_a_texture_on_both(run: Run, pair: Path, drawn: Drawn) -> None:  # noqa: F811
    write_square_obj(pair / "square.obj")
    (pair / "square.mtl").write_text("newmtl paint\nmap_Kd skin.png\n")
    (pair / "skin.png").write_bytes(encoded(quarters(8)))
    square = load_shape("square.obj")
    save_shape("plain.ply", square)
    np.save("same.npy", np.arange(4))
    words = ("transfer-texture", "square.obj", "plain.ply", "--map", "same.npy", "--size", "64")
    well(run(*words, "-o", "out.glb", "--picture", "p.png"))
    assert all(panel.appearance is not None and panel.appearance.textured for panel in drawn.panels)
    well(run(*words, "-o", "out.ply", "--picture", "p.png"))
    assert drawn.panels[1].appearance is not None
    assert not drawn.panels[1].appearance.textured


def test_what_is_turned_upright_in_its_file_is_drawn_as_the_target_stands(
    run: Run,
    pair: Path,  # noqa: F811
    drawn: Drawn,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quarter = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    monkeypatch.setattr("meshmatch.api.texture.turn_upright", lambda *_: quarter)
    write_square_obj(pair / "square.obj")
    square = load_shape("square.obj")
    (pair / "square.mtl").write_text("newmtl paint\nmap_Kd skin.png\n")
    (pair / "skin.png").write_bytes(encoded(quarters(8)))
    save_shape("plain.ply", square)
    np.save("same.npy", np.arange(4))
    words = ("transfer-texture", "square.obj", "plain.ply", "--map", "same.npy", "--size", "64")
    well(run(*words, "-o", "out.glb", "--picture", "p.png"))
    assert np.abs(load_shape("out.glb").bounds - square.bounds).max() > 0.1
    assert drawn.panels[1].shape.bounds == pytest.approx(square.bounds, abs=1e-6)


def test_after_a_match_shapes_are_turned_as_their_fits_say(
    run: Run,
    pair: Path,  # noqa: F811
    drawn: Drawn,
    stub: FakeMatching,
) -> None:
    from meshmatch.geometry.frames import Frame
    from meshmatch.maps.mapped_mesh import invert_map

    turns = iter((np.eye(3), np.diag([-1.0, 1.0, -1.0])))
    forward = load_map("ab.npz", load_shape("a.ply"), load_shape("b.ply"))
    back = invert_map(forward, load_shape("a.ply"), load_shape("b.ply"))
    stub.make_map = lambda a, b, **about: forward if a.name == "a.ply" else back
    stub.make_fit = lambda shape, *_: fake_fit(shape, frame=Frame(1.0, next(turns), np.zeros(3)))
    words = call("color --picture p.png")
    at = words.index("--map")
    well(run(*words[:at], *words[at + 2 :]))
    for panel, rotation in zip(drawn.panels, (np.eye(3), np.diag([-1.0, 1.0, -1.0])), strict=True):
        assert np.array_equal(panel.rotation, rotation)
