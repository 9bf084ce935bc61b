"""Base types of generators: a template shape at rest with its parts, and a source of random shapes on its vertices."""

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
from meshmatch.shapes.alignment import Mirroring
from meshmatch.shapes.shape import Shape
from meshmatch.templates.location import bundled_folder
from meshmatch.templates.make import NodeConfig, make_template
from meshmatch.templates.template import Template, read_template

Source = Callable[[int, torch.Generator], Float[Tensor, "N V 3"]]
"""Draws shapes with the template's connectivity: (count, generator) -> vertices (count, V, 3), any unit."""


@dataclass(frozen=True, eq=False)
class Generator:
    """A kind of shapes.

    ``template`` is a shape at rest, with its parts. ``draw`` returns shapes on its vertices, with random identities and
    poses, determined by the seed. ``data`` describes them on a model's card; ``mirror`` is whether fits also try mirror
    images.
    """

    kind: str
    template: Template
    draw: Source
    data: str
    mirror: Mirroring = "no"


@dataclass(frozen=True, eq=False)
class RestShape:
    """A shape at rest that becomes a kind's template, with the part of every vertex and the core's vertices."""

    shape: Shape  # its name is that of the kind
    labels: Int[Ints, " V"]
    parts: tuple[str, ...]
    core: Int[Ints, " C"] | None
    nodes: NodeConfig
    source: str = ""
    licence: str = ""

    def template(self) -> Template:
        """Return the template of the bundled model of the kind if it has the same faces, else make a new one."""
        kind = self.shape.name
        bundled = bundled_template(kind)
        if bundled is not None and np.array_equal(bundled.dense.faces, self.shape.faces):
            return bundled
        new_template = make_template(
            self.shape, kind, self.nodes, labels=self.labels, label_names=self.parts, core=self.core
        )
        return replace(new_template, source=self.source, licence=self.licence)


def bundled_template(kind: str) -> Template | None:
    """Template of the bundled model of a kind, if there is one."""
    path = bundled_folder() / "models" / kind / "template.safetensors"
    return read_template(path) if path.is_file() else None


def draw_any(shapes: Float[Tensor, "N V 3"], count: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
    """Draw ``count`` of N fixed shapes with replacement."""
    return shapes[torch.randint(len(shapes), (count,), generator=generator)]


def mix_sources(first: Source, second: Source, share: float) -> Source:
    """Source that draws from two others; each shape is of the second with probability ``share``."""
    return partial(_draw_mixed, first, second, share)


def _draw_mixed(
    first: Source, second: Source, share: float, count: int, generator: torch.Generator
) -> Float[Tensor, "B V 3"]:
    from_second = torch.rand(count, generator=generator) < share
    batches = [
        source(int(rows.sum()), generator)
        for source, rows in ((first, ~from_second), (second, from_second))
        if rows.any()
    ]
    order = torch.argsort(torch.cat([torch.nonzero(~from_second)[:, 0], torch.nonzero(from_second)[:, 0]]))
    return torch.cat(batches)[order]


def source_on(source: Source, device: torch.device) -> Source | None:
    """Copy of one of meshmatch's own sources that draws on a device, from a generator there; None for custom sources."""
    function = source.func if isinstance(source, partial) else type(source)
    return to_device(source, device) if function.__module__.partition(".")[0] == __name__.partition(".")[0] else None


def to_device(obj: Any, device: torch.device) -> Any:
    """Copy of a value with every tensor in it on a device; goes through dataclasses, tuples, modules and partial calls."""
    if isinstance(obj, Tensor):
        return obj.to(device)
    if isinstance(obj, torch.nn.Module):
        return deepcopy(obj).to(device)
    if isinstance(obj, partial):
        keywords = {name: to_device(value, device) for name, value in obj.keywords.items()}
        return partial(obj.func, *to_device(obj.args, device), **keywords)
    if type(obj) is tuple:
        return tuple(to_device(each, device) for each in obj)
    if is_dataclass(obj) and not isinstance(obj, type):
        names = (each.name for each in fields(obj) if each.init)
        return replace(obj, **{name: to_device(getattr(obj, name), device) for name in names})
    return obj
