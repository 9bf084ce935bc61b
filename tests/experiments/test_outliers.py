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
    assert main(["--data", str(tmp_path), "--limit-pairs", "3"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["pairs"] == "3 of 6"


def test_the_file_of_the_benchmark(bench: Path) -> None:
    clouds = load_clouds(bench)
    assert len(clouds) == 30 and all(cloud.V == 1000 and cloud.is_cloud for cloud in clouds)
