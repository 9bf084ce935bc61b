"""The comparison of the two refinements, on eggs with an untrained network."""

import numpy as np
import pytest
import torch

from meshmatch.experiments.paper.refinement import FEWER, measured, refined, started
from meshmatch.fitting.fit_config import LatentRefineConfig, NodeRefineConfig
from meshmatch.fitting.solve.system import node_system
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.shape import Shape
from tests.fitting.eggs import egg_model
from tests.training.small import bent_eggs


@pytest.fixture(scope="module")
def model() -> TrainedModel:
    return egg_model()


@pytest.fixture(scope="module")
def eggs(model: TrainedModel) -> list[Shape]:
    drawn = bent_eggs(model.template)(2, torch.Generator().manual_seed(3)).double().numpy()
    return [Shape(verts, model.template.shape.faces, f"egg {k}") for k, verts in enumerate(drawn)]


def test_all_ways_begin_with_the_network_and_nodes_come_nearer(model: TrainedModel, eggs: list[Shape]) -> None:
    rows = measured(model, eggs, 20, 0)
    assert [row["method"] for row in rows] == ["network", "code", *FEWER, "nodes"]
    network, code, *_, nodes = rows
    assert nodes["error_cm"] < network["error_cm"]
    assert nodes["times"] == pytest.approx(code["cpu"] / nodes["cpu"])
    off = []
    for egg in eggs:  # the network's own error, by hand
        fit, _ = started(model, egg, 0)
        off.append(np.linalg.norm(node_system(model).moved(fit.vectors) - fit.frame.apply(egg.verts), axis=1).mean())
    assert network["error_cm"] == pytest.approx(CM_PER_UNIT * np.mean(off))


def test_the_same_seed_gives_the_same_answers(model: TrainedModel, eggs: list[Shape]) -> None:
    fit, scan = started(model, eggs[0], 0)
    for how in (LatentRefineConfig(steps=3), NodeRefineConfig(), None):
        first, again = (refined(model, how, scan, fit.vectors, 0) for _ in range(2))
        assert np.array_equal(first, again)
        assert np.array_equal(first, fit.vectors) == (how is None)
