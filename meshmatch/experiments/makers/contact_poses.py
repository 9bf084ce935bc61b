"""Poses in which a body touches itself: sitting with crossed legs, hands on face, knees, shins or the other arm.

A pose begins with clinical angles set by hand. They are then moved, within their limits, until points of the skin that are
to touch lie on each other, and parts run into each other no deeper than soft skin gives way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.generators.bodies import joint_rotations, pose_limbs
from meshmatch.generators.figure import Figure, part
from meshmatch.generators.limbs import Draw, Limbs
from meshmatch.generators.rig import Rig, forward_kinematics, skin
from meshmatch.generators.rotations import DEGREE
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import vertex_normals

_STEPS, _EVERY, _RATE = 240, 6, 2.5  # of the descent: steps, steps between two searches for contacts, degrees a step
_APART = 0.15  # metres between two points of the resting skin that are no neighbours
_NEIGHBOURS = 40  # among which the nearest point that is no neighbour is looked for
_REACH = 0.06  # metres: what is farther inside has come in from another side
_TOUCHES = 0.015  # metres between vertices of parts that touch
_GIVES = 0.004  # metres that skin gives way
_TOUCH, _SOFT, _STAY = 100.0, 300.0, 2e-5  # weights: of square metres, and of square degrees from where a pose began
_HAND = 0.03  # metres from the palm to the back of a hand
_SPINE = {"spine05": 0.15, "spine04": 0.25, "spine03": 0.2, "spine02": 0.2, "spine01": 0.2}
_NECK = {"neck01": 0.3, "neck02": 0.2, "neck03": 0.2, "head": 0.3}

# Degrees (of the curl: hundredths), and how far they may go.
_LIMITS = {
    "arm_elevation": (3, 175), "arm_azimuth": (-60, 140), "arm_twist": (-130, 90), "elbow": (0, 150),
    "pronation": (-90, 95), "hip_flexion": (-40, 135), "hip_abduction": (-25, 65), "hip_twist": (-50, 75),
    "knee": (0, 155), "ankle": (-35, 40), "curl": (-30, 100), "wrist_x": (-60, 60), "wrist_y": (-60, 60),
    "wrist_z": (-60, 60),
}  # fmt: skip
_TRUNK_LIMITS = {
    "bend": (-20, 75),
    "turn": (-30, 30),
    "lean": (-25, 25),
    "nod": (-30, 50),
    "look": (-40, 40),
    "tilt": (-25, 25),
}
Angles = Mapping[str, float]


@dataclass(frozen=True)
class ContactPose:
    """Angles to begin with, of the left and the right side (what is not named is 0), and of the trunk; the points of the
    skin that touch."""

    left: Angles
    right: Angles
    trunk: Angles
    touching: tuple[tuple[str, str], ...]


_HAND_DOWN = {"arm_elevation": 35, "arm_azimuth": 60, "elbow": 45, "curl": 20}
_HAND_UP = {"arm_elevation": 55, "arm_azimuth": 80, "elbow": 135, "arm_twist": 20, "curl": 10}
_TAILOR = {"hip_flexion": 98, "hip_abduction": 42, "hip_twist": 45, "knee": 125}
_CHAIR = {"hip_flexion": 85, "hip_abduction": 4, "knee": 85}
_FOLDED = {"arm_elevation": 35, "arm_azimuth": 75, "elbow": 100, "arm_twist": 50, "curl": 10}
_DRAWN_UP = {"hip_flexion": 122, "hip_abduction": 6, "knee": 125}
POSES = {
    "crossed legs, hands on the knees": ContactPose(
        _TAILOR | _HAND_DOWN, _TAILOR | {"knee": 138} | _HAND_DOWN, {"bend": 15},
        (("palm L", "knee L"), ("palm R", "knee R"), ("ankle L", "calf R")),
    ),
    "hands on the face": ContactPose(
        _HAND_UP | {"hip_abduction": 5}, _HAND_UP | {"hip_abduction": 5}, {"nod": 15},
        (("palm L", "cheek L"), ("palm R", "cheek R")),
    ),
    "sitting, a leg over the other, chin in the hand": ContactPose(
        _CHAIR | _HAND_DOWN, _CHAIR | {"hip_flexion": 102, "hip_abduction": -16, "knee": 80} | _HAND_UP,
        {"bend": 25, "nod": 10},
        (("hollow R", "thigh L"), ("palm L", "knee R"), ("palm R", "cheek R")),
    ),
    "bent forward, hands on the shins": ContactPose(
        _DRAWN_UP | _HAND_DOWN | {"elbow": 60}, _DRAWN_UP | _HAND_DOWN | {"elbow": 60}, {"bend": 40, "nod": 10},
        (("palm L", "shin L"), ("palm R", "shin R")),
    ),
    "arms folded, ankles crossed": ContactPose(
        _FOLDED | {"hip_abduction": -10}, _FOLDED | {"hip_abduction": -16, "hip_flexion": 12, "knee": 12}, {},
        (("palm L", "upper arm R"), ("palm R", "upper arm L"), ("back of the ankle R", "front of the ankle L")),
    ),
    "sitting, an ankle on the knee": ContactPose(
        _CHAIR | _HAND_DOWN, _CHAIR | {"hip_abduction": 35, "hip_twist": 60, "knee": 100} | _HAND_DOWN, {"bend": 15},
        (("ankle R", "thigh L"), ("palm L", "shin R"), ("palm R", "knee R")),
    ),
    "crossed legs, face in the hands": ContactPose(
        _TAILOR | {"knee": 138} | _HAND_UP, _TAILOR | _HAND_UP, {"bend": 40, "nod": 20},
        (("palm L", "cheek L"), ("palm R", "cheek R"), ("ankle R", "calf L"), ("elbow L", "thigh L")),
    ),
    "a hand on the other arm, one on the knee": ContactPose(
        _DRAWN_UP | {"hip_abduction": 14} | _FOLDED, _DRAWN_UP | {"hip_abduction": 14} | _HAND_DOWN, {"bend": 25},
        (("palm L", "forearm R"), ("palm R", "knee R")),
    ),
}  # fmt: skip


def contact_poses(
    figure: Figure, rest: Float[Tensor, "B V 3"], heads: Float[Tensor, "B J 3"], names: Sequence[str], seed: int
) -> Float[Tensor, "B V 3"]:
    """Resting bodies, each in a pose of `POSES` that is a little different with every seed; metres, y up, facing +z."""
    rig, poses = figure.rig, [POSES[name] for name in names]
    low, high = torch.tensor([*_LIMITS.values(), *_LIMITS.values(), *_TRUNK_LIMITS.values()]).T
    start = torch.tensor([_angles_of(each) for each in poses])
    start += 5 * torch.randn(start.shape, generator=torch.Generator().manual_seed(seed))
    angles = start.clamp(low, high).requires_grad_()
    row, one, two, above = _goals(poses, skin_points(figure))
    descent = torch.optim.Adam([angles], _RATE)
    schedule = torch.optim.lr_scheduler.LambdaLR(descent, lambda step: 1 - 0.9 * step / _STEPS)
    for step in range(_STEPS):
        verts = skin(rig, rest, *posed(rig, heads, angles, seed))
        if step % _EVERY == 0:
            normals = _normals(verts.detach(), rig.faces)
            at, near, far = _near_contacts(verts.detach(), rest)
        apart = verts[row, one] - verts[row, two] - above[:, None] * normals[row, two]
        depth = ((verts[at, far] - verts[at, near]) * normals[at, far]).sum(-1)
        loss = _TOUCH * apart.square().sum() + _SOFT * (depth - _GIVES).clamp_min(0).square().sum()
        descent.zero_grad()
        (loss + _STAY * (angles - start).square().sum()).backward()
        descent.step()
        schedule.step()
        with torch.no_grad():
            angles.clamp_(low, high)
    return skin(rig, rest, *posed(rig, heads, angles.detach(), seed))


def _angles_of(pose: ContactPose) -> list[float]:
    sides = [float(side.get(name, 0)) for side in (pose.left, pose.right) for name in _LIMITS]
    return [*sides, *(float(pose.trunk.get(name, 0)) for name in _TRUNK_LIMITS)]


def _goals(poses: Sequence[ContactPose], points: Mapping[str, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows of poses, two vertices of each, and how far above the second one the first one is to be."""
    goals = []
    for row, each in enumerate(poses):
        for a, b in each.touching:
            goals.append((row, points[a], points[b], 0.0))
            if a.startswith("palm"):  # a hand lies flat if its back is right above
                goals.append((row, points[a.replace("palm", "back")], points[b], _HAND))
    rows, ones, twos, above = (torch.tensor(column) for column in zip(*goals, strict=True))
    return rows, ones, twos, above


def _near_contacts(verts: Float[Tensor, "B V 3"], rest: Float[Tensor, "B V 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Bodies, vertices, and the far neighbours of these."""
    found = [far_neighbours(_array(own), _array(asleep)) for own, asleep in zip(verts, rest, strict=True)]
    index = torch.from_numpy(np.stack(found))
    at, near = torch.nonzero(index >= 0).T
    return at, near, index[at, near]


def posed(
    rig: Rig, heads: Float[Tensor, "B J 3"], angles: Float[Tensor, "B A"], seed: int
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """World rotations and offsets of joints by angles in the order of the limits; what is drawn beside them has a seed."""
    n = len(_LIMITS)
    sides = [dict(zip(_LIMITS, side.unbind(1), strict=True)) for side in (angles[:, :n], angles[:, n : 2 * n])]
    left, right = (
        Limbs(**{name: side[name] for name in Limbs.__dataclass_fields__} | {"curl": 0.01 * side["curl"]})
        for side in sides
    )
    vectors = torch.zeros(len(angles), heads.shape[1], 3)
    draw = Draw(len(angles), torch.Generator().manual_seed(seed))
    matrices = pose_limbs(vectors, rig, heads, left, right, draw)
    for side, suffix in zip(sides, (".L", ".R"), strict=True):
        turn = torch.stack([side[f"wrist_{axis}"] for axis in "xyz"], -1)
        vectors[:, rig.joint("wrist" + suffix)] += DEGREE * turn
    for shares, own in ((_SPINE, angles[:, 2 * n : 2 * n + 3]), (_NECK, angles[:, 2 * n + 3 :])):
        for name, share in shares.items():
            vectors[:, rig.joint(name)] = share * DEGREE * own
    return forward_kinematics(rig, heads, joint_rotations(vectors, matrices))


def far_neighbours(verts: Float[Floats, "V 3"], rest: Float[Floats, "V 3"]) -> Int[Ints, " V"]:
    """Of every vertex the nearest one that is far from it along the body, -1 where none is within reach."""
    away, near = cKDTree(verts).query(verts, _NEIGHBOURS, distance_upper_bound=_REACH)
    near[~np.isfinite(away)] = 0
    far = np.isfinite(away) & (np.linalg.norm(rest[near] - rest[:, None], axis=-1) > _APART)
    first = far.argmax(1)
    return np.where(far.any(1), near[np.arange(len(verts)), first], -1)


def contact_depths(
    verts: Float[Floats, "V 3"], rest: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> tuple[Bool[Bools, " V"], Float[Floats, " V"]]:
    """Which vertices touch a part of the body that is far from them, to the distance of neighbours; and how deep each lies
    in one, metres."""
    other = far_neighbours(verts, rest)
    away = np.where(other[:, None] >= 0, verts[other] - verts, np.inf)
    depth = np.where(other >= 0, (np.nan_to_num(away, posinf=0.0) * vertex_normals(verts, faces)[other]).sum(1), 0.0)
    return np.linalg.norm(away, axis=1) < _TOUCHES, depth.clip(0)


def _array(values: Tensor) -> Floats:
    return np.asarray(values.numpy(), np.float64)


def _normals(verts: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V 3"]:
    return torch.from_numpy(np.stack([vertex_normals(_array(each), faces.numpy()) for each in verts])).float()


def skin_points(figure: Figure) -> dict[str, int]:
    """Vertices of points of the skin, by their names, from the mean body."""
    rig = figure.rig
    rest, heads = rig.rest.float().mean(0), rig.heads.mean(0)
    ahead, up = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0])

    def joint(name: str) -> Tensor:
        return heads[rig.joint(name)]

    found: dict[str, tuple[int, Tensor]] = {}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        out = sign * torch.tensor([1.0, 0.0, 0.0])
        finger = [joint(f"finger3-{k}.{side}") for k in (1, 2, 3)]
        a, b = finger[1] - finger[0], finger[2] - finger[1]
        curled = torch.nn.functional.normalize(torch.linalg.cross(torch.linalg.cross(a, b), a), dim=0)
        shoulder, elbow, wrist = (joint(f"{name}.{side}") for name in ("upperarm01", "lowerarm01", "wrist"))
        hip, knee, ankle = (joint(f"{name}.{side}") for name in ("upperleg01", "lowerleg01", "foot"))
        found |= {
            f"palm {side}": (part("hand", side), finger[0] + 0.05 * curled),
            f"back {side}": (part("hand", side), finger[0] - 0.05 * curled),
            f"cheek {side}": (part("head"), joint(f"eye.{side}") - 0.05 * up + 0.05 * ahead + 0.02 * out),
            f"upper arm {side}": (part("upper arm", side), 0.4 * shoulder + 0.6 * elbow + 0.1 * (out + up + ahead)),
            f"elbow {side}": (part("forearm", side), elbow - 0.1 * ahead),
            f"forearm {side}": (part("forearm", side), 0.5 * elbow + 0.5 * wrist + 0.1 * up),
            f"thigh {side}": (part("thigh", side), 0.25 * hip + 0.75 * knee + 0.2 * ahead),
            f"knee {side}": (part("thigh", side), knee + 0.03 * up + 0.2 * ahead),
            f"hollow {side}": (part("shin", side), 0.85 * knee + 0.15 * ankle - 0.2 * ahead),
            f"shin {side}": (part("shin", side), 0.5 * knee + 0.5 * ankle + 0.2 * ahead),
            f"calf {side}": (part("shin", side), 0.4 * knee + 0.6 * ankle - 0.2 * ahead - 0.1 * out),
            f"front of the ankle {side}": (part("shin", side), 0.2 * knee + 0.8 * ankle + 0.1 * ahead),
            f"back of the ankle {side}": (part("shin", side), 0.2 * knee + 0.8 * ankle - 0.1 * ahead),
            f"ankle {side}": (part("shin", side), 0.15 * knee + 0.85 * ankle + 0.1 * out),
        }
    owner = figure.share.argmax(1)
    return {
        name: int(torch.where(owner == of, (rest - place).norm(dim=1), torch.inf).argmin())
        for name, (of, place) in found.items()
    }
