"""Training batches, drawn statelessly: batch s is a function of (seed, s), which makes resuming exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from meshmatch.arrays import Float, Int
from meshmatch.models.encoder import BasisEncoder, PointEncoder
from meshmatch.training.scans import (
    ScanConfig,
    bump,
    normalise,
    random_rotations,
    rigid_fit,
    sample_scan,
    small_rotations,
    yaw_rotations,
)

# Draws shapes with the template's connectivity: (count, generator) -> vertices (count, V, 3), any unit.
Source = Callable[[int, torch.Generator], Float[torch.Tensor, "N V 3"]]


def registered_source(shapes: Float[torch.Tensor, "N V 3"]) -> Source:
    """A fixed set of registered shapes, drawn with replacement."""
    shapes = shapes - shapes.mean(1, keepdim=True)
    return lambda count, generator: shapes[torch.randint(len(shapes), (count,), generator=generator)]


def step_generator(seed: int, step: int) -> torch.Generator:
    """The random stream of one training step. A large odd multiplier keeps those of different seeds apart."""
    return torch.Generator().manual_seed((seed * 2_654_435_761 + step) % (2**63))


@dataclass(frozen=True, eq=False)
class Batch:
    """One training batch; lengths in units of sqrt(surface area).

    points : scan in a roughly right core frame
    targets : where the template's loss points belong, same frame
    encode_features : what the encoder reads of ``points``
    align_features, align_rotation, align_center : the aligner's input (any turn) and answer
    """

    points: Float[torch.Tensor, "B P 3"]
    targets: Float[torch.Tensor, "B M 3"]
    encode_features: torch.Tensor
    align_features: torch.Tensor | None = None
    align_rotation: Float[torch.Tensor, "B 3 3"] | None = None
    align_center: Float[torch.Tensor, "B 3"] | None = None

    def to(self, device: torch.device) -> Batch:
        return replace(self, **{n: v.to(device) for n, v in vars(self).items() if v is not None})


@dataclass(frozen=True, eq=False)
class BatchDataset(torch.utils.data.Dataset):
    """Item s is the batch of training step s.

    Attributes
    ----------
    template_core : template vertices of the core, template frame; core : their indices
    loss_points : vertex indices that are supervised
    scans_per_shape : each drawn shape is scanned this many times
    """

    source: Source
    faces: Int[torch.Tensor, "F 3"]
    template_core: Float[torch.Tensor, "C 3"]
    core: Int[torch.Tensor, " C"]
    loss_points: Int[torch.Tensor, " M"]
    encoder: BasisEncoder | PointEncoder
    aligner: BasisEncoder | None
    scan: ScanConfig
    shapes: int = 32
    scans_per_shape: int = 2
    seed: int = 0
    length: int = 1

    def __len__(self) -> int:
        return self.length

    @torch.no_grad()
    def __getitem__(self, step: int) -> Batch:
        generator = step_generator(self.seed, step)
        verts = self.source(self.shapes, generator)
        scale = verts.flatten(1).std(1)[:, None, None]
        verts = bump(verts / scale * 0.3, self.scan.bumps, generator)
        verts, areas = normalise(verts, self.faces)
        if self.scans_per_shape > 1:
            verts = verts.repeat_interleave(self.scans_per_shape, 0)
            areas = areas.repeat_interleave(self.scans_per_shape, 0)
        B = len(verts)
        size = 1 + self.scan.scale * torch.randn(B, 1, 1, generator=generator).clamp(-2, 2)
        verts = verts * size
        points = sample_scan(verts, areas, self.faces, self.scan, generator)
        R, t = rigid_fit(self.template_core, verts[:, self.core])

        # The roughly right frame in which the encoder works: x_core = S R^T (x - t) + shift.
        if self.scan.upright:
            t = points.mean(1)
            turn, shift = yaw_rotations(B, generator), torch.zeros(B, 1, 3)
        else:
            turn = small_rotations(B, generator) @ R.transpose(1, 2)
            shift = 0.03 * torch.randn(B, 1, 3, generator=generator)
        in_core = (points - t[:, None]) @ turn.transpose(1, 2) + shift
        targets = (verts[:, self.loss_points] - t[:, None]) @ turn.transpose(1, 2) + shift
        features = self.encoder.features(in_core)
        if self.aligner is None:
            return Batch(in_core, targets, features)
        # The aligner sees the scan centred on its own points and turned anywhere.
        middle = points.mean(1, keepdim=True)
        anywhere = random_rotations(B, generator)
        turned = (points - middle) @ anywhere.transpose(1, 2)
        center = (anywhere @ (t - middle[:, 0])[..., None])[..., 0]
        return Batch(in_core, targets, features, self.aligner.features(turned), anywhere @ R, center)
