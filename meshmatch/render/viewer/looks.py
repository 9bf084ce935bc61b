"""Appearance of two shapes on a page: that of one file, on its shape and transferred to the other by the map."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from meshmatch.arrays import Floats
from meshmatch.errors import InputError
from meshmatch.geometry.triangles import same_rows
from meshmatch.maps.vertex_map import VertexMap
from meshmatch.render.viewer.assembly import scaled, small_integers
from meshmatch.render.viewer.drawn_shapes import Drawn
from meshmatch.shapes.appearance import Appearance, Material, Pixels, png_bytes
from meshmatch.shapes.colors import to_srgb
from meshmatch.shapes.shape import Shape
from meshmatch.transfer.bake import BakeOptions, colors_of_vertices, transfer_texture
from meshmatch.transfer.unwrap import atlas_of

Arrays = dict[str, NDArray[Any]]
TEXELS = 1024
"""Width and height of a texture that is baked for a page."""
MAX_FACES = 40_000
"""A finer mesh gets vertex colors instead: they show nearly as much, and unwrapping it would take a minute."""
MAX_SIDE = 2048
"""Maximum length in pixels of an image's longer side; larger images are reduced."""
MAX_PIXELS = 3 * MAX_SIDE**2
"""Maximum number of pixels of all images of one look together."""
_LOSSLESS_SIZE = 256  # pixels along a side up to which an image is kept without loss: it may be drawn by hand


@dataclass(frozen=True, eq=False)
class Looks:
    """The look of the shape on ``side``, as ``shown`` on both shapes; ``own`` is the other shape's, if its file has one."""

    side: Literal["source", "target"]
    shown: tuple[Appearance, Appearance]
    own: Appearance | None = None

    @property
    def words(self) -> dict[str, Any]:
        """What the page's buttons and legend say, as JSON."""
        textured = self.shown[self.side == "target"].textured
        kind = "texture" if textured else "colors"
        return {"look": {"kind": kind, "side": self.side}, "own": self.own is not None}

    def of(self, k: int) -> list[tuple[str, Appearance]]:
        """The looks of one shape (0 the source, 1 the target), each with its key in the page."""
        found = [("look", self.shown[k])]
        if self.own is not None:
            found.append(("own", self.shown[k] if k == (self.side == "target") else self.own))
        return found


def share_look(
    shapes: tuple[Shape, Shape],
    own: tuple[Appearance | None, Appearance | None],
    there: VertexMap,
    back: VertexMap,
    *,
    coordinates: tuple[Floats | None, Floats | None] = (None, None),
    workers: int = 1,
) -> Looks | None:
    """The source's look on both shapes; the target's if the source has none; None if neither has one.

    ``own`` are the looks of source and target in their files, and ``coordinates`` (F, 3, 2) their texture coordinates, which
    are baked to where they are valid. The maps go from source to target, and from target to source.
    """
    source, target = shapes
    first, second = own
    if first is not None:
        return Looks("source", (first, _transfer_look(first, source, target, back, coordinates[1], workers)), second)
    if second is not None:
        return Looks("target", (_transfer_look(second, target, source, there, coordinates[0], workers), second))
    return None


def _transfer_look(
    look: Appearance, source: Shape, target: Shape, back: VertexMap, coordinates: Floats | None, workers: int
) -> Appearance:
    """The source's look on the target, by a map from target to source: as a baked texture, or as vertex colors."""
    material = np.zeros(target.F, np.int64)
    if look.textured and 0 < target.F <= MAX_FACES:
        options = BakeOptions(size=TEXELS, padding=4, workers=workers)
        try:
            atlas = atlas_of(target, coordinates, options.size, options.padding)
            baked = transfer_texture(source, look, target, back, atlas, options)
        except InputError:  # it has no area, or cannot be unwrapped
            pass
        else:
            baked_material = baked.material
            texture = Material(
                "",
                baked_material.color,
                wrap=("clamp", "clamp"),
                alpha=baked_material.alpha,
                cutoff=baked_material.cutoff,
            )
            return Appearance((texture,), material, atlas.uv)
    colors = colors_of_vertices(source, look, target, back)
    return Appearance((Material(),), material, np.zeros((target.F, 3, 2)), colors)


def look_arrays(look: Appearance, shape: Shape, part: Drawn) -> tuple[Arrays, dict[str, Any] | None]:
    """Arrays and words of a look for the drawn part of a shape.

    A textured mesh if there are several materials or an image, and the triangles are the file's own; else only ``paint``
    (N, 3), a color for each drawn vertex, without words.
    """
    if len(part.file_face) and (look.textured or len(look.materials) > 1):
        return _textured_mesh(look, part)
    if look.textured or len(look.materials) > 1:
        light = colors_of_vertices(shape, look, shape, VertexMap.identity(shape))
    else:
        light = np.asarray(look.materials[0].factor) * (np.ones((shape.V, 4)) if look.colors is None else look.colors)
    return {"paint": scaled(to_srgb(light[part.vertex, :3]), np.uint8)}, None


def _textured_mesh(look: Appearance, part: Drawn) -> tuple[Arrays, dict[str, Any]]:
    """A textured mesh for a page.

    Arrays: ``vertex`` (S,) the drawn row of the shape, ``uv`` (S, 2), ``face`` (M, 3) indices of these S, sorted by
    material; ``paint`` (S, 3) vertex colors to multiply with, if any; ``image0``, ``image1``...: bytes of files. Words:
    ``groups``, the faces of each material, and ``images``, the media types of the files.
    """
    material = look.material[part.file_face]
    order = np.argsort(material, kind="stable")
    corners = part.faces[order].reshape(-1)
    uv = look.uv[part.file_face[order]].reshape(-1, 2).astype(np.float32)
    first = same_rows(np.column_stack([corners.astype(np.float64), uv]))
    own = first == np.arange(len(first))
    number = (np.cumsum(own) - 1)[first]
    arrays: Arrays = {
        "vertex": small_integers(corners[own]),
        "uv": uv[own],
        "face": small_integers(number.reshape(-1, 3)),
    }
    if look.colors is not None:
        arrays["paint"] = scaled(to_srgb(look.colors[corners[own], :3]), np.uint8)
    used, starts, counts = np.unique(material[order], return_index=True, return_counts=True)
    materials = [look.materials[k] for k in used.tolist()]
    pictures = {id(m.image): m.image for m in materials if m.image is not None}
    sizes = [min(1.0, MAX_SIDE / max(image.shape[:2])) ** 2 * image[..., 0].size for image in pictures.values()]
    shrink = min(1.0, float(np.sqrt(MAX_PIXELS / max(sum(sizes), 1.0))))
    kinds = []
    for k, image in enumerate(pictures.values()):
        kind, data = _encoded(image, shrink, all(m.alpha == "opaque" for m in materials if m.image is image))
        arrays[f"image{k}"] = np.frombuffer(data, np.uint8)
        kinds.append(kind)
    groups = [
        {
            "start": 3 * start,
            "count": 3 * count,
            "image": None if m.image is None else list(pictures).index(id(m.image)),
            "factor": [round(float(part), 5) for part in m.factor],
            "wrap": list(m.wrap),
            "nearest": m.nearest,
            "alpha": m.alpha,
            "cutoff": float(m.cutoff),
        }
        for m, start, count in zip(materials, starts.tolist(), counts.tolist(), strict=True)
    ]
    return arrays, {"groups": groups, "images": kinds}


def _encoded(pixels: Pixels, shrink: float, opaque: bool) -> tuple[str, bytes]:
    """Media type and bytes of an image file: PNG if it is small or has alpha, else JPEG."""
    height, width = pixels.shape[:2]
    scale = shrink * min(1.0, MAX_SIDE / max(height, width))
    if opaque:
        pixels = np.concatenate([pixels[..., :3], np.full_like(pixels[..., 3:], 255)], axis=2)
    if scale < 1.0:
        size = max(1, round(width * scale)), max(1, round(height * scale))
        pixels = np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS))
    if not opaque or max(pixels.shape[:2]) <= _LOSSLESS_SIZE:
        return "image/png", png_bytes(pixels)
    out = BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels[..., :3])).save(out, format="JPEG", quality=90)
    return "image/jpeg", out.getvalue()
