"""Errors of ablation runs: maps through fitted templates on little spheres whose truth is known, and refinements of eggs."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.bench.sets import load_set
from meshmatch.experiments.paper.ablation_errors import (
    LINES,
    METHODS,
    Measure,
    begin,
    chosen_names,
    descend,
    errors_of,
    pair_errors,
    refined,
    refinement_of,
    subject,
)
from meshmatch.experiments.paper.ablation_setting import Setting
from meshmatch.experiments.paper.ablation_views import BASE, CONSTRAINTS
from meshmatch.fitting.fit_config import NodeRefineConfig
from meshmatch.fitting.search.latent import LatentRefineConfig
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import Frame
from meshmatch.shapes.normalise import sqrt_area_frame
from tests.experiments.egg_runs import prepare_eggs
from tests.experiments.small_bench import BODY, build, order
from tests.fitting.eggs import egg_model, write_model
from tests.training.small import POINTS

QUICK = Measure(shapes=3, landmarks=20, code_steps=3, code_points=200, samples=300)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


def subjects_of(small: Path, name: str, cache: Path, measure: Measure = QUICK):
    bench = load_set(name, small)
    names = chosen_names(bench, measure)
    frames = [sqrt_area_frame(bench.shape(each)) for each in names]
    return bench, [subject(bench, each, frame, measure, cache) for each, frame in zip(names, frames, strict=True)]


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
    assert isinstance(refinement_of(BASE, "nodes", Measure()), NodeRefineConfig)


def test_every_refinement_is_measured(small: Path, tmp_path: Path) -> None:
    _, subjects = subjects_of(small, "faust", tmp_path)
    folder = str(write_model(egg_model(), tmp_path / "egg"))
    far = replace(QUICK, code_steps=40, code_rate=0.1)
    found = errors_of(egg_model(), BASE, subjects, folder, METHODS, far)
    assert tuple(found) == METHODS
    assert all(len(record["pair_cm"]) == 6 and record["mean_cm"] > 0 for record in found.values())
    assert found["none"]["seconds"] < found["code"]["seconds"]
    assert found["none"]["mean_cm"] != found["nodes"]["mean_cm"]
    start = begin(egg_model(), subjects[0], folder, QUICK)
    rows = [refined(egg_model(), start, refinement_of(BASE, how, far), 0) for how in METHODS]
    for a, b in combinations(rows, 2):
        assert np.abs(a - b).max() > 1e-6
    model = egg_model(network=replace(POINTS, field="pointwise"))
    start = begin(model, subjects[0], folder, QUICK)
    kept = refined(model, start, NodeRefineConfig(), 0)
    assert np.array_equal(kept, start.candidate.vectors)  # it has no nodes
    moved = refined(model, start, LatentRefineConfig(steps=5, points=100), 0)
    assert moved.shape == kept.shape


def test_a_shape_is_begun_in_the_frame_of_the_reference(small: Path, tmp_path: Path) -> None:
    # The same shape, its file turned and scaled: a network is told the same, and its answer lies on the same place.
    model = egg_model()
    folder = str(write_model(model, tmp_path / "egg"))
    _, (one, *_) = subjects_of(small, "faust", tmp_path)
    turn = Frame(2.0, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([1.0, 2, 3]))
    other = replace(one, frame=turn.compose(one.frame))
    here, there = (begin(model, each, folder, QUICK) for each in (one, other))
    assert np.allclose(here.candidate.vectors, there.candidate.vectors)
    laid = [start.frame.undo(node_system(model).moved(start.candidate.vectors)) for start in (here, there)]
    assert np.allclose(turn.apply(laid[1]), laid[0])


def test_refinement_is_followed_step_by_step(tmp_path: Path) -> None:
    setting = Setting(folder=str(prepare_eggs(tmp_path)))
    made = setting.resting("T")
    model = replace(egg_model(), template=made)
    network = model.network
    assert len(network.nodes) == made.K == 36
    lines = {"code": (BASE, "code", (0, 2)), "nodes": (BASE, "nodes", (0, 3))}
    assert {method for _, method, _ in LINES.values()} <= set(METHODS)
    found = descend({BASE: model}, setting, QUICK, 2, lines)
    assert set(found) == {"code", "nodes"}
    for line in found.values():
        assert [len(errors) for errors in line["errors_cm"]] == [2, 2]
        assert line["seconds"][0] < line["seconds"][1]
    code, nodes = found["code"]["errors_cm"], found["nodes"]["errors_cm"]
    assert code[0] == nodes[0]  # both begin with the network's answer
    assert code[1] != code[0]
    assert nodes[1] != nodes[0]
