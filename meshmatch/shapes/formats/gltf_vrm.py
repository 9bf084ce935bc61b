"""What the extensions of a character (VRM 0.x and 1.0) say about a glTF document by number, kept right when that changes.

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
OLD, NEW = "VRM", "VRMC_vrm"
"""The extension of VRM 0.x, and that of 1.0."""
SPRINGS, CONSTRAINT = "VRMC_springBone", "VRMC_node_constraint"
ROOTS = (OLD, NEW, SPRINGS, CONSTRAINT)
"""Extensions that say something about a whole character."""
KNOWN = re.compile(
    r"VRM|VRMC_(?:vrm|springBone|springBone_extended_collider|node_constraint|materials_mtoon|materials_hdr\w+)"
)
"""Extensions all of whose numbers are among `references`, or stand in materials."""
_QUEUES = {"OPAQUE": 2000, "MASK": 2450, "BLEND": 3000}


def is_character(json: Json) -> bool:
    """Whether a document says which of its bones are a person's."""
    return any(isinstance(json.get("extensions", {}).get(name), dict) for name in (OLD, NEW))


def check_character(file: Path | None, output: Path) -> None:
    """Refuse a .vrm of what is none (`OptionError`): who made it, and under which licence, nobody could say."""
    if output.suffix.lower() != SUFFIX:
        return
    name, hint = "the target" if file is None else file.name, "end the name in .glb"
    found = False, False
    if file is not None and file.suffix.lower() in gltf.SUFFIXES:
        found = gltf.understood(
            file, read_bytes(file), "scene makes", lambda each: (is_character(each.json), each.draws_copies())
        )
    if not found[0]:
        raise OptionError(f"{output.name} would be no character: {name} has no VRM extension", hint)
    if found[1]:
        raise OptionError(f"{output.name} would be no character: {name} draws copies of one mesh", hint)


def references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """Kind, holder and key of all numbers in these extensions that stand for a node, mesh, material, texture or image."""
    for kind, holder, key in (*_old(json), *_new(json)):
        if isinstance(holder[key], int) and holder[key] >= 0:  # -1 is none
            yield kind, holder, key


def copy_mesh(json: Json, old: int, new: int) -> None:
    """Let what is said of a mesh count for a copy of it too."""
    extension = part(json, "extensions", OLD)
    held = [part(group, "binds") for group in entries(extension, "blendShapeMaster", "blendShapeGroups")]
    for some in (*held, part(extension, "firstPerson", "meshAnnotations")):
        if isinstance(some, list):
            some += [each | {"mesh": new} for each in entries(some) if each.get("mesh") == old]


def reorder_targets(json: Json, node: int, mesh: int, columns: Sequence[int]) -> None:
    """Let expressions name the same morph targets of a node, whose mesh no other draws: ``columns`` are the old places of
    all that it has now, or -1.
    """
    now = {old: new for new, old in enumerate(columns) if old >= 0}
    for kind, number, bind in _morph_binds(json):
        if number == (mesh if kind == "mesh" else node):
            bind["index"] = now.get(bind.get("index", -1), bind.get("index"))


def copy_material(json: Json, old: int, new: int) -> None:
    """Let expressions color a copy of a material too."""
    for expression in _expressions(json):
        for key in ("materialColorBinds", "textureTransformBinds"):
            held = expression.get(key)
            if isinstance(held, list):
                held += [each | {"material": new} for each in entries(held) if each.get("material") == old]


def complete_properties(json: Json, added: Sequence[Json] = ()) -> None:
    """Say of materials that are new in a document of VRM 0.x how to draw them: of the last ones what is ``added``, of others
    that glTF has it.
    """
    extension = part(json, "extensions", OLD)
    if isinstance(extension, dict):
        held = extension.setdefault("materialProperties", [])
        for material in json.get("materials", [])[len(held) : len(json.get("materials", [])) - len(added)]:
            held.append(plain_properties(material))
        held += copy.deepcopy(list(added))


def plain_properties(material: Json) -> Json:
    """What VRM 0.x says of a material that is drawn as glTF has it."""
    groups = ("floatProperties", "vectorProperties", "textureProperties", "keywordMap", "tagMap")
    entry: Json = {"name": material.get("name", ""), "shader": "VRM_USE_GLTFSHADER"}
    return entry | {"renderQueue": _QUEUES.get(material.get("alphaMode", "OPAQUE"), 2000)} | {key: {} for key in groups}


def properties(json: Json) -> list[Json]:
    """How VRM 0.x draws each material; shorter, or empty, where nothing is said."""
    return entries(part(json, "extensions", OLD), "materialProperties")


def show_mesh(json: Json, node: int, mesh: int) -> None:
    """Let a new mesh be seen from inside the head as the others are, where the document says so of each."""
    for name, entry in ((OLD, {"mesh": mesh, "firstPersonFlag": "Auto"}), (NEW, {"node": node, "type": "auto"})):
        held = part(json, "extensions", name, "firstPerson", "meshAnnotations")
        if isinstance(held, list):
            held.append(entry)


def moving_textures(json: Json, materials: Mapping[int, str]) -> list[str]:
    """Names of expressions that move the textures of these materials, by number, over their surface."""
    found = []
    for group in entries(part(json, "extensions", OLD), "blendShapeMaster", "blendShapeGroups"):
        values = [each for each in entries(group, "materialValues") if each.get("materialName") in materials.values()]
        if any(str(each.get("propertyName")).startswith("_MainTex") for each in values):
            found.append(str(group.get("name", "")))
    for kind in ("preset", "custom"):
        named = part(json, "extensions", NEW, "expressions", kind)
        for name, expression in named.items() if isinstance(named, dict) else ():
            if any(each.get("material") in materials for each in entries(expression, "textureTransformBinds")):
                found.append(str(name))
    return found


def springs_and_constraints(json: Json) -> int:
    """How many there are that move joints, in either version."""
    springs = [*entries(json, "extensions", OLD, "secondaryAnimation", "boneGroups")]
    springs += entries(json, "extensions", SPRINGS, "springs")
    return len(springs) + sum(CONSTRAINT in node.get("extensions", {}) for node in json["nodes"])


def part(held: Any, *keys: str) -> Any:
    """What lies at the end of these keys; None where there is nothing."""
    for key in keys:
        held = held.get(key) if isinstance(held, dict) else None
    return held


def entries(held: Any, *keys: str) -> list[Json]:
    """The objects of a list, or the values of an object, at the end of these keys."""
    found = part(held, *keys)
    found = list(found.values()) if isinstance(found, dict) else found
    return [each for each in found if isinstance(each, dict)] if isinstance(found, list) else []


def _expressions(json: Json) -> list[Json]:
    """Those of VRM 1.0."""
    held = part(json, "extensions", NEW, "expressions")
    return [*entries(held, "preset"), *entries(held, "custom")]


def _morph_binds(json: Json) -> Iterator[tuple[str, Any, Json]]:
    """What each bind names its morph targets by, "mesh" or "node", its number, and the bind."""
    for group in entries(part(json, "extensions", OLD), "blendShapeMaster", "blendShapeGroups"):
        yield from (("mesh", bind.get("mesh"), bind) for bind in entries(group, "binds"))
    for expression in _expressions(json):
        yield from (("node", bind.get("node"), bind) for bind in entries(expression, "morphTargetBinds"))


def _named(kind: str, holders: Sequence[Json], key: str) -> Iterator[tuple[str, Json, str]]:
    return ((kind, holder, key) for holder in holders if key in holder)


def _old(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """Those of VRM 0.x."""
    extension = part(json, "extensions", OLD)
    springs = entries(extension, "secondaryAnimation", "boneGroups")
    single = {key: [held] for key in ("meta", "firstPerson") if isinstance(held := part(extension, key), dict)}
    yield from _named("textures", single.get("meta", []), "texture")
    yield from _named("nodes", single.get("firstPerson", []), "firstPersonBone")
    yield from _named("nodes", entries(extension, "humanoid", "humanBones"), "node")
    yield from _named("meshes", entries(extension, "firstPerson", "meshAnnotations"), "mesh")
    for group in entries(extension, "blendShapeMaster", "blendShapeGroups"):
        yield from _named("meshes", entries(group, "binds"), "mesh")
    yield from _named("nodes", springs, "center")
    yield from _named("nodes", entries(extension, "secondaryAnimation", "colliderGroups"), "node")
    for spring in springs:
        bones = spring.get("bones")
        yield from (("nodes", bones, k) for k in range(len(bones) if isinstance(bones, list) else 0))
    for entry in properties(json):
        textures = part(entry, "textureProperties")
        yield from (("textures", textures, key) for key in (textures if isinstance(textures, dict) else ()))


def _new(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """Those of VRM 1.0."""
    extension, springs = (part(json, "extensions", name) for name in (NEW, SPRINGS))
    meta = part(extension, "meta")
    yield from _named("images", [meta] if isinstance(meta, dict) else [], "thumbnailImage")
    yield from _named("nodes", entries(extension, "humanoid", "humanBones"), "node")
    yield from _named("nodes", entries(extension, "firstPerson", "meshAnnotations"), "node")
    for expression in _expressions(json):
        yield from _named("nodes", entries(expression, "morphTargetBinds"), "node")
        for key in ("materialColorBinds", "textureTransformBinds"):
            yield from _named("materials", entries(expression, key), "material")
    yield from _named("nodes", entries(springs, "colliders"), "node")
    for spring in entries(springs, "springs"):
        yield from _named("nodes", entries(spring, "joints"), "node")
        yield from _named("nodes", [spring], "center")
    for node in json.get("nodes", []):
        yield from _named("nodes", entries(node, "extensions", CONSTRAINT, "constraint"), "source")
