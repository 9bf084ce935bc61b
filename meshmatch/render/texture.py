"""The textures of a file on the triangles of a picture."""

from __future__ import annotations

import numpy as np

from meshmatch.arrays import Bool, Bools, Float, Floats32, Int, Ints
from meshmatch.render.surface import AnyFloats
from meshmatch.shapes.appearance import Appearance, Material
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.texels import Pyramid

_INVISIBLE = 0.05  # an alpha below this is meant to be invisible


class TexturePaint:
    """Paint by the materials of a file: image times factor times vertex color, as glTF defines it.

    ``shape`` is of the same file, and ``scale`` the length in it that is 1 in view coordinates.
    """

    def __init__(self, look: Appearance, shape: Shape, scale: float) -> None:
        self._look, self._faces = look, shape.faces
        self._colors = None if look.colors is None else np.nan_to_num(look.colors).astype(np.float32)
        self._pyramids: dict[int, Pyramid] = {}
        used = np.unique(look.material).tolist()
        shared: dict[tuple[int, tuple[str, str], bool, bool], Pyramid] = {}
        for number in used:
            material = look.materials[number]
            if material.image is not None:
                key = (id(material.image), material.wrap, material.nearest, material.alpha == "opaque")
                if key not in shared:
                    shared[key] = Pyramid.of(material)
                self._pyramids[number] = shared[key]
        # Texels per unit of length on each face: a pixel averages as many as it is wide.
        a, b = look.uv[:, 1] - look.uv[:, 0], look.uv[:, 2] - look.uv[:, 0]
        flat = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        solid = 2.0 * shape.face_areas / scale**2
        sizes = np.array([_texels(material) for material in look.materials])[look.material]
        self._density = np.sqrt(flat * sizes / np.maximum(solid, 1e-20)).astype(np.float32)

    def at(self, faces: Int[Ints, " N"], weights: Float[AnyFloats, "N 3"], footprint: float) -> Float[Floats32, "N 4"]:
        """Linear colors and 1, or 0 for a hole (see `Paint.at`)."""
        weights = np.asarray(weights, np.float32)
        out = np.ones((len(faces), 4), np.float32)
        materials = self._look.material[faces]
        tint = np.ones((len(faces), 4), np.float32)
        if self._colors is not None:
            tint = np.einsum("nk,nkc->nc", weights, self._colors[self._faces[faces]])
        for number in np.unique(materials).tolist():
            rows = np.flatnonzero(materials == number)
            material = self._look.materials[number]
            if number in self._pyramids:
                uv = np.einsum("nk,nkc->nc", weights[rows], self._look.uv[faces[rows]]).astype(np.float32)
                wide = np.float32(footprint) * self._density[faces[rows]]
                out[rows] = self._pyramids[number].look(uv[:, 0], uv[:, 1], wide).T
            own = tint[rows] * np.array(material.factor, np.float32)
            out[rows, :3] *= own[:, :3]
            out[rows, 3] = _solid(material, out[rows, 3], own[:, 3])
        return out


def _solid(material: Material, image: Float[Floats32, " N"], factor: Float[Floats32, " N"]) -> Bool[Bools, " N"]:
    """Whether there is anything, by the alpha of the image and of its factor.

    Half-transparent glass is drawn as if it were solid; what an image cuts out, such as hair from its card, is not.
    """
    if material.alpha == "opaque":
        return np.ones(len(image), bool)
    if material.alpha == "mask":
        return np.asarray(image * factor >= material.cutoff)
    return np.asarray((image >= 0.5) & (factor >= _INVISIBLE))


def _texels(material: Material) -> float:
    return 0.0 if material.image is None else float(material.image.shape[0] * material.image.shape[1])
