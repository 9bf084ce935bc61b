"""Appearance and skin weights of glTF scenes: materials, texture coordinates, vertex colors and joint influences.

Specification: Khronos glTF 2.0, sections 3.7.3, 3.8 and 3.9; KHR_texture_transform,
KHR_materials_pbrSpecularGlossiness (its diffuse part) and EXT_texture_webp. Metal, roughness, normals and light are read
by `meshmatch.shapes.formats.gltf_layers`. Vertices and faces are those of `meshmatch.shapes.formats.gltf.read`, in the
same order.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import InputError
from meshmatch.outputs import make_unique, plain_text
from meshmatch.shapes.appearance import Alpha, Appearance, ImageReader, Material, Pixels, Wrap, no_coordinates
from meshmatch.shapes.formats import concatenate_colors, damaged
from meshmatch.shapes.formats.gltf import Document, is_embedded, parse_document
from meshmatch.shapes.shape import Shape

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_ALPHAS: dict[str, Alpha] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_NEAREST = 9728


def read_appearance(path: Path, data: bytes, _: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Read materials, texture coordinates and vertex colors; `picture`, if given, replaces all images."""
    return parse_document(path, data, "materials make", lambda document: Look(document, reader, picture).scene())


def read_coordinates(path: Path, data: bytes, _: Shape) -> Float[Floats, "F 3 2"] | None:
    """Read the first texture coordinates of all faces; None if any primitive with faces has none."""
    return parse_document(path, data, "texture coordinates make", _coordinates)


def read_skin(path: Path, data: bytes) -> tuple[csr_array, tuple[str, ...]]:
    """Read the positive skin weights, (vertices, joints) and not normalised, and the unique names of the joints.

    The joints of all skins form one list, in the file's node order. An unskinned mesh below a joint, such as a sword in
    a hand, gets weight 1 for that joint. `InputError` if the file is damaged or has no skin.
    """
    return parse_document(path, data, "skin makes", _skin)


def _coordinates(document: Document) -> Floats | None:
    parts = [np.empty((0, 3, 2))]
    for node, primitive, matrix in document.primitives():
        attributes = primitive["attributes"]
        faces = document.drawn_triangles(node, primitive, matrix)
        if len(faces) and "TEXCOORD_0" not in attributes:
            return None
        if len(faces):
            parts.append(base_color_uv(document, primitive)[faces])
    return np.concatenate(parts)


def base_color_uv(document: Document, primitive: dict[str, Any]) -> Float[Floats, "V 2"]:
    """First texture coordinates of a primitive's vertices, after the texture transform of its base color."""
    uv = document.accessor(primitive["attributes"]["TEXCOORD_0"])
    return _transformed(uv, transform_of(document, primitive))


def transform_of(document: Document, primitive: dict[str, Any]) -> dict[str, Any]:
    """Return the texture transform of a primitive's base color on its first texture coordinates; empty if none."""
    texture = _base(document.json, primitive.get("material", -1))[1] or {}
    transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
    return transform if transform.get("texCoord", texture.get("texCoord", 0)) == 0 else {}


def _base(json: dict[str, Any], number: int) -> tuple[dict[str, Any], dict[str, Any] | None, tuple[float, ...]]:
    """Return a material, its base color texture and its base color factor."""
    material = json["materials"][number] if number >= 0 else {}
    gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if gloss is not None and "pbrMetallicRoughness" not in material:
        return material, gloss.get("diffuseTexture"), tuple(gloss.get("diffuseFactor", (1.0,) * 4))
    pbr = material.get("pbrMetallicRoughness", {})
    return material, pbr.get("baseColorTexture"), tuple(pbr.get("baseColorFactor", (1.0,) * 4))


def _transformed(uv: Float[Floats, "V 2"], transform: dict[str, Any]) -> Float[Floats, "V 2"]:
    if not transform:
        return uv
    # Counter-clockwise with v down, as in the extension's text and example (its GLSL listing differs).
    angle = float(transform.get("rotation", 0.0))
    u, v = (uv * np.array(transform.get("scale", (1.0, 1.0)), np.float64)).T
    rotated = np.stack([np.cos(angle) * u + np.sin(angle) * v, np.cos(angle) * v - np.sin(angle) * u], axis=1)
    return np.asarray(rotated + np.array(transform.get("offset", (0.0, 0.0)), np.float64))


class Look:
    """Reader of the base color layer of a scene; subclasses read other layers."""

    def __init__(self, document: Document, reader: ImageReader, picture: Pixels | None) -> None:
        self.document, self.json, self.reader, self.picture = document, document.json, reader, picture
        self.images: dict[int, Pixels] = {}
        self.materials: dict[tuple[int, bool], Material] = {}

    def scene(self) -> Appearance:
        """Read materials, texture coordinates per face corner and vertex colors, in the order of `gltf.read`."""
        uvs: list[Floats] = [np.empty((0, 3, 2))]
        material_of_face: list[Ints] = [np.empty(0, np.int64)]
        colors: list[Floats | None] = []
        counts: list[int] = []
        numbers: dict[tuple[int, bool], int] = {}
        for node, primitive, matrix in self.document.primitives():
            counts.append(self.document.count(primitive["attributes"]["POSITION"]))
            colors.append(self.document.colors(primitive))
            faces = self.document.drawn_triangles(node, primitive, matrix)
            uv = self._coordinates(primitive) if len(faces) else None
            key = primitive.get("material", -1), uv is not None
            if key not in self.materials:
                self.materials[key] = self.read(*key)
            material_of_face.append(np.full(len(faces), numbers.setdefault(key, len(numbers))))
            uvs.append(np.zeros((len(faces), 3, 2)) if uv is None else uv[faces])
        vertex_colors = concatenate_colors(colors, counts)
        found = Appearance(
            tuple(self.materials.values()), np.concatenate(material_of_face), np.concatenate(uvs), vertex_colors
        )
        if self.picture is not None and not found.textured:
            raise no_coordinates(self.document.name)
        return found

    def base(self, number: int) -> tuple[dict[str, Any], dict[str, Any] | None, tuple[float, ...]]:
        """Return a material and the texture and factor of the layer: base color here, others in subclasses."""
        return _base(self.json, number)

    def read(self, number: int, has_uv: bool) -> Material:
        """Read a material, with its image if the primitive has texture coordinates (`has_uv`)."""
        entry, texture, factor = self.base(number)
        red, green, blue, alpha = (float(np.clip(value, 0.0, 1.0)) for value in factor)
        meaning, cutoff = _ALPHAS[entry.get("alphaMode", "OPAQUE")], float(entry.get("alphaCutoff", 0.5))
        name, factor = str(entry.get("name", "")), (red, green, blue, alpha)
        material = Material(name, factor=factor, alpha=meaning, cutoff=cutoff)
        if has_uv and self.picture is not None:
            material = replace(material, image=self.picture, factor=(1.0, 1.0, 1.0, 1.0))
        if not has_uv or texture is None:
            return material
        texture_entry = self.json["textures"][texture["index"]]
        sampler = self.json["samplers"][texture_entry["sampler"]] if "sampler" in texture_entry else {}
        wrap = _WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)]
        material = replace(material, wrap=wrap, nearest=sampler.get("magFilter") == _NEAREST)
        return material if self.picture is not None else replace(material, image=self._image(texture_entry))

    def _image(self, texture: dict[str, Any]) -> Pixels:
        extensions = texture.get("extensions", {})
        number = texture.get("source", extensions.get("EXT_texture_webp", {}).get("source"))
        if number is None:
            kind = next(iter(extensions), "no image at all")
            unreadable = f"{self.document.name} holds a texture that cannot be read ({kind})"
            raise InputError(unreadable, "export it with png or jpg textures")
        if number not in self.images:
            entry = self.json["images"][number]
            uri = entry.get("uri")
            data = self.document.view_bytes(entry["bufferView"]) if uri is None else self.document.resource(uri)
            embedded_image = uri is None or is_embedded(uri)
            self.images[number] = self.reader.decode(
                data, f"image {number} of {self.document.name}" if embedded_image else uri
            )
        return self.images[number]

    def _coordinates(self, primitive: dict[str, Any]) -> Floats | None:
        """(V, 2) coordinates of a primitive's vertices for the texture of the layer; None without coordinates or texture."""
        _, texture, _ = self.base(primitive.get("material", -1))
        if texture is None and self.picture is None:
            return None
        texture = texture or {}
        transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
        chosen = f"TEXCOORD_{int(transform.get('texCoord', texture.get('texCoord', 0)))}"
        if chosen not in primitive["attributes"]:
            return None
        uv = self.document.accessor(primitive["attributes"][chosen])
        if uv.shape[1] != 2:
            raise damaged(self.document.name, "texture coordinates are not pairs")
        return _transformed(uv, transform)


def joint_nodes(document: Document) -> list[int]:
    """Sorted numbers of the nodes that are joints of any skin, in the order of `read_skin`."""
    return sorted({int(joint) for skin in document.json.get("skins", []) for joint in skin["joints"]})


def _skin(document: Document) -> tuple[csr_array, tuple[str, ...]]:
    skins, nodes = document.json.get("skins", []), joint_nodes(document)
    if not nodes:
        raise InputError(f"{document.name} has no skin", "give the weights in a file: --weights weights.npz")
    column_of = {node: k for k, node in enumerate(nodes)}
    parent = {int(c): k for k, node in enumerate(document.nodes) for c in node.get("children", [])}
    entries: list[tuple[Ints, Ints, Floats]] = []  # vertices, joints, weights
    columns_of_skin: dict[int, Ints] = {}  # per skin, the column of each of its joints
    n_verts = 0
    primitives = list(document.primitives())
    nearest_joint: dict[int | None, int | None] = {}  # per node, the nearest joint: itself or an ancestor
    for node in document.world:  # parents before children
        nearest_joint[node] = node if node in column_of else nearest_joint.get(parent.get(node))
    for number, primitive, _ in primitives:
        attributes = primitive["attributes"]
        V, skin = document.count(attributes["POSITION"]), document.nodes[number].get("skin")
        if skin is not None and "JOINTS_0" in attributes:
            if skin not in columns_of_skin:
                columns_of_skin[skin] = np.array([column_of[int(joint)] for joint in skins[skin]["joints"]])
            skin_columns = columns_of_skin[skin]
            for numbers, weight in document.influences(primitive):
                if numbers.shape != (V, 4) or weight.shape != (V, 4):
                    raise ValueError("joints or weights are not four for each vertex")
                row, column = np.nonzero(np.isfinite(weight) & (weight > 0))
                used = numbers[row, column]
                if not ((used >= 0) & (used < len(skin_columns))).all():
                    raise ValueError(
                        f"a vertex refers to a joint that is not among the {len(skin_columns)} of its skin"
                    )
                entries.append((n_verts + row, skin_columns[used.astype(np.int64)], weight[row, column]))
        elif (joint := nearest_joint[number]) is not None:
            entries.append((n_verts + np.arange(V), np.full(V, column_of[joint]), np.ones(V)))
        n_verts += V
    if not entries:
        raise InputError(f"{document.name} has a skin that moves no vertex", "was it exported with its weights?")
    vertices, joints, weights = (np.concatenate(each) for each in zip(*entries, strict=True))
    labels = [document.nodes[node].get("name") or f"joint {node}" for node in nodes]
    names = make_unique((plain_text(str(label)) for label in labels), " ")
    return csr_array((weights, (vertices, joints)), (n_verts, len(nodes))), tuple(names)
