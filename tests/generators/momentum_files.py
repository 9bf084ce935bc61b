"""A hand-made Momentum rig in the files of its release, with a small tetrahedron around every joint that is read."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from tests.generators.stick import stick_figure

_STATIONS = {"uparm": 5, "lowarm": 5, "upleg": 5, "lowleg": 5}
_FINGERS = ("thumb", "index", "middle", "ring", "pinky")


def _layout() -> list[tuple[str, str, np.ndarray]]:
    """Return name, parent and position in cm of the joints, with equidistant twist joints along bones."""
    rig = stick_figure(3)
    at = {name: 100 * rig.heads[1, k].double().numpy() for k, name in enumerate(rig.names)}
    rows = [("body_world", "", np.zeros(3)), ("root", "body_world", at["root"])]
    for k, name in enumerate(("spine05", "spine04", "spine03", "spine01")):
        rows.append((f"c_spine{k}", f"c_spine{k - 1}" if k else "root", at[name]))
    rows += [("c_neck", "c_spine3", at["neck01"]), ("c_neck_twist1_proc", "c_neck", at["neck02"])]
    rows += [("c_neck_twist0_proc", "c_neck", at["neck01"]), ("c_head", "c_neck", at["head"])]
    for s in "lr":
        own = {name[:-2]: place for name, place in at.items() if name.endswith(s.upper())}
        chain = [
            ("clavicle", "c_spine3", "clavicle"), ("uparm", f"{s}_clavicle", "upperarm01"),
            ("lowarm", f"{s}_uparm", "lowerarm01"), ("wrist", f"{s}_lowarm", "wrist"), ("upleg", "root", "upperleg01"),
            ("lowleg", f"{s}_upleg", "lowerleg01"), ("talocrural", f"{s}_lowleg", "foot"),
            ("ball", f"{s}_talocrural", "toe2-1"), ("eye", "c_head", "eye"),
            *((f"{name}{k}", f"{s}_{name}{k - 1}" if k > 1 else f"{s}_wrist", f"finger{n}-{k}")
              for n, name in enumerate(_FINGERS, 1) for k in (1, 2, 3)),
        ]  # fmt: skip
        rows += [(f"{s}_{name}", parent, own[place]) for name, parent, place in chain]
        ends = {"uparm": "lowerarm01", "lowarm": "wrist", "upleg": "lowerleg01", "lowleg": "foot"}
        starts = {"uparm": "upperarm01", "lowarm": "lowerarm01", "upleg": "upperleg01", "lowleg": "lowerleg01"}
        for bone, end in ends.items():
            begin = own[starts[bone]]
            for k in range(0 if bone.startswith("up") else 1, 5):
                share = k / 4 if bone.startswith("up") else k / 5
                rows.append((f"{s}_{bone}_twist{k}_proc", f"{s}_{bone}", begin + share * (own[end] - begin)))
    return rows


def write_rig(folder: Path, shapes: int = 47) -> list[str]:
    """Write both files; return the names of the joints, each of which has four vertices."""
    rows = _layout()
    names = [name for name, *_ in rows]
    place = np.array([at for *_, at in rows])
    corner = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    verts = (place[:, None] + corner).reshape(-1, 3)
    faces = (np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]) + 4 * np.arange(len(rows))[:, None, None]).reshape(
        -1, 3
    )
    closed = faces.astype(np.int32)
    closed[:, 2] = ~closed[:, 2]
    objects = [
        node("Geometry", [1, b"mesh\0\1Geometry", b"Mesh"], [node("Vertices", [verts.ravel()]),
                                                             node("PolygonVertexIndex", [closed.ravel()])])
    ]  # fmt: skip
    for k in reversed(range(shapes)):  # blend k moves vertex k by k mm
        content = [node("Indexes", [np.array([k], np.int32)]), node("Vertices", [np.array([0.1 * k, 0, 0])])]
        objects.append(node("Geometry", [100 + k, f"blend_{k}\0\1Geometry".encode(), b"Shape"], content))
    links = []
    for k, (name, parent, at) in enumerate(rows):
        shift = at - (place[names.index(parent)] if parent else 0)
        moved = node("P", [b"Lcl Translation", b"", b"", b"A", *map(float, shift)])
        kind = b"LimbNode" if parent else b"Root"
        objects.append(
            node("Model", [1000 + k, f"{name}\0\1Model".encode(), kind], [node("Properties70", [], [moved])])
        )
        own = [node("Indexes", [np.arange(4 * k, 4 * k + 4, dtype=np.int32)]), node("Weights", [np.full(4, 0.5)])]
        objects.append(node("Deformer", [5000 + k, f"cluster{k}\0\1SubDeformer".encode(), b"Cluster"], own))
        links.append(node("C", [b"OO", 1000 + k, 5000 + k]))
        if parent:
            links.append(node("C", [b"OO", 1000 + k, 1000 + names.index(parent)]))
    folder.mkdir(exist_ok=True)
    (folder / "lod3.fbx").write_bytes(fbx([node("Objects", [], objects), node("Connections", [], links)]))
    (folder / "compact_v6_1.model").write_text(
        "Momentum Model Definition V1.0\n[ParameterTransform]\n# bones\nroot.tx = 10.0 * root_tx\n"
        "l_wrist.tx = 10.0 * scale_lowarms # longer\nr_wrist.tx = -10.0 * scale_lowarms\nl_wrist.sc = 1.0 * scale_l_hands\n"
        "r_wrist.sc = 1.0 * scale_r_hands\nl_uparm.rx = 1.0 * l_uparm_twist\n[Limits]\n"
        "limit scale_lowarms minmax [-1.0, 0.5]\nlimit scale_l_hands minmax [-0.2, 0.2]\n"
        "limit scale_r_hands minmax [-0.2, 0.2] 0.1\nlimit scale_knee_knock minmax [0.0, 0.0]\n"
        "limit l_uparm_twist minmax [-1.5, 1.8]\n"
    )
    return names


def node(name: str, values: list[Any], children: list[Any] | None = None) -> tuple[str, list[Any], list[Any]]:
    return name, values, children or []


def fbx(nodes: list[Any]) -> bytes:
    """Encode nodes as a binary FBX file of version 7.4."""
    data = bytearray(b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", 7400))
    for each in nodes:
        _append(data, each)
    return bytes(data + bytes(13))


def _append(data: bytearray, each: Any) -> None:
    name, values, children = each
    start = len(data)
    data += bytes(12) + bytes([len(name)]) + name.encode()
    begin = len(data)
    for value in values:
        data += _property(value)
    length = len(data) - begin
    for child in children:
        _append(data, child)
    if children:
        data += bytes(13)
    data[start : start + 12] = struct.pack("<III", len(data), len(values), length)


def _property(value: Any) -> bytes:
    if isinstance(value, bytes):
        return b"S" + struct.pack("<I", len(value)) + value
    if isinstance(value, np.ndarray):
        raw = zlib.compress(value.tobytes())
        return (b"d" if value.dtype == np.float64 else b"i") + struct.pack("<III", value.size, 1, len(raw)) + raw
    return b"D" + struct.pack("<d", value) if isinstance(value, float) else b"L" + struct.pack("<q", value)
