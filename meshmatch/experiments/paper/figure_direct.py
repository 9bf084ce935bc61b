"""A field itself fitted to one body, without a network: what each representation and loss makes of few, inexact points.

The training's loss on one shape: mean squared distance at some template points whose places on the body are known up to
noise, and the weights of the paper for volume and rigidity. What is searched, by Adam from rest, are the node vectors; for
a pointwise field, the weights of its network. Blends of codes (Z) need a network's codes and have no part in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from meshmatch.arrays import Float, Floats
from meshmatch.experiments.paper.figure_fields import SCALE, Drawn, change, template_frame, volume
from meshmatch.fields.field import Field, PointField, PointwiseField, pack
from meshmatch.fields.shape_functions import FieldName, has_nodes, shape_functions
from meshmatch.geometry.kernels import Kernel
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.layers import PointDecoder
from meshmatch.render.figures import Panel
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template
from meshmatch.training.losses import CorrespondenceLoss

CONSTRAINTS = ("none", "vol", "arap", "vol+arap")


@dataclass(frozen=True)
class Direct:
    """How a field is fitted.

    Parameters
    ----------
    supervised : how many template points have a known place, spread over the template
    noise : of these places, units of sqrt(area); 0.007 is 1 cm
    strained : at how many points volume and rigidity are looked at
    steps, rate : of Adam; a network's rate is a tenth of it
    width : of a pointwise network
    """

    supervised: int = 300
    noise: float = 0.007
    strained: int = 400
    steps: int = 400
    rate: float = 1e-2
    width: int = 256
    kernel: Kernel = "smooth"
    seed: int = 0


def in_template_frame(template: Template, body: Float[Floats, "V 3"]) -> Float[Floats, "V 3"]:
    """A body on the template's vertices at area 1, turned so that its core lies on the template's."""
    return template_frame(template, body).apply(body)


def fitted(
    field: FieldName, constraint: str, template: Template, target: Float[Floats, "V 3"], how: Direct
) -> Float[Floats, "V 3"]:
    """The template's vertices after the fit to a body in the template's frame."""
    torch.manual_seed(how.seed)
    verts = template.shape.verts
    order = farthest_points(verts, max(how.supervised, how.strained))
    known, strained = order[: how.supervised], order[: how.strained]
    noise = how.noise * np.random.default_rng(how.seed).standard_normal((len(known), 3))
    places = torch.from_numpy((target[known] + noise).astype(np.float32))[None]
    fields: list[PointField]
    if has_nodes(field):
        rows = torch.zeros(1, template.K, 3, requires_grad=True)
        wanted, rate = [rows], how.rate

        def on(points: Floats) -> PointField:
            functions = shape_functions(field, points, template.nodes, template.radius, how.kernel)
            return Field.of(functions).for_training()

    else:
        network, code = PointDecoder(1, how.width), torch.zeros(1, 1)
        rows, wanted, rate = pack(code), list(network.parameters()), 0.1 * how.rate

        def on(points: Floats) -> PointField:
            at = torch.from_numpy(points.astype(np.float32))
            return PointwiseField(at, at, network.displacement, 1)

    fields = [on(verts[known]), on(verts[strained])]
    loss = CorrespondenceLoss()
    loss = replace(loss, volume=loss.volume * ("vol" in constraint), arap=loss.arap * ("arap" in constraint))
    at = torch.from_numpy(verts[known].astype(np.float32))
    optimiser = torch.optim.Adam(wanted, rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, how.steps)
    for _ in range(how.steps):
        optimiser.zero_grad()
        total = (at + fields[0].displacement(rows) - places).square().sum(-1).mean()
        if loss.volume or loss.arap:
            total = total + sum(loss.rigidity(fields[1].deformation_gradient(rows)).values())
        total.backward()
        optimiser.step()
        schedule.step()
    with torch.no_grad():
        return verts + on(verts).displacement(rows)[0].double().numpy()


def direct_fits(
    cases: Sequence[tuple[FieldName, str, str]], template: Template, body: Float[Floats, "V 3"], how: Direct
) -> Drawn:
    """A body and its fits, by cases of field, constraint and label. The change is beside the body's own triangles."""
    faces = template.shape.faces
    target = in_template_frame(template, body)
    panels, rows = [Panel(Shape(target, faces, "body"), None, "the body", rotation=np.eye(3))], []
    for field, constraint, label in cases:
        verts = fitted(field, constraint, template, target, how)
        found, numbers = change(verts, target, faces)
        row: dict[str, Any] = {"what": label, **numbers, "volume": volume(verts, faces) / volume(target, faces) - 1}
        off = np.linalg.norm(verts - target, axis=1).mean()
        rows.append(row | {"error_cm": float(off * CM_PER_UNIT)})
        colors = SCALE.colors(found)
        panels.append(Panel(Shape(verts, faces, label), label=label, face_colors=colors, rotation=np.eye(3)))
    return Drawn(panels, rows)
