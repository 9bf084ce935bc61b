"""Training batches of shapes without correspondence: samples, smoothly deformed, a little turned, scaled and rough."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from meshmatch.fields.field import Field
from meshmatch.fields.mls import build_field
from meshmatch.models.encoder import BasisEncoder, PointEncoder
from meshmatch.templates.unregistered import Gathered
from meshmatch.training.datasets import Source, registered_source
from meshmatch.training.scans import ScanConfig, small_rotations

_SIDE = 4  # nodes of the lattice along each axis
_REACH = 1.9  # of a lattice node, in spacings
_LARGEST = 400_000  # points on which a warp is kept ready; with more shapes there is no need of it


@dataclass(frozen=True)
class CloudConfig:
    """How much shapes are changed from one drawing to the next. Lengths in units of sqrt(surface area).

    warp : standard deviation of the vectors of a coarse lattice of nodes, whose field deforms a shape smoothly; every
    shape draws how much of it. plain : share of the shapes that are not warped.
    """

    warp: float = 0.08
    plain: float = 0.25


@dataclass(frozen=True, eq=False)
class Warp:
    """A coarse field on every sample of N shapes: phi (N, P, L), gradient (N, P, 3, L); the same on landmarks."""

    phi: torch.Tensor
    gradient: torch.Tensor
    landmark_phi: torch.Tensor

    @property
    def L(self) -> int:
        return self.phi.shape[2]


@dataclass(frozen=True, eq=False)
class CloudBatch:
    """One batch; lengths in units of sqrt(surface area), roughly the template's frame.

    points, normals : (B, P, 3) a scan
    landmarks : (B, L, 3) known points, not a number where missing
    encode_features : what the encoder reads of ``points``
    """

    points: torch.Tensor
    normals: torch.Tensor
    landmarks: torch.Tensor
    encode_features: torch.Tensor

    def to(self, device: torch.device) -> CloudBatch:
        return replace(self, **{n: v.to(device) for n, v in vars(self).items()})


def build_warp(gathered: Gathered) -> Warp | None:
    """A lattice around all shapes and its field on their samples; None where there are so many that none is needed."""
    N, P, _ = gathered.points.shape
    if N * P > _LARGEST:
        return None
    known = np.nan_to_num(gathered.landmarks)
    everything = np.concatenate([gathered.points.reshape(-1, 3), known.reshape(-1, 3)]).astype(np.float64)
    field = _lattice_field(everything)
    phi = field.phi.to_dense()
    gradient = field.gradient.to_dense()[: 3 * N * P].reshape(N, P, 3, -1)
    return Warp(
        phi[: N * P].reshape(N, P, -1),
        gradient,
        phi[N * P :].reshape(N, gathered.landmarks.shape[1], field.K),
    )


def _lattice_field(points: np.ndarray) -> Field:
    """The field of a coarse lattice around all points (N, 3), at them."""
    low, high = points.min(0), points.max(0)
    middle, half = 0.5 * (low + high), 0.55 * float((high - low).max())
    ticks = np.linspace(-half, half, _SIDE)
    lattice = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3) + middle
    return build_field(points, lattice, _REACH * float(ticks[1] - ticks[0]), "smooth")


def warped_source(shapes: torch.Tensor, change: CloudConfig | None = None) -> Source:
    """Registered shapes (N, V, 3), drawn with replacement and smoothly deformed; all stand alike, in any unit.

    So many that no change is needed (see `build_warp`) are drawn as they are.
    """
    change = change or CloudConfig()
    N, V, _ = shapes.shape
    if N * V > _LARGEST or change.warp <= 0:
        return registered_source(shapes)
    shapes = shapes - shapes.mean(1, keepdim=True)
    shapes = 0.3 * shapes / shapes.flatten(1).std(1)[:, None, None]  # about area 1
    phi = _lattice_field(shapes.reshape(-1, 3).double().numpy()).phi.to_dense().reshape(N, V, -1)

    def draw(count: int, generator: torch.Generator) -> torch.Tensor:
        which = torch.randint(N, (count,), generator=generator)
        size = change.warp * torch.rand(count, 1, 1, generator=generator)
        size = size * (torch.rand(count, 1, 1, generator=generator) >= change.plain)
        vectors = size * torch.randn(count, phi.shape[2], 3, generator=generator)
        return shapes[which] + phi[which] @ vectors

    return draw


@dataclass(frozen=True, eq=False)
class CloudDataset(torch.utils.data.Dataset):
    """Item s is the batch of training step s, a function of the seed and s alone."""

    points: torch.Tensor
    normals: torch.Tensor
    landmarks: torch.Tensor
    warp: Warp | None
    encoder: BasisEncoder | PointEncoder | None
    scan: ScanConfig
    change: CloudConfig
    shapes: int = 8
    seed: int = 0
    length: int = 1

    def __len__(self) -> int:
        return self.length

    @torch.no_grad()
    def __getitem__(self, step: int) -> CloudBatch:
        generator = torch.Generator().manual_seed((self.seed * 2_654_435_761 + step) % (2**63))
        N, total, _ = self.points.shape
        # Every shape once before one comes again, as far as a batch goes.
        order = [torch.randperm(N, generator=generator) for _ in range(-(-self.shapes // N))]
        which = torch.cat(order)[: self.shapes]
        P = min(self.scan.points, total)
        pick = torch.stack([torch.randperm(total, generator=generator)[:P] for _ in which])
        rows = which[:, None]
        points, normals, known = self.points[rows, pick], self.normals[rows, pick], self.landmarks[which]
        if self.warp is not None and self.change.warp > 0:
            points, normals, known = self._warped(which, pick, points, normals, known, generator)
        B = len(which)
        turn = small_rotations(B, generator)
        size = 1 + self.scan.scale * torch.randn(B, 1, 1, generator=generator).clamp(-2, 2)
        shift = 0.02 * torch.randn(B, 1, 3, generator=generator)
        points = size * points @ turn.transpose(1, 2) + shift
        known = size * known @ turn.transpose(1, 2) + shift
        normals = normals @ turn.transpose(1, 2)
        sigma = self.scan.noise * torch.rand(B, 1, 1, generator=generator) ** 3
        points = points + sigma * torch.randn(B, P, 3, generator=generator)
        features = torch.zeros(B, 0) if self.encoder is None else self.encoder.features(points)
        return CloudBatch(points, normals, known, features)

    def _warped(self, which, pick, points, normals, known, generator):
        assert self.warp is not None
        B = len(which)
        size = self.change.warp * torch.rand(B, 1, 1, generator=generator)
        size = size * (torch.rand(B, 1, 1, generator=generator) >= self.change.plain)
        vectors = size * torch.randn(B, self.warp.L, 3, generator=generator)
        rows = which[:, None]
        points = points + self.warp.phi[rows, pick] @ vectors
        known = known + self.warp.landmark_phi[which] @ vectors
        slopes = self.warp.gradient[rows, pick] @ vectors[:, None]  # B P k a: d u_a / d x_k
        F = slopes.transpose(-1, -2) + torch.eye(3)
        return points, turned_normals(F, normals), known


def turned_normals(F: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Unit normals after a deformation with gradient F (..., 3, 3): its cofactors on the normals (..., 3)."""
    a, b, c = F.unbind(-1)  # columns
    cofactors = torch.stack(
        [torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1
    )
    return torch.nn.functional.normalize((cofactors @ normals[..., None])[..., 0], dim=-1)
