"""Scans are registered, measured and drawn in the colours of the template's parts."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.api.inputs import as_model
from meshmatch.api.matching import register
from meshmatch.experiments import segments
from meshmatch.experiments.scans import main, scan_panels
from meshmatch.fitting.fit_config import FitConfig
from meshmatch.render.scales import label_colors
from meshmatch.shapes.files import load_shape

DANCER = Path(__file__).parents[2] / "templates" / "samples" / "dancer.ply"


def test_a_scan_wears_the_parts_of_the_template() -> None:
    shape = load_shape(DANCER)
    fit = register(shape, config=FitConfig(refine="none"))
    labels = np.asarray(as_model("human").template.labels)
    scan, laid = scan_panels("one", shape, fit, labels)
    assert (scan.label, laid.label) == ("one", fit.verdict)
    assert np.array_equal(np.asarray(laid.colors, float), label_colors(labels))
    worn = {tuple(color) for color in np.asarray(scan.colors, float).round(6).tolist()}
    known = {tuple(color) for color in label_colors(labels).round(6).tolist()}
    assert worn <= known and len(worn) == len(known)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(DANCER), "-o", str(tmp_path / "new")]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert record["scans"][DANCER.stem]["verdict"] == "good"
    assert (tmp_path / "new" / "scans-1.png").stat().st_size > 10_000
    assert main([str(tmp_path / "none.ply")]) == 1
    assert "none.ply" in capsys.readouterr().err


@pytest.mark.parametrize("benchmark", ["scans", "segments"])
def test_a_folder_that_cannot_be_made_is_told_before_any_work(
    benchmark: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = tmp_path / "taken"
    taken.write_text("a file")
    words = {
        "scans": [str(DANCER), "-o", str(taken)],
        "segments": ["--data", str(tmp_path), "--pictures", str(taken)],
    }[benchmark]
    assert {"scans": main, "segments": segments.main}[benchmark](words) == 1
    said = capsys.readouterr().err
    assert "cannot make the folder" in said and "choose another folder" in said
    assert "fitting" not in said
