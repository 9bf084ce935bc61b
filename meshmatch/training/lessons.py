"""What a training learns from: the shapes of a prepared folder, or generated ones."""

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
from meshmatch.generators.generator import Source, shipped_template
from meshmatch.generators.kinds import Kind
from meshmatch.generators.proportions import STYLISED
from meshmatch.models.registry import TEMPLATE
from meshmatch.models.trained import TrainedModel
from meshmatch.outputs import as_path
from meshmatch.progress import Progress
from meshmatch.shapes.normalise import Mirroring
from meshmatch.templates.prepared_folder import (
    RegisteredShapes,
    ShapeSamples,
    frame_of,
    has_sides,
    read_registered,
    read_samples,
)
from meshmatch.templates.template import Template, read_template
from meshmatch.training.datasets import deformed_source, drawn_once, registered_source
from meshmatch.training.recipes import Recipe

_AGAIN = "the learned shapes, drawn anew"


@dataclass(frozen=True, eq=False)
class Lessons:
    """A template, shapes on its vertices or samples without correspondence, and what the card says of them."""

    template: Template
    source: Source | ShapeSamples
    category: str  # empty where nothing says what the shapes are
    data: str  # a few words
    frame: dict[str, str] | None = None  # how fits find it, where the shapes say so
    mirror: Mirroring = "no"  # "auto" where shapes come in two sides
    unseen: Source | None = None  # draws shapes to be measured on, where the source draws but few again and again
    digest: str = ""  # the same for the same shapes, wherever they lie: a checkpoint goes on with no others
    each: frozenset[str] = frozenset()  # the same of each registered shape
    measured: str = ""  # what is measured on, in a few words, unless it is more of what is generated


def generated(kind: Kind | Bodies, recipe: Recipe, progress: Progress) -> Lessons:
    """Generated shapes; errors are those of their generators."""
    seed = recipe.train.seed
    if isinstance(kind, Kind):
        made = kind.generator(seed, progress)
        return Lessons(made.template, made.draw, made.kind, made.data, mirror=made.mirror, digest=_digest(made.data))
    if kind.characters is None:
        kind = replace(kind, characters=recipe.characters)
    if kind.stylised is None and recipe.stylised != STYLISED:
        kind = replace(kind, stylised=recipe.stylised)
    if kind.bodies is None:
        kind = replace(kind, bodies=recipe.bodies)
    template = read_template(kind.template or recipe.template)
    source = people_source(template, kind, seed, progress)
    few = drawn_once(source, kind.bodies, seed, progress) if kind.bodies else source
    return Lessons(template, few, "human", kind.words, unseen=source, digest=_digest(kind.words))


def prepared(shapes: Path, recipe: Recipe) -> Lessons:
    """The shapes of a folder that `prepare` made, as a recipe needs them; `InputError` if it is none."""
    template = read_template(shapes / TEMPLATE)
    name = shapes.resolve().name
    frame = frame_of(shapes) if recipe.deform else None
    mirror: Mirroring = "auto" if has_sides(shapes) else "no"
    if recipe.train.loss.needs_correspondence:
        verts = read_registered(shapes, template)
        source = (deformed_source if recipe.deform else registered_source)(torch.from_numpy(verts))
        data, each = f"{len(verts)} registered shapes of {name}", _each(verts)
        return Lessons(template, source, "", data, frame, mirror, None, _digest(verts), each, _AGAIN)
    samples = read_samples(shapes, template)
    known = f" and {len(samples.template_landmarks)} known points" if len(samples.template_landmarks) else ""
    data = f"{len(samples.points)} shapes of {name}, without correspondence{known}"
    digest = _digest(samples.points, samples.landmarks)
    return Lessons(template, samples, "", data, frame, mirror, digest=digest, measured=_AGAIN)


def _digest(*parts: np.ndarray | str) -> str:
    """Of arrays, or of words where shapes are generated anew."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part.encode() if isinstance(part, str) else np.ascontiguousarray(part).tobytes())
    return found.hexdigest()[:16]


def _each(verts: np.ndarray) -> frozenset[str]:
    """Of each of N registered shapes."""
    return frozenset(_digest(each) for each in verts)


def template_of(
    shapes: str | Path | RegisteredShapes | None, kind: Kind | Bodies | None, recipe: Recipe, start: TrainedModel
) -> Template | None:
    """The template that `lessons` will have, where it is known before shapes are made: for a model to start from that is of
    their kind a `Kind` may make another. `TemplateError` if it is missing or damaged.
    """
    if isinstance(shapes, RegisteredShapes):
        return shapes.template
    if shapes is not None:
        return read_template(as_path(shapes) / TEMPLATE)
    if isinstance(kind, Kind):
        return None if start.template.name == kind.name else shipped_template(kind.name)
    return read_template((kind.template if kind else None) or recipe.template)


def check_start(start: TrainedModel, template: Template | None, recipe: Recipe) -> None:
    """`OptionError` if a training with that template and recipe cannot begin with the weights of a model."""
    same = {
        "template": template is None or start.template.hash == template.hash,
        "network": start.inference.config == recipe.network,
        "kernel": start.card.field["kernel"] == recipe.kernel,
    }
    if other := [name for name, equal in same.items() if not equal]:
        hint = f"fit your shapes with it (`meshmatch fit ... --model {start.card.name}`), and train on the fits"
        raise OptionError(f"model {start.card.name} has another {' and another '.join(other)}", hint)


def measured_on(shapes: str | Path | RegisteredShapes | None, learned: Lessons) -> Lessons:
    """The same lessons, measured on other registered shapes if there are some; warns of those that are learned, too.

    `InputError` for a folder that is not prepared, or for another template; `OptionError` where learning needs no
    correspondence, and is measured without.
    """
    if shapes is None:
        return learned
    if isinstance(learned.source, ShapeSamples):
        raise OptionError("learning without correspondence is not measured on registered shapes", "leave them out")
    if isinstance(shapes, RegisteredShapes):
        verts, name = np.asarray(shapes.verts, np.float32), shapes.name
        if shapes.template.hash != learned.template.hash:
            raise InputError(f"{name}: these are fits of another template", "fit them with the same model")
        words = f"{len(verts)} fits of {name}"
    else:
        verts, name = read_registered(shapes, learned.template), as_path(shapes).resolve().name
        words = f"{len(verts)} registered shapes of {name}"
    if same := len(_each(verts) & learned.each):
        warn(f"{name}: {same} of {len(verts)} shapes to be measured on are learned as well")
    return replace(learned, unseen=registered_source(torch.from_numpy(verts)), measured=words)


def kind_named(name: str) -> Kind | Bodies:
    """What is generated for the name of a kind; `OptionError` if there is none."""
    return Bodies() if name == "human" else Kind(name)


def lessons(
    shapes: str | Path | RegisteredShapes | None, kind: Kind | Bodies | None, recipe: Recipe, progress: Progress
) -> Lessons:
    """The shapes of a folder, or generated ones; `OptionError` if both are asked for."""
    if shapes is None:
        return generated(kind or Bodies(), recipe, progress)
    if kind is not None:
        raise OptionError("generated shapes do not go with a folder of shapes", "leave out one of the two")
    if isinstance(shapes, RegisteredShapes):
        verts = np.asarray(shapes.verts, np.float32)
        source = deformed_source(torch.from_numpy(verts))
        rest: dict[str, Any] = {"digest": _digest(verts), "each": _each(verts), "measured": _AGAIN}
        known = f"{len(verts)} fits of {shapes.name}"
        if shapes.orientation is None:
            return Lessons(shapes.template, source, shapes.name, known, **rest)
        frame = {"orientation": shapes.orientation, "scale": "area"}
        sides: Mirroring = "auto" if shapes.mirror else "no"
        return Lessons(shapes.template, source, "", f"{known}, without a model", frame, sides, **rest)
    return prepared(as_path(shapes), recipe)
