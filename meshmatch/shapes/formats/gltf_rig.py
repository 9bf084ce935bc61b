"""Skeletons of glTF scenes: joints, how they stand, the weights of the vertices that they move, and animation clips.

Specification: Khronos glTF 2.0, sections 3.7.3 and 3.11.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from meshmatch.arrays import Brief, Float, Floats, Floats32, Int, Ints
from meshmatch.errors import InputError
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats.gltf import Document, local_matrix, understood
from meshmatch.shapes.formats.gltf_attributes import joint_nodes

Moved = Literal["rotation", "translation", "scale"]
_WIDTHS: dict[str, int] = {"rotation": 4, "translation": 3, "scale": 3}
_INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")
_FEW_KEYS = 3_500_000
"""Keys of clips that a file of any size may have; and one more for every 4 of its bytes: several may share theirs."""
MOST_JOINTS = 4096
_MOST_NODES = 4  # for each of them, with those above and below
_LARGEST = 1e18  # of a number: its square is still a 32-bit float


@dataclass(frozen=True, eq=False, repr=False)
class Track(Brief):
    """How one node moves in a clip.

    Of a cubic spline there are three values for each time: the slope before it, the value and the slope after it.
    """

    node: int
    moves: Moved
    times: Float[Floats, " T"]  # seconds
    values: Float[Floats, "N D"]  # rotations are x, y, z, w
    interpolation: str


@dataclass(frozen=True, eq=False, repr=False)
class Clip(Brief):
    """An animation of a skeleton."""

    name: str
    tracks: tuple[Track, ...]
    extras: Any = None  # what somebody noted in the file


@dataclass(frozen=True, eq=False, repr=False)
class Rig(Brief):
    """A skeleton: joints, the nodes above them and the empty ones below; parents come before their children.

    Rotations, translations and scales are those of each node in the frame of its parent, as the nodes stand.
    """

    names: tuple[str, ...]  # N; may be empty, or occur twice
    parents: Int[Ints, " N"]  # -1 for a node that hangs from nothing
    joints: Int[Ints, " J"]  # the node of each joint
    rotations: Float[Floats, "N 4"]  # x, y, z, w
    translations: Float[Floats, "N 3"]
    scales: Float[Floats, "N 3"]
    clips: tuple[Clip, ...]
    extras: tuple[Any, ...] = ()  # N, or none: what somebody noted at the nodes

    def worlds(self) -> Float[Floats, "N 4 4"]:
        """Where every node stands in the scene."""
        found = np.tile(np.eye(4), (len(self.parents), 1, 1))
        found[:, :3, :3] = Rotation.from_quat(self.rotations).as_matrix() * self.scales[:, None, :]
        found[:, :3, 3] = self.translations
        for node, parent in enumerate(self.parents.tolist()):
            if parent >= 0:
                found[node] = found[parent] @ found[node]
        return found


@dataclass(frozen=True, eq=False, repr=False)
class Binding(Brief):
    """A skeleton, and how it moves the vertices of a scene.

    Attributes
    ----------
    rig
        The skeleton as it is to stand, with its clips.
    bind
        Where its nodes stand when every vertex is where it was, but for the turn.
    joints
        Numbers in ``rig.joints`` of up to four joints for each vertex.
    weights
        How much each of them moves the vertex.
    turn
        What turns the scene upright.
    """

    rig: Rig
    bind: Float[Floats, "N 4 4"]
    joints: Int[NDArray[np.int32], "V K"]
    weights: Float[Floats32, "V K"]
    turn: Float[Floats, "3 3"] = field(default_factory=lambda: np.eye(3))

    def of(self, rows: Int[Ints, " N"]) -> Binding:
        """That of other vertices, which move as some of these do."""
        return replace(self, joints=self.joints[rows], weights=self.weights[rows])

    def table(self) -> tuple[NDArray[Any], Floats32]:
        """Joints and weights, four for each vertex, as a file holds them."""
        joints, weights = (np.pad(each, ((0, 0), (0, 4 - each.shape[1]))) for each in (self.joints, self.weights))
        return joints.astype("<u1" if len(self.rig.joints) <= 256 else "<u2"), weights.astype(np.float32)


def read_rig(path: Path, data: bytes) -> Rig:
    """The skeleton of a glb or gltf; its joints are those of all skins, in the order of `gltf_attributes.read_skin`.

    `InputError`: there is none, it is mirrored or too large, or the file is damaged.
    """
    return understood(path, data, "skeleton makes", _rig)


def _rig(document: Document) -> Rig:
    joints = joint_nodes(document)
    if not joints:
        raise InputError(f"{document.name} has no skin", "a rig has joints, and weights that bind a mesh to them")
    if len(joints) > MOST_JOINTS:
        raise InputError(f"{document.name} has {len(joints)} joints, of {MOST_JOINTS} at most", "export one character")
    list(document.primitives())  # walks through the scene
    chosen = nodes_of_skeleton(document, joints)
    if len(chosen) > _MOST_NODES * MOST_JOINTS:
        raise InputError(f"the skeleton of {document.name} has {len(chosen)} nodes, too many", "export one character")
    place = {node: k for k, node in enumerate(chosen)}
    parent = {int(child): node for node in chosen for child in document.nodes[node].get("children", [])}
    rotations, translations, scales = np.zeros((len(chosen), 4)), np.zeros((len(chosen), 3)), np.ones((len(chosen), 3))
    for k, node in enumerate(chosen):
        rotations[k], translations[k], scales[k] = _parts(document.name, document.nodes[node])
    rig = Rig(
        tuple(plain_text(str(document.nodes[node].get("name", ""))) for node in chosen),
        np.array([place.get(parent.get(node, -1), -1) for node in chosen], np.int64),
        np.array([place[node] for node in joints], np.int64),
        *(rotations, translations, scales),
        _clips(document, place),
        tuple(document.nodes[node].get("extras") for node in chosen),
    )
    worlds = rig.worlds()
    if not (np.isfinite(worlds).all() and np.abs(worlds).max() < _LARGEST):
        raise ValueError("a joint does not stand anywhere")
    return rig


def nodes_of_skeleton(document: Document, joints: list[int]) -> list[int]:
    """Joints, the nodes above them, and those below that hold nothing, parents before children."""
    if missing := [joint for joint in joints if joint not in document.world]:
        raise ValueError(f"joint {missing[0]} is not in the scene")
    parent = {int(child): node for node in document.world for child in document.nodes[node].get("children", [])}
    wanted = set(joints)
    for joint in joints:
        above = parent.get(joint)
        while above is not None and above not in wanted:
            wanted.add(above)
            above = parent.get(above)
    below = set(joints)
    for node in document.world:
        if parent.get(node) in below and not {"mesh", "camera", "extensions"} & document.nodes[node].keys():
            below.add(node)
    wanted |= below
    return [node for node in document.world if node in wanted]


def _parts(name: str, node: dict[str, Any]) -> tuple[Floats, Floats, Floats]:
    """Rotation (x, y, z, w), translation and scale of a node."""
    local = local_matrix(node)
    if "matrix" in node:
        left, _, right = np.linalg.svd(local[:3, :3])
        turn = left @ right
        scale = np.einsum("ij,ij->j", turn, local[:3, :3])
    else:
        turn = local_matrix({"rotation": node.get("rotation", (0, 0, 0, 1))})[:3, :3]
        scale = np.array(node.get("scale", (1, 1, 1)), np.float64)
    if np.linalg.det(turn) < 0 or scale.prod() < 0:
        hint = "apply the scale of its armature before it is exported"
        raise InputError(f"the skeleton of {name} is mirrored by a negative scale", hint)
    return Rotation.from_matrix(turn).as_quat(), local[:3, 3], scale


def _clips(document: Document, place: dict[int, int]) -> tuple[Clip, ...]:
    clips: list[Clip] = []
    arrays: dict[int, Floats] = {}
    keys = 0
    for number, animation in enumerate(document.json.get("animations", [])):
        tracks: list[Track] = []
        for channel in animation["channels"]:
            target, sampler = channel["target"], animation["samplers"][channel["sampler"]]
            node, moves = place.get(target.get("node", -1)), target["path"]
            if node is None or moves not in _WIDTHS:
                continue
            for accessor in (sampler["input"], sampler["output"]):
                if accessor not in arrays:
                    arrays[accessor] = document.accessor(accessor)
            times, values = arrays[sampler["input"]][:, 0], arrays[sampler["output"]]
            interpolation = sampler.get("interpolation", "LINEAR")
            many = len(times) * (3 if interpolation == "CUBICSPLINE" else 1)
            if interpolation not in _INTERPOLATIONS or not len(times) or values.shape != (many, _WIDTHS[moves]):
                raise ValueError(f"a channel of animation {number} has {values.shape} values for {len(times)} times")
            if moves == "rotation" and interpolation != "CUBICSPLINE":  # those of few bits are not
                values = values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-30)
            if not (np.abs(values) < _LARGEST).all() or not (np.abs(times) < _LARGEST).all():
                raise ValueError(f"animation {number} holds what is not a number")
            keys += many
            if keys > _FEW_KEYS + document.size // 4:
                many_keys = f"the clips of {document.name} have over {_FEW_KEYS:,} keys, many of them shared"
                raise InputError(many_keys, "export fewer clips, or sample them less often")
            tracks.append(Track(node, moves, times, values, interpolation))
        if tracks:
            name = plain_text(str(animation.get("name", f"clip {number}")))
            clips.append(Clip(name, tuple(tracks), animation.get("extras")))
    return tuple(clips)
