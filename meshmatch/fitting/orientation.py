"""Which way is up, which way is front: core frames that the aligner proposes, or that obey given axes.

The aligner is asked about many turned copies of the samples. Every answer is a vote for one rotation; votes that agree
form a hypothesis. Asking again from the voted frame sharpens it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.errors import OptionError
from meshmatch.geometry.frames import RigidPose
from meshmatch.models.inference import Network, quick_tree

_AGREE = 30  # degrees: votes that are closer agree. Set by hand.
# Turns of the core frame that a vote may be wrong by: about face, upside down, on its head, a quarter either way.
_FLIPS = Rotation.from_rotvec(
    np.pi * np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0.5, 0], [0, -0.5, 0]])
).as_matrix()


def turned_copies(count: int, seed: int) -> Float[Floats, "count 3 3"]:
    """Well-spread rotations, the first of them the identity."""
    rotations = Rotation.random(count, random_state=np.random.default_rng(seed)).as_matrix()
    rotations[0] = np.eye(3)
    return rotations


def ask_aligner(
    network: Network, points: Float[Floats, "P 3"], turns: Float[Floats, "N 3 3"]
) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"]]:
    """Rotations and centers of core frames of the points, each read off one turned copy (rows x -> turn x)."""
    middle = points.mean(0)
    cloud = (points - middle).astype(np.float32)
    # Turning the basis the other way is cheaper than turning and indexing the points N times.
    queries = np.einsum("mk,nkl->nml", network.align_basis, turns).astype(np.float32)
    offsets = cloud[quick_tree(cloud).query(queries)[1]] - queries  # N M 3
    R, t = network.read_frames(offsets @ turns.astype(np.float32).transpose(0, 2, 1))
    back = turns.transpose(0, 2, 1)
    return back @ R, (back @ t[..., None])[..., 0] + middle


def propose(
    network: Network, points: Float[Floats, "P 3"], copies: int = 48, keep: int = 4, seed: int = 0
) -> list[RigidPose]:
    """Hypotheses of the core frame, most voted first.

    Parameters
    ----------
    points : samples
    copies : how many turned copies vote
    keep : how many hypotheses to return at most
    """
    rotations, centers = ask_aligner(network, points, turned_copies(copies, seed))
    # Second look: from its own proposed frame the network knows the pose best.
    rotations, centers = ask_aligner(network, points, rotations.transpose(0, 2, 1))
    trace = np.einsum("nij,mij->nm", rotations, rotations)
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    close = angle < _AGREE
    free = np.ones(len(rotations), bool)
    found: list[RigidPose] = []
    while free.any() and len(found) < keep:
        votes = (close & free).sum(1) * free
        members = close[int(votes.argmax())] & free
        mean = Rotation.from_matrix(rotations[members]).mean().as_matrix()
        found.append(RigidPose(mean, np.median(centers[members], 0)))
        free &= ~members
    return found


def with_flips(poses: list[RigidPose]) -> list[RigidPose]:
    """Every pose and its flips; front and back of a body look alike to a vote, not to a fit."""
    return [RigidPose(pose.rotation @ flip, pose.center) for flip in _FLIPS for pose in poses]


def standing_grid(center: Float[Floats, " 3"]) -> list[RigidPose]:
    """Six axes up, twelve turns about each: for networks without an aligner."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return [RigidPose(pose.rotation, center) for axis in axes for pose in forced_frames(axis, None)]


def axis_vector(name: str) -> Float[Floats, " 3"]:
    """Unit vector of an axis name such as "y", "+y" or "-z"; any other name is an `OptionError`."""
    word = str(name)
    sign = -1.0 if word.startswith("-") else 1.0
    axis = word.lstrip("+-").lower()
    if axis not in ("x", "y", "z") or len(word) > 2:
        raise OptionError(f"invalid axis {name!r}", "write x, y or z, with - for the opposite direction")
    return sign * np.eye(3)["xyz".index(axis)]


def forced_frames(
    up: Float[Floats, " 3"] | None, front: Float[Floats, " 3"] | None, turns: int = 12
) -> list[RigidPose]:
    """Core frames that obey given axes: all turns about the one that is given, or the only one if both are."""
    along, other = (up, front) if up is not None else (front, None)
    assert along is not None
    seed = other if other is not None else np.roll(along, 1)
    across = seed - (seed @ along) * along
    across /= np.linalg.norm(across)
    frames = []
    for turn in range(1 if other is not None else turns):
        angle = 2 * np.pi * turn / turns
        second = np.cos(angle) * across + np.sin(angle) * np.cross(along, across)
        y, z = (along, second) if up is not None else (second, along)
        frames.append(RigidPose(np.stack([np.cross(y, z), y, z], 1), np.zeros(3)))
    return frames
