"""Add a skeleton to a glTF scene that moves everything drawn; nodes, materials and vertex positions are kept.

Specification: Khronos glTF 2.0, sections 3.7.3 and 3.11.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import warn
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_attachments import count_vertices, reattach_children, warn_of_detached
from meshmatch.shapes.formats.gltf_edit import Editor, drawn_nodes
from meshmatch.shapes.formats.gltf_prune import can_edit_nodes, drop_nodes
from meshmatch.shapes.formats.gltf_rig import Binding, Clip, Rig, nodes_of_skeleton
from meshmatch.shapes.formats.gltf_write import VERTICES

_MAX_OFFSET = 1e-6  # relative to the size of a mesh; vertices that a skin displaces by less count as not displaced
_DIRECTIONS = ("NORMAL", "TANGENT")


@dataclass(frozen=True)
class FormerSkeleton:
    """The former skeleton that no longer moves a scene: its number of joints, and the names of clips that animated it."""

    joints: int = 0
    clips: tuple[str, ...] = ()


def with_skeleton(document: Document, binding: Binding, apart: Container[int] = ()) -> tuple[bytes, FormerSkeleton]:
    """Return the scene as a glb that is moved by a new skeleton, and the former skeleton that it replaces.

    Former joints and their clips are removed, except for nodes that something else needs. Nodes in `apart` are not
    changed. Vertices of the binding are in scene order. Vertices keep their stored positions, unless a skin deforms them
    or a transform mirrors them: these are stored in scene coordinates.
    """
    editor = Editor(document)
    rig, turn = binding.rig, binding.turn
    node_of = _add_nodes(editor, document, rig)
    joint_rows, weight_rows = binding.table()
    inverse_bind = np.linalg.inv(binding.bind[rig.joints])
    skins: dict[bytes, int] = {}
    former_skins: set[int] = set()
    n_verts = 0
    for number, parts in drawn_nodes(document).items():
        if number in apart:
            n_verts += count_vertices(document, parts)
            continue
        node = editor.json["nodes"][number]
        frame = rigid_frame(document, number, parts)
        mesh = editor.own_mesh(number)  # each node gets its own weights
        for k, part in parts.items():
            primitive = mesh["primitives"][k]
            if frame is None:
                bake_transform(editor, document, number, part, primitive)
            attributes = primitive["attributes"]
            for key in [key for key in attributes if key.startswith(("JOINTS_", "WEIGHTS_"))]:
                del attributes[key]
            rows = slice(n_verts, n_verts + document.count(part["attributes"]["POSITION"]))
            attributes["JOINTS_0"] = editor.add_array(joint_rows[rows], target=VERTICES)
            attributes["WEIGHTS_0"] = editor.add_array(weight_rows[rows], target=VERTICES)
            n_verts = rows.stop
        to_scene = np.eye(4) if frame is None else frame.copy()
        to_scene[:3] = turn @ to_scene[:3]
        if to_scene.tobytes() not in skins:
            inverse = (inverse_bind @ to_scene).swapaxes(1, 2).reshape(-1, 16)
            entry: dict[str, Any] = {"name": rig.names[0], "joints": [node_of[joint] for joint in rig.joints.tolist()]}
            entry["inverseBindMatrices"] = editor.add_array(inverse.astype("<f4"))
            if (rig.parents < 0).sum() == 1:
                entry["skeleton"] = node_of[0]
            skins[to_scene.tobytes()] = editor.add("skins", entry)
        if "skin" in node:
            former_skins.add(node["skin"])
        node["skin"] = skins[to_scene.tobytes()]
    former_joints, clips = _drop_skins(editor, former_skins)
    _move_to_root(editor, document, {number for number in drawn_nodes(document) if number not in apart})
    arrays: dict[bytes, int] = {}
    own_clips: dict[str, list[dict[str, Any]]] = {}
    for animation in reversed(editor.json.get("animations", [])):
        own_clips.setdefault(str(animation.get("name")), []).append(animation)
    for clip in rig.clips:
        _add_clip(editor, clip, node_of, arrays, own_clips)
    if former_joints:
        reattached = reattach_children(editor, document, former_joints, binding, node_of)
        warn_of_detached(document, former_joints, reattached)
        drop_nodes(
            editor.json, [node for node in nodes_of_skeleton(document, sorted(former_joints)) if node not in reattached]
        )
        editor.prune(document)
    return editor.to_bytes(), FormerSkeleton(len(former_joints), clips)


def _add_nodes(editor: Editor, document: Document, rig: Rig) -> list[int]:
    """Add the nodes of a skeleton to the scene; return their numbers in the document."""
    node_numbers = [editor.add_node(*each) for each in zip(rig.names, rig.rotations, rig.translations, strict=True)]
    for number, extras in zip(node_numbers, rig.extras, strict=False):
        editor.json["nodes"][number] |= {} if extras is None else {"extras": extras}
    for node, parent in enumerate(rig.parents.tolist()):
        if np.any(rig.scales[node] != 1.0):
            editor.json["nodes"][node_numbers[node]]["scale"] = rig.scales[node].tolist()
        if parent >= 0:
            editor.json["nodes"][node_numbers[parent]].setdefault("children", []).append(node_numbers[node])
        else:
            editor.draw(document, node_numbers[node])
    return node_numbers


def rigid_frame(document: Document, number: int, parts: dict[int, dict[str, Any]]) -> Float[Floats, "4 4"] | None:
    """Return the matrix that takes the vertices of a node to scene coordinates.

    None if a skin deforms them (no single matrix does) or if they are mirrored: viewers disagree on which side of a
    triangle is outside if joints mirror it.
    """
    matrix = document.world[number]
    if any(document.is_mirrored(number, part, matrix) for part in parts.values()):
        return None
    if "skin" not in document.nodes[number]:
        return matrix
    bones = document.skinning_matrices(document.nodes[number]["skin"])
    frame = None
    for part in parts.values():
        positions, in_scene = (
            document.accessor(part["attributes"]["POSITION"]),
            document.scene_positions(number, part, matrix),
        )
        if frame is None:
            frame = matrix
            if "JOINTS_0" in part["attributes"]:
                joints, weights = next(document.influences(part))
                frame = bones[int(joints[0, weights[0].argmax()])]
        offset = np.abs(positions @ frame[:3, :3].T + frame[:3, 3] - in_scene)
        if not offset.max() <= _MAX_OFFSET * max(float(np.ptp(in_scene, axis=0).max()), float(np.abs(in_scene).max())):
            return None
    return frame


def bake_transform(
    editor: Editor, document: Document, number: int, part: dict[str, Any], primitive: dict[str, Any]
) -> None:
    """Store a primitive in scene coordinates: positions, normals, tangents and morph targets; mirrored faces are flipped."""
    matrix = document.world[number]

    def transform(accessor: int, normalize: bool) -> Floats:
        values = document.accessor(accessor)
        directions = np.hstack([values[:, :3], np.zeros((len(values), 1))])
        vectors = document.to_scene(number, part, directions, matrix)
        if normalize:
            vectors = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)
        return np.hstack([vectors, values[:, 3:]])

    attributes = primitive["attributes"]
    in_scene = document.scene_positions(number, part, matrix).astype("<f4")
    attributes["POSITION"] = editor.add_array(in_scene, bounds=True, target=VERTICES)
    for key in [key for key in _DIRECTIONS if key in attributes]:
        attributes[key] = editor.add_array(transform(attributes[key], True).astype("<f4"), target=VERTICES)
    for target in primitive.get("targets", []):
        for key in [key for key in ("POSITION", *_DIRECTIONS) if key in target]:
            target[key] = editor.add_array(transform(target[key], False).astype("<f4"), bounds=key == "POSITION")
    faces = document.drawn_triangles(number, part, matrix)
    if len(faces) and document.is_mirrored(number, part, matrix):
        primitive["indices"] = editor.add_indices(faces, len(in_scene))
        primitive.pop("mode", None)


def _drop_skins(editor: Editor, candidates: set[int]) -> tuple[set[int], tuple[str, ...]]:
    """Remove unused skins and the animation channels of their joints.

    Returns the joints that no remaining skin uses, and the names of clips that animated them.
    """
    nodes, skins = editor.json["nodes"], editor.json["skins"]
    used = {node["skin"] for node in nodes if "skin" in node}
    unused = candidates - used
    kept = [k for k in range(len(skins)) if k not in unused]
    joints = {joint for k in unused for joint in skins[k]["joints"]} - {
        joint for k in kept for joint in skins[k]["joints"]
    }
    new_number = {old: new for new, old in enumerate(kept)}
    for node in nodes:
        if "skin" in node:
            node["skin"] = new_number[node["skin"]]
    editor.json["skins"] = [skins[k] for k in kept]
    clips = drop_channels(editor, lambda target: target.get("node") in joints)
    return joints, clips


def drop_channels(editor: Editor, to_drop: Callable[[dict[str, Any]], bool]) -> tuple[str, ...]:
    """Remove the animation channels whose target satisfies `to_drop`, and clips that become empty.

    Returns the names of the clips that had such channels.
    """
    names = []
    for number, animation in enumerate(editor.json.get("animations", [])):
        kept = [each for each in animation["channels"] if not to_drop(each["target"])]
        if len(kept) < len(animation["channels"]):
            names.append(str(animation.get("name") or f"clip {number}"))
        animation["channels"] = kept
    if "animations" in editor.json:
        editor.json["animations"] = [each for each in editor.json["animations"] if each["channels"]]
        if not editor.json["animations"]:
            del editor.json["animations"]
    return tuple(names)


def _move_to_root(editor: Editor, document: Document, skinned: set[int]) -> None:
    """Make newly skinned meshes root nodes without a transform, in scene order.

    glTF ignores transforms above a skinned mesh, but some viewers do not. A node with other content besides its mesh stays
    in place without the mesh.
    """
    if not can_edit_nodes(editor.json):
        return
    nodes = editor.json["nodes"]
    joints = {joint for skin in editor.json["skins"] for joint in skin["joints"]}
    clips = [channel["target"] for clip in editor.json.get("animations", []) for channel in clip["channels"]]
    parents = {child: number for number, node in enumerate(document.nodes) for child in node.get("children", [])}
    trees: dict[int, list[int]] = {}  # per root node, the skinned meshes below it, in scene order
    root: dict[int, int] = {}
    for number in document.world:  # parents before children
        root[number] = root.get(parents.get(number, -1), number)
        if number in skinned:
            trees.setdefault(root[number], []).append(number)
    newly_skinned = {number for number in skinned if "skin" not in document.nodes[number]}
    affected = newly_skinned | {number for number in skinned if np.linalg.det(document.world[number][:3, :3]) < 0}
    # trees whose meshes were all skinned before, and not mirrored, are not changed
    trees = {top: meshes for top, meshes in trees.items() if not affected.isdisjoint(meshes)}
    lifted = {number for meshes in trees.values() for number in meshes}
    movable: set[int] = set()  # nodes that can move as they are, with all below them
    for number in reversed(document.world):  # children before parents
        node = nodes[number]
        if number in lifted - joints and not node.keys() & {"camera", "extensions"}:
            movable |= {number} if movable.issuperset(node.get("children", [])) else set()
    new_node: dict[int, int] = {}
    for number in sorted(lifted - movable):
        node = nodes[number]
        moved_keys = {key: node.pop(key) for key in ("mesh", "skin", "weights") if key in node}
        new_node[number] = editor.add("nodes", moved_keys | ({"name": node["name"]} if "name" in node else {}))
    for target in clips:
        if target["path"] == "weights" and target.get("node") in new_node:
            target["node"] = new_node[target["node"]]
    for number in {parents[number] for number in movable if number in parents}:
        remaining = [child for child in nodes[number].pop("children") if child not in movable]
        nodes[number] |= {"children": remaining} if remaining else {}
    for scene in editor.json["scenes"]:
        tops = scene.get("nodes", [])
        root_lists = [[top, *(new_node.get(each, each) for each in trees.get(top, []))] for top in tops]
        scene["nodes"] = list(dict.fromkeys(number for each in root_lists for number in each))
    for number in movable:
        for key in ("translation", "rotation", "scale", "matrix"):
            nodes[number].pop(key, None)
    above = newly_skinned & lifted
    for number in reversed(document.world):
        if number in above and number in parents:
            above.add(parents[number])
    if any(target.get("node") in above and target["path"] != "weights" for target in clips):
        warn(f"clips of {document.name} that moved a mesh as a whole no longer do, since its skeleton moves it")
    drop_channels(editor, lambda target: target.get("node") in movable and target["path"] != "weights")


def _add_clip(
    editor: Editor, clip: Clip, node_of: list[int], arrays: dict[bytes, int], own_clips: dict[str, list[dict[str, Any]]]
) -> None:
    """Add a clip of the skeleton.

    ``arrays`` caches the accessors added so far, since many tracks share their times. If the scene has a clip of the same
    name (``own_clips``), which may animate a lamp, the channels are added to it; it is then removed from ``own_clips``.
    """
    joined = own_clips[clip.name].pop() if own_clips.get(clip.name) else None
    entry: dict[str, Any] = joined or {"name": clip.name, "samplers": [], "channels": []}

    def add_once(values: Floats, bounds: bool) -> int:
        as_float32 = values.astype("<f4")
        key = b"%d %d " % (bounds, values[0].size) + as_float32.tobytes()
        if key not in arrays:
            arrays[key] = editor.add_array(as_float32, bounds=bounds)
        return arrays[key]

    for track in clip.tracks:
        sampler: dict[str, Any] = {"input": add_once(track.times, True), "output": add_once(track.values, False)}
        sampler["interpolation"] = track.interpolation
        target = {"node": node_of[track.node], "path": track.moves}
        entry["channels"].append({"sampler": len(entry["samplers"]), "target": target})
        entry["samplers"].append(sampler)
    if joined is None:
        editor.add("animations", entry | ({} if clip.extras is None else {"extras": clip.extras}))
