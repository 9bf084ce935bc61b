"""Apply a baked texture to toon materials of characters (MToon of VRM 0.x and 1.0), keeping their shading.

Specification: VRM Consortium, VRM 0.0, ``materialProperties``; VRMC_materials_mtoon 1.0.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from meshmatch.errors import warn
from meshmatch.shapes.appearance import BakedMaterial
from meshmatch.shapes.colors import to_linear, to_srgb
from meshmatch.shapes.formats import gltf_vrm

Json = dict[str, Any]
MTOON, _EMISSIVE_MULTIPLIER = "VRMC_materials_mtoon", "VRMC_materials_hdr_emissiveMultiplier"
_OLD_MTOON = "VRM/MToon"
_MAX_NAMES = 5  # materials or expressions that a warning lists
_IDENTITY = [0.0, 0.0, 1.0, 1.0]  # offset and scale of a texture without a transform
# Blend modes of MToon in VRM 0.x, by transparency: _BlendMode, source and destination blend factors, _ZWrite,
# _AlphaToMask, shader keyword, RenderType tag and render queue.
_MODES: dict[str, tuple[int, int, int, int, int, str, str, int]] = {
    "opaque": (0, 1, 0, 1, 0, "", "Opaque", 2000),
    "mask": (1, 1, 0, 1, 1, "_ALPHATEST_ON", "TransparentCutout", 2450),
    "blend": (2, 5, 10, 0, 0, "_ALPHABLEND_ON", "Transparent", 3000),
}
_BLENDS_WITH_DEPTH = 3
_UNAFFECTED = ("_MainTex", "_ShadeTexture", "_BumpMap", "_EmissionMap", "_SphereAdd")
"""Textures of VRM 0.x that are replaced, or (the last one) use no texture coordinates."""


def toon_materials(json: Json) -> list[str]:
    """Names of the toon materials of a file, which do not show vertex colors."""
    old = gltf_vrm.properties(json)
    return [
        str(entry.get("name", k))
        for k, entry in enumerate(json.get("materials", []))
        if MTOON in entry.get("extensions", {}) or (k < len(old) and old[k].get("shader") == _OLD_MTOON)
    ]


@dataclass
class ToonMaterials:
    """Rewrites the toon materials of a character for a baked one.

    `color`, `normal` and `glow` are the numbers of the textures of the baked images.
    """

    name: str
    json: Json
    baked: BakedMaterial
    color: int
    normal: int | None
    glow: int | None
    lost_shades: list[str] = field(default_factory=list)
    lost_textures: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.before = copy.deepcopy(gltf_vrm.properties(self.json))

    def is_toon(self, number: int | None, entry: Json) -> bool:
        """Whether a material is a toon material, and stays one."""
        old = number is not None and number < len(self.before) and self.before[number].get("shader") == _OLD_MTOON
        return old or MTOON in entry.get("extensions", {})

    def replace_shade(self, entry: Json, before: Json, moved_to: int | None) -> None:
        """Set the shade texture of a VRM 1.0 material to the baked color, keeping the tint of its shade."""
        toon = entry.get("extensions", {}).get(MTOON)
        if toon is None:
            return
        entry["extensions"].pop(_EMISSIVE_MULTIPLIER, None)
        pbr, shade = before.get("pbrMetallicRoughness", {}), toon.get("shadeMultiplyTexture", {})
        if shade.get("index", -1) != pbr.get("baseColorTexture", {}).get("index", -1) and shade:
            self.lost_shades.append(str(entry.get("name", "")))
        lit = pbr.get("baseColorFactor", [1.0] * 4)[:3]
        toon["shadeColorFactor"] = _tint(lit, toon.get("shadeColorFactor", [0.0] * 3)).tolist()
        toon["shadeMultiplyTexture"] = {"index": self.color}
        if before.get("alphaMode", "OPAQUE") != entry.get("alphaMode", "OPAQUE"):
            for key in ("transparentWithZWrite", "renderQueueOffsetNumber"):
                toon.pop(key, None)
        toon.get("matcapTexture", {}).pop("texCoord", None)  # a matcap uses no texture coordinates
        if moved_to is not None and any(
            key.endswith("Texture") and key not in ("matcapTexture", "shadeMultiplyTexture") for key in toon
        ):
            self.lost_textures.append(str(entry.get("name", "")))

    def finish(self, made: Mapping[tuple[int | None, int | None], int]) -> None:
        """Update the material properties of VRM 0.x to match the glTF materials, and warn of what programs cannot show.

        ``made`` maps (old material number, set of its former texture coordinates) to the new material number.
        """
        gltf_vrm.complete_properties(self.json)
        properties, materials = gltf_vrm.properties(self.json), self.json.get("materials", [])
        for (old, moved_to), new in made.items():
            if old is not None and new != old:
                gltf_vrm.copy_material(self.json, old, new)
            if properties:
                old_properties = self.before[old] if old is not None and old < len(self.before) else {}
                was_toon = old_properties.get("shader") == _OLD_MTOON
                entry = (
                    self._rewrite_old(old_properties, moved_to is not None)
                    if was_toon
                    else gltf_vrm.plain_properties(materials[new])
                )
                properties[new].clear()
                properties[new].update(entry)
        self._warn({new: str(materials[new].get("name", "")) for new in made.values()})

    def _rewrite_old(self, before: Json, moved: bool) -> Json:
        """Rewrite the properties of a VRM 0.x toon material; ``moved``: its texture coordinates have been replaced."""
        entry, baked = copy.deepcopy(before), self.baked
        groups = ("floatProperties", "vectorProperties", "textureProperties", "keywordMap", "tagMap")
        floats, vectors, textures, keywords, tags = (entry.setdefault(key, {}) for key in groups)
        if textures.get("_ShadeTexture", -1) not in (-1, textures.get("_MainTex", -1)):
            self.lost_shades.append(str(entry.get("name", "")))
        lit, shade = (to_linear(vectors.get(key, [1.0] * 4)[:3]) for key in ("_Color", "_ShadeColor"))
        vectors["_ShadeColor"] = [*to_srgb(_tint(lit, shade)).tolist(), 1.0]
        vectors["_Color"] = [1.0] * 4
        displaced = moved or not np.allclose(vectors.get("_MainTex", _IDENTITY), _IDENTITY)
        for key in [key for key in textures if displaced and key not in _UNAFFECTED]:
            del textures[key]
            self.lost_textures.append(str(entry.get("name", "")))
        if displaced:
            textures.pop("_BumpMap", None)
            keywords.pop("_NORMALMAP", None)
        textures |= {"_MainTex": self.color, "_ShadeTexture": self.color}
        textures.pop("_EmissionMap", None)
        vectors["_EmissionColor"] = [*baked.light, 1.0]
        if self.glow is not None:
            textures["_EmissionMap"] = self.glow
        if self.normal is not None:
            textures["_BumpMap"], floats["_BumpScale"], keywords["_NORMALMAP"] = self.normal, 1.0, True
        for key in [key for key in vectors if key in textures or key == "_MainTex"]:
            vectors[key] = [*_IDENTITY]
        self._blend(entry, floats, keywords, tags)
        return entry

    def _blend(self, entry: Json, floats: Json, keywords: Json, tags: Json) -> None:
        """Set the blend mode of a VRM 0.x material to the transparency of the baked one."""
        mode = self.baked.alpha
        number, source, target, depth, samples, keyword, tag, queue = _MODES[mode]
        if mode == "mask":
            floats["_Cutoff"] = self.baked.cutoff
        if round(floats.get("_BlendMode", 0)) in (number, _BLENDS_WITH_DEPTH if mode == "blend" else number):
            return
        floats |= {"_BlendMode": number, "_SrcBlend": source, "_DstBlend": target, "_ZWrite": depth}
        floats["_AlphaToMask"] = samples
        for other in ("_ALPHATEST_ON", "_ALPHABLEND_ON", "_ALPHAPREMULTIPLY_ON"):
            keywords.pop(other, None)
        keywords |= {keyword: True} if keyword else {}
        tags["RenderType"], entry["renderQueue"] = tag, queue

    def _warn(self, material_names: Mapping[int, str]) -> None:
        """Warn of shade images, other textures and texture animations that are lost or changed."""
        if self.lost_shades:
            what = "separate shade images, which the new texture replaces"
            warn(f"{self.name} has materials with {what}: {_listed(self.lost_shades)}")
        if self.lost_textures and self.before:
            what = "that would not fit the new coordinates are left out"
            warn(f"other textures of toon materials of {self.name} {what}: {_listed(self.lost_textures)}")
        elif self.lost_textures:
            what = "use its former texture coordinates, which few programs support"
            warn(f"other textures of toon materials of {self.name} {what}: {_listed(self.lost_textures)}")
        if moving := gltf_vrm.moving_textures(self.json, material_names):
            warn(f"expressions of {self.name} that move a texture now move the new one: {_listed(moving)}")


def _tint(lit: ArrayLike, shade: ArrayLike) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Ratio of the shade color to the lit color, per channel in linear light, clipped to 0..1."""
    lit, shade = np.asarray(lit, np.float64), np.asarray(shade, np.float64)
    return np.clip(np.where(lit > 0, shade / np.where(lit > 0, lit, 1.0), shade), 0.0, 1.0)


def _listed(names: list[str]) -> str:
    unique = list(dict.fromkeys(names))
    return ", ".join(unique[:_MAX_NAMES]) + (", ..." if len(unique) > _MAX_NAMES else "")
