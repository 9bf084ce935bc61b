"""Endless generated human bodies: identity, pose, linear blend skinning."""

from __future__ import annotations

import torch

from meshmatch.training.pose_files import GivenPoses
from meshmatch.training.poses import sample_free_pose
from meshmatch.training.rig import Rig


def draw_identities(rig: Rig, B: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Blend pairs of stored identities: rest vertices (B, V, 3) and joints (B, J, 3), metres.

    The body model is linear in its coefficients, so a blend of two bodies (and a little beyond) is a body.
    """
    pick = torch.randint(rig.identities, (2, B), generator=generator)
    blend = torch.rand(B, 1, 1, generator=generator) * 1.2 - 0.1
    rest = torch.lerp(rig.rest[pick[0]].float(), rig.rest[pick[1]].float(), blend)
    heads = torch.lerp(rig.heads[pick[0]], rig.heads[pick[1]], blend)
    return rest, heads


def skin(rig: Rig, rest: torch.Tensor, world: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Linear blend skinning: posed vertices (B, V, 3)."""
    transforms = torch.cat([world.flatten(2), offset], -1)  # B J 12
    blended = torch.einsum("vj,bjk->bvk", rig.weights, transforms)
    return (blended[..., :9].unflatten(-1, (3, 3)) @ rest[..., None])[..., 0] + blended[..., 9:]


def sample_bodies(
    rig: Rig, B: int, generator: torch.Generator, poses: GivenPoses | None = None
) -> torch.Tensor:
    """Posed bodies (B, V, 3) in metres, pelvis roughly upright, y up, facing +z; some in given poses."""
    rest, heads = draw_identities(rig, B, generator)
    world, offset = sample_free_pose(rig, heads, generator)
    if poses is not None:
        world, offset = poses.mixed(rig, heads, world, offset, generator)
    return skin(rig, rest, world, offset)
