"""Poses with self-contact: sitting with crossed legs, hands on face, knees, shins or the other arm.

A pose starts from clinical angles set by hand. They are then optimised, within their limits, until given points of the skin
touch, and body parts do not penetrate deeper than soft skin yields.
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

_STEPS, _EVERY, _RATE = 240, 6, 2.5  # Adam: steps, steps between two searches for contacts, rate in degrees
_MIN_REST_DISTANCE = 0.15  # metres: points of the skin that are farther apart at rest are not neighbours
_N_NEAREST = 40  # nearest vertices that are searched for one that is not a neighbour
_MAX_DEPTH = 0.06  # metres: points that are deeper inside came in from another side
_TOUCH_DISTANCE = 0.015  # metres between vertices of touching parts
_SKIN_YIELD = 0.004  # metres of penetration that are not penalised
# Weights of contact and penetration (square metres), and of the deviation from the initial angles (square degrees).
_TOUCH, _SOFT, _STAY = 100.0, 300.0, 2e-5
_HAND = 0.03  # metres from the palm to the back of a hand
_SPINE = {"spine05": 0.15, "spine04": 0.25, "spine03": 0.2, "spine02": 0.2, "spine01": 0.2}
_NECK = {"neck01": 0.3, "neck02": 0.2, "neck03": 0.2, "head": 0.3}

# Limits of the angles in degrees (of the curl in hundredths).
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
    """Initial angles of the left side, right side and trunk (0 if not given), and the pairs of skin points that touch."""

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
    """Pose bodies, each by a pose of `POSES` with variations that depend on the seed; metres, y up, facing +z."""
    rig, poses = figure.rig, [POSES[name] for name in names]
    low, high = torch.tensor([*_LIMITS.values(), *_LIMITS.values(), *_TRUNK_LIMITS.values()]).T
    start = torch.tensor([_angles(each) for each in poses])
    start += 5 * torch.randn(start.shape, generator=torch.Generator().manual_seed(seed))
    angles = start.clamp(low, high).requires_grad_()
    row, first, second, above = _contacts(poses, skin_points(figure))
    optimiser = torch.optim.Adam([angles], _RATE)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: 1 - 0.9 * step / _STEPS)
    for step in range(_STEPS):
        verts = skin(rig, rest, *posed(rig, heads, angles, seed))
        if step % _EVERY == 0:
            normals = _normals(verts.detach(), rig.faces)
            body_index, inner, outer = _near_contacts(verts.detach(), rest)
        contact_gap = verts[row, first] - verts[row, second] - above[:, None] * normals[row, second]
        depth = ((verts[body_index, outer] - verts[body_index, inner]) * normals[body_index, outer]).sum(-1)
        loss = _TOUCH * contact_gap.square().sum() + _SOFT * (depth - _SKIN_YIELD).clamp_min(0).square().sum()
        optimiser.zero_grad()
        (loss + _STAY * (angles - start).square().sum()).backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            angles.clamp_(low, high)
    return skin(rig, rest, *posed(rig, heads, angles.detach(), seed))


def _angles(pose: ContactPose) -> list[float]:
    sides = [float(side.get(name, 0)) for side in (pose.left, pose.right) for name in _LIMITS]
    return [*sides, *(float(pose.trunk.get(name, 0)) for name in _TRUNK_LIMITS)]


def _contacts(poses: Sequence[ContactPose], points: Mapping[str, int]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Contacts of all poses: index of the body, two vertices, and the height of the first one above the second."""
    contacts = []
    for row, each in enumerate(poses):
        for a, b in each.touching:
            contacts.append((row, points[a], points[b], 0.0))
            if a.startswith("palm"):  # the hand is flat if its back is straight above
                contacts.append((row, points[a.replace("palm", "back")], points[b], _HAND))
    rows, firsts, seconds, above = (torch.tensor(column) for column in zip(*contacts, strict=True))
    return rows, firsts, seconds, above


def _near_contacts(verts: Float[Tensor, "B V 3"], rest: Float[Tensor, "B V 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Indices of bodies and vertices with `far_neighbours`, and these neighbours."""
    neighbours = [
        far_neighbours(_array(posed_verts), _array(rest_verts))
        for posed_verts, rest_verts in zip(verts, rest, strict=True)
    ]
    index = torch.from_numpy(np.stack(neighbours))
    at, near = torch.nonzero(index >= 0).T
    return at, near, index[at, near]


def posed(
    rig: Rig, heads: Float[Tensor, "B J 3"], angles: Float[Tensor, "B A"], seed: int
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """World rotations and offsets of joints from angles in the order of the limits; ``seed`` is for all other joints."""
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
        wrist_angles = torch.stack([side[f"wrist_{axis}"] for axis in "xyz"], -1)
        vectors[:, rig.joint("wrist" + suffix)] += DEGREE * wrist_angles
    for shares, trunk_angles in ((_SPINE, angles[:, 2 * n : 2 * n + 3]), (_NECK, angles[:, 2 * n + 3 :])):
        for name, share in shares.items():
            vectors[:, rig.joint(name)] = share * DEGREE * trunk_angles
    return forward_kinematics(rig, heads, joint_rotations(vectors, matrices))


def far_neighbours(verts: Float[Floats, "V 3"], rest: Float[Floats, "V 3"]) -> Int[Ints, " V"]:
    """For each vertex the nearest vertex that is far away on the body at rest; -1 if there is none within `_MAX_DEPTH`."""
    distance, near = cKDTree(verts).query(verts, _N_NEAREST, distance_upper_bound=_MAX_DEPTH)
    near[~np.isfinite(distance)] = 0
    far = np.isfinite(distance) & (np.linalg.norm(rest[near] - rest[:, None], axis=-1) > _MIN_REST_DISTANCE)
    first = far.argmax(1)
    return np.where(far.any(1), near[np.arange(len(verts)), first], -1)


def contact_depths(
    verts: Float[Floats, "V 3"], rest: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> tuple[Bool[Bools, " V"], Float[Floats, " V"]]:
    """Whether each vertex touches a distant part of the body, and its depth inside one, in metres."""
    neighbour = far_neighbours(verts, rest)
    offset = np.where(neighbour[:, None] >= 0, verts[neighbour] - verts, np.inf)
    depth = np.where(
        neighbour >= 0, (np.nan_to_num(offset, posinf=0.0) * vertex_normals(verts, faces)[neighbour]).sum(1), 0.0
    )
    return np.linalg.norm(offset, axis=1) < _TOUCH_DISTANCE, depth.clip(0)


def _array(values: Tensor) -> Floats:
    return np.asarray(values.numpy(), np.float64)


def _normals(verts: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "B V 3"]:
    return torch.from_numpy(np.stack([vertex_normals(_array(each), faces.numpy()) for each in verts])).float()


def skin_points(figure: Figure) -> dict[str, int]:
    """Vertex indices of named points of the skin, determined on the mean body."""
    rig = figure.rig
    rest, heads = rig.rest.float().mean(0), rig.heads.mean(0)
    ahead, up = torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0])

    def joint(name: str) -> Tensor:
        return heads[rig.joint(name)]

    targets: dict[str, tuple[int, Tensor]] = {}
    for side, sign in (("L", 1.0), ("R", -1.0)):
        out = sign * torch.tensor([1.0, 0.0, 0.0])
        finger = [joint(f"finger3-{k}.{side}") for k in (1, 2, 3)]
        a, b = finger[1] - finger[0], finger[2] - finger[1]
        curled = torch.nn.functional.normalize(torch.linalg.cross(torch.linalg.cross(a, b), a), dim=0)
        shoulder, elbow, wrist = (joint(f"{name}.{side}") for name in ("upperarm01", "lowerarm01", "wrist"))
        hip, knee, ankle = (joint(f"{name}.{side}") for name in ("upperleg01", "lowerleg01", "foot"))
        targets |= {
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
        name: int(torch.where(owner == part_index, (rest - position).norm(dim=1), torch.inf).argmin())
        for name, (part_index, position) in targets.items()
    }
