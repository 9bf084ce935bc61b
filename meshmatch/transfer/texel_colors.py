"""Places of the target's texels on the source, and the color of any point of the source: from its materials, images and
vertex colors.
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
from meshmatch.transfer.surface_walk import SurfaceWalker, duals, weighted_sum
from meshmatch.transfer.texels import MAX_ROWS, build_pyramids, count_rows, covered_texels, wrap_index

# The map is discontinuous on a triangle if an edge of its image is this many times longer than usual, plus some slack
# (sqrt(area)). Set by hand, as in `mapped_mesh`.
_STRETCH, _SLACK = 3.0, 0.02
# Edges do not bend by more than this share of their length: there a map is discontinuous, or the maps disagree.
_MAX_BEND = 0.25
_MAX_BEND_FACES = 200_000  # on larger meshes edges are short enough to be straight
# A place farther away than this, relative to the triangle's image, is searched again from the other corners. Set by hand.
_MAX_DISTANCE = 0.1
_HALF_TEXEL = 0.499  # offset to the texels that are interpolated; weights below 0.001 are ignored
_CHUNK = 2**18  # points at a time, along triangles that are as thin as lines


class MaterialSampler:
    """The colors of a shape at any point: materials, images as pyramids, and the density of their texels.

    The walker must be of the same file; lengths are in its unit. For a cloud, whose points act as faces, the look has a
    material for each point. `alpha` and `cutoff` are the alpha mode of `colors`; faces across whose edges the colors
    continue without a seam have the same number in `chart` (F,).
    """

    def __init__(self, look: Appearance, walker: SurfaceWalker) -> None:
        self.materials = look.materials
        self._material = look.material
        self._faces = walker.faces
        self._colors = None if look.colors is None else list(look.colors.T.astype(np.float32, order="C"))
        used = [self.materials[k] for k in np.unique(look.material).tolist()]
        self.alpha, self.cutoff, self._threshold = _common_alpha(used)
        uv = _wrap_coordinates(look.uv)
        clamped = np.array(["clamp" in m.wrap for m in self.materials])[look.material]
        uv[clamped] = look.uv[clamped]
        self._uv = [list(uv[:, :, k].T.astype(np.float32, order="C")) for k in range(2)]
        self.chart = find_charts(walker, look)
        self._density = _texel_density(walker, self.materials, look.material, look.uv)
        self._pyramids = build_pyramids(look, known_texels)

    def footprint(self, face: NDArray[np.integer], reach: Floats32) -> Floats32:
        """Texels of the image that a step of `reach` (N,) covers on faces (N,)."""
        return reach * self._density.take(face)

    def colors(self, face: NDArray[np.integer], weights: Floats32, footprint: Floats32) -> Floats32:
        """(4, N) linear colors and alpha on faces (N,) at weights (3, N), averaged over `footprint` (N,) texels."""
        if len(self.materials) == 1:
            return self._material_colors(0, face, weights, footprint)
        out = np.ones((4, len(face)), np.float32)
        material = self._material.take(face)
        order = np.argsort(material, kind="stable")
        used, begins = np.unique(material[order], return_index=True)
        for number, rows in zip(used.tolist(), np.split(order, begins[1:]), strict=True):
            out[:, rows] = self._material_colors(number, face[rows], weights[:, rows], footprint[rows])
        return out

    def _material_colors(
        self, number: int, face: NDArray[np.integer], weights: Floats32, footprint: Floats32
    ) -> Floats32:
        material = self.materials[number]
        out = np.ones((4, len(face)), np.float32)
        if number in self._pyramids:
            u, v = (weighted_sum(weights, [column.take(face) for column in columns]) for columns in self._uv)
            out = self._pyramids[number].sample(u, v, footprint)
        if material.factor != (1.0, 1.0, 1.0, 1.0):
            out *= np.array(material.factor, np.float32)[:, None]
        if self._colors is not None:
            corners = self._faces[face].T
            for k in range(4):
                out[k] *= weighted_sum(weights, [self._colors[k].take(corner) for corner in corners])
        if material.alpha == "opaque":
            out[3] = 1.0
        elif material.alpha == "mask" and self._threshold:
            out[3] = out[3] >= material.cutoff
        return out


def _wrap_coordinates(uv: Floats) -> Floats:
    """Coordinates (F, 3, 2) without whole repeats of an image, two at a time so that mirrored ones do not change."""
    return np.asarray(uv - 2.0 * np.floor(uv.min(axis=1, keepdims=True) / 2.0))


def _common_alpha(used: list[Material]) -> tuple[Alpha, float, bool]:
    """Common alpha mode and cutoff of all materials, and whether "mask" materials are thresholded when sampled."""
    modes = {material.alpha for material in used}
    cutoffs = {material.cutoff for material in used if material.alpha == "mask"}
    if "blend" in modes:
        return "blend", 0.5, True
    if "mask" in modes:
        return ("mask", cutoffs.pop(), False) if len(cutoffs) == 1 else ("mask", 0.5, True)
    return "opaque", 0.5, False


def known_texels(material: Material, uv: Floats) -> Bools | None:
    """(H, W) texels of an image that are on the surface, by the coordinates (F, 3, 2) of its faces; None where that would
    cost too much: the image is repeated, or covered many times.
    """
    assert material.image is not None
    height, width = material.image.shape[:2]
    if len(uv) == 0 or (uv.max(axis=1) - uv.min(axis=1)).max() >= 1.0:
        return None
    corners = (uv if "clamp" in material.wrap else _wrap_coordinates(uv)) * np.array([width, height])
    size = corners.max(axis=1) - corners.min(axis=1) + 1.0
    if np.prod(size, axis=1).sum() > 16.0 * width * height + 64.0 * len(uv) or count_rows(corners).sum() > MAX_ROWS:
        return None
    known, small = np.zeros((height, width), bool), np.ones(len(uv), bool)
    for face, column, row in covered_texels(corners):
        known[wrap_index(row, height, material.wrap[1]), wrap_index(column, width, material.wrap[0])] = True
        small[face] = False
    # Triangles without a texel center mark the texels they lie on, where nothing nearby is known.
    at = _texels_at(corners[small].mean(axis=1), material, known.shape)
    isolated = ~maximum_filter(known, 3)[at]
    thin = corners[small][isolated]
    sides = thin[:, [1, 2, 0]] - thin
    rows, longest = np.arange(len(thin)), np.square(sides).sum(axis=2).argmax(axis=1)
    start, side = thin[rows, longest], sides[rows, longest]
    ends = np.cumsum(np.ceil(2.0 * np.abs(side).max(axis=1)).astype(np.int64) + 1)  # points half a texel apart
    if len(ends) and ends[-1] > known.size + 64 * len(uv):
        return None
    for low in range(0, int(ends[-1]) if len(ends) else 0, _CHUNK):
        point = np.arange(low, min(low + _CHUNK, int(ends[-1])))
        row = np.searchsorted(ends, point, side="right")
        first, count = np.where(row > 0, ends[row - 1], 0), np.diff(ends, prepend=0)[row]
        share = (point - first) / np.maximum(count - 1, 1)
        points = start[row] + share[:, None] * side[row]
        for offset in itertools.product((-_HALF_TEXEL, _HALF_TEXEL), repeat=2):
            known[_texels_at(points + offset, material, known.shape)] = True
    return known


def _texels_at(points: Floats, material: Material, shape: tuple[int, ...]) -> tuple[Ints, Ints]:
    """Row and column of the texels that contain points (N, 2)."""
    column, row = np.floor(points).astype(np.int64).T
    return wrap_index(row, shape[0], material.wrap[1]), wrap_index(column, shape[1], material.wrap[0])


def _texel_density(walker: SurfaceWalker, materials: tuple[Material, ...], material: Ints, uv: Floats) -> Floats32:
    """(F,) texels per unit of length on each face; a face without an image counts as one texel.

    The geometric mean of both directions, or half of the densest direction if that is more.
    """
    sizes = np.array([(0, 0) if m.image is None else m.image.shape[1::-1] for m in materials], np.float64)
    corners = uv * sizes[material][:, None]
    first, second = duals(walker.verts[walker.faces])
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    u, v = (one[:, k : k + 1] * first + two[:, k : k + 1] * second for k in range(2))
    density = extent_of(u, v)
    plain = sizes[material][:, 0] == 0
    density[plain] = 1.0 / np.sqrt(2.0 * np.maximum(walker.areas[plain], 1e-12))
    return density.astype(np.float32)


def extent_of(first: Floats, second: Floats) -> Floats:
    """(N,) size of parallelograms with sides (N, 3) and (N, 3): the root of the area, or half the longest extent."""
    a, c = squared_lengths(first), squared_lengths(second)
    b = np.einsum("ni,ni->n", first, second)
    longest = np.sqrt((a + c) / 2 + np.sqrt(((a - c) / 2) ** 2 + b * b))
    area = np.sqrt(squared_lengths(cross_product(first, second)))
    return np.asarray(np.maximum(np.sqrt(area), longest / 2))


def find_seams(walker: SurfaceWalker, look: Appearance) -> Bools:
    """(F, 3) True for edges, by the opposite corner, across which material or texture coordinates are discontinuous."""
    found = np.ones(walker.opposite.shape, bool)
    for k in range(3):
        face = np.flatnonzero(walker.opposite[:, k] >= 0)
        other, edge = (each[face, k].astype(np.int64) for each in (walker.opposite, walker.opposite_edge))
        ends, other_ends = ((k + 1) % 3, (k + 2) % 3), ((edge + 1) % 3, (edge + 2) % 3)
        # the other face has the edge in opposite direction, unless it is flipped
        same_way = walker.welded[face, ends[0]] == walker.welded[other, other_ends[0]]
        agree = look.material[face] == look.material[other]
        for i in (0, 1):
            corner = np.where(same_way, other_ends[i], other_ends[1 - i])
            agree &= np.abs(look.uv[face, ends[i]] - look.uv[other, corner]).max(axis=1) < 1e-6
        found[face, k] = ~agree
    return found


def find_charts(walker: SurfaceWalker, look: Appearance) -> Ints32:
    """(F,) charts: faces connected over edges that are not seams; faces without an image are grouped by material."""
    F = len(walker.faces)
    face, edge = np.nonzero(~find_seams(walker, look))
    graph = coo_array((np.ones(len(face), np.int8), (face, walker.opposite[face, edge])), shape=(F, F))
    chart = np.asarray(connected_components(graph, directed=False)[1], np.int32)
    has_image = np.array([material.image is not None for material in look.materials])[look.material]
    return np.where(has_image, chart, F + look.material).astype(np.int32)


class TexelLocator:
    """Places on the source of the target's triangles and of any point of their texels.

    ``walker`` is on the source, ``back`` maps target to source, and ``corners`` (F, 3, 2) are the target's triangles in the
    atlas, counted in texels. With ``bends`` (`edge_bends`) the images of triangles are bent.

    `discontinuous` (F,) are triangles whose corners' images lie far apart. Each of their texels extrapolates the surface
    around its nearest corner, by the `jacobian` (V, 3, 3) there: the texture is cut in the middle, where interpolation would
    smear it. `reach` (F,) is the size of a texel on the source.
    """

    def __init__(
        self, walker: SurfaceWalker, target: Shape, back: VertexMap, corners: Floats, bends: Floats | None = None
    ) -> None:
        self.walker = walker
        self._confidence = back.assumed_confidence.astype(np.float32)
        self._image, start = image_points(walker, back)
        self.faces, self.verts = target.faces, target.verts
        self._corners = list(np.ascontiguousarray(target.faces.T))
        images = self._image[target.faces]
        first, second = images[:, 1] - images[:, 0], images[:, 2] - images[:, 0]
        flat = _inverse_maps(corners)
        right = flat[:, 0:1] * first + flat[:, 2:3] * second
        down = flat[:, 1:2] * first + flat[:, 3:4] * second
        self.reach = extent_of(right, down).astype(np.float32)
        length, own_length = (
            np.linalg.norm(each - np.roll(each, -1, axis=1), axis=2) for each in (images, target.verts[target.faces])
        )
        self._size = length.max(axis=1).astype(np.float32)
        scale = float(np.median(length.ravel() / np.maximum(own_length.ravel(), 1e-300)))
        self.discontinuous = (length > _STRETCH * scale * own_length + _SLACK).any(axis=1) | ~target.valid_faces
        if self.discontinuous.any():
            self.jacobian = _vertex_jacobians(target, images, ~self.discontinuous)
            bend = (scale * own_length.max(axis=1) / np.maximum(self._size, 1e-12)).astype(np.float32)
            self.reach[self.discontinuous] *= bend[self.discontinuous]
        self._steps = first, second
        self._start = list(start[target.faces].T.astype(np.int32, order="C"))
        bent = [] if bends is None else [bends.reshape(-1, 9)]
        table = np.concatenate([corners[:, 0], flat, images[:, 0], first, second, *bent], axis=1)
        self._table = list(table.T.astype(np.float32, order="C"))

    def push_directions(self, directions: Float[Floats, "F N M 3"]) -> Float[Floats, "F N M 3"]:
        """Push directions (tangent vectors of the target's triangles) forward to the source, by the map."""
        shares = (np.einsum("fnmi,fi->fnm", directions, dual) for dual in duals(self.verts[self.faces]))
        one, two = (share[..., None] * step[:, None, None] for share, step in zip(shares, self._steps, strict=True))
        return np.asarray(one + two)

    def locate(
        self, face: Ints32, x: Floats32, y: Floats32, start: Ints32 | None = None
    ) -> tuple[Floats32, Ints32, Floats32]:
        """Locate points x, y (N,) of the atlas that belong to triangles (N,) of the target.

        Returns weights (3, N) in the triangle, and face (N,) and weights (3, N) on the source. Points outside their triangle
        are extrapolated in its plane. ``start`` are faces (N,) to search from, -1 where unknown.
        """
        column = [values.take(face) for values in self._table]
        right, down = x - column[0], y - column[1]
        weights = np.empty((3, len(face)), np.float32)
        weights[1] = column[2] * right + column[3] * down
        weights[2] = column[4] * right + column[5] * down
        weights[0] = 1 - weights[1] - weights[2]
        outside = np.flatnonzero(np.minimum(np.minimum(weights[0], weights[1]), weights[2]) < -1)
        if len(outside):  # slivers, where one texel spans many triangles
            barycentric = np.clip(weights[:, outside], 0, 1)
            weights[:, outside] = barycentric / barycentric.sum(axis=0)
        points = np.empty((3, len(face)), np.float32)
        for k in range(3):
            points[k] = column[6 + k] + weights[1] * column[9 + k] + weights[2] * column[12 + k]
        if len(column) > 15:  # hat functions: 1 at an edge's middle, 0 at the other middles and corners, linear between
            one, two, three = np.maximum(weights, 0)
            for at, (left, right, far) in ((15, (two, three, one)), (18, (three, one, two)), (21, (one, two, three))):
                share = np.maximum(np.minimum(np.minimum(2 * left, 2 * right), 1 - 2 * far), 0)
                for k in range(3):
                    points[k] += share * column[at + k]
        corner = np.where(weights[2] > np.maximum(weights[0], weights[1]), 2, weights[1] > weights[0])
        cut = np.flatnonzero(self.discontinuous.take(face))
        if len(cut):
            points[:, cut] = self._extrapolate(face[cut], weights[:, cut], corner[cut])
        begin = self._start_faces(face, corner)
        begin = begin if start is None else np.where(start >= 0, start, begin)
        place, barycentric, distance = self.walker.closest(points, begin)
        far = np.flatnonzero(distance > _MAX_DISTANCE * self._size.take(face))
        for k in (1, 2) if len(far) else ():
            other = self._start_faces(face[far], (corner[far] + k) % 3)
            other_place, other_weights, gap = self.walker.closest(points[:, far], other)
            better = gap < distance[far]
            rows = far[better]
            place[rows], barycentric[:, rows], distance[rows] = (
                other_place[better],
                other_weights[:, better],
                gap[better],
            )
        return weights, place, barycentric

    def _start_faces(self, face: Ints32, corner: Ints) -> Ints32:
        """A face of the source at the images of these corners (N,)."""
        return np.choose(corner, [column.take(face) for column in self._start])

    def confidence(self, face: Ints32, weights: Floats32) -> Floats32:
        """(N,) confidence of the map at weights (3, N) in triangles (N,)."""
        clipped = np.maximum(weights, 0)
        weighted = weighted_sum(clipped, [self._confidence.take(column.take(face)) for column in self._corners])
        return np.asarray(weighted / (clipped[0] + clipped[1] + clipped[2]))

    def _extrapolate(self, face: Ints32, weights: Floats32, corner: Ints) -> Floats32:
        """Points (3, N) of discontinuous triangles: extrapolated from the surface around the nearest corner."""
        vertex = self.faces[face, corner]
        corners = self.verts[self.faces[face]]
        offset = np.einsum("kn,nkd->nd", weights, corners) - self.verts[vertex]
        points = self._image[vertex] + np.einsum("nij,nj->ni", self.jacobian[vertex], offset)
        return np.asarray(points.T, np.float32)


def edge_bends(source: Shape, target: Shape, forward: VertexMap, back: VertexMap) -> Float[Floats, "F 3 3"] | None:
    """Displacement of the image of each edge's middle (by the opposite corner) from the middle of its ends' images.

    In units of the source's sqrt(area), by the inverse of the map ``forward`` from source to target. A map is known at
    vertices, so the images of its triangles are flat. The map in the other direction is linear on the other mesh's triangles
    instead, and tells how they bend: with it a texture that is transferred there and back stays in place. None for clouds,
    large targets, and maps to vertices; an edge whose ends the two maps place differently does not bend.
    """
    if source.is_cloud or target.F > _MAX_BEND_FACES or forward.on_vertex.mean() > 0.5:
        return None
    ends = np.sort(target.faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)
    edges, of_face = np.unique(ends[..., 0] * target.V + ends[..., 1], return_inverse=True)
    ends = np.stack(np.divmod(edges, target.V), axis=1)
    mapped = SurfaceWalker(Shape(forward.points(target), source.faces, invalid=source.invalid))
    walker, verts = SurfaceWalker(source), (target.verts - mapped.center) / mapped.unit
    known, start = image_points(walker, back)
    queries = np.concatenate([verts, verts[ends].mean(axis=1)])
    start = np.concatenate([start, start[ends[:, 0]]])
    face, weights, _ = mapped.closest(queries.T.astype(np.float32, order="C"), start.astype(np.int32))
    corners, weights = mapped.faces[face], weights.T.astype(np.float64)
    image, error = interpolate(walker.verts, corners, weights), interpolate(mapped.verts, corners, weights) - queries
    bends, (one, two) = image[target.V :] - image[ends].mean(axis=1), ends.T
    disagreement = image[: target.V] - known
    for deviation, at in (
        (bends, known),
        (disagreement[one], known),
        (disagreement[two], known),
        (error[target.V :], verts),
    ):
        bends[squared_lengths(deviation) > _MAX_BEND**2 * squared_lengths(at[two] - at[one])] = 0.0
    return np.asarray(bends[of_face.reshape(-1, 3)])


def image_points(walker: SurfaceWalker, back: VertexMap) -> tuple[Floats, Ints]:
    """(V_target, 3) images of the target's vertices on the source, and (V_target,) a face of the source at each."""
    image = walker.verts[back.index]
    inside = np.flatnonzero(back.face >= 0)
    image[inside] = interpolate(walker.verts, walker.faces[back.face[inside]], back.barycentric[inside])
    return image, np.where(back.face >= 0, back.face, walker.face_of_vertex[back.index])


def _inverse_maps(corners: Floats) -> Floats:
    """(F, 4) linear maps (2 x 2) from an offset from the first corner, in texels, to the second and third weights."""
    one, two = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    determinant = one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]
    share = np.where(determinant == 0, 0.0, 1.0 / np.where(determinant == 0, 1.0, determinant))
    return np.stack([two[:, 1], -two[:, 0], -one[:, 1], one[:, 0]], axis=1) * share[:, None]


def _vertex_jacobians(target: Shape, image: Floats, continuous: Bools) -> Floats:
    """(V, 3, 3) Jacobian of the map at each vertex: the area-weighted mean over adjacent continuous faces."""
    first, second = duals(target.verts[target.faces])
    steps = image[:, 1] - image[:, 0], image[:, 2] - image[:, 0]
    jacobian = np.einsum("fi,fj->fij", steps[0], first) + np.einsum("fi,fj->fij", steps[1], second)
    weight = np.where(continuous, target.face_areas, 0.0)
    corner, weights = target.faces.ravel(), np.repeat(weight, 3)
    total = np.bincount(corner, weights, target.V)
    out = np.empty((target.V, 9))
    for k in range(9):
        out[:, k] = np.bincount(corner, weights * np.repeat(jacobian.reshape(-1, 9)[:, k], 3), target.V)
    return (out / np.where(total > 0, total, 1.0)[:, None]).reshape(-1, 3, 3)
