"""Training batches, drawn statelessly: batch s is a function of (seed, s), which makes resuming exact.

Registered shapes are scanned (`BatchDataset`); shapes without correspondence are known by samples (`CloudDataset`), which
are smoothly deformed, a little turned, scaled and roughened.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats, Int
from meshmatch.errors import InputError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import build_field
from meshmatch.generators.generator import Source, any_of
from meshmatch.models.layers import BasisEncoder, Encoder
from meshmatch.progress import Progress
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.training import scans
from meshmatch.training.scans import ScanConfig, small_rotations

DEFORM = 0.08
"""Standard deviation of the vectors of a coarse lattice, whose field deforms a shape smoothly, units of sqrt(area)."""
_PLAIN = 0.25  # of the shapes are not deformed; this and `DEFORM` are set by hand
_SIDE = 4  # nodes of the lattice along each axis; this and the reach are set by hand
_REACH = 1.9  # of a lattice node, in spacings
_BLOCK = 50  # shapes that are drawn at a time
_MAX_POINTS = 400_000  # for which a lattice is kept ready; with more shapes there is no need to deform them


def registered_source(shapes: Float[Tensor, "N V 3"]) -> Source:
    """A fixed set of registered shapes, drawn with replacement."""
    return partial(any_of, shapes - shapes.mean(1, keepdim=True))


def drawn_once(source: Source, count: int, seed: int, progress: Progress) -> Source:
    """The first ``count`` shapes that a source draws, and no others."""
    generator, blocks = torch.Generator().manual_seed(seed), []
    for start in range(0, count, _BLOCK):
        blocks.append(source(min(_BLOCK, count - start), generator))
        progress(min(1.0, (start + _BLOCK) / count))
    return registered_source(torch.cat(blocks))


def step_generator(seed: int, step: int, device: torch.device | str = "cpu") -> torch.Generator:
    """The random stream of one training step. A large odd multiplier keeps those of different seeds apart.

    Every sort of device has streams of its own.
    """
    return torch.Generator(device).manual_seed((seed * 2_654_435_761 + step) % (2**63))


class OnDevice:
    """Dataclasses of tensors."""

    def to(self, device: torch.device) -> Self:
        return type(self)(**{n: v if v is None else v.to(device) for n, v in vars(self).items()})


@dataclass(frozen=True, eq=False)
class Batch(OnDevice):
    """Scans in a roughly right core frame, lengths in units of sqrt(surface area); where the template's loss points belong
    in it; what the encoder reads of ``points``; and the aligner's input (any turn) and answer."""

    points: Float[Tensor, "B P 3"]
    targets: Float[Tensor, "B M 3"]
    encode_features: Tensor
    align_features: Tensor | None = None
    align_rotation: Float[Tensor, "B 3 3"] | None = None
    align_center: Float[Tensor, "B 3"] | None = None


@dataclass(frozen=True, eq=False)
class BatchDataset(torch.utils.data.Dataset[Batch]):
    """Item s is the batch of training step s, drawn on the CPU; see `training.batches` for other devices.

    ``template_core`` are the template's vertices of the core, ``core`` their indices; ``loss_points`` the indices of
    supervised vertices. Each drawn shape is scanned ``scans_per_shape`` times, and scaled to ``radius`` or to area 1.
    """

    source: Source
    faces: Int[Tensor, "F 3"]
    template_core: Float[Tensor, "C 3"]
    core: Int[Tensor, " C"]
    loss_points: Int[Tensor, " M"]
    encoder: Encoder | None
    aligner: BasisEncoder | None
    scan: ScanConfig
    shapes: int = 32
    scans_per_shape: int = 2
    seed: int = 0
    length: int = 1
    radius: float | None = None

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, step: int) -> Batch:
        return self.batch(step_generator(self.seed, step))

    @torch.no_grad()
    def drawn(self, generator: torch.Generator) -> Float[Tensor, "N V 3"]:
        """Shapes of the source, which is ours if it draws on a GPU, and looked at nowhere else."""
        if not callable(self.source):
            hint = "docs/training.md has one of your own"
            raise InputError(f"a source is a function that draws shapes, not {type(self.source).__name__}", hint)
        found = self.source(self.shapes, generator)
        return found if self.faces.device.type != "cpu" else _checked(found, self.shapes, int(self.faces.max()) + 1)

    @torch.no_grad()
    def batch(self, generator: torch.Generator, verts: Float[Tensor, "N V 3"] | None = None) -> Batch:
        """The batch of a random stream, of shapes that it draws or of given ones, where the tensors of this are."""
        verts = self.drawn(generator) if verts is None else verts
        scale = verts.flatten(1).std(1)[:, None, None]
        verts = scans.bump(verts / scale * 0.3, self.scan.bumps, generator)
        verts, areas = scans.normalise(verts, self.faces)
        if self.radius is not None:
            verts = verts * (self.radius / verts.norm(dim=-1).amax(1))[:, None, None]
        verts, areas = (table.repeat_interleave(self.scans_per_shape, 0) for table in (verts, areas))
        B = len(verts)
        verts = verts * (1 + self.scan.scale * torch.randn(B, 1, 1, generator=generator).clamp(-2, 2))
        areas, grown, foreign = self._clutter(verts, areas, generator)
        verts = verts * grown
        points = scans.sample_scan(verts, areas, self.faces, self.scan, generator)
        if self.scan.strays:
            strange = torch.rand(points.shape[:2], generator=generator)[..., None] < foreign
            points = torch.where(strange, scans.stray_points(verts, points.shape[1], generator), points)
        R, t = scans.rigid_fit(self.template_core, verts[:, self.core])
        # The roughly right frame in which the encoder works: x_core = S R^T (x - t) + shift.
        if self.scan.upright:
            t = points.mean(1)
            turn = scans.yaw_rotations(B, generator) if self.scan.yaw else torch.eye(3).expand(B, 3, 3)
            shift = torch.zeros(B, 1, 3)
        else:
            turn = small_rotations(B, generator) @ R.transpose(1, 2)
            shift = 0.03 * torch.randn(B, 1, 3, generator=generator)
        in_core = (points - t[:, None]) @ turn.transpose(1, 2) + shift
        targets = (verts[:, self.loss_points] - t[:, None]) @ turn.transpose(1, 2) + shift
        features = torch.zeros(B, 0) if self.encoder is None else self.encoder.features(in_core)
        if self.aligner is None:
            return Batch(in_core, targets, features)
        # The aligner sees the scan centred on its own points and turned anywhere.
        middle = points.mean(1, keepdim=True)
        anywhere = scans.random_rotations(B, generator)
        turned = (points - middle) @ anywhere.transpose(1, 2)
        center = (anywhere @ (t - middle[:, 0])[..., None])[..., 0]
        return Batch(in_core, targets, features, self.aligner.features(turned), anywhere @ R, center)

    def _clutter(
        self, verts: Tensor, areas: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Float[Tensor, "B 1 1"]]:
        """Areas of faces without those that scans do not show; the factor by which shapes then are larger, and with things
        beside them smaller, at the same total area; and which share of each scan is such things."""
        B, scan = len(verts), self.scan
        foreign = torch.zeros(B, 1, 1)
        if scan.outside:
            chosen = torch.rand(B, generator=generator) < scan.outside
            # a GPU sooner looks at all than that somebody waits until it knows which
            at = torch.nonzero(chosen)[:, 0] if areas.device.type == "cpu" else torch.arange(B)
            seen = scans.seen_from_outside(verts[at], self.faces, generator) | ~chosen[at, None]
            areas = areas.index_copy(0, at, areas[at] * torch.where(seen, 1.0, 1e-3))
        if scan.strays:
            foreign = 0.3 * torch.rand(B, 1, 1, generator=generator)
            foreign = foreign * (torch.rand(B, 1, 1, generator=generator) < scan.strays)
        shown = areas.sum(1)[:, None, None]
        return areas, ((1 - foreign) / shown).sqrt(), foreign


def _checked(found: Any, count: int, V: int) -> Float[Tensor, "N V 3"]:
    """What a source drew, in float32; `InputError` if these are not so many shapes of at least V vertices."""
    try:
        verts: Tensor = torch.as_tensor(found).float()
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"a source must give vertices, not {type(found).__name__}", "it returns a tensor") from error
    if verts.ndim != 3 or len(verts) != count or verts.shape[1] < V or verts.shape[2] != 3:
        wanted = f"({count}, V, 3) with the template's vertices"
        raise InputError(
            f"a source must give vertices {wanted}, not {tuple(verts.shape)}", "it is asked for `count` shapes"
        )
    if not verts.isfinite().all():
        raise InputError("a source gave vertices that are nan or infinite", "look at the shapes that it draws")
    if not (verts.amax(1) > verts.amin(1)).any(1).all():
        raise InputError("a source gave a shape whose vertices are all in one place", "look at what it draws")
    return verts


@dataclass(frozen=True, eq=False)
class Lattice:
    """A coarse field on every sample of N shapes, its gradient there, and the field on their landmarks."""

    phi: Float[Tensor, "N P L"]
    gradient: Float[Tensor, "N P 3 L"]
    landmark_phi: Float[Tensor, "N M L"]


@dataclass(frozen=True, eq=False)
class CloudBatch(OnDevice):
    """As `Batch`, roughly in the template's frame; landmarks that a shape lacks are NaN."""

    points: Float[Tensor, "B P 3"]
    normals: Float[Tensor, "B P 3"]
    landmarks: Float[Tensor, "B L 3"]
    encode_features: Tensor


def build_lattice(samples: ShapeSamples) -> Lattice | None:
    """A lattice around all shapes and its field on their samples; None where there are so many that none is needed."""
    N, P, _ = samples.points.shape
    if N * P > _MAX_POINTS:
        return None
    known = np.nan_to_num(samples.landmarks)
    field = _lattice_field(np.concatenate([samples.points.reshape(-1, 3), known.reshape(-1, 3)]).astype(np.float64))
    phi, gradient = field.phi.to_dense(), field.gradient.to_dense()[: 3 * N * P]
    on_landmarks = phi[N * P :].reshape(N, known.shape[1], field.K)
    return Lattice(phi[: N * P].reshape(N, P, -1), gradient.reshape(N, P, 3, -1), on_landmarks)


def _lattice_field(points: Float[Floats, "N 3"]) -> Field:
    """The field of a coarse lattice around all points, at them."""
    low, high = points.min(0), points.max(0)
    middle, half = 0.5 * (low + high), 0.55 * float((high - low).max())
    ticks = np.linspace(-half, half, _SIDE)
    lattice = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3) + middle
    return Field.of(build_field(points, lattice, _REACH * float(ticks[1] - ticks[0]), "smooth"))


def lattice_vectors(deform: float, B: int, L: int, generator: torch.Generator) -> Float[Tensor, "B L 3"]:
    """Vectors of a lattice's nodes for a batch of shapes; every shape draws how much of the deformation it gets."""
    size = deform * torch.rand(B, 1, 1, generator=generator)
    size = size * (torch.rand(B, 1, 1, generator=generator) >= _PLAIN)
    return size * torch.randn(B, L, 3, generator=generator)


def deformed_source(shapes: Float[Tensor, "N V 3"], deform: float = DEFORM) -> Source:
    """Registered shapes, drawn with replacement and smoothly deformed; all stand alike, in any unit.

    So many that no change is needed (see `build_lattice`) are drawn as they are.
    """
    N, V, _ = shapes.shape
    if N * V > _MAX_POINTS or deform <= 0:
        return registered_source(shapes)
    shapes = shapes - shapes.mean(1, keepdim=True)
    shapes = 0.3 * shapes / shapes.flatten(1).std(1)[:, None, None]  # about area 1
    phi = _lattice_field(shapes.reshape(-1, 3).double().numpy()).phi.to_dense().reshape(N, V, -1)
    return partial(_deformed, shapes, phi, deform)


def _deformed(
    shapes: Float[Tensor, "N V 3"], phi: Float[Tensor, "N V L"], deform: float, count: int, generator: torch.Generator
) -> Float[Tensor, "B V 3"]:
    which = torch.randint(len(shapes), (count,), generator=generator)
    return shapes[which] + phi[which] @ lattice_vectors(deform, count, phi.shape[2], generator)


@dataclass(frozen=True, eq=False)
class CloudDataset(torch.utils.data.Dataset[CloudBatch]):
    """Item s is the batch of training step s, a function of the seed and s alone."""

    points: Float[Tensor, "N P 3"]
    normals: Float[Tensor, "N P 3"]
    landmarks: Float[Tensor, "N L 3"]
    lattice: Lattice | None
    encoder: Encoder | None
    scan: ScanConfig
    shapes: int = 8
    seed: int = 0
    length: int = 1
    deform: float = DEFORM

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, step: int) -> CloudBatch:
        return self.batch(step_generator(self.seed, step))

    @torch.no_grad()
    def batch(self, generator: torch.Generator) -> CloudBatch:
        """The batch of a random stream, where the tensors of this are."""
        N, total, _ = self.points.shape
        # Every shape once before one comes again, as far as a batch goes.
        order = [torch.randperm(N, generator=generator) for _ in range(-(-self.shapes // N))]
        which = torch.cat(order)[: self.shapes]
        P = min(self.scan.points, total)
        pick = torch.stack([torch.randperm(total, generator=generator)[:P] for _ in which])
        rows = which[:, None]
        points, normals, known = self.points[rows, pick], self.normals[rows, pick], self.landmarks[which]
        B = len(which)
        if self.lattice is not None and self.deform > 0:
            vectors = lattice_vectors(self.deform, B, self.lattice.phi.shape[2], generator)
            points = points + self.lattice.phi[rows, pick] @ vectors
            known = known + self.lattice.landmark_phi[which] @ vectors
            slopes = self.lattice.gradient[rows, pick] @ vectors[:, None]  # B P k a: d u_a / d x_k
            normals = deformed_normals(slopes.transpose(-1, -2) + torch.eye(3), normals)
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


def deformed_normals(F: Float[Tensor, "*B 3 3"], normals: Float[Tensor, "*#B 3"]) -> Float[Tensor, "*B 3"]:
    """Unit normals after a deformation with gradient F: its cofactors on the normals."""
    a, b, c = F.unbind(-1)  # columns
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)
    return torch.nn.functional.normalize((cofactors @ normals[..., None])[..., 0], dim=-1)
