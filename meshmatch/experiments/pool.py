"""Shapes to learn from, drawn once for all cells, and shapes that no cell learns from.

Simulating a scan costs several times what learning from it does in a small network. So a fixed number of shapes is
scanned a few times each beforehand, and a cell that has fewer shapes has the first ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import torch

from meshmatch.experiments.cells import BASE, Cell, Setting
from meshmatch.models.encoder import BasisEncoder, PointEncoder
from meshmatch.training.datasets import Batch, Source
from meshmatch.training.setup import build_dataset, build_deformer

SCANS = 4
"""How often each shape is scanned."""

HELD_OUT = 64
_BLOCK = 50
_SEED, _UNSEEN = 17, 999_983


@dataclass(frozen=True, eq=False)
class Pool:
    """Scans of N shapes, `SCANS` each, one after the other.

    points : (N, P, 3) scans; without points (P = 0) where all that is read of them is in the features
    features : (N, M, 3), or of a network that reads the points themselves (N, 0, 3)
    targets : (N, 1000, 3) where the template's loss points belong
    basis : (M, 3) basis points of every cell's encoder, whose features these are
    held_out : a batch of shapes that no cell learns from
    source : draws such shapes as there are in the pool
    """

    points: torch.Tensor
    features: torch.Tensor
    targets: torch.Tensor
    basis: torch.Tensor
    held_out: Batch
    source: Source

    def batch(
        self, step: int, count: int, shapes: int, seed: int, encoder: BasisEncoder | PointEncoder
    ) -> Batch:
        """The batch of a step, of the scans of the first ``shapes``: a function of its arguments."""
        generator = torch.Generator().manual_seed((seed * 2_654_435_761 + step) % (2**63))
        most = min(shapes * SCANS, len(self.targets))
        chosen = torch.randint(most, (count,), generator=generator)
        points = self.points[chosen]
        features = self.features[chosen] if self.features.shape[1] else encoder.features(points)
        return Batch(points, self.targets[chosen], features)


def pool_of(setting: Setting, pose: str, shapes: int = BASE.shapes) -> Pool:
    """The pool of a template pose, drawn once in a process."""
    return _drawn(setting, pose, shapes)


@lru_cache(maxsize=3)
def _drawn(setting: Setting, pose: str, shapes: int) -> Pool:
    cell = Cell(pose=pose)
    template, recipe = setting.resting(pose), setting.recipe(cell)
    source, unseen = setting.sources(pose)
    generator = torch.Generator().manual_seed(_SEED)
    drawn = torch.cat([source(min(_BLOCK, shapes - at), generator) for at in range(0, shapes, _BLOCK)])

    def some(count: int, generator: torch.Generator) -> torch.Tensor:
        return drawn[torch.randint(len(drawn), (count,), generator=generator)]

    model = build_deformer(template, some, recipe.network, recipe.scan, recipe.kernel, _SEED)
    data = build_dataset(template, some, model, recipe.scan, _BLOCK, SCANS, _SEED)
    reads = recipe.network.encoder == "point"
    blocks = []
    for number, block in enumerate(drawn.split(_BLOCK)):
        batch = replace(data, source=lambda *_, block=block: block, shapes=len(block))[number]
        none = torch.zeros(len(batch.points), 0, 3)
        features = none if reads else batch.encode_features
        blocks.append((batch.points if reads else none, features, batch.targets))
    points, features, targets = (torch.cat(part) for part in zip(*blocks, strict=True))
    held_out = replace(data, source=unseen, shapes=HELD_OUT, scans_per_shape=1, seed=_UNSEEN)[0]
    encoder = model.encoder
    basis = encoder.basis.clone() if isinstance(encoder, BasisEncoder) else torch.zeros(1, 3)
    return Pool(points, features, targets, basis, held_out, some)
