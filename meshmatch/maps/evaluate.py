"""Quality measures of maps: errors where ground truth is known, coverage and distortion where it is not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.arrays import (
    Float,
    Floats,
    Floats32,
    PickledFields,
    ShortRepr,
    as_array,
    as_integers,
    as_numbers,
    set_read_only,
    table_html,
)
from meshmatch.errors import InputError, warn
from meshmatch.geometry.triangles import dot, squared_lengths, triangle_vectors
from meshmatch.maps.folds import Folds
from meshmatch.maps.geodesics import GEODESIC, GeodesicDistances
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.progress import Progress, ProgressCallback
from meshmatch.shapes.shape import Shape

SKIN_M2 = 1.9
CM_PER_UNIT = 100.0 * float(np.sqrt(SKIN_M2))
"""Centimetres in one sqrt(area) of a person with 1.9 m2 of skin."""
LOST_CM = 15.0
"""A point with a larger error is on the wrong limb; a pair with a larger mean error is a left-right flip."""
_TRUTH_HINT = "give one target vertex for every source vertex, or a pair of lists of the same length"
_MAX_ERROR = float(np.finfo(np.float32).max)  # of the type of errors; larger thresholds count as this
_LOST_ERROR = 0.1  # an error above this is a point in a wrong place, on shapes other than people; units of sqrt(area)


@dataclass(frozen=True)
class ErrorUnit:
    """The unit that errors are reported in.

    Attributes
    ----------
    name
        "cm" (the target scaled to 1.9 m2 of skin), "file" (unit of the target's file) or "x100" (hundredths of sqrt(area)).
    factor
        Number of these units in one sqrt(area) of the target.
    symbol
        Written after a number.
    words
        Label of a plot's axis.
    lost
        Threshold above which a point is in a wrong place.
    """

    name: str
    factor: float
    symbol: str
    words: str
    lost: float

    @classmethod
    def of_file(cls, target: Shape) -> ErrorUnit:
        """The unit of the target's file.

        Parameters
        ----------
        target
            The shape on which errors were measured.

        Returns
        -------
        ErrorUnit
            ``factor`` is the square root of the target's area.
        """
        size = float(np.sqrt(target.area))
        return cls("file", size, "(unit of the file)", "unit of the file", _LOST_ERROR * size)


CM = ErrorUnit("cm", CM_PER_UNIT, "cm", "cm, target scaled to 1.9 m² of skin", LOST_CM)
X100 = ErrorUnit("x100", 100.0, "x 0.01 sqrt(area)", "hundredths of sqrt(area)", 100 * _LOST_ERROR)


@dataclass(frozen=True)
class SurfaceDistance:
    """Distance between two surfaces.

    Attributes
    ----------
    mean
        Mean distance over both surfaces, in ``unit``.
    most
        Largest distance, in ``unit``.
    unit
        Unit of lengths.

    Examples
    --------
    >>> fit = meshmatch.register("templates/samples/climber.ply")
    >>> apart = meshmatch.measure_distance("templates/samples/climber.ply", fit.shape, unit="file")
    >>> print(apart.mean, apart.most)
    """

    mean: float
    most: float
    unit: ErrorUnit

    def __str__(self) -> str:
        """One line of text."""
        name, length = self.unit.name, "" if self.unit.name == "file" else f" {self.unit.symbol}"
        place = {"file": ", in the unit of the file", "cm": ", on a body of 1.9 square metres of skin"}.get(name, "")
        return f"surfaces lie {self.mean:.2g}{length} apart on average, {self.most:.2g} at most{place}"

    def as_dict(self) -> dict[str, float | str]:
        """Plain numbers, for a line of JSON.

        Returns
        -------
        dict
            ``mean`` and ``most`` in ``unit``, the name of an `ErrorUnit`.
        """
        return {"mean": self.mean, "most": self.most, "unit": self.unit.name}


@dataclass(frozen=True, eq=False, repr=False)
class Errors(ShortRepr, PickledFields):
    """Errors of a map, one for each point with known ground truth.

    An error is the geodesic distance between the predicted and the true point on the target, divided by the square root of
    the target's area. In centimetres, the target is scaled to 1.9 m2, the skin of a person.

    Attributes
    ----------
    values
        (N,) float32, in units of sqrt(area).

    Raises
    ------
    InputError
        The list is empty, or an error is negative or not finite.

    Examples
    --------
    >>> errors = meshmatch.Errors(np.array([0.01, 0.02, 0.3], np.float32))
    >>> print(errors.mean_cm, errors.share_over(15.0), errors.curve([0.05, 0.1]))
    """

    values: Float[Floats32, " N"]

    def __post_init__(self) -> None:
        values = as_numbers(self.values, "errors").astype(np.float32).reshape(-1)
        if not values.size or not np.isfinite(values).all() or values.min() < 0:
            raise InputError("there must be errors, all finite and 0 or more")
        object.__setattr__(self, "values", set_read_only(values))

    @property
    def cm(self) -> Float[Floats32, " N"]:
        """The errors in centimetres."""
        return np.asarray(self.values * np.float32(CM_PER_UNIT))

    @property
    def mean(self) -> float:
        """Mean error, in units of sqrt(area)."""
        return float(self.values.mean(dtype=np.float64))

    @property
    def median(self) -> float:
        """Median error, in units of sqrt(area)."""
        return float(np.median(self.values))

    @property
    def mean_cm(self) -> float:
        """Mean error in centimetres."""
        return self.mean * CM_PER_UNIT

    @property
    def median_cm(self) -> float:
        """Median error in centimetres."""
        return self.median * CM_PER_UNIT

    def share_over(self, cm: float = LOST_CM) -> float:
        """Share of the points with an error above a threshold.

        Parameters
        ----------
        cm
            The threshold, in centimetres.

        Returns
        -------
        float
            From 0 to 1.
        """
        return float((self.values > min(float(cm) / CM_PER_UNIT, _MAX_ERROR)).mean())

    def curve(self, thresholds: ArrayLike) -> Floats:
        """Share of the points with an error of at most each threshold.

        Parameters
        ----------
        thresholds
            In units of sqrt(area).

        Returns
        -------
        array of float64
            From 0 to 1, in the shape of the thresholds.
        """
        ordered = np.sort(self.values.astype(np.float64))
        return np.asarray(np.searchsorted(ordered, np.asarray(thresholds), side="right") / len(ordered))


@dataclass(frozen=True)
class Coverage:
    """How much of a target a map reaches: the shares (0..1) of its vertices, and of their areas, that are hit.

    A source with fewer vertices than the target cannot reach all: `vertices` is at most V_source / V_target.
    """

    vertices: float
    area: float


def map_errors(
    index: ArrayLike,
    source_points: ArrayLike,
    target_points: ArrayLike,
    geodesics: GeodesicDistances,
    progress: Callable[[float], None] | None = None,
) -> Errors:
    """Geodesic distances between ``index[source_points[n]]`` and the true vertices ``target_points[n]``.

    `index` (V_source,) is the map; both lists of points (N,) are vertices; `geodesics` are distances on the target.
    Pairs with a -1 have no counterpart, and are left out with a warning.
    `InputError` if the lists are not integers, differ in length, or name a vertex that does not exist.
    """
    index = as_array(index, "the map")
    a, b = (as_integers(ids, "the truth", "vertices, counted from 0") for ids in (source_points, target_points))
    if a.shape != b.shape or a.ndim != 1 or not a.size:
        raise InputError(f"the truth has {a.shape} vertices of the source and {b.shape} of the target", _TRUTH_HINT)
    known = (a != -1) & (b != -1)
    if not known.any():
        raise InputError("the truth has no vertex with a counterpart", _TRUTH_HINT)
    if not known.all():
        warn(f"{np.count_nonzero(~known)} of {len(known)} vertices have no counterpart: left out")
        a, b = a[known], b[known]
    for ids, size, side in ((a, len(index), "source"), (b, geodesics.V, "target")):
        if (wrong := ids[(ids < 0) | (ids >= size)]).size:
            hint = "vertices are counted from 0 (subtract 1 from those of MATLAB and R), and those of the source come first"
            raise InputError(f"the truth names vertex {wrong[0]} of the {side}, which has {size}", hint)
    return Errors(geodesics.between(index[a], b, progress).astype(np.float32))


def placed_pairs(
    source_points: ArrayLike, target_points: ArrayLike, source: Shape, target: Shape
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Known pairs whose vertices both have a position; others are left out with a warning.

    Lists that are not valid are returned unchanged, for `map_errors` to refuse.
    """
    a, b = (as_array(ids, "the truth", _TRUTH_HINT) for ids in (source_points, target_points))
    known = (source.invalid is not None or target.invalid is not None) and a.shape == b.shape and a.ndim == 1
    if not known or not all(ids.dtype.kind in "iu" for ids in (a, b)):
        return a, b
    lost = np.zeros(len(a), bool)
    for ids, shape in ((a, source), (b, target)):
        there = (ids >= 0) & (ids < shape.V)
        lost[there] |= ~shape.valid[ids[there]]
    if lost.any():
        warn(f"{np.count_nonzero(lost)} of {len(lost)} known points have a vertex without a position: left out")
    return a[~lost], b[~lost]


def coverage(index: ArrayLike, target: Shape) -> Coverage:
    """Share of the target's vertices, and of its area, that ``index`` ``(V_source,)`` hits."""
    hit = np.zeros(target.V, dtype=bool)
    hit[np.asarray(index)] = True
    total = float(target.vertex_areas.sum())
    area = float(target.vertex_areas[hit].sum()) / total if total > 0 else float(hit.mean())
    return Coverage(float(hit.mean()), area)


def distortion(
    index: ArrayLike, source: GeodesicDistances, target: GeodesicDistances, rng: np.random.Generator, samples: int = 80
) -> float:
    """Mean change of the distance between two points under a map, in units of sqrt(area).

    Compares ``samples`` random source vertices pairwise; both shapes in units of their own sqrt(area). 0 for an
    isometry; a random map between two bodies has about 0.45. It needs no ground truth, and does not see a left-right
    flip. Vertices that no face uses are left out.
    """
    index = np.asarray(index)
    chosen = rng.choice(source.on_surface, size=min(samples, len(source.on_surface)), replace=False)
    images, column = np.unique(index[chosen], return_inverse=True)
    before = np.concatenate([rows[:, chosen] for _, rows in source.chunks(chosen)])
    after = np.concatenate([rows[:, images] for _, rows in target.chunks(images)])[np.ix_(column, column)]
    pairs = np.triu_indices(len(chosen), k=1)
    return float(np.abs(before - after)[pairs].mean()) if len(chosen) > 1 else 0.0


def dirichlet_energy(found: VertexMap, source: Shape, target: Shape) -> float:
    """Dirichlet energy of a map: half the integral of its squared gradient over the source, both shapes scaled to area 1.

    1 for an isometry, larger for rougher maps. Triangles without area are left out.
    """
    images, verts = found.points(target) / np.sqrt(target.area), source.verts
    faces = source.faces[source.valid_faces & (source.face_areas > 0)]
    double, energy = np.sqrt(squared_lengths(triangle_vectors(verts, faces))), 0.0
    for corner, left, right in (faces.T, faces.T[[1, 2, 0]], faces.T[[2, 0, 1]]):
        cotangent = dot(verts[left] - verts[corner], verts[right] - verts[corner]) / double
        energy += 0.25 * float((cotangent * squared_lengths(images[left] - images[right])).sum())
    return energy


def round_trip(found: VertexMap, backward: VertexMap, source: GeodesicDistances) -> float:
    """Mean distance between a source vertex and its image under the map and then the map back, in units of sqrt(area).

    Vertices that no face uses are left out.
    """
    there_and_back, rows = found.compose(backward).index, source.on_surface
    return float(source.between(rows, there_and_back[rows]).mean())


@dataclass(frozen=True)
class Evaluation:
    """All measures of one map.

    Attributes
    ----------
    coverage
        Shares (0..1) of the target's ``vertices`` and ``area`` that the map reaches.
    distortion
        Mean change of the distance between two points, in units of sqrt(area); None unless both are meshes.
    folds
        Shares (0..1) of the source's area that are ``flipped`` and ``crushed``, and the median ``stretch`` (a factor of 1
        or more); None unless both are meshes.
    errors
        Distances from the ground truth; None where it is not known.
    unit
        The unit that errors are reported in.
    geodesic
        How distances along a surface are measured.
    dirichlet
        Dirichlet energy, both shapes scaled to area 1: 1 for an isometry, more for a rough map; None unless both are
        meshes.
    bijectivity
        Mean distance between a vertex of the source and its image under both maps in succession, in units of sqrt(area);
        None where the map back is not given, and for a cloud.

    Examples
    --------
    >>> climber, dancer = "templates/samples/climber.ply", "templates/samples/dancer.ply"
    >>> found = meshmatch.evaluate(meshmatch.match(climber, dancer), climber, dancer)
    >>> print(found.coverage.area, found.distortion, found.as_dict())
    """

    coverage: Coverage
    distortion: float | None = None
    folds: Folds | None = None
    errors: Errors | None = None
    unit: ErrorUnit = CM
    geodesic: str = GEODESIC
    dirichlet: float | None = None
    bijectivity: float | None = None

    def _repr_html_(self) -> str:
        rows = {name: f"{value:.4g}" for name, value in self.as_dict().items() if isinstance(value, float | int)}
        return table_html("Evaluation", rows)

    def as_dict(self, threshold: float | None = None) -> Mapping[str, Any]:
        """Plain numbers, for a line of JSON.

        Parameters
        ----------
        threshold
            Errors above this count in ``share_over_threshold``; in ``unit``, by default the unit's ``lost``.

        Returns
        -------
        dict
            ``mean``, ``median`` and ``threshold`` of errors are in ``unit``; lengths ending in "x100" in sqrt(area) x 100,
            those in "cm" for a target of 1.9 m2.
        """
        record: dict[str, Any] = {
            "coverage_vertices": self.coverage.vertices,
            "coverage_area": self.coverage.area,
            "distortion": self.distortion,
            "dirichlet": self.dirichlet,
            "bijectivity": self.bijectivity,
            **({} if self.folds is None else asdict(self.folds)),
        }
        if self.errors is not None:
            record |= {
                "points": int(self.errors.values.size),
                "unit": self.unit.name,
                "mean": self.unit.factor * self.errors.mean,
                "median": self.unit.factor * self.errors.median,
                "mean_x100": 100 * self.errors.mean,
                "median_x100": 100 * self.errors.median,
                "mean_cm": self.errors.mean_cm,
                "median_cm": self.errors.median_cm,
                "threshold": self.unit.lost if threshold is None else threshold,
                "share_over_threshold": self.share_over(threshold),
                "geodesic": self.geodesic,
            }
        return record

    def share_over(self, threshold: float | None = None) -> float:
        """Share of the points with an error above a threshold.

        Parameters
        ----------
        threshold
            In ``unit``; by default the unit's ``lost``.

        Returns
        -------
        float
            From 0 to 1; nan where the ground truth is not known.
        """
        if self.errors is None:
            return float("nan")
        limit = float(self.unit.lost if threshold is None else threshold) / float(self.unit.factor)
        return float((self.errors.values > min(limit, _MAX_ERROR)).mean())


def evaluate_map(
    vertex_map: VertexMap,
    source: Shape,
    target: Shape,
    source_points: ArrayLike | None = None,
    target_points: ArrayLike | None = None,
    *,
    backward: VertexMap | None = None,
    unit: ErrorUnit = CM,
    rng: np.random.Generator | None = None,
    progress: ProgressCallback | None = None,
) -> Evaluation:
    """Compute all measures of a map that the arguments allow.

    Coverage always; distortion, Dirichlet energy and folds if both shapes are meshes; bijectivity if the map back
    (``backward``) is given; errors if ground truth is given, as in `map_errors`. With `target_points` alone, entry i
    belongs to vertex i of the source. `unit` is the unit that errors are reported in; `rng`, ``default_rng(0)`` if None,
    chooses the points of `distortion`. `InputError` if the maps or the ground truth do not belong to these shapes, or if
    ground truth is given and the target is a cloud.
    """
    vertex_map = vertex_map.for_shapes(source, target)
    geodesics_target = errors = distances_change = folds = energy = bijectivity_error = None
    backward = None if backward is None else backward.for_shapes(target, source, "the map back")
    report = Progress(progress, target.name).stage("measuring errors")
    if target_points is not None:
        source_points = np.arange(source.V) if source_points is None else source_points
        geodesics_target, pairs = GeodesicDistances(target), placed_pairs(source_points, target_points, source, target)
        errors = map_errors(vertex_map.index, *pairs, geodesics_target, report)
    if not source.is_cloud and not target.is_cloud:
        geodesics = GeodesicDistances(source), geodesics_target or GeodesicDistances(target)
        distances_change = distortion(vertex_map.index, *geodesics, rng or np.random.default_rng(0))
        folds, energy = Folds.of(vertex_map, source, target), dirichlet_energy(vertex_map, source, target)
    if backward is not None and not source.is_cloud:
        bijectivity_error = round_trip(vertex_map, backward, GeodesicDistances(source))
    measured: dict[str, Any] = {"dirichlet": energy, "bijectivity": bijectivity_error}
    return Evaluation(coverage(vertex_map.index, target), distances_change, folds, errors, unit, **measured)
