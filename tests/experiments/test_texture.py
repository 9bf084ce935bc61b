"""The benchmark of textures: its measure, its cases where they are cheap, its command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.bench import texture
from meshmatch.experiments.bench.texture import colors_at, loss, main, nearest_map
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.shape import Shape
from tests.shapes.painted import CORNERS, FACES, UV, quarters
from tests.transfer.known import split


def test_losses_by_hand() -> None:
    one = np.zeros((2, 3))
    two = one.copy()
    two[0, 0] = 1.0
    assert loss(one, two) == {"mean": 255 / 6, "psnr": pytest.approx(10 * np.log10(6), abs=0.01)}
    assert loss(one, one)["psnr"] == np.inf


def test_the_nearest_map_of_a_finer_copy_is_exact(sphere: Shape) -> None:
    fine, there, back = split(sphere)
    np.testing.assert_allclose(nearest_map(sphere, fine).points(fine), there.points(fine), atol=1e-9)
    np.testing.assert_allclose(nearest_map(fine, sphere).points(sphere), back.points(sphere), atol=1e-9)


def test_colors_at_points_of_a_square() -> None:
    square = Shape(CORNERS, FACES)
    look = Appearance((Material(image=quarters(16)),), np.zeros(2, np.int64), UV[FACES])
    found = colors_at(square, look, np.array([[0.25, 0.75, 0], [0.75, 0.75, 0.3], [0.25, 0.25, 0]]))
    np.testing.assert_allclose(found, [[1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-6)


def test_a_body_to_itself(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(texture, "POINTS", 2000)
    words = ["--cases", "itself,spot", "--size", "512", "--samples", "1", "--threads", "1"]
    assert main([*words, "--data", str(tmp_path), "--keep", str(tmp_path / "kept")]) == 0
    heard = capsys.readouterr().out
    record = json.loads(heard.strip().splitlines()[-1])
    assert record["threads"] == 1 and "spot: no data" in heard
    (found,) = record["cases"]
    # half of the sample's own texels: blurred, but the same
    assert 0 < found["there_mean"] < found["back_mean"] < 12
    assert found["there_psnr"] > 20
    assert sorted(file.name for file in (tmp_path / "kept").iterdir()) == ["itself-back.glb", "itself-there.glb"]


def test_a_size_that_cannot_be_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--cases", "itself", "--size", "1"]) == 1
    assert "16 to 8192" in capsys.readouterr().err


@pytest.mark.slow
def test_the_cow_loses_next_to_nothing(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(texture, "POINTS", 5000)
    trip = texture.trip_of("spot", bench)
    record = texture.measure("spot", trip, texture.BakeOptions(size=512, workers=1), None)
    assert record["back_psnr"] > 31
