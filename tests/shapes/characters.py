"""Hand-made characters in VRM 0.x and 1.0, and their extensions with names in place of indices."""

from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.shapes.formats.gltf import Document
from tests.shapes.painted import CORNERS, FACES, UV, encoded, quarters, write_document

VERSIONS = [0, 1]
IMAGES = ("color", "shade", "rim", "thumbnail")


def picture(k: int) -> bytes:
    """Encode the k-th image of a character."""
    return encoded(np.roll(quarters(4), k, axis=0) // (k + 1))


def write_character(path: Path, version: int, **more: Any) -> None:
    """Write a square moved by two joints, with three morph targets and a toon material, and two eyes that share a mesh.

    `more` is added to the toon material's extension (1.0) or properties (0.x).
    """
    arrays = [
        CORNERS.astype("f4"),
        UV.astype("f4"),
        FACES.ravel().astype("u2"),
        np.array([[0, 0, 0, 0]] * 2 + [[0, 1, 0, 0]] * 2, "u1"),
        np.array([[1.0, 0, 0, 0]] * 2 + [[0.25, 0.75, 0, 0]] * 2, "f4"),
        np.array([np.eye(4), [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, -0.5, 0, 1]]], "f4").reshape(2, 16),
        *((0.1 * (k + 1) * CORNERS).astype("f4") for k in range(3)),
        *(np.frombuffer(picture(k), "u1") for k in range(4)),
    ]
    skinned = {"POSITION": 0, "TEXCOORD_0": 1, "JOINTS_0": 3, "WEIGHTS_0": 4}
    body = {"attributes": skinned, "indices": 2, "material": 0, "targets": [{"POSITION": 6 + k} for k in range(3)]}
    eye = {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 1, "targets": [{"POSITION": 6}]}
    names = {"extras": {"targetNames": ["a", "o", "smile"]}}
    toon: dict[str, Any] = {
        "name": "skin",
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [0.5, 0.5, 1, 1]},
        "extensions": {"KHR_materials_unlit": {}},
    }
    iris = {"name": "iris", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    document: dict[str, Any] = {
        "scene": 0,
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"name": "pelvis", "children": [1]},
            {"name": "skull", "translation": [0, 0.5, 0], "children": [3, 4]},
            {"name": "body", "mesh": 0, "skin": 0},
            {"name": "left", "mesh": 1, "translation": [2, 0, 0]},
            {"name": "right", "mesh": 1, "translation": [4, 0, 0]},
        ],
        # VRM 0.x has names in primitives
        "meshes": [
            {"name": "body", "primitives": [body | (names if version == 0 else {})]} | (names if version else {}),
            {"name": "eye", "primitives": [eye]},
        ],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": 5}],
        "materials": [toon, iris],
        "textures": [{"source": k} for k in range(4)],
        "images": [{"bufferView": 9 + k, "mimeType": "image/png", "name": IMAGES[k]} for k in range(4)],
    }
    extensions = _new(toon, more) if version else _old(more)
    document |= {"extensions": extensions}
    document["extensionsUsed"] = [*extensions, "KHR_materials_unlit", *(["VRMC_materials_mtoon"] if version else [])]
    write_document(path, document, *arrays)


def _old(more: dict[str, Any]) -> dict[str, Any]:
    skin = {
        "name": "skin",
        "shader": "VRM/MToon",
        "renderQueue": 2000,
        "floatProperties": {"_BlendMode": 0, "_RimLift": 0.5},
        "vectorProperties": {"_Color": [0.5, 0.5, 1, 1], "_ShadeColor": [0.5, 0.25, 1, 1], "_MainTex": [0, 0, 1, 1]},
        "textureProperties": {"_MainTex": 0, "_ShadeTexture": 1, "_RimTexture": 2},
        "keywordMap": {},
        "tagMap": {"RenderType": "Opaque"},
    }
    plain = {"name": "iris", "shader": "VRM_USE_GLTFSHADER", "renderQueue": 2000}
    groups: list[dict[str, Any]] = [
        {"name": "Joy", "presetName": "joy", "binds": [{"mesh": 0, "index": 2, "weight": 100}]},
        {"name": "O", "presetName": "o", "binds": [{"mesh": 0, "index": 1, "weight": 50}]},
        {"name": "Blink", "presetName": "blink", "binds": [{"mesh": 1, "index": 0, "weight": 100}]},
    ]
    return {
        "VRM": {
            "specVersion": "0.0",
            "meta": {"title": "square", "author": "nobody", "licenseName": "CC0", "texture": 3},
            "humanoid": {"humanBones": [{"bone": "hips", "node": 0}, {"bone": "head", "node": 1}]},
            "firstPerson": {
                "firstPersonBone": 1,
                "firstPersonBoneOffset": {"x": 0, "y": 0.25, "z": 0},
                "meshAnnotations": [
                    {"mesh": 0, "firstPersonFlag": "Auto"},
                    {"mesh": 1, "firstPersonFlag": "ThirdPersonOnly"},
                ],
            },
            "blendShapeMaster": {"blendShapeGroups": groups},
            "secondaryAnimation": {
                "boneGroups": [{"comment": "hair", "center": -1, "bones": [1], "colliderGroups": [0]}],
                "colliderGroups": [{"node": 0, "colliders": [{"offset": {"x": 0, "y": 0, "z": 0}, "radius": 0.1}]}],
            },
            "materialProperties": [skin | more, plain],
        }
    }


def _new(toon: dict[str, Any], more: dict[str, Any]) -> dict[str, Any]:
    toon["extensions"]["VRMC_materials_mtoon"] = {
        "specVersion": "1.0",
        "shadeColorFactor": [0.5, 0.25, 1],
        "shadeMultiplyTexture": {"index": 1},
        "rimMultiplyTexture": {"index": 2},
        "outlineWidthFactor": 0.01,
    } | more
    tint = {"material": 1, "type": "color", "targetValue": [1, 0, 0, 1]}
    expressions = {
        "preset": {
            "happy": {"morphTargetBinds": [{"node": 2, "index": 2, "weight": 1.0}]},
            "oh": {"morphTargetBinds": [{"node": 2, "index": 1, "weight": 0.5}], "materialColorBinds": [tint]},
        },
        "custom": {"wink": {"morphTargetBinds": [{"node": 4, "index": 0, "weight": 1.0}]}},
    }
    return {
        "VRMC_vrm": {
            "specVersion": "1.0",
            "meta": {"name": "square", "authors": ["nobody"], "licenseUrl": "https://none", "thumbnailImage": 3},
            "humanoid": {"humanBones": {"hips": {"node": 0}, "head": {"node": 1}}},
            "firstPerson": {"meshAnnotations": [{"node": 2, "type": "auto"}, {"node": 3, "type": "thirdPersonOnly"}]},
            "lookAt": {"type": "expression", "offsetFromHeadBone": [0, 0.25, 0]},
            "expressions": expressions,
        },
        "VRMC_springBone": {
            "specVersion": "1.0",
            "colliders": [{"node": 0, "shape": {"sphere": {"offset": [0, 0, 0], "radius": 0.1}}}],
            "springs": [{"name": "hair", "joints": [{"node": 1}], "center": 0}],
        },
    }


def read(path: Path) -> Document:
    return Document(path, path.read_bytes())


def image_of(document: Document, texture: int) -> str:
    """Return the name of a texture's image; the data of an image that `write_character` wrote must be unchanged."""
    return named_image(document, document.json["textures"][texture]["source"])


def named_image(document: Document, number: int) -> str:
    image = document.json["images"][number]
    name = str(image["name"])
    if name in IMAGES:
        assert document.view_bytes(image["bufferView"]).startswith(picture(IMAGES.index(name)))
    return name


def toon_images(document: Document, number: int = 0) -> dict[str, str]:
    """Return the names of a toon material's images, in either version, by the property names of 0.x."""
    old = document.json["extensions"].get("VRM")
    if old is not None:
        return {key: image_of(document, k) for key, k in old["materialProperties"][number]["textureProperties"].items()}
    material = document.json["materials"][number]
    toon, paint = material["extensions"]["VRMC_materials_mtoon"], material["pbrMetallicRoughness"]
    found = {"_MainTex": paint["baseColorTexture"]} | {
        word: toon[key]
        for key, word in (("shadeMultiplyTexture", "_ShadeTexture"), ("rimMultiplyTexture", "_RimTexture"))
        if key in toon
    }
    return {word: image_of(document, texture["index"]) for word, texture in found.items()}


def read_extensions(path: Path) -> dict[str, Any]:
    """Return the contents of the extensions, but for toon materials, with names in place of indices."""
    document = read(path)
    json = document.json
    nodes = [node.get("name") for node in json["nodes"]]

    def drawing(mesh: int) -> list[str]:
        return sorted(node.get("name", "") for node in json["nodes"] if node.get("mesh") == mesh)

    def target(mesh: int, index: int) -> str:
        held = json["meshes"][mesh], *json["meshes"][mesh]["primitives"]
        told = [each["extras"]["targetNames"] for each in held if "targetNames" in each.get("extras", {})]
        assert all(names == told[0] for names in told)
        move = document.accessor(json["meshes"][mesh]["primitives"][0]["targets"][index]["POSITION"])
        return f"{told[0][index] if told else f'shape {index}'} {np.abs(move).max():.3f}"

    if "VRM" in json["extensions"]:
        old = json["extensions"]["VRM"]
        named = [each["name"] for each in old["materialProperties"]]
        assert named == [each.get("name", "") for each in json["materials"]]
        flags = [(each["mesh"], each["firstPersonFlag"]) for each in old["firstPerson"]["meshAnnotations"]]
        binds = {
            group["name"]: sorted(
                (name, target(bind["mesh"], bind["index"]), bind["weight"])
                for bind in group["binds"]
                for name in drawing(bind["mesh"])
            )
            for group in old["blendShapeMaster"]["blendShapeGroups"]
        }
        [spring], [collider] = (old["secondaryAnimation"][key] for key in ("boneGroups", "colliderGroups"))
        return {
            "meta": old["meta"] | {"texture": image_of(document, old["meta"]["texture"])},
            "bones": {each["bone"]: nodes[each["node"]] for each in old["humanoid"]["humanBones"]},
            "eyes": nodes[old["firstPerson"]["firstPersonBone"]],
            "seen": {name: flag for mesh, flag in flags for name in drawing(mesh)},
            "binds": binds,
            "springs": ([nodes[k] for k in spring["bones"]], spring["center"], nodes[collider["node"]]),
        }
    new, springs = json["extensions"]["VRMC_vrm"], json["extensions"]["VRMC_springBone"]
    expressions = new["expressions"]["preset"] | new["expressions"]["custom"]
    [spring], [collider] = springs["springs"], springs["colliders"]
    return {
        "meta": new["meta"] | {"thumbnailImage": named_image(document, new["meta"]["thumbnailImage"])},
        "bones": {bone: nodes[each["node"]] for bone, each in new["humanoid"]["humanBones"].items()},
        "seen": {nodes[each["node"]]: each["type"] for each in new["firstPerson"]["meshAnnotations"]},
        "binds": {
            name: sorted(
                (nodes[bind["node"]], target(json["nodes"][bind["node"]]["mesh"], bind["index"]), bind["weight"])
                for bind in each["morphTargetBinds"]
            )
            for name, each in expressions.items()
        },
        "tints": {
            name: [json["materials"][bind["material"]]["name"] for bind in each.get("materialColorBinds", [])]
            for name, each in expressions.items()
        },
        "springs": (
            [nodes[each["node"]] for each in spring["joints"]],
            nodes[spring["center"]],
            nodes[collider["node"]],
        ),
    }
