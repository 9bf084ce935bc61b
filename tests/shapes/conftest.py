"""Fixtures for tests of file formats."""

from pathlib import Path

import pytest

from tests.shapes.morphs import write_morphs


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A glTF file with morph targets and a clip; see `write_morphs`."""
    path = tmp_path / "face.gltf"
    write_morphs(path)
    return path
