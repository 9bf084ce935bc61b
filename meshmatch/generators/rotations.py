"""Rotations as vectors (axis times angle, radians) and as matrices."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from meshmatch.arrays import Float

DEGREE = math.pi / 180.0


def rotation_from_vector(vector: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Rodrigues' formula: rotation vectors, in radians, to matrices."""
    angle = vector.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    x, y, z = (vector / angle).unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    sine, cosine = angle.sin()[..., None], angle.cos()[..., None]
    result: Tensor = torch.eye(3).to(vector) + sine * cross + (1 - cosine) * (cross @ cross)
    return result


def rotation_between(a: Float[Tensor, "*B 3"], b: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Smallest rotations that take unit vectors a to b, as rotation vectors."""
    axis = torch.linalg.cross(a, b)
    sine = axis.norm(dim=-1, keepdim=True)
    cosine = (a * b).sum(-1, keepdim=True)
    # For opposite vectors any perpendicular axis is valid.
    any_axis = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a)
    across = normalize(torch.linalg.cross(a, any_axis), dim=-1)
    half = (sine < 1e-6) & (cosine < 0)
    return torch.where(half, across * math.pi, axis / sine.clamp_min(1e-9) * torch.atan2(sine, cosine))
