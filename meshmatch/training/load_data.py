"""Load the data that a model is trained on: a prepared folder, fits, or generated shapes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from meshmatch.errors import InputError, OptionError, warn
from meshmatch.generators.bodies import Bodies
from meshmatch.generators.characters import people_source
from meshmatch.generators.generator import Source, bundled_template
from meshmatch.generators.kinds import Kind
from meshmatch.generators.proportions import STYLISED
from meshmatch.models.registry import TEMPLATE
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import as_path
from meshmatch.progress import Progress
from meshmatch.shapes.alignment import Mirroring
from meshmatch.templates.prepared_folder import (
    RegisteredShapes,
    ShapeSamples,
    card_frame,
    has_sides,
    read_registered,
    read_samples,
)
from meshmatch.templates.template import Template, read_template
from meshmatch.training.datasets import deformed_source, fixed_pool, registered_source
from meshmatch.training.recipes import Recipe

_RESAMPLED = "the learned shapes, drawn anew"


@dataclass(frozen=True, eq=False)
class TrainingData:
    """A template, a source of shapes on its vertices or samples without correspondence, and facts for the model card."""

    template: Template
    source: Source | ShapeSamples
    category: str  # empty where it is unknown
    data: str  # short description of the shapes
    frame: dict[str, str] | None = None  # how fits find the orientation and scale, where the shapes determine it
    mirror: Mirroring = "no"  # "auto" where shapes come in left and right versions
    validation_source: Source | None = None  # used for validation where the source repeats a fixed pool of shapes
    digest: str = ""  # hash of the shapes, independent of their path; a checkpoint resumes only with the same shapes
    shape_digests: frozenset[str] = frozenset()  # one hash for each registered shape
    measured: str = ""  # short description of the validation shapes; empty if they are newly generated ones


def _load_generated(kind: Kind | Bodies, recipe: Recipe, progress: Progress) -> TrainingData:
    """Generated shapes; raises the errors of their generators."""
    seed = recipe.train.seed
    if isinstance(kind, Kind):
        generator = kind.generator(seed, progress)
        return TrainingData(
            generator.template,
            generator.draw,
            generator.kind,
            generator.data,
            mirror=generator.mirror,
            digest=_digest(generator.data),
        )
    if kind.characters is None:
        kind = replace(kind, characters=recipe.characters)
    if kind.stylised is None and recipe.stylised != STYLISED:
        kind = replace(kind, stylised=recipe.stylised)
    if kind.bodies is None:
        kind = replace(kind, bodies=recipe.bodies)
    template = read_template(kind.template or recipe.template)
    source = people_source(template, kind, seed, progress)
    pool = fixed_pool(source, kind.bodies, seed, progress) if kind.bodies else source
    return TrainingData(template, pool, "human", kind.words, validation_source=source, digest=_digest(kind.words))


def _load_prepared(shapes: Path, recipe: Recipe) -> TrainingData:
    """Shapes of a prepared folder: registered ones or samples, as the recipe's loss requires.

    `InputError` if the folder is not a prepared one.
    """
    template = read_template(shapes / TEMPLATE)
    name = shapes.resolve().name
    frame = card_frame(shapes) if recipe.deform else None
    mirror: Mirroring = "auto" if has_sides(shapes) else "no"
    if recipe.train.loss.needs_correspondence:
        verts = read_registered(shapes, template)
        source = (deformed_source if recipe.deform else registered_source)(torch.from_numpy(verts))
        data, each = f"{len(verts)} registered shapes of {name}", _shape_digests(verts)
        return TrainingData(template, source, "", data, frame, mirror, None, _digest(verts), each, _RESAMPLED)
    samples = read_samples(shapes, template)
    landmark_note = f" and {len(samples.template_landmarks)} known points" if len(samples.template_landmarks) else ""
    data = f"{len(samples.points)} shapes of {name}, without correspondence{landmark_note}"
    digest = _digest(samples.points, samples.landmarks)
    return TrainingData(template, samples, "", data, frame, mirror, digest=digest, measured=_RESAMPLED)


def _digest(*parts: np.ndarray | str) -> str:
    """Hash of arrays, or of a description where shapes are newly generated."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()[:16]


def _shape_digests(verts: np.ndarray) -> frozenset[str]:
    """Hash of each of N registered shapes."""
    return frozenset(_digest(each) for each in verts)


def known_template(
    shapes: str | Path | RegisteredShapes | None, kind: Kind | Bodies | None, recipe: Recipe, start: TrainedModel
) -> Template | None:
    """The template that `load_training_data` will return, without making any shapes.

    None if it is not known in advance: for a start model of the same `Kind`, whose generator may make another template.
    `TemplateError` if the template is missing or damaged.
    """
    if isinstance(shapes, RegisteredShapes):
        return shapes.template
    if shapes is not None:
        return read_template(as_path(shapes) / TEMPLATE)
    if isinstance(kind, Kind):
        return None if start.template.name == kind.name else bundled_template(kind.name)
    return read_template((kind.template if kind else None) or recipe.template)


def check_start(start: TrainedModel, template: Template | None, recipe: Recipe) -> None:
    """Raise `OptionError` unless the start model has the same template (if known), network and kernel as the training."""
    matches = {
        "template": template is None or start.template.hash == template.hash,
        "network": start.inference.config == recipe.network,
        "kernel": start.card.field["kernel"] == recipe.kernel,
    }
    if differing := [name for name, equal in matches.items() if not equal]:
        hint = f"fit your shapes with it (`meshmatch fit ... --model {start.card.name}`), and train on the fits"
        raise OptionError(f"model {start.card.name} has another {' and another '.join(differing)}", hint)


def with_validation(shapes: str | Path | RegisteredShapes | None, training_data: TrainingData) -> TrainingData:
    """Use other registered ``shapes``, if given, for validation; warns if some of them are training shapes as well.

    `InputError` for a folder that is not prepared, or another template; `OptionError` if training needs no
    correspondence: it is then validated on samples.
    """
    if shapes is None:
        return training_data
    if isinstance(training_data.source, ShapeSamples):
        raise OptionError("training without correspondence cannot be validated on registered shapes", "leave them out")
    if isinstance(shapes, RegisteredShapes):
        verts, name = np.asarray(shapes.verts, np.float32), shapes.name
        if shapes.template.hash != training_data.template.hash:
            raise InputError(f"{name}: these are fits of another template", "fit them with the same model")
        description = f"{len(verts)} fits of {name}"
    else:
        verts, name = read_registered(shapes, training_data.template), as_path(shapes).resolve().name
        description = f"{len(verts)} registered shapes of {name}"
    if n_shared := len(_shape_digests(verts) & training_data.shape_digests):
        warn(f"{name}: {n_shared} of {len(verts)} validation shapes are also training shapes")
    return replace(training_data, validation_source=registered_source(torch.from_numpy(verts)), measured=description)


def default_kind(name: str) -> Kind | Bodies:
    """Default generator settings of a kind; `OptionError` if its name is unknown."""
    return Bodies() if name == "human" else Kind(name)


def load_training_data(
    shapes: str | Path | RegisteredShapes | None, kind: Kind | Bodies | None, recipe: Recipe, progress: Progress
) -> TrainingData:
    """Load shapes from a folder or from fits, or generate them; `OptionError` if both are requested."""
    if shapes is None:
        return _load_generated(kind or Bodies(), recipe, progress)
    if kind is not None:
        raise OptionError("generated shapes cannot be combined with a folder of shapes", "leave out one of the two")
    if isinstance(shapes, RegisteredShapes):
        verts = np.asarray(shapes.verts, np.float32)
        source = deformed_source(torch.from_numpy(verts))
        rest: dict[str, Any] = {
            "digest": _digest(verts),
            "shape_digests": _shape_digests(verts),
            "measured": _RESAMPLED,
        }
        description = f"{len(verts)} fits of {shapes.name}"
        if shapes.orientation is None:
            return TrainingData(shapes.template, source, shapes.name, description, **rest)
        frame = {"orientation": shapes.orientation, "scale": "area"}
        sides: Mirroring = "auto" if shapes.mirror else "no"
        return TrainingData(shapes.template, source, "", f"{description}, without a model", frame, sides, **rest)
    return _load_prepared(as_path(shapes), recipe)
