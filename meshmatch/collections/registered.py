"""Registered shapes (same vertices and faces), the input of an atlas, read from a folder of meshes.

`Collection.registered` makes them of fits.
"""

from __future__ import annotations

import fnmatch
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats, Int, Ints, ShortRepr
from meshmatch.collections.atlas import Atlas
from meshmatch.collections.covariates import shorten_names
from meshmatch.collections.named_parts import WHOLE, Masks, groups_of, parts_of_file
from meshmatch.collections.sources import find_name, name_index, spellings
from meshmatch.collections.superimpose import Scale
from meshmatch.errors import InputError, warn
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape
from meshmatch.shapes.input_files import read_text, stem_of, suffix_of
from meshmatch.shapes.shape import Shape
from meshmatch.shapes.tables import read_by_suffix

_IN_MEMORY = 256 * 2**20  # bytes; larger arrays are kept in a temporary file
_MIN_SHAPES, _MAX_DEVIATIONS = 8, 6.0  # criteria of outliers; deviations are estimated robustly (MAD)
_MAX_SIZE_RATIO = 3.0  # larger ratios are probably a mix of units
_LINE_BYTES = 200  # memory needed per line
_LIST_HINT = (
    "write one name per line; for a table of specimens, --metadata TABLE --model 'shape ~ COLUMN' compares groups"
)


@dataclass(frozen=True, eq=False, repr=False)
class Registered(ShortRepr):
    """S shapes with the same vertices and faces, and their names.

    ``rotation`` turns them to y up and z to the front; None if that is not known. ``left_out`` maps names of shapes that
    were left out to the reason, "poor" or "asked". ``template`` is the hash of the template if the shapes are fits, else
    empty. ``parts`` returns the masks of named parts. ``partial`` are names of shapes that were fitted as a part.
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
        """Names of the partial shapes if there are whole ones as well; empty if all shapes are partial."""
        return self.partial if len(self.partial) < len(self.names) else ()

    def atlas(self, *, modes: int = 100, scale: Scale = "keep", robust: bool = False, align_by: str = WHOLE) -> Atlas:
        """Build the atlas of the shapes, see `Atlas.of`; ``align_by`` says what to superimpose, see `groups_of`.

        Warns if there are partial shapes among whole ones (`MeshmatchWarning`).
        """
        if self.cut:
            warn(
                f"{shorten_names(self.cut)}: cut, among whole shapes: what is missing was guessed, "
                "see --leave-out (`leave_out`)"
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


def match_names(names: Iterable[str], patterns: str | Sequence[str]) -> set[str]:
    """Names that match one or any of several patterns, with wildcards * and ?; `InputError` if a pattern matches none.

    A pattern may also be the name of a file: a name with its suffix.
    """
    index, found = name_index(names), set[str]()
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        meant = next(filter(None, (fnmatch.filter(index, each) for each in spellings(pattern))), ())
        if not meant:
            close = get_close_matches(pattern, index, n=1)
            raise InputError(f"there is no shape called {pattern}", f"did you mean {(close or list(index))[0]}?")
        found.update(index[each] for each in meant)
    return found


@contextmanager
def registered_meshes(folder: str | Path, leave_out: Sequence[str] = ()) -> Iterator[Registered]:
    """Read the meshes of a folder, named by their files without suffix, as a context; see `load_points`.

    ``leave_out`` are patterns of names to leave out, see `match_names`. `InputError`: fewer than three meshes, two of
    the same name, or meshes that do not share vertices and faces.
    """
    files = sorted(path for path in Path(folder).iterdir() if suffix_of(path) in PLAIN_SUFFIXES and path.is_file())
    all_names = [stem_of(path) for path in files]
    duplicate = next((name for name, count in Counter(all_names).items() if count > 1), None)
    if duplicate is not None:
        raise InputError(f"{folder} holds two meshes called {duplicate}", "an atlas needs different names")
    out = dict.fromkeys(sorted(match_names(all_names, leave_out)), "asked")
    names = tuple(name for name in all_names if name not in out)
    files = [path for path, name in zip(files, all_names, strict=True) if name not in out]
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
                hint = "faces are reversed, as in a mirror image: meshmatch export --place template flips them back"
                raise InputError(what, hint)
            raise InputError(what, "register the shapes first: meshmatch fit")
        return shape.verts

    with load_points(len(files), first.V, read) as points:
        yield Registered(points, first.faces, names, None, out, parts=lambda: parts_of_file(files[0]))


@contextmanager
def load_points(
    count: int, vertices: int, read: Callable[[int], Float[Floats, "V 3"]]
) -> Iterator[Float[Floats, "S V 3"]]:
    """Read shapes into one array, in memory or, above 256 MiB, in a temporary file that is removed when the block ends.

    ``read`` gives the vertices of a shape by its number; it is called once for each, in order.
    """
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
    """Read names of shapes from a file (.txt, .csv), one per line, with or without suffix.

    Shapes that were left out are skipped. `InputError` for an unknown name, or a file that cannot be read.
    """
    found = []
    known = set(shapes.names)
    index = name_index([*shapes.names, *shapes.left_out])

    def read(path: Path) -> list[str]:
        return read_text(path, _LINE_BYTES).splitlines()

    for line in read_by_suffix(path, {".txt": read, ".csv": read}, "names of shapes", _LIST_HINT):
        word = line.strip()
        if not word:
            continue
        meant = find_name(word, index)
        if meant is None:
            close = get_close_matches(word, shapes.names, n=1)
            hint = f"did you mean {close[0]}?" if close else _LIST_HINT
            raise InputError(f"{Path(path).name}: there is no shape called {word}", hint)
        if meant in known:
            found.append(meant)
    return found


def size_ratio(sizes: Sequence[float] | Floats) -> float:
    """Ratio of the largest size to the smallest."""
    return float(np.max(sizes) / np.min(sizes))


def mixed_units(names: Sequence[str], sizes: Sequence[float] | Floats) -> str:
    """A warning if the sizes of shapes differ so much that their files may have different units; empty if not."""
    if len(sizes) == 0 or (ratio := size_ratio(sizes)) <= _MAX_SIZE_RATIO:
        return ""
    large, small = names[int(np.argmax(sizes))], names[int(np.argmin(sizes))]
    words = f"{ratio:,.0f}" if ratio >= 100 else f"{ratio:.3g}"
    return f"{large} is {words} times as large as {small}: do the files have one unit?"


def find_outliers(distances: Float[Floats, " S"]) -> Int[Ints, " N"]:
    """Rows of shapes that are so far from the mean, compared with most, that they are probably cut or of another kind.

    One in thirty collections of normal shapes has a false positive. Empty for fewer than eight shapes.
    """
    if len(distances) < _MIN_SHAPES:
        return np.empty(0, np.int64)
    beyond = distances - np.median(distances)
    return np.flatnonzero(beyond > _MAX_DEVIATIONS * 1.4826 * np.median(np.abs(beyond)) + 1e-9 * distances.max())
