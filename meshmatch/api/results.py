"""Result types of matching and transfers, and functions that evaluate maps and fits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.api.kinds import UnitName, error_unit
from meshmatch.arrays import Float, Floats, ShortRepr, to_numpy
from meshmatch.errors import InputError, OptionError
from meshmatch.fitting.fit import Fit
from meshmatch.maps.build import build_map
from meshmatch.maps.evaluate import Evaluation, SurfaceDistance, evaluate_map
from meshmatch.maps.files import load_map
from meshmatch.maps.mapped_mesh import invert_map
from meshmatch.maps.places import PlacedFit, Places, surface_distance
from meshmatch.maps.unfold_pair import unfold_pair
from meshmatch.maps.vertex_map import VertexMap, check_map
from meshmatch.models.registry import NO_MODEL
from meshmatch.outputs import as_path, replace_on_success
from meshmatch.progress import ProgressCallback
from meshmatch.scalars import check_seed, is_number
from meshmatch.shapes.deformed_files import save_moved
from meshmatch.shapes.files import ShapeLike, as_shape
from meshmatch.shapes.formats.gltf_rig import Binding
from meshmatch.shapes.repair import Repaired, repair
from meshmatch.shapes.shape import Shape
from meshmatch.threads import thread_limit
from meshmatch.transfer.low_confidence import LowConfidence

if TYPE_CHECKING:
    from meshmatch.implicit.fit import ImplicitFit

T = TypeVar("T")


@dataclass(frozen=True, eq=False, repr=False)
class MovedMesh(ShortRepr):
    """A mesh with moved vertices: the base of the results of `transfer_garment` and `wrap`.

    Attributes
    ----------
    shape
        The mesh with its new positions; vertices and faces in their original order.
    turns
        (V, 3, 3) rotation of the surface at each vertex.
    original
        The mesh's file, if it was read from one.
    binding
        The skeleton that moves the mesh in a .glb, if there is one.
    turn
        (3, 3) rotation that makes y the up axis, as .glb requires; None if it is already, or the up axis is unknown.
    """

    shape: Shape
    turns: Float[Floats, "V 3 3"]
    original: Path | None = field(default=None, kw_only=True)
    binding: Binding | None = field(default=None, kw_only=True)
    turn: Float[Floats, "3 3"] | None = field(default=None, kw_only=True)

    def save(self, path: str | Path) -> None:
        """Write the mesh, with everything else of its file that the format supports.

        An .obj written from an .obj keeps all text but the positions and normals; its materials and images are copied next
        to it. A .glb written from a .glb, .gltf or .vrm keeps everything but the positions and what rotates with them. In
        a .glb, a node turns the mesh upright if needed.

        Parameters
        ----------
        path
            The output file; its suffix selects the format, see `save_shape`. A warning lists what the format cannot hold.

        Raises
        ------
        OptionError
            The suffix is unknown, or a material would replace another file.
        OutputError
            A file cannot be written.
        """
        save_moved(path, self.original, self.shape, self.turns, self.binding, self.turn)


@dataclass(frozen=True, eq=False)
class MatchResult:
    """The result of `match`: a map, and the fits it was made from.

    Attributes
    ----------
    map
        From source to target: ``map.index[i]`` is the vertex of the target matched to vertex i of the source.
    source_fit
        The template fitted to the source, after both fits were refined jointly so that the template stretches alike.
    target_fit
        The same for the target.
    seconds
        Wall time.
    notes
        Repairs of the shapes before fitting, parts that were left out, and options that were replaced.
    before_agreement
        Both fits before the joint refinement. Where it moved them far, the confidence of the map is low.
    threads
        Number of threads for further computations, such as `backward`.
    opposite
        The map from target to source, if it was computed together with `map`: for two complete meshes of up to 60,000
        vertices that match well.

    Examples
    --------
    >>> result = meshmatch.match("templates/samples/climber.ply", "templates/samples/dancer.ply")
    >>> print(result.map.verdict, result.source_fit.trust, result.notes)
    >>> dancer_to_climber = result.backward()
    """

    map: VertexMap
    source_fit: Fit | ImplicitFit
    target_fit: Fit | ImplicitFit
    seconds: float
    notes: tuple[str, ...]
    before_agreement: tuple[Fit | ImplicitFit, Fit | ImplicitFit]
    threads: int = 1
    opposite: VertexMap | None = None

    def __repr__(self) -> str:
        return f"MatchResult({self.map!r}, {self.seconds:.1f} s, {len(self.notes)} notes)"

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import map_html

        shapes = self.shapes
        more = {"time": f"{self.seconds:.1f} s", "notes": "; ".join(self.notes)}
        return map_html("Match", self.map, shapes, self.rotations, more)

    @property
    def shapes(self) -> tuple[Shape, Shape] | None:
        """Source and target, with weight 0 where a fit left something out; None if the fits do not contain them."""
        repaired = [getattr(fit, "repaired", None) for fit in (self.source_fit, self.target_fit)]
        return (repaired[0].original, repaired[1].original) if repaired[0] and repaired[1] else None

    @property
    def rotations(self) -> tuple[Floats | None, Floats | None]:
        """Rotations (3, 3) of source and target, from their files to the orientation of the template, for pictures.

        (None, None) for implicit models, whose template has no known up axis, and for fits without a model, whose common
        frame says nothing about what is upright.
        """
        known = isinstance(self.source_fit, Fit) and self.source_fit.model != NO_MODEL
        return (self.source_fit.frame.turn, self.target_fit.frame.turn) if known else (None, None)

    def backward(self) -> VertexMap:
        """Return the map from target to source, which transfers use to pull values from the source.

        For two complete meshes of up to 60,000 vertices that match well, it is the inverse of `map`, and exchanging source
        and target gives the same two maps. Otherwise it is computed separately from the same fits.

        Returns
        -------
        VertexMap
            One entry for each vertex of the target.
        """
        if self.opposite is not None and self.map.verdict == "good":
            return self.opposite
        source, target = self.before_agreement
        with thread_limit(1):
            return maps_of_fits((self.target_fit, self.source_fit), (target, source), self.threads)[0]

    def deformed_source(self) -> Shape:
        """Return the mesh of the source, deformed onto the target.

        Its vertices follow the fitted template and keep their offsets from it, so that details are preserved.

        Returns
        -------
        Shape
            The vertices and faces of the source's file in their order, in the frame and unit of the target's file.

        Raises
        ------
        OptionError
            The match was made with an implicit model, which cannot deform a mesh.
        """
        from meshmatch.maps.deformed import deformed

        source, target = self.source_fit, self.target_fit
        if not (isinstance(source, Fit) and isinstance(target, Fit)):
            raise OptionError("an implicit model carries no mesh from shape to shape", "choose another model, or none")
        with thread_limit(1):
            return deformed(shape_of(source), source, target, self.threads)


@dataclass(frozen=True, eq=False, repr=False)
class MapPair(ShortRepr):
    """The maps between two shapes in both directions.

    Attributes
    ----------
    source
        The shape that attributes are transferred from.
    target
        The shape that they are transferred to.
    forward
        The map from source to target.
    match
        The match that produced the map, if any; it also provides the map back.
    threads
        Number of threads for further computations, such as `backward`.
    opposite
        The map from target to source, if it is already known.

    Examples
    --------
    >>> maps = meshmatch.find_maps("templates/samples/dancer.ply", "templates/samples/climber.ply")
    >>> print(maps.forward.verdict, maps.backward.index)
    """

    source: Shape
    target: Shape
    forward: VertexMap
    match: MatchResult | None = None
    threads: int = 1
    opposite: VertexMap | None = None

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import map_html

        return map_html("Maps", self.forward, (self.source, self.target), self.rotations)

    @property
    def rotations(self) -> tuple[Floats | None, Floats | None]:
        """Rotations of the match, see `MatchResult.rotations`; (None, None) without a match."""
        return (None, None) if self.match is None else self.match.rotations

    @cached_property
    def backward(self) -> VertexMap:
        """The map from target to source: ``opposite``, or the match's, or else the inverse of ``forward``."""
        if self.opposite is not None:
            return self.opposite
        if self.match is not None:
            return self.match.backward()
        with thread_limit(1):
            return invert_map(self.forward, self.source, self.target, self.threads)


def maps_of_fits(
    fits: tuple[Fit | ImplicitFit, Fit | ImplicitFit], before: tuple[Fit | ImplicitFit, Fit | ImplicitFit], threads: int
) -> tuple[VertexMap, VertexMap | None]:
    """Compute the map from the shape of the first fit to the shape of the second.

    For two complete meshes that match well and are not too large, also return the inverse map; exchanging the fits then
    exchanges the two maps. For other shapes the second result is None. ``before`` are the fits before their joint
    refinement. `OptionError` if the fits are of different templates, or do not contain their shapes.
    """
    first, second = fits
    if not isinstance(first, Fit) and not isinstance(second, Fit):
        assert first.owner and first.source and second.source
        return first.owner.match(first, second, first.source, second.source), None

    def placed(fit: Fit | ImplicitFit, own: Fit | ImplicitFit) -> tuple[Places, Shape | None]:
        assert isinstance(fit, Fit) and isinstance(own, Fit)
        if isinstance(fit, PlacedFit):
            return fit.places, None
        part = shape_of(fit)
        return Places.of(part, fit, own, threads), part.original

    (here, source), (there, target) = placed(first, before[0]), placed(second, before[1])
    found, back = build_map(here, there, threads), None
    if source is not None and target is not None:
        partial = _partial(first) or _partial(second)
        found, back = unfold_pair(found, lambda: build_map(there, here, threads), source, target, partial, threads)
        found, back = _repeat_for_copies(found, first), back and _repeat_for_copies(back, second)
    ups = [fit.up if isinstance(fit, Fit) else "" for fit in fits]
    return replace(found, source_up=ups[0], target_up=ups[1]), back


def _repeat_for_copies(found: VertexMap, fit: Fit | ImplicitFit) -> VertexMap:
    """The map with the images of a figure also for its copies elsewhere in the scene, whose folds were not removed."""
    part = fit.repaired if isinstance(fit, Fit) else None
    if part is None or part.copied is None:
        return found
    rows = np.where(part.copied, part.kept_vertex[part.original_to_repaired], np.arange(part.original.V))
    return replace(found, index=found.index[rows], face=found.face[rows], barycentric=found.barycentric[rows])


def _partial(fit: Fit | ImplicitFit) -> bool:
    return isinstance(fit, Fit) and fit.partial


def shape_of(fit: Fit) -> Repaired:
    """The repaired shape of a fit; `OptionError` if the fit does not contain it."""
    if fit.repaired is None:
        hint = "make it with meshmatch.register or Matcher.fit, or read it with meshmatch.load_fit"
        raise OptionError("this fit does not contain its shape", hint)
    return fit.repaired


@dataclass(frozen=True)
class ConfidenceRule:
    """What to do with transferred values of low confidence; by default they are kept.

    Attributes
    ----------
    minimum
        Confidence (0..1) below which a value counts as low.
    fill
        Replace low values by those of their neighbours.
    blank
        Replace low values by this number, numbers (one per column), color (sRGB, 0..1) or label.

    Raises
    ------
    OptionError
        Both ``fill`` and ``blank`` are given, or the minimum is outside 0..1.

    Examples
    --------
    >>> rule = meshmatch.ConfidenceRule(minimum=0.5, fill=True)
    >>> heights = meshmatch.load_shape("templates/samples/dancer.ply").verts[:, 1]
    >>> meshmatch.transfer_values("templates/samples/dancer.ply", "templates/samples/climber.ply", heights, rule=rule).low
    """

    minimum: float = 0.3
    fill: bool = False
    blank: float | str | Sequence[float] | None = None

    def __post_init__(self) -> None:
        if self.fill and self.blank is not None:
            raise OptionError("fill and blank contradict each other", "choose one of them")
        if not (is_number(self.minimum) and 0 <= self.minimum <= 1):
            raise OptionError(f"a confidence lies in 0..1, not {self.minimum!r}")


@dataclass(frozen=True, eq=False, repr=False)
class Transferred(ShortRepr, Generic[T]):
    """Attributes transferred to the target.

    Attributes
    ----------
    data
        The transferred attributes: an array, `Labels`, `SkinWeights`, `Landmarks` or `Measurements`.
    confidence
        (N,) float64 confidence of each vertex, face, landmark or measurement, from 0 (a guess) to 1 (certain).
    low
        The number of values of low confidence, and how they were handled.
    maps
        The maps that were used.
    writer
        Writes the file for `save`; called with a temporary path and the final path.

    Examples
    --------
    >>> moved = meshmatch.transfer_landmarks("templates/samples/dancer.ply", "templates/samples/climber.ply", [0, 100])
    >>> moved.data.points, moved.confidence
    >>> climber_to_dancer = moved.maps.backward
    """

    data: T
    confidence: Float[Floats, " N"]
    low: LowConfidence
    maps: MapPair
    writer: Callable[[Path, Path], None] = field(repr=False)

    def save(self, path: str | Path) -> None:
        """Write the transferred data, in the format of the suffix.

        Parameters
        ----------
        path
            The output file. Mesh formats contain the target with the data. Colors: .ply, .glb, .vrm (if the target is
            one), .obj, .off, .vtp or .vtk; .npy or .csv. Values: .ply, .vtp or .vtk; .npy or .csv. Labels: .ply or .vtp;
            .npy, .csv, .txt or .json. Skin weights: .npz or .json. Landmarks: .csv, .json, .pp, .fcsv, .mrk.json or .tps.
            Measurements: .csv or .json.

        Raises
        ------
        OptionError
            The suffix is not supported.
        OutputError
            The file cannot be written.
        """
        path = as_path(path)
        with replace_on_success(path) as temporary:
            self.writer(temporary, path)

    def _repr_html_(self) -> str:
        from meshmatch.api.notebook import map_html

        maps, low = self.maps, {"low confidence": f"{self.low.low:,} of {self.low.total:,} values"}
        return map_html("Transferred", maps.forward, (maps.source, maps.target), maps.rotations, low)


def evaluate(
    found: MatchResult | VertexMap | str | Path,
    source: ShapeLike,
    target: ShapeLike,
    truth: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    *,
    backward: VertexMap | str | Path | None = None,
    unit: UnitName = "auto",
    seed: int = 0,
    progress: ProgressCallback | None = None,
) -> Evaluation:
    """Evaluate a map: coverage, distortion, Dirichlet energy and folds, and errors if the ground truth is known.

    Errors are geodesic distances on the target, divided by the square root of its area. They are reported in the unit of
    its file, or for a person in centimetres, with the target scaled to 1.9 square metres of skin.

    Parameters
    ----------
    found
        A match, a map, or the path of a map.
    source
        As in `match`.
    target
        As in `match`.
    truth
        The true target vertex of every source vertex (V_source,), -1 if it has none; or corresponding vertices of source
        and target, as two arrays ((N,), (N,)) or as an array of pairs (N, 2).
    backward
        A map from target to source, or its path, to measure ``bijectivity``; for instance ``result.backward()`` of a match.
    unit
        Unit of errors: "cm" (target scaled to a person), "file" (the unit of the target's file), "x100" (hundredths of
        sqrt(area)), or "auto": "cm" if the model ``human`` recognises the target, else "file".
    seed
        Random seed for the pairs of points between which distortion is measured.
    progress
        As in `match`.

    Returns
    -------
    Evaluation
        The measurements; ``errors`` is None without the ground truth.

    Raises
    ------
    MeshmatchError
        The map or the ground truth belongs to other shapes or has an invalid type, or the unit is unknown.

    Examples
    --------
    >>> climber, dancer = "templates/samples/climber.ply", "templates/samples/dancer.ply"
    >>> found = meshmatch.match(climber, dancer)
    >>> print(meshmatch.evaluate(found, climber, dancer))
    """
    source, target = as_shape(source, "source"), as_shape(target, "target")
    if isinstance(found, str | Path):
        found = load_map(found, source, target)
    if isinstance(backward, str | Path):
        backward = load_map(backward, target, source)
    vertex_map = found.map if isinstance(found, MatchResult) else found
    for each in (vertex_map, *([] if backward is None else [backward])):
        check_map(each)
    known = truth if isinstance(truth, tuple) and len(truth) == 2 else (None, truth)
    if tuple(getattr(truth, "shape", ()))[1:] == (2,):
        first, second = np.asarray(to_numpy(truth)).T
        known = first, second
    check_seed(seed)
    rng = np.random.default_rng(seed)
    with thread_limit(1):
        # Finding out whether the target is a person takes a moment, and is not needed without errors to report.
        resolved = error_unit("cm" if truth is None and str(unit) == "auto" else unit, target)
        return evaluate_map(
            vertex_map, source, target, *known, backward=backward, unit=resolved, rng=rng, progress=progress
        )


def measure_distance(
    shape: ShapeLike, fitted: ShapeLike, *, one_way: bool = False, unit: UnitName = "auto"
) -> SurfaceDistance:
    """Measure the distance between the surfaces of a shape and of a mesh that was fitted to it.

    Distances are measured from every vertex of either shape to the nearest point of the other whose normal points the same
    way, weighted by the area around the vertex. If the shape is a point cloud, they are measured from its points alone.

    Parameters
    ----------
    shape
        As in `match`.
    fitted
        A mesh in the same frame and unit, such as ``fit.shape`` of `register`, `MatchResult.deformed_source` or
        ``shape`` of a `WrapResult`.
    one_way
        Measure only from the shape to the mesh, for a partial shape (``fit.partial``).
    unit
        As in `evaluate`, for the shape.

    Returns
    -------
    SurfaceDistance
        Mean and largest distance; ``str`` gives a readable sentence.

    Raises
    ------
    MeshmatchError
        A shape cannot be read or has no surface area, or the unit is unknown.

    Examples
    --------
    >>> fit = meshmatch.register("templates/samples/climber.ply")
    >>> print(meshmatch.measure_distance("templates/samples/climber.ply", fit.shape))
    """
    with thread_limit(1):
        there, here = (repair(as_shape(each, what)).shape for each, what in ((shape, "shape"), (fitted, "fitted")))
        if here.is_cloud:
            raise InputError(f"{here.name or 'what was fitted'} has no faces", "only the shape may be a point cloud")
        for each, what in ((there, "the shape"), (here, "what was fitted")):
            if not each.vertex_areas.sum() > 0:
                hint = "are all its points the same, or on a line?"
                raise InputError(f"{each.name or what} has no surface area", hint)
        resolved = error_unit(unit, there)
        factor = 1.0 if resolved.name == "file" else resolved.factor / float(np.sqrt(here.area))
        mean, largest = surface_distance(there, here, one_way)
        return SurfaceDistance(factor * mean, factor * largest, resolved)
