"""Read the appearance of files: materials and images of glb, gltf, obj and ply, vertex colors of all other formats."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from meshmatch import blender
from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError, OptionError
from meshmatch.shapes import appearance
from meshmatch.shapes.appearance import Appearance, ImageReader, Layer
from meshmatch.shapes.formats import gltf, gltf_attributes, gltf_layers, obj_appearance, ply_appearance
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

TEXTURED_SUFFIXES = (".glb", ".obj", ".vrm")
_FINISHES = dict.fromkeys(gltf.SUFFIXES, gltf_layers.read_finish) | {".obj": obj_appearance.read_finish}
_LAYER_IMAGES: dict[Layer, tuple[str, ...]] = {
    "normal": ("normal",),
    "surface": ("roughness", "metal"),
    "glow": ("emission",),
}
_READERS = {  # readers of appearances, and of texture coordinates alone
    **dict.fromkeys(gltf.SUFFIXES, (gltf_attributes.read_appearance, gltf_attributes.read_coordinates)),
    ".obj": (obj_appearance.read_appearance, obj_appearance.read_coordinates),
    ".ply": (ply_appearance.read_appearance, ply_appearance.read_coordinates),
}


def load_appearance(path: str | Path, shape: Shape, image: str | Path | None = None) -> Appearance:
    """Read the appearance of a file.

    glb and gltf: materials with their images and factors, samplers, texture transforms, vertex colors. obj: Kd, map_Kd,
    d and map_d of its mtl, which is in the same folder. ply: images named in comments, in the same folder, or else
    vertex colors. Other formats: vertex colors.

    `shape` is the result of `load_shape` for the same file; `image` is a picture that replaces the images of the file,
    or is used if the file names none. `InputError`: an image or material file is missing, damaged, too large, or
    outside the file's folder; there are no texture coordinates for `image`; or the file has no appearance.
    """
    look = find_appearance(path, shape, image, finished=True)
    if look is None:
        nothing = f"{Path(path).name} has no texture and no vertex colors: there is nothing to transfer"
        hint = "name a picture for its texture coordinates with --image, or export it with its materials"
        raise InputError(nothing, hint)
    return look


def find_appearance(
    path: str | Path, shape: Shape, image: str | Path | None = None, finished: bool = False, plain: bool = False
) -> Appearance | None:
    """As `load_appearance`, but None if the file has no appearance.

    ``finished`` also reads the `Finish`; ``plain`` also returns appearances of a single color.
    """
    path = Path(path)
    suffix, reader = path.suffix.lower(), ImageReader()
    picture = None if image is None else reader.read(Path(image))
    if suffix in _READERS:
        with np.errstate(invalid="ignore", over="ignore"):  # coordinates are judged by the appearance
            look = _READERS[suffix][0](path, read_bytes(path), shape, reader, picture)
    elif picture is not None:
        raise appearance.no_coordinates(path.name)
    else:
        look = appearance.vertex_colors_alone(shape)
    if len(look.material) != shape.F or (look.colors is not None and len(look.colors) != shape.V):
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    if finished and suffix in _FINISHES:
        look = replace(look, finish=_FINISHES[suffix](path, read_bytes(path), shape, reader))
    return None if look.plain and not plain else appearance.make_visible(look, path.name)


def load_coordinates(path: str | Path, shape: Shape) -> Float[Floats, "F 3 2"] | None:
    """Texture coordinates of every corner, v down, regardless of materials; None if any face has none.

    `shape` is the result of `load_shape` for the same file; `InputError` if that is damaged.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    coordinates = _READERS[suffix][1](path, read_bytes(path), shape) if suffix in _READERS else None
    if coordinates is not None and len(coordinates) != shape.F:
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    return coordinates if shape.F else None


def output_files(path: Path, layers: Collection[Layer] = (), tiles: Iterable[int | str] = ()) -> list[Path]:
    """The files of an output: an obj has an mtl, and images for each map of these layers and each tile (UDIM)."""
    if path.suffix.lower() != ".obj":
        return [path]
    shown = [word for layer in layers for word in _LAYER_IMAGES.get(layer, ())]
    images = [image_file(path, word) for word in ("color", *shown)]
    return [
        path,
        path.with_suffix(".mtl"),
        *(tile_file(image, tile) for tile in list(tiles) or [""] for image in images),
    ]


def image_file(path: Path, word: str) -> Path:
    """The image of an output for one map: "color", "normal", "roughness", "metal" or "emission"."""
    return path.with_suffix(".png") if word == "color" else path.with_name(f"{path.stem}-{word}.png")


def tile_file(image: Path, tile: int | str) -> Path:
    """The file name for one tile of an image; the image itself without a tile."""
    return image.with_name(f"{image.stem}.{tile}{image.suffix}") if tile else image


def check_textured(path: Path, colored: tuple[str, ...] = ()) -> None:
    """`OptionError` for a suffix that can hold neither textures nor, if it is in `colored`, vertex colors."""
    if blender.is_converted(path):
        blender.check_written(path)
    elif path.suffix.lower() not in (*TEXTURED_SUFFIXES, *colored):
        hint = f", or in {' or '.join(colored)} for vertex colors" if colored else ""
        unknown = f"{path.name}: cannot write a texture as {path.suffix or '(no suffix)'}"
        raise OptionError(unknown, f"end the name in {' or '.join(TEXTURED_SUFFIXES)}{hint}")
