"""Generated people with known truth: in clothes, or naked and touching themselves.

They are made of people and poses that no training drew. A body is cut into other triangles, so that its vertices are
nobody's; the truth is the place on the naked body below.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.makers.contact_poses import POSES, contact_poses
from meshmatch.experiments.makers.fused_surface import fused_surface
from meshmatch.experiments.makers.other_triangles import other_triangles
from meshmatch.generators.bodies import draw_identities, template_rig
from meshmatch.generators.characters import Cast, sample_layers
from meshmatch.generators.figure import Figure
from meshmatch.generators.proportions import CHILD, SHARES, draw_style, stretched
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

TRAINED_SEED = 0
_FACES = 18_000  # of a body as it is seen
_NORMAL = (
    0.02  # metres that a vertex may be nearer and yet not be the place of one whose normal is a radian from its own
)


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


def touching(template: Template, count: int, seed: int = 0, tag: str = "", fused: bool = False) -> list[Character]:
    """Naked people, every second one a child, in the poses of `contact_poses.POSES`, one after the other; they too are of
    64 that no training drew. ``fused``: the surface around them, in which parts that touch are one.
    """
    figure = Figure.of(template_rig(template, 64, TRAINED_SEED + 1 + seed))
    generator = torch.Generator().manual_seed(7919 * (seed + 1) + len(SHARES))
    rest, heads = draw_identities(figure.rig, count, generator)
    children = torch.arange(1, count, 2)
    style = draw_style(len(children), generator, [float(kind == CHILD) for kind in range(len(SHARES))])
    rest[children], heads[children] = stretched(figure, rest[children], heads[children], style)
    names = [list(POSES)[k % len(POSES)] for k in range(count)]
    posed = contact_poses(figure, rest, heads, names, seed).double().numpy()
    weights, fine = other_triangles(figure.rig.faces.numpy(), posed.shape[1])
    bones = (weights @ figure.share.double().numpy()).argmax(1)
    found = []
    for k, naked in enumerate(posed):
        body = Shape(weights @ naked, fine, f"body {k}")
        shape = fused_surface(body) if fused else body
        shape = replace(decimate(shape, _FACES + 1000 * (k % 3)), name=f"{tag}{k}")
        places = places_on(body, shape)
        found.append(Character(shape, bones[places], body, places))
    return found


def places_on(body: Shape, shape: Shape) -> Int[Ints, " V"]:
    """Of every vertex of a shape that lies on a body the nearest vertex of the body, among those whose normals are like its
    own: where two parts touch, the place is on the right one.
    """

    def known(each: Shape) -> Float[Floats, "V 6"]:
        return np.hstack([each.verts, _NORMAL * each.vertex_normals])

    return np.asarray(cKDTree(known(body)).query(known(shape))[1])
