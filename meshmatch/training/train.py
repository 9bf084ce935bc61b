"""`meshmatch train` as a library: a folder of shapes, or generated bodies, becomes a model folder.

How a folder is learned is decided by `meshmatch.training.recipes.recipe_for`.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Int, Ints
from meshmatch.errors import InputError, OptionError, TemplateError
from meshmatch.fields.field import Field
from meshmatch.fields.shape_functions import has_nodes, shape_functions
from meshmatch.generators.bodies import Bodies
from meshmatch.generators.generator import Source
from meshmatch.generators.kinds import Kind
from meshmatch.geometry.kernels import Kernel
from meshmatch.models.card import ModelCard, check_name, write_card
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
from meshmatch.training.alone import ALIGNER, alone
from meshmatch.training.alone import CHECKPOINT as CHECKPOINT
from meshmatch.training.datasets import BatchDataset, CloudDataset, build_lattice
from meshmatch.training.facts import CardFacts as CardFacts
from meshmatch.training.facts import inherited
from meshmatch.training.lessons import Lessons, check_start, kind_named, lessons, measured_on, template_of
from meshmatch.training.loop import StepReport, TrainConfig, Trainer
from meshmatch.training.losses import LossPoints, SurfacePoints, held_out_error
from meshmatch.training.recipe_files import recipe_record
from meshmatch.training.recipes import Recipe, going_on, recipe_for, small_data
from meshmatch.training.records import CURVES, METRICS, Metrics, Report, check_curves, curves, in_turn
from meshmatch.training.scans import ScanConfig

BEST = "best"
"""The folder of the model with the lowest validation error so far."""
VALIDATION_SEED = 999_983
"""Of the batch that no training sees and every training is measured on."""


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
    """Train a model, or go on training it from the checkpoint in its folder, exactly.

    The folder receives ``checkpoint/last.safetensors`` and ``metrics.jsonl`` on the way and, at every stop,
    ``template.safetensors``, ``weights.safetensors`` and last ``card.json``; and in ``best`` the same of the model with the
    lowest validation error, which is measured every 500 steps and at the end.

    Parameters
    ----------
    output
        The model's folder.
    shapes
        A folder that `prepare` made, which also has the template; or fits (``Collection(FITS).to_learn()``): a
        model that made them goes on learning from them, and what no model made is learned anew.
    kind
        Or generated shapes: "human" (the default), "quadruped", "hand" or "head"; or `Bodies` or a `Kind` with choices.
    recipe
        Losses, sizes and steps, such as ``recipe_for(shapes, ...).changed(minutes=60)``; by default chosen for the
        shapes.
    facts
        What the card says of the model: name, category, licence.
    resume
        Go on from a checkpoint if there is one.
    validation
        Registered shapes to measure on, which the training does not see: a folder that `prepare` made with the same
        template, or fits as for ``shapes``. By default more of what is learned.
    tensorboard
        Also write curves for TensorBoard (the extra ``tensorboard``), into the folder ``tensorboard``.
    progress
        As in `match`.
    report
        Called with losses and validation every 50 steps.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    InputError
        A folder is not prepared, or has too few shapes.
    OptionError
        Choices do not go together, or the extra ``train`` or ``tensorboard`` is not installed.
    ModelError
        The name cannot be one, or the checkpoint is of another training.
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
    kind = kind_named(kind) if isinstance(kind, str) else kind
    of_model = shapes.model if isinstance(shapes, RegisteredShapes) and shapes.model != NO_MODEL else None
    start = facts.start or of_model
    start = load_model(start) if isinstance(start, str | Path) else start
    facts = replace(facts, start=start)
    if not isinstance(shapes, RegisteredShapes):
        recipe = recipe or recipe_for(shapes, kind=None if kind is None else kind.name)
    elif of_model is None:
        recipe = recipe or small_data()
    else:
        assert start is not None
        if Path(shapes.model).resolve() == output.resolve():
            raise OptionError(f"{output} is the model that made the fits", "choose another folder")
        facts, recipe = inherited(facts, start.card), recipe or going_on(start)
    if start is not None:
        check_start(start, template_of(shapes, kind, recipe, start), recipe)  # shapes may take minutes to make

    if tensorboard:
        check_curves()

    making = Progress(progress, "shapes").stage("making shapes (once)")

    def make() -> Lessons:
        return measured_on(validation, lessons(shapes, kind, recipe, making))

    return _learn(output, facts, recipe, resume, report, tensorboard, make, Progress(progress, "training"))


@alone
def _learn(
    output: str | Path, facts: CardFacts, recipe: Recipe, resume: bool, report: Report | None, tensorboard: bool,
    make: Callable[[], Lessons], progress: Progress,
) -> Path:  # fmt: skip
    """What `train` does once its folder is its own."""
    learned = make()
    facts = replace(facts, category=facts.category or learned.category or facts.name, data=facts.data or learned.data)
    facts = replace(facts, frame=facts.frame or learned.frame, mirror=facts.mirror or learned.mirror)
    facts = replace(facts, measured=facts.measured or learned.measured)
    return train_model(
        learned.template, learned.source, output, recipe, facts, resume, report, learned.unseen, tensorboard, progress,
        learned.digest,
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
    """`train` on shapes with the template's vertices, validated on ``unseen`` ones or on more of the same, or on samples
    without correspondence; returns the folder. The shapes' ``digest`` is that of `Lessons`.

    `InputError` of a single shape; `OptionError` if the model to start from has another template, network or kernel.
    """
    checkpoint = (output := Path(output)) / CHECKPOINT
    name = facts.name or output.resolve().name
    facts = replace(facts, name=name, category=facts.category or name)
    record = recipe_record(recipe)
    _card(template, recipe, facts, record)  # what a card could not hold is refused now, not at the end
    make_folder(checkpoint.parent)
    config, kernel = recipe.train, recipe.kernel
    if recipe.scan.sphere and getattr(source, "scale", "sphere") == "sphere":  # the paper's lengths are in it
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
        few: dict[str, Any] = {"shapes": min(32, 2 * len(source.points))}
    else:
        turned = {"orientation": "searched", "scale": "sphere"} if recipe.scan.sphere else None
        facts = replace(facts, frame=facts.frame or turned)
        points = build_loss_points(template, kernel, model)
        size = config.shapes, config.scans_per_shape, config.seed, config.steps
        data = build_dataset(template, source, model, recipe.scan, *size)
        few = {"shapes": 32, "scans_per_shape": 1, "source": unseen or source}
    resumed = resume and checkpoint.is_file()
    aligning = None if progress is None else progress.stage("orientations alone (once)")
    aligned = Aligned() if resumed else align(model, data, config, output / ALIGNER, resume, aligning)
    held_out = replace(data, seed=VALIDATION_SEED, **few)[0]
    trainer = Trainer(model, points, config, digest, record | {"kernel": recipe.kernel})
    if resumed:
        trainer.load(checkpoint)
        for name in ("encoder", "aligner"):  # what reads the batches are copies (see `build_dataset`)
            if (reader := getattr(data, name, None)) is not None:
                reader.load_state_dict(getattr(trainer.model, name).state_dict())

    def error(_: Deformer) -> float:
        """Of the averaged weights, which the model will have."""
        with trainer.averaged():
            return held_out_error(trainer.model, held_out, trainer.points)

    def keep(score: float | None) -> None:
        if score is not None and metrics.is_best(score):
            make_folder(output / BEST)
            export(trainer, template, output / BEST, recipe, facts, score)

    if trainer.rank == 0:
        metrics = Metrics(output / METRICS, trainer)
        drawn = curves(output / CURVES, trainer.step) if tensorboard else None
        report = in_turn(metrics, drawn, report, lambda now: keep(now.validation))
    trainer.seconds += aligned.of_all
    if not trainer.any_says(not aligned.done):
        trainer.run(data, checkpoint, report, error, spent=aligned.seconds, progress=progress)
        (output / ALIGNER).unlink(missing_ok=True)
    trainer.close()
    if trainer.rank == 0:
        score = error(trainer.model)
        if (output / BEST).is_dir():
            keep(score)
        export(trainer, template, output, recipe, facts, score)
    return output


def align(
    model: Deformer, data: Any, config: TrainConfig, checkpoint: Path, resume: bool, progress: Progress | None
) -> Aligned:
    """The aligner alone, if a training begins with it."""
    if not resume:
        checkpoint.unlink(missing_ok=True)
    if not config.align_steps or not isinstance(data, BatchDataset) or model.aligner is None:
        return Aligned()
    torch.set_num_threads(config.threads)
    model.to(training_device(int(os.environ.get("LOCAL_RANK", 0)), config.device))
    return train_aligner(model, data, config.align_steps, progress, config.draw, config.minutes, checkpoint)


def check_encoder(model: Deformer, P: int) -> None:
    """`ModelError` if an encoder of one's own fails on two clouds of P points: told before anything is learned, and without
    a trace in what is."""
    with torch.random.fork_rng(devices=[]):
        deepcopy(model).train().code_of(0.3 * torch.randn(2, P, 3))


def export(trainer: Trainer, template: Template, output: Path, recipe: Recipe, facts: CardFacts, score: float) -> None:
    """Write the averaged weights as a model folder, with the validation error ``score``; the card comes last."""
    (output / CARD).unlink(missing_ok=True)
    save_template(template, output / TEMPLATE)
    digest = save_weights(trainer.averaged_state(), output / WEIGHTS, storage=recipe.storage)
    history: dict[str, Any] = {"earlier": trainer.earlier, "validation": facts.measured}
    history |= {"processes": trainer.world} if trainer.world > 1 else {}
    settings = recipe_record(recipe) | {name: value for name, value in history.items() if value}
    if isinstance(facts.start, TrainedModel):
        begun = facts.start.card
        settings["start"] = {"model": begun.name, "weights_sha256": begun.weights_sha256, "steps": begun.steps}
    card = replace(
        _card(template, recipe, facts, settings), steps=trainer.step, training_minutes=round(trainer.seconds / 60, 1),
        metrics={"validation": {"distance": round(score, 5)}}, weights_sha256=digest,
    )  # fmt: skip
    write_card(card, output / CARD)


def _card(template: Template, recipe: Recipe, facts: CardFacts, settings: dict[str, Any]) -> ModelCard:
    """The card of a model that has learned nothing yet; `ModelError` of facts that no card can hold."""
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
    """Basis points spread where shapes of the category are: farthest points of jittered samples."""
    flat = points.flatten(0, 1)
    flat = flat[torch.randperm(len(flat), generator=generator)[:20_000]]
    jittered = flat + 0.06 * torch.randn(len(flat), 3, generator=generator)
    # Farthest points run to the outliers of a set: leave out the outermost ones first.
    jittered = jittered[jittered.norm(dim=1) < torch.quantile(jittered.norm(dim=1), 0.995)]
    return jittered[torch.from_numpy(farthest_points(jittered.double().numpy(), M))]


def anchor_vertices(template: Template, A: int) -> Int[Ints, " A"]:
    """Template vertices where corrections look at the scan; `TemplateError` if there are fewer than that."""
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
    """An untrained network for a template, its basis points laid where the source's shapes are."""
    basis = align_basis = torch.zeros(1, 3)
    if network.encoder != "point" or network.align_basis:
        if isinstance(source, CloudDataset):
            points = replace(source, shapes=64, seed=seed + 1)[0].points
        else:
            points = build_dataset(template, source, None, scan, shapes=48, scans_per_shape=2, seed=seed)[0].points
        generator = torch.Generator().manual_seed(seed)
        basis = fill_basis(points, network.basis, generator)
        if network.align_basis:
            turned = points - points.mean(1, keepdim=True)
            direction = torch.nn.functional.normalize(torch.randn(turned.shape, generator=generator), dim=-1)
            align_basis = fill_basis(turned.norm(dim=-1, keepdim=True) * direction, network.align_basis, generator)
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
    """Evenly spread template vertices that a loss is computed on."""
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
    """Batches of a source for a model, or for none as yet, supervised on evenly spread template vertices.

    It stays on the CPU, wherever the model goes: so it has its encoders' copies.
    """
    verts = torch.from_numpy(np.array(template.shape.verts)).float()
    core = torch.from_numpy(template.core)
    faces, supervised = torch.from_numpy(np.array(template.shape.faces)), torch.from_numpy(loss_vertices(template))
    encoder = None if model is None else deepcopy(model.encoder).cpu()
    aligner = None if model is None or model.aligner is None else deepcopy(model.aligner).cpu()
    settings = scan, shapes, scans_per_shape, seed, length, template_radius(template) if scan.sphere else None
    return BatchDataset(source, faces, verts[core], core, supervised, encoder, aligner, *settings)


def build_loss_points(template: Template, kernel: Kernel, model: Deformer, gradients: int = 400) -> LossPoints:
    """The model's field at the supervised vertices; its gradient at the first ``gradients`` of them."""
    verts = template.shape.verts[loss_vertices(template)]
    field = model.field(verts, template.nodes, template.radius, kernel)
    return LossPoints(torch.from_numpy(verts).float(), field.for_training(gradients))


def build_cloud_dataset(samples: ShapeSamples, config: TrainConfig, scan: ScanConfig) -> CloudDataset:
    """Batches of a folder's samples, as yet without an encoder."""
    points, normals, known = map(torch.from_numpy, (samples.points, samples.normals, samples.landmarks))
    settings = scan, config.shapes, config.seed, config.steps
    return CloudDataset(points, normals, known, build_lattice(samples), None, *settings)


def build_surface_points(
    template: Template, kernel: Kernel, model: Deformer, landmarks: Int[Ints, " L"], count: int = 1200
) -> SurfacePoints:
    """Evenly spread template vertices, and the landmark vertices, with what a Chamfer distance needs of them."""
    chosen = loss_vertices(template, count)
    at, M = np.concatenate([chosen, landmarks]).astype(np.int64), len(chosen)
    field = model.field(template.shape.verts[at], template.nodes, template.radius, kernel).for_training()
    verts = torch.from_numpy(template.shape.verts[at]).float()
    normals = torch.from_numpy(template.shape.vertex_normals[chosen]).float()
    return SurfacePoints(verts[:M], field.part(0, M), normals, verts[M:], field.part(M, len(at)))
