"""From a folder without correspondence to a map, through the program's only door."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshmatch
from meshmatch.api import kinds
from meshmatch.errors import InputError, ModelError
from meshmatch.models.card import read_card, write_card
from meshmatch.shapes.files import save_shape
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.training import recipes
from meshmatch.training.loop import StepReport
from tests.cli.conftest import Run
from tests.conftest import icosphere

FEW = ("--nodes", "60", "--radius", "0.35", "--strategy", "uniform", "-q")
AS_THEY_ARE = ("--align", "none", "--mirror", "no")


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("meshmatch.render.compose.render_shapes", lambda *_: None)


@pytest.fixture
def eggs(tmp_path: Path) -> Path:
    """Three eggs of different connectivity, two of them with a known tip."""
    folder = tmp_path / "eggs"
    folder.mkdir()
    for n, splits in enumerate((2, 3, 2)):
        ball = icosphere(splits)
        shape = Shape(ball.verts * [0.8, 1.4 + 0.1 * n, 1.0], ball.faces)
        save_shape(folder / f"egg{n}.ply", shape)
        if n:
            np.save(folder / f"egg{n}.tip.npy", [int(shape.verts[:, 1].argmax())])
    return folder


def test_prepare_says_what_it_chose_and_what_kind_the_shapes_are(
    run: Run, eggs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[dict[str, Path]] = []
    monkeypatch.setattr(kinds, "kinds_of", lambda files, *_: seen.append(files) or dict.fromkeys(files, "hand"))
    answer = run("prepare", eggs, "-o", tmp_path / "out", *FEW[:-1], "--mirror", "no", "--json")
    record = answer.record
    assert (record["registered"], record["align"], record["scale"], record["landmarks"]) == (0, "rigid", "area", 0)
    assert "which lies nearest to all others" in answer.err
    assert "3 shapes without correspondence" in answer.err
    assert f"the model hand knows these shapes: to begin with it, `meshmatch fit {eggs} -o fits`" in answer.err
    assert any("knows these shapes" in note for note in record["notes"])
    assert list(seen[0]) == record["shapes"]
    assert all(path.is_file() for path in seen[0].values())

    assert run("prepare", eggs, "-o", tmp_path / "out", *FEW, *AS_THEY_ARE).status == 0
    assert len(seen) == 1  # nobody listens, nobody asks

    def refuse(*_: object) -> dict[str, str]:
        raise ModelError("no model is installed", "see `meshmatch models list`")

    monkeypatch.setattr(kinds, "kinds_of", refuse)
    answer = run("prepare", eggs, "-o", tmp_path / "out", *FEW[:-1], *AS_THEY_ARE)
    assert answer.status == 0
    assert "the kinds of these shapes were not read: no model is installed" in answer.err


def test_from_a_folder_to_a_map(run: Run, eggs: Path, tmp_path: Path) -> None:
    assert run("prepare", eggs, "-o", tmp_path / "out", *FEW, *AS_THEY_ARE).status == 0
    answer = run("train", "--shapes", tmp_path / "out", "-o", tmp_path / "mine", "--steps", "3")
    assert answer.status == 0, answer.err
    assert "trained on 3 shapes of out, without correspondence" in answer.err
    card = read_card(tmp_path / "mine" / "card.json")
    assert card.frame == {"orientation": "none", "scale": "area"}
    assert (card.steps, card.category) == (3, "mine")
    assert "without correspondence" in card.data
    answer = run(
        *("match", eggs / "egg0.ply", eggs / "egg1.ply", "-o", tmp_path / "map.npy"),
        *("--model", tmp_path / "mine", "-q"),
    )
    assert answer.status == 0, answer.err
    assert np.load(tmp_path / "map.npy").shape == (162,)


@pytest.mark.slow
def test_from_fits_without_a_model_to_a_map(run: Run, tmp_path: Path) -> None:
    """Shapes are registered to each other first, and what is learned has correspondence."""
    eggs = tmp_path / "eggs"
    eggs.mkdir()
    ball = icosphere(4)
    for n in range(3):
        save_shape(
            eggs / f"egg{n}.ply", Shape(ball.verts[:, np.roll(range(3), n)] * [0.8, 1.4 + 0.1 * n, 1.0], ball.faces)
        )
    answer = run("fit", eggs, "-o", tmp_path / "fits", "--model", "none", "--jobs", "1", "-q")
    assert answer.status == 0, answer.err
    mine = ("-o", tmp_path / "mine", "--steps", "3")
    answer = run("train", "--shapes", tmp_path / "fits", *mine, "--start", "human")
    assert answer.status == 1 and "contains fits without a model" in answer.err
    answer = run("train", "--shapes", tmp_path / "fits", *mine)
    assert answer.status == 0 and "training on 3 of 3 fits" in answer.err
    card = read_card(tmp_path / "mine" / "card.json")
    assert card.frame == {"orientation": "rigid", "scale": "area"} and card.correspondence
    assert (card.category, card.data, card.steps) == ("mine", "3 fits of fits, without a model", 3)
    answer = run(
        "match", eggs / "egg0.ply", eggs / "egg1.ply", "-o", tmp_path / "map.npy", "--model", tmp_path / "mine"
    )
    assert answer.status == 0, answer.err
    assert np.load(tmp_path / "map.npy").shape == (ball.V,)


@pytest.mark.slow
def test_from_few_registered_shapes_to_a_map(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A small network that finds no orientation: the card says how shapes are turned."""
    folder = tmp_path / "eggs"
    folder.mkdir()
    ball = icosphere(2)
    for n in range(3):
        save_shape(folder / f"egg{n}.ply", Shape(ball.verts * [0.8, 1.4 + 0.1 * n, 1.0], ball.faces))
    answer = run("prepare", folder, "-o", tmp_path / "out", *FEW[:-1], "--json")
    assert answer.record["align"] == "near"
    words = ("--steps", "3", "--seed", "2", "--stiffness", "0.1")
    answer = run("train", "--shapes", tmp_path / "out", "-o", tmp_path / "mine", *words)
    assert answer.status == 0 and "after step 3;" in answer.err
    assert "continuing" not in answer.err
    again = run("train", "--shapes", tmp_path / "out", "-o", tmp_path / "mine", *words)
    assert "continuing from the checkpoint" in again.err
    card = read_card(tmp_path / "mine" / "card.json")
    assert card.frame == {"orientation": "near", "scale": "area"}
    assert card.stiffness == 0.1
    assert (card.data, card.network["align_basis"], card.recipe["train"]["seed"]) == (
        "3 registered shapes of out",
        0,
        2,
    )
    answer = run(
        *("match", folder / "egg0.ply", folder / "egg1.ply", "-o", tmp_path / "map.npy"),
        *("--model", tmp_path / "mine", "-q"),
    )
    assert answer.status == 0, answer.err
    assert np.load(tmp_path / "map.npy").shape == (162,)
    plain = recipes.paper()
    few = replace(plain, train=replace(plain.train, shapes=2), scan=replace(plain.scan, points=200))
    monkeypatch.setattr(recipes, "paper", lambda: few)
    words = ("--steps", "1", "--preset", "paper", "-q")
    assert run("train", "--shapes", tmp_path / "out", "-o", tmp_path / "papers", *words).status == 0
    papers = read_card(tmp_path / "papers" / "card.json")
    assert (papers.frame["orientation"], papers.stiffness) == ("searched", 1.0)


@pytest.mark.parametrize(("registered", "words"), [(True, ["--unsupervised"]), (False, [])])
def test_known_points_and_preset_reach_the_training(
    run: Run, eggs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, registered: bool, words: list[str]
) -> None:
    called = {}

    def stub(template, samples, output, recipe, facts, resume, report, *of_validation):
        called.update(vars(facts), known=samples.landmarks.shape, output=output, recipe=recipe, resume=resume)
        report(StepReport(1, 1, 1e-3, 1.0, {"total": 0.5}))
        card = read_card(bundled_folder() / "models" / "human" / "card.json")
        write_card(replace(card, name=facts.name), Path(output) / "card.json")
        return output

    def calibrate(output, shapes, **_):
        called.update(calibrated=(output, shapes))
        raise InputError("few shapes")

    monkeypatch.setattr("meshmatch.training.train.train_model", stub)
    monkeypatch.setattr(meshmatch, "calibrate", calibrate)
    if registered:
        (eggs / "egg1.ply").unlink()
    prepared = ("--landmarks", ".tip.npy", "--template", "egg2", *AS_THEY_ARE)
    answer = run("prepare", eggs, "-o", tmp_path / "out", *FEW[:-1], *prepared)
    assert answer.status == 0 and "1 known points" in answer.err
    answer = run(
        *("train", "--shapes", tmp_path / "out", "-o", tmp_path / "mine", "--preset", "paper", *words),
        *("--stiffness", "0.2", "--category", "egg", "--licence", "CC0", "--seed", "4", "--fresh"),
    )
    assert answer.status == 0, answer.err
    assert called["calibrated"] == (tmp_path / "mine", tmp_path / "out")
    assert "none of its fits will be good: few shapes" in answer.err
    assert called["known"] == (2 if registered else 3, 1, 3)
    assert (called["category"], called["licence"], called["resume"]) == ("egg", "CC0", False)
    assert (called["recipe"].network.encoder, called["stiffness"]) == ("point", 0.2)
    assert called["recipe"].train.seed == 4
    assert "1 known points" in called["data"]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["prepare", "eggs/egg0.ply", "-o", "out", "--align", "none"], "align applies to a folder"),
        (["prepare", "eggs/egg0.ply", "-o", "out", "--landmarks", ".x"], "landmarks applies to a folder"),
        (["prepare", "eggs", "-o", "out", "--landmarks", ".nothing"], "has landmarks"),
        (["prepare", "eggs", "-o", "out", "--template", "egg9"], "egg9"),
        (["prepare", "bad", "-o", "out"], "no shape in bad could be used"),
        (["prepare", "bad/three.npy", "-o", "out"], "three.npy cannot be a template: it has points in only 3 places"),
        (["prepare", "bad/line.npy", "-o", "out"], "on no surface"),
        (["train", "-o", "mine", "--unsupervised"], "learning without correspondence needs a folder"),
        (["train", "-o", "mine", "--shapes", "alone"], "one shape is too few"),
    ],
)
def test_what_cannot_be_is_told_in_a_line_and_a_hint(
    run: Run, eggs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], told: str
) -> None:
    monkeypatch.chdir(tmp_path)
    ball = icosphere(3)
    Path("bad").mkdir()
    np.save("bad/three.npy", np.eye(3))
    np.save("bad/same.npy", np.ones((400, 3)))
    if any("line" in word for word in words):
        np.save("bad/line.npy", np.linspace([0, 0, 0], [1, 0, 0], 400))
    if "alone" in words:
        Path("one").mkdir()
        np.save("one/cloud.npy", ball.verts)
        assert run("prepare", "one", "-o", "alone", *FEW).status == 0
    answer = run(*words)
    assert answer.status == 1
    assert told in answer.err and "hint:" in answer.err
    assert not Path("out/prepared.json").exists()
