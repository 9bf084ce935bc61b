"""Labels of the target's faces, by a vote of points spread over each face."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Floats, Ints
from meshmatch.geometry.triangles import interpolate, triangle_areas
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import (
    faces_at_vertices,
    most_votes,
    one_hot,
    vertex_votes,
)
from meshmatch.transfer.inverse_map import target_normals
from meshmatch.transfer.mapped_mesh import MappedMesh, discontinuous_faces

# A face is cut into so many rows of small triangles, whose centers vote: its square of points.
_ROWS = 3
# A face this many times as large as those of the source there may hold more labels than its corners tell.
_LARGE = 4.0


def pull_face_labels(
    back: VertexMap, source: Shape, target: Shape, labels: Ints, on_faces: bool, workers: int = 1
) -> Ints:
    """Labels (F_tgt,) of the target's faces from those of the source's vertices or faces.

    Where everything around the places of its three corners has one label, a face has it too. Elsewhere evenly
    spread points of the face look up the source, and the label that most of them find wins.

    Parameters
    ----------
    back : VertexMap
        From target to source.
    labels : (V_src,) or, ``on_faces``, (F_src,) int64
        A number for each label from 0; -1 for none.
    """
    around = _around_corners(back, source, target, labels, on_faces)
    found = most_votes(around)
    area = triangle_areas(back.points(source), target.faces)
    usual = _face_area_around(source)[back.index[target.faces]].mean(axis=1)
    ask = np.flatnonzero((np.diff(around.indptr) != 1) | (area > _LARGE * usual))
    if not len(ask):
        return found
    votes = csr_array(_incidence(target) @ vertex_votes(back, source, labels, on_faces))[ask]
    torn = discontinuous_faces(back, target, source, back.points(source), float(np.sqrt(source.area)) or 1.0)[
        ask
    ]
    whole = np.flatnonzero(~torn)
    if len(whole):
        sampled = _sampled(back, source, target, labels, on_faces, ask[whole], workers)
        # Its corners decide only where no point of a face has found a label.
        votes = csr_array(1e-6 * votes)
        votes = (
            votes
            + csr_array((np.ones(len(whole)), (whole, np.arange(len(whole)))), shape=(len(ask), len(whole)))
            @ sampled
        )
    found[ask] = most_votes(csr_array(votes))
    return found


def _around_corners(back: VertexMap, source: Shape, target: Shape, labels: Ints, on_faces: bool) -> csr_array:
    """(F_tgt, labels): whatever occurs around the places of a face's corners, however small its weight."""
    at = np.repeat(back.index[:, None], 3, axis=1)
    inside = back.face >= 0
    at[inside] = source.faces[back.face[inside]]
    V = back.source_vertices
    touched = csr_array((np.ones(3 * V), (np.repeat(np.arange(V), 3), at.ravel())), shape=(V, source.V))
    occurring = one_hot(labels)
    if on_faces:
        occurring = csr_array(faces_at_vertices(source, np.ones(source.F)) @ occurring)
    return csr_array(_incidence(target) @ (touched @ occurring))


def _face_area_around(shape: Shape) -> Floats:
    """(V,) mean area of the faces at each vertex; of a cloud, the area of each point."""
    if shape.is_cloud:
        return shape.vertex_areas
    corners = shape.faces.ravel()
    total = np.bincount(corners, np.repeat(shape.face_areas, 3), shape.V)
    return np.asarray(total / np.maximum(np.bincount(corners, minlength=shape.V), 1))


def _incidence(shape: Shape) -> csr_array:
    """(F, V) sparse: 1 for each corner."""
    return csr_array(faces_at_vertices(shape, np.ones(shape.F)).T.tocsr())


def _sampled(
    back: VertexMap, source: Shape, target: Shape, labels: Ints, on_faces: bool, faces: Ints, workers: int
) -> csr_array:
    """(N, labels) votes of the points of N faces of the target."""
    spread = lattice(_ROWS)  # P 3
    corners = target.faces[faces]
    points = np.einsum("pk,nkd->npd", spread, back.points(source)[corners]).reshape(-1, 3)
    image = MappedMesh(VertexMap.identity(source), source, source)
    normals = _normals(back, source)
    facing = np.einsum("pk,nkd->npd", spread, normals[corners]).reshape(-1, 3)
    places = image.query(points, facing, workers)
    of_face = np.repeat(np.arange(len(faces)), len(spread))
    if on_faces and source.F:
        rows, code = of_face[places.face >= 0], labels[places.face[places.face >= 0]]
        weight = np.ones(len(code))
    else:
        at = np.repeat(places.vertex[:, None], 3, axis=1)
        at[places.face >= 0] = source.faces[places.face[places.face >= 0]]
        own = most_votes(
            csr_array(
                (places.barycentric.ravel(), (np.repeat(np.arange(len(at)), 3), at.ravel())),
                shape=(len(at), source.V),
            )
            @ one_hot(labels)
        )
        rows, code, weight = of_face, own, np.ones(len(own))
    known = code >= 0
    width = int(labels.max(initial=-1)) + 1
    return csr_array((weight[known], (rows[known], code[known])), shape=(len(faces), max(width, 1)))


def _normals(back: VertexMap, source: Shape) -> Floats:
    """(V_tgt, 3) the source's normals at the places of the target's vertices."""
    own = target_normals(source)
    normals = own[back.index]
    inside = back.face >= 0
    corners = source.faces[back.face[inside]]
    normals[inside] = interpolate(own, corners, back.barycentric[inside])
    return normals


def of_faces(confidence: Floats, target: Shape) -> Floats:
    """(F,) mean of the corners' confidence (V,)."""
    return np.asarray(confidence[target.faces].mean(axis=1))


def lattice(rows: int) -> Floats:
    """(rows^2, 3) barycentric centers of the equal triangles into which a triangle is cut."""
    points = []
    for i in range(rows):
        for j in range(rows - i):
            points.append((i + 1 / 3, j + 1 / 3))
            if j < rows - i - 1:
                points.append((i + 2 / 3, j + 2 / 3))
    first, second = np.array(points).T / rows
    return np.stack([1.0 - first - second, first, second], axis=1)
