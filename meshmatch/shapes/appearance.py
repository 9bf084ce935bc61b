"""Appearance of a surface as its file gives it: texture coordinates, materials with images, vertex colors.

It is separate from `Shape`: few commands need it. Faces and vertices are those of `load_shape`, in the same order.
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

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr, UInts8
from meshmatch.errors import InputError, warn
from meshmatch.shapes.colors import INVISIBLE, srgb_to_linear_alpha
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

Pixels = UInts8
Wrap = Literal["repeat", "clamp", "mirror"]
Alpha = Literal["opaque", "mask", "blend"]
_MAX_UV = 1e6
MAX_PIXELS = 8192 * 8192
"""Maximum number of pixels of one image, a little below the limit of Pillow's own warning."""
MAX_ALL_PIXELS = 2 * MAX_PIXELS
"""Maximum number of pixels of all images of one shape."""
# without a handler Python prints Pillow's messages to stderr
logging.getLogger("PIL").addHandler(logging.NullHandler())
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
_DECODE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, TypeError, IndexError)


@dataclass(frozen=True, eq=False)
class Material:
    """The base color of some faces, an image times a factor; or another map of the surface (`Finish`).

    `image` (H, W, 4) holds sRGB colors, or plain numbers if it is `linear`, and linear alpha; its top row is at v = 0.
    `factor` is linear red, green, blue, and alpha; `strength` scales the effect of the image of a layer. `wrap` says
    what u and v outside 0..1 mean; `nearest` asks for texels that are not interpolated. Alpha is ignored ("opaque"),
    compared with `cutoff` ("mask"), or blended ("blend").
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
    """Properties of a surface besides its color.

    Each layer has materials and coordinates of its own, like the colors: "normal", directions in the tangent frame;
    "surface", with roughness in green and metalness in blue; "occlusion" in red; "glow", emitted light, in units of
    `light`. A missing layer is not specified by the file.
    """

    layers: Mapping[Layer, Appearance]
    light: float = 1.0
    double_sided: bool = True
    unlit: bool = False

    @property
    def occluded(self) -> bool:
        """Whether there is an occlusion image."""
        return "occlusion" in self.layers and self.layers["occlusion"].textured

    @property
    def even(self) -> bool:
        """Whether roughness and metalness are constant over the surface."""
        return "surface" in self.layers and self.layers["surface"].plain

    @property
    def images(self) -> tuple[Layer, ...]:
        """The layers that need an image when they are baked; occlusion shares that of the surface."""
        needed: dict[Layer, bool] = {
            "normal": "normal" in self.layers and self.layers["normal"].textured,
            "surface": "surface" in self.layers and (self.occluded or not self.even),
            "glow": "glow" in self.layers and not self.layers["glow"].plain,
        }
        return tuple(layer for layer, is_needed in needed.items() if is_needed)


@dataclass(frozen=True, eq=False)
class BakedMaterial:
    """One material for a whole surface; its images share one set of texture coordinates.

    Attributes
    ----------
    color
        (H, W, 4) sRGB colors and linear alpha, which is used as ``alpha`` and ``cutoff`` say, see `Material`.
    name
        Of the material.
    double_sided
        Whether faces are visible from both sides.
    unlit
        Whether the color is shown without lighting.
    normal
        (H, W, 4) directions in the tangent frame, as in glTF: red along u, green against v, blue outwards.
    surface
        (H, W, 4): red is occlusion if ``occluded``, green roughness, blue metalness.
    even
        Whether roughness and metalness are constant, so that the image holds occlusion alone.
    roughness
        In 0..1; multiplies the image, if it holds roughness.
    metal
        Metalness in 0..1; multiplies the image, if it holds metalness.
    glow
        (H, W, 4) sRGB colors of the emitted light.
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
        """The layers that an obj has images for; it cannot hold occlusion."""
        surface = None if self.even else self.surface
        shown: dict[Layer, Pixels | None] = {"normal": self.normal, "surface": surface, "glow": self.glow}
        return tuple(layer for layer, image in shown.items() if image is not None)


@dataclass(frozen=True, eq=False, repr=False)
class Appearance(ShortRepr):
    """The appearance of the faces of one shape.

    There is at least one material; each face has one. `uv` are the texture coordinates of each corner: u to the right,
    v *down*, as in glTF, after the texture transforms of the file; zeros for materials without an image. `colors` are
    linear color and alpha of each vertex, multiplied with the materials. `finish` holds the other properties of the
    materials, if requested.

    `InputError` for a coordinate that is not finite or absurdly large on a face with an image.
    """

    materials: tuple[Material, ...]
    material: Int[Ints, " F"]
    uv: Float[Floats, "F 3 2"]
    colors: Float[Floats, "V 4"] | None = None
    finish: Finish | None = None

    def __post_init__(self) -> None:
        has_image = np.array([m.image is not None for m in self.materials])[self.material]
        is_valid = (np.abs(self.uv[has_image]) < _MAX_UV).all(axis=(1, 2))
        if not is_valid.all():
            problem = f"the texture coordinates of {len(is_valid) - int(is_valid.sum())} faces are out of range"
            hint = "unwrap the source again, or export it again"
            raise InputError(f"{problem} (not a number, or over a million)", hint)

    @property
    def textured(self) -> bool:
        """Whether any face has an image."""
        return any(self.materials[k].image is not None for k in np.unique(self.material).tolist())

    @property
    def plain(self) -> bool:
        """Whether the whole surface has one color, without images or vertex colors."""
        factors = {self.materials[k].factor for k in np.unique(self.material).tolist()}
        layers = () if self.finish is None else self.finish.layers.values()
        is_one_color = not self.textured and self.colors is None and len(factors) <= 1
        return is_one_color and not any(layer.textured for layer in layers)


def make_visible(look: Appearance, name: str) -> Appearance:
    """The appearance, with wholly transparent materials made opaque; issues a `MeshmatchWarning` that names them.

    Such materials are never intended: many programs write the opacity as transparency, or 0 where they support neither.
    """
    materials, hidden = list(look.materials), []
    for number in np.unique(look.material).tolist():
        material = opaque_if_hidden(materials[number])
        if material is not materials[number]:
            hidden.append(material.name or "without a name")
            materials[number] = material
    if not hidden:
        return look
    listed = ", ".join(dict.fromkeys(hidden[:5])) + (", ..." if len(hidden) > 5 else "")
    subject = (
        f"the material {listed} of {name} is"
        if len(hidden) == 1
        else f"{len(hidden)} materials of {name} ({listed}) are"
    )
    warn(f"{subject} wholly transparent; taken as opaque")
    return replace(look, materials=tuple(materials))


def opaque_if_hidden(material: Material) -> Material:
    """The material, or if it would be invisible an opaque one; a mask in its image's alpha is kept."""
    if material.alpha == "opaque":
        return material
    max_alpha = 1.0 if material.image is None else float(material.image[..., 3].max(initial=0)) / 255.0
    min_visible = INVISIBLE if material.alpha == "blend" else min(material.cutoff, 1.0)
    if material.factor[3] * max_alpha >= min_visible:
        return material
    solid = replace(material, factor=(*material.factor[:3], 1.0))
    if max_alpha < min_visible or material.image is None or bool((material.image[..., 3] == 255).all()):
        return replace(solid, alpha="opaque")
    return solid


def vertex_colors_alone(shape: Shape) -> Appearance:
    """The appearance of a shape with vertex colors only (sRGB, as in ply, obj and off files)."""
    colors = None if shape.colors is None else srgb_to_linear_alpha(shape.colors)
    alpha: Alpha = "blend" if colors is not None and (colors[:, 3] < 1).any() else "opaque"
    return Appearance((Material(alpha=alpha),), np.zeros(shape.F, np.int64), np.zeros((shape.F, 3, 2)), colors)


def no_coordinates(name: str) -> InputError:
    """The error for an image without texture coordinates."""
    what = f"{name} has no texture coordinates: no image can be mapped onto it"
    return InputError(what, "unwrap it, or leave out --image and use its vertex colors")


class ImageReader:
    """Decodes the images of one shape, and limits their total number of pixels: a small file can expand to gigabytes."""

    def __init__(self) -> None:
        self.left = MAX_ALL_PIXELS
        self._known: dict[Path, Pixels] = {}

    def read(self, file: Path) -> Pixels:
        """`decode` a file; cached, because many materials may refer to one image."""
        if file not in self._known:
            self._known[file] = self.decode(read_bytes(file), file.name)
        return self._known[file]

    def decode(self, data: bytes, label: str) -> Pixels:
        """Decode a png, jpeg, webp, bmp, tga or tiff to (H, W, 4) red, green, blue, alpha, top row first.

        `InputError` if the image is damaged, too large, or of another format.
        """
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # sizes are checked below; other warnings concern metadata
                with Image.open(BytesIO(data), formats=_FORMATS) as image:
                    size = f"{image.width} x {image.height} pixels"
                    if image.width * image.height > MAX_PIXELS:
                        raise _too_large(label, size)
                    self.left -= image.width * image.height
                    if self.left < 0:
                        raise _too_large(label, f"{size}, and the others before it nearly as many")
                    with _suppress_stderr() if image.format == "TIFF" else nullcontext():
                        return _rgba(image)
        except Image.DecompressionBombError as error:
            raise _too_large(label, "over 179 million pixels") from error
        except UnidentifiedImageError as error:
            raise InputError(f"{label} cannot be read as an image", "save it as png or jpg") from error
        except _DECODE_ERRORS as error:
            what = (str(error) or type(error).__name__).strip().splitlines()[0][:80]
            raise InputError(f"{label} is a damaged image ({what})", "export it or copy it again") from error


@contextmanager
def _suppress_stderr() -> Iterator[None]:
    """Suppress output to stderr: libtiff, a C library, reports errors in files there."""
    try:
        saved = os.dup(2)
    except OSError:  # stderr is closed
        yield
        return
    try:
        with open(os.devnull, "wb") as devnull:
            os.dup2(devnull.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


def _rgba(image: Image.Image) -> Pixels:
    """(H, W, 4) 8-bit pixels of an image in any mode."""
    if image.mode.startswith("I") or image.mode == "F":  # 16-bit grey, which Pillow would clip
        gray = np.asarray(image).astype(np.float64)
        maximum = 65535.0 if image.mode.startswith("I") else 1.0
        byte = np.round(255 * np.clip(np.nan_to_num(gray) / maximum, 0, 1)).astype(np.uint8)
        return np.stack([byte, byte, byte, np.full_like(byte, 255)], axis=-1)
    return np.array(image.convert("RGBA"))


def _too_large(label: str, what: str) -> InputError:
    side = int(MAX_PIXELS**0.5)
    return InputError(f"{label} is too large: {what}", f"make it smaller: at most {side} x {side} pixels")


def png_bytes(pixels: Pixels) -> bytes:
    """Encode (H, W, 4) pixels as PNG; without the alpha channel if it is 255 everywhere."""
    opaque = bool((pixels[..., 3] == 255).all())
    image = Image.fromarray(np.ascontiguousarray(pixels[..., :3]) if opaque else pixels)
    out = BytesIO()
    image.save(out, format="PNG", compress_level=4)  # level 6 takes twice as long for 3 % less
    return out.getvalue()
