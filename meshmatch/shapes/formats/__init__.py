"""Files of shapes: bytes to plain arrays, and a `Shape` to bytes. Here is what the readers of several formats share.

A map answers for every vertex of a file, so readers keep them all, in order, and never allocate what a header merely
promises. The readers are our own, because of what trimesh 5.2 does (measured):

- ply: text takes 1.4 s instead of 0.4 s for 164,000 vertices; importing trimesh takes 0.7 s, and ply is what
  benchmarks and scans come in. Triangle strips become points, and 16-bit colors lose their upper byte.
- obj: a file with several materials becomes several meshes, each with all the vertices.
- off: vertex colors are lost, and a face that is cut short vanishes without a word.
- stl: bytes behind the triangles, a count of 0 or -1, a text without its last line are refused.
- gltf: meshes come in another order than the scene's (`Rogue.glb`), skins are ignored, strips without indices fail.

Its writers round: ply to 32 bits, off to ten digits and obj to eight behind the point (1e-20 becomes 0), colors of
glb to 8 bits of linear light, too few for dark ones. Ours keep every bit of ply, off and obj positions.
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
from meshmatch.shapes.colors import light, seen

NO_FACES = np.empty((0, 3), np.int64)
NO_MESH = "is it a mesh or a point cloud at all?"
WRONG_SUFFIX = "does the suffix fit the content?"
MOST_PLACES = 40_000_000
"""Vertices and faces of one file: more than anything here can work on."""
FEW_PLACES = 3_500_000
"""How many a file of any size may have; and one more for every 12 of its bytes, or 24 where it is text."""
DECIMAL_COMMA = "is that a decimal comma? export it with decimal points, split by spaces"
_ODD_COMMA = re.compile(rb"(?<!\S)(?![+-]?\d*,\d+(?:[eE][+-]?\d+)?(?!\S))[^\s,]*+,\S*")
_WORD = re.compile(rb"\S+")
_SPACE = np.zeros(256, bool)
_SPACE[[9, 10, 11, 12, 13, 32]] = True


@dataclass(frozen=True, eq=False)
class Raw:
    """What a file says, unchecked: positions, maybe NaN; faces; sRGB colors and alpha in 0..1."""

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    colors: Float[Floats, "V 4"] | None = None
    skinned: Bool[Bools, " V"] | None = None  # vertices that joints of the file move
    meshes: tuple[tuple[tuple[str, ...], int], ...] = ()  # of a scene, in order: names (of node and mesh), vertices
    made_of: tuple[str, ...] = ()  # hashes, see `Shape.made_of`


@dataclass(frozen=True, eq=False)
class Textured:
    """A mesh that wears one image, ready to be written, in the unit of the file.

    `uv` belongs to each corner: u to the right, v down; `cutoff` is the threshold of "mask".
    """

    verts: Float[Floats, "V 3"]
    faces: Int[Ints, "F 3"]
    uv: Float[Floats, "F 3 2"]
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    cutoff: float = 0.5


def tell_lost_faces(name: str, listed: int, faces: Int[Ints, "F 3"]) -> None:
    """Say that a file has faces, but none with three corners."""
    if listed and not len(faces):
        warn(f"{name}: none of its {listed} faces has three corners, so it is read as a point cloud")


def damaged(name: str, what: str) -> InputError:
    """The error for a file that does not hold what it promises."""
    return InputError(f"{name}: {what[:300]}", "the file is damaged or was cut short; export or download it again")


def check_places(name: str, size: int, vertices: int, faces: int = 0, text: bool = False) -> None:
    """Refuse a file that makes more vertices and faces than its bytes can mean (`InputError`): each takes up to 200 bytes
    of memory, and hours where there are many.
    """
    most = min(MOST_PLACES, FEW_PLACES + size // (24 if text else 12))
    if vertices + faces > most:
        many = f"{name} makes {vertices + faces:,} vertices and faces, of {most:,} at most for its size"
        raise InputError(many, "decimate it, or export it as a binary .ply or .glb with fewer copies of its meshes")


def runs(starts: Int[Ints, " N"], sizes: Int[Ints, " N"], step: int = 1) -> Int[Ints, " M"]:
    """start, start + step, ... of every run, one run after the other."""
    within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.asarray(np.repeat(starts, sizes) + step * within)


def fan(corners: Int[Ints, " N"], sizes: Int[Ints, " P"]) -> Int[Ints, "F 3"]:
    """Triangles of polygons: `corners` one polygon after the other, `sizes` how many each has.

    A polygon a b c d ... becomes a b c, a c d, ...; one of fewer than 3 corners becomes nothing.
    """
    if len(sizes) and (sizes == 3).all():
        return corners.reshape(-1, 3)
    starts, triangles = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    second = runs(starts + 1, triangles)
    return np.stack([corners[np.repeat(starts, triangles)], corners[second], corners[second + 1]], axis=1)


def strips(corners: Int[Ints, " N"], sizes: Int[Ints, " P"]) -> Int[Ints, "F 3"]:
    """Triangles of strips, given as to `fan`: a b c d ... becomes a b c, c b d, ..., every other one turned over."""
    counts = np.maximum(sizes - 2, 0)
    first = runs(np.cumsum(sizes) - sizes, counts)
    odd = runs(np.zeros(len(counts), np.int64), counts) % 2
    return np.stack([corners[first + odd], corners[first + 1 - odd], corners[first + 2]], axis=1)


def indices(name: str, values: NDArray[Any]) -> Ints:
    """Numbers of vertices, or `InputError`: floats are what text files are read as."""
    if values.dtype.kind == "f" and not (np.abs(values) < 2**53).all():
        raise damaged(name, "a face refers to a vertex that is not a number")
    return values.astype(np.int64)


def painted(channels: Float[Floats, "N C"]) -> Float[Floats, "N 4"]:
    """Colors of 3 or 4 channels, which count to 255 if one is above 1, else to 1; of alpha this is told apart."""
    channels = np.nan_to_num(channels)
    colors = np.ones((len(channels), 4))
    for some in (slice(0, 3), slice(3, channels.shape[1])):
        largest = 255.0 if (channels[:, some] > 1).any() else 1.0
        colors[:, some] = np.clip(channels[:, some] / largest, 0.0, 1.0)
    return colors


def as_float32(values: Floats, suffix: str) -> NDArray[np.float32]:
    """Values for a file of 32-bit floats; `OutputError` for finite ones that are too large for these."""
    with np.errstate(over="ignore"):
        written = values.astype("<f4")
    if not np.isfinite(written).all() and (np.isinf(written) & np.isfinite(values)).any():
        what = f"the shape reaches beyond {np.finfo(np.float32).max:.1e}, the largest number of a {suffix} file"
        raise OutputError(what, "save it as .ply, .obj or .off, or scale it first")
    return written


def joined_colors(colors: list[Float[Floats, "_ 4"] | None], counts: list[int]) -> Float[Floats, "V 4"] | None:
    """Colors of meshes one after the other, white for those without; None if none has any."""
    if all(color is None for color in colors):
        return None
    return np.vstack([np.ones((n, 4)) if c is None else c for c, n in zip(colors, counts, strict=True)])


def colors_of_faces(count: int, corners: Int[Ints, " N"], colors: Float[Floats, "N 4"]) -> Float[Floats, "count 4"]:
    """Colors of vertices where a file has them for faces: the mean light of those around; white where there are none.

    `corners` are the vertices of all faces, one face after the other, each with the color of its face.
    """
    fine = (corners >= 0) & (corners < count)
    corners, own = corners[fine], light(colors[fine])
    many = np.bincount(corners, minlength=count)[:, None]
    total = np.stack([np.bincount(corners, channel, count) for channel in own.T], axis=1)
    return np.where(many > 0, seen(total / np.maximum(many, 1)), 1.0)


def without_comments(text: bytes) -> bytes:
    return re.sub(rb"#[^\n]*", b"", text) if b"#" in text else text


def numbers(name: str, text: bytes) -> Float[Floats, " N"]:
    """All the whitespace-separated numbers of a text, fast, nan and inf included; `InputError` for other words.

    A decimal comma counts as a decimal point where no number of the text has a point.
    """
    if not text.strip():
        return np.empty(0)
    if b"," in text:
        text = with_points(name, text)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # how fromstring says that it met a word
        try:
            return np.fromstring(text, dtype=np.float64, sep=" ")
        except (DeprecationWarning, ValueError):
            pass
    try:
        return np.fromiter((_number(word[0]) for word in _WORD.finditer(text)), np.float64)
    except ValueError as error:
        raise damaged(name, f"found {error} where a number should be") from None


def with_points(name: str, text: bytes) -> bytes:
    """A text of numbers that are split by spaces, its decimal commas made points; `InputError` where commas may mean
    something else.
    """
    other = _ODD_COMMA.search(text)
    if other or b"." in text:
        mixed = "some of its numbers have a comma, others a point"
        odd = mixed if other is None else f"found {other[0][:20].decode(errors='replace')!r} where a number should be"
        raise InputError(f"{name}: {odd}", DECIMAL_COMMA)
    return text.replace(b",", b".")


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        if b"nan" in word.lower() or b"#" in word:  # 1.#QNAN, -nan(ind)
            return np.nan
    raise ValueError(repr(word[:20].decode(errors="replace")))


def words_per_line(text: bytes) -> Int[Ints, " lines"]:
    """How many words each non-blank line of a text has."""
    if not text:
        return np.empty(0, np.int64)
    characters = np.frombuffer(text, np.uint8)
    space = _SPACE[characters]
    begins = ~space
    begins[1:] &= space[:-1]
    before = np.searchsorted(np.flatnonzero(begins), np.flatnonzero(characters == 10))
    counts = np.diff(before, prepend=0, append=np.count_nonzero(begins))
    return counts[counts > 0].astype(np.int64)


def columns(
    values: Float[Floats, " words"], counts: Int[Ints, " lines"], first: int, last: int
) -> Float[Floats, "lines width"]:
    """Columns `first` to `last` (excluded) of lines of unequal length: flat values, and words per line."""
    if len(counts) and (counts == counts[0]).all():
        return values.reshape(len(counts), -1)[:, first:last]
    starts = np.cumsum(counts) - counts
    return np.asarray(values[starts[:, None] + np.arange(first, last)])


def lines_of(text: bytes, *words: bytes) -> list[tuple[bytes, Ints]]:
    """For each of the given first words: its lines without that word, and which lines of the text they are.

    Spaces in front of the word are allowed.
    """
    characters = np.frombuffer(text + b"\n", np.uint8)
    ends = np.flatnonzero(characters == 10)
    starts = np.concatenate([[0], ends[:-1] + 1])
    if ((characters[starts] == 32) | (characters[starts] == 9)).any():
        return lines_of(re.sub(rb"^[ \t]+", b"", text, flags=re.MULTILINE), *words)
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
