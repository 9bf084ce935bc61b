"""Training losses: an `Objective` holds the weights of its terms and computes them for a batch.

A custom loss is a subclass of `Objective` in a recipe. `CorrespondenceLoss` needs the place of every template point on the
shape. `ChamferLoss` does not: it has a robust Chamfer distance, the paper's regularisers and optional landmarks.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from meshmatch.arrays import Float
from meshmatch.fields.field import PointField, arap_energy, volume_energy
from meshmatch.models.deformer import Deformer
from meshmatch.models.layers import nearest_index
from meshmatch.training.datasets import Batch, CloudBatch, OnDevice, deformed_normals

Terms = dict[str, Tensor]
NORMAL_WEIGHT = 0.15
"""Weight of normals in the search for nearest points: the distance that a unit difference of normals counts as, in units of
sqrt(area); set by hand."""
_ROBUST = 0.25  # scale of the robust loss, units of sqrt(area): it saturates at larger distances; set by hand


@dataclass(frozen=True, eq=False)
class LossPoints(OnDevice):
    """The supervised template points (M, 3) and the field there, with its gradient on the first G of them."""

    positions: Float[Tensor, "M 3"]
    field: PointField

    def moved(self, rows: Float[Tensor, "B R 3"]) -> Float[Tensor, "B M 3"]:
        """Deformed positions of the points, for the decoder's outputs of B shapes."""
        return self.positions + self.field.displacement(rows)


@dataclass(frozen=True)
class Objective(ABC):
    """Base class of losses: the paper's weights l1 to l4 (with its defaults for registered bodies), and of the corrections.

    ``reconstruction``, ``volume``, ``arap`` and ``blend`` are l1 to l4; ``blend`` weights volume and rigidity of blends of
    two codes. ``correct`` weights the learned corrections, which see the first ``correct_points`` points of a scan.
    """

    needs_correspondence: ClassVar[bool] = True  # whether shapes must be registered
    reconstruction: float = 1.0
    volume: float = 5e-3
    arap: float = 1e-2
    blend: float = 5e-3
    correct: float = 1.0
    correct_points: int = 1024

    @abstractmethod
    def __call__(self, model: Deformer, batch: Any, points: Any, generator: torch.Generator | None) -> Terms:
        """Return weighted terms by name, and their sum as ``total``; unweighted errors have names that begin with ``error``.

        Random numbers come from the generator, or from torch's global stream if that is None.
        """

    def rigidity(self, F: Float[Tensor, "B G 3 3"]) -> Terms:
        """Weighted volume and as-rigid-as-possible energies of deformation gradients."""
        return {"volume": self.volume * volume_energy(F).mean(), "arap": self.arap * arap_energy(F).mean()}

    def between(
        self,
        model: Deformer,
        code: Float[Tensor, "B D"],
        shift: int,
        points: LossPoints,
        generator: torch.Generator | None,
    ) -> Terms:
        """Weighted volume and rigidity energies of random blends of each code with the one ``shift`` rows before it."""
        if not self.blend:
            return {}
        share = torch.rand(len(code), 1, generator=generator, device=_device_for(generator, code)).to(code.device)
        F = points.field.deformation_gradient(model.decoder(share * code + (1 - share) * code.roll(shift, 0)))
        return {"blend": self.blend * (volume_energy(F).mean() + arap_energy(F).mean())}


@dataclass(frozen=True)
class CorrespondenceLoss(Objective):
    """Distance of every template point to its known place on the shape.

    ``align`` is the weight of the aligner's rotation and center. ``robust`` takes the mean distance instead of the paper's
    mean squared distance.
    """

    align: float = 0.3
    robust: bool = False

    def __call__(self, model: Deformer, batch: Batch, points: LossPoints, generator: torch.Generator | None) -> Terms:
        code = model.encoder(batch.encode_features)
        rows = model.decoder(code)
        deformed = points.moved(rows)
        fit = distance(deformed, batch.targets)
        squared = (deformed - batch.targets).square().sum(-1).mean()
        terms = {"reconstruction": self.reconstruction * (fit if self.robust else squared)}
        terms |= self._rigidity(points, rows)
        errors = {"error_code": fit.detach()}
        # Blend scans half a batch apart: neighbours are scans of the same shape, whose blends have nothing to teach.
        terms |= self.between(model, code, max(1, len(code) // 2), points, generator)
        if model.corrector is not None:
            scan = batch.points[:, : self.correct_points]
            current = rows.detach()
            steps = []
            for _ in range(model.config.corrections):
                current = model.correct(current, scan)
                steps.append(distance(points.moved(current), batch.targets))
                errors["error_corrected"] = steps[-1].detach()
                stiff = list(self._rigidity(points, current).values())
                steps += [stiff[0] + stiff[1]] if stiff else []
                current = current.detach()
            terms["correct"] = self.correct * torch.stack(steps).sum()
        if model.aligner is not None:
            assert batch.align_features is not None and batch.align_rotation is not None
            assert batch.align_center is not None
            R, t = model.align(batch.align_features)
            turn = (R - batch.align_rotation).square().sum((1, 2)).clamp_min(1e-12).sqrt().mean()
            terms["align"] = self.align * (turn + 3 * distance(t, batch.align_center))
            errors["error_align"] = turn.detach()
        return {"total": torch.stack(list(terms.values())).sum(), **terms, **errors}

    def _rigidity(self, points: LossPoints, rows: Tensor) -> Terms:
        if not self.volume and not self.arap:
            return {}  # do not compute the gradient if both weights are zero
        return self.rigidity(points.field.deformation_gradient(rows))


def _device_for(generator: torch.Generator | None, like: Tensor) -> torch.device:
    return like.device if generator is None else generator.device


def distance(a: Float[Tensor, "*N 3"], b: Float[Tensor, "*N 3"]) -> Float[Tensor, ""]:
    """Mean Euclidean distance of corresponding points."""
    return ((a - b).square().sum(-1) + 1e-8).sqrt().mean()


@dataclass(frozen=True, eq=False)
class SurfacePoints(LossPoints):
    """Supervised template points with unit normals (M, 3), and the template's landmarks (L, 3) with the field there."""

    normals: Float[Tensor, "M 3"]
    landmarks: Float[Tensor, "L 3"]
    landmark_field: PointField


@dataclass(frozen=True)
class ChamferLoss(Objective):
    """Symmetric Chamfer distance between template and shape.

    Nearest points are found by position and normal, and the distance is robust, so that far points pull less. With ``plain``
    they are found by position only, and the distance is squared, as in the paper. ``landmarks`` is the weight of the squared
    distances of landmarks.
    """

    needs_correspondence: ClassVar[bool] = False
    landmarks: float = 1.0
    plain: bool = False

    def __call__(
        self, model: Deformer, batch: CloudBatch, points: SurfacePoints, generator: torch.Generator | None
    ) -> Terms:
        code = model.encoder(batch.encode_features)
        rows = model.decoder(code)
        terms, fit = self._energies(rows, batch, points)
        # Neighbours in a batch are different shapes: each is drawn once before any is repeated.
        terms |= self.between(model, code, 1, points, generator)
        if model.corrector is not None:
            current = rows.detach()
            correct: Tensor | float = 0.0
            for _ in range(model.config.corrections):
                current = model.correct(current, batch.points[:, : self.correct_points])
                again, fit = self._energies(current, batch, points)
                correct = correct + self.correct * torch.stack(list(again.values())).sum()
                current = current.detach()
            assert isinstance(correct, Tensor)
            terms["correct"] = correct
        return {"total": torch.stack(list(terms.values())).sum(), **terms, "error": fit}

    def _energies(
        self, rows: Float[Tensor, "B R 3"], batch: CloudBatch, points: SurfacePoints
    ) -> tuple[Terms, Float[Tensor, ""]]:
        """Weighted terms for the decoder's outputs, and the mean distance in both directions."""
        deformed = points.moved(rows)
        F = points.field.deformation_gradient(rows)
        normals = deformed_normals(F.detach(), points.normals)
        share = 0.0 if self.plain else 1.0
        to_shape, to_template = chamfer(deformed, share * normals, batch.points, share * batch.normals)
        penalty = torch.Tensor.float if self.plain else robust
        terms = {"reconstruction": self.reconstruction * (penalty(to_shape).mean() + penalty(to_template).mean())}
        terms |= self.rigidity(F)
        has_landmark = ~batch.landmarks.isnan().any(-1)
        if self.landmarks and has_landmark.any():
            placed = points.landmarks + points.landmark_field.displacement(rows)
            squared = (placed[has_landmark] - batch.landmarks[has_landmark]).square().sum(-1)
            terms["landmarks"] = self.landmarks * squared.mean()
        with torch.no_grad():
            fit = 0.5 * ((to_shape + 1e-12).sqrt().mean() + (to_template + 1e-12).sqrt().mean())
        return terms, fit


def chamfer(
    deformed: Float[Tensor, "B M 3"],
    normals: Float[Tensor, "B M 3"],
    points: Float[Tensor, "B P 3"],
    point_normals: Float[Tensor, "B P 3"],
) -> tuple[Float[Tensor, "B M"], Float[Tensor, "B P"]]:
    """Squared distances of ``deformed`` to the nearest of ``points``, and of ``points`` to the nearest of ``deformed``.

    Nearest points are found by position and weighted normal. The distances are those of positions only, and have gradients
    with respect to ``deformed``.
    """
    with torch.no_grad():
        deformed_features = torch.cat([deformed, NORMAL_WEIGHT * normals], -1).float()
        point_features = torch.cat([points, NORMAL_WEIGHT * point_normals], -1).float()
        nearest_point, nearest_moved = (
            nearest_index(deformed_features, point_features),
            nearest_index(point_features, deformed_features),
        )
    nearest_position = torch.gather(points, 1, nearest_point[..., None].expand(-1, -1, 3))
    nearest_deformed = torch.gather(deformed, 1, nearest_moved[..., None].expand(-1, -1, 3))
    return (deformed - nearest_position).square().sum(-1), (nearest_deformed - points).square().sum(-1)


def robust(squared: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Geman-McClure loss of squared distances: d^2 / (1 + d^2 / s^2), which is close to d^2 for small d."""
    return squared / (1 + squared / _ROBUST**2)


@torch.no_grad()
def held_out_error(model: Deformer, batch: Batch | CloudBatch, points: LossPoints) -> float:
    """Mean distance on held-out shapes after the learned corrections, units of sqrt(area).

    With correspondence this is the distance of template points from their correct places, without it the mean distance of
    nearest points in both directions.
    """
    was_training = model.training
    model.eval()
    batch = batch.to(points.positions.device)
    if isinstance(batch, Batch):
        error = distance(points.moved(model(batch.points)), batch.targets)
    else:
        assert isinstance(points, SurfacePoints)
        error = ChamferLoss(blend=0.0)(model, batch, points, torch.Generator())["error"]
    model.train(was_training)
    return float(error)
