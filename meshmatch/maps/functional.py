"""Functional maps (Ovsjanikov et al. 2012): Laplacian eigenfunctions, and recovery of vertex maps from matrices.

`VertexMap.functional` computes the functional map of a vertex map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import robust_laplacian
from numpy.typing import ArrayLike
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import eigsh

from meshmatch.arrays import Float, Floats, PickledFields, ShortRepr, as_numbers, set_read_only
from meshmatch.errors import InputError
from meshmatch.geometry.trees import cKDTree
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.scalars import is_integer
from meshmatch.shapes.files import ShapeLike, as_shape

_INFO_HINT = "meshmatch info FILE says what is in it"


@dataclass(frozen=True, eq=False, repr=False)
class LaplacianBasis(ShortRepr, PickledFields):
    """The first K eigenfunctions of the Laplacian of a shape.

    They are orthonormal: ``vectors.T @ (mass[:, None] * vectors)`` is the identity.

    Attributes
    ----------
    vectors
        (V, K) eigenfunctions, one per column, the constant one first.
    values
        (K,) eigenvalues, ascending, in 1 / area.
    mass
        (V,) the area around each vertex.

    Examples
    --------
    >>> basis = meshmatch.laplacian_basis("templates/samples/dancer.ply", 30)
    >>> coefficients = basis.vectors.T @ (basis.mass * basis.vectors[:, 3])  # of a function (V,)
    """

    vectors: Float[Floats, "V K"]
    values: Float[Floats, " K"]
    mass: Float[Floats, " V"]


def laplacian_basis(shape: ShapeLike, K: int = 100) -> LaplacianBasis:
    """Compute the first eigenfunctions of the Laplacian of a mesh or a cloud.

    The Laplacian is the intrinsic Delaunay one with lumped areas (Sharp and Crane, *A Laplacian for Nonmanifold Triangle
    Meshes*, 2020), which needs neither good triangles nor a manifold. The sign of a function is arbitrary but
    reproducible.

    Parameters
    ----------
    shape
        As in `match`; all vertices must have a position.
    K
        Number of eigenfunctions.

    Returns
    -------
    LaplacianBasis
        In the unit of the shape: vectors in 1 / length.

    Raises
    ------
    InputError
        There are too few vertices, some have no position, or the triangles have no area.

    Examples
    --------
    >>> basis = meshmatch.laplacian_basis("templates/samples/dancer.ply", 30)
    >>> basis.vectors.shape, basis.values[1]
    """
    found = as_shape(shape)
    name = found.name or "the shape"
    if not is_integer(K):
        raise InputError(f"the number of eigenfunctions must be an integer, not {K!r}", f"ask for 1 to {found.V - 2}")
    if not 1 <= K <= found.V - 2:
        raise InputError(f"{name} with {found.V} vertices has no {K} eigenfunctions", f"ask for 1 to {found.V - 2}")
    if not found.valid.all():
        raise InputError(f"{name} has vertices without a position", "export it again without them")
    unit = float(found.diagonal) or 1.0  # lengths that are far from 1 would shift the spectrum
    verts = found.verts / unit
    try:
        if found.is_cloud:
            stiffness, mass = robust_laplacian.point_cloud_laplacian(verts)
        else:
            stiffness, mass = robust_laplacian.mesh_laplacian(verts, found.faces)
    except RuntimeError as error:
        raise InputError(f"{name} is no surface: its points or triangles span no area", _INFO_HINT) from error
    areas = np.asarray(mass.diagonal(), np.float64)
    floor = 1e-9 * areas.mean()
    if not (np.isfinite(areas).all() and floor > 0):
        raise InputError(f"{name} has no surface area", _INFO_HINT)
    areas = np.maximum(areas, floor)  # vertices that no face uses
    start = np.random.default_rng(0).standard_normal(found.V)
    values, vectors = eigsh(csr_matrix(stiffness), K, csr_matrix((areas, (range(found.V),) * 2)), sigma=-1e-8, v0=start)
    vectors = vectors * np.sign(np.take_along_axis(vectors, np.abs(vectors).argmax(0)[None], 0))
    order = np.argsort(values)
    scaled = vectors[:, order] / unit, values[order].clip(min=0.0) / unit**2, areas * unit**2
    return LaplacianBasis(*map(set_read_only, scaled))


def map_from_functional(
    C: ArrayLike, source: ShapeLike, target: ShapeLike, basis_source: ArrayLike, basis_target: ArrayLike
) -> VertexMap:
    """Recover a vertex map from a functional map, by nearest neighbours in the spectral embedding.

    The matrix is as `VertexMap.functional` gives it: from functions on the target to functions on the source. pyFM's
    ``FM_12`` for ``mesh1`` and ``mesh2`` has ``mesh1`` as target and ``mesh2`` as source.

    Parameters
    ----------
    C
        (K_source, K_target).
    source
        As in `match`.
    target
        As in `match`.
    basis_source
        (V_source, K) functions, one per column; the first K_source are used.
    basis_target
        (V_target, K), the same on the target.

    Returns
    -------
    VertexMap
        From source to target, vertex to vertex. Its confidence is not known (nan).

    Raises
    ------
    InputError
        An array has the wrong shape, or values that are not finite.

    Examples
    --------
    >>> climber, dancer = "templates/samples/climber.ply", "templates/samples/dancer.ply"
    >>> bases = [meshmatch.laplacian_basis(each, 50) for each in (climber, dancer)]
    >>> C = meshmatch.match(climber, dancer).map.functional(bases[0].vectors, bases[1].vectors, bases[0].mass)
    >>> found = meshmatch.map_from_functional(C, climber, dancer, bases[0].vectors, bases[1].vectors)
    """
    shapes = as_shape(source, "source"), as_shape(target, "target")
    matrix = as_numbers(C, "a functional map", finite=True)
    if matrix.ndim != 2 or not matrix.size:
        raise InputError(f"a functional map must be an array of (K_source, K_target), not {matrix.shape}")
    bases = []
    for side, shape, basis, K in zip(
        ("source", "target"), shapes, (basis_source, basis_target), matrix.shape, strict=True
    ):
        functions = as_numbers(basis, f"the basis of the {side}", finite=True)
        if functions.ndim != 2 or len(functions) != shape.V or functions.shape[1] < K:
            needed = f"({shape.V}, {K} or more)"
            raise InputError(f"the basis of the {side} must be an array of {needed}, not {functions.shape}")
        bases.append(functions[:, :K])
    index = cKDTree(bases[1] @ matrix.T).query(bases[0])[1]
    return VertexMap.between(*shapes, index)
