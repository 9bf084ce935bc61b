"""What a set's truth says beside vertices in the same order, where shapes have them."""

import json
from pathlib import Path

import numpy as np
import pytest

from meshmatch.experiments.sets import load_set
from meshmatch.experiments.truth import groups, main, same_order
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.shapes.shape import Shape
from tests.experiments.small_bench import BODY, build


def test_the_same_order_is_seen_and_a_shuffled_one_too() -> None:
    bent = Shape(BODY.verts * [1, 2, 1] + 3, BODY.faces)
    order = np.random.default_rng(0).permutation(BODY.V)
    assert same_order(BODY, bent)
    assert not same_order(BODY, Shape(BODY.verts[order], np.argsort(order)[BODY.faces]))
    assert not same_order(BODY, Shape(BODY.verts[:-1], BODY.faces[:1]))


def test_a_truth_that_is_wrong_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """SCAPE's little shapes keep their order, and their truth is just that; one landmark of the others is moved."""
    data = build(tmp_path)
    assert groups(load_set("scape", data)) == [["mesh000", "mesh001"]]
    words = ["--data", str(data), "--cache", str(tmp_path / "kept")]
    assert main([*words, "--set", "scape"]) == 0
    record = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert record["groups"][0]["mean_cm"] == 0.0 and record["groups"][0]["pairs"] == 2

    assert main([*words, "--set", "shrec19"]) == 1  # every shape is shuffled in its own way
    assert "no two shapes" in capsys.readouterr().err

    for name in ("1", "2"):
        for suffix in (".ply", ".landmarks.npy"):
            (data / "shrec19" / f"{name}{suffix}").unlink()
    scape = load_set("scape", data)
    for name, shape in (("1", "mesh000"), ("2", "mesh001")):
        (data / "shrec19" / f"{name}.ply").write_bytes(scape.path(shape).read_bytes())
        ids = np.arange(BODY.V)
        if name == "2":
            ids[0] = 1  # landmark 0 is one edge off
        np.save(data / "shrec19" / f"{name}.landmarks.npy", ids)
    assert main([*words, "--set", "shrec19"]) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])["groups"][0]
    shape = scape.shape("mesh001")
    edge = np.linalg.norm(shape.verts[0] - shape.verts[1]) / np.sqrt(shape.area) * CM_PER_UNIT
    assert found["shapes"] == ["1", "2"]
    assert found["mean_cm"] == pytest.approx(edge / BODY.V, rel=0.02)
