"""Skeletons of meshes that have moved: that of the body that a garment sits on, or their own, carried along."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array

from meshmatch.api.results import MapPair
from meshmatch.errors import InputError, warn
from meshmatch.maps.folds import known_normals
from meshmatch.maps.mapped_mesh import MappedMesh
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.formats.gltf_rig import Binding, read_rig
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.attributes import joint_table, largest_weights, pull_weights
from meshmatch.transfer.carry_rig import UP, carry, upright
from meshmatch.transfer.clean_weights import clean_weights
from meshmatch.transfer.retarget_clips import standing_clips
from meshmatch.transfer.weight_files import SkinWeights, load_weights

INFLUENCES = 4
"""Joints that may move a vertex: what all programs read."""


def has_skin(file: Path | None) -> bool:
    """Whether joints of a file move a mesh of it."""
    if file is None or file.suffix.lower() not in gltf.SUFFIXES:
        return False

    def found(document: gltf.Document) -> bool:
        return any({"mesh", "skin"} <= node.keys() for node in document.nodes)

    return gltf.understood(file, read_bytes(file), "scene makes", found)


def bound_to(maps: MapPair, file: Path | None, garment: Shape, original: Path | None) -> Binding | None:
    """How the skeleton of the target's file moves a garment that was on the source: by the weights of its ``original`` file,
    if the joints of these have their namesakes in the target, or else as the skin that is below it on the source. None
    where the target has no skeleton; one that cannot be followed is told.
    """
    if file is None or not has_skin(file):
        return None
    try:
        rig, skin = read_rig(file, read_bytes(file)), load_weights(file, maps.target)
        own = load_weights(original, garment) if original is not None and has_skin(original) else None
    except InputError as error:
        warn(f"{garment.name} does not move with {file.name}: {error.message}")
        return None
    found = None if own is None else _renamed(own, skin.names)
    if found is None:
        near = MappedMesh.of(maps.source).query(garment.verts, known_normals(garment), maps.threads)
        below = VertexMap.between(garment, maps.source, near.vertex, face=near.face, barycentric=near.barycentric)
        skin_below = pull_weights(maps.forward, skin.matrix, INFLUENCES)
        found = clean_weights(pull_weights(below, skin_below, INFLUENCES), garment, INFLUENCES)
    return Binding(rig, rig.worlds(), *joint_table(largest_weights(found, INFLUENCES)))


def _renamed(weights: SkinWeights, names: tuple[str, ...]) -> csr_array | None:
    """Weights of the joints with these names; None where one that moves something has none."""
    place = {name: k for k, name in enumerate(names)}
    column = np.array([place.get(name, -1) for name in weights.names])[weights.matrix.indices]
    if (column < 0).any():
        return None
    matrix = weights.matrix
    return csr_array((matrix.data, column, matrix.indptr), (matrix.shape[0], len(names)))


def carried_along(original: Path | None, now: Shape, stands: bool) -> Binding | None:
    """The skeleton of a mesh's own file, each joint where the skin around it has gone, with its clips; None where there is
    none, or where an extension knows its nodes, as that of a vrm does.

    ``stands`` says that the mesh stands along y where it is ``now``; else the skeleton turns it.
    """
    if original is None or not has_skin(original):
        return None
    data = read_bytes(original)
    extensions = gltf.understood(original, data, "scene makes", lambda document: document.json.get("extensions", {}))
    if any(name.startswith("VRM") for name in extensions):
        return None
    before = load_shape(original)
    rig, weights = read_rig(original, data), load_weights(original, before)
    share = np.where(before.valid, before.vertex_areas / max(before.area, 1e-300) * before.V + 1e-3, 0.0)
    turn = np.eye(3) if stands else upright(before, now.verts, share)
    places = now.verts @ turn.T
    carried = carry(rig, weights.matrix, before, places, share, float(places[now.valid, UP].min()))
    standing = replace(carried.bind, clips=standing_clips(carried.bind, carried.source_pose))
    table = joint_table(largest_weights(weights.matrix, INFLUENCES))
    return Binding(standing, carried.bind.worlds(), *table, turn)
