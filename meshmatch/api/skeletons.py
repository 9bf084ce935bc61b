"""Skeletons for moved meshes: the skeleton of the body under a garment, or the mesh's own skeleton moved with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from meshmatch.api.results import MapPair
from meshmatch.errors import InputError, warn
from meshmatch.maps.folds import normals_or_zeros
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_rig import Binding, read_rig
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import joint_table, largest_weights, pull_weights
from meshmatch.transfer.carry_rig import UP, rotation_to_upright, transfer_skeleton
from meshmatch.transfer.clean_weights import clean_weights
from meshmatch.transfer.retarget_clips import standing_clips
from meshmatch.transfer.weight_files import SkinWeights, load_weights

INFLUENCES = 4
"""Maximum number of joints per vertex, which all programs support."""


def has_skin(file: Path | None) -> bool:
    """Whether a glTF file contains a skinned mesh."""
    if file is None or file.suffix.lower() not in gltf.SUFFIXES:
        return False

    def found(document: gltf.Document) -> bool:
        return any({"mesh", "skin"} <= node.keys() for node in document.nodes)

    return gltf.parse_document(file, read_bytes(file), "scene makes", found)


def bind_garment(maps: MapPair, file: Path | None, garment: Shape, original: Path | None) -> Binding | None:
    """Bind a garment, in its place on the source, to the skeleton of the target's ``file``.

    The garment keeps the skin weights of its ``original`` file if all joints they use exist in the target by name.
    Otherwise it takes the transferred weights of the source's surface nearest to it. Return None if the target has no
    skeleton, or if one of the skeletons cannot be read, with a warning.
    """
    if file is None or not has_skin(file):
        return None
    try:
        rig, skin = read_rig(file, read_bytes(file)), load_weights(file, maps.target)
        own = load_weights(original, garment) if original is not None and has_skin(original) else None
    except InputError as error:
        warn(f"{garment.name} does not move with {file.name}: {error.message}")
        return None
    found = None if own is None else _reorder_joints(own, skin.names)
    if found is None:
        near = MappedMesh.of(maps.source).query(garment.verts, normals_or_zeros(garment), maps.threads)
        below = VertexMap.between(garment, maps.source, near.vertex, face=near.face, barycentric=near.barycentric)
        skin_below = pull_weights(maps.forward, skin.matrix, INFLUENCES)
        found = clean_weights(pull_weights(below, skin_below, INFLUENCES), garment, INFLUENCES)
    return Binding(rig, rig.worlds(), *joint_table(largest_weights(found, INFLUENCES)))


def _reorder_joints(weights: SkinWeights, names: tuple[str, ...]) -> csr_array | None:
    """Skin weights with columns in the order of ``names``; None if a joint that moves a vertex is not among them."""
    index = {name: k for k, name in enumerate(names)}
    column = np.array([index.get(name, -1) for name in weights.names])[weights.matrix.indices]
    if (column < 0).any():
        return None
    matrix = weights.matrix
    return csr_array((matrix.data, column, matrix.indptr), (matrix.shape[0], len(names)))


def move_skeleton(original: Path | None, now: Shape, is_upright: bool) -> Binding | None:
    """Move the skeleton of a mesh's ``original`` file, with its clips, to the mesh as it is ``now``.

    Each joint follows the skin around it. Return None if the file has no skeleton, or is a VRM, whose extension refers to
    its nodes. If y is not the up axis of the moved mesh (``is_upright``), the binding turns it upright.
    """
    if original is None or not has_skin(original):
        return None
    data = read_bytes(original)
    extensions = gltf.parse_document(
        original, data, "scene makes", lambda document: document.json.get("extensions", {})
    )
    if any(name.startswith("VRM") for name in extensions):
        return None
    before = load_shape(original)
    rig, weights = read_rig(original, data), load_weights(original, before)
    share = np.where(before.valid, before.vertex_areas / max(before.area, 1e-300) * before.V + 1e-3, 0.0)
    turn = np.eye(3) if is_upright else rotation_to_upright(before, now.verts, share)
    places = now.verts @ turn.T
    carried = transfer_skeleton(rig, weights.matrix, before, places, share, float(places[now.valid, UP].min()))
    standing = replace(carried.bind, clips=standing_clips(carried.bind, carried.source_pose))
    table = joint_table(largest_weights(weights.matrix, INFLUENCES))
    return Binding(standing, carried.bind.worlds(), *table, turn)
