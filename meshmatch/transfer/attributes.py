"""Values, directions, labels and skin weights of the source, pulled back to the target along `back`, a map from target to
source.

Smooth quantities are interpolated between the corners of the source's face; labels are decided by votes, never averaged.
Labels are numbers from 0, and `NO_LABEL` for none: one for each vertex of the source or, ``on_faces``, for each face.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from meshmatch.arrays import Float, Floats, Floats32, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import triangle_areas
from meshmatch.maps.folds import normals_or_zeros
from meshmatch.maps.indices import corners_of
from meshmatch.maps.mapped_mesh import MappedMesh, discontinuous_faces, mean_around
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape

NO_LABEL = -1
# A face votes with the centers of the triangles it is cut into, the square of this number.
_SUBDIVISIONS = 3
# A face this many times larger than the source's faces there may contain labels that none of its corners has.
_MAX_AREA_RATIO = 4.0


def pull_values(back: VertexMap, values: Floats) -> Floats:
    """Values (V_source,) or (V_source, D) on the target, interpolated as by `VertexMap.apply`.

    Values that are not finite are ignored, unless they have more than half of the weight: then the result is nan.
    """
    values = np.asarray(values, np.float64)
    matrix = back.sparse()
    finite = np.isfinite(values)
    if finite.all():
        return np.asarray(matrix @ values)
    share = np.asarray(matrix @ finite.astype(np.float64))
    sums = np.asarray(matrix @ np.where(finite, values, 0.0))
    return np.where(share >= 0.5, sums / np.maximum(share, 0.5), np.nan)


def pull_directions(
    back: VertexMap, source: Shape, target: Shape, directions: Float[Floats, "V_source 3"]
) -> Float[Floats, "V_target 3"]:
    """Unit vectors at the target's vertices, from vectors at the source's, such as normals; each in its file's frame.

    They are rotated like the edges and the normal around each vertex (Kabsch); vectors that cancel become zeros.
    `InputError` if one of the shapes is a point cloud.
    """
    if source.is_cloud or target.is_cloud:
        raise InputError("directions need meshes, not point clouds", "transfer them as plain numbers")
    points = back.points(source)
    edges = target.edges.vertices
    target_edges, source_edges = (place[edges[:, 1]] - place[edges[:, 0]] for place in (target.verts, points))
    unit = np.sqrt(target.area * source.area) or 1.0
    products = np.einsum("ni,nj->nij", target_edges, source_edges) / unit
    sums = np.zeros((target.V, 3, 3))
    np.add.at(sums, edges[:, 0], products)
    np.add.at(sums, edges[:, 1], products)
    # the normal counts as much as all edges: in a flat ring these leave its sign open
    weight = np.maximum(np.linalg.norm(sums, axis=(1, 2)), 1e-12)[:, None, None]
    sums += weight * np.einsum("ni,nj->nij", target.vertex_normals, back.apply(source.vertex_normals))
    left, _, right = np.linalg.svd(sums)
    sign = np.ones((target.V, 3))
    sign[:, 2] = np.sign(np.linalg.det(left @ right))
    rotations = (left * sign[:, None, :]) @ right
    turned = np.einsum("nij,nj->ni", rotations, back.apply(np.nan_to_num(directions)))
    length = np.linalg.norm(turned, axis=1, keepdims=True)
    return np.asarray(turned / np.where(length > 0, length, 1.0))


def pull_labels(
    back: VertexMap, source: Shape, labels: Int[Ints, " N"], on_faces: bool = False
) -> Int[Ints, " V_target"]:
    """Labels of the target's vertices: at each the one with the largest weight around its place on the source."""
    return most_votes(_vertex_votes(back, source, labels, on_faces))


def pull_face_labels(
    back: VertexMap, source: Shape, target: Shape, labels: Int[Ints, " N"], on_faces: bool, workers: int = 1
) -> Int[Ints, " F_target"]:
    """Labels of the target's faces.

    A face takes the label that all places around its corners' images have, if it is a single one; else the label that most
    of its evenly distributed points find on the source.
    """
    # Labels that occur around the places of a face's corners, however small their weight.
    touched = _corner_matrix(corners_of(source.faces, back.face, back.index), source.V)
    occurring, corners = _one_hot(labels), _corner_matrix(target.faces, target.V)
    if on_faces:
        occurring = csr_array(_corner_matrix(source.faces, source.V).T @ occurring)
    around = csr_array(corners @ (touched @ occurring))
    found = most_votes(around)
    area = triangle_areas(back.points(source), target.faces)
    typical_area = _mean_face_area(source)[back.index[target.faces]].mean(axis=1)
    undecided = np.flatnonzero((np.diff(around.indptr) != 1) | (area > _MAX_AREA_RATIO * typical_area))
    if not len(undecided):
        return found
    votes = csr_array(corners @ _vertex_votes(back, source, labels, on_faces))[undecided]
    continuous = undecided[~discontinuous_faces(back, target, source)[undecided]]
    if len(continuous):
        # The corners decide only where no point of the face has found a label.
        votes = 1e-6 * votes + _sampled_votes(back, source, target, labels, on_faces, continuous, workers)[undecided]
    found[undecided] = most_votes(csr_array(votes))
    return found


def _sampled_votes(
    back: VertexMap, source: Shape, target: Shape, labels: Ints, on_faces: bool, faces: Ints, workers: int
) -> csr_array:
    """(F_target, labels) votes of the sample points of some faces (N,) of the target."""
    spread = lattice(_SUBDIVISIONS)  # (P, 3)
    corners = target.faces[faces]
    normals = back.apply(normals_or_zeros(source))
    points, facing = (
        np.einsum("pk,nkd->npd", spread, values[corners]).reshape(-1, 3) for values in (back.points(source), normals)
    )
    found = MappedMesh.of(source).query(points, facing, workers)
    voter = np.repeat(faces, len(spread))
    if on_faces and source.F:
        code = np.where(found.face >= 0, labels[found.face], NO_LABEL)
    else:
        at = corners_of(source.faces, found.face, found.vertex)
        code = most_votes(_corner_matrix(at, source.V, found.barycentric) @ _one_hot(labels))
    known = code >= 0
    return _count_matrix(voter[known], code[known], (target.F, max(int(labels.max(initial=-1)) + 1, 1)))


def lattice(rows: int) -> Float[Floats, "P 3"]:
    """(P, 3) barycentric centers of the ``rows``^2 equal triangles into which a triangle is subdivided."""
    across = np.add.outer(np.arange(rows), np.arange(rows))
    first, second = (
        np.concatenate([np.argwhere(across < rows) + 1 / 3, np.argwhere(across < rows - 1) + 2 / 3]).T / rows
    )
    return np.stack([1.0 - first - second, first, second], axis=1)


def _mean_face_area(shape: Shape) -> Float[Floats, " V"]:
    """Mean area of the faces at each vertex; for a cloud the area of each point."""
    return shape.vertex_areas if shape.is_cloud else mean_around(shape.faces, shape.face_areas, shape.V)


def _vertex_votes(back: VertexMap, source: Shape, labels: Ints, on_faces: bool) -> csr_array:
    """(V_target, labels) sparse: weight of each label at each target vertex."""
    if not on_faces:
        return csr_array(back.sparse() @ _one_hot(labels))
    # The source's face at each place; at a vertex all adjacent faces, by area.
    within = (back.face >= 0) & (back.barycentric.max(axis=1) < 1.0 - 1e-9)
    inside, outside = np.flatnonzero(within), np.flatnonzero(~within)
    direct = _count_matrix(inside, back.face[inside], (len(within), source.F))
    vertex_matrix = _count_matrix(outside, back.index[outside], (len(within), source.V))
    area = source.face_areas / max(float(source.face_areas.max()), 1e-300) + 1e-12
    around = csr_array(_corner_matrix(source.faces, source.V, area[:, None]).T)
    return csr_array(csr_array(direct + vertex_matrix @ around) @ _one_hot(labels))


def _corner_matrix(corners: Ints, V: int, weights: Floats | float = 1.0) -> csr_array:
    """(N, V) sparse matrix with weights (N, 3) at corners (N, 3)."""
    values = np.broadcast_to(weights, corners.shape).ravel()
    return csr_array((values, (np.repeat(np.arange(len(corners)), 3), corners.ravel())), (len(corners), V))


def _one_hot(labels: Int[Ints, " N"]) -> csr_array:
    """(N, labels) sparse: 1 at each label; rows without a label are empty."""
    rows = np.flatnonzero(labels >= 0)
    return _count_matrix(rows, labels[rows], (len(labels), max(int(labels.max(initial=-1)) + 1, 1)))


def _count_matrix(rows: Ints, columns: Ints, shape: tuple[int, int]) -> csr_array:
    """Sparse matrix with 1 at these places; duplicates add up."""
    return csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)


def most_votes(votes: csr_array) -> Int[Ints, " N"]:
    """The label with the most votes in each row, the lowest one of ties; `NO_LABEL` for an empty row."""
    votes = csr_array(votes)
    rows = np.repeat(np.arange(votes.shape[0]), np.diff(votes.indptr))
    # Sums of thirds differ in the last bits, but equal votes should tie.
    order = np.lexsort((votes.indices, -np.round(votes.data, 9), rows))
    order = order[votes.data[order] > 0]
    winner, first = np.unique(rows[order], return_index=True)
    result = np.full(votes.shape[0], NO_LABEL, np.int64)
    result[winner] = votes.indices[order[first]]
    return result


def pull_weights(back: VertexMap, weights: csr_array, max_joints: int = 4) -> csr_array:
    """Skin weights (V_source, J) on the target, (V_target, J). Rows have at most `max_joints` weights, and sum to 1, or to 0
    where the source has none.
    """
    return largest_weights(csr_array(back.sparse() @ weights), max_joints)


def largest_weights(weights: csr_array, limit: int) -> csr_array:
    """Keep the `limit` largest weights of each row, scaled to sum to 1; drop those that are not positive."""
    weights = csr_array(weights)
    rows = np.repeat(np.arange(weights.shape[0]), np.diff(weights.indptr))
    order = np.lexsort((weights.indices, -weights.data, rows))
    rank = np.arange(len(order)) - weights.indptr[rows[order]]
    order = order[(rank < limit) & (weights.data[order] > 0)]
    rows, data = rows[order], weights.data[order]
    data = data / np.bincount(rows, data, weights.shape[0])[rows]
    return csr_array((data, (rows, weights.indices[order])), shape=weights.shape)


def joint_table(weights: csr_array) -> tuple[Int[NDArray[np.int32], "V N"], Float[Floats32, "V N"]]:
    """Joints of each vertex (V, N), heaviest first, and their weights (V, N); shorter rows are padded with zeros."""
    weights = csr_array(weights)
    V = weights.shape[0]
    rows = np.repeat(np.arange(V), np.diff(weights.indptr))
    order = np.lexsort((weights.indices, -weights.data, rows))
    place = np.arange(len(order)) - weights.indptr[rows[order]]
    N = int(np.diff(weights.indptr).max(initial=1))
    joints, shares = np.zeros((V, N), np.int32), np.zeros((V, N), np.float32)
    joints[rows[order], place] = weights.indices[order]
    shares[rows[order], place] = weights.data[order]
    return joints, shares
