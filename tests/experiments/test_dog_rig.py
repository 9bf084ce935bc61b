"""The rig of generated animals, made from the files of a ball with a skeleton; and from the dog's, where they are."""

import importlib.util
import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshmatch.errors import InputError
from meshmatch.experiments.makers import dog_rig
from meshmatch.experiments.makers.mujoco_skin import find_files, read_animal
from meshmatch.generators.quadruped_rig import AnimalRig, load_rig
from meshmatch.generators.quadrupeds import resting_animal
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, make_template
from tests.generators.animal_rigs import check_rig

SKIN, SKELETON = "dog_skin.skn", "dog.xml"
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
    (folder / SKIN).write_bytes(content)

    def body(name: str) -> str:
        inside = "".join(body(child) for child, (parent, _) in bones.items() if parent == name)
        return f'<body name="{name}">{"<body>" + inside + "</body>" if name == "torso" else inside}</body>'

    (folder / SKELETON).write_text(f"<mujoco><worldbody>{body('torso')}</worldbody></mujoco>")
    return folder


@pytest.fixture(scope="module")
def rig(assets: Path) -> AnimalRig:
    return dog_rig.symmetric_rig(read_animal(assets / SKIN, assets / SKELETON), 1200)


def test_the_rig_is_closed_and_symmetric(rig: AnimalRig) -> None:
    check_rig(rig)
    assert 600 < len(rig.faces) <= 1300
    assert rig.names[0] == "torso"
    assert rig.names[rig.parents[rig.names.index("jaw")]] == "skull"
    assert np.ptp(rig.verts[:, 2]) == pytest.approx(1.0, abs=0.02)  # the length lies along z
    assert rig.joints[rig.names.index("foot_L"), 0] > 0  # and its left at +x


def test_damaged_files_are_errors(assets: Path, tmp_path: Path) -> None:
    skin = (assets / SKIN).read_bytes()
    for name, content in ((SKIN, skin[:-50]), (SKELETON, b"<mujoco>")):
        for file in assets.iterdir():
            (tmp_path / file.name).write_bytes(file.read_bytes())
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="of MuJoCo"):
            read_animal(tmp_path / SKIN, tmp_path / SKELETON)


def test_without_dm_control(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = SimpleNamespace(submodule_search_locations=[str(tmp_path)])
    for found, told in ((None, "not installed"), (package, r"lacks rodent\.xml")):
        monkeypatch.setattr(importlib.util, "find_spec", lambda name, found=found: found)
        with pytest.raises(InputError, match=told) as caught:
            find_files("rodent.xml")
        assert "pip install --no-deps dm_control" in caught.value.hint


def test_another_decimation_is_laid_on_the_template(rig: AnimalRig, assets: Path) -> None:
    rest = Shape(resting_animal(rig), rig.faces, "ball")
    template = make_template(rest, "ball", NodeConfig("uniform", 60, 0.4))
    assert template.shape.V == len(rig.verts)
    for faces, apart in ((1200, 1e-4), (2000, 0.02)):
        laid = dog_rig.transfer_rig(
            dog_rig.symmetric_rig(read_animal(assets / SKIN, assets / SKELETON), faces), template
        )
        check_rig(laid)
        assert np.array_equal(laid.faces, template.shape.faces)
        own = sqrt_area_frame(rest).apply(resting_animal(laid))
        assert np.linalg.norm(own - template.shape.verts, axis=1).max() < apart


@pytest.mark.skipif(importlib.util.find_spec("dm_control") is None, reason="dm_control is not installed")
def test_the_included_rig_is_the_dogs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert dog_rig.main(["-o", str(tmp_path / "dog.safetensors")]) == 0  # type: ignore[call-arg]
    made, included = load_rig(tmp_path / "dog.safetensors"), load_rig()
    assert made.names == included.names
    assert np.array_equal(made.faces, included.faces)
    assert np.abs(made.verts - included.verts).max() < 0.005  # metres
