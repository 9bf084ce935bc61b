"""The benchmark of rigs, on tubes matched by construction."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.api.matcher import Matcher
from meshmatch.experiments.bench import rigs
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from tests.transfer.rigs import write_tube


def test_a_folder_of_equal_tubes_has_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rigs" / "tubes"
    folder.mkdir(parents=True)
    for name in ("a.glb", "b.glb", "c.glb"):
        write_tube(folder / name)

    def match(_: Matcher, a: Shape, b: Shape) -> VertexMap:
        return VertexMap.between(a, b, np.arange(a.V), verdict="good")

    monkeypatch.setattr(Matcher, "match", match)
    out = tmp_path / "rigs.json"
    assert rigs.main(["--data", str(tmp_path), "--folders", "tubes", "--limit-pairs", "2", "--save", str(out)]) == 0
    assert "2 / 0 / 0" in capsys.readouterr().out
    (row,) = json.loads(out.read_text())["values"]["rows"]
    assert (row["same"], row["near_good"]) == (1.0, 1.0) and row["high_cm"] < 1e-3
    row = rigs.row_of("tubes", [{"verdict": "good", "same": 1.0, "near": 1.0, "seconds": 1.0, "cm": [0.0, 1.0]}] * 2)
    assert (row["median_cm"], row["high_good_cm"], row["near_good"]) == (0.5, 1.0, 1.0)
    assert rigs.main(["--data", str(tmp_path), "--folders", "horses"]) == 1
    assert "*.glb files in" in capsys.readouterr().err


def test_neighbours_are_parents_children_and_siblings(tmp_path: Path) -> None:
    write_tube(tmp_path / "a.glb")
    near = rigs._Character(tmp_path / "a.glb").near
    assert {("hip", "hip"), ("hip", "knee"), ("knee", "hip"), ("hip", "foot"), ("hip", "root")} <= near
    assert not {("knee", "foot"), ("armature", "tip"), ("armature", "hip")} & near
