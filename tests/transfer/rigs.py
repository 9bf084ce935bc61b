"""A hand-made rigged tube, and the pose of a rigged file at a time of a clip."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.shape import Shape
from tests.shapes.painted import write_document

RINGS, AROUND = 41, 16
BEND = 60.0
"""Rotation of the knee at the end of the clip, in degrees."""
KNEE, FOOT = np.array([0, 1.0, 0]), np.array([0, 1.9, 0])
NODES = ("armature", "root", "hip", "knee", "tip", "foot", "tube")


def tube() -> Shape:
    """A closed tube of height 2 with an oval cross-section, standing at the origin."""
    angle = 2 * np.pi * np.arange(AROUND) / AROUND
    oval = np.stack([0.25 * np.sin(angle), np.zeros(AROUND), 0.15 * np.cos(angle)], axis=1)
    heights = np.linspace(0, 2, RINGS)
    verts = (oval[None] + heights[:, None, None] * [0.0, 1, 0]).reshape(-1, 3)
    verts = np.concatenate([verts, [[0, 0, 0], [0, 2, 0]]])
    k = np.arange(RINGS - 1)[:, None] * AROUND + np.arange(AROUND)
    right = np.arange(RINGS - 1)[:, None] * AROUND + (np.arange(AROUND) + 1) % AROUND
    sides = [np.stack([k, right, right + AROUND], -1), np.stack([k, right + AROUND, k + AROUND], -1)]
    ring, after = np.arange(AROUND), (np.arange(AROUND) + 1) % AROUND
    top = AROUND * (RINGS - 1)
    ends = [
        np.stack([np.full(AROUND, len(verts) - 2), after, ring], -1),
        np.stack([np.full(AROUND, len(verts) - 1), top + ring, top + after], -1),
    ]
    return Shape(verts, np.concatenate([*(each.reshape(-1, 3) for each in sides), *ends]), "tube")


def weights_of(height: np.ndarray) -> np.ndarray:
    """Return the weights (V, 3) of hip, knee and foot."""
    knee = np.clip((height - 0.8) / 0.4, 0, 1)
    foot = np.clip((height - 1.7) / 0.2, 0, 1)
    return np.stack([1 - knee, knee * (1 - foot), knee * foot], axis=1)


def write_tube(path: Path, *, stands: float = 0.0, clips: bool = True, **more: Any) -> Shape:
    """Write a tube with a skeleton below an armature that is rotated and scaled by 100.

    Its clip "bend" bends the knee within a second. The joints are root, which moves no vertex, hip, knee and foot; the foot
    is a child of the root and follows the knee. The pose of the file has the knee bent by `stands` degrees. `more` is added
    to the document.
    """
    shape = tube()
    weights = weights_of(shape.verts[:, 1])
    joints = (np.pad(weights > 0, ((0, 0), (0, 1))) * [1, 2, 3, 0]).astype("u1")
    inverse = np.tile(np.eye(4), (4, 1, 1))
    turn = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    for joint, place in enumerate((np.zeros(3), np.zeros(3), KNEE, FOOT)):
        world = np.eye(4)
        world[:3, :3], world[:3, 3] = 100 * turn, place
        inverse[joint] = np.linalg.inv(world)
    times = np.linspace(0, 1, 13).astype("f4")
    own = turn.T / 100  # from the scene to the armature
    knees = Rotation.from_rotvec(np.radians(BEND) * times[:, None] * [1.0, 0, 0])
    bent = KNEE + knees.apply(FOOT - KNEE)
    into = Rotation.from_matrix(turn.T)
    local = into * knees * into.inv()
    arrays = [
        shape.verts.astype("f4"),
        shape.faces.ravel().astype("u2"),
        joints,
        np.pad(weights, ((0, 0), (0, 1))).astype("f4"),
        inverse.swapaxes(1, 2).reshape(-1, 16).astype("f4"),
        times,
        local.as_quat().astype("f4"),
        (bent @ own.T).astype("f4"),
    ]
    standing = Rotation.from_euler("x", stands, degrees=True)
    now, foot = into * standing * into.inv(), KNEE + standing.apply(FOOT - KNEE)
    nodes: list[dict[str, Any]] = [
        {"rotation": Rotation.from_matrix(turn).as_quat().tolist(), "scale": [100, 100, 100], "children": [1]},
        {"children": [2, 5]},
        {"children": [3]},
        {"translation": (own @ KNEE).tolist(), "rotation": now.as_quat().tolist(), "children": [4]},
        {"translation": (own @ [0, 1, 0]).tolist()},
        {"translation": (own @ foot).tolist(), "rotation": now.as_quat().tolist()},
        {"mesh": 0, "skin": 0},
    ]
    moves = [(3, "rotation", 6), (5, "rotation", 6), (5, "translation", 7)]
    clip = {
        "name": "bend",
        "samplers": [{"input": 5, "output": output} for _, _, output in moves],
        "channels": [{"sampler": k, "target": {"node": n, "path": p}} for k, (n, p, _) in enumerate(moves)],
    }
    attributes = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}
    document: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"nodes": [0, 6]}],
        "nodes": [{"name": name} | node for name, node in zip(NODES, nodes, strict=True)],
        "meshes": [{"name": "skin of a tube", "primitives": [{"attributes": attributes, "indices": 1}]}],
        "skins": [{"joints": [1, 2, 3, 5], "inverseBindMatrices": 4}],
    }
    write_document(path, document | ({"animations": [clip]} if clips else {}) | more, *arrays)
    return shape


def posed_verts(path: Path, clip: str = "", time: float = 0.0) -> np.ndarray:
    """Return the vertices at a time of a clip, or in the file's pose without one, by linear blend skinning."""
    document = Document(path, path.read_bytes())
    for animation in document.json.get("animations", []):
        for channel in animation["channels"] if animation["name"] == clip else []:
            sampler = animation["samplers"][channel["sampler"]]
            times, values = document.accessor(sampler["input"])[:, 0], document.accessor(sampler["output"])
            now = np.array([np.interp(time, times, column) for column in values.T])
            if channel["target"]["path"] == "rotation":
                now /= np.linalg.norm(now)
            document.nodes[channel["target"]["node"]][channel["target"]["path"]] = now.tolist()
    return document.scene().verts


def volume(verts: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (verts[faces[:, k]] for k in range(3))
    return float(np.einsum("fi,fi->f", a, np.cross(b, c)).sum() / 6)
