"""Simulate scans of clean shapes: samples of uneven density, noise, holes, outliers, arbitrary orientation."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from meshmatch.arrays import Bool, Float, Int
from meshmatch.generators.rotations import DEGREE, rotation_from_vector

_VIEWS, _CELLS = 10, 48  # for visibility from outside: number of views, and cells along each side of a depth image


@dataclass(frozen=True)
class ScanConfig:
    """Settings of simulated scans, set by hand; lengths are in units of sqrt(surface area).

    ``points`` is the number of points of a scan; ``noise``, ``density``, ``bumps`` and ``scale`` are the strengths of noise,
    uneven density, smooth bumps and random scaling. These are shares of the scans: ``holes`` of those with holes;
    ``outliers`` of those with up to 10 % outliers; ``partial`` of those seen from one side or cut by a plane; ``outside`` of
    those that show only what is visible from outside, not surfaces inside clothes or between parts; ``strays`` of those with
    a foreign object, such as a held object, a base or a sheet.

    With ``upright``, scans are in the category's own axes, centred, and rotated about the vertical axis only (as in the
    paper), or not at all without ``yaw``; otherwise they are approximately in the core frame, as an aligner leaves them.
    With ``sphere``, shapes are scaled to the template's radius around its centroid (as in the paper) instead of to area 1.
    """

    points: int = 2048
    noise: float = 0.02
    holes: float = 0.3
    outliers: float = 0.15
    partial: float = 0.12
    density: float = 0.6
    bumps: float = 0.004
    scale: float = 0.04
    outside: float = 0.0
    strays: float = 0.0
    upright: bool = False
    yaw: bool = True
    sphere: bool = False


def surface_area(
    verts: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "B F"], Float[Tensor, "B 3"]]:
    """Areas of the faces, and the area-weighted centroid of each shape."""
    a, b, c = (verts[:, faces[:, k]] for k in range(3))
    area = 0.5 * torch.linalg.cross(b - a, c - a).square().sum(-1).sqrt()
    centroid = (area[..., None] * (a + b + c)).sum(1) / (3 * area.sum(1, keepdim=True))
    return area, centroid


def normalise(
    verts: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "B V 3"], Float[Tensor, "B F"]]:
    """Scale every shape to area 1 with its centroid at 0; returns vertices and normalised face areas."""
    area, centroid = surface_area(verts, faces)
    total = area.sum(1)
    return (verts - centroid[:, None]) / total.sqrt()[:, None, None], area / total[:, None]


def random_rotations(B: int, generator: torch.Generator) -> Float[Tensor, "B 3 3"]:
    """Uniform rotations from random unit quaternions."""
    q = torch.nn.functional.normalize(torch.randn(B, 4, generator=generator), dim=1)
    w, x, y, z = q.unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    result: Tensor = torch.stack(rows, -1).unflatten(-1, (3, 3))
    return result


def rigid_fit(
    source: Float[Tensor, "N 3"], target: Float[Tensor, "B N 3"]
) -> tuple[Float[Tensor, "B 3 3"], Float[Tensor, "B 3"]]:
    """Best rigid motions: target ~ R source + t (Kabsch), batched."""
    center = target.mean(1)
    covariance = (target - center[:, None]).transpose(1, 2) @ (source - source.mean(0))
    U, _, Vh = torch.linalg.svd(covariance)
    sign = torch.det(U @ Vh)
    U = torch.cat([U[..., :2], U[..., 2:] * sign[:, None, None]], -1)
    R = U @ Vh
    return R, center - (R @ source.mean(0)[:, None])[..., 0]


def small_rotations(B: int, generator: torch.Generator) -> Float[Tensor, "B 3 3"]:
    """Random rotations of the size of an aligner's errors: mostly a few degrees, sometimes tens."""
    size = torch.where(torch.rand(B, 1, generator=generator) < 0.75, 6.0, 18.0) * DEGREE
    return rotation_from_vector(size * torch.randn(B, 3, generator=generator))


def yaw_rotations(B: int, generator: torch.Generator) -> Float[Tensor, "B 3 3"]:
    """Uniformly random rotations about the vertical axis y."""
    angle = 2 * torch.pi * torch.rand(B, 1, generator=generator)
    return rotation_from_vector(angle * torch.tensor([0.0, 1.0, 0.0]))


def bump(verts: Float[Tensor, "B V 3"], amplitude: float, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Add a smooth random displacement, such as from clothes, soft tissue or modelling style; amplitude in sqrt(area)."""
    B = len(verts)
    size = amplitude * torch.rand(B, 1, 1, generator=generator)
    for frequency in (8.0, 20.0):
        direction = torch.randn(B, 3, 3, generator=generator) * frequency
        phase = torch.rand(B, 1, 3, generator=generator) * 6.283
        verts = verts + size * torch.sin(verts @ direction + phase)
    return verts


def seen_share(
    normals: Float[Tensor, "B F 3"], centers: Float[Tensor, "B F 3"], share: float, generator: torch.Generator
) -> Float[Tensor, "B F"]:
    """Factors for the sampling probability of each face: nearly 0 where a partial scan does not show it, else 1.

    A ``share`` of the scans is partial. Half of those show the faces that point in one direction, the others lose the faces
    beyond a plane, at most half of them. Occlusion is ignored.
    """
    B = len(centers)
    direction = torch.nn.functional.normalize(torch.randn(B, 3, 1, generator=generator), dim=1)
    facing = (normals @ direction)[..., 0] > 0
    height = (centers @ direction)[..., 0]  # (B, F)
    rank = (0.5 * torch.rand(B, generator=generator) * height.shape[1]).long()
    plane = height.sort(dim=1).values[torch.arange(B), rank]
    kind = torch.rand(B, 1, generator=generator) / max(share, 1e-9)
    seen = torch.where(kind < 0.5, facing, (height >= plane[:, None]) | (kind >= 1))
    return torch.where(seen, 1.0, 1e-4)


def seen_from_outside(
    verts: Float[Tensor, "B V 3"], faces: Int[Tensor, "F 3"], generator: torch.Generator
) -> Bool[Tensor, "B F"]:
    """Whether each face is visible from outside: its center is close to the foremost in the depth image of some view."""
    B, cells = len(verts), _CELLS
    centers = verts[:, faces].mean(2)
    views = random_rotations(B * _VIEWS, generator).view(B, _VIEWS, 3, 3)
    rotated = centers[:, None] @ views.transpose(-1, -2)  # B D F 3
    low, high = rotated.amin(2, keepdim=True), rotated.amax(2, keepdim=True)
    at = ((rotated - low) / (high - low).amax(-1, keepdim=True) * (cells - 1e-3)).long()
    cell = at[..., 0] * cells + at[..., 1]
    foremost = torch.full((B, _VIEWS, cells * cells), -torch.inf)
    foremost.scatter_reduce_(2, cell, rotated[..., 2], "amax")
    depth = foremost.gather(2, cell) - rotated[..., 2]
    return (depth < 0.03).any(1)


def stray_points(verts: Float[Tensor, "B V 3"], P: int, generator: torch.Generator) -> Float[Tensor, "B P 3"]:
    """Points of a foreign object: a box, rod or sheet near each body, or a slab below it (y is up)."""
    B = len(verts)
    shape_index = torch.arange(B)
    is_slab = torch.rand(B, 1, generator=generator) < 0.3
    half = 0.015 * 30 ** torch.rand(B, 3, generator=generator)  # half extents, from a stick to a shield
    slab = torch.cat([half[:, :1], half[:, 1:2] * 0.15, half[:, :1]], 1) + torch.tensor([0.12, 0.0, 0.12])
    half = torch.where(is_slab, slab, half)
    sides = torch.stack([half[:, 1] * half[:, 2], half[:, 0] * half[:, 2], half[:, 0] * half[:, 1]], 1)
    axis = torch.multinomial(sides, P, True, generator=generator)
    inside = 2 * torch.rand(B, P, 3, generator=generator) - 1
    on_surface = inside.scatter(2, axis[..., None], inside.gather(2, axis[..., None]).sign()) * half[:, None]
    rotation = torch.where(is_slab[..., None], torch.eye(3), random_rotations(B, generator))
    anchor = verts[shape_index, torch.randint(verts.shape[1], (B,), generator=generator)]
    anchor = anchor + 0.5 * half.amin(1, keepdim=True) * torch.randn(B, 3, generator=generator)
    lowest, middle = verts[..., 1].amin(1), verts.mean(1)
    below = torch.stack([middle[:, 0], lowest - half[:, 1], middle[:, 2]], 1)
    return on_surface @ rotation.transpose(1, 2) + torch.where(is_slab, below, anchor)[:, None]


def sample_scan(
    verts: Float[Tensor, "B V 3"],
    areas: Float[Tensor, "B F"],
    faces: Int[Tensor, "F 3"],
    config: ScanConfig,
    generator: torch.Generator,
) -> Float[Tensor, "B P 3"]:
    """Sample points on the surface, with uneven density, holes, noise and outliers."""
    B, P = len(verts), config.points
    a, b, c = (verts[:, faces[:, k]] for k in range(3))
    centers = (a + b + c) / 3  # B F 3
    face_weight = areas.clone()
    if config.partial:
        face_weight = face_weight * seen_share(torch.linalg.cross(b - a, c - a), centers, config.partial, generator)
    waves = torch.randn(B, 3, 1, generator=generator) * 4
    strength = config.density * torch.rand(B, 1, generator=generator)
    face_weight = face_weight * (strength * torch.sin((centers @ waves)[..., 0])).exp()
    # A hole removes everything within a ball around a random face center.
    for _ in range(2):
        center_face = torch.randint(centers.shape[1], (B,), generator=generator)
        middle = centers[torch.arange(B), center_face]
        radius = 0.16 * torch.rand(B, generator=generator)
        radius = radius * (torch.rand(B, generator=generator) < config.holes)
        inside = (centers - middle[:, None]).square().sum(-1) < radius[:, None] ** 2
        face_weight = torch.where(inside, face_weight * 1e-4, face_weight)
    picked = torch.multinomial(face_weight, P, True, generator=generator)  # B P
    corner = faces[picked]  # B P 3
    weight = torch.rand(B, P, 2, generator=generator)
    weight = torch.where(weight.sum(-1, keepdim=True) > 1, 1 - weight, weight)
    rows = torch.arange(B)[:, None]
    a, b, c = (verts[rows, corner[..., k]] for k in range(3))
    points = a + weight[..., :1] * (b - a) + weight[..., 1:] * (c - a)
    sigma = config.noise * torch.rand(B, 1, 1, generator=generator) ** 3
    points = points + sigma * torch.randn(B, P, 3, generator=generator)
    has_outliers = torch.rand(B, 1, generator=generator) < config.outliers
    outlier = torch.rand(B, P, generator=generator) < 0.1 * torch.rand(B, 1, generator=generator) * has_outliers
    return torch.where(outlier[..., None], 0.5 * torch.randn(B, P, 3, generator=generator), points)
