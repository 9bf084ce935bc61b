"""Appearances from files: materials and images of glb, gltf, obj and ply, vertex colors of all others."""

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
from meshmatch.shapes.formats import gltf, gltf_attributes, gltf_finish, obj_look, ply_look
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

TEXTURED_SUFFIXES = (".glb", ".obj", ".vrm")
_FINISHES = dict.fromkeys(gltf.SUFFIXES, gltf_finish.read_finish) | {".obj": obj_look.read_finish}
_SHOWN: dict[Layer, tuple[str, ...]] = {"normal": ("normal",), "surface": ("roughness", "metal"), "glow": ("emission",)}
_READERS = {  # of the look, and of texture coordinates alone
    **dict.fromkeys(gltf.SUFFIXES, (gltf_attributes.read_look, gltf_attributes.read_coordinates)),
    ".obj": (obj_look.read_look, obj_look.read_coordinates),
    ".ply": (ply_look.read_look, ply_look.read_coordinates),
}


def load_appearance(path: str | Path, shape: Shape, image: str | Path | None = None) -> Appearance:
    """What a file says about the look of its surface.

    glb and gltf: materials with their images and factors, samplers, texture transforms, vertex colors.
    obj: its mtl with Kd, map_Kd, d and map_d, beside it. ply: the images that its comments name, beside it, or else vertex
    colors. Everything else: vertex colors.

    `shape` is what `load_shape` made of the same file; `image` a picture that takes the place of those that the file
    names, or that it fails to name. `InputError`: an image or material file is missing, damaged, too large, or outside
    the file's folder; there are no texture coordinates for `image`; or the file has no look at all.
    """
    found = find_appearance(path, shape, image, finished=True)
    if found is None:
        nothing = f"{Path(path).name} has no texture and no vertex colors: there is nothing to transfer"
        hint = "name a picture for its texture coordinates with --image, or export it with its materials"
        raise InputError(nothing, hint)
    return found


def find_appearance(
    path: str | Path, shape: Shape, image: str | Path | None = None, finished: bool = False, plain: bool = False
) -> Appearance | None:
    """As `load_appearance`, but None where the file has no look at all, unless ``plain`` looks of one color are wanted too;
    and with a finish only if that is asked for.
    """
    path = Path(path)
    suffix, reader = path.suffix.lower(), ImageReader()
    picture = None if image is None else reader.read(Path(image))
    if suffix in _READERS:
        with np.errstate(invalid="ignore", over="ignore"):  # coordinates are judged by the appearance
            found = _READERS[suffix][0](path, read_bytes(path), shape, reader, picture)
    elif picture is not None:
        raise appearance.no_coordinates(path.name)
    else:
        found = appearance.vertex_colors_alone(shape)
    if len(found.material) != shape.F or (found.colors is not None and len(found.colors) != shape.V):
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    if finished and suffix in _FINISHES:
        found = replace(found, finish=_FINISHES[suffix](path, read_bytes(path), shape, reader))
    return None if found.plain and not plain else appearance.visible(found, path.name)


def load_coordinates(path: str | Path, shape: Shape) -> Float[Floats, "F 3 2"] | None:
    """Texture coordinates of every corner, v down, whatever the materials say; None where a face has none.

    `shape` is what `load_shape` made of the same file; `InputError` if that is damaged.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    found = _READERS[suffix][1](path, read_bytes(path), shape) if suffix in _READERS else None
    if found is not None and len(found) != shape.F:
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    return found if shape.F else None


def files_of(path: Path, layers: Collection[Layer] = (), tiles: Iterable[int | str] = ()) -> list[Path]:
    """What will be written for an output: an obj has companions, more of them with images of these layers, and one of each
    for every tile (UDIM).
    """
    if path.suffix.lower() != ".obj":
        return [path]
    shown = [word for layer in layers for word in _SHOWN.get(layer, ())]
    images = [image_file(path, word) for word in ("color", *shown)]
    return [
        path,
        path.with_suffix(".mtl"),
        *(tile_file(image, tile) for tile in list(tiles) or [""] for image in images),
    ]


def image_file(path: Path, word: str) -> Path:
    """The image beside an output that shows what a word says."""
    return path.with_suffix(".png") if word == "color" else path.with_name(f"{path.stem}-{word}.png")


def tile_file(image: Path, tile: int | str) -> Path:
    """The name of an image of one tile; without a tile, its own."""
    return image.with_name(f"{image.stem}.{tile}{image.suffix}") if tile else image


def check_textured(path: Path, colored: tuple[str, ...] = ()) -> None:
    """Refuse a suffix that holds no texture (`OptionError`), nor is one of those `colored` by vertex."""
    if blender.is_converted(path):
        blender.check_written(path)
    elif path.suffix.lower() not in (*TEXTURED_SUFFIXES, *colored):
        hint = f", or in {' or '.join(colored)} for vertex colors" if colored else ""
        unknown = f"{path.name}: cannot write a texture as {path.suffix or '(no suffix)'}"
        raise OptionError(unknown, f"end the name in {' or '.join(TEXTURED_SUFFIXES)}{hint}")
