"""Shapes that share their vertices, as an atlas needs them: from a folder of meshes here, from fits in `collection`."""

from __future__ import annotations

import fnmatch
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from meshmatch.arrays import Brief, Float, Floats, Int, Ints
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.covariates import some
from meshmatch.collections.named_parts import WHOLE, Masks, groups_of, parts_of_file
from meshmatch.collections.superimpose import Scale
from meshmatch.errors import InputError, warn
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape
from meshmatch.shapes.input_files import read_text, stem_of, suffix_of
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import read_by_suffix

_IN_MEMORY = 256 * 2**20  # bytes; more are kept in a temporary file
_TELLING, _UNLIKE = 8, 6.0  # shapes; deviations, by the median absolute one
_ODD = 3.0  # sizes further apart than this are probably units
_LINE = 200  # bytes of memory for a line
_ONE_A_LINE = (
    "write one name a line; of a table of specimens, --metadata TABLE --model 'shape ~ COLUMN' compares groups"
)


@dataclass(frozen=True, eq=False, repr=False)
class Registered(Brief):
    """S shapes with the same vertices and faces, and their names.

    ``rotation`` leads into y up, z to the front, where it is known. ``left_out`` are names of shapes that do not count, and
    why: "poor" or "asked". ``template`` is the hash of the template, if they are fits. ``parts`` gives parts by name.
    ``partial`` are names of fits to a part of a shape.
    """

    points: Float[Floats, "S V 3"]
    faces: Int[Ints, "F 3"]
    names: tuple[str, ...]
    rotation: Float[Floats, "3 3"] | None
    left_out: dict[str, str]
    template: str = ""
    parts: Callable[[], Masks] = dict
    partial: tuple[str, ...] = ()

    @property
    def cut(self) -> tuple[str, ...]:
        """Names of cut shapes among whole ones: none, where all are cut alike."""
        return self.partial if len(self.partial) < len(self.names) else ()

    def atlas(self, *, modes: int = 100, scale: Scale = "keep", robust: bool = False, align_by: str = WHOLE) -> Atlas:
        """Their atlas; see `Atlas.of`. ``align_by`` is what is superimposed, as `groups_of` has it.

        Warns of cut shapes among whole ones (`MeshmatchWarning`).
        """
        if self.cut:
            warn(
                f"{some(self.cut)}: cut, among whole shapes, what is missing was guessed: see --leave-out (`leave_out`)"
            )
        groups = groups_of(Shape(self.points[0], self.faces), align_by, self.parts)
        return Atlas.of(
            self.points,
            self.faces,
            self.names,
            modes=modes,
            scale=scale,
            robust=robust,
            template=self.template,
            groups=groups,
        )


def matching(names: Iterable[str], patterns: Sequence[str]) -> set[str]:
    """Names that match some patterns, in which * and ? stand for any characters; `InputError` for one that matches none."""
    known, found = list(names), set[str]()
    for pattern in patterns:
        meant = fnmatch.filter(known, pattern) or fnmatch.filter(known, os.path.splitext(pattern)[0])
        if not meant:
            close = get_close_matches(pattern, known, n=1)
            raise InputError(f"there is no shape called {pattern}", f"did you mean {(close or known)[0]}?")
        found.update(meant)
    return found


@contextmanager
def registered_meshes(folder: str | Path, leave_out: Sequence[str] = ()) -> Iterator[Registered]:
    """The meshes of a folder, by the names of their files without suffix; held in memory, or in a file until the block ends.
    ``leave_out`` are names of some that do not count, as of `matching`.

    `InputError`: fewer than three meshes, two of one name, or meshes that do not share vertices and faces.
    """
    files = sorted(path for path in Path(folder).iterdir() if suffix_of(path) in PLAIN_SUFFIXES and path.is_file())
    called = [stem_of(path) for path in files]
    twice = next((name for name, count in Counter(called).items() if count > 1), None)
    if twice is not None:
        raise InputError(f"{folder} holds two meshes called {twice}", "an atlas needs different names")
    out = dict.fromkeys(sorted(matching(called, leave_out)), "asked")
    names = tuple(name for name in called if name not in out)
    files = [path for path, name in zip(files, called, strict=True) if name not in out]
    if len(files) < 3:
        raise InputError(f"{folder} holds {len(files)} meshes", "an atlas needs three or more, registered")
    first = load_shape(files[0])
    if first.is_cloud:
        raise InputError(f"{files[0].name} has no faces", "an atlas is made of meshes")

    def read(number: int) -> Float[Floats, "V 3"]:
        shape = load_shape(files[number])
        if shape.V != first.V or not np.array_equal(shape.faces, first.faces):
            what = f"{files[number].name} does not have the vertices and faces of {files[0].name}"
            if shape.V == first.V and np.array_equal(np.sort(shape.faces, axis=1), np.sort(first.faces, axis=1)):
                hint = (
                    "faces look the other way, as of a mirror image: meshmatch export --place template turns those over"
                )
                raise InputError(what, hint)
            raise InputError(what, "register the shapes first: meshmatch fit")
        return shape.verts

    with held(len(files), first.V, read) as points:
        yield Registered(points, first.faces, names, None, out, parts=lambda: parts_of_file(files[0]))


@contextmanager
def held(count: int, vertices: int, read: Callable[[int], Float[Floats, "V 3"]]) -> Iterator[Float[Floats, "S V 3"]]:
    """Shapes, each read once: in memory, or if they are many in a file until the block ends."""
    size = count, vertices, 3
    with tempfile.TemporaryDirectory() as folder:
        points: Floats
        if 8 * count * vertices * 3 > _IN_MEMORY:
            points = np.lib.format.open_memmap(Path(folder, "points.npy"), mode="w+", dtype=np.float64, shape=size)
        else:
            points = np.empty(size)
        for number in range(count):
            points[number] = read(number)
        yield points


def read_group(path: str | Path, shapes: Registered) -> list[str]:
    """The names in a file (.txt, .csv), one a line, as the shapes have them: a name may have a suffix. Those that are left
    out do not count. `InputError` for a name that is unknown, or a file that cannot be read.
    """
    found = []
    known = set(shapes.names)

    def read(path: Path) -> list[str]:
        return read_text(path, _LINE).splitlines()

    for line in read_by_suffix(path, {".txt": read, ".csv": read}, "names of shapes", _ONE_A_LINE):
        word = line.strip()
        if not word:
            continue
        meant = [name for name in (word, os.path.splitext(word)[0]) if name in known or name in shapes.left_out]
        if not meant:
            close = get_close_matches(word, shapes.names, n=1)
            hint = f"did you mean {close[0]}?" if close else _ONE_A_LINE
            raise InputError(f"{Path(path).name}: there is no shape called {word}", hint)
        if meant[0] in known:
            found.append(meant[0])
    return found


def size_ratio(sizes: Sequence[float] | Floats) -> float:
    """How many times as large the largest shape is as the smallest."""
    return float(np.max(sizes) / np.min(sizes))


def mixed_units(names: Sequence[str], sizes: Sequence[float] | Floats) -> str:
    """What to say where sizes of shapes are so unlike that their files may have several units; else empty."""
    if len(sizes) == 0 or (times := size_ratio(sizes)) <= _ODD:
        return ""
    large, small = names[int(np.argmax(sizes))], names[int(np.argmin(sizes))]
    words = f"{times:,.0f}" if times >= 100 else f"{times:.3g}"
    return f"{large} is {words} times as large as {small}: do the files have one unit?"


def outlying(distances: Float[Floats, " S"]) -> Int[Ints, " N"]:
    """Rows of shapes that are so much further from the mean than most that they are probably cut, or of another kind.

    One collection in thirty of normal shapes has one; of fewer than eight nothing is said.
    """
    if len(distances) < _TELLING:
        return np.empty(0, np.int64)
    beyond = distances - np.median(distances)
    return np.flatnonzero(beyond > _UNLIKE * 1.4826 * np.median(np.abs(beyond)) + 1e-9 * distances.max())
