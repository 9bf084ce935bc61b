"""Readers and writers of shape files: bytes to plain arrays, and a `Shape` to bytes. This module has their shared parts.

A map has an entry for every vertex of a file, so readers keep all vertices in file order. They never allocate memory for
counts that a header merely declares. The package has its own readers because of these defects of trimesh 5.2 (measured):

- ply: text takes 1.4 s instead of 0.4 s for 164,000 vertices; importing trimesh takes 0.7 s, and most benchmarks and
  scans are ply files. Triangle strips become points, and 16-bit colors lose their upper byte.
- obj: a file with several materials becomes several meshes, each with all the vertices.
- off: vertex colors are lost, and a truncated face is dropped silently.
- stl: files with trailing bytes, a count of 0 or -1, or (text) no last line are rejected.
- gltf: meshes are not in scene order (`Rogue.glb`), skins are ignored, strips without indices fail.

Its writers round: ply positions to 32 bits, off to ten digits, obj to eight decimals (1e-20 becomes 0), and glb colors to
8 bits of linear light, which is too coarse for dark colors. Ours keep every bit of ply, off and obj positions.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from meshmatch.arrays import Bool, Bools, Float, Floats, Int, Ints
from meshmatch.errors import InputError, OutputError, warn
from meshmatch.shapes.colors import linear_to_srgb_alpha, srgb_to_linear_alpha

NO_FACES = np.empty((0, 3), np.int64)
NO_MESH = "is it a mesh or a point cloud at all?"
COORDINATES = "texture coordinates"
"""Name of texture coordinates in lists of what a file contains."""
WRONG_SUFFIX = "does the suffix fit the content?"
MAX_ELEMENTS = 40_000_000
"""Maximum number of vertices and faces, together, in one file: more than any method here can process."""
BASE_ELEMENTS = 3_500_000
"""Vertices and faces allowed in a file of any size; each 12 bytes of a binary file (24 of a text file) allow one more."""
DECIMAL_COMMA = "is that a decimal comma? export it with decimal points, split by spaces"
_ODD_COMMA = re.compile(rb"(?<!\S)(?![+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\S))[^\s,]*+,\S*")
_WORD = re.compile(rb"\S+")
_SPACE = np.zeros(256, bool)
_SPACE[[9, 10, 11, 12, 13, 32]] = True


@dataclass(frozen=True, eq=False)
class Raw:
    """Unchecked content of a file: positions (may contain NaN), faces, and sRGB colors with alpha in 0..1."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    colors: Float[Floats, "V 4"] | None = None
    skinned: Bool[Bools, " V"] | None = None  # mask of the vertices that joints in the file move
    meshes: tuple[
        tuple[tuple[str, ...], int], ...
    ] = ()  # per mesh, in scene order: (names of node and mesh), vertex count
    made_of: tuple[str, ...] = ()  # hashes, see `Shape.made_of`


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh textured with one image, ready to be written, in the unit of the file.

    `uv` has texture coordinates per face corner (u to the right, v down); `cutoff` is the alpha threshold of "mask".
    """

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    uv: Float[Floats, "F 3 2"]
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    cutoff: float = 0.5


def warn_if_no_triangles(name: str, n_listed: int, faces: Int[Ints, "F 3"]) -> None:
    """Warn if a file lists `n_listed` faces but none yields a triangle."""
    if n_listed and not len(faces):
        warn(f"{name}: none of its {n_listed} faces has three corners, so it is read as a point cloud")


def damaged(name: str, what: str) -> InputError:
    """Return the `InputError` for a file whose content is inconsistent or incomplete; `what` says how."""
    return InputError(f"{name}: {what[:300]}", "the file is damaged or was cut short; export or download it again")


def check_element_count(name: str, size: int, vertices: int, faces: int = 0, text: bool = False) -> None:
    """Raise `InputError` if a file of `size` bytes yields more vertices and faces than that size can plausibly encode.

    Each one takes up to 200 bytes of memory, and processing very many takes hours.
    """
    limit = min(MAX_ELEMENTS, BASE_ELEMENTS + size // (24 if text else 12))
    if vertices + faces > limit:
        message = f"{name} makes {vertices + faces:,} vertices and faces, of {limit:,} at most for its size"
        raise InputError(message, "decimate it, or export it as a binary .ply or .glb with fewer copies of its meshes")


def concatenated_ranges(starts: Int[Ints, " N"], sizes: Int[Ints, " N"], step: int = 1) -> Int[Ints, " M"]:
    """Concatenate the runs start, start + step, ..., where run i has sizes[i] elements."""
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.asarray(np.repeat(starts, sizes) + step * within)


def fan(corners: Int[Ints, " N"], sizes: Int[Ints, " P"]) -> Int[Ints, "F 3"]:
    """Triangulate polygons as fans: a b c d ... becomes a b c, a c d, ...

    `corners` lists the vertices of all polygons, one polygon after the other; `sizes` has the corner count of each.
    Polygons with fewer than 3 corners yield no triangles.
    """
    if len(sizes) and (sizes == 3).all():
        return corners.reshape(-1, 3)
    starts, triangles = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    second = concatenated_ranges(starts + 1, triangles)
    return np.stack([corners[np.repeat(starts, triangles)], corners[second], corners[second + 1]], axis=1)


def strips(corners: Int[Ints, " N"], sizes: Int[Ints, " P"]) -> Int[Ints, "F 3"]:
    """Split triangle strips, given as for `fan`: a b c d ... becomes a b c, c b d, ... (every other triangle flipped)."""
    counts = np.maximum(sizes - 2, 0)
    first = concatenated_ranges(np.cumsum(sizes) - sizes, counts)
    odd = concatenated_ranges(np.zeros(len(counts), np.int64), counts) % 2
    return np.stack([corners[first + odd], corners[first + 1 - odd], corners[first + 2]], axis=1)


def indices(name: str, values: NDArray[Any]) -> Ints:
    """Convert vertex indices to integers (text files are parsed as floats); `InputError` for NaN, inf or huge values."""
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
        raise damaged(name, "a face refers to a vertex that is not a number")
    return values.astype(np.int64)


def rgba_from_channels(channels: Float[Floats, "N C"]) -> Float[Floats, "N 4"]:
    """RGBA in 0..1 from 3 or 4 channels, missing alpha being 1.

    Values are taken to range to 255 if any is above 1, else to 1; this is decided separately for color and for alpha.
    """
    channels = np.nan_to_num(channels)
    colors = np.ones((len(channels), 4))
    for channel_range in (slice(0, 3), slice(3, channels.shape[1])):
        largest = 255.0 if (channels[:, channel_range] > 1).any() else 1.0
        colors[:, channel_range] = np.clip(channels[:, channel_range] / largest, 0.0, 1.0)
    return colors


def as_float32(values: Floats, suffix: str) -> NDArray[np.float32]:
    """Convert values to little-endian float32 for a file; `OutputError` if a finite value overflows."""
    with np.errstate(over="ignore"):
        written = values.astype("<f4")
    if not np.isfinite(written).all() and (np.isinf(written) & np.isfinite(values)).any():
        message = f"the shape reaches beyond {np.finfo(np.float32).max:.1e}, the largest number of a {suffix} file"
        raise OutputError(message, "save it as .ply, .obj or .off, or scale it first")
    return written


def concatenate_colors(colors: list[Float[Floats, "_ 4"] | None], counts: list[int]) -> Float[Floats, "V 4"] | None:
    """Concatenate the colors of several meshes, white for meshes without colors; None if no mesh has colors."""
    if all(color is None for color in colors):
        return None
    return np.vstack([np.ones((n, 4)) if c is None else c for c, n in zip(colors, counts, strict=True)])


def vertex_colors_from_faces(
    count: int, corners: Int[Ints, " N"], colors: Float[Floats, "N 4"]
) -> Float[Floats, "count 4"]:
    """Convert face colors to vertex colors: the mean, in linear light, of the adjacent faces; white for unused vertices.

    `corners` are the vertices of all faces, one face after the other; `colors` has the color of its face for each corner.
    """
    in_range = (corners >= 0) & (corners < count)
    corners, linear = corners[in_range], srgb_to_linear_alpha(colors[in_range])
    n_corners = np.bincount(corners, minlength=count)[:, None]
    total = np.stack([np.bincount(corners, channel, count) for channel in linear.T], axis=1)
    return np.where(n_corners > 0, linear_to_srgb_alpha(total / np.maximum(n_corners, 1)), 1.0)


def without_comments(text: bytes) -> bytes:
    """Remove everything from each ``#`` to the end of its line."""
    return re.sub(rb"#[^\n]*", b"", text) if b"#" in text else text


def parse_numbers(name: str, text: bytes) -> Float[Floats, " N"]:
    """Parse all whitespace-separated numbers of a text, including nan and inf; `InputError` for any other word.

    A decimal comma is accepted if no number of the text has a decimal point.
    """
    if not text.strip():
        return np.empty(0)
    if b"," in text:
        text = with_decimal_points(name, text)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # fromstring raises it at a word that is not a number
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            pass
    try:
        return np.fromiter((_number(word[0]) for word in _WORD.finditer(text)), np.float64)
    except ValueError as error:
        raise damaged(name, f"found {error} where a number should be") from None


def with_decimal_points(name: str, text: bytes) -> bytes:
    """Replace the decimal commas of whitespace-separated numbers by points; `InputError` where commas are ambiguous."""
    other = _ODD_COMMA.search(text)
    if other or b"." in text:
        mixed = "some of its numbers have a comma, others a point"
        found = mixed if other is None else f"found {other[0][:20].decode(errors='replace')!r} where a number should be"
        raise InputError(f"{name}: {found}", DECIMAL_COMMA)
    return text.replace(b",", b".")


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        if b"nan" in word.lower() or b"#" in word:  # 1.#QNAN, -nan(ind)
            return np.nan
    raise ValueError(repr(word[:20].decode(errors="replace")))


def words_per_line(text: bytes) -> Int[Ints, " lines"]:
    """Count the words of each non-blank line of a text."""
    if not text:
        return np.empty(0, np.int64)
    characters = np.frombuffer(text, np.uint8)
    space = _SPACE[characters]
    starts_word = ~space
    starts_word[1:] &= space[:-1]
    words_before = np.searchsorted(np.flatnonzero(starts_word), np.flatnonzero(characters == 10))
    counts = np.diff(words_before, prepend=0, append=np.count_nonzero(starts_word))
    return counts[counts > 0].astype(np.int64)


def columns(
    values: Float[Floats, " words"], counts: Int[Ints, " lines"], first: int, last: int
) -> Float[Floats, "lines width"]:
    """Select columns `first` to `last` (exclusive) from lines of unequal length.

    `values` has the values of all lines, flattened; `counts` has the number of values per line.
    """
    if len(counts) and (counts == counts[0]).all():
        return values.reshape(len(counts), -1)[:, first:last]
    starts = np.cumsum(counts) - counts
    return np.asarray(values[starts[:, None] + np.arange(first, last)])


def lines_starting_with(text: bytes, *words: bytes) -> list[tuple[bytes, Ints]]:
    """For each of the words, return the lines that start with it, without the word, and their line indices in the text.

    White space before the word is allowed.
    """
    characters = np.frombuffer(text + b"\n", np.uint8)
    ends = np.flatnonzero(characters == 10)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if ((characters[starts] == 32) | (characters[starts] == 9)).any():
        return lines_starting_with(re.sub(rb"^[ \t]+", b"", text, flags=re.MULTILINE), *words)
    lengths = np.diff(ends, prepend=-1)
    out = []
    for word in words:
        chosen = lengths > len(word) + 1
        for k, letter in enumerate(word):
            chosen &= characters[np.minimum(starts + k, ends)] == letter
        chosen &= _SPACE[characters[np.minimum(starts + len(word), ends)]]
        kept = characters[np.repeat(chosen, lengths)]
        first = np.cumsum(lengths[chosen]) - lengths[chosen]
        for k in range(len(word)):
            kept[first + k] = 32
        out.append((kept.tobytes(), np.flatnonzero(chosen)))
    return out
