"""How a file says that its surface looks: texture coordinates, materials with their images, vertex colours.

It stands beside `Shape` and not in it: appearance belongs to the file, geometry to the shape, and few verbs ask
for it. Faces and vertices are those of `load_shape`, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.images import Pixels
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import to_linear

Wrap = Literal["repeat", "clamp", "mirror"]
Alpha = Literal["opaque", "mask", "blend"]
_FURTHEST_UV = 1e6


@dataclass(frozen=True, eq=False)
class Material:
    """The base colour of some faces: an image times a factor.

    Parameters
    ----------
    name : str
        As the file has it.
    image : (H, W, 4) uint8, optional
        sRGB colours and plain alpha. Its top row begins at v = 0.
    factor : 4 floats
        Linear red, green, blue, and alpha.
    wrap : two of "repeat", "clamp", "mirror"
        What u and v outside 0..1 mean.
    nearest : bool
        True where the file wants texels as squares, not blended.
    alpha : {"opaque", "mask", "blend"}
        Ignored, a threshold, or a share.
    cutoff : float
        The threshold of "mask".
    """

    name: str = ""
    image: Pixels | None = None
    factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    alpha: Alpha = "opaque"
    cutoff: float = 0.5


@dataclass(frozen=True, eq=False)
class Appearance:
    """What lies on the faces of one shape.

    Parameters
    ----------
    materials : tuple of Material
        At least one.
    material : (F,) int64
        Material of each face.
    uv : (F, 3, 2) float64
        Texture coordinates of each corner: u to the right, v *down*, as in glTF; zeros where a material has no
        image. Transforms that the file asks for are applied.
    colors : (V, 4) float64, optional
        Linear colour and alpha of each vertex, to be multiplied.

    Raises
    ------
    InputError
        A coordinate that is not finite or absurdly large on a face with an image.
    """

    materials: tuple[Material, ...]
    material: Int[Ints, " F"]
    uv: Float[Floats, "F 3 2"]
    colors: Float[Floats, "V 4"] | None = None

    def __post_init__(self) -> None:
        pictured = np.array([m.image is not None for m in self.materials])[self.material]
        if not (np.abs(self.uv[pictured]) < _FURTHEST_UV).all():
            bad = int(np.count_nonzero(~(np.abs(self.uv[pictured]) < _FURTHEST_UV).all(axis=(1, 2))))
            raise InputError(
                f"the texture coordinates of {bad} faces are out of range (not a number, or over a million)",
                "unwrap the source again, or export it again",
            )

    @property
    def textured(self) -> bool:
        """True if some face has an image."""
        return any(self.materials[k].image is not None for k in np.unique(self.material).tolist())

    @property
    def plain(self) -> bool:
        """True if there is nothing to see: no image, no vertex colours, one colour all over."""
        factors = {self.materials[k].factor for k in np.unique(self.material).tolist()}
        return not self.textured and self.colors is None and len(factors) <= 1


def vertex_colors_alone(shape: Shape) -> Appearance:
    """The look of a shape that has its vertex colours and nothing else (sRGB, as ply, obj and off hold them)."""
    colors = None
    if shape.colors is not None:
        colors = np.concatenate([to_linear(shape.colors[:, :3]), shape.colors[:, 3:]], axis=1)
    alpha: Alpha = "blend" if colors is not None and (colors[:, 3] < 1).any() else "opaque"
    return Appearance((Material(alpha=alpha),), np.zeros(shape.F, np.int64), np.zeros((shape.F, 3, 2)), colors)


def no_coordinates(name: str) -> InputError:
    """The error for a picture that nothing says how to lay on."""
    return InputError(
        f"{name} has no texture coordinates: an image cannot be laid on it",
        "unwrap it, or leave out --image and use its vertex colours",
    )
