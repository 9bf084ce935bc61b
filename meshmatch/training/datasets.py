"""Training batches without state: batch s is a function of (seed, s), which makes resuming exact.

`BatchDataset` simulates scans of registered shapes. `CloudDataset` has samples of shapes without correspondence, and
augments them with smooth deformations, small rotations, scaling and noise.
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
from meshmatch.generators.generator import Source, draw_any
from meshmatch.models.layers import BasisEncoder, Encoder
from meshmatch.progress import Progress
from meshmatch.templates.prepared_folder import ShapeSamples
from meshmatch.training import scans
from meshmatch.training.scans import ScanConfig, small_rotations

DEFORM = 0.08
"""Standard deviation of the node vectors of the coarse lattice that deforms shapes smoothly, units of sqrt(area)."""
_UNDEFORMED_SHARE = 0.25  # share of shapes that are not deformed; this and `DEFORM` are set by hand
_SIDE = 4  # nodes of the lattice along each axis; this and the radius are set by hand
_NODE_RADIUS = 1.9  # radius of a lattice node, in spacings
_BLOCK = 50  # shapes drawn at a time
_MAX_POINTS = 400_000  # data sets with more points need no deformation, and get no lattice


def registered_source(shapes: Float[Tensor, "N V 3"]) -> Source:
    """Source that draws from a fixed set of registered shapes with replacement."""
    return partial(draw_any, shapes - shapes.mean(1, keepdim=True))


def fixed_pool(source: Source, count: int, seed: int, progress: Progress) -> Source:
    """Source that draws, with replacement, from the first ``count`` shapes of another source."""
    generator, blocks = torch.Generator().manual_seed(seed), []
    for start in range(0, count, _BLOCK):
        blocks.append(source(min(_BLOCK, count - start), generator))
        progress(min(1.0, (start + _BLOCK) / count))
    return registered_source(torch.cat(blocks))


def step_generator(seed: int, step: int, device: torch.device | str = "cpu") -> torch.Generator:
    """Random generator of one training step. A large odd multiplier separates the streams of different seeds.

    Different kinds of device give different random numbers.
    """
    return torch.Generator(device).manual_seed((seed * 2_654_435_761 + step) % (2**63))


class OnDevice:
    """Base of dataclasses of tensors that can be moved to a device."""

    def to(self, device: torch.device) -> Self:
        return type(self)(**{n: v if v is None else v.to(device) for n, v in vars(self).items()})


@dataclass(frozen=True, eq=False)
class Batch(OnDevice):
    """A batch of B scans with their supervision.

    ``points`` are approximately in the core frame, in units of sqrt(surface area); ``targets`` are the correct places of the
    template's loss points in the same frame; ``encode_features`` are the encoder's features of ``points``. The aligner's
    input is the scan in a random orientation, and ``align_rotation`` and ``align_center`` are the expected answer.
    """

    points: Float[Tensor, "B P 3"]
    targets: Float[Tensor, "B M 3"]
    encode_features: Tensor
    align_features: Tensor | None = None
    align_rotation: Float[Tensor, "B 3 3"] | None = None
    align_center: Float[Tensor, "B 3"] | None = None


@dataclass(frozen=True, eq=False)
class BatchDataset(torch.utils.data.Dataset[Batch]):
    """Simulated scans of registered shapes. Item s is the batch of step s, drawn on the CPU; see `training.batches`.

    ``template_core`` are the template's core vertices, ``core`` their indices; ``loss_points`` are the indices of the
    supervised vertices. Each drawn shape is scaled to ``radius``, or to area 1, and scanned ``scans_per_shape`` times.
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
    def draw_shapes(self, generator: torch.Generator) -> Float[Tensor, "N V 3"]:
        """Draw shapes from the source and check them.

        They are not checked on a GPU, where only meshmatch's own sources draw.
        """
        if not callable(self.source):
            hint = "see docs/training.md for custom sources"
            raise InputError(f"a source is a function that draws shapes, not {type(self.source).__name__}", hint)
        shapes = self.source(self.shapes, generator)
        return (
            shapes if self.faces.device.type != "cpu" else _check_shapes(shapes, self.shapes, int(self.faces.max()) + 1)
        )

    @torch.no_grad()
    def batch(self, generator: torch.Generator, verts: Float[Tensor, "N V 3"] | None = None) -> Batch:
        """Batch for a random stream, on the dataset's device; shapes are drawn unless ``verts`` are given."""
        verts = self.draw_shapes(generator) if verts is None else verts
        scale = verts.flatten(1).std(1)[:, None, None]
        verts = scans.bump(verts / scale * 0.3, self.scan.bumps, generator)
        verts, areas = scans.normalise(verts, self.faces)
        if self.radius is not None:
            verts = verts * (self.radius / verts.norm(dim=-1).amax(1))[:, None, None]
        verts, areas = (table.repeat_interleave(self.scans_per_shape, 0) for table in (verts, areas))
        B = len(verts)
        verts = verts * (1 + self.scan.scale * torch.randn(B, 1, 1, generator=generator).clamp(-2, 2))
        areas, factor, foreign = self._clutter(verts, areas, generator)
        verts = verts * factor
        points = scans.sample_scan(verts, areas, self.faces, self.scan, generator)
        if self.scan.strays:
            is_foreign = torch.rand(points.shape[:2], generator=generator)[..., None] < foreign
            points = torch.where(is_foreign, scans.stray_points(verts, points.shape[1], generator), points)
        R, t = scans.rigid_fit(self.template_core, verts[:, self.core])
        # The approximate core frame in which the encoder works: x_core = S R^T (x - t) + shift.
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
        # The aligner sees the scan centred on its own points, in a random orientation.
        middle = points.mean(1, keepdim=True)
        orientation = scans.random_rotations(B, generator)
        rotated = (points - middle) @ orientation.transpose(1, 2)
        center = (orientation @ (t - middle[:, 0])[..., None])[..., 0]
        return Batch(in_core, targets, features, self.aligner.features(rotated), orientation @ R, center)

    def _clutter(
        self, verts: Tensor, areas: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Float[Tensor, "B 1 1"]]:
        """Simulate hidden surfaces and foreign objects in scans that have a total area of 1.

        Returns face areas, nearly 0 where a scan does not show the face; the factor that scales each shape to its share of
        the total area; and the share of each scan that is foreign objects.
        """
        B, scan = len(verts), self.scan
        foreign = torch.zeros(B, 1, 1)
        if scan.outside:
            shows_outside = torch.rand(B, generator=generator) < scan.outside
            # On a GPU it is faster to process all shapes than to wait for the indices of the chosen ones.
            at = torch.nonzero(shows_outside)[:, 0] if areas.device.type == "cpu" else torch.arange(B)
            is_visible = scans.seen_from_outside(verts[at], self.faces, generator) | ~shows_outside[at, None]
            areas = areas.index_copy(0, at, areas[at] * torch.where(is_visible, 1.0, 1e-3))
        if scan.strays:
            foreign = 0.3 * torch.rand(B, 1, 1, generator=generator)
            foreign = foreign * (torch.rand(B, 1, 1, generator=generator) < scan.strays)
        shown = areas.sum(1)[:, None, None]
        return areas, ((1 - foreign) / shown).sqrt(), foreign


def _check_shapes(drawn: Any, count: int, V: int) -> Float[Tensor, "N V 3"]:
    """Convert what a source returned to float32; `InputError` if it is not ``count`` shapes of at least V vertices."""
    try:
        verts: Tensor = torch.as_tensor(drawn).float()
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"a source must return vertices, not {type(drawn).__name__}", "return a tensor") from error
    if verts.ndim != 3 or len(verts) != count or verts.shape[1] < V or verts.shape[2] != 3:
        expected = f"({count}, V, 3) with the template's vertices"
        raise InputError(f"a source must return vertices {expected}, not {tuple(verts.shape)}", "return `count` shapes")
    if not verts.isfinite().all():
        raise InputError("a source returned vertices that are nan or infinite", "check the shapes that it draws")
    if not (verts.amax(1) > verts.amin(1)).any(1).all():
        raise InputError(
            "a source returned a shape whose vertices are all in one place", "check the shapes that it draws"
        )
    return verts


@dataclass(frozen=True, eq=False)
class Lattice:
    """Shape functions of a coarse lattice of L nodes at the P samples of N shapes, their gradients, and at M landmarks."""

    phi: Float[Tensor, "N P L"]
    gradient: Float[Tensor, "N P 3 L"]
    landmark_phi: Float[Tensor, "N M L"]


@dataclass(frozen=True, eq=False)
class CloudBatch(OnDevice):
    """A batch of B shapes without correspondence, approximately in the template's frame; missing landmarks are NaN."""

    points: Float[Tensor, "B P 3"]
    normals: Float[Tensor, "B P 3"]
    landmarks: Float[Tensor, "B L 3"]
    encode_features: Tensor


def build_lattice(samples: ShapeSamples) -> Lattice | None:
    """Build a lattice around all shapes, with its field at their samples; None if there are more than `_MAX_POINTS`."""
    N, P, _ = samples.points.shape
    if N * P > _MAX_POINTS:
        return None
    landmarks = np.nan_to_num(samples.landmarks)
    field = _lattice_field(np.concatenate([samples.points.reshape(-1, 3), landmarks.reshape(-1, 3)]).astype(np.float64))
    phi, gradient = field.phi.to_dense(), field.gradient.to_dense()[: 3 * N * P]
    on_landmarks = phi[N * P :].reshape(N, landmarks.shape[1], field.K)
    return Lattice(phi[: N * P].reshape(N, P, -1), gradient.reshape(N, P, 3, -1), on_landmarks)


def _lattice_field(points: Float[Floats, "N 3"]) -> Field:
    """Field at the points, of a coarse lattice of nodes that encloses them."""
    low, high = points.min(0), points.max(0)
    middle, half = 0.5 * (low + high), 0.55 * float((high - low).max())
    ticks = np.linspace(-half, half, _SIDE)
    lattice = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3) + middle
    return Field.of(build_field(points, lattice, _NODE_RADIUS * float(ticks[1] - ticks[0]), "smooth"))


def lattice_vectors(deform: float, B: int, L: int, generator: torch.Generator) -> Float[Tensor, "B L 3"]:
    """Random node vectors of a lattice for a batch of shapes; their magnitude varies from shape to shape."""
    size = deform * torch.rand(B, 1, 1, generator=generator)
    size = size * (torch.rand(B, 1, 1, generator=generator) >= _UNDEFORMED_SHARE)
    return size * torch.randn(B, L, 3, generator=generator)


def deformed_source(shapes: Float[Tensor, "N V 3"], deform: float = DEFORM) -> Source:
    """Source that draws registered shapes with replacement and deforms them smoothly.

    All shapes have the same orientation, in any unit. Large sets (see `build_lattice`) are not deformed.
    """
    N, V, _ = shapes.shape
    if N * V > _MAX_POINTS or deform <= 0:
        return registered_source(shapes)
    shapes = shapes - shapes.mean(1, keepdim=True)
    shapes = 0.3 * shapes / shapes.flatten(1).std(1)[:, None, None]  # about area 1
    phi = _lattice_field(shapes.reshape(-1, 3).double().numpy()).phi.to_dense().reshape(N, V, -1)
    return partial(_draw_deformed, shapes, phi, deform)


def _draw_deformed(
    shapes: Float[Tensor, "N V 3"], phi: Float[Tensor, "N V L"], deform: float, count: int, generator: torch.Generator
) -> Float[Tensor, "B V 3"]:
    which = torch.randint(len(shapes), (count,), generator=generator)
    return shapes[which] + phi[which] @ lattice_vectors(deform, count, phi.shape[2], generator)


@dataclass(frozen=True, eq=False)
class CloudDataset(torch.utils.data.Dataset[CloudBatch]):
    """Augmented samples of shapes without correspondence. Item s is the batch of training step s."""

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
        """Batch for a random stream, on the dataset's device."""
        N, total, _ = self.points.shape
        # Within a batch every shape is drawn once before any is repeated.
        order = [torch.randperm(N, generator=generator) for _ in range(-(-self.shapes // N))]
        which = torch.cat(order)[: self.shapes]
        P = min(self.scan.points, total)
        pick = torch.stack([torch.randperm(total, generator=generator)[:P] for _ in which])
        rows = which[:, None]
        points, normals, landmarks = self.points[rows, pick], self.normals[rows, pick], self.landmarks[which]
        B = len(which)
        if self.lattice is not None and self.deform > 0:
            vectors = lattice_vectors(self.deform, B, self.lattice.phi.shape[2], generator)
            points = points + self.lattice.phi[rows, pick] @ vectors
            landmarks = landmarks + self.lattice.landmark_phi[which] @ vectors
            slopes = self.lattice.gradient[rows, pick] @ vectors[:, None]  # (B, P, k, a): d u_a / d x_k
            normals = deformed_normals(slopes.transpose(-1, -2) + torch.eye(3), normals)
        turn = small_rotations(B, generator)
        size = 1 + self.scan.scale * torch.randn(B, 1, 1, generator=generator).clamp(-2, 2)
        shift = 0.02 * torch.randn(B, 1, 3, generator=generator)
        points = size * points @ turn.transpose(1, 2) + shift
        landmarks = size * landmarks @ turn.transpose(1, 2) + shift
        normals = normals @ turn.transpose(1, 2)
        sigma = self.scan.noise * torch.rand(B, 1, 1, generator=generator) ** 3
        points = points + sigma * torch.randn(B, P, 3, generator=generator)
        features = torch.zeros(B, 0) if self.encoder is None else self.encoder.features(points)
        return CloudBatch(points, normals, landmarks, features)


def deformed_normals(F: Float[Tensor, "*B 3 3"], normals: Float[Tensor, "*#B 3"]) -> Float[Tensor, "*B 3"]:
    """Unit normals after a deformation with gradient F, by the cofactor matrix of F."""
    a, b, c = F.unbind(-1)  # columns
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)
    return torch.nn.functional.normalize((cofactors @ normals[..., None])[..., 0], dim=-1)
