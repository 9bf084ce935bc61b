"""A folder of boxes, and a model trained on them far enough to have a surface."""

from dataclasses import replace
from pathlib import Path

import pytest

from meshmatch.implicit.training import train_implicit
from tests.implicit.boxes import TRAIN, boxes, config


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("boxes")
    boxes(made)
    return made


@pytest.fixture(scope="session")
def learned(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("learned")
    training = replace(TRAIN, steps=120, rate=3e-3, average=0.9)
    return train_implicit(output, folder, config=config("mls"), training=training)
