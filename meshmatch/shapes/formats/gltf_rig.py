"""Skeletons of glTF scenes: joints, their pose, skin weights and animation clips.

Specification: Khronos glTF 2.0, sections 3.7.3 and 3.11.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Bool, Bools, Float, Floats, Floats32, Int, Ints, ShortRepr
from meshmatch.errors import InputError
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats.gltf import Document, local_matrix, parse_document
from meshmatch.shapes.formats.gltf_attributes import joint_nodes

Moved = Literal["rotation", "translation", "scale"]
_WIDTHS: dict[str, int] = {"rotation": 4, "translation": 3, "scale": 3}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
_BASE_KEYS = 3_500_000
"""Keys of clips allowed in a file of any size; each 4 bytes allow one more (channels may share their keys)."""
MAX_JOINTS = 4096
_MAX_NODES_PER_JOINT = 4  # including the nodes above and below the joints
_MAX_VALUE = 1e18  # its square is still within the range of 32-bit floats


@dataclass(frozen=True, eq=False, repr=False)
class Track(ShortRepr):
    """Animation of one property of one node in a clip.

    A cubic spline has three values per time: in-tangent, value and out-tangent.
    """

    node: int
    moves: Moved
    times: Float[Floats, " T"]  # seconds
    values: Float[Floats, "N D"]  # rotations are x, y, z, w
    interpolation: str


@dataclass(frozen=True, eq=False, repr=False)
class Clip(ShortRepr):
    """An animation of a skeleton."""

    name: str
    tracks: tuple[Track, ...]
    extras: Any = None  # application-specific data of the file


@dataclass(frozen=True, eq=False, repr=False)
class Rig(ShortRepr):
    """A skeleton: joints, the nodes above them and empty nodes below them; parents come before their children.

    Rotations, translations and scales are those of each node relative to its parent, in the pose of the file.
    """

    names: tuple[str, ...]  # N; may be empty, and need not be unique
    parents: Int[Ints, " N"]  # -1 for a root
    joints: Int[Ints, " J"]  # the node of each joint
    rotations: Float[Floats, "N 4"]  # x, y, z, w
    translations: Float[Floats, "N 3"]
    scales: Float[Floats, "N 3"]
    clips: tuple[Clip, ...]
    extras: tuple[Any, ...] = ()  # N, or empty: application-specific data of the nodes

    def worlds(self) -> Float[Floats, "N 4 4"]:
        """World matrices of all nodes."""
        found = np.tile(np.eye(4), (len(self.parents), 1, 1))
        found[:, :3, :3] = Rotation.from_quat(self.rotations).as_matrix() * self.scales[:, None, :]
        found[:, :3, 3] = self.translations
        for node, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                found[node] = found[parent] @ found[node]
        return found

    def nodes_around(self, used: Bool[Bools, " J"]) -> Bool[Bools, " N"]:
        """Nodes of some joints: they, and all nodes below and above them."""
        below = np.zeros(len(self.parents), bool)
        below[self.joints[used]] = True
        for node, parent in enumerate(self.parents.tolist()):
            below[node] |= parent >= 0 and below[parent]
        around = below.copy()
        for node in reversed(np.flatnonzero(self.parents >= 0).tolist()):
            around[self.parents[node]] |= around[node]
        return around

    def restricted_to(self, kept: Bool[Bools, " N"]) -> Rig:
        """The skeleton of some nodes, which include the parents of each, and the clips that move them."""
        index = np.cumsum(kept) - 1
        tracks = [
            tuple(replace(each, node=int(index[each.node])) for each in clip.tracks if kept[each.node])
            for clip in self.clips
        ]
        return Rig(
            tuple(compress(self.names, kept)),
            np.where(self.parents < 0, -1, index[self.parents])[kept],
            index[self.joints[kept[self.joints]]],
            *(self.rotations[kept], self.translations[kept], self.scales[kept]),
            tuple(replace(clip, tracks=own) for clip, own in zip(self.clips, tracks, strict=True) if own),
            tuple(compress(self.extras, kept)),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Binding(ShortRepr):
    """A skeleton and its skin weights for the vertices of a scene.

    Attributes
    ----------
    rig
        The skeleton in the pose that is to be written, with its clips.
    bind
        World matrices of its nodes in the bind pose, in which every vertex is at its position in the scene after the turn.
    joints
        Up to four joints per vertex, as indices into ``rig.joints``.
    weights
        Weight of each of these joints.
    turn
        Rotation that makes the scene upright.
    """

    rig: Rig
    bind: Float[Floats, "N 4 4"]
    joints: Int[NDArray[np.int32], "V K"]
    weights: Float[Floats32, "V K"]
    turn: Float[Floats, "3 3"] = field(default_factory=lambda: np.eye(3))

    def of(self, rows: Int[Ints, " N"]) -> Binding:
        """Return the binding for other vertices: vertex k gets the joints and weights of vertex ``rows[k]`` here."""
        return replace(self, joints=self.joints[rows], weights=self.weights[rows])

    def table(self) -> tuple[NDArray[Any], Floats32]:
        """Joints and weights, four per vertex, in the data types of a glTF file."""
        joints, weights = (np.pad(each, ((0, 0), (0, 4 - each.shape[1]))) for each in (self.joints, self.weights))
        return joints.astype("<u1" if len(self.rig.joints) <= 256 else "<u2"), weights.astype(np.float32)


def read_rig(path: Path, data: bytes) -> Rig:
    """Read the skeleton of a glb or gltf: the joints of all skins, in the order of `gltf_attributes.read_skin`.

    `InputError` if there is none, if it is mirrored or too large, or if the file is damaged.
    """
    return parse_document(path, data, "skeleton makes", _rig)


def _rig(document: Document) -> Rig:
    joints = joint_nodes(document)
    if not joints:
        raise InputError(f"{document.name} has no skin", "a rig has joints, and weights that bind a mesh to them")
    if len(joints) > MAX_JOINTS:
        raise InputError(f"{document.name} has {len(joints)} joints, of {MAX_JOINTS} at most", "export one character")
    list(document.primitives())  # fills `document.world`
    chosen = nodes_of_skeleton(document, joints)
    if len(chosen) > _MAX_NODES_PER_JOINT * MAX_JOINTS:
        raise InputError(f"the skeleton of {document.name} has {len(chosen)} nodes, too many", "export one character")
    index_of = {node: k for k, node in enumerate(chosen)}
    parent = {int(child): node for node in chosen for child in document.nodes[node].get("children", [])}
    rotations, translations, scales = np.zeros((len(chosen), 4)), np.zeros((len(chosen), 3)), np.ones((len(chosen), 3))
    for k, node in enumerate(chosen):
        rotations[k], translations[k], scales[k] = _decompose(document.name, document.nodes[node])
    rig = Rig(
        tuple(plain_text(str(document.nodes[node].get("name", ""))) for node in chosen),
        np.array([index_of.get(parent.get(node, -1), -1) for node in chosen], np.int64),
        np.array([index_of[node] for node in joints], np.int64),
        *(rotations, translations, scales),
        _clips(document, index_of),
        tuple(document.nodes[node].get("extras") for node in chosen),
    )
    worlds = rig.worlds()
    if not (np.isfinite(worlds).all() and np.abs(worlds).max() < _MAX_VALUE):
        raise ValueError("a joint does not stand anywhere")
    return rig


def nodes_of_skeleton(document: Document, joints: list[int]) -> list[int]:
    """Joints, the nodes above them, and the empty nodes below them, parents before children."""
    if missing := [joint for joint in joints if joint not in document.world]:
        raise ValueError(f"joint {missing[0]} is not in the scene")
    parent = {int(child): node for node in document.world for child in document.nodes[node].get("children", [])}
    chosen = set(joints)
    for joint in joints:
        above = parent.get(joint)
        while above is not None and above not in chosen:
            chosen.add(above)
            above = parent.get(above)
    below = set(joints)
    for node in document.world:
        if parent.get(node) in below and not {"mesh", "camera", "extensions"} & document.nodes[node].keys():
            below.add(node)
    chosen |= below
    return [node for node in document.world if node in chosen]


def _decompose(name: str, node: dict[str, Any]) -> tuple[Floats, Floats, Floats]:
    """Rotation (x, y, z, w), translation and scale of a node; the shear of a matrix is dropped (polar decomposition).

    `InputError` if the scale mirrors.
    """
    local = local_matrix(node)
    if "matrix" in node:
        u, _, vt = np.linalg.svd(local[:3, :3])
        rotation = u @ vt
        scale = np.einsum("ij,ij->j", rotation, local[:3, :3])
    else:
        rotation = local_matrix({"rotation": node.get("rotation", (0, 0, 0, 1))})[:3, :3]
        scale = np.array(node.get("scale", (1, 1, 1)), np.float64)
    if np.linalg.det(rotation) < 0 or scale.prod() < 0:
        hint = "apply the scale of its armature before it is exported"
        raise InputError(f"the skeleton of {name} is mirrored by a negative scale", hint)
    return Rotation.from_matrix(rotation).as_quat(), local[:3, 3], scale


def _clips(document: Document, index_of: dict[int, int]) -> tuple[Clip, ...]:
    clips: list[Clip] = []
    arrays: dict[int, Floats] = {}
    keys = 0
    for number, animation in enumerate(document.json.get("animations", [])):
        tracks: list[Track] = []
        for channel in animation["channels"]:
            target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
            node, moves = index_of.get(target.get("node", -1)), target["path"]
            if node is None or moves not in _WIDTHS:
                continue
            for accessor in (sampler["input"], sampler["output"]):
                if accessor not in arrays:
                    arrays[accessor] = document.accessor(accessor)
            times, values = arrays[sampler["input"]][:, 0], arrays[sampler["output"]]
            interpolation = sampler.get("interpolation", "LINEAR")
            n_keys = len(times) * (3 if interpolation == "CUBICSPLINE" else 1)
            if interpolation not in _INTERPOLATIONS or not len(times) or values.shape != (n_keys, _WIDTHS[moves]):
                raise ValueError(f"a channel of animation {number} has {values.shape} values for {len(times)} times")
            if moves == "rotation" and interpolation != "CUBICSPLINE":  # quantised quaternions are not of unit length
                values = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-30)
            if not (np.abs(values) < _MAX_VALUE).all() or not (np.abs(times) < _MAX_VALUE).all():
                raise ValueError(f"animation {number} holds what is not a number")
            if (np.diff(times) < 0).any():
                raise ValueError(f"the times of animation {number} go back")
            keys += n_keys
            if keys > _BASE_KEYS + document.size // 4:
                message = f"the clips of {document.name} have over {_BASE_KEYS:,} keys, many of them shared"
                raise InputError(message, "export fewer clips, or sample them less often")
            tracks.append(Track(node, moves, times, values, interpolation))
        if tracks:
            name = plain_text(str(animation.get("name", f"clip {number}")))
            clips.append(Clip(name, tuple(tracks), animation.get("extras")))
    return tuple(clips)
