"""Generated people with ground-truth correspondence: clothed, or naked in poses of self-contact.

Their identities and poses differ from those of all trainings. Bodies are remeshed, so that their vertices do not coincide
with the template's; the ground truth is the place on the naked body below the clothes.
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
from meshmatch.generators.characters import CharacterConfig, sample_layers
from meshmatch.generators.figure import Figure
from meshmatch.generators.proportions import CHILD, SHARES, draw_style, scale_bones
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

TRAINED_SEED = 0
_FACES = 18_000  # number of faces of a shape, approximately
_NORMAL_WEIGHT = 0.02  # distance in metres that counts as much as a unit difference of normals


@dataclass(frozen=True, eq=False)
class Character:
    """A shape; its vertices have a body part (``bones``) and a corresponding vertex (``places``) of the naked ``body``."""

    shape: Shape
    bones: Int[Ints, " V"]
    body: Shape
    places: Int[Ints, " V"]


def clothed_people(template: Template, count: int, kind: int, seed: int = 0, tag: str = "") -> list[Character]:
    """Clothed people with one of the styles of `meshmatch.generators.proportions`.

    They are drawn from 64 identities that no training of a bundled model used.
    """
    figure = Figure.of(template_rig(template, 64, TRAINED_SEED + 1 + seed))
    config = CharacterConfig(figure, 1.0, style_shares=tuple(float(each == kind) for each in range(len(SHARES))))
    generator = torch.Generator().manual_seed(7919 * (seed + 1) + kind)
    faces, share = figure.rig.faces.numpy(), figure.share.double().numpy()
    weights, fine = other_triangles(faces, len(share))
    bones = (weights @ share).argmax(1)
    characters = []
    for k, (clothed, naked) in enumerate(zip(*sample_layers(config, count, generator), strict=True)):
        outer, inner = (weights @ layer.double().numpy() for layer in (clothed, naked))
        shape = decimate(Shape(outer, fine, f"{tag}{k}"), _FACES + 1000 * (k % 3))
        places = cKDTree(outer).query(shape.verts)[1]
        characters.append(Character(shape, bones[places], Shape(inner, fine, f"body {k}"), places))
    return characters


def people_in_contact(
    template: Template, count: int, seed: int = 0, tag: str = "", fused: bool = False
) -> list[Character]:
    """Naked people, every second one a child, in the poses of `contact_poses.POSES` in order.

    They are drawn from 64 identities that no training used. With ``fused``, shapes are the outer surfaces of the bodies, in
    which touching parts are merged.
    """
    figure = Figure.of(template_rig(template, 64, TRAINED_SEED + 1 + seed))
    generator = torch.Generator().manual_seed(7919 * (seed + 1) + len(SHARES))
    rest, heads = draw_identities(figure.rig, count, generator)
    children = torch.arange(1, count, 2)
    style = draw_style(len(children), generator, [float(kind == CHILD) for kind in range(len(SHARES))])
    rest[children], heads[children] = scale_bones(figure, rest[children], heads[children], style)
    names = [list(POSES)[k % len(POSES)] for k in range(count)]
    posed = contact_poses(figure, rest, heads, names, seed).double().numpy()
    weights, fine = other_triangles(figure.rig.faces.numpy(), posed.shape[1])
    bones = (weights @ figure.share.double().numpy()).argmax(1)
    characters = []
    for k, naked in enumerate(posed):
        body = Shape(weights @ naked, fine, f"body {k}")
        shape = fused_surface(body) if fused else body
        shape = replace(decimate(shape, _FACES + 1000 * (k % 3)), name=f"{tag}{k}")
        places = places_on(body, shape)
        characters.append(Character(shape, bones[places], body, places))
    return characters


def places_on(body: Shape, shape: Shape) -> Int[Ints, " V"]:
    """For each vertex of a shape on a body's surface, the nearest vertex of the body by position and normal.

    Normals select the right part where two parts touch.
    """

    def features(each: Shape) -> Float[Floats, "V 6"]:
        return np.hstack([each.verts, _NORMAL_WEIGHT * each.vertex_normals])

    return np.asarray(cKDTree(features(body)).query(features(shape))[1])
