"""Read the appearance of Wavefront OBJ files: texture coordinates, and materials from mtl files in the same folder.

Images are not multiplied by Kd, since many programs write a grey Kd with every image; Kd is the color of faces without one.
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
from meshmatch.shapes.companions import canonical_name, find_companion
from meshmatch.shapes.formats import DECIMAL_COMMA, columns, damaged, lines_starting_with, parse_numbers, words_per_line
from meshmatch.shapes.formats.obj import entries_and_faces, join_lines, resolve_indices, vertices_of_corners
from meshmatch.shapes.formats.polygons import triangles_of
from meshmatch.shapes.input_files import read_bytes
from meshmatch.shapes.shape import Shape

_FINISH_KEYWORDS = ("pr", "pm", "ke", "map_pr", "map_pm", "map_ke", "norm", "map_bump", "bump")
_MAX_MTL_BYTES = 10_000_000
_MAX_LIBRARIES = 100  # file names in one mtllib line
_COMMENT = re.compile(r"\s#.*")  # ambiguous: it may be part of a name, such as Material #25
_MAP_LINE = re.compile(r"^[ \t]*(?:map_\w+|bump|disp|decal|refl|norm)[ \t]+(\S[^\n]*)$", re.MULTILINE | re.IGNORECASE)
_TILE = re.compile("<udim>", re.IGNORECASE)
_TILES = range(1001, 1101)  # UDIM: ten per row, the first one covers u and v from 0 to 1
_NUMBER = r"[+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:e[+-]?\d+)?"
_OPTION = re.compile(
    rf"(?:(-o|-s|-t)((?:\s+{_NUMBER}(?!\S)){{0,3}})|-mm\s+\S+\s+\S+|(-clamp)\s+(\S+)|"
    r"-(?:blendu|blendv|cc|bm|boost|texres|imfchan|type)\s+\S+)(?:\s+|\Z)",
    re.IGNORECASE,
)


@dataclass
class _Map:
    """A texture map of a material: the name of its image file, its transform and its wrap mode."""

    file: str
    offset: tuple[float, float] = (0.0, 0.0)
    scale: tuple[float, float] = (1.0, 1.0)
    clamp: bool = False


@dataclass
class _Entry:
    """A material as defined in an mtl file."""

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
        """Opacity in 0..1. ``d`` takes precedence over ``Tr`` (1 - opacity), where some programs write the opacity."""
        return float(np.clip(1.0 - self.transparency if self.dissolve is None else self.dissolve, 0.0, 1.0))

    @property
    def tiled(self) -> bool:
        """Whether the name of any image is a UDIM pattern for several tiles."""
        images = [self.image, self.alpha, *self.maps.values()]
        return any(image is not None and _TILE.search(image.file) for image in images)

    def of_tile(self, tile: int) -> _Entry:
        """Return the material for one UDIM tile."""

        def named(image: _Map | None) -> _Map | None:
            return None if image is None else replace(image, file=_TILE.sub(str(tile), image.file))

        maps = {word: replace(image, file=_TILE.sub(str(tile), image.file)) for word, image in self.maps.items()}
        return replace(self, image=named(self.image), alpha=named(self.alpha), maps=maps)


def read_appearance(path: Path, data: bytes, shape: Shape, reader: ImageReader, picture: Pixels | None) -> Appearance:
    """Read materials and texture coordinates per face, in the order of `obj.read`; `picture` replaces all images."""
    faces = _face_materials(path, join_lines(data), shape, picture is None)
    corners, face_has_uv, material_index = faces.corners, faces.face_has_uv, faces.material_index
    materials: list[Material] = []
    scale, offset = np.ones((len(faces.entries), 2)), np.zeros((len(faces.entries), 2))
    for number, (name, entry, has_uv) in enumerate(faces.entries):
        image = picture if picture is not None else _image(path, name, entry, reader, has_uv)
        materials.append(_material(name, entry, image if has_uv else None))
        if has_uv and entry.image is not None:
            scale[number], offset[number] = entry.image.scale, entry.image.offset
    corners[face_has_uv] = (
        corners[face_has_uv] * scale[material_index[face_has_uv], None] + offset[material_index[face_has_uv], None]
    )
    corners[face_has_uv, :, 1] = 1.0 - corners[face_has_uv, :, 1]
    if not materials or (picture is None and all(material.image is None for material in materials)):
        vertex_colors = appearance.vertex_colors_alone(shape)
        if vertex_colors.colors is not None or not materials:
            return vertex_colors
    if picture is not None and not face_has_uv.any():
        raise appearance.no_coordinates(path.name)
    return Appearance(tuple(materials), material_index, corners)


def read_finish(path: Path, data: bytes, shape: Shape, reader: ImageReader) -> Finish | None:
    """Read the layers besides color, with the keywords for physically based materials.

    These are ``Pr``, ``Pm``, ``Ke`` and their maps, and a normal map (``norm`` or ``map_Bump``). An image that cannot be
    read is left out, with a warning. None if no material has any of these.
    """
    faces = _face_materials(path, join_lines(data), shape, True)
    if not any(entry.numbers or entry.maps for _, entry, _ in faces.entries):
        return None
    corners = faces.corners
    corners[faces.face_has_uv, :, 1] = 1.0 - corners[faces.face_has_uv, :, 1]
    layer_materials: dict[Layer, list[Material]] = {"normal": [], "surface": [], "glow": []}
    for name, entry, has_uv in faces.entries:
        images: dict[str, Pixels] = {}
        for word, texture_map in entry.maps.items() if has_uv else ():
            try:
                images[word] = _read_image(path, name, entry, texture_map, reader)
            except InputError as error:
                warn(f"{error.message}; it is left out")
        normal = images.get("norm", images.get("map_bump", images.get("bump")))
        if normal is not None and (normal[..., 0] == normal[..., 2]).all():
            warn(f"the bump map of {name} in {path.name} holds heights, which are not transferred")
            normal = None
        flat = (0.5, 0.5, 1.0, 1.0) if normal is None else (1.0,) * 4
        layer_materials["normal"].append(Material(name, normal, flat, linear=True))
        layer_materials["surface"].append(_surface(name, entry, images.get("map_pr"), images.get("map_pm")))
        glow = images.get("map_ke")
        red, green, blue = entry.numbers.get("ke", (0.0,) * 3)
        if glow is not None and not (red or green or blue):  # some programs write Ke 0 0 0 with an emission map
            red = green = blue = 1.0
        layer_materials["glow"].append(Material(name, glow, (red, green, blue, 1.0)))
    layers: dict[Layer, Appearance] = {
        layer: Appearance(tuple(materials), faces.material_index, corners)
        for layer, materials in layer_materials.items()
    }
    return Finish(layers)


def _surface(name: str, entry: _Entry, rough: Pixels | None, metal: Pixels | None) -> Material:
    """Build the material of roughness (green) and metalness (blue), from images or numbers; matte nonmetal by default."""
    factors = [1.0, *entry.numbers.get("pr", (1.0,))[:1], *entry.numbers.get("pm", (0.0,))[:1], 1.0]
    if rough is None and metal is None:
        return Material(name, None, (factors[0], factors[1], factors[2], 1.0), linear=True)
    if rough is not None and metal is not None and rough.shape != metal.shape:
        warn(f"the maps of roughness and metal of {name} differ in size: the second is left out")
        metal = None
    image = np.full_like(rough if rough is not None else metal, 255)
    for channel, channel_image in ((1, rough), (2, metal)):
        if channel_image is not None:
            image[..., channel], factors[channel] = channel_image[..., 0], 1.0
    return Material(name, image, (factors[0], factors[1], factors[2], 1.0), linear=True)


@dataclass
class _FaceMaterials:
    """Texture coordinates and materials of faces.

    Attributes
    ----------
    corners
        (F, 3, 2) texture coordinates, v up.
    face_has_uv
        (F,) whether a face has texture coordinates.
    material_index
        (F,) index of its material in `entries`.
    entries
        Materials: name, entry, and whether its faces have texture coordinates.
    """

    corners: Floats
    face_has_uv: Bools
    material_index: Ints
    entries: list[tuple[str, _Entry, bool]]


def _face_materials(path: Path, data: bytes, shape: Shape, read_libraries: bool) -> _FaceMaterials:
    usemtl, libraries = (_words(*materials) for materials in lines_starting_with(data, b"usemtl", b"mtllib"))
    corners, face_has_uv, lines = _coordinates(path.name, data, shape)
    names = list(dict.fromkeys(name for name, _ in usemtl))
    index_of = {name: k for k, name in enumerate(names)}
    used = np.searchsorted([line for _, line in usemtl], lines, side="right") - 1
    used = np.array([*(index_of[name] for name, _ in usemtl), -1])[used]  # -1: before the first usemtl line
    names.append("")
    entries = _libraries(path, [name for name, _ in libraries], shape) if read_libraries else {}
    used_names = {names[k] for k in np.unique(used).tolist()}
    material_of = (
        _match_names(path.name, used_names, entries.keys()) if entries else {name: name for name in used_names}
    )
    # Only materials that faces use are read. A material is listed twice if only some of its faces have coordinates.
    _, representative, material_index = np.unique(2 * used + face_has_uv, return_index=True, return_inverse=True)
    materials = [(material_of[names[used[face]]], bool(face_has_uv[face])) for face in representative.tolist()]
    entries_in_use = [(name, entries.get(name, _Entry()), has_uv) for name, has_uv in materials]
    return _by_tile(_FaceMaterials(corners, face_has_uv, material_index.reshape(-1).astype(np.int64), entries_in_use))


def _by_tile(faces: _FaceMaterials) -> _FaceMaterials:
    """Split materials with UDIM images into one per tile.

    Coordinates are not moved to the first tile, since images repeat.
    """
    tiled = np.array([has_uv and entry.tiled for _, entry, has_uv in faces.entries])
    rows = np.flatnonzero(tiled[faces.material_index]) if tiled.any() else faces.material_index[:0]
    if not len(rows):
        return faces
    middle = np.nextafter(faces.corners[rows].mean(axis=1), 0.0)  # degenerate on a tile's edge: in the tile before it
    tile_place = np.clip(np.nan_to_num(np.floor(middle), nan=-1.0), -1.0, 10.0).astype(np.int64)
    if tile_place.min() < 0 or tile_place.max() > 9:
        name = faces.entries[int(faces.material_index[rows[0]])][0]
        raise InputError(f"faces of the material {name} lie in no tile of its images", "UDIM tiles are 1001 to 1100")
    tile = np.zeros_like(faces.material_index)
    tile[rows] = _TILES.start + tile_place @ [1, 10]
    _, representative, material_index = np.unique(
        faces.material_index * 10_000 + tile, return_index=True, return_inverse=True
    )
    entries = []
    for number, own_tile in zip(
        faces.material_index[representative].tolist(), tile[representative].tolist(), strict=True
    ):
        name, entry, has_uv = faces.entries[number]
        entries.append((name, entry.of_tile(own_tile) if own_tile else entry, has_uv))
    return _FaceMaterials(faces.corners, faces.face_has_uv, material_index.reshape(-1), entries)


def read_coordinates(path: Path, data: bytes, shape: Shape) -> Float[Floats, "F 3 2"] | None:
    """Read texture coordinates of all faces, v down; None if any face has none. `shape` is read from the same file."""
    uv, face_has_uv, _ = _coordinates(path.name, join_lines(data), shape)
    uv[:, :, 1] = 1.0 - uv[:, :, 1]
    return uv if face_has_uv.all() else None


def companions(path: Path, data: bytes) -> tuple[list[Path], list[str]]:
    """Find the files that an obj refers to: its material files and their images, in the obj's folder or below it.

    Returns these files, and the names for which there is no file.
    """
    found: dict[Path, None] = {}
    missing: dict[str, None] = {}
    [libraries] = lines_starting_with(join_lines(data), b"mtllib")
    for name, _ in _words(*libraries):
        files, missing_names = _library_files(path.parent, name)
        missing |= dict.fromkeys(missing_names)
        found |= dict.fromkeys(files)
    for library in list(found):
        text = join_lines(read_bytes(library, largest=_MAX_MTL_BYTES)).decode("utf-8", "surrogateescape")
        for rest in _MAP_LINE.findall(text):
            try:
                name = _parse_map(rest.strip()).file
            except (ValueError, LookupError):
                name = rest.split()[-1]
            folders = (library.parent, path.parent)
            tiles = [_TILE.sub(str(tile), name) for tile in _TILES] if _TILE.search(name) else [name]
            images = [
                file for each in tiles for folder in folders if (file := find_companion(folder, each)) is not None
            ]
            found |= dict.fromkeys(images if tiles[1:] else images[:1])
            if not images:
                missing[name] = None
    return list(found), list(missing)


def second_index(text: bytes) -> bytes:
    """Replace each word by its part between first and second slash: 1/2/3 becomes 2; 1, 1//3 and 1/ become 0."""
    text = re.sub(rb"(?<!\S)(?:[^\s/]++|(?=/))(?:/(?:/\S*+)?+)?+(?=\s|\Z)", b"0", text)
    return re.sub(rb"[^\s/]*+/([^\s/]*+)\S*+", rb"\1", text)


def _words(text: bytes, lines: Ints) -> list[tuple[str, int]]:
    """Decode lines of text, and pair each with its line number."""
    names = [row.decode("utf-8", "surrogateescape").strip() for row in text.split(b"\n")]
    return list(zip(names, lines.tolist(), strict=False))


def _uncommented(words: str) -> str:
    """Remove a comment from the end of a line."""
    return _COMMENT.sub("", words).strip()


def _coordinates(name: str, data: bytes, shape: Shape) -> tuple[Floats, Bools, Ints]:
    """Return (F, 3, 2) coordinates with v up, (F,) whether all three corners have them, and (F,) the line of each face."""
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
        index = resolve_indices(name, "texture coordinate", values, vt_lines, np.repeat(face_lines, sizes))
    vertices = index
    if (sizes > 3).any():  # the triangulation of polygons depends on their vertices
        [(_, v_lines)] = lines_starting_with(data, b"v")
        vertices = vertices_of_corners(name, faces, sizes, v_lines, face_lines)
    triangles = index[triangles_of(name, shape.verts_or_nan, vertices, sizes)]
    face_has_uv = np.asarray((triangles > 0).all(axis=1))
    uv = np.zeros((len(triangles), 3, 2))
    uv[face_has_uv] = pairs[triangles[face_has_uv] - 1]
    return uv, face_has_uv, np.repeat(face_lines, np.maximum(sizes - 2, 0))


def _match_names(file: str, wanted: set[str], known: Collection[str]) -> dict[str, str]:
    """Map each material name that faces use ("" for faces without one) to the name of a defined material.

    Names may differ in case or by a trailing comment. If only one material is defined, faces without a name get it. Warns
    about names without a material.
    """
    by_folded: dict[str, str] = {}
    for fold in (canonical_name, lambda name: canonical_name(_uncommented(name))):
        for name in known:
            by_folded.setdefault(fold(name), name)
    without_comment = {name: by_folded.get(canonical_name(_uncommented(name)), name) for name in wanted}
    material_of = {
        name: name if name in known else by_folded.get(canonical_name(name), without_comment[name]) for name in wanted
    }
    if "" in wanted and len(known) == 1:
        [material_of[""]] = known
    elif wanted == {""}:
        warn(f"{file} does not say which of the {len(known)} materials of its mtl to use: its faces have no image")
    missing = sorted(name for name in wanted if name and material_of[name] not in known)
    if missing:
        listed = ", ".join(name[:60] for name in missing[:5]) + (", ..." if len(missing) > 5 else "")
        what = f"a material {listed}" if len(missing) == 1 else f"{len(missing)} materials ({listed})"
        warn(f"{file} names {what} that its mtl does not have: those faces have no image")
    return material_of


def _libraries(path: Path, names: list[str], shape: Shape) -> dict[str, _Entry]:
    """Read all mtl files that are referred to; a missing one raises `InputError`, unless the shape has vertex colors."""
    entries: dict[str, _Entry] = {}
    for name in dict.fromkeys(names):
        files, missing_names = _library_files(path.parent, name)
        for file in files:
            entries |= _parse(file)
        if missing_names and shape.colors is None:
            missing = f"{path.name} has its materials in {missing_names[0][:200]}, which is not there"
            raise InputError(missing, f"copy it to {path.parent}, or name the picture with --image")
    return entries


def _library_files(folder: Path, line: str) -> tuple[list[Path], list[str]]:
    """Resolve an mtllib line that has one file name, perhaps with spaces, or several: files, and names of missing ones."""
    names = _uncommented(line)
    words = names.split(None, _MAX_LIBRARIES)[:_MAX_LIBRARIES]
    if (file := find_companion(folder, line)) is not None or not words:
        return [] if file is None else [file], []
    found = {word: find_companion(folder, word) for word in words}
    files = [file for file in found.values() if file is not None]
    is_list = all(word.lower().endswith(".mtl") for word in words)
    if not (is_list and len(files) == len(found)) and (file := find_companion(folder, names)) is not None:
        return [file], []
    return files, [word for word, file in found.items() if file is None] if is_list else [line]


def _parse(file: Path) -> dict[str, _Entry]:
    """Parse an mtl file; `InputError` for a malformed color, opacity or color map."""
    entries: dict[str, _Entry] = {}
    entry = _Entry()
    data = join_lines(read_bytes(file, largest=_MAX_MTL_BYTES))
    for line in data.decode("utf-8", "surrogateescape").split("\n"):
        word, rest = (*line.split(None, 1), "", "")[:2]
        word, rest = word.lower(), rest.strip()
        if word not in ("newmtl", "map_kd", "map_d", *_FINISH_KEYWORDS):
            rest = _uncommented(f" {rest}")
        if not rest and word != "newmtl":
            continue  # a keyword without values
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
                entry.image = _parse_map(rest)
            elif word == "map_d":
                entry.alpha = _parse_map(rest)
            elif word in _FINISH_KEYWORDS:
                _read_finish(entry, word, rest)
        except (ValueError, LookupError) as error:
            failure = damaged(file.name, f"cannot make sense of the line '{line.strip()[:60]}'")
            raise InputError(failure.message, DECIMAL_COMMA if "," in rest else failure.hint) from error
    return entries


def _read_finish(entry: _Entry, word: str, rest: str) -> None:
    """Store the value of a keyword of a layer besides color; malformed ones are ignored."""
    with suppress(ValueError, LookupError):
        if word in ("pr", "pm", "ke"):
            values = tuple(float(np.clip(_number(each), 0.0, 1.0)) for each in rest.split()[:3])
            if len(values) == (3 if word == "ke" else 1) and np.isfinite(values).all():
                entry.numbers[word] = values
        else:
            entry.maps[word] = _parse_map(rest)


def _number(word: str) -> float:
    """Parse a number with a decimal point or comma (numbers in mtl files are separated by spaces)."""
    return float(word.replace(",", ".") if word.count(",") == 1 and "." not in word else word)


def _parse_map(text: str) -> _Map:
    """Parse the options and the file name of a map; the name may contain spaces."""
    result = _Map("")
    while text.startswith("-"):
        found = _OPTION.match(text)
        if found is None:
            raise ValueError("an unknown option")
        option, words, clamp, state = (group.lower() for group in found.groups(""))
        if option in ("-o", "-s"):
            u, v = [*map(_number, words.split()), 0.0 if option == "-o" else 1.0][:2]
            result = replace(result, offset=(u, v)) if option == "-o" else replace(result, scale=(u, v))
        elif clamp:
            result.clamp = state == "on"
        text = text[found.end() :]
    if not text:
        raise ValueError("no file")
    return replace(result, file=text)


def _material(name: str, entry: _Entry, image: Pixels | None) -> Material:
    red, green, blue = to_linear(np.clip(entry.color, 0.0, 1.0)).tolist()
    opacity = entry.opacity
    alpha: Alpha = "opaque" if opacity == 1.0 and (image is None or (image[..., 3] == 255).all()) else "blend"
    if image is None:
        return Material(name, None, (red, green, blue, opacity), alpha=alpha)
    wrap: Wrap = "clamp" if entry.image is not None and entry.image.clamp else "repeat"
    return Material(name, image, (1.0, 1.0, 1.0, opacity), (wrap, wrap), alpha=alpha)


def _image(path: Path, name: str, entry: _Entry, reader: ImageReader, has_uv: bool) -> Pixels | None:
    """Read the color image of a material; if faces have coordinates (`has_uv`), with the alpha of its ``map_d`` image.

    This is the alpha channel of that image if it has one, else its brightness.
    """
    if entry.image is None:
        return None
    image = _read_image(path, name, entry, entry.image, reader)
    if not has_uv or entry.alpha is None or entry.alpha.file == entry.image.file:
        return image
    alpha_image = _read_image(path, name, entry, entry.alpha, reader)
    if alpha_image.shape != image.shape:
        message = f"{path.name}: the alpha image {entry.alpha.file} differs in size from the color image"
        raise InputError(message, "save both at the same size, or the alpha as a channel of the color png")
    channel = alpha_image[..., 0] if (alpha_image[..., 3] == 255).all() else alpha_image[..., 3]
    return np.concatenate([image[..., :3], channel[..., None]], axis=-1)


def _read_image(path: Path, name: str, entry: _Entry, texture_map: _Map, reader: ImageReader) -> Pixels:
    """Read an image of a material from the folder of the mtl or that of the obj; `InputError` if it is missing."""
    names = dict.fromkeys((texture_map.file, _uncommented(texture_map.file)))
    candidates = [(folder, each) for each in names for folder in (entry.folder, path.parent)]
    file = next((found for each in candidates if (found := find_companion(*each)) is not None), None)
    if file is None:
        message = f"{path.name} needs the image {texture_map.file[:200]} of its material {name}, which is not there"
        raise InputError(message, f"copy it to {entry.folder}, or name another with --image")
    return reader.read(file)
