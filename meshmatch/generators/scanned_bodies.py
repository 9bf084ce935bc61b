"""Bodies whose shapes were learned from scans: random people of a Momentum rig, on the vertices of a human template.

They have the same random poses as other generated people, and the rig's own joints and skin weights. Joints of the poses are
matched to those of the rig, and the twist of limbs is distributed along their length as in the rig.
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
# Standard deviations of the coefficients, set by hand from pictures: (number of blend shapes, deviation) for body, head and
# hands; expressions (deviation, probability); bone lengths as shares of their limits (each one, all limbs together).
_SHAPES = ((20, 1.1), (20, 0.8), (5, 0.7))
_EXPRESSION, _EXPRESSION_PROBABILITY = 0.15, 0.3
_LENGTH, _COMMON_LENGTH = 0.2, 0.15
_LIMB_LENGTHS = ("scale_uparms", "scale_lowarms", "scale_uplegs", "scale_lowlegs")
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")
_CURL = 0.2  # angle of every finger joint at rest, radians: straight fingers would not determine the axis of bending

# Joints of `Rig`: name, parent, joint of the Momentum rig. Names that end in a dot stand for both sides.
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
_WITHOUT_SKIN = ("spine02", "neck03")  # share the Momentum rig's joint with another one, which has the skin weights
_MORE_SKIN = (("neck01", "c_neck_twist0_proc"), *(("lowerleg01.", f"lowleg_twist{k}_proc") for k in range(1, 5)))
# Twisting limbs: prefix of their two joints, whether the first one has none of the twist (else half of it), and the fraction
# of the twist at the Momentum rig's joints.
_TWISTS = (
    ("upperarm", False, (("uparm", 1.0), *((f"uparm_twist{k}_proc", k / 4) for k in range(5)))),
    ("upperleg", False, (("upleg", 1.0), *((f"upleg_twist{k}_proc", k / 4) for k in range(5)))),
    ("lowerarm", True, (("lowarm", 0.0), *((f"lowarm_twist{k}_proc", k / 5) for k in range(1, 5)))),
)


@dataclass(frozen=True, eq=False)
class Twist:
    """A limb whose skin is twisted along its length.

    ``weights`` are skin weights for no, half and full twist. The ``second`` joint has the full twist; the ``first`` has
    ``none`` of it, or half.
    """

    first: int
    second: int
    none: bool
    weights: Float[Tensor, "V 3"]

    def motions(
        self, heads: Float[Tensor, "B J 3"], world: Float[Tensor, "B J 3 3"], offset: Float[Tensor, "B J 3"]
    ) -> tuple[Float[Tensor, "B 3 3 3"], Float[Tensor, "B 3 3"]]:
        """Rotations and offsets of the limb with no, half and full twist, from those of all joints."""
        first, last = world[:, self.first], world[:, self.second]
        turn = first.transpose(1, 2) @ last
        if self.none:
            turns = torch.stack([first, first @ half_rotation(turn), last], 1)
        else:
            turns = torch.stack([first @ turn.transpose(1, 2), first, last], 1)
        head = heads[:, self.first, :, None]
        place = first @ head + offset[:, self.first, :, None]
        return turns, (place[:, None] - turns @ head[:, None])[..., 0]


@dataclass(frozen=True, eq=False)
class TwistingRig:
    """A rig with twisting limbs; the weights of both together sum to one."""

    rig: Rig
    twists: tuple[Twist, ...]

    def posed(
        self, rest: Float[Tensor, "B V 3"], heads: Tensor, world: Float[Tensor, "B J 3 3"], offset: Tensor
    ) -> Float[Tensor, "B V 3"]:
        """Posed vertices."""
        verts = skin(self.rig, rest, world, offset)
        for twist in self.twists:
            verts += skin(replace(self.rig, weights=twist.weights), rest, *twist.motions(heads, world, offset))
        return verts


def scanned_source(template: Template, scanned: Scanned, seed: int = 0, identities: int = IDENTITIES) -> Source:
    """Source of random people on a template's vertices; `OptionError` if ``scanned`` was made for another template."""
    if len(scanned.corners) != template.shape.V:
        raise OptionError(
            f"the scanned bodies were not made for template {template.name}", "give scanned_bodies this template"
        )
    return partial(sample_scanned, build_twisting_rig(scanned, np.array(template.shape.faces), identities, seed))


def sample_scanned(bodies: TwistingRig, B: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Posed bodies in metres, pelvis approximately upright, y up, facing +z."""
    rig = bodies.rig
    which = torch.randint(len(rig.rest), (B,), generator=generator)
    rest, heads = rig.rest[which].float(), rig.heads[which]
    return bodies.posed(rest, heads, *sample_free_pose(rig, heads, generator))


def half_rotation(rotation: Float[Tensor, "B 3 3"]) -> Float[Tensor, "B 3 3"]:
    """Rotations by half the angle, for angles below 180 degrees: the nearest rotation to the mean with the identity."""
    u, _, v = torch.linalg.svd(rotation + torch.eye(3))
    result: Tensor = u @ v
    return result


def build_twisting_rig(scanned: Scanned, faces: Int[Ints, "F 3"], identities: int, seed: int) -> TwistingRig:
    """Build a rig of random identities on a template's vertices and ``faces``; `InputError` if a joint is missing."""
    momentum, rng = scanned.rig, np.random.default_rng(seed)
    rows = [row for joint in _JOINTS for row in _expand_sides(*joint)]
    names = tuple(name for name, *_ in rows)
    if missing := [joint for *_, joint in rows if joint not in momentum.joints]:
        raise InputError(f"the Momentum rig has no joint {missing[0]}", "take the files of its release")
    chosen = [momentum.joints.index(joint) for *_, joint in rows]
    parents = tuple(names.index(parent) if parent else -1 for _, parent, _ in rows)
    rest, heads = [], []
    for start in range(0, identities, 64):
        verts, joints = random_people(momentum, min(64, identities - start), rng)
        rest.append(torch.from_numpy(np.stack([scanned.place(each) for each in verts])).half())
        heads.append(torch.from_numpy(joints[:, chosen]).float())
    weights, twists = _split_weights(momentum, names, torch.from_numpy(scanned.place(momentum.weights)).float())
    rig = Rig(torch.cat(rest), torch.cat(heads), weights, parents, names, torch.from_numpy(faces))
    return TwistingRig(rig, twists)


def random_people(
    rig: MomentumRig, B: int, rng: np.random.Generator
) -> tuple[Float[Floats, "B V 3"], Float[Floats, "B J 3"]]:
    """Vertices and joints of random people at rest, with slightly bent fingers: random blend shapes, then bone lengths."""
    sizes = np.concatenate([np.full(count, size) for count, size in _SHAPES])[: len(rig.shapes)]
    blend = np.zeros((B, len(rig.shapes)))
    blend[:, : len(sizes)] = (sizes * rng.standard_normal((B, len(sizes)))).clip(-3, 3)
    expressions = blend[:, len(sizes) :]
    expressions[:] = np.abs(_EXPRESSION * rng.standard_normal(expressions.shape)) * (
        rng.random(expressions.shape) < _EXPRESSION_PROBABILITY
    )
    verts = rig.verts + np.tensordot(blend, rig.shapes, 1)
    low, high = rig.limits.T
    share = _LENGTH * rng.standard_normal((B, len(low)))
    share += _COMMON_LENGTH * rng.standard_normal((B, 1)) * np.isin(rig.parameters, _LIMB_LENGTHS)
    share = share[:, [_right_parameter(rig, name) for name in rig.parameters]]
    values = (0.5 * (low + high) + 0.5 * (high - low) * share).clip(low, high)
    fingers = np.array([joint[2:-1] in _FINGERS and joint[-1] in "123" for joint in rig.joints])
    axes, places = rig.frames(values, _CURL * fingers)
    reference, reference_places = rig.frames(np.zeros((1, len(low))))
    turns = axes @ np.linalg.inv(reference)
    shifts = places - np.einsum("bjxy,jy->bjx", turns, reference_places[0])
    motions = np.concatenate([turns.reshape(B, -1, 9), shifts], 2)
    blended = np.einsum("vj,bjk->bvk", rig.weights, motions, optimize=True)
    return np.einsum("bvxy,bvy->bvx", blended[..., :9].reshape(B, -1, 3, 3), verts) + blended[..., 9:], places


def _right_parameter(rig: MomentumRig, parameter: str) -> int:
    """Index of the parameter whose random value is used: left parameters have the value of the right ones."""
    right = parameter.replace("_l_", "_r_")
    return rig.parameters.index(right if right in rig.parameters else parameter)


def _expand_sides(name: str, *others: str) -> list[tuple[str, ...]]:
    """Expand a row of a table to both sides if its name ends in a dot; the last entry is a joint of the Momentum rig."""
    if not name.endswith("."):
        return [(name, *others)]
    *ours, joint = others
    rows = []
    for side in "lr":
        rows.append(
            (*(each + side.upper() if each.endswith(".") else each for each in (name, *ours)), f"{side}_{joint}")
        )
    return rows


def _split_weights(
    rig: MomentumRig, names: tuple[str, ...], weights: Float[Tensor, "V J"]
) -> tuple[Float[Tensor, "V K"], tuple[Twist, ...]]:
    """Distribute the Momentum rig's weights to the joints of `Rig` and to twisting limbs."""
    twists, used = [], set()
    for limb, none, stations in _TWISTS:
        for side in "lr":
            twist_weights = torch.zeros(len(weights), 3)
            for joint, share in stations:
                index = rig.joints.index(f"{side}_{joint}")
                used.add(index)
                at = min(int(2 * share), 1)
                twist_weights[:, at] += weights[:, index] * (1 + at - 2 * share)
                twist_weights[:, at + 1] += weights[:, index] * (2 * share - at)
            first, second = (names.index(f"{limb}0{k}.{side.upper()}") for k in (1, 2))
            twists.append(Twist(first, second, none, twist_weights))
    skins = [(name, joint) for name, _, joint in _JOINTS if name not in _WITHOUT_SKIN]
    owner = {joint: names.index(name) for row in (*skins, *_MORE_SKIN) for name, joint in _expand_sides(*row)}
    rigid = torch.zeros(len(weights), len(names))
    for index in range(len(rig.joints)):
        above = index  # a joint without counterpart moves with its parent
        while rig.joints[above] not in owner and rig.parents[above] >= 0:
            above = rig.parents[above]
        if index not in used:
            rigid[:, owner.get(rig.joints[above], 0)] += weights[:, index]
    return rigid, tuple(twists)
