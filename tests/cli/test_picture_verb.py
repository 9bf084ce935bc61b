"""`picture` draws what was asked for, and says what cannot be."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

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
from tests.cli.conftest import FakeMatching, Run, fake_fit, refused, well
from tests.shapes.painted import encoded, quarters, write_square_obj

V = 642


@pytest.fixture
def files(two: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of a.ply, b.ply and c.ply, which is the first in another order; a map from a to c, half of it unsure; and
    files to do right and wrong things with.
    """
    folder = two[0].parent
    monkeypatch.chdir(folder)
    shape = load_shape("a.ply")
    place = np.argsort(np.random.default_rng(0).permutation(V))
    save_shape("c.ply", Shape(shape.verts[np.argsort(place)], place[shape.faces]))
    confidence = np.where(shape.verts[:, 0] > 0, 1.0, 0.25)
    save_map("map.npz", VertexMap.between(shape, load_shape("c.ply"), place, confidence=confidence))
    arrays = {"truth": place, "all": np.arange(V), "v": np.arange(float(V)), "seven": np.zeros(7)}
    arrays |= {"wide": np.full((V, 2), 0.5), "loud": np.full((V, 3), 2.0), "fine": np.zeros((V, 3))}
    for name, array in arrays.items():
        np.save(f"{name}.npy", array)
    Path("empty.txt").write_text("")
    return folder


class Drawn:
    """Draws with a renderer that only keeps what it is given."""

    def __init__(self, run: Run) -> None:
        self.run = run

    def render(self, panels: Any, path: Path, look: Look) -> tuple[int, int]:
        self.panels: list[Panel] = list(panels)
        self.look = look
        path.write_bytes(b"a picture")
        return look.size or (7, 5)

    def __call__(self, words: str) -> dict[str, Any]:
        """What is told of a picture that went well."""
        answer = well(self.run("picture", *words.split(), "-o", "o.png", "--json"))
        self.err = answer.err
        return answer.record

    @property
    def names(self) -> list[str]:
        return [panel.label for panel in self.panels]

    @property
    def scale(self) -> Scale:
        assert isinstance(self.look.legend, Scale)
        return self.look.legend

    @property
    def swatches(self) -> Swatches:
        assert isinstance(self.look.legend, Swatches)
        return self.look.legend


@pytest.fixture
def drawn(run: Run, files: Path, monkeypatch: pytest.MonkeyPatch) -> Drawn:
    recorder = Drawn(run)
    monkeypatch.setattr(drawing, "render_shapes", recorder.render)
    return recorder


def test_a_picture_of_a_shape(run: Run, files: Path) -> None:
    answer = well(run("picture", "a.ply", "-o", "out.png", "--size", "96x80", "--json"))
    assert answer.err.splitlines() == ["drew out.png: 1 shape (96 x 80 pixels)"]
    expected = {"output": "out.png", "shapes": ["a.ply"], "width": 96, "height": 80, "shows": "1 shape"}
    assert answer.record == expected
    with Image.open("out.png") as image:
        picture = np.asarray(image)
    assert picture.shape[:2] == (80, 96)
    assert tuple(picture[0, 0]) == (255, 255, 255)
    assert picture[30, 48].max() < 250


@pytest.mark.parametrize(
    ("words", "look", "names"),
    [
        ("", Look(), ["a.ply", "b.ply"]),
        (
            "--view back --up z --front -x --size 300x200 --background dark --no-ground --no-names",
            Look((300, 200), "dark", "z", "-x", 180.0, 8.0, False),
            ["", ""],
        ),
        ("--name one --name two", Look(), ["one", "two"]),
    ],
)
def test_options_of_the_look(drawn: Drawn, words: str, look: Look, names: list[str]) -> None:
    drawn(f"a.ply b.ply {words}")
    assert (drawn.look, drawn.names) == (look, names)


def test_files_of_one_name_are_told_apart(drawn: Drawn) -> None:
    Path("other").mkdir()
    Path("other/a.ply").write_bytes(Path("a.ply").read_bytes())
    drawn("a.ply other/a.ply b.ply")
    assert drawn.names == ["a.ply", "other/a.ply", "b.ply"]
    drawn("a.ply a.ply")
    assert drawn.names == ["a.ply", "a.ply"]


def test_numbers_become_heat_on_one_scale(drawn: Drawn) -> None:
    values = np.linspace(0, 3, V)
    values[5] = np.nan
    np.save("a.npy", values)
    Path("b.csv").write_text("vertex,heat\n" + "\n".join(f"{k},{k / 200}" for k in range(1600)))
    assert drawn("a.ply b.ply --values a.npy --values b.csv")["range"] == [0, 8]
    assert (drawn.scale.low, drawn.scale.high, drawn.scale.title, drawn.scale.unknown) == (0, 8, "a", True)
    assert np.array_equal(drawn.panels[0].colors, drawn.scale.colors(values))
    assert tuple(np.asarray(drawn.panels[0].colors)[5]) == UNKNOWN
    drawn("a.ply --values v.npy --title error --range -1 2")
    assert drawn.look.legend == Scale(-1, 2, "error", beyond=(False, True))


def test_three_numbers_are_a_color(drawn: Drawn) -> None:
    colors = np.random.default_rng(0).random((V, 3))
    np.save("colors.npy", colors)
    drawn("a.ply --values colors.npy")
    assert np.array_equal(drawn.panels[0].colors, colors)
    assert drawn.look.legend is None


def test_a_label_has_one_color_on_all_shapes(drawn: Drawn) -> None:
    Path("l.txt").write_text("\n".join(["head"] * 600 + ["arm"] * 42))
    faces = load_shape("b.ply").F
    Path("f.json").write_text(json.dumps({"on": "faces", "labels": ["leg"] * (faces - 5) + ["head"] * 5}))
    assert drawn("a.ply b.ply --labels l.txt --labels f.json")["labels"] == ["arm", "head", "leg"]
    assert drawn.swatches.names == ("arm", "head", "leg")
    one, other = drawn.panels
    assert one.sharp
    assert np.asarray(one.colors)[0] == pytest.approx(drawn.swatches.colors[1])
    assert np.asarray(other.face_colors)[[-1, 0]] == pytest.approx(np.asarray(drawn.swatches.colors)[[1, 2]])


def test_what_labels_belong_to_can_be_said(drawn: Drawn) -> None:
    save_shape("t.ply", Shape(np.eye(4, 3), np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])))
    np.save("l.npy", np.array([2, -1, 10, 2]))
    assert drawn.run("picture", "t.ply", "--labels", "l.npy", "-o", "o.png").status == 1
    drawn("t.ply --labels l.npy --on faces")
    assert drawn.panels[0].colors is None
    assert drawn.swatches.names == ("-1", "2", "10")
    drawn("t.ply --labels l.npy --on vertices")
    assert drawn.panels[0].face_colors is None


def test_a_map_as_colors(drawn: Drawn) -> None:
    drawn("a.ply c.ply --map map.npz")
    assert "corresponding points in the same color" in drawn.err
    one, other = drawn.panels
    assert np.asarray(other.colors)[np.load("truth.npy")] == pytest.approx(np.asarray(one.colors))
    assert drawn.names == ["a.ply", "c.ply"]


def test_the_confidence_of_a_map(drawn: Drawn) -> None:
    assert 0.5 < drawn("a.ply c.ply --map map.npz --confidence")["confidence_mean"] < 0.75
    assert drawn.scale.reverse and "confidence" in drawn.scale.title


@pytest.mark.parametrize("known", ["--truth truth.npy", "--points all.npy truth.npy"])
def test_the_errors_of_a_map(drawn: Drawn, known: str) -> None:
    record = drawn(f"a.ply c.ply --map map.npz {known}")
    assert (record["points"], record["mean_cm"]) == (V, 0.0)
    assert "unit of the file" in drawn.scale.title and record["unit"] == "file"
    drawn(f"a.ply c.ply --map map.npz {known} --unit x100 --range 0 9")
    assert (drawn.scale.high, "sqrt(area)" in drawn.scale.title) == (9, True)


def test_a_registered_mesh_over_its_shape(drawn: Drawn) -> None:
    shape = load_shape("a.ply")
    save_shape("fitted.ply", Shape(1.5 * shape.verts, shape.faces))
    assert drawn("a.ply --fit fitted.ply --range 0 1")["distance_mean"] == pytest.approx(0.5, abs=0.01)
    assert drawn.panels[0].over is not None
    assert np.array_equal(drawn.panels[0].over.verts, load_shape("fitted.ply").verts)
    assert np.asarray(drawn.panels[1].colors) == pytest.approx(drawn.scale.colors(np.full(V, 0.5)), abs=0.03)
    assert drawn.scale.high == 1


def test_a_model_is_fitted_to_the_shape_first(drawn: Drawn, stub: FakeMatching) -> None:
    turn = np.diag([-1.0, 1, -1])
    stub.make_fit = lambda shape, *_: replace(
        fake_fit(shape, frame=Frame(1.0, turn, np.zeros(3))), points=shape.verts @ turn, faces=shape.faces
    )
    drawn("a.ply --fit human --up y --front -z --seed 3")
    assert "good fit, up +y, front -z" in drawn.err
    assert stub.called["config"] == FitConfig(seed=3, up="y", front="-z")
    assert np.array_equal(drawn.panels[0].rotation, turn)


@pytest.mark.parametrize(
    "what",
    ["human-T", "human", bundled_folder() / "human" / "human-A.safetensors", bundled_folder() / "models" / "human"],
)
def test_templates_and_models_show_their_nodes(drawn: Drawn, what: object) -> None:
    drawn(f"{what}")
    (panel,) = drawn.panels
    assert panel.glass and panel.points is not None
    assert f"{len(np.asarray(panel.points))} nodes" in panel.label
    drawn(f"{what} --plain")
    assert drawn.panels[0].points is None


def test_a_file_comes_before_a_template_of_the_same_name(run: Run, files: Path) -> None:
    Path("human-T").write_text("x")
    refused(run("picture", "human-T", "-o", "o.png"), "no suffix", files, set(os.listdir(files)))


def test_a_texture_is_shown_unless_plain(drawn: Drawn) -> None:
    write_square_obj(Path("square.obj"))
    Path("square.mtl").write_text("newmtl paint\nmap_Kd skin.png\n")
    Path("skin.png").write_bytes(encoded(quarters(8)))
    drawn("square.obj")
    assert drawn.panels[0].appearance is not None
    drawn("square.obj --plain")
    assert drawn.panels[0].appearance is None


@pytest.mark.parametrize(("lost", "word"), [("square.mtl", "square.mtl"), ("p.png", "the image p.png")])
@pytest.mark.parametrize("colored", [False, True])
def test_a_shape_is_drawn_where_its_texture_is_lost(drawn: Drawn, lost: str, word: str, colored: bool) -> None:
    write_square_obj(Path("a.obj"), vt=True)
    Path("square.mtl").write_text("newmtl paint\nmap_Kd p.png\n")
    Path("p.png").write_bytes(encoded(quarters()))
    if colored:
        rows = [f"{row} 1 0 0" if row.startswith("v ") else row for row in Path("a.obj").read_text().splitlines()]
        Path("a.obj").write_text("\n".join(rows) + "\n")
    Path(lost).unlink()
    drawn("a.obj")
    assert (drawn.panels[0].appearance is not None) == colored
    if not (colored and lost == "square.mtl"):  # then it wears its colors, without a word
        assert "warning: a.obj is shown without its" in drawn.err and word in drawn.err
    assert drawn.run("picture", "a.obj", "--image", lost, "-o", "p3.png").status == 1


def test_another_image(run: Run, files: Path) -> None:
    write_square_obj(Path("square.obj"), mtl=None)
    Path("other.png").write_bytes(encoded(quarters(8)))
    words = "square.obj --image other.png --view front --up y --front z --no-names --size 96x80 -o o.png"
    well(run("picture", *words.split()))
    with Image.open("o.png") as image:
        picture = np.asarray(image, dtype=int)
    red, green, blue, white = picture[24, 32], picture[24, 64], picture[56, 32], picture[56, 64]
    assert red[0] > 2 * red[1:].max()
    assert green[1] > 2 * green[[0, 2]].max()
    assert blue[2] > 2 * blue[:2].max()
    assert np.ptp(white) < 12


BAD: list[tuple[str, str]] = [
    ("a.ply -o o.jpg", "a picture is a PNG"),
    ("a.ply -o a.ply", "a picture is a PNG"),
    ("a.ply -o nowhere/o.png", "there is no folder"),
    ("gone.ply", "there is no file"),
    ("gone", "there is no file"),
    ("v.npy", "v.npy"),
    ("a.ply --size 12", "invalid size"),
    ("a.ply --size 12x", "invalid size"),
    ("a.ply --size ax9", "invalid size"),
    ("a.ply --size -5x9", "invalid size"),
    ("a.ply --size 1e9x2", "invalid size"),
    ("a.ply --size 99999x99999", "too large"),
    ("a.ply --size 8000x8000", "too large"),
    ("a.ply --size 99999999999999999999x9", "too large"),
    ("a.ply --size 3x3", "shows nothing"),
    ("a.ply --background mauve", "invalid background"),
    ("a.ply --up y --front -y", "lie along one axis"),
    ("a.ply b.ply --name one", "2 shapes need 2 names"),
    ("a.ply --map map.npz", "a map is of two shapes"),
    ("a.ply c.ply b.ply --map map.npz", "a map is of two shapes"),
    ("c.ply a.ply --map map.npz", "wrong way"),
    ("a.ply b.ply --map map.npz", "another target"),
    ("a.ply c.ply --map gone.npz", "no file"),
    ("a.ply c.ply --confidence", "needs a map"),
    ("a.ply c.ply --truth truth.npy", "need a map"),
    ("a.ply c.ply --map map.npz --confidence --truth truth.npy", "both color"),
    ("a.ply c.ply --map map.npz --truth truth.npy --points truth.npy truth.npy", "both give the ground truth"),
    ("a.ply c.ply --map map.npz --truth seven.npy", "seven.npy"),
    ("a.ply c.ply --map map.npz --values v.npy", "do not go together"),
    ("a.ply c.ply --map map.npz --plain", "do not go together"),
    ("a.ply --values v.npy --labels v.npy", "do not go together"),
    ("a.ply --plain --image x.png", "do not go together"),
    ("a.ply --values seven.npy", "has 7 rows"),
    ("a.ply --values wide.npy", "2 numbers per vertex"),
    ("a.ply --values loud.npy", "3 numbers per vertex"),
    ("a.ply --values fine.npy --title x", "colors have no scale"),
    ("a.ply --values gone.npy", "no file"),
    ("a.ply b.ply --values v.npy", "--values 2 times"),
    ("a.ply --values v.npy --range 2 1", "cannot run from 2 to 1"),
    ("a.ply --values v.npy --range nan 1", "cannot run"),
    ("a.ply --values v.npy --range -1e308 1e308", "cannot run"),
    ("a.ply --values v.npy --range 0 1e308", "cannot run"),
    ("a.ply --range 0 1", "needs a color scale"),
    ("a.ply --title x", "--title needs"),
    ("a.ply --on faces", "--on needs"),
    ("a.ply --labels seven.npy", "7 labels"),
    ("a.ply --labels empty.txt", "empty.txt"),
    ("a.ply b.ply --labels v.npy", "need --labels 2 times"),
    ("a.ply b.ply --fit c.ply", "for one shape"),
    ("a.ply --fit gone.ply", "there is no file"),
    ("a.ply --fit humna", "no model"),
    ("a.ply b.ply --image x.png", "for one shape"),
    ("a.ply --image x.png", "x.png"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "told"), BAD, ids=[words for words, _ in BAD])
def test_what_cannot_be_is_a_line_and_a_hint(run: Run, files: Path, words: str, told: str) -> None:
    output = [] if "-o" in words.split() else ["-o", "o.png"]
    refused(run("picture", *words.split(), *output), told, files, set(os.listdir(files)))


def test_a_picture_that_fails_leaves_what_was_there(run: Run, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("o.png").write_bytes(b"before")

    def failing(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(drawing, "render_shapes", failing)
    before = sorted(os.listdir(files))
    assert run("picture", "a.ply", "-o", "o.png").status == 130
    assert sorted(os.listdir(files)) == before
    assert Path("o.png").read_bytes() == b"before"


@pytest.mark.parametrize(
    "words",
    [
        *("a.ply c.ply --map o.png", "a.ply c.ply --map map.npz --truth o.png", "a.ply --values o.png"),
        *("a.ply c.ply --map map.npz --points o.png truth.npy", "a.ply c.ply --map map.npz --points truth.npy o.png"),
        *("a.ply --labels o.png", "a.ply --fit o.png", "a.ply --image o.png"),
    ],
)
def test_no_file_that_is_read_is_drawn_over(run: Run, files: Path, words: str) -> None:
    Path("o.png").write_bytes(b"before")
    answer = run("picture", *words.split(), "-o", "o.png")
    refused(answer, "is an input of this command", files, set(os.listdir(files)))
