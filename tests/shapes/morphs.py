"""A hand-made glTF scene with morph targets: two meshes below a rotated and scaled node."""

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from tests.shapes.painted import CORNERS, FACES, write_document

TURN = Rotation.from_euler("x", 90, degrees=True)
SCALE = 2.0
UP = np.array([[0, 0, 1.0]] * 4, "f4")
ONE = np.array([[0.5, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]], "f4")


def write_morphs(path: Path, **more: Any) -> None:
    """Write squares "face" (morph targets smile, blink) and "teeth" (blink, open), and a clip of both.

    smile lifts the face by 1 along its own z, blink moves the first corner of either mesh, and open lifts the teeth. `more`
    is added to the document.
    """
    times = np.array([0, 1, 3], "f4")
    talk = np.array([0, 0, 1, 0.5, 0, 1], "f4")  # smile and blink of face
    bite = np.array([0, 0, 0.5, 1, 0, 0], "f4")  # blink and open of teeth
    arrays = (CORNERS.astype("f4"), FACES.ravel().astype("u2"), UP, ONE, times, talk, bite, np.zeros((4, 3), "f4"))
    primitive = {"attributes": {"POSITION": 0, "NORMAL": 2}, "indices": 1}
    shapes = [{"POSITION": 2, "NORMAL": 7}, {"POSITION": 3, "NORMAL": 7}]
    meshes = [
        {"name": "face", "primitives": [primitive | {"targets": shapes}], "weights": [0.25, 0.0]},
        {"name": "teeth", "primitives": [primitive | {"targets": shapes[::-1]}]},
    ]
    for mesh, names in zip(meshes, (["smile", "blink"], ["blink", "open"]), strict=True):
        mesh["extras"] = {"targetNames": names, "mine": 7}
    nodes = [
        {"rotation": TURN.as_quat().tolist(), "scale": [SCALE] * 3, "children": [1, 2]},
        {"mesh": 0},
        {"mesh": 1, "translation": [0, 0, -1]},
    ]
    channels = [{"sampler": k, "target": {"node": k + 1, "path": "weights"}} for k in range(2)]
    samplers = [{"input": 4, "output": 5}, {"input": 4, "output": 6}]
    clip = {"name": "talk", "samplers": samplers, "channels": channels}
    document: dict[str, Any] = {"scenes": [{"nodes": [0]}], "scene": 0, "nodes": nodes, "meshes": meshes}
    write_document(path, document | {"animations": [clip]} | more, *arrays)
