"""Train a model on a folder of shapes or on generated shapes, and write it as a model folder.

`meshmatch.training.recipes.recipe_for` chooses the settings for a folder.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable
from contextlib import suppress
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Int, Ints
from meshmatch.errors import InputError, ModelError, OptionError, TemplateError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import has_nodes, shape_functions
from meshmatch.generators.bodies import Bodies
from meshmatch.generators.generator import Source
from meshmatch.generators.kinds import Kind
from meshmatch.geometry.kernels import Kernel
from meshmatch.models.card import ModelCard, check_name, read_card, write_card
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.deformer import Deformer
from meshmatch.models.inference import training_device
from meshmatch.models.network import NetworkConfig
from meshmatch.models.registry import CARD, NO_MODEL, TEMPLATE, WEIGHTS, load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import make_folder
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.sampling import farthest_points
from meshmatch.templates.prepared_folder import RegisteredShapes, ShapeSamples
from meshmatch.templates.template import Template, save_template, template_radius
from meshmatch.training.aligner import Aligned, train_aligner
from meshmatch.training.datasets import BatchDataset, CloudDataset, build_lattice
from meshmatch.training.facts import CardFacts as CardFacts
from meshmatch.training.facts import fill_from_card
from meshmatch.training.folder_lock import ALIGNER, exclusive_folder
from meshmatch.training.folder_lock import CHECKPOINT as CHECKPOINT
from meshmatch.training.load_data import (
    TrainingData,
    check_start,
    default_kind,
    known_template,
    load_training_data,
    with_validation,
)
from meshmatch.training.loop import StepReport, TrainConfig, Trainer
from meshmatch.training.losses import LossPoints, Objective, SurfacePoints, held_out_error
from meshmatch.training.recipe_files import recipe_record
from meshmatch.training.recipes import Recipe, fine_tuning, recipe_for, small_data
from meshmatch.training.records import CURVES, METRICS, Metrics, Report, check_curves, combine_reports, curves
from meshmatch.training.scans import ScanConfig

BEST = "best"
"""Subfolder for the model with the lowest validation error so far."""
VALIDATION_SEED = 999_983
"""Seed of the validation batch, which no training step draws."""


def train(
    output: str | Path,
    *,
    shapes: str | Path | RegisteredShapes | None = None,
    kind: str | Kind | Bodies | None = None,
    recipe: Recipe | None = None,
    facts: CardFacts | None = None,
    resume: bool = True,
    validation: str | Path | RegisteredShapes | None = None,
    tensorboard: bool = False,
    progress: ProgressCallback | None = None,
    report: Callable[[StepReport], None] | None = None,
) -> Path:
    """Train a model, or resume its training exactly from the checkpoint in its folder.

    During training the folder receives ``checkpoint/last.safetensors`` and ``metrics.jsonl``. Whenever training stops,
    ``template.safetensors``, ``weights.safetensors`` and finally ``card.json`` are written. The subfolder ``best`` holds the
    same files for the model with the lowest validation error, which is measured every 500 steps and at the end.

    Parameters
    ----------
    output
        The model's folder.
    shapes
        A prepared folder (see `prepare`), which also contains the template; or fits (``Collection(FITS).to_learn()``):
        if a model made the fits, its training continues on them, otherwise a new model is trained.
    kind
        Generated shapes instead of ``shapes``: "human" (the default), "quadruped", "hand" or "head"; or `Bodies` or a
        `Kind` with options.
    recipe
        Losses, sizes and steps, such as ``recipe_for(shapes, ...).changed(minutes=60)``; by default chosen for the
        shapes.
    facts
        Facts about the model for its card: name, category, licence.
    resume
        Resume from a checkpoint if there is one.
    validation
        Registered shapes for validation, excluded from training: a folder prepared with the same template, or fits as
        for ``shapes``. By default another batch is drawn as in training.
    tensorboard
        Also write curves for TensorBoard (the extra ``tensorboard``), into the folder ``tensorboard``.
    progress
        As in `match`.
    report
        Called with the losses every 50 steps, and with the validation error every 500.

    Returns
    -------
    Path
        The model's folder.

    Raises
    ------
    InputError
        A folder is not prepared, or has too few shapes.
    OptionError
        The options conflict, or the extra ``train`` or ``tensorboard`` is not installed.
    ModelError
        The name is invalid, or the checkpoint belongs to another training.
    TemplateError
        The template is missing or damaged.
    OutputError
        The folder cannot be written, or another training writes to it.

    Examples
    --------
    >>> recipe = meshmatch.recipe_for("my-prepared").changed(minutes=60)
    >>> meshmatch.train("my-model", shapes="my-prepared", recipe=recipe)
    """
    output, facts = Path(output), facts or CardFacts()
    facts = replace(facts, name=check_name(facts.name or output.resolve().name))
    kind = default_kind(kind) if isinstance(kind, str) else kind
    source_model = shapes.model if isinstance(shapes, RegisteredShapes) and shapes.model != NO_MODEL else None
    start = facts.start or source_model
    start = load_model(start) if isinstance(start, str | Path) else start
    facts = replace(facts, start=start)
    if not isinstance(shapes, RegisteredShapes):
        recipe = recipe or recipe_for(shapes, kind=None if kind is None else kind.name)
    elif source_model is None:
        recipe = recipe or small_data()
    else:
        assert start is not None
        if Path(shapes.model).resolve() == output.resolve():
            raise OptionError(f"{output} is the model that made the fits", "choose another folder")
        facts, recipe = fill_from_card(facts, start.card), recipe or fine_tuning(start)
    if start is not None:
        # Check this before shapes are made, which may take minutes.
        check_start(start, known_template(shapes, kind, recipe, start), recipe)

    if tensorboard:
        check_curves()

    shape_progress = Progress(progress, "shapes").stage("making shapes (once)")

    def load_data() -> TrainingData:
        return with_validation(validation, load_training_data(shapes, kind, recipe, shape_progress))

    return _train_locked(output, facts, recipe, resume, report, tensorboard, load_data, Progress(progress, "training"))


@exclusive_folder
def _train_locked(
    output: str | Path, facts: CardFacts, recipe: Recipe, resume: bool, report: Report | None, tensorboard: bool,
    load_data: Callable[[], TrainingData], progress: Progress,
) -> Path:  # fmt: skip
    """Train in ``output``, which this process has locked; see `train`."""
    data = load_data()
    facts = replace(facts, category=facts.category or data.category or facts.name, data=facts.data or data.data)
    facts = replace(facts, frame=facts.frame or data.frame, mirror=facts.mirror or data.mirror)
    facts = replace(facts, measured=facts.measured or data.measured)
    return train_model(
        data.template, data.source, output, recipe, facts, resume, report, data.validation_source, tensorboard,
        progress, data.digest,
    )  # fmt: skip


def train_model(
    template: Template,
    source: Source | ShapeSamples,
    output: str | Path,
    recipe: Recipe,
    facts: CardFacts,
    resume: bool = True,
    report: Callable[[StepReport], None] | None = None,
    unseen: Source | None = None,
    tensorboard: bool = False,
    progress: Progress | None = None,
    digest: str = "",
) -> Path:
    """Train on shapes with the template's vertices (a `Source`), or on samples without correspondence; return the folder.

    A source is validated on shapes drawn from ``unseen``, by default from the source itself. ``digest`` identifies the
    shapes, see `TrainingData`.

    `InputError` if there is only one shape; `OptionError` if the loss is not for such shapes, or the start model has another
    template, network or kernel.
    """
    _check_loss(recipe.train.loss, registered=not isinstance(source, ShapeSamples))
    checkpoint = (output := Path(output)) / CHECKPOINT
    name = facts.name or output.resolve().name
    facts = replace(facts, name=name, category=facts.category or name)
    record = recipe_record(recipe)
    _build_card(template, recipe, facts, record)  # fail now, not at the end, if a card cannot hold the facts
    make_folder(checkpoint.parent)
    config, kernel = recipe.train, recipe.kernel
    if recipe.scan.sphere and getattr(source, "scale", "sphere") == "sphere":  # the paper's units of length
        reconstruction = config.loss.reconstruction / template_radius(template) ** 2
        config = replace(config, loss=replace(config.loss, reconstruction=reconstruction))
    points: Any
    data: Any = source
    if isinstance(source, ShapeSamples):
        if len(source.points) < 2:
            raise InputError("one shape is too few to learn from", "prepare several; ten or more are better")
        data = build_cloud_dataset(source, config, recipe.scan)
    model = build_deformer(template, data, recipe.network, recipe.scan, kernel, config.seed)
    if isinstance(start := facts.start, TrainedModel):
        check_start(start, template, recipe)
        model.load_state_dict(start.network.state_dict())
    if isinstance(source, ShapeSamples):
        data = replace(data, encoder=deepcopy(model.encoder).cpu())
        points = build_surface_points(template, kernel, model, source.template_landmarks)
        facts = replace(facts, frame=facts.frame or {"orientation": source.align, "scale": source.scale})
        validation_changes: dict[str, Any] = {"shapes": min(32, 2 * len(source.points))}
    else:
        default_frame = {"orientation": "searched", "scale": "sphere"} if recipe.scan.sphere else None
        facts = replace(facts, frame=facts.frame or default_frame)
        points = build_loss_points(template, kernel, model)
        size = config.shapes, config.scans_per_shape, config.seed, config.steps
        data = build_dataset(template, source, model, recipe.scan, *size)
        validation_changes = {"shapes": 32, "scans_per_shape": 1, "source": unseen or source}
    resumed = resume and checkpoint.is_file()
    aligning = None if progress is None else progress.stage("orientations alone (once)")
    aligned = Aligned() if resumed else align(model, data, config, output / ALIGNER, resume, aligning)
    held_out = replace(data, seed=VALIDATION_SEED, **validation_changes)[0]
    trainer = Trainer(model, points, config, digest, record | {"kernel": recipe.kernel})
    if resumed:
        trainer.load(checkpoint)
        for name in ("encoder", "aligner"):  # the dataset has copies of them (see `build_dataset`)
            if (feature_module := getattr(data, name, None)) is not None:
                feature_module.load_state_dict(getattr(trainer.model, name).state_dict())

    def validation_error(_: Deformer) -> float:
        """Validation error of the averaged weights, those that are exported."""
        with trainer.averaged():
            return held_out_error(trainer.model, held_out, trainer.points)

    def export_if_best(score: float | None) -> None:
        if score is not None and metrics.is_best(score):
            make_folder(output / BEST)
            export(trainer, template, output / BEST, recipe, facts, score)

    if trainer.rank == 0:
        metrics = Metrics(output / METRICS, trainer)
        metrics.best = min(metrics.best, _stored_best(output / BEST, trainer.step))
        tensorboard_report = curves(output / CURVES, trainer.step) if tensorboard else None
        report = combine_reports(metrics, tensorboard_report, report, lambda now: export_if_best(now.validation))
    trainer.seconds += aligned.total_seconds
    if not trainer.any_process(not aligned.done):
        trainer.run(data, checkpoint, report, validation_error, spent=aligned.seconds, progress=progress)
        (output / ALIGNER).unlink(missing_ok=True)
    trainer.close()
    if trainer.rank == 0:
        score = validation_error(trainer.model)
        if (output / BEST).is_dir():
            export_if_best(score)
        export(trainer, template, output, recipe, facts, score)
    return output


def _check_loss(loss: Objective, registered: bool) -> None:
    """Raise `OptionError` if the loss is not for such shapes."""
    if loss.needs_correspondence != registered:
        what = (
            f"the loss {type(loss).__name__} is for shapes {'without' if registered else 'with'} known correspondence"
        )
        raise OptionError(what, f"derive it from {'CorrespondenceLoss' if registered else 'ChamferLoss'}")


def _stored_best(folder: Path, step: int) -> float:
    """Validation error of the model in ``folder`` if it is of ``step`` or earlier, infinity otherwise.

    It may be of the step at which a run stopped, which has no line in `METRICS`.
    """
    with suppress(ModelError, KeyError, TypeError):
        card = read_card(folder / CARD)
        if card.steps <= step:
            return float(card.metrics["validation"]["distance"])
    return float("inf")


def align(
    model: Deformer, data: Any, config: TrainConfig, checkpoint: Path, resume: bool, progress: Progress | None
) -> Aligned:
    """Train the aligner on its own first, if the configuration asks for it.

    ``checkpoint`` holds the state of an interrupted alignment; it is deleted unless ``resume`` is set.
    """
    if not resume:
        checkpoint.unlink(missing_ok=True)
    if not config.align_steps or not isinstance(data, BatchDataset) or model.aligner is None:
        return Aligned()
    torch.set_num_threads(config.threads)
    model.to(training_device(int(os.environ.get("LOCAL_RANK", 0)), config.device))
    return train_aligner(model, data, config.align_steps, progress, config.draw, config.minutes, checkpoint)


def check_encoder(model: Deformer, P: int) -> None:
    """Raise `ModelError` if a custom encoder fails on two clouds of P points.

    It runs on a copy and leaves the random state unchanged, so training is not affected.
    """
    with torch.random.fork_rng(devices=[]):
        deepcopy(model).train().code_of(0.3 * torch.randn(2, P, 3))


def export(trainer: Trainer, template: Template, output: Path, recipe: Recipe, facts: CardFacts, score: float) -> None:
    """Write the averaged weights as a model folder, with the validation error ``score``; the card is written last."""
    (output / CARD).unlink(missing_ok=True)
    save_template(template, output / TEMPLATE)
    digest = save_weights(trainer.averaged_state(), output / WEIGHTS, storage=recipe.storage)
    history: dict[str, Any] = {"earlier": trainer.earlier, "validation": facts.measured}
    history |= {"processes": trainer.world} if trainer.world > 1 else {}
    settings = recipe_record(recipe) | {name: value for name, value in history.items() if value}
    if isinstance(facts.start, TrainedModel):
        origin = facts.start.card
        settings["start"] = {"model": origin.name, "weights_sha256": origin.weights_sha256, "steps": origin.steps}
    card = replace(
        _build_card(template, recipe, facts, settings), steps=trainer.step, training_minutes=round(trainer.seconds / 60, 1),
        metrics={"validation": {"distance": round(score, 5)}}, weights_sha256=digest,
    )  # fmt: skip
    write_card(card, output / CARD)


def _build_card(template: Template, recipe: Recipe, facts: CardFacts, settings: dict[str, Any]) -> ModelCard:
    """Card of an untrained model; `ModelError` if the facts are invalid."""
    frame: dict[str, Any] = {} if facts.frame is None else {"frame": facts.frame}
    return ModelCard(
        name=facts.name, category=facts.category, template=template.name, template_hash=template.hash,
        network=recipe.network.to_dict(),
        field={"kernel": recipe.kernel, "radius": template.reach, "nodes": template.K},
        data=facts.data, licence=facts.licence, recipe=settings, seed=recipe.train.seed, steps=0,
        training_minutes=0.0, metrics={}, weights_sha256=64 * "0", created=datetime.date.today().isoformat(),
        stiffness=facts.stiffness, mirror=facts.mirror or "no",
        correspondence=recipe.train.loss.needs_correspondence, **frame,
    )  # fmt: skip


def fill_basis(points: Float[Tensor, "B P 3"], M: int, generator: torch.Generator) -> Float[Tensor, "M 3"]:
    """(M, 3) basis points spread over the region that shapes occupy: farthest points of jittered samples."""
    flat = points.flatten(0, 1)
    flat = flat[torch.randperm(len(flat), generator=generator)[:20_000]]
    jittered = flat + 0.06 * torch.randn(len(flat), 3, generator=generator)
    # Farthest point sampling favours outliers: drop the outermost points first.
    jittered = jittered[jittered.norm(dim=1) < torch.quantile(jittered.norm(dim=1), 0.995)]
    return jittered[torch.from_numpy(farthest_points(jittered.double().numpy(), M))]


def anchor_vertices(template: Template, A: int) -> Int[Ints, " A"]:
    """Indices of A template vertices where the corrector compares template and scan; `TemplateError` if V < A."""
    if template.shape.V < A:
        problem = f"template {template.name} has {A} nodes but only {template.shape.V} vertices"
        raise TemplateError(problem, "prepare it with fewer nodes")
    return farthest_points(template.shape.verts, A)


def build_deformer(
    template: Template,
    source: Source | CloudDataset,
    network: NetworkConfig,
    scan: ScanConfig,
    kernel: Kernel,
    seed: int,
) -> Deformer:
    """Build an untrained network for a template; its basis points are sampled from the source's shapes."""
    basis = align_basis = torch.zeros(1, 3)
    if network.encoder != "point" or network.align_basis:
        if isinstance(source, CloudDataset):
            points = replace(source, shapes=64, seed=seed + 1)[0].points
        else:
            points = build_dataset(template, source, None, scan, shapes=48, scans_per_shape=2, seed=seed)[0].points
        generator = torch.Generator().manual_seed(seed)
        basis = fill_basis(points, network.basis, generator)
        if network.align_basis:
            centered = points - points.mean(1, keepdim=True)
            direction = torch.nn.functional.normalize(torch.randn(centered.shape, generator=generator), dim=-1)
            align_basis = fill_basis(centered.norm(dim=-1, keepdim=True) * direction, network.align_basis, generator)
    anchors = template.shape.verts[anchor_vertices(template, template.K)]
    phi = None
    if has_nodes(network.field):
        field = Field.of(shape_functions(network.field, anchors, template.nodes, template.radius, kernel))
        phi = field.for_training().phi
    nodes = torch.from_numpy(template.nodes).float()
    torch.manual_seed(seed)
    model = Deformer(network, nodes, torch.from_numpy(anchors).float(), phi, basis, align_basis)
    if isinstance(network.encoder, type):
        check_encoder(model, scan.points)
    return model


def loss_vertices(template: Template, M: int = 1000) -> Int[Ints, " M"]:
    """Indices of at most M evenly spread template vertices, on which losses are computed."""
    return farthest_points(template.shape.verts, min(M, template.shape.V))


def build_dataset(
    template: Template,
    source: Source,
    model: Deformer | None,
    scan: ScanConfig,
    shapes: int,
    scans_per_shape: int,
    seed: int,
    length: int = 1,
) -> BatchDataset:
    """Dataset of batches from a source, supervised on evenly spread template vertices.

    With a model, batches include the features of its encoder and aligner; the dataset has copies of both on the CPU,
    whatever device the model is on.
    """
    verts = torch.from_numpy(np.array(template.shape.verts)).float()
    core = torch.from_numpy(template.core)
    faces, supervised = torch.from_numpy(np.array(template.shape.faces)), torch.from_numpy(loss_vertices(template))
    encoder = None if model is None else deepcopy(model.encoder).cpu()
    aligner = None if model is None or model.aligner is None else deepcopy(model.aligner).cpu()
    settings = scan, shapes, scans_per_shape, seed, length, template_radius(template) if scan.sphere else None
    return BatchDataset(source, faces, verts[core], core, supervised, encoder, aligner, *settings)


def build_loss_points(template: Template, kernel: Kernel, model: Deformer, gradients: int = 400) -> LossPoints:
    """The supervised vertices with the model's field there; its gradient at the first ``gradients`` of them."""
    verts = template.shape.verts[loss_vertices(template)]
    field = model.field(verts, template.nodes, template.radius, kernel)
    return LossPoints(torch.from_numpy(verts).float(), field.for_training(gradients))


def build_cloud_dataset(samples: ShapeSamples, config: TrainConfig, scan: ScanConfig) -> CloudDataset:
    """Dataset of batches from a folder's samples, without an encoder."""
    points, normals, landmarks = map(torch.from_numpy, (samples.points, samples.normals, samples.landmarks))
    settings = scan, config.shapes, config.seed, config.steps
    return CloudDataset(points, normals, landmarks, build_lattice(samples), None, *settings)


def build_surface_points(
    template: Template, kernel: Kernel, model: Deformer, landmarks: Int[Ints, " L"], count: int = 1200
) -> SurfacePoints:
    """Evenly spread template vertices with normals, and the landmark vertices, each with the model's field."""
    chosen = loss_vertices(template, count)
    at, M = np.concatenate([chosen, landmarks]).astype(np.int64), len(chosen)
    field = model.field(template.shape.verts[at], template.nodes, template.radius, kernel).for_training()
    verts = torch.from_numpy(template.shape.verts[at]).float()
    normals = torch.from_numpy(template.shape.vertex_normals[chosen]).float()
    return SurfacePoints(verts[:M], field.part(0, M), normals, verts[M:], field.part(M, len(at)))
