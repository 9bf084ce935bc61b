"""Rats: the one of dm_control (Apache-2.0), which no training saw, in random poses, beside animals made of its dog.

Both skeletons have the same parts, so that a truth comes for free: the share of vertices whose partner hangs on the same
part of the body, left and right told apart. Where one part ends and the next begins is a matter of the rigs, so that no map
reaches 1.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.experiments.character_designs import Character
from meshmatch.experiments.mujoco_skin import find_files, read_animal
from meshmatch.generators.quadruped_rig import AnimalRig, load_rig, skinned
from meshmatch.generators.quadruped_traits import EXTRAS, TRAITS
from meshmatch.generators.quadrupeds import body_parts, draw_angles, make_animal
from meshmatch.shapes.shape import Shape

FILES = ("rodent_walker_skin.skn", "rodent.xml")
UNSEEN_SEED = 100
"""Of the poses and of the dog's animals; trainings draw with small ones."""
# Beginnings of the rat's bones, and of the dog's that are the same.
_SAME = {
    "vertebra_cervical_": "C_",
    "vertebra_atlant": "C_1",
    "vertebra_axis": "C_2",
    "vertebra_C": "Ca_",
    "vertebra_": "L_",
}


def read_rat() -> AnimalRig:
    """The rat, with the dog's names of bones. `InputError` if dm_control is not installed."""
    rat = read_animal(*find_files(*FILES))

    def renamed(name: str) -> str:
        return next((dogs + name.removeprefix(rats) for rats, dogs in _SAME.items() if name.startswith(rats)), name)

    return replace(rat, names=tuple(map(renamed, rat.names)))


def rats_and_dogs(count: int, seed: int) -> list[Character]:
    """So many rats, the first at rest, and as many animals of the dog, turned anywhere, with the part of every vertex."""
    rat, dog = read_rat(), load_rig()
    plain = {name: float(name not in EXTRAS) for name in TRAITS}
    still = np.tile(np.eye(3), (len(rat.names), 1, 1))
    rng = np.random.default_rng([UNSEEN_SEED, seed])
    poses = [np.zeros((len(rat.names), 3)), *(draw_angles(rat, plain, rng) for _ in range(count - 1))]
    names = sorted({*body_parts(rat)[1], *body_parts(dog)[1]})
    made = [_character(rat, skinned(rat, rat.verts, still, pose), f"rat {k}", names) for k, pose in enumerate(poses)]
    made += [_character(dog, make_animal(dog, UNSEEN_SEED + seed, k), f"animal {k}", names) for k in range(count)]
    turns = Rotation.random(len(made), random_state=rng).as_matrix()
    return [
        replace(each, shape=replace(each.shape, verts=each.shape.verts @ turn.T))
        for each, turn in zip(made, turns, strict=True)
    ]


def _character(rig: AnimalRig, verts: Float[Floats, "V 3"], name: str, names: list[str]) -> Character:
    labels, own = body_parts(rig)
    shape, bones = Shape(verts, rig.faces, name), np.array([names.index(part) for part in own])[labels]
    return Character(shape, bones)
