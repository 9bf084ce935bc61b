"""Contents of a written file, and differences from what other programs find in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.blender import is_converted
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.formats.gltf import Document

_GLTF = (".glb", ".gltf", ".vrm")
_MAX_DIFFERENCE = 0.005  # maximum difference of bounding boxes and their scale, as a fraction of the size
_TRIANGLE_MODES = (None, 4)


@dataclass(frozen=True, eq=False)
class Written:
    """Contents of a file: ``counts`` of its elements, numbers of primitives (``parts``) and of morph targets of all
    primitives, names of joints, and the bounding box in the file's axes.
    """

    suffix: str
    counts: dict[str, int]
    parts: int
    part_morphs: int
    joints: frozenset[str]
    box: Float[Floats, "2 3"]

    @classmethod
    def of(cls, path: Path) -> Written:
        """Read the contents of a file; for one that Blender wrote, those of the glb of the same name, if it exists."""
        suffix = path.suffix
        if is_converted(path) and (twin := path.with_suffix(".glb")).exists():
            path = twin
        shape = load_shape(path)
        box = np.array(shape.bounds, np.float64)
        if path.suffix not in _GLTF:
            return cls(suffix, {"meshes": 1, "faces": shape.F, "images": _obj_images(path)}, 1, 0, frozenset(), box)
        document = Document(path, path.read_bytes())
        json = document.json
        meshes = [json["meshes"][node["mesh"]]["primitives"] for node in document.nodes if "mesh" in node]
        parts = [part for mesh in meshes for part in mesh]
        joints = {joint for node in document.nodes if "skin" in node for joint in json["skins"][node["skin"]]["joints"]}
        counts = {
            "meshes": len(meshes),
            "faces": sum(_triangles(json, part) for part in parts),
            "bones": len(joints),
            "clips": len(json.get("animations", [])),
            "morphs": sum(len(mesh[0].get("targets", [])) for mesh in meshes),
            "images": len(json.get("images", [])),
        }
        morphs = sum(len(part.get("targets", [])) for part in parts)
        names = frozenset(str(document.nodes[joint].get("name")) for joint in joints)
        return cls(suffix, counts, len(parts), morphs, names, box)

    def begins(self, tool: str) -> bool:
        """Return whether a viewer shows the first frame of a clip instead of the rest pose."""
        formats = (".dae", ".fbx", ".usdz") if tool == "three" else (".dae",)
        return bool(self.counts.get("clips")) and self.suffix in formats


def _triangles(json: dict[str, Any], part: dict[str, Any]) -> int:
    if part.get("mode") not in _TRIANGLE_MODES:
        return 0
    accessor = part.get("indices", part["attributes"]["POSITION"])
    return int(json["accessors"][accessor]["count"]) // 3


def _obj_images(path: Path) -> int:
    """Count the images named by the mtl of an obj."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.suffix == ".obj" else []
    library = next((line.split(maxsplit=1)[1] for line in lines if line.startswith("mtllib ")), None)
    words = [] if library is None else path.with_name(library).read_text(encoding="utf-8").splitlines()
    return len({line.split()[-1] for line in words if line.strip().lower().startswith("map_")})


def differences(written: Written, found: dict[str, Any], tool: str) -> list[str]:
    """Describe the differences between what was written and what a viewer found."""
    wanted = dict(written.counts)
    if tool == "three":  # has one mesh per primitive
        wanted |= {"meshes": written.parts, "morphs": written.part_morphs}
    have = {key: len(found[key]) if isinstance(found[key], list) else found[key] for key in wanted if key in found}
    if tool == "blender" and written.joints:  # it also makes bones of nodes between joints
        have["bones"] = len(written.joints & set(found["bones"]))
    words = {"bones": "joints", "morphs": "shapes"}
    if written.suffix not in _GLTF:  # ancestors of joints become joints, and blendshapes get a skeleton in a usdz
        have |= {key: min(have[key], wanted[key]) for key in ("bones", "clips") if key in wanted}
    wrong = [
        f"{have[key]:g} of {wanted[key]} {words.get(key, key)}" for key in wanted if have.get(key, 0) != wanted[key]
    ]
    there, box = np.array(found["box"], float), written.box
    size = float(np.linalg.norm(np.ptp(box, axis=0)))
    unit = 100.0 if tool == "three" and written.suffix == ".fbx" else 1.0  # three.js keeps the centimetres of fbx
    scale = float(np.linalg.norm(np.ptp(there, axis=0))) / size
    if not np.isfinite(there).all():
        return [*wrong, "lies nowhere"]
    if written.begins(tool):
        return wrong
    if abs(scale / unit - 1.0) > _MAX_DIFFERENCE:
        wrong.append(f"{scale / unit:.3g} times as large")
    if (off := float(np.abs(there / scale - box).max()) / size) > _MAX_DIFFERENCE:
        wrong.append(f"lies {off:.1%} of its size off")
    return wrong
