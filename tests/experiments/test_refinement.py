"""The comparison of the two refinements, on eggs with an untrained network and on a small benchmark."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.api.inputs import validated
from meshmatch.errors import OptionError
from meshmatch.experiments.makers import human_bodies
from meshmatch.experiments.paper import refinement
from meshmatch.experiments.paper.refinement import (
    METHODS,
    Answer,
    Subject,
    body_errors,
    choose_shapes,
    main,
    pair_errors,
    refined,
)
from meshmatch.fitting.solve.system import node_system
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from tests.experiments.small_bench import build
from tests.fitting.eggs import egg_model
from tests.training.small import bent_eggs


@pytest.fixture(scope="module")
def model() -> TrainedModel:
    return egg_model()


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("bench"))


def eggs(model: TrainedModel, count: int = 2) -> list[Shape]:
    drawn = bent_eggs(model.template)(count, torch.Generator().manual_seed(3)).double().numpy()
    return [Shape(verts, model.template.shape.faces, f"egg {k}") for k, verts in enumerate(drawn)]


@pytest.fixture(scope="module")
def subjects(model: TrainedModel) -> list[Subject]:
    return refined(model, eggs(model), 40, 0)


def test_both_start_from_the_network_and_the_paper_lowers_its_own_energy(subjects: list[Subject]) -> None:
    for subject in subjects:
        network, code, nodes = (subject.answers[name] for name in ("network", "code", "nodes"))
        assert np.array_equal(network.vectors, subject.fit.vectors)
        assert code.energy < network.energy
        for answer in (code, nodes):
            assert answer.cpu > 0
            assert answer.wall > 0
            assert np.abs(answer.vectors - network.vectors).max() > 1e-3


def test_the_same_seed_gives_the_same_answers(model: TrainedModel) -> None:
    first, again = (refined(model, eggs(model, 1), 3, 0)[0] for _ in range(2))
    for name in METHODS:
        assert np.array_equal(first.answers[name].vectors, again.answers[name].vectors)


def test_the_error_of_bodies_is_the_distance_to_their_own_vertices(
    model: TrainedModel, subjects: list[Subject]
) -> None:
    # A shape that is the template moved: vectors that move it so are right, and a shift of all nodes is off by itself.
    template, fit = model.template, subjects[0].fit
    right = np.random.default_rng(0).normal(0, 0.02, (template.K, 3))
    shape = Shape(fit.frame.undo(node_system(model).moved(right)), template.shape.faces, "made")
    answers = {
        "network": Answer(right, 0, 0, 0),
        "code": Answer(right + np.array([0.03, 0, 0]), 0, 0, 0),
        "nodes": Answer(right + np.array([0, 0.04, 0.03]), 0, 0, 0),
    }
    errors = body_errors(model, [Subject(shape, fit, answers)])
    wanted = {"network": 0.0, "code": 0.03 * CM_PER_UNIT, "nodes": 0.05 * CM_PER_UNIT}
    assert errors == pytest.approx(wanted, abs=1e-4)


def test_the_error_of_pairs_is_that_of_maps_through_the_fits(
    model: TrainedModel, subjects: list[Subject], small: Path, tmp_path: Path
) -> None:
    # The bench's bodies have their own triangulation: the template's vertices are laid where the answers say.
    bench = refinement.load_set("scape", small)
    shape, other = (bench.shape(name) for name in bench.shapes)
    frames = [sqrt_area_frame(each) for each in (shape, other)]
    fits = [
        replace(subjects[0].fit, frame=frame, repaired=validated(each))
        for frame, each in zip(frames, (shape, other), strict=True)
    ]
    still = np.zeros((model.template.K, 3))
    turned = 2 * np.array([-1.0, 0, -1.0]) * model.template.nodes  # a half turn about y: x and z change sign
    turned[:, 1] = 0

    def subject(each: Shape, fit, code: np.ndarray) -> Subject:
        kept = {name: Answer(code if name == "code" else still, 0, 0, 0) for name in METHODS}
        return Subject(each, fit, kept)

    made = [subject(shape, fits[0], still), subject(other, fits[1], turned)]
    errors = pair_errors(model, made, "scape", small, tmp_path)
    assert errors["network"] == errors["nodes"]
    assert errors["network"] < 5
    assert errors["code"] > 40  # every vertex goes to the other side


def test_the_command_on_bodies_and_a_set(
    model: TrainedModel,
    small: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    drawn: list[tuple[int, int, int]] = []

    def bodies(template, count: int, trained: int, seed: int) -> np.ndarray:
        drawn.append((count, trained, seed))
        return np.stack([shape.verts for shape in eggs(model, count)])

    monkeypatch.setattr(refinement, "as_model", lambda name: model)
    monkeypatch.setattr(human_bodies, "unseen_bodies", bodies)
    words = ["--sets", "bodies,scape", "--shapes", "2", "--steps", "3", "--model", "egg", "--seed", "4"]
    assert main([*words, "--data", str(small), "--cache", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.strip().splitlines()
    record = json.loads(lines[-1])
    assert drawn == [(2, model.card.seed, 4)]
    assert record["steps"] == {"nodes": 10, "code": 3}
    rows = record["rows"]
    assert [(row["set"], row["method"]) for row in rows] == [(n, m) for n in ("bodies", "scape") for m in METHODS]
    for first in (0, len(METHODS)):
        code, *steps = rows[first + 1 : first + len(METHODS)]
        nodes, racing = steps[-1], [row["error_cm"] <= code["error_cm"] for row in steps]
        assert [row.get("race") == "equal error" for row in steps] == [
            won and not any(racing[:k]) for k, won in enumerate(racing)
        ]
        assert nodes["times_as_fast"] == pytest.approx(code["cpu"] / nodes["cpu"])
        assert nodes["met"] == (nodes["times_as_fast"] >= 50 and nodes["error_cm"] < code["error_cm"])
    assert all(name in "".join(lines[:-1]) for name in ("bodies", "scape", "network", "code", "nodes"))


def test_shapes_are_spread_over_a_set_that_has_pairs_of_them(model: TrainedModel, tmp_path: Path) -> None:
    small = build(tmp_path)
    chosen = [Path(shape.name).stem for shape in choose_shapes(model, "faust", 2, 0, small)]
    assert chosen == ["tr_reg_000", "tr_reg_010"]
    assert len(choose_shapes(model, "shrec19", 9, 0, small)) == 3
    (small / "shrec19" / "pairs.txt").write_text("1 2\n")
    with pytest.raises(OptionError, match="no pair among 1, 10"):
        choose_shapes(model, "shrec19", 2, 0, small)
