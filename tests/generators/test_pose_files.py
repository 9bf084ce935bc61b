"""Files of poses: what is read, what is refused, and that bodies stand as the file says."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.errors import InputError, OptionError
from meshmatch.generators import bodies, pose_files
from meshmatch.generators.bodies import sample_bodies
from meshmatch.generators.pose_files import GivenPoses, load_poses
from meshmatch.generators.rig import Rig, forward_kinematics
from meshmatch.shapes import input_files
from tests.generators.stick import seeded, stick_figure
from tests.training.small import egg_template

JOINTS = ("lowerarm01.L", "head", "root")
VECTORS = np.array([[[0.1, 0.2, -0.3], [0, 0.5, 0], [0, 0, 0]], [[0, 0, 0], [0, -1, 0.25], [0, 3.1, 0]]])


def write(path: Path, joints=JOINTS, vectors=VECTORS) -> Path:
    if path.suffix == ".npz":
        np.savez(path, joints=np.array(joints), rotations=np.asarray(vectors))
    elif path.suffix == ".json":
        path.write_text(json.dumps({"joints": list(joints), "rotations": np.asarray(vectors).tolist()}))
    else:
        rows = [
            f"p{pose},{joint},{','.join(str(v) for v in vectors[pose][k])}"
            for pose in range(len(vectors))
            for k, joint in enumerate(joints)
        ]
        path.write_text("pose,joint,x,y,z\n" + "\n".join(rows) + "\n")
    return path


@pytest.fixture(scope="module")
def rig() -> Rig:
    return stick_figure(3)


@pytest.mark.parametrize("suffix", [".npz", ".json", ".csv"])
def test_every_format_reads_the_same(tmp_path: Path, suffix: str) -> None:
    found = load_poses(write(tmp_path / f"poses{suffix}"), 0.25)
    assert found.joints == JOINTS
    assert np.allclose(found.vectors, VECTORS)
    assert found.vectors.dtype == np.float32
    assert (found.P, found.share) == (2, 0.25)


def test_a_table_may_leave_out_what_rests_and_mix_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("\ufeffpose, joint, x, y, z\r\nsit,head,0,1,0\r\n\r\nwave,wrist.L,0.5,0,0\r\nsit,wrist.L,0,0,2\r\n")
    found = load_poses(path)
    assert found.joints == ("head", "wrist.L")
    assert found.vectors.tolist() == [[[0, 1, 0], [0, 0, 2]], [[0, 0, 0], [0.5, 0, 0]]]


def test_bodies_stand_as_the_file_says(rig: Rig) -> None:
    """The forearm turned by a quarter about z: everything beyond the elbow turns about the elbow."""
    turn = np.array([[[0.0, 0, np.pi / 2]]])
    poses = GivenPoses(("lowerarm01.L",), turn, share=1.0)
    heads = rig.heads[:1]
    still = torch.full((1, len(rig.names), 3, 3), torch.nan), torch.full((1, len(rig.names), 3), torch.nan)
    world, offset = poses.mixed(rig, heads, *still, seeded())
    posed = ((world @ heads[..., None])[..., 0] + offset)[0]
    elbow, wrist, hand = (rig.joint(name) for name in ("lowerarm01.L", "wrist.L", "finger3-1.L"))
    rest = heads[0]
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for beyond in (wrist, hand):
        assert torch.allclose(posed[beyond], quarter @ (rest[beyond] - rest[elbow]) + rest[elbow], atol=1e-6)
    assert torch.allclose(posed[rig.joint("wrist.R")], rest[rig.joint("wrist.R")], atol=1e-6)
    assert torch.allclose(posed[elbow], rest[elbow], atol=1e-6)


def test_a_parent_acts_after_its_child(rig: Rig) -> None:
    vectors = np.array([[[0.4, 0, 0], [0, 0.9, 0]]])
    poses = GivenPoses(("lowerarm01.R", "upperarm01.R"), vectors, share=1.0)
    rotations = torch.eye(3).repeat(1, len(rig.names), 1, 1)
    from meshmatch.generators.rotations import rotation_from_vector

    for name, vector in zip(poses.joints, vectors[0], strict=True):
        rotations[0, rig.joint(name)] = rotation_from_vector(torch.from_numpy(vector)).float()
    wanted = forward_kinematics(rig, rig.heads[:1], rotations)
    found = poses.mixed(rig, rig.heads[:1], *(torch.zeros_like(part) for part in wanted), seeded())
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(found, wanted, strict=True))


def test_the_share_is_kept_and_the_others_stand_as_without(rig: Rig) -> None:
    B = 400
    poses = GivenPoses(JOINTS, VECTORS, share=0.3)
    plain = sample_bodies(rig, B, seeded(5))
    mixed = sample_bodies(rig, B, seeded(5), poses)
    again = sample_bodies(rig, B, seeded(5), poses)
    assert torch.equal(mixed, again)
    taken = (plain != mixed).flatten(1).any(1)
    assert 0.2 < taken.float().mean() < 0.4
    none = sample_bodies(rig, B, seeded(5), GivenPoses(JOINTS, VECTORS, share=0.0))
    assert torch.equal(none, plain)
    every = sample_bodies(rig, B, seeded(5), GivenPoses(JOINTS, VECTORS, share=1.0))
    assert torch.equal(every[taken], mixed[taken])
    # both poses of the file are drawn: the second one turns the body about face
    toe, heel = (4 * rig.joint(name) for name in ("toe2-1.L", "foot.L"))
    faces_back = (every[:, toe] - every[:, heel])[:, 2] < 0
    assert 0.4 < faces_back.float().mean() < 0.6


def test_a_joint_that_the_body_lacks_is_told_with_its_neighbours(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = GivenPoses(("lowerarm1.L",), np.zeros((1, 1, 3)))
    with pytest.raises(InputError, match=r"no joint 'lowerarm1\.L'") as caught:
        poses.columns(rig)
    assert "lowerarm01.L" in caught.value.hint
    with pytest.raises(InputError, match="no joint 'Hips'") as caught:
        GivenPoses(("Hips",), np.zeros((1, 1, 3))).columns(rig)
    assert "docs/formats.md" in caught.value.hint
    monkeypatch.setattr(bodies, "template_rig", lambda *_: rig)
    with pytest.raises(InputError, match=r"no joint 'lowerarm1\.L'"):
        bodies.human_source(egg_template(), poses=poses)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"vectors": VECTORS * 57.3}, "more than a full turn"),
        ({"vectors": VECTORS * 1e30}, "more than a full turn"),
        ({"vectors": np.where(VECTORS == 0.5, np.nan, VECTORS)}, "pose 0 has a rotation of 'head'"),
        ({"vectors": np.where(VECTORS == 0.5, 1e308, VECTORS)}, "pose 0 has a rotation of 'head'"),
        ({"vectors": VECTORS[:, :2]}, "not numbers of"),
        ({"vectors": VECTORS[..., :2]}, "not numbers of"),
        ({"vectors": VECTORS[:0]}, "no poses"),
        ({"joints": ("head", "root", "head")}, "'head' is named twice"),
    ],
)
@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_what_is_no_pose_is_told(tmp_path: Path, suffix: str, changes: dict, told: str) -> None:
    path = write(tmp_path / f"bad{suffix}", **changes)
    if suffix == ".json" and changes.get("vectors") is not None and len(changes["vectors"]) == 0:
        told = "not numbers of"  # an empty list has lost its shape
    with pytest.raises(InputError, match=told) as caught:
        load_poses(path)
    assert caught.value.message.startswith(f"bad{suffix}: ")
    assert caught.value.hint


def archive(**members: bytes) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return data.getvalue()


def npy(array: np.ndarray) -> bytes:
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def header(kind: str, *shape: int) -> bytes:
    """The beginning of an npy file, which may promise anything."""
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": kind, "fortran_order": False, "shape": shape})
    return data.getvalue()


NAMES = npy(np.array(JOINTS))
NAMELESS = header("|S0", 10**6 + 1) + bytes(10**6 + 1)
BROKEN: dict[str, tuple[str, bytes, str]] = {
    "empty archive": (".npz", b"", "not a zip file"),
    "text as archive": (".npz", b"head 1 2 3\n", "not a zip file"),
    "cut archive": (".npz", archive(joints=NAMES, rotations=npy(VECTORS))[:-40], "not a zip file"),
    "no rotations": (".npz", archive(joints=NAMES), "has no rotations"),
    "names are numbers": (".npz", archive(joints=npy(np.arange(3)), rotations=npy(VECTORS)), "not a list of names"),
    "no npy inside": (".npz", archive(joints=b"abc", rotations=npy(VECTORS)), "does not hold arrays"),
    "short array": (".npz", archive(joints=NAMES, rotations=npy(VECTORS)[:-8]), "does not hold arrays"),
    "too many names": (".npz", archive(joints=npy(np.zeros(10**6 + 1, "S1")), rotations=npy(VECTORS)), "too many"),
    "names of no letters": (".npz", archive(joints=NAMELESS, rotations=npy(VECTORS)), "too many"),
    "a long name": (".npz", archive(joints=npy(np.zeros(1, "S1000001")), rotations=npy(VECTORS)), "too many"),
    "text for numbers": (".npz", archive(joints=NAMES, rotations=npy(VECTORS.astype(str))), "not numbers of"),
    "complex": (".npz", archive(joints=NAMES, rotations=npy(VECTORS + 0j)), "not numbers of"),
    "empty json": (".json", b"", "is empty"),
    "a list": (".json", b"[1, 2]", "not an object"),
    "no joints": (".json", b'{"rotations": []}', "it has no joints"),
    "joints no list": (".json", b'{"joints": "head", "rotations": []}', "not a list of names"),
    "joints no names": (".json", b'{"joints": [1], "rotations": [[[0, 0, 0]]]}', "not a list of names"),
    "ragged": (".json", b'{"joints": ["head"], "rotations": [[[0, 0, 0]], [[0, 0]]]}', "equal length"),
    "a number without end": (".json", b'{"joints": ["head"], "rotations": [[[0, 0, 1%s]]]}' % (b"0" * 400), "equal length"),
    "an object inside": (".json", b'{"joints": ["head"], "rotations": {"a": 1}}', "equal length"),
    "deep": (".json", b"[" * 100_000, "is not a file of poses"),
    "bytes": (".json", b"\xff\xfe\x00", "is not a file of poses"),
    "empty table": (".csv", b"", "is empty"),
    "another table": (".csv", b"a,b\n1,2\n", "first line is not pose,joint,x,y,z"),
    "a table without rows": (".csv", b"pose,joint,x,y,z\n", "no poses"),
    "a short row": (".csv", b"pose,joint,x,y,z\n1,head,0,0\n", "line 2 has 4 columns"),
    "a word": (".csv", b"pose,joint,x,y,z\n1,head,0,0,north\n", "line 2 has text"),
    "a row twice": (".csv", b"pose,joint,x,y,z\n1,head,0,0,1\n1,head,0,0,1\n", "again"),
    "not a number": (".csv", b"pose,joint,x,y,z\n1,head,0,nan,1\n", "not a number"),
}  # fmt: skip


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_line(tmp_path: Path, case: str) -> None:
    suffix, data, told = BROKEN[case]
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=told) as caught:
        load_poses(path)
    assert "bad" in caught.value.message
    assert len(caught.value.message) < 300
    assert caught.value.hint


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, joints=np.array(JOINTS, dtype=object), rotations=VECTORS)
    with pytest.raises(InputError, match="holds Python objects"):
        load_poses(path)


def test_a_promise_of_terabytes_is_not_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "bad.npz"
    path.write_bytes(archive(joints=NAMES, rotations=header("<f8", 10**9, 3, 3) + b"\0" * 100))
    with pytest.raises(InputError, match=r"rotations\.npy promises 72000000000 bytes"):
        load_poses(path)
    path.write_bytes(archive(joints=NAMES, rotations=npy(np.zeros((4000, 3, 3)))))  # small on disk
    assert load_poses(path).P == 4000
    monkeypatch.setattr(input_files, "LARGEST", 200_000)
    with pytest.raises(InputError, match=r"rotations\.npy promises 288000 bytes"):
        load_poses(path)
    monkeypatch.setattr(pose_files, "MAX_BYTES", 2000)
    path.write_bytes(b"\0" * 3000)
    with pytest.raises(InputError, match=r"bad\.npz: it is larger"):
        load_poses(path)


def test_a_table_of_strangers_does_not_grow_to_its_square(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_files, "MAX_VECTORS", 100)
    path = tmp_path / "bad.csv"
    path.write_text("pose,joint,x,y,z\n" + "".join(f"{k},joint{k},0,0,0\n" for k in range(11)))
    with pytest.raises(InputError, match="11 poses of 11 joints are too many"):
        load_poses(path)


def test_files_that_are_not_there_and_shares_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no file"):
        load_poses(tmp_path / "poses.npz")
    with pytest.raises(InputError, match=r"poses\.bvh is not a file of poses") as caught:
        load_poses(tmp_path / "poses.bvh")
    assert ".npz, .json, .csv" in caught.value.hint
    for share in (-0.1, 1.5, float("nan")):
        with pytest.raises(OptionError, match="from 0 to 1"):
            load_poses(write(tmp_path / "poses.npz"), share)


def test_the_page_names_the_joints(rig: Rig) -> None:
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text()
    stems = {name.removesuffix(".L").removesuffix(".R") for name in rig.names}
    inner = {f"{limb}{n}-{k}" for limb in ("toe", "finger") for n in range(1, 6) for k in (1, 2, 3)}
    inner |= {f"spine0{k}" for k in (2, 3, 4)} | {"neck02"}
    assert {name for name in stems - inner if f"`{name}`" not in page} == set()
