"""Read the layers of glTF materials besides base color: metalness, roughness, normals, occlusion and emission.

Specification: Khronos glTF 2.0, section 3.9; KHR_materials_emissive_strength, KHR_materials_unlit,
KHR_materials_pbrSpecularGlossiness (its glossiness). Faces are those of `meshmatch.shapes.formats.gltf.read`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from meshmatch.errors import InputError, warn
from meshmatch.shapes.appearance import Appearance, Finish, ImageReader, Layer, Material, Pixels
from meshmatch.shapes.formats.gltf import Document, parse_document
from meshmatch.shapes.formats.gltf_attributes import Look
from meshmatch.shapes.shape import Shape

_UNLIT, _STRENGTH = "KHR_materials_unlit", "KHR_materials_emissive_strength"
_LABELS: dict[Layer, str] = {
    "normal": "normal map",
    "surface": "metal and roughness",
    "occlusion": "occlusion map",
    "glow": "emission",
}
# Prefix of material extensions; those that are not in `_READ` are reported as not transferred.
_MATERIAL_PREFIX = "KHR_materials_"
_READ = (_UNLIT, _STRENGTH, "KHR_materials_pbrSpecularGlossiness", "KHR_materials_variants")


def read_finish(path: Path, data: bytes, _: Shape, reader: ImageReader) -> Finish | None:
    """Read the layers of a scene's materials; None if it has no material.

    A layer whose image cannot be read is left out, with a warning.
    """
    return parse_document(path, data, "materials make", lambda document: _finish(document, reader))


def _finish(document: Document, reader: ImageReader) -> Finish | None:
    used = {primitive["material"] for _, primitive, _ in document.primitives() if "material" in primitive}
    entries = [document.json["materials"][number] for number in sorted(used)]
    if not entries:
        return None
    light = max((_peak_emission(entry) for entry in entries), default=1.0)
    images: dict[int, Pixels] = {}
    layers: dict[Layer, Appearance] = {}
    for layer in get_args(Layer):
        try:
            found = _LayerLook(document, reader, images, layer, max(light, 1.0)).scene()
        except InputError as error:
            warn(f"the {_LABELS[layer]} of {document.name} cannot be read and is left out: {error.message}")
        else:
            layers[layer] = replace(found, colors=None)
    unsupported = {
        name for entry in entries for name in entry.get("extensions", {}) if name.startswith(_MATERIAL_PREFIX)
    }
    if unsupported := unsupported - {*_READ}:
        extension_names = ", ".join(sorted(name.removeprefix(_MATERIAL_PREFIX) for name in unsupported))
        warn(f"the materials of {document.name} use extensions that are not transferred: {extension_names[:200]}")
    unlit = all(_UNLIT in entry.get("extensions", {}) for entry in entries)
    return Finish(layers, max(light, 1.0), any(entry.get("doubleSided", False) for entry in entries), unlit)


def _peak_emission(entry: dict[str, Any]) -> float:
    """Emission of the strongest channel of a material: emissive factor times emissive strength."""
    strength = float(entry.get("extensions", {}).get(_STRENGTH, {}).get("emissiveStrength", 1.0))
    return strength * max(float(value) for value in entry.get("emissiveFactor", (0.0, 0.0, 0.0)))


class _LayerLook(Look):
    """Reader of one layer of a scene's materials; emission is divided by `light`."""

    def __init__(
        self, document: Document, reader: ImageReader, images: dict[int, Pixels], layer: Layer, light: float
    ) -> None:
        super().__init__(document, reader, None)
        self.images, self.layer, self.light = images, layer, light

    def base(self, number: int) -> tuple[dict[str, Any], dict[str, Any] | None, tuple[float, ...]]:
        """Return a material, the texture of the layer and its factor."""
        entry = self.json["materials"][number] if number >= 0 else {}
        if self.layer == "normal":
            texture = entry.get("normalTexture")
            return entry, texture, (0.5, 0.5, 1.0, 1.0) if texture is None else (1.0,) * 4
        if self.layer == "occlusion":
            return entry, entry.get("occlusionTexture"), (1.0,) * 4
        if self.layer == "glow":
            strength = float(entry.get("extensions", {}).get(_STRENGTH, {}).get("emissiveStrength", 1.0)) / self.light
            color = [strength * float(value) for value in entry.get("emissiveFactor", (0.0, 0.0, 0.0))]
            return entry, entry.get("emissiveTexture"), (*color, 1.0)
        gloss = entry.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
        if gloss is not None and "pbrMetallicRoughness" not in entry:
            return entry, None, (1.0, 1.0 - float(gloss.get("glossinessFactor", 1.0)), 0.0, 1.0)
        pbr = entry.get("pbrMetallicRoughness", {})
        default = 1.0 if number >= 0 else 0.0
        factors = pbr.get("roughnessFactor", 1.0), pbr.get("metallicFactor", default)
        return entry, pbr.get("metallicRoughnessTexture"), (1.0, *map(float, factors), 1.0)

    def read(self, number: int, has_uv: bool) -> Material:
        """Read a material of the layer, with its image if the primitive has texture coordinates (`has_uv`)."""
        _, texture, _ = self.base(number)
        material = super().read(number, has_uv)
        if self.layer == "normal" and material.image is None:  # also if there are no texture coordinates
            material = replace(material, factor=(0.5, 0.5, 1.0, 1.0))
        key = {"normal": "scale", "occlusion": "strength"}.get(self.layer, "")
        strength = float(np.clip(float((texture or {}).get(key, 1.0)), 0.0, 1e3))
        return replace(material, alpha="opaque", linear=self.layer != "glow", strength=strength)
