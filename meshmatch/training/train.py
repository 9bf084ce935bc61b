"""`meshmatch train` as a library: a folder of shapes, or generated bodies, becomes a model folder.

How a folder is learned is decided by `meshmatch.training.recipes.recipe_for`.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from meshmatch.errors import InputError, OptionError
from meshmatch.models.card import ModelCard, check_name, write_card
from meshmatch.models.checkpoint import save_weights
from meshmatch.models.registry import CARD, TEMPLATE, WEIGHTS, load_model
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import make_folder
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.templates.prepared_folder import ShapeSamples, frame_of, read_registered, read_samples
from meshmatch.templates.template import Template, read_template, save_template, template_radius
from meshmatch.training import setup
from meshmatch.training.bodies import Bodies, human_source
from meshmatch.training.datasets import Source, deformed_source, registered_source
from meshmatch.training.loop import StepReport, Trainer
from meshmatch.training.losses import held_out_error
from meshmatch.training.recipes import Recipe, recipe_for

CHECKPOINT = Path("checkpoint", "last.safetensors")  # in the model folder
VALIDATION_SEED = 999_983
"""Of the batch that no training sees and every training is measured on."""


@dataclass(frozen=True)
class CardFacts:
    """What a training is told about its model; goes onto the card, see `ModelCard`.

    Empty words are found out. The weights of ``start`` (a model of the same template, network and kernel, its name or
    folder) begin the training.
    """

    name: str = ""  # the output folder's
    category: str = ""  # the name of the folder of shapes; "human" for bodies
    data: str = ""  # a sentence about the shapes
    licence: str = "unstated"
    stiffness: float = 1.0  # 0.05 suits what differs more from shape to shape than bodies do, such as organs
    start: TrainedModel | str | Path | None = None
    frame: dict[str, str] | None = None  # as the training's shapes and network say


def train(
    output: str | Path,
    *,
    shapes: str | Path | None = None,
    bodies: Bodies | None = None,
    recipe: Recipe | None = None,
    facts: CardFacts | None = None,
    resume: bool = True,
    progress: ProgressCallback | None = None,
    report: Callable[[StepReport], None] | None = None,
) -> Path:
    """Train a model, or (with ``resume``) go on training it from the checkpoint in its folder, exactly; returns the folder.

    The folder ``output`` receives ``checkpoint/last.safetensors`` on the way and, at every stop, ``template.safetensors``,
    ``weights.safetensors`` and last ``card.json``. It learns from ``shapes``, a folder that `prepare` made, which also has
    the template, or else from generated human ``bodies``. The recipe is `recipe_for` of the shapes unless another is given,
    such as ``recipe_for(shapes, ...).changed(steps=..., minutes=...)``. ``progress`` is called with (stage, name, share),
    ``report`` with losses and validation every 50 steps.

    `InputError` if the folder is not prepared or has too few shapes; `OptionError` for choices that do not go together, or
    if the extra ``train`` is not installed; `ModelError` for a name that cannot be one, or a checkpoint of another
    training; `OutputError` if the folder cannot be written.
    """
    output = Path(output)
    facts = facts or CardFacts()
    facts = replace(facts, name=check_name(facts.name or output.resolve().name))
    if isinstance(facts.start, str | Path):
        facts = replace(facts, start=load_model(facts.start))
    recipe = recipe or recipe_for(shapes)
    source: Source | ShapeSamples
    if shapes is None:
        bodies = bodies or Bodies()
        template = read_template(bodies.template)
        making = Progress(progress, "bodies").stage("making bodies (once)")
        source = human_source(template, bodies.identities, recipe.train.seed, making, bodies.poses)
        category, data = "human", bodies.words
    elif bodies is not None:
        raise OptionError("poses and bodies do not go with a folder of shapes", "leave out one of the two")
    else:
        template = read_template(Path(shapes) / TEMPLATE)
        category = Path(shapes).resolve().name
        source, data = _source(Path(shapes), template, recipe)
        if recipe.deform and facts.frame is None:
            facts = replace(facts, frame=frame_of(shapes))
    facts = replace(facts, category=facts.category or category, data=facts.data or data)

    def both(now: StepReport) -> None:
        if progress is not None:
            progress(now.words, "training", now.step / now.steps)
        if report is not None:
            report(now)

    return train_model(template, source, output, recipe, facts, resume, both)


def _source(shapes: Path, template: Template, recipe: Recipe) -> tuple[Source | ShapeSamples, str]:
    """The shapes of a prepared folder as a recipe needs them, and a few words about them."""
    name = shapes.resolve().name
    if recipe.train.loss.needs_correspondence:
        verts = torch.from_numpy(read_registered(shapes, template))
        source = (deformed_source if recipe.deform else registered_source)(verts)
        return source, f"{len(verts)} registered shapes of {name}"
    samples = read_samples(shapes, template)
    known = f" and {len(samples.template_landmarks)} known points" if len(samples.template_landmarks) else ""
    return samples, f"{len(samples.points)} shapes of {name}, without correspondence{known}"


def train_model(
    template: Template,
    source: Source | ShapeSamples,
    output: str | Path,
    recipe: Recipe,
    facts: CardFacts,
    resume: bool = True,
    report: Callable[[StepReport], None] | None = None,
) -> Path:
    """`train` on shapes with the template's vertices, or on samples without correspondence; returns the folder.

    `InputError` if there is only one shape; `OptionError` if the model to start from has another template, network or
    kernel.
    """
    output = Path(output)
    checkpoint = output / CHECKPOINT
    make_folder(checkpoint.parent)
    config, kernel = recipe.train, recipe.kernel
    if recipe.scan.sphere:  # lengths of the paper are in the unit sphere
        config = replace(
            config,
            loss=replace(config.loss, reconstruction=config.loss.reconstruction / template_radius(template) ** 2),
        )
        facts = replace(facts, frame=facts.frame or {"orientation": "searched", "scale": "sphere"})
    points: Any
    data: Any = source
    if isinstance(source, ShapeSamples):
        if len(source.points) < 2:
            hint = "prepare a folder of several; ten or more are better"
            raise InputError("one shape is too few to learn from", hint)
        data = setup.build_cloud_dataset(source, config, recipe.scan)
    model = setup.build_deformer(template, data, recipe.network, recipe.scan, kernel, config.seed)
    if isinstance(start := facts.start, TrainedModel):
        theirs = start.template.hash, start.network.config, start.card.field["kernel"]
        if theirs != (template.hash, recipe.network, kernel):
            hint = "start from a model of the same template and preset, or from nothing"
            raise OptionError(f"model {start.card.name} has another template, network or kernel", hint)
        model.load_state_dict(start.network.state_dict())
    if isinstance(source, ShapeSamples):
        data = replace(data, encoder=deepcopy(model.encoder).cpu())
        points = setup.build_surface_points(template, kernel, model, source.template_landmarks)
        facts = replace(facts, frame=facts.frame or {"orientation": source.align, "scale": source.scale})
        few = {"shapes": min(32, 2 * len(source.points))}
    else:
        points = setup.build_loss_points(template, kernel, model)
        size = config.shapes, config.scans_per_shape
        data = setup.build_dataset(template, source, model, recipe.scan, *size, config.seed, config.steps)
        few = {"shapes": 32, "scans_per_shape": 1}
    held_out = replace(data, seed=VALIDATION_SEED, **few)[0]
    trainer = Trainer(model, points, config)
    if resume and checkpoint.is_file():
        trainer.load(checkpoint)
        for name in ("encoder", "aligner"):  # what reads the batches are copies (see `build_dataset`)
            if (reader := getattr(data, name, None)) is not None:
                reader.load_state_dict(getattr(trainer.model, name).state_dict())
    trainer.run(data, checkpoint, report, lambda model: held_out_error(model, held_out, trainer.points))
    trainer.close()
    if trainer.rank == 0:
        trainer.model.load_state_dict(trainer.averaged_state())
        export(trainer, template, output, recipe, facts, held_out_error(trainer.model, held_out, trainer.points))
    return output


def export(trainer: Trainer, template: Template, output: Path, recipe: Recipe, facts: CardFacts, score: float) -> None:
    """Write the averaged weights as a model folder, with the validation error ``score``; the card comes last."""
    (output / CARD).unlink(missing_ok=True)
    save_template(template, output / TEMPLATE)
    digest = save_weights(trainer.averaged_state(), output / WEIGHTS, storage=recipe.storage)
    settings: dict[str, Any] = {"train": asdict(recipe.train), "scan": asdict(recipe.scan)}
    if isinstance(facts.start, TrainedModel):
        begun = facts.start.card
        settings["start"] = {"model": begun.name, "weights_sha256": begun.weights_sha256, "steps": begun.steps}
    frame: dict[str, Any] = {} if facts.frame is None else {"frame": facts.frame}
    card = ModelCard(
        name=facts.name, category=facts.category, template=template.name, template_hash=template.hash,
        network=recipe.network.to_dict(),
        field={"kernel": recipe.kernel, "radius": template.radius, "nodes": template.K},
        data=facts.data, licence=facts.licence, recipe=settings, seed=recipe.train.seed, steps=trainer.step,
        training_minutes=round(trainer.seconds / 60, 1), metrics={"validation": {"distance": round(score, 5)}},
        weights_sha256=digest, created=datetime.date.today().isoformat(), stiffness=facts.stiffness, **frame,
    )  # fmt: skip
    write_card(card, output / CARD)
