"""Making a shape fit for work without losing sight of any original vertex.

Only what is safe is done: nothing is moved, no hole is closed, no face is invented.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.cloud import stray_points
from meshmatch.shapes.orientation import turn_faces
from meshmatch.shapes.shape import Floats, Ints, Shape
from meshmatch.shapes.topology import edge_keys, edges_of, face_parts, open_edges, same_rows

STRAY_SHARE = 0.02
"""A part with less than this share of the largest part's area is stray."""
_FAR = 0.25  # gap between two big parts, in diagonals of the largest, from which they count as apart
_NEAR = 0.05  # gap up to which a small part belongs to a shape that is made of small parts


@dataclass(frozen=True, eq=False)
class Repaired:
    """A shape that is fit for work, and how it relates to the one that it came from.

    Parameters
    ----------
    shape : Shape
        All its vertices are valid and, in a mesh, used by a face.
    original_to_repaired : (V_original,) int64
        The repaired vertex that stands for each original one: itself, its twin at the same position, or if it was
        dropped the nearest one. The nearest to a vertex without a position is a valid corner of one of its faces,
        or if there is none the nearest in the file's order.
    kept_vertex : (V,) int64
        The original vertex that each repaired one is; increasing.
    notes : tuple of str
        What was found and done, a line each; empty for a shape that was fine.
    far_parts : int
        Big parts that lie far from the largest one: perhaps two objects in one file. They are kept.
    """

    shape: Shape
    original_to_repaired: Ints
    kept_vertex: Ints
    notes: tuple[str, ...]
    far_parts: int = 0


def repair(shape: Shape) -> Repaired:
    """Drop what is broken, merge what is double, and say so.

    In this order: vertices without a position and the faces that touch them; vertices at exactly the same position
    are merged if they lie on an open edge (texture seams of obj and glTF files, every corner of an stl; two layers
    that merely touch stay apart); faces without area; faces that occur twice (both of them, where they are a flap of
    no volume on a closed surface); stray parts (see `STRAY_SHARE`; unless together they are more than a tenth of the surface: then the shape
    is made of small parts, and only those far from the rest are stray); vertices that no face uses. Then faces are
    turned so that neighbours agree and the shape is not inside out. Open and non-manifold edges are counted, not mended.
    Of a cloud: points without a position, double ones, and strays far from all others.

    Raises
    ------
    InputError
        Nothing is left: no face of a mesh has any area.
    """
    return _repair_cloud(shape) if shape.is_cloud else _repair_mesh(shape)


def _repair_cloud(shape: Shape) -> Repaired:
    notes: list[str] = []
    valid = _valid(shape, notes)
    twin = same_rows(shape.verts)
    twin[~valid] = np.flatnonzero(~valid)
    kept = valid & (twin == np.arange(shape.V))
    _note(notes, int(valid.sum() - kept.sum()), "point", "merged with another at the same position")
    chosen = np.flatnonzero(kept)
    stray = stray_points(shape.verts[chosen])
    _note(notes, int(stray.sum()), "stray point", "far from all others dropped")
    kept[chosen[stray]] = False
    return _result(shape, kept, twin, shape.faces, valid, notes)


def _repair_mesh(shape: Shape) -> Repaired:
    notes: list[str] = []
    valid = _valid(shape, notes)
    faces, cross = shape.faces, shape.face_vectors
    if not valid.all():
        fine = valid[faces].all(axis=1)
        _note(notes, int((~fine).sum()), "face", "at such vertices dropped")
        faces, cross = faces[fine], cross[fine]
    twin = _seams(shape.verts, faces)
    twin[~valid] = np.flatnonzero(~valid)
    doubles = int((twin != np.arange(shape.V)).sum())
    if doubles:
        _note(notes, doubles, "vertex", "merged with another at the same position")
        faces = twin[faces]
    flat = _flat(shape.verts, faces, cross, shape.diagonal)
    if flat.any():
        _note(notes, int(flat.sum()), "face", "without area dropped")
        faces, cross = faces[~flat], cross[~flat]
    double = _double_faces(faces)
    if double.any():
        _note(notes, int(double.sum()), "face", "dropped that occurred twice")
        faces, cross = faces[~double], cross[~double]
    if len(faces) == 0:
        raise InputError(f"{shape.name or 'the shape'} has no face with any area", "is it a mesh at all?")
    stray, far_parts = _strays(shape.verts, faces, cross, notes)
    if stray.any():
        faces, cross = faces[~stray], cross[~stray]
    kept = np.zeros(shape.V, bool)
    kept[faces.ravel()] = True
    touched = np.zeros(shape.V, bool)
    touched[shape.faces.ravel()] = True
    _note(notes, int((valid & ~touched).sum()), "vertex", "that no face uses dropped")
    edges = edges_of(faces)
    faces, turned = turn_faces(shape.verts, faces, cross, edges)
    if turned == len(faces):
        notes.append("turned all faces: the shape was inside out")
    else:
        _note(notes, turned, "face", "turned to face the same way as the others")
    border, crowded = edges.counts
    _note(notes, border, "open edge", "(the surface has holes or a border)")
    _note(notes, crowded, "non-manifold edge", "(more than two faces meet there), left as they are")
    return _result(shape, kept, twin, faces, valid, notes, far_parts)


def _strays(verts: Floats, faces: Ints, cross: Floats, notes: list[str]) -> tuple[NDArray[np.bool_], int]:
    """(F,) True for faces of stray parts; and how many big parts lie far from the rest."""
    part = face_parts(faces, len(verts))
    if part.max() == 0:
        return np.zeros(len(faces), bool), 0
    areas = np.bincount(part, weights=0.5 * np.sqrt(_squared(cross)))
    largest = int(areas.argmax())
    small = areas < STRAY_SHARE * areas[largest]
    big = np.flatnonzero(~small)
    # the body grows from the largest part by all big parts that are near
    body = np.array([largest])
    while True:
        gap, diagonal = _gaps(verts, faces, part, body, np.setdiff1d(big, body))
        near = np.setdiff1d(big[gap[big] <= _FAR * diagonal], body)
        if len(near) == 0:
            break
        body = np.concatenate([body, near])
    far = np.setdiff1d(big, body)
    stray = small.copy()
    if areas[small].sum() > 0.1 * areas.sum():
        gap, diagonal = _gaps(verts, faces, part, big, np.flatnonzero(small))
        stray &= gap > _NEAR * diagonal
    lost = stray[part]
    if stray.any():
        what = f"dropped ({lost.sum():,} {'face' if lost.sum() == 1 else 'faces'})"
        _note(notes, int(stray.sum()), "stray part", what)
    kept = len(areas) - int(stray.sum())
    if kept > 1:
        _note(notes, kept, "separate part", "kept")
    if len(far):
        share = areas[far].sum() / areas.sum()
        verb = "lies" if len(far) == 1 else "lie"
        _note(
            notes,
            len(far),
            "part",
            f"of these {verb} far from the rest, {share:.0%} of the area: two objects in one file?",
        )
    return lost, len(far)


def _gaps(verts: Floats, faces: Ints, part: Ints, body: Ints, others: Ints) -> tuple[Floats, float]:
    """Distance (parts,) of each of the `others` to the parts in `body`, 0 for the rest; and the body's diagonal."""
    from scipy.spatial import cKDTree

    count = int(part.max()) + 1
    theirs, ours = np.isin(np.arange(count), others), np.isin(np.arange(count), body)
    anchor = np.unique(faces[ours[part]])
    diagonal = float(np.linalg.norm(np.ptp(verts[anchor], axis=0)))
    gap = np.zeros(count)
    if len(others):
        chosen = theirs[part]
        corners, place = np.unique(faces[chosen], return_index=True)
        distance = cKDTree(verts[anchor[:: max(len(anchor) // 20_000, 1)]]).query(verts[corners])[0]
        gap[others] = np.inf
        np.minimum.at(gap, np.repeat(part[chosen], 3)[place], distance)
    return gap, diagonal


def _seams(verts: Floats, faces: Ints) -> Ints:
    """(V,) the vertex to use instead of each: the first at the same position, if both lie on an open edge."""
    twin = same_rows(verts)
    own = np.arange(len(verts))
    if (twin == own).all():
        return twin
    border = np.zeros(len(verts), bool)
    border[open_edges(faces)] = True
    # the first of a group need not be on the border: number the border alone
    place = np.flatnonzero(border)
    own[place] = place[same_rows(verts[place])]
    return own


def _double_faces(faces: Ints) -> NDArray[np.bool_]:
    """True for faces to drop: all but the first of the same three corners, and the first too if the two are a flap.

    Two that face opposite ways cancel. On a surface that goes on around them they are a fold of no volume, and without
    both it is closed as before; in a sheet that is double all over, one of each is the surface.
    """
    a, b, c = np.ascontiguousarray(faces.T)
    low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
    first = same_rows(np.stack([low, a + b + c - low - high, high], axis=1))
    double = first != np.arange(len(faces))
    if not double.any():
        return double
    many = np.bincount(first, minlength=len(faces))
    second = np.flatnonzero(double & (many[first] == 2))
    pair = np.stack([first[second], second], axis=1)
    pair = pair[_handed(faces[pair[:, 0]]) != _handed(faces[pair[:, 1]])]
    single = np.sort(edge_keys(faces, many[first] == 1))
    keys = edge_keys(faces)[pair[:, :1] + len(faces) * np.arange(3)]
    others = np.searchsorted(single, keys, "right") - np.searchsorted(single, keys, "left")  # pairs 3
    flap = ((others == 0) | (others == 2)).all(axis=1) & (others == 2).any(axis=1)
    double[pair[flap, 0]] = True
    return double


def _handed(faces: Ints) -> NDArray[np.bool_]:
    """Which of its two ways round each face goes: the same for a b c, b c a and c a b."""
    turned = np.take_along_axis(faces, (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    return np.asarray(turned[:, 1] < turned[:, 2])


def _result(
    shape: Shape, kept: NDArray[np.bool_], twin: Ints, faces: Ints, valid: NDArray[np.bool_],
    notes: list[str], far_parts: int = 0,
) -> Repaired:  # fmt: skip
    chosen = np.flatnonzero(kept)
    if len(chosen) == 0:
        raise InputError(
            f"{shape.name or 'the shape'} has no usable vertex", "is it a mesh or a point cloud at all?"
        )
    if len(chosen) == shape.V and not notes:
        every = np.arange(shape.V)
        return Repaired(shape, every, every, ())
    new = np.full(shape.V, -1, np.int64)
    new[chosen] = np.arange(len(chosen))
    colors = None if shape.colors is None else shape.colors[chosen]
    repaired = Shape(shape.verts[chosen], new[faces], shape.name, colors)
    stands = twin.copy()
    if not valid.all():
        stands = twin[_valid_neighbour(shape, valid)]
    answer = new[stands]
    lost = np.flatnonzero(answer < 0)
    if len(lost):
        from scipy.spatial import cKDTree

        answer[lost] = cKDTree(repaired.verts).query(shape.verts[stands[lost]])[1]
    return Repaired(repaired, answer, chosen, tuple(notes), far_parts)


def _valid_neighbour(shape: Shape, valid: NDArray[np.bool_]) -> Ints:
    """(V,) itself for a valid vertex; for others a valid corner of one of their faces, or the nearest in file order."""
    places = np.flatnonzero(valid)
    every = np.arange(shape.V)
    after = np.searchsorted(places, every).clip(max=len(places) - 1)
    before = (after - 1).clip(min=0)
    nearer = every - places[before] < np.abs(places[after] - every)
    stands = np.where(nearer & ~valid, places[before], places[after])
    for k in range(3):
        for other in ((k + 1) % 3, (k + 2) % 3):
            a, b = shape.faces[:, k], shape.faces[:, other]
            helps = ~valid[a] & valid[b]
            stands[a[helps]] = b[helps]
    return stands


def _valid(shape: Shape, notes: list[str]) -> NDArray[np.bool_]:
    if shape.invalid is None:
        return np.ones(shape.V, bool)
    count = int(shape.invalid.sum())
    if count == shape.V:
        raise InputError(
            f"{shape.name or 'the shape'}: no vertex has a position (all NaN)", "export it again"
        )
    _note(notes, count, "vertex", "without a position (NaN) dropped")
    return ~shape.invalid


def _flat(verts: Floats, faces: Ints, cross: Floats, diagonal: float) -> NDArray[np.bool_]:
    """True for a face that names a vertex twice, or whose height is rounding beside its longest edge."""
    double_areas = _squared(cross)
    flat = double_areas <= (1e-12 * diagonal**2) ** 2  # no edge is longer than the diagonal
    small = np.flatnonzero(flat)
    a, b, c = (verts[faces[small, k]] for k in range(3))
    longest = np.maximum(np.maximum(_squared(b - a), _squared(c - a)), _squared(c - b))
    flat[small] = double_areas[small] <= (1e-12 * longest) ** 2
    return np.asarray(flat)


def _squared(vectors: Floats) -> Floats:
    return np.asarray(np.einsum("fi,fi->f", vectors, vectors))


def _note(notes: list[str], count: int, noun: str, what: str) -> None:
    if count:
        plural = {"vertex": "vertices"}.get(noun, noun + "s")
        notes.append(f"{count:,} {noun if count == 1 else plural} {what}")
