"""Where on the source the texels of the target's atlas lie, and the color of any point of the source: from its
materials, images and vertex colors.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from meshmatch.arrays import Bools, Float, Floats, Floats32, Ints, Ints32
from meshmatch.geometry.triangles import cross_product, interpolate, squared_lengths
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.appearance import Alpha, Appearance, Material
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.surface_walk import SurfaceWalker, duals, weighted
from meshmatch.transfer.texels import MOST_ROWS, pyramids_of, rows_of, texels_in, wrapped

# The map is discontinuous on a triangle if an edge of its image is this many times as long as usual, and a little
# more (sqrt(area)). Set by hand, as in `mapped_mesh`.
_STRETCH, _SLACK = 3.0, 0.02
# A bend by more than this share of an edge is where the map is discontinuous, or maps disagree. Set by hand.
_BENT = 0.25
_FEW = 200_000  # faces; on larger meshes edges are short enough to be straight
# A place this far off, in sizes of its triangle's image, is searched again from the other corners. Set by hand.
_FAR = 0.1
_BESIDE = 0.499  # of a texel: what a color between texels is mixed of, but for what hardly counts
_POINTS = 2**18  # at a time, along triangles that are lines


class MaterialSampler:
    """The look of a shape: materials, images as pyramids, and how dense their texels lie.

    The walker is of the same file; lengths are in its unit. For a cloud, whose points are its faces, the look has a
    material for each point. `alpha` and `cutoff` say what the alpha of `colors` means; faces over whose edges the
    colors go on without a seam have one number in `chart` (F,).
    """

    def __init__(self, look: Appearance, walker: SurfaceWalker) -> None:
        self.materials = look.materials
        self._material = look.material
        self._faces = walker.faces
        self._colors = None if look.colors is None else list(look.colors.T.astype(np.float32, order="C"))
        used = [self.materials[k] for k in np.unique(look.material).tolist()]
        self.alpha, self.cutoff, self._hard = _meaning(used)
        uv = _folded(look.uv)
        held = np.array(["clamp" in m.wrap for m in self.materials])[look.material]
        uv[held] = look.uv[held]
        self._uv = [list(uv[:, :, k].T.astype(np.float32, order="C")) for k in range(2)]
        self.chart = charts_of(walker, look)
        self._density = _densities(walker, self.materials, look.material, look.uv)
        self._pyramids = pyramids_of(look, known_texels)

    def footprint(self, face: NDArray[np.integer], reach: Floats32) -> Floats32:
        """How many texels of its image a step of `reach` (N,) covers on faces (N,)."""
        return reach * self._density.take(face)

    def colors(self, face: NDArray[np.integer], weights: Floats32, footprint: Floats32) -> Floats32:
        """Linear colors and alpha (4, N) on faces (N,) at weights (3, N), as wide as `footprint` (N,) texels."""
        if len(self.materials) == 1:
            return self._of_one(0, face, weights, footprint)
        out = np.ones((4, len(face)), np.float32)
        material = self._material.take(face)
        order = np.argsort(material, kind="stable")
        used, begins = np.unique(material[order], return_index=True)
        for number, rows in zip(used.tolist(), np.split(order, begins[1:]), strict=True):
            out[:, rows] = self._of_one(number, face[rows], weights[:, rows], footprint[rows])
        return out

    def _of_one(self, number: int, face: NDArray[np.integer], weights: Floats32, footprint: Floats32) -> Floats32:
        made = self.materials[number]
        out = np.ones((4, len(face)), np.float32)
        if number in self._pyramids:
            u, v = (weighted(weights, [column.take(face) for column in columns]) for columns in self._uv)
            out = self._pyramids[number].look(u, v, footprint)
        if made.factor != (1.0, 1.0, 1.0, 1.0):
            out *= np.array(made.factor, np.float32)[:, None]
        if self._colors is not None:
            corners = self._faces[face].T
            for k in range(4):
                out[k] *= weighted(weights, [self._colors[k].take(corner) for corner in corners])
        if made.alpha == "opaque":
            out[3] = 1.0
        elif made.alpha == "mask" and self._hard:
            out[3] = out[3] >= made.cutoff
        return out


def _folded(uv: Floats) -> Floats:
    """Coordinates (F, 3, 2) without whole repeats of an image, also of a mirrored one: they change nothing."""
    return np.asarray(uv - 2.0 * np.floor(uv.min(axis=1, keepdims=True) / 2.0))


def _meaning(used: list[Material]) -> tuple[Alpha, float, bool]:
    """Alpha and cutoff for all materials together, and whether those of "mask" are decided at once."""
    kinds = {material.alpha for material in used}
    cutoffs = {material.cutoff for material in used if material.alpha == "mask"}
    if "blend" in kinds:
        return "blend", 0.5, True
    if "mask" in kinds:
        return ("mask", cutoffs.pop(), False) if len(cutoffs) == 1 else ("mask", 0.5, True)
    return "opaque", 0.5, False


def known_texels(material: Material, uv: Floats) -> Bools | None:
    """(H, W) True for the texels of an image on the surface, by the coordinates (F, 3, 2) of its faces; None where it
    is not worth asking: an image that is tiled, or laid over itself many times.
    """
    assert material.image is not None
    height, width = material.image.shape[:2]
    if len(uv) == 0 or (uv.max(axis=1) - uv.min(axis=1)).max() >= 1.0:
        return None
    corners = (uv if "clamp" in material.wrap else _folded(uv)) * np.array([width, height])
    size = corners.max(axis=1) - corners.min(axis=1) + 1.0
    if np.prod(size, axis=1).sum() > 16.0 * width * height + 64.0 * len(uv) or rows_of(corners).sum() > MOST_ROWS:
        return None
    known, small = np.zeros((height, width), bool), np.ones(len(uv), bool)
    for face, column, row in texels_in(corners):
        known[wrapped(row, height, material.wrap[1]), wrapped(column, width, material.wrap[0])] = True
        small[face] = False
    # Triangles that hold no center of a texel still name some; they count where nothing near is known.
    at = _texels_at(corners[small].mean(axis=1), material, known.shape)
    alone = ~maximum_filter(known, 3)[at]
    thin = corners[small][alone]
    sides = thin[:, [1, 2, 0]] - thin
    rows, longest = np.arange(len(thin)), np.square(sides).sum(axis=2).argmax(axis=1)
    start, side = thin[rows, longest], sides[rows, longest]
    ends = np.cumsum(np.ceil(2.0 * np.abs(side).max(axis=1)).astype(np.int64) + 1)  # points half a texel apart
    if len(ends) and ends[-1] > known.size + 64 * len(uv):
        return None
    for low in range(0, int(ends[-1]) if len(ends) else 0, _POINTS):
        point = np.arange(low, min(low + _POINTS, int(ends[-1])))
        row = np.searchsorted(ends, point, side="right")
        first, count = np.where(row > 0, ends[row - 1], 0), np.diff(ends, prepend=0)[row]
        share = (point - first) / np.maximum(count - 1, 1)
        points = start[row] + share[:, None] * side[row]
        for offset in itertools.product((-_BESIDE, _BESIDE), repeat=2):
            known[_texels_at(points + offset, material, known.shape)] = True
    return known


def _texels_at(points: Floats, material: Material, shape: tuple[int, ...]) -> tuple[Ints, Ints]:
    """Row and column of the texels on which points (N, 2) lie."""
    column, row = np.floor(points).astype(np.int64).T
    return wrapped(row, shape[0], material.wrap[1]), wrapped(column, shape[1], material.wrap[0])


def _densities(walker: SurfaceWalker, materials: tuple[Material, ...], material: Ints, uv: Floats) -> Floats32:
    """(F,) texels of its image along a unit of length on each face (one on the whole face without an image): as an area
    has them, or half of what the densest direction has if that is more.
    """
    sizes = np.array([(0, 0) if m.image is None else m.image.shape[1::-1] for m in materials], np.float64)
    corners = uv * sizes[material][:, None]
    first, second = duals(walker.verts[walker.faces])
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    u, v = (one[:, k : k + 1] * first + two[:, k : k + 1] * second for k in range(2))
    density = reach_of(u, v)
    plain = sizes[material][:, 0] == 0
    density[plain] = 1.0 / np.sqrt(2.0 * np.maximum(walker.areas[plain], 1e-12))
    return density.astype(np.float32)


def reach_of(first: Floats, second: Floats) -> Floats:
    """(N,) the size of a parallelogram (N, 3), (N, 3): the root of its area, or half its longest extent."""
    a, c = squared_lengths(first), squared_lengths(second)
    b = np.einsum("ni,ni->n", first, second)
    longest = np.sqrt((a + c) / 2 + np.sqrt(((a - c) / 2) ** 2 + b * b))
    area = np.sqrt(squared_lengths(cross_product(first, second)))
    return np.asarray(np.maximum(np.sqrt(area), longest / 2))


def seams_of(walker: SurfaceWalker, look: Appearance) -> Bools:
    """(F, 3) True for an edge, by the corner opposite to it, over which material or texture coordinates do not go on."""
    found = np.ones(walker.opposite.shape, bool)
    for k in range(3):
        face = np.flatnonzero(walker.opposite[:, k] >= 0)
        other, edge = (each[face, k].astype(np.int64) for each in (walker.opposite, walker.opposite_edge))
        ends, theirs = ((k + 1) % 3, (k + 2) % 3), ((edge + 1) % 3, (edge + 2) % 3)
        # the other face runs along the edge the other way round, unless it is turned over
        same_way = walker.same[face, ends[0]] == walker.same[other, theirs[0]]
        agree = look.material[face] == look.material[other]
        for i in (0, 1):
            corner = np.where(same_way, theirs[i], theirs[1 - i])
            agree &= np.abs(look.uv[face, ends[i]] - look.uv[other, corner]).max(axis=1) < 1e-6
        found[face, k] = ~agree
    return found


def charts_of(walker: SurfaceWalker, look: Appearance) -> Ints32:
    """(F,) faces joined over edges that are no seams; without an image, by material."""
    F = len(walker.faces)
    face, edge = np.nonzero(~seams_of(walker, look))
    graph = coo_array((np.ones(len(face), np.int8), (face, walker.opposite[face, edge])), shape=(F, F))
    chart = np.asarray(connected_components(graph, directed=False)[1], np.int32)
    pictured = np.array([made.image is not None for made in look.materials])[look.material]
    return np.where(pictured, chart, F + look.material).astype(np.int32)


class TexelLocator:
    """Where the target's triangles lie on the source, and where each point of their texels does.

    The walker is that of the source, `back` a map from target to source, and corners (F, 3, 2) are those of the
    target's triangles in the atlas, counted in texels. `discontinuous` (F,) are triangles whose corners' images lie far
    apart. Their texels continue the surface around the nearest corner, by the `jacobian` (V, 3, 3) there, and meet in the
    middle: a cut, where interpolation would smear. `reach` (F,) is the size of a texel on the source. With
    `bends_of` the maps, images of triangles are bent.
    """

    def __init__(
        self, walker: SurfaceWalker, target: Shape, back: VertexMap, corners: Floats, bends: Floats | None = None
    ) -> None:
        self.walker = walker
        self._confidence = back.assumed_confidence.astype(np.float32)
        self._image, start = images_of(walker, back)
        self.faces, self.verts = target.faces, target.verts
        self._corners = list(np.ascontiguousarray(target.faces.T))
        held = self._image[target.faces]
        first, second = held[:, 1] - held[:, 0], held[:, 2] - held[:, 0]
        flat = _inverse(corners)
        right = flat[:, 0:1] * first + flat[:, 2:3] * second
        down = flat[:, 1:2] * first + flat[:, 3:4] * second
        self.reach = reach_of(right, down).astype(np.float32)
        length, own_length = (
            np.linalg.norm(each - np.roll(each, -1, axis=1), axis=2) for each in (held, target.verts[target.faces])
        )
        self._size = length.max(axis=1).astype(np.float32)
        scale = float(np.median(length.ravel() / np.maximum(own_length.ravel(), 1e-300)))
        self.discontinuous = (length > _STRETCH * scale * own_length + _SLACK).any(axis=1) | ~target.valid_faces
        if self.discontinuous.any():
            self.jacobian = _jacobians(target, held, ~self.discontinuous)
            bend = (scale * own_length.max(axis=1) / np.maximum(self._size, 1e-12)).astype(np.float32)
            self.reach[self.discontinuous] *= bend[self.discontinuous]
        self._steps = first, second
        self._start = list(start[target.faces].T.astype(np.int32, order="C"))
        bent = [] if bends is None else [bends.reshape(-1, 9)]
        table = np.concatenate([corners[:, 0], flat, held[:, 0], first, second, *bent], axis=1)
        self._table = list(table.T.astype(np.float32, order="C"))

    def laid(self, directions: Float[Floats, "F N M 3"]) -> Float[Floats, "F N M 3"]:
        """Directions along each triangle of the target, as the map lays them on the source."""
        shares = (np.einsum("fnmi,fi->fnm", directions, dual) for dual in duals(self.verts[self.faces]))
        one, two = (share[..., None] * step[:, None, None] for share, step in zip(shares, self._steps, strict=True))
        return np.asarray(one + two)

    def locate(
        self, face: Ints32, x: Floats32, y: Floats32, start: Ints32 | None = None
    ) -> tuple[Floats32, Ints32, Floats32]:
        """Places of points (N,), (N,) of the atlas that belong to triangles (N,) of the target: weights (3, N) in the
        triangle; face (N,) and weights (3, N) on the source. Points outside their triangle continue its plane.
        """
        column = [values.take(face) for values in self._table]
        right, down = x - column[0], y - column[1]
        weights = np.empty((3, len(face)), np.float32)
        weights[1] = column[2] * right + column[3] * down
        weights[2] = column[4] * right + column[5] * down
        weights[0] = 1 - weights[1] - weights[2]
        wild = np.flatnonzero(np.minimum(np.minimum(weights[0], weights[1]), weights[2]) < -1)
        if len(wild):  # slivers: one texel aside is many triangles aside
            held = np.clip(weights[:, wild], 0, 1)
            weights[:, wild] = held / held.sum(axis=0)
        points = np.empty((3, len(face)), np.float32)
        for k in range(3):
            points[k] = column[6 + k] + weights[1] * column[9 + k] + weights[2] * column[12 + k]
        if len(column) > 15:  # 1 in the middle of an edge, 0 at the other middles and at the corners, linear in between
            one, two, three = np.maximum(weights, 0)
            for at, (left, right, far) in ((15, (two, three, one)), (18, (three, one, two)), (21, (one, two, three))):
                share = np.maximum(np.minimum(np.minimum(2 * left, 2 * right), 1 - 2 * far), 0)
                for k in range(3):
                    points[k] += share * column[at + k]
        corner = np.where(weights[2] > np.maximum(weights[0], weights[1]), 2, weights[1] > weights[0])
        cut = np.flatnonzero(self.discontinuous.take(face))
        if len(cut):
            points[:, cut] = self._continued(face[cut], weights[:, cut], corner[cut])
        begin = self._begin(face, corner)
        begin = begin if start is None else np.where(start >= 0, start, begin)
        place, held, distance = self.walker.closest(points, begin)
        far = np.flatnonzero(distance > _FAR * self._size.take(face))
        for k in (1, 2) if len(far) else ():
            other = self._begin(face[far], (corner[far] + k) % 3)
            there, weigh, gap = self.walker.closest(points[:, far], other)
            better = gap < distance[far]
            rows = far[better]
            place[rows], held[:, rows], distance[rows] = there[better], weigh[:, better], gap[better]
        return weights, place, held

    def _begin(self, face: Ints32, corner: Ints) -> Ints32:
        """Where the images of the corners lie: faces of the source."""
        return np.choose(corner, [column.take(face) for column in self._start])

    def confidence(self, face: Ints32, weights: Floats32) -> Floats32:
        """(N,) of the map at points (3, N) of triangles (N,)."""
        held = np.maximum(weights, 0)
        sure = weighted(held, [self._confidence.take(column.take(face)) for column in self._corners])
        return np.asarray(sure / (held[0] + held[1] + held[2]))

    def _continued(self, face: Ints32, weights: Floats32, corner: Ints) -> Floats32:
        """Points (3, N) of discontinuous triangles: the surface around the nearest corner, continued."""
        vertex = self.faces[face, corner]
        corners = self.verts[self.faces[face]]
        away = np.einsum("kn,nkd->nd", weights, corners) - self.verts[vertex]
        points = self._image[vertex] + np.einsum("nij,nj->ni", self.jacobian[vertex], away)
        return np.asarray(points.T, np.float32)


def bends_of(source: Shape, target: Shape, forward: VertexMap, back: VertexMap) -> Float[Floats, "F 3 3"] | None:
    """How far the image of the middle of each triangle's edge, opposite to each corner, lies from the middle of the images
    of its ends (units of the source's sqrt(area)), all by the inverse of the map ``forward`` from source to target.

    A map is known at the vertices of a mesh, and images of its triangles are flat. The map that goes the other way is flat
    on the other mesh's triangles, and says how they bend: so a texture comes back to where it was. None where nothing is
    known, also of a map that knows vertices alone; an edge does not bend where both maps disagree about its ends.
    """
    if source.is_cloud or target.F > _FEW or forward.on_vertex.mean() > 0.5:
        return None
    ends = np.sort(target.faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
    edges, of_face = np.unique(ends[..., 0] * target.V + ends[..., 1], return_inverse=True)
    ends = np.stack(np.divmod(edges, target.V), axis=1)
    there = SurfaceWalker(Shape(forward.points(target), source.faces, invalid=source.invalid))
    own, verts = SurfaceWalker(source), (target.verts - there.center) / there.unit
    known, start = images_of(own, back)
    asked = np.concatenate([verts, verts[ends].mean(axis=1)])
    start = np.concatenate([start, start[ends[:, 0]]])
    face, weights, _ = there.closest(asked.T.astype(np.float32, order="C"), start.astype(np.int32))
    corners, weights = there.faces[face], weights.T.astype(np.float64)
    image, off = interpolate(own.verts, corners, weights), interpolate(there.verts, corners, weights) - asked
    bends, (one, two) = image[target.V :] - image[ends].mean(axis=1), ends.T
    apart = image[: target.V] - known
    for far, at in ((bends, known), (apart[one], known), (apart[two], known), (off[target.V :], verts)):
        bends[squared_lengths(far) > _BENT**2 * squared_lengths(at[two] - at[one])] = 0.0
    return np.asarray(bends[of_face.reshape(-1, 3)])


def images_of(walker: SurfaceWalker, back: VertexMap) -> tuple[Floats, Ints]:
    """(V_target, 3) where each vertex of the target lies on the source, and (V_target,) a face of the source there."""
    image = walker.verts[back.index]
    inside = np.flatnonzero(back.face >= 0)
    image[inside] = interpolate(walker.verts, walker.faces[back.face[inside]], back.barycentric[inside])
    return image, np.where(back.face >= 0, back.face, walker.face_of_vertex[back.index])


def _inverse(corners: Floats) -> Floats:
    """(F, 4) the linear map from an offset (2,) from the first corner, in texels, to the weights of the second and third."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    determinant = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    share = np.where(determinant == 0, 0.0, 1.0 / np.where(determinant == 0, 1.0, determinant))
    return np.stack([two[:, 1], -two[:, 0], -one[:, 1], one[:, 0]], axis=1) * share[:, None]


def _jacobians(target: Shape, image: Floats, continuous: Bools) -> Floats:
    """(V, 3, 3) the Jacobian of the map at each vertex: the area-weighted mean of the continuous faces around."""
    first, second = duals(target.verts[target.faces])
    steps = image[:, 1] - image[:, 0], image[:, 2] - image[:, 0]
    jacobian = np.einsum("fi,fj->fij", steps[0], first) + np.einsum("fi,fj->fij", steps[1], second)
    weight = np.where(continuous, target.face_areas, 0.0)
    corner, many = target.faces.ravel(), np.repeat(weight, 3)
    total = np.bincount(corner, many, target.V)
    out = np.empty((target.V, 9))
    for k in range(9):
        out[:, k] = np.bincount(corner, many * np.repeat(jacobian.reshape(-1, 9)[:, k], 3), target.V)
    return (out / np.where(total > 0, total, 1.0)[:, None]).reshape(-1, 3, 3)
