"""The look of glTF 2.0 files: base colours, their images, samplers and texture coordinates.

Specification: Khronos glTF 2.0, sections 3.8 and 3.9; KHR_texture_transform, KHR_materials_pbrSpecularGlossiness
(its diffuse part) and EXT_texture_webp. Metal, roughness, normals and light are ignored.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from meshmatch.arrays import Float, Floats, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.appearance import Alpha, Appearance, Material, Wrap, no_coordinates
from meshmatch.shapes.formats import damaged
from meshmatch.shapes.formats.gltf import NONSENSE, Document, joined_colors
from meshmatch.shapes.images import ImageReader, Pixels

_WRAPS: dict[int, Wrap] = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_ALPHAS: dict[str, Alpha] = {"OPAQUE": "opaque", "MASK": "mask", "BLEND": "blend"}
_NEAREST = 9728


def read_look(path: Path, data: bytes, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Materials and texture coordinates, face by face in the order of `gltf.read`; `picture` replaces all
    images.
    """
    try:
        return _Look(Document(path, data), reader, picture).scene()
    except NONSENSE as error:
        raise damaged(path.name, f"its materials make no sense ({type(error).__name__}: {error})") from error


def read_coordinates(path: Path, data: bytes) -> Float[Floats, "F 3 2"] | None:
    """(F, 3, 2) first texture coordinates of all faces; None where a part has none."""
    try:
        document = Document(path, data)
        parts = [np.empty((0, 3, 2))]
        for _, primitive in document.primitives():
            attributes = primitive["attributes"]
            faces = document.triangles(primitive, document.count(attributes["POSITION"]))
            if len(faces) and "TEXCOORD_0" not in attributes:
                return None
            if len(faces):
                parts.append(document.accessor(attributes["TEXCOORD_0"])[faces])
        return np.concatenate(parts)
    except NONSENSE as error:
        raise damaged(path.name, f"its texture coordinates make no sense ({error})") from error


class _Look:
    def __init__(self, document: Document, reader: ImageReader, picture: Pixels | None) -> None:
        self.document, self.json, self.reader, self.picture = document, document.json, reader, picture
        self.images: dict[int, Pixels] = {}
        self.materials: list[Material] = []
        self.numbers: dict[tuple[int, bool], int] = {}

    def scene(self) -> Appearance:
        uvs: list[Floats] = []
        kinds: list[Ints] = []
        colors: list[Floats | None] = []
        counts: list[int] = []
        for _, primitive in self.document.primitives():
            counts.append(self.document.count(primitive["attributes"]["POSITION"]))
            colors.append(self.document.colors(primitive))
            faces = self.document.triangles(primitive, counts[-1])
            uv = self._coordinates(primitive) if len(faces) else None
            kinds.append(np.full(len(faces), self._material(primitive.get("material", -1), uv is not None)))
            uvs.append(np.zeros((len(faces), 3, 2)) if uv is None else uv[faces])
        found = Appearance(
            tuple(self.materials),
            np.concatenate([np.empty(0, np.int64), *kinds]),
            np.concatenate([np.empty((0, 3, 2)), *uvs]),
            joined_colors(colors, counts),
        )
        if self.picture is not None and not found.textured:
            raise no_coordinates(self.document.name)
        return found

    def _base(self, number: int) -> tuple[dict[str, Any], dict[str, Any] | None, tuple[float, ...]]:
        """A material, its base colour texture and its factor."""
        if number < 0:
            return {}, None, (1.0, 1.0, 1.0, 1.0)
        material = self.json["materials"][number]
        gloss = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if gloss is not None and "pbrMetallicRoughness" not in material:
            return material, gloss.get("diffuseTexture"), tuple(gloss.get("diffuseFactor", (1.0,) * 4))
        pbr = material.get("pbrMetallicRoughness", {})
        return material, pbr.get("baseColorTexture"), tuple(pbr.get("baseColorFactor", (1.0,) * 4))

    def _material(self, number: int, laid: bool) -> int:
        """The number, in our list, of a material of the file, with its image if there are coordinates."""
        if (number, laid) not in self.numbers:
            self.numbers[number, laid] = len(self.materials)
            self.materials.append(self._read(number, laid))
        return self.numbers[number, laid]

    def _read(self, number: int, laid: bool) -> Material:
        entry, texture, factor = self._base(number)
        red, green, blue, alpha = (float(np.clip(value, 0.0, 1.0)) for value in factor)
        made = Material(
            str(entry.get("name", "")),
            factor=(red, green, blue, alpha),
            alpha=_ALPHAS[entry.get("alphaMode", "OPAQUE")],
            cutoff=float(entry.get("alphaCutoff", 0.5)),
        )
        if laid and self.picture is not None:
            made = replace(made, image=self.picture, factor=(1.0, 1.0, 1.0, 1.0))
        if not laid or texture is None:
            return made
        described = self.json["textures"][texture["index"]]
        sampler = self.json["samplers"][described["sampler"]] if "sampler" in described else {}
        wrap = _WRAPS[sampler.get("wrapS", 10497)], _WRAPS[sampler.get("wrapT", 10497)]
        made = replace(made, wrap=wrap, nearest=sampler.get("magFilter") == _NEAREST)
        return made if self.picture is not None else replace(made, image=self._image(described))

    def _image(self, texture: dict[str, Any]) -> Pixels:
        extensions = texture.get("extensions", {})
        number = texture.get("source", extensions.get("EXT_texture_webp", {}).get("source"))
        if number is None:
            kind = next(iter(extensions), "no image at all")
            raise InputError(
                f"{self.document.name} holds a texture that cannot be read ({kind})",
                "export it with png or jpg textures",
            )
        if number not in self.images:
            entry = self.json["images"][number]
            if "uri" in entry:
                data = self.document.resource(entry["uri"])
                inside = entry["uri"].startswith("data:")
                label = f"image {number} of {self.document.name}" if inside else entry["uri"]
            else:
                data = self.document.view_bytes(entry["bufferView"])
                label = f"image {number} of {self.document.name}"
            self.images[number] = self.reader.decode(data, label)
        return self.images[number]

    def _coordinates(self, primitive: dict[str, Any]) -> Floats | None:
        """(V, 2) coordinates of a primitive's vertices, or None where it has none, or nothing to lay on."""
        _, texture, _ = self._base(primitive.get("material", -1))
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
        if not transform:
            return uv
        # Counter-clockwise with v down, as the extension's words and its example have it (its listing does not).
        angle = float(transform.get("rotation", 0.0))
        with np.errstate(all="ignore"):  # what is not finite is refused by the appearance
            u, v = (uv * np.array(transform.get("scale", (1.0, 1.0)), np.float64)).T
            turned = np.stack([np.cos(angle) * u + np.sin(angle) * v, np.cos(angle) * v - np.sin(angle) * u], axis=1)
        return np.asarray(turned + np.array(transform.get("offset", (0.0, 0.0)), np.float64))
