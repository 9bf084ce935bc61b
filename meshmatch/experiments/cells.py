"""The cells of the paper's tables and figures: what is trained, once each, and looked at from many sides.

A cell is a choice in everything that the paper varies. All tables and figures are views of the same cells, most of
which differ from `BASE` in one thing. What all cells of a run share is a `Setting`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import torch

from meshmatch.errors import TemplateError
from meshmatch.fields.choice import FieldName
from meshmatch.geometry.kernels import Kernel
from meshmatch.models.deformer import NetworkConfig
from meshmatch.templates.nodes import NodeConfig, Strategy, choose_nodes
from meshmatch.templates.registered import read_registered
from meshmatch.templates.template import Template, read_template
from meshmatch.training.bodies import human_source
from meshmatch.training.datasets import Source, registered_source
from meshmatch.training.loop import TrainConfig
from meshmatch.training.losses import CorrespondenceLoss
from meshmatch.training.recipes import Recipe, recipe_for
from meshmatch.training.scans import ScanConfig

CONSTRAINTS = ("none", "arap", "vol", "vol+arap", "vol+arap+Z")
PRESETS = ("small", "default", "paper")
SPHERE = 0.65
"""The paper's unit, the radius of a sphere around the body, in units of sqrt(area)."""


@dataclass(frozen=True)
class Cell:
    """One training.

    Parameters
    ----------
    field, kernel : of the deformation
    constraint : one of `CONSTRAINTS`
    nodes, radius : K, and r in the paper's unit
    strategy : how nodes are chosen
    pose : of the template
    shapes : how many there are to learn from
    supervised : on how many template points the right place is told
    """

    field: FieldName = "mls"
    constraint: str = "vol+arap+Z"
    nodes: int = 300
    radius: float = 0.2
    strategy: Strategy = "parts"
    pose: str = "T"
    shapes: int = 2000
    supervised: int = 1000
    kernel: Kernel = "smooth"
    seed: int = 0

    @property
    def name(self) -> str:
        """Of its folder: in what it differs from the base."""
        base = Cell()
        parts = [
            f"{each.name}-{getattr(self, each.name)}".replace("+", "-").lower()
            for each in fields(self)
            if getattr(self, each.name) != getattr(base, each.name)
        ]
        return ".".join(parts) or "base"


BASE = Cell()
"""What cells differ from."""


@dataclass(frozen=True)
class Setting:
    """What all cells share; plain values, so that a process of its own can be told.

    Parameters
    ----------
    preset : {"small", "default", "paper"}
        The recipe: network, losses, scans. "small" is for minutes of one core.
    folder : str, optional
        Shapes that `meshmatch prepare` made ready; None for generated bodies.
    identities : int
        Of generated bodies.
    batch, code, width : int, optional
        In place of the preset's.
    """

    preset: Literal["small", "default", "paper"] = "small"
    folder: str | None = None
    identities: int = 1024
    batch: int | None = None
    code: int | None = None
    width: int | None = None
    threads: int = 1

    def recipe(self, cell: Cell) -> Recipe:
        """The preset's recipe with the cell's choices; constraints that it does not have weigh nothing.

        No network has an aligner or learned corrections: the orientation is given, the same to all cells, and what is
        compared is the deformation.
        """
        chosen = SMALL if self.preset == "small" else recipe_for(preset=self.preset)
        loss = replace(
            chosen.train.loss,
            volume=chosen.train.loss.volume if "vol" in cell.constraint else 0.0,
            arap=chosen.train.loss.arap if "arap" in cell.constraint else 0.0,
            blend=chosen.train.loss.blend if "Z" in cell.constraint else 0.0,
        )
        network = replace(
            chosen.network,
            field=cell.field,
            align_basis=0,
            corrections=0,
            code=self.code or chosen.network.code,
            width=self.width or chosen.network.width,
        )
        train = replace(
            chosen.train,
            loss=loss,
            shapes=self.batch or chosen.train.shapes * chosen.train.scans_per_shape,
            scans_per_shape=1,
            workers=0,
            threads=self.threads,
            seed=cell.seed,
        )
        return Recipe(network, train, replace(chosen.scan, upright=False), cell.kernel)

    @property
    def strained(self) -> int:
        """At how many of the loss points the energies of the regularisers are taken."""
        return 200 if self.preset == "small" else 400

    def template(self, cell: Cell) -> Template:
        """The template with the cell's nodes, chosen by its `rule`.

        Raises
        ------
        TemplateError
            Nodes of this number and radius do not carry it.
        """
        return _with_nodes(self.resting(cell.pose), cell.nodes, cell.radius * SPHERE, cell.strategy)[0]

    def rule(self, cell: Cell) -> Strategy:
        """By which rule its nodes are chosen: its own, or none ("uniform") where that one leaves too few."""
        return _with_nodes(self.resting(cell.pose), cell.nodes, cell.radius * SPHERE, cell.strategy)[1]

    def resting(self, pose: str) -> Template:
        """The template in a pose, with the nodes that it came with; a folder has one pose."""
        return _resting(self.folder, pose)

    def sources(self, pose: str) -> tuple[Source, Source]:
        """What draws shapes to learn from, and shapes that nobody learned from: other people, or a folder's last ones."""
        template = self.resting(pose)
        if self.folder is None:
            return human_source(template, self.identities, 0), human_source(template, 64, 1)
        shapes = torch.from_numpy(read_registered(self.folder, template))
        kept = max(1, len(shapes) - max(1, len(shapes) // 5))
        return registered_source(shapes[:kept]), registered_source(shapes[kept:])


@lru_cache(maxsize=4)
def _resting(folder: str | None, pose: str) -> Template:
    return read_template(f"human-{pose}" if folder is None else Path(folder) / "template.safetensors")


@lru_cache(maxsize=8)
def _with_nodes(template: Template, K: int, radius: float, strategy: Strategy) -> tuple[Template, Strategy]:
    config = NodeConfig(strategy, K, radius)
    rule = strategy
    try:
        nodes = choose_nodes(template.shape, config, template.labels)
    except TemplateError:
        if strategy == "uniform":
            raise
        rule = "uniform"
        nodes = choose_nodes(template.shape, replace(config, strategy=rule), template.labels)
    return replace(template, nodes=nodes, radius=radius), rule


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
"""The recipe of the preset "small"."""
