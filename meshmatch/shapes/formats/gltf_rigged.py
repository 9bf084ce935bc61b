"""A glTF scene with a skeleton added to it, which moves all that is drawn: nodes, materials and vertices stay as they are.

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
from meshmatch.shapes.formats.gltf_edit import Editor, drawn
from meshmatch.shapes.formats.gltf_former import count_of, hang_over, tell_staying
from meshmatch.shapes.formats.gltf_out import VERTICES
from meshmatch.shapes.formats.gltf_prune import drop_nodes, nodes_are_ours
from meshmatch.shapes.formats.gltf_rig import Binding, Clip, Rig, nodes_of_skeleton

_SAME = 1e-6  # of the size of a mesh: vertices that a skin moves by less than this are not moved
_DIRECTIONS = ("NORMAL", "TANGENT")


@dataclass(frozen=True)
class Replaced:
    """What moved a scene before and moves it no more: the number of its joints, and the names of clips that moved them."""

    joints: int = 0
    clips: tuple[str, ...] = ()


def rigged(document: Document, binding: Binding, apart: Container[int] = ()) -> tuple[bytes, Replaced]:
    """The scene as a glb, moved by a skeleton, which hangs from its first node; and what of its own moves it no more:
    joints and their clips are taken out, but for nodes that something else needs. Nodes `apart` are left alone.

    Vertices are stored as they are, unless a skin of their own bends them, or they are drawn as in a mirror: then as they
    stand. Those of the binding are in the order of the scene.
    """
    editor = Editor(document)
    rig, turn = binding.rig, binding.turn
    names = _add_nodes(editor, document, rig)
    where, shares = binding.table()
    back = np.linalg.inv(binding.bind[rig.joints])
    skins: dict[bytes, int] = {}
    before: set[int] = set()
    seen = 0
    for number, parts in drawn(document).items():
        if number in apart:
            seen += count_of(document, parts)
            continue
        node = editor.json["nodes"][number]
        frame = frame_of(document, number, parts)
        mesh = editor.own_mesh(number)  # other weights for each node
        for k, part in parts.items():
            own = mesh["primitives"][k]
            if frame is None:
                straighten(editor, document, number, part, own)
            attributes = own["attributes"]
            for key in [key for key in attributes if key.startswith(("JOINTS_", "WEIGHTS_"))]:
                del attributes[key]
            some = slice(seen, seen + document.count(part["attributes"]["POSITION"]))
            attributes["JOINTS_0"] = editor.add_array(where[some], target=VERTICES)
            attributes["WEIGHTS_0"] = editor.add_array(shares[some], target=VERTICES)
            seen = some.stop
        standing = np.eye(4) if frame is None else frame.copy()
        standing[:3] = turn @ standing[:3]
        if standing.tobytes() not in skins:
            inverse = (back @ standing).swapaxes(1, 2).reshape(-1, 16)
            entry: dict[str, Any] = {"name": rig.names[0], "joints": [names[joint] for joint in rig.joints.tolist()]}
            entry["inverseBindMatrices"] = editor.add_array(inverse.astype("<f4"))
            if (rig.parents < 0).sum() == 1:
                entry["skeleton"] = names[0]
            skins[standing.tobytes()] = editor.add("skins", entry)
        if "skin" in node:
            before.add(node["skin"])
        node["skin"] = skins[standing.tobytes()]
    gone, clips = _drop_skins(editor, before)
    _lift(editor, document, {number for number in drawn(document) if number not in apart})
    arrays: dict[bytes, int] = {}
    theirs: dict[str, list[dict[str, Any]]] = {}
    for animation in reversed(editor.json.get("animations", [])):
        theirs.setdefault(str(animation.get("name")), []).append(animation)
    for clip in rig.clips:
        _add_clip(editor, clip, names, arrays, theirs)
    if gone:
        hang = hang_over(editor, document, gone, binding, names)
        tell_staying(document, gone, hang)
        drop_nodes(editor.json, [node for node in nodes_of_skeleton(document, sorted(gone)) if node not in hang])
        editor.prune(document)
    return editor.to_bytes(), Replaced(len(gone), clips)


def _add_nodes(editor: Editor, document: Document, rig: Rig) -> list[int]:
    """The numbers of the skeleton's nodes in the document."""
    names = [editor.add_node(*each) for each in zip(rig.names, rig.rotations, rig.translations, strict=True)]
    for number, extras in zip(names, rig.extras, strict=False):
        editor.json["nodes"][number] |= {} if extras is None else {"extras": extras}
    for node, parent in enumerate(rig.parents.tolist()):
        if np.any(rig.scales[node] != 1.0):
            editor.json["nodes"][names[node]]["scale"] = rig.scales[node].tolist()
        if parent >= 0:
            editor.json["nodes"][names[parent]].setdefault("children", []).append(names[node])
        else:
            editor.draw(document, names[node])
    return names


def frame_of(document: Document, number: int, parts: dict[int, dict[str, Any]]) -> Float[Floats, "4 4"] | None:
    """What puts the vertices of a node where they stand in the scene; None where a skin bends them, or they are mirrored:
    programs differ in which side of a triangle is outside if joints mirror it.
    """
    place = document.world[number]
    if any(document.mirrors(number, part, place) for part in parts.values()):
        return None
    if "skin" not in document.nodes[number]:
        return place
    bones = document.bones(document.nodes[number]["skin"])
    frame = None
    for part in parts.values():
        positions, standing = document.accessor(part["attributes"]["POSITION"]), document.placed(number, part, place)
        if frame is None:
            frame = place
            if "JOINTS_0" in part["attributes"]:
                joints, weights = next(document.influences(part))
                frame = bones[int(joints[0, weights[0].argmax()])]
        off = np.abs(positions @ frame[:3, :3].T + frame[:3, 3] - standing)
        if not off.max() <= _SAME * max(float(np.ptp(standing, axis=0).max()), float(np.abs(standing).max())):
            return None
    return frame


def straighten(editor: Editor, document: Document, number: int, part: dict[str, Any], own: dict[str, Any]) -> None:
    """Store the vertices of a primitive where a skin or a mirror puts them, and turn what belongs to them."""
    place = document.world[number]

    def turned(accessor: int, unit: bool) -> Floats:
        values = document.accessor(accessor)
        directions = np.hstack([values[:, :3], np.zeros((len(values), 1))])
        found = document.moved(number, part, directions, place)
        if unit:
            found = found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-30)
        return np.hstack([found, values[:, 3:]])

    attributes = own["attributes"]
    standing = document.placed(number, part, place).astype("<f4")
    attributes["POSITION"] = editor.add_array(standing, bounds=True, target=VERTICES)
    for key in [key for key in _DIRECTIONS if key in attributes]:
        attributes[key] = editor.add_array(turned(attributes[key], True).astype("<f4"), target=VERTICES)
    for target in own.get("targets", []):
        for key in [key for key in ("POSITION", *_DIRECTIONS) if key in target]:
            target[key] = editor.add_array(turned(target[key], False).astype("<f4"), bounds=key == "POSITION")
    faces = document.drawn_triangles(number, part, place)
    if len(faces) and document.mirrors(number, part, place):
        own["indices"] = editor.add_indices(faces, len(standing))
        own.pop("mode", None)


def _drop_skins(editor: Editor, before: set[int]) -> tuple[set[int], tuple[str, ...]]:
    """Remove skins that move nothing any more, and what moves their joints; returns these joints, and the names of clips
    that moved them.
    """
    nodes, skins = editor.json["nodes"], editor.json["skins"]
    used = {node["skin"] for node in nodes if "skin" in node}
    gone = before - used
    kept = [k for k in range(len(skins)) if k not in gone]
    joints = {joint for k in gone for joint in skins[k]["joints"]} - {
        joint for k in kept for joint in skins[k]["joints"]
    }
    number = {old: new for new, old in enumerate(kept)}
    for node in nodes:
        if "skin" in node:
            node["skin"] = number[node["skin"]]
    editor.json["skins"] = [skins[k] for k in kept]
    clips = drop_channels(editor, lambda target: target.get("node") in joints)
    return joints, clips


def drop_channels(editor: Editor, gone: Callable[[dict[str, Any]], bool]) -> tuple[str, ...]:
    """Let clips move some targets no more, and go where they move nothing; returns the names of those that did."""
    names = []
    for number, animation in enumerate(editor.json.get("animations", [])):
        kept = [each for each in animation["channels"] if not gone(each["target"])]
        if len(kept) < len(animation["channels"]):
            names.append(str(animation.get("name") or f"clip {number}"))
        animation["channels"] = kept
    if "animations" in editor.json:
        editor.json["animations"] = [each for each in editor.json["animations"] if each["channels"]]
        if not editor.json["animations"]:
            del editor.json["animations"]
    return tuple(names)


def _lift(editor: Editor, document: Document, skinned: set[int]) -> None:
    """Let what a skin moves now hang from nothing, without a transform, in the order of the scene: glTF ignores transforms
    above a skinned mesh, and not all viewers do. A node that holds something else as well stays, without its mesh.
    """
    if not nodes_are_ours(editor.json):
        return
    nodes = editor.json["nodes"]
    joints = {joint for skin in editor.json["skins"] for joint in skin["joints"]}
    clips = [channel["target"] for clip in editor.json.get("animations", []) for channel in clip["channels"]]
    parents = {child: number for number, node in enumerate(document.nodes) for child in node.get("children", [])}
    trees: dict[int, list[int]] = {}  # meshes that a skin moves, in the order of the scene
    root: dict[int, int] = {}
    for number in document.world:  # parents before children
        root[number] = root.get(parents.get(number, -1), number)
        if number in skinned:
            trees.setdefault(root[number], []).append(number)
    new = {number for number in skinned if "skin" not in document.nodes[number]}
    turned = new | {number for number in skinned if np.linalg.det(document.world[number][:3, :3]) < 0}
    # others lay there with their skins
    trees = {top: some for top, some in trees.items() if not turned.isdisjoint(some)}
    lifted = {number for some in trees.values() for number in some}
    whole: set[int] = set()
    for number in reversed(document.world):  # children before parents
        node = nodes[number]
        if number in lifted - joints and not node.keys() & {"camera", "extensions"}:
            whole |= {number} if whole.issuperset(node.get("children", [])) else set()
    place: dict[int, int] = {}
    for number in sorted(lifted - whole):
        node = nodes[number]
        held = {key: node.pop(key) for key in ("mesh", "skin", "weights") if key in node}
        place[number] = editor.add("nodes", held | ({"name": node["name"]} if "name" in node else {}))
    for target in clips:
        if target["path"] == "weights" and target.get("node") in place:
            target["node"] = place[target["node"]]
    for number in {parents[number] for number in whole if number in parents}:
        left = [child for child in nodes[number].pop("children") if child not in whole]
        nodes[number] |= {"children": left} if left else {}
    for scene in editor.json["scenes"]:
        tops = scene.get("nodes", [])
        listed = [[top, *(place.get(each, each) for each in trees.get(top, []))] for top in tops]
        scene["nodes"] = list(dict.fromkeys(number for each in listed for number in each))
    for number in whole:
        for key in ("translation", "rotation", "scale", "matrix"):
            nodes[number].pop(key, None)
    above = new & lifted
    for number in reversed(document.world):
        if number in above and number in parents:
            above.add(parents[number])
    if any(target.get("node") in above and target["path"] != "weights" for target in clips):
        warn(f"clips of {document.name} that moved a mesh as a whole do so no more, for its skeleton moves it")
    drop_channels(editor, lambda target: target.get("node") in whole and target["path"] != "weights")


def _add_clip(
    editor: Editor, clip: Clip, names: list[int], arrays: dict[bytes, int], theirs: dict[str, list[dict[str, Any]]]
) -> None:
    """Add an animation; ``arrays`` are accessors of those that were added before, for many share their times. One of its
    name among ``theirs``, which the scene had and which may move a lamp, takes it in; each does so once.
    """
    joined = theirs[clip.name].pop() if theirs.get(clip.name) else None
    entry: dict[str, Any] = joined or {"name": clip.name, "samplers": [], "channels": []}

    def once(values: Floats, bounds: bool) -> int:
        short = values.astype("<f4")
        key = b"%d %d " % (bounds, values[0].size) + short.tobytes()
        if key not in arrays:
            arrays[key] = editor.add_array(short, bounds=bounds)
        return arrays[key]

    for track in clip.tracks:
        sampler: dict[str, Any] = {"input": once(track.times, True), "output": once(track.values, False)}
        sampler["interpolation"] = track.interpolation
        target = {"node": names[track.node], "path": track.moves}
        entry["channels"].append({"sampler": len(entry["samplers"]), "target": target})
        entry["samplers"].append(sampler)
    if joined is None:
        editor.add("animations", entry | ({} if clip.extras is None else {"extras": clip.extras}))
