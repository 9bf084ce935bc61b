"""Shapes: triangle meshes and point clouds, with derived quantities."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints, PickledFields, as_read_only, set_read_only, to_numpy
from meshmatch.errors import InputError
from meshmatch.geometry import triangles
from meshmatch.geometry.triangles import areas_to_vertices, average_normals, squared_lengths, triangle_vectors
from meshmatch.shapes.cloud import estimate_normals, local_areas, roughness

if TYPE_CHECKING:
    from trimesh import Trimesh

LARGEST = 1e60
"""Positions from this size on are invalid: squared areas must not overflow."""


@dataclass(frozen=True, eq=False)
class Shape(PickledFields):
    """A triangle mesh, or a point cloud if it has no faces. It is validated on construction; its arrays are read-only.

    Attributes
    ----------
    verts
        (V, 3) positions in the file's own frame and unit, always finite.
    faces
        (F, 3) corners of each triangle; (0, 3) for a cloud.
    name
        For messages: usually the file's name without its folder.
    colors
        (V, 4) red, green, blue (sRGB) and alpha in 0..1, whatever the file stores.
    invalid
        (V,) True for a vertex whose position in the file was not finite. It keeps its place in the order (maps answer
        for it too), but its ``verts`` row is a stand-in, and faces that touch it have no area.
    weights
        (V,) how far a fit trusts each vertex, from 0 (not at all) to 1; fully by default.
    skinned
        (V,) True for a vertex that joints of its file move: parts with such a vertex are never dropped as outliers.
    upright
        Whether its file format defines y as up and z as front, as glTF does. A fit tries that orientation first.
    made_of
        Hashes of meshes whose vertices are the first ones of this shape, in their order, with the same triangles, for a
        file that a transfer made of them. Maps to one of these are maps to this shape too.
    meshes
        Name and number of vertices of each mesh of its scene, or label of its label map, in the order of the vertices.

    Raises
    ------
    InputError
        Wrong array shapes, no vertices, a position that is not finite, or a face with an invalid vertex index.

    Examples
    --------
    >>> triangle = meshmatch.Shape(np.eye(3), np.array([[0, 1, 2]]), "triangle")
    >>> triangle.V, triangle.F, triangle.is_cloud
    >>> meshmatch.save_shape("triangle.ply", triangle)
    """

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    name: str = ""
    colors: Float[Floats, "V 4"] | None = None
    invalid: Bool[Bools, " V"] | None = None
    weights: Float[Floats, " V"] | None = None
    skinned: Bool[Bools, " V"] | None = None
    upright: bool = False
    made_of: tuple[str, ...] = ()
    meshes: tuple[tuple[str, int], ...] = ()

    def __post_init__(self) -> None:
        label = self.name or "the shape"
        verts = as_read_only(self.verts, np.float64, label)
        given = np.asarray([] if self.faces is None else to_numpy(self.faces))
        if given.size and given.dtype.kind not in "iu":
            raise InputError(f"{label}: faces must be integers, not {given.dtype}")
        faces = as_read_only(given if given.size else np.empty((0, 3)), np.int64, label)
        if verts.ndim != 2 or verts.shape[1] != 3:
            raise InputError(f"{label}: vertices must be an array of (V, 3), not {verts.shape}")
        if faces.ndim != 2 or faces.shape[1] != 3:
            hint = "each names three vertices, from 0"
            raise InputError(f"{label}: faces must be an array of (F, 3), not {faces.shape}", hint)
        V = len(verts)
        if V == 0:
            raise InputError(f"{label} has no vertices")
        if not np.isfinite(verts).all():
            problem = f"{label}: some vertex positions are not finite"
            raise InputError(problem, "load it with load_shape, which marks them invalid")
        if len(faces) and (faces.min() < 0 or faces.max() >= V):
            invalid_index = int(faces.min()) if faces.min() < 0 else int(faces.max())
            problem = f"{label}: a face refers to vertex {invalid_index}, but there are only {V} vertices"
            raise InputError(problem, "the file is damaged, or was cut short")
        object.__setattr__(self, "verts", verts)
        object.__setattr__(self, "faces", faces)
        specifications = {"colors": (np.float64, (V, 4)), "invalid": (np.bool_, (V,)), "weights": (np.float64, (V,))}
        specifications["skinned"] = (np.bool_, (V,))
        for name, (dtype, shape) in specifications.items():
            if (values := getattr(self, name)) is not None:
                array = as_read_only(values, dtype, label)
                if array.shape != shape:
                    raise InputError(f"{label}: {name} must be an array of {shape}, not {array.shape}")
                object.__setattr__(self, name, array)
        if self.invalid is not None and not self.invalid.any():
            object.__setattr__(self, "invalid", None)
        if self.weights is not None and not ((self.weights >= 0) & (self.weights <= 1)).all():
            raise InputError(f"{label}: weights must lie in 0 to 1", "one for each vertex")

    @classmethod
    def with_invalid(
        cls, verts: Float[Floats, "V 3"], faces: Int[Ints, "F 3"], name: str, colors: Float[Floats, "V 4"] | None = None
    ) -> Shape:
        """A shape from positions that may be NaN or infinite.

        Such positions are marked in ``invalid``, and moved to the centroid of the others.

        Parameters
        ----------
        verts
            (V, 3), file frame and unit.
        faces
            (F, 3).
        name
            For messages.
        colors
            (V, 4), sRGB and alpha in 0..1.

        Returns
        -------
        Shape
            With all vertices, in order.

        Raises
        ------
        InputError
            As for the class; or no position is finite.
        """
        if len(verts) == 0:
            raise InputError(f"{name or 'the shape'} holds no vertices", "is it a mesh or a point cloud at all?")
        usable = np.asarray((np.abs(verts) < LARGEST).all(axis=1))
        if usable.all():
            return cls(verts, faces, name, colors)
        if not usable.any():
            raise InputError(
                f"{name or 'the shape'}: no vertex has a usable position",
                f"all are NaN, or beyond {LARGEST:.0e}: export it again",
            )
        verts = verts.copy()
        verts[~usable] = verts[usable].mean(axis=0)
        return cls(verts, faces, name, colors, ~usable)

    @property
    def verts_or_nan(self) -> Float[Floats, "V 3"]:
        """Positions for writing to a file: NaN where a vertex is invalid."""
        return self.verts if self.invalid is None else np.where(self.invalid[:, None], np.nan, self.verts)

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
        """Whether there are no faces."""
        return len(self.faces) == 0

    @property
    def valid(self) -> Bool[Bools, " V"]:
        """(V,) whether each vertex has a position."""
        return np.ones(self.V, bool) if self.invalid is None else ~self.invalid

    @property
    def valid_faces(self) -> Bool[Bools, " F"]:
        """(F,) whether all corners of a face have a position."""
        return np.asarray(self.valid[self.faces].all(axis=1))

    @cached_property
    def on_surface(self) -> Bool[Bools, " V"]:
        """(V,) whether a vertex belongs to a valid face; without such faces, as in a cloud, whether it has a position."""
        used = np.bincount(self.faces[self.valid_faces].ravel(), minlength=self.V) > 0
        return set_read_only(used if used.any() else self.valid)

    @cached_property
    def face_vectors(self) -> Floats:
        """(F, 3) normal of each face, with a length of twice its area; 0 if a corner is invalid."""
        vectors = triangle_vectors(self.verts, self.faces)
        if self.invalid is not None:
            vectors[~self.valid_faces] = 0.0
        return vectors

    @cached_property
    def face_areas(self) -> Floats:
        """(F,) areas, in squared units of the file."""
        return set_read_only(0.5 * np.sqrt(squared_lengths(self.face_vectors)))

    @property
    def _valid_verts(self) -> Floats:
        return self.verts if self.invalid is None else self.verts[~self.invalid]

    def _estimate(self, estimate: Callable[[Floats], Floats]) -> Floats:
        """Estimates for the points of a cloud; zeros for invalid ones."""
        if self.invalid is None:
            return set_read_only(estimate(self.verts))
        estimates = estimate(self._valid_verts)
        result = np.zeros((self.V, *estimates.shape[1:]))
        result[~self.invalid] = estimates
        return set_read_only(result)

    @cached_property
    def vertex_areas(self) -> Floats:
        """(V,) area of each vertex: a third of that of its faces; estimated for a cloud."""
        if self.is_cloud:
            return self._estimate(local_areas)
        return set_read_only(areas_to_vertices(self.face_areas, self.faces, self.V))

    @cached_property
    def vertex_normals(self) -> Floats:
        """(V, 3) unit normals, area-weighted means of the surrounding faces' normals; zeros where there are none.

        Those of a cloud are estimated from neighbourhoods and oriented outwards as far as possible.
        """
        if self.is_cloud:
            return self._estimate(estimate_normals)
        return set_read_only(average_normals(self.face_vectors, self.faces, self.V))

    @cached_property
    def edges(self) -> triangles.Edges:
        """The edges of the faces."""
        return triangles.edges_of(self.faces)

    @cached_property
    def face_parts(self) -> Ints:
        """(F,) number of the connected part of each face; faces that share a vertex are connected."""
        return set_read_only(triangles.face_parts(self.faces, self.V))

    @cached_property
    def vertex_parts(self) -> Ints:
        """(V,) number of the connected part of each vertex; -1 without a face."""
        part = np.full(self.V, -1, np.int64)
        part[self.faces] = self.face_parts[:, None]
        return set_read_only(part)

    @cached_property
    def area(self) -> float:
        """Surface area, in squared units of the file; estimated from the density of a cloud."""
        return float(self.vertex_areas.sum() if self.is_cloud else self.face_areas.sum())

    @cached_property
    def roughness(self) -> float:
        """Noise of a cloud, 0..1 (see `cloud.roughness`); 0 for a mesh."""
        return roughness(self._valid_verts) if self.is_cloud else 0.0

    @cached_property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest corner of the bounding box of the surface, or of a cloud's points."""
        verts = self.verts[self.on_surface] if self.on_surface.any() else self.verts
        return set_read_only(np.stack([verts.min(axis=0), verts.max(axis=0)]))

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal, in units of the file."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @cached_property
    def hash(self) -> str:
        """16 hexadecimal digits that identify the geometry (sha256 of the bytes of verts, then of faces)."""
        digest = hashlib.sha256(self.verts.data)
        digest.update(self.faces.data if len(self.faces) else b"")
        return digest.hexdigest()[:16]

    def to_trimesh(self) -> Trimesh:
        """Convert to a trimesh mesh with vertices and faces in the same order; a cloud becomes a mesh without faces.

        Invalid vertices keep their stand-in positions; colors become 8-bit vertex colors.

        Returns
        -------
        trimesh.Trimesh
            In the file's frame and unit.
        """
        from trimesh import Trimesh

        colors = None if self.colors is None else np.rint(255 * np.clip(self.colors, 0, 1)).astype(np.uint8)
        return Trimesh(self.verts.copy(), self.faces.copy(), vertex_colors=colors, process=False)

    def __repr__(self) -> str:
        kind = "cloud" if self.is_cloud else f"{self.F} faces"
        return f"Shape({self.name!r}, {self.V} vertices, {kind})"


def checked_shape(shape: object, whose: str) -> Shape:
    """Check an argument: return it if it is a `Shape`; `InputError` for anything else, such as a file's name."""
    if not isinstance(shape, Shape):
        raise InputError(f"{whose} must be a Shape, not {type(shape).__name__}", "read a file with load_shape")
    return shape
