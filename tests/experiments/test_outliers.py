"""Clouds with outliers: what the command counts, with a method that knows the answer for all but the outliers."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.experiments.bench import outliers
from meshmatch.experiments.bench.outliers import load_clouds, main
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

P = 40


class Known:
    """Right but for the last quarter of the points, which go to their neighbor with little confidence."""

    def fit(self, shape: Shape) -> SimpleNamespace:
        return SimpleNamespace(verdict="fair")

    def map(self, source: Shape, _: object, target: Shape, __: object) -> VertexMap:
        outlier = np.arange(P) >= 30
        index = np.where(outlier, (np.arange(P) + 1) % P, np.arange(P))
        return VertexMap.between(source, target, index, confidence=np.where(outlier, 0.1, 0.9))


def test_outliers_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    points = np.zeros((3, P, 3), np.float32)
    points[:, :, 0] = 0.2 * np.arange(P)  # meters: neighbors are 20 cm apart
    np.save(tmp_path / outliers.FILE, points)
    monkeypatch.setattr(outliers, "OurMethod", lambda *_, **__: Known())
    assert main(["--data", str(tmp_path)]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert record["pairs"] == "6 of 6"
    assert record["share_over_15cm"] == pytest.approx(0.25)
    assert record["mean_cm"] == pytest.approx((9 * 20 + 39 * 20) / P, rel=1e-5)
    assert record["median_cm"] == 0.0
    assert (record["confident_share"], record["confident_mean_cm"]) == (0.75, 0.0)
    assert record["verdicts"] == {"fair": 3}
    assert record["flips"] == 1.0  # 24 cm on average
    assert main(["--data", str(tmp_path), "--limit", "2"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["pairs"] == "2 of 2"
    assert main(["--data", str(tmp_path), "--limit-pairs", "3"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["pairs"] == "3 of 6"


def test_what_is_finished_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / outliers.FILE, np.random.default_rng(0).normal(size=(3, P, 3)).astype(np.float32))
    fitted: list[str] = []

    class Counted(Known):
        def fit(self, shape: Shape) -> SimpleNamespace:
            fitted.append(shape.name)
            return super().fit(shape)

    monkeypatch.setattr(outliers, "OurMethod", lambda *_, **__: Counted())
    words = ["--data", str(tmp_path), "--work", str(tmp_path / "work")]
    assert main(words) == 0
    before = json.loads(capsys.readouterr().out.splitlines()[-1])
    (tmp_path / "work" / "0-2.json").unlink()
    fitted.clear()
    assert main(words) == 0
    after = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert fitted == ["cloud 0", "cloud 2"]
    assert after["mean_cm"] == before["mean_cm"] and after["verdicts"] == {"fair": 3}
    assert main([*words, "--seed", "1"]) == 1
    assert "other choices (seed)" in capsys.readouterr().err


def test_a_missing_or_wrong_file_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert outliers.FILE in capsys.readouterr().err
    np.save(tmp_path / outliers.FILE, np.zeros((4, 3)))
    assert main(["--data", str(tmp_path)]) == 1
    assert "(4, 3)" in capsys.readouterr().err


def test_the_file_of_the_benchmark(bench: Path) -> None:
    clouds = load_clouds(bench)
    assert len(clouds) == 30 and all(cloud.V == 1000 and cloud.is_cloud for cloud in clouds)
