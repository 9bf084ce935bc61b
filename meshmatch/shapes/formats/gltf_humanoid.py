"""Map the humanoid bones of a character (VRM 0.x or 1.0) to the nodes of a new skeleton.

Specification: VRM Consortium, VRM 0.0; VRMC_vrm 1.0.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import warn
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_add_skeleton import drop_channels
from meshmatch.shapes.formats.gltf_attributes import joint_nodes
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_prune import drop_nodes
from meshmatch.shapes.formats.gltf_rig import nodes_of_skeleton
from meshmatch.shapes.formats.gltf_vrm import CONSTRAINT, SPRINGS, VRM0, VRM1, nested, nested_entries

_VRM1_NAMES = {  # names in VRM 1.0 of the bones that VRM 0.x calls differently
    f"{side}Thumb{old}": f"{side}Thumb{new}"
    for side in ("left", "right")
    for old, new in (("Proximal", "Metacarpal"), ("Intermediate", "Proximal"))
}


@dataclass(frozen=True)
class HumanoidBones:
    """Correspondence between humanoid bones and skeleton nodes.

    Attributes
    ----------
    bones
        Index of each bone, by its VRM 1.0 name, among the nodes of the source's skeleton.
    former
        Nodes of the skeleton that the target has.
    nodes
        Number of nodes of the target.
    """

    bones: Mapping[str, int]
    former: tuple[int, ...]
    nodes: int


def find_humanoid_bones(source: Document, target: Document) -> HumanoidBones | None:
    """Find the humanoid bones of a source: by its VRM extension, or else by the names of the target's bone nodes.

    None if it has no extension and not exactly one node for every bone name, or if hips or head are missing.
    """
    list(source.primitives()), list(target.primitives())  # fills `world` of both
    nodes = nodes_of_skeleton(source, joint_nodes(source))
    source_bones, target_bones = _bones(source), _bones(target)
    if source_bones:
        index_of = {node: k for k, node in enumerate(nodes)}
        bones = {bone: index_of[node] for bone, node in source_bones.items() if node in index_of}
    else:
        names = [source.nodes[node].get("name") for node in nodes]
        name_of_bone, n_with_name = (
            {bone: target.nodes[node].get("name") for bone, node in target_bones.items()},
            Counter(names),
        )
        if any(name is None or n_with_name[name] != 1 for name in name_of_bone.values()):
            return None
        index_of_name = {name: k for k, name in enumerate(names)}
        bones = {bone: index_of_name[name] for bone, name in name_of_bone.items()}
    if not {"hips", "head"} <= bones.keys():
        return None
    return HumanoidBones(bones, tuple(nodes_of_skeleton(target, joint_nodes(target))), len(target.nodes))


def with_humanoid_bones(document: Document, person: HumanoidBones) -> bytes:
    """Return the rigged target as a character whose humanoid bones are nodes of its new skeleton.

    The former skeleton is removed together with its springs and constraints. Bones of VRM 0.x must have no rotation, so
    their clips are removed as well. Warns about everything that is lost.
    """
    list(document.primitives())
    editor = Editor(document)
    first = person.nodes + 1  # after the node named after the source's file
    bones = {bone: first + node_index for bone, node_index in person.bones.items()}
    worlds = dict(document.world)
    if nested(editor.json, "extensions", VRM0) is not None:
        worlds = _remove_rotations(editor, document, range(person.nodes, len(document.nodes)))
        _set_vrm0_bones(nested(editor.json, "extensions", VRM0), bones, document.world, worlds)
    if nested(editor.json, "extensions", VRM1) is not None:
        _set_vrm1_bones(nested(editor.json, "extensions", VRM1), bones, _bones(document), worlds)
    _drop_physics(editor, person)
    drop_nodes(editor.json, person.former, character=True)
    editor.prune(document)
    return editor.to_bytes()


def _bones(document: Document) -> dict[str, int]:
    """Node numbers of a character's humanoid bones, by their names in VRM 1.0."""
    count = len(document.nodes)
    vrm0_bones = nested_entries(document.json, "extensions", VRM0, "humanoid", "humanBones")
    vrm1_bones = nested(document.json, "extensions", VRM1, "humanoid", "humanBones")
    bones = {_VRM1_NAMES.get(str(each.get("bone")), str(each.get("bone"))): each.get("node") for each in vrm0_bones}
    bones |= {bone: nested(each, "node") for bone, each in vrm1_bones.items()} if isinstance(vrm1_bones, dict) else {}
    return {bone: node for bone, node in bones.items() if isinstance(node, int) and 0 <= node < count}


def _set_vrm0_bones(
    extension: Any, bones: Mapping[str, int], before: Mapping[int, Floats], now: Mapping[int, Floats]
) -> None:
    """Set the humanoid bones of VRM 0.x, and move the first-person offset to the new head."""
    vrm0_names = {new: old for old, new in _VRM1_NAMES.items()}
    human_bones = [
        {"bone": vrm0_names.get(bone, bone), "node": node, "useDefaultValues": True} for bone, node in bones.items()
    ]
    extension.setdefault("humanoid", {})["humanBones"] = human_bones
    first_person = extension.get("firstPerson")
    if not isinstance(first_person, dict) or first_person.get("firstPersonBone", -1) not in before:
        return
    old_offset = first_person.get("firstPersonBoneOffset")
    old_offset = old_offset if isinstance(old_offset, dict) else {}
    mirrored = np.array([1.0, 1.0, -1.0])  # vectors of VRM 0.x are left-handed
    offset = mirrored * [old_offset.get(axis, 0.0) for axis in "xyz"]
    offset = mirrored * _change_frame(before[first_person["firstPersonBone"]], offset, now[bones["head"]])
    first_person["firstPersonBone"], first_person["firstPersonBoneOffset"] = (
        bones["head"],
        dict(zip("xyz", offset.tolist(), strict=True)),
    )


def _set_vrm1_bones(
    extension: Any, bones: Mapping[str, int], former: Mapping[str, int], worlds: Mapping[int, Floats]
) -> None:
    """Set the humanoid bones of VRM 1.0, and move the look-at offset to the new head."""
    extension.setdefault("humanoid", {})["humanBones"] = {bone: {"node": node} for bone, node in bones.items()}
    look_at = extension.get("lookAt")
    if isinstance(look_at, dict) and "offsetFromHeadBone" in look_at and former.get("head", -1) in worlds:
        offset = np.array(look_at["offsetFromHeadBone"], np.float64)
        look_at["offsetFromHeadBone"] = _change_frame(worlds[former["head"]], offset, worlds[bones["head"]]).tolist()


def _change_frame(here: Floats, offset: Float[Floats, " 3"], there: Floats) -> Float[Floats, " 3"]:
    """Transform a point from the frame of one node (world matrix `here`) to that of another (`there`)."""
    return np.asarray((np.linalg.inv(there) @ here @ [*offset, 1.0])[:3])


def _remove_rotations(editor: Editor, document: Document, nodes: range) -> dict[int, Floats]:
    """Remove rotation and scale from nodes without moving their origins, as VRM 0.x requires; return all world matrices.

    Inverse bind matrices are updated, and clips of these nodes removed.
    """
    parents = {child: number for number, node in enumerate(document.nodes) for child in node.get("children", [])}
    worlds = dict(document.world)
    for number in nodes:
        position, node = document.world[number][:3, 3], editor.json["nodes"][number]
        parent = parents.get(number)
        for key in ("rotation", "scale", "matrix"):
            node.pop(key, None)
        node["translation"] = (position - (0.0 if parent is None else document.world[parent][:3, 3])).tolist()
        worlds[number] = np.eye(4)
        worlds[number][:3, 3] = position
    for skin, entry in enumerate(editor.json["skins"]):
        if all(joint in nodes for joint in entry["joints"]):
            skinning = document.skinning_matrices(skin)
            inverse_bind = np.linalg.inv(np.stack([worlds[joint] for joint in entry["joints"]])) @ skinning
            entry["inverseBindMatrices"] = editor.add_array(inverse_bind.swapaxes(1, 2).reshape(-1, 16).astype("<f4"))
    lost_clips = drop_channels(editor, lambda target: target.get("node") in nodes)
    if lost_clips:
        what = f"{len(lost_clips)} clips" if lost_clips[1:] else f"the clip {lost_clips[0]}"
        warn(f"{document.name} does not have {what} of its skeleton: bones of VRM 0.x have no rotation")
    return worlds


def _drop_physics(editor: Editor, person: HumanoidBones) -> None:
    """Remove the springs and constraints of the former skeleton."""
    json, n_removed = editor.json, 0
    springs = nested(json, "extensions", VRM0, "secondaryAnimation")
    if isinstance(springs, dict):
        n_removed += len(nested_entries(springs, "boneGroups"))
        springs |= {"boneGroups": [], "colliderGroups": []}
    n_removed += len(nested_entries(json["extensions"].pop(SPRINGS, None), "springs"))
    for number in person.former:
        extensions = json["nodes"][number].get("extensions", {})
        n_removed += extensions.pop(CONSTRAINT, None) is not None
        if not extensions:
            json["nodes"][number].pop("extensions", None)
    used = {key for node in json["nodes"] for key in node.get("extensions", {})} | json["extensions"].keys()
    for name in (SPRINGS, CONSTRAINT):
        if name in json.get("extensionsUsed", []) and name not in used:
            json["extensionsUsed"].remove(name)
    if n_removed:
        what = "spring or constraint that moved its" if n_removed == 1 else "springs and constraints that moved its"
        warn(f"{editor.name} does not have the {n_removed} {what} former skeleton")
