"""Skins of a glTF scene: which joint moves which vertex, and how much (glTF 2.0, section 3.7.3).

Vertices are those of `meshmatch.shapes.formats.gltf.read`, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.outputs import plain_text
from meshmatch.shapes.formats import damaged
from meshmatch.shapes.formats.gltf import NONSENSE, Document


@dataclass(frozen=True, eq=False)
class Skin:
    """The weights that are not 0, one after the other.

    Parameters
    ----------
    V : int
        Vertices of the scene.
    vertex, joint : (N,) int64
    weight : (N,) float64
        Positive, as the file has them.
    names : tuple of str
        One for each joint; none twice.
    """

    V: int
    vertex: Int[Ints, " N"]
    joint: Int[Ints, " N"]
    weight: Float[Floats, " N"]
    names: tuple[str, ...]


def read_skin(path: Path, data: bytes) -> Skin:
    """Skin weights of the scene's vertices.

    The joints of all skins are one list, in the file's order of nodes. A mesh that no skin moves but that hangs
    from a joint, such as a sword from a hand, goes with that joint.

    Raises
    ------
    InputError
        The file is damaged, or has no skin.
    """
    try:
        return _skin(Document(path, data))
    except NONSENSE as error:
        raise damaged(path.name, f"its skin makes no sense ({type(error).__name__}: {error})") from error


def _skin(document: Document) -> Skin:
    skins = document.json.get("skins", [])
    nodes = sorted({int(joint) for skin in skins for joint in skin["joints"]})
    if not nodes:
        raise InputError(f"{document.name} has no skin", "give the weights in a file: --weights weights.npz")
    place = {node: k for k, node in enumerate(nodes)}
    parent = {int(c): k for k, node in enumerate(document.nodes) for c in node.get("children", [])}
    vertices, joints, weights = [], [], []
    seen = 0
    for number, primitive in document.primitives():
        attributes = primitive["attributes"]
        V = int(document.json["accessors"][attributes["POSITION"]]["count"])
        node = document.nodes[number]
        if "skin" in node and "JOINTS_0" in attributes:
            own = np.array([place[int(joint)] for joint in skins[node["skin"]]["joints"]])
            for numbers, amount in document.influences(primitive):
                if numbers.shape != (V, 4) or amount.shape != (V, 4):
                    raise ValueError("joints or weights are not four for each vertex")
                row, column = np.nonzero(np.isfinite(amount) & (amount > 0))
                used = numbers[row, column]
                if not ((used >= 0) & (used < len(own))).all():
                    raise ValueError(f"a vertex refers to a joint that is not among the {len(own)} of its skin")
                vertices.append(seen + row)
                joints.append(own[used.astype(np.int64)])
                weights.append(amount[row, column])
        else:
            joint: int | None = number
            while joint is not None and joint not in place:
                joint = parent.get(joint)
            if joint is not None:
                vertices.append(seen + np.arange(V))
                joints.append(np.full(V, place[joint]))
                weights.append(np.ones(V))
        seen += V
    if not vertices:
        raise InputError(f"{document.name} has a skin that moves no vertex", "was it exported with its weights?")
    labels = [document.nodes[node].get("name") or f"joint {node}" for node in nodes]
    names = _apart([plain_text(str(label)) for label in labels])
    return Skin(seen, np.concatenate(vertices), np.concatenate(joints), np.concatenate(weights), names)


def _apart(names: list[str]) -> tuple[str, ...]:
    """Names, numbered where one occurs again."""
    taken: dict[str, None] = {}
    for name in names:
        word, k = name, 1
        while word in taken:
            k += 1
            word = f"{name} {k}"
        taken[word] = None
    return tuple(taken)
