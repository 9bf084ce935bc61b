"""What all ablation runs share: the recipe, templates, and shapes to learn from, drawn once for all runs.

Simulating a scan costs several times what learning from it does in a small network. So a fixed number of shapes is
scanned a few times each beforehand, and a run that has fewer shapes has the first ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from meshmatch.arrays import Float, Int
from meshmatch.errors import TemplateError
from meshmatch.experiments.makers.human_bodies import diameter, heavy
from meshmatch.experiments.paper.ablation_views import BASE, HEAVY, Run
from meshmatch.generators.bodies import human_source
from meshmatch.generators.generator import Source
from meshmatch.models.layers import BasisEncoder, PointEncoder
from meshmatch.models.network import NetworkConfig
from meshmatch.templates.make import NodeConfig, Strategy, lay_nodes
from meshmatch.templates.template import Template, read_template
from meshmatch.training.datasets import Batch
from meshmatch.training.loop import TrainConfig
from meshmatch.training.losses import CorrespondenceLoss
from meshmatch.training.recipes import Recipe, recipe_for
from meshmatch.training.scans import ScanConfig
from meshmatch.training.train import build_dataset, build_deformer

Preset = Literal["small", "default", "paper"]
SCANS = 4
"""How often each shape is scanned."""
HELD_OUT_SHAPES = 64
_BLOCK = 50
_SEED, _UNSEEN = 17, 999_983

SMALL = Recipe(
    NetworkConfig(code=256, width=384, depth=2, basis=512, align_basis=0, corrections=0),
    TrainConfig(
        shapes=32,
        scans_per_shape=1,
        warm_up=20,
        decay=0.6,
        average=0.99,
        workers=0,
        loss=CorrespondenceLoss(volume=2e-3, arap=2e-3, blend=1e-3, robust=True),
    ),
    ScanConfig(points=1024, holes=0.0, outliers=0.0, partial=0.0),
    "smooth",
)
"""The recipe of the preset "small", for minutes of one core."""


@dataclass(frozen=True)
class Setting:
    """What all runs share; plain values, so that a process of its own can be told.

    Parameters
    ----------
    preset : {"small", "default", "paper"}
        The recipe: network, losses, scans.
    batch : int, optional
        Shapes of a step; None for the recipe's.
    """

    preset: Preset = "small"
    threads: int = 1
    batch: int | None = None

    def recipe(self, run: Run) -> Recipe:
        """The preset's recipe with the run's choices; constraints that it does not have weigh nothing.

        No network has an aligner or learned corrections: the orientation is given, the same to all runs, and what is
        compared is the deformation.
        """
        chosen = SMALL if self.preset == "small" else recipe_for(preset=self.preset)
        given = chosen.train.loss
        loss = replace(
            given,
            volume=given.volume if "vol" in run.constraint else 0.0,
            arap=given.arap if "arap" in run.constraint else 0.0,
            blend=given.blend if "Z" in run.constraint else 0.0,
        )
        network = replace(chosen.network, align_basis=0, corrections=0)
        if run.field != "transmatch":  # which has a network of its own
            network = replace(network, field=run.field)
        train = replace(
            chosen.train,
            loss=loss,
            shapes=self.batch or chosen.train.shapes * chosen.train.scans_per_shape,
            scans_per_shape=1,
            workers=0,
            threads=self.threads,
            seed=run.seed,
        )
        return Recipe(network, train, replace(chosen.scan, upright=False, sphere=False), run.kernel)

    @property
    def strained(self) -> int:
        """At how many of the loss points the energies of the regularisers are taken."""
        return 200 if self.preset == "small" else 400

    def template(self, run: Run) -> Template:
        """The template with the run's nodes, chosen by its `rule`: as many as it says, their radii grown where vertices
        lack some.

        Raises
        ------
        TemplateError
            Nodes of this number and radius do not carry it.
        """
        return self._chosen(run)[0]

    def rule(self, run: Run) -> Strategy:
        """By which rule its nodes are chosen: its own, or none ("uniform") where that one leaves too few."""
        return self._chosen(run)[1]

    def _chosen(self, run: Run) -> tuple[Template, Strategy]:
        resting = self.resting(run.pose)
        return _with_nodes(resting, run.nodes, run.radius * diameter(resting.shape), run.strategy)

    def resting(self, pose: str) -> Template:
        """The template in a pose, with the nodes that it came with; of other people in "T-heavy"."""
        return _resting(pose)

    def sources(self, pose: str) -> tuple[Source, Source]:
        """What draws shapes to learn from, and shapes of people that nobody learned from."""
        template = self.resting(pose)
        return human_source(template, 1024, 0), human_source(template, 64, 1)


@lru_cache(maxsize=4)
def _resting(pose: str) -> Template:
    template = read_template(f"human-{pose.removesuffix(HEAVY)}")
    return heavy(template) if pose.endswith(HEAVY) else template


@lru_cache(maxsize=32)
def _with_nodes(template: Template, K: int, radius: float, strategy: Strategy) -> tuple[Template, Strategy]:
    for rule in dict.fromkeys((strategy, "uniform")):
        try:
            laid = lay_nodes(template.shape, NodeConfig(rule, K, radius, grow=True), template.labels)
            return replace(template, nodes=laid.nodes, radius=laid.radius), rule
        except TemplateError:
            if rule == "uniform":
                raise
    raise AssertionError


@dataclass(frozen=True, eq=False)
class Pool:
    """Scans of N shapes, `SCANS` each, one after the other.

    Parameters
    ----------
    points : without points (P = 0) unless they are read
    features : of a network that reads the points themselves (N, 0, 3)
    targets : where the template's loss points belong
    basis : basis points of every run's encoder, whose features these are
    held_out : a batch of shapes that no run learns from
    source : draws such shapes as there are in the pool
    """

    points: Float[Tensor, "N P 3"]
    features: Float[Tensor, "N M 3"]
    targets: Float[Tensor, "N 1000 3"]
    basis: Float[Tensor, "M 3"]
    held_out: Batch
    source: Source

    def batch(self, step: int, count: int, shapes: int, seed: int, encoder: BasisEncoder | PointEncoder) -> Batch:
        """The batch of a step, of the scans of the first ``shapes``: a function of its arguments."""
        chosen = self.rows(step, count, shapes, seed)
        points = self.points[chosen]
        features = self.features[chosen] if self.features.shape[1] else encoder.features(points)
        return Batch(points, self.targets[chosen], features)

    def rows(self, step: int, count: int, shapes: int, seed: int) -> Int[Tensor, " count"]:
        """Which scans a step sees."""
        generator = torch.Generator().manual_seed((seed * 2_654_435_761 + step) % (2**63))
        return torch.randint(min(shapes * SCANS, len(self.targets)), (count,), generator=generator)


@lru_cache(maxsize=8)
def pool_of(setting: Setting, pose: str, shapes: int = BASE.shapes, read_points: bool = False) -> Pool:
    """The pool of a template pose, drawn once in a process; the same scans whether or not their points are kept."""
    template, recipe = setting.resting(pose), setting.recipe(Run(pose=pose))
    source, unseen = setting.sources(pose)
    generator = torch.Generator().manual_seed(_SEED)
    drawn = torch.cat([source(min(_BLOCK, shapes - at), generator) for at in range(0, shapes, _BLOCK)])

    def some(count: int, generator: torch.Generator) -> Tensor:
        return drawn[torch.randint(len(drawn), (count,), generator=generator)]

    model = build_deformer(template, some, recipe.network, recipe.scan, recipe.kernel, _SEED)
    data = build_dataset(template, some, model, recipe.scan, _BLOCK, SCANS, _SEED)
    encodes = recipe.network.encoder != "point"
    blocks = []
    for number, block in enumerate(drawn.split(_BLOCK)):
        batch = replace(data, source=lambda *_, block=block: block, shapes=len(block))[number]
        none = torch.zeros(len(batch.points), 0, 3)
        points = none if encodes and not read_points else batch.points
        blocks.append((points, batch.encode_features if encodes else none, batch.targets))
    points, features, targets = (torch.cat(part) for part in zip(*blocks, strict=True))
    held_out = replace(data, source=unseen, shapes=HELD_OUT_SHAPES, scans_per_shape=1, seed=_UNSEEN)[0]
    encoder = model.encoder
    basis = encoder.basis.clone() if isinstance(encoder, BasisEncoder) else torch.zeros(1, 3)
    return Pool(points, features, targets, basis, held_out, some)
