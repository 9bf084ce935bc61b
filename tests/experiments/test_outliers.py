"""Clouds with strays: what the command counts, with a matcher that knows the answer for all but the strays."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments import outliers
from meshmatch.experiments.outliers import load_clouds, main
from meshmatch.fitting.fit import Fit
from meshmatch.geometry.frames import Frame
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

P = 40


def register(shape: Shape, **_: object) -> Fit:
    none, still = np.zeros(shape.V), np.zeros((1, 3))
    return Fit(
        "", Frame.identity(), still, still, still, still, 0.0, none, "fair", (), "+y", "+z", 0.0, 0
    )  # fmt: skip


def map_between(source: Shape, _: Fit, target: Shape, __: Fit, **___: object) -> VertexMap:
    """Right but for the last quarter of the points, which go to their neighbour with little confidence."""
    stray = np.arange(P) >= 30
    index = np.where(stray, (np.arange(P) + 1) % P, np.arange(P))
    return VertexMap.between(source, target, index, confidence=np.where(stray, 0.1, 0.9))


def test_strays_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = np.zeros((3, P, 3), np.float32)
    points[:, :, 0] = 0.2 * np.arange(P)  # metres: neighbours are 20 cm apart
    np.save(tmp_path / outliers.FILE, points)
    monkeypatch.setattr(outliers, "register", register)
    monkeypatch.setattr(outliers, "map_between", map_between)
    assert main(["--data", str(tmp_path)]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert record["pairs"] == 6
    assert record["share_over_15cm"] == pytest.approx(0.25)
    assert record["mean_cm"] == pytest.approx((9 * 20 + 39 * 20) / P, rel=1e-5)
    assert record["median_cm"] == 0.0
    assert (record["confident_share"], record["confident_mean_cm"]) == (0.75, 0.0)
    assert record["verdicts"] == {"fair": 3}
    assert record["flips"] == 1.0  # 24 cm on average

    assert main(["--data", str(tmp_path), "--limit", "2"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["pairs"] == 2
    assert main(["--data", str(tmp_path), "--limit-pairs", "3"]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert (record["pairs"], record["of"]) == (3, 6)


def test_fits_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    points = np.random.default_rng(0).random((2, P, 3))
    np.save(tmp_path / outliers.FILE, points)
    seen: list[Fit] = []

    def made(shape: Shape, **how: object) -> Fit:
        fit = register(shape)
        return replace(
            fit, reasons=("few", "far"), partial=True, frame=Frame(2.0, np.eye(3)[::-1] * -1, np.ones(3))
        )

    def mapped(source: Shape, fit: Fit, *rest: object, **how: object) -> VertexMap:
        seen.append(fit)
        return map_between(source, fit, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(outliers, "register", made)
    monkeypatch.setattr(outliers, "map_between", mapped)
    words = ["--data", str(tmp_path), "--keep", str(tmp_path / "kept")]
    assert main(words) == 0
    monkeypatch.setattr(outliers, "register", None)
    assert main(words) == 0
    first, *_, last = seen
    assert (last.verdict, last.reasons, last.partial, last.up) == ("fair", ("few", "far"), True, "+y")
    assert last.frame.scale == 2.0 and np.array_equal(last.frame.rotation, first.frame.rotation)
    assert np.array_equal(last.points, first.points) and last.residual == first.residual
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    assert told[0]["mean_cm"] == told[1]["mean_cm"]


def test_files_that_are_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(tmp_path)]) == 1
    assert outliers.FILE in capsys.readouterr().err
    np.save(tmp_path / outliers.FILE, np.zeros((4, 3)))
    assert main(["--data", str(tmp_path)]) == 1
    assert "(4, 3)" in capsys.readouterr().err


def test_the_file_of_the_benchmark(bench: Path) -> None:
    clouds = load_clouds(bench)
    assert len(clouds) == 30 and all(cloud.V == 1000 and cloud.is_cloud for cloud in clouds)
