"""What an implicit model learns from: points of shapes with normals and signed distances, as far as these are known.

Watertight meshes know both; clouds their normals alone (a file's are estimated, `.npz` keeps true ones); `.npz` files with
``points`` and ``distances`` the signed distances, negative inside. Each shape is centred and scaled by its box into the
cube from -1 to 1; none is turned.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from meshmatch.arrays import Brief, Float, Floats, Floats32
from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import is_watertight
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape
from meshmatch.shapes.input_files import existing, read_npz, suffix_of
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

FILLED = 0.85
"""Half the longest side of a shape's box, in the cube of half side 1."""
FAR = 0.05
"""From the surface, in the cube: where a distance of zero is an error."""
ARRAYS = ("points", "distances", "normals")
_DENSE, _MOST, _ALL = 40_000, 16_384, 40_000_000  # surface points; samples of a shape, and of a folder
_HUGE = 1e100  # whose square is a number
_BEYOND = 1e30  # half sides of the cube, still a float32
_NEAR = 0.05  # deviation of the free points that lie near a surface
_KINDS = {*PLAIN_SUFFIXES, ".npz"} - {".npy"}  # arrays beside shapes are labels or landmarks


@dataclass(frozen=True, eq=False, repr=False)
class ImplicitSamples(Brief):
    """N samples of each of S shapes in the cube, the first half on the surface or nearest to it: point, signed distance (NaN
    where only known to be off the surface), normal (0 where it is not known).
    """

    names: tuple[str, ...]
    frames: tuple[Frame, ...]  # from each file into the cube
    rows: Float[Floats32, "S N 7"]


def read_implicit_samples(folder: str | Path, seed: int = 0) -> ImplicitSamples:
    """Samples of all shapes of a folder, the same for a seed.

    `InputError` if there are fewer than two, or one cannot be read or tells no inside: a mesh with holes.
    """
    files = sorted(file for file in Path(folder).glob("*") if suffix_of(file) in _KINDS)
    names = tuple(file.stem for file in files)
    if len(files) < 2 or len(set(names)) < len(names):
        hint = f"give a folder of watertight meshes, clouds or .npz ({', '.join(sorted(_KINDS))}), each once"
        raise InputError(f"{folder} has {len(set(names))} shapes of different names; two are needed", hint)
    N = int(np.clip(_ALL // len(files), 1024, _MOST)) // 4 * 4
    found = [samples_of(file, N, np.random.default_rng([seed, number])) for number, file in enumerate(files)]
    frames, rows = zip(*found, strict=True)
    return ImplicitSamples(names, frames, np.stack(rows))


@dataclass(frozen=True, eq=False, repr=False)
class SampledShape(Shape):
    """The points of ``.npz`` samples as a cloud, in their order; with their distances, or normals of length 1."""

    distances: Float[Floats, " N"] = field(kw_only=True)
    normals: Float[Floats, "N 3"] = field(kw_only=True)


def load_source(file: str | Path) -> Shape:
    """The shape of a file; of ``.npz`` samples a `SampledShape`."""
    if Path(file).suffix.lower() != ".npz":
        return load_shape(file)
    points, distances, normals = _arrays(Path(file))
    return SampledShape(points, np.empty((0, 3), np.int64), Path(file).name, distances=distances, normals=normals)


def samples_of(
    source: Shape | str | Path, N: int, rng: np.random.Generator, closed: bool = True
) -> tuple[Frame, Float[Floats32, "N 7"]]:
    """The frame of a shape or a file, and ``N`` samples (a multiple of 4) as in `ImplicitSamples`.

    Where it need not be ``closed``, a mesh with holes is taken as a cloud with normals. `InputError` as above.
    """
    shape = source if isinstance(source, Shape) else load_source(source)
    if isinstance(shape, SampledShape):
        points, distances, normals = shape.verts, shape.distances, shape.normals
        solid = False
    else:
        solid = not shape.is_cloud and shape.invalid is None and is_watertight(shape.faces)
        if closed and not (solid or shape.is_cloud):
            raise InputError(
                f"{shape.name} is not watertight: it has no inside", "close its holes, or give it as a point cloud"
            )
        count = shape.V if shape.is_cloud else _DENSE
        if solid or shape.invalid is None:
            drawn = sample_surface(shape, count, rng)
        else:
            kept = np.flatnonzero(~shape.invalid)
            drawn = sample_surface(Shape(shape.verts[kept], np.empty((0, 3), np.int64), shape.name), len(kept), rng)
        points, distances, normals = drawn.points, np.zeros(0), drawn.normals
    inside = points[distances < 0] if len(distances) else points
    if len(inside) < 4:
        what = f"{shape.name or 'the shape'} has {len(inside)} points of the shape; four are needed"
        raise InputError(what, "distances are negative inside")
    low, high = inside.min(0), inside.max(0)
    frame = Frame(float((high - low).max()) / (2 * FILLED), np.eye(3), (low + high) / 2)
    with np.errstate(over="ignore"):
        points, distances = frame.apply(points), distances / frame.scale
    if not all((np.abs(each) < _BEYOND).all() for each in (points, distances)):
        raise InputError(f"{shape.name or 'the shape'} has points far beyond the shape", "leave these points out")
    if len(distances):
        rows = _nearer_first(points, distances, N, rng)
    else:
        rows = free_and_surface(points, normals, N, rng) if solid else off_surface(points, normals, N, rng)
    return frame, rows.astype(np.float32)


def _arrays(file: Path) -> tuple[Floats, Floats, Floats]:
    """Points, and either their distances or their normals."""
    held = read_npz(existing(file), ARRAYS)
    points, distances, normals = (np.asarray(held.get(name, ())) for name in ARRAYS)
    alike = distances.shape == points.shape[:1] or normals.shape == points.shape
    if not (points.ndim == 2 and points.shape[1] == 3 and alike and len(points)):
        what = f"{file.name} needs points (N, 3), and distances (N,) or normals (N, 3)"
        raise InputError(what, "see docs/formats.md")
    found = (points, distances, normals)
    if any(each.dtype.kind not in "fiu" or not (np.abs(each.astype(np.float64)) < _HUGE).all() for each in found):
        raise InputError(f"{file.name} holds numbers that are not finite, or huge", "leave these points out")
    points, distances, normals = (each.astype(np.float64) for each in found)
    if not len(distances):
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return points, distances, normals


def _nearer_first(
    points: Float[Floats, "P 3"], distances: Float[Floats, " P"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Given samples: half of the quarter that is nearest to the surface, half of all."""
    kept = np.flatnonzero((np.abs(points) <= 1).all(1))
    near = kept[np.argsort(np.abs(distances[kept]), kind="stable")[: max(1, len(kept) // 4)]]
    rows = np.concatenate([rng.choice(near, N // 2), rng.choice(kept, N // 2)])
    return np.column_stack([points[rows], distances[rows], np.zeros((N, 3))])


def _surface(points: Floats, normals: Floats, count: int, rng: np.random.Generator) -> Float[Floats, "N 7"]:
    on = rng.choice(len(points), count, replace=len(points) < count)
    return np.column_stack([points[on], np.zeros(count), normals[on]])


def off_surface(
    points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Half on the surface; half anywhere in the cube but near it, where no distance is said."""
    free = rng.uniform(-1, 1, (8 * N, 3))
    free = free[cKDTree(points).query(free, distance_upper_bound=FAR)[0] > FAR][: N // 2]
    if len(free) < N // 2:
        raise InputError(f"{len(points)} points leave no room around them in the cube", "are they points of a surface?")
    unknown = np.column_stack([free, np.full(len(free), np.nan), np.zeros_like(free)])
    return np.concatenate([_surface(points, normals, N // 2, rng), unknown])


def free_and_surface(
    points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Half on the surface, a quarter near it, a quarter anywhere in the cube, with distances to the surface.

    The nearest points say how far it is, and the nearest eight together on which side.
    """
    surface = _surface(points, normals, N // 2, rng)
    near = rng.choice(len(points), N // 4, replace=len(points) < N // 4)
    beside = np.clip(points[near] + _NEAR * rng.standard_normal((N // 4, 3)), -1, 1)
    free = np.concatenate([beside, rng.uniform(-1, 1, (N // 4, 3))])
    far, index = cKDTree(points).query(free, min(8, len(points)))
    height = ((free[:, None] - points[index]) * normals[index]).sum(2)
    spacing = np.median(far[:, -1] - far[:, 0])
    length = np.where(far[:, 0] < spacing, np.minimum(np.abs(height[:, 0]), far[:, 0]), far[:, 0])
    sdf = np.where(height.sum(1) < 0, -length, length)
    return np.concatenate([surface, np.column_stack([free, sdf, np.zeros_like(free)])])
