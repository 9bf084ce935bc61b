"""Labels of the target's faces, by a vote of points spread over each face."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import triangle_areas
from meshmatch.maps.map_checks import corners_of
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import faces_at_vertices, most_votes, one_hot, vertex_votes
from meshmatch.transfer.mapped_mesh import MappedMesh, discontinuous_faces, known_normals

# A face is cut into the square of so many small triangles, whose centers vote.
_ROWS = 3
# A face this many times as large as those of the source there may hold more labels than its corners tell.
_LARGE = 4.0


def pull_face_labels(
    back: VertexMap, source: Shape, target: Shape, labels: Int[Ints, " N"], on_faces: bool, workers: int = 1
) -> Int[Ints, " F_target"]:
    """Labels of the target's faces from those of the source's vertices or faces.

    Where everything around the places of its three corners has one label, a face has it too. Elsewhere evenly
    spread points of the face look up the source, and the label that most of them find wins.

    Parameters
    ----------
    back : VertexMap
        From target to source.
    labels : (V_source,) or, ``on_faces``, (F_source,) int64
        A number for each label from 0; -1 for none.
    """
    around = _around_corners(back, source, target, labels, on_faces)
    found = most_votes(around)
    area = triangle_areas(back.points(source), target.faces)
    usual = _face_area_around(source)[back.index[target.faces]].mean(axis=1)
    ask = np.flatnonzero((np.diff(around.indptr) != 1) | (area > _LARGE * usual))
    if not len(ask):
        return found
    votes = csr_array(_corner_matrix(target) @ vertex_votes(back, source, labels, on_faces))[ask]
    continuous = np.flatnonzero(~discontinuous_faces(back, target, source)[ask])
    if len(continuous):
        sampled = _sampled_votes(back, source, target, labels, on_faces, ask[continuous], workers)
        rows = csr_array(
            (np.ones(len(continuous)), (continuous, np.arange(len(continuous)))), (len(ask), len(continuous))
        )
        # The corners decide only where no point of a face has found a label.
        votes = 1e-6 * votes + rows @ sampled
    found[ask] = most_votes(csr_array(votes))
    return found


def _around_corners(back: VertexMap, source: Shape, target: Shape, labels: Ints, on_faces: bool) -> csr_array:
    """(F_target, labels): whatever occurs around the places of a face's corners, however small its weight."""
    at = corners_of(source.faces, back.face, back.index)
    touched = csr_array((np.ones(at.size), (np.repeat(np.arange(len(at)), 3), at.ravel())), (len(at), source.V))
    occurring = one_hot(labels)
    if on_faces:
        occurring = csr_array(faces_at_vertices(source, np.ones(source.F)) @ occurring)
    return csr_array(_corner_matrix(target) @ (touched @ occurring))


def _face_area_around(shape: Shape) -> Float[Floats, " V"]:
    """Mean area of the faces at each vertex; of a cloud, the area of each point."""
    if shape.is_cloud:
        return shape.vertex_areas
    corners = shape.faces.ravel()
    total = np.bincount(corners, np.repeat(shape.face_areas, 3), shape.V)
    return np.asarray(total / np.maximum(np.bincount(corners, minlength=shape.V), 1))


def _corner_matrix(shape: Shape) -> csr_array:
    """(F, V) sparse: 1 for each corner."""
    return csr_array(faces_at_vertices(shape, np.ones(shape.F)).T.tocsr())


def _sampled_votes(
    back: VertexMap, source: Shape, target: Shape, labels: Ints, on_faces: bool, faces: Ints, workers: int
) -> csr_array:
    """(N, labels) votes of the points of N faces of the target."""
    spread = lattice(_ROWS)  # P 3
    corners = target.faces[faces]
    normals = back.apply(known_normals(source))
    points, facing = (
        np.einsum("pk,nkd->npd", spread, values[corners]).reshape(-1, 3) for values in (back.points(source), normals)
    )
    found = MappedMesh.of(source).query(points, facing, workers)
    voter = np.repeat(np.arange(len(faces)), len(spread))
    if on_faces and source.F:
        code = np.where(found.face >= 0, labels[found.face], -1)
    else:
        at = corners_of(source.faces, found.face, found.vertex)
        rows = np.repeat(np.arange(len(at)), 3)
        places = csr_array((found.barycentric.ravel(), (rows, at.ravel())), (len(at), source.V))
        code = most_votes(places @ one_hot(labels))
    known = code >= 0
    width = max(int(labels.max(initial=-1)) + 1, 1)
    return csr_array((np.ones(int(known.sum())), (voter[known], code[known])), (len(faces), width))


def lattice(rows: int) -> Float[Floats, "P 3"]:
    """Barycentric centers of the rows^2 equal triangles into which a triangle is cut."""
    points = []
    for i in range(rows):
        for j in range(rows - i):
            points.append((i + 1 / 3, j + 1 / 3))
            if j < rows - i - 1:
                points.append((i + 2 / 3, j + 2 / 3))
    first, second = np.array(points).T / rows
    return np.stack([1.0 - first - second, first, second], axis=1)


def mean_of_corners(confidence: Float[Floats, " V"], target: Shape) -> Float[Floats, " F"]:
    """Confidence of faces: the mean of their corners'."""
    return np.asarray(confidence[target.faces].mean(axis=1))
