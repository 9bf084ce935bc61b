"""How a file says that its surface looks: texture coordinates, materials with their images, vertex colours.

It stands beside `Shape` and not in it: appearance belongs to the file, geometry to the shape, and few verbs ask
for it. Faces and vertices are those of `load_shape`, in the same order.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from meshmatch.errors import InputError
from meshmatch.shapes.files import read_bytes
from meshmatch.shapes.images import ImageReader, Pixels
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
    material: NDArray[np.int64]
    uv: NDArray[np.float64]
    colors: NDArray[np.float64] | None = None

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


def load_appearance(path: str | Path, shape: Shape, image: str | Path | None = None) -> Appearance:
    """What a file says about the look of its surface.

    glb and gltf: materials with base colour image and factor, samplers, texture transforms, vertex colours.
    obj: its mtl with Kd, map_Kd, d and map_d, beside it. Everything else: vertex colours.

    Parameters
    ----------
    path : str or Path
    shape : Shape
        What `load_shape` made of the same file.
    image : str or Path, optional
        A picture that takes the place of those that the file names, or that it fails to name.

    Raises
    ------
    InputError
        An image or material file is missing, damaged, too large, or outside the file's folder; there are no
        texture coordinates for `image`; or the file has no look at all.
    """
    found = find_appearance(path, shape, image)
    if found is None:
        raise InputError(
            f"{Path(path).name} has no texture and no vertex colours: there is nothing to transfer",
            "name a picture for its texture coordinates with --image, or export it with its materials",
        )
    return found


def find_appearance(path: str | Path, shape: Shape, image: str | Path | None = None) -> Appearance | None:
    """As `load_appearance`, but None where the file has no look at all."""
    path = Path(path)
    reader = ImageReader()
    picture = None if image is None else reader.decode(read_bytes(Path(image)), Path(image).name)
    found = _read(path, shape, reader, picture)
    if len(found.material) != shape.F or (found.colors is not None and len(found.colors) != shape.V):
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    return None if found.plain else found


def load_coordinates(path: str | Path, shape: Shape) -> NDArray[np.float64] | None:
    """(F, 3, 2) texture coordinates of every corner, v down, whatever the materials say; None where a face has none.

    Parameters
    ----------
    shape : Shape
        What `load_shape` made of the same file.

    Raises
    ------
    InputError
        The file is damaged.
    """
    path = Path(path)
    found = None
    if path.suffix.lower() in (".glb", ".gltf"):
        from meshmatch.shapes.formats.gltf_look import read_coordinates as coordinates_of_gltf

        found = coordinates_of_gltf(path, read_bytes(path))
    elif path.suffix.lower() == ".obj":
        from meshmatch.shapes.formats.obj_look import read_coordinates as coordinates_of_obj

        found = coordinates_of_obj(path, read_bytes(path))
    if found is not None and len(found) != shape.F:
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    return found if shape.F else None


def _read(path: Path, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        from meshmatch.shapes.formats.gltf_look import read_look as look_of_gltf

        return look_of_gltf(path, read_bytes(path), reader, picture)
    if suffix == ".obj":
        from meshmatch.shapes.formats.obj_look import read_look as look_of_obj

        return look_of_obj(path, read_bytes(path), shape, reader, picture)
    if picture is not None:
        raise no_coordinates(path.name)
    return vertex_colors_alone(shape)


def vertex_colors_alone(shape: Shape) -> Appearance:
    """The look of a shape that has its vertex colours and nothing else (sRGB, as ply, obj and off hold them)."""
    colors = None
    if shape.colors is not None:
        colors = np.concatenate([to_linear(shape.colors[:, :3]), shape.colors[:, 3:]], axis=1)
    alpha: Alpha = "blend" if colors is not None and (colors[:, 3] < 1).any() else "opaque"
    return Appearance(
        (Material(alpha=alpha),), np.zeros(shape.F, np.int64), np.zeros((shape.F, 3, 2)), colors
    )


def no_coordinates(name: str) -> InputError:
    """The error for a picture that nothing says how to lay on."""
    return InputError(
        f"{name} has no texture coordinates: an image cannot be laid on it",
        "unwrap it, or leave out --image and use its vertex colours",
    )
