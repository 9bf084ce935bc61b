"""Core frames in which a shape is tried: those of the category (see the model card), of the network, or of the user's axes.

The network's aligner sees many rotated copies of the samples. Every answer is a vote for one rotation, and votes that agree
form a hypothesis. A second query from the voted frame sharpens it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Float, Floats
from meshmatch.derived import derived
from meshmatch.fitting.fit_config import FitConfig, axis_of
from meshmatch.geometry.frames import Frame, RigidPose
from meshmatch.geometry.oriented import OrientedPoints, nearest_by_brute_force
from meshmatch.models.network import Network
from meshmatch.models.trained import TrainedModel
from meshmatch.shapes.alignment import ALIGNS, align
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import SCALES, template_radius, template_samples, unit_frame

# All of these were set by hand.
_MAX_ALIGNED = 4  # orientations to try if the category's alignment has to search
_ALIGNER_SAMPLES = 2048  # samples that the aligner sees
# Offsets of a body's core from the centroid of a part of it, along the body's up axis (units of sqrt(area)).
_CORE_OFFSETS = (-0.3, -0.15, 0.0, 0.15)
_MIN_USER_COSINE = 0.5  # between an axis of a frame and the user's axis
MIN_AXIS_COSINE = 0.85
"""Cosine above which an axis of a frame counts as a given one, such as the file's."""
_N_ANYWHERE = 144  # rotations to try for a shape in a pose that the aligner does not know
# How far the core is then assumed below the shape's centroid, along its up axis (units of sqrt(area)).
_CORE_BELOW = 0.15
_SPIRAL = 1.533751168755204288118041  # the solution of x ** 4 = x + 4
_AGREE = 30  # degrees: votes that are closer agree. Set by hand.
# Possible errors of a vote, as rotations of the core frame: none, half turns about y, x and z, quarter turns about y.
_FLIPS = Rotation.from_rotvec(
    np.pi * np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1], [0, 0.5, 0], [0, -0.5, 0]])
).as_matrix()


def scan_frame(model: TrainedModel, shape: Shape, mirrored: bool = False) -> Frame:
    """The frame in which the model sees shapes before they are rotated: scaled to area 1 or to the template's radius."""
    scale = next(kind for kind in SCALES if kind == model.card.frame["scale"])  # a card has no other
    frame = unit_frame(shape, scale, template_radius(model.template))
    return replace(frame, rotation=frame.rotation * [[-1], [1], [1]]) if mirrored else frame


def frames_to_try(
    model: TrainedModel, samples: OrientedPoints, config: FitConfig, upright: bool = False
) -> list[RigidPose]:
    """Core frames to try: those of the category, of the aligner (or a grid without one), or those that fit the user's axes.

    If the file states that the shape is ``upright`` and no frame of the aligner is, the upright frame is tried too.
    """
    frames = aligned_frames(model, samples)
    if frames is None and not model.inference.config.align_basis:
        frames = standing_grid(samples.points.mean(0))
    elif frames is None:
        own = principal_pose(samples.points)
        points = own.to_local(samples.points[:_ALIGNER_SAMPLES])
        voted = propose(model.on(config.device), points, config.copies, config.hypotheses, config.seed)
        frames = with_flips([own @ pose for pose in voted])
        if upright and not any(stands_upright(pose) for pose in frames):
            frames.append(RigidPose.identity())
    return _matching_user_axes(frames, config) or forced_frames(*_axes(config))


def frames_anywhere(model: TrainedModel, samples: OrientedPoints, config: FitConfig) -> list[RigidPose]:
    """Core frames in evenly spread rotations that fit the user's axes; none for a category whose orientation is fixed."""
    if model.card.frame["orientation"] in ALIGNS:
        return []
    own = principal_pose(samples.points)
    turned = [own @ RigidPose(turn, -_CORE_BELOW * turn[:, 1]) for turn in _even_rotations(_N_ANYWHERE)]
    return _matching_user_axes(turned, config)


def _matching_user_axes(frames: list[RigidPose], config: FitConfig) -> list[RigidPose]:
    """Keep the frames whose axes are near the user's, if there are any."""
    up, front = _axes(config)
    return [
        pose
        for pose in frames
        if (up is None or pose.rotation[:, 1] @ up > _MIN_USER_COSINE)
        and (front is None or pose.rotation[:, 2] @ front > _MIN_USER_COSINE)
    ]


def _even_rotations(count: int) -> Float[Floats, "count 3 3"]:
    """Evenly spread rotations (Alexa, *Super-Fibonacci Spirals*, CVPR 2022)."""
    step = np.arange(count) + 0.5
    first, second = 2 * np.pi * step / np.sqrt(2), 2 * np.pi * step / _SPIRAL
    inner, outer = np.sqrt(step / count), np.sqrt(1 - step / count)
    quaternions = [inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second)]
    return np.asarray(Rotation.from_quat(np.stack(quaternions, 1)).as_matrix())


def stands_upright(pose: RigidPose) -> bool:
    """Return whether a core frame is upright as in glTF: up along y and front along z."""
    return bool(min(pose.rotation[1, 1], pose.rotation[2, 2]) > MIN_AXIS_COSINE)


def aligned_frames(model: TrainedModel, samples: OrientedPoints) -> list[RigidPose] | None:
    """Core frames of a category whose orientation its network does not search; None if the network does."""
    align_method = next(
        (align_method for align_method in ALIGNS if align_method == model.card.frame["orientation"]), None
    )
    if align_method is None:
        return None
    if align_method == "none":
        return [RigidPose.identity()]
    return [each.pose for each in align(samples, _template_samples(model), align_method, _MAX_ALIGNED)]


@derived
def _template_samples(model: TrainedModel) -> OrientedPoints:
    return template_samples(model.template)


def frames_of_part(
    model: TrainedModel, samples: OrientedPoints, config: FitConfig, wide: bool, upright: bool = False
) -> tuple[list[RigidPose], list[RigidPose]]:
    """Core frames to try for a part, whose centroid is not that of the whole and whose orientation a vote seldom finds.

    The first list is that of `frames_to_try`. The second has all rotations about the user's axes, each with several
    positions of the core along the body; it is the same for any samples. If the user gives no axes, a ``wide`` search has
    all rotations about the axes of the file as its second list, and no first one.
    """
    if model.card.frame["orientation"] in ALIGNS:
        return frames_to_try(model, samples, config, upright), []
    up, front = _axes(config)
    has_axes, rotated = up is not None or front is not None, []
    if has_axes:
        rotated = forced_frames(up, front)
    elif wide:
        rotated = [pose for axis in np.concatenate([np.eye(3), -np.eye(3)]) for pose in forced_frames(axis, None, 8)]
    frames = [] if wide and not has_axes else frames_to_try(model, samples, config, upright)
    spread = [
        RigidPose(pose.rotation, pose.center + offset * pose.rotation[:, 1])
        for pose in rotated
        for offset in _CORE_OFFSETS
    ]
    return frames, spread


def _axes(config: FitConfig) -> tuple[Float[Floats, " 3"] | None, Float[Floats, " 3"] | None]:
    """The user's up and front axes."""
    up, front = (None if name is None else axis_vector(name) for name in (config.up, config.front))
    return up, front


def principal_pose(points: Float[Floats, "P 3"]) -> RigidPose:
    """The pose of the centroid and principal axes of points.

    The signs of two axes point to the side that extends further (third moments); the sign of the third, whose third moment
    is the smallest, makes the axes a rotation. A search that starts there does not depend on the orientation of the file,
    unless the points are symmetric.
    """
    middle = points.mean(0)
    axes = np.linalg.eigh(np.cov(points.T))[1]
    further = (((points - middle) @ axes) ** 3).sum(0)
    axes *= np.where(further < 0, -1.0, 1.0)
    axes[:, np.abs(further).argmin()] *= np.sign(np.linalg.det(axes))
    return RigidPose(axes, middle)


def random_rotations(count: int, seed: int) -> Float[Floats, "count 3 3"]:
    """Uniformly random rotations, the first of which is replaced by the identity."""
    rotations = Rotation.random(count, random_state=np.random.default_rng(seed)).as_matrix()
    rotations[0] = np.eye(3)
    return rotations


def ask_aligner(
    network: Network, points: Float[Floats, "P 3"], turns: Float[Floats, "N 3 3"]
) -> tuple[Float[Floats, "N 3 3"], Float[Floats, "N 3"]]:
    """Rotations and centers of the core frame of points, predicted from N rotated copies of them (x -> turn x)."""
    middle = points.mean(0)
    cloud = (points - middle).astype(np.float32)
    # Turning the basis the other way is cheaper than turning and indexing the points N times.
    queries = np.einsum("mk,nkl->nml", network.align_basis, turns).astype(np.float32)
    offsets = cloud[nearest_by_brute_force(cloud, queries.reshape(-1, 3))].reshape(queries.shape) - queries  # N M 3
    R, t = network.read_frames(offsets @ turns.astype(np.float32).transpose(0, 2, 1))
    back = turns.transpose(0, 2, 1)
    return back @ R, (back @ t[..., None])[..., 0] + middle


def propose(
    network: Network, points: Float[Floats, "P 3"], copies: int = 48, keep: int = 4, seed: int = 0
) -> list[RigidPose]:
    """At most ``keep`` hypotheses for the core frame of samples, most votes first, from the votes of rotated ``copies``."""
    rotations, centers = ask_aligner(network, points, random_rotations(copies, seed))
    # Ask again from the proposed frames, where the network is most reliable.
    rotations, centers = ask_aligner(network, points, rotations.transpose(0, 2, 1))
    trace = np.einsum("nij,mij->nm", rotations, rotations)
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    close = angle < _AGREE
    unassigned = np.ones(len(rotations), bool)
    found: list[RigidPose] = []
    while unassigned.any() and len(found) < keep:
        votes = (close & unassigned).sum(1) * unassigned
        members = close[int(votes.argmax())] & unassigned
        mean = Rotation.from_matrix(rotations[members]).mean().as_matrix()
        found.append(RigidPose(mean, np.median(centers[members], 0)))
        unassigned &= ~members
    return found


def with_flips(poses: list[RigidPose]) -> list[RigidPose]:
    """Every pose and its flips: a vote may mistake the front of a body for its back, a fit does not."""
    return [RigidPose(pose.rotation @ flip, pose.center) for flip in _FLIPS for pose in poses]


def standing_grid(center: Float[Floats, " 3"]) -> list[RigidPose]:
    """Six up axes with twelve rotations about each, for networks without an aligner."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return [RigidPose(pose.rotation, center) for axis in axes for pose in forced_frames(axis, None)]


def axis_vector(name: str) -> Float[Floats, " 3"]:
    """Unit vector of an axis name such as "y", "+y" or "-z"; any other name is an `OptionError`."""
    axis, sign = axis_of(name)
    return np.asarray(sign * np.eye(3)[axis])


def forced_frames(
    up: Float[Floats, " 3"] | None, front: Float[Floats, " 3"] | None, turns: int = 12
) -> list[RigidPose]:
    """Core frames with given axes: rotations about the one that is given, or the only possible one if both are."""
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
