"""What every generator is: a resting shape with its parts, and shapes without end on its vertices, in random poses."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Int, Ints
from meshmatch.shapes.normalise import Mirroring
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.template import Template, read_template

Source = Callable[[int, torch.Generator], Float[Tensor, "N V 3"]]
"""Draws shapes with the template's connectivity: (count, generator) -> vertices (count, V, 3), any unit."""


@dataclass(frozen=True, eq=False)
class Generator:
    """Shapes of a kind: the ``template`` is one at rest, with its parts; ``draw`` gives others on its vertices, of random
    identities in random poses, a function of the seed. ``data`` is what a model's card says of them, ``mirror`` whether its
    fits also try mirror images.
    """

    kind: str
    template: Template
    draw: Source
    data: str
    mirror: Mirroring = "no"


@dataclass(frozen=True, eq=False)
class Resting:
    """The shape at rest that becomes a kind's template: the part of every vertex, and those that fix the kind's frame."""

    shape: Shape  # named after the kind
    labels: Int[Ints, " V"]
    parts: tuple[str, ...]
    core: Int[Ints, " C"] | None
    nodes: NodeConfig
    source: str = ""
    licence: str = ""

    def template(self) -> Template:
        """The template of the included model of the kind, if it is of this shape; else one that is made."""
        kind = self.shape.name
        found = shipped_template(kind)
        if found is not None and np.array_equal(found.dense.faces, self.shape.faces):
            return found
        made = make_template(self.shape, kind, self.nodes, labels=self.labels, label_names=self.parts, core=self.core)
        return replace(made, source=self.source, licence=self.licence)


def shipped_template(kind: str) -> Template | None:
    """The template of the included model of a kind, if there is one."""
    shipped = bundled_folder() / "models" / kind / "template.safetensors"
    return read_template(shipped) if shipped.is_file() else None


def any_of(shapes: Float[Tensor, "N V 3"], count: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Some of a fixed set of shapes, drawn with replacement."""
    return shapes[torch.randint(len(shapes), (count,), generator=generator)]


def mixed(first: Source, second: Source, share: float) -> Source:
    """Draws shapes of the first source and, in random places, a share of the second."""
    return partial(_of_both, first, second, share)


def _of_both(
    first: Source, second: Source, share: float, count: int, generator: torch.Generator
) -> Float[Tensor, "B V 3"]:
    other = torch.rand(count, generator=generator) < share
    drawn = [source(int(rows.sum()), generator) for source, rows in ((first, ~other), (second, other)) if rows.any()]
    order = torch.argsort(torch.cat([torch.nonzero(~other)[:, 0], torch.nonzero(other)[:, 0]]))
    return torch.cat(drawn)[order]


def source_on(source: Source, device: torch.device) -> Source | None:
    """A source of ours that draws on a device, from a generator there; None of others', drawn where they like."""
    made = source.func if isinstance(source, partial) else type(source)
    return moved(source, device) if made.__module__.partition(".")[0] == __name__.partition(".")[0] else None


def moved(held: Any, device: torch.device) -> Any:
    """The same value, every tensor in it on a device: in dataclasses, tuples, modules and calls that are partly given."""
    if isinstance(held, Tensor):
        return held.to(device)
    if isinstance(held, torch.nn.Module):
        return deepcopy(held).to(device)
    if isinstance(held, partial):
        given = {name: moved(value, device) for name, value in held.keywords.items()}
        return partial(held.func, *moved(held.args, device), **given)
    if type(held) is tuple:
        return tuple(moved(each, device) for each in held)
    if is_dataclass(held) and not isinstance(held, type):
        inside = (each.name for each in fields(held) if each.init)
        return replace(held, **{name: moved(getattr(held, name), device) for name in inside})
    return held
