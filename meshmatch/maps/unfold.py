"""Remove folds from maps: images of triangles that are flipped or crushed are recomputed from their surroundings.

Closest points fold where the distance between a fit and its shape exceeds their radius of curvature. Three methods move the
neighbourhoods of folds in turn; only improvements are kept. *Reconstruction* finds images whose deformation gradients are
nearest to those of the unfolded triangles around (a Poisson equation, as in Sumner and Popovic, *Deformation transfer for
triangle meshes*, 2004), and projects them onto the target. *Smoothing* is for sharp bends, as in an armpit or between
fingers, where gradients on one side say little about the other: images move to the mean of their neighbours, weighted by
mean value coordinates of the source, which are positive, and back to the surface. *Flattening* maps the neighbourhood and
the part of the target under its images into one plane, where means of neighbours hardly fold and no crease is in the way;
the same plane gives the images of the opposite map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.sparse.linalg import splu

from meshmatch.arrays import Bools, Float, Floats, Int, Ints
from meshmatch.derived import derived
from meshmatch.geometry.disks import Disk, edge_connected_patches, locate_points, mean_values
from meshmatch.geometry.triangles import (
    FacesAround,
    dot,
    edge_lengths,
    interpolate,
    normalized,
    squared_lengths,
    triangle_areas,
    triangle_vectors,
)
from meshmatch.maps.folds import (
    CRUSHED_RATIO,
    area_ratios,
    consistent_faces,
    normals_at,
    normals_or_zeros,
    orientation_agreement,
)
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import MappedMesh, invert_map, length_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.alignment import in_single_precision
from meshmatch.shapes.faces import seam_representatives
from meshmatch.shapes.shape import Shape

# All set by hand on bodies of SCAPE, FAUST and SHREC'19.
_POISSON_RINGS = (2,)  # width, in triangles, of the neighbourhood that moves, for each round; more rounds gain little
_SMOOTHING_RINGS, _SMOOTHING_STEPS = (3,), 2  # the same for smoothing, and steps per round; ten gain little more
_FLATTENING_RINGS, _FINAL_RINGS = (1, 2), (1, 2, 3)  # the same for flattening, and for its final pass on flipped faces
_CLOSING_RINGS = 3  # holes of a neighbourhood are closed within this many rings around it
# Margin around images within which the target is flattened: two of its edges, plus the longest edge of an image times this.
_MARGINS = 0.0, 0.5
_FLIPPED_COST = 5.0  # a flipped triangle counts as much as this many crushed ones
_MAX_STRETCH, _STRETCH_OFFSET = 3.0, 0.02  # the map tears at edges with longer images; offset in units of sqrt(area)
_MIN_ASPECT = 1e-3  # height over length; thinner triangles have no area to preserve and spoil the equations
_MAX_COTANGENT = 50.0  # bound on the weights of slivers
_MAX_FOLDED = 0.2  # a map that folds more of the surface is wrong as a whole
_MAX_VERTICES = 200_000  # triangles of larger meshes are smaller than the errors of fits
_EPSILON = 1e-6  # area ratios and barycentric weights below this are 0
_REGULARIZATION = 1e-3  # pull of each image to where it was, so that every component has a solution


def unfold(found: VertexMap, source: Shape, target: Shape, workers: int = 1) -> VertexMap:
    """Reduce the folds of a map; a map without folds, or of clouds or very large meshes, is returned unchanged."""
    if source.is_cloud or target.is_cloud or max(source.V, target.V) > _MAX_VERTICES:
        return found
    own, theirs = _welded(source), _welded(target)
    start = _between_welded(found, own, theirs)
    images = _Images(start, own.shape, theirs.shape, workers)
    images.repeat(images.reconstruct, _POISSON_RINGS)
    images.repeat(images.smooth, _SMOOTHING_RINGS)
    images.repeat(images.flatten, _FLATTENING_RINGS)
    images.repeat(images.flatten, _FINAL_RINGS, 0.0)
    moved = (images.face != start.face) | (images.weights != start.barycentric).any(axis=1)
    if not moved.any():
        return found
    return _between_files(images.map, found, own, target, np.flatnonzero(moved[own.number]))


def unfold_both_ways(
    found: VertexMap, opposite: VertexMap, source: Shape, target: Shape, workers: int = 1
) -> tuple[VertexMap, VertexMap]:
    """Reduce the folds of a map, and return it with its inverse, which has few folds as well.

    Changes to one map update the other. The result does not depend on which of the two shapes is the source, on copies of
    vertices along seams, or on the orientation of a file: the map of the coarser mesh is unfolded first, because its
    inverse is finer. Confidence is kept from the map ``found`` and from its ``opposite``, which were made from fits.
    """
    own, theirs = _welded(source), _welded(target)
    if theirs.order < own.order:
        backward, forward = unfold_both_ways(opposite, found, target, source, workers)
        return forward, backward
    images = _Images(_between_welded(found, own, theirs), own.shape, theirs.shape, workers)
    images.repeat(images.reconstruct, _POISSON_RINGS)
    images.repeat(images.smooth, _SMOOTHING_RINGS)
    images.repeat(images.flatten, _FLATTENING_RINGS)
    images_back = images.inverse()
    images_back.repeat(images_back.reconstruct, _POISSON_RINGS)
    images_back.repeat(images_back.flatten, _FLATTENING_RINGS)
    images = images_back.inverse()
    images.opposite, images_back.opposite = images_back, images
    for each in (images, images_back):
        each.repeat(each.flatten, _FINAL_RINGS, 0.0)
    return _between_files(images.map, found, own, target), _between_files(images_back.map, opposite, theirs, source)


@dataclass(frozen=True, eq=False)
class _Welded:
    """A mesh with vertices merged along seams, in the order in which faces use them, so that copies of vertices in a file
    make no difference. Parts that merely touch are not merged.

    Attributes
    ----------
    first : the file's first vertex of each merged vertex
    number : the merged vertex of each vertex of the file
    """

    shape: Shape
    first: Int[Ints, " N"]
    number: Int[Ints, " V"]

    @property
    def order(self) -> tuple[int, int, float, str]:
        """Sort key that puts the coarser of two meshes first, independent of scale and orientation; the hash decides between
        meshes with congruent triangles, such as a shape and its mirror image.
        """
        sides = edge_lengths(self.shape.verts, self.shape.edges.vertices)
        fineness = round(float(sides.mean()) / length_of(self.shape), 6)  # digits that survive single precision
        return self.shape.V, self.shape.F, fineness, self.shape.hash


@derived
def _welded(shape: Shape) -> _Welded:
    shape = in_single_precision(shape)
    twin = seam_representatives(shape.verts, shape.faces[shape.valid_faces])
    first, begins = np.unique(np.concatenate([twin[shape.faces].ravel(), twin]), return_index=True)
    first = first[np.argsort(begins)]
    number = np.empty(shape.V, np.int64)
    number[first] = np.arange(len(first))
    number = number[twin]
    invalid = None if shape.invalid is None else shape.invalid[first]
    return _Welded(Shape(shape.verts[first], number[shape.faces], shape.name, invalid=invalid), first, number)


def _between_welded(found: VertexMap, source: _Welded, target: _Welded) -> VertexMap:
    """Convert a map between two files to one between their welded meshes, which have the same faces."""
    rows = source.first
    rest = {"face": found.face[rows], "barycentric": found.barycentric[rows], "confidence": found.confidence[rows]}
    return VertexMap.between(source.shape, target.shape, target.number[found.index[rows]], **rest)


def _between_files(
    welded: VertexMap, found: VertexMap, source: _Welded, target: Shape, rows: Ints | None = None
) -> VertexMap:
    """Insert the images of a map between welded meshes into a map between the files; ``rows`` are vertices, default all."""
    rows = np.arange(len(source.number)) if rows is None else rows
    at, theirs = source.number[rows], _welded(target)
    index, face, weights = found.index.copy(), found.face.copy(), found.barycentric.copy()
    face[rows], weights[rows] = welded.face[at], welded.barycentric[at]
    corners = corners_of(target.faces, face[rows], theirs.first[welded.index[at]])
    index[rows] = _heaviest(corners, weights[rows])
    return replace(found, index=index, face=face, barycentric=weights)


class _Images:
    """The images of the source's vertices on the target, both scaled to area 1, and the operations that move them."""

    def __init__(self, found: VertexMap, source: Shape, target: Shape, workers: int) -> None:
        self._found, self.source, self._target_in_file, self.workers = found, source, target, workers
        self.index, self.face, self.weights = found.index.copy(), found.face.copy(), found.barycentric.copy()
        self.opposite: _Images | None = None  # those of the opposite map, which flattening updates as well
        faces = consistent_faces(source)[source.valid_faces]
        self.verts, self.points = source.verts / length_of(source), found.points(target) / length_of(target)
        sides = self.verts[faces] - self.verts[faces[:, [1, 2, 0]]]
        longest = squared_lengths(sides.reshape(-1, 3)).reshape(-1, 3).max(axis=1)
        kept = 2 * triangle_areas(self.verts, faces) > _MIN_ASPECT * longest
        self.faces, self.face_in_file = faces[kept], np.flatnonzero(source.valid_faces)[kept]
        self.normals = normals_at(found, target)
        self.side = 1.0 if orientation_agreement(self.points, self.normals, self.verts, self.faces) >= 0 else -1.0
        self.normals *= self.side
        self.target = Shape(target.verts / length_of(target), target.faces, invalid=target.invalid)
        self.upwards = normals_or_zeros(target)
        self.areas = triangle_areas(self.verts, self.faces)
        self.ratio = _ratios(self.points, self.normals, self.verts, self.faces)
        self.torn = _torn_faces(self.points, self.verts, self.faces)
        self.around, self.around_target = (
            FacesAround.of(each, V) for each, V in ((self.faces, source.V), (target.faces, target.V))
        )
        self.surface: MappedMesh | None = None

    @property
    def map(self) -> VertexMap:
        """The current map."""
        return replace(self._found, index=self.index.copy(), face=self.face.copy(), barycentric=self.weights.copy())

    def inverse(self) -> _Images:
        """Images of the inverse of the current map."""
        source, target = self.source, self._target_in_file
        return _Images(invert_map(self.map, source, target, self.workers), target, source, self.workers)

    def repeat(self, move: Callable[[int, float], bool], rounds: tuple[int, ...], least: float = CRUSHED_RATIO) -> None:
        """Apply ``move`` around folds (faces of area ratio up to ``least``), once for each width, until there are none."""
        for rings in rounds:
            if not move(rings, least):
                break

    def reconstruct(self, rings: int, least: float) -> bool:
        """Recompute images around all folds from deformation gradients; False if there is nothing to do."""
        rows, near = self._around_folds(rings, least)
        triangles = near[~self.torn[near] & np.isfinite(self.ratio[near])]
        if not len(rows) or not len(triangles):
            return False
        self._improve(rows, near, self._on_surface(rows, self._solve_poisson(rows, triangles), self.normals[rows]))
        return True

    def smooth(self, rings: int, least: float) -> bool:
        """Move images around all folds to means of their neighbours; False if there is nothing to do."""
        rows, near = self._around_folds(rings, least)
        if not len(rows):
            return False
        weights = mean_values(self.verts, self.faces[near])[rows]
        means = diags_array(1 / weights.sum(axis=1)) @ weights
        points, normals = self.points.copy(), self.normals.copy()
        for _ in range(_SMOOTHING_STEPS):
            found = self._on_surface(rows, means @ points, normalized(means @ normals))
            points[rows], normals[rows] = found.points, found.normals
        self._improve(rows, near, found)
        return True

    def flatten(self, rings: int, least: float) -> bool:
        """Recompute images around all folds in a plane, with both surfaces flattened; False if there are no folds."""
        rows, near = self._around_folds(rings, least)
        if not len(rows):
            return False
        inside, zone = np.zeros((2, len(self.faces)), bool)
        inside[near] = True
        zone[self._dilated(self.faces[near].ravel(), _CLOSING_RINGS)[self.faces].all(axis=1)] = True
        for patch in edge_connected_patches(self.faces, inside, zone | inside):
            disk = Disk.of(self.faces, patch)
            if disk is not None and (self.ratio[patch] <= least).any():
                any(self._flatten_patch(disk, reach) for reach in _MARGINS)
        return True

    def _flatten_patch(self, disk: Disk, reach: float) -> bool:
        """Recompute the images of a disk's interior in the plane; True if the folds decrease. ``reach``: see `_MARGINS`."""
        rim, rows = disk.vertices[disk.rim], np.delete(disk.vertices, disk.rim)
        beneath = self._target_patch(disk, reach)
        if not len(rows) or beneath is None:
            return False
        between = self._corners(rim)
        corners = np.minimum(np.searchsorted(beneath.vertices, between), len(beneath.vertices) - 1)
        if (beneath.vertices[corners] != between).any():
            return False
        plane = beneath.laid_flat(self.target.verts)
        if plane is None:
            return False
        places = disk.laid_flat(self.verts, interpolate(plane, corners, self.weights[rim]), self.side)
        if places is None:
            return False
        face, weights, _ = locate_points(plane, beneath.corners, np.delete(places, disk.rim, axis=0))
        corners = self.target.faces[beneath.faces[face]]
        found = self._interpolated(corners, beneath.faces[face], weights)
        near = self.around.at(rows)
        if self.opposite is None:
            return self._improve(rows, near, found)
        before, folded = self._get(rows), self._fold_cost(near)
        if not self._improve(rows, near, found):
            return False
        face, weights, inside = locate_points(places, disk.corners, plane)
        others = beneath.vertices[inside]
        changed = self.opposite.around.at(others)
        others_before, folded = self.opposite._get(others), folded + self.opposite._fold_cost(changed)
        self.opposite._update_from(others, changed, self, disk.faces[face[inside]], weights[inside])
        if self._fold_cost(near) + self.opposite._fold_cost(changed) < folded:
            return True
        self._set(rows, near, before)
        self.opposite._set(others, changed, others_before)
        return False

    def _fold_cost(self, faces: Ints) -> float:
        """Total cost of the folds of some faces: areas times `_fold_costs`."""
        return float((self.areas[faces] * _fold_costs(self.ratio[faces])).sum())

    def _update_from(self, rows: Ints, near: Ints, back: _Images, faces: Ints, weights: Floats) -> None:
        """Move vertices to ``weights`` in ``faces`` of the opposite map's source; ``near`` are the faces around them."""
        corners, in_file = back.faces[faces], back.face_in_file[faces]
        order = (back.source.faces[in_file][:, :, None] == corners[:, None, :]).argmax(axis=2)
        own = back.source.faces[in_file]
        self._set(rows, near, self._interpolated(own, in_file, np.take_along_axis(weights, order, axis=1)))

    def _target_patch(self, disk: Disk, reach: float) -> Disk | None:
        """The part of the target under the images of a disk, with a margin, if it is a disk itself; otherwise None."""
        faces, images = self.target.faces, self.points[disk.vertices]
        sides = images[disk.corners] - images[disk.corners[:, [1, 2, 0]]]
        far = reach * np.sqrt(squared_lengths(sides.reshape(-1, 3)).max()) + 2 * self._median_edge
        away = dijkstra(self._edge_graph, indices=np.unique(self._corners(disk.vertices)), min_only=True, limit=2 * far)
        subset = self.around_target.at(np.flatnonzero(np.isfinite(away)))
        away = away[faces[subset]].max(axis=1)
        found = edge_connected_patches(faces[subset], away <= far, away <= 2 * far)
        return Disk.of(faces, subset[found[0]]) if len(found) == 1 else None

    def _corners(self, rows: Ints) -> Ints:
        """(N, 3) the target's vertices between which images lie; the heaviest one replaces corners of weight 0, so that an
        image on an edge does not depend on which of the edge's two faces it is assigned to.
        """
        weights = self.weights[rows]
        corners = corners_of(self.target.faces, self.face[rows], self.index[rows])
        return np.where(weights < _EPSILON, _heaviest(corners, weights)[:, None], corners)

    @property
    @derived
    def _edge_graph(self) -> csr_array:
        """(V_target, V_target) graph of the target's edges, weighted by length."""
        edges, V = self.target.edges.vertices, self.target.V
        lengths = edge_lengths(self.target.verts, edges)
        return csr_array((np.tile(lengths, 2), np.concatenate([edges, edges[:, ::-1]]).T), shape=(V, V))

    @property
    @derived
    def _median_edge(self) -> float:
        return float(np.median(self._edge_graph.data))

    def _around_folds(self, rings: int, least: float) -> tuple[Ints, Ints]:
        """The vertices within ``rings`` triangles of folds, and the faces at them; none if the map is sound, or wrong."""
        folded = (self.ratio <= least) & ~self.torn
        if not 0 < self.areas[folded].sum() < _MAX_FOLDED * self.areas.sum():
            return np.empty(0, np.int64), np.empty(0, np.int64)
        inside = self._dilated(self.faces[folded].ravel(), rings)
        inside[self.faces[self.torn].ravel()] = False
        return np.flatnonzero(inside), np.flatnonzero(self._touches(inside))

    def _improve(self, rows: Ints, near: Ints, found: _Positions) -> bool:
        """Accept new images of these vertices in each connected component whose fold cost decreases; False if in none."""
        vertices, corners = np.unique(self.faces[near], return_inverse=True)
        corners, moved = corners.reshape(-1, 3), np.searchsorted(vertices, rows)
        points, normals, verts = self.points[vertices], self.normals[vertices], self.verts[vertices]
        points[moved], normals[moved] = found.points, found.normals
        ratio = _ratios(points, normals, verts, corners)
        # each connected component of moved vertices is judged by itself
        number = np.full(len(vertices), -1)
        number[moved] = np.arange(len(rows))
        part = _components(number[corners], len(rows))
        of_face = np.where(number[corners] >= 0, part[number[corners]], -1).max(axis=1)
        own = self.areas[near]
        before, after = (
            np.bincount(of_face, own * _fold_costs(each), part.max() + 1) for each in (self.ratio[near], ratio)
        )
        # With few unfolded faces around, a solution may lie anywhere; the map then tears at the fixed rim.
        tears = np.bincount(of_face, _torn_faces(points, verts, corners) & ~self.torn[near], part.max() + 1) > 0
        improved = (after < before) & ~tears
        better, changed = improved[part], improved[of_face]
        self._set(rows[better], near[changed], found.subset(better), ratio[changed])
        return bool(improved.any())

    def _touches(self, marked: Bools) -> Bools:
        """(F,) which faces have a marked corner."""
        first, second, third = self.faces.T
        return np.asarray(marked[first] | marked[second] | marked[third])

    def _dilated(self, vertices: Ints, rings: int) -> Bools:
        """(V,) mask of these vertices, dilated by ``rings`` triangles."""
        marked = np.zeros(len(self.verts), bool)
        marked[vertices] = True
        for _ in range(rings):
            marked[self.faces[self._touches(marked)].ravel()] = True
        return marked

    def _gradients(self, subset: Ints) -> Floats:
        """(N, 3, 3) deformation gradients of triangles and their normals."""
        corners = self.faces[subset]
        normal = normalized(triangle_vectors(self.verts, corners))
        facing = normalized(self.normals[corners].sum(axis=1))
        before, after = (
            np.stack([each[corners[:, 1]] - each[corners[:, 0]], each[corners[:, 2]] - each[corners[:, 0]], up], axis=2)
            for each, up in ((self.verts, normal), (self.points, facing))
        )
        return np.asarray(after @ np.linalg.inv(before))

    def _wanted_gradients(self, triangles: Ints) -> Floats:
        """(N, 3, 3) mean gradients of adjacent unfolded triangles or, where there are none, of all unfolded ones around."""
        near = np.zeros(len(self.verts), bool)
        near[self.faces[triangles].ravel()] = True
        around = np.flatnonzero(self._touches(near))
        sound = around[~self.torn[around] & (self.ratio[around] >= CRUSHED_RATIO)]
        area = self.areas[sound]
        vertices = np.unique(self.faces[around])
        local = np.full(len(self.verts), -1)
        local[vertices] = np.arange(len(vertices))
        values = np.column_stack([self._gradients(sound).reshape(-1, 9) * area[:, None], area])
        places = local[self.faces[sound]].ravel()
        to_vertices = csr_array(
            (np.ones(len(places)), (places, np.repeat(np.arange(len(sound)), 3))), shape=(len(vertices), len(sound))
        )
        mean = (to_vertices @ values)[local[self.faces[triangles]]].sum(axis=1)
        mean[mean[:, 9] <= 0] = values.sum(axis=0)
        return np.asarray((mean[:, :9] / np.maximum(mean[:, 9:], 1e-300)).reshape(-1, 3, 3))

    def _solve_poisson(self, rows: Ints, triangles: Ints) -> Floats:
        """(N, 3) images for which the gradients of triangles are nearest to the wanted ones; other vertices are fixed."""
        gradients, V = self._wanted_gradients(triangles), len(self.verts)
        double = 2 * self.areas[triangles]
        right, entries = np.zeros((V, 3)), []
        for k in range(3):
            i, j, opposite = (self.faces[triangles, (k + each) % 3] for each in (1, 2, 0))
            a, b = self.verts[i] - self.verts[opposite], self.verts[j] - self.verts[opposite]
            cotangent = np.clip(dot(a, b) / np.maximum(double, 1e-300), -_MAX_COTANGENT, _MAX_COTANGENT)
            pull = cotangent[:, None] * np.einsum("nij,nj->ni", gradients, self.verts[i] - self.verts[j])
            for axis in range(3):
                right[:, axis] += np.bincount(i, pull[:, axis], V) - np.bincount(j, pull[:, axis], V)
            entries += [(i, i, cotangent), (j, j, cotangent), (i, j, -cotangent), (j, i, -cotangent)]
        first, second, value = (np.concatenate(each) for each in zip(*entries, strict=True))
        number = np.full(V, -1)
        number[rows] = np.arange(len(rows))
        own = number[first] >= 0
        first, second, value = number[first[own]], second[own], value[own]
        free = number[second] >= 0
        N = len(rows)
        matrix = csr_array(
            (value[free], (first[free], number[second[free]])), shape=(N, N)
        ) + _REGULARIZATION * eye_array(N)
        held = csr_array((value[~free], (first[~free], second[~free])), shape=(N, V)) @ self.points
        return np.asarray(splu(matrix.tocsc()).solve(right[rows] - held + _REGULARIZATION * self.points[rows]))

    def _on_surface(self, rows: Ints, wanted: Floats, facing: Floats) -> _Positions:
        """Project points onto the target, preferring normals ``facing`` and the connected parts of the current images."""
        if self.surface is None:
            self.surface = MappedMesh.of(self.target)
        foot = self.surface.query(wanted, self.side * facing, self.workers, parts=self.surface.part[self.index[rows]])
        points = foot.values(self.target.faces, self.target.verts)
        normals = self.side * normalized(foot.values(self.target.faces, self.upwards))
        return _Positions(foot.vertex, foot.face, foot.barycentric, points, normals)

    def _interpolated(self, corners: Ints, face: Ints, weights: Floats) -> _Positions:
        """Positions from barycentric weights and corners (N, 3) of the target's faces."""
        points = interpolate(self.target.verts, corners, weights)
        normals = self.side * normalized(interpolate(self.upwards, corners, weights))
        return _Positions(_heaviest(corners, weights), face, weights, points, normals)

    def _get(self, rows: Ints) -> _Positions:
        """Current positions of these vertices; a copy."""
        return _Positions(self.index, self.face, self.weights, self.points, self.normals).subset(rows)

    def _set(self, rows: Ints, near: Ints, places: _Positions, ratio: Floats | None = None) -> None:
        """Move these vertices and update the area ratios of the faces ``near`` them; computed unless given."""
        self.points[rows], self.normals[rows] = places.points, places.normals
        self.index[rows], self.face[rows], self.weights[rows] = places.index, places.face, places.weights
        if ratio is None:
            ratio = _ratios(self.points, self.normals, self.verts, self.faces[near])
        self.ratio[near] = ratio


@dataclass(frozen=True, eq=False)
class _Positions:
    """Images of N vertices: nearest vertex, face (-1 if a vertex) and weights on the target; points and normals."""

    index: Int[Ints, " N"]
    face: Int[Ints, " N"]
    weights: Float[Floats, "N 3"]
    points: Float[Floats, "N 3"]
    normals: Float[Floats, "N 3"]

    def subset(self, rows: Ints | Bools) -> _Positions:
        """Select some of the images; a copy."""
        places = self.points[rows], self.normals[rows]
        return _Positions(self.index[rows], self.face[rows], self.weights[rows], *places)


def _torn_faces(points: Floats, verts: Floats, faces: Ints) -> Bools:
    """(F,) faces that images (V, 3) tear apart, whose corners never move."""
    found = np.zeros(len(faces), bool)
    for start, end in zip(faces.T, faces[:, [1, 2, 0]].T, strict=True):
        own, image = (np.sqrt(squared_lengths(each[start] - each[end])) for each in (verts, points))
        found |= image > _MAX_STRETCH * own + _STRETCH_OFFSET
    return found


def _ratios(points: Floats, normals: Floats, verts: Floats, faces: Ints) -> Floats:
    """(F,) `area_ratios`, with values near 0 set to 0 so that rounding does not decide which triangles are flipped."""
    ratio = area_ratios(points, normals, verts, faces)
    ratio[np.abs(ratio) < _EPSILON] = 0.0
    return ratio


def _fold_costs(ratio: Floats) -> Floats:
    """(N,) cost of triangles with these area ratios: 0 unless they are flipped or crushed."""
    return np.where(ratio <= 0, _FLIPPED_COST, ratio < CRUSHED_RATIO)


def _heaviest(corners: Ints, weights: Floats) -> Ints:
    """(N,) the corner (N, 3) with the largest weight."""
    return np.take_along_axis(corners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]


def _components(corners: Ints, N: int) -> Ints:
    """(N,) label the connected components of N vertices, connected by triangles; a corner of -1 is not one of them."""
    start, end = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]).T
    both = (start >= 0) & (end >= 0)
    graph = csr_array((np.ones(int(both.sum()), np.int8), (start[both], end[both])), shape=(N, N))
    return np.asarray(connected_components(graph, directed=False)[1])
