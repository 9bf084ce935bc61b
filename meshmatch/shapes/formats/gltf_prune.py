"""What a glTF document refers to no more, taken out of it: accessors, buffer views, textures and images."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

from meshmatch.shapes.formats import gltf_vrm

# Extensions that refer to nothing but textures of materials, or what is found below; with others nothing is taken out.
_OF_TEXTURES = re.compile(r"KHR_texture_basisu|EXT_texture_webp|EXT_texture_avif|MSFT_texture_dds")
_KNOWN = re.compile(
    r"KHR_(?:materials_\w+|texture_transform|mesh_quantization|lights_punctual|node_visibility)|" + _OF_TEXTURES.pattern
)
_KINDS = ("textures", "images", "samplers", "accessors", "bufferViews")
Json = dict[str, Any]


def unused(json: Json) -> dict[str, set[int]]:
    """Of each kind, the numbers that nothing refers to."""
    found = {kind: set(range(len(json.get(kind, [])))) for kind in _KINDS}
    for kind, holder, key in references(json):
        found[kind].discard(holder[key])
    return found


def prune(json: Json, before: dict[str, set[int]]) -> bool:
    """Take out what is not used, but for what was not used ``before``, and kinds of images that are no more; returns whether
    there was any.
    """
    if not all(_KNOWN.fullmatch(name) or gltf_vrm.KNOWN.fullmatch(name) for name in _extensions(json)):
        return False
    some = False
    for kind in _KINDS:
        gone = unused(json)[kind] - before[kind]
        if gone:
            some = True
            number = {old: new for new, old in enumerate(k for k in range(len(json[kind])) if k not in gone)}
            for _, holder, key in [each for each in references(json) if each[0] == kind]:
                holder[key] = number.get(holder[key], holder[key])
            json[kind] = [json[kind][old] for old in number]
            if not json[kind]:
                del json[kind]
    left = {name for texture in json.get("textures", []) for name in texture.get("extensions", {})}
    for key in ("extensionsUsed", "extensionsRequired") if some else ():
        named = [name for name in json.get(key, []) if name in left or not _OF_TEXTURES.fullmatch(name)]
        json.pop(key, None)
        json |= {key: named} if named else {}
    return some


def nodes_are_ours(json: Json) -> bool:
    """Whether no extension might refer to a node."""
    return all(_KNOWN.fullmatch(name) for name in _extensions(json))


def _extensions(json: Json) -> tuple[str, ...]:
    """Those that a document uses, also where it does not say so."""
    return (*json.get("extensionsUsed", []), *json.get("extensions", {}))


def drop_nodes(json: Json, candidates: Iterable[int], character: bool = False) -> None:
    """Take out those nodes that hold nothing, and that nothing refers to; none where an extension might, but for those of a
    ``character``.
    """
    known = all(_KNOWN.fullmatch(name) or gltf_vrm.KNOWN.fullmatch(name) for name in _extensions(json))
    if not (known if character else nodes_are_ours(json)):
        return
    named = [each for each in gltf_vrm.references(json) if each[0] == "nodes"]
    nodes, left = json["nodes"], set(candidates)
    channels = [channel["target"] for clip in json.get("animations", []) for channel in clip["channels"]]
    skins = json.get("skins", [])
    needed = {target.get("node") for target in channels} | {skin.get("skeleton") for skin in skins}
    needed |= {joint for skin in skins for joint in skin["joints"]} | {holder[key] for _, holder, key in named}
    left = {number for number in left - needed if not nodes[number].keys() & {"mesh", "camera", "extensions", "extras"}}
    above: dict[int, list[int]] = {}
    for parent in left:
        for child in nodes[parent].get("children", []):
            above.setdefault(child, []).append(parent)
    staying = [child for child in above if child not in left]
    while staying:  # what is above it stays too
        for parent in left.intersection(above[staying.pop()]):
            left.remove(parent)
            staying += [parent] if parent in above else []
    number = {old: new for new, old in enumerate(k for k in range(len(nodes)) if k not in left)}
    holders = [*((node, "children") for node in nodes), *((scene, "nodes") for scene in json.get("scenes", []))]
    for holder, key in [each for each in holders if each[1] in each[0]]:
        holder[key] = [number[child] for child in holder[key] if child in number]
        if not holder[key]:
            del holder[key]
    for _, holder, key in named:
        holder[key] = number[holder[key]]
    for target in channels:
        if "node" in target:
            target["node"] = number[target["node"]]
    for skin in skins:
        skin["joints"] = [number[joint] for joint in skin["joints"]]
        if "skeleton" in skin:
            skin["skeleton"] = number[skin["skeleton"]]
    json["nodes"] = [nodes[old] for old in number]


def references(json: Json) -> Iterator[tuple[str, Any, Any]]:
    """Kind, holder and key of all numbers of a document that stand for one of the kinds."""
    for mesh in json.get("meshes", []):
        for primitive in mesh["primitives"]:
            for held in (primitive.get("attributes", {}), *primitive.get("targets", [])):
                yield from (("accessors", held, key) for key in held)
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
    """Those of accessors, images and textures."""
    for accessor in json.get("accessors", []):
        sparse = accessor.get("sparse", {})
        for held in (accessor, sparse.get("indices", {}), sparse.get("values", {})):
            if "bufferView" in held:
                yield "bufferViews", held, "bufferView"
    for image in json.get("images", []):
        if "bufferView" in image:
            yield "bufferViews", image, "bufferView"
    for texture in json.get("textures", []):
        if "sampler" in texture:
            yield "samplers", texture, "sampler"
        for held in (texture, *texture.get("extensions", {}).values()):
            if "source" in held:
                yield "images", held, "source"


def textures_in(entry: Json) -> Iterator[Json]:
    """All references to textures in a material and its extensions."""
    for key, value in entry.items():
        if isinstance(value, dict):
            if key.endswith("Texture") and "index" in value:
                yield value
            else:
                yield from textures_in(value)
