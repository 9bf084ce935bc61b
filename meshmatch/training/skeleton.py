"""A posed skeleton: where its joints go, and how deep it runs into itself."""

from __future__ import annotations

import torch

from meshmatch.arrays import Float
from meshmatch.training.rig import Rig


def forward_kinematics(
    rig: Rig, heads: Float[torch.Tensor, "B J 3"], rotations: Float[torch.Tensor, "B J 3 3"]
) -> tuple[Float[torch.Tensor, "B J 3 3"], Float[torch.Tensor, "B J 3"]]:
    """World rotation R and offset t of every joint: x -> R x + t for a rest point x."""
    world: list[torch.Tensor] = []
    offset: list[torch.Tensor] = []
    for index, parent in enumerate(rig.parents):
        R, head = rotations[:, index], heads[:, index]
        shift = head - (R @ head[..., None])[..., 0]
        if parent >= 0:
            shift = (world[parent] @ shift[..., None])[..., 0] + offset[parent]
            R = world[parent] @ R
        world.append(R)
        offset.append(shift)
    return torch.stack(world, 1), torch.stack(offset, 1)


# Capsules for self-intersection: (start joint, end joint, radius in units of the torso length).
_CAPSULES: tuple[tuple[str, str, float], ...] = (
    ("root", "spine03", 0.24),
    ("spine03", "spine01", 0.23),
    ("spine01", "neck01", 0.16),
    ("neck03", "eye.L", 0.17),
    ("neck03", "eye.R", 0.17),
    *(
        (start + side, end + side, radius)
        for side in (".L", ".R")
        for start, end, radius in (
            ("upperarm02", "lowerarm01", 0.08),
            ("lowerarm01", "wrist", 0.06),
            ("wrist", "finger3-2", 0.05),
            ("upperleg02", "lowerleg01", 0.12),
            ("lowerleg01", "foot", 0.085),
            ("foot", "toe2-1", 0.06),
        )
    ),
)
_NEAR = {"upperarm02": ("spine01",), "upperleg02": ("root",)}


def _capsule_pairs() -> list[tuple[int, int]]:
    pairs = []
    for i, (start_a, end_a, _) in enumerate(_CAPSULES):
        for j, (start_b, end_b, _) in enumerate(_CAPSULES[:i]):
            joined = {start_a, end_a} & {start_b, end_b} or (i < 5 and j < 5)
            girdle = start_b in ("spine03", "spine01") and start_a.startswith("upperarm")
            hips = start_b == "root" and start_a.startswith("upperleg")
            thighs = start_a.startswith("upperleg") and start_b.startswith("upperleg")
            if not (joined or girdle or hips or thighs):
                pairs.append((i, j))
    return pairs


def penetration(
    rig: Rig,
    heads: Float[torch.Tensor, "B J 3"],
    world: Float[torch.Tensor, "B J 3 3"],
    offset: Float[torch.Tensor, "B J 3"],
) -> Float[torch.Tensor, " B"]:
    """Summed overlap of non-adjacent body capsules, in units of the torso length."""
    joints = (world @ heads[..., None])[..., 0] + offset
    torso = (heads[:, rig.joint("neck01")] - heads[:, rig.joint("root")]).norm(dim=-1)
    steps = torch.linspace(0, 1, 5)
    start = torch.stack([joints[:, rig.joint(capsule[0])] for capsule in _CAPSULES], 1)
    end = torch.stack([joints[:, rig.joint(capsule[1])] for capsule in _CAPSULES], 1)
    points = start[:, :, None] + (end - start)[:, :, None] * steps[:, None]  # B C 5 3
    pairs = torch.tensor(_capsule_pairs())
    radii = torch.tensor([capsule[2] for capsule in _CAPSULES])
    gap = (points[:, pairs[:, 0], :, None] - points[:, pairs[:, 1], None]).norm(dim=-1).amin((-1, -2))
    touch = 0.85 * (radii[pairs[:, 0]] + radii[pairs[:, 1]])
    return (touch - gap / torso[:, None]).clamp_min(0).sum(-1)
