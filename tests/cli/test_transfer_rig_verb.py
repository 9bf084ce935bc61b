"""transfer-rig through the program's only door."""

from pathlib import Path

import numpy as np
import pytest

from meshmatch.fitting.fit_config import FitConfig
from meshmatch.maps.files import save_map
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape, save_shape
from meshmatch.shapes.formats.gltf_rig import read_rig
from meshmatch.shapes.shape import Shape
from tests.cli.conftest import FakeMatching, Run, refused, well
from tests.transfer.rigs import NODES, tube, write_tube

CALL = ("transfer-rig", "a.glb", "b.ply", "-o", "rigged.glb")


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A rigged tube a.glb, a larger one b.ply, the map between them, and a good file where the output goes."""
    monkeypatch.chdir(tmp_path)
    write_tube(Path("a.glb"))
    shape = tube()
    save_shape("b.ply", Shape(2 * shape.verts, shape.faces))
    a, b = load_shape("a.glb"), load_shape("b.ply")
    save_map("ab.npz", VertexMap.between(a, b, np.arange(a.V), verdict="good"))
    save_map("ba.npz", VertexMap.between(b, a, np.arange(a.V), verdict="good"))
    save_map("poor.npz", VertexMap.between(a, b, np.arange(a.V), verdict="poor", reasons=("an arm is missing",)))
    return tmp_path


def test_a_rig_by_a_map(run: Run, pair: Path) -> None:
    answer = well(run(*CALL, "--map", "ab.npz", "--json", "--picture", "p.png"))
    record = answer.record
    assert record.items() >= {
        ("output", "rigged.glb"), ("picture", "p.png"), ("pose", "rest"), ("joints", 4), ("replaced_joints", 0),
        ("source", "a.glb"), ("target", "b.ply"), ("map", "ab.npz"), ("verdict", "good"),
    }  # fmt: skip
    assert (record["clips"], record["unused_joints"]) == (["bend"], [])
    assert "wrote rigged.glb: b.ply with 4 joints, 1 clip\n" in answer.err
    assert Path("p.png").stat().st_size > 1000
    rig = read_rig(Path("rigged.glb"), Path("rigged.glb").read_bytes())
    assert rig.names == ("a", *NODES[:-1])
    answer = well(run(*CALL, "--map", "ab.npz", "--quiet", "--pose", "source"))
    assert (answer.out, answer.err) == ("", "")


def test_a_vrm_is_read_and_a_rigged_target_said(run: Run, pair: Path) -> None:
    Path("a.vrm").write_bytes(Path("a.glb").read_bytes())
    Path("c.vrm").write_bytes(Path("a.glb").read_bytes())
    a = load_shape("a.vrm")
    save_map("aa.npz", VertexMap.between(a, load_shape("c.vrm"), np.arange(a.V)))
    answer = well(run("transfer-rig", "a.vrm", "c.vrm", "-o", "rigged.glb", "--map", "aa.npz"))
    assert "note: the skeleton that c.vrm had (4 joints) is replaced\n" in answer.err
    assert "warning: 1 clip of that skeleton no longer moves anything: bend\n" in answer.err


def test_a_single_joint_is_in_the_singular(run: Run, pair: Path) -> None:
    write_tube(Path("a.glb"), skins=[{"joints": [1, 1, 1, 1], "inverseBindMatrices": 4}], clips=False)
    assert "wrote rigged.glb: b.ply with 1 joint\n" in well(run(*CALL)).err


def test_joints_without_a_vertex_are_named(run: Run, pair: Path) -> None:
    """The target is the lower part of the source."""
    shape = tube()
    used, faces = np.unique(shape.faces[(shape.verts[shape.faces, 1] < 1.5).all(axis=1)], return_inverse=True)
    save_shape("b.ply", Shape(shape.verts[used], faces.reshape(-1, 3)))
    a, b = load_shape("a.glb"), load_shape("b.ply")
    nearest = np.linalg.norm(a.verts[:, None] - b.verts[None], axis=2).argmin(axis=1)
    save_map("low.npz", VertexMap.between(a, b, nearest, confidence=(a.verts[:, 1] < 1.5).astype("f4")))
    answer = well(run(*CALL, "--map", "low.npz", "--json"))
    assert answer.record["unused_joints"] == ["foot"]
    assert "warning: 1 joint that moves a.glb has no vertex on the target: foot\n" in answer.err


def test_options_reach_the_matching(run: Run, pair: Path, stub: FakeMatching) -> None:
    well(run(*CALL, "--source-up", "y", "--target-up", "z", "--seed", "7", "--threads", "3", "--whole"))
    config = FitConfig(up="y", seed=7, partial="no"), FitConfig(up="z", seed=7, partial="no")
    assert (stub.called["config"], stub.called["threads"]) == (config, 3)


WRONG = [
    ("--map ba.npz", "runs the wrong way"),
    ("--map gone.npz", "there is no file gone.npz"),
    ("--map ab.npz --partial", "--partial does not go with --map"),
    ("--map poor.npz --strict", "an arm is missing"),
    ("--model humna", "did you mean human?"),
    ("--up y --front -y", "along one axis"),
    ("--picture p.jpg", "a picture is a PNG"),
]


@pytest.mark.parametrize(("words", "told"), WRONG)
def test_what_cannot_be_is_told_in_a_line(run: Run, pair: Path, no_fit: None, words: str, told: str) -> None:
    Path("rigged.glb").write_bytes(b"old")
    before = {path.name for path in pair.iterdir()}
    refused(run(*CALL, *words.split()), told, pair, before)
    assert Path("rigged.glb").read_bytes() == b"old"


OTHERS = [
    ("transfer-rig b.ply b.ply -o rigged.glb", "b.ply has no skeleton"),
    ("transfer-rig plain.glb b.ply -o rigged.glb", "plain.glb has no skin"),
    ("transfer-rig a.glb b.ply -o rigged.ply", "not a format for rigs"),
    ("transfer-rig a.glb b.ply -o a.glb", "is an input of this command"),
    ("transfer-rig a.glb b.ply -o nowhere/out.glb", "there is no folder nowhere"),
    ("transfer-rig a.glb cut.glb -o rigged.glb", "cut.glb"),
]


@pytest.mark.parametrize(("words", "told"), OTHERS)
def test_files_that_cannot_be_rigged(run: Run, pair: Path, no_fit: None, words: str, told: str) -> None:
    save_shape("plain.glb", tube())
    Path("cut.glb").write_bytes(Path("a.glb").read_bytes()[:3000])
    refused(run(*words.split()), told, pair, {path.name for path in pair.iterdir()})
