"""A small hand-made glb with a skin."""

from pathlib import Path

import numpy as np

from tests.shapes.painted import write_document


def write_skinned_glb(path: Path, wide: bool = False) -> None:
    """Write a sword of one triangle on the knee, a body of two triangles on knee and hip, and a separate stone.

    Vertices in the order of the scene: 0 to 2 are the sword; 3 and 4 follow the knee, 5 both joints equally, 6 the hip; 7 to
    9 are the stone. With ``wide`` vertices of the body have eight slots for joints, and vertex 3 has the hip in the fifth.
    """
    body = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
    joints = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 1, 0, 0], [1, 0, 0, 0]], "<u2")
    weights = np.array([[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0], [1, 0, 0, 0]], "<f4")
    if wide:
        weights[0, 0] = 0.75
    more_joints, more = np.zeros((4, 4), "u1"), np.zeros((4, 4), "u1")
    more_joints[0, 0], more[0, 0] = 1, 64  # normalised: 64 / 255
    arrays = [
        body,
        np.array([0, 1, 2, 1, 3, 2], "<u2"),
        joints,
        weights,
        np.array([[5, 0, 0], [6, 0, 0], [5, 1, 0]], "<f4"),
        more_joints,
        more,
    ]
    attributes = {"POSITION": 0, "JOINTS_0": 2, "WEIGHTS_0": 3}
    if wide:
        attributes |= {"JOINTS_1": 5, "WEIGHTS_1": 6}
    document = {
        "scene": 0,
        "scenes": [{"nodes": [0, 3, 5]}],
        "nodes": [
            {"name": "hip", "children": [1]},
            {"name": "knee", "children": [2]},
            {"name": "holder", "children": [4]},
            {"name": "body", "mesh": 0, "skin": 0},
            {"name": "sword", "mesh": 1},
            {"name": "stone", "mesh": 1},
        ],
        "meshes": [
            {"primitives": [{"attributes": attributes, "indices": 1}]},
            {"primitives": [{"attributes": {"POSITION": 4}}]},
        ],
        "skins": [{"joints": [1, 0]}],  # indices of joints are in the skin's order: 0 is the knee
    }
    write_document(path, document, *arrays, normalized=6)
