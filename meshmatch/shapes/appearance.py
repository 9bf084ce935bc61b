"""How a file says that its surface looks: texture coordinates, materials with their images, vertex colors.

It stands beside `Shape` and not in it: appearance belongs to the file, geometry to the shape, and few verbs ask
for it. Faces and vertices are those of `load_shape`, in the same order.
"""

from __future__ import annotations

import logging
import os
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, UnidentifiedImageError

from meshmatch.arrays import Brief, Float, Floats, Int, Ints, UInts8
from meshmatch.errors import InputError, warn
from meshmatch.shapes.colors import INVISIBLE, light
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

Pixels = UInts8
Wrap = Literal["repeat", "clamp", "mirror"]
Alpha = Literal["opaque", "mask", "blend"]
_FURTHEST_UV = 1e6
MAX_PIXELS = 8192 * 8192
"""Of one image. Pillow's own alarm stands a little higher."""
MAX_ALL_PIXELS = 2 * MAX_PIXELS
"""Of all images of one shape together."""
logging.getLogger("PIL").addHandler(logging.NullHandler())  # else Python prints what nobody listens to
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
_DAMAGE = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, TypeError, IndexError)


@dataclass(frozen=True, eq=False)
class Material:
    """The base color of some faces: an image times a factor. Or what else an image says of a surface (`Finish`).

    `image` (H, W, 4) has sRGB colors, or numbers if it is `linear`, and plain alpha; its top row begins at v = 0. `factor`
    is linear red, green, blue, and alpha; `strength` is how much the image of a layer counts. `wrap` says what u and v
    outside 0..1 mean, `nearest` that the file wants texels as squares, not blended. Alpha is ignored ("opaque"), compared
    with `cutoff` ("mask"), or a share ("blend").
    """

    name: str = ""
    image: Pixels | None = None
    factor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")
    nearest: bool = False
    alpha: Alpha = "opaque"
    cutoff: float = 0.5
    linear: bool = False
    strength: float = 1.0


Layer = Literal["normal", "surface", "occlusion", "glow"]


@dataclass(frozen=True, eq=False)
class Finish:
    """What a file says of its surface besides its color.

    Each layer is laid on like the colors, by materials and coordinates of its own: "normal", directions in the frame of the
    surface; "surface", with roughness in green and metal in blue; "occlusion" in red; "glow", light that it sends out, in
    units of `light`. A layer that is missing says nothing.
    """

    layers: Mapping[Layer, Appearance]
    light: float = 1.0
    double_sided: bool = True
    unlit: bool = False

    @property
    def occluded(self) -> bool:
        """Whether an image says where light is kept out."""
        return "occlusion" in self.layers and self.layers["occlusion"].textured

    @property
    def even(self) -> bool:
        """Whether roughness and metal are the same all over."""
        return "surface" in self.layers and self.layers["surface"].plain

    @property
    def images(self) -> tuple[Layer, ...]:
        """The layers that need an image when they are baked; occlusion goes with the surface."""
        needed: dict[Layer, bool] = {
            "normal": "normal" in self.layers and self.layers["normal"].textured,
            "surface": "surface" in self.layers and (self.occluded or not self.even),
            "glow": "glow" in self.layers and not self.layers["glow"].plain,
        }
        return tuple(layer for layer, some in needed.items() if some)


@dataclass(frozen=True, eq=False)
class BakedMaterial:
    """One material for a whole surface, whose images lie on one set of coordinates.

    Attributes
    ----------
    color
        (H, W, 4) sRGB colors and plain alpha, which means what ``alpha`` and ``cutoff`` say, as in `Material`.
    name
        Of the material.
    double_sided
        Faces are seen from both sides.
    unlit
        The color is all there is: no light falls on the surface.
    normal
        (H, W, 4) directions in the frame of the surface, as glTF has them: red along u, green against v, blue outwards.
    surface
        (H, W, 4): red is occlusion if it is ``occluded``, green roughness, blue metal.
    even
        Roughness and metal are the same all over: the image shows occlusion alone.
    roughness
        In 0..1; multiplies the image, if there is one that shows it.
    metal
        The same.
    glow
        (H, W, 4) sRGB colors of the light that the surface sends out.
    light
        Linear red, green and blue; multiplies ``glow``, if there is one. May be above 1.
    """

    color: Pixels
    alpha: Alpha = "opaque"
    cutoff: float = 0.5
    name: str = ""
    double_sided: bool = True
    unlit: bool = False
    normal: Pixels | None = None
    surface: Pixels | None = None
    occluded: bool = False
    even: bool = False
    roughness: float = 1.0
    metal: float = 0.0
    glow: Pixels | None = None
    light: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """Those that an obj has images of, which holds no occlusion."""
        surface = None if self.even else self.surface
        shown: dict[Layer, Pixels | None] = {"normal": self.normal, "surface": surface, "glow": self.glow}
        return tuple(layer for layer, image in shown.items() if image is not None)


@dataclass(frozen=True, eq=False, repr=False)
class Appearance(Brief):
    """What lies on the faces of one shape.

    There is at least one material; each face has one. `uv` are the texture coordinates of each corner: u to the right,
    v *down*, as in glTF, with the transforms that the file asks for; zeros where a material has no image. `colors` are
    linear color and alpha of each vertex, to be multiplied. `finish` is the rest of the materials, where it was asked for.

    `InputError` for a coordinate that is not finite or absurdly large on a face with an image.
    """

    materials: tuple[Material, ...]
    material: Int[Ints, " F"]
    uv: Float[Floats, "F 3 2"]
    colors: Float[Floats, "V 4"] | None = None
    finish: Finish | None = None

    def __post_init__(self) -> None:
        pictured = np.array([m.image is not None for m in self.materials])[self.material]
        fine = (np.abs(self.uv[pictured]) < _FURTHEST_UV).all(axis=(1, 2))
        if not fine.all():
            bad = f"the texture coordinates of {len(fine) - int(fine.sum())} faces are out of range"
            hint = "unwrap the source again, or export it again"
            raise InputError(f"{bad} (not a number, or over a million)", hint)

    @property
    def textured(self) -> bool:
        """True if some face has an image."""
        return any(self.materials[k].image is not None for k in np.unique(self.material).tolist())

    @property
    def plain(self) -> bool:
        """True if there is nothing to see: no image, no vertex colors, one color all over."""
        factors = {self.materials[k].factor for k in np.unique(self.material).tolist()}
        layers = () if self.finish is None else self.finish.layers.values()
        bare = not self.textured and self.colors is None and len(factors) <= 1
        return bare and not any(layer.textured for layer in layers)


def visible(look: Appearance, name: str) -> Appearance:
    """The look of a file of a name, but no material is wholly transparent: such a one is never meant, and becomes opaque.

    Many programs write the opacity of a material as its transparency, or 0 where they know of neither. It is said which
    materials these were (`MeshmatchWarning`).
    """
    materials, hidden = list(look.materials), []
    for number in np.unique(look.material).tolist():
        made = opaque_if_hidden(materials[number])
        if made is not materials[number]:
            hidden.append(made.name or "without a name")
            materials[number] = made
    if not hidden:
        return look
    some = ", ".join(dict.fromkeys(hidden[:5])) + (", ..." if len(hidden) > 5 else "")
    what = (
        f"the material {some} of {name} is" if len(hidden) == 1 else f"{len(hidden)} materials of {name} ({some}) are"
    )
    warn(f"{what} wholly transparent; taken as opaque")
    return replace(look, materials=tuple(materials))


def opaque_if_hidden(material: Material) -> Material:
    """The same material, or, if nothing of it would be seen, one that is opaque but for what its image cuts out."""
    if material.alpha == "opaque":
        return material
    most = 1.0 if material.image is None else float(material.image[..., 3].max(initial=0)) / 255.0
    least = INVISIBLE if material.alpha == "blend" else min(material.cutoff, 1.0)
    if material.factor[3] * most >= least:
        return material
    solid = replace(material, factor=(*material.factor[:3], 1.0))
    if most < least or material.image is None or bool((material.image[..., 3] == 255).all()):
        return replace(solid, alpha="opaque")
    return solid


def vertex_colors_alone(shape: Shape) -> Appearance:
    """The look of a shape that has its vertex colors and nothing else (sRGB, as ply, obj and off hold them)."""
    colors = None if shape.colors is None else light(shape.colors)
    alpha: Alpha = "blend" if colors is not None and (colors[:, 3] < 1).any() else "opaque"
    return Appearance((Material(alpha=alpha),), np.zeros(shape.F, np.int64), np.zeros((shape.F, 3, 2)), colors)


def no_coordinates(name: str) -> InputError:
    """The error for a picture that nothing says how to lay on."""
    what = f"{name} has no texture coordinates: an image cannot be laid on it"
    return InputError(what, "unwrap it, or leave out --image and use its vertex colors")


class ImageReader:
    """Decodes the images of one shape, and counts their pixels: a small file can promise gigabytes."""

    def __init__(self) -> None:
        self.left = MAX_ALL_PIXELS
        self._known: dict[Path, Pixels] = {}

    def read(self, file: Path) -> Pixels:
        """`decode` of a file: once, for many materials may name one image."""
        if file not in self._known:
            self._known[file] = self.decode(read_bytes(file), file.name)
        return self._known[file]

    def decode(self, data: bytes, label: str) -> Pixels:
        """(H, W, 4) red, green, blue, alpha of a png, jpeg, webp, bmp, tga or tiff, top row first; or `InputError`."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the bomb is judged here; other warnings are of metadata
                with Image.open(BytesIO(data), formats=_FORMATS) as image:
                    size = f"{image.width} x {image.height} pixels"
                    if image.width * image.height > MAX_PIXELS:
                        raise _too_large(label, size)
                    self.left -= image.width * image.height
                    if self.left < 0:
                        raise _too_large(label, f"{size}, and the others before it nearly as many")
                    with _silent() if image.format == "TIFF" else nullcontext():
                        return _rgba(image)
        except Image.DecompressionBombError as error:
            raise _too_large(label, "over 179 million pixels") from error
        except UnidentifiedImageError as error:
            raise InputError(f"{label} cannot be read as an image", "save it as png or jpg") from error
        except _DAMAGE as error:
            what = (str(error) or type(error).__name__).strip().splitlines()[0][:80]
            raise InputError(f"{label} is a damaged image ({what})", "export it or copy it again") from error


@contextmanager
def _silent() -> Iterator[None]:
    """Let nothing be written to stderr: libtiff, a library in C, tells there what is wrong with a file."""
    try:
        kept = os.dup(2)
    except OSError:  # there is none
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _rgba(image: Image.Image) -> Pixels:
    if image.mode.startswith("I") or image.mode == "F":  # 16 bits of grey, which Pillow would cut off
        grey = np.asarray(image).astype(np.float64)
        most = 65535.0 if image.mode.startswith("I") else 1.0
        byte = np.round(255 * np.clip(np.nan_to_num(grey) / most, 0, 1)).astype(np.uint8)
        return np.stack([byte, byte, byte, np.full_like(byte, 255)], axis=-1)
    return np.array(image.convert("RGBA"))


def _too_large(label: str, what: str) -> InputError:
    side = int(MAX_PIXELS**0.5)
    return InputError(f"{label} is too large: {what}", f"make it smaller: at most {side} x {side} pixels")


def png_bytes(pixels: Pixels) -> bytes:
    """A PNG of (H, W, 4) pixels; without alpha if that is 255 everywhere."""
    opaque = bool((pixels[..., 3] == 255).all())
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3]) if opaque else pixels)
    out = BytesIO()
    image.save(out, format="PNG", compress_level=4)  # 6 takes twice as long for 3 % less
    return out.getvalue()
