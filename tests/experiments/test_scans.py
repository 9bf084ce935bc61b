"""Scans are registered, measured and drawn in the colors of the template's parts."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.api.matching import Matcher
from meshmatch.experiments.bench.scans import main, scan_panels
from meshmatch.experiments.makers.simulated_scans import scanned, simulated_scans
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.shapes.colors import label_colors
from meshmatch.shapes.shape import Shape

DANCER = Path(__file__).parents[2] / "templates" / "samples" / "dancer.ply"


def test_a_scan_wears_the_parts_of_the_template() -> None:
    matcher = Matcher("human", FitConfig(refine="none"))
    fit, labels = matcher.fit(DANCER), np.asarray(matcher.model.template.labels)
    scan, fitted = scan_panels("one", fit, labels)
    assert (scan.label, fitted.label) == ("one", fit.verdict)
    assert np.array_equal(np.asarray(fitted.colors, float), label_colors(labels))
    worn = {tuple(color) for color in np.asarray(scan.colors, float).round(6).tolist()}
    known = {tuple(color) for color in label_colors(labels).round(6).tolist()}
    assert worn <= known and len(worn) == len(known)


def test_simulated_scans_have_holes_and_a_truth(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("anny")
    assert main(["--simulated", "1"]) == 0
    (row,) = json.loads(capsys.readouterr().out.splitlines()[-1])["scans"]
    assert row["verdict"] in ("good", "fair") and row["error_cm"] < 5
    (body, scan), (_, again) = (*simulated_scans(1), *simulated_scans(1))
    assert 0.6 * body.V < scan.V < 0.98 * body.V and np.array_equal(scan.verts, again.verts)


def test_a_camera_ring_sees_the_outside_alone(cube: Shape) -> None:
    """A box in a box: the inner one is seen by nobody."""
    inner = Shape(0.5 * cube.verts + 0.25, cube.faces)
    both = Shape(np.concatenate([cube.verts, inner.verts]), np.concatenate([cube.faces, inner.faces + cube.V]))
    seen = scanned(both, 0)
    assert seen.V == cube.V and 8 <= seen.F <= cube.F
