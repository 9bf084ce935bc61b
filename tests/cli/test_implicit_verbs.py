"""`train --implicit`, and `interpolate` and `match` with such a model: a folder of boxes, from files to files."""

import json
from dataclasses import replace
from functools import partial, partialmethod
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("skimage", reason="scikit-image is of the extra `implicit`")

import meshmatch
from meshmatch.cli import main
from meshmatch.geometry.triangles import is_watertight
from meshmatch.implicit import training
from meshmatch.implicit.codes import fit_implicit, loss_of
from meshmatch.implicit.model import ImplicitModel, load_implicit
from meshmatch.implicit.training import AS_PUBLISHED, train_implicit
from meshmatch.models.card import IMPLICIT, is_implicit, read_implicit_card
from meshmatch.training.train import CHECKPOINT
from tests.implicit.boxes import TRAIN, box, box_sdf, boxes, config

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("boxes")
    boxes(made, 3)
    return made


@pytest.fixture(scope="module")
def model(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    how = replace(TRAIN, steps=120, rate=3e-3, average=0.9)
    return train_implicit(tmp_path_factory.mktemp("model"), folder, config=config("mls"), training=how)


@pytest.mark.parametrize("field", ["mls", "pointwise"])
def test_a_folder_becomes_a_model_and_goes_on(folder: Path, tmp_path: Path, capsys: Capture, field: str) -> None:
    words = ["train", "--implicit", "--shapes", str(folder), "-o", str(tmp_path / "model"), "--json"]
    words += ["--field", field, *(["--arap", "0.004"] if field == "mls" else [])]
    words += ["--category", "box", "--licence", "CC0", "--steps"]
    assert main([*words, "1"]) == 0
    heard = capsys.readouterr()
    assert json.loads(heard.out)["steps"] == 1
    card = read_implicit_card(tmp_path / "model")
    assert (card.category, card.licence, card.shapes) == ("box", "CC0", ["box0", "box1", "box2"])
    assert card.network["field"] == field
    assert card.recipe["loss"]["arap"] == (0.004 if field == "mls" else TRAIN.loss.arap)
    assert (tmp_path / "model" / CHECKPOINT).is_file()
    assert not [path for path in (tmp_path / "model").rglob("*") if path.suffix in (".pt", ".pkl", ".pth")]
    assert main([*words, "2"]) == 0
    heard = capsys.readouterr()
    assert json.loads(heard.out)["steps"] == 2
    assert "continuing" in heard.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--field", "rbf"], "mls or pointwise"),
        (["--unsupervised"], "--unsupervised does not go"),
        (["--preset", "paper", "--arap", "0.001"], "--arap does not go with --implicit --preset paper"),
        (["--bf16"], "--bf16 does not go"),
        (["--compile"], "--compile does not go"),
        (["--steps", str(10**20)], "steps must lie in 1.."),
        (["--workers", "100000"], "workers must lie in 0..256"),
        *(
            (["--field", "pointwise", energy, "0.001"], f"{energy} does not go with --implicit --field pointwise")
            for energy in ("--volume", "--arap", "--blend")
        ),
    ],
)
def test_what_does_not_go_with_it_is_told(
    folder: Path, tmp_path: Path, capsys: Capture, words: list[str], said: str
) -> None:
    output = tmp_path / "model"
    assert main(["train", "--implicit", "--shapes", str(folder), "-o", str(output), *words]) == 1
    assert said in capsys.readouterr().err
    assert not (output / IMPLICIT).exists()


def test_dif_net_as_it_was_published(folder: Path, tmp_path: Path) -> None:
    words = ["train", "--implicit", "--shapes", str(folder), "-o", str(tmp_path), "--preset", "paper", "--steps", "1"]
    assert main(words) == 0
    card = read_implicit_card(tmp_path)
    assert card.network["field"] == "pointwise"
    assert [card.network[name] for name in ("code", "width", "inner", "maker", "frequency")] == [128, 128, 128, 256, 30]
    assert (card.recipe["rate"], card.recipe["loss"]["published"], card.recipe["loss"]["off"]) == (1e-4, True, 0.5)
    assert load_implicit(tmp_path).network.config.layers == 4
    assert loss_of(card) == AS_PUBLISHED.loss


def test_the_reduced_field_in_dif_net_as_it_was_published(folder: Path, tmp_path: Path) -> None:
    words = ["train", "--implicit", "--shapes", str(folder), "-o", str(tmp_path), "--preset", "paper", "--steps", "1"]
    assert main([*words, "--field", "mls", "--arap", "0.004"]) == 0
    card = read_implicit_card(tmp_path)
    assert [card.network[name] for name in ("field", "code", "layers", "frequency")] == ["mls", 128, 4, 30]
    loss = card.recipe["loss"]
    assert (card.recipe["rate"], loss["published"], loss["off"], loss["arap"]) == (1e-4, True, 0.5, 0.004)


def test_a_folder_is_needed(tmp_path: Path, capsys: Capture) -> None:
    assert main(["train", "--implicit", "-o", str(tmp_path / "model")]) == 1
    assert "needs --shapes" in capsys.readouterr().err


@pytest.mark.slow
def test_surfaces_between_two_files(model: Path, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    a, b = (meshmatch.load_shape(folder / f"box{k}.ply") for k in (0, 1))
    far = meshmatch.Shape(10 + 2 * b.verts, b.faces)  # another place and unit
    meshmatch.save_shape(tmp_path / "far.ply", far)
    files = [str(folder / "box0.ply"), str(tmp_path / "far.ply")]
    words = ["interpolate", *files, "--model", str(model), "-n", "3", "--resolution", "32", "--json"]
    assert main([*words, "-o", str(tmp_path / "way")]) == 0
    record = json.loads(capsys.readouterr().out)
    assert [frame["time"] for frame in record["frames"]] == [0, 0.5, 1]
    assert max(fit["residual"] for fit in record["shapes"]) < 4
    frames = json.loads((tmp_path / "way" / "frames.json").read_text())["frames"]
    shapes = [meshmatch.load_shape(tmp_path / "way" / frame["file"]) for frame in frames]
    assert [shape.V for shape in shapes] == [frame["vertices"] for frame in record["frames"]]
    assert all(is_watertight(shape.faces) for shape in shapes)
    for shape, truth in ((shapes[0], a), (shapes[2], far)):
        assert np.abs(shape.bounds - truth.bounds).max() < 0.3 * truth.diagonal
    assert a.bounds.mean() < shapes[1].bounds.mean() < far.bounds.mean()


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Codes after a few steps, and coarse surfaces."""
    monkeypatch.setattr("meshmatch.api.implicit.fit_implicit", partial(fit_implicit, steps=5))
    monkeypatch.setattr(ImplicitModel, "register", partialmethod(ImplicitModel.register, resolution=32))


def test_surfaces_in_a_row(model: Path, folder: Path, tmp_path: Path) -> None:
    files = [str(folder / f"box{k}.ply") for k in (0, 1)]
    words = ["interpolate", *files, "--model", str(model), "-n", "2", "--resolution", "16"]
    assert main([*words, "-o", str(tmp_path / "row.png")]) == 0
    assert (tmp_path / "row.png").read_bytes()[:4] == b"\x89PNG"


def test_a_map_through_the_template(model: Path, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    half = np.array([0.8, 0.35, 0.6])
    meshmatch.save_shape(tmp_path / "unseen.ply", box(half))
    files = [str(tmp_path / "unseen.ply"), str(folder / "box1.ply")]
    output = tmp_path / "map.npz"
    assert main(["match", *files, "--model", str(model), "-o", str(output), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["source_vertices"] == 8
    shapes = [meshmatch.load_shape(file) for file in files]
    found = meshmatch.load_map(output, *shapes)
    assert found.verdict == record["verdict"]
    assert np.array_equal(np.sign(shapes[1].verts[found.index]), np.sign(shapes[0].verts))  # corner to corner


def test_samples_of_distances_are_matched_and_fitted(
    model: Path, folder: Path, tmp_path: Path, capsys: Capture
) -> None:
    """Their points take the place of vertices, in the file's order; to a file with its own sides they all agree."""
    half = np.array([0.8, 0.35, 0.6])
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (3000, 3)) * half
    np.savez(tmp_path / "box.npz", points=points, distances=box_sdf(points, half))
    files = [str(tmp_path / "box.npz"), str(folder / "box1.ply")]
    output = tmp_path / "map.npy"
    assert main(["match", *files, "--model", str(model), "-o", str(output), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["source_vertices"] == 3000
    corner = np.flatnonzero((np.abs(points / half) > 0.8).all(1))
    assert len(corner) > 5
    target = meshmatch.load_shape(files[1])
    assert np.array_equal(np.sign(target.verts[np.load(output)[corner]]), np.sign(points[corner]))
    words = ["register", files[0], "--model", str(model), "-o", str(tmp_path / "fit.ply")]
    assert main(words) == 0
    assert np.abs(meshmatch.load_shape(tmp_path / "fit.ply").bounds - [-half, half]).max() < 0.3
    assert main(["match", files[1], str(tmp_path / "none.npz"), "--model", str(model), "-o", str(output)]) == 1


def test_the_template_on_a_shape(model: Path, folder: Path, tmp_path: Path, capsys: Capture) -> None:
    found = []
    for k in (0, 1):
        words = ["register", str(folder / f"box{k}.ply"), "--model", str(model), "--json"]
        words += ["--picture", str(tmp_path / "fit.png")] if k == 0 else []
        assert main([*words, "-o", str(tmp_path / f"fit{k}.ply")]) == 0
        record = json.loads(capsys.readouterr().out)
        assert {"residual", "missed", "invented", "verdict"} <= record.keys()
        found.append(meshmatch.load_shape(tmp_path / f"fit{k}.ply"))
        assert found[k].V == record["vertices"]
        truth = meshmatch.load_shape(folder / f"box{k}.ply")
        assert np.abs(found[k].bounds - truth.bounds).max() < 0.3 * truth.diagonal
    assert np.array_equal(found[0].faces, found[1].faces)
    assert (tmp_path / "fit.png").is_file()


def test_the_registry_knows_implicit_models(
    model: Path, folder: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MESHMATCH_HOME", str(tmp_path / "home"))
    name = read_implicit_card(model).name

    def run(*words: str) -> str:
        status = main(list(words))
        heard = capsys.readouterr()
        return heard.out if status == 0 else heard.err

    run("models", "add", str(model))
    assert name in [line.split()[0] for line in run("models", "list").splitlines()]
    assert json.loads(run("models", "show", name))["shapes"] == ["box0", "box1", "box2"]
    assert "ok, sha256" in run("models", "verify", name)
    files = [str(folder / f"box{k}.ply") for k in (0, 1)]
    assert main(["match", *files, "--model", name, "-o", str(tmp_path / "map.npz")]) == 0
    assert (tmp_path / "map.npz").is_file()
    assert meshmatch.load_implicit(name).card.name == name
    capsys.readouterr()
    assert main(["models", "verify", "human"]) == 0  # the others are there as before
    with pytest.raises(meshmatch.MeshmatchError, match="implicit model"):
        meshmatch.Matcher(name)
    weights = tmp_path / "home" / "models" / name / "weights.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4] + b"gone")
    capsys.readouterr()
    assert "not those of its card" in run("models", "verify", name)
    run("models", "remove", name)
    assert name not in run("models", "list")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["match", "-o", "map.npz", "--up", "y"], "--up does not go with an implicit model"),
        (["match", "-o", "map.npz", "--landmarks", "pairs.txt"], "--landmarks does not go"),
        (["interpolate", "-o", "way", "--mesh", "template"], "--mesh does not go"),
        (["interpolate", "-o", "way.html"], "a page needs shapes that share vertices"),
        (["interpolate", "-o", "way", "--resolution", "33"], "must be even"),
    ],
)
def test_options_that_mean_nothing_there_are_refused(
    model: Path, folder: Path, tmp_path: Path, capsys: Capture, words: list[str], said: str
) -> None:
    verb, dash, name, *rest = words
    files = [str(folder / f"box{k}.ply") for k in (0, 1)]
    assert main([verb, *files, "--model", str(model), dash, str(tmp_path / name), *rest]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_the_library_does_the_same(model: Path, folder: Path) -> None:
    loaded = meshmatch.load_implicit(model)
    files = folder / "box0.ply", folder / "box1.ply"
    result = meshmatch.match(*files, model=loaded, config=meshmatch.FitConfig(seed=1))
    assert result.source_fit.seed == 1
    assert result.backward().source_vertices == result.map.target_vertices
    fit = meshmatch.register(files[0], model=loaded)
    assert np.array_equal(fit.points_in_file, loaded.register(fit).verts)
    for wrong in ({"landmarks": ([0], [0])}, {"config": meshmatch.FitConfig(up="y")}):
        with pytest.raises(meshmatch.MeshmatchError, match="implicit model"):
            meshmatch.match(*files, model=loaded, **wrong)
    sequence = meshmatch.interpolate(files, 2, model=loaded, options=meshmatch.InterpolationOptions(resolution=16))
    assert [step.time for step in sequence.steps] == [0, 1]
    assert is_implicit(model)
    assert not is_implicit(folder)
    assert training.TRAINING.steps > 1
