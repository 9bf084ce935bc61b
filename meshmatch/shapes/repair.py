"""Repair of shapes for processing, with a correspondence for every original vertex.

Repairs are conservative: no hole is closed, no face is added, and vertices move only where noise is smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Int, Ints, ShortRepr
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import edges_of, same_rows
from meshmatch.shapes.cloud import outlier_points
from meshmatch.shapes.copies import counterparts
from meshmatch.shapes.denoise import remove_noise
from meshmatch.shapes.faces import (
    collapse_short_edges,
    degenerate_faces,
    duplicate_faces,
    find_outlier_parts,
    find_spikes,
    orient_faces,
    seam_representatives,
)
from meshmatch.shapes.shape import Shape

_MAX_LISTED = 5  # maximum number of meshes in a note
NOT_TRUSTED = "left out, as was asked for (weight 0)"
"""The end of a note about faces or points of weight 0."""


@dataclass(frozen=True, eq=False, repr=False)
class Repaired(ShortRepr):
    """A repaired shape, and its relation to the original.

    All vertices of `shape` are valid and, in a mesh, used by a face; they have not moved, unless noise was smoothed.

    Attributes
    ----------
    shape
        The repaired shape.
    original_to_repaired
        (V_original,) vertex that represents each original one: itself, its twin at the same position, the other end of
        an edge without length, or if it was dropped the nearest one. The nearest to a vertex without a position is a
        valid corner of one of its faces, or without one the nearest in the file's order.
    kept_vertex
        (V,) original vertex of each vertex, increasing.
    notes
        What was found and done, a line each; none for a shape without defects.
    original
        The shape that was repaired.
    kept_face
        (F,) original face of each face, whose corners may be reversed or replaced by twins.
    far_parts
        Number of big parts that lie far from the largest one: perhaps two objects in one file. They are kept.
    left_out
        Numbers of parts (`meshmatch.shapes.parts`) that were left out, as only the others are of the model's kind.
    copied
        (V_original,) vertices that were dropped with a copy of all kept parts, such as the same figure at another node
        of a scene; their counterparts represent them.
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
    """Drop invalid parts of a shape and merge duplicates, and report it.

    In this order: vertices without a position, single vertices far from all others (`meshmatch.shapes.faces.find_spikes`),
    and the faces that touch them; faces, or points, of weight 0; vertices at exactly the same position are merged if
    they lie on an open edge (texture seams of obj and glTF files, every corner of an stl; two layers that merely touch
    stay separate); edges without length are collapsed; faces without area; duplicate faces (both of them, where they
    are a flap without volume on a closed surface); outlier parts (see `meshmatch.shapes.faces.OUTLIER_SHARE`; if
    together they are more than a tenth of the surface, the shape is made of small parts, and only those far from the
    rest are outliers; never parts that joints move, such as the shells of a robot's fingers); vertices without a face.
    Then faces are oriented consistently and outwards. Open and non-manifold edges are counted, not repaired. Where
    noise is as large as the triangles, the surface is smoothed (`meshmatch.shapes.denoise`). For a cloud: points
    without a position, duplicates, and outliers far from all others are dropped.

    `InputError` if nothing is left: no face of a mesh has any area.
    """
    notes: list[str] = []
    valid = shape.valid
    if not valid.any():
        hint = "all are NaN, infinite or huge: export it again"
        raise InputError(f"{shape.name or 'the shape'}: no vertex has a usable position", hint)
    _add_note(notes, shape.V - int(valid.sum()), "vertex", "without a usable position dropped")
    far = find_spikes(shape.verts, shape.faces[shape.valid_faces])
    if far.any():
        _add_note(notes, int(far.sum()), "vertex", "far from all others dropped (spikes)")
        valid = valid & ~far
    _note_rigid(notes, shape)
    return (_repair_cloud if shape.is_cloud else _repair_mesh)(shape, valid, notes)


def oriented_outwards(shape: Shape) -> Shape:
    """The shape with faces oriented as by `repair`, and no other change.

    Nodes of negative scale, and some scans, are inside out.
    """
    has_area = np.flatnonzero(shape.face_areas > 0)
    if not len(has_area):
        return shape
    faces = seam_representatives(shape.verts, shape.faces)[shape.faces[has_area]]
    oriented, n_turned = orient_faces(shape.verts, faces, shape.face_vectors[has_area], edges_of(faces))
    if not n_turned:
        return shape
    flip = has_area[(oriented != faces).any(axis=1)]
    all_faces = shape.faces.copy()
    all_faces[flip] = all_faces[flip][:, ::-1]
    return replace(shape, faces=all_faces)


def _repair_cloud(shape: Shape, valid: Bools, notes: list[str]) -> Repaired:
    twin = np.where(valid, same_rows(shape.verts), np.arange(shape.V))
    kept = valid & (twin == np.arange(shape.V))
    _add_note(notes, int(valid.sum() - kept.sum()), "point", "merged with another at the same position")
    if shape.weights is not None:
        _add_note(notes, int((kept & (shape.weights == 0)).sum()), "point", NOT_TRUSTED)
        kept &= shape.weights > 0
    chosen = np.flatnonzero(kept)
    outlier = outlier_points(shape.verts[chosen])
    _add_note(notes, int(outlier.sum()), "outlier point", "far from all others dropped")
    kept[chosen[outlier]] = False
    return _build_result(shape, kept, twin, shape.faces, np.arange(shape.F), valid, notes)


def _repair_mesh(shape: Shape, valid: Bools, notes: list[str]) -> Repaired:
    drop = np.asarray((~valid)[shape.faces].any(axis=1))
    _add_note(notes, int(drop.sum()), "face", "at these vertices dropped")
    if shape.weights is not None:
        ignored = ~drop & ~(shape.weights > 0)[shape.faces].any(axis=1)
        _add_note(notes, int(ignored.sum()), "face", NOT_TRUSTED)
        drop |= ignored
    faces, cross, original_face = _drop(drop, shape.faces, shape.face_vectors, np.arange(shape.F))
    twin = np.where(valid, seam_representatives(shape.verts, faces), np.arange(shape.V))
    n_doubles = int((twin != np.arange(shape.V)).sum())
    if n_doubles:
        _add_note(notes, n_doubles, "vertex", "merged with another at the same position")
        faces = twin[faces]
    representative = collapse_short_edges(shape.verts, faces, cross, shape.diagonal)
    n_collapsed = int((representative != np.arange(shape.V)).sum())
    if n_collapsed:
        _add_note(notes, n_collapsed, "edge", "without length collapsed")
        faces, twin = representative[faces], representative[twin]
        cross = np.where((faces == faces[:, [1, 2, 0]]).any(axis=1)[:, None], 0.0, cross)
    flat = degenerate_faces(shape.verts, faces, cross, shape.diagonal)
    _add_note(notes, int(flat.sum()), "face", "without area dropped")
    faces, cross, original_face = _drop(flat, faces, cross, original_face)
    double = duplicate_faces(faces)
    _add_note(notes, int(double.sum()), "duplicate face", "dropped")
    faces, cross, original_face = _drop(double, faces, cross, original_face)
    if len(faces) == 0:
        raise InputError(f"{shape.name or 'the shape'} has no face with any area", "is it a mesh at all?")
    outlier, outlier_parts, parts, far, far_share = find_outlier_parts(shape.verts, faces, cross, shape.skinned)
    text = (
        f"dropped ({outlier.sum():,} {'face' if outlier.sum() == 1 else 'faces'}"
        f"{_describe_meshes(shape, faces[outlier])})"
    )
    _add_note(notes, outlier_parts, "outlier part", text)
    faces, cross, original_face = _drop(outlier, faces, cross, original_face)
    _add_note(notes, parts if parts > 1 else 0, "separate part", "kept")
    text = f"of these {'lies' if far == 1 else 'lie'} far from the rest, {far_share:.0%} of the area"
    _add_note(notes, far, "part", f"{text}: two objects in one file?")
    kept, touched = (np.bincount(each.ravel(), minlength=shape.V) > 0 for each in (faces, shape.faces))
    _add_note(notes, int((valid & ~touched).sum()), "vertex", "that no face uses dropped")
    edges = shape.edges if np.array_equal(faces, shape.faces) else edges_of(faces)
    faces, n_turned = orient_faces(shape.verts, faces, cross, edges)
    if n_turned == len(faces):
        notes.append("turned all faces: the shape was inside out")
    else:
        _add_note(notes, n_turned, "face", "turned to face the same way as the others")
    n_open, n_nonmanifold = edges.counts
    _add_note(notes, n_open, "open edge", "(the surface has holes or a border)")
    _add_note(notes, n_nonmanifold, "non-manifold edge", "(more than two faces meet there), left as they are")
    repaired = _build_result(shape, kept, twin, faces, original_face, valid, notes, far)
    smooth, passes = remove_noise(repaired.shape, parts)
    if not passes:
        return repaired
    return replace(
        repaired, shape=smooth, notes=(*repaired.notes, f"smoothed {passes} times, because noise hid the surface")
    )


def _note_rigid(notes: list[str], shape: Shape) -> None:
    """Note the meshes of a character without a skin, unless vertices have weights already."""
    counts = [count for _, count in shape.meshes]
    if shape.skinned is None or shape.weights is not None or sum(counts) != shape.V:
        return
    parts = zip(shape.meshes, np.split(shape.skinned, np.cumsum(counts)[:-1]), strict=True)
    names = list(dict.fromkeys(name for (name, _), moved in parts if name and not moved.any()))
    if names:
        listed = ", ".join(names[:_MAX_LISTED]) + (", ..." if len(names) > _MAX_LISTED else "")
        have = "has" if len(names) == 1 else "have"
        notes.append(f"{listed} {have} no skin, as weapons have: --without (without=) leaves parts out")


def _describe_meshes(shape: Shape, faces: Int[Ints, "N 3"]) -> str:
    """Words for the meshes of a scene that faces belong to, for a note; empty if meshes have no names."""
    if not len(faces) or sum(count for _, count in shape.meshes) != shape.V:
        return ""
    mesh = np.repeat(np.arange(len(shape.meshes)), [count for _, count in shape.meshes])
    names = list(dict.fromkeys(name for k in np.unique(mesh[faces]) if (name := shape.meshes[k][0])))
    return f" of {', '.join(names[:_MAX_LISTED])}{', ...' if len(names) > _MAX_LISTED else ''}" if names else ""


def _drop(bad: Bools, *arrays: NDArray[Any]) -> tuple[NDArray[Any], ...]:
    return tuple(array[~bad] for array in arrays) if bad.any() else arrays


def _add_note(notes: list[str], count: int, noun: str, what: str) -> None:
    if count:
        plural = {"vertex": "vertices"}.get(noun, noun + "s")
        notes.append(f"{count:,} {noun if count == 1 else plural} {what}")


def _build_result(
    shape: Shape, kept: Bools, twin: Ints, faces: Ints, which: Ints, valid: Bools,
    notes: list[str], far_parts: int = 0,
) -> Repaired:  # fmt: skip
    """The repaired shape of the kept vertices and faces, and its relation to the original."""
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
    representative = twin if valid.all() else twin[_valid_representative(shape, valid)]
    to_repaired = new[representative]
    dropped = np.flatnonzero(to_repaired < 0)
    if len(dropped):
        from meshmatch.geometry.trees import cKDTree

        tree = cKDTree(repaired.verts, compact_nodes=False, balanced_tree=False)
        counterpart = counterparts(shape, to_repaired < 0)
        copied = (counterpart >= 0) & (to_repaired[counterpart] >= 0)
        to_repaired[dropped] = tree.query(shape.verts[representative[dropped]])[1]
        to_repaired[copied] = to_repaired[counterpart[copied]]
        if copied.any():
            _add_note(
                notes, int(copied.sum()), "vertex", "of copies elsewhere in the scene, matched like their originals"
            )
            return Repaired(repaired, to_repaired, chosen, tuple(notes), shape, which, far_parts, copied=copied)
    return Repaired(repaired, to_repaired, chosen, tuple(notes), shape, which, far_parts)


def _valid_representative(shape: Shape, valid: Bools) -> Ints:
    """(V,) each vertex if valid; else a valid corner of one of its faces, or the nearest valid vertex in file order."""
    valid_indices = np.flatnonzero(valid)
    indices = np.arange(shape.V)
    after = np.searchsorted(valid_indices, indices).clip(max=len(valid_indices) - 1)
    before = (after - 1).clip(min=0)
    nearer = indices - valid_indices[before] < np.abs(valid_indices[after] - indices)
    representative = np.where(nearer & ~valid, valid_indices[before], valid_indices[after])
    for k in range(3):
        for other in ((k + 1) % 3, (k + 2) % 3):
            a, b = shape.faces[:, k], shape.faces[:, other]
            is_better = ~valid[a] & valid[b]
            representative[a[is_better]] = b[is_better]
    return np.asarray(representative)
