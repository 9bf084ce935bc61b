"""Characters with known truth: generated people in clothes, robots of many parts, soldiers in plates of armour.

All are made of people and poses that no training drew. A clothed body is cut into other triangles, so that its vertices are
nobody's; the truth is the place on the naked body below. A robot is a pile of separate solids, each hung on a bone; two
robots share the bones, and nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.experiments.makers.other_triangles import other_triangles
from meshmatch.generators.bodies import draw_identities, template_rig
from meshmatch.generators.characters import Cast, sample_layers, standing
from meshmatch.generators.figure import PARTS, SIDED, Figure, joints_of
from meshmatch.generators.proportions import SHARES
from meshmatch.generators.rig import forward_kinematics, skin
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template

TRAINED_SEED = 0
_FACES = 18_000  # of a clothed body
_EDGE = 0.08  # metres, of a robot
# How wide a part of a robot is, across and out, in units of its length.
_WIDTHS = {"hips": (2.2, 1.3), "belly": (1.7, 1.0), "chest": (1.5, 0.9), "neck": (0.9, 0.9), "head": (1.2, 1.2),
           "upper arm": (0.35, 0.35), "forearm": (0.35, 0.35), "hand": (0.8, 0.5), "thigh": (0.4, 0.4),
           "shin": (0.33, 0.33), "foot": (0.5, 0.5)}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Character:
    """A shape; of every vertex the bone that it hangs on, and, where there is a body below, the body and its vertex."""

    shape: Shape
    bones: Int[Ints, " V"]
    body: Shape | None = None
    places: Int[Ints, " V"] | None = None


@dataclass(frozen=True, eq=False)
class Designer:
    """Makes characters of the people of a figure."""

    figure: Figure
    seed: int = 0

    @classmethod
    def unseen(cls, template: Template, seed: int = 0) -> Designer:
        """With 64 people that no training of an included model drew, on a human template's vertices."""
        return cls(Figure.of(template_rig(template, 64, TRAINED_SEED + 1 + seed)), seed)

    def people(self, count: int, kinds: Sequence[int], tag: str) -> list[Character]:
        """People in clothes, of these kinds of `meshmatch.generators.proportions`."""
        cast = Cast(self.figure, 1.0, kinds=tuple(float(kind in kinds) for kind in range(len(SHARES))))
        generator = torch.Generator().manual_seed(7919 * (self.seed + 1) + sum(kinds))
        faces, share = self.figure.rig.faces.numpy(), self.figure.share.double().numpy()
        weights, fine = other_triangles(faces, len(share))
        bones = (weights @ share).argmax(1)
        found = []
        for k, (clothed, naked) in enumerate(zip(*sample_layers(cast, count, generator), strict=True)):
            seen, below = (weights @ layer.double().numpy() for layer in (clothed, naked))
            shape = decimate(Shape(seen, fine, f"{tag}{k}"), _FACES + 1000 * (k % 3))
            places = cKDTree(seen).query(shape.verts)[1]
            found.append(Character(shape, bones[places], Shape(below, fine, f"body {k}"), places))
        return found

    def robots(self, count: int) -> list[Character]:
        """Robots whose parts are separate solids, in poses near those in which modellers deliver them."""
        return [self._robot(k, np.random.default_rng([self.seed, 1, k])) for k in range(count)]

    def soldiers(self, count: int) -> list[Character]:
        """Naked bodies below separate plates of armour, in the same poses."""
        return [self._soldier(k, np.random.default_rng([self.seed, 2, k])) for k in range(count)]

    def _posed(self, rng: np.random.Generator) -> tuple[Float[Floats, "J 3"], Float[Floats, "V 3"]]:
        """Joints and skin of somebody who stands as modellers deliver characters."""
        rig = self.figure.rig
        rest, heads = draw_identities(rig, 1, generator := torch.Generator().manual_seed(int(rng.integers(2**31))))
        world, offset = forward_kinematics(rig, heads, standing(rig, heads, generator))
        joints = (world @ heads[..., None])[..., 0] + offset
        return joints[0].double().numpy(), skin(rig, rest, world, offset)[0].double().numpy()

    def _robot(self, k: int, rng: np.random.Generator) -> Character:
        joints = self._posed(rng)[0]
        girth = rng.uniform(0.8, 1.35)
        designs = {name: _Solid.drawn(rng) for name in _WIDTHS}
        sides = [joints[joints_of(self.figure.rig, "upper arm", side)[0]] for side in "LR"]
        shoulders = float(np.linalg.norm(sides[0] - sides[1]))
        solids, bones = [], []
        for p, name in enumerate(PARTS):
            stem, side = (name[:-2], name[-1]) if name[:-2] in SIDED else (name, "")
            start, end = (joints[j] for j in joints_of(self.figure.rig, stem, side))
            design, along = designs[stem], end - start
            if stem == "head":
                start, along = end, np.array([0.0, 0.26 * design.size, 0.0])
            wide = girth * design.size * np.array(_WIDTHS[stem])
            if stem == "chest":  # as wide as from shoulder to shoulder, so that arms hang beside it
                wide[0] = 0.9 * shoulders / float(np.linalg.norm(along))
            for solid in design.made(start, along, wide):
                solids.append(solid)
                bones.append(p)
        return _joined(f"robot{k}", solids, bones)

    def _soldier(self, k: int, rng: np.random.Generator) -> Character:
        skin_verts = self._posed(rng)[1]
        faces = self.figure.rig.faces.numpy()
        normals = np.array(Shape(skin_verts, faces).vertex_normals)
        own = self.figure.share.argmax(1).numpy()
        solids: list[trimesh.Trimesh] = [trimesh.Trimesh(skin_verts, faces, process=False)]
        bones: list[Int[Ints, " V"] | int] = [own]
        for p, name in enumerate(PARTS):
            rows = faces[(own == p)[faces].all(1)]
            if name in ("neck", "head") or rng.random() < 0.2:
                continue
            keep, where = np.unique(rows, return_inverse=True)  # the skin of a part, pushed out: a shell of two sides
            inside = where.reshape(-1, 3)
            gap = rng.uniform(0.01, 0.03)
            shell = np.concatenate([skin_verts[keep] + away * normals[keep] for away in (gap + 0.012, gap)])
            solids.append(trimesh.Trimesh(shell, np.concatenate([inside, inside[:, ::-1] + len(keep)]), process=False))
            bones.append(p)
        head = PARTS.index("head")
        top = skin_verts[own == head]
        helmet = trimesh.creation.icosphere(3, 0.6 * float(np.ptp(top[:, 1])))
        solids.append(helmet.apply_translation(0.5 * (top.min(0) + top.max(0))))
        bones.append(head)
        return _joined(f"soldier{k}", solids, bones)


@dataclass(frozen=True)
class _Solid:
    """A kind of solid, how large, and whether a ball sits at its joint and a plate upon it."""

    kind: str
    size: float
    ball: bool
    plate: bool

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> _Solid:
        return cls(
            str(rng.choice(["box", "capsule", "rod", "ball"])), rng.uniform(0.85, 1.2), *(rng.random(2) < 0.5).tolist()
        )

    def made(self, start: Floats, along: Floats, wide: Floats) -> list[trimesh.Trimesh]:
        """Solids of a part that begins at a place and runs along; ``wide``: across and out, in units of its length."""
        length = float(np.linalg.norm(along))
        axis, frame = along / length, np.eye(4)
        ahead = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
        across = np.cross(axis, ahead)
        across /= np.linalg.norm(across)
        frame[:3, :3] = np.stack([across, np.cross(axis, across), axis], 1)
        frame[:3, 3] = start + 0.5 * length * axis
        x, y = wide * length
        if self.kind == "box":
            main = trimesh.creation.box((x, y, 0.95 * length))
        elif self.kind == "ball":
            main = trimesh.creation.icosphere(3).apply_scale((0.55 * x, 0.55 * y, 0.55 * length))
        elif self.kind == "rod":
            main = trimesh.creation.cylinder(0.5, 0.95 * length, 24).apply_scale((x, y, 1))
        else:
            main = trimesh.creation.icosphere(3)
            main.vertices = np.sign(main.vertices) * np.abs(main.vertices) ** 0.5 * [0.5 * x, 0.5 * y, 0.5 * length]
        found = [main.apply_transform(frame)]
        if self.ball:
            found.append(trimesh.creation.icosphere(2, 0.3 * min(x, y)).apply_translation(start))
        if self.plate:
            plate = trimesh.creation.box((0.8 * x, 0.15 * y, 0.6 * length))
            plate.apply_translation((0, -0.55 * y, 0)).apply_transform(frame)
            found.append(plate)
        return [_fine(each) for each in found]


def _fine(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    """With edges short enough that large parts have more vertices than small ones."""
    while solid.edges_unique_length.max() > _EDGE:
        solid = solid.subdivide()
    return solid


def _joined(name: str, solids: Sequence[trimesh.Trimesh], bones: Sequence[Int[Ints, " V"] | int]) -> Character:
    first = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    faces = np.concatenate([solid.faces + start for solid, start in zip(solids, first[:-1], strict=True)])
    of = [
        np.full(len(solid.vertices), bone) if isinstance(bone, int) else bone
        for solid, bone in zip(solids, bones, strict=True)
    ]
    return Character(
        Shape(np.concatenate([solid.vertices for solid in solids]), faces, name), np.concatenate(of).astype(np.int64)
    )
