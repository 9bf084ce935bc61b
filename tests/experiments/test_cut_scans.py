"""Scans of hands and heads for measuring: errors by hand, clutter, and where anny is installed, the scans."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.makers.cut_scans import CutScan, make_scans, scan_errors, with_clutter
from meshmatch.generators import rig as rigs
from meshmatch.maps.vertex_map import VertexMap
from tests.experiments.small_bench import BODY


def test_only_what_both_shapes_show_counts_and_clutter_is_a_length_off(tmp_path: Path) -> None:
    own, length = np.arange(BODY.V), 2.0
    kept = own != 40  # of 0, 20, 40 and 60, where errors are measured
    a = CutScan(BODY, BODY, np.where(own == 20, -1, own), kept | True, length)
    b = CutScan(BODY, BODY, np.where(own == 7, -1, own), kept, length)
    index = own.copy()
    index[60], index[0] = 61, 7
    found = scan_errors({"a": a, "b": b}, {("a", "b"): VertexMap.between(BODY, BODY, index)}, tmp_path)["a", "b"]
    assert len(found) == 2  # 0 and 60, not 20 and 40
    assert found[0] == 1
    straight = np.linalg.norm(BODY.verts[60] - BODY.verts[61])
    assert straight / length * 0.99 < found[1] < 3 * straight / length


def test_clutter_touches_the_shape_and_comes_last() -> None:
    found = with_clutter(BODY, 2.0, np.random.default_rng(0))
    assert np.array_equal(found.verts[: BODY.V], BODY.verts)
    assert np.array_equal(found.faces[: BODY.F], BODY.faces)
    assert found.faces[BODY.F :].min() >= BODY.V
    assert found.V - BODY.V > 100


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("anny") is None, reason="anny is not installed")
def test_hands_have_other_triangles_and_lose_places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rigs, "home_folder", lambda kind: tmp_path)
    scans = make_scans("hand", 4, 1)
    assert len({scan.shape.F for scan in scans}) == 4
    assert len({np.median(scan.shape.verts) for scan in make_scans("hand", 4, 1) + scans}) == 4  # seeded
    assert {scan.mirrored for scan in make_scans("hand", 6, 1)} == {True, False}
    for scan in scans:
        assert 0.5 < scan.kept.mean() < 1  # the forearm's end is cut off
        assert len(scan.places) == scan.shape.V
        assert scan.places.max() < scan.whole.V
