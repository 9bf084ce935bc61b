"""The former skeleton of a glTF scene that gets a new one: objects attached to its joints, and figures that keep theirs.

Specification: Khronos glTF 2.0, section 3.7.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from meshmatch.arrays import Bool, Bools, Ints
from meshmatch.errors import warn
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_attributes import joint_nodes
from meshmatch.shapes.formats.gltf_edit import Editor, drawn_nodes
from meshmatch.shapes.formats.gltf_prune import can_edit_nodes
from meshmatch.shapes.formats.gltf_rig import Binding

_LIGHT, _MAX_NAMES = "KHR_lights_punctual", 5
_MAX_SHIFT = 0.1  # largest distance between joints of two copies of a skeleton, as a share of its extent; set by hand


def find_rigid_groups(document: Document) -> list[tuple[Ints, Ints]]:
    """Groups of vertices that must move rigidly, because their unskinned nodes are attached to a joint.

    Each group comes with the vertices that it should follow: those that the joint, or else its nearest ancestor joint
    that moves any, influences most. Nodes that follow the same vertices form one group. Indices are in scene order.
    """
    skeleton, unmatched, n_verts = _Influences(document), [], 0
    followers: dict[int, list[Ints]] = {}
    for number, parts in drawn_nodes(document).items():
        V = count_vertices(document, parts)
        joint = number if number in skeleton.joints else skeleton.above.get(number)
        if joint is not None and "skin" not in document.nodes[number]:
            vertices, mover = np.arange(n_verts, n_verts + V), skeleton.mover(joint)
            if len(skeleton.around(mover)):
                followers.setdefault(mover, []).append(vertices)
            else:
                unmatched.append((vertices, skeleton.around(mover)))
        n_verts += V
    return [*unmatched, *((np.concatenate(groups), skeleton.around(mover)) for mover, groups in followers.items())]


def find_separate_figures(document: Document, hit: Ints) -> dict[int, str]:
    """Find skinned nodes that draw a separate object next to the matched figure, such as a flag; returns their names.

    ``hit`` are the vertices that a map reaches. No vertex of such a node is hit, its joints belong to other roots of the
    scene, and at most half of them share their names and positions with joints of the matched figure.
    """
    root: dict[int, int] = {}
    for node in document.roots():
        root |= dict.fromkeys(_below(document, node), node)
    hits, n_verts = np.bincount(hit), 0
    skin_of: dict[int, int] = {}
    matched_skins: set[int] = set()  # skins
    matched_roots: set[int] = set()  # roots
    for number, parts in drawn_nodes(document).items():
        rows = slice(n_verts, n_verts := n_verts + count_vertices(document, parts))
        skin = document.nodes[number].get("skin")
        if skin is not None:
            skin_of[number] = skin
        if hits[rows].any():
            matched_skins |= set() if skin is None else {skin}
            matched_roots.add(root[number])
    joints = [{int(joint) for joint in skin["joints"]} for skin in document.json.get("skins", [])]
    place_of = {joint: document.world[joint][:3, 3] for joint in set().union(*joints) if joint in document.world}
    figure = {
        document.nodes[joint].get("name"): place_of[joint]
        for skin in matched_skins
        for joint in joints[skin]
        if joint in place_of
    }
    tolerance = _MAX_SHIFT * float(np.ptp(list(figure.values()), axis=0).max()) if figure else 0.0
    matched_roots |= {root.get(joint, joint) for skin in matched_skins for joint in joints[skin]}

    def is_copied(joint: int) -> bool:
        place, own = figure.get(document.nodes[joint].get("name")), place_of.get(joint)
        return place is not None and own is not None and bool(np.abs(place - own).max() <= tolerance)

    def is_apart(own: set[int]) -> bool:
        copied = sum(is_copied(joint) for joint in own)
        return matched_roots.isdisjoint(root.get(joint, joint) for joint in own) and 2 * copied <= len(own)

    apart = {skin for skin in set(skin_of.values()) if matched_skins and joints[skin] and is_apart(joints[skin])}
    found = [number for number, skin in skin_of.items() if skin in apart]
    return {number: plain_text(str(document.nodes[number].get("name") or f"node {number}")) for number in found}


def find_skins(document: Document, hit: Bool[Bools, " V"]) -> Bool[Bools, " J"]:
    """Joints, in the order of `joint_nodes`, of all skins that draw a mesh with some of these vertices."""
    joints: set[int] = set()
    n_verts = 0
    for number, primitive, _ in document.primitives():
        rows = slice(n_verts, n_verts := n_verts + document.count(primitive["attributes"]["POSITION"]))
        if "skin" in document.nodes[number] and hit[rows].any():
            joints.update(map(int, document.json["skins"][document.nodes[number]["skin"]]["joints"]))
    return np.isin(joint_nodes(document), list(joints))


def count_vertices(document: Document, parts: dict[int, dict[str, Any]]) -> int:
    """Number of vertices of some primitives."""
    return sum(document.count(part["attributes"]["POSITION"]) for part in parts.values())


class _Influences:
    """Joints of a scene: the nearest joint above each node, and the joint with the largest weight for each vertex."""

    def __init__(self, document: Document) -> None:
        self.joints = {int(joint) for skin in document.json.get("skins", []) for joint in skin["joints"]}
        parts = [(number, part) for number, own in drawn_nodes(document).items() for part in own.values()]
        moved_by = np.concatenate([np.zeros(0, np.int64), *(_movers(document, *each) for each in parts)])
        self._order = np.argsort(moved_by, kind="stable")
        self._sorted = moved_by[self._order]
        moving = set(np.unique(moved_by).tolist())
        self.above: dict[int, int] = {}
        self._mover: dict[int, int] = {}  # per joint: itself, or its nearest ancestor that moves vertices
        for node in document.world:  # parents before children
            joint = node if node in self.joints else self.above.get(node)
            if joint is None:
                continue
            if joint == node:
                self._mover[node] = node if node in moving else self._mover.get(self.above.get(node, node), node)
            self.above |= {int(child): joint for child in document.nodes[node].get("children", [])}

    def mover(self, joint: int) -> int:
        """Return the joint if it moves vertices, else its nearest ancestor that does, if any, else the joint."""
        return self._mover.get(joint, joint)

    def around(self, joint: int) -> Ints:
        """Vertices that `mover` of a joint influences most."""
        low, high = np.searchsorted(self._sorted, self.mover(joint) + np.array([0, 1]))
        return self._order[low:high]


def _movers(document: Document, number: int, part: dict[str, Any]) -> Ints:
    """Joint with the largest weight for each vertex of a primitive; -1 without a skin."""
    V = document.count(part["attributes"]["POSITION"])
    sets = list(document.influences(part)) if "skin" in document.nodes[number] else []
    if not sets:
        return np.full(V, -1)
    numbers, weights = (np.concatenate(each, axis=1) for each in zip(*sets, strict=True))
    joint_numbers = np.array(document.json["skins"][document.nodes[number]["skin"]]["joints"], np.int64)
    return np.asarray(joint_numbers[numbers[np.arange(V), weights.argmax(axis=1)].astype(np.int64)])


def reattach_children(
    editor: Editor, document: Document, replaced: set[int], binding: Binding, names: list[int]
) -> set[int]:
    """Reattach children of replaced joints, such as a lamp or a socket, to the new joints that move the skin there.

    They keep their position in the scene. Leaf nodes that only mark the end of a bone are not reattached.

    Returns
    -------
    set of int
        The reattached nodes and all their descendants.
    """
    reattached: set[int] = set()
    if not can_edit_nodes(editor.json):
        return reattached
    nodes, influences = editor.json["nodes"], _Influences(document)
    animated = {
        channel["target"].get("node") for clip in editor.json.get("animations", []) for channel in clip["channels"]
    }
    above_joints = set(influences.joints)  # nodes that are joints, or have joints below them
    for node in reversed(document.world):  # children before parents
        if not above_joints.isdisjoint(document.nodes[node].get("children", [])):
            above_joints.add(node)
    movers: dict[int, int] = {}  # new joint, by the former joint that moved the skin there
    for joint in sorted(replaced):
        rows, children = influences.around(joint), document.nodes[joint].get("children", [])
        attached = []
        for child in children if len(rows) else ():
            # skinned meshes ignore their parents; animated nodes and joints depend on theirs
            if child in above_joints or child in animated or "skin" in nodes[child] or child not in document.world:
                continue
            tree = _below(document, child)
            is_bone_end = len(tree) == 1 and not nodes[child].keys() & {"camera", "extensions", "extras"}
            if not (is_bone_end and (len(children) == 1 or nodes[child].get("name") in binding.rig.names)):
                attached.append(child)
                reattached |= tree
        if not attached:
            continue
        if (mover := influences.mover(joint)) not in movers:
            votes = np.bincount(binding.joints[rows].ravel(), binding.weights[rows].ravel())
            movers[mover] = int(binding.rig.joints[votes.argmax()])
        new = movers[mover]
        for child in attached:
            matrix = np.linalg.inv(binding.bind[new]) @ document.world[child]
            for key in ("translation", "rotation", "scale", "matrix"):
                nodes[child].pop(key, None)
            nodes[child]["matrix"] = matrix.T.ravel().tolist()
        remaining = set(nodes[joint]["children"]).difference(attached)
        nodes[joint]["children"] = [child for child in nodes[joint]["children"] if child in remaining]
        if not remaining:
            del nodes[joint]["children"]
        nodes[names[new]].setdefault("children", []).extend(attached)
    return reattached


def _below(document: Document, number: int) -> set[int]:
    """A node and all its descendants."""
    found, stack = set(), [number]
    while stack:
        found.add(node := stack.pop())
        stack += document.nodes[node].get("children", [])
    return found


def warn_of_detached(document: Document, joints: set[int], reattached: set[int]) -> None:
    """Warn of cameras and lights below replaced joints, except for those reattached to new ones (``reattached``)."""
    below, names = set(joints), []
    for number in document.world:  # parents before children
        node = document.nodes[number]
        if number in below:
            below.update(node.get("children", []))
            if number not in reattached and ("camera" in node or _LIGHT in node.get("extensions", {})):
                names.append(plain_text(str(node.get("name") or f"node {number}")))
    if names:
        what = f"{', '.join(names[:_MAX_NAMES])}{', ...' if len(names) > _MAX_NAMES else ''} of {document.name}"
        stay = "keeps its" if len(names) == 1 else "keep their"
        warn(f"{what}, below the skeleton that is replaced, {stay} position")
