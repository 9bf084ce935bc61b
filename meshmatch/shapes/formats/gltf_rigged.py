"""A glTF scene with a skeleton added to it, which moves all that is drawn: nodes, materials and vertices stay as they are.

Specification: Khronos glTF 2.0, sections 3.7.3 and 3.11.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Brief, Float, Floats, Floats32, Int, Ints
from meshmatch.errors import warn
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import VERTICES, Editor, drawn
from meshmatch.shapes.formats.gltf_prune import drop_nodes, nodes_are_ours
from meshmatch.shapes.formats.gltf_rig import Clip, Rig, nodes_of_skeleton

_SAME = 1e-6  # of the size of a mesh: vertices that a skin moves by less than this are not moved
_DIRECTIONS = ("NORMAL", "TANGENT")
_LIGHT, _TOLD = "KHR_lights_punctual", 5


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
            seen += _count(document, parts)
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
        hang = _hang_over(editor, document, gone, binding, names)
        _tell_left(document, gone, hang)
        drop_nodes(editor.json, [node for node in nodes_of_skeleton(document, sorted(gone)) if node not in hang])
        editor.prune(document)
    return editor.to_bytes(), Replaced(len(gone), clips)


def hanging_groups(document: Document) -> list[tuple[Ints, Ints]]:
    """Vertices, in the order of the scene, of nodes that hang from a joint and are not bent by a skin, which are to stay
    rigid; and those to go with: what the joint, or else the next above it, moves most. Nodes that go with the same are one.
    """
    skin, alone, seen = _OldSkin(document), [], 0
    beside: dict[int, list[Ints]] = {}
    for number, parts in drawn(document).items():
        V = _count(document, parts)
        joint = number if number in skin.joints else skin.above.get(number)
        if joint is not None and "skin" not in document.nodes[number]:
            own, mover = np.arange(seen, seen + V), skin.mover(joint)
            if len(skin.around(mover)):
                beside.setdefault(mover, []).append(own)
            else:
                alone.append((own, skin.around(mover)))
        seen += V
    return [*alone, *((np.concatenate(groups), skin.around(mover)) for mover, groups in beside.items())]


def figures_apart(document: Document, hit: Ints) -> dict[int, str]:
    """Nodes that draw a thing of its own beside what a map leads to, such as a flag, with their names: no vertex of it is
    ``hit``, and its joints hang from another root of the scene, with names that the others, for the most part, do not have.
    """
    root: dict[int, int] = {}
    for node in document.roots():
        root |= dict.fromkeys(_below(document, node), node)
    hits, seen = np.bincount(hit), 0
    skin_of: dict[int, int] = {}
    fitted: set[int] = set()  # skins
    taken: set[int] = set()  # roots
    for number, parts in drawn(document).items():
        rows = slice(seen, seen := seen + _count(document, parts))
        skin = document.nodes[number].get("skin")
        if skin is not None:
            skin_of[number] = skin
        if hits[rows].any():
            fitted |= set() if skin is None else {skin}
            taken.add(root[number])
    joints = [{int(joint) for joint in skin["joints"]} for skin in document.json.get("skins", [])]
    names = {document.nodes[joint].get("name") for skin in fitted for joint in joints[skin]}
    taken |= {root.get(joint, joint) for skin in fitted for joint in joints[skin]}

    def is_apart(own: set[int]) -> bool:
        copied = sum(document.nodes[joint].get("name") in names for joint in own)
        return taken.isdisjoint(root.get(joint, joint) for joint in own) and 2 * copied <= len(own)

    apart = {skin for skin in set(skin_of.values()) if fitted and joints[skin] and is_apart(joints[skin])}
    found = [number for number, skin in skin_of.items() if skin in apart]
    return {number: plain_text(str(document.nodes[number].get("name") or f"node {number}")) for number in found}


def _count(document: Document, parts: dict[int, dict[str, Any]]) -> int:
    return sum(document.count(part["attributes"]["POSITION"]) for part in parts.values())


class _OldSkin:
    """The joints of a scene: which of them is next above each node, and which moves each vertex most."""

    def __init__(self, document: Document) -> None:
        self.joints = {int(joint) for skin in document.json.get("skins", []) for joint in skin["joints"]}
        parts = [(number, part) for number, own in drawn(document).items() for part in own.values()]
        moved_by = np.concatenate([np.zeros(0, np.int64), *(_movers(document, *each) for each in parts)])
        self._order = np.argsort(moved_by, kind="stable")
        self._sorted = moved_by[self._order]
        moving = set(np.unique(moved_by).tolist())
        self.above: dict[int, int] = {}
        self._mover: dict[int, int] = {}  # of each joint: itself, or the next above it that moves something
        for node in document.world:  # parents before children
            joint = node if node in self.joints else self.above.get(node)
            if joint is None:
                continue
            if joint == node:
                self._mover[node] = node if node in moving else self._mover.get(self.above.get(node, node), node)
            self.above |= {int(child): joint for child in document.nodes[node].get("children", [])}

    def mover(self, joint: int) -> int:
        """A joint; of one that moves nothing, the next above it that moves something, if there is one."""
        return self._mover.get(joint, joint)

    def around(self, joint: int) -> Ints:
        """The vertices that a joint, or the one that moves in its place, moves most."""
        low, high = np.searchsorted(self._sorted, self.mover(joint) + np.array([0, 1]))
        return self._order[low:high]


def _movers(document: Document, number: int, part: dict[str, Any]) -> Ints:
    """Of each vertex of a primitive the joint that its skin moves it most by; -1 where there is none."""
    V = document.count(part["attributes"]["POSITION"])
    sets = list(document.influences(part)) if "skin" in document.nodes[number] else []
    if not sets:
        return np.full(V, -1)
    numbers, weights = (np.concatenate(each, axis=1) for each in zip(*sets, strict=True))
    listed = np.array(document.json["skins"][document.nodes[number]["skin"]]["joints"], np.int64)
    return np.asarray(listed[numbers[np.arange(V), weights.argmax(axis=1)].astype(np.int64)])


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


def _hang_over(editor: Editor, document: Document, gone: set[int], binding: Binding, names: list[int]) -> set[int]:
    """Let what hangs from joints that are replaced, such as a lamp or a socket, hang where it stood from those that move the
    skin there now; returns these nodes and all below them. Ends of bones hang from nothing new.
    """
    found: set[int] = set()
    if not nodes_are_ours(editor.json):
        return found
    nodes, skin = editor.json["nodes"], _OldSkin(document)
    moved = {
        channel["target"].get("node") for clip in editor.json.get("animations", []) for channel in clip["channels"]
    }
    holding = set(skin.joints)  # nodes that are joints, or have some below them
    for node in reversed(document.world):  # children before parents
        if not holding.isdisjoint(document.nodes[node].get("children", [])):
            holding.add(node)
    for joint in sorted(gone):
        rows, children = skin.around(joint), document.nodes[joint].get("children", [])
        hung = []
        for child in children if len(rows) else ():
            # meshes hang from nothing, clips and joints need what is above them
            if child in holding or child in moved or "skin" in nodes[child] or child not in document.world:
                continue
            tree = _below(document, child)
            plain = len(tree) == 1 and not nodes[child].keys() & {"camera", "extensions", "extras"}
            if not (plain and (len(children) == 1 or nodes[child].get("name") in binding.rig.names)):
                hung.append(child)
                found |= tree
        if not hung:
            continue
        votes = np.bincount(binding.joints[rows].ravel(), binding.weights[rows].ravel())
        new = int(binding.rig.joints[votes.argmax()])
        for child in hung:
            place = np.linalg.inv(binding.bind[new]) @ document.world[child]
            for key in ("translation", "rotation", "scale", "matrix"):
                nodes[child].pop(key, None)
            nodes[child]["matrix"] = place.T.ravel().tolist()
        left = set(nodes[joint]["children"]).difference(hung)
        nodes[joint]["children"] = [child for child in nodes[joint]["children"] if child in left]
        if not left:
            del nodes[joint]["children"]
        nodes[names[new]].setdefault("children", []).extend(hung)
    return found


def _below(document: Document, number: int) -> set[int]:
    """A node and all below it."""
    found, stack = set(), [number]
    while stack:
        found.add(node := stack.pop())
        stack += document.nodes[node].get("children", [])
    return found


def _tell_left(document: Document, joints: set[int], hang: set[int]) -> None:
    """Warn of cameras and lights below joints which move nothing any more, but for those that ``hang`` from new ones."""
    below, held = set(joints), []
    for number in document.world:  # parents before children
        node = document.nodes[number]
        if number in below:
            below.update(node.get("children", []))
            if number not in hang and ("camera" in node or _LIGHT in node.get("extensions", {})):
                held.append(plain_text(str(node.get("name") or f"node {number}")))
    if held:
        what = f"{', '.join(held[:_TOLD])}{', ...' if len(held) > _TOLD else ''} of {document.name}"
        stay = "stays where it" if len(held) == 1 else "stay where they"
        warn(f"{what} hung from the skeleton that is replaced, and {stay} stood")


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
