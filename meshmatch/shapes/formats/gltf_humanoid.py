"""A character (VRM 0.x or 1.0) that was given another skeleton: which of the new nodes are which of its bones.

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
from meshmatch.shapes.formats.gltf_attributes import joint_nodes
from meshmatch.shapes.formats.gltf_edit import Editor
from meshmatch.shapes.formats.gltf_prune import drop_nodes
from meshmatch.shapes.formats.gltf_rig import nodes_of_skeleton
from meshmatch.shapes.formats.gltf_rigged import drop_channels
from meshmatch.shapes.formats.gltf_vrm import CONSTRAINT, NEW, OLD, SPRINGS, entries, part

_SINCE = {  # what bones of VRM 0.x are called in 1.0
    f"{side}Thumb{old}": f"{side}Thumb{new}"
    for side in ("left", "right")
    for old, new in (("Proximal", "Metacarpal"), ("Intermediate", "Proximal"))
}


@dataclass(frozen=True)
class Person:
    """Whose bones are whose: the place of each bone, by its name in VRM 1.0, among the nodes of the source's skeleton; the
    nodes of the skeleton that the target has; and how many nodes there are in all.
    """

    bones: Mapping[str, int]
    former: tuple[int, ...]
    nodes: int


def person_of(source: Document, target: Document) -> Person | None:
    """The bones of a source that is a character, or that has nodes with the names of all bones of the target; None where
    it has not.
    """
    list(source.primitives()), list(target.primitives())  # walk through the scenes
    nodes = nodes_of_skeleton(source, joint_nodes(source))
    own, wanted = _bones(source), _bones(target)
    if own:
        places = {node: k for k, node in enumerate(nodes)}
        bones = {bone: places[node] for bone, node in own.items() if node in places}
    else:
        names = [source.nodes[node].get("name") for node in nodes]
        called, times = {bone: target.nodes[node].get("name") for bone, node in wanted.items()}, Counter(names)
        if any(name is None or times[name] != 1 for name in called.values()):
            return None
        named = {name: k for k, name in enumerate(names)}
        bones = {bone: named[name] for bone, name in called.items()}
    if not {"hips", "head"} <= bones.keys():
        return None
    return Person(bones, tuple(nodes_of_skeleton(target, joint_nodes(target))), len(target.nodes))


def with_bones(document: Document, person: Person) -> bytes:
    """The target, rigged, as a character whose bones are those of the skeleton that moves it now; the former one goes, and
    with it its springs and constraints. Bones of VRM 0.x are not turned, so that they have no clips. What is lost is told.
    """
    list(document.primitives())
    editor = Editor(document)
    first = person.nodes + 1  # after the node with the name of the source's file
    bones = {bone: first + place for bone, place in person.bones.items()}
    worlds = dict(document.world)
    if part(editor.json, "extensions", OLD) is not None:
        worlds = _untwisted(editor, document, range(person.nodes, len(document.nodes)))
        _name_old(part(editor.json, "extensions", OLD), bones, document.world, worlds)
    if part(editor.json, "extensions", NEW) is not None:
        _name_new(part(editor.json, "extensions", NEW), bones, _bones(document), worlds)
    _drop_physics(editor, person)
    drop_nodes(editor.json, person.former, character=True)
    editor.prune(document)
    return editor.to_bytes()


def _bones(document: Document) -> dict[str, int]:
    """Nodes of a character's bones, by their names in VRM 1.0."""
    count = len(document.nodes)
    old = entries(document.json, "extensions", OLD, "humanoid", "humanBones")
    held = part(document.json, "extensions", NEW, "humanoid", "humanBones")
    found = {_SINCE.get(str(each.get("bone")), str(each.get("bone"))): each.get("node") for each in old}
    found |= {bone: part(each, "node") for bone, each in held.items()} if isinstance(held, dict) else {}
    return {bone: node for bone, node in found.items() if isinstance(node, int) and 0 <= node < count}


def _name_old(
    extension: Any, bones: Mapping[str, int], before: Mapping[int, Floats], now: Mapping[int, Floats]
) -> None:
    earlier = {new: old for old, new in _SINCE.items()}
    named = [{"bone": earlier.get(bone, bone), "node": node, "useDefaultValues": True} for bone, node in bones.items()]
    extension.setdefault("humanoid", {})["humanBones"] = named
    first = extension.get("firstPerson")
    if not isinstance(first, dict) or first.get("firstPersonBone", -1) not in before:
        return
    given = first.get("firstPersonBoneOffset")
    given = given if isinstance(given, dict) else {}
    mirrored = np.array([1.0, 1.0, -1.0])  # vectors of VRM 0.x are left-handed
    offset = mirrored * [given.get(axis, 0.0) for axis in "xyz"]
    offset = mirrored * _seen_from(before[first["firstPersonBone"]], offset, now[bones["head"]])
    first["firstPersonBone"], first["firstPersonBoneOffset"] = (
        bones["head"],
        dict(zip("xyz", offset.tolist(), strict=True)),
    )


def _name_new(
    extension: Any, bones: Mapping[str, int], former: Mapping[str, int], worlds: Mapping[int, Floats]
) -> None:
    extension.setdefault("humanoid", {})["humanBones"] = {bone: {"node": node} for bone, node in bones.items()}
    look = extension.get("lookAt")
    if isinstance(look, dict) and "offsetFromHeadBone" in look and former.get("head", -1) in worlds:
        offset = np.array(look["offsetFromHeadBone"], np.float64)
        look["offsetFromHeadBone"] = _seen_from(worlds[former["head"]], offset, worlds[bones["head"]]).tolist()


def _seen_from(here: Floats, offset: Float[Floats, " 3"], there: Floats) -> Float[Floats, " 3"]:
    """A place in the frame of one node in that of another."""
    return np.asarray((np.linalg.inv(there) @ here @ [*offset, 1.0])[:3])


def _untwisted(editor: Editor, document: Document, nodes: range) -> dict[int, Floats]:
    """Let nodes stand where they do without being turned or scaled, as those of VRM 0.x must; returns where all stand."""
    parents = {child: number for number, node in enumerate(document.nodes) for child in node.get("children", [])}
    worlds = dict(document.world)
    for number in nodes:
        place, node = document.world[number][:3, 3], editor.json["nodes"][number]
        above = parents.get(number)
        for key in ("rotation", "scale", "matrix"):
            node.pop(key, None)
        node["translation"] = (place - (0.0 if above is None else document.world[above][:3, 3])).tolist()
        worlds[number] = np.eye(4)
        worlds[number][:3, 3] = place
    for skin, own in enumerate(editor.json["skins"]):
        if all(joint in nodes for joint in own["joints"]):
            stand = document.bones(skin)
            back = np.linalg.inv(np.stack([worlds[joint] for joint in own["joints"]])) @ stand
            own["inverseBindMatrices"] = editor.add_array(back.swapaxes(1, 2).reshape(-1, 16).astype("<f4"))
    moved = drop_channels(editor, lambda target: target.get("node") in nodes)
    if moved:
        many = f"{len(moved)} clips" if moved[1:] else f"the clip {moved[0]}"
        warn(f"{document.name} does not have {many} of its skeleton: bones of VRM 0.x are not turned")
    return worlds


def _drop_physics(editor: Editor, person: Person) -> None:
    """Take out what moved the former skeleton."""
    json, gone = editor.json, 0
    springs = part(json, "extensions", OLD, "secondaryAnimation")
    if isinstance(springs, dict):
        gone += len(entries(springs, "boneGroups"))
        springs |= {"boneGroups": [], "colliderGroups": []}
    gone += len(entries(json["extensions"].pop(SPRINGS, None), "springs"))
    for number in person.former:
        extensions = json["nodes"][number].get("extensions", {})
        gone += extensions.pop(CONSTRAINT, None) is not None
        if not extensions:
            json["nodes"][number].pop("extensions", None)
    used = {key for node in json["nodes"] for key in node.get("extensions", {})} | json["extensions"].keys()
    for name in (SPRINGS, CONSTRAINT):
        if name in json.get("extensionsUsed", []) and name not in used:
            json["extensionsUsed"].remove(name)
    if gone:
        what = "spring or constraint that moved its" if gone == 1 else "springs and constraints that moved its"
        warn(f"{editor.name} does not have the {gone} {what} former skeleton")
