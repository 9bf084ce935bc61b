"""The look of Wavefront OBJ files: texture coordinates, and materials from the mtl beside it.

An image is taken as it is: Kd counts for faces without one (many programs write a grey Kd beside every image).
"""

from __future__ import annotations

import re
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from meshmatch.arrays import Bools, Float, Floats, Ints
from meshmatch.errors import InputError, warn
from meshmatch.shapes import appearance
from meshmatch.shapes.appearance import Alpha, Appearance, Finish, ImageReader, Layer, Material, Pixels, Wrap
from meshmatch.shapes.colors import to_linear
from meshmatch.shapes.companions import beside, folded
from meshmatch.shapes.formats import DECIMAL_COMMA, columns, damaged, lines_starting_with, parse_numbers, words_per_line
from meshmatch.shapes.formats.obj import entries_and_faces, from_one, joined_lines, vertices_of_corners
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

_FINISH = ("pr", "pm", "ke", "map_pr", "map_pm", "map_ke", "norm", "map_bump", "bump")
_LARGEST_MTL = 10_000_000  # bytes
_MOST_LIBRARIES = 100  # names in one line
_COMMENT = re.compile(r"\s#.*")  # or the end of a name, such as Material #25
_PICTURE = re.compile(r"^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+(\S[^\n]*)$", re.MULTILINE | re.IGNORECASE)
_TILE = re.compile("<udim>", re.IGNORECASE)
_TILES = range(1001, 1101)  # ten in a row, the first at u and v from 0 to 1
_NUMBER = r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[+-]?\d+)?"
_OPTION = re.compile(
    rf"(?:(-o|-s|-t)((?:\s+{_NUMBER}(?!\S)){{0,3}})|-mm\s+\S+\s+\S+|(-clamp)\s+(\S+)|"
    r"-(?:blendu|blendv|cc|bm|boost|texres|imfchan|type)\s+\S+)(?:\s+|\Z)",
    re.IGNORECASE,
)


@dataclass
class _Map:
    """An image that a material names, and how it is laid on."""

    file: str
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    clamp: bool = False


@dataclass
class _Entry:
    """A material as the mtl has it."""

    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    dissolve: float | None = None
    transparency: float = 0.0
    image: _Map | None = None
    alpha: _Map | None = None
    numbers: dict[str, tuple[float, ...]] = field(default_factory=dict)
    maps: dict[str, _Map] = field(default_factory=dict)
    folder: Path = field(default_factory=Path)

    @property
    def opacity(self) -> float:
        """In 0..1. What is given as such (d) counts more than its opposite (Tr), which some programs write for it."""
        return float(np.clip(1.0 - self.transparency if self.dissolve is None else self.dissolve, 0.0, 1.0))

    @property
    def tiled(self) -> bool:
        """Whether the name of an image stands for those of many tiles."""
        images = [self.image, self.alpha, *self.maps.values()]
        return any(image is not None and _TILE.search(image.file) for image in images)

    def of_tile(self, tile: int) -> _Entry:
        """The material of one tile."""

        def named(image: _Map | None) -> _Map | None:
            return None if image is None else replace(image, file=_TILE.sub(str(tile), image.file))

        maps = {word: replace(image, file=_TILE.sub(str(tile), image.file)) for word, image in self.maps.items()}
        return replace(self, image=named(self.image), alpha=named(self.alpha), maps=maps)


def read_look(path: Path, data: bytes, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Materials and texture coordinates, face by face in the order of `obj.read`; `picture` replaces all images."""
    worn = _worn(path, joined_lines(data), shape, picture is None)
    corners, laid, kind = worn.corners, worn.laid, worn.kind
    materials: list[Material] = []
    scale, offset = np.ones((len(worn.entries), 2)), np.zeros((len(worn.entries), 2))
    for number, (name, entry, covered) in enumerate(worn.entries):
        image = picture if picture is not None else _image(path, name, entry, reader, covered)
        materials.append(_material(name, entry, image if covered else None))
        if covered and entry.image is not None:
            scale[number], offset[number] = entry.image.scale, entry.image.offset
    corners[laid] = corners[laid] * scale[kind[laid], None] + offset[kind[laid], None]
    corners[laid, :, 1] = 1.0 - corners[laid, :, 1]
    if not materials or (picture is None and all(material.image is None for material in materials)):
        bare = appearance.vertex_colors_alone(shape)
        if bare.colors is not None or not materials:
            return bare
    if picture is not None and not laid.any():
        raise appearance.no_coordinates(path.name)
    return Appearance(tuple(materials), kind, corners)


def read_finish(path: Path, data: bytes, shape: Shape, reader: ImageReader) -> Finish | None:
    """What the materials say besides their color, as exporters of physically based materials write it: ``Pr``, ``Pm``,
    ``Ke``, their maps, and a normal map (``norm`` or ``map_Bump``). An image that cannot be read is told, and left out.
    """
    worn = _worn(path, joined_lines(data), shape, True)
    if not any(entry.numbers or entry.maps for _, entry, _ in worn.entries):
        return None
    corners = worn.corners
    corners[worn.laid, :, 1] = 1.0 - corners[worn.laid, :, 1]
    made: dict[Layer, list[Material]] = {"normal": [], "surface": [], "glow": []}
    for name, entry, covered in worn.entries:
        images: dict[str, Pixels] = {}
        for word, placed in entry.maps.items() if covered else ():
            try:
                images[word] = _decoded(path, name, entry, placed, reader)
            except InputError as error:
                warn(f"{error.message}; it is left out")
        normal = images.get("norm", images.get("map_bump", images.get("bump")))
        if normal is not None and (normal[..., 0] == normal[..., 2]).all():
            warn(f"the bump map of {name} in {path.name} holds heights, which are not transferred")
            normal = None
        flat = (0.5, 0.5, 1.0, 1.0) if normal is None else (1.0,) * 4
        made["normal"].append(Material(name, normal, flat, linear=True))
        made["surface"].append(_surface(name, entry, images.get("map_pr"), images.get("map_pm")))
        glow = images.get("map_ke")
        red, green, blue = entry.numbers.get("ke", (0.0,) * 3)
        if glow is not None and not (red or green or blue):  # as some programs write it beside the image
            red = green = blue = 1.0
        made["glow"].append(Material(name, glow, (red, green, blue, 1.0)))
    layers: dict[Layer, Appearance] = {
        layer: Appearance(tuple(materials), worn.kind, corners) for layer, materials in made.items()
    }
    return Finish(layers)


def _surface(name: str, entry: _Entry, rough: Pixels | None, metal: Pixels | None) -> Material:
    """Roughness in green and metal in blue, of images or of numbers; matt paint without either."""
    factors = [1.0, *entry.numbers.get("pr", (1.0,))[:1], *entry.numbers.get("pm", (0.0,))[:1], 1.0]
    if rough is None and metal is None:
        return Material(name, None, (factors[0], factors[1], factors[2], 1.0), linear=True)
    if rough is not None and metal is not None and rough.shape != metal.shape:
        warn(f"the maps of roughness and metal of {name} differ in size: the second is left out")
        metal = None
    image = np.full_like(rough if rough is not None else metal, 255)
    for channel, given in ((1, rough), (2, metal)):
        if given is not None:
            image[..., channel], factors[channel] = given[..., 0], 1.0
    return Material(name, image, (factors[0], factors[1], factors[2], 1.0), linear=True)


@dataclass
class _Worn:
    """Of each face its coordinates (v up), whether it has any, and its number in a list of materials: name, entry, and
    whether its faces have coordinates.
    """

    corners: Floats
    laid: Bools
    kind: Ints
    entries: list[tuple[str, _Entry, bool]]


def _worn(path: Path, data: bytes, shape: Shape, libraries_too: bool) -> _Worn:
    named, libraries = (_words(*found) for found in lines_starting_with(data, b"usemtl", b"mtllib"))
    corners, laid, lines = _coordinates(path.name, data, shape)
    names = list(dict.fromkeys(name for name, _ in named))
    place = {name: k for k, name in enumerate(names)}
    used = np.searchsorted([line for _, line in named], lines, side="right") - 1
    used = np.array([*(place[name] for name, _ in named), -1])[used]  # -1: none named yet
    names.append("")
    entries = _libraries(path, [name for name, _ in libraries], shape) if libraries_too else {}
    wanted = {names[k] for k in np.unique(used).tolist()}
    meant = _materials_meant(path.name, wanted, entries.keys()) if entries else {name: name for name in wanted}
    # Only what faces use is read; a material counts twice where some of its faces have no coordinates.
    _, which, kind = np.unique(2 * used + laid, return_index=True, return_inverse=True)
    found = [(meant[names[used[face]]], bool(laid[face])) for face in which.tolist()]
    listed = [(name, entries.get(name, _Entry()), covered) for name, covered in found]
    return _by_tile(_Worn(corners, laid, kind.reshape(-1).astype(np.int64), listed))


def _by_tile(worn: _Worn) -> _Worn:
    """Materials whose images are named by tile (UDIM) as one for each tile; images repeat, so coordinates may stay there."""
    tiled = np.array([covered and entry.tiled for _, entry, covered in worn.entries])
    rows = np.flatnonzero(tiled[worn.kind]) if tiled.any() else worn.kind[:0]
    if not len(rows):
        return worn
    middle = np.nextafter(worn.corners[rows].mean(axis=1), 0.0)  # without area on an edge: in the tile before it
    place = np.clip(np.nan_to_num(np.floor(middle), nan=-1.0), -1.0, 10.0).astype(np.int64)
    if place.min() < 0 or place.max() > 9:
        name = worn.entries[int(worn.kind[rows[0]])][0]
        raise InputError(f"faces of the material {name} lie in no tile of its images", "UDIM tiles are 1001 to 1100")
    tile = np.zeros_like(worn.kind)
    tile[rows] = _TILES.start + place @ [1, 10]
    _, which, kind = np.unique(worn.kind * 10_000 + tile, return_index=True, return_inverse=True)
    entries = []
    for number, own in zip(worn.kind[which].tolist(), tile[which].tolist(), strict=True):
        name, entry, covered = worn.entries[number]
        entries.append((name, entry.of_tile(own) if own else entry, covered))
    return _Worn(worn.corners, worn.laid, kind.reshape(-1), entries)


def read_coordinates(path: Path, data: bytes, shape: Shape) -> Float[Floats, "F 3 2"] | None:
    """Texture coordinates of all faces, v down; None where a face has none. `shape` is of the same file."""
    uv, laid, _ = _coordinates(path.name, joined_lines(data), shape)
    uv[:, :, 1] = 1.0 - uv[:, :, 1]
    return uv if laid.all() else None


def companions(path: Path, data: bytes) -> tuple[list[Path], list[str]]:
    """The material files that an obj names and the images that these name, all in the obj's folder or below it; and the
    names that lead nowhere.
    """
    found: dict[Path, None] = {}
    missing: dict[str, None] = {}
    [libraries] = lines_starting_with(joined_lines(data), b"mtllib")
    for name, _ in _words(*libraries):
        whole = beside(path.parent, name)
        files = [whole] if whole is not None else _named(path.parent, _uncommented(name))
        if None in files or not files:
            missing[name] = None
        found |= dict.fromkeys(file for file in files if file is not None)
    for library in list(found):
        text = joined_lines(read_bytes(library, largest=_LARGEST_MTL)).decode("utf-8", "surrogateescape")
        for rest in _PICTURE.findall(text):
            try:
                name = _map(rest.strip()).file
            except (ValueError, LookupError):
                name = rest.split()[-1]
            folders = (library.parent, path.parent)
            tiles = [_TILE.sub(str(tile), name) for tile in _TILES] if _TILE.search(name) else [name]
            images = [file for each in tiles for folder in folders if (file := beside(folder, each)) is not None]
            found |= dict.fromkeys(images if tiles[1:] else images[:1])
            if not images:
                missing[name] = None
    return list(found), list(missing)


def second_index(text: bytes) -> bytes:
    """Of each word what stands between its first and its second slash: 1/2/3 becomes 2; 1, 1//3 and 1/ become 0."""
    text = re.sub(rb"(?<!\S)(?:[^\s/]++|(?=/))(?:/(?:/\S*+)?+)?+(?=\s|\Z)", b"0", text)
    return re.sub(rb"[^\s/]*+/([^\s/]*+)\S*+", rb"\1", text)


def _words(text: bytes, lines: Ints) -> list[tuple[str, int]]:
    names = [row.decode("utf-8", "surrogateescape").strip() for row in text.split(b"\n")]
    return list(zip(names, lines.tolist(), strict=False))


def _uncommented(words: str) -> str:
    """Words without the comment that may follow them."""
    return _COMMENT.sub("", words).strip()


def _coordinates(name: str, data: bytes, shape: Shape) -> tuple[Floats, Bools, Ints]:
    """(F, 3, 2) coordinates with v up, (F,) whether all three corners have them, and (F,) the line of each face."""
    text, vt_lines, faces, sizes, face_lines = entries_and_faces(name, data, b"vt")
    counts = words_per_line(text)
    if len(counts) < len(vt_lines):
        raise damaged(name, "a texture coordinate has no numbers")
    pairs = np.zeros((len(vt_lines), 2))
    if len(vt_lines):
        width = int(min(counts.min(), 2))
        pairs[:, :width] = columns(parse_numbers(name, text), counts, 0, width)
    index = np.zeros(int(sizes.sum()), np.int64)
    if b"/" in faces:
        values = parse_numbers(name, second_index(faces))
        index = from_one(name, "texture coordinate", values, vt_lines, np.repeat(face_lines, sizes))
    vertices = index
    if (sizes > 3).any():  # how polygons are split, depends on where their vertices are
        [(_, v_lines)] = lines_starting_with(data, b"v")
        vertices = vertices_of_corners(name, faces, sizes, v_lines, face_lines)
    triangles = index[triangles_of(name, shape.verts_or_nan, vertices, sizes)]
    laid = np.asarray((triangles > 0).all(axis=1))
    uv = np.zeros((len(triangles), 3, 2))
    uv[laid] = pairs[triangles[laid] - 1]
    return uv, laid, np.repeat(face_lines, np.maximum(sizes - 2, 0))


def _materials_meant(file: str, wanted: set[str], known: Collection[str]) -> dict[str, str]:
    """For each name that faces use ("" for none at all) that of a material: the same, or one that differs in nothing but
    case or a comment behind it; where there is but one material, that one for faces without a name. Names without a
    material are said.
    """
    alike: dict[str, str] = {}
    for likeness in (folded, lambda name: folded(_uncommented(name))):
        for name in known:
            alike.setdefault(likeness(name), name)
    bare = {name: alike.get(folded(_uncommented(name)), name) for name in wanted}
    meant = {name: name if name in known else alike.get(folded(name), bare[name]) for name in wanted}
    if "" in wanted and len(known) == 1:
        [meant[""]] = known
    elif wanted == {""}:
        warn(f"{file} does not say which of the {len(known)} materials of its mtl to use: its faces have no image")
    missing = sorted(name for name in wanted if name and meant[name] not in known)
    if missing:
        some = ", ".join(name[:60] for name in missing[:5]) + (", ..." if len(missing) > 5 else "")
        what = f"a material {some}" if len(missing) == 1 else f"{len(missing)} materials ({some})"
        warn(f"{file} names {what} that its mtl does not have: those faces have no image")
    return meant


def _libraries(path: Path, names: list[str], shape: Shape) -> dict[str, _Entry]:
    """The materials of all mtl files that are named. A shape with vertex colors may miss them."""
    entries: dict[str, _Entry] = {}
    for name in dict.fromkeys(names):
        whole = beside(path.parent, name)
        for file in [whole] if whole is not None else _named(path.parent, _uncommented(name)):
            if file is not None:
                entries |= _parse(file)
            elif shape.colors is None:
                missing = f"{path.name} has its materials in {name[:200]}, which is not there"
                raise InputError(missing, f"copy it to {path.parent}, or name the picture with --image")
    return entries


def _named(folder: Path, names: str) -> list[Path | None]:
    """The files of a line that names one, maybe with spaces, or several; None for one that is not there."""
    several = [beside(folder, word) for word in names.split(None, _MOST_LIBRARIES)[:_MOST_LIBRARIES]]
    if len(several) > 1 and not all(file is not None and file.suffix.lower() == ".mtl" for file in several):
        whole = beside(folder, names)
        return several if whole is None else [whole]
    return several


def _parse(file: Path) -> dict[str, _Entry]:
    entries: dict[str, _Entry] = {}
    entry = _Entry()
    data = joined_lines(read_bytes(file, largest=_LARGEST_MTL))
    for line in data.decode("utf-8", "surrogateescape").split("\n"):
        word, rest = (*line.split(None, 1), "", "")[:2]
        word, rest = word.lower(), rest.strip()
        if word not in ("newmtl", "map_kd", "map_d", *_FINISH):
            rest = _uncommented(f" {rest}")
        if not rest and word != "newmtl":
            continue  # a word alone says nothing
        try:
            if word == "newmtl":
                entry = entries[rest] = _Entry(folder=file.parent)
            elif word == "kd" and not rest.startswith(("spectral", "xyz")):
                values = [_number(word) for word in rest.split()[:3]]
                entry.color = (values[0], values[1], values[2]) if len(values) == 3 else (values[0],) * 3
            elif word == "d":
                entry.dissolve = _number(rest.split()[-1])  # d -halo 0.5
            elif word == "tr":
                entry.transparency = _number(rest.split()[-1])
            elif word == "map_kd":
                entry.image = _map(rest)
            elif word == "map_d":
                entry.alpha = _map(rest)
            elif word in _FINISH:
                _read_finish(entry, word, rest)
        except (ValueError, LookupError) as error:
            odd = damaged(file.name, f"cannot make sense of the line '{line.strip()[:60]}'")
            raise InputError(odd.message, DECIMAL_COMMA if "," in rest else odd.hint) from error
    return entries


def _read_finish(entry: _Entry, word: str, rest: str) -> None:
    """Note what a line says besides the color; what makes no sense there never mattered, and is left out."""
    with suppress(ValueError, LookupError):
        if word in ("pr", "pm", "ke"):
            values = tuple(float(np.clip(_number(each), 0.0, 1.0)) for each in rest.split()[:3])
            if len(values) == (3 if word == "ke" else 1) and np.isfinite(values).all():
                entry.numbers[word] = values
        else:
            entry.maps[word] = _map(rest)


def _number(word: str) -> float:
    """A number, with a decimal point or comma: words of an mtl are split by spaces."""
    return float(word.replace(",", ".") if word.count(",") == 1 and "." not in word else word)


def _map(text: str) -> _Map:
    """Options and file of a map; the file's name may hold spaces."""
    made = _Map("")
    while text.startswith("-"):
        found = _OPTION.match(text)
        if found is None:
            raise ValueError("an unknown option")
        option, words, clamp, state = (group.lower() for group in found.groups(""))
        if option in ("-o", "-s"):
            u, v = [*map(_number, words.split()), 0.0 if option == "-o" else 1.0][:2]
            made = replace(made, offset=(u, v)) if option == "-o" else replace(made, scale=(u, v))
        elif clamp:
            made.clamp = state == "on"
        text = text[found.end() :]
    if not text:
        raise ValueError("no file")
    return replace(made, file=text)


def _material(name: str, entry: _Entry, image: Pixels | None) -> Material:
    red, green, blue = to_linear(np.clip(entry.color, 0.0, 1.0)).tolist()
    opacity = entry.opacity
    alpha: Alpha = "opaque" if opacity == 1.0 and (image is None or (image[..., 3] == 255).all()) else "blend"
    if image is None:
        return Material(name, None, (red, green, blue, opacity), alpha=alpha)
    side: Wrap = "clamp" if entry.image is not None and entry.image.clamp else "repeat"
    return Material(name, image, (1.0, 1.0, 1.0, opacity), (side, side), alpha=alpha)


def _image(path: Path, name: str, entry: _Entry, reader: ImageReader, laid: bool) -> Pixels | None:
    """The image of a material; if it is `laid` on, with the alpha of map_d: of that its own, else how bright it is."""
    if entry.image is None:
        return None
    image = _decoded(path, name, entry, entry.image, reader)
    if not laid or entry.alpha is None or entry.alpha.file == entry.image.file:
        return image
    other = _decoded(path, name, entry, entry.alpha, reader)
    if other.shape != image.shape:
        what = f"{path.name}: the alpha image {entry.alpha.file} differs in size from the color image"
        raise InputError(what, "save both at the same size, or the alpha as a channel of the color png")
    channel = other[..., 0] if (other[..., 3] == 255).all() else other[..., 3]
    return np.concatenate([image[..., :3], channel[..., None]], axis=-1)


def _decoded(path: Path, name: str, entry: _Entry, wanted: _Map, reader: ImageReader) -> Pixels:
    """An image that a material names."""
    names = dict.fromkeys((wanted.file, _uncommented(wanted.file)))
    places = [(folder, each) for each in names for folder in (entry.folder, path.parent)]
    file = next((found for each in places if (found := beside(*each)) is not None), None)
    if file is None:
        what = f"{path.name} needs the image {wanted.file[:200]} of its material {name}, which is not there"
        raise InputError(what, f"copy it to {entry.folder}, or name another with --image")
    return reader.read(file)
