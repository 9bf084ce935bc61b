"""Generated people of every kind: naked bodies, children, stylised characters, bodies built of parts, in clothes or not."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.generators.bodies import (
    Bodies,
    draw_identities,
    human_source,
    joint_rotations,
    posable_rig,
    pose_limbs,
    sample_free_pose,
)
from meshmatch.generators.clothes import dressed, skirted
from meshmatch.generators.figure import Figure
from meshmatch.generators.generator import Source, mixed
from meshmatch.generators.limbs import Draw, Limbs
from meshmatch.generators.pose_files import GivenPoses
from meshmatch.generators.proportions import PLAIN, SHARES, STYLISED, TOON, draw_style, rounded, shares_with, stretched
from meshmatch.generators.rig import Rig, forward_kinematics, skin
from meshmatch.generators.scanned_bodies import scanned_source
from meshmatch.progress import Progress
from meshmatch.templates.template import Template

_CLOTHED = 0.75  # of those that are not plain wear something
_SKIRTS = 0.35  # of these, something around both legs
_STILL = 0.55  # of stylised and built bodies stand as modellers deliver them


@dataclass(frozen=True, eq=False)
class Cast:
    """Who is generated: bodies of a rig's figure, a share of them other than naked and as the body model has them."""

    figure: Figure
    share: float
    poses: GivenPoses | None = None
    kinds: tuple[float, ...] = SHARES


def people_source(template: Template, bodies: Bodies, seed: int = 0, progress: Progress | None = None) -> Source:
    """Generated people on a human template's vertices; errors as `meshmatch.generators.bodies.human_source`."""
    if bodies.scanned is not None:
        others = people_source(template, replace(bodies, scanned=None), seed, progress)
        return mixed(others, scanned_source(template, bodies.scanned, seed), bodies.scanned.share)
    if not bodies.characters:
        return human_source(template, bodies.identities, seed, progress, bodies.poses)
    rig = posable_rig(template, bodies.identities, seed, progress, bodies.poses)
    kinds = shares_with(STYLISED if bodies.stylised is None else bodies.stylised)
    return partial(sample_characters, Cast(Figure.of(rig), bodies.characters, bodies.poses, kinds))


def sample_characters(cast: Cast, B: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Posed bodies in metres, pelvis roughly upright, y up, facing +z."""
    return _sample(cast, B, generator)[0]


def sample_layers(
    cast: Cast, B: int, generator: torch.Generator
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B V 3"]]:
    """The same bodies as they are seen, and as they are below their clothes."""
    return _sample(cast, B, generator, below=True)


def _sample(cast: Cast, B: int, generator: torch.Generator, below: bool = False) -> tuple[Tensor, Tensor]:
    figure, rig = cast.figure, cast.figure.rig
    rest, heads = draw_identities(rig, B, generator)
    other = torch.nonzero(torch.rand(B, generator=generator) < cast.share)[:, 0]
    style = draw_style(B, generator, cast.kinds).rows(other)
    worn = (torch.rand(B, generator=generator)[other] < _CLOTHED) | (style.kind == PLAIN)
    naked = rest
    if len(other):
        own, bones = stretched(figure, rest[other], heads[other], style)
        shaped = torch.nonzero(style.kind >= TOON)[:, 0]
        if len(shaped):
            own[shaped] = rounded(figure, own[shaped], bones[shaped], style.kind[shaped], generator)
        if below:
            naked = rest.index_copy(0, other, own)
        if worn.any():
            own[worn] = dressed(figure, own[worn], bones[worn], generator)
        rest[other], heads[other] = own, bones
    world, offset = sample_free_pose(rig, heads, generator)
    if cast.poses is not None:
        world, offset = cast.poses.mixed(rig, heads, world, offset, generator)
    still = other[(style.kind >= TOON) & (torch.rand(len(other), generator=generator) < _STILL)]
    if len(still):
        world[still], offset[still] = forward_kinematics(rig, heads[still], standing(rig, heads[still], generator))
    verts = skin(rig, rest, world, offset)
    naked = skin(rig, naked, world, offset) if below else verts
    skirts = other[worn & (torch.rand(len(other), generator=generator) < _SKIRTS)]
    if len(skirts):
        joints = (world[skirts] @ heads[skirts][..., None])[..., 0] + offset[skirts]
        verts[skirts] = skirted(figure, verts[skirts], heads[skirts], joints, generator)
    soft = other[worn & (torch.rand(len(other), generator=generator) < 0.5)]
    if len(soft):
        verts[soft] = figure.smooth(verts[soft], 6)
    return verts, naked


def standing(rig: Rig, heads: Float[Tensor, "B J 3"], generator: torch.Generator) -> Float[Tensor, "B J 3 3"]:
    """Poses in which modellers deliver characters: T, A and I, and a little away from them."""
    B, J = heads.shape[:2]
    draw = Draw(B, generator)
    vectors = torch.zeros(B, J, 3)
    arms = draw.choice([0.4, 0.35, 0.25], [draw.normal(85, 8), draw.normal(50, 10), draw.normal(18, 8)]).clamp(4, 110)
    angles = dict.fromkeys(Limbs.__dataclass_fields__, torch.zeros(B)) | {
        "arm_elevation": arms, "arm_azimuth": draw.normal(5, 8), "arm_twist": draw.normal(0, 15),
        "elbow": draw.normal(8, 8).abs(), "pronation": draw.normal(0, 20), "hip_flexion": draw.normal(1, 4),
        "hip_abduction": draw.normal(7, 6), "knee": draw.normal(3, 4).abs(), "ankle": draw.normal(0, 4),
        "hip_twist": draw.normal(3, 8), "curl": draw.choice([0.5, 0.5], [draw.uniform(-0.3, 0.3), draw.uniform(0.4, 1.0)]),
    }  # fmt: skip
    limbs = Limbs(**angles)
    matrices = pose_limbs(vectors, rig, heads, limbs, limbs, draw)
    return joint_rotations(vectors, matrices)
