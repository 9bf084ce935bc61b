"""`picture` draws what was asked for, and says what cannot be."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from meshmatch.cli.picture import PictureOptions
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.frames import Frame
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render import compose as drawing
from meshmatch.render.figures import Panel
from meshmatch.render.picture import Look
from meshmatch.render.scales import Scale, Swatches
from meshmatch.shapes.colors import UNKNOWN
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from tests.cli.conftest import FakeMatching, Run, fake_fit, refused
from tests.shapes.painted import encoded, quarters, write_square_obj

V = 642
SMALL = ("--size", "96x80")


class Drawn:
    """Stands for the renderer: keeps what it was given."""

    def __init__(self) -> None:
        self.panels: list[Panel] = []
        self.look = Look()

    def __call__(self, panels: Any, path: Path, look: Look) -> tuple[int, int]:
        self.panels, self.look = list(panels), look
        path.write_bytes(b"a picture")
        return look.size or (7, 5)

    @property
    def names(self) -> list[str]:
        return [panel.label for panel in self.panels]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    recorder = Drawn()
    monkeypatch.setattr(drawing, "render_shapes", recorder)
    return recorder


@pytest.fixture
def turned_map(two: tuple[Path, Path]) -> tuple[Path, Path, Path]:
    """A map from a.ply to c.ply, the same ball in another order, half of it unsure."""
    shape = load_shape(two[0])
    order = np.random.default_rng(0).permutation(V)
    place = np.argsort(order)
    other = two[0].with_name("c.ply")
    save_shape(other, Shape(shape.verts[order], place[shape.faces]))
    confidence = np.where(shape.verts[:, 0] > 0, 1.0, 0.25)
    found = VertexMap.between(shape, load_shape(other), place, confidence=confidence)
    save_map(two[0].with_name("map.npz"), found)
    np.save(two[0].with_name("truth.npy"), place)
    return two[0].with_name("map.npz"), two[0], other


def test_a_picture_of_a_shape(run: Run, two: tuple[Path, Path]) -> None:
    out = two[0].with_name("out.png")
    answer = run("picture", two[0], "-o", out, *SMALL, "--json")
    assert answer.status == 0
    assert answer.err.splitlines() == [f"drew {out}: 1 shape (96 x 80 pixels)"]
    record = json.loads(answer.out)
    assert (record["output"], record["shapes"]) == (str(out), [str(two[0])])
    assert (record["width"], record["height"], record["shows"]) == (96, 80, "1 shape")
    with Image.open(out) as image:
        assert image.size == (96, 80)
        picture = np.asarray(image)
    assert tuple(picture[0, 0]) == (255, 255, 255)
    assert picture[30, 48].max() < 250


def test_options_of_the_look(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    out = two[0].with_name("out.png")
    assert run("picture", *two, "-o", out).status == 0
    assert (drawn.look, drawn.names) == (Look(), ["a.ply", "b.ply"])
    words = ("--view", "back", "--up", "z", "--front", "-x", "--size", "300x200", "--background", "dark")
    assert run("picture", *two, "-o", out, *words, "--no-ground", "--no-names").status == 0
    assert drawn.look == Look((300, 200), "dark", "z", "-x", 180.0, 8.0, False)
    assert drawn.names == ["", ""]
    assert run("picture", *two, "-o", out, "--name", "one", "--name", "two").status == 0
    assert drawn.names == ["one", "two"]


def test_files_of_one_name_are_told_apart(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    other = two[0].parent / "other" / "a.ply"
    other.parent.mkdir()
    other.write_bytes(two[0].read_bytes())
    assert run("picture", two[0], other, two[1], "-o", two[0].with_name("out.png")).status == 0
    assert drawn.names == [str(two[0]), str(other), "b.ply"]
    assert run("picture", two[0], two[0], "-o", two[0].with_name("out.png")).status == 0
    assert drawn.names == ["a.ply", "a.ply"]


def test_numbers_become_heat_on_one_scale(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    a, b, out = two[0].with_name("a.npy"), two[0].with_name("b.csv"), two[0].with_name("out.png")
    np.save(a, np.linspace(0, 3, V))
    b.write_text("vertex,heat\n" + "\n".join(f"{k},{k / 200}" for k in range(1600)))
    answer = run("picture", *two, "--values", a, "--values", b, "-o", out, "--json")
    assert answer.status == 0, answer.err
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert (scale.low, scale.high, scale.title) == (0, 8, "a")
    assert json.loads(answer.out)["range"] == [0, 8]
    assert np.array_equal(drawn.panels[0].colors, scale.colors(np.linspace(0, 3, V)))
    words = ("--title", "error (mm)", "--range", "-1", "2")
    assert run("picture", two[0], "--values", a, "-o", out, *words).status == 0
    assert drawn.look.legend == Scale(-1, 2, "error (mm)", beyond=(False, True))


def test_three_numbers_are_a_color(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    colors = np.random.default_rng(0).random((V, 3))
    np.save(two[0].with_name("c.npy"), colors)
    assert run("picture", two[0], "--values", two[0].with_name("c.npy"), "-o", two[0].with_name("o.png")).status == 0
    assert np.array_equal(drawn.panels[0].colors, colors)
    assert drawn.look.legend is None


def test_a_label_has_one_color_on_all_shapes(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    here, there, out = two[0].with_name("l.txt"), two[0].with_name("f.json"), two[0].with_name("out.png")
    here.write_text("\n".join(["head"] * 600 + ["arm"] * 42))
    faces = load_shape(two[1]).F
    there.write_text(json.dumps({"on": "faces", "labels": ["leg"] * (faces - 5) + ["head"] * 5}))
    answer = run("picture", *two, "--labels", here, "--labels", there, "-o", out, "--json")
    assert answer.status == 0, answer.err
    assert json.loads(answer.out)["labels"] == ["arm", "head", "leg"]
    legend = drawn.look.legend
    assert isinstance(legend, Swatches)
    assert legend.names == ("arm", "head", "leg")
    one, other = drawn.panels
    assert one.sharp
    assert np.asarray(one.colors)[0] == pytest.approx(legend.colors[1])
    assert np.asarray(other.face_colors)[-1] == pytest.approx(legend.colors[1])
    assert np.asarray(other.face_colors)[0] == pytest.approx(legend.colors[2])


def test_what_labels_belong_to_can_be_said(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    tetra = two[0].with_name("t.ply")
    save_shape(tetra, Shape(np.eye(4, 3), np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])))
    np.save(two[0].with_name("l.npy"), np.array([2, -1, 10, 2]))
    words = ("picture", tetra, "--labels", two[0].with_name("l.npy"), "-o", two[0].with_name("o.png"))
    assert run(*words).status == 1
    assert run(*words, "--on", "faces").status == 0
    assert drawn.panels[0].colors is None
    legend = drawn.look.legend
    assert isinstance(legend, Swatches)
    assert legend.names == ("-1", "2", "10")
    assert run(*words, "--on", "vertices").status == 0
    assert drawn.panels[0].face_colors is None


def test_a_map_as_colors(run: Run, turned_map: tuple[Path, Path, Path], drawn: Drawn) -> None:
    found, a, c = turned_map
    answer = run("picture", a, c, "--map", found, "-o", a.with_name("o.png"))
    assert answer.status == 0, answer.err
    assert "matched places in one color" in answer.err
    one, other = drawn.panels
    assert np.asarray(other.colors)[np.load(a.with_name("truth.npy"))] == pytest.approx(np.asarray(one.colors))
    assert [one.label, other.label] == ["a.ply", "c.ply"]


def test_the_confidence_of_a_map(run: Run, turned_map: tuple[Path, Path, Path], drawn: Drawn) -> None:
    found, a, c = turned_map
    answer = run("picture", a, c, "--map", found, "--confidence", "-o", a.with_name("o.png"), "--json")
    assert 0.5 < json.loads(answer.out)["confidence_mean"] < 0.75
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert scale.reverse
    assert "confidence" in scale.title


@pytest.mark.parametrize("form", ["truth", "points"])
def test_the_errors_of_a_map(run: Run, turned_map: tuple[Path, Path, Path], drawn: Drawn, form: str) -> None:
    found, a, c = turned_map
    truth = a.with_name("truth.npy")
    np.save(a.with_name("all.npy"), np.arange(V))
    known = ("--truth", truth) if form == "truth" else ("--points", a.with_name("all.npy"), truth)
    words = ("picture", a, c, "--map", found, *known, "-o", a.with_name("o.png"), "--json")
    record = json.loads(run(*words).out)
    assert (record["points"], record["mean_cm"]) == (V, 0.0)
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert "cm" in scale.title
    assert run(*words, "--unit", "x100", "--range", "0", "9").status == 0
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert (scale.high, "sqrt(area)" in scale.title) == (9, True)


def test_a_registered_mesh_over_its_shape(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    shape = load_shape(two[0])
    over = two[0].with_name("fitted.ply")
    save_shape(over, Shape(1.5 * shape.verts, shape.faces))
    answer = run("picture", two[0], "--fit", over, "-o", two[0].with_name("o.png"), "--json", "--range", "0", "1")
    assert answer.status == 0, answer.err
    assert json.loads(answer.out)["distance_mean"] == pytest.approx(0.5, abs=0.01)
    assert drawn.panels[0].over is not None
    assert np.array_equal(drawn.panels[0].over.verts, load_shape(over).verts)
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert np.asarray(drawn.panels[1].colors) == pytest.approx(scale.colors(np.full(V, 0.5)), abs=0.03)
    assert scale.high == 1


def test_a_model_is_fitted_to_the_shape_first(
    run: Run, two: tuple[Path, Path], drawn: Drawn, stub: FakeMatching
) -> None:
    turn = np.diag([-1.0, 1, -1])
    stub.make_fit = lambda shape, *_: replace(
        fake_fit(shape, frame=Frame(1.0, turn, np.zeros(3))), points=shape.verts @ turn, faces=shape.faces
    )
    words = ("--up", "y", "--front", "-z", "--seed", "3")
    answer = run("picture", two[0], "--fit", "human", "-o", two[0].with_name("o.png"), *words)
    assert answer.status == 0, answer.err
    assert "good fit, up +y, front -z" in answer.err
    assert stub.called["config"] == FitConfig(seed=3, up="y", front="-z")
    assert np.array_equal(drawn.panels[0].rotation, turn)


@pytest.mark.parametrize(
    "what",
    ["human-T", "human", bundled_folder() / "human" / "human-A.safetensors", bundled_folder() / "models" / "human"],
)
def test_templates_and_models_show_their_nodes(run: Run, two: tuple[Path, Path], drawn: Drawn, what: object) -> None:
    answer = run("picture", what, "-o", two[0].with_name("o.png"))
    assert answer.status == 0, answer.err
    (panel,) = drawn.panels
    assert panel.glass
    assert panel.points is not None
    assert f"{len(np.asarray(panel.points))} nodes" in panel.label
    assert run("picture", what, "-o", two[0].with_name("o.png"), "--plain").status == 0
    assert drawn.panels[0].points is None


def test_a_file_comes_before_a_template_of_the_same_name(
    run: Run, two: tuple[Path, Path], drawn: Drawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(two[0].parent)
    Path("human-T").write_text("x")
    answer = run("picture", "human-T", "-o", "o.png")
    assert answer.status == 1
    assert "no suffix" in answer.err


def test_a_texture_is_shown_unless_plain(run: Run, tmp_path: Path, drawn: Drawn) -> None:
    write_square_obj(tmp_path / "square.obj")
    (tmp_path / "square.mtl").write_text("newmtl paint\nmap_Kd skin.png\n")
    (tmp_path / "skin.png").write_bytes(encoded(quarters(8)))
    out = tmp_path / "o.png"
    assert run("picture", tmp_path / "square.obj", "-o", out).status == 0
    assert drawn.panels[0].appearance is not None
    assert run("picture", tmp_path / "square.obj", "-o", out, "--plain").status == 0
    assert drawn.panels[0].appearance is None


@pytest.mark.parametrize(("lost", "word"), [("square.mtl", "square.mtl"), ("p.png", "the image p.png")])
@pytest.mark.parametrize("colored", [False, True])
def test_a_shape_is_drawn_where_its_texture_is_lost(
    run: Run, tmp_path: Path, drawn: Drawn, lost: str, word: str, colored: bool
) -> None:
    write_square_obj(tmp_path / "a.obj", vt=True)
    (tmp_path / "square.mtl").write_text("newmtl paint\nmap_Kd p.png\n")
    (tmp_path / "p.png").write_bytes(encoded(quarters()))
    if colored:
        text = (tmp_path / "a.obj").read_text()
        rows = [f"{row} 1 0 0" if row.startswith("v ") else row for row in text.splitlines()]
        (tmp_path / "a.obj").write_text("\n".join(rows) + "\n")
    (tmp_path / lost).unlink()
    answer = run("picture", tmp_path / "a.obj", "-o", tmp_path / "p2.png", *SMALL)
    assert answer.status == 0
    look = drawn.panels[0].appearance
    assert (look is not None) == colored
    if not (colored and lost == "square.mtl"):  # then it wears its colors, without a word
        assert "warning: a.obj is shown without its" in answer.err and word in answer.err
    assert run("picture", tmp_path / "a.obj", "--image", tmp_path / lost, "-o", tmp_path / "p3.png").status == 1


def test_another_image(run: Run, tmp_path: Path) -> None:
    write_square_obj(tmp_path / "square.obj", mtl=None)
    (tmp_path / "other.png").write_bytes(encoded(quarters(8)))
    out = tmp_path / "o.png"
    words = ("--view", "front", "--up", "y", "--front", "z", "--no-names", *SMALL)
    assert run("picture", tmp_path / "square.obj", "--image", tmp_path / "other.png", "-o", out, *words).status == 0
    with Image.open(out) as image:
        picture = np.asarray(image, dtype=int)
    red, green, blue, white = picture[24, 32], picture[24, 64], picture[56, 32], picture[56, 64]
    assert red[0] > 2 * red[1:].max()
    assert green[1] > 2 * green[[0, 2]].max()
    assert blue[2] > 2 * blue[:2].max()
    assert np.ptp(white) < 12


@pytest.fixture
def files(turned_map: tuple[Path, Path, Path]) -> Path:
    """A folder of files to do wrong things with."""
    folder = turned_map[0].parent
    np.save(folder / "seven.npy", np.zeros(7))
    np.save(folder / "wide.npy", np.full((V, 2), 0.5))
    np.save(folder / "loud.npy", np.full((V, 3), 2.0))
    np.save(folder / "fine.npy", np.zeros((V, 3)))
    np.save(folder / "v.npy", np.arange(float(V)))
    (folder / "empty.txt").write_text("")
    return folder


BAD: list[tuple[str, str]] = [
    ("a.ply -o o.jpg", "a picture is a PNG"),
    ("a.ply -o a.ply", "a picture is a PNG"),
    ("a.ply -o nowhere/o.png", "there is no folder"),
    ("gone.ply -o o.png", "there is no file"),
    ("gone -o o.png", "there is no file"),
    ("v.npy -o o.png", "v.npy"),
    ("a.ply -o o.png --size 12", "invalid size"),
    ("a.ply -o o.png --size 12x", "invalid size"),
    ("a.ply -o o.png --size ax9", "invalid size"),
    ("a.ply -o o.png --size -5x9", "invalid size"),
    ("a.ply -o o.png --size 1e9x2", "invalid size"),
    ("a.ply -o o.png --size 99999x99999", "too large"),
    ("a.ply -o o.png --size 8000x8000", "too large"),
    ("a.ply -o o.png --size 99999999999999999999x9", "too large"),
    ("a.ply -o o.png --size 3x3", "shows nothing"),
    ("a.ply -o o.png --background mauve", "invalid background"),
    ("a.ply -o o.png --up y --front -y", "lie along one axis"),
    ("a.ply b.ply -o o.png --name one", "2 shapes need 2 names"),
    ("a.ply -o o.png --map map.npz", "a map is of two shapes"),
    ("a.ply c.ply b.ply -o o.png --map map.npz", "a map is of two shapes"),
    ("c.ply a.ply -o o.png --map map.npz", "wrong way"),
    ("a.ply b.ply -o o.png --map map.npz", "another target"),
    ("a.ply c.ply -o o.png --map gone.npz", "no file"),
    ("a.ply c.ply -o o.png --confidence", "needs a map"),
    ("a.ply c.ply -o o.png --truth truth.npy", "need a map"),
    ("a.ply c.ply -o o.png --map map.npz --confidence --truth truth.npy", "both color"),
    ("a.ply c.ply -o o.png --map map.npz --truth truth.npy --points truth.npy truth.npy", "both give the ground truth"),
    ("a.ply c.ply -o o.png --map map.npz --truth seven.npy", "seven.npy"),
    ("a.ply c.ply -o o.png --map map.npz --values v.npy", "do not go together"),
    ("a.ply c.ply -o o.png --map map.npz --plain", "do not go together"),
    ("a.ply -o o.png --values v.npy --labels v.npy", "do not go together"),
    ("a.ply -o o.png --plain --image x.png", "do not go together"),
    ("a.ply -o o.png --values seven.npy", "has 7 rows"),
    ("a.ply -o o.png --values wide.npy", "2 numbers per vertex"),
    ("a.ply -o o.png --values loud.npy", "3 numbers per vertex"),
    ("a.ply -o o.png --values fine.npy --title x", "colors have no scale"),
    ("a.ply -o o.png --values gone.npy", "no file"),
    ("a.ply b.ply -o o.png --values v.npy", "need --values 2 times"),
    ("a.ply -o o.png --values v.npy --range 2 1", "cannot run from 2 to 1"),
    ("a.ply -o o.png --values v.npy --range nan 1", "cannot run"),
    ("a.ply -o o.png --range 0 1", "needs a color scale"),
    ("a.ply -o o.png --title x", "--title needs"),
    ("a.ply -o o.png --on faces", "--on needs"),
    ("a.ply -o o.png --labels seven.npy", "7 labels"),
    ("a.ply -o o.png --labels empty.txt", "empty.txt"),
    ("a.ply b.ply -o o.png --labels v.npy", "need --labels 2 times"),
    ("a.ply b.ply -o o.png --fit c.ply", "for one shape"),
    ("a.ply -o o.png --fit gone.ply", "there is no file"),
    ("a.ply -o o.png --fit humna", "no model"),
    ("a.ply b.ply -o o.png --image x.png", "for one shape"),
    ("a.ply -o o.png --image x.png", "x.png"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "told"), BAD, ids=[words for words, _ in BAD])
def test_what_cannot_be_is_a_line_and_a_hint(
    run: Run, files: Path, monkeypatch: pytest.MonkeyPatch, words: str, told: str
) -> None:
    monkeypatch.chdir(files)
    refused(run("picture", *words.split()), told, files, set(os.listdir(files)))


def test_a_picture_that_fails_leaves_what_was_there(run: Run, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = files / "o.png"
    out.write_bytes(b"before")

    def failing(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(drawing, "render_shapes", failing)
    before = sorted(os.listdir(files))
    assert run("picture", files / "a.ply", "-o", out).status == 130
    assert sorted(os.listdir(files)) == before
    assert out.read_bytes() == b"before"


def test_all_files_that_are_read_are_guarded() -> None:
    asked = PictureOptions(
        map=Path("m"),
        truth=Path("t"),
        points=(Path("p"), Path("q")),
        values=[Path("v")],
        labels=[Path("l")],
        fit="f",
        image=Path("i"),
    )
    assert {str(path) for path in asked.files} == {"m", "t", "p", "q", "v", "l", "f", "i"}


def test_an_unknown_value_is_grey(run: Run, two: tuple[Path, Path], drawn: Drawn) -> None:
    values = np.arange(float(V))
    values[5] = np.nan
    np.save(two[0].with_name("v.npy"), values)
    assert run("picture", two[0], "--values", two[0].with_name("v.npy"), "-o", two[0].with_name("o.png")).status == 0
    assert tuple(np.asarray(drawn.panels[0].colors)[5]) == UNKNOWN
    scale = drawn.look.legend
    assert isinstance(scale, Scale)
    assert scale.unknown
