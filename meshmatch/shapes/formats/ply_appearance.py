"""Read the appearance of PLY files: texture coordinates of corners or vertices, and images named in header comments.

There is no standard. This module follows MeshLab, as most scanning software does: ``comment TextureFile a.png``, one per
image; on each face a list ``texcoord`` of u and v (up) of its corners, and ``texnumber``, the index of its image.
Alternatively, each vertex has its u and v, under one of several names.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes import appearance
from meshmatch.shapes.appearance import Appearance, ImageReader, Material, Pixels
from meshmatch.shapes.companions import find_companion
from meshmatch.shapes.formats import damaged
from meshmatch.shapes.formats.ply import Content, corners_of, parsed, strip_triangles
from meshmatch.shapes.formats.ply_rows import Element
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.shape import Shape

_TEXTURE = re.compile(r"texture[ _]?file\b\s*[:=]?\s*(.+)|texture\b\s*[:=]?\s*(.+\.\w{3,4})", re.IGNORECASE)
_UV_LISTS = ("texcoord", "texcoords", "texturecoords", "texturecoordinates", "textureuv", "uv", "uvs", "st")
_COORDINATE = re.compile(r"(?:tex(?:ture)?(?:coord(?:inate)?s?)?|uv|tc)(?:0(?=.))?([uvstxy012])|([uvst]|t[uvxy])0?")
_AXIS_PAIRS = ("uv", "st", "xy", "01", "12")
_IMAGE_INDICES = ("texnumber", "textureid", "textureindex", "texindex")


def read_appearance(path: Path, data: bytes, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Read images and texture coordinates per face, in the order of `ply.read`; `picture` replaces all images.

    Falls back to vertex colors if the images or the coordinates are missing.
    """
    content = parsed(path.name, data)
    uv, has_uv, image_index = _coordinates(path.name, content, shape)
    names = _image_names(content)
    if picture is not None:
        if not has_uv.any():
            raise appearance.no_coordinates(path.name)
        image_index, names = np.zeros_like(image_index), [""]
    elif names and not has_uv.any():
        warn(f"{path.name} names the image {names[0][:200]}, but has no texture coordinates under a known name")
    has_uv &= (image_index >= 0) & (image_index < len(names))
    if not has_uv.any():
        return appearance.vertex_colors_alone(shape)
    used_images, material_index = np.unique(np.where(has_uv, image_index, -1), return_inverse=True)
    materials = []
    for each in used_images.tolist():
        image = None if each < 0 else picture if picture is not None else _image(path, names[each], reader, shape)
        if each >= 0 and image is None:
            return appearance.vertex_colors_alone(shape)
        is_transparent = image is not None and bool((image[..., 3] < 255).any())
        materials.append(
            Material(names[each] if each >= 0 else "", image, alpha="blend" if is_transparent else "opaque")
        )
    uv[~has_uv] = 0.0
    return Appearance(tuple(materials), material_index.reshape(-1).astype(np.int64), uv)


def read_coordinates(path: Path, data: bytes, shape: Shape) -> Float[Floats, "F 3 2"] | None:
    """Read texture coordinates of all faces, v down; None if any face has none. `shape` is read from the same file."""
    uv, has_uv, _ = _coordinates(path.name, parsed(path.name, data), shape)
    return uv if has_uv.all() else None


def companions(path: Path, data: bytes) -> tuple[list[Path], list[str]]:
    """Find the images that a ply names, in its folder or below it. Returns them, and the names without a file."""
    files = {name: find_companion(path.parent, name) for name in _image_names(parsed(path.name, data))}
    found = dict.fromkeys(file for file in files.values() if file is not None)
    return list(found), [name for name, file in files.items() if file is None]


def _image_names(content: Content) -> list[str]:
    """Names of images in header comments."""
    return [(found[1] or found[2]).strip() for comment in content.comments if (found := _TEXTURE.match(comment))]


def _image(path: Path, name: str, reader: ImageReader, shape: Shape) -> Pixels | None:
    """Read an image by file name; if it is missing, None with a warning if there are vertex colors, else `InputError`."""
    file = find_companion(path.parent, name)
    if file is not None:
        return reader.read(file)
    missing = f"{path.name} needs the image {name[:200]}, which is not there"
    if shape.colors is None:
        raise InputError(missing, f"copy it to {path.parent}, or name another with --image")
    warn(f"{missing}: its vertex colors are used instead")
    return None


def _coordinates(name: str, content: Content, shape: Shape) -> tuple[Floats, Bools, Ints]:
    """Return (F, 3, 2) coordinates with v down, (F,) whether a face has them, and (F,) the index of its image."""
    vertex_uv = _vertex_uv(content.vertices)
    uvs, has_uv, image_indices = [np.empty((0, 3, 2))], [np.empty(0, bool)], [np.empty(0, np.int64)]
    for face in content.faces:
        corners, sizes = corners_of(name, face)
        triangles = triangles_of(name, shape.verts_or_nan, corners, sizes)
        corner_uv = _corner_uv(name, face, sizes)
        polygon = np.repeat(np.arange(len(sizes)), sizes)[triangles[:, 0]]
        if corner_uv is not None:
            uvs.append(corner_uv[0][triangles])
            has_uv.append(corner_uv[1][polygon])
        else:
            uvs.append(_uv_of_faces(vertex_uv, corners[triangles]))
            has_uv.append(np.full(len(triangles), vertex_uv is not None))
        index_property = next(
            (p.name for p in face.properties if _normalized(p.name) in _IMAGE_INDICES and not p.count_kind), None
        )
        image_index = (
            np.zeros(len(sizes), np.int64) if index_property is None else _image_indices(face.table[index_property])
        )
        image_indices.append(image_index[polygon])
    for strip in content.strips:
        triangles = strip_triangles(*corners_of(name, strip))
        uvs.append(_uv_of_faces(vertex_uv, triangles))
        has_uv.append(np.full(len(triangles), vertex_uv is not None))
        image_indices.append(np.zeros(len(triangles), np.int64))
    uv = np.concatenate(uvs)
    uv[..., 1] = 1.0 - uv[..., 1]
    return uv, np.concatenate(has_uv), np.concatenate(image_indices)


def _normalized(name: str) -> str:
    """Normalise a property name: lower case, without "_" and "-"."""
    return name.lower().replace("_", "").replace("-", "")


def _image_indices(values: Floats | Ints) -> Ints:
    """Convert image indices to integers; values that are not finite or too large become -1."""
    values = np.asarray(values, np.float64)
    return np.where(np.abs(values) < 2**31, np.nan_to_num(values, posinf=0.0, neginf=0.0), -1).astype(np.int64)


def has_coordinates(content: Content) -> bool:
    """Whether vertices, or corners of faces, have texture coordinates under a known name."""
    lists = (p.name for face in content.faces for p in face.properties if p.count_kind)
    return _vertex_uv(content.vertices) is not None or any(_normalized(each) in _UV_LISTS for each in lists)


def _vertex_uv(element: Element) -> Floats | None:
    """(V, 2) texture coordinates of the vertices, v up; None if there are none."""
    known: dict[str, dict[str, str]] = {}  # property name, by prefix and axis
    for p in element.properties:
        if not p.count_kind and (found := _COORDINATE.fullmatch(_normalized(p.name))):
            axis = (found[1] or found[2])[-1]
            known.setdefault(found[0].removesuffix("0" if found[2] else "")[:-1], {})[axis] = p.name
    for pair in _AXIS_PAIRS:
        for names in known.values():
            if set(pair) <= set(names):
                return np.stack([element.table[names[axis]].astype(np.float64) for axis in pair], axis=1)
    return None


def _uv_of_faces(vertex_uv: Floats | None, faces: Ints) -> Floats:
    """(F, 3, 2) coordinates of the corners of faces, from those of vertices; zeros if there are none."""
    if vertex_uv is None:
        return np.zeros((len(faces), 3, 2))
    return np.asarray(vertex_uv[np.clip(faces, 0, len(vertex_uv) - 1)])  # the shape reports invalid vertex indices


def _corner_uv(name: str, face: Element, sizes: Ints) -> tuple[Floats, Bools] | None:
    """(N, 2) coordinates, v up, of the corners of all polygons, and (P,) which polygons have them; None if no list has."""
    list_name = next((p.name for p in face.properties if p.count_kind and _normalized(p.name) in _UV_LISTS), None)
    if list_name is None:
        return None
    values, n_values = face.table[list_name]
    has_all = n_values == 2 * sizes
    if not has_all.any():
        return None
    if not (has_all | (n_values == 0)).all():
        raise damaged(name, f"a face has other than two texture coordinates ({list_name}) for each corner")
    uv = np.zeros((int(sizes.sum()), 2))
    uv[np.repeat(has_all, sizes)] = np.asarray(values, np.float64).reshape(-1, 2)
    return uv, has_all
