"""The look of Wavefront OBJ files: texture coordinates, and materials from the mtl beside it.

An image is taken as it is: Kd counts for faces without one (many programs write a grey Kd beside every image).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Ints
from meshmatch.errors import InputError
from meshmatch.shapes.appearance import Alpha, Appearance, Material, Wrap, no_coordinates, vertex_colors_alone
from meshmatch.shapes.formats import damaged, fan
from meshmatch.shapes.formats.obj import from_one, joined_lines, with_old
from meshmatch.shapes.formats.text import columns, lines_of, numbers, second_index, words_per_line
from meshmatch.shapes.images import ImageReader, Pixels
from meshmatch.shapes.paths import beside, read_bytes
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.srgb import to_linear

# How many numbers follow an option of a map; up to three where it is None.
_OPTIONS = {
    **dict.fromkeys(("-o", "-s", "-t"), None),
    **dict.fromkeys(("-blendu", "-blendv", "-cc", "-clamp", "-bm", "-boost", "-texres", "-imfchan", "-type"), 1),
    "-mm": 2,
}


@dataclass
class _Map:
    """An image that a material names, and how it is laid on."""

    file: str = ""
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    clamp: bool = False


@dataclass
class _Entry:
    """A material as the mtl has it."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    opacity: float = 1.0
    image: _Map | None = None
    alpha: _Map | None = None
    folder: Path = field(default_factory=Path)


def read_look(path: Path, data: bytes, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Materials and texture coordinates, face by face in the order of `obj.read`; `picture` replaces all images."""
    data = joined_lines(data)
    named, libraries = (_words(*found) for found in lines_of(data, b"usemtl", b"mtllib"))
    corners, laid, lines = _coordinates(path.name, data)
    used = np.searchsorted([line for _, line in named], lines, side="right") - 1  # -1: none named yet
    entries = {} if picture is not None else _libraries(path, [name for name, _ in libraries], shape)
    # Only what faces use is read; a material counts twice where some of its faces have no coordinates.
    _, which, kind = np.unique(2 * used + laid, return_index=True, return_inverse=True)
    materials = []
    for face in which.tolist():
        name = named[used[face]][0] if used[face] >= 0 else ""
        entry = entries.get(name, _Entry())
        look = _Material(path, name, entry, reader)
        materials.append(look.build(bool(laid[face]), picture))
        if laid[face] and entry.image is not None and picture is None:
            rows = kind.reshape(-1) == len(materials) - 1
            corners[rows] = corners[rows] * entry.image.scale + entry.image.offset
    corners[laid, :, 1] = 1.0 - corners[laid, :, 1]
    if not materials or (picture is None and all(material.image is None for material in materials)):
        bare = vertex_colors_alone(shape)
        if bare.colors is not None or not materials:
            return bare
    if picture is not None and not laid.any():
        raise no_coordinates(path.name)
    return Appearance(tuple(materials), kind.reshape(-1).astype(np.int64), corners)


def _words(text: bytes, lines: Ints) -> list[tuple[str, int]]:
    names = [re.split(r"\s#", row.decode("utf-8", "surrogateescape"))[0].strip() for row in text.split(b"\n")]
    return list(zip(names, lines.tolist(), strict=False))


def read_coordinates(path: Path, data: bytes) -> Float[Floats, "F 3 2"] | None:
    """(F, 3, 2) texture coordinates of all faces, v down; None where a face has none."""
    uv, laid, _ = _coordinates(path.name, joined_lines(data))
    uv[:, :, 1] = 1.0 - uv[:, :, 1]
    return uv if laid.all() else None


def _coordinates(name: str, data: bytes) -> tuple[Floats, Bools, Ints]:
    """(F, 3, 2) coordinates with v up, (F,) whether all three corners have them, and (F,) the line of each face."""
    if b"#" in data:
        data = re.sub(rb"#[^\n]*", b"", data)
    (text, vt_lines), *faces_found = lines_of(data, b"vt", b"f", b"fo")
    faces_text, face_lines = with_old(faces_found)
    sizes = words_per_line(faces_text)
    if len(sizes) < len(face_lines):
        raise damaged(name, "a face has no corners")
    counts = words_per_line(text)
    if len(counts) < len(vt_lines):
        raise damaged(name, "a texture coordinate has no numbers")
    pairs = np.zeros((len(vt_lines), 2))
    if len(vt_lines):
        width = int(min(counts.min(), 2))
        pairs[:, :width] = columns(numbers(name, text), counts, 0, width)
    if b"/" in faces_text:
        values = numbers(name, second_index(faces_text))
        index = from_one(name, "texture coordinate", values, vt_lines, np.repeat(face_lines, sizes))
    else:
        index = np.zeros(int(sizes.sum()), np.int64)
    triangles = fan(index, sizes)
    laid = np.asarray((triangles > 0).all(axis=1))
    uv = np.zeros((len(triangles), 3, 2))
    uv[laid] = pairs[triangles[laid] - 1]
    return uv, laid, np.repeat(face_lines, np.maximum(sizes - 2, 0))


def _libraries(path: Path, names: list[str], shape: Shape) -> dict[str, _Entry]:
    """The materials of all mtl files that are named. A shape with vertex colours may miss them."""
    entries: dict[str, _Entry] = {}
    for name in names:
        whole = _beside(path.parent, name)
        files = [whole] if whole is not None else [_beside(path.parent, word) for word in name.split()]
        for file in files:
            if file is not None:
                entries |= _parse(file)
            elif shape.colors is None:
                raise InputError(
                    f"{path.name} has its materials in {name[:200]}, which is not there",
                    f"copy it to {path.parent}, or name the picture with --image",
                )
    return entries


def _beside(folder: Path, name: str) -> Path | None:
    """A file that is named relative to a folder, within it; else one of the same name in it; else None."""
    windows = PureWindowsPath(name.strip().strip('"'))  # takes both kinds of slash
    return beside(folder, windows.as_posix()) or beside(folder, windows.name)


def _parse(file: Path) -> dict[str, _Entry]:
    entries: dict[str, _Entry] = {}
    entry = _Entry()
    for line in joined_lines(file.read_bytes()).decode("utf-8", "surrogateescape").splitlines():
        word, rest = (*line.split(None, 1), "", "")[:2]
        word, rest = word.lower(), rest.strip()
        if word.startswith("#"):
            continue
        try:
            if word == "newmtl":
                entry = entries[rest] = _Entry(folder=file.parent)
            elif word == "kd" and not rest.startswith(("spectral", "xyz")):
                values = [float(number) for number in rest.split()[:3]]
                entry.color = (values[0], values[1], values[2]) if len(values) == 3 else (values[0],) * 3
            elif word == "d":
                entry.opacity = float(rest.split()[-1])  # d -halo 0.5
            elif word == "tr":
                entry.opacity = 1.0 - float(rest.split()[-1])
            elif word == "map_kd":
                entry.image = _map(rest)
            elif word == "map_d":
                entry.alpha = _map(rest)
        except (ValueError, LookupError) as error:
            raise damaged(file.name, f"cannot make sense of the line '{line.strip()[:60]}'") from error
    return entries


def _map(text: str) -> _Map:
    """Options and file of a map; the file's name may hold spaces."""
    made, rest = _Map(), text
    while rest.startswith("-"):
        option, rest = (*rest.split(None, 1), "")[:2]
        count = _OPTIONS[option.lower()]
        taken: list[str] = []
        while rest and len(taken) < (count or 3):
            word, behind = (*rest.split(None, 1), "")[:2]
            if count is None and not _is_number(word):
                break
            taken.append(word)
            rest = behind
        if option.lower() == "-o":
            made.offset = (float(taken[0]), float((*taken, "0")[1]))
        elif option.lower() == "-s":
            made.scale = (float(taken[0]), float((*taken, "1")[1]))
        elif option.lower() == "-clamp":
            made.clamp = taken[0].lower() == "on"
    if not rest:
        raise ValueError("no file")
    made.file = rest
    return made


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class _Material:
    """One entry of an mtl on its way to a `Material`."""

    path: Path
    name: str
    entry: _Entry
    reader: ImageReader

    def build(self, laid: bool, picture: Pixels | None) -> Material:
        """The material; with its image where faces have coordinates."""
        entry = self.entry
        red, green, blue = to_linear(np.clip(entry.color, 0.0, 1.0)).tolist()
        opacity = float(np.clip(entry.opacity, 0.0, 1.0))
        alpha: Alpha = "opaque" if opacity == 1.0 else "blend"
        made = Material(self.name, None, (red, green, blue, opacity), alpha=alpha)
        image = picture if picture is not None or entry.image is None else self._decode(entry.image)
        if not laid or image is None:
            return made
        if entry.alpha is not None and picture is None:
            image = self._with_alpha(image, entry.alpha)
        side: Wrap = "clamp" if entry.image is not None and entry.image.clamp else "repeat"
        alpha = alpha if (image[..., 3] == 255).all() else "blend"
        return replace(made, image=image, factor=(1.0, 1.0, 1.0, opacity), wrap=(side, side), alpha=alpha)

    def _with_alpha(self, image: Pixels, wanted: _Map) -> Pixels:
        """The image with the alpha of another one: its own alpha if it has any, else how bright it is."""
        if self.entry.image is not None and wanted.file == self.entry.image.file:
            return image
        other = self._decode(wanted)
        if other.shape != image.shape:
            raise InputError(
                f"{self.path.name}: the alpha image {wanted.file} differs in size from the colour image",
                "save both in one size, or the alpha within the colours' png",
            )
        channel = other[..., 0] if (other[..., 3] == 255).all() else other[..., 3]
        return np.concatenate([image[..., :3], channel[..., None]], axis=-1)

    def _decode(self, wanted: _Map) -> Pixels:
        file = _beside(self.entry.folder, wanted.file)
        if file is None:
            raise InputError(
                f"{self.path.name} needs the image {wanted.file[:200]} of its material {self.name}, which is not there",
                f"copy it to {self.entry.folder}, or name another with --image",
            )
        return self.reader.decode(read_bytes(file), file.name)
