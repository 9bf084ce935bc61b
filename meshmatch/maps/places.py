"""Places: where the vertices of a shape belong on the rest template. Maps are built from the places of two shapes.

The place of a vertex is its footpoint on the fitted template, moved to the rest template and raised above it by as much as
the vertex lies above the fitted one. This height keeps detail that the fit smooths away, and distinguishes the two sides
of a thin wall.

For a point of a noisy cloud a place is not known exactly. Noise moves points across the surface and along it alike; the
closest point of the template removes the first error and keeps the second. Such a point is therefore assigned to all of
the template within reach, with Gaussian weights: its place is the expectation, its spread the standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix, identity, vstack

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints, Ints32, ShortRepr
from meshmatch.errors import InputError
from meshmatch.fitting.fit import Fit, check_fit
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import areas_to_vertices, blend, triangle_areas, vertex_areas, vertex_normals
from meshmatch.maps.footpoints import Footpoints, Surface, closest_footpoints, in_core_frame, template_footpoints
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.shapes.repair import Repaired
from meshmatch.shapes.shape import Shape

# Largest height (units of sqrt(area)): what is farther off is not the template's surface. Set by hand.
_MAX_HEIGHT = 0.03
# For noisy clouds, set by hand:
_MIN_NOISY_ROUGHNESS = 0.5  # from this `Shape.roughness` on, noise is larger than the template's triangles
_N_SAMPLES = 48  # nearest samples of the template over which the expectation of a point is taken
_NOISE_RANGE = 0.006, 0.03  # units of sqrt(area)
_CHUNK = 8192  # points per chunk


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Places(ShortRepr):
    """Places of one shape's vertices on the rest template. Those of two shapes, on one template, make a map.

    Vertices and faces are those of the shape's file, lengths in units of sqrt(area).

    Attributes
    ----------
    name, hash : name and hash of the shape, see `Shape.hash`
    template_hash : hash of the template
    resting : (V, 3) place of each vertex on, or just above, the rest template, in the template's frame
    height : (V,) height of each place above the rest template
    distance : (V,) distance between each vertex and the fitted template
    moved : (V, 3) how each place moved on the rest template when the fit was made to agree with others; None if it was not
    spread : (V,) standard deviation of the place, for a noisy cloud; None for other shapes
    stands : (V,) the vertex that represents each one: itself, its duplicate, or the nearest that was fitted
    faces : (F, 3) all triangles; fitted : (F,) False for those that were left out of the fit
    verdict, reasons, trust : those of the fit
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
        """Compute the places of a repaired shape; ``before`` is its fit before it was made to agree with others."""
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
            moved = foot.values(fit.faces, _displacement_on_rest(before, fit))

        def of_file(values: Floats) -> Floats32:
            return values.astype(np.float32)[part.original_to_repaired]

        original = part.original
        stands = part.kept_vertex[part.original_to_repaired]
        # The distance of a vertex that was left out is that of its representative plus the distance to it; a vertex without
        # a position may be anywhere on the shape.
        away = np.linalg.norm(original.verts - original.verts[stands], axis=1)
        away = np.where(original.valid, away, original.diagonal) / fit.frame.scale
        if part.copied is not None:  # copies match their originals however far apart they are
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
        """Closest points on the rest template to the places."""
        return Surface(np.asarray(template.verts), np.asarray(template.faces)).query(self.resting.astype(np.float64))

    def nearest(
        self, resting: Float[Floats32, "N 3"], workers: int = 1, among: Int[Ints, " F"] | None = None
    ) -> Footpoints:
        """Find the points of this shape whose places are nearest to N places on the rest template.

        For a mesh, ``among`` restricts the search to some of the faces that were fitted.
        """
        query = resting.astype(np.float64)
        if len(self._fitted_faces):
            faces = self._fitted_faces if among is None else among
            surface = self._surface if among is None else self._surface_of_faces(among)
            found = surface.query(query, None, workers)
            corners = self.faces[faces].take(found.face, 0)
            nearest = np.take_along_axis(corners, found.barycentric.argmax(1)[:, None], 1)[:, 0]
            vertex = self.stands[nearest].astype(np.int64)
            return Footpoints(vertex, faces[found.face], found.barycentric, found.distance)
        known = np.zeros((len(query), 0 if self.spread is None else 1))
        distance, index = self._tree.query(np.column_stack([query, known]), workers=workers)
        weights = np.tile([1.0, 0.0, 0.0], (len(query), 1))
        return Footpoints(self._kept_vertices[index], np.full(len(query), -1, np.int64), weights, distance)

    @cached_property
    def _fitted_faces(self) -> Ints:
        """Indices of the faces that were fitted."""
        return np.flatnonzero(self.fitted)

    @cached_property
    def _surface(self) -> Surface:
        """The fitted faces, with vertices at their places."""
        return Surface(self.resting.astype(np.float64), self.stands[self.faces[self._fitted_faces]].astype(np.int64))

    def _surface_of_faces(self, faces: Int[Ints, " F"]) -> Surface:
        """The same for some faces, built from their corners only, so that a query of one part does not cost the whole."""
        corners, faces = np.unique(self.stands[self.faces[faces]], return_inverse=True)
        return Surface(self.resting[corners].astype(np.float64), faces.reshape(-1, 3).astype(np.int64))

    @cached_property
    def _kept_vertices(self) -> Ints:
        """Vertices that represent themselves."""
        return np.flatnonzero(self.stands == np.arange(len(self.stands)))

    @cached_property
    def _tree(self) -> cKDTree:
        """Search tree for a cloud; the spread is an additional coordinate.

        The expected squared distance to an uncertain point is that to its mean plus its variance.
        """
        columns = [self.resting] if self.spread is None else [self.resting, self.spread[:, None]]
        return cKDTree(np.concatenate(columns, 1)[self._kept_vertices])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PlacedFit(Fit):
    """A fit that was read from a folder of fits: it has the places of its shape's vertices, but not the shape.

    Attributes
    ----------
    places
        Places of the vertices on the template.
    """

    places: Places

    @classmethod
    def of(cls, fit: Fit, places: Places) -> PlacedFit:
        """Replace the shape of a fit by the places of its vertices."""
        known = {field.name: getattr(fit, field.name) for field in fields(Fit)}
        return cls(**known | {"verts": np.empty((0, 3)), "repaired": None, "places": places})

    @property
    def shape_name(self) -> str:
        return self.places.name


def surface_distance(shape: Shape, fitted: Shape, one_way: bool = False) -> tuple[float, float]:
    """Mean and maximum distance between two surfaces in one frame, in its unit.

    Measured from every vertex of each surface to the closest point of the other, and averaged over both directions. If
    ``shape`` is a cloud, or with ``one_way``, for a shape that is only a part of the fitted one, only from ``shape``.
    """
    ways = [(MappedMesh.of(fitted).query(shape.verts).distance, shape.vertex_areas)]
    if not (one_way or shape.is_cloud):
        ways.append((MappedMesh.of(shape).query(fitted.verts).distance, fitted.vertex_areas))
    mean = np.mean([np.average(distance, weights=weights) for distance, weights in ways])
    return float(mean), float(max(distance.max() for distance, _ in ways))


def _displacement_on_rest(before: Fit, after: Fit) -> Float[Floats, "V 3"]:
    """Displacement from after to before agreement, per vertex, pulled back from the fitted to the rest template.

    Each triangle's mean displacement is expressed in its edges on the fitted template and rebuilt from those of the rest
    template; vertices get area-weighted means.
    """
    faces = after.faces
    slid = (before.points - after.points)[faces].mean(1)
    edges, resting = ((verts[faces[:, 1:]] - verts[faces[:, :1]]) for verts in (after.points, after.resting))
    gram = edges @ edges.transpose(0, 2, 1)
    gram += 1e-9 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(2) + 1e-30 * np.eye(2)
    along = np.linalg.solve(gram, (edges @ slid[..., None]))[..., 0]
    moves = np.clip((along[:, None] @ resting)[:, 0], -1.0, 1.0)  # bounds the moves of degenerate triangles
    area = triangle_areas(after.resting, faces)
    total = areas_to_vertices(area, faces, len(after.points))
    sums = np.stack([areas_to_vertices(area * column, faces, len(after.points)) for column in moves.T], 1)
    return np.asarray(sums / np.maximum(total, 1e-300)[:, None])


def heights(shape: Shape, fit: Fit, foot: Footpoints) -> Float[Floats, " V"]:
    """Signed heights of a shape's vertices above their footpoints on the fitted template, clipped to `_MAX_HEIGHT`."""
    above = in_core_frame(shape, fit)[0] - foot.values(fit.faces, fit.points)
    above *= foot.values(fit.faces, vertex_normals(fit.points, fit.faces))
    return np.asarray(np.clip(above.sum(1), -_MAX_HEIGHT, _MAX_HEIGHT))


def is_noisy(shape: Shape) -> bool:
    """Whether a shape is a cloud so noisy that places are computed as expectations."""
    return shape.roughness >= _MIN_NOISY_ROUGHNESS


def noise_level(distance: Float[Floats, " N"]) -> float:
    """Robust estimate of the standard deviation of noise, from distances between points and a surface.

    The median of a Gaussian's absolute values is 0.6745 standard deviations.
    """
    return float(np.clip(np.median(distance) / 0.6745, *_NOISE_RANGE))


def expectation(
    points: Float[Floats, "N 3"], fit: Fit, noise: float, values: Sequence[Float[Floats, "T D"]]
) -> tuple[list[Float[Floats, "N D"]], Float[Floats, " N"]]:
    """Expected values at noisy points, over their possible footpoints on the template, and the variance of the first.

    `points` are in the fit's core frame; `noise` is the standard deviation along each axis, in units of sqrt(area);
    `values` belong to the vertices of the fitted template. Returns the mean of each, and the variance of the first,
    summed over D.
    """
    # samples: vertices and face centers of the template, as a matrix over the vertices, and the area that each represents
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
        distance, index = tree.query(points[part], min(_N_SAMPLES, tree.n))
        further = np.square(distance) - np.square(distance[:, :1])  # the closest keeps its weight at any distance
        weight = prior[index] * np.exp(-0.5 * further / noise**2)
        weight /= weight.sum(1, keepdims=True)
        for mean, value in zip(means, sampled, strict=True):
            mean[part] = blend(value[index], weight)
        deviation = np.square(sampled[0][index] - means[0][part][:, None]).sum(2)
        variance[part] = (weight * deviation).sum(1)
    return means, variance
