"""The model of eggs, and its node system."""

import pytest

from meshmatch.fitting.solve.system import NodeSystem, node_system
from meshmatch.models.trained import TrainedModel
from tests.fitting.eggs import egg_model


@pytest.fixture(scope="session")
def model() -> TrainedModel:
    return egg_model()


@pytest.fixture(scope="session")
def system(model: TrainedModel) -> NodeSystem:
    return node_system(model)
