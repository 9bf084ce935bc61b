"""Source of generated people: naked bodies, children, stylised characters and bodies built of parts, clothed or not."""

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
from meshmatch.generators.clothes import add_clothes, add_skirts
from meshmatch.generators.figure import Figure
from meshmatch.generators.generator import Source, mix_sources
from meshmatch.generators.limbs import Draw, Limbs
from meshmatch.generators.pose_files import GivenPoses
from meshmatch.generators.proportions import (
    PLAIN,
    SHARES,
    STYLISED,
    TOON,
    draw_style,
    round_parts,
    scale_bones,
    shares_with_stylised,
)
from meshmatch.generators.rig import Rig, forward_kinematics, skin
from meshmatch.generators.scanned_bodies import scanned_source
from meshmatch.progress import Progress
from meshmatch.templates.template import Template

_CLOTHED_SHARE = 0.75  # share of characters with clothes; those of plain proportions always have some
_SKIRT_SHARE = 0.35  # share of the clothed with a garment around both legs
_REST_POSE_SHARE = 0.55  # share of stylised and built bodies in a rest pose such as T or A


@dataclass(frozen=True, eq=False)
class CharacterConfig:
    """Settings of generated people: the rig's figure, the ``share`` of characters, and the shares of their styles.

    All other bodies are naked, with the proportions of the body model.
    """

    figure: Figure
    share: float
    poses: GivenPoses | None = None
    style_shares: tuple[float, ...] = SHARES


def people_source(template: Template, bodies: Bodies, seed: int = 0, progress: Progress | None = None) -> Source:
    """Source of people on a human template's vertices; errors as `meshmatch.generators.bodies.human_source`.

    Scanned bodies are in random poses only: given poses are rotations from the rest pose of the other bodies' rig.
    """
    if bodies.scanned is not None:
        others = people_source(template, replace(bodies, scanned=None), seed, progress)
        return mix_sources(others, scanned_source(template, bodies.scanned, seed), bodies.scanned.share)
    if not bodies.characters:
        return human_source(template, bodies.identities, seed, progress, bodies.poses)
    rig = posable_rig(template, bodies.identities, seed, progress, bodies.poses)
    style_shares = shares_with_stylised(STYLISED if bodies.stylised is None else bodies.stylised)
    return partial(sample_characters, CharacterConfig(Figure.of(rig), bodies.characters, bodies.poses, style_shares))


def sample_characters(config: CharacterConfig, B: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Posed bodies in metres, pelvis approximately upright, y up, facing +z."""
    return _sample(config, B, generator)[0]


def sample_layers(
    config: CharacterConfig, B: int, generator: torch.Generator
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B V 3"]]:
    """Posed bodies with their clothes, and the same bodies without."""
    return _sample(config, B, generator, with_naked=True)


def _sample(
    config: CharacterConfig, B: int, generator: torch.Generator, with_naked: bool = False
) -> tuple[Tensor, Tensor]:
    figure, rig = config.figure, config.figure.rig
    rest, heads = draw_identities(rig, B, generator)
    characters = torch.nonzero(torch.rand(B, generator=generator) < config.share)[:, 0]
    style = draw_style(B, generator, config.style_shares).rows(characters)
    is_clothed = (torch.rand(B, generator=generator)[characters] < _CLOTHED_SHARE) | (style.kind == PLAIN)
    naked = rest
    if len(characters):
        shaped_rest, shaped_heads = scale_bones(figure, rest[characters], heads[characters], style)
        to_round = torch.nonzero(style.kind >= TOON)[:, 0]
        if len(to_round):
            shaped_rest[to_round] = round_parts(
                figure, shaped_rest[to_round], shaped_heads[to_round], style.kind[to_round], generator
            )
        if with_naked:
            naked = rest.index_copy(0, characters, shaped_rest)
        if is_clothed.any():
            shaped_rest[is_clothed] = add_clothes(figure, shaped_rest[is_clothed], shaped_heads[is_clothed], generator)
        rest[characters], heads[characters] = shaped_rest, shaped_heads
    world, offset = sample_free_pose(rig, heads, generator)
    if config.poses is not None:
        world, offset = config.poses.mixed(rig, heads, world, offset, generator)
    in_rest_pose = characters[
        (style.kind >= TOON) & (torch.rand(len(characters), generator=generator) < _REST_POSE_SHARE)
    ]
    if len(in_rest_pose):
        world[in_rest_pose], offset[in_rest_pose] = forward_kinematics(
            rig, heads[in_rest_pose], sample_rest_poses(rig, heads[in_rest_pose], generator)
        )
    verts = skin(rig, rest, world, offset)
    naked = skin(rig, naked, world, offset) if with_naked else verts
    skirts = characters[is_clothed & (torch.rand(len(characters), generator=generator) < _SKIRT_SHARE)]
    if len(skirts):
        joints = (world[skirts] @ heads[skirts][..., None])[..., 0] + offset[skirts]
        verts[skirts] = add_skirts(figure, verts[skirts], heads[skirts], joints, generator)
    smoothed = characters[is_clothed & (torch.rand(len(characters), generator=generator) < 0.5)]
    if len(smoothed):
        verts[smoothed] = figure.smooth(verts[smoothed], 6)
    return verts, naked


def sample_rest_poses(rig: Rig, heads: Float[Tensor, "B J 3"], generator: torch.Generator) -> Float[Tensor, "B J 3 3"]:
    """Random rest poses of character models: variations of the T, A and I poses."""
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
