"""Shapes with known truth on which a verdict must be honest: sound and damaged ones, and what is of no kind at all.

Every family is drawn from people, animals and poses that no training drew, a function of the seed and a number alone. The
truth of a vertex is its vertex of the template (low resolution), or -1 where it has no counterpart; a shape of another
kind has none anywhere. `TUNED` families may set thresholds, by seeds other than those that measure them; `KEPT` never.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial, reduce

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.experiments.bench.partial import seen_faces
from meshmatch.experiments.makers.character_designs import clothed_people
from meshmatch.experiments.makers.fused_surface import fused_with_base
from meshmatch.experiments.makers.human_bodies import unseen_bodies
from meshmatch.generators.generator import Generator
from meshmatch.generators.kinds import GENERATORS, Kind
from meshmatch.generators.proportions import CHILD, PLAIN, TOON
from meshmatch.geometry.trees import cKDTree
from meshmatch.shapes.decimate import decimate
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape
from meshmatch.templates.template import Template, read_template

_DRAWN = 200
METRES = 1.7
"""How large what is no person is made."""
LIMBS = (
    ("left thigh", "left shin", "left foot"), ("right thigh", "right shin", "right foot"),
    ("left upper arm", "left forearm", "left hand"), ("right upper arm", "right forearm", "right hand"),
    ("head", "neck"), ("left forearm", "left hand"), ("right hand",), ("left foot", "left shin"),
    ("chest", "belly", "hips"),
    ("hips", "left thigh", "left shin", "left foot", "right thigh", "right shin", "right foot"),
)  # fmt: skip
"""Labels of parts of people that are cut out together."""


CAMERAS, ENOUGH = 8, 2
"""Around a body that is scanned; and how many must see a face."""
NOISE = 0.0015  # of a scan, in shares of the bounding box's diagonal: 3 mm on a person
_HEIGHTS = (-0.15, 0.45)  # of the cameras' directions, by turns: from below the middle and from above


def ring(cameras: int = CAMERAS) -> Float[Floats, "C 3"]:
    """Directions from a body, y up, to cameras around it."""
    angle = 2 * np.pi * np.arange(cameras) / cameras + 0.2
    towards = np.stack([np.sin(angle), np.resize(_HEIGHTS, cameras), np.cos(angle)], axis=1)
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def scanned(body: Shape, seed: int) -> Shape:
    """The faces of a body that enough cameras see, with noise along the normals: armpits, crotch and soles are holes."""
    centers = body.verts[body.faces].mean(axis=1)
    views = np.sum([seen_faces(body, centers, towards) for towards in ring()], axis=0)
    faces = body.faces[views >= ENOUGH]
    used = np.unique(faces)
    off = NOISE * body.diagonal * np.random.default_rng(seed).standard_normal((len(used), 1))
    return Shape(body.verts[used] + off * body.vertex_normals[used], np.searchsorted(used, faces), body.name)


def direction(rng: np.random.Generator) -> Float[Floats, " 3"]:
    """A random unit vector."""
    found = rng.normal(size=3)
    return np.asarray(found / np.linalg.norm(found))


def faces_kept(shape: Shape, truth: Ints, kept: Bool[Bools, " F"]) -> tuple[Shape, Ints]:
    """Only some faces, with their vertices."""
    used, faces = np.unique(shape.faces[kept], return_inverse=True)
    return Shape(shape.verts[used], faces.reshape(-1, 3)), truth[used]


def between(shape: Shape, truth: Ints, axis: Float[Floats, " 3"], low: float, high: float) -> tuple[Shape, Ints]:
    """Only the faces between two quantiles (0..1) of their places along an axis."""
    along = shape.verts[shape.faces].mean(1) @ axis
    first, last = np.quantile(along, [low, high])
    return faces_kept(shape, truth, np.asarray((along > first) & (along <= last)))


def joined(shape: Shape, other: Shape, at: Float[Floats, "W 3"]) -> Shape:
    """Two shapes as one, the second one with its vertices elsewhere."""
    return Shape(np.concatenate([shape.verts, at]), np.concatenate([shape.faces, other.faces + shape.V]))


def grid(side: float, cells: int) -> Shape:
    """A square in the plane y = 0 around the origin."""
    x, z = np.meshgrid(*[np.linspace(-0.5 * side, 0.5 * side, cells + 1)] * 2, indexing="ij")
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, 1:].ravel(), corner[1:, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Shape(np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()]), faces)


def refined(shape: Shape, F: int) -> Shape:
    """The same surface in F triangles or a few more; where triangles of two sizes meet there are slits."""
    verts, faces = np.asarray(shape.verts), np.asarray(shape.faces)
    while len(faces) < F:
        some = np.arange(min(len(faces), -(-(F - len(faces)) // 3)))
        verts, faces = trimesh.remesh.subdivide(verts, faces, some)
    return Shape(verts, faces)


def solids(rng: np.random.Generator) -> Shape:
    """A few boxes, balls and rods run together."""
    parts = []
    for _ in range(int(rng.integers(1, 7))):
        size = rng.uniform(0.1, 1.0, 3)
        made = (
            trimesh.creation.box(size).subdivide_to_size(0.1),
            trimesh.creation.icosphere(4, size[0]),
            trimesh.creation.capsule(size[0] * 2, size[1] * 0.3),
        )[rng.integers(3)]
        made.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
        made.apply_translation(rng.normal(size=3) * 0.4)
        parts.append(Shape(np.asarray(made.vertices), np.asarray(made.faces)))
    return reduce(lambda whole, part: joined(whole, part, part.verts), parts)


def boxes(corners: Sequence[Float[Floats, "2 3"]], edge: float) -> Shape:
    """Boxes by their lower and upper corners, which may run into each other; no edge is longer than that."""
    parts = []
    for low, high in corners:
        made = trimesh.creation.box(high - low).subdivide_to_size(edge)
        parts.append(Shape(np.asarray(made.vertices) + 0.5 * (low + high), np.asarray(made.faces)))
    return reduce(lambda whole, part: joined(whole, part, part.verts), parts)


def furniture(number: int, rng: np.random.Generator) -> list[Float[Floats, "2 3"]]:
    """The boxes of a chair, a plane or a table, by turns; y is up."""
    wide, deep, tall, thick = rng.uniform((0.2, 0.2, 0.35, 0.02), (0.5, 0.5, 0.8, 0.05))
    if number % 3 == 1:
        tail = rng.uniform(0.1, 0.25)
        solids = [
            ((0, 0, 0), (1.5 * thick, 1.5 * thick, 0.5)),
            ((0, 0, rng.uniform(-0.1, 0.15)), (wide + 0.1, 0.6 * thick, 0.3 * deep)),
            ((0, 0, -0.45), (tail, 0.6 * thick, 0.05)),
            ((0, tail, -0.45), (0.6 * thick, tail, 0.05)),
        ]
    else:
        legs = [((x * (wide - thick), 0.5 * tall, z * (deep - thick)), (thick, 0.5 * tall, thick))
                for x in (-1, 1) for z in (-1, 1)]  # fmt: skip
        solids = [((0, tall, 0), (wide, thick, deep)), *legs]
    if number % 3 == 0:
        back = rng.uniform(0.2, 0.6)
        solids.append(((0, tall + back, thick - deep), (wide, back, thick)))
    return [np.array([np.subtract(middle, half), np.add(middle, half)]) for middle, half in solids]


def melded(corners: Sequence[Float[Floats, "2 3"]], cells: int = 48) -> Shape:
    """Boxes by their lower and upper corners as one watertight mesh with round edges, of so many cells along its longest
    side."""
    ends = np.array(corners)
    low, high = ends[:, 0].min(0), ends[:, 1].max(0)
    step = float((high - low).max()) / cells
    ticks = [np.arange(a - 3 * step, b + 3 * step, step) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*ticks, indexing="ij"), -1)
    distance = np.full(points.shape[:3], np.inf)
    for first, last in ends:
        out = np.abs(points - 0.5 * (first + last)) - 0.5 * (last - first)
        distance = np.minimum(distance, np.linalg.norm(np.maximum(out, 0), axis=-1) + np.minimum(out.max(-1), 0))
    verts, faces, _, _ = marching_cubes(distance, step, spacing=(step,) * 3, allow_degenerate=False)
    return Shape(verts.astype(np.float64) + low - 3 * step, faces.astype(np.int64))


def on_floor(shape: Shape, side: float) -> Shape:
    """A shape above the middle of a square that it stands on."""
    plane = grid(side, 40)
    at = np.array([shape.verts[:, 0].mean(), shape.verts[:, 1].min(), shape.verts[:, 2].mean()])
    return joined(shape, plane, plane.verts + at)


def no_body(verts: Floats, faces: Ints) -> tuple[Shape, Ints]:
    """A shape as large as a person, none of whose vertices has a counterpart."""
    return Shape(verts * (METRES / np.ptp(verts, axis=0).max()), faces), np.full(len(verts), -1)


def rough(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """The vertices with noise."""
    return np.asarray(shape.verts + rng.uniform(0.002, 0.04) * rng.standard_normal(shape.verts.shape))


def swollen(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """The vertices moved outwards."""
    return np.asarray(shape.verts + rng.uniform(0.01, 0.06) * shape.vertex_normals)


def melted(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """The vertices smoothed, up to some hundred times."""
    mesh = trimesh.Trimesh(shape.verts, shape.faces, process=False)
    trimesh.smoothing.filter_laplacian(mesh, iterations=int(rng.integers(20, 400)))
    return np.asarray(mesh.vertices)


def twisted(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """The vertices turned about the y axis, the further the higher."""
    middle = shape.verts.mean(0)
    local = shape.verts - middle
    turns = Rotation.from_rotvec(np.outer(local[:, 1] * rng.uniform(0.3, 4.0), [0, 1, 0]))
    return np.asarray(turns.apply(local) + middle)


def sheared(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """The vertices moved along one axis as another one says."""
    axis, verts = rng.permutation(3), np.array(shape.verts)
    verts[:, axis[0]] += rng.uniform(0.2, 1.5) * verts[:, axis[1]]
    return verts


def lumpy(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """The vertices moved by a smooth random field."""
    verts = np.array(shape.verts)
    for _ in range(12):
        wave = direction(rng) * rng.uniform(2, 9)
        phase = rng.uniform(0, 2 * np.pi)
        verts += np.outer(np.sin(shape.verts @ wave + phase), direction(rng)) * rng.uniform(0.0, 0.05)
    return verts


@dataclass(frozen=True, eq=False)
class Case:
    """A shape, and of every vertex the template's vertex that it belongs to, or -1."""

    family: str
    shape: Shape
    truth: Int[Ints, " V"]


@dataclass(frozen=True, eq=False)
class Cases:
    """Draws cases of a kind of which there are generated shapes."""

    kind: str = "human"
    seed: int = 0

    @cached_property
    def template(self) -> Template:
        """What the truth is about."""
        return read_template("human-T") if self.kind == "human" else self._others[self.kind].template

    @cached_property
    def bodies(self) -> Float[Floats, "N V 3"]:
        """People, animals, hands or heads in poses, about as large as a person."""
        if self.kind == "human":
            return unseen_bodies(self.template, _DRAWN, seed=1000 + self.seed)
        return self._drawn(self.kind)

    @cached_property
    def _others(self) -> dict[str, Generator]:
        return {name: Kind(name, 64).generator(7100 + self.seed) for name in GENERATORS}

    def _drawn(self, kind: str) -> Float[Floats, "N V 3"]:
        if kind not in self._kept:
            generator = torch.Generator().manual_seed(7100 + self.seed)
            verts = self._others[kind].draw(_DRAWN, generator).double().numpy()
            self._kept[kind] = verts * (METRES / np.ptp(verts, axis=1).max(1)[:, None, None])
        return self._kept[kind]

    @cached_property
    def _kept(self) -> dict[str, Floats]:
        return {}

    @cached_property
    def _opposite(self) -> Int[Ints, " V"]:
        """The template's vertex across the plane of its symmetry."""
        verts = self.template.shape.verts
        return np.asarray(cKDTree(verts).query(verts * [-1, 1, 1])[1], dtype=np.int64)

    def draw(self, family: str, number: int) -> Case:
        """A case of a family, turned anywhere, in any unit."""
        rng = np.random.default_rng([self.seed, number, *family.encode()])
        shape, truth = FAMILIES[family](self, number, rng)
        turn, unit = Rotation.random(random_state=rng).as_matrix(), 10.0 ** rng.uniform(-2, 3)
        verts = unit * (np.asarray(shape.verts) @ turn.T + rng.normal(size=3))
        return Case(family, Shape(verts, shape.faces, f"{family} {number}"), truth)

    def body(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """A sound shape, by turns with the template's triangles and with others."""
        verts = self.bodies[int(rng.integers(len(self.bodies)))]
        shape = Shape(verts, self.template.shape.faces)
        if number % 2:
            return shape, np.arange(shape.V)
        fine = trimesh.Trimesh(verts, shape.faces, process=False).subdivide()
        other = decimate(Shape(fine.vertices, fine.faces), int(rng.integers(5_000, 16_000)))
        return other, np.asarray(cKDTree(verts).query(other.verts)[1], dtype=np.int64)

    # Right as a rule.

    def _cloud(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        points = sample_surface(shape, int(rng.integers(1_500, 12_000)), rng).points
        near = cKDTree(shape.verts).query(points)[1]
        noise = rng.uniform(0, 0.025) * rng.standard_normal(points.shape)
        return Shape(points + noise, np.empty((0, 3), np.int64)), truth[near]

    def _holes(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        centers = shape.verts[shape.faces].mean(1)
        kept: Bools = np.ones(shape.F, bool)
        for _ in range(int(rng.integers(1, 9))):
            at = centers[rng.integers(shape.F)]
            kept &= np.linalg.norm(centers - at, axis=1) > rng.uniform(0.04, 0.2)
        return faces_kept(shape, truth, kept)

    def _scan(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        scan = scanned(shape, int(rng.integers(2**31)))
        distance, near = cKDTree(shape.verts).query(scan.verts)
        return scan, np.where(distance < 0.05, truth[near], -1)

    def _dressed(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        return self._character(number, PLAIN)

    def _stylised(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        return self._character(number, (TOON, CHILD)[number % 2])

    def _character(self, number: int, kind: int) -> tuple[Shape, Ints]:
        drawn, faces = self._casts.setdefault(kind, []), self.template.shape.faces
        corners = np.concatenate([np.arange(self.template.shape.V), faces[:, 0]])  # of the body's other triangles
        while len(drawn) <= number:
            made = clothed_people(self.template, 10, kind, 100 + self.seed + len(drawn))
            drawn += [(each.shape, corners[np.asarray(each.places)]) for each in made]
        return drawn[number]

    @cached_property
    def _casts(self) -> dict[int, list[tuple[Shape, Ints]]]:
        return {}

    def _inside_out(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        return Shape(shape.verts, shape.faces[:, ::-1]), truth

    # Damaged.

    def _scaled(
        self, number: int, rng: np.random.Generator, factor: Callable[[np.random.Generator], float]
    ) -> tuple[Shape, Ints]:
        """Along one axis."""
        times = factor(rng)
        shape, truth = self.body(number, rng)
        axis = np.eye(3)[rng.integers(3)] if number % 3 else direction(rng)
        along = shape.verts @ axis
        return Shape(shape.verts + np.outer(along * (times - 1), axis), shape.faces), truth

    def _warped(
        self, number: int, rng: np.random.Generator, warp: Callable[[Shape, np.random.Generator], Floats]
    ) -> tuple[Shape, Ints]:
        """Its vertices elsewhere."""
        shape, truth = self.body(number, rng)
        return Shape(warp(shape, rng), shape.faces), truth

    def _mirrored(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        return Shape(shape.verts * [-1, 1, 1], shape.faces[:, ::-1]), self._opposite[truth]

    def _limb(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        kept = self._in_limb(truth, rng)[shape.faces].all(1)
        return faces_kept(shape, truth, np.asarray(kept))

    def _in_limb(self, truth: Ints, rng: np.random.Generator, most: int = len(LIMBS)) -> Bool[Bools, " V"]:
        """Whether vertices are of some limb, one of the first so many: of people a named one, else a few parts."""
        names, labels = self.template.label_names or (), np.asarray(self.template.labels)
        if self.kind == "human":
            asked = [names.index(name) for name in LIMBS[int(rng.integers(most))]]
        else:
            first = int(rng.integers(len(names)))
            asked = list(range(first, min(first + int(rng.integers(1, 4)), len(names))))
        return np.asarray(np.isin(labels[truth], asked))

    def _cut(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        return between(shape, truth, direction(rng), rng.uniform(0.1, 0.75), 1.0)

    def _merged(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        (one, first), (other, second) = self.body(number, rng), self.body(number + 1, rng)
        apart = rng.uniform(0.0, 0.8) * direction(rng)
        return joined(one, other, other.verts + apart), np.concatenate([first, second])

    def _floor(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        whole = on_floor(shape, rng.uniform(0.8, 6.0))
        return whole, np.append(truth, np.full(whole.V - shape.V, -1))

    # No bodies.

    def _animal(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """An animal, a hand or a head."""
        kind = [name for name in GENERATORS if name != self.kind][number % 2 if self.kind != "human" else number % 3]
        verts = self._drawn(kind)
        return no_body(verts[int(rng.integers(len(verts)))], np.asarray(self._others[kind].template.shape.faces))

    def _furniture(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        whole = melded(furniture(number, rng))
        return no_body(whole.verts, whole.faces)

    def _solid(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        whole = solids(rng)
        return no_body(whole.verts, whole.faces)

    def _kit(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Furniture of boxes that run into each other."""
        kit = boxes(furniture(number, rng), 0.2)
        return no_body(kit.verts, kit.faces)

    # Kept: nothing is tuned on these.

    def _amputated(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        shape, truth = self.body(number, rng)
        lost = self._in_limb(truth, rng, 8)[shape.faces].all(1)
        return faces_kept(shape, truth, np.asarray(~lost))

    def _beside(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Boxes and balls on or in the body."""
        shape, truth = self.body(number, rng)
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform(0.05, 0.8, 3)
            thing = boxes([np.stack([-0.5 * size, 0.5 * size])], 0.08)
            at = shape.verts[rng.integers(shape.V)] + rng.normal(size=3) * 0.1
            shape = joined(shape, thing, thing.verts + at)
            truth = np.append(truth, np.full(thing.V, -1))
        return shape, truth

    def _two_cut(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Two cuts: what lies between two parallel planes."""
        shape, truth = self.body(number, rng)
        axis, low = direction(rng), rng.uniform(0, 0.5)
        return between(shape, truth, axis, low, low + rng.uniform(0.3, 0.5))

    def _dense(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """The same surface in two million triangles."""
        shape, truth = self.body(number, rng)
        fine = refined(shape, 2_000_000)
        return fine, truth[cKDTree(shape.verts).query(fine.verts)[1]]

    def _fused(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """One skin around a body and the plinth, plate or floor that it stands in; of every other floor the top alone."""
        shape, truth = self.body(number, rng)
        whole, near = fused_with_base(shape, ("plinth", "plate", "floor", "scanned floor")[number % 4], rng)
        return whole, np.where(near < 0, -1, truth[near])

    def _not_manifold(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """With triangles twice, turned round, and across the body."""
        shape, truth = self.body(number, rng)
        some = rng.permutation(shape.F)
        twice, turned, across = (shape.faces[some[k::3]][: int(0.04 * shape.F)] for k in range(3))
        across = np.column_stack([across[:20, :2], rng.integers(shape.V, size=20)])
        return Shape(shape.verts, np.concatenate([shape.faces, twice, turned[:, ::-1], across])), truth


Family = Callable[[Cases, int, np.random.Generator], tuple[Shape, Ints]]
TUNED: dict[str, Family] = {
    "sound": Cases.body,
    "rough": partial(Cases._warped, warp=rough),
    "cloud": Cases._cloud,
    "holes": Cases._holes,
    "scan": Cases._scan,
    "dressed": Cases._dressed,
    "stylised": Cases._stylised,
    "swollen": partial(Cases._warped, warp=swollen),
    "inside out": Cases._inside_out,
    "squashed": partial(Cases._scaled, factor=lambda rng: rng.uniform(0.2, 0.8)),
    "flattened": partial(Cases._scaled, factor=lambda rng: rng.choice([0.0, rng.uniform(0, 0.15)])),
    "pulled": partial(Cases._scaled, factor=lambda rng: rng.uniform(1.25, 4.0)),
    "mirrored": Cases._mirrored,
    "limb": Cases._limb,
    "cut": Cases._cut,
    "merged": Cases._merged,
    "floor": Cases._floor,
    "melted": partial(Cases._warped, warp=melted),
    "animal": Cases._animal,
    "furniture": Cases._furniture,
    "solid": Cases._solid,
}
KEPT: dict[str, Family] = {
    "twisted": partial(Cases._warped, warp=twisted),
    "amputated": Cases._amputated,
    "things beside": Cases._beside,
    "sheared": partial(Cases._warped, warp=sheared),
    "lumpy": partial(Cases._warped, warp=lumpy),
    "cut twice": Cases._two_cut,
    "two million": Cases._dense,
    "not manifold": Cases._not_manifold,
    "kit": Cases._kit,
    "fused base": Cases._fused,
}
FAMILIES = TUNED | KEPT
OF_PEOPLE = ("dressed", "stylised")
