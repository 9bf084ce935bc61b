"""Ablation runs: what they differ in, what they learn from, how they are trained and timed."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from meshmatch.errors import TemplateError
from meshmatch.experiments.paper import ablation_setting, ablation_training, ablation_transmatch
from meshmatch.experiments.paper.ablation_setting import SCANS, Setting, pool_of
from meshmatch.experiments.paper.ablation_training import (
    built,
    fewer,
    is_trained,
    memory,
    new_network,
    planned,
    timed,
    train_run,
)
from meshmatch.experiments.paper.ablation_transmatch import train_transformer
from meshmatch.experiments.paper.ablation_views import (
    BASE,
    CODED,
    CONSTRAINTS,
    POSES,
    TABLE4,
    TRANSMATCH,
    VIEWS,
    Run,
    all_runs,
    methods_of,
)
from meshmatch.experiments.paper.learned_baselines import TransConfig
from meshmatch.fields.shape_functions import FIELDS, FieldName
from meshmatch.geometry.frames import kabsch
from meshmatch.models.registry import load_model
from meshmatch.templates.make import Laid
from meshmatch.templates.template import read_template
from meshmatch.training.train import build_loss_points
from tests.experiments.egg_runs import make_small, prepare_eggs


class Work(TorchDispatchMode):
    """Counts the multiplications and additions of products of matrices, gradients included."""

    def __init__(self) -> None:
        super().__init__()
        self.done = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        if func._overloadpacket in flop_registry:
            self.done += flop_registry[func._overloadpacket](*args, **(kwargs or {}), out_val=out)
        return out


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return prepare_eggs(tmp_path_factory.mktemp("eggs"))


@pytest.fixture
def setting(prepared: Path, monkeypatch: pytest.MonkeyPatch) -> Setting:
    make_small(monkeypatch)
    return Setting(folder=str(prepared))


def test_every_view_looks_at_the_same_cells() -> None:
    runs = all_runs(list(VIEWS))
    assert len(runs) == len(set(runs)) == 45
    assert runs[0] == BASE
    assert len({run.name for run in runs}) == 45
    assert BASE.name == "base"
    assert Run(field="rbf", constraint="vol+arap", seed=2).name == "field-rbf.constraint-vol-arap.seed-2"
    for view in VIEWS.values():
        assert view.runs[0] == BASE
    # all but table 4's runs and the repetitions differ from the base in one thing, or in two of a table
    for run in runs:
        apart = [each.name for each in fields(run) if getattr(run, each.name) != getattr(BASE, each.name)]
        assert len(apart) <= (2 if run.field in ("mls", "rbf") else 3)  # others, and how much they have
    again = all_runs(["table4", "figure9"], 3, ["table4"])
    assert len(again) == 9 + 3 + 3 + 4 + 18
    assert [run.seed for run in again[:19]] == [0] * 19


def test_cells_differ_in_representation_and_constraints_alone() -> None:
    setting = Setting(preset="paper", threads=2)
    for field in FIELDS:
        none, arap, vol, both, every = (setting.recipe(Run(field, each, seed=3)) for each in CONSTRAINTS)
        assert none.network == both.network == every.network
        assert none.network.field == field
        assert [r.train.loss.volume for r in (none, arap, vol, both, every)] == [0, 0, 5e-3, 5e-3, 5e-3]
        assert [r.train.loss.arap for r in (none, arap, vol, both, every)] == [0, 1e-2, 0, 1e-2, 1e-2]
        assert [r.train.loss.blend for r in (none, arap, vol, both, every)] == [0, 0, 0, 0, 5e-3]
        assert (none.train.threads, none.train.seed) == (2, 3)
    assert Setting(preset="paper").recipe(BASE).train.shapes == 16
    assert Setting(preset="default").recipe(BASE).network.encoder == "basis"
    for preset in ("small", "default", "paper"):
        chosen = Setting(preset=preset).recipe(replace(BASE, kernel="cubic"))  # type: ignore[arg-type]
        assert chosen.kernel == "cubic"
        assert chosen.network.align_basis == chosen.network.corrections == 0
        assert not chosen.scan.upright


@pytest.mark.slow
def test_where_a_rule_leaves_too_few_nodes_all_are_taken(prepared: Path) -> None:
    setting = Setting(unit="sphere")
    assert setting.rule(BASE) == "parts"
    assert setting.template(BASE).K == 300
    assert setting.template(BASE).radius == pytest.approx(0.13)
    assert Setting().template(BASE).radius == pytest.approx(read_template("human-T-300").radius, abs=0.005)
    arms_down = replace(BASE, pose="A")  # the rule leaves vertices short there: radii grow, the rule stays
    assert Setting().rule(arms_down) == "parts"
    assert Setting().template(arms_down).K == 300 and isinstance(Setting().template(arms_down).radius, np.ndarray)
    wide = replace(BASE, nodes=100, radius=0.5)
    assert setting.rule(wide) == "uniform"
    assert setting.template(wide).K == 100
    with pytest.raises(TemplateError):
        Setting(folder=str(prepared)).template(replace(BASE, nodes=4, radius=0.01))
    assert setting.template(replace(BASE, pose="A")).name == "human-A"


def test_a_run_is_measured_alike_with_every_seed() -> None:
    for run in all_runs(list(VIEWS)):
        assert methods_of(replace(run, seed=3)) == methods_of(run)
    assert methods_of(replace(BASE, seed=1)) == ("code", "none", "chamfer", "nodes")
    assert methods_of(replace(BASE, field="rbf", seed=1)) == ("code", "nodes")
    assert methods_of(replace(BASE, pose="A", seed=1)) == ("code",)
    assert methods_of(replace(TRANSMATCH, shapes=250)) == ("none",)


def test_a_pool_is_drawn_once_and_some_of_it_is_held_out(setting: Setting) -> None:
    drawn = pool_of(setting, "T", 7)
    assert drawn.targets.shape == (7 * SCANS, 642, 3)
    assert drawn.features.shape[:2] == (7 * SCANS, 24)
    assert len(drawn.held_out.targets) == 5
    again = pool_of(setting, "T", 7)
    assert torch.equal(drawn.features, again.features)
    network = new_network(BASE, setting, drawn)
    other = new_network(replace(BASE, seed=1), setting, drawn)
    assert torch.equal(network.encoder.basis, drawn.basis)
    assert torch.equal(other.encoder.basis, drawn.basis)
    # What a batch's features say is what the encoder would say of a scan.
    batch = drawn.batch(3, 6, 2, 0, network.encoder)
    first = drawn.targets[: 2 * SCANS]
    for target in batch.targets:
        assert any(torch.equal(target, each) for each in first)
    assert torch.equal(batch.targets, drawn.batch(3, 6, 2, 0, network.encoder).targets)
    assert not torch.equal(batch.targets, drawn.batch(4, 6, 2, 0, network.encoder).targets)
    assert not torch.equal(batch.targets, drawn.batch(3, 6, 2, 1, network.encoder).targets)


def test_a_network_that_reads_points_gets_points(setting: Setting, monkeypatch: pytest.MonkeyPatch) -> None:
    paper = replace(setting, preset="paper")
    drawn = pool_of(paper, "T", 2)
    assert drawn.features.shape == (2 * SCANS, 0, 3)
    network = new_network(BASE, paper, drawn)
    batch = drawn.batch(0, 2, 2, 0, network.encoder)
    assert torch.equal(batch.encode_features, network.encoder.features(batch.points))
    assert batch.points.shape == (2, 3000, 3)


def test_held_out_eggs_are_not_in_the_pool(setting: Setting) -> None:
    ours, unseen = (source(30, torch.Generator().manual_seed(0)) for source in setting.sources("T"))
    apart = torch.cdist(ours.flatten(1), unseen.flatten(1))
    assert apart.min() > 1e-3


@pytest.mark.parametrize("run", [BASE, CODED, replace(BASE, supervised=50), replace(BASE, field="rbf")])
def test_a_cell_is_trained_into_a_model(
    run: Run, setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = pool_of(setting, "T", 3)
    monkeypatch.setattr(ablation_training, "pool_of", lambda *_: small)
    found = train_run(run, setting, tmp_path / "model", minutes=0.005)
    assert found["steps"] >= 1
    assert found["seconds"] >= 0.3
    assert 0 < found["held_out_cm"] < 200
    assert (found["nodes"], found["rule"]) == (300, "parts")
    assert np.mean(found["bodies_cm"]) == pytest.approx(found["held_out_cm"], abs=1e-3)
    assert len(found["bodies_cm"]) == len(small.held_out.targets)
    model = load_model(tmp_path / "model")
    assert model.network.config.field == run.field
    assert model.card.steps == found["steps"]
    assert is_trained(tmp_path / "model", found)
    assert not is_trained(tmp_path / "model", found | {"model": "0"})
    assert not is_trained(tmp_path, found)


def test_longer_training_is_better(setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = setting.sources("T")[0]
    monkeypatch.setattr(Setting, "sources", lambda *_: (source, source))  # as well as what it learns from
    small = pool_of(setting, "T", 8)
    monkeypatch.setattr(ablation_training, "pool_of", lambda *_: small)
    none = replace(BASE, constraint="none")
    short, long = (train_run(none, setting, tmp_path / str(n), steps=n)["held_out_cm"] for n in (1, 200))
    assert long < short - 0.03


def test_transmatch_learns_from_the_scans_of_the_others(
    setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = setting.sources("T")[0]
    monkeypatch.setattr(Setting, "sources", lambda *_: (source, source))
    small, theirs = (pool_of(setting, "T", 8, read_points=read) for read in (True, False))
    assert torch.equal(small.targets, theirs.targets) and torch.equal(small.features, theirs.features)
    assert small.points.shape == (8 * SCANS, 64, 3) and theirs.points.shape == (8 * SCANS, 0, 3)
    far = torch.cdist(small.targets, small.points).amin(2)
    assert far.mean() < 0.8 * torch.cdist(small.targets, small.points.roll(SCANS, 0)).amin(2).mean()
    monkeypatch.setattr(ablation_transmatch, "pool_of", lambda *_, **__: small)
    config = TransConfig(width=32, heads=2, latents=8, depth=1, frequencies=2)
    few = replace(TRANSMATCH, supervised=50)
    short, long, less = (
        train_transformer(run, setting, tmp_path / str(k), steps=steps, config=config)
        for k, (run, steps) in enumerate([(TRANSMATCH, 1), (TRANSMATCH, 150), (few, 150)])
    )
    assert long["held_out_cm"] < 0.9 * short["held_out_cm"]
    assert long["steps"] == 150 and len(long["bodies_cm"]) == len(small.held_out.targets)
    assert less["model"] != long["model"] and less["held_out_cm"] < short["held_out_cm"]
    assert is_trained(tmp_path / "1", long) and not is_trained(tmp_path / "1", short)


def test_a_number_of_steps_is_a_budget_too(setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small = pool_of(setting, "T", 2)
    monkeypatch.setattr(ablation_training, "pool_of", lambda *_: small)
    first, again = (train_run(BASE, setting, tmp_path / name, steps=7) for name in ("a", "b"))
    assert first["steps"] == again["steps"] == 7
    assert first["model"] == again["model"]


def test_fewer_supervised_points_are_regularised_everywhere(setting: Setting) -> None:
    drawn = pool_of(setting, "T", 2)
    network = new_network(BASE, setting, drawn)
    points = build_loss_points(setting.template(BASE), "smooth", network)
    few = fewer(points, 50)
    vectors = torch.randn(2, 300, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    assert torch.allclose(few.moved(vectors), points.moved(vectors)[:, :50], atol=1e-6)
    assert torch.equal(few.field.deformation_gradient(vectors), points.field.deformation_gradient(vectors))
    assert fewer(points, 1000) is points


def test_fewer_supervised_points_of_a_network_at_every_point(setting: Setting) -> None:
    network = new_network(CODED, setting, pool_of(setting, "T", 2))
    points = build_loss_points(setting.template(CODED), "smooth", network, gradients=200)
    few = fewer(points, 50)
    rows = network.decoder(torch.randn(2, network.config.code, generator=torch.Generator().manual_seed(0)))
    assert torch.allclose(few.moved(rows), points.moved(rows)[:, :50], atol=1e-6)
    assert few.field.deformation_gradient(rows).shape[1] == 200


def test_cells_take_turns(setting: Setting) -> None:
    runs = [replace(BASE, field=field) for field in FIELDS]
    found = timed(setting, runs, 2)
    assert set(found) == {"base", "field-rbf", "field-pointwise"}
    for record in found.values():
        assert record["rounds"] == 2 and record["ms"] > 0 and record["cpu_ms"] > 0


def test_a_plan_multiplies_the_cost_of_an_iteration(setting: Setting) -> None:
    """Runs that cost alike are one row, whatever their seeds and rules."""
    runs = [BASE, replace(BASE, seed=1), replace(BASE, strategy="uniform"), CODED]
    rows = planned(setting, runs, 600, rounds=1)
    assert [(row["field"], row["constraint"], row["runs"]) for row in rows] == [
        ("mls", "vol+arap+Z", 3),
        ("pointwise", "none", 1),
    ]
    for row in rows:
        assert row["minutes"] == pytest.approx(row["runs"] * row["cpu_ms"] / 100, abs=0.006)


def test_a_step_has_the_batch_that_is_asked_for() -> None:
    assert Setting(batch=5).recipe(BASE).train.shapes == 5
    assert Setting().recipe(BASE).train.shapes == 32


def test_a_cell_without_constraints_has_no_terms_of_them(setting: Setting) -> None:
    trainer, batches = built(setting, CODED)
    assert set(trainer.iterate(batches[0])) == {"total", "reconstruction", "error_code"}
    trainer, batches = built(setting, replace(BASE, field="pointwise"))
    assert {"volume", "arap", "blend"} < set(trainer.iterate(batches[0]))
    assert trainer.step == 1


def test_constraints_multiply_the_work_of_a_pointwise_network(prepared: Path) -> None:
    setting = Setting(folder=str(prepared))

    def work(field: FieldName, constraint: str) -> int:
        trainer, batches = built(setting, replace(BASE, field=field, constraint=constraint))
        with Work() as work:
            trainer.iterate(batches[0])
        return work.done

    factor = {field: work(field, "vol+arap+Z") / work(field, "none") for field in FIELDS}
    assert factor["mls"] < 2
    assert factor["rbf"] < 2
    assert factor["pointwise"] > 3
    assert work("pointwise", "vol+arap+Z") > 10 * work("mls", "vol+arap+Z")


def test_memory_is_that_of_the_iterations(prepared: Path) -> None:
    # In a process of its own, which knows nothing of a smaller recipe.
    run = replace(BASE, field="pointwise", constraint=TABLE4[1])
    found = memory(Setting(folder=str(prepared)), run, 1)
    assert "resident set" in found["how"] or "GPU" in found["how"]
    # 32 x 642 points, layers of 384 numbers, in float32, are 4 MB and more with what gradients keep
    assert found["megabytes"] > 4


def test_a_template_of_heavy_people_stands_as_the_usual_one() -> None:
    pytest.importorskip("anny", reason="the body model is of the extra `train`")
    usual, heavy = (Setting().resting(pose) for pose in ("T", "T-heavy"))
    assert (heavy.pose, heavy.shape.V) == ("T", usual.shape.V) and np.array_equal(heavy.shape.faces, usual.shape.faces)
    assert heavy.shape.area == pytest.approx(1, abs=0.01)
    assert np.array_equal(heavy.core, usual.core) and np.array_equal(heavy.labels, usual.labels)
    turned = kabsch(usual.shape.verts[usual.core], heavy.shape.verts[heavy.core]).frame
    assert np.trace(turned.rotation) > 2.99  # up and to the front as well
    tall, short = (np.ptp(each.shape.verts[:, 1]) for each in (usual, heavy))
    assert short < 0.95 * tall  # of the same area
    assert POSES == ("T", "A", "I", "T-heavy")


def test_what_a_milder_rule_refuses_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablation_setting, "lay_nodes", lambda *_: Laid(np.zeros((4, 3)), 0.17, 0.9, 0.2))
    run = replace(BASE, strategy="geodesic", nodes=4, radius=0.123)  # of no other test, whose nodes are remembered
    assert (Setting().rule(run), Setting().taken(run)) == ("geodesic", 0.2)
