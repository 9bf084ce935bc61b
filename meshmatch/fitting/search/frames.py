"""Core frames in which a shape is tried: as the card says that its category is placed, as the user or the network says.

The network's aligner is asked about many turned copies of the samples. Every answer is a vote for one rotation; votes
that agree form a hypothesis. Asking again from the voted frame sharpens it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.derived import derived
from meshmatch.fitting.fit_config import FitConfig, axis_of
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import OrientedPoints, nearest
from meshmatch.models.network import Network
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.normalise import ALIGNS, align
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import SCALES, template_radius, template_samples, unit_frame

# All of these were set by hand.
_ALIGNED = 4  # orientations that are tried where the alignment has to search
_VOTERS = 2048  # samples that the aligner sees
# How far along its own up axis a body's core may lie from the middle of a part of it (units of sqrt(area)).
_ALONG = (-0.3, -0.15, 0.0, 0.15)
_OBEYS = 0.5  # cosine of the angle between an axis of a frame and the user's
USUAL = 0.85
"""Cosine above which an orientation is a usual one, or that of the file."""
_ANYWHERE = 144  # turns of a shape that stands as nothing that the aligner knows
_BELOW = 0.15  # how far a core then lies below the middle of its shape, along its own up axis (units of sqrt(area))
_SPIRAL = 1.533751168755204288118041  # the solution of x ** 4 = x + 4
_AGREE = 30  # degrees: votes that are closer agree. Set by hand.
# Turns of the core frame that a vote may be wrong by: about face, upside down, on its head, a quarter either way.
_FLIPS = Rotation.from_rotvec(
    np.pi * np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0.5, 0], [0, -0.5, 0]])
).as_matrix()


def scan_frame(model: TrainedModel, shape: Shape, mirrored: bool = False) -> Frame:
    """The frame in which the model knows shapes, before they are turned: of area 1, or of the template's radius."""
    scale = next(kind for kind in SCALES if kind == model.card.frame["scale"])  # the card knows no other
    frame = unit_frame(shape, scale, template_radius(model.template))
    return replace(frame, rotation=frame.rotation * [[-1], [1], [1]]) if mirrored else frame


def frames_to_try(
    model: TrainedModel, samples: OrientedPoints, config: FitConfig, upright: bool = False
) -> list[RigidPose]:
    """Core frames to try: the category's, the aligner's (or a grid without one), or those that obey the user's axes; and
    that in which a shape is ``upright``, if its file says so.
    """
    frames = aligned_frames(model, samples)
    if frames is None and not model.inference.config.align_basis:
        frames = standing_grid(samples.points.mean(0))
    elif frames is None:
        own = own_axes(samples.points)
        points = own.to_local(samples.points[:_VOTERS])
        voted = propose(model.on(config.device), points, config.copies, config.hypotheses, config.seed)
        frames = with_flips([own @ pose for pose in voted])
        if upright and not any(stands_upright(pose) for pose in frames):
            frames.append(RigidPose.identity())
    return _obeying(frames, config) or forced_frames(*_axes(config))


def frames_anywhere(model: TrainedModel, samples: OrientedPoints, config: FitConfig) -> list[RigidPose]:
    """Core frames turned evenly every way, those that obey the user's axes; none of a category whose orientation is not
    searched.
    """
    if model.card.frame["orientation"] in ALIGNS:
        return []
    own = own_axes(samples.points)
    turned = [own @ RigidPose(turn, -_BELOW * turn[:, 1]) for turn in _even_turns(_ANYWHERE)]
    return _obeying(turned, config)


def _obeying(frames: list[RigidPose], config: FitConfig) -> list[RigidPose]:
    """Those whose axes are about the user's, if the user gives any."""
    up, front = _axes(config)
    return [
        pose
        for pose in frames
        if (up is None or pose.rotation[:, 1] @ up > _OBEYS) and (front is None or pose.rotation[:, 2] @ front > _OBEYS)
    ]


def _even_turns(count: int) -> Float[Floats, "count 3 3"]:
    """Rotations spread evenly, by the spiral of Alexa (*Super-Fibonacci Spirals*, CVPR 2022)."""
    step = np.arange(count) + 0.5
    first, second = 2 * np.pi * step / np.sqrt(2), 2 * np.pi * step / _SPIRAL
    inner, outer = np.sqrt(step / count), np.sqrt(1 - step / count)
    quaternions = [inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second)]
    return np.asarray(Rotation.from_quat(np.stack(quaternions, 1)).as_matrix())


def stands_upright(pose: RigidPose) -> bool:
    """Whether a core frame stands as glTF says: up along y, and front along z."""
    return bool(min(pose.rotation[1, 1], pose.rotation[2, 2]) > USUAL)


def aligned_frames(model: TrainedModel, samples: OrientedPoints) -> list[RigidPose] | None:
    """Core frames of a category whose orientation its network does not search; None where it does."""
    how = next((how for how in ALIGNS if how == model.card.frame["orientation"]), None)
    if how is None:
        return None
    if how == "none":
        return [RigidPose.identity()]
    return [each.pose for each in align(samples, _template_samples(model), how, _ALIGNED)]


@derived
def _template_samples(model: TrainedModel) -> OrientedPoints:
    return template_samples(model.template)


def frames_of_part(
    model: TrainedModel, samples: OrientedPoints, config: FitConfig, wide: bool, upright: bool = False
) -> tuple[list[RigidPose], list[RigidPose]]:
    """Core frames to try for a part, whose middle is not that of the whole, and which a vote seldom knows.

    Those of `frames_to_try`; and, the same for any samples, all turns about the user's axes, each with several places of
    the core along the body. Where nobody says how a shape stands, a ``wide`` search has all turns about the axes of the
    file instead of both.
    """
    if model.card.frame["orientation"] in ALIGNS:
        return frames_to_try(model, samples, config, upright), []
    up, front = _axes(config)
    given, turned = up is not None or front is not None, []
    if given:
        turned = forced_frames(up, front)
    elif wide:
        turned = [pose for axis in np.concatenate([np.eye(3), -np.eye(3)]) for pose in forced_frames(axis, None, 8)]
    frames = [] if wide and not given else frames_to_try(model, samples, config, upright)
    spread = [RigidPose(pose.rotation, pose.center + away * pose.rotation[:, 1]) for pose in turned for away in _ALONG]
    return frames, spread


def _axes(config: FitConfig) -> tuple[Float[Floats, " 3"] | None, Float[Floats, " 3"] | None]:
    """The user's up and front."""
    up, front = (None if name is None else axis_vector(name) for name in (config.up, config.front))
    return up, front


def own_axes(points: Float[Floats, "P 3"]) -> RigidPose:
    """The middle of points and their principal axes; two point to the side that reaches further, by third moments, and
    the one of which these say least makes it a rotation.

    A search that begins there finds the same however the file stands, unless the points are symmetric.
    """
    middle = points.mean(0)
    axes = np.linalg.eigh(np.cov(points.T))[1]
    further = (((points - middle) @ axes) ** 3).sum(0)
    axes *= np.where(further < 0, -1.0, 1.0)
    axes[:, np.abs(further).argmin()] *= np.sign(np.linalg.det(axes))
    return RigidPose(axes, middle)


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
    offsets = cloud[nearest(cloud, queries.reshape(-1, 3))].reshape(queries.shape) - queries  # N M 3
    R, t = network.read_frames(offsets @ turns.astype(np.float32).transpose(0, 2, 1))
    back = turns.transpose(0, 2, 1)
    return back @ R, (back @ t[..., None])[..., 0] + middle


def propose(
    network: Network, points: Float[Floats, "P 3"], copies: int = 48, keep: int = 4, seed: int = 0
) -> list[RigidPose]:
    """At most ``keep`` hypotheses of the core frame of samples, most voted first; so many turned copies vote."""
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
    axis, sign = axis_of(name)
    return np.asarray(sign * np.eye(3)[axis])


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
