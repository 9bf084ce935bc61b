"""Where the vertices of a shape belong on the template: what one fit knows, and all that maps need of it.

A vertex belongs to its footpoint on the fitted template, and as high above the resting one as it lies above the fitted
one: what a fit smooths away tells points apart, and the two sides of a thin wall.

Of a noisy cloud no place is known for a point, but how likely each is. Noise moves points across the surface and along it
alike. Taking the closest point of the template undoes the first and keeps the second. Here a point belongs to all of the
template within reach, with Gaussian weights; its place is the expectation, and its spread says how well it is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix, identity, vstack

from meshmatch.arrays import Bool, Bools, Brief, Float, Floats, Floats32, Int, Ints, Ints32
from meshmatch.errors import InputError
from meshmatch.fitting.fit import Fit, check_fit
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import blend, share_areas, triangle_areas, vertex_areas, vertex_normals
from meshmatch.maps.footpoints import Footpoints, Surface, closest_footpoints, in_core_frame, template_footpoints
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

_HIGH = 0.03  # units of sqrt(area): what lies further off is something else than the template's surface. Set by hand.
# Of noisy clouds, set by hand:
_ROUGH = 0.5  # from this `Shape.roughness` on, noise is larger than the template's triangles
_SAMPLES = 48  # of the template that share a point
_NOISE_RANGE = 0.006, 0.03  # units of sqrt(area)
_CHUNK = 8192  # points at a time


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Places(Brief):
    """Where the vertices of one shape belong on the template. Two of them, of one template, make a map.

    Vertices and faces are those of the shape's file, lengths in units of sqrt(area).

    Attributes
    ----------
    name, hash : of the shape, see `Shape.hash`
    template_hash : which template
    resting : (V, 3) where each vertex belongs on, or just above, the resting template, template frame
    height : (V,) how far above it
    distance : (V,) how far each vertex lies from the fitted template
    moved : (V, 3) how each place moved on the resting template when the fit had to agree with others; None if it had not
    spread : (V,) of a noisy cloud, standard deviation of the place; None for other shapes
    stands : (V,) which vertex stands for each: itself, its twin, or the nearest that was fitted
    faces : (F, 3) all triangles; fitted : (F,) whether each was fitted, or dropped as broken
    verdict, reasons, trust : of the fit
    """

    name: str
    hash: str
    template_hash: str
    resting: Float[Floats32, "V 3"]
    height: Float[Floats32, " V"]
    distance: Float[Floats32, " V"]
    moved: Float[Floats32, "V 3"] | None
    spread: Float[Floats32, " V"] | None
    stands: Int[Ints32, " V"]
    faces: Int[Ints32, "F 3"]
    fitted: Bool[Bools, " F"]
    verdict: str
    reasons: tuple[str, ...] = ()
    trust: float = 1.0

    @classmethod
    def of(cls, part: Repaired, fit: Fit, before: Fit | None = None, workers: int = 1) -> Places:
        """The places of a repaired shape; ``before`` is its fit before it agreed with others."""
        if not isinstance(part, Repaired):
            hint = "a fit of a collection has its places: fit.places"
            raise InputError(f"places are of a repaired shape (fit.repaired), not of {type(part).__name__}", hint)
        check_fit(fit)
        foot, resting = template_footpoints(part.shape, fit, workers)
        distance, spread, moved = foot.distance, None, None
        height = heights(part.shape, fit, foot)
        if is_noisy(part.shape):
            distance = closest_footpoints(part.shape, fit, workers).distance
            points = in_core_frame(part.shape, fit)[0]
            (_, resting), variance = expectation(points, fit, noise_level(distance), [fit.points, fit.resting])
            spread, height = np.sqrt(variance), np.zeros(len(points))
        else:
            normals = vertex_normals(fit.resting, fit.faces)
            resting += height[:, None] * foot.values(fit.faces, normals)
        if before is not None:
            moved = foot.values(fit.faces, _places_moved(before, fit))

        def of_file(values: Floats) -> Floats32:
            return values.astype(np.float32)[part.original_to_repaired]

        original = part.original
        stands = part.kept_vertex[part.original_to_repaired]
        # What was left out is as near to the template as the vertex that stands for it, and the way there; what has no
        # position may be anywhere on the shape.
        away = np.linalg.norm(original.verts - original.verts[stands], axis=1)
        away = np.where(original.valid, away, original.diagonal) / fit.frame.scale
        if part.copied is not None:  # but a copy is where it is for another reason
            away[part.copied] = 0.0
        fitted = np.zeros(original.F, bool)
        fitted[part.kept_face] = True
        return cls(
            name=original.name,
            hash=original.hash,
            template_hash=fit.template_hash,
            resting=of_file(resting),
            height=of_file(height),
            distance=of_file(distance) + away.astype(np.float32),
            moved=None if moved is None else of_file(moved),
            spread=None if spread is None else of_file(spread),
            stands=stands.astype(np.int32),
            faces=original.faces.astype(np.int32),
            fitted=fitted,
            verdict=fit.verdict,
            reasons=fit.reasons,
            trust=fit.trust,
        )

    def on(self, template: Shape) -> Footpoints:
        """The points of the resting template where the vertices belong."""
        return Surface(np.asarray(template.verts), np.asarray(template.faces)).query(self.resting.astype(np.float64))

    def nearest(
        self, resting: Float[Floats32, "N 3"], workers: int = 1, among: Int[Ints, " F"] | None = None
    ) -> Footpoints:
        """The points of this shape that belong nearest to N places on the resting template; of a mesh, ``among`` some of
        the faces that were fitted."""
        asked = resting.astype(np.float64)
        if len(self._used):
            used = self._used if among is None else among
            surface = self._surface if among is None else self._surface_of_some(among)
            found = surface.query(asked, None, workers)
            corners = self.faces[used].take(found.face, 0)
            nearest = np.take_along_axis(corners, found.barycentric.argmax(1)[:, None], 1)[:, 0]
            vertex = self.stands[nearest].astype(np.int64)
            return Footpoints(vertex, used[found.face], found.barycentric, found.distance)
        known = np.zeros((len(asked), 0 if self.spread is None else 1))
        distance, index = self._tree.query(np.column_stack([asked, known]), workers=workers)
        weights = np.tile([1.0, 0.0, 0.0], (len(asked), 1))
        return Footpoints(self._points[index], np.full(len(asked), -1, np.int64), weights, distance)

    @cached_property
    def _used(self) -> Ints:
        """Numbers of the faces that were fitted."""
        return np.flatnonzero(self.fitted)

    @cached_property
    def _surface(self) -> Surface:
        """The faces as they lie on the resting template."""
        return Surface(self.resting.astype(np.float64), self.stands[self.faces[self._used]].astype(np.int64))

    def _surface_of_some(self, faces: Int[Ints, " F"]) -> Surface:
        """The same of some faces, of their corners alone: what is asked of one part must not cost the whole."""
        corners, faces = np.unique(self.stands[self.faces[faces]], return_inverse=True)
        return Surface(self.resting[corners].astype(np.float64), faces.reshape(-1, 3).astype(np.int64))

    @cached_property
    def _points(self) -> Ints:
        """Vertices that stand for themselves."""
        return np.flatnonzero(self.stands == np.arange(len(self.stands)))

    @cached_property
    def _tree(self) -> cKDTree:
        """Of a cloud. The expected squared distance is that of the means, plus the variance of this shape's point."""
        columns = [self.resting] if self.spread is None else [self.resting, self.spread[:, None]]
        return cKDTree(np.concatenate(columns, 1)[self._points])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlacedFit(Fit):
    """A fit that was read from a folder of fits: it does not know its shape, but where the shape's vertices belong.

    Attributes
    ----------
    places
        Where they belong on the template.
    """

    places: Places

    @classmethod
    def of(cls, fit: Fit, places: Places) -> PlacedFit:
        """A fit with the places of its shape's vertices, in place of the shape."""
        known = {field.name: getattr(fit, field.name) for field in fields(Fit)}
        return cls(**known | {"verts": np.empty((0, 3)), "repaired": None, "places": places})

    @property
    def shape_name(self) -> str:
        return self.places.name


def surface_distance(shape: Shape, fitted: Shape, one_way: bool = False) -> tuple[float, float]:
    """How far two surfaces in one frame lie apart, on average over both and at most, in its unit: from every vertex of each
    to the nearest place of the other.

    Of a cloud, and with ``one_way`` of what is only a part of the fitted one, only from there.
    """
    ways = [(MappedMesh.of(fitted).query(shape.verts).distance, shape.vertex_areas)]
    if not (one_way or shape.is_cloud):
        ways.append((MappedMesh.of(shape).query(fitted.verts).distance, fitted.vertex_areas))
    mean = np.mean([np.average(distance, weights=weights) for distance, weights in ways])
    return float(mean), float(max(distance.max() for distance, _ in ways))


def _places_moved(before: Fit, after: Fit) -> Float[Floats, "V 3"]:
    """How places on the resting template move when the fitted one slides: as far, and back, as each triangle has it."""
    faces = after.faces
    slid = (before.points - after.points)[faces].mean(1)
    edges, resting = ((verts[faces[:, 1:]] - verts[faces[:, :1]]) for verts in (after.points, after.resting))
    gram = edges @ edges.transpose(0, 2, 1)
    gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-30 * np.eye(2)
    along = np.linalg.solve(gram, (edges @ slid[..., None]))[..., 0]
    moves = np.clip((along[:, None] @ resting)[:, 0], -1.0, 1.0)  # where a triangle is crushed to nothing
    area = triangle_areas(after.resting, faces)
    total = share_areas(area, faces, len(after.points))
    sums = np.stack([share_areas(area * column, faces, len(after.points)) for column in moves.T], 1)
    return np.asarray(sums / np.maximum(total, 1e-300)[:, None])


def heights(shape: Shape, fit: Fit, foot: Footpoints) -> Float[Floats, " V"]:
    """How far the vertices of a shape lie above their footpoints on the fitted template, at most `_HIGH` either way."""
    above = in_core_frame(shape, fit)[0] - foot.values(fit.faces, fit.points)
    above *= foot.values(fit.faces, vertex_normals(fit.points, fit.faces))
    return np.asarray(np.clip(above.sum(1), -_HIGH, _HIGH))


def is_noisy(shape: Shape) -> bool:
    """Whether a shape is a cloud so noisy that expectations pay."""
    return shape.roughness >= _ROUGH


def noise_level(distance: Float[Floats, " N"]) -> float:
    """Standard deviation of noise, from distances between points and a surface: robust against outliers.

    The median of a Gaussian's absolute values is 0.6745 standard deviations.
    """
    return float(np.clip(np.median(distance) / 0.6745, *_NOISE_RANGE))


def expectation(
    points: Float[Floats, "N 3"], fit: Fit, noise: float, values: Sequence[Float[Floats, "T D"]]
) -> tuple[list[Float[Floats, "N D"]], Float[Floats, " N"]]:
    """Expected values over the places of the template where points may belong, and how uncertain the first are.

    `points` are in the fit's core frame; `noise` is the standard deviation along each axis, in units of sqrt(area);
    `values` belong to the vertices of the fitted template. Returns the mean of each, and the variance of the first,
    summed over D.
    """
    # vertices and face centers of the template, as a matrix over the vertices, and the area that each stands for
    F, T = len(fit.faces), len(fit.points)
    rows = np.repeat(np.arange(F), 3)
    centers = csr_matrix((np.full(3 * F, 1 / 3), (rows, fit.faces.reshape(-1))), (F, T))
    matrix = csr_matrix(vstack([identity(T), centers]))
    areas = vertex_areas(fit.points, fit.faces), triangle_areas(fit.points, fit.faces)  # half of the whole each
    prior = np.concatenate([0.5 * area for area in areas])
    tree = cKDTree(matrix @ fit.points)
    sampled = [matrix @ value for value in values]
    means = [np.empty((len(points), value.shape[1])) for value in values]
    variance = np.empty(len(points))
    for low in range(0, len(points), _CHUNK):
        part = slice(low, low + _CHUNK)
        distance, index = tree.query(points[part], min(_SAMPLES, tree.n))
        further = np.square(distance) - np.square(distance[:, :1])  # the closest keeps its weight at any distance
        weight = prior[index] * np.exp(-0.5 * further / noise**2)
        weight /= weight.sum(1, keepdims=True)
        for mean, value in zip(means, sampled, strict=True):
            mean[part] = blend(value[index], weight)
        deviation = np.square(sampled[0][index] - means[0][part][:, None]).sum(2)
        variance[part] = (weight * deviation).sum(1)
    return means, variance
