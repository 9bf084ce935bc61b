"""Training on shapes without correspondence: a folder that `meshmatch prepare` made, a model folder out."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from meshmatch.errors import InputError
from meshmatch.models.deformer import PAPER, Deformer
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import make_folder
from meshmatch.templates.template import Template
from meshmatch.templates.unregistered import Gathered
from meshmatch.training.chamfer import SurfacePoints, build_surface_points, chamfer_losses
from meshmatch.training.clouds import CloudBatch, CloudConfig, CloudDataset, build_warp
from meshmatch.training.folder import VALIDATION_SEED, checkpoint_in, train_into
from meshmatch.training.loop import Progress, TrainConfig, Trainer
from meshmatch.training.losses import LossConfig
from meshmatch.training.run import Preset, Recipe, export, take_weights
from meshmatch.training.scans import ScanConfig
from meshmatch.training.setup import fill_basis, lay_anchors
from meshmatch.training.small_data import few_recipe


def cloud_recipe(preset: Preset = "default") -> Recipe:
    """The recipe of a preset for shapes without correspondence.

    ``paper``: its network, and its weights for segmentation transfer. ``default``: a network for few shapes.
    """
    if preset == "paper":
        loss = LossConfig(volume=1e-4, arap=1e-3, blend=1e-4)
        train = TrainConfig(
            steps=4000, shapes=8, scans_per_shape=1, decay=0.0, weight_decay=0.0, loss=loss, workers=0
        )
        return Recipe(PAPER, train, ScanConfig(points=1024, noise=0.0, scale=0.0), "cubic")
    few = few_recipe()
    loss = LossConfig(volume=1e-4, arap=1e-3, blend=1e-4)
    return replace(few, train=replace(few.train, loss=loss))


def build_cloud_dataset(
    gathered: Gathered, recipe: Recipe, change: CloudConfig | None = None
) -> CloudDataset:
    """Batches of a folder's samples, as yet without an encoder."""
    return CloudDataset(
        points=torch.from_numpy(gathered.points),
        normals=torch.from_numpy(gathered.normals),
        landmarks=torch.from_numpy(gathered.landmarks),
        warp=build_warp(gathered),
        encoder=None,
        scan=recipe.scan,
        change=change or CloudConfig(),
        shapes=recipe.train.shapes,
        seed=recipe.train.seed,
        length=recipe.train.steps,
    )


def build_cloud_deformer(template: Template, data: CloudDataset, recipe: Recipe, seed: int) -> Deformer:
    """An untrained network, its basis points laid where the folder's shapes are."""
    basis = torch.zeros(1, 3)
    if recipe.network.encoder == "basis":
        generator = torch.Generator().manual_seed(seed)
        drawn = replace(data, shapes=64, seed=seed + 1)[0]
        basis = fill_basis(drawn.points, recipe.network.basis, generator)
    anchors, anchor_phi = lay_anchors(template, recipe.network, recipe.kernel)
    nodes = torch.from_numpy(template.nodes).float()
    torch.manual_seed(seed)
    return Deformer(recipe.network, nodes, anchors, anchor_phi, basis, torch.zeros(1, 3))


def train_clouds(
    template: Template,
    gathered: Gathered,
    output: str | Path,
    *,
    recipe: Recipe,
    name: str,
    category: str,
    data: str = "",
    licence: str = "",
    start: TrainedModel | None = None,
    resume: bool = True,
    change: CloudConfig | None = None,
    stiffness: float = 1.0,
    progress: Callable[[Progress], None] | None = None,
) -> Path:
    """Train, or go on training, and write a model folder; as `meshmatch.training.run.train_model`.

    Raises
    ------
    InputError
        There is only one shape.
    """
    if len(gathered.points) < 2:
        raise InputError(
            "one shape is too few to learn from", "prepare a folder of several; ten or more are better"
        )
    output = Path(output)
    make_folder(checkpoint_in(output).parent)
    config = recipe.train
    dataset = build_cloud_dataset(gathered, recipe, change)
    model = build_cloud_deformer(template, dataset, recipe, config.seed)
    if start is not None:
        take_weights(model, template, recipe, start)
    dataset = replace(dataset, encoder=deepcopy(model.encoder).cpu())
    points = build_surface_points(template, recipe.kernel, model, gathered.template_landmarks)
    trainer = Trainer(model, points, config, chamfer_losses)
    held_out = replace(dataset, seed=VALIDATION_SEED, shapes=min(32, 2 * len(gathered.points)))[0]

    def measure(model: Deformer) -> float:
        return surface_error(model, held_out, points.to(trainer.device))

    write = partial(
        export,
        *(trainer, template, output, recipe, name, category, data, licence),
        storage="float16",
        start=start,
        frame={"orientation": gathered.align, "scale": gathered.scale},
        stiffness=stiffness,
    )
    return train_into(output, trainer, dataset, measure, write, resume, progress)


@torch.no_grad()
def surface_error(model: Deformer, batch: CloudBatch, points: SurfacePoints) -> float:
    """Mean distance both ways between the fitted template and held-out draws of the shapes, units of sqrt(area)."""
    was = model.training
    model.eval()
    batch = batch.to(points.positions.device)
    terms = chamfer_losses(model, batch, points, LossConfig(blend=0.0), torch.Generator())
    model.train(was)
    return float(terms["error"])
