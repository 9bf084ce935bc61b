"""The benchmark of rigs, on tubes matched by construction."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_array, diags_array

from meshmatch.api.matcher import Matcher
from meshmatch.experiments.bench import rigs
from meshmatch.experiments.bench.skinning import (
    distances_from_bones,
    nearest_and_inpainted,
    pose_in_motion,
    skin_vertices,
    volume,
)
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.weight_files import SkinWeights
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
    more = dict.fromkeys(("nearest", "inpainted", "volume", "volume_own", "further", "further_own"), 1.0) | {
        "bone_cm": [0.5]
    }
    row = rigs.row_of(
        "tubes", [{"verdict": "good", "same": 1.0, "near": 1.0, "seconds": 1.0, "cm": [0.0, 1.0]} | more] * 2
    )
    assert (row["median_cm"], row["high_good_cm"], row["near_good"]) == (0.5, 1.0, 1.0)
    assert rigs.main(["--data", str(tmp_path), "--folders", "horses"]) == 1
    assert "*.glb files in" in capsys.readouterr().err


def test_what_the_target_s_own_rig_does_not_move_has_no_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.glb", "b.glb"):
        write_tube(tmp_path / name)
    monkeypatch.setattr(Matcher, "match", lambda _, a, b: VertexMap.between(a, b, np.arange(a.V), verdict="good"))
    source, target = rigs._Character(tmp_path / "a.glb"), rigs._Character(tmp_path / "b.glb")
    moved = np.ones(target.shape.V)
    moved[:20] = 0
    target.weights = SkinWeights(csr_array(diags_array(moved) @ target.weights.matrix), target.weights.names)
    row = rigs.measure_pair(source, target, Matcher("human"))
    assert (row["same"], row["near"], row["nearest"]) == (1.0, 1.0, 1.0)


def test_joints_that_one_rig_lacks_and_feet_that_hang_from_the_root(tmp_path: Path) -> None:
    write_tube(tmp_path / "a.glb")
    one = rigs._Character(tmp_path / "a.glb")
    names = set(one.weights.names)
    assert set(rigs._main_joints(one, one.weights, names)) == {"hip", "knee", "foot"}
    assert set(rigs._main_joints(one, one.weights, names - {"knee"})) == {"hip", "foot"}  # the knee's go to the hip
    assert one.nearest_shared("knee", {"foot"}) == ""


def test_a_foot_of_inverse_kinematics_is_the_neighbour_of_the_shin_that_ends_there(tmp_path: Path) -> None:
    write_tube(tmp_path / "a.glb")
    rig = rigs._Character(tmp_path / "a.glb").rig
    feet = {("knee", "foot"), ("foot", "knee")}
    assert not feet & rigs.neighbours(rig, 0.02)
    assert feet <= rigs.neighbours(rig, 0.11)  # the shin's end lies 0.1 beyond the foot


def test_a_shape_that_moves(tmp_path: Path) -> None:
    shape = write_tube(tmp_path / "a.glb")
    one = rigs._Character(tmp_path / "a.glb")
    still = replace(one.rig, clips=())
    np.testing.assert_allclose(
        skin_vertices(shape.verts, one.weights.matrix, still, pose_in_motion(still)), shape.verts, atol=1e-6
    )
    running = replace(one.rig, clips=tuple(replace(clip, name="Run") for clip in one.rig.clips))
    sitting = replace(still, names=tuple("LowerLeg" if name == "knee" else name for name in still.names))
    for rig in (running, sitting):
        moved = skin_vertices(shape.verts, one.weights.matrix, still, pose_in_motion(rig))
        hip = shape.verts[:, 1] < 0.7
        np.testing.assert_allclose(moved[hip], shape.verts[hip], atol=1e-6)
        assert np.abs(moved - shape.verts).max() > 0.3
        assert 0.7 < volume(moved, shape) / volume(shape.verts, shape) < 1.0
    assert volume(2 * shape.verts, shape) == pytest.approx(8 * volume(shape.verts, shape))
    main = np.full(shape.V, one.weights.names.index("hip"))
    away = distances_from_bones(shape.verts, main, one.rig)
    assert away[shape.verts[:, 1] < 0.9].max() <= 0.26 and away.max() > 0.9


def test_other_ways_to_weights(tmp_path: Path) -> None:
    shape = write_tube(tmp_path / "a.glb")
    weights = rigs._Character(tmp_path / "a.glb").weights.matrix
    for found in nearest_and_inpainted(shape, shape.verts, weights, shape):
        np.testing.assert_allclose(found.toarray(), weights.toarray(), atol=1e-5)
    band = np.abs(shape.verts[:, 1] - 1.0) < 0.15
    away = shape.verts + np.outer(band, [0, 0, 5.0])
    inpainted = nearest_and_inpainted(shape, away, weights, shape)[1].toarray()
    off = np.abs(inpainted - weights.toarray()).max(axis=1)
    assert off[~band].max() < 0.3 and off[band].max() < 0.2


def test_neighbours_are_parents_children_and_siblings(tmp_path: Path) -> None:
    write_tube(tmp_path / "a.glb")
    near = rigs._Character(tmp_path / "a.glb").near
    assert {("hip", "hip"), ("hip", "knee"), ("knee", "hip"), ("hip", "foot"), ("hip", "root")} <= near
    assert not {("knee", "foot"), ("armature", "tip")} & near
