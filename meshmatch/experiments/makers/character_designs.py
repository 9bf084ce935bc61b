"""Generated people in clothes with known truth.

They are made of people and poses that no training drew. A clothed body is cut into other triangles, so that its vertices are
nobody's; the truth is the place on the naked body below.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from meshmatch.arrays import Int, Ints
from meshmatch.experiments.makers.other_triangles import other_triangles
from meshmatch.generators.bodies import template_rig
from meshmatch.generators.characters import Cast, sample_layers
from meshmatch.generators.figure import Figure
from meshmatch.generators.proportions import SHARES
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

TRAINED_SEED = 0
_FACES = 18_000  # of a clothed body


@dataclass(frozen=True, eq=False)
class Character:
    """A shape; of every vertex the bone that it hangs on, the vertex of the body below, and that body."""

    shape: Shape
    bones: Int[Ints, " V"]
    body: Shape
    places: Int[Ints, " V"]


def people(template: Template, count: int, kind: int, seed: int = 0, tag: str = "") -> list[Character]:
    """People in clothes, of a kind of `meshmatch.generators.proportions`: of 64 that no training of an included model drew,
    on a human template's vertices."""
    figure = Figure.of(template_rig(template, 64, TRAINED_SEED + 1 + seed))
    cast = Cast(figure, 1.0, kinds=tuple(float(each == kind) for each in range(len(SHARES))))
    generator = torch.Generator().manual_seed(7919 * (seed + 1) + kind)
    faces, share = figure.rig.faces.numpy(), figure.share.double().numpy()
    weights, fine = other_triangles(faces, len(share))
    bones = (weights @ share).argmax(1)
    found = []
    for k, (clothed, naked) in enumerate(zip(*sample_layers(cast, count, generator), strict=True)):
        seen, below = (weights @ layer.double().numpy() for layer in (clothed, naked))
        shape = decimate(Shape(seen, fine, f"{tag}{k}"), _FACES + 1000 * (k % 3))
        places = cKDTree(seen).query(shape.verts)[1]
        found.append(Character(shape, bones[places], Shape(below, fine, f"body {k}"), places))
    return found
