"""Add everything that one glTF scene draws to another scene, with its materials and images.

Specification: Khronos glTF 2.0, sections 3.5 and 3.7.3.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from meshmatch.arrays import Floats
from meshmatch.shapes.formats import gltf_vrm
from meshmatch.shapes.formats.gltf import Document
from meshmatch.shapes.formats.gltf_add_skeleton import bake_transform, rigid_frame
from meshmatch.shapes.formats.gltf_attributes import joint_nodes
from meshmatch.shapes.formats.gltf_edit import Editor, drawn_nodes
from meshmatch.shapes.formats.gltf_prune import references
from meshmatch.shapes.formats.gltf_rig import Binding
from meshmatch.shapes.formats.gltf_write import VERTICES

_KINDS = ("bufferViews", "accessors", "images", "samplers", "textures", "materials", "meshes")
_VARIANTS = "KHR_materials_variants"


def add_scene(document: Document, added: Document, binding: Binding | None) -> bytes:
    """Return a scene as a glb, with the meshes of another scene added, one new node each, at their world positions.

    Parameters
    ----------
    document
        The scene; its content is kept.
    added
        The scene to add, without its clips, cameras and lights.
    binding
        Skin weights of the added vertices for the joints of `document`, in the order of `joint_nodes`. None, or a scene
        without joints: the added meshes are not skinned.
    """
    editor, joints = Editor(document), joint_nodes(document)
    parts = drawn_nodes(added)
    meshes, frames = _copy_meshes(editor, added, parts)
    joint_rows, weight_rows = (None, None) if binding is None or not joints else binding.table()
    n_verts = 0
    for (number, primitives), mesh, frame in zip(parts.items(), meshes, frames, strict=True):
        mesh_entry = editor.json["meshes"][mesh]
        entry: dict[str, Any] = {"mesh": mesh}
        if name := added.nodes[number].get("name") or mesh_entry.get("name"):
            entry["name"] = name
        entry |= {key: added.nodes[number][key] for key in ("weights", "extras") if key in added.nodes[number]}
        for k, part in primitives.items():
            rows = slice(n_verts, n_verts + added.count(part["attributes"]["POSITION"]))
            n_verts = rows.stop
            attributes = mesh_entry["primitives"][k]["attributes"]
            for key in [key for key in attributes if key.startswith(("JOINTS_", "WEIGHTS_"))]:
                del attributes[key]
            if joint_rows is not None and weight_rows is not None:
                attributes["JOINTS_0"] = editor.add_array(joint_rows[rows], target=VERTICES)
                attributes["WEIGHTS_0"] = editor.add_array(weight_rows[rows], target=VERTICES)
        if binding is None or not joints:
            entry["matrix"] = frame.T.ravel().tolist()
        else:
            inverse_bind = np.linalg.inv(binding.bind[binding.rig.joints]) @ frame
            inverse = editor.add_array(inverse_bind.swapaxes(1, 2).reshape(-1, 16).astype("<f4"))
            entry["skin"] = editor.add("skins", {"joints": joints, "inverseBindMatrices": inverse})
        node = editor.add("nodes", entry)
        editor.draw(document, node)
        gltf_vrm.show_mesh(editor.json, node, mesh)
    return editor.to_bytes()


def _copy_meshes(
    editor: Editor, added: Document, parts: dict[int, dict[int, dict[str, Any]]]
) -> tuple[list[int], list[Floats]]:
    """Copy the meshes of nodes, with everything they refer to, into another document.

    Returns their numbers there, and for each the matrix that takes its vertices to scene coordinates.
    """
    other = Editor(added)
    offset = {kind: len(editor.json.get(kind, [])) for kind in _KINDS}
    meshes = [copy.deepcopy(other.json["meshes"][added.nodes[number]["mesh"]]) for number in parts]
    frames = []
    for (number, primitives), mesh in zip(parts.items(), meshes, strict=True):
        frame = rigid_frame(added, number, primitives)
        for k, part in primitives.items() if frame is None else ():
            bake_transform(other, added, number, part, mesh["primitives"][k])
        frames.append(np.eye(4) if frame is None else frame)
    other.json |= {"meshes": meshes, "skins": [], "animations": []}
    for kind, holder, key in references(other.json):
        holder[key] += offset[kind]
    for primitive in [primitive for mesh in meshes for primitive in mesh["primitives"]]:
        primitive.get("extensions", {}).pop(_VARIANTS, None)
        if "material" in primitive:
            primitive["material"] += offset["materials"]
    editor.add_buffer(other)
    for kind in _KINDS:
        if entries := other.json.get(kind):
            editor.json.setdefault(kind, []).extend(entries)
    gltf_vrm.complete_properties(other.json)
    gltf_vrm.complete_properties(editor.json, gltf_vrm.properties(other.json))
    for key in ("extensionsUsed", "extensionsRequired"):
        added_names = [name for name in other.json.get(key, []) if name not in gltf_vrm.ROOTS]
        if extension_names := [*editor.json.get(key, []), *added_names]:
            editor.json[key] = list(dict.fromkeys(extension_names))
    return [offset["meshes"] + k for k in range(len(meshes))], frames
