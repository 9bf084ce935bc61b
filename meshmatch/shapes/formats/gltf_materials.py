"""Replace the materials of a glTF scene by one baked material, or its texture coordinates or vertex colors.

Nodes, skins, clips, morph targets and vertex positions are kept.

Specification: Khronos glTF 2.0, sections 3.7.2 and 3.9; KHR_materials_emissive_strength, KHR_materials_unlit.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import warn
from meshmatch.geometry.triangles import normalized
from meshmatch.shapes.appearance import BakedMaterial, Pixels, png_bytes
from meshmatch.shapes.colors import srgb_to_linear_alpha
from meshmatch.shapes.formats.gltf import COMPRESSED, Document
from meshmatch.shapes.formats.gltf_attributes import base_color_uv, transform_of
from meshmatch.shapes.formats.gltf_edit import Editor, drawn_nodes
from meshmatch.shapes.formats.gltf_prune import textures_in
from meshmatch.shapes.formats.gltf_toon import ToonMaterials, toon_materials
from meshmatch.shapes.formats.gltf_write import VERTICES, smooth_normals
from meshmatch.shapes.formats.seams import split_at_seams, vertex_tangents

_LINEAR, _LINEAR_MIPS, _REPEAT, _CLAMP = 9729, 9987, 10497, 33071
_GLOW, _UNLIT = "KHR_materials_emissive_strength", "KHR_materials_unlit"
_GLOSS, _VARIANTS = "KHR_materials_pbrSpecularGlossiness", "KHR_materials_variants"
_TRANSFORM = "KHR_texture_transform"
_UV_TOLERANCE = 1e-5  # of texture coordinates that lie outside of 0..1


def with_material(
    document: Document, uv: Float[Floats, "F 3 2"], own: bool, material: BakedMaterial, turn: Float[Floats, "3 3"]
) -> bytes:
    """Return the scene as a glb with a baked material.

    Parameters
    ----------
    document
        The scene.
    uv
        Texture coordinates of each corner of its triangles, in scene order, v down.
    own
        Whether `uv` are the scene's own base color coordinates. If they are not, or if the base color has a texture
        transform, they become the first set and the former first set becomes the last; vertices at seams are duplicated
        and appended.
    material
        Replaces color, metalness, roughness, emission and transparency of the materials of everything drawn. Names and
        all other properties are kept, including normal and occlusion maps that the new material does not have.
    turn
        Rotation that makes the scene upright.
    """
    editor = Editor(document)
    stored = _stored_uv(document) if own else uv  # in the file, they may lie in another tile of the image
    materials = _MaterialReplacer(editor, document, material, stored)
    n_faces = 0
    for number, parts in drawn_nodes(document).items():
        mesh = editor.own_mesh(number)  # each node has its own region of the image
        normals = {} if material.normal is None else _normals(document, parts)
        for k, part in parts.items():
            faces = document.triangles(part)
            corners = uv[n_faces : n_faces + len(faces)]
            if document.is_mirrored(number, part, document.world[number]):  # `uv` is in the corner order of the scene
                corners = corners[:, ::-1]
            n_faces += len(faces)
            if not len(faces):
                continue
            primitive = mesh["primitives"][k]
            V = document.count(part["attributes"]["POSITION"])
            split = (np.arange(V), base_color_uv(document, part), faces) if own else split_at_seams(V, faces, corners)
            unchanged = own and not transform_of(document, part)
            moved_to = None if unchanged else _set_first_uv(editor, document, V, primitive, split)
            _disable_vertex_colors(document, part, primitive)
            if k in normals:
                _add_tangents(editor, document, part, primitive, normals[k], split)
            materials.assign(primitive, moved_to)
    if not np.array_equal(turn, np.eye(3)):
        editor.turn(document, turn)
    materials.list_extensions()
    materials.toon.finish(materials.made)
    editor.prune(document)
    return editor.to_bytes()


def with_texture_coordinates(document: Document, uv: Float[Floats, "F 3 2"]) -> bytes:
    """Return the scene as a glb with new texture coordinates per face corner, in scene order, v down.

    Materials are kept; vertices at seams are duplicated and appended.
    """
    editor, n_faces = Editor(document), 0
    for number, parts in drawn_nodes(document).items():
        mesh = editor.own_mesh(number)
        for k, part in parts.items():
            V, faces = document.count(part["attributes"]["POSITION"]), document.triangles(part)
            corners = uv[n_faces : n_faces + len(faces)]
            n_faces += len(faces)
            _set_first_uv(editor, document, V, mesh["primitives"][k], split_at_seams(V, faces, corners))
    return editor.to_bytes()


def with_vertex_colors(document: Document, colors: Float[Floats, "V 4"], turn: Float[Floats, "3 3"]) -> bytes:
    """Return the scene as a glb with new vertex colors (sRGB and alpha, 0..1), rotated by `turn`.

    Warns about toon materials, which do not show vertex colors.
    """
    editor = Editor(document)
    if toon := toon_materials(document.json):
        hidden = f"{len(toon)} toon materials" if toon[1:] else f"the toon material {toon[0]}"
        warn(f"programs do not show vertex colors on {hidden} of {document.name}, but they do show textures")
    n_verts = 0
    for number, parts in drawn_nodes(document).items():
        mesh = editor.own_mesh(number)
        for k, part in parts.items():
            V = document.count(part["attributes"]["POSITION"])
            linear = srgb_to_linear_alpha(colors[n_verts : n_verts + V]).astype("<f4")
            mesh["primitives"][k]["attributes"]["COLOR_0"] = editor.add_array(linear, target=VERTICES)
            n_verts += V
    if not np.array_equal(turn, np.eye(3)):
        editor.turn(document, turn)
    editor.prune(document)
    return editor.to_bytes()


def _stored_uv(document: Document) -> Floats:
    """First texture coordinates of everything that the scene draws, with texture transforms applied."""
    parts = [part for parts in drawn_nodes(document).values() for part in parts.values()]
    found = [base_color_uv(document, part) for part in parts if "TEXCOORD_0" in part["attributes"]]
    return np.concatenate([np.empty((0, 2)), *found])


SplitVertices: TypeAlias = tuple[Ints, Floats, Ints]
"""Vertices of a primitive after splitting at seams: original vertex of each, its texture coordinates, and the triangles."""


def _set_first_uv(
    editor: Editor, document: Document, V: int, primitive: dict[str, Any], split: SplitVertices
) -> int | None:
    """Set the first texture coordinates of a primitive of V vertices.

    Returns the new number of the former first set, or None if there was none.
    """
    vertex, coordinates, faces = split
    attributes = primitive["attributes"]
    n_sets = sum(key.startswith("TEXCOORD_") for key in attributes)
    if n_sets:
        attributes[f"TEXCOORD_{n_sets}"] = attributes.pop("TEXCOORD_0")
    if len(vertex) > V:
        for table in (attributes, *primitive.get("targets", [])):
            for key in table:
                table[key] = editor.add_rows(document, table[key], vertex)
    attributes["TEXCOORD_0"] = editor.add_array(coordinates.astype("<f4"), target=VERTICES)
    if len(vertex) > V or "indices" not in primitive or primitive.get("mode", 4) != 4:
        primitive["indices"] = editor.add_indices(faces, len(vertex))
        primitive.pop("mode", None)
    for extension in COMPRESSED:  # the uncompressed data is valid from now on
        primitive.get("extensions", {}).pop(extension, None)
    return n_sets or None


def _disable_vertex_colors(document: Document, part: dict[str, Any], primitive: dict[str, Any]) -> None:
    """Rename vertex colors to custom attributes, since viewers would multiply them with the image.

    All sets are renamed, because the sets of a primitive must be numbered from 0.
    """
    colors, attributes = document.colors(part), primitive["attributes"]
    if colors is not None and (colors != 1.0).any():
        for key in [key for key in attributes if key.startswith("COLOR_")]:
            attributes[f"_{key}"] = attributes.pop(key)


def _normals(document: Document, parts: dict[int, dict[str, Any]]) -> dict[int, Floats]:
    """Normals of each primitive of a node; smooth vertex normals for primitives that have none."""
    if all("NORMAL" in part["attributes"] for part in parts.values()):
        return {k: document.accessor(part["attributes"]["NORMAL"]) for k, part in parts.items()}
    places = [document.accessor(part["attributes"]["POSITION"]) for part in parts.values()]
    starts = np.cumsum([0, *map(len, places)])
    faces = [document.triangles(part) + start for part, start in zip(parts.values(), starts, strict=False)]
    smooth = smooth_normals(np.concatenate(places), np.concatenate(faces))
    computed = dict(zip(parts, np.split(smooth, starts[1:-1]), strict=True))
    accessors = {k: part["attributes"]["NORMAL"] for k, part in parts.items() if "NORMAL" in part["attributes"]}
    return computed | {k: document.accessor(number) for k, number in accessors.items()}


def _add_tangents(
    editor: Editor,
    document: Document,
    part: dict[str, Any],
    primitive: dict[str, Any],
    normals: Floats,
    split: SplitVertices,
) -> None:
    """Add the tangents that the normal map was baked for, and normals if missing, since tangents need them."""
    vertex, coordinates, faces = split
    positions, normals = document.accessor(part["attributes"]["POSITION"])[vertex], normalized(normals[vertex])
    if "NORMAL" not in primitive["attributes"]:
        primitive["attributes"]["NORMAL"] = editor.add_array(normals.astype("<f4"), target=VERTICES)
    tangents = vertex_tangents(positions, normals, faces, coordinates)
    primitive["attributes"]["TANGENT"] = editor.add_array(tangents.astype("<f4"), target=VERTICES)
    for target in primitive.get("targets", []):
        target.pop("TANGENT", None)


class _MaterialReplacer:
    """Materials of a scene, rewritten with a baked one; a material may be needed with several texture coordinate sets."""

    def __init__(self, editor: Editor, document: Document, material: BakedMaterial, uv: Floats) -> None:
        self.editor, self.baked = editor, material
        self.before = copy.deepcopy(editor.json.get("materials", []))
        parts = [part for parts in drawn_nodes(document).values() for part in parts.values()]
        drawn_ids = {id(part) for part in parts}
        others = (part for mesh in document.json["meshes"] for part in mesh["primitives"] if id(part) not in drawn_ids)
        # Materials of primitives that are not drawn, and those rewritten already, keep their numbers.
        self.kept = {number for part in others for number in _materials_of(part)}
        self.made: dict[tuple[int | None, int | None], int] = {}
        outside = len(uv) > 0 and (uv.min() < -_UV_TOLERANCE or uv.max() > 1.0 + _UV_TOLERANCE)
        wrap = _REPEAT if outside else _CLAMP
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPS, "wrapS": wrap, "wrapT": wrap}
        self.sampler = editor.add("samplers", sampler)
        self.color = self._texture(material.color, "")
        self.normal, self.surface, self.glow = (
            None if image is None else self._texture(image, f" {suffix}")
            for image, suffix in (
                (material.normal, "normal"),
                (material.surface, "occlusion" if material.even else "occlusion, roughness, metal"),
                (material.glow, "emission"),
            )
        )

        self.toon = ToonMaterials(editor.name, editor.json, material, self.color, self.normal, self.glow)

    def _texture(self, image: Pixels, suffix: str) -> int:
        view = self.editor.add_view(png_bytes(image))
        entry = {"bufferView": view, "mimeType": "image/png", "name": f"{self.baked.name}{suffix}".strip()}
        return self.editor.add("textures", {"sampler": self.sampler, "source": self.editor.add("images", entry)})

    def assign(self, primitive: dict[str, Any], moved_to: int | None) -> None:
        """Assign the baked material to a primitive and its variants.

        ``moved_to`` is the number of the set that has its former first coordinates.
        """
        primitive["material"] = self._material_for(primitive.get("material"), moved_to)
        for mapping in primitive.get("extensions", {}).get(_VARIANTS, {}).get("mappings", []):
            mapping["material"] = self._material_for(mapping["material"], moved_to)

    def _material_for(self, number: int | None, moved_to: int | None) -> int:
        """Number of the baked version of a material (None: the default one); created at its first use."""
        key = number, moved_to
        if key not in self.made:
            if number is None:
                entry: dict[str, Any] = {"name": self.baked.name} if self.baked.name else {}
                entry |= {"doubleSided": True} if self.baked.double_sided else {}
            else:
                entry = copy.deepcopy(self.before[number])
            self._replace_layers(entry, moved_to, self.toon.is_toon(number, entry))
            if number is not None:
                self.toon.replace_shade(entry, self.before[number], moved_to)
            if number is not None and number not in self.kept:
                self.editor.json["materials"][number], self.made[key] = entry, number
                self.kept.add(number)
            else:
                self.made[key] = self.editor.add("materials", entry)
        return self.made[key]

    def _replace_layers(self, entry: dict[str, Any], moved_to: int | None, toon: bool) -> None:
        """Replace the properties of a material that the baked one has.

        A toon material stays unlit, as its fallback in programs that do not support toon shading.
        """
        baked, extensions = self.baked, entry.setdefault("extensions", {})
        for key in (_GLOSS, _GLOW) if toon else (_GLOSS, _GLOW, _UNLIT):
            extensions.pop(key, None)
        for key in ("alphaMode", "alphaCutoff", "emissiveTexture", "emissiveFactor"):
            entry.pop(key, None)
        if self.normal is not None:
            entry.pop("normalTexture", None)
        if baked.occluded:
            entry.pop("occlusionTexture", None)
        pbr = entry.setdefault("pbrMetallicRoughness", {})
        for key in ("baseColorTexture", "baseColorFactor", "metallicRoughnessTexture"):
            pbr.pop(key, None)
        if moved_to is not None:
            _use_moved_uv(entry, moved_to)
        pbr |= {"metallicFactor": baked.metal, "roughnessFactor": baked.roughness}
        for holder, key, texture in (
            (pbr, "baseColorTexture", self.color),
            (pbr, "metallicRoughnessTexture", None if baked.even else self.surface),
            (entry, "occlusionTexture", self.surface if baked.occluded else None),
            (entry, "normalTexture", self.normal),
            (entry, "emissiveTexture", self.glow),
        ):
            if texture is not None:
                holder[key] = {"index": texture}
        strength = max(baked.light)
        if strength > 0:
            entry["emissiveFactor"] = [share / max(strength, 1.0) for share in baked.light]
        if strength > 1.0:
            extensions[_GLOW] = {"emissiveStrength": strength}
        if baked.alpha != "opaque":
            entry["alphaMode"] = baked.alpha.upper()
        if baked.alpha == "mask":
            entry["alphaCutoff"] = baked.cutoff
        if baked.unlit:
            extensions[_UNLIT] = {}
        if not extensions:
            del entry["extensions"]

    def list_extensions(self) -> None:
        """Add the extensions that the materials use to `extensionsUsed`."""
        used = {key for entry in self.editor.json["materials"] for key in entry.get("extensions", {})}
        declared = self.editor.json.get("extensionsUsed", [])
        if added := [key for key in (_GLOW, _UNLIT) if key in used and key not in declared]:
            self.editor.json["extensionsUsed"] = [*declared, *added]


def _materials_of(primitive: dict[str, Any]) -> Iterator[int]:
    """Numbers of the materials of a primitive and of its variants."""
    if "material" in primitive:
        yield primitive["material"]
    for mapping in primitive.get("extensions", {}).get(_VARIANTS, {}).get("mappings", []):
        yield mapping["material"]


def _use_moved_uv(entry: dict[str, Any], moved_to: int) -> None:
    """Make the remaining textures of a material use the former first texture coordinates."""
    for texture in textures_in(entry):
        transform = texture.get("extensions", {}).get(_TRANSFORM, {})
        holder = transform if "texCoord" in transform else texture
        if holder.get("texCoord", 0) == 0:
            holder["texCoord"] = moved_to
