"""Making a shape fit for work without losing sight of any original vertex.

Only what is safe is done: no hole is closed, no face is invented, and nothing is moved but what noise has moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Brief, Int, Ints
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import edges_of, same_rows
from meshmatch.shapes.cloud import outlier_points
from meshmatch.shapes.copies import counterparts
from meshmatch.shapes.denoise import remove_noise
from meshmatch.shapes.faces import collapsed, duplicate_faces, find_parts, flat_faces, seams, spikes, turn_faces
from meshmatch.shapes.shape import Shape

_NAMED = 5  # meshes that a note lists
NOT_TRUSTED = "left out, as was asked for (weight 0)"
"""The end of a note about faces or points that nobody trusts."""


@dataclass(frozen=True, eq=False, repr=False)
class Repaired(Brief):
    """A shape that is fit for work, and how it relates to the one that it came from.

    All vertices of `shape` are valid and, in a mesh, used by a face; they are where they were, unless noise was smoothed.
    `original_to_repaired` is the vertex that stands for each original one: itself, its twin at the same position, the other
    end of an edge without length, or if it was dropped the nearest one. The nearest to a vertex without a position is a
    valid corner of one of its faces, or if there is none the nearest in the file's order. `kept_vertex` and `kept_face` are
    the original vertex (increasing) or face that each repaired one is; corners may be turned, or stand for twins. `notes`
    say what was found and done, a line each; none for a shape that was fine. `far_parts` counts big parts that lie far from
    the largest one: perhaps two objects in one file. They are kept. `left_out` are numbers of parts
    (`meshmatch.shapes.parts`) that were tried apart and are no part of what is fitted. `copied` are original vertices that
    were dropped with a copy of all that is kept, such as the same figure at another node of a scene: their counterparts
    stand for them.
    """

    shape: Shape
    original_to_repaired: Int[Ints, " V_original"]
    kept_vertex: Int[Ints, " V"]
    notes: tuple[str, ...]
    original: Shape
    kept_face: Int[Ints, " F"]
    far_parts: int = 0
    left_out: tuple[int, ...] = ()
    copied: Bool[Bools, " V_original"] | None = None


def repair(shape: Shape) -> Repaired:
    """Drop what is broken, merge what is double, and say so.

    In this order: vertices without a position, or single ones far away from all others
    (`meshmatch.shapes.faces.spikes`), and the faces that touch them; faces, or points, of weight 0; vertices at
    exactly the same position are merged if they lie on an open edge (texture seams of obj and glTF files, every corner
    of an stl; two layers that merely touch stay apart); edges without length, which are collapsed; faces without area;
    faces that occur twice (both of them, where they are a flap of no volume on a closed surface); outlier parts (see
    `meshmatch.shapes.faces.OUTLIER_SHARE`; unless together they are more than a tenth of the surface: then the shape
    is made of small parts, and only those far from the rest are outliers; never what joints move, such as the shells
    of a robot's fingers); vertices that no face uses. Then faces are turned so that neighbours agree and the shape is
    not inside out. Open and non-manifold edges are counted, not mended. Where noise is as large as the triangles, the
    surface is smoothed (`meshmatch.shapes.denoise`).
    Of a cloud: points without a position, double ones, and outliers far from all others.

    `InputError` if nothing is left: no face of a mesh has any area.
    """
    notes: list[str] = []
    valid = shape.valid
    if not valid.any():
        hint = "all are NaN, infinite or huge: export it again"
        raise InputError(f"{shape.name or 'the shape'}: no vertex has a usable position", hint)
    _note(notes, shape.V - int(valid.sum()), "vertex", "without a usable position dropped")
    far = spikes(shape.verts, shape.faces[shape.valid_faces])
    if far.any():
        _note(notes, int(far.sum()), "vertex", "far from all others dropped, as a spike is")
        valid = valid & ~far
    _note_rigid(notes, shape)
    return (_repair_cloud if shape.is_cloud else _repair_mesh)(shape, valid, notes)


def turned_outwards(shape: Shape) -> Shape:
    """The shape with its faces turned as `repair` turns them, and nothing else: a node of negative scale has them inside
    out, as some scans have.
    """
    real = np.flatnonzero(shape.face_areas > 0)
    if not len(real):
        return shape
    faces = seams(shape.verts, shape.faces)[shape.faces[real]]
    turned, many = turn_faces(shape.verts, faces, shape.face_vectors[real], edges_of(faces))
    if not many:
        return shape
    flip = real[(turned != faces).any(axis=1)]
    own = shape.faces.copy()
    own[flip] = own[flip][:, ::-1]
    return replace(shape, faces=own)


def _repair_cloud(shape: Shape, valid: Bools, notes: list[str]) -> Repaired:
    twin = np.where(valid, same_rows(shape.verts), np.arange(shape.V))
    kept = valid & (twin == np.arange(shape.V))
    _note(notes, int(valid.sum() - kept.sum()), "point", "merged with another at the same position")
    if shape.weights is not None:
        _note(notes, int((kept & (shape.weights == 0)).sum()), "point", NOT_TRUSTED)
        kept &= shape.weights > 0
    chosen = np.flatnonzero(kept)
    outlier = outlier_points(shape.verts[chosen])
    _note(notes, int(outlier.sum()), "outlier point", "far from all others dropped")
    kept[chosen[outlier]] = False
    return _result(shape, kept, twin, shape.faces, np.arange(shape.F), valid, notes)


def _repair_mesh(shape: Shape, valid: Bools, notes: list[str]) -> Repaired:
    bad = np.asarray((~valid)[shape.faces].any(axis=1))
    _note(notes, int(bad.sum()), "face", "at such vertices dropped")
    if shape.weights is not None:
        ignored = ~bad & ~(shape.weights > 0)[shape.faces].any(axis=1)
        _note(notes, int(ignored.sum()), "face", NOT_TRUSTED)
        bad |= ignored
    faces, cross, which = _without(bad, shape.faces, shape.face_vectors, np.arange(shape.F))
    twin = np.where(valid, seams(shape.verts, faces), np.arange(shape.V))
    doubles = int((twin != np.arange(shape.V)).sum())
    if doubles:
        _note(notes, doubles, "vertex", "merged with another at the same position")
        faces = twin[faces]
    stands = collapsed(shape.verts, faces, cross, shape.diagonal)
    joined = int((stands != np.arange(shape.V)).sum())
    if joined:
        _note(notes, joined, "edge", "without length collapsed")
        faces, twin = stands[faces], stands[twin]
        cross = np.where((faces == faces[:, [1, 2, 0]]).any(axis=1)[:, None], 0.0, cross)
    flat = flat_faces(shape.verts, faces, cross, shape.diagonal)
    _note(notes, int(flat.sum()), "face", "without area dropped")
    faces, cross, which = _without(flat, faces, cross, which)
    double = duplicate_faces(faces)
    _note(notes, int(double.sum()), "duplicate face", "dropped")
    faces, cross, which = _without(double, faces, cross, which)
    if len(faces) == 0:
        raise InputError(f"{shape.name or 'the shape'} has no face with any area", "is it a mesh at all?")
    outlier, outlier_parts, parts, far, far_share = find_parts(shape.verts, faces, cross, shape.skinned)
    what = f"dropped ({outlier.sum():,} {'face' if outlier.sum() == 1 else 'faces'}{_meshes_of(shape, faces[outlier])})"
    _note(notes, outlier_parts, "outlier part", what)
    faces, cross, which = _without(outlier, faces, cross, which)
    _note(notes, parts if parts > 1 else 0, "separate part", "kept")
    what = f"of these {'lies' if far == 1 else 'lie'} far from the rest, {far_share:.0%} of the area"
    _note(notes, far, "part", f"{what}: two objects in one file?")
    kept, touched = (np.bincount(each.ravel(), minlength=shape.V) > 0 for each in (faces, shape.faces))
    _note(notes, int((valid & ~touched).sum()), "vertex", "that no face uses dropped")
    edges = shape.edges if np.array_equal(faces, shape.faces) else edges_of(faces)
    faces, turned = turn_faces(shape.verts, faces, cross, edges)
    if turned == len(faces):
        notes.append("turned all faces: the shape was inside out")
    else:
        _note(notes, turned, "face", "turned to face the same way as the others")
    border, crowded = edges.counts
    _note(notes, border, "open edge", "(the surface has holes or a border)")
    _note(notes, crowded, "non-manifold edge", "(more than two faces meet there), left as they are")
    found = _result(shape, kept, twin, faces, which, valid, notes, far)
    smooth, passes = remove_noise(found.shape, parts)
    if not passes:
        return found
    return replace(found, shape=smooth, notes=(*found.notes, f"smoothed {passes} times, because noise hid the surface"))


def _note_rigid(notes: list[str], shape: Shape) -> None:
    """Name the meshes of a character that its skin does not move, unless somebody has chosen already."""
    counts = [count for _, count in shape.meshes]
    if shape.skinned is None or shape.weights is not None or sum(counts) != shape.V:
        return
    parts = zip(shape.meshes, np.split(shape.skinned, np.cumsum(counts)[:-1]), strict=True)
    names = list(dict.fromkeys(name for (name, _), moved in parts if name and not moved.any()))
    if names:
        listed = ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
        have = "has" if len(names) == 1 else "have"
        notes.append(f"{listed} {have} no skin, as weapons have: --without (without=) leaves parts out")


def _meshes_of(shape: Shape, faces: Int[Ints, "N 3"]) -> str:
    """Of which meshes of a scene some faces are, for a note; nothing where meshes have no names."""
    if not len(faces) or sum(count for _, count in shape.meshes) != shape.V:
        return ""
    mesh = np.repeat(np.arange(len(shape.meshes)), [count for _, count in shape.meshes])
    names = list(dict.fromkeys(name for k in np.unique(mesh[faces]) if (name := shape.meshes[k][0])))
    return f" of {', '.join(names[:_NAMED])}{', ...' if len(names) > _NAMED else ''}" if names else ""


def _without(bad: Bools, *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    return tuple(array[~bad] for array in arrays) if bad.any() else arrays


def _note(notes: list[str], count: int, noun: str, what: str) -> None:
    if count:
        plural = {"vertex": "vertices"}.get(noun, noun + "s")
        notes.append(f"{count:,} {noun if count == 1 else plural} {what}")


def _result(
    shape: Shape, kept: Bools, twin: Ints, faces: Ints, which: Ints, valid: Bools,
    notes: list[str], far_parts: int = 0,
) -> Repaired:  # fmt: skip
    chosen = np.flatnonzero(kept)
    if len(chosen) == 0:
        raise InputError(f"{shape.name or 'the shape'} has no usable vertex", "is it a mesh or a point cloud at all?")
    if len(chosen) == shape.V and not notes:
        return Repaired(shape, chosen, chosen, (), shape, which)
    new = np.full(shape.V, -1, np.int64)
    new[chosen] = np.arange(len(chosen))
    colors = None if shape.colors is None else shape.colors[chosen]
    weights = None if shape.weights is None else shape.weights[chosen]
    repaired = Shape(shape.verts[chosen], new[faces], shape.name, colors, weights=weights, upright=shape.upright)
    stands = twin if valid.all() else twin[_valid_neighbour(shape, valid)]
    answer = new[stands]
    lost = np.flatnonzero(answer < 0)
    if len(lost):
        from meshmatch.geometry.trees import cKDTree

        tree = cKDTree(repaired.verts, compact_nodes=False, balanced_tree=False)
        own = counterparts(shape, answer < 0)
        copied = (own >= 0) & (answer[own] >= 0)
        answer[lost] = tree.query(shape.verts[stands[lost]])[1]
        answer[copied] = answer[own[copied]]
        if copied.any():
            _note(
                notes, int(copied.sum()), "vertex", "of copies of the rest, elsewhere in the scene, matched as that is"
            )
            return Repaired(repaired, answer, chosen, tuple(notes), shape, which, far_parts, copied=copied)
    return Repaired(repaired, answer, chosen, tuple(notes), shape, which, far_parts)


def _valid_neighbour(shape: Shape, valid: Bools) -> Ints:
    """(V,) itself if valid; else a valid corner of one of its faces, or the nearest in file order."""
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
    return np.asarray(stands)
