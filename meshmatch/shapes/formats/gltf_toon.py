"""Toon materials of characters (MToon of VRM 0.x and 1.0) that wear a baked texture: their shading stays.

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
MTOON, _BRIGHTER = "VRMC_materials_mtoon", "VRMC_materials_hdr_emissiveMultiplier"
_OLD_MTOON = "VRM/MToon"
_NAMED = 5  # materials or expressions that a warning lists
_STILL = [0.0, 0.0, 1.0, 1.0]  # a texture that is neither moved nor scaled
# Of MToon in VRM 0.x, by how transparent it is: its own number, factors of what is drawn and what was there, whether depth
# is written, whether alpha counts samples, the keyword, the tag and the place in the queue.
_MODES: dict[str, tuple[int, int, int, int, int, str, str, int]] = {
    "opaque": (0, 1, 0, 1, 0, "", "Opaque", 2000),
    "mask": (1, 1, 0, 1, 1, "_ALPHATEST_ON", "TransparentCutout", 2450),
    "blend": (2, 5, 10, 0, 0, "_ALPHABLEND_ON", "Transparent", 3000),
}
_BLENDS_WITH_DEPTH = 3
_FREE = ("_MainTex", "_ShadeTexture", "_BumpMap", "_EmissionMap", "_SphereAdd")
"""Textures of VRM 0.x that are replaced, or (the last) lie on no coordinates."""


def toon_materials(json: Json) -> list[str]:
    """Names of toon materials, which show no colors of vertices."""
    old = gltf_vrm.properties(json)
    return [
        str(entry.get("name", k))
        for k, entry in enumerate(json.get("materials", []))
        if MTOON in entry.get("extensions", {}) or (k < len(old) and old[k].get("shader") == _OLD_MTOON)
    ]


@dataclass
class ToonWear:
    """What the materials of a character become that wear a baked one, whose images are these textures."""

    name: str
    json: Json
    baked: BakedMaterial
    color: int
    normal: int | None
    glow: int | None
    shaded: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.before = copy.deepcopy(gltf_vrm.properties(self.json))

    def keeps(self, number: int | None, entry: Json) -> bool:
        """Whether a material stays a toon material."""
        old = number is not None and number < len(self.before) and self.before[number].get("shader") == _OLD_MTOON
        return old or MTOON in entry.get("extensions", {})

    def lay_on(self, entry: Json, before: Json, moved_to: int | None) -> None:
        """Let the shade of a material of VRM 1.0 show the baked color, in the tint that it had."""
        toon = entry.get("extensions", {}).get(MTOON)
        if toon is None:
            return
        entry["extensions"].pop(_BRIGHTER, None)
        paint, shade = before.get("pbrMetallicRoughness", {}), toon.get("shadeMultiplyTexture", {})
        if shade.get("index", -1) != paint.get("baseColorTexture", {}).get("index", -1) and shade:
            self.shaded.append(str(entry.get("name", "")))
        lit = paint.get("baseColorFactor", [1.0] * 4)[:3]
        toon["shadeColorFactor"] = _tint(lit, toon.get("shadeColorFactor", [0.0] * 3)).tolist()
        toon["shadeMultiplyTexture"] = {"index": self.color}
        if before.get("alphaMode", "OPAQUE") != entry.get("alphaMode", "OPAQUE"):
            for key in ("transparentWithZWrite", "renderQueueOffsetNumber"):
                toon.pop(key, None)
        toon.get("matcapTexture", {}).pop("texCoord", None)  # it lies on no coordinates
        if moved_to is not None and any(
            key.endswith("Texture") and key not in ("matcapTexture", "shadeMultiplyTexture") for key in toon
        ):
            self.left.append(str(entry.get("name", "")))

    def finish(self, made: Mapping[tuple[int | None, int | None], int]) -> None:
        """Say the same in what extensions hold beside the materials; ``made`` are the new numbers of materials, by the old
        ones and by where their former coordinates are. What programs cannot show is told.
        """
        gltf_vrm.complete_properties(self.json)
        held, materials = gltf_vrm.properties(self.json), self.json.get("materials", [])
        for (old, moved_to), new in made.items():
            if old is not None and new != old:
                gltf_vrm.copy_material(self.json, old, new)
            if held:
                own = self.before[old] if old is not None and old < len(self.before) else {}
                toon = own.get("shader") == _OLD_MTOON
                entry = self._worn(own, moved_to is not None) if toon else gltf_vrm.plain_properties(materials[new])
                held[new].clear()
                held[new].update(entry)
        self._tell({new: str(materials[new].get("name", "")) for new in made.values()})

    def _worn(self, before: Json, moved: bool) -> Json:
        entry, baked = copy.deepcopy(before), self.baked
        groups = ("floatProperties", "vectorProperties", "textureProperties", "keywordMap", "tagMap")
        floats, vectors, textures, words, tags = (entry.setdefault(key, {}) for key in groups)
        if textures.get("_ShadeTexture", -1) not in (-1, textures.get("_MainTex", -1)):
            self.shaded.append(str(entry.get("name", "")))
        lit, shade = (to_linear(vectors.get(key, [1.0] * 4)[:3]) for key in ("_Color", "_ShadeColor"))
        vectors["_ShadeColor"] = [*to_srgb(_tint(lit, shade)).tolist(), 1.0]
        vectors["_Color"] = [1.0] * 4
        off = moved or not np.allclose(vectors.get("_MainTex", _STILL), _STILL)
        for key in [key for key in textures if off and key not in _FREE]:
            del textures[key]
            self.left.append(str(entry.get("name", "")))
        if off:
            textures.pop("_BumpMap", None)
            words.pop("_NORMALMAP", None)
        textures |= {"_MainTex": self.color, "_ShadeTexture": self.color}
        textures.pop("_EmissionMap", None)
        vectors["_EmissionColor"] = [*baked.light, 1.0]
        if self.glow is not None:
            textures["_EmissionMap"] = self.glow
        if self.normal is not None:
            textures["_BumpMap"], floats["_BumpScale"], words["_NORMALMAP"] = self.normal, 1.0, True
        for key in [key for key in vectors if key in textures or key == "_MainTex"]:
            vectors[key] = [*_STILL]
        self._blend(entry, floats, words, tags)
        return entry

    def _blend(self, entry: Json, floats: Json, words: Json, tags: Json) -> None:
        """How transparent a material of VRM 0.x is."""
        mode = self.baked.alpha
        number, source, target, depth, samples, word, tag, queue = _MODES[mode]
        if mode == "mask":
            floats["_Cutoff"] = self.baked.cutoff
        if round(floats.get("_BlendMode", 0)) in (number, _BLENDS_WITH_DEPTH if mode == "blend" else number):
            return
        floats |= {"_BlendMode": number, "_SrcBlend": source, "_DstBlend": target, "_ZWrite": depth}
        floats["_AlphaToMask"] = samples
        for other in ("_ALPHATEST_ON", "_ALPHABLEND_ON", "_ALPHAPREMULTIPLY_ON"):
            words.pop(other, None)
        words |= {word: True} if word else {}
        tags["RenderType"], entry["renderQueue"] = tag, queue

    def _tell(self, worn: Mapping[int, str]) -> None:
        if self.shaded:
            many = "images of their own for the shade, where the new texture is seen now"
            warn(f"{self.name} has materials with {many}: {_listed(self.shaded)}")
        if self.left and self.before:
            many = "that the new coordinates would displace are left out"
            warn(f"other textures of toon materials of {self.name} {many}: {_listed(self.left)}")
        elif self.left:
            many = "lie on its former coordinates, which few programs draw"
            warn(f"other textures of toon materials of {self.name} {many}: {_listed(self.left)}")
        if moving := gltf_vrm.moving_textures(self.json, worn):
            warn(f"expressions of {self.name} that move a texture move the new one: {_listed(moving)}")


def _tint(lit: ArrayLike, shade: ArrayLike) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Of what is lit, how much is seen in the shade (linear)."""
    lit, shade = np.asarray(lit, np.float64), np.asarray(shade, np.float64)
    return np.clip(np.where(lit > 0, shade / np.where(lit > 0, lit, 1.0), shade), 0.0, 1.0)


def _listed(names: list[str]) -> str:
    some = list(dict.fromkeys(names))
    return ", ".join(some[:_NAMED]) + (", ..." if len(some) > _NAMED else "")
