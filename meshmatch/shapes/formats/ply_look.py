"""The look of PLY files: texture coordinates of corners or vertices, and the images that comments of the header name.

There is no standard. This is what MeshLab writes, and most scanners' programs after it: ``comment TextureFile a.png``, one
for each image; on each face a list ``texcoord`` of u and v (up) of its corners, and ``texnumber``, which image it has. Or
each vertex has its u and v, under one of several names.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes import appearance
from meshmatch.shapes.appearance import Appearance, ImageReader, Material, Pixels
from meshmatch.shapes.companions import beside
from meshmatch.shapes.formats import damaged
from meshmatch.shapes.formats.ply import Content, corners_of, faces_of, parsed
from meshmatch.shapes.formats.ply_rows import Element
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.shape import Shape

_TEXTURE = re.compile(r"texture[ _]?file\b\s*[:=]?\s*(.+)|texture\b\s*[:=]?\s*(.+\.\w{3,4})", re.IGNORECASE)
_LISTS = ("texcoord", "texcoords", "texturecoords", "texturecoordinates", "textureuv", "uv", "uvs", "st")
_COORDINATE = re.compile(r"(?:tex(?:ture)?(?:coord(?:inate)?s?)?|uv|tc)(?:0(?=.))?([uvstxy012])|([uvst]|t[uvxy])0?")
_PAIRS = ("uv", "st", "xy", "01", "12")
_NUMBERS = ("texnumber", "textureid", "textureindex", "texindex")


def read_look(path: Path, data: bytes, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Images and texture coordinates, face by face in the order of `ply.read`; `picture` replaces all images.

    Without either, the vertex colors.
    """
    content = parsed(path.name, data)
    uv, laid, number = _coordinates(path.name, content, shape)
    names = [(found[1] or found[2]).strip() for comment in content.comments if (found := _TEXTURE.match(comment))]
    if picture is not None:
        if not laid.any():
            raise appearance.no_coordinates(path.name)
        number, names = np.zeros_like(number), [""]
    elif names and not laid.any():
        warn(f"{path.name} names the image {names[0][:200]}, but no texture coordinates by a name that is known")
    laid &= (number >= 0) & (number < len(names))
    if not laid.any():
        return appearance.vertex_colors_alone(shape)
    used, kind = np.unique(np.where(laid, number, -1), return_inverse=True)
    materials = []
    for each in used.tolist():
        image = None if each < 0 else picture if picture is not None else _image(path, names[each], reader, shape)
        if each >= 0 and image is None:
            return appearance.vertex_colors_alone(shape)
        clear = image is not None and bool((image[..., 3] < 255).any())
        materials.append(Material(names[each] if each >= 0 else "", image, alpha="blend" if clear else "opaque"))
    uv[~laid] = 0.0
    return Appearance(tuple(materials), kind.reshape(-1).astype(np.int64), uv)


def read_coordinates(path: Path, data: bytes, shape: Shape) -> Float[Floats, "F 3 2"] | None:
    """Texture coordinates of all faces, v down; None where a face has none. `shape` is of the same file."""
    uv, laid, _ = _coordinates(path.name, parsed(path.name, data), shape)
    return uv if laid.all() else None


def _image(path: Path, name: str, reader: ImageReader, shape: Shape) -> Pixels | None:
    """The image of a name; None if it is not there, and the vertices have colors to show instead."""
    file = beside(path.parent, name)
    if file is not None:
        return reader.read(file)
    missing = f"{path.name} needs the image {name[:200]}, which is not there"
    if shape.colors is None:
        raise InputError(missing, f"copy it to {path.parent}, or name another with --image")
    warn(f"{missing}: its vertex colors are taken instead")
    return None


def _coordinates(name: str, content: Content, shape: Shape) -> tuple[Floats, Bools, Ints]:
    """(F, 3, 2) coordinates with v down, (F,) whether a face has them, and (F,) the number of its image."""
    own = _of_vertices(content.vertices)
    uvs, laid, numbers = [np.empty((0, 3, 2))], [np.empty(0, bool)], [np.empty(0, np.int64)]
    for face in content.faces:
        corners, sizes = corners_of(name, face)
        triangles = triangles_of(name, shape.verts_or_nan, corners, sizes)
        of_corners = _of_corners(name, face, sizes)
        polygon = np.repeat(np.arange(len(sizes)), sizes)[triangles[:, 0]]
        if of_corners is not None:
            uvs.append(of_corners[0][triangles])
            laid.append(of_corners[1][polygon])
        else:
            uvs.append(_at(own, corners[triangles]))
            laid.append(np.full(len(triangles), own is not None))
        chosen = next((p.name for p in face.properties if _plain(p.name) in _NUMBERS and not p.count_kind), None)
        number = np.zeros(len(sizes), np.int64) if chosen is None else _whole(face.table[chosen])
        numbers.append(number[polygon])
    for strip in content.strips:
        triangles = faces_of(*corners_of(name, strip))
        uvs.append(_at(own, triangles))
        laid.append(np.full(len(triangles), own is not None))
        numbers.append(np.zeros(len(triangles), np.int64))
    uv = np.concatenate(uvs)
    uv[..., 1] = 1.0 - uv[..., 1]
    return uv, np.concatenate(laid), np.concatenate(numbers)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "")


def _whole(values: Floats | Ints) -> Ints:
    """Numbers of images; -1 for what is none."""
    values = np.asarray(values, np.float64)
    return np.where(np.abs(values) < 2**31, np.nan_to_num(values, posinf=0.0, neginf=0.0), -1).astype(np.int64)


def _of_vertices(element: Element) -> Floats | None:
    """(V, 2) coordinates, v up, of the vertices; None if they have none."""
    known: dict[str, dict[str, str]] = {}  # what a name begins with, its axis, the name itself
    for p in element.properties:
        if not p.count_kind and (found := _COORDINATE.fullmatch(_plain(p.name))):
            axis = (found[1] or found[2])[-1]
            known.setdefault(found[0].removesuffix("0" if found[2] else "")[:-1], {})[axis] = p.name
    for pair in _PAIRS:
        for names in known.values():
            if set(pair) <= set(names):
                return np.stack([element.table[names[axis]].astype(np.float64) for axis in pair], axis=1)
    return None


def _at(own: Floats | None, faces: Ints) -> Floats:
    if own is None:
        return np.zeros((len(faces), 3, 2))
    return np.asarray(own[np.clip(faces, 0, len(own) - 1)])  # a face of no vertex is judged by the shape


def _of_corners(name: str, face: Element, sizes: Ints) -> tuple[Floats, Bools] | None:
    """(N, 2) coordinates, v up, of the corners of all polygons, and (P,) which polygons have them; None if none has."""
    chosen = next((p.name for p in face.properties if p.count_kind and _plain(p.name) in _LISTS), None)
    if chosen is None:
        return None
    values, many = face.table[chosen]
    fine = many == 2 * sizes
    if not fine.any():
        return None
    if not (fine | (many == 0)).all():
        raise damaged(name, f"a face has other than two texture coordinates ({chosen}) for each corner")
    uv = np.zeros((int(sizes.sum()), 2))
    uv[np.repeat(fine, sizes)] = np.asarray(values, np.float64).reshape(-1, 2)
    return uv, fine
