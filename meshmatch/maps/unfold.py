"""Maps without folds: what a map turns over or crushes is laid out anew, as its surroundings are.

Closest points fold where a fit and its shape are apart by more than the radius at which they bend. Around each triangle
whose image is turned over or crushed, images are found whose deformation gradients are nearest to those of the triangles
that are sound (a Poisson equation, as in Sumner and Popovic, *Deformation transfer for triangle meshes*, 2004), and put back
on the surface of the target. Ever wider surroundings move, until nothing is folded or the map tears; what does not become
better stays as it was.

Where the surface bends sharply, as in an armpit or between fingers, what is sound on one side says little about the other.
What is still folded is smoothed there: each image moves to the mean of its neighbours, weighted by mean value coordinates
of the source, which are positive, and back to the surface. Last, the surroundings and the part of the target that their
images lie on are both laid flat, in one plane, where means of neighbours hardly fold and no crease is in the way. The plane
holds the way back as well.
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
from meshmatch.geometry.disks import Disk, found_in, mean_values, patches
from meshmatch.geometry.triangles import (
    FacesAround,
    dot,
    edge_lengths,
    interpolate,
    squared_lengths,
    triangle_areas,
    triangle_vectors,
    unit,
)
from meshmatch.maps.folds import CRUSHED_RATIO, area_ratios, facing, known_normals, normals_at, consistent_faces
from meshmatch.maps.mapped_mesh import MappedMesh, invert_map, length_of
from meshmatch.maps.named_places import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.faces import seams
from meshmatch.shapes.normalise import in_single_precision
from meshmatch.shapes.shape import Shape

# All set by hand on bodies of SCAPE, FAUST and SHREC'19.
_RINGS = (2,)  # of triangles around a fold that move, round by round; more rounds gain little
_SMOOTHED, _SWEEPS = (3,), 2  # the same of smoothing, and steps of each round; ten gain little more
_FLAT, _LAST = (1, 2), (1, 2, 3)  # the same of what is laid flat, at last only around what is turned over
_CLOSED = 3  # rings around it, within which holes are closed
# How far around images the target is laid flat: two of its edges, and so many times the longest edge of an image.
_REACHES = 0.0, 0.5
_TURNED = 5.0  # a triangle that is turned over is so many times as bad as one that is crushed
_STRETCH, _SLACK = 3.0, 0.02  # an edge whose image is longer, in units of sqrt(area), is where the map tears
_THINNEST = 1e-3  # height over length: what is thinner has no area that its image could keep, and spoils the equations
_STIFFEST = 50.0  # a sliver's sides count no more
_MOST = 0.2  # a map that folds more of the surface is wrong as a whole
_LARGEST = 200_000  # vertices; triangles of larger meshes are smaller than the fits are exact
_NOTHING = 1e-6  # share of its area that an image without any may have
_HOLD = 1e-3  # how much each image stays, so that every part has a solution


def unfolded(found: VertexMap, source: Shape, target: Shape, workers: int = 1) -> VertexMap:
    """A map between these shapes with fewer folds: the same where it has none, and of clouds and very large meshes."""
    if source.is_cloud or target.is_cloud or max(source.V, target.V) > _LARGEST:
        return found
    own, theirs = _welded(source), _welded(target)
    start = _between_welded(found, own, theirs)
    images = _Images(start, own.shape, theirs.shape, workers)
    images.repeat(images.relaid, _RINGS)
    images.repeat(images.smoothed, _SMOOTHED)
    images.repeat(images.flattened, _FLAT)
    images.repeat(images.flattened, _LAST, 0.0)
    moved = (images.face != start.face) | (images.weights != start.barycentric).any(axis=1)
    if not moved.any():
        return found
    return _between_files(images.map, found, own, target, np.flatnonzero(moved[own.number]))


def unfolded_both_ways(
    found: VertexMap, opposite: VertexMap, source: Shape, target: Shape, workers: int = 1
) -> tuple[VertexMap, VertexMap]:
    """Such a map and its inverse, which has few folds as well: what is laid out anew in the one is so in the other.

    Which of the two shapes is the source makes no difference, nor do copies of vertices along the seams of a file, nor how
    it stands: the coarser mesh's map is unfolded first, for the inverse of that is finer. Confidence is kept from the map
    ``found`` and from its ``opposite``, which were made from fits.
    """
    own, theirs = _welded(source), _welded(target)
    if theirs.order < own.order:
        backward, forward = unfolded_both_ways(opposite, found, target, source, workers)
        return forward, backward
    there = _Images(_between_welded(found, own, theirs), own.shape, theirs.shape, workers)
    there.repeat(there.relaid, _RINGS)
    there.repeat(there.smoothed, _SMOOTHED)
    there.repeat(there.flattened, _FLAT)
    back = there.inverse()
    back.repeat(back.relaid, _RINGS)
    back.repeat(back.flattened, _FLAT)
    there = back.inverse()
    there.opposite, back.opposite = back, there
    for each in (there, back):
        each.repeat(each.flattened, _LAST, 0.0)
    return _between_files(there.map, found, own, target), _between_files(back.map, opposite, theirs, source)


@dataclass(frozen=True, eq=False)
class _Welded:
    """A mesh whose vertices along seams are one, in the order in which faces name them: the same whatever copies of
    vertices a file has. Parts that merely touch stay apart.

    Attributes
    ----------
    first : the file's first vertex at each place
    number : which place each vertex of the file is at
    """

    shape: Shape
    first: Int[Ints, " N"]
    number: Int[Ints, " V"]

    @property
    def order(self) -> tuple[int, int, float, str]:
        """By which the coarser of two meshes is known, whatever their size and however they stand; of meshes of the same
        triangles, as a shape and its mirror image, one or the other.
        """
        sides = edge_lengths(self.shape.verts, self.shape.edges.vertices)
        fineness = round(float(sides.mean()) / length_of(self.shape), 6)  # formats of single precision hold that much
        return self.shape.V, self.shape.F, fineness, self.shape.hash


@derived
def _welded(shape: Shape) -> _Welded:
    shape = in_single_precision(shape)
    twin = seams(shape.verts, shape.faces[shape.valid_faces])
    first, begins = np.unique(np.concatenate([twin[shape.faces].ravel(), twin]), return_index=True)
    first = first[np.argsort(begins)]
    number = np.empty(shape.V, np.int64)
    number[first] = np.arange(len(first))
    number = number[twin]
    invalid = None if shape.invalid is None else shape.invalid[first]
    return _Welded(Shape(shape.verts[first], number[shape.faces], shape.name, invalid=invalid), first, number)


def _between_welded(found: VertexMap, source: _Welded, target: _Welded) -> VertexMap:
    """A map between two files as one between their welded meshes, which have the same faces."""
    rows = source.first
    rest = {"face": found.face[rows], "barycentric": found.barycentric[rows], "confidence": found.confidence[rows]}
    return VertexMap.between(source.shape, target.shape, target.number[found.index[rows]], **rest)


def _between_files(
    welded: VertexMap, found: VertexMap, source: _Welded, target: Shape, rows: Ints | None = None
) -> VertexMap:
    """A map between two files with images, by default of all vertices, as one between their welded meshes has them."""
    rows = np.arange(len(source.number)) if rows is None else rows
    at, theirs = source.number[rows], _welded(target)
    index, face, weights = found.index.copy(), found.face.copy(), found.barycentric.copy()
    face[rows], weights[rows] = welded.face[at], welded.barycentric[at]
    corners = corners_of(target.faces, face[rows], theirs.first[welded.index[at]])
    index[rows] = _heaviest(corners, weights[rows])
    return replace(found, index=index, face=face, barycentric=weights)


class _Images:
    """The source's vertices on the target, both scaled to area 1: on which of its faces, or vertices, and where."""

    def __init__(self, found: VertexMap, source: Shape, target: Shape, workers: int) -> None:
        self._found, self.source, self._target_in_file, self.workers = found, source, target, workers
        self.index, self.face, self.weights = found.index.copy(), found.face.copy(), found.barycentric.copy()
        self.opposite: _Images | None = None  # of the way back, which follows what is laid flat
        faces = consistent_faces(source)[source.valid_faces]
        self.verts, self.points = source.verts / length_of(source), found.points(target) / length_of(target)
        sides = self.verts[faces] - self.verts[faces[:, [1, 2, 0]]]
        longest = squared_lengths(sides.reshape(-1, 3)).reshape(-1, 3).max(axis=1)
        kept = 2 * triangle_areas(self.verts, faces) > _THINNEST * longest
        self.faces, self.face_in_file = faces[kept], np.flatnonzero(source.valid_faces)[kept]
        self.normals = normals_at(found, target)
        self.side = 1.0 if facing(self.points, self.normals, self.verts, self.faces) >= 0 else -1.0
        self.normals *= self.side
        self.target = Shape(target.verts / length_of(target), target.faces, invalid=target.invalid)
        self.upwards = known_normals(target)
        self.areas = triangle_areas(self.verts, self.faces)
        self.ratio = _ratios(self.points, self.normals, self.verts, self.faces)
        self.torn = _torn(self.points, self.verts, self.faces)
        self.around, self.around_target = (
            FacesAround.of(each, V) for each, V in ((self.faces, source.V), (target.faces, target.V))
        )
        self.surface: MappedMesh | None = None

    @property
    def map(self) -> VertexMap:
        """As it is now."""
        return replace(self._found, index=self.index.copy(), face=self.face.copy(), barycentric=self.weights.copy())

    def inverse(self) -> _Images:
        """Of the inverse of the map as it is now."""
        source, target = self.source, self._target_in_file
        return _Images(invert_map(self.map, source, target, self.workers), target, source, self.workers)

    def repeat(self, move: Callable[[int, float], bool], rounds: tuple[int, ...], least: float = CRUSHED_RATIO) -> None:
        """Move what lies around folds, triangles whose area shrinks to less, round by round so many triangles wide."""
        for rings in rounds:
            if not move(rings, least):
                break

    def relaid(self, rings: int, least: float) -> bool:
        """Lay out the surroundings of all folds anew, so many triangles wide; False where there is nothing to do."""
        rows, near = self._around_folds(rings, least)
        laid = near[~self.torn[near] & np.isfinite(self.ratio[near])]
        if not len(rows) or not len(laid):
            return False
        self._take_better(rows, near, self._on_surface(rows, self._solved(rows, laid), self.normals[rows]))
        return True

    def smoothed(self, rings: int, least: float) -> bool:
        """Let them move to the mean of their neighbours instead."""
        rows, near = self._around_folds(rings, least)
        if not len(rows):
            return False
        weights = mean_values(self.verts, self.faces[near])[rows]
        means = diags_array(1 / weights.sum(axis=1)) @ weights
        points, normals = self.points.copy(), self.normals.copy()
        for _ in range(_SWEEPS):
            found = self._on_surface(rows, means @ points, unit(means @ normals))
            points[rows], normals[rows] = found.points, found.normals
        self._take_better(rows, near, found)
        return True

    def flattened(self, rings: int, least: float) -> bool:
        """Find images for what is still folded in a plane, in which both surfaces lie flat."""
        rows, near = self._around_folds(rings, least)
        if not len(rows):
            return False
        inside, zone = np.zeros((2, len(self.faces)), bool)
        inside[near] = True
        zone[self._dilated(self.faces[near].ravel(), _CLOSED)[self.faces].all(axis=1)] = True
        for patch in patches(self.faces, inside, zone | inside):
            disk = Disk.of(self.faces, patch)
            if disk is not None and (self.ratio[patch] <= least).any():
                any(self._laid_in_plane(disk, reach) for reach in _REACHES)
        return True

    def _laid_in_plane(self, disk: Disk, reach: float) -> bool:
        """Find images for the inside of a disk where the target lies flat so far around; True where less is folded then."""
        rim, rows = disk.vertices[disk.rim], np.delete(disk.vertices, disk.rim)
        beneath = self._beneath(disk, reach)
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
        face, weights, _ = found_in(plane, beneath.corners, np.delete(places, disk.rim, axis=0))
        corners = self.target.faces[beneath.faces[face]]
        found = self._placed(corners, beneath.faces[face], weights)
        near = self.around.at(rows)
        if self.opposite is None:
            return self._take_better(rows, near, found)
        before, folded = self._at(rows), self._folded(near)
        if not self._take_better(rows, near, found):
            return False
        face, weights, inside = found_in(places, disk.corners, plane)
        others = beneath.vertices[inside]
        changed = self.opposite.around.at(others)
        others_before, folded = self.opposite._at(others), folded + self.opposite._folded(changed)
        self.opposite._follow(others, changed, self, disk.faces[face[inside]], weights[inside])
        if self._folded(near) + self.opposite._folded(changed) < folded:
            return True
        self._take(rows, near, before)
        self.opposite._take(others, changed, others_before)
        return False

    def _folded(self, faces: Ints) -> float:
        """How much of the surface is folded, and how badly."""
        return float((self.areas[faces] * _badness(self.ratio[faces])).sum())

    def _follow(self, rows: Ints, near: Ints, back: _Images, faces: Ints, weights: Floats) -> None:
        """Put vertices where those faces of the other way lie that now cover them; ``near`` are the faces around."""
        corners, in_file = back.faces[faces], back.face_in_file[faces]
        order = (back.source.faces[in_file][:, :, None] == corners[:, None, :]).argmax(axis=2)
        own = back.source.faces[in_file]
        self._take(rows, near, self._placed(own, in_file, np.take_along_axis(weights, order, axis=1)))

    def _beneath(self, disk: Disk, reach: float) -> Disk | None:
        """The part of the target that the images of a disk lie on, and so far around, if it is a disk."""
        faces, images = self.target.faces, self.points[disk.vertices]
        sides = images[disk.corners] - images[disk.corners[:, [1, 2, 0]]]
        far = reach * np.sqrt(squared_lengths(sides.reshape(-1, 3)).max()) + 2 * self._edge
        away = dijkstra(self._along, indices=np.unique(self._corners(disk.vertices)), min_only=True, limit=2 * far)
        some = self.around_target.at(np.flatnonzero(np.isfinite(away)))
        away = away[faces[some]].max(axis=1)
        found = patches(faces[some], away <= far, away <= 2 * far)
        return Disk.of(faces, some[found[0]]) if len(found) == 1 else None

    def _corners(self, rows: Ints) -> Ints:
        """(N, 3) the target's vertices that images lie between; of an image on an edge those of the edge alone, whichever of
        its two faces it is told to be on.
        """
        weights = self.weights[rows]
        corners = corners_of(self.target.faces, self.face[rows], self.index[rows])
        return np.where(weights < _NOTHING, _heaviest(corners, weights)[:, None], corners)

    @property
    @derived
    def _along(self) -> csr_array:
        """(V_target, V_target) lengths of the target's edges."""
        edges, V = self.target.edges.vertices, self.target.V
        lengths = edge_lengths(self.target.verts, edges)
        return csr_array((np.tile(lengths, 2), np.concatenate([edges, edges[:, ::-1]]).T), shape=(V, V))

    @property
    @derived
    def _edge(self) -> float:
        return float(np.median(self._along.data))

    def _around_folds(self, rings: int, least: float) -> tuple[Ints, Ints]:
        """The vertices so many triangles around folds, none where the map is sound or wrong; and the faces that move."""
        folded = (self.ratio <= least) & ~self.torn
        if not 0 < self.areas[folded].sum() < _MOST * self.areas.sum():
            return np.empty(0, np.int64), np.empty(0, np.int64)
        inside = self._dilated(self.faces[folded].ravel(), rings)
        inside[self.faces[self.torn].ravel()] = False
        return np.flatnonzero(inside), np.flatnonzero(self._touches(inside))

    def _take_better(self, rows: Ints, near: Ints, found: _Places) -> bool:
        """Keep new images of these vertices where less of the faces around is folded; False if there are none."""
        vertices, corners = np.unique(self.faces[near], return_inverse=True)
        corners, moved = corners.reshape(-1, 3), np.searchsorted(vertices, rows)
        points, normals, verts = self.points[vertices], self.normals[vertices], self.verts[vertices]
        points[moved], normals[moved] = found.points, found.normals
        ratio = _ratios(points, normals, verts, corners)
        # each part that moved counts by itself
        number = np.full(len(vertices), -1)
        number[moved] = np.arange(len(rows))
        part = _parts(number[corners], len(rows))
        of_face = np.where(number[corners] >= 0, part[number[corners]], -1).max(axis=1)
        own = self.areas[near]
        before, after = (
            np.bincount(of_face, own * _badness(each), part.max() + 1) for each in (self.ratio[near], ratio)
        )
        # Where little is sound around, and much moves, a solution may lie anywhere; the rim, which is held, then tears.
        tears = np.bincount(of_face, _torn(points, verts, corners) & ~self.torn[near], part.max() + 1) > 0
        improved = (after < before) & ~tears
        better, changed = improved[part], improved[of_face]
        self._take(rows[better], near[changed], found.some(better), ratio[changed])
        return bool(improved.any())

    def _touches(self, marked: Bools) -> Bools:
        """(F,) which faces have a corner that is marked."""
        first, second, third = self.faces.T
        return np.asarray(marked[first] | marked[second] | marked[third])

    def _dilated(self, vertices: Ints, rings: int) -> Bools:
        """(V,) these vertices, and those so many triangles around."""
        marked = np.zeros(len(self.verts), bool)
        marked[vertices] = True
        for _ in range(rings):
            marked[self.faces[self._touches(marked)].ravel()] = True
        return marked

    def _gradients(self, some: Ints) -> Floats:
        """(N, 3, 3) how some triangles and their normals are deformed."""
        corners = self.faces[some]
        normal = unit(triangle_vectors(self.verts, corners))
        facing = unit(self.normals[corners].sum(axis=1))
        before, after = (
            np.stack([each[corners[:, 1]] - each[corners[:, 0]], each[corners[:, 2]] - each[corners[:, 0]], up], axis=2)
            for each, up in ((self.verts, normal), (self.points, facing))
        )
        return np.asarray(after @ np.linalg.inv(before))

    def _wanted(self, laid: Ints) -> Floats:
        """(N, 3, 3) the gradients that triangles should have: the mean of the sound ones beside them or, where there are
        none, of all sound ones around.
        """
        near = np.zeros(len(self.verts), bool)
        near[self.faces[laid].ravel()] = True
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
        mean = (to_vertices @ values)[local[self.faces[laid]]].sum(axis=1)
        mean[mean[:, 9] <= 0] = values.sum(axis=0)
        return np.asarray((mean[:, :9] / np.maximum(mean[:, 9:], 1e-300)).reshape(-1, 3, 3))

    def _solved(self, rows: Ints, laid: Ints) -> Floats:
        """(N, 3) images of vertices whose triangles' gradients are nearest to those wanted, the rest staying."""
        gradients, V = self._wanted(laid), len(self.verts)
        double = 2 * self.areas[laid]
        right, entries = np.zeros((V, 3)), []
        for k in range(3):
            i, j, opposite = (self.faces[laid, (k + each) % 3] for each in (1, 2, 0))
            a, b = self.verts[i] - self.verts[opposite], self.verts[j] - self.verts[opposite]
            cotangent = np.clip(dot(a, b) / np.maximum(double, 1e-300), -_STIFFEST, _STIFFEST)
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
        matrix = csr_array((value[free], (first[free], number[second[free]])), shape=(N, N)) + _HOLD * eye_array(N)
        held = csr_array((value[~free], (first[~free], second[~free])), shape=(N, V)) @ self.points
        return np.asarray(splu(matrix.tocsc()).solve(right[rows] - held + _HOLD * self.points[rows]))

    def _on_surface(self, rows: Ints, wanted: Floats, facing: Floats) -> _Places:
        """Where points of these rows lie on the target's surface, where it faces so, on the part that they were on."""
        if self.surface is None:
            self.surface = MappedMesh.of(self.target)
        foot = self.surface.query(wanted, self.side * facing, self.workers, parts=self.surface.part[self.index[rows]])
        points = foot.values(self.target.faces, self.target.verts)
        normals = self.side * unit(foot.values(self.target.faces, self.upwards))
        return _Places(foot.vertex, foot.face, foot.barycentric, points, normals)

    def _placed(self, corners: Ints, face: Ints, weights: Floats) -> _Places:
        """Places between corners (N, 3) of the target's faces."""
        points = interpolate(self.target.verts, corners, weights)
        normals = self.side * unit(interpolate(self.upwards, corners, weights))
        return _Places(_heaviest(corners, weights), face, weights, points, normals)

    def _at(self, rows: Ints) -> _Places:
        """Where these vertices are."""
        return _Places(self.index, self.face, self.weights, self.points, self.normals).some(rows)

    def _take(self, rows: Ints, near: Ints, places: _Places, ratio: Floats | None = None) -> None:
        """Move these vertices; the faces around have these ratios of areas then."""
        self.points[rows], self.normals[rows] = places.points, places.normals
        self.index[rows], self.face[rows], self.weights[rows] = places.index, places.face, places.weights
        if ratio is None:
            ratio = _ratios(self.points, self.normals, self.verts, self.faces[near])
        self.ratio[near] = ratio


@dataclass(frozen=True, eq=False)
class _Places:
    """Images of N vertices: on which faces of the target, at which of their vertices, -1 and one vertex alone, and where."""

    index: Int[Ints, " N"]
    face: Int[Ints, " N"]
    weights: Float[Floats, "N 3"]
    points: Float[Floats, "N 3"]
    normals: Float[Floats, "N 3"]

    def some(self, rows: Ints | Bools) -> _Places:
        """Of some of the vertices; a copy."""
        places = self.points[rows], self.normals[rows]
        return _Places(self.index[rows], self.face[rows], self.weights[rows], *places)


def _torn(points: Floats, verts: Floats, faces: Ints) -> Bools:
    """(F,) which faces images (V, 3) pull apart. Where the map does, their corners never move."""
    found = np.zeros(len(faces), bool)
    for start, end in zip(faces.T, faces[:, [1, 2, 0]].T, strict=True):
        own, image = (np.sqrt(squared_lengths(each[start] - each[end])) for each in (verts, points))
        found |= image > _STRETCH * own + _SLACK
    return found


def _ratios(points: Floats, normals: Floats, verts: Floats, faces: Ints) -> Floats:
    """(F,) `area_ratios`, nothing where there is next to nothing: rounding is not to decide what is turned over."""
    ratio = area_ratios(points, normals, verts, faces)
    ratio[np.abs(ratio) < _NOTHING] = 0.0
    return ratio


def _badness(ratio: Floats) -> Floats:
    """(N,) what is wrong with triangles of these ratios of areas."""
    return np.where(ratio <= 0, _TURNED, ratio < CRUSHED_RATIO)


def _heaviest(corners: Ints, weights: Floats) -> Ints:
    """(N,) the corners (N, 3) of most weight."""
    return np.take_along_axis(corners, weights.argmax(axis=1)[:, None], axis=1)[:, 0]


def _parts(corners: Ints, N: int) -> Ints:
    """(N,) which part each of N vertices is in; those of a triangle are in one, -1 for a corner that is none of them."""
    start, end = np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)]).T
    both = (start >= 0) & (end >= 0)
    graph = csr_array((np.ones(int(both.sum()), np.int8), (start[both], end[both])), shape=(N, N))
    return np.asarray(connected_components(graph, directed=False)[1])
