"""The sets of the benchmark: their shapes, pairs and ground truth.

docs/datasets.md says where they come from and how to lay them out; `meshmatch.experiments.bench.datasets` checks a
folder. In short, *landmark k is the same body point on every shape of a set*; sets differ in how the vertices of landmarks
are given:

- ``shrec19``: ``N.landmarks.npy`` (6890,) vertex ids; the pairs of ``pairs.txt``.
- ``scape``: vertex i is landmark i on every shape (the triangulations differ); all ordered pairs.
- ``faust``: ``tr_reg_NNN.landmarks.npy`` (5000,) vertex ids; all ordered pairs, in the groups same subject and
  cross subject. Ten consecutive numbers are one subject.

- ``faust-outliers``: row i of every cloud of ``faust_outliers.npy``, (30, 1000, 3) in metres. Many points are not on the
  surface; all of them count. There is no mesh, so errors are Euclidean.

``scape-pcn`` is ``scape`` as the paper's *PC+N*: methods get only the vertices, with Gaussian noise of 1 % of the bounding
box's diagonal; errors are measured on the original mesh.

Several landmarks may share a vertex where a mesh is coarser than the landmarks. All of them count.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import permutations
from pathlib import Path

import numpy as np

from meshmatch.arrays import Int, Ints
from meshmatch.errors import InputError, OptionError
from meshmatch.experiments.runner import evenly_spread, files_in
from meshmatch.shapes.files import load_shape
from meshmatch.shapes.shape import Shape

Pair = tuple[str, str]
Shapes = Mapping[str, Shape]
SET_NAMES = ("shrec19", "scape", "faust")
CLOUD_SET = "scape-pcn"
OUTLIERS, OUTLIERS_FILE = "faust-outliers", "faust_outliers.npy"
ALL_SETS = (*SET_NAMES, CLOUD_SET, OUTLIERS)
NOISE = 0.01  # standard deviation along each axis, as a fraction of the bounding box's diagonal


@dataclass(frozen=True)
class BenchSet:
    """A set of the benchmark: names of shapes, and ordered pairs ``(source, target)`` of them."""

    name: str
    folder: Path
    shapes: tuple[str, ...]
    pairs: tuple[Pair, ...]

    def path(self, shape: str) -> Path:
        """Return the path of a shape's file."""
        return self.folder / f"{shape}.ply"

    def shape(self, shape: str) -> Shape:
        """Load a shape with all vertices, in the file's order."""
        if self.name == OUTLIERS:
            return load_clouds(self.folder)[shape]
        return load_shape(self.path(shape))

    def seen(self, shape: str) -> Shape:
        """Return the shape that methods get: for ``scape-pcn`` the vertices with noise, seeded by the shape's index."""
        whole = self.shape(shape)
        if self.name != CLOUD_SET:
            return whole
        noise = np.random.default_rng(self.shapes.index(shape)).standard_normal(whole.verts.shape)
        return Shape(whole.verts + NOISE * whole.diagonal * noise, np.empty((0, 3), np.int64), whole.name)

    def landmarks(self, shape: str) -> Int[Ints, " N"]:
        """Return the vertex ids of the landmarks; N is the same for all shapes of a set."""
        if self.name == OUTLIERS:
            return np.arange(self.shape(shape).V)
        return _landmarks(self.path(shape), self.folder.name == "scape")

    def group(self, pair: Pair) -> str:
        """Return the group of a pair within its set; empty if the set has no groups."""
        if self.name != "faust":
            return ""
        return "same subject" if len({_faust_subject(name) for name in pair}) == 1 else "cross subject"


def load_set(name: str, data: Path) -> BenchSet:
    """Find a set in the benchmark's folder and list its shapes and pairs.

    Raises
    ------
    OptionError
        There is no set of this name.
    InputError
        The folder lacks the set, or a shape named by its pairs.
    """
    if name not in ALL_SETS:
        raise OptionError(f"unknown set '{name}'", f"choose from {', '.join(ALL_SETS)}")
    if name == OUTLIERS:
        clouds = tuple(load_clouds(Path(data)))
        return BenchSet(name, Path(data), clouds, tuple(permutations(clouds, 2)))
    folder = Path(data) / ("scape" if name == CLOUD_SET else name)
    shapes = tuple(sorted((path.stem for path in files_in(folder, "*.ply")), key=_by_number))
    if name == "shrec19":
        try:
            lines = (folder / "pairs.txt").read_text(encoding="ascii").split("\n")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"cannot read {folder / 'pairs.txt'}", "a line for each pair: source target") from error
        pairs = tuple((words[0], words[1]) for words in (line.split() for line in lines) if words)
    else:
        pairs = tuple(permutations(shapes, 2))
    missing = sorted({shape for pair in pairs for shape in pair} - set(shapes))
    if missing:
        raise InputError(f"{folder} lacks {', '.join(missing)}, named by its pairs")
    return BenchSet(name, folder, shapes, pairs)


@cache
def load_clouds(folder: Path) -> dict[str, Shape]:
    """Load the clouds with outliers, by name.

    Raises
    ------
    InputError
        The file is missing or is not an (N, P, 3) array.
    """
    path = folder / OUTLIERS_FILE
    try:
        points = np.load(path, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read {path}", "--data names the folder that holds it") from error
    if points.ndim != 3 or points.shape[2] != 3:
        raise InputError(f"{path} holds {points.shape}, not (N, P, 3)")
    none = np.empty((0, 3), np.int64)
    return {f"cloud {k}": Shape(cloud, none, f"cloud {k}") for k, cloud in enumerate(points)}


def _by_number(name: str) -> tuple[int, str]:
    """Sort key: numeric names by value, others by name."""
    return (int(name), "") if name.isdigit() else (0, name)


def _faust_subject(name: str) -> int:
    return int(name.removeprefix("tr_reg_")) // 10


@cache
def _landmarks(path: Path, every_vertex: bool) -> Int[Ints, " N"]:
    """Read the landmarks of a shape; `InputError` if they are not vertices of it."""
    shape = load_shape(path)
    if every_vertex:
        ids = np.arange(shape.V)
    else:
        ids = np.load(path.with_suffix(".landmarks.npy"), allow_pickle=False).astype(np.int64)
    if ids.ndim != 1 or not ids.size or ids.min() < 0 or ids.max() >= shape.V:
        raise InputError(f"the landmarks of {path} do not name its vertices")
    ids.setflags(write=False)
    return ids


def ordered_pairs(names: Iterable[str], limit: int | None = None) -> list[Pair]:
    """Return all ordered pairs, or ``limit`` of them, evenly spread."""
    return evenly_spread(list(permutations(names, 2)), limit)


def load_folder(folder: Path, suffix: str) -> tuple[dict[str, Shape], Mapping[str, Ints]]:
    """Load all shapes of a folder and the ground truth array of each (``NAME`` + suffix), by name.

    Raises
    ------
    InputError
        The folder is missing, or the ground truth of a shape.
    """
    files = files_in(folder, "*.ply")
    paths = {file.stem: file.with_name(file.stem + suffix) for file in files}
    if missing := [name for name, path in paths.items() if not path.is_file()]:
        raise InputError(f"{missing[0]} has no {suffix}")
    truth = {name: np.load(path, allow_pickle=False) for name, path in paths.items()}
    return {file.stem: load_shape(file) for file in files}, truth
