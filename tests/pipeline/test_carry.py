"""The maps for carrying things, from a map at hand."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch import pipeline
from meshmatch.errors import InputError
from meshmatch.maps.files import save_map
from meshmatch.shapes.files import load_shape, save_shape
from tests.conftest import icosphere
from tests.transfer.known import split


@pytest.fixture(autouse=True)
def no_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    def begun(*_: object, **__: object) -> None:
        raise AssertionError("a fit began")

    monkeypatch.setattr(pipeline, "lay_template", begun)


def test_a_map_at_hand_is_turned_round() -> None:
    coarse = icosphere(1)
    fine, forward, back = split(coarse)
    result = pipeline.carry(coarse, fine, forward)
    assert result.match is None
    assert np.array_equal(result.forward.index, forward.index)
    assert np.allclose(result.back.points(coarse), back.points(coarse), atol=1e-12)


def test_shapes_and_map_may_be_files(tmp_path: Path) -> None:
    save_shape(tmp_path / "a.ply", icosphere(1))
    a = load_shape(tmp_path / "a.ply")
    save_shape(tmp_path / "b.ply", split(a)[0])
    fine, forward, _ = split(a)
    save_map(tmp_path / "ab.npy", forward)
    result = pipeline.carry(tmp_path / "a.ply", tmp_path / "b.ply", tmp_path / "ab.npy")
    assert (result.back.source, result.back.target) == ("b.ply", "a.ply")
    assert result.back.source_vertices == fine.V
    with pytest.raises(InputError, match=r"ab\.npy runs the wrong way: from a\.ply to b\.ply"):
        pipeline.carry(tmp_path / "b.ply", tmp_path / "a.ply", tmp_path / "ab.npy")
