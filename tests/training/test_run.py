"""From a folder of registered shapes to a model that loads, and on from there."""

import json
import pickle
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from meshmatch.api.prepare import PrepareConfig, prepare
from meshmatch.errors import InputError, MeshmatchWarning, ModelError, OptionError, OutputError, TemplateError
from meshmatch.experiments.makers import human_bodies
from meshmatch.fields.shape_functions import build_field
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.fitting.fitter import Fitter
from meshmatch.generators import bodies
from meshmatch.generators import rig as rigs
from meshmatch.generators.bodies import Bodies
from meshmatch.generators.generator import Source
from meshmatch.generators.kinds import Kind
from meshmatch.implicit.training import train_implicit
from meshmatch.locks import locked
from meshmatch.models.layers import Encoder
from meshmatch.models.registry import load_model, verify_model
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig
from meshmatch.templates.prepared_folder import RegisteredShapes, read_registered, read_samples
from meshmatch.templates.template import Template, read_template
from meshmatch.training.datasets import registered_source
from meshmatch.training.load_data import known_template
from meshmatch.training.loop import StepReport, TrainConfig, Trainer
from meshmatch.training.losses import ChamferLoss, CorrespondenceLoss
from meshmatch.training.recipe_files import read_recipe
from meshmatch.training.recipes import Recipe, default, fine_tuning, paper, people, recipe_for
from meshmatch.training.records import curves
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import CardFacts, train, train_model
from tests.generators.stick import stick_figure
from tests.training.small import (
    NETWORK,
    POINTS,
    SCAN,
    UPRIGHT,
    egg_template,
    prepared_eggs,
    registered_eggs,
    small_data,
    small_network,
)

SMALL = Recipe(NETWORK, TrainConfig(steps=4, shapes=4, scans_per_shape=1, workers=0, warm_up=1), SCAN, "smooth")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of five registered eggs, prepared."""
    return prepared_eggs(tmp_path_factory.mktemp("eggs"), 5)


def test_nodes_with_radii_of_their_own_are_learned_and_fitted(prepared: Path, tmp_path: Path) -> None:
    """From the folder through training, the model's file and card to the shape functions of a fit."""
    template = egg_template()
    nodes = NodeConfig(strategy="uniform", K=24, radius=0.2, depth=0.05, grow=True)
    prepare(prepared.parent / "in", tmp_path / "few", PrepareConfig(nodes))
    own = read_template(tmp_path / "few" / "template.safetensors")
    assert isinstance(own.radius, np.ndarray) and own.K == 24
    model = load_model(trained(tmp_path / "few", tmp_path / "model"))
    assert model.template.hash == own.hash
    assert model.card.field["radius"] == own.reach == own.radius.max()
    vectors = 0.05 * np.random.default_rng(0).standard_normal((24, 3))
    functions = model.field(own.shape.verts)
    wanted = build_field(own.shape.verts, own.nodes, own.radius, "smooth")
    assert np.array_equal(functions.displaced(vectors), wanted.displaced(vectors))
    one = build_field(own.shape.verts, own.nodes, own.reach, "smooth")
    assert not np.allclose(one.displaced(vectors), wanted.displaced(vectors), atol=1e-3)
    points = 0.2 * np.random.default_rng(1).standard_normal((50, 3))
    drawn = model.network(torch.from_numpy(points).float()[None])[0].detach().numpy()
    assert np.allclose(model.inference.predict([points])[0], drawn, atol=1e-4)
    other = Shape(template.shape.verts * [1, 1.1, 1], template.shape.faces)
    fit = Fitter(model, FitConfig(samples=300, coarse_samples=60, careful=1, partial="no")).fit(other)
    assert np.isfinite(fit.residual)


def egg_source(prepared: Path, template: Template) -> Source:
    return registered_source(torch.from_numpy(read_registered(prepared, template)))


def trained(prepared: Path, output: Path, chosen: Recipe = SMALL, **more) -> Path:
    facts = CardFacts("eggs", "eggs", "5 eggs", "CC0-1.0", start=more.pop("start", None))
    return train(output, shapes=prepared, recipe=chosen, facts=facts, **more)


@pytest.mark.parametrize(
    "chosen", [SMALL, replace(SMALL, network=POINTS, scan=UPRIGHT, kernel="cubic")], ids=["default", "paper"]
)
def test_a_folder_becomes_a_model(prepared: Path, tmp_path: Path, chosen: Recipe) -> None:
    seen: list[StepReport] = []
    folder = trained(prepared, tmp_path / "model", chosen, report=seen.append)
    card = verify_model(folder)
    assert (card.name, card.category, card.data, card.licence) == ("eggs", "eggs", "5 eggs", "CC0-1.0")
    assert card.steps == 4
    assert card.field == {"kernel": chosen.kernel, "radius": 0.45, "nodes": card.field["nodes"]}
    assert card.recipe["train"]["shapes"] == 4
    assert card.recipe["scan"]["points"] == 96
    assert card.metrics["validation"]["distance"] > 0
    assert seen[-1].step == 4
    (line,) = (folder / "metrics.jsonl").read_text().splitlines()
    assert json.loads(line) == {
        "step": 4,
        "rate": seen[-1].rate,
        "seconds": json.loads(line)["seconds"],
        **seen[-1].terms,
        "validation": seen[-1].validation,
    }
    model = load_model(folder)
    assert model.card == card
    points = torch.randn(2, 50, 3, generator=torch.Generator().manual_seed(0)) * 0.2
    assert model.network(points).shape == (2, model.template.K, 3)
    assert not model.network.training


def test_orientations_that_are_learned_first_are_told_of(prepared: Path, tmp_path: Path) -> None:
    told: list[tuple[str, float]] = []
    first = replace(SMALL, train=replace(SMALL.train, align_steps=2))
    trained(prepared, tmp_path / "model", first, progress=lambda stage, name, share: told.append((stage, share)))
    at = told.index(("orientations alone (once)", 0.5))
    assert told[at + 1] == ("orientations alone (once)", 1.0)
    assert told[at + 2] == ("step 1 of 4", 0.25)  # each step is told of, for it may take long
    assert told[-1][0].startswith("step 4 of 4: total ") and told[-1][1] == 1


@dataclass(frozen=True)
class Masked(CorrespondenceLoss):
    """A loss of one's own with something that no card can hold."""

    mask: object = None


def test_what_no_card_could_hold_is_refused_before_the_work(prepared: Path, tmp_path: Path) -> None:
    for mask in (torch.ones(3), float("inf")):
        recipe = replace(SMALL, train=replace(SMALL.train, loss=Masked(mask=mask)))
        with pytest.raises(OptionError, match="a card cannot hold"):
            trained(prepared, tmp_path / "model", recipe)
    assert not (tmp_path / "model" / "metrics.jsonl").exists()
    template = read_template(prepared / "template.safetensors")
    source = egg_source(prepared, template)
    for facts, words in (
        (CardFacts("My eggs"), "cannot be the name"),
        (CardFacts("eggs", stiffness=0.0), "stiffness must be above 0"),
        (CardFacts("eggs", mirror="yes"), "mirror must be one of"),
    ):
        with pytest.raises(ModelError, match=words):
            train_model(template, source, tmp_path / "other", SMALL, facts)
    assert not (tmp_path / "other").exists()


def test_a_loss_for_other_shapes_is_refused_before_the_work(prepared: Path, tmp_path: Path) -> None:
    template = read_template(prepared / "template.safetensors")
    unregistered = replace(SMALL, train=replace(SMALL.train, loss=ChamferLoss()))
    samples = read_samples(prepared, template)
    for source, recipe, words in (
        (egg_source(prepared, template), unregistered, "without known correspondence"),
        (samples, SMALL, "with known correspondence"),
    ):
        with pytest.raises(OptionError, match=words) as caught:
            train_model(template, source, tmp_path / "model", recipe, CardFacts("eggs"))
        assert "Loss" in caught.value.hint and not (tmp_path / "model").exists()


def test_a_model_without_words_is_called_as_its_folder(prepared: Path, tmp_path: Path) -> None:
    template = read_template(prepared / "template.safetensors")
    train_model(template, egg_source(prepared, template), tmp_path / "eggs", SMALL, CardFacts())
    card = verify_model(tmp_path / "eggs")
    assert (card.name, card.category) == ("eggs", "eggs")


def test_the_best_model_so_far_is_kept_beside_the_last(prepared: Path, tmp_path: Path, monkeypatch: Any) -> None:
    scores = iter([0.3, 0.2, 0.25, 0.5])  # of three validations on the way, and at the end
    monkeypatch.setattr("meshmatch.training.train.held_out_error", lambda *_: next(scores))
    run = Trainer.run
    monkeypatch.setattr(Trainer, "run", lambda *args, **more: run(*args, **more, every=1))  # validated every ten steps
    folder = trained(prepared, tmp_path / "model", SMALL.changed(steps=30))
    best, last = load_model(folder / "best").card, load_model(folder).card
    assert (best.steps, last.steps) == (20, 30)
    assert [each.metrics["validation"]["distance"] for each in (best, last)] == [0.2, 0.5]
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["validation"] for row in rows if "validation" in row] == [0.3, 0.2, 0.25]


def test_a_best_model_of_the_step_where_a_run_stopped_is_kept(
    prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scores = iter([0.3, 0.1, 0.2, 0.2, 0.2])  # of step 10 and of the stop; then of steps 20, 30 and the end
    stopped = False

    def measured(*_: object) -> float:
        nonlocal stopped
        stopped = True
        return next(scores)

    monkeypatch.setattr("meshmatch.training.train.held_out_error", measured)
    run, is_true = Trainer.run, Trainer.any_process
    monkeypatch.setattr(Trainer, "run", lambda *args, **more: run(*args, **more, every=1))
    monkeypatch.setattr(Trainer, "any_process", lambda self, flag: is_true(self, flag) or stopped)
    recipe = SMALL.changed(steps=30, minutes=60.0)
    folder = trained(prepared, tmp_path / "model", recipe)
    assert load_model(folder / "best").card.metrics["validation"]["distance"] == 0.1
    monkeypatch.setattr(Trainer, "any_process", is_true)
    assert load_model(trained(prepared, folder, recipe)).card.steps == 30
    best = load_model(folder / "best").card
    assert best.steps < 20 and best.metrics["validation"]["distance"] == 0.1


def test_another_folder_can_be_measured_on(prepared: Path, tmp_path: Path) -> None:
    usual = trained(prepared, tmp_path / "usual")
    template = read_template(prepared / "template.safetensors")
    flat = RegisteredShapes(template, read_registered(prepared, template)[:1] * [1, 0.5, 1], "flat", "none")
    there = trained(prepared, tmp_path / "there", validation=flat)
    card, other = load_model(usual).card, load_model(there).card
    assert card.weights_sha256 == other.weights_sha256 and card.metrics != other.metrics
    told = [each.recipe["validation"] for each in (card, other)]
    assert told == ["the learned shapes, drawn anew", "1 fits of flat"]
    with pytest.warns(MeshmatchWarning, match="5 of 5 validation shapes are also training shapes"):
        same = load_model(trained(prepared, tmp_path / "same", validation=prepared)).card
    assert same.weights_sha256 == card.weights_sha256
    assert read_recipe(tmp_path / "same" / "card.json", SMALL) == SMALL
    other_template = replace(flat, template=replace(template, core=template.core[:-1]))
    for wrong, error in ((tmp_path / "usual", "not a prepared folder"), (other_template, "another template")):
        with pytest.raises(InputError, match=error):
            trained(prepared, tmp_path / "wrong", validation=wrong)


def test_tensorboard_is_asked_for_before_shapes_are_made(prepared: Path, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    with pytest.raises(OptionError, match="needs tensorboard") as caught:
        trained(prepared, tmp_path / "model", tensorboard=True)
    assert "meshmatch[tensorboard]" in caught.value.hint and not (tmp_path / "model").exists()


def test_curves_have_the_numbers_of_the_reports(tmp_path: Path, monkeypatch: Any) -> None:
    drawn: list[tuple[str, float, int]] = []

    class Writer:
        def __init__(self, folder: Path, purge_step: int) -> None:
            assert (folder, purge_step) == (tmp_path, 51)

        def add_scalar(self, name: str, value: float, step: int) -> None:
            drawn.append((name, value, step))

        def flush(self) -> None:
            pass

    monkeypatch.setitem(sys.modules, "tensorboard", ModuleType("tensorboard"))
    board = ModuleType("torch.utils.tensorboard")
    board.SummaryWriter = Writer  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", board)
    curves(tmp_path, 50)(StepReport(100, 200, 1e-3, 1.0, {"total": 2.0}, 0.5))
    assert drawn == [("rate", 1e-3, 100), ("loss/total", 2.0, 100), ("validation", 0.5, 100)]


def test_batches_are_drawn_on_the_cpu_wherever_the_model_is() -> None:
    template = egg_template()
    model = small_network(template)
    data = small_data(template, model)
    there = data[0]
    model.to("meta")  # a device on which nothing can be computed
    assert torch.equal(data[0].encode_features, there.encode_features)
    assert there.align_features is not None and data[0].align_features is not None
    assert torch.equal(data[0].align_features, there.align_features)


def test_a_training_begun_from_a_model_goes_on_without_being_told_of_it(prepared: Path, tmp_path: Path) -> None:
    """The basis of the encoder is the model's, and reads the rest of the batches too."""
    other = replace(SMALL, train=replace(SMALL.train, seed=5))
    start = load_model(trained(prepared, tmp_path / "start", other))
    whole = verify_model(trained(prepared, tmp_path / "whole", start=start))
    half = replace(SMALL, train=replace(SMALL.train, minutes=1e-9))
    trained(prepared, tmp_path / "stopped", half, start=start)  # one step of four
    card = verify_model(trained(prepared, tmp_path / "stopped"))
    assert (card.steps, card.weights_sha256) == (4, whole.weights_sha256)


def test_training_goes_on_from_the_checkpoint_unless_told_not_to(prepared: Path, tmp_path: Path) -> None:
    whole = verify_model(trained(prepared, tmp_path / "whole"))
    # the schedule is that of four steps; a folder whose run was stopped after two
    stopped = tmp_path / "stopped"

    half = replace(SMALL, train=replace(SMALL.train, checkpoint_minutes=0.0))
    template = read_template(prepared / "template.safetensors")
    source = egg_source(prepared, template)
    calls = iter(range(100))

    def interrupted(count: int, generator: torch.Generator) -> torch.Tensor:
        if next(calls) == 4:  # the basis and the held-out batch are drawn first, then the steps
            raise KeyboardInterrupt
        return source(count, generator)

    with pytest.raises(KeyboardInterrupt):
        train_model(template, interrupted, stopped, half, CardFacts("eggs"))
    assert (stopped / "checkpoint" / "last.safetensors").is_file()
    assert not (stopped / "card.json").exists()  # no model yet
    assert verify_model(trained(prepared, stopped)).weights_sha256 == whole.weights_sha256
    again = verify_model(trained(prepared, stopped))  # nothing left to do: the same model
    assert (again.weights_sha256, again.steps) == (whole.weights_sha256, 4)
    longer = replace(SMALL, train=replace(SMALL.train, steps=6))
    with pytest.warns(MeshmatchWarning, match="steps 4 is 6 now"):
        found = verify_model(trained(prepared, stopped, longer))
    assert (found.steps, found.recipe["earlier"]) == (6, [{"until_step": 4, "train.steps": 4}])
    other = replace(SMALL, train=replace(SMALL.train, seed=1))
    fresh = verify_model(trained(prepared, stopped, other, resume=False))
    assert (fresh.steps, fresh.seed) == (4, 1)
    assert fresh.weights_sha256 != whole.weights_sha256


class Pooled(Encoder):
    """An encoder of a user."""

    def __init__(self, basis: torch.Tensor, outputs: int) -> None:
        super().__init__()
        self.reach = torch.nn.Parameter(basis.norm(dim=1).max())
        self.code = torch.nn.Linear(3, outputs)

    def features(self, points: torch.Tensor) -> torch.Tensor:
        return 2 * points

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = self.code((features / self.reach).amax(1))
        return found


def test_an_encoder_of_ones_own_is_trained_kept_and_asked_for(prepared: Path, tmp_path: Path) -> None:
    own = replace(SMALL, network=replace(NETWORK, encoder=Pooled))
    folder = trained(prepared, tmp_path / "pooled", own)
    name = f"{Pooled.__module__}.Pooled"
    with pytest.raises(ModelError, match=f"a custom encoder, '{name}'") as caught:
        load_model(folder)
    assert "encoder=" in caught.value.hint
    with pytest.raises(ModelError, match=r"not 'meshmatch\.models\.layers\.Encoder"):
        load_model(folder, encoder=Encoder)
    for wrong in (Pooled(torch.ones(1, 3), 2), "Pooled", lambda basis, outputs: Pooled(basis, outputs), int):
        with pytest.raises(ModelError, match="a class with features and forward"):
            load_model(folder, encoder=wrong)  # type: ignore[arg-type]
        if wrong != "Pooled":
            with pytest.raises(ModelError, match="a class with features and forward"):
                replace(NETWORK, encoder=wrong)
    moved = type("Pooled", (Pooled,), {"__module__": "__main__"})
    assert load_model(folder, encoder=moved).card.network["encoder"] == name
    model = load_model(folder, encoder=Pooled)
    assert model.card.network["encoder"] == name and isinstance(model.network.encoder, Pooled)
    eggs = np.asarray(egg_template().shape.verts)
    found = model.inference.predict([eggs, eggs[::-1]])
    np.testing.assert_allclose(found[0], found[1], atol=1e-5)  # whatever the order of the points
    learned = model.network.state_dict()
    assert not torch.equal(learned["encoder.reach"], small_network(egg_template(), own.network).encoder.reach)
    again = pickle.loads(pickle.dumps(model))
    assert again.card == model.card
    np.testing.assert_array_equal(again.inference.predict([eggs]), found[:1])
    fit = Fitter(model, FitConfig(samples=300, coarse_samples=60, careful=1, partial="no")).fit(egg_template().shape)
    assert np.isfinite(fit.points).all()
    longer = replace(own, train=replace(own.train, steps=6))
    with pytest.warns(MeshmatchWarning, match="other settings"):
        assert load_model(trained(prepared, folder, longer), encoder=Pooled).card.steps == 6
    ours = trained(prepared, tmp_path / "ours")
    with pytest.raises(ModelError, match="the built-in encoder"):
        load_model(ours, encoder=Pooled)


class Failing(Pooled):
    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward(features) @ torch.ones(3, 3)


class Short(Pooled):
    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward(features)[:, 1:]


class Unmade(Pooled):
    def __init__(self, basis: torch.Tensor, outputs: int) -> None:
        raise KeyError("layers")


@pytest.mark.parametrize(
    ("encoder", "words"),
    [
        (Failing, "Failing fails: RuntimeError: .*shapes cannot be multiplied"),
        (Short, r"Short fails: ValueError: it gives \(2, 15\) instead of \(2, 16\)"),
        (Unmade, "Unmade fails: KeyError: 'layers'"),
    ],
)
def test_an_encoder_that_fails_is_named_before_anything_is_learned(
    prepared: Path, tmp_path: Path, encoder: type[Encoder], words: str
) -> None:
    own = replace(SMALL, network=replace(NETWORK, encoder=encoder))
    with pytest.raises(ModelError, match=f"the encoder {__name__}.{words}") as caught:
        trained(prepared, tmp_path / "model", own)
    assert caught.value.__cause__ is not None and caught.value.__cause__.__traceback__ is not None
    assert not (tmp_path / "model" / "metrics.jsonl").exists()


def test_trying_an_encoder_leaves_no_trace(prepared: Path, tmp_path: Path, monkeypatch: Any) -> None:
    own = replace(SMALL, network=replace(NETWORK, encoder=Pooled))
    tried = load_model(trained(prepared, tmp_path / "tried", own), encoder=Pooled).card
    monkeypatch.setattr("meshmatch.training.train.check_encoder", lambda *_: None)
    assert (
        load_model(trained(prepared, tmp_path / "not", own), encoder=Pooled).card.weights_sha256 == tried.weights_sha256
    )


@pytest.mark.parametrize("unsupervised", [False, True])
def test_a_checkpoint_goes_on_with_no_other_shapes(prepared: Path, tmp_path: Path, unsupervised: bool) -> None:
    chosen = replace(recipe_for(prepared, unsupervised=unsupervised), network=SMALL.network).changed(
        steps=4, points=96, workers=0, minutes=1e-9
    )
    trained(prepared, tmp_path / "model", chosen)
    moved, fewer = tmp_path / "moved", tmp_path / "fewer"
    shutil.copytree(prepared, moved)
    assert load_model(trained(moved, tmp_path / "model", chosen)).card.steps == 2
    eggs = registered_eggs(tmp_path / "eggs", 5)
    (eggs / "egg4.ply").unlink()
    nodes = NodeConfig(strategy="uniform", K=36, radius=0.45, depth=0.05)
    prepare(eggs, fewer, PrepareConfig(nodes))
    assert read_template(fewer / "template.safetensors").hash == read_template(prepared / "template.safetensors").hash
    with pytest.raises(ModelError, match="a training with other shapes") as caught:
        trained(fewer, tmp_path / "model", chosen)
    assert "--start" in caught.value.hint
    assert load_model(trained(fewer, tmp_path / "model", chosen, resume=False)).card.steps == 1


def test_a_training_may_begin_with_a_models_weights(prepared: Path, tmp_path: Path) -> None:
    first = load_model(trained(prepared, tmp_path / "first"))
    slow = replace(SMALL, train=replace(SMALL.train, rate=1e-9, seed=3))
    second = load_model(trained(prepared, tmp_path / "second", slow, start=first))
    scratch = load_model(trained(prepared, tmp_path / "scratch", slow))

    def apart(a: TrainedModel, b: TrainedModel) -> float:
        both = zip(a.network.parameters(), b.network.parameters(), strict=True)
        return max(float((x - y).detach().abs().max()) for x, y in both)

    assert apart(first, second) < 0.01 < apart(first, scratch)  # but for 8-bit rounding
    begun = second.card.recipe["start"]
    assert begun == {"model": "eggs", "weights_sha256": first.card.weights_sha256, "steps": 4}
    assert "start" not in scratch.card.recipe
    with pytest.raises(OptionError, match="another kernel") as caught:
        trained(prepared, tmp_path / "other", replace(SMALL, kernel="cubic"), start=first)
    assert "`meshmatch fit ... --model eggs`" in caught.value.hint
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize(("kind", "start"), [("quadruped", "human"), ("human", "quadruped")])
def test_a_model_to_start_from_is_looked_at_before_shapes_are_made(
    kind: str, start: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their networks and kernels are equal, their templates are not."""
    monkeypatch.setattr("meshmatch.training.train.load_training_data", lambda *_: pytest.fail("shapes were made"))
    with pytest.raises(OptionError, match=f"model {start} has another template$"):
        train(tmp_path / "other", kind=kind, facts=CardFacts(start=start))
    assert not list(tmp_path.iterdir())


def test_the_template_of_a_training_is_known_before_its_shapes(prepared: Path) -> None:
    human, quadruped = load_model("human"), load_model("quadruped")
    usual = people()

    def known(shapes=None, kind=None, start=human):
        found = known_template(shapes, kind, usual, start)
        return None if found is None else found.hash

    assert known() == known(kind=Bodies()) == human.template.hash
    assert known(kind=Bodies("human-I")) == read_template("human-I").hash != human.template.hash
    assert known(kind=Kind("quadruped")) == quadruped.template.hash
    assert known(kind=Kind("quadruped"), start=quadruped) is None  # another one may be made
    assert known(prepared) == read_template(prepared / "template.safetensors").hash
    fits = RegisteredShapes(human.template, np.asarray(human.template.shape.verts)[None], "fits", "human")
    assert known(fits) == human.template.hash


def test_a_model_goes_on_with_shapes_that_it_has_fitted(prepared: Path, tmp_path: Path) -> None:
    start = load_model(trained(prepared, tmp_path / "start"))
    verts = np.asarray(start.template.shape.verts) * np.array([[[1.0, 1.1, 1.0]], [[1.0, 0.9, 1.0]], [[1.1, 1.0, 1.0]]])
    known = RegisteredShapes(start.template, verts, "fits", str(tmp_path / "start"))
    for wrong in (verts[:, 1:], verts[0], np.where(verts > 0, np.nan, verts)):
        with pytest.raises(InputError, match="shapes of 162 vertices"):
            replace(known, verts=wrong)
    usual = fine_tuning(start)
    assert (usual.network, usual.kernel, usual.deform) == (SMALL.network, SMALL.kernel, True)
    card = verify_model(
        train(
            tmp_path / "more",
            shapes=known,
            recipe=usual.changed(steps=2, points=96, workers=0),
            facts=CardFacts(name="more"),
        )
    )
    assert (card.data, card.category, card.template_hash) == ("3 fits of fits", "eggs", start.template.hash)
    assert card.recipe["start"]["model"] == "eggs"
    assert (card.mirror, card.licence) == (start.card.mirror, "CC0-1.0")
    with pytest.raises(OptionError, match="the model that made the fits"):
        train(tmp_path / "start", shapes=known)
    doubted = TrainedModel.of(replace(start.card, correspondence=False), start.template, start.network)
    with pytest.raises(OptionError, match="without correspondence"):
        train(tmp_path / "doubted", shapes=known, facts=CardFacts(start=doubted))


def test_an_output_that_cannot_be_made_is_told(prepared: Path, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(OutputError, match="cannot make the folder"):
        trained(prepared, tmp_path / "taken")


def test_a_second_training_in_a_folder_is_refused(prepared: Path, tmp_path: Path) -> None:
    (tmp_path / "m" / "checkpoint").mkdir(parents=True)
    with locked(tmp_path / "m" / "checkpoint" / "lock", "", ""):
        with pytest.raises(OutputError, match="another training writes to"):
            train(tmp_path / "m", shapes=prepared)
        with pytest.raises(OutputError, match="another training writes to"):
            train_implicit(tmp_path / "m", prepared)


def test_bodies_do_not_go_with_a_folder(prepared: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="generated shapes cannot be combined with a folder"):
        train(tmp_path / "mine", shapes=prepared, kind=bodies.Bodies())


def test_the_presets_are_what_they_say() -> None:
    papers, usual = recipe_for(preset="paper"), recipe_for()
    assert (papers, usual) == (paper(), people())
    assert papers.network.align_basis == papers.network.corrections == 0
    assert isinstance(papers.train.loss, CorrespondenceLoss) and not papers.train.loss.robust
    assert papers.scan == ScanConfig(3000, 0, 0, 0, 0, 0, 0, 0, upright=True, sphere=True)
    assert usual.network.encoder == "basis"
    assert usual.scan.noise > 0
    assert (usual.characters, papers.characters) == (0.5, 0)
    assert (usual.bodies, papers.bodies) == (0, 1000)
    assert usual.scan.strays > 0 < usual.scan.outside
    assert replace(usual, scan=default().scan, characters=0.0) == default()
    with pytest.raises(OptionError, match="unknown preset 'best'") as caught:
        recipe_for(preset="best")  # type: ignore[arg-type]
    assert "paper" in caught.value.hint


def test_templates_are_found_by_file_and_by_name(prepared: Path) -> None:
    assert read_template("human-A").pose == "A"
    assert read_template(prepared / "template.safetensors").K >= 36
    with pytest.raises(TemplateError, match="human-Z"):
        read_template("human-Z")
    with pytest.raises(InputError, match="another template"):
        read_registered(prepared, egg_template())


def test_bodies_need_a_template_of_the_body_model(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    rig = stick_figure()
    monkeypatch.setattr(bodies, "cached_rig", lambda *_: rig)
    with pytest.raises(OptionError, match="not made from the body model") as caught:
        bodies.human_source(egg_template())
    assert "--shapes" in caught.value.hint
    dense = Shape(rig.rest[0].double().numpy(), rig.faces.numpy(), "stick")
    keep = np.arange(0, dense.V, 2)
    faces = np.stack([np.arange(len(keep) - 2) + k for k in range(3)], 1)
    small = Shape(dense.verts[keep], faces)
    half = Template("half", small, dense, np.eye(3), 1.0, np.zeros(len(keep), int), ("all",), np.arange(9))
    drawn = bodies.human_source(half)(3, torch.Generator().manual_seed(0))
    assert drawn.shape == (3, len(keep), 3)
    wanted = bodies.sample_bodies(rig, 3, torch.Generator().manual_seed(0))[:, keep]
    assert torch.equal(drawn, wanted)


def test_unseen_bodies_are_of_people_that_the_training_never_drew(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []

    def source(template: Template, identities: int, seed: int):
        asked.append((identities, seed))
        return lambda count, generator: torch.rand(count, 5, 3, generator=generator)

    monkeypatch.setattr(human_bodies, "human_source", source)
    egg = egg_template()
    drawn = [human_bodies.unseen_bodies(egg, 2, trained, seed) for trained, seed in ((0, 0), (0, 1), (7, 0), (0, 0))]
    assert [seed for _, seed in asked] == [1, 2, 8, 1]
    assert all(identities < 4096 for identities, _ in asked)
    assert drawn[0].shape == (2, 5, 3)
    assert drawn[0].dtype == np.float64
    assert np.array_equal(drawn[0], drawn[3])
    assert not np.array_equal(drawn[0], drawn[1])


def test_the_rig_is_built_once_and_kept(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    built: list[int] = []

    def build(identities: int, seed: int, progress=None):
        built.append(identities)
        return stick_figure(identities)

    monkeypatch.setattr(rigs, "build_rig", build)
    monkeypatch.setattr(rigs, "home_folder", lambda kind: tmp_path / "cache")
    first = rigs.cached_rig(3, 0)
    second = rigs.cached_rig(3, 0)
    assert built == [3]
    assert torch.equal(first.heads, second.heads)
    rigs.cached_rig(4, 0)
    rigs.cached_rig(3, 1)
    assert built == [3, 4, 3]
