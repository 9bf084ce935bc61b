"""Generated animals: the dog that they are made of, and what becomes of it."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open

from meshmatch import load_model
from meshmatch.errors import TemplateError
from meshmatch.generators import quadruped_rig, quadrupeds
from meshmatch.generators.quadruped_rig import LIMITS, AnimalRig, group_of, load_rig, rig_file, save_rig
from meshmatch.generators.quadruped_traits import KINDS, TRAITS, draw_traits
from meshmatch.generators.quadrupeds import draw_angles, make_animal, plush, resting_animal
from meshmatch.geometry.triangles import vertex_normals
from tests.generators.animal_rigs import check_rig


@pytest.fixture(scope="module")
def rig() -> AnimalRig:
    return load_rig()


def test_the_dog_is_closed_and_symmetric(rig: AnimalRig) -> None:
    check_rig(rig)
    assert 4500 < len(rig.verts) < 5200


def test_a_rig_survives_its_file(rig: AnimalRig, tmp_path: Path) -> None:
    save_rig(rig, tmp_path / "rig.safetensors")
    again = load_rig(tmp_path / "rig.safetensors")
    assert again.names == rig.names
    for name in ("verts", "faces", "mirror", "parents", "joints", "weights"):
        assert np.array_equal(getattr(again, name), getattr(rig, name))


def test_the_rig_says_whose_it_is_and_a_damaged_one_is_an_error(tmp_path: Path) -> None:
    with safe_open(str(rig_file()), "numpy") as file:
        words = file.metadata()
    assert "dm_control Authors; changed: eyes closed" in words["source"]
    assert words["licence"] == "Apache-2.0"
    (tmp_path / "cut.safetensors").write_bytes(rig_file().read_bytes()[:-9])
    for path in (tmp_path / "cut.safetensors", tmp_path / "none.safetensors"):
        with pytest.raises(TemplateError, match="is missing or damaged"):
            load_rig(path)


def edges(rig: AnimalRig, verts: np.ndarray) -> float:
    """How far normals are from their neighbours' mean."""
    normals = vertex_normals(verts, rig.faces)
    return float(np.linalg.norm(normals - rig.smoothed(normals, 1), axis=1).mean())


def test_a_stuffed_animal_is_smoother_and_no_thinner(rig: AnimalRig) -> None:
    rest = resting_animal(rig)
    stuffed = plush(rig, rest)

    def volume(verts: np.ndarray) -> float:
        return float(np.linalg.det(verts[rig.faces]).sum() / 6)

    assert edges(rig, stuffed) < 0.7 * edges(rig, rest)
    assert volume(rest) < volume(stuffed) < 1.6 * volume(rest)


def test_toys_are_stuffed_and_keep_their_mouths_shut(rig: AnimalRig, monkeypatch: pytest.MonkeyPatch) -> None:
    def animal(plush: float) -> np.ndarray:
        def traits(rng: np.random.Generator) -> dict[str, float]:
            return draw_traits(rng) | {"plush": plush}

        monkeypatch.setattr(quadrupeds, "draw_traits", traits)
        return make_animal(rig, 0, 1)

    assert edges(rig, animal(1.0)) < 0.8 * edges(rig, animal(0.0))
    jaw, rng = rig.names.index("jaw"), np.random.default_rng(0)
    gapes = [draw_angles(rig, draw_traits(rng) | {"plush": 1.0}, rng)[jaw, 0] for _ in range(20)]
    assert max(gapes) < -25  # degrees: closed


def test_an_animal_is_a_function_of_seed_and_number(rig: AnimalRig) -> None:
    first = make_animal(rig, 3, 7)
    assert np.array_equal(first, make_animal(rig, 3, 7))
    assert np.isfinite(first).all()
    for seed, number in ((3, 8), (4, 7)):
        assert np.abs(make_animal(rig, seed, number) - first).max() > 0.01


def test_the_animal_at_rest_is_symmetric(rig: AnimalRig) -> None:
    rest = resting_animal(rig)
    assert np.abs(rest[rig.mirror] * [-1, 1, 1] - rest).max() < 1e-3  # metres: its joints are that far from symmetric


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


def test_the_generator_draws_registered_animals() -> None:
    first, again, other = (quadrupeds.quadruped_generator(3, seed) for seed in (5, 5, 6))
    template = first.template
    assert (template.name, template.label_names) == ("quadruped", quadrupeds.body_parts(load_rig())[1])
    assert template.hash == load_model("quadruped").card.template_hash  # `train --start quadruped` asks for it
    drawn = [made.draw(8, torch.Generator().manual_seed(1)) for made in (first, again, other)]
    assert drawn[0].shape == (8, template.shape.V, 3)
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    assert again.template.hash == template.hash == other.template.hash
    assert "3 four-legged animals" in first.data
