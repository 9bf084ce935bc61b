"""Bodies of a Momentum rig: what is read, how bones grow, how limbs twist, and what lies under the template."""

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from meshmatch.api.scanned import scanned_bodies
from meshmatch.errors import InputError, OptionError
from meshmatch.generators import characters
from meshmatch.generators.bodies import Bodies
from meshmatch.generators.characters import people_source
from meshmatch.generators.generator import Source, mix_sources
from meshmatch.generators.momentum_rig import MomentumRig, Scanned, read_momentum_rig
from meshmatch.generators.pose_files import GivenPoses
from meshmatch.generators.rig import forward_kinematics
from meshmatch.generators.rotations import rotation_from_vector
from meshmatch.generators.scanned_bodies import (
    TwistingRig,
    build_twisting_rig,
    half_rotation,
    random_people,
    sample_scanned,
    scanned_source,
)
from meshmatch.geometry.trees import cKDTree
from meshmatch.templates.template import read_template
from tests.fitting.eggs import egg_template
from tests.generators.momentum_files import fbx, node, write_rig
from tests.generators.stick import seeded

MHR = Path(__file__).parents[3] / "shared" / "train" / "mhr"
needs_mhr = pytest.mark.skipif(not MHR.is_dir(), reason="the Momentum rig's files are not here")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("rig")
    write_rig(made)
    return made


@pytest.fixture(scope="module")
def rig(folder: Path) -> MomentumRig:
    return read_momentum_rig(folder)


def on_own_vertices(rig: MomentumRig, share: float = 0.5) -> Scanned:
    """The bodies on their own vertices."""
    corners = np.arange(len(rig.verts))[:, None].repeat(3, 1)
    return Scanned(rig, corners, np.tile([1.0, 0, 0], (len(corners), 1)), share)


@pytest.fixture(scope="module")
def people(rig: MomentumRig) -> TwistingRig:
    return build_twisting_rig(on_own_vertices(rig), rig.faces, 5, 0)


def test_both_files_are_read(rig: MomentumRig, folder: Path) -> None:
    joints = len(rig.joints)
    assert rig.verts.shape == (4 * joints, 3) and rig.faces.shape == (4 * joints, 3)
    assert (rig.joints[0], rig.parents[0]) == ("body_world", -1) and all(p < k for k, p in enumerate(rig.parents))
    assert rig.verts[:, 1].max() == pytest.approx(1.67)  # metres
    assert np.allclose(
        rig.shapes[:, :, 0], 0.001 * np.diag(np.arange(4 * joints))[:47]
    )  # in the order of their numbers
    assert np.array_equal(rig.weights, np.eye(joints).repeat(4, 0))
    assert rig.parameters == ("scale_lowarms", "scale_l_hands", "scale_r_hands")  # what may vary of bone lengths alone
    assert rig.limits.tolist() == [[-1, 0.5], [-0.2, 0.2], [-0.2, 0.2]]


def test_bones_grow_and_fingers_bend(rig: MomentumRig) -> None:
    number = rig.joints.index
    _, rest = rig.frames(np.zeros((1, 3)))
    assert np.allclose(rest[0], rig.verts.reshape(-1, 4, 3).mean(1))
    _, grown = rig.frames(np.array([[0.5, 1.0, 0.0]]))
    moved = grown[0] - rest[0]
    assert np.allclose(moved[number("l_wrist")], [0.05, 0, 0]) and np.allclose(moved[number("r_wrist")], [-0.05, 0, 0])
    hand = rest[0, number("l_middle3")] - rest[0, number("l_wrist")]
    assert np.allclose(moved[number("l_middle3")], np.array([0.05, 0, 0]) + hand)  # twice as large
    assert np.allclose(moved[number("l_lowarm")], 0)
    bent = np.zeros(len(rig.joints))
    bent[number("l_index2")] = 0.3
    _, curled = rig.frames(np.zeros((1, 3)), bent)
    assert np.flatnonzero(np.abs(curled - rest).max((0, 2)) > 1e-9).tolist() == [number("l_index3")]


def test_people_vary_within_the_limits(rig: MomentumRig) -> None:
    verts, joints = random_people(rig, 400, np.random.default_rng(0))
    side = joints[:, [rig.joints.index(f"{s}_wrist") for s in "lr"], 0]
    longer = side[:, 0] - side[:, 0].min()
    assert np.allclose(side[:, 0], -side[:, 1])  # both arms alike
    assert 0.01 < longer.std() and longer.max() <= 0.15 + 1e-9
    assert not np.allclose(verts[0], verts[1])
    again = random_people(rig, 400, np.random.default_rng(0))[0]
    assert np.array_equal(verts, again)


def test_skin_weights_are_shared_out_whole(people: TwistingRig) -> None:
    total = people.rig.weights.sum(1) + sum(twist.weights.sum(1) for twist in people.twists)
    assert torch.allclose(total, torch.ones(len(total)))


def test_a_limb_twists_along_its_length(rig: MomentumRig, people: TwistingRig) -> None:
    own, rest, heads = people.rig, people.rig.rest[:1].float(), people.rig.heads[:1]
    rotations = torch.eye(3).repeat(1, len(own.names), 1, 1)
    elbow, pronated = own.joint("lowerarm01.L"), own.joint("lowerarm02.L")
    axis = torch.nn.functional.normalize(heads[0, own.joint("wrist.L")] - heads[0, elbow], dim=0)
    rotations[:, pronated] = rotation_from_vector(axis * 1.2)
    world, offset = forward_kinematics(own, heads, rotations)
    posed = people.posed(rest, heads, world, offset)[0].reshape(-1, 4, 3)
    before = rest[0].reshape(-1, 4, 3)

    def angle(joint: str) -> float:
        place = rig.joints.index(joint)
        a, b = (each[place] - each[place].mean(0) for each in (before, posed))
        u, _, v = torch.linalg.svd(a.T @ b)
        return float(torch.acos((((u @ v).trace() - 1) / 2).clamp(-1, 1)))

    turned = [angle(f"l_{name}") for name in ("lowarm", *(f"lowarm_twist{k}_proc" for k in range(1, 5)), "wrist")]
    assert turned == pytest.approx([0, 0.24, 0.48, 0.72, 0.96, 1.2], abs=0.03)
    assert angle("r_wrist") == pytest.approx(0, abs=1e-3) and angle("l_uparm_twist2_proc") == pytest.approx(0, abs=1e-3)


def test_the_upper_arm_does_not_twist_at_the_shoulder(rig: MomentumRig, people: TwistingRig) -> None:
    own, rest, heads = people.rig, people.rig.rest[:1].float(), people.rig.heads[:1]
    rotations = torch.eye(3).repeat(1, len(own.names), 1, 1)
    first, second = own.joint("upperarm01.R"), own.joint("upperarm02.R")
    axis = torch.nn.functional.normalize(heads[0, own.joint("lowerarm01.R")] - heads[0, first], dim=0)
    rotations[:, first] = rotations[:, second] = rotation_from_vector(axis * 0.5)
    posed = people.posed(rest, heads, *forward_kinematics(own, heads, rotations))[0].reshape(-1, 4, 3)
    moved = (posed - rest[0].reshape(-1, 4, 3)).norm(dim=-1).amax(1)
    stations = [float(moved[rig.joints.index(f"r_uparm_twist{k}_proc")]) for k in range(5)]
    assert stations[0] < 1e-4 and stations == sorted(stations) and stations[4] > 0.01


def test_half_of_a_turn() -> None:
    vectors = torch.randn(20, 3, generator=seeded(1))
    assert torch.allclose(half_rotation(rotation_from_vector(vectors)), rotation_from_vector(vectors / 2), atol=1e-4)


def test_posed_bodies_are_a_function_of_the_seed(people: TwistingRig) -> None:
    drawn = sample_scanned(people, 6, seeded(3))
    assert drawn.shape == (6, people.rig.rest.shape[1], 3) and torch.isfinite(drawn).all()
    assert torch.equal(drawn, sample_scanned(people, 6, seeded(3)))
    assert not torch.equal(drawn, sample_scanned(people, 6, seeded(4)))


def test_a_share_of_the_bodies_is_of_the_other_source() -> None:
    def of(value: float) -> Source:
        return lambda count, generator: torch.full((count, 2, 3), value)

    drawn = mix_sources(of(1.0), of(2.0), 0.25)(4000, seeded(0))[:, 0, 0]
    assert set(drawn.tolist()) == {1.0, 2.0}
    assert float((drawn == 2).float().mean()) == pytest.approx(0.25, abs=0.03)
    assert (drawn[:100] == 2).any() and (drawn[-100:] == 2).any()
    assert (mix_sources(of(1.0), of(2.0), 0.0)(9, seeded(0)) == 1).all() and (
        mix_sources(of(1.0), of(2.0), 1.0)(9, seeded(0)) == 2
    ).all()


def test_people_are_a_mixture_and_the_card_says_so(rig: MomentumRig, monkeypatch: pytest.MonkeyPatch) -> None:
    template = read_template("human-T")
    under = Scanned(rig, np.zeros((template.shape.V, 3), int), np.tile([1.0, 0, 0], (template.shape.V, 1)), 0.25)
    bodies = Bodies(characters=0.5, scanned=under)
    assert "75% 4096 generated bodies" in bodies.words and "25% naked bodies of the Momentum Human Rig" in bodies.words
    posed = replace(bodies, poses=GivenPoses(("head",), np.zeros((3, 1, 3), np.float32), 0.5, "dance.csv"))
    generated, scanned = posed.words.split("; 25%")
    assert "50% of them in 3 poses of dance.csv" in generated and scanned.endswith(", in sampled poses only")
    assert "sampled poses only" not in bodies.words
    asked: list[Any] = []

    def naked(*given: Any) -> Source:
        asked.extend(given)
        return lambda count, generator: torch.full((count, template.shape.V, 3), 9.0)

    monkeypatch.setattr(characters, "human_source", naked)
    drawn = people_source(template, replace(bodies, characters=0), 0)(400, seeded(0))
    assert asked[:2] == [template, 4096]
    other = (drawn != 9).all(2).all(1)
    assert 0.17 < float(other.float().mean()) < 0.33 and (drawn[~other] == 9).all()


def test_another_template_is_refused(rig: MomentumRig) -> None:
    with pytest.raises(OptionError, match="were not made for template"):
        scanned_source(egg_template(), on_own_vertices(rig))
    with pytest.raises(OptionError, match="share"):
        on_own_vertices(rig, 1.5)


@pytest.mark.parametrize("kept", [0, 22, 26, 60, 3000])
def test_files_that_are_cut_off_are_refused(folder: Path, tmp_path: Path, kept: int) -> None:
    write_rig(tmp_path)
    whole = (folder / "lod3.fbx").read_bytes()
    (tmp_path / "lod3.fbx").write_bytes(whole[:kept])
    with pytest.raises(InputError, match=r"lod3\.fbx is not the mesh of a Momentum rig"):
        read_momentum_rig(tmp_path)


def test_arrays_that_claim_too_much_are_refused(tmp_path: Path) -> None:
    write_rig(tmp_path)
    honest = fbx([node("Objects", [], [node("Geometry", [np.zeros(4)])])])
    size = struct.pack("<III", 4, 1, 0)[:8]
    assert honest.count(size) == 1
    (tmp_path / "lod3.fbx").write_bytes(honest.replace(size, struct.pack("<II", 2**31, 1)))
    with pytest.raises(InputError, match="is not the mesh"):
        read_momentum_rig(tmp_path)


def test_missing_and_strange_parameters_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lod3\.fbx cannot be read") as told:
        read_momentum_rig(tmp_path)
    assert "facebookresearch/MHR" in str(told.value.hint)
    write_rig(tmp_path)
    (tmp_path / "compact_v6_1.model").write_text("limit l_uparm_twist minmax [-1, 1]\n")
    with pytest.raises(InputError, match="does not describe the parameters"):
        read_momentum_rig(tmp_path)


@needs_mhr
def test_the_rig_lies_under_the_template() -> None:
    template, scanned = read_template("human-T"), scanned_bodies(MHR)
    own = scanned.place(scanned.rig.verts)
    apart = cKDTree(own).query(scanned.rig.verts)[0]
    assert own.shape == (template.shape.V, 3) and np.median(apart) < 0.01 and apart.max() < 0.06
    drawn = scanned_source(template, scanned, 0, 64)(16, seeded(0))
    tall = drawn[..., 1].amax(1) - drawn[..., 1].amin(1)
    assert torch.isfinite(drawn).all() and 0.5 < float(tall.min()) and float(tall.max()) < 2.6
