"""The comparison with other methods: every method's map, results that are kept, what is skipped and what fails."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshmatch.errors import InputError
from meshmatch.experiments.bench import baselines, methods
from meshmatch.experiments.bench.baselines import METHODS, Baseline, Choices, main
from meshmatch.experiments.bench.methods import Method, Registration, ZoomOut, carried, coded, library, placed
from meshmatch.experiments.paper import learned_baselines
from meshmatch.experiments.paper.learned_baselines import (
    TransBatch,
    TransConfig,
    Transformer,
    coded_recipe,
    draw_batch,
    train_transmatch,
)
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape
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


def test_3d_coded_can_be_told_how_a_shape_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    turn, asked = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix(), []

    class Told:
        def __init__(self, model: str, config: FitConfig, threads: int) -> None:
            self.config = config

        def fit(self, shape: Shape, config: FitConfig | None) -> None:
            asked.append((shape.verts, config or self.config))

    monkeypatch.setattr(methods, "frame_by", lambda *given: Frame(2.0, turn.T, np.zeros(3)))
    monkeypatch.setattr(methods, "Matcher", Told)
    ball = icosphere(1)
    turned = Shape(ball.verts @ turn.T, ball.faces, "turned")
    for model in ("", "human"):
        coded("coded", 7, 5, model).fit(turned)
    (free, searched), (upright, told) = asked
    assert np.array_equal(free, turned.verts) and np.allclose(2 * upright, ball.verts)
    assert (searched.up, searched.front, told.up, told.front) == (None, None, "y", "z")
    assert searched == replace(told, up=None, front=None)


def test_the_frame_of_a_model_is_upright_whatever_the_files_is() -> None:
    dancer = load_shape("templates/samples/dancer.ply")
    turn = Rotation.from_rotvec([1.4, 0.4, -0.9]).as_matrix()
    turned = Shape(7 * dancer.verts @ turn.T, dancer.faces, "turned")
    first, second = (methods.frame_by("human", shape).apply(shape.verts) for shape in (dancer, turned))
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
    assert main([*words, "--sets", "shrec19,scape"]) == 0
    text, record = answer(capsys)
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


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "find_spec", lambda name: None)
    assert all(row.method is not None for row in METHODS["rigid"](Choices()))
    for name in ("zoomout", "nricp", "meshmonk"):
        rows = METHODS[name](Choices())
        assert all(row.method is None and "pip install 'meshmatch[bench]'" in row.missing for row in rows)


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
