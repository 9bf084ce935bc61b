"""Scans of hands and heads for measuring: errors by hand, clutter, and where anny is installed, the scans."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.cut_scans import CutScan, make_scans, scan_errors, with_clutter
from meshmatch.generators import rig as rigs
from meshmatch.maps.vertex_map import VertexMap
from tests.experiments.small_bench import BODY


def test_landmarks_that_one_shape_lacks_do_not_count(tmp_path: Path) -> None:
    marks = np.array([3, 30, 40, 50])
    length = 2.0
    a = CutScan(BODY, np.where(marks == 3, -1, marks), length)
    b = CutScan(BODY, np.where(marks == 50, -1, marks), length)
    index = np.arange(BODY.V)
    index[30] = 40
    found = scan_errors({"a": a, "b": b}, {("a", "b"): VertexMap.between(BODY, BODY, index)}, tmp_path)["a", "b"]
    assert found.shape == (2,)  # 30 and 40
    assert found[1] == 0
    straight = np.linalg.norm(BODY.verts[30] - BODY.verts[40])
    assert straight / length * 0.99 < found[0] < 3 * straight / length


def test_clutter_touches_the_shape_and_comes_last() -> None:
    found = with_clutter(BODY, 2.0, np.random.default_rng(0))
    assert np.array_equal(found.verts[: BODY.V], BODY.verts)
    assert np.array_equal(found.faces[: BODY.F], BODY.faces)
    assert found.faces[BODY.F :].min() >= BODY.V
    assert found.V - BODY.V > 100


@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")
def test_hands_have_other_triangles_and_lose_landmarks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rigs, "home_folder", lambda kind: tmp_path)
    scans = make_scans("hand", 4, 1)
    assert len({scan.shape.F for scan in scans}) == 4
    assert len({np.median(scan.shape.verts) for scan in make_scans("hand", 4, 1) + scans}) == 4  # seeded
    assert {scan.mirrored for scan in make_scans("hand", 6, 1)} == {True, False}
    for scan in scans:
        has = scan.landmarks >= 0
        assert 0.5 < has.mean() < 1  # the forearm's end is cut off
        assert scan.landmarks.max() < scan.shape.V
        extent = np.linalg.norm(np.ptp(scan.shape.verts, axis=0))
        assert 0.5 < extent / scan.length < 3.5
