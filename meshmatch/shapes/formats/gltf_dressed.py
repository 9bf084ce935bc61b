"""A glTF scene that wears one baked material: nodes, skins, clips, morph targets and vertices stay as they are.

Specification: Khronos glTF 2.0, sections 3.7.2 and 3.9; KHR_materials_emissive_strength, KHR_materials_unlit.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import warn
from meshmatch.geometry.triangles import unit
from meshmatch.shapes.appearance import BakedMaterial, Pixels, png_bytes
from meshmatch.shapes.colors import light
from meshmatch.shapes.formats.gltf import COMPRESSED, Document
from meshmatch.shapes.formats.gltf_attributes import base_color_uv, transform_of
from meshmatch.shapes.formats.gltf_edit import Editor, drawn
from meshmatch.shapes.formats.gltf_out import VERTICES, smooth_normals
from meshmatch.shapes.formats.gltf_prune import textures_in
from meshmatch.shapes.formats.gltf_toon import ToonWear, toon_materials
from meshmatch.shapes.formats.seams import split_at_seams, vertex_tangents

_LINEAR, _LINEAR_MIPS, _REPEAT, _CLAMP = 9729, 9987, 10497, 33071
_GLOW, _UNLIT = "KHR_materials_emissive_strength", "KHR_materials_unlit"
_GLOSS, _VARIANTS = "KHR_materials_pbrSpecularGlossiness", "KHR_materials_variants"
_TRANSFORM = "KHR_texture_transform"
_SLACK = 1e-5


def dressed(
    document: Document, uv: Float[Floats, "F 3 2"], own: bool, material: BakedMaterial, turn: Float[Floats, "3 3"]
) -> bytes:
    """The scene as a glb that wears a material.

    Parameters
    ----------
    document
        The scene.
    uv
        Texture coordinates of each corner of its triangles, in the order of the scene, v down.
    own
        They are those that it has, as the base color lies on them. If they are not, or that is moved over them, they become
        the first ones, and what was the first becomes the last; vertices at seams are copied, behind the others.
    material
        Takes the place of color, metal, roughness, light and transparency of the materials of all that is drawn. Names and
        everything else stay, also a normal or an occlusion map where the new material has none.
    turn
        What turns the scene upright.
    """
    editor = Editor(document)
    stored = _stored(document) if own else uv  # the file may have them in another tile of the image
    wardrobe = _Wardrobe(editor, document, material, stored)
    seen = 0
    for number, parts in drawn(document).items():
        mesh = editor.own_mesh(number)  # each has its own place in the image
        normals = {} if material.normal is None else _normals(document, parts)
        for k, part in parts.items():
            faces = document.triangles(part)
            corners = uv[seen : seen + len(faces)]
            if document.mirrors(number, part, document.world[number]):  # they are in the order of the scene's triangles
                corners = corners[:, ::-1]
            seen += len(faces)
            if not len(faces):
                continue
            primitive = mesh["primitives"][k]
            V = document.count(part["attributes"]["POSITION"])
            laid = (np.arange(V), base_color_uv(document, part), faces) if own else split_at_seams(V, faces, corners)
            kept = own and not transform_of(document, part)
            moved_to = None if kept else _lay(editor, document, V, primitive, laid)
            _untint(document, part, primitive)
            if k in normals:
                _add_tangents(editor, document, part, primitive, normals[k], laid)
            wardrobe.dress(primitive, moved_to)
    if not np.array_equal(turn, np.eye(3)):
        editor.turn(document, turn)
    wardrobe.list_extensions()
    wardrobe.toon.finish(wardrobe.made)
    editor.prune(document)
    return editor.to_bytes()


def laid(document: Document, uv: Float[Floats, "F 3 2"]) -> bytes:
    """The scene as a glb with other texture coordinates of each corner, in the order of its triangles, v down, and the
    materials that it has; vertices at seams are copied, behind the others.
    """
    editor, seen = Editor(document), 0
    for number, parts in drawn(document).items():
        mesh = editor.own_mesh(number)
        for k, part in parts.items():
            V, faces = document.count(part["attributes"]["POSITION"]), document.triangles(part)
            corners = uv[seen : seen + len(faces)]
            seen += len(faces)
            _lay(editor, document, V, mesh["primitives"][k], split_at_seams(V, faces, corners))
    return editor.to_bytes()


def colored(document: Document, colors: Float[Floats, "V 4"], turn: Float[Floats, "3 3"]) -> bytes:
    """The scene as a glb with other colors of its vertices (sRGB and alpha, 0..1), and turned. Materials that do not show
    them are told.
    """
    editor = Editor(document)
    if toon := toon_materials(document.json):
        hidden = f"{len(toon)} toon materials" if toon[1:] else f"the toon material {toon[0]}"
        warn(f"programs show no colors of vertices on {hidden} of {document.name}; they show a texture")
    seen = 0
    for number, parts in drawn(document).items():
        mesh = editor.own_mesh(number)
        for k, part in parts.items():
            V = document.count(part["attributes"]["POSITION"])
            amounts = light(colors[seen : seen + V]).astype("<f4")
            mesh["primitives"][k]["attributes"]["COLOR_0"] = editor.add_array(amounts, target=VERTICES)
            seen += V
    if not np.array_equal(turn, np.eye(3)):
        editor.turn(document, turn)
    editor.prune(document)
    return editor.to_bytes()


def _stored(document: Document) -> Floats:
    """All first texture coordinates of a scene."""
    parts = [part for parts in drawn(document).values() for part in parts.values()]
    found = [base_color_uv(document, part) for part in parts if "TEXCOORD_0" in part["attributes"]]
    return np.concatenate([np.empty((0, 2)), *found])


Laid: TypeAlias = tuple[Ints, Floats, Ints]
"""Of the vertices of a primitive after it was split: which one each was, its coordinates; and triangles over them."""


def _lay(editor: Editor, document: Document, V: int, primitive: dict[str, Any], laid: Laid) -> int | None:
    """Give a primitive of V vertices new first coordinates; returns which the former first ones are now, if any."""
    vertex, coordinates, faces = laid
    attributes = primitive["attributes"]
    sets = sum(key.startswith("TEXCOORD_") for key in attributes)
    if sets:
        attributes[f"TEXCOORD_{sets}"] = attributes.pop("TEXCOORD_0")
    if len(vertex) > V:
        for held in (attributes, *primitive.get("targets", [])):
            for key in held:
                held[key] = editor.add_rows(document, held[key], vertex)
    attributes["TEXCOORD_0"] = editor.add_array(coordinates.astype("<f4"), target=VERTICES)
    if len(vertex) > V or "indices" not in primitive or primitive.get("mode", 4) != 4:
        primitive["indices"] = editor.add_indices(faces, len(vertex))
        primitive.pop("mode", None)
    for extension in COMPRESSED:  # the plain data that was beside it counts now
        primitive.get("extensions", {}).pop(extension, None)
    return sets or None


def _untint(document: Document, part: dict[str, Any], primitive: dict[str, Any]) -> None:
    """Keep colors of vertices, which would be multiplied with the image, under names that no program draws: all sets of
    them, for those of a primitive are counted from 0.
    """
    colors, attributes = document.colors(part), primitive["attributes"]
    if colors is not None and (colors != 1.0).any():
        for key in [key for key in attributes if key.startswith("COLOR_")]:
            attributes[f"_{key}"] = attributes.pop(key)


def _normals(document: Document, parts: dict[int, dict[str, Any]]) -> dict[int, Floats]:
    """The normals of each primitive of a node; smooth ones where one has none."""
    if all("NORMAL" in part["attributes"] for part in parts.values()):
        return {k: document.accessor(part["attributes"]["NORMAL"]) for k, part in parts.items()}
    places = [document.accessor(part["attributes"]["POSITION"]) for part in parts.values()]
    starts = np.cumsum([0, *map(len, places)])
    faces = [document.triangles(part) + start for part, start in zip(parts.values(), starts, strict=False)]
    smooth = smooth_normals(np.concatenate(places), np.concatenate(faces))
    own = dict(zip(parts, np.split(smooth, starts[1:-1]), strict=True))
    held = {k: part["attributes"]["NORMAL"] for k, part in parts.items() if "NORMAL" in part["attributes"]}
    return own | {k: document.accessor(number) for k, number in held.items()}


def _add_tangents(
    editor: Editor, document: Document, part: dict[str, Any], primitive: dict[str, Any], normals: Floats, laid: Laid
) -> None:
    """The tangents that the normal map was baked for, and normals where there are none, without which they count for
    nothing.
    """
    vertex, coordinates, faces = laid
    places, normals = document.accessor(part["attributes"]["POSITION"])[vertex], unit(normals[vertex])
    if "NORMAL" not in primitive["attributes"]:
        primitive["attributes"]["NORMAL"] = editor.add_array(normals.astype("<f4"), target=VERTICES)
    tangents = vertex_tangents(places, normals, faces, coordinates)
    primitive["attributes"]["TANGENT"] = editor.add_array(tangents.astype("<f4"), target=VERTICES)
    for target in primitive.get("targets", []):
        target.pop("TANGENT", None)


class _Wardrobe:
    """The materials of a scene, which wear a baked one; each as often as it is needed."""

    def __init__(self, editor: Editor, document: Document, material: BakedMaterial, uv: Floats) -> None:
        self.editor, self.baked = editor, material
        self.before = copy.deepcopy(editor.json.get("materials", []))
        parts = [part for parts in drawn(document).values() for part in parts.values()]
        seen = {id(part) for part in parts}
        others = (part for mesh in document.json["meshes"] for part in mesh["primitives"] if id(part) not in seen)
        # What others wear keeps its number, and so does what is made already.
        self.kept = {number for part in others for number in _materials_of(part)}
        self.made: dict[tuple[int | None, int | None], int] = {}
        leaves = len(uv) > 0 and (uv.min() < -_SLACK or uv.max() > 1.0 + _SLACK)
        wrap = _REPEAT if leaves else _CLAMP
        sampler = {"magFilter": _LINEAR, "minFilter": _LINEAR_MIPS, "wrapS": wrap, "wrapT": wrap}
        self.sampler = editor.add("samplers", sampler)
        self.color = self._texture(material.color, "")
        self.normal, self.surface, self.glow = (
            None if image is None else self._texture(image, f" {what}")
            for image, what in (
                (material.normal, "normal"),
                (material.surface, "occlusion" if material.even else "occlusion, roughness, metal"),
                (material.glow, "emission"),
            )
        )

        self.toon = ToonWear(editor.name, editor.json, material, self.color, self.normal, self.glow)

    def _texture(self, image: Pixels, what: str) -> int:
        view = self.editor.add_view(png_bytes(image))
        entry = {"bufferView": view, "mimeType": "image/png", "name": f"{self.baked.name}{what}".strip()}
        return self.editor.add("textures", {"sampler": self.sampler, "source": self.editor.add("images", entry)})

    def dress(self, primitive: dict[str, Any], moved_to: int | None) -> None:
        """Give a primitive, and its variants, the baked material; ``moved_to`` is where its former coordinates are."""
        primitive["material"] = self._worn(primitive.get("material"), moved_to)
        for mapping in primitive.get("extensions", {}).get(_VARIANTS, {}).get("mappings", []):
            mapping["material"] = self._worn(mapping["material"], moved_to)

    def _worn(self, number: int | None, moved_to: int | None) -> int:
        key = number, moved_to
        if key not in self.made:
            if number is None:
                entry: dict[str, Any] = {"name": self.baked.name} if self.baked.name else {}
                entry |= {"doubleSided": True} if self.baked.double_sided else {}
            else:
                entry = copy.deepcopy(self.before[number])
            self._lay_on(entry, moved_to, self.toon.keeps(number, entry))
            if number is not None:
                self.toon.lay_on(entry, self.before[number], moved_to)
            if number is not None and number not in self.kept:
                self.editor.json["materials"][number], self.made[key] = entry, number
                self.kept.add(number)
            else:
                self.made[key] = self.editor.add("materials", entry)
        return self.made[key]

    def _lay_on(self, entry: dict[str, Any], moved_to: int | None, toon: bool) -> None:
        """Replace in a material what the baked one has; that a toon material is plain where nobody knows it, stays."""
        baked, extensions = self.baked, entry.setdefault("extensions", {})
        for key in (_GLOSS, _GLOW) if toon else (_GLOSS, _GLOW, _UNLIT):
            extensions.pop(key, None)
        for key in ("alphaMode", "alphaCutoff", "emissiveTexture", "emissiveFactor"):
            entry.pop(key, None)
        if self.normal is not None:
            entry.pop("normalTexture", None)
        if baked.occluded:
            entry.pop("occlusionTexture", None)
        paint = entry.setdefault("pbrMetallicRoughness", {})
        for key in ("baseColorTexture", "baseColorFactor", "metallicRoughnessTexture"):
            paint.pop(key, None)
        if moved_to is not None:
            _move_textures(entry, moved_to)
        paint |= {"metallicFactor": baked.metal, "roughnessFactor": baked.roughness}
        for where, key, texture in (
            (paint, "baseColorTexture", self.color),
            (paint, "metallicRoughnessTexture", None if baked.even else self.surface),
            (entry, "occlusionTexture", self.surface if baked.occluded else None),
            (entry, "normalTexture", self.normal),
            (entry, "emissiveTexture", self.glow),
        ):
            if texture is not None:
                where[key] = {"index": texture}
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
        """Say which extensions the materials use."""
        used = {key for entry in self.editor.json["materials"] for key in entry.get("extensions", {})}
        listed = self.editor.json.get("extensionsUsed", [])
        if added := [key for key in (_GLOW, _UNLIT) if key in used and key not in listed]:
            self.editor.json["extensionsUsed"] = [*listed, *added]


def _materials_of(primitive: dict[str, Any]) -> Iterator[int]:
    if "material" in primitive:
        yield primitive["material"]
    for mapping in primitive.get("extensions", {}).get(_VARIANTS, {}).get("mappings", []):
        yield mapping["material"]


def _move_textures(entry: dict[str, Any], moved_to: int) -> None:
    """Let what is left of a material's textures lie on the former first coordinates."""
    for texture in textures_in(entry):
        held = texture.get("extensions", {}).get(_TRANSFORM, {})
        where = held if "texCoord" in held else texture
        if where.get("texCoord", 0) == 0:
            where["texCoord"] = moved_to
