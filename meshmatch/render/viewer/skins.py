"""Textures in a page: triangles that know their texture coordinates, and images within bounds."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from meshmatch.arrays import Ints
from meshmatch.geometry.topology import same_rows
from meshmatch.render.viewer.packing import small_integers, to_bytes
from meshmatch.shapes.appearance import Appearance, Material, Pixels, png_bytes
from meshmatch.shapes.colors import to_srgb

LARGEST = 2048
"""Pixels along an image's longer side; a larger one is made smaller."""
MOST_PIXELS = 3 * LARGEST**2
"""Of all images of one look together."""
_DRAWN = 256  # pixels along a side up to which an image is kept without loss: it may be drawn by hand


@dataclass(frozen=True, eq=False)
class Skin:
    """A textured surface as the page has it.

    Parameters
    ----------
    arrays : dict
        ``vertex`` (S,): row of the shape that is drawn, ``uv`` (S, 2), ``face`` (M, 3) of these S, by material;
        ``paint`` (S, 3) where vertex colours are to be multiplied; ``image0``, ``image1``...: bytes of files.
    words : dict
        ``groups``: which faces have which material; ``images``: the kinds of the files.
    """

    arrays: dict[str, NDArray[Any]]
    words: dict[str, Any]


def make_skin(look: Appearance, faces: Ints, file_face: Ints) -> Skin:
    """The skin of the triangles ``faces`` (M, 3), which are the faces ``file_face`` (M,) of the file."""
    material = look.material[file_face]
    order = np.argsort(material, kind="stable")
    corners = faces[order].reshape(-1)
    uv = look.uv[file_face[order]].reshape(-1, 2).astype(np.float32)
    first = same_rows(np.column_stack([corners.astype(np.float64), uv]))
    own = first == np.arange(len(first))
    number = (np.cumsum(own) - 1)[first]
    arrays: dict[str, NDArray[Any]] = {
        "vertex": small_integers(corners[own]),
        "uv": uv[own],
        "face": small_integers(number.reshape(-1, 3)),
    }
    if look.colors is not None:
        arrays["paint"] = to_bytes(to_srgb(look.colors[corners[own], :3]))
    used, start, count = np.unique(material[order], return_index=True, return_counts=True)
    materials = [look.materials[k] for k in used.tolist()]
    pictures = {id(m.image): m.image for m in materials if m.image is not None}
    shrink = _shrink(list(pictures.values()))
    kinds, place = [], {}
    for k, (key, image) in enumerate(pictures.items()):
        opaque = all(m.alpha == "opaque" for m in materials if m.image is image)
        kind, data = _encoded(image, shrink, opaque)
        arrays[f"image{k}"] = np.frombuffer(data, np.uint8)
        kinds.append(kind)
        place[key] = k
    groups = [
        _group(m, 3 * int(begin), 3 * int(many), None if m.image is None else place[id(m.image)])
        for m, begin, many in zip(materials, start, count, strict=True)
    ]
    return Skin(arrays, {"groups": groups, "images": kinds})


def _group(material: Material, start: int, count: int, image: int | None) -> dict[str, Any]:
    return {
        "start": start,
        "count": count,
        "image": image,
        "factor": [round(float(part), 5) for part in material.factor],
        "wrap": list(material.wrap),
        "nearest": material.nearest,
        "alpha": material.alpha,
        "cutoff": float(material.cutoff),
    }


def _shrink(images: list[Pixels]) -> float:
    """By how much every image is made smaller so that all of them stay within `MOST_PIXELS`."""
    sizes = [min(1.0, LARGEST / max(image.shape[:2])) ** 2 * image.shape[0] * image.shape[1] for image in images]
    return min(1.0, float(np.sqrt(MOST_PIXELS / max(sum(sizes), 1.0))))


def _encoded(pixels: Pixels, shrink: float, opaque: bool) -> tuple[str, bytes]:
    """Media type and bytes of an image file: PNG where it is small or has alpha, else JPEG."""
    height, width = pixels.shape[:2]
    scale = shrink * min(1.0, LARGEST / max(height, width))
    if opaque:
        pixels = np.concatenate([pixels[..., :3], np.full_like(pixels[..., 3:], 255)], axis=2)
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        pixels = np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS))
    if not opaque or max(pixels.shape[:2]) <= _DRAWN:
        return "image/png", png_bytes(pixels)
    out = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels[..., :3])).save(out, format="JPEG", quality=90)
    return "image/jpeg", out.getvalue()
