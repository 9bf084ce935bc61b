"""TransMatch on bent eggs: it learns, goes on where it stopped, and finds a turned copy."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from meshmatch.errors import ModelError, OptionError, OutputError
from meshmatch.experiments import transmatch
from meshmatch.experiments.transformer import TransConfig, TransMatch, TransMatcher, load_transmatch
from meshmatch.experiments.transmatch import CHECKPOINT, Schedule, draw_batch, main, train
from meshmatch.shapes.shape import Shape
from meshmatch.training.scans import ScanConfig
from tests.training.small import bent_eggs, egg_template

SMALL = TransConfig(width=16, heads=2, latents=6, depth=1, frequencies=2)


def brief(steps: int, **more: float) -> Schedule:
    return Schedule(steps=steps, shapes=4, points=96, targets=40, warm_up=5, **more)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    template = egg_template()
    return train(template, bent_eggs(template), tmp_path_factory.mktemp("egg"), SMALL, brief(2))


def test_a_batch_has_its_truth_on_the_scan() -> None:
    template = egg_template()
    clean = ScanConfig(points=2000, noise=0, outliers=0, holes=0, partial=0, density=0, upright=True)
    generator = torch.Generator().manual_seed(0)
    points, chosen, goal = draw_batch(template, bent_eggs(template), clean, 3, 50, generator)
    assert points.shape == (3, 2000, 3) and goal.shape == (3, 50, 3) and len(set(chosen.tolist())) == 50
    assert torch.cdist(goal, points).amin(2).max() < 0.1  # about the spacing of so many points
    assert points.mean(1).abs().max() < 1e-5


def test_the_network_ignores_the_order_of_points_and_starts_at_rest() -> None:
    torch.manual_seed(0)
    network = TransMatch(SMALL).eval()
    points, rest = torch.randn(2, 30, 3), torch.randn(7, 3)
    there = network(points, rest)
    assert there.shape == (2, 7, 3) and there.abs().max() < 0.1
    torch.nn.init.normal_(network.last.weight)
    there = network(points, rest)
    assert torch.allclose(network(points[:, torch.randperm(30)], rest), there, atol=1e-5)
    assert torch.allclose(network(points, rest.flip(0)), there.flip(1), atol=1e-5)
    assert not torch.allclose(network(points.flip(0), rest), there, atol=1e-3)


def test_it_learns(tmp_path: Path) -> None:
    template = egg_template()
    losses: list[float] = []
    train(
        template,
        bent_eggs(template),
        tmp_path / "egg",
        TransConfig(width=32, heads=2, latents=8, depth=1, frequencies=2),
        Schedule(steps=120, shapes=8, points=96, targets=40, rate=3e-3, warm_up=5),
        tell=lambda step, seconds, loss: losses.append(loss),
    )
    assert len(losses) == 120 and losses[-1] < 0.8 * losses[0]


def test_it_goes_on_where_it_stopped(tmp_path: Path) -> None:
    template = egg_template()
    source = bent_eggs(template)
    whole = train(template, source, tmp_path / "a", SMALL, brief(6, decay=0))
    part = train(template, source, tmp_path / "b", SMALL, brief(3, decay=0))
    assert load_transmatch(part).words["steps"] == 3
    train(template, source, tmp_path / "b", SMALL, brief(6, decay=0))
    assert load_transmatch(part).words["steps"] == 6
    one, two = (load_transmatch(each).network.state_dict() for each in (whole, part))
    assert all(torch.equal(one[name], two[name]) for name in one)
    with pytest.raises(ModelError):
        train(template, source, tmp_path / "b", TransConfig(width=8, heads=2), brief(6))


def test_the_rate_ends_with_the_steps_or_the_time() -> None:
    plan = Schedule(steps=100, minutes=1, warm_up=10, decay=0.5)
    assert plan.rate_at(0, 0) == pytest.approx(plan.rate / 10)
    assert plan.rate_at(30, 0) == plan.rate
    assert plan.rate_at(100, 0) == plan.rate_at(50, 60) == 0
    assert plan.rate_at(75, 0) == pytest.approx(plan.rate / 2)
    with pytest.raises(OptionError):
        Schedule(minutes=0)


def test_a_turned_copy_is_found_again(folder: Path) -> None:
    egg = egg_template().shape
    verts = egg.verts.copy()
    verts[:, 0] += 0.5 * verts[:, 1] ** 2
    turn = Rotation.from_euler("xyz", [90, 0, 30], degrees=True).as_matrix()
    order = np.random.default_rng(0).permutation(egg.V)
    source = Shape(verts, egg.faces, "a")
    target = Shape((5 * verts @ turn.T + 2)[order], np.argsort(order)[egg.faces], "b")
    matcher = TransMatcher(str(folder), points=600, few=300, keep=3)
    laid = [matcher.fit(shape) for shape in (source, target)]
    assert laid[0].residual < 0.2
    found = matcher.map(source, laid[0], target, laid[1])
    far = np.linalg.norm(target.verts[found.index] - target.verts[np.argsort(order)], axis=1)
    # half a turn of an egg is nearly the egg again: what must hold is that it lands on the right ring
    across = np.linalg.norm(target.verts[::-1] - target.verts[np.argsort(order)], axis=1)
    assert found.index.shape == (source.V,) and far.mean() < 0.5 * across.mean()


def test_a_folder_that_is_none_is_told(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="holds no TransMatch"):
        load_transmatch(tmp_path)
    (tmp_path / "transmatch.json").write_text(json.dumps({"network": {"width": 10**9}}))
    with pytest.raises(ModelError, match="width"):
        load_transmatch(tmp_path)
    (tmp_path / "transmatch.json").write_text("[]")
    with pytest.raises(ModelError, match="damaged"):
        load_transmatch(tmp_path)
    (tmp_path / "file").write_text("")
    template = egg_template()
    with pytest.raises(OutputError):
        train(template, bent_eggs(template), tmp_path / "file" / "x", SMALL, brief(1))
    assert (folder / CHECKPOINT).is_file()


def test_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[int] = []

    def eggs(template, identities: int, seed: int):
        asked.extend([identities, seed])
        return bent_eggs(template)

    monkeypatch.setattr(transmatch, "human_source", eggs)
    monkeypatch.setattr(transmatch, "load_template", lambda path: egg_template())
    words = ["-o", str(tmp_path / "t"), "--minutes", "1", "--steps", "1", "--threads", "1", "--seed", "3"]
    assert main([*words, "--identities", "64", "--shapes", "3", "--points", "80"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert asked == [64, 3]
    assert record["steps"] == 1 and record["schedule"]["seed"] == 3 and record["network"]["width"] == 192
    assert (record["schedule"]["shapes"], record["schedule"]["points"]) == (3, 80)
    assert {"date", "commit", "machine", "minutes", "distance"} <= record.keys()
    assert main(["-o", str(tmp_path), "--minutes", "0"]) == 1
    assert "minutes above 0" in " ".join(capsys.readouterr().err.split())
