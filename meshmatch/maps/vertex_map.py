"""`VertexMap`, the map from the vertices of one shape to points on another."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, replace
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from meshmatch.arrays import (
    Bool,
    Bools,
    Float,
    Floats,
    Floats32,
    Int,
    Ints,
    PickledFields,
    SomeTensor,
    as_integers,
    as_numbers,
    set_read_only,
)
from meshmatch.errors import InputError
from meshmatch.fields.local_fits import product
from meshmatch.geometry.triangles import interpolate
from meshmatch.maps.indices import UNKNOWN as UNKNOWN
from meshmatch.maps.indices import check_faces, check_range, corners_of
from meshmatch.shapes.shape import Shape, checked_shape

DIRECTION = "index[i] is the vertex of the target matched to vertex i of the source"
VERDICTS = ("good", "fair", "poor", "unknown")
_UP_AXES = ("", "+x", "-x", "+y", "-y", "+z", "-z")
_OTHER_MESH_HINT = (
    "match these two again; a map needs one entry for each vertex of the source, in the order of its file, and one "
    "kept as .npy or .csv goes by the count of vertices alone"
)
_READ_WITH_SHAPES_HINT = "read it with load_map(path, source, target)"


@dataclass(frozen=True, eq=False)
class VertexMap(PickledFields):
    """A map from every vertex of a source to a target: *index[i] is the vertex of the target matched to vertex i of the
    source.*

    Checked when built; its arrays are read-only. `VertexMap.between` fills in names, counts and hashes from two shapes;
    `for_shapes` does so for a map that was read from a file.

    Attributes
    ----------
    source
        Name of the source, for display.
    target
        Name of the target, for display.
    index
        (V_source,) the target vertex of each source vertex.
    face
        (V_source,) the target face in which the matched point lies; -1 where it is the vertex itself, always for a
        cloud.
    barycentric
        (V_source, 3) weights of that face's corners: not negative, rows sum to 1, (1, 0, 0) where the face is -1.
    confidence
        (V_source,) float32 from 0 (a guess) to 1 (certain); all nan if it is not known, as in a map from elsewhere.
    verdict
        "good", "fair" or "poor", for the map as a whole; "unknown" if its file has none.
    reasons
        Why the verdict is not good, one line each.
    source_vertices
        Number of vertices of the source.
    target_vertices
        Number of vertices of the target; -1 where not known, as for a plain list of indices.
    source_hash
        `Shape.hash` of the source; empty where not known.
    target_hash
        `Shape.hash` of the target; empty where not known.
    source_up
        The axis of the source that was used as up, such as "+z"; empty where not known.
    target_up
        The axis of the target that was used as up; empty where not known.
    target_faces
        (F_target, 3) triangles whose corners ``barycentric`` weights; not written to files.

    Raises
    ------
    InputError
        An array has the wrong shape or type, an index lies outside the target, weights do not sum to 1, faces are given
        without weights or weights without faces, or the verdict or an axis is unknown.

    Examples
    --------
    >>> found = meshmatch.match("templates/samples/climber.ply", "templates/samples/dancer.ply").map
    >>> dancer = meshmatch.load_shape("templates/samples/dancer.ply")
    >>> heights = found.apply(dancer.verts[:, 1])  # (V_source,)
    """

    source: str
    target: str
    index: Int[Ints, " V_source"]
    _: KW_ONLY
    face: Int[Ints, " V_source"] = None  # type: ignore[assignment]  # an array once built
    barycentric: Float[Floats, "V_source 3"] = None  # type: ignore[assignment]
    confidence: Float[Floats32, " V_source"] = None  # type: ignore[assignment]
    verdict: str = "unknown"
    reasons: tuple[str, ...] = ()
    source_vertices: int = UNKNOWN
    target_vertices: int = UNKNOWN
    source_hash: str = ""
    target_hash: str = ""
    source_up: str = ""
    target_up: str = ""
    target_faces: Int[Ints, "F_target 3"] | None = None

    def __post_init__(self) -> None:
        label = f"the map {self.source or 'source'} -> {self.target or 'target'}"
        arrays = self._checked_arrays(label)
        size = len(arrays["index"])
        if self.source_vertices not in (UNKNOWN, size):
            raise InputError(f"{label} has {size} entries for {self.source_vertices} vertices of the source")
        if self.verdict not in VERDICTS:
            raise InputError(f"{label}: a verdict is one of {', '.join(VERDICTS)}, not '{self.verdict}'")
        for axis in (self.source_up, self.target_up):
            if axis not in _UP_AXES:
                raise InputError(f"{label}: up is one of {', '.join(_UP_AXES[1:])}, not '{axis[:20]}'")
        for name, array in arrays.items():
            object.__setattr__(self, name, set_read_only(array))
        if self.target_faces is not None:
            check_faces(self.face, len(self.target_faces), label)
        object.__setattr__(self, "reasons", tuple(str(reason) for reason in self.reasons))
        object.__setattr__(self, "source_vertices", size)

    @np.errstate(invalid="ignore")  # signaling nan; refused below
    def _checked_arrays(self, label: str) -> dict[str, NDArray[Any]]:
        """Return copies of the arrays, with defaults filled in; `InputError` if one is invalid."""
        vertex = as_integers(self.index, f"{label}: index")
        if vertex.ndim != 1 or (size := len(vertex)) == 0:
            raise InputError(f"{label}: index must be a list of (V_source,) vertices, not an array of {vertex.shape}")
        if self.target_vertices != UNKNOWN and self.target_vertices < 1:
            raise InputError(f"{label}: a target needs vertices, not {self.target_vertices}")
        check_range(vertex, self.target_vertices, label)
        faces = np.full(size, -1) if self.face is None else as_integers(self.face, f"{label}: face")
        weights_given = np.eye(1, 3).repeat(size, 0) if self.barycentric is None else self.barycentric
        weights = np.array(as_numbers(weights_given, f"{label}: barycentric"))
        confidence_given = np.full(size, np.nan) if self.confidence is None else self.confidence
        numbers = as_numbers(confidence_given, f"{label}: confidence")
        trust = np.clip(numbers, -1, 2).astype(np.float32)  # float32 cannot represent 1e300, which is refused below
        arrays: dict[str, NDArray[Any]] = {"index": vertex, "face": faces, "barycentric": weights, "confidence": trust}
        for name, array in arrays.items():
            shape = (size, 3) if name == "barycentric" else (size,)
            if array.shape != shape:
                raise InputError(f"{label}: {name} must be an array of {shape}, not {array.shape}")
        if faces.min() < -1:
            raise InputError(f"{label}: face {int(faces.min())} does not exist")
        if not (weights >= -1e-9).all() or not np.allclose(weights.sum(axis=1), 1.0, atol=1e-6):
            raise InputError(f"{label}: barycentric weights must be 0 or more and sum to 1")
        if self.barycentric is None and faces.max() >= 0:
            raise InputError(f"{label} names faces without barycentric weights", "give both, or the index alone")
        if self.face is None and (weights[:, 0] != 1).any():
            raise InputError(f"{label} has barycentric weights without faces", "give both, or the index alone")
        if not (((trust >= 0) & (trust <= 1)).all() or np.isnan(trust).all()):
            raise InputError(f"{label}: confidence must lie in 0..1; leave it out where it is not known")
        return arrays

    @classmethod
    def between(cls, source: Shape, target: Shape, index: ArrayLike, **rest: Any) -> VertexMap:
        """A map between two shapes in memory.

        Parameters
        ----------
        source
            Supplies the source's name, vertex count and hash.
        target
            Supplies the target's name, vertex count, hash and faces.
        index
            (V_source,) the target vertex of each source vertex.
        rest
            The other attributes: face, barycentric, confidence, verdict, reasons.

            For points within triangles, given by faces and weights, the index is usually the corner with the largest
            weight: ``target.faces[face, weights.argmax(1)]``. It may be another vertex, such as the nearest one, which
            need not be a corner. Errors of `evaluate` are measured at ``index``; `points`, `apply` and `functional` use
            faces and weights.

        Returns
        -------
        VertexMap
            The map, checked.

        Raises
        ------
        InputError
            As for the class, or the target lacks a face that the map names.
        """
        fields = _side_fields("source", source) | _side_fields("target", target)
        return cls(index=as_integers(index, "index"), target_faces=target.faces, **fields, **rest)

    @classmethod
    def identity(cls, shape: Shape) -> VertexMap:
        """The map of a shape to itself.

        Parameters
        ----------
        shape
            Source and target.

        Returns
        -------
        VertexMap
            Every vertex to itself, with confidence 1.

        Raises
        ------
        InputError
            ``shape`` is not a `Shape`.
        """
        index = np.arange(checked_shape(shape, "the shape").V)
        return cls.between(shape, shape, index, confidence=np.ones(len(index)), verdict="good")

    @property
    def assumed_confidence(self) -> Float[Floats32, " V_source"]:
        """(V_source,) the confidence, or 1 where it is not known: transfers rely on the map that they are given."""
        return np.nan_to_num(self.confidence, nan=1.0)

    def for_shapes(self, source: Shape | None, target: Shape | None, label: str = "the map") -> VertexMap:
        """Check that this map is from `source` to `target`, and fill in names, counts and hashes.

        Vertex counts must agree, and hashes where the map has them: a map for another pose, or for a mesh that was edited
        since, is refused. Results of transfers (`Shape.made_of`) accept the maps of the meshes that they were made from.

        Parameters
        ----------
        source
            The source; not checked if None.
        target
            The target; not checked if None.
        label
            Name of the map in error messages.

        Returns
        -------
        VertexMap
            The map with names, counts, hashes and faces filled in.

        Raises
        ------
        InputError
            The map was made for another mesh, runs from target to source, or names a vertex or a face that the target
            does not have.
        """
        sides = [(side, shape) for side, shape in (("source", source), ("target", target)) if shape is not None]
        misfits = [self._misfit(side, shape) for side, shape in sides]
        if source is not None and target is not None and any(misfits):
            reversed_fits = not self._misfit("source", target) and not self._misfit("target", source)
            if reversed_fits and self.index.max() < source.V:
                a, b = source.name or "the source", target.name or "the target"
                way = f"{label} runs the wrong way: from {b} to {a}, where one from {a} to {b} is needed"
                raise InputError(way, f"swap the two shapes, or match {a} to {b} ({DIRECTION})")
        for found in filter(None, misfits):
            raise InputError(f"{label} was made for another {found}", _OTHER_MESH_HINT)
        fill: dict[str, Any] = {} if target is None else {"target_faces": target.faces}
        for side, shape in sides:
            fill |= _side_fields(side, shape) | ({side: getattr(self, side)} if getattr(self, side) else {})
        try:
            return replace(self, **fill)
        except InputError as error:
            raise InputError(f"{label}: {error.message}", error.hint) from error

    def _misfit(self, side: str, shape: Shape) -> str:
        """How `shape` differs from the source or target ("side") that the map was made for; empty if it matches."""
        vertices, digest = getattr(self, f"{side}_vertices"), getattr(self, f"{side}_hash")
        made_for, name = getattr(self, side) or "a mesh", shape.name or f"the {side}"
        if digest in shape.made_of and (vertices == shape.V or (side == "target" and vertices < shape.V)):
            return ""
        if vertices not in (UNKNOWN, shape.V):
            return f"{side}: {made_for} of {vertices} vertices, but {name} has {shape.V}"
        if digest not in ("", shape.hash):
            return f"{side}: {made_for} ({digest}), but {name} is {shape.hash}: vertices or faces differ"
        return ""

    @property
    def on_vertex(self) -> Bool[Bools, " V_source"]:
        """True where the matched point is a vertex of the target."""
        return np.asarray((self.face < 0) | (self.barycentric.max(axis=1) >= 1.0 - 1e-12))

    def corners(self) -> Int[Ints, "V_source 3"]:
        """The three target vertices that ``barycentric`` weights.

        Returns
        -------
        (V_source, 3) int64
            Three times ``index`` where the face is -1.

        Raises
        ------
        InputError
            Points lie in faces that are not known: the map was read without its target.
        """
        if self.target_faces is None and self.face.max() >= 0:
            raise InputError(f"the faces that the map {_arrow(self)} leads to are unknown", _READ_WITH_SHAPES_HINT)
        return corners_of(self.target_faces, self.face, self.index)

    def points(self, target: Shape) -> Float[Floats, "V_source 3"]:
        """The matched points on `target`.

        Parameters
        ----------
        target
            The map's target; another pose of it with the same faces will do.

        Returns
        -------
        (V_source, 3) float64
            In the target's frame and unit.

        Raises
        ------
        InputError
            The vertices or faces of `target` are not those of the map's target.
        """
        if self.target_vertices not in (UNKNOWN, checked_shape(target, "the target").V):
            led = f"the map leads to {self.target} with {self.target_vertices} vertices"
            raise InputError(f"{led}, but {target.name or 'the target'} has {target.V}")
        check_range(self.index, target.V, f"the map {_arrow(self)}")
        check_faces(self.face, target.F, f"the map {_arrow(self)}")
        return interpolate(target.verts, corners_of(target.faces, self.face, self.index), self.barycentric)

    def sparse(self) -> csr_array:
        """The map as a matrix P: ``P @ values`` is `apply`.

        Returns
        -------
        (V_source, V_target) csr_array, float64
            Rows sum to 1.

        Raises
        ------
        InputError
            The map was read without its target, whose vertices or faces are unknown.
        """
        if self.target_vertices == UNKNOWN:
            what = f"the number of vertices that the map {_arrow(self)} leads to is unknown"
            raise InputError(what, _READ_WITH_SHAPES_HINT)
        weight = self.barycentric.ravel()
        kept = weight > 0
        places = np.repeat(np.arange(self.source_vertices), 3)[kept], self.corners().ravel()[kept]
        matrix = csr_array((weight[kept], places), shape=(self.source_vertices, self.target_vertices))
        matrix.sum_duplicates()
        return matrix

    @overload
    def apply(self, values: SomeTensor) -> SomeTensor: ...
    @overload
    def apply(self, values: ArrayLike) -> Floats: ...
    def apply(self, values: ArrayLike | SomeTensor) -> Any:
        """Pull values of the *target's* vertices back to the source, interpolated within the target's faces.

        Parameters
        ----------
        values
            (V_target,) or (V_target, D).

        Returns
        -------
        (V_source,) or (V_source, D) float64
            The value at the matched point of each source vertex; for a tensor, a tensor of its kind, with gradients.

        Raises
        ------
        InputError
            As for `sparse`, or the number of rows is not the number of the target's vertices.
        """
        numbers = as_numbers(values, "values")
        matrix = self.sparse()
        if numbers.ndim not in (1, 2) or len(numbers) != matrix.shape[1]:
            needed = f"values (V,) or (V, D) of the {matrix.shape[1]} vertices of its target"
            raise InputError(f"the map {_arrow(self)} needs {needed}, not an array of {numbers.shape}")
        return product(matrix, values)

    def functional(
        self, basis_source: ArrayLike, basis_target: ArrayLike, mass: ArrayLike | None = None
    ) -> Float[Floats, "K_source K_target"]:
        """The functional map C of this map (Ovsjanikov et al. 2012), which goes the other way: it takes coefficients of
        a function on the *target* to those of the pulled-back function on the *source*.

        ``basis_source @ C`` is the least-squares fit to ``apply(basis_target)``. With the vertex areas of the source as
        ``mass`` this is the definition of the literature, and pyFM's for points within triangles. `map_from_functional`
        is the inverse.

        Parameters
        ----------
        basis_source
            (V_source, K_source) linearly independent functions, such as Laplacian eigenvectors, one per column.
        basis_target
            (V_target, K_target), the same on the target.
        mass
            (V_source,) positive weights of the source's vertices; equal by default.

        Returns
        -------
        (K_source, K_target) float64
            C.

        Raises
        ------
        InputError
            As for `apply`; or the rows of the source's basis or masses are not one for each vertex, a value is not finite,
            or a mass is not positive.
        """
        basis = as_numbers(basis_source, "a basis", finite=True)
        V = self.source_vertices
        if basis.ndim != 2 or len(basis) != V:
            raise InputError(f"a basis of the source must be an array of ({V}, K), not {basis.shape}")
        pulled = self.apply(as_numbers(basis_target, "a basis", finite=True)).reshape(len(basis), -1)
        if mass is not None:
            areas = as_numbers(mass, "the masses", finite=True)
            if areas.shape != (V,) or not (areas > 0).all():
                raise InputError(f"the masses must be {V} positive numbers, one for each vertex of the source")
            root = np.sqrt(areas)[:, None]
            basis, pulled = root * basis, root * pulled
        return np.asarray(np.linalg.lstsq(basis, pulled, rcond=None)[0])

    def compose(self, other: VertexMap) -> VertexMap:
        """Compose this map with `other`: first this map, then `other`.

        The image of vertex i is that of the vertex ``index[i]`` under `other`. The confidence is the lower of the two, and
        unknown if either is; the verdict is the worse of the two.

        Parameters
        ----------
        other
            A map that starts where this one ends.

        Returns
        -------
        VertexMap
            From this source to the other's target.

        Raises
        ------
        InputError
            `other` is not a map, or does not start on the shape where this one ends.
        """
        check_map(other)
        counts = {self.target_vertices, other.source_vertices} - {UNKNOWN}
        hashes = {self.target_hash, other.source_hash} - {""}
        if len(counts) > 1 or len(hashes) > 1:
            ends = _describe(self.target, self.target_vertices, self.target_hash)
            starts = _describe(other.source, other.source_vertices, other.source_hash)
            backwards = ends == _describe(other.target, other.target_vertices, other.target_hash)
            what = f"cannot join {_arrow(self)} with {_arrow(other)}: the first ends on {ends}, the second starts on"
            hint = "the second runs the wrong way round" if backwards else "the first must end where the second starts"
            raise InputError(f"{what} {starts}", hint)
        check_range(self.index, other.source_vertices, _arrow(self))
        worse = max(self.verdict, other.verdict, key=("good", "fair", "unknown", "poor").index)
        return replace(
            other,
            source=self.source,
            index=other.index[self.index],
            face=other.face[self.index],
            barycentric=other.barycentric[self.index],
            confidence=np.minimum(self.confidence, other.confidence[self.index]),
            verdict=worse,
            reasons=tuple(dict.fromkeys(self.reasons + other.reasons)),
            source_vertices=self.source_vertices,
            source_hash=self.source_hash,
            source_up=self.source_up,
        )

    def __repr__(self) -> str:
        target = "?" if self.target_vertices == UNKNOWN else self.target_vertices
        return f"VertexMap({_arrow(self)}, {self.source_vertices} -> {target} vertices, {self.verdict})"


def check_map(found: object) -> None:
    """Raise `InputError` if ``found`` is not a `VertexMap`."""
    if not isinstance(found, VertexMap):
        hint = "pass a VertexMap: a MatchResult has one as .map, and VertexMap.between makes one of an index"
        raise InputError(f"{type(found).__name__} is not a map", hint)


def _side_fields(side: str, shape: Shape) -> dict[str, Any]:
    return {side: checked_shape(shape, f"the {side}").name, f"{side}_vertices": shape.V, f"{side}_hash": shape.hash}


def _arrow(m: VertexMap) -> str:
    return f"{m.source or '?'} -> {m.target or '?'}"


def _describe(name: str, vertices: int, digest: str) -> str:
    count = "vertices unknown" if vertices == UNKNOWN else f"{vertices} vertices"
    return f"{name or '?'} ({count}{', ' + digest if digest else ''})"
