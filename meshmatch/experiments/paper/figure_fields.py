"""What fields and losses do to a template's triangles, the paper's figures 4 and 5; what refinement changes, figure 6.

In figures 4 and 5 a field itself is fitted to one body, without a network: the training's loss on one shape, the mean
squared distance at some template points whose places on the body are known up to noise, and the weights of the paper for
volume and rigidity. What is searched, by Adam from rest, are the node vectors; for a pointwise field, the weights of its
network. Blends of codes (Z) need a network's codes and have no part in it.

The *change* of a triangle is log2 of its area over its area before, or over its area on the true body: 0 for none, 1 for
twice, -1 for half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments.paper.ablation_errors import Measure, begin_body, refined, refinement_of
from meshmatch.experiments.paper.ablation_views import BASE
from meshmatch.fields.field import Field, PointField, PointwiseField, pack
from meshmatch.fields.shape_functions import FIELDS, FieldName, has_nodes, shape_functions
from meshmatch.fitting.solve.system import node_system
from meshmatch.geometry.frames import Frame, kabsch
from meshmatch.geometry.kernels import Kernel
from meshmatch.geometry.triangles import dot, triangle_areas, triangle_vectors
from meshmatch.maps.evaluate import CM_PER_UNIT
from meshmatch.models.layers import PointDecoder
from meshmatch.models.trained import TrainedModel
from meshmatch.render.figures import Panel
from meshmatch.render.scales import Scale
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.sampling import farthest_points
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template
from meshmatch.training.losses import CorrespondenceLoss

PULLED = ("left forearm", "left hand")
PULL = (0.10, 0.16, 0.0)
"""How far the nodes of these parts are moved: out and up, units of sqrt(area) (0.1 is 14 cm)."""
CONSTRAINTS = ("none", "vol", "arap", "vol+arap")
SCALE = Scale(-1.0, 1.0, "area of a triangle: log2 of how many times what it should be", beyond=(True, True))
COLUMNS = {"what": "what", "mean |change|": "change:.3f", "beyond a quarter": "over_quarter:.1%"}
COLUMNS |= {"beyond twice": "over_twice:.1%", "turned over": "turned:.2%"}
PULL_COLUMNS = COLUMNS | {"handles missed, cm": "missed_cm:.2f", "rest moved, cm": "elsewhere_cm:.2f"}
REFINED = {"none": "the network", "code": "its code searched", "nodes": "nodes refined"}
OFF = Scale(0.0, 10.0, "distance of the template's points from where they belong, cm", beyond=(False, True))
REFINED_COLUMNS = {"body": "body:d", "refinement": "what", "error, cm": "error_cm:.2f", "over 10 cm": "far:.1%"}
FIT_COLUMNS = COLUMNS | {"volume": "volume:.1%", "error, cm": "error_cm:.2f"}
_WIDTH, _MOST_STEPS, _CLOSE = 256, 3000, 1e-3


@dataclass(frozen=True, eq=False)
class Drawn:
    """Panels of a row of a figure, and the numbers behind each."""

    panels: list[Panel]
    rows: list[dict[str, Any]]


def change(
    verts: Float[Floats, "V 3"], right: Float[Floats, "V 3"], faces: Int[Ints, "F 3"]
) -> tuple[Float[Floats, " F"], dict[str, Any]]:
    """The change of every triangle beside what is right; mean |change|, shares, by area on what is right.

    ``turned``: triangles whose normal points away from the right one's.
    """
    before = triangle_areas(right, faces)
    found = np.log2(np.maximum(triangle_areas(verts, faces), 1e-12) / np.maximum(before, 1e-12))
    weight, off = before / before.sum(), np.abs(found)
    turned = dot(triangle_vectors(verts, faces), triangle_vectors(right, faces)) < 0
    numbers = {
        **{"change": float(weight @ off), "over_quarter": float(weight @ (off > np.log2(1.25)))},
        **{"over_twice": float(weight @ (off > 1)), "turned": float(weight @ turned)},
    }
    return found, numbers


def pulled_nodes(template: Template) -> Bool[Bools, " K"]:
    """Which nodes belong to the parts that are pulled: those whose nearest vertex does."""
    parts = [template.label_names.index(name) for name in PULLED]
    nearest = cKDTree(template.shape.verts).query(template.nodes)[1]
    return np.isin(template.labels[nearest], parts)


def pulled_by(field: FieldName, template: Template, kernel: Kernel, seed: int) -> tuple[Floats, Floats]:
    """The vertices, and the nodes, after a field moved the handles: the nodes of the arm by `PULL`, all others not.

    Node vectors are the handles' displacements. A pointwise network learns them at the nodes, by Adam from its beginning
    until it misses them by a thousandth on average, and is regularised by nothing.
    """
    vectors = np.where(pulled_nodes(template)[:, None], PULL, 0.0)
    verts, nodes = template.shape.verts, template.nodes
    if has_nodes(field):
        moved = [
            points + shape_functions(field, points, nodes, template.radius, kernel).displaced(vectors)
            for points in (verts, nodes)
        ]
        return moved[0], moved[1]
    torch.manual_seed(seed)
    network, code = PointDecoder(1, _WIDTH), torch.zeros(1, 1)
    at, wanted = (torch.from_numpy(each.astype(np.float32))[None] for each in (nodes, vectors))
    optimiser = torch.optim.Adam(network.parameters(), 1e-3)
    for _ in range(_MOST_STEPS):
        optimiser.zero_grad()
        off = network.displacement(at, code) - wanted
        off.square().sum(-1).mean().backward()
        optimiser.step()
        if float(off.detach().norm(dim=-1).mean()) < _CLOSE:
            break
    with torch.no_grad():
        both = [network.displacement(torch.from_numpy(p.astype(np.float32))[None], code)[0] for p in (verts, nodes)]
    return verts + both[0].double().numpy(), nodes + both[1].double().numpy()


def pull(template: Template, kernel: Kernel, seed: int) -> Drawn:
    """Figure 4, above: the same handles by every field. The arm's own triangles are what is pulled between."""
    shape, arm = template.shape, pulled_nodes(template)
    side = [k for k, name in enumerate(template.label_names) if name in (*PULLED, "left upper arm", "chest", "neck")]
    elsewhere = ~np.isin(template.labels, side)
    colors = np.where(arm[:, None], (0.86, 0.30, 0.12), (0.45, 0.47, 0.50))
    panels = [Panel(shape, None, "handles", points=template.nodes, point_colors=colors, point_radius=0.012, glass=True)]
    rows = []
    for field in FIELDS:
        verts, nodes = pulled_by(field, template, kernel, seed)
        found, numbers = change(verts, shape.verts, shape.faces)
        missed = nodes - template.nodes - np.where(arm[:, None], PULL, 0.0)
        numbers["missed_cm"] = float(np.linalg.norm(missed, axis=1).mean() * CM_PER_UNIT)
        moved = np.linalg.norm(verts - shape.verts, axis=1)[elsewhere]
        rows.append({"what": field, **numbers, "elsewhere_cm": float(moved.mean() * CM_PER_UNIT)})
        panels.append(Panel(Shape(verts, shape.faces, field), label=field, face_colors=SCALE.colors(found)))
    return Drawn(panels, rows)


def template_frame(template: Template, body: Float[Floats, "V 3"]) -> Frame:
    """From a body on the template's vertices to area 1, its core on the template's."""
    frame = sqrt_area_frame(Shape(body, template.shape.faces, "body"))
    pose = kabsch(template.shape.verts[template.core], frame.apply(body)[template.core])
    return frame.compose(pose.frame)


def refinements(model: TrainedModel, bodies: Sequence[Float[Floats, "V 3"]], measure: Measure) -> list[Drawn]:
    """Bodies, and the template as a model fits each: by its network, after the search over codes, after that for nodes.

    The error is the distance of the template's vertices from where they belong, at 1.9 m2 of skin.
    """
    faces, drawn = model.template.shape.faces, []
    for number, body in enumerate(bodies):
        upright, start = template_frame(model.template, body), begin_body(model, body, measure)
        panels = [Panel(Shape(upright.apply(body), faces, "body"), None, "the body", rotation=np.eye(3))]
        rows = []
        for method, words in REFINED.items():
            found = refined(model, start, refinement_of(BASE, method, measure), measure.seed)
            verts = upright.apply(start.frame.undo(node_system(model).moved(found)))
            off = CM_PER_UNIT * np.linalg.norm(verts - upright.apply(body), axis=1)
            rows.append(
                {"body": number, "what": words, "error_cm": float(off.mean()), "far": float((off > OFF.high).mean())}
            )
            panels.append(Panel(Shape(verts, faces, words), OFF.colors(off), words, rotation=np.eye(3)))
        drawn.append(Drawn(panels, rows))
    return drawn


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
    target = template_frame(template, body).apply(body)
    panels, rows = [Panel(Shape(target, faces, "body"), None, "the body", rotation=np.eye(3))], []
    for field, constraint, label in cases:
        verts = fitted(field, constraint, template, target, how)
        found, numbers = change(verts, target, faces)
        volumes = [trimesh.Trimesh(each, faces, process=False).volume for each in (target, verts)]
        row: dict[str, Any] = {"what": label, **numbers, "volume": volumes[1] / volumes[0] - 1}
        off = np.linalg.norm(verts - target, axis=1).mean()
        rows.append(row | {"error_cm": float(off * CM_PER_UNIT)})
        colors = SCALE.colors(found)
        panels.append(Panel(Shape(verts, faces, label), label=label, face_colors=colors, rotation=np.eye(3)))
    return Drawn(panels, rows)
