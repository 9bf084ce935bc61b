"""The noun of this room: where every vertex of one shape lies on another."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.shape import Shape

DIRECTION = "index[i] is the vertex of the target matched to vertex i of the source"
VERDICTS = ("good", "fair", "poor", "unknown")
UNKNOWN = -1


@dataclass(frozen=True, eq=False)
class VertexMap:
    """A map from every vertex of a source to a target: *index[i] is the vertex of the target matched to
    vertex i of the source.*

    Valid once built; its arrays are read-only. `VertexMap.between` fills in names, counts and hashes from two
    shapes.

    Parameters
    ----------
    source, target : str
        Names of the two shapes, for people.
    index : (V_src,) int64
        Target vertex of each source vertex.
    face : (V_src,) int64, optional
        Target face in which the matched point lies; -1 where it is the vertex ``index[i]`` itself (always for
        a cloud).
    barycentric : (V_src, 3) float64, optional
        Weights of that face's corners: not negative, rows sum to 1. (1, 0, 0) where the face is -1.
    confidence : (V_src,) float32, optional
        0 (a guess) to 1 (sure). All 1 where nothing is known about it (see `verdict`).
    verdict : str
        "good", "fair" or "poor", of the map as a whole; "unknown" if it was read from a file that does not
        say.
    reasons : tuple of str
        Why it is not good, a line each.
    source_vertices, target_vertices : int
        Vertex counts; -1 for a target's that is not known (a bare list of indices does not tell).
    source_hash, target_hash : str
        `Shape.hash` of both; empty where not known.

    Raises
    ------
    InputError
        Arrays of the wrong shape or kind, an index outside the target, weights that do not sum to 1, or a
        verdict that is none.
    """

    source: str
    target: str
    index: NDArray[np.int64]
    face: NDArray[np.int64] = None  # type: ignore[assignment]  # an array once built
    barycentric: NDArray[np.float64] = None  # type: ignore[assignment]
    confidence: NDArray[np.float32] = None  # type: ignore[assignment]
    verdict: str = "unknown"
    reasons: tuple[str, ...] = ()
    source_vertices: int = UNKNOWN
    target_vertices: int = UNKNOWN
    source_hash: str = ""
    target_hash: str = ""

    def __post_init__(self) -> None:
        label = f"the map {self.source or 'source'} -> {self.target or 'target'}"
        index = _integers(self.index, f"{label}: index")
        size = len(index)
        if index.ndim != 1 or size == 0:
            raise InputError(
                f"{label}: index must be a list of (V_src,) vertices, not an array of {index.shape}"
            )
        if self.source_vertices not in (UNKNOWN, size):
            raise InputError(f"{label} has {size} entries for {self.source_vertices} vertices of the source")
        if self.target_vertices != UNKNOWN and self.target_vertices < 1:
            raise InputError(f"{label}: a target needs vertices, not {self.target_vertices}")
        _in_range(index, self.target_vertices, label)

        face = np.full(size, -1) if self.face is None else _integers(self.face, f"{label}: face")
        if self.barycentric is None:
            weights = np.zeros((size, 3))
            weights[:, 0] = 1.0
        else:
            weights = np.array(self.barycentric, dtype=np.float64)
        confidence = np.ones(size) if self.confidence is None else np.asarray(self.confidence)
        confidence = np.array(confidence, dtype=np.float32)
        for name, array, shape in (
            ("face", face, (size,)),
            ("barycentric", weights, (size, 3)),
            ("confidence", confidence, (size,)),
        ):
            if array.shape != shape:
                raise InputError(f"{label}: {name} must be an array of {shape}, not {array.shape}")
        if face.min() < -1:
            raise InputError(f"{label}: face {int(face.min())} does not exist")
        if not (weights >= -1e-9).all() or not np.allclose(weights.sum(axis=1), 1.0, atol=1e-6):
            raise InputError(f"{label}: barycentric weights must be 0 or more and sum to 1")
        if not ((confidence >= 0) & (confidence <= 1)).all():
            raise InputError(f"{label}: confidence must lie in 0..1")
        if self.verdict not in VERDICTS:
            raise InputError(f"{label}: a verdict is one of {', '.join(VERDICTS)}, not '{self.verdict}'")

        for name, array in (
            ("index", index),
            ("face", face),
            ("barycentric", weights),
            ("confidence", confidence),
        ):
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "reasons", tuple(str(reason) for reason in self.reasons))
        object.__setattr__(self, "source_vertices", size)

    @classmethod
    def between(cls, source: Shape, target: Shape, index: ArrayLike, **rest: Any) -> "VertexMap":
        """A map between two shapes at hand; `rest` are the other fields (face, barycentric, confidence,
        verdict, ...).

        Raises
        ------
        InputError
            As `VertexMap`, or a face that the target does not have.
        """
        made = cls(
            source=source.name,
            target=target.name,
            index=np.asarray(index),
            source_vertices=source.V,
            target_vertices=target.V,
            source_hash=source.hash,
            target_hash=target.hash,
            **rest,
        )
        made.check_faces(target)
        return made

    @classmethod
    def identity(cls, shape: Shape) -> "VertexMap":
        """Every vertex to itself, surely."""
        return cls.between(shape, shape, np.arange(shape.V), verdict="good")

    def check_faces(self, target: Shape) -> None:
        """Refuse faces that `target` does not have (`InputError`)."""
        highest = int(self.face.max())
        if highest >= target.F:
            raise InputError(
                f"the map {_way(self)} names face {highest}, but {target.name or 'the target'} "
                f"has only {target.F} faces"
            )

    def points(self, target: Shape) -> NDArray[np.float64]:
        """The matched points ``(V_src, 3)`` on `target`, in its own frame.

        Raises
        ------
        InputError
            `target` is not the shape that this map leads to.
        """
        if self.target_vertices not in (UNKNOWN, target.V):
            raise InputError(
                f"the map leads to {self.target} with {self.target_vertices} vertices, "
                f"but {target.name or 'the target'} has {target.V}"
            )
        _in_range(self.index, target.V, f"the map {_way(self)}")
        self.check_faces(target)
        points = target.verts[self.index]
        inside = self.face >= 0
        corners = target.verts[target.faces[self.face[inside]]]
        points[inside] = np.einsum("nk,nki->ni", self.barycentric[inside], corners)
        return points

    def compose(self, other: "VertexMap") -> "VertexMap":
        """This map, then `other`: from this source to the other's target.

        The point of a vertex is where `other` puts the vertex ``index[i]``; the confidence is the lower of
        the two, the verdict the worse.

        Raises
        ------
        InputError
            `other` does not start on the shape where this one ends.
        """
        counts = {self.target_vertices, other.source_vertices} - {UNKNOWN}
        hashes = {self.target_hash, other.source_hash} - {""}
        if len(counts) > 1 or len(hashes) > 1:
            ends = _named(self.target, self.target_vertices, self.target_hash)
            starts = _named(other.source, other.source_vertices, other.source_hash)
            backwards = ends == _named(other.target, other.target_vertices, other.target_hash)
            raise InputError(
                f"cannot join {_way(self)} with {_way(other)}: the first ends on {ends}, "
                f"the second starts on {starts}",
                "the second runs the wrong way round"
                if backwards
                else "the first must end where the second starts",
            )
        _in_range(self.index, other.source_vertices, _way(self))
        worse = max(self.verdict, other.verdict, key=("good", "fair", "unknown", "poor").index)
        return VertexMap(
            source=self.source,
            target=other.target,
            index=other.index[self.index],
            face=other.face[self.index],
            barycentric=other.barycentric[self.index],
            confidence=np.minimum(self.confidence, other.confidence[self.index]),
            verdict=worse,
            reasons=tuple(dict.fromkeys(self.reasons + other.reasons)),
            source_vertices=self.source_vertices,
            target_vertices=other.target_vertices,
            source_hash=self.source_hash,
            target_hash=other.target_hash,
        )

    def __repr__(self) -> str:
        target = "?" if self.target_vertices == UNKNOWN else self.target_vertices
        return f"VertexMap({_way(self)}, {self.source_vertices} -> {target} vertices, {self.verdict})"


def _way(m: VertexMap) -> str:
    return f"{m.source or '?'} -> {m.target or '?'}"


def _named(name: str, vertices: int, digest: str) -> str:
    count = "vertices unknown" if vertices == UNKNOWN else f"{vertices} vertices"
    return f"{name or '?'} ({count}{', ' + digest if digest else ''})"


def _in_range(index: NDArray[np.int64], target_vertices: int, label: str) -> None:
    if index.min() < 0:
        raise InputError(
            f"{label}: vertex {int(np.argmin(index))} is matched to {int(index.min())}; indices start at 0"
        )
    if target_vertices != UNKNOWN and index.max() >= target_vertices:
        one_based = index.min() >= 1 and index.max() == target_vertices
        raise InputError(
            f"{label}: vertex {int(np.argmax(index))} is matched to vertex {int(index.max())}, "
            f"but the target has only {target_vertices} vertices",
            "it looks 1-based: subtract 1"
            if one_based
            else "is it a map to another shape, or the other way round?",
        )


def _integers(values: ArrayLike, label: str) -> NDArray[np.int64]:
    array = np.asarray(values)
    if array.dtype.kind == "f" and np.isfinite(array).all() and (array == np.round(array)).all():
        return array.astype(np.int64)  # MATLAB's numbers are doubles
    if array.dtype.kind not in "iu":
        raise InputError(f"{label} must be whole numbers, not {array.dtype}")
    return np.array(array, dtype=np.int64)
