"""Bodies whose shapes were learned from scans: random people of a Momentum rig, on the vertices of a human template.

They stand in the same random poses as other generated people, moved by the rig's own joints and weights: the joints that
poses speak of are found among the rig's, and limbs twist along their length as it says.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.generators.bodies import sample_free_pose
from meshmatch.generators.generator import Source
from meshmatch.generators.momentum_rig import MomentumRig, Scanned
from meshmatch.generators.rig import Rig, skin
from meshmatch.templates.template import Template

IDENTITIES = 2048
# Deviations of the coefficients, set by hand from pictures: how many shapes of the body, the head and the hands there are,
# and how much each varies; of expressions; of bone lengths as shares of their limits, each and all limbs together.
_SHAPES = ((20, 1.1), (20, 0.8), (5, 0.7))
_EXPRESSION, _EXPRESSIVE = 0.15, 0.3
_LENGTHS, _TALL = 0.2, 0.15
_LONG = ("scale_uparms", "scale_lowarms", "scale_uplegs", "scale_lowlegs")
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_CURLED = 0.2  # of every joint of a finger at rest, radians: straight ones do not say which way they bend

# Our joints: name, parent, the rig's; those that end in a dot come for both sides.
_JOINTS = (
    ("root", "", "root"), ("spine05", "root", "c_spine0"), ("spine04", "spine05", "c_spine1"),
    ("spine03", "spine04", "c_spine2"), ("spine02", "spine03", "c_spine2"), ("spine01", "spine02", "c_spine3"),
    ("neck01", "spine01", "c_neck"), ("neck02", "neck01", "c_neck_twist1_proc"),
    ("neck03", "neck02", "c_neck_twist1_proc"), ("head", "neck03", "c_head"), ("eye.", "head", "eye"),
    ("clavicle.", "spine01", "clavicle"), ("upperarm01.", "clavicle.", "uparm"),
    ("upperarm02.", "upperarm01.", "uparm_twist2_proc"), ("lowerarm01.", "upperarm02.", "lowarm"),
    ("lowerarm02.", "lowerarm01.", "lowarm_twist3_proc"), ("wrist.", "lowerarm02.", "wrist"),
    ("upperleg01.", "root", "upleg"), ("upperleg02.", "upperleg01.", "upleg_twist2_proc"),
    ("lowerleg01.", "upperleg02.", "lowleg"), ("foot.", "lowerleg01.", "talocrural"), ("toe2-1.", "foot.", "ball"),
    *((f"finger{n}-{k}.", f"finger{n}-{k - 1}." if k > 1 else "wrist.", f"{name}{k}")
      for n, name in enumerate(_FINGERS, 1) for k in (1, 2, 3)),
)  # fmt: skip
_WITHOUT_SKIN = ("spine02", "neck03")  # where the rig has one joint for two of ours, the other moves the skin
_ALSO = (("neck01", "c_neck_twist0_proc"), *(("lowerleg01.", f"lowleg_twist{k}_proc") for k in range(1, 5)))
# Limbs that twist: their two joints, whether the first of these has none of the twist (or half), and how much the skin
# has at the rig's joints.
_TWISTS = (
    ("upperarm", False, (("uparm", 1.0), *((f"uparm_twist{k}_proc", k / 4) for k in range(5)))),
    ("upperleg", False, (("upleg", 1.0), *((f"upleg_twist{k}_proc", k / 4) for k in range(5)))),
    ("lowerarm", True, (("lowarm", 0.0), *((f"lowarm_twist{k}_proc", k / 5) for k in range(1, 5)))),
)


@dataclass(frozen=True, eq=False)
class Twist:
    """A limb that twists: its joints, and the ``weights`` of its skin where it is not twisted, by half, and wholly.

    The ``second`` joint has all of the twist, the ``first`` ``none`` or half.
    """

    first: int
    second: int
    none: bool
    weights: Float[Tensor, "V 3"]

    def motions(
        self, heads: Float[Tensor, "B J 3"], world: Float[Tensor, "B J 3 3"], offset: Float[Tensor, "B J 3"]
    ) -> tuple[Float[Tensor, "B 3 3 3"], Float[Tensor, "B 3 3"]]:
        """Rotations and offsets of the limb not twisted, by half, and wholly, from those of all joints."""
        first, last = world[:, self.first], world[:, self.second]
        turn = first.transpose(1, 2) @ last
        if self.none:
            turns = torch.stack([first, first @ half_of(turn), last], 1)
        else:
            turns = torch.stack([first @ turn.transpose(1, 2), first, last], 1)
        head = heads[:, self.first, :, None]
        place = first @ head + offset[:, self.first, :, None]
        return turns, (place[:, None] - turns @ head[:, None])[..., 0]


@dataclass(frozen=True, eq=False)
class Skinned:
    """A rig with the limbs that twist; the weights of both together sum to one."""

    rig: Rig
    twists: tuple[Twist, ...]

    def posed(
        self, rest: Float[Tensor, "B V 3"], heads: Tensor, world: Float[Tensor, "B J 3 3"], offset: Tensor
    ) -> Float[Tensor, "B V 3"]:
        """Vertices in a pose."""
        verts = skin(self.rig, rest, world, offset)
        for twist in self.twists:
            verts += skin(replace(self.rig, weights=twist.weights), rest, *twist.motions(heads, world, offset))
        return verts


def scanned_source(template: Template, scanned: Scanned, seed: int = 0, identities: int = IDENTITIES) -> Source:
    """Random people on a template's vertices; `OptionError` if they were laid under another."""
    if len(scanned.corners) != template.shape.V:
        raise OptionError(
            f"the scanned bodies do not lie under template {template.name}", "name the template for them too"
        )
    return partial(sample_scanned, skinned(scanned, np.array(template.shape.faces), identities, seed))


def sample_scanned(bodies: Skinned, B: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Posed bodies in metres, pelvis roughly upright, y up, facing +z."""
    rig = bodies.rig
    which = torch.randint(len(rig.rest), (B,), generator=generator)
    rest, heads = rig.rest[which].float(), rig.heads[which]
    return bodies.posed(rest, heads, *sample_free_pose(rig, heads, generator))


def half_of(rotation: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 3 3"]:
    """Half of rotations by less than half a turn: the rotation that is nearest to their mean with none."""
    u, _, v = torch.linalg.svd(rotation + torch.eye(3))
    result: Tensor = u @ v
    return result


def skinned(scanned: Scanned, faces: Int[Ints, "F 3"], identities: int, seed: int) -> Skinned:
    """Random identities on the vertices of a template with such faces; `InputError` if the rig lacks a joint."""
    own, rng = scanned.rig, np.random.default_rng(seed)
    rows = [row for joint in _JOINTS for row in _sides(*joint)]
    names = tuple(name for name, *_ in rows)
    if missing := [joint for *_, joint in rows if joint not in own.joints]:
        raise InputError(f"the Momentum rig has no joint {missing[0]}", "take the files of its release")
    chosen = [own.joints.index(joint) for *_, joint in rows]
    parents = tuple(names.index(parent) if parent else -1 for _, parent, _ in rows)
    rest, heads = [], []
    for start in range(0, identities, 64):
        verts, joints = random_people(own, min(64, identities - start), rng)
        rest.append(torch.from_numpy(np.stack([scanned.place(each) for each in verts])).half())
        heads.append(torch.from_numpy(joints[:, chosen]).float())
    weights, twists = _shared_weights(own, names, torch.from_numpy(scanned.place(own.weights)).float())
    rig = Rig(torch.cat(rest), torch.cat(heads), weights, parents, names, torch.from_numpy(faces))
    return Skinned(rig, twists)


def random_people(
    rig: MomentumRig, B: int, rng: np.random.Generator
) -> tuple[Float[Floats, "B V 3"], Float[Floats, "B J 3"]]:
    """Vertices and joints of people at rest, fingers a little bent: random shapes, then bone lengths within their limits."""
    sizes = np.concatenate([np.full(count, size) for count, size in _SHAPES])[: len(rig.shapes)]
    blend = np.zeros((B, len(rig.shapes)))
    blend[:, : len(sizes)] = (sizes * rng.standard_normal((B, len(sizes)))).clip(-3, 3)
    faces = blend[:, len(sizes) :]
    faces[:] = np.abs(_EXPRESSION * rng.standard_normal(faces.shape)) * (rng.random(faces.shape) < _EXPRESSIVE)
    verts = rig.verts + np.tensordot(blend, rig.shapes, 1)
    low, high = rig.limits.T
    share = _LENGTHS * rng.standard_normal((B, len(low)))
    share += _TALL * rng.standard_normal((B, 1)) * np.isin(rig.parameters, _LONG)
    share = share[:, [_of_both_sides(rig, name) for name in rig.parameters]]
    values = (0.5 * (low + high) + 0.5 * (high - low) * share).clip(low, high)
    fingers = np.array([joint[2:-1] in _FINGERS and joint[-1] in "123" for joint in rig.joints])
    axes, places = rig.frames(values, _CURLED * fingers)
    plain, at = rig.frames(np.zeros((1, len(low))))
    turns = axes @ np.linalg.inv(plain)
    shifts = places - np.einsum("bjxy,jy->bjx", turns, at[0])
    motions = np.concatenate([turns.reshape(B, -1, 9), shifts], 2)
    blended = np.einsum("vj,bjk->bvk", rig.weights, motions, optimize=True)
    return np.einsum("bvxy,bvy->bvx", blended[..., :9].reshape(B, -1, 3, 3), verts) + blended[..., 9:], places


def _of_both_sides(rig: MomentumRig, parameter: str) -> int:
    """The parameter whose draw is taken: hands are alike."""
    right = parameter.replace("_l_", "_r_")
    return rig.parameters.index(right if right in rig.parameters else parameter)


def _sides(name: str, *others: str) -> list[tuple[str, ...]]:
    """Rows of a table for both sides, or the one row: names of ours first, last a joint of the rig."""
    if not name.endswith("."):
        return [(name, *others)]
    *ours, joint = others
    rows = []
    for side in "lr":
        rows.append(
            (*(each + side.upper() if each.endswith(".") else each for each in (name, *ours)), f"{side}_{joint}")
        )
    return rows


def _shared_weights(
    rig: MomentumRig, names: tuple[str, ...], weights: Float[Tensor, "V J"]
) -> tuple[Float[Tensor, "V K"], tuple[Twist, ...]]:
    """The rig's weights as those of our joints, and of limbs that twist."""
    twists, taken = [], set()
    for limb, none, stations in _TWISTS:
        for side in "lr":
            own = torch.zeros(len(weights), 3)
            for joint, share in stations:
                index = rig.joints.index(f"{side}_{joint}")
                taken.add(index)
                at = min(int(2 * share), 1)
                own[:, at] += weights[:, index] * (1 + at - 2 * share)
                own[:, at + 1] += weights[:, index] * (2 * share - at)
            first, second = (names.index(f"{limb}0{k}.{side.upper()}") for k in (1, 2))
            twists.append(Twist(first, second, none, own))
    skins = [(name, joint) for name, _, joint in _JOINTS if name not in _WITHOUT_SKIN]
    owner = {joint: names.index(name) for row in (*skins, *_ALSO) for name, joint in _sides(*row)}
    rigid = torch.zeros(len(weights), len(names))
    for index in range(len(rig.joints)):
        above = index  # a joint that we lack moves with the one above it
        while rig.joints[above] not in owner and rig.parents[above] >= 0:
            above = rig.parents[above]
        if index not in taken:
            rigid[:, owner.get(rig.joints[above], 0)] += weights[:, index]
    return rigid, tuple(twists)
