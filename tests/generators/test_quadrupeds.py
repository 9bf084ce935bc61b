"""Generated animals, on a small rig: a ball with a skeleton, in the files that MuJoCo has; and on the dog where it is."""

import importlib.util
import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from meshmatch.errors import InputError
from meshmatch.generators import quadruped_rig, quadrupeds
from meshmatch.generators.quadruped_rig import LIMITS, AnimalRig, group_of, load_rig
from meshmatch.generators.quadrupeds import KINDS, TRAITS, draw_angles, draw_traits, make_animal, resting_animal
from meshmatch.geometry.triangles import is_watertight
from meshmatch.templates.make import NodeConfig

# Name: parent, place (x forward, y left, z up); those of a side have a partner on the other.
_LEGS = {
    "upper_leg_L": ("pelvis", (-0.3, 0.05, 0.45)), "lower_leg_L": ("upper_leg_L", (-0.34, 0.06, 0.3)),
    "foot_L": ("lower_leg_L", (-0.5, 0.06, 0.15)), "toe_L": ("foot_L", (-0.5, 0.06, 0.04)),
    "scapula_L": ("torso", (0.12, 0.03, 0.55)), "upper_arm_L": ("scapula_L", (0.2, 0.05, 0.43)),
    "lower_arm_L": ("upper_arm_L", (0.15, 0.06, 0.28)), "hand_L": ("lower_arm_L", (0.15, 0.06, 0.09)),
    "finger_L": ("hand_L", (0.17, 0.06, 0.03)),
}  # fmt: skip
_MIDDLE = {
    "jaw": ("skull", (0.35, 0.0, 0.63)), "skull": ("C_7", (0.34, 0.0, 0.69)), "C_7": ("torso", (0.2, 0.0, 0.5)),
    "torso": ("", (0.04, 0.0, 0.42)), "L_1": ("torso", (-0.1, 0.0, 0.5)), "pelvis": ("L_1", (-0.3, 0.0, 0.48)),
    "Ca_1": ("pelvis", (-0.4, 0.0, 0.5)), "Ca_2": ("Ca_1", (-0.5, 0.0, 0.4)),
}  # fmt: skip


def octahedron(rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball whose triangles do not cross the planes of symmetry."""
    verts = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(rounds):
        corners = verts[faces]
        middle = (corners + np.roll(corners, -1, axis=1)) / 2
        soup = np.concatenate([corners, middle], axis=1).reshape(-1, 3)
        verts, own = np.unique(np.round(soup, 9), axis=0, return_inverse=True)
        a, b, c, d, e, f = own.reshape(-1, 6).T
        faces = np.stack([a, d, f, d, b, e, f, e, c, d, e, f]).T.reshape(-1, 3)
    return verts / np.linalg.norm(verts, axis=1, keepdims=True), faces


@pytest.fixture(scope="module")
def assets(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The two files of the dog, of a ball."""
    folder = tmp_path_factory.mktemp("dog_v2")
    bones = dict(_MIDDLE)
    for name, (parent, place) in _LEGS.items():
        other = parent[:-2] + "_R" if parent.endswith("_L") else parent
        bones |= {name: (parent, place), name[:-2] + "_R": (other, (place[0], -place[1], place[2]))}
    verts, faces = octahedron(4)
    verts = verts * [0.5, 0.2, 0.3] + [0.0, 0.0, 0.42]
    joints = np.array([place for _, place in bones.values()])
    weights = np.exp(-np.square(np.linalg.norm(verts[:, None] - joints, axis=2) / 0.15))
    # As in the file of the dog: triangles with vertices of their own, to be welded.
    soup, corners = faces.reshape(-1), np.arange(faces.size)
    content = struct.pack("<4i", len(soup), len(soup), len(faces), len(bones))
    content += verts[soup].astype("<f4").tobytes() + np.zeros(2 * len(soup), "<f4").tobytes()
    content += corners.astype("<i4").tobytes()
    for bone, (name, place) in enumerate(zip(bones, joints, strict=True)):
        content += name.encode().ljust(40, b"\0") + np.array([*place, 1, 0, 0, 0], "<f4").tobytes()
        content += struct.pack("<i", len(soup)) + corners.astype("<i4").tobytes()
        content += weights[soup, bone].astype("<f4").tobytes()
    (folder / quadruped_rig.SKIN).write_bytes(content)

    def body(name: str) -> str:
        inside = "".join(body(child) for child, (parent, _) in bones.items() if parent == name)
        return f'<body name="{name}">{"<body>" + inside + "</body>" if name == "torso" else inside}</body>'

    (folder / quadruped_rig.SKELETON).write_text(f"<mujoco><worldbody>{body('torso')}</worldbody></mujoco>")
    return folder


@pytest.fixture(scope="module")
def rig(assets: Path) -> AnimalRig:
    return load_rig(assets, faces=1200)


def check_rig(rig: AnimalRig) -> None:
    assert is_watertight(rig.faces)
    mirrored = rig.verts[rig.mirror] * [-1, 1, 1]
    assert np.abs(mirrored - rig.verts).max() < 1e-12
    assert np.abs(rig.weights.sum(1) - 1).max() < 1e-6
    other = [
        rig.names.index({"L": n[:-1] + "R", "R": n[:-1] + "L"}.get(n[-1], n) if n[-2] == "_" else n) for n in rig.names
    ]
    assert np.abs(rig.weights[rig.mirror][:, other] - rig.weights).max() < 1e-9
    assert (rig.parents < np.arange(len(rig.names))).all()
    assert set(map(group_of, rig.names)) <= set(LIMITS)


def test_the_rig_is_closed_and_symmetric(rig: AnimalRig) -> None:
    check_rig(rig)
    assert 600 < len(rig.faces) <= 1300
    assert rig.names[0] == "torso"
    assert rig.names[rig.parents[rig.names.index("jaw")]] == "skull"
    assert np.ptp(rig.verts[:, 2]) == pytest.approx(1.0, abs=0.02)  # the length lies along z
    assert rig.joints[rig.names.index("foot_L"), 0] > 0  # and its left at +x


def test_an_animal_is_a_function_of_seed_and_number(rig: AnimalRig) -> None:
    first = make_animal(rig, 3, 7)
    assert np.array_equal(first, make_animal(rig, 3, 7))
    assert np.isfinite(first).all()
    for seed, number in ((3, 8), (4, 7)):
        assert np.abs(make_animal(rig, seed, number) - first).max() > 0.01


def test_the_animal_at_rest_is_symmetric(rig: AnimalRig) -> None:
    rest = resting_animal(rig)
    assert np.abs(rest[rig.mirror] * [-1, 1, 1] - rest).max() < 1e-9


def test_parts_are_those_of_the_bones(rig: AnimalRig) -> None:
    labels, names = quadrupeds.body_parts(rig)
    assert {"trunk", "tail", "left hock", "right hock"} <= set(names)
    exchanged = [name.replace("left", "x").replace("right", "left").replace("x", "right") for name in names]
    sides = np.abs(rig.verts[:, 0]) > 0.02
    assert (np.array(exchanged)[labels] == np.array(names)[labels[rig.mirror]])[sides].all()


def test_bones_turn_within_the_limits_of_their_joints(rig: AnimalRig) -> None:
    rng = np.random.default_rng(0)
    seen = np.array([draw_angles(rig, draw_traits(rng), rng) for _ in range(60)])
    low, high = np.array([LIMITS[group_of(name)] for name in rig.names]).transpose(2, 0, 1)
    assert (seen >= low - 1e-9).all()
    assert (seen <= high + 1e-9).all()
    assert (seen[:, 0] == 0).all()  # the trunk is the frame
    bends = np.ptp(seen[:, [rig.names.index("lower_leg_L"), rig.names.index("jaw")], 0], axis=0)
    assert (bends > 40).all()


def test_kinds_name_known_traits() -> None:
    assert all(set(traits) <= set(TRAITS) for traits in KINDS.values())
    rng = np.random.default_rng(1)
    drawn = [draw_traits(rng) for _ in range(200)]
    assert min(each["leg"] for each in drawn) > 0.4
    assert max(each["wide"] for each in drawn) > 1.8  # as a hippo
    assert np.mean([each["bush"] > 0.4 for each in drawn]) > 0.2


def test_a_thicker_bone_is_thicker_and_a_longer_one_longer(rig: AnimalRig) -> None:
    still = np.zeros((len(rig.names), 3))
    sizes = np.tile(np.eye(3), (len(rig.names), 1, 1))
    assert np.allclose(quadruped_rig.skinned(rig, rig.verts, sizes, still), rig.verts)
    longer = quadruped_rig.skinned(rig, rig.verts, sizes * np.array([1.0, 1.0, 2.0]), still)
    assert np.ptp(longer[:, 2]) == pytest.approx(2 * np.ptp(rig.verts[:, 2]), rel=0.02)
    assert np.ptp(longer[:, 0]) == pytest.approx(np.ptp(rig.verts[:, 0]), rel=0.02)


def test_the_generator_draws_registered_animals(assets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quadruped_rig, "find_assets", lambda folder: assets)
    monkeypatch.setattr(quadrupeds, "_NODES", NodeConfig("uniform", 60, 0.4))
    first, again, other = (quadrupeds.quadruped_generator(3, seed) for seed in (5, 5, 6))
    template = first.template
    assert (template.name, template.label_names) == ("quadruped", quadrupeds.body_parts(load_rig())[1])
    assert is_watertight(template.shape.faces)
    drawn = [made.draw(8, torch.Generator().manual_seed(1)) for made in (first, again, other)]
    assert drawn[0].shape == (8, template.shape.V, 3)
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert again.template.hash == template.hash == other.template.hash
    assert "3 four-legged animals" in first.data


def test_missing_and_damaged_files_are_errors(assets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"lacks dog_skin\.skn") as caught:
        load_rig(tmp_path)
    assert "dm_control" in caught.value.hint
    skin = (assets / quadruped_rig.SKIN).read_bytes()
    for name, content in ((quadruped_rig.SKIN, skin[:-50]), (quadruped_rig.SKELETON, b"<mujoco>")):
        for file in assets.iterdir():
            (tmp_path / file.name).write_bytes(file.read_bytes())
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="of MuJoCo"):
            load_rig(tmp_path)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="not installed") as caught:
        load_rig()
    assert "pip install --no-deps dm_control" in caught.value.hint


@pytest.mark.skipif(importlib.util.find_spec("dm_control") is None, reason="dm_control is not installed")
def test_the_dog() -> None:
    rig = load_rig()
    check_rig(rig)
    assert 4500 < len(rig.verts) < 5200
    rest = resting_animal(rig)
    assert np.abs(rest[rig.mirror] * [-1, 1, 1] - rest).max() < 1e-3  # metres: its joints are that far from symmetric
