"""Appearances out of files: materials and images of glb, gltf and obj, vertex colours of all others."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats
from meshmatch.errors import InputError
from meshmatch.shapes.appearance import Appearance, no_coordinates, vertex_colors_alone
from meshmatch.shapes.formats import gltf_look, obj_look
from meshmatch.shapes.images import ImageReader, Pixels
from meshmatch.shapes.paths import read_bytes
from meshmatch.shapes.shape import Shape


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
    with np.errstate(invalid="ignore", over="ignore"):  # coordinates are judged by the appearance
        found = _read(path, shape, reader, picture)
    if len(found.material) != shape.F or (found.colors is not None and len(found.colors) != shape.V):
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    return None if found.plain else found


def load_coordinates(path: str | Path, shape: Shape) -> Float[Floats, "F 3 2"] | None:
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
        found = gltf_look.read_coordinates(path, read_bytes(path))
    elif path.suffix.lower() == ".obj":
        found = obj_look.read_coordinates(path, read_bytes(path))
    if found is not None and len(found) != shape.F:
        raise InputError(f"{path.name} is not the file that {shape.name or 'the shape'} was read from")
    return found if shape.F else None


def _read(path: Path, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        return gltf_look.read_look(path, read_bytes(path), reader, picture)
    if suffix == ".obj":
        return obj_look.read_look(path, read_bytes(path), shape, reader, picture)
    if picture is not None:
        raise no_coordinates(path.name)
    return vertex_colors_alone(shape)
