"""Ablations: what runs differ in, how errors and claims are counted, and the command, on eggs and little spheres."""

import json
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.experiments.bench.sets import load_set
from meshmatch.experiments.paper import ablation_errors, ablation_training, ablations, blends
from meshmatch.experiments.paper.ablation_errors import (
    Measure,
    build_subject,
    chosen_names,
    pair_errors,
    predict_start,
    refinement_of,
)
from meshmatch.experiments.paper.ablation_results import (
    Sample,
    bodies_interval,
    check_increase,
    claims_table,
    difference,
    shapes_interval,
)
from meshmatch.experiments.paper.ablation_training import (
    SCANS,
    Setting,
    keep_first_points,
    new_network,
    pool_of,
    time_iterations,
    train_run,
)
from meshmatch.experiments.paper.ablation_views import BASE, CODED, CONSTRAINTS, TABLE3, VIEWS, Run, all_runs
from meshmatch.experiments.runner import table_cells
from meshmatch.fields.shape_functions import FIELDS
from meshmatch.fitting.fit_config import FitConfig, LatentRefineConfig
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.models.registry import load_model
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.template import Template, template_radius
from meshmatch.training.datasets import Batch
from meshmatch.training.loop import Trainer
from meshmatch.training.train import build_loss_points
from tests.conftest import icosphere
from tests.experiments.small_bench import BODY, build, order
from tests.fitting.eggs import egg_model, write_model
from tests.training.small import NETWORK, bent_eggs

QUICK = Measure(shapes=3, landmarks=20, code_steps=3, code_points=200, samples=300)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


@pytest.fixture(scope="module")
def eggs() -> Template:
    """With as many vertices as the most nodes, and more."""
    ball = icosphere(3)
    return make_template(Shape(ball.verts * [0.8, 1.5, 1.0], ball.faces, "egg"), "egg", NodeConfig("uniform", 36, 0.5))


@pytest.fixture
def setting(eggs: Template, monkeypatch: pytest.MonkeyPatch) -> Setting:
    """The recipe is tiny, and eggs take the place of bodies."""
    small = ablation_training.SMALL
    network = replace(NETWORK, align_basis=0, corrections=0)
    tiny = replace(small, network=network, train=replace(small.train, shapes=4), scan=replace(small.scan, points=64))
    monkeypatch.setattr(ablation_training, "SMALL", tiny)
    monkeypatch.setattr(ablation_training, "HELD_OUT_SHAPES", 5)
    monkeypatch.setattr(Setting, "resting", lambda *_: eggs)
    monkeypatch.setattr(Setting, "sources", lambda *_: (bent_eggs(eggs), bent_eggs(eggs)))
    monkeypatch.setattr(ablation_training, "pool_of", pool_of.__wrapped__)
    return Setting()


def test_every_view_looks_at_the_same_cells() -> None:
    runs = all_runs(list(VIEWS))
    assert len(runs) == len(set(runs)) == len({run.name for run in runs}) == 47
    runs = [run for run in runs if not run.steps]
    assert len(runs) == 39 and runs[0] == BASE
    assert BASE.name == "base"
    assert Run(field="rbf", constraint="vol+arap", seed=2).name == "field-rbf.constraint-vol-arap.seed-2"
    for name, view in VIEWS.items():
        assert view.runs[0] == BASE or name == "length"
    assert {replace(run, steps=0) for run in VIEWS["length"].runs} == {BASE, replace(BASE, constraint="none")}
    # all but table 4's runs and the repetitions differ from the base in one thing, or in two of a table
    for run in runs:
        apart = [each.name for each in fields(run) if getattr(run, each.name) != getattr(BASE, each.name)]
        assert len(apart) <= (2 if run.field in ("mls", "rbf") else 3)  # others, and how much they have
    again = all_runs(["table4", "figure9"], 3, ["table4"])
    assert len(again) == 9 + 3 + 3 + 18
    assert [run.seed for run in again[:15]] == [0] * 15


def test_cells_differ_in_representation_and_constraints_alone() -> None:
    setting = Setting(threads=2, loss="ours")
    for field in FIELDS:
        none, arap, vol, both, every = (setting.recipe(Run(field, each, seed=3)) for each in CONSTRAINTS)
        assert none.network == both.network == every.network
        assert none.network.field == field
        assert [r.train.loss.volume for r in (none, arap, vol, both, every)] == [0, 0, 2e-3, 2e-3, 2e-3]
        assert [r.train.loss.arap for r in (none, arap, vol, both, every)] == [0, 2e-3, 0, 2e-3, 2e-3]
        assert [r.train.loss.blend for r in (none, arap, vol, both, every)] == [0, 0, 0, 0, 1e-3]
        assert (none.train.threads, none.train.seed) == (2, 3)
    papers = Setting().recipe(replace(BASE, constraint="vol")).train.loss
    radius = template_radius(Setting().resting("T"))
    assert (papers.volume, papers.arap, papers.blend, papers.robust) == (5e-3, 0, 0, False)
    assert papers.reconstruction == 1 / radius**2 and 0.5 < radius < 2  # squared lengths in the unit sphere
    chosen = Setting(batch=8).recipe(replace(BASE, kernel="cubic"))
    assert (chosen.train.shapes, chosen.kernel) == (8, "cubic")
    assert chosen.network.align_basis == chosen.network.corrections == 0
    assert not chosen.scan.upright


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
    batch = drawn.batch(3, 6, 2, 0)
    first = drawn.targets[: 2 * SCANS]
    for target, features in zip(batch.targets, batch.encode_features, strict=True):
        (k,) = [k for k, each in enumerate(first) if torch.equal(target, each)]
        assert torch.equal(features, drawn.features[k])
    assert torch.equal(batch.targets, drawn.batch(3, 6, 2, 0).targets)
    assert not torch.equal(batch.targets, drawn.batch(4, 6, 2, 0).targets)
    assert not torch.equal(batch.targets, drawn.batch(3, 6, 2, 1).targets)


@pytest.mark.parametrize("run", [CODED, replace(BASE, supervised=50)])
def test_a_cell_is_trained_into_a_model(
    run: Run, setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = pool_of(setting, "T", 3)
    monkeypatch.setattr(ablation_training, "pool_of", lambda *_: small)
    found = train_run(run, setting, tmp_path / "model", 3)
    assert found["steps"] == 3
    assert 0 < found["held_out_cm"] < 200
    assert (found["nodes"], found["rule"]) == (300, "parts")
    assert np.mean(found["bodies_cm"]) == pytest.approx(found["held_out_cm"], abs=1e-3)
    assert len(found["bodies_cm"]) == len(small.held_out.targets)
    model = load_model(tmp_path / "model")
    assert model.network.config.field == run.field
    assert model.card.steps == found["steps"]


def test_a_cell_that_was_stopped_goes_on_exactly(
    setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = pool_of(setting, "T", 3)
    monkeypatch.setattr(ablation_training, "pool_of", lambda *_: small)
    recipe = setting.recipe(BASE)
    often = replace(recipe, train=replace(recipe.train, checkpoint_minutes=0.0))
    monkeypatch.setattr(Setting, "recipe", lambda *_: often)
    whole = train_run(BASE, setting, tmp_path / "whole" / "model", 4)
    iterate, done = Trainer.iterate, []

    def stopped(trainer: Trainer, batch: Batch) -> dict[str, torch.Tensor]:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(trainer.step)
        return iterate(trainer, batch)

    monkeypatch.setattr(Trainer, "iterate", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_run(BASE, setting, tmp_path / "halves" / "model", 4)
    monkeypatch.setattr(Trainer, "iterate", iterate)
    again = train_run(BASE, setting, tmp_path / "halves" / "model", 4)
    assert done == [0, 1] and again["model"] == whole["model"]
    assert not list((tmp_path / "halves").glob("checkpoint*"))


def test_fewer_supervised_points_are_regularised_everywhere(setting: Setting) -> None:
    drawn = pool_of(setting, "T", 2)
    network = new_network(BASE, setting, drawn)
    points = build_loss_points(setting.template(BASE), "smooth", network)
    few = keep_first_points(points, 50)
    vectors = torch.randn(2, 300, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    assert torch.allclose(few.moved(vectors), points.moved(vectors)[:, :50], atol=1e-6)
    assert torch.equal(few.field.deformation_gradient(vectors), points.field.deformation_gradient(vectors))
    assert keep_first_points(points, 1000) is points


@pytest.mark.slow
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


@pytest.mark.parametrize(
    ("errors", "verdict"),
    [
        (([1.0, 1.1], [2.0, 2.1], [3.0, 3.1]), "supported"),
        (([1.0, 1.1], [3.0, 3.1], [2.0, 2.1]), "not supported"),
        (([2.0, 2.1], [2.0, 2.1], [3.0, 3.1]), "not testable here"),
        (([1.0], [2.0]), "not testable here"),  # one seed
        (([1.0, 4.0], [2.0, 5.0]), "not testable here"),
        (([1.0, 1.1], []), "not measured"),
    ],
)
def test_a_claim_needs_an_interval_beside_zero(errors: tuple[list[float], ...], verdict: str) -> None:
    assert check_increase("held out", "rising", [Sample(each) for each in errors]).verdict == verdict


def test_a_claim_that_nobody_measured_has_no_row() -> None:
    there = Sample([1.0, 1.1]), Sample([2.0, 2.1])
    found = [check_increase("held out", "a < b", there), check_increase("scape", "b < c", [Sample([]), Sample([])])]
    assert table_cells(claims_table(found)) == (
        ["claim", "held out", "scape"],
        [["a < b", "supported (0.70 to 1.30)", ""]],
    )


def test_an_interval_of_seeds_is_the_textbooks() -> None:
    low, high = difference(Sample([1.0, 1.2]), Sample([2.0, 2.2])) or (0.0, 0.0)
    reach = 4.302653 * np.sqrt(0.02 / 2 + 0.02 / 2)  # two degrees of freedom
    assert (low, high) == pytest.approx((1 - reach, 1 + reach))
    assert difference(Sample([1.0, 5.0]), Sample([2.0, 6.0]), paired=True) == (1.0, 1.0)


def test_pairs_must_carry_an_order_too() -> None:
    """Half of the bodies are better and half worse: the mean of one body more or less decides."""
    clear, even = [1.0] * 4, [0.0, 0.0, 2.2, 2.2]
    for bodies, verdict in (([1.1] * 4, "supported"), (even, "not testable here")):
        samples = Sample([1.0, 1.01], [clear, clear]), Sample([1.1, 1.11], [bodies, bodies])
        assert check_increase("scape", "rising", samples).verdict == verdict


def test_pairs_of_a_shape_are_no_independent_witnesses() -> None:
    """All pairs of one of twelve shapes are worse, all others a little better or the same."""
    off = np.full((12, 12), -0.02)
    off[3], off[:, 3] = 2.0, 2.0
    off = off[~np.eye(12, dtype=bool)]
    low, high = shapes_interval(off, 12)
    assert low < 0 < bodies_interval(off)[0] and high > bodies_interval(off)[1]
    assert shapes_interval(np.arange(6.0), 3)[0] >= 0 and shapes_interval(np.full(6, 0.5), 3) == [0.5, 0.5]


def subjects_of(small: Path, name: str, cache: Path, measure: Measure = QUICK):
    bench = load_set(name, small)
    names = chosen_names(bench, measure)
    frames = [sqrt_area_frame(bench.shape(each)) for each in names]
    return bench, [build_subject(bench, each, frame, measure, cache) for each, frame in zip(names, frames, strict=True)]


def test_a_template_that_lies_on_the_shapes_makes_no_error(small: Path, tmp_path: Path) -> None:
    bench, subjects = subjects_of(small, "faust", tmp_path)
    assert [one.name for one in subjects] == ["tr_reg_000", "tr_reg_001", "tr_reg_010"]
    # The body as the template, vertex by vertex: vertex k of it lies where each shape has it.
    laid = [bench.shape(one.name).verts[np.argsort(order(one.name))] for one in subjects]
    errors = pair_errors(subjects, laid)
    assert errors.shape == (6, 20)
    assert errors.max() == 0
    turned = [laid[0], laid[1], laid[2][::-1]]
    errors = pair_errors(subjects, turned)
    # pairs in order: 01, 02, 10, 12, 20, 21; those of the third shape are wrong
    assert errors[[0, 2]].max() == 0
    assert errors[[1, 3, 4, 5]].mean(1).min() > 20


def test_errors_are_lengths_along_the_target(small: Path, tmp_path: Path) -> None:
    bench, subjects = subjects_of(small, "scape", tmp_path)
    laid = [bench.shape(one.name).verts for one in subjects]
    one_off = laid[1].copy()
    mark = np.linspace(0, BODY.V - 1, 20).round().astype(int)[4]
    near = BODY.faces[(BODY.faces == mark).any(1)][0]
    other = near[near != mark][0]
    one_off[mark] = laid[1][other]
    errors = pair_errors(subjects, [laid[0], one_off])
    edge = np.linalg.norm(laid[1][mark] - laid[1][other]) / np.sqrt(bench.shape("mesh001").area)
    assert errors[0].max() == pytest.approx(100 * np.sqrt(1.9) * edge, rel=2e-3)
    assert (errors[0] > 0).sum() == 1


def test_shapes_are_spread_over_the_targets(small: Path) -> None:
    bench = load_set("shrec19", small)
    assert bench.pairs == (("1", "2"), ("1", "10"), ("10", "2"))
    assert chosen_names(bench, Measure()) == ["2", "10"]
    assert chosen_names(load_set("faust", small), Measure(shapes=2)) == ["tr_reg_000", "tr_reg_010"]


def test_regularisers_at_test_time_are_those_of_the_run() -> None:
    weights = {}
    for constraint in CONSTRAINTS:
        how = refinement_of(replace(BASE, constraint=constraint), "code", Measure(code_steps=7))
        assert isinstance(how, LatentRefineConfig)
        assert (how.steps, how.rate, how.points) == (7, 5e-3, 1500)
        weights[constraint] = (how.volume, how.arap)
    assert weights == {
        **{"none": (0, 0), "arap": (0, 1e-3), "vol": (1e-4, 0)},
        **{"vol+arap": (1e-4, 1e-3), "vol+arap+Z": (1e-4, 1e-3)},
    }
    chamfer = refinement_of(BASE, "chamfer", Measure())
    assert isinstance(chamfer, LatentRefineConfig)
    assert (chamfer.volume, chamfer.arap) == (0, 0)
    assert refinement_of(BASE, "none", Measure()) is None


def test_a_shape_is_begun_in_the_frame_of_the_reference(small: Path, tmp_path: Path) -> None:
    # The same shape, its file turned and scaled: a network is told the same, and its answer lies on the same place.
    model = egg_model()
    folder = str(write_model(model, tmp_path / "egg"))
    _, (one, *_) = subjects_of(small, "faust", tmp_path)
    turn = Frame(2.0, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([1.0, 2, 3]))
    other = replace(one, frame=turn.compose(one.frame))
    here, there = (predict_start(model, each, folder, QUICK) for each in (one, other))
    assert np.allclose(here.candidate.vectors, there.candidate.vectors)
    laid = [start.frame.undo(node_system(model).moved(start.candidate.vectors)) for start in (here, there)]
    assert np.allclose(turn.apply(laid[1]), laid[0])


@pytest.mark.slow
def test_the_command_goes_on(
    small: Path, setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn = pool_of.__wrapped__
    monkeypatch.setattr(ablation_training, "pool_of", lambda setting, pose, **more: drawn(setting, pose, 4, **more))
    quick = partial(FitConfig, samples=300, coarse_samples=60, careful=1)
    monkeypatch.setattr(ablation_errors, "FitConfig", quick)
    monkeypatch.setattr(ablations, "Measure", partial(Measure, landmarks=20, samples=300, code_points=200))
    output, model = tmp_path / "out", write_model(egg_model(), tmp_path / "egg")
    words = ["--output", str(output), "--model", str(model), "--data", str(small), "--cache", str(tmp_path / "cache")]
    words += ["--sets", "scape", "--steps", "2", "--code-steps", "1", "--shapes", "2", "--views", "figure10"]

    def run(*more: str) -> dict:
        assert ablations.main([*words, *more]) == 0
        return json.loads(capsys.readouterr().out.splitlines()[-1])

    assert run("--show")["rows"] == {}
    first = run()["rows"]
    ours = {"base", "supervised-50", "supervised-100"}
    coded = {f"field-pointwise.constraint-none{each}" for each in ("", ".supervised-50", ".supervised-100")}
    trained = {name.removesuffix("/trained.json"): row for name, row in first.items() if name.endswith("trained.json")}
    assert set(trained) == ours | coded and {each["steps"] for each in trained.values()} == {2}
    lacking = "supervised-50/error-scape-code.json"
    assert {"base/error-scape-chamfer.json", "frames-scape.json", lacking} <= first.keys()

    saved = tmp_path / "saved.json"
    (output / lacking).unlink()
    begun = run("--show", "--save", str(saved))["rows"]
    assert first.keys() - begun.keys() == {lacking, "supervised-50/trained.json"}  # nothing of it without its model
    again = run()["rows"]
    assert again[lacking]["pair_cm"] == first[lacking]["pair_cm"]  # measured again, by the same model
    assert ablations.main([*words, "--steps", "3"]) == 1  # runs of another budget

    # elsewhere, with the file alone: one run is trained again, and the file that is written then holds all
    words[1] = str(tmp_path / "elsewhere")
    there = run("--rows", str(saved), "--save", str(saved))["rows"]
    assert there.keys() == first.keys() and there[lacking]["pair_cm"] == first[lacking]["pair_cm"]
    assert {name: row for name, row in there.items() if name in begun} == begun
    assert [each.name for each in (tmp_path / "elsewhere").iterdir()] == ["supervised-50"]
    words[words.index("figure10")] = "figure9"
    assert run("--show", "--rows", str(saved))["rows"].keys() == first.keys()  # also those of other views
    capsys.readouterr()
    words[words.index("figure9")] = "figure10"
    assert ablations.main([*words, "--rows", str(saved), "--shapes", "3"]) == 1
    assert "was measured with other options (measure)" in capsys.readouterr().err
    assert ablations.main([*words, "--rows", str(output / lacking)]) == 1
    assert "holds no rows of ablations" in capsys.readouterr().err


def test_cells_take_turns(setting: Setting) -> None:
    found = time_iterations(setting, [replace(BASE, field=field) for field in FIELDS], 2)
    assert set(found) == {"base", "field-rbf", "field-pointwise"}
    assert all(record["rounds"] == 2 and record["ms"] > 0 and record["cpu_ms"] > 0 for record in found.values())


def test_table_3_is_trained_from_the_beginning_and_its_codes_are_blended(
    setting: Setting, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    papers = setting.recipe(replace(BASE, constraint=TABLE3)).train.loss
    assert (papers.volume, papers.arap, papers.blend) == (1e-4, 1e-2, 1.0)
    drawn = pool_of(setting, "T", 4)
    for module in (ablation_training, blends):
        monkeypatch.setattr(module, "pool_of", lambda *_: drawn)
    words = ["--steps", "3", "--seeds", "2", "--work", str(tmp_path)]
    assert blends.main(words) == 0
    first = capsys.readouterr()
    rows = json.loads(first.out.splitlines()[-1])["rows"]
    assert list(rows) == list(blends.WEIGHTS) and "training" in first.err
    for each in rows.values():
        assert [one["steps"] for one in each] == [3, 3] and each[0]["model"] != each[1]["model"]
        found = [
            one[f"{name}_{where}"] for one in each for name in ("volume", "rigidity") for where in ("ends", "halfway")
        ]
        assert min(found) > 0 and len(set(found)) == 8
    assert blends.main(words) == 0  # all of it is kept
    again = capsys.readouterr()
    assert json.loads(again.out.splitlines()[-1])["rows"] == rows and "training" not in again.err
    row = blends.row_of("words", rows["table 3"])
    assert row["held_out_cm"].count("±") == 1 and "±" not in blends.row_of("words", rows["table 3"][:1])["held_out_cm"]
