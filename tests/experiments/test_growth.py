"""Steps over files that hold many of something: all run, and the table has the exponent of their growth."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.bench import growth
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.repair import repair
from meshmatch.shapes.textured_files import load_appearance


@pytest.mark.parametrize("name", growth.STEPS)
def test_each_step_runs(name: str, tmp_path: Path) -> None:
    assert growth.STEPS[name](30, tmp_path)() is not None


def test_shapes_hold_as_many_as_they_say(tmp_path: Path) -> None:
    assert len(np.unique(growth.loose(50, 0.1).face_parts)) == 50
    assert repair(growth.loose(50)).kept_vertex.size < 50
    growth.nodes(7, tmp_path)
    assert load_shape(tmp_path / "nodes.gltf").F == 7
    growth.materials(7, tmp_path)
    path = tmp_path / "materials.obj"
    assert len(load_appearance(path, load_shape(path)).materials) == 7


def test_the_exponent_is_that_of_the_largest_counts(capsys: pytest.CaptureFixture[str]) -> None:
    assert growth.main(["--steps", "labels,boundary loops", "--most", "1000"]) == 0
    rows = json.loads(capsys.readouterr().out.splitlines()[-1])["rows"]
    assert [row["step"] for row in rows] == ["labels", "boundary loops"]
    for row in rows:
        assert row["exponent"] == pytest.approx(np.log10(max(row["1000"], 1e-4) / max(row["100"], 1e-4)), abs=0.01)
