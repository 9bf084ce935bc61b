"""`meshmatch train`: from a template and shapes to a model folder that the registry accepts."""

from __future__ import annotations

import datetime
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import platformdirs
import torch

from meshmatch.errors import OptionError
from meshmatch.models.card import ModelCard, write_card
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.deformer import PAPER, Deformer, NetworkConfig
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import make_folder
from meshmatch.templates.prepare import read_registered
from meshmatch.templates.template import Template, load_template
from meshmatch.training.clouds import warped_source
from meshmatch.training.datasets import Source, body_source, registered_source
from meshmatch.training.folder import VALIDATION_SEED, checkpoint_in, train_into
from meshmatch.training.human_template import restrict
from meshmatch.training.loop import Progress, TrainConfig, Trainer
from meshmatch.training.losses import LossConfig, LossPoints, distance
from meshmatch.training.pose_files import GivenPoses
from meshmatch.training.rig import RIG_VERSION, Rig, build_rig, load_rig, save_rig
from meshmatch.training.scans import ScanConfig
from meshmatch.training.setup import build_dataset, build_deformer, build_loss_points

Preset = Literal["default", "paper"]


@dataclass(frozen=True)
class Recipe:
    """Everything a training run is a function of, besides its shapes."""

    network: NetworkConfig
    train: TrainConfig
    scan: ScanConfig
    kernel: Literal["smooth", "cubic"]


def recipe(preset: Preset = "default") -> Recipe:
    """The recipe of a preset.

    ``paper``: point encoder, node decoder, squared loss with the paper's weights, its kernel, batch and rate,
    3,000 clean points turned about the vertical axis. ``default``: what beat it (docs/results.md).
    """
    if preset == "paper":
        return Recipe(
            PAPER,
            TrainConfig(
                steps=75_000, shapes=16, scans_per_shape=1, decay=0.0, weight_decay=0.0, loss=LossConfig()
            ),
            ScanConfig(
                points=3000,
                noise=0.0,
                holes=0.0,
                outliers=0.0,
                partial=0.0,
                density=0.0,
                bumps=0.0,
                scale=0.0,
                upright=True,
            ),
            "cubic",
        )
    if preset == "default":
        loss = LossConfig(volume=2e-3, arap=2e-3, blend=1e-3, robust=True)
        return Recipe(
            NetworkConfig(), TrainConfig(steps=13_000, decay=0.65, loss=loss), ScanConfig(), "smooth"
        )
    raise OptionError(f"no preset {preset!r}", "choose default or paper")


def human_source(
    template: Template,
    identities: int = 4096,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    poses: GivenPoses | None = None,
) -> Source:
    """Generated bodies on a human template's vertices, some in given poses; the rig is built once and cached."""
    rig = cached_rig(identities, seed, progress)
    if poses is not None:
        poses.columns(rig)  # a name that the rig does not know is told now
    # Template vertices are a subset of the body model's: the dense mesh says which.
    from scipy.spatial import cKDTree

    apart, keep = cKDTree(template.dense.verts).query(template.shape.verts)
    if template.dense.verts.shape[0] != rig.rest.shape[1] or apart.max() > 1e-4:
        raise OptionError(
            f"template {template.name} is not made from the body model",
            "train on a prepared folder (--shapes), or use a human template",
        )
    return body_source(restrict(rig, keep, np.array(template.shape.faces)), poses)


def unseen_bodies(template: Template, count: int, trained: int = 0, seed: int = 0) -> np.ndarray:
    """Generated bodies (count, V, 3) in metres on a human template's vertices, of people that a training never drew.

    ``trained`` is the seed of that training: people are drawn with another one, and few of them.
    """
    other = trained + 1 + seed
    return human_source(template, 64, other)(count, torch.Generator().manual_seed(other)).double().numpy()


def cached_rig(identities: int, seed: int, progress: Callable[[int, int], None] | None = None) -> Rig:
    """The body rig from the cache, or built into it (a minute or two, once)."""
    path = (
        Path(platformdirs.user_cache_dir("meshmatch")) / f"rig-v{RIG_VERSION}-{identities}-{seed}.safetensors"
    )
    if path.is_file():
        return load_rig(path)
    make_folder(path.parent)
    rig = build_rig(identities, seed, progress=progress)
    save_rig(rig, path)
    return rig


def folder_source(folder: str | Path, template: Template, warped: bool = False) -> tuple[Source, int]:
    """Registered shapes of a prepared folder, and how many there are; ``warped``: smoothly deformed when drawn."""
    shapes = torch.from_numpy(read_registered(folder, template))
    return (warped_source if warped else registered_source)(shapes), len(shapes)


def train_model(
    template: Template,
    source: Source,
    output: str | Path,
    *,
    recipe: Recipe,
    name: str,
    category: str = "human",
    data: str = "",
    licence: str = "",
    start: TrainedModel | None = None,
    resume: bool = True,
    frame: dict[str, str] | None = None,
    stiffness: float = 1.0,
    progress: Callable[[Progress], None] | None = None,
) -> Path:
    """Train, or go on training, and write a model folder.

    ``frame`` and ``stiffness`` are the card's; the frame is by default that of a network that finds the orientation.
    ``output`` receives ``checkpoint/last.safetensors`` on the way and, at every stop, ``template.safetensors``,
    ``weights.safetensors`` and last ``card.json``. ``start`` gives the first weights; it must have the same
    template and network.

    Returns
    -------
    Path
        The model folder.
    """
    output = Path(output)
    make_folder(checkpoint_in(output).parent)
    config = recipe.train
    model = build_deformer(template, source, recipe.network, recipe.scan, recipe.kernel, config.seed)
    if start is not None:
        take_weights(model, template, recipe, start)
    points = build_loss_points(template, recipe.kernel, model)
    dataset = build_dataset(
        template, source, model, recipe.scan, config.shapes, config.scans_per_shape, config.seed, config.steps
    )
    trainer = Trainer(model, points, config)
    held_out = replace(dataset, seed=VALIDATION_SEED, shapes=32, scans_per_shape=1)[0]

    def measure(model: Deformer) -> float:
        return validation_error(model, held_out, trainer.points)

    write = partial(
        export,
        *(trainer, template, output, recipe, name, category, data, licence),
        start=start,
        frame=frame,
        stiffness=stiffness,
    )
    return train_into(output, trainer, dataset, measure, write, resume, progress)


def take_weights(model: Deformer, template: Template, recipe: Recipe, start: TrainedModel) -> None:
    """Begin where a trained model ended.

    Raises
    ------
    OptionError
        It has another template, network or kernel.
    """
    same = start.template.hash == template.hash and start.network.config == recipe.network
    if not (same and start.card.field["kernel"] == recipe.kernel):
        raise OptionError(
            f"model {start.card.name} has another template, network or kernel",
            "start from a model of the same template and preset, or from nothing",
        )
    model.load_state_dict(start.network.state_dict())


@torch.no_grad()
def validation_error(model: Deformer, batch, points: LossPoints) -> float:
    """Mean distance (units of sqrt(area)) on held-out scans, learned corrections included."""
    was = model.training
    model.eval()
    device = points.positions.device
    error = float(distance(points.moved(model(batch.points.to(device))), batch.targets.to(device)))
    model.train(was)
    return error


def export(
    trainer: Trainer,
    template: Template,
    output: Path,
    recipe: Recipe,
    name: str,
    category: str,
    data: str,
    licence: str,
    score: float,
    storage: str = "int8",
    start: TrainedModel | None = None,
    frame: dict[str, str] | None = None,
    stiffness: float = 1.0,
) -> None:
    """Write the averaged weights as a model folder; the card comes last."""
    from meshmatch.templates.template import save_template

    (output / "card.json").unlink(missing_ok=True)
    save_template(template, output / "template.safetensors")
    digest = save_weights(trainer.averaged_state(), output / "weights.safetensors", storage=storage)
    card = ModelCard(
        name=name,
        category=category,
        template=template.name,
        template_hash=template.hash,
        network=recipe.network.to_dict(),
        field={"kernel": recipe.kernel, "radius": template.radius, "nodes": template.K},
        data=data,
        licence=licence,
        recipe={"train": asdict(recipe.train), "scan": asdict(recipe.scan), **_beginning(start)},
        seed=recipe.train.seed,
        steps=trainer.step,
        training_minutes=round(trainer.seconds / 60, 1),
        metrics={"validation": {"distance": round(score, 5)}},
        weights_sha256=digest,
        created=datetime.date.today().isoformat(),
        description="",
        stiffness=stiffness,
    )
    if frame is not None:
        card = replace(card, frame=frame)
    write_card(card, output / "card.json")


def _beginning(start: TrainedModel | None) -> dict:
    if start is None:
        return {}
    card = start.card
    return {"start": {"model": card.name, "weights_sha256": card.weights_sha256, "steps": card.steps}}


def read_template(name: str | Path) -> Template:
    """A template by file, or one of the built-in ones by name (human-T, human-A, human-I)."""
    from meshmatch.templates.location import bundled_folder

    path = Path(name)
    if path.is_file():
        return load_template(path)
    inside = bundled_folder() / "human" / f"{name}.safetensors"
    return load_template(inside if inside.is_file() else path)
