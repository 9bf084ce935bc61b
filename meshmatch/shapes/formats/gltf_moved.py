"""A glTF scene whose vertices have moved: nodes, meshes, skins, materials and images stay as they are.

What belongs to vertices turns with them: normals, tangents and morph targets, which also grow. All is stored as the node or
the skin puts it into place, so that the scene stands as it was asked to; joints stay where they are.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import edge_lengths, edges_of, unit
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor, drawn, frames_of
from meshmatch.shapes.formats.gltf_out import VERTICES


def moved(document: Document, verts: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> bytes:
    """The scene as a glb whose vertices are elsewhere.

    Parameters
    ----------
    document
        The scene.
    verts
        Where its vertices are now, in the order of `gltf.read`; a row that is not finite stays.
    turns
        The rotation around each of them.
    """
    editor = Editor(document)
    seen = 0
    for number, parts in drawn(document).items():
        mesh = editor.own_mesh(number)
        for k, part in parts.items():
            some = slice(seen, seen + document.count(part["attributes"]["POSITION"]))
            seen = some.stop
            _move(editor, document, number, part, mesh["primitives"][k], verts[some], turns[some])
    editor.prune(document)
    return editor.to_bytes()


def _move(
    editor: Editor,
    document: Document,
    number: int,
    part: dict[str, Any],
    own: dict[str, Any],
    verts: Float[Floats, "N 3"],
    turns: Float[Floats, "N 3 3"],
) -> None:
    place = document.world[number]
    before, frames = document.placed(number, part, place), frames_of(document, number, part)
    origin = document.moved(number, part, np.tile([0.0, 0.0, 0.0, 1.0], (len(verts), 1)), place)
    back = np.linalg.pinv(frames)
    kept = np.asarray(~np.isfinite(verts).all(axis=1))
    now = np.where(kept[:, None], before, verts)
    turned = back @ np.where(kept[:, None, None], np.eye(3), turns) @ frames
    facing = np.linalg.pinv(turned).swapaxes(1, 2)  # normals turn so that they stay across tangents

    def rows(accessor: int, by: NDArray[Any]) -> Floats:
        values = document.accessor(accessor)
        return np.hstack([np.einsum("vij,vj->vi", by, values[:, :3]), values[:, 3:]])

    attributes = own["attributes"]
    local = np.einsum("vij,vj->vi", back, now - origin)
    attributes["POSITION"] = editor.add_array(local.astype("<f4"), bounds=True, target=VERTICES)
    for key, by in (("NORMAL", facing), ("TANGENT", turned)):
        if key in attributes:
            values = rows(attributes[key], by)
            values[:, :3] = unit(values[:, :3])
            attributes[key] = editor.add_array(values.astype("<f4"), target=VERTICES)
    growth = _growth(before, now, document.triangles(part)) if "targets" in own else np.ones(len(now))
    for target in own.get("targets", []):
        for key, by in (("POSITION", growth[:, None, None] * turned), ("NORMAL", facing), ("TANGENT", turned)):
            if key in target:
                target[key] = editor.add_sparse(rows(target[key], by).astype(np.float32), bounds=key == "POSITION")


def _growth(before: Float[Floats, "N 3"], now: Float[Floats, "N 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, " N"]:
    """How much longer the edges at each vertex have become."""
    edges = edges_of(faces).vertices
    sums = [np.bincount(edges.T.ravel(), np.tile(edge_lengths(each, edges), 2), len(now)) for each in (before, now)]
    usual = float(sums[1].sum() / sums[0].sum()) if sums[0].sum() > 0 else 1.0
    return np.asarray(np.where(sums[0] > 0, sums[1] / np.where(sums[0] > 0, sums[0], 1.0), usual), np.float64)
