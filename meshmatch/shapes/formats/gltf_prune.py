"""Remove unused entries from a glTF document: accessors, buffer views, textures, samplers, images and nodes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

from meshmatch.shapes.formats import gltf_vrm

# Extensions whose references are all found by `references`; if a document uses any other, nothing is removed.
_TEXTURE_EXTENSIONS = re.compile(r"KHR_texture_basisu|EXT_texture_webp|EXT_texture_avif|MSFT_texture_dds")
_KNOWN = re.compile(
    r"KHR_(?:materials_\w+|texture_transform|mesh_quantization|lights_punctual|node_visibility)|"
    + _TEXTURE_EXTENSIONS.pattern
)
_KINDS = ("textures", "images", "samplers", "accessors", "bufferViews")
Json = dict[str, Any]


def unused(json: Json) -> dict[str, set[int]]:
    """Numbers of the entries of each kind that nothing refers to."""
    found = {kind: set(range(len(json.get(kind, [])))) for kind in _KINDS}
    for kind, holder, key in references(json):
        found[kind].discard(holder[key])
    return found


def prune(json: Json, before: dict[str, set[int]]) -> bool:
    """Remove entries that are unused, except those that were unused ``before``; return whether anything was removed.

    Extensions for image formats that no texture uses any more are removed from the lists of extensions.
    """
    if not all(_KNOWN.fullmatch(name) or gltf_vrm.KNOWN.fullmatch(name) for name in _extensions(json)):
        return False
    changed = False
    for kind in _KINDS:
        removed = unused(json)[kind] - before[kind]
        if removed:
            changed = True
            new_number = {old: new for new, old in enumerate(k for k in range(len(json[kind])) if k not in removed)}
            for _, holder, key in [each for each in references(json) if each[0] == kind]:
                holder[key] = new_number.get(holder[key], holder[key])
            json[kind] = [json[kind][old] for old in new_number]
            if not json[kind]:
                del json[kind]
    remaining = {name for texture in json.get("textures", []) for name in texture.get("extensions", {})}
    for key in ("extensionsUsed", "extensionsRequired") if changed else ():
        kept_names = [
            name for name in json.get(key, []) if name in remaining or not _TEXTURE_EXTENSIONS.fullmatch(name)
        ]
        json.pop(key, None)
        json |= {key: kept_names} if kept_names else {}
    return changed


def can_edit_nodes(json: Json) -> bool:
    """Whether the document uses no extension that might refer to nodes."""
    return all(_KNOWN.fullmatch(name) for name in _extensions(json))


def _extensions(json: Json) -> tuple[str, ...]:
    """Names of extensions that a document uses, including root-level ones that it does not declare."""
    return (*json.get("extensionsUsed", []), *json.get("extensions", {}))


def drop_nodes(json: Json, candidates: Iterable[int], character: bool = False) -> None:
    """Remove those candidate nodes that are empty and that nothing refers to.

    Nothing is removed if the document uses an extension that might refer to nodes. With ``character``, VRM extensions are
    allowed, and nodes to which they refer are kept.
    """
    known = all(_KNOWN.fullmatch(name) or gltf_vrm.KNOWN.fullmatch(name) for name in _extensions(json))
    if not (known if character else can_edit_nodes(json)):
        return
    vrm_references = [each for each in gltf_vrm.references(json) if each[0] == "nodes"]
    nodes, unneeded = json["nodes"], set(candidates)
    channels = [channel["target"] for clip in json.get("animations", []) for channel in clip["channels"]]
    skins = json.get("skins", [])
    needed = {target.get("node") for target in channels} | {skin.get("skeleton") for skin in skins}
    needed |= {joint for skin in skins for joint in skin["joints"]} | {holder[key] for _, holder, key in vrm_references}
    unneeded = {
        new_number
        for new_number in unneeded - needed
        if not nodes[new_number].keys() & {"mesh", "camera", "extensions", "extras"}
    }
    parents_of: dict[int, list[int]] = {}
    for parent in unneeded:
        for child in nodes[parent].get("children", []):
            parents_of.setdefault(child, []).append(parent)
    staying = [child for child in parents_of if child not in unneeded]
    while staying:  # ancestors of a node that stays also stay
        for parent in unneeded.intersection(parents_of[staying.pop()]):
            unneeded.remove(parent)
            staying += [parent] if parent in parents_of else []
    new_number = {old: new for new, old in enumerate(k for k in range(len(nodes)) if k not in unneeded)}
    holders = [*((node, "children") for node in nodes), *((scene, "nodes") for scene in json.get("scenes", []))]
    for holder, key in [each for each in holders if each[1] in each[0]]:
        holder[key] = [new_number[child] for child in holder[key] if child in new_number]
        if not holder[key]:
            del holder[key]
    for _, holder, key in vrm_references:
        holder[key] = new_number[holder[key]]
    for target in channels:
        if "node" in target:
            target["node"] = new_number[target["node"]]
    for skin in skins:
        skin["joints"] = [new_number[joint] for joint in skin["joints"]]
        if "skeleton" in skin:
            skin["skeleton"] = new_number[skin["skeleton"]]
    json["nodes"] = [nodes[old] for old in new_number]


def references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """Yield (kind, holder, key) for every reference by number to an entry of one of `_KINDS`."""
    for mesh in json.get("meshes", []):
        for primitive in mesh["primitives"]:
            for accessors in (primitive.get("attributes", {}), *primitive.get("targets", [])):
                yield from (("accessors", accessors, key) for key in accessors)
            if "indices" in primitive:
                yield "accessors", primitive, "indices"
    for skin in json.get("skins", []):
        if "inverseBindMatrices" in skin:
            yield "accessors", skin, "inverseBindMatrices"
    for animation in json.get("animations", []):
        for sampler in animation["samplers"]:
            yield from (("accessors", sampler, key) for key in ("input", "output"))
    yield from _inner_references(json)
    for entry in json.get("materials", []):
        yield from (("textures", texture, "index") for texture in textures_in(entry))
    yield from (each for each in gltf_vrm.references(json) if each[0] in _KINDS)


def _inner_references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """The `references` within accessors, images and textures."""
    for accessor in json.get("accessors", []):
        sparse = accessor.get("sparse", {})
        for entry in (accessor, sparse.get("indices", {}), sparse.get("values", {})):
            if "bufferView" in entry:
                yield "bufferViews", entry, "bufferView"
    for image in json.get("images", []):
        if "bufferView" in image:
            yield "bufferViews", image, "bufferView"
    for texture in json.get("textures", []):
        if "sampler" in texture:
            yield "samplers", texture, "sampler"
        for entry in (texture, *texture.get("extensions", {}).values()):
            if "source" in entry:
                yield "images", entry, "source"


def textures_in(entry: Json) -> Iterator[Json]:
    """Yield all texture references (objects with an "index") in a material and its extensions."""
    for key, value in entry.items():
        if isinstance(value, dict):
            if key.endswith("Texture") and "index" in value:
                yield value
            else:
                yield from textures_in(value)
