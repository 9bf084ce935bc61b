"""Keep the VRM extensions (0.x and 1.0) of a character consistent when numbered entries of its glTF document change.

Specification: VRM Consortium, VRM 0.0; VRMC_vrm 1.0, VRMC_springBone 1.0, VRMC_node_constraint 1.0.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from meshmatch.errors import OptionError
from meshmatch.shapes.formats import gltf
from meshmatch.shapes.input_files import read_bytes

Json = dict[str, Any]
SUFFIX = ".vrm"
VRM0, VRM1 = "VRM", "VRMC_vrm"
"""Extensions of VRM 0.x and of VRM 1.0."""
SPRINGS, CONSTRAINT = "VRMC_springBone", "VRMC_node_constraint"
ROOTS = (VRM0, VRM1, SPRINGS, CONSTRAINT)
"""Extensions that describe a character as a whole."""
KNOWN = re.compile(
    r"VRM|VRMC_(?:vrm|springBone|springBone_extended_collider|node_constraint|materials_mtoon|materials_hdr\w+)"
)
"""Extensions whose references by number are all found by `references`, or are in materials."""
_QUEUES = {"OPAQUE": 2000, "MASK": 2450, "BLEND": 3000}


def is_character(json: Json) -> bool:
    """Whether a document has a VRM extension."""
    return any(isinstance(json.get("extensions", {}).get(name), dict) for name in (VRM0, VRM1))


def check_character(file: Path | None, output: Path) -> None:
    """Raise `OptionError` if `output` is a .vrm but `file` is not a character, since author and license would be unknown.

    Scenes that use GPU instancing are refused as well.
    """
    if output.suffix.lower() != SUFFIX:
        return
    target_name, hint = "the target" if file is None else file.name, "end the name in .glb"
    checks = False, False
    if file is not None and file.suffix.lower() in gltf.SUFFIXES:
        checks = gltf.parse_document(
            file, read_bytes(file), "scene makes", lambda each: (is_character(each.json), each.uses_instancing())
        )
    if not checks[0]:
        raise OptionError(f"{output.name} would be no character: {target_name} has no VRM extension", hint)
    if checks[1]:
        raise OptionError(f"{output.name} would be no character: {target_name} draws copies of one mesh", hint)


def references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """Yield (kind, holder, key) for every reference by number in VRM extensions.

    Kinds are nodes, meshes, materials, textures and images.
    """
    for kind, holder, key in (*_vrm0_references(json), *_vrm1_references(json)):
        if isinstance(holder[key], int) and holder[key] >= 0:  # -1 means none
            yield kind, holder, key


def copy_mesh(json: Json, old: int, new: int) -> None:
    """Apply the expressions and first-person settings (VRM 0.x) of a mesh to a copy of it as well."""
    extension = nested(json, "extensions", VRM0)
    lists = [nested(group, "binds") for group in nested_entries(extension, "blendShapeMaster", "blendShapeGroups")]
    for items in (*lists, nested(extension, "firstPerson", "meshAnnotations")):
        if isinstance(items, list):
            items += [each | {"mesh": new} for each in nested_entries(items) if each.get("mesh") == old]


def reorder_targets(json: Json, node: int, mesh: int, columns: Sequence[int]) -> None:
    """Update the morph target indices in expressions after the targets of a node have been reordered.

    No other node may draw the mesh. ``columns`` has the old index of each target that the node has now, or -1.
    """
    new_index = {old: new for new, old in enumerate(columns) if old >= 0}
    for kind, number, bind in _morph_binds(json):
        if number == (mesh if kind == "mesh" else node):
            bind["index"] = new_index.get(bind.get("index", -1), bind.get("index"))


def copy_material(json: Json, old: int, new: int) -> None:
    """Apply the expressions (VRM 1.0) that change a material to a copy of it as well."""
    for expression in _expressions(json):
        for key in ("materialColorBinds", "textureTransformBinds"):
            binds = expression.get(key)
            if isinstance(binds, list):
                binds += [each | {"material": new} for each in nested_entries(binds) if each.get("material") == old]


def complete_properties(json: Json, added: Sequence[Json] = ()) -> None:
    """Append the VRM 0.x properties of new materials: ``added`` for the last ones, plain glTF shading for others."""
    extension = nested(json, "extensions", VRM0)
    if isinstance(extension, dict):
        entry_list = extension.setdefault("materialProperties", [])
        for material in json.get("materials", [])[len(entry_list) : len(json.get("materials", [])) - len(added)]:
            entry_list.append(plain_properties(material))
        entry_list += copy.deepcopy(list(added))


def plain_properties(material: Json) -> Json:
    """VRM 0.x properties of a material with plain glTF shading."""
    groups = ("floatProperties", "vectorProperties", "textureProperties", "keywordMap", "tagMap")
    entry: Json = {"name": material.get("name", ""), "shader": "VRM_USE_GLTFSHADER"}
    return entry | {"renderQueue": _QUEUES.get(material.get("alphaMode", "OPAQUE"), 2000)} | {key: {} for key in groups}


def properties(json: Json) -> list[Json]:
    """VRM 0.x properties of the materials, in their order; may be shorter than the list of materials, or empty."""
    return nested_entries(nested(json, "extensions", VRM0), "materialProperties")


def show_mesh(json: Json, node: int, mesh: int) -> None:
    """Add the first-person setting "auto" for a new mesh if the document has such settings."""
    for name, entry in ((VRM0, {"mesh": mesh, "firstPersonFlag": "Auto"}), (VRM1, {"node": node, "type": "auto"})):
        annotations = nested(json, "extensions", name, "firstPerson", "meshAnnotations")
        if isinstance(annotations, list):
            annotations.append(entry)


def moving_textures(json: Json, materials: Mapping[int, str]) -> list[str]:
    """Names of expressions that shift or scale the textures of these materials (names by number)."""
    found = []
    for group in nested_entries(nested(json, "extensions", VRM0), "blendShapeMaster", "blendShapeGroups"):
        values = [
            each for each in nested_entries(group, "materialValues") if each.get("materialName") in materials.values()
        ]
        if any(str(each.get("propertyName")).startswith("_MainTex") for each in values):
            found.append(str(group.get("name", "")))
    for kind in ("preset", "custom"):
        expressions = nested(json, "extensions", VRM1, "expressions", kind)
        for name, expression in expressions.items() if isinstance(expressions, dict) else ():
            if any(each.get("material") in materials for each in nested_entries(expression, "textureTransformBinds")):
                found.append(str(name))
    return found


def springs_and_constraints(json: Json) -> int:
    """Count the springs and constraints that move joints, in either version."""
    springs = [*nested_entries(json, "extensions", VRM0, "secondaryAnimation", "boneGroups")]
    springs += nested_entries(json, "extensions", SPRINGS, "springs")
    return len(springs) + sum(CONSTRAINT in node.get("extensions", {}) for node in json["nodes"])


def nested(data: Any, *keys: str) -> Any:
    """Return the value at a path of keys in nested objects; None if it does not exist."""
    for key in keys:
        data = data.get(key) if isinstance(data, dict) else None
    return data


def nested_entries(data: Any, *keys: str) -> list[Json]:
    """Return the objects in the list, or among the values of the object, at a path of keys; empty if there are none."""
    found = nested(data, *keys)
    found = list(found.values()) if isinstance(found, dict) else found
    return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []


def _expressions(json: Json) -> list[Json]:
    """All expressions of VRM 1.0."""
    expressions = nested(json, "extensions", VRM1, "expressions")
    return [*nested_entries(expressions, "preset"), *nested_entries(expressions, "custom")]


def _morph_binds(json: Json) -> Iterator[tuple[str, Any, Json]]:
    """Yield ("mesh" or "node", its number, bind) for every morph target bind of an expression."""
    for group in nested_entries(nested(json, "extensions", VRM0), "blendShapeMaster", "blendShapeGroups"):
        yield from (("mesh", bind.get("mesh"), bind) for bind in nested_entries(group, "binds"))
    for expression in _expressions(json):
        yield from (("node", bind.get("node"), bind) for bind in nested_entries(expression, "morphTargetBinds"))


def _references_at(kind: str, holders: Sequence[Json], key: str) -> Iterator[tuple[str, Json, str]]:
    return ((kind, holder, key) for holder in holders if key in holder)


def _vrm0_references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """The `references` of VRM 0.x."""
    extension = nested(json, "extensions", VRM0)
    springs = nested_entries(extension, "secondaryAnimation", "boneGroups")
    single = {key: [held] for key in ("meta", "firstPerson") if isinstance(held := nested(extension, key), dict)}
    yield from _references_at("textures", single.get("meta", []), "texture")
    yield from _references_at("nodes", single.get("firstPerson", []), "firstPersonBone")
    yield from _references_at("nodes", nested_entries(extension, "humanoid", "humanBones"), "node")
    yield from _references_at("meshes", nested_entries(extension, "firstPerson", "meshAnnotations"), "mesh")
    for group in nested_entries(extension, "blendShapeMaster", "blendShapeGroups"):
        yield from _references_at("meshes", nested_entries(group, "binds"), "mesh")
    yield from _references_at("nodes", springs, "center")
    yield from _references_at("nodes", nested_entries(extension, "secondaryAnimation", "colliderGroups"), "node")
    for spring in springs:
        bones = spring.get("bones")
        yield from (("nodes", bones, k) for k in range(len(bones) if isinstance(bones, list) else 0))
    for entry in properties(json):
        textures = nested(entry, "textureProperties")
        yield from (("textures", textures, key) for key in (textures if isinstance(textures, dict) else ()))


def _vrm1_references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """The `references` of VRM 1.0."""
    extension, springs = (nested(json, "extensions", name) for name in (VRM1, SPRINGS))
    meta = nested(extension, "meta")
    yield from _references_at("images", [meta] if isinstance(meta, dict) else [], "thumbnailImage")
    yield from _references_at("nodes", nested_entries(extension, "humanoid", "humanBones"), "node")
    yield from _references_at("nodes", nested_entries(extension, "firstPerson", "meshAnnotations"), "node")
    for expression in _expressions(json):
        yield from _references_at("nodes", nested_entries(expression, "morphTargetBinds"), "node")
        for key in ("materialColorBinds", "textureTransformBinds"):
            yield from _references_at("materials", nested_entries(expression, key), "material")
    yield from _references_at("nodes", nested_entries(springs, "colliders"), "node")
    for spring in nested_entries(springs, "springs"):
        yield from _references_at("nodes", nested_entries(spring, "joints"), "node")
        yield from _references_at("nodes", [spring], "center")
    for node in json.get("nodes", []):
        yield from _references_at("nodes", nested_entries(node, "extensions", CONSTRAINT, "constraint"), "source")
