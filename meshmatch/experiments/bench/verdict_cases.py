"""Test cases for verdicts, with ground truth: sound and damaged shapes, and shapes of other kinds.

Each case of a family is a function of the seed and a number alone, with identities and poses that training did not use. The
truth of a vertex is the corresponding vertex of the template (low resolution), or -1 without a counterpart; shapes of other
kinds have none at all. Thresholds may be tuned on `TUNED` families, with seeds other than those that measure them, and never
on the held-out `KEPT` families.
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

_N_BODIES = 200
MAX_EXTENT = 1.7
"""Longest side of shapes other than people, in metres."""
LIMBS = (
    ("left thigh", "left shin", "left foot"), ("right thigh", "right shin", "right foot"),
    ("left upper arm", "left forearm", "left hand"), ("right upper arm", "right forearm", "right hand"),
    ("head", "neck"), ("left forearm", "left hand"), ("right hand",), ("left foot", "left shin"),
    ("chest", "belly", "hips"),
    ("hips", "left thigh", "left shin", "left foot", "right thigh", "right shin", "right foot"),
)  # fmt: skip
"""Labels of people's parts that are cut out together."""


CAMERAS, MIN_VIEWS = 8, 2
"""Number of cameras around a scanned body, and of those that must see a face."""
NOISE = 0.0015  # standard deviation in scans, as a fraction of the bounding box's diagonal: 3 mm on a person
_HEIGHTS = (-0.15, 0.45)  # y of the cameras' directions before normalisation, alternating: from below and from above


def camera_directions(cameras: int = CAMERAS) -> Float[Floats, "C 3"]:
    """Return directions from a body to cameras around it; y is up."""
    angle = 2 * np.pi * np.arange(cameras) / cameras + 0.2
    towards = np.stack([np.sin(angle), np.resize(_HEIGHTS, cameras), np.cos(angle)], axis=1)
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))


def simulate_scan(body: Shape, seed: int) -> Shape:
    """Simulate a scan: faces seen by enough cameras, with noise along normals; armpits, crotch and soles are holes."""
    centers = body.verts[body.faces].mean(axis=1)
    views = np.sum([seen_faces(body, centers, towards) for towards in camera_directions()], axis=0)
    faces = body.faces[views >= MIN_VIEWS]
    used = np.unique(faces)
    off = NOISE * body.diagonal * np.random.default_rng(seed).standard_normal((len(used), 1))
    return Shape(body.verts[used] + off * body.vertex_normals[used], np.searchsorted(used, faces), body.name)


def direction(rng: np.random.Generator) -> Float[Floats, " 3"]:
    """Draw a random unit vector."""
    found = rng.normal(size=3)
    return np.asarray(found / np.linalg.norm(found))


def faces_kept(shape: Shape, truth: Ints, kept: Bool[Bools, " F"]) -> tuple[Shape, Ints]:
    """Return a shape of selected faces, and the truth of its vertices."""
    used, faces = np.unique(shape.faces[kept], return_inverse=True)
    return Shape(shape.verts[used], faces.reshape(-1, 3)), truth[used]


def faces_between(shape: Shape, truth: Ints, axis: Float[Floats, " 3"], low: float, high: float) -> tuple[Shape, Ints]:
    """Return the faces between two quantiles (0 to 1) of their centers' coordinates along an axis."""
    along = shape.verts[shape.faces].mean(1) @ axis
    first, last = np.quantile(along, [low, high])
    return faces_kept(shape, truth, np.asarray((along > first) & (along <= last)))


def concatenate(shape: Shape, other: Shape, at: Float[Floats, "W 3"]) -> Shape:
    """Concatenate two shapes; the vertices of the second one are moved to ``at``."""
    return Shape(np.concatenate([shape.verts, at]), np.concatenate([shape.faces, other.faces + shape.V]))


def grid(side: float, cells: int) -> Shape:
    """Build a square in the plane y = 0, centred at the origin."""
    x, z = np.meshgrid(*[np.linspace(-0.5 * side, 0.5 * side, cells + 1)] * 2, indexing="ij")
    corner = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = corner[:-1, :-1].ravel(), corner[:-1, 1:].ravel(), corner[1:, 1:].ravel(), corner[1:, :-1].ravel()
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return Shape(np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()]), faces)


def subdivide_to(shape: Shape, F: int) -> Shape:
    """Subdivide a surface into F triangles or a few more; T-junctions leave slits between triangles of two sizes."""
    verts, faces = np.asarray(shape.verts), np.asarray(shape.faces)
    while len(faces) < F:
        some = np.arange(min(len(faces), -(-(F - len(faces)) // 3)))
        verts, faces = trimesh.remesh.subdivide(verts, faces, some)
    return Shape(verts, faces)


def random_solids(rng: np.random.Generator) -> Shape:
    """Draw a few overlapping boxes, balls and capsules."""
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
    return reduce(lambda whole, part: concatenate(whole, part, part.verts), parts)


def build_boxes(corners: Sequence[Float[Floats, "2 3"]], edge: float) -> Shape:
    """Build boxes, which may overlap, from their lower and upper corners, without edges longer than ``edge``."""
    parts = []
    for low, high in corners:
        made = trimesh.creation.box(high - low).subdivide_to_size(edge)
        parts.append(Shape(np.asarray(made.vertices) + 0.5 * (low + high), np.asarray(made.faces)))
    return reduce(lambda whole, part: concatenate(whole, part, part.verts), parts)


def furniture(number: int, rng: np.random.Generator) -> list[Float[Floats, "2 3"]]:
    """Draw the boxes (lower and upper corners) of a chair, a plane or a table, depending on ``number``; y is up."""
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


def box_union(corners: Sequence[Float[Floats, "2 3"]], cells: int = 48) -> Shape:
    """Build the union of boxes as one watertight mesh with rounded edges, by marching cubes on a grid of their distances."""
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
    """Put a shape on the middle of a square floor; ``side`` is its length."""
    plane = grid(side, 40)
    at = np.array([shape.verts[:, 0].mean(), shape.verts[:, 1].min(), shape.verts[:, 2].mean()])
    return concatenate(shape, plane, plane.verts + at)


def as_unrelated(verts: Floats, faces: Ints) -> tuple[Shape, Ints]:
    """Scale a shape to the size of a person; no vertex has a counterpart."""
    return Shape(verts * (MAX_EXTENT / np.ptp(verts, axis=0).max()), faces), np.full(len(verts), -1)


def rough(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Add noise to the vertices."""
    return np.asarray(shape.verts + rng.uniform(0.002, 0.04) * rng.standard_normal(shape.verts.shape))


def swollen(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Move the vertices outward along their normals."""
    return np.asarray(shape.verts + rng.uniform(0.01, 0.06) * shape.vertex_normals)


def melted(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Smooth the vertices, in up to 400 iterations."""
    mesh = trimesh.Trimesh(shape.verts, shape.faces, process=False)
    trimesh.smoothing.filter_laplacian(mesh, iterations=int(rng.integers(20, 400)))
    return np.asarray(mesh.vertices)


def twisted(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Twist the vertices about the y axis."""
    middle = shape.verts.mean(0)
    local = shape.verts - middle
    turns = Rotation.from_rotvec(np.outer(local[:, 1] * rng.uniform(0.3, 4.0), [0, 1, 0]))
    return np.asarray(turns.apply(local) + middle)


def sheared(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Shear the vertices along one axis, proportionally to another."""
    axis, verts = rng.permutation(3), np.array(shape.verts)
    verts[:, axis[0]] += rng.uniform(0.2, 1.5) * verts[:, axis[1]]
    return verts


def lumpy(shape: Shape, rng: np.random.Generator) -> Float[Floats, "V 3"]:
    """Move the vertices by a smooth random field."""
    verts = np.array(shape.verts)
    for _ in range(12):
        wave = direction(rng) * rng.uniform(2, 9)
        phase = rng.uniform(0, 2 * np.pi)
        verts += np.outer(np.sin(shape.verts @ wave + phase), direction(rng)) * rng.uniform(0.0, 0.05)
    return verts


@dataclass(frozen=True, eq=False)
class Case:
    """A shape, and the corresponding template vertex of each of its vertices, or -1."""

    family: str
    shape: Shape
    truth: Int[Ints, " V"]


@dataclass(frozen=True, eq=False)
class Cases:
    """Generator of test cases for a kind."""

    kind: str = "human"
    seed: int = 0

    @cached_property
    def template(self) -> Template:
        """The template whose vertices the truth refers to."""
        return read_template("human-T") if self.kind == "human" else self._others[self.kind].template

    @cached_property
    def bodies(self) -> Float[Floats, "N V 3"]:
        """Posed shapes of the kind, about as large as a person."""
        if self.kind == "human":
            return unseen_bodies(self.template, _N_BODIES, seed=1000 + self.seed)
        return self._generated(self.kind)

    @cached_property
    def _others(self) -> dict[str, Generator]:
        return {name: Kind(name, 64).generator(7100 + self.seed) for name in GENERATORS}

    def _generated(self, kind: str) -> Float[Floats, "N V 3"]:
        """Return generated shapes of a kind, scaled to `MAX_EXTENT`; they are cached."""
        if kind not in self._generated_cache:
            generator = torch.Generator().manual_seed(7100 + self.seed)
            verts = self._others[kind].draw(_N_BODIES, generator).double().numpy()
            self._generated_cache[kind] = verts * (MAX_EXTENT / np.ptp(verts, axis=1).max(1)[:, None, None])
        return self._generated_cache[kind]

    @cached_property
    def _generated_cache(self) -> dict[str, Floats]:
        return {}

    @cached_property
    def _opposite(self) -> Int[Ints, " V"]:
        """Index of the vertex nearest to each vertex's mirror image in the template's plane of symmetry."""
        verts = self.template.shape.verts
        return np.asarray(cKDTree(verts).query(verts * [-1, 1, 1])[1], dtype=np.int64)

    def draw(self, family: str, number: int) -> Case:
        """Draw a case of a family, in a random orientation and unit of length."""
        rng = np.random.default_rng([self.seed, number, *family.encode()])
        shape, truth = FAMILIES[family](self, number, rng)
        turn, unit = Rotation.random(random_state=rng).as_matrix(), 10.0 ** rng.uniform(-2, 3)
        verts = unit * (np.asarray(shape.verts) @ turn.T + rng.normal(size=3))
        return Case(family, Shape(verts, shape.faces, f"{family} {number}"), truth)

    def body(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Draw a sound shape: with the template's triangles for odd numbers, remeshed for even ones."""
        verts = self.bodies[int(rng.integers(len(self.bodies)))]
        shape = Shape(verts, self.template.shape.faces)
        if number % 2:
            return shape, np.arange(shape.V)
        fine = trimesh.Trimesh(verts, shape.faces, process=False).subdivide()
        other = decimate(Shape(fine.vertices, fine.faces), int(rng.integers(5_000, 16_000)))
        return other, np.asarray(cKDTree(verts).query(other.verts)[1], dtype=np.int64)

    # Cases that usually have a right fit.

    def _cloud(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Sample a body as a noisy point cloud."""
        shape, truth = self.body(number, rng)
        points = sample_surface(shape, int(rng.integers(1_500, 12_000)), rng).points
        near = cKDTree(shape.verts).query(points)[1]
        noise = rng.uniform(0, 0.025) * rng.standard_normal(points.shape)
        return Shape(points + noise, np.empty((0, 3), np.int64)), truth[near]

    def _holes(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Cut random holes into a body."""
        shape, truth = self.body(number, rng)
        centers = shape.verts[shape.faces].mean(1)
        kept: Bools = np.ones(shape.F, bool)
        for _ in range(int(rng.integers(1, 9))):
            at = centers[rng.integers(shape.F)]
            kept &= np.linalg.norm(centers - at, axis=1) > rng.uniform(0.04, 0.2)
        return faces_kept(shape, truth, kept)

    def _scan(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Simulate a scan of a body; vertices far from the body have no counterpart."""
        shape, truth = self.body(number, rng)
        scan = simulate_scan(shape, int(rng.integers(2**31)))
        distance, near = cKDTree(shape.verts).query(scan.verts)
        return scan, np.where(distance < 0.05, truth[near], -1)

    def _dressed(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Return a clothed person."""
        return self._character(number, PLAIN)

    def _stylised(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Return a stylised person or a child, by turns."""
        return self._character(number, (TOON, CHILD)[number % 2])

    def _character(self, number: int, kind: int) -> tuple[Shape, Ints]:
        """Return a generated person of a style in clothes; people are drawn in batches and cached."""
        drawn, faces = self._character_cache.setdefault(kind, []), self.template.shape.faces
        # Template vertex of each vertex of the body that `clothed_people` refines.
        corners = np.concatenate([np.arange(self.template.shape.V), faces[:, 0]])
        while len(drawn) <= number:
            made = clothed_people(self.template, 10, kind, 100 + self.seed + len(drawn))
            drawn += [(each.shape, corners[np.asarray(each.places)]) for each in made]
        return drawn[number]

    @cached_property
    def _character_cache(self) -> dict[int, list[tuple[Shape, Ints]]]:
        return {}

    def _inside_out(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Reverse the faces of a body."""
        shape, truth = self.body(number, rng)
        return Shape(shape.verts, shape.faces[:, ::-1]), truth

    # Damaged shapes.

    def _scaled(
        self, number: int, rng: np.random.Generator, factor: Callable[[np.random.Generator], float]
    ) -> tuple[Shape, Ints]:
        """Scale a body along a random axis."""
        times = factor(rng)
        shape, truth = self.body(number, rng)
        axis = np.eye(3)[rng.integers(3)] if number % 3 else direction(rng)
        along = shape.verts @ axis
        return Shape(shape.verts + np.outer(along * (times - 1), axis), shape.faces), truth

    def _warped(
        self, number: int, rng: np.random.Generator, warp: Callable[[Shape, np.random.Generator], Floats]
    ) -> tuple[Shape, Ints]:
        """Apply a deformation to a body."""
        shape, truth = self.body(number, rng)
        return Shape(warp(shape, rng), shape.faces), truth

    def _mirrored(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Reflect a body; left and right of the truth are exchanged."""
        shape, truth = self.body(number, rng)
        return Shape(shape.verts * [-1, 1, 1], shape.faces[:, ::-1]), self._opposite[truth]

    def _limb(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Cut a limb out of a body."""
        shape, truth = self.body(number, rng)
        kept = self._in_limb(truth, rng)[shape.faces].all(1)
        return faces_kept(shape, truth, np.asarray(kept))

    def _in_limb(self, truth: Ints, rng: np.random.Generator, most: int = len(LIMBS)) -> Bool[Bools, " V"]:
        """Select the vertices of a limb at random: one of the first ``most`` of `LIMBS` for people, else a few parts."""
        names, labels = self.template.label_names or (), np.asarray(self.template.labels)
        if self.kind == "human":
            asked = [names.index(name) for name in LIMBS[int(rng.integers(most))]]
        else:
            first = int(rng.integers(len(names)))
            asked = list(range(first, min(first + int(rng.integers(1, 4)), len(names))))
        return np.asarray(np.isin(labels[truth], asked))

    def _cut(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Keep what is on one side of a random plane."""
        shape, truth = self.body(number, rng)
        return faces_between(shape, truth, direction(rng), rng.uniform(0.1, 0.75), 1.0)

    def _merged(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Merge two bodies, near each other."""
        (one, first), (other, second) = self.body(number, rng), self.body(number + 1, rng)
        apart = rng.uniform(0.0, 0.8) * direction(rng)
        return concatenate(one, other, other.verts + apart), np.concatenate([first, second])

    def _floor(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Add a floor to a body."""
        shape, truth = self.body(number, rng)
        whole = on_floor(shape, rng.uniform(0.8, 6.0))
        return whole, np.append(truth, np.full(whole.V - shape.V, -1))

    # Shapes of other kinds.

    def _animal(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Draw a shape of another kind with a generator: an animal, a hand or a head."""
        kind = [name for name in GENERATORS if name != self.kind][number % 2 if self.kind != "human" else number % 3]
        verts = self._generated(kind)
        return as_unrelated(verts[int(rng.integers(len(verts)))], np.asarray(self._others[kind].template.shape.faces))

    def _furniture(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Draw watertight furniture."""
        whole = box_union(furniture(number, rng))
        return as_unrelated(whole.verts, whole.faces)

    def _solid(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Draw overlapping solids."""
        whole = random_solids(rng)
        return as_unrelated(whole.verts, whole.faces)

    def _kit(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Draw furniture of overlapping boxes."""
        kit = build_boxes(furniture(number, rng), 0.2)
        return as_unrelated(kit.verts, kit.faces)

    # Held-out families: nothing is tuned on these.

    def _amputated(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Remove a limb from a body."""
        shape, truth = self.body(number, rng)
        lost = self._in_limb(truth, rng, 8)[shape.faces].all(1)
        return faces_kept(shape, truth, np.asarray(~lost))

    def _with_objects(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Add boxes on or in the body."""
        shape, truth = self.body(number, rng)
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform(0.05, 0.8, 3)
            thing = build_boxes([np.stack([-0.5 * size, 0.5 * size])], 0.08)
            at = shape.verts[rng.integers(shape.V)] + rng.normal(size=3) * 0.1
            shape = concatenate(shape, thing, thing.verts + at)
            truth = np.append(truth, np.full(thing.V, -1))
        return shape, truth

    def _cut_twice(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Keep what is between two parallel planes."""
        shape, truth = self.body(number, rng)
        axis, low = direction(rng), rng.uniform(0, 0.5)
        return faces_between(shape, truth, axis, low, low + rng.uniform(0.3, 0.5))

    def _dense(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Subdivide a body into two million triangles."""
        shape, truth = self.body(number, rng)
        fine = subdivide_to(shape, 2_000_000)
        return fine, truth[cKDTree(shape.verts).query(fine.verts)[1]]

    def _fused(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Fuse a body and its plinth, plate or floor into one surface; scanned floors have only their top side."""
        shape, truth = self.body(number, rng)
        whole, near = fused_with_base(shape, ("plinth", "plate", "floor", "scanned floor")[number % 4], rng)
        return whole, np.where(near < 0, -1, truth[near])

    def _not_manifold(self, number: int, rng: np.random.Generator) -> tuple[Shape, Ints]:
        """Duplicate triangles, also with reversed orientation, and add triangles across the body."""
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
    "things beside": Cases._with_objects,
    "sheared": partial(Cases._warped, warp=sheared),
    "lumpy": partial(Cases._warped, warp=lumpy),
    "cut twice": Cases._cut_twice,
    "two million": Cases._dense,
    "not manifold": Cases._not_manifold,
    "kit": Cases._kit,
    "fused base": Cases._fused,
}
FAMILIES = TUNED | KEPT
OF_PEOPLE = ("dressed", "stylised")
