"""Write a glTF scene with new vertex positions: nodes, meshes, skins, materials and images are kept.

Normals, tangents and morph targets rotate with their vertices; morph targets are also scaled by the local stretch. All are
stored in the local coordinates that the node or the skin, with joints unmoved, maps to the requested positions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.geometry.triangles import edge_lengths, edges_of, normalized
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor, drawn_nodes, vertex_frames
from meshmatch.shapes.formats.gltf_write import VERTICES


def with_positions(document: Document, verts: Float[Floats, "V 3"], turns: Float[Floats, "V 3 3"]) -> bytes:
    """Return the scene as a glb with new vertex positions.

    Parameters
    ----------
    document
        The scene.
    verts
        New positions, in the order of `gltf.read`; vertices with a row that is not finite are not moved.
    turns
        Rotation at each vertex.
    """
    editor = Editor(document)
    first = 0
    for number, parts in drawn_nodes(document).items():
        mesh = editor.own_mesh(number)
        for k, part in parts.items():
            rows = slice(first, first + document.count(part["attributes"]["POSITION"]))
            first = rows.stop
            _move(editor, document, number, part, mesh["primitives"][k], verts[rows], turns[rows])
    editor.prune(document)
    return editor.to_bytes()


def _move(
    editor: Editor,
    document: Document,
    number: int,
    part: dict[str, Any],
    primitive: dict[str, Any],
    verts: Float[Floats, "N 3"],
    turns: Float[Floats, "N 3 3"],
) -> None:
    """Store a primitive with new positions, and rotate its normals, tangents and morph targets."""
    matrix = document.world[number]
    before, frames = document.scene_positions(number, part, matrix), vertex_frames(document, number, part)
    origin = document.to_scene(number, part, np.tile([0.0, 0.0, 0.0, 1.0], (len(verts), 1)), matrix)
    to_local = np.linalg.pinv(frames)
    unmoved = np.asarray(~np.isfinite(verts).all(axis=1))
    now = np.where(unmoved[:, None], before, verts)
    local_turns = to_local @ np.where(unmoved[:, None, None], np.eye(3), turns) @ frames
    normal_maps = np.linalg.pinv(local_turns).swapaxes(1, 2)  # normals transform by the inverse transpose

    def rows(accessor: int, by: NDArray[Any]) -> Floats:
        values = document.accessor(accessor)
        return np.hstack([np.einsum("vij,vj->vi", by, values[:, :3]), values[:, 3:]])

    attributes = primitive["attributes"]
    local = np.einsum("vij,vj->vi", to_local, now - origin)
    attributes["POSITION"] = editor.add_array(local.astype("<f4"), bounds=True, target=VERTICES)
    for key, by in (("NORMAL", normal_maps), ("TANGENT", local_turns)):
        if key in attributes:
            values = rows(attributes[key], by)
            values[:, :3] = normalized(values[:, :3])
            attributes[key] = editor.add_array(values.astype("<f4"), target=VERTICES)
    stretch = _stretch(before, now, document.triangles(part)) if "targets" in primitive else np.ones(len(now))
    for target in primitive.get("targets", []):
        for key, by in (
            ("POSITION", stretch[:, None, None] * local_turns),
            ("NORMAL", normal_maps),
            ("TANGENT", local_turns),
        ):
            if key in target:
                target[key] = editor.add_sparse(rows(target[key], by).astype(np.float32), bounds=key == "POSITION")


def _stretch(before: Float[Floats, "N 3"], now: Float[Floats, "N 3"], faces: Int[Ints, "F 3"]) -> Float[Floats, " N"]:
    """Ratio of new to old total length of the edges at each vertex; the overall ratio for vertices without edges."""
    edges = edges_of(faces).vertices
    sums = [np.bincount(edges.T.ravel(), np.tile(edge_lengths(each, edges), 2), len(now)) for each in (before, now)]
    overall = float(sums[1].sum() / sums[0].sum()) if sums[0].sum() > 0 else 1.0
    return np.asarray(np.where(sums[0] > 0, sums[1] / np.where(sums[0] > 0, sums[0], 1.0), overall), np.float64)
