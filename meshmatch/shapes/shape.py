"""The two nouns of this room: a shape, and the way back to its own coordinates."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from meshmatch.errors import InputError

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Shape:
    """A triangle mesh, or a point cloud if it has no faces. Valid once built; its arrays are read-only.

    Parameters
    ----------
    verts : (V, 3) float64
        Positions in the file's own frame and unit. Always finite.
    faces : (F, 3) int64
        Corners of each triangle; (0, 3) for a cloud.
    name : str
        For people: usually the file's name without its folder.
    colors : (V, 4) float64, optional
        Red, green, blue as screens show them (sRGB), and alpha, in 0..1; whatever the file has.
    invalid : (V,) bool, optional
        True for a vertex whose position in the file was not a number. Such a vertex keeps its place in the
        order (the map answers for it too) but its `verts` row is only a stand-in, and faces that touch it
        have no area.

    Raises
    ------
    InputError
        Wrong array shapes, no vertices, a position that is not finite, or a face that names no vertex.
    """

    verts: Floats
    faces: Ints
    name: str = ""
    colors: Floats | None = None
    invalid: NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        label = self.name or "the shape"
        verts = _read_only(self.verts, np.float64, label)
        faces = self.faces
        faces = np.empty((0, 3), np.int64) if faces is None or np.size(faces) == 0 else faces
        if np.asarray(faces).dtype.kind not in "iu":
            raise InputError(f"{label}: faces must be integers, not {np.asarray(faces).dtype}")
        faces = _read_only(faces, np.int64, label)
        if verts.ndim != 2 or verts.shape[1] != 3:
            raise InputError(f"{label}: vertices must be an array of (V, 3), not {verts.shape}")
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise InputError(f"{label}: faces must be an array of (F, 3), not {faces.shape}")
        if len(verts) == 0:
            raise InputError(f"{label} has no vertices")
        if not np.isfinite(verts).all():
            raise InputError(
                f"{label}: some vertex positions are not finite",
                "load it with load_shape, which marks them invalid",
            )
        if len(faces) and (faces.min() < 0 or faces.max() >= len(verts)):
            worst = int(faces.min()) if faces.min() < 0 else int(faces.max())
            raise InputError(
                f"{label}: a face names vertex {worst}, but there are only {len(verts)} vertices",
                "the file is damaged, or was cut short",
            )
        object.__setattr__(self, "verts", verts)
        object.__setattr__(self, "faces", faces)
        if self.colors is not None:
            colors = _read_only(self.colors, np.float64, label)
            if colors.shape != (len(verts), 4):
                raise InputError(f"{label}: colors must be an array of ({len(verts)}, 4), not {colors.shape}")
            object.__setattr__(self, "colors", colors)
        if self.invalid is not None:
            invalid = _read_only(self.invalid, np.bool_, label)
            if invalid.shape != (len(verts),):
                raise InputError(f"{label}: invalid must be an array of ({len(verts)},), not {invalid.shape}")
            object.__setattr__(self, "invalid", invalid if invalid.any() else None)

    @property
    def V(self) -> int:
        """Number of vertices."""
        return len(self.verts)

    @property
    def F(self) -> int:
        """Number of triangles; 0 for a cloud."""
        return len(self.faces)

    @property
    def is_cloud(self) -> bool:
        """True if there are no faces."""
        return len(self.faces) == 0

    @cached_property
    def face_vectors(self) -> Floats:
        """(F, 3) normal of each face, twice its area long; 0 where a corner is invalid."""
        a, b, c = (self.verts[self.faces[:, k]] for k in range(3))
        vectors = cross_product(b - a, c - a)
        if self.invalid is not None:
            vectors[self.invalid[self.faces].any(axis=1)] = 0.0
        return vectors

    @cached_property
    def face_areas(self) -> Floats:
        """(F,) areas, squared units of the file."""
        return _frozen(0.5 * np.sqrt(squared_lengths(self.face_vectors)))

    @cached_property
    def face_normals(self) -> Floats:
        """(F, 3) unit normals by the right-hand rule; zeros for a face without area."""
        return _frozen(_unit(self.face_vectors))

    @cached_property
    def vertex_areas(self) -> Floats:
        """(V,) share of the surface around each vertex: a third of its faces; a cloud's are estimated."""
        if self.is_cloud:
            from meshmatch.shapes.cloud import local_areas

            return _frozen(local_areas(self.verts, self.invalid))
        thirds = np.repeat(self.face_areas / 3.0, 3)
        return _frozen(np.bincount(self.faces.ravel(), weights=thirds, minlength=self.V))

    @cached_property
    def vertex_normals(self) -> Floats:
        """(V, 3) unit normals, the area-weighted mean of the faces around; zeros where there is none.

        A cloud's are estimated from its neighbourhoods and turned outwards as far as that can be told.
        """
        if self.is_cloud:
            from meshmatch.shapes.cloud import estimate_normals

            return _frozen(estimate_normals(self.verts, self.invalid))
        corners = self.faces.ravel()
        sums = np.empty((self.V, 3))
        for axis in range(3):
            weights = np.repeat(self.face_vectors[:, axis], 3)
            sums[:, axis] = np.bincount(corners, weights=weights, minlength=self.V)
        return _frozen(_unit(sums))

    @cached_property
    def area(self) -> float:
        """Surface area, squared units of the file; a cloud's is estimated from its density."""
        return float(self.vertex_areas.sum() if self.is_cloud else self.face_areas.sum())

    @cached_property
    def roughness(self) -> float:
        """How noisy a cloud is, 0..1 (see `cloud.roughness`); 0 for a mesh, whose faces say what lies where."""
        if not self.is_cloud:
            return 0.0
        from meshmatch.shapes.cloud import roughness

        return roughness(self.verts, self.invalid)

    @cached_property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the box around the valid vertices."""
        verts = self.verts if self.invalid is None else self.verts[~self.invalid]
        if len(verts) == 0:
            verts = self.verts
        return _frozen(np.stack([verts.min(axis=0), verts.max(axis=0)]))

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, units of the file."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @cached_property
    def hash(self) -> str:
        """16 hexadecimal digits that name this geometry (sha256 of the bytes of verts, then of faces)."""
        digest = hashlib.sha256(self.verts.data)
        digest.update(self.faces.data if len(self.faces) else b"")
        return digest.hexdigest()[:16]

    def __repr__(self) -> str:
        kind = "cloud" if self.is_cloud else f"{self.F} faces"
        return f"Shape({self.name!r}, {self.V} vertices, {kind})"


@dataclass(frozen=True, eq=False)
class Frame:
    """A similarity: the way from a file's own coordinates into a model's, and back.

    Parameters
    ----------
    scale : float
        Length in the file that becomes 1. Positive.
    rotation : (3, 3) float64
        Applied after centring; orthonormal, determinant +1.
    center : (3,) float64
        The file's point that becomes the origin.
    """

    scale: float
    rotation: Floats
    center: Floats

    def __post_init__(self) -> None:
        rotation = _read_only(self.rotation, np.float64, "a frame's rotation")
        center = _read_only(self.center, np.float64, "a frame's center")
        if rotation.shape != (3, 3) or center.shape != (3,):
            raise InputError(
                f"a frame needs a (3, 3) rotation and a (3,) center, not {rotation.shape}, {center.shape}"
            )
        if not (np.isfinite(self.scale) and self.scale > 0 and np.isfinite(center).all()):
            raise InputError(
                f"a frame's scale must be positive and finite, not {self.scale}", "has the shape any size?"
            )
        proper = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) and np.linalg.det(rotation) > 0
        if not proper:
            raise InputError("a frame's rotation must be orthonormal with determinant +1")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "center", center)

    @classmethod
    def identity(cls) -> "Frame":
        """The frame that changes nothing."""
        return cls(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: ArrayLike) -> Floats:
        """Points (..., 3) of the file, in the model's frame: ``((points - center) @ rotation.T) / scale``."""
        return ((np.asarray(points, np.float64) - self.center) @ self.rotation.T) / self.scale

    def undo(self, points: ArrayLike) -> Floats:
        """Points (..., 3) of the model's frame, back in the file's."""
        return (np.asarray(points, np.float64) * self.scale) @ self.rotation + self.center

    def apply_vectors(self, vectors: ArrayLike) -> Floats:
        """Displacements (..., 3) of the file, in the model's frame: turned and scaled, not moved."""
        return (np.asarray(vectors, np.float64) @ self.rotation.T) / self.scale

    def undo_vectors(self, vectors: ArrayLike) -> Floats:
        """Displacements (..., 3) of the model's frame, back in the file's."""
        return (np.asarray(vectors, np.float64) * self.scale) @ self.rotation

    def compose(self, outer: "Frame") -> "Frame":
        """This frame first, then `outer`: ``self.compose(outer).apply(x) = outer.apply(self.apply(x))``."""
        return Frame(self.scale * outer.scale, outer.rotation @ self.rotation, self.undo(outer.center))


def cross_product(a: Floats, b: Floats) -> Floats:
    """(N, 3) a x b, column by column: three times as fast as `numpy.cross` on long arrays."""
    out = np.empty_like(a)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[:, i] = a[:, j] * b[:, k] - a[:, k] * b[:, j]
    return out


def squared_lengths(vectors: Floats) -> Floats:
    """(N,) squared length of each row."""
    return np.asarray(np.einsum("ni,ni->n", vectors, vectors))


def _read_only(values: Any, dtype: type, label: str) -> NDArray[Any]:
    """An own, contiguous, read-only array; one that is all of this already is shared, not copied."""
    if isinstance(values, np.ndarray) and values.dtype == dtype and values.base is None:
        shareable = values.flags.c_contiguous and not values.flags.writeable
        if shareable:
            return values
    try:
        array: NDArray[Any] = np.array(values, dtype=dtype, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{label}: not an array of numbers ({error})") from error
    return _frozen(array)


def _frozen(array: NDArray[Any]) -> NDArray[Any]:
    array.setflags(write=False)
    return array


def _unit(vectors: Floats) -> Floats:
    lengths = np.sqrt(squared_lengths(vectors))
    return vectors / np.where(lengths > 0, lengths, 1.0)[:, None]
