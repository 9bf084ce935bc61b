"""A browser for the tests of a module, and a folder for screenshots to look at."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.render.browser import browser


@pytest.fixture(scope="module")
def running() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def artefacts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder named by MESHMATCH_ARTEFACTS, else a temporary one."""
    named = os.environ.get("MESHMATCH_ARTEFACTS")
    folder = Path(named) if named else tmp_path_factory.mktemp("artefacts")
    folder.mkdir(parents=True, exist_ok=True)
    return folder
