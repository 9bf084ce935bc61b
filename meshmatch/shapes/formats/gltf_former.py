"""The skeleton that a glTF scene has before it gets another: what hangs from its joints, and which figures keep their own.

Specification: Khronos glTF 2.0, section 3.7.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshmatch.arrays import Ints
from meshmatch.errors import warn
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_edit import Editor, drawn
from meshmatch.shapes.formats.gltf_prune import nodes_are_ours
from meshmatch.shapes.formats.gltf_rig import Binding

_LIGHT, _TOLD = "KHR_lights_punctual", 5


def hanging_groups(document: Document) -> list[tuple[Ints, Ints]]:
    """Vertices, in the order of the scene, of nodes that hang from a joint and are not bent by a skin, which are to stay
    rigid; and those to go with: what the joint, or else the next above it, moves most. Nodes that go with the same are one.
    """
    skin, alone, seen = _Skin(document), [], 0
    beside: dict[int, list[Ints]] = {}
    for number, parts in drawn(document).items():
        V = count_of(document, parts)
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
        rows = slice(seen, seen := seen + count_of(document, parts))
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


def count_of(document: Document, parts: dict[int, dict[str, Any]]) -> int:
    return sum(document.count(part["attributes"]["POSITION"]) for part in parts.values())


class _Skin:
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


def hang_over(editor: Editor, document: Document, gone: set[int], binding: Binding, names: list[int]) -> set[int]:
    """Let what hangs from joints that are replaced, such as a lamp or a socket, hang where it stood from those that move the
    skin there now; returns these nodes and all below them. Ends of bones hang from nothing new.
    """
    found: set[int] = set()
    if not nodes_are_ours(editor.json):
        return found
    nodes, skin = editor.json["nodes"], _Skin(document)
    moved = {
        channel["target"].get("node") for clip in editor.json.get("animations", []) for channel in clip["channels"]
    }
    holding = set(skin.joints)  # nodes that are joints, or have some below them
    for node in reversed(document.world):  # children before parents
        if not holding.isdisjoint(document.nodes[node].get("children", [])):
            holding.add(node)
    movers: dict[int, int] = {}  # the new joints, by what moved the skin there
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
        if (mover := skin.mover(joint)) not in movers:
            votes = np.bincount(binding.joints[rows].ravel(), binding.weights[rows].ravel())
            movers[mover] = int(binding.rig.joints[votes.argmax()])
        new = movers[mover]
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


def tell_staying(document: Document, joints: set[int], hang: set[int]) -> None:
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
