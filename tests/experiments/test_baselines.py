"""The comparison with other methods: every method's map, results that are kept, what is skipped and what fails."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError, ModelError, OptionError
from meshmatch.experiments.bench import baseline_methods, orientation
from meshmatch.experiments.bench import classical as classical_baselines
from meshmatch.experiments.bench.baseline_methods import METHODS, Baseline, Choices, Coded
from meshmatch.experiments.bench.baselines import main
from meshmatch.experiments.bench.classical import Registration, ZoomOut, carried, library, placed
from meshmatch.experiments.bench.methods import Method
from meshmatch.experiments.paper import learned_baselines
from meshmatch.experiments.paper.learned_baselines import (
    TransBatch,
    TransMatch,
    coded_recipe,
    draw_batch,
    load_transmatch,
    train_transmatch,
)
from meshmatch.experiments.paper.transformer import TransConfig, Transformer
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.frames import Frame
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
from meshmatch.training.alone import CHECKPOINT
from meshmatch.training.datasets import step_generator
from meshmatch.training.loop import TrainConfig
from meshmatch.training.scans import ScanConfig
from tests.conftest import icosphere
from tests.experiments.small_bench import Oracle, build
from tests.training.small import bent_eggs, egg_template

SMALL = TransConfig(width=16, heads=2, latents=6, depth=1, frequencies=2)


def lump(splits: int = 3) -> Shape:
    """A bent pear that no turn and no mirror takes to itself."""
    verts = icosphere(splits).verts
    x, y, z = (verts * (1 + 0.45 * verts[:, 1:2]) * [0.6, 1.6, 1.0]).T
    verts = np.stack([x + 0.3 * y**2 + 0.15 * z * y, y, z + 0.25 * x * y + 0.12 * y**3], 1)
    return Shape(verts, icosphere(splits).faces, "lump")


def moved(shape: Shape) -> tuple[Shape, np.ndarray]:
    """A copy, a little bent, turned, scaled and shuffled; and the true map to it (V,)."""
    verts = shape.verts + 0.02 * np.sin(3 * shape.verts[:, [1, 2, 0]])
    turn = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix()
    order = np.random.default_rng(3).permutation(shape.V)
    truth = np.argsort(order)
    return Shape((7 * verts @ turn.T + [3, 1, 2])[order], truth[shape.faces], "copy"), truth


@pytest.mark.parametrize(
    ("package", "method"),
    [
        (None, Registration("rigid", seed=1)),
        ("trimesh", Registration("nricp", 400)),
        ("meshmonk", Registration("meshmonk", 900)),
        ("pyFM", ZoomOut(faces=1000, first=10, last=30)),
    ],
    ids=["rigid", "nricp", "meshmonk", "zoomout"],
)
def test_a_moved_copy_is_found_again(package: str | None, method: Method) -> None:
    if package is not None:
        pytest.importorskip(package)
    source = lump()
    target, truth = moved(source)
    found = method.map(source, method.fit(source), target, method.fit(target))
    far = np.linalg.norm(target.verts[found.index] - target.verts[truth], axis=1) / np.sqrt(target.area)
    guess = np.linalg.norm(target.verts[::-1] - target.verts[truth], axis=1) / np.sqrt(target.area)
    assert far.mean() < 0.05 < 0.3 < guess.mean()


@pytest.mark.parametrize(
    ("package", "method"),
    [(None, Registration("rigid", oriented_by="m")), ("pyFM", ZoomOut(1000, 10, 30, oriented_by="m"))],
    ids=["rigid", "zoomout"],
)
def test_a_ball_is_found_again_from_the_orientation_that_it_is_given(
    package: str | None, method: Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other start could tell one point of a ball from another."""
    if package is not None:
        pytest.importorskip(package)
    ball = icosphere(3)
    turn = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix()
    source = Shape(ball.verts, ball.faces, "ball")
    target = Shape(ball.verts @ turn.T, ball.faces, "turned")
    frames = {"ball": np.eye(3), "turned": turn.T}

    def frame_by(model: str, shape: Shape, seed: int) -> Frame:
        assert model == "m"
        return Frame(3.5, frames[shape.name], np.zeros(3))

    monkeypatch.setattr(classical_baselines, "frame_by", frame_by)
    found = method.map(source, method.fit(source), target, method.fit(target))
    assert np.linalg.norm(target.verts[found.index] - target.verts, axis=1).mean() < 0.06


def test_3d_coded_can_be_told_how_a_shape_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    turn, asked = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix(), []

    class Told:
        def __init__(self, model: str, config: FitConfig) -> None:
            self.config = config

        def fit(self, shape: Shape) -> None:
            asked.append((shape.verts, self.config))

    monkeypatch.setattr(orientation, "frame_by", lambda *given: Frame(2.0, turn.T, np.zeros(3)))
    monkeypatch.setattr(baseline_methods, "Matcher", Told)
    ball = icosphere(1)
    turned = Shape(ball.verts @ turn.T, ball.faces, "turned")
    for model in ("", "human"):
        Coded("coded", 7, 5, model).fit(turned)
    (free, searched), (upright, told) = asked
    assert np.array_equal(free, turned.verts) and np.allclose(2 * upright, ball.verts)
    assert (searched.up, searched.front, told.up, told.front) == (None, None, "y", "z")
    assert searched == replace(told, up=None, front=None)


def test_zoomout_goes_on_from_a_map() -> None:
    """One that is rough: every vertex goes to one of its neighbours."""
    pytest.importorskip("pyFM")
    ball = icosphere(3)
    source, target = (Shape(ball.verts, ball.faces, name) for name in ("ball", "again"))
    method = ZoomOut(1000, 10, 30)
    neighbour = np.zeros(ball.V, np.int64)
    neighbour[ball.faces] = np.roll(ball.faces, 1, axis=1)
    rough = VertexMap.between(source, target, neighbour)
    found = method.map(source, method.fit(source), target, method.fit(target), rough)
    away, before = (np.linalg.norm(ball.verts[each.index] - ball.verts, axis=1).mean() for each in (found, rough))
    assert away < 0.06 < before


def test_the_frame_of_a_model_is_upright_whatever_the_files_is() -> None:
    dancer = load_shape("templates/samples/dancer.ply")
    turn = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix()
    turned = Shape(7 * dancer.verts @ turn.T, dancer.faces, "turned")
    first, second = (classical_baselines.frame_by("human", shape).apply(shape.verts) for shape in (dancer, turned))
    assert np.linalg.norm(first - second, axis=1).mean() < 0.15  # turned the wrong way it would be 0.4 or more


@pytest.mark.parametrize("method", [Registration("nricp"), Registration("meshmonk"), ZoomOut()])
def test_a_method_that_needs_triangles_says_so(method: Method) -> None:
    cloud = Shape(lump(2).verts, np.empty((0, 3), np.int64), "points")
    with pytest.raises(InputError, match="needs triangles"):
        method.fit(cloud)
    Registration("rigid").fit(cloud)


def test_the_whole_goes_where_the_thin_one_goes() -> None:
    whole = placed(lump())
    there = whole.whole.verts * [1, 2, 3] + 4
    assert np.allclose(carried(whole, there), there)
    thin = placed(lump(), faces=300)
    assert thin.thin.F < 400
    there = thin.thin.verts @ np.diag([1.0, 2.0, 3.0]) + 4
    assert np.abs(carried(thin, there) - (thin.whole.verts * [1, 2, 3] + 4)).max() < 0.2


def test_a_librarys_failure_is_a_failed_pair_and_a_bug_is_a_bug() -> None:
    with pytest.raises(InputError, match="abc gave up: no way"), library("abc"):
        raise ValueError("no way")
    with pytest.raises(InputError, match="gave up"), library("abc"):
        np.linalg.cholesky(-np.eye(2))
    with pytest.raises(TypeError), library("abc"):
        raise TypeError


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


@pytest.fixture
def words(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The command's words, with oracles for two of the methods; one of them refuses a shape."""
    for row in (
        Baseline("rigid", "turned round", Oracle(turned=True)),
        Baseline("nricp", "n", None, "gone"),
        Baseline("ours", "ours", Oracle(refuses="2"), "", 12.5, "abc"),
    ):
        monkeypatch.setitem(METHODS, row.name, lambda _, row=row: [row])
    words = ["--data", str(small), "--cache", str(tmp_path / "cache"), "--output", str(tmp_path / "kept")]
    return [*words, "--methods", "rigid,ours"]


def answer(capsys: pytest.CaptureFixture[str]) -> tuple[str, dict[str, Any]]:
    text = capsys.readouterr().out
    return text, json.loads(text.strip().splitlines()[-1])


def test_the_command(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = tmp_path / "plot.png"
    assert main([*words, "--sets", "shrec19,scape", "--picture", str(picture)]) == 0
    text, record = answer(capsys)
    assert picture.stat().st_size > 1000
    rows = {(row["set"], row["name"]): row for row in record["rows"]}
    # A shape that cannot be fitted costs its pairs; none is left out.
    ours = rows["shrec19", "ours"]
    assert (ours["measured"], ours["failures"], ours["minutes"]) == ("3 of 3", 2, 12.5)
    assert ours["flips"] == pytest.approx(2 / 3, abs=1e-4)
    assert rows["scape", "ours"]["mean_cm"] == 0
    assert rows["scape", "rigid"]["mean_cm"] > 10
    line = next(line for line in text.splitlines() if "shrec19" in line and "ours" in line)
    assert "3 of 3" in line and "12.5" in line and "67 %" in line
    assert "Not all pairs" not in text

    # A second run reads them, and measures only what is not there.
    (tmp_path / "kept" / "scape-rigid.json").unlink()
    fitted: list[str] = []
    plain = Oracle.fit
    monkeypatch.setattr(Oracle, "fit", lambda self, shape: fitted.append(shape.name) or plain(self, shape))
    assert main([*words, "--sets", "shrec19,scape"]) == 0
    again = {(row["set"], row["name"]): row for row in answer(capsys)[1]["rows"]}
    assert len(fitted) == 2
    assert again["shrec19", "ours"] == ours
    assert again["scape", "rigid"]["mean_cm"] == pytest.approx(rows["scape", "rigid"]["mean_cm"])
    assert (tmp_path / "kept" / "baselines.png").stat().st_size > 1000


def test_a_part_says_so_and_is_not_taken_for_another(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*words, "--sets", "faust", "--limit-pairs", "2"]) == 0
    text, _ = answer(capsys)
    assert "2 of 6" in text and "Not all pairs were measured" in text
    assert main([*words, "--sets", "faust"]) == 1
    assert "other choices (pairs)" in " ".join(capsys.readouterr().err.split())


def test_what_is_not_there_is_skipped_with_a_reason(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--sets", "scape", "--methods", "rigid,nricp,coded,transmatch"]) == 0
    text, record = answer(capsys)
    assert [row["name"] for row in record["rows"]] == ["rigid"]
    assert "scape, n: gone" in text and "give --coded MODEL" in text and "give --transmatch MODEL" in text
    late = [*words, "--sets", "scape", "--minutes", "0", "--methods", "rigid,coded", "--coded", "human"]
    assert main([*late, "--output", str(tmp_path / "new"), "--coded-steps", "7"]) == 0
    skipped = answer(capsys)[1]["skipped"]
    assert len(skipped) == 3 and all("the time was up" in why for why in skipped.values())


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baseline_methods, "find_spec", lambda name: None)
    assert all(row.method is not None for row in METHODS["rigid"](Choices()))
    for name in ("zoomout", "nricp", "meshmonk"):
        rows = METHODS[name](Choices())
        assert all(row.method is None and "pip install 'meshmatch[bench]'" in row.missing for row in rows)


def test_methods_that_know_no_category_have_a_row_from_our_orientation() -> None:
    plain, oriented = METHODS["rigid"](Choices(seed=4))
    assert (plain.method, oriented.method) == (Registration("rigid", seed=4), Registration("rigid", None, 4, "human"))
    assert (oriented.name, oriented.label) == ("rigid-oriented", "rigid, nearest, our orientation")
    assert oriented.model and not plain.model


def test_our_own_rows() -> None:
    choices = Choices(seed=5, coded="human", coded_steps=7)
    plain, refined = METHODS["ours"](choices)
    assert (plain.method.refine, refined.method.refine, refined.method.seed) == ("none", "nodes", 5)  # type: ignore[union-attr]
    assert refined.minutes and refined.minutes > 0
    assert [row.method for row in METHODS["coded"](choices)] == [Coded("human", 7, 5), Coded("human", 7, 5, "human")]
    assert [row.method for row in METHODS["transmatch"](choices)] == [None]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--methods", "rigid,smpl"], "unknown method 'smpl'"),
        (["--methods", "transmatch", "--transmatch", "nowhere"], "holds no TransMatch"),
        (["--methods", "coded", "--coded", "nobody"], "nobody"),
    ],
)
def test_a_wrong_choice_is_told(
    words: list[str], more: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*words, "--sets", "scape", *more]) == 1
    assert said in " ".join(capsys.readouterr().err.split())


def brief(steps: int, **more: Any) -> TrainConfig:
    return TrainConfig(**({"steps": steps, "shapes": 4, "warm_up": 5, "decay": 0.5, "workers": 0} | more))


def test_the_recipe_of_3d_coded_is_pointwise_and_free() -> None:
    chosen = coded_recipe(brief(7, seed=3), 96, 64)
    loss = chosen.train.loss
    assert (loss.volume, loss.arap, loss.blend, loss.robust) == (0, 0, 0, False)
    assert (chosen.network.field, chosen.network.encoder, chosen.network.width) == ("pointwise", "point", 64)
    assert (chosen.train.steps, chosen.train.shapes, chosen.train.seed) == (7, 4, 3)
    assert chosen.scan.upright and chosen.scan.points == 96 and chosen.scan.partial == 0


def test_a_batch_of_transmatch_has_its_truth_on_the_scan(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_baselines, "TARGETS", 50)
    template = egg_template()
    clean = ScanConfig(points=2000, noise=0, outliers=0, holes=0, partial=0, density=0, upright=True)
    generator = torch.Generator().manual_seed(0)
    batch = draw_batch(template, bent_eggs(template), clean, 3, generator)
    assert batch.points.shape == (3, 2000, 3) and batch.goal.shape == (3, 50, 3)
    assert len(set(batch.chosen.tolist())) == 50
    assert torch.cdist(batch.goal, batch.points).amin(2).max() < 0.1  # about the spacing of so many points
    assert batch.points.mean(1).abs().max() < 1e-5


def test_the_transformer_ignores_the_order_of_points_and_starts_at_rest() -> None:
    torch.manual_seed(0)
    network = Transformer(SMALL).eval()
    points, rest = torch.randn(2, 30, 3), torch.randn(7, 3)
    there = network(points, rest)
    assert there.shape == (2, 7, 3) and there.abs().max() < 0.1
    torch.nn.init.normal_(network.last.weight)
    there = network(points, rest)
    assert torch.allclose(network(points[:, torch.randperm(30)], rest), there, atol=1e-5)
    assert torch.allclose(network(points, rest.flip(0)), there.flip(1), atol=1e-5)
    assert not torch.allclose(network(points.flip(0), rest), there, atol=1e-3)


EGG = TransConfig(width=32, heads=2, latents=8, depth=1, frequencies=2)


def trained(
    folder: Path, steps: int, drawn: list[int] | None = None, killed: int | None = None, **choices: Any
) -> dict[str, Any]:
    """TransMatch on bent eggs; ``drawn`` hears which batches it asks for, and at ``killed`` it is."""
    template = egg_template()
    config = choices.pop("config", EGG)
    told = {"points": choices.pop("points", 96)}
    scan, eggs = ScanConfig(points=told["points"], partial=0.0, upright=True), bent_eggs(template)

    def draw(step: int) -> TransBatch:
        if step == killed:
            raise KeyboardInterrupt
        if drawn is not None:
            drawn.append(step)
        return draw_batch(template, eggs, scan, 8, step_generator(0, step))

    train = brief(steps, **({"rate": 3e-3, "shapes": 8} | choices))
    return train_transmatch(folder, template, draw, train, config, told)


def test_transmatch_learns(tmp_path: Path) -> None:
    first, last = trained(tmp_path / "a", 1), trained(tmp_path / "b", 120)
    assert last["steps"] == 120 and last["distance"] < 0.9 * first["distance"]
    assert load_transmatch(tmp_path / "b").words["steps"] == 120


def test_transmatch_goes_on_exactly_where_it_was_stopped(tmp_path: Path) -> None:
    whole = trained(tmp_path / "whole", 9)
    broken, drawn = tmp_path / "broken", []
    assert trained(broken, 9, minutes=1e-9)["steps"] == 1
    with pytest.raises(KeyboardInterrupt):  # a kill, four steps after the last checkpoint
        trained(broken, 9, killed=5)
    last = trained(broken, 9, drawn)
    assert drawn == [*range(1, 9), 9]  # the batch after the last is what it is measured on
    assert all(last[name] == whole[name] for name in ("steps", "weights_sha256", "distance"))
    drawn.clear()
    again = trained(broken, 9, drawn)
    assert drawn == [9] and again["weights_sha256"] == whole["weights_sha256"]


@pytest.mark.parametrize(
    "other",
    [{"steps": 8}, {"seed": 1}, {"shapes": 4}, {"points": 90}, {"config": TransConfig(32, 4, 8, 1, 2)}],
    ids=["steps", "seed", "shapes", "points", "heads"],
)
def test_a_checkpoint_of_other_choices_is_refused(
    other: dict[str, Any], tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    trained(tmp_path, 7, minutes=1e-9)
    name = request.node.callspec.id
    with pytest.raises(OptionError, match=rf"other choices \({name}\)"):
        trained(tmp_path, **({"steps": 7} | other))
    drawn: list[int] = []
    (tmp_path / CHECKPOINT).with_name("asked.json").unlink()  # as the hint says
    trained(tmp_path, drawn=drawn, **({"steps": 7} | other))
    assert drawn[0] == 0


def test_a_damaged_checkpoint_of_transmatch_is_refused(tmp_path: Path) -> None:
    trained(tmp_path, 3, minutes=1e-9)
    (tmp_path / CHECKPOINT).write_bytes(b"not a checkpoint")
    with pytest.raises(ModelError, match="is not a checkpoint"):
        trained(tmp_path, 3)


def test_transmatch_finds_a_turned_copy(tmp_path: Path) -> None:
    trained(tmp_path, 2)
    egg = egg_template().shape
    verts = egg.verts.copy()
    verts[:, 0] += 0.5 * verts[:, 1] ** 2
    turn = Rotation.from_euler("xyz", [90, 0, 30], degrees=True).as_matrix()
    order = np.random.default_rng(0).permutation(egg.V)
    source = Shape(verts, egg.faces, "a")
    target = Shape((5 * verts @ turn.T + 2)[order], np.argsort(order)[egg.faces], "b")
    method = TransMatch(str(tmp_path), points=600, few=300, keep=3)
    found = method.map(source, method.fit(source), target, method.fit(target))
    far = np.linalg.norm(target.verts[found.index] - target.verts[np.argsort(order)], axis=1)
    # half a turn of an egg is nearly the egg again: what must hold is that it lands on the right ring
    across = np.linalg.norm(target.verts[::-1] - target.verts[np.argsort(order)], axis=1)
    assert found.index.shape == (source.V,) and far.mean() < 0.5 * across.mean()


def test_a_folder_without_transmatch_is_told(tmp_path: Path) -> None:
    for text in (None, "[]", '{"network": {"widths": 3}}'):
        if text is not None:
            (tmp_path / "transmatch.json").write_text(text)
        with pytest.raises(ModelError, match="holds no TransMatch"):
            load_transmatch(tmp_path)


@pytest.mark.parametrize("method", ["coded", "transmatch"])
def test_training_by_command(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def eggs(template, identities: int, seed: int) -> Callable:
        asked.extend([identities, seed])
        return bent_eggs(template)

    monkeypatch.setattr(learned_baselines, "human_source", eggs)
    monkeypatch.setattr(learned_baselines, "read_template", lambda name: egg_template())
    folder = tmp_path / "egg"
    words = [method, "-o", str(folder), "--steps", "2", "--points", "96", "--width", "16", "--shapes", "4"]
    assert learned_baselines.main([*words, "--identities", "64", "--seed", "3", "--bf16"]) == 0
    assert asked == [64, 3]
    assert answer(capsys)[1]["steps"] == 2
    egg = egg_template().shape
    fitted = (Coded(str(folder), steps=3) if method == "coded" else TransMatch(str(folder))).fit(egg)
    assert (fitted.points if method == "coded" else fitted).shape == egg.verts.shape
