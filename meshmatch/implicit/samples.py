"""Training samples of implicit models: points of shapes with normals and signed distances, where known.

Watertight meshes give both. Clouds give normals only (estimated for point files, exact in `.npz` files with ``normals``).
`.npz` files with ``points`` and ``distances`` give signed distances, negative inside. Each shape is centred and scaled by
its bounding box into the cube from -1 to 1, without a rotation.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from meshmatch.arrays import Float, Floats, Floats32, ShortRepr
from meshmatch.errors import InputError
from meshmatch.geometry.frames import Frame
from meshmatch.geometry.trees import cKDTree
from meshmatch.geometry.triangles import is_watertight
from meshmatch.shapes.files import PLAIN_SUFFIXES, load_shape
from meshmatch.shapes.input_files import check_input_file, read_npz, suffix_of
from meshmatch.shapes.sampling import sample_surface
from meshmatch.shapes.shape import Shape

FILLED = 0.85
"""Half the longest side of a shape's box, in the cube of half side 1."""
FAR = 0.05
"""Distance from the surface, in the cube, beyond which a predicted distance of 0 is an error."""
ARRAYS = ("points", "distances", "normals")
# surface points per mesh; maximum numbers of samples, per shape and per folder
_N_SURFACE, _MAX_PER_SHAPE, _MAX_TOTAL = 40_000, 16_384, 40_000_000
_MAX_NUMBER = 1e100  # bound on numbers in files; its square is finite
_MAX_CUBE_NUMBER = 1e30  # bound on numbers in the cube; a float32
_NEAR_DEVIATION = 0.05  # standard deviation of sample points near the surface
_SUFFIXES = {*PLAIN_SUFFIXES, ".npz"} - {".npy"}  # .npy files in a folder of shapes are labels or landmarks


@dataclass(frozen=True, eq=False, repr=False)
class ImplicitSamples(ShortRepr):
    """N samples of each of S shapes in the cube; the first half is on the surface, or nearest to it.

    A row is a point, its signed distance (NaN if it is only known to be off the surface), and its normal (0 if not known).
    """

    names: tuple[str, ...]
    frames: tuple[Frame, ...]  # from each file into the cube
    rows: Float[Floats32, "S N 7"]


def read_implicit_samples(folder: str | Path, seed: int = 0) -> ImplicitSamples:
    """Sample all shapes of a folder, reproducibly for a seed.

    `InputError` if there are fewer than two shapes, or one cannot be read or has no inside, such as a mesh with holes.
    """
    files = sorted(file for file in Path(folder).glob("*") if suffix_of(file) in _SUFFIXES)
    names = tuple(file.stem for file in files)
    if len(files) < 2 or len(set(names)) < len(names):
        hint = f"give a folder of watertight meshes, clouds or .npz ({', '.join(sorted(_SUFFIXES))}), each once"
        raise InputError(f"{folder} has {len(set(names))} shapes of different names; two are needed", hint)
    N = int(np.clip(_MAX_TOTAL // len(files), 1024, _MAX_PER_SHAPE)) // 4 * 4
    found = [sample_shape(file, N, np.random.default_rng([seed, number])) for number, file in enumerate(files)]
    frames, rows = zip(*found, strict=True)
    return ImplicitSamples(names, frames, np.stack(rows))


@dataclass(frozen=True, eq=False, repr=False)
class SampledShape(Shape):
    """The points of an ``.npz`` file as a cloud, in their order, with either distances or unit normals."""

    distances: Float[Floats, " N"] = field(kw_only=True)
    normals: Float[Floats, "N 3"] = field(kw_only=True)


def load_source(file: str | Path) -> Shape:
    """Read the shape in a file; a `SampledShape` from an ``.npz`` file."""
    if Path(file).suffix.lower() != ".npz":
        return load_shape(file)
    points, distances, normals = _read_samples(Path(file))
    return SampledShape(points, np.empty((0, 3), np.int64), Path(file).name, distances=distances, normals=normals)


def sample_shape(
    source: Shape | str | Path, N: int, rng: np.random.Generator, closed: bool = True
) -> tuple[Frame, Float[Floats32, "N 7"]]:
    """Return the frame of a shape or a file, and ``N`` samples (a multiple of 4) as in `ImplicitSamples`.

    Without ``closed``, a mesh with holes is treated as a cloud with normals. `InputError` as `read_implicit_samples`.
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
        count = shape.V if shape.is_cloud else _N_SURFACE
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
    if not all((np.abs(each) < _MAX_CUBE_NUMBER).all() for each in (points, distances)):
        raise InputError(f"{shape.name or 'the shape'} has points far beyond the shape", "leave these points out")
    if len(distances):
        rows = _nearer_first(points, distances, N, rng)
    else:
        rows = free_and_surface(points, normals, N, rng) if solid else off_surface(points, normals, N, rng)
    return frame, rows.astype(np.float32)


def _read_samples(file: Path) -> tuple[Floats, Floats, Floats]:
    """Read points, and either distances or normals; the other array is empty."""
    arrays = read_npz(check_input_file(file), ARRAYS)
    points, distances, normals = (np.asarray(arrays.get(name, ())) for name in ARRAYS)
    matching = distances.shape == points.shape[:1] or normals.shape == points.shape
    if not (points.ndim == 2 and points.shape[1] == 3 and matching and len(points)):
        what = f"{file.name} needs points (N, 3), and distances (N,) or normals (N, 3)"
        raise InputError(what, "see docs/formats.md")
    found = (points, distances, normals)
    if any(each.dtype.kind not in "fiu" or not (np.abs(each.astype(np.float64)) < _MAX_NUMBER).all() for each in found):
        raise InputError(f"{file.name} holds numbers that are not finite, or huge", "leave these points out")
    points, distances, normals = (each.astype(np.float64) for each in found)
    if not len(distances):
        normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return points, distances, normals


def _nearer_first(
    points: Float[Floats, "P 3"], distances: Float[Floats, " P"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Draw N of given samples: half from the quarter that is nearest to the surface, half from all in the cube."""
    kept = np.flatnonzero((np.abs(points) <= 1).all(1))
    near = kept[np.argsort(np.abs(distances[kept]), kind="stable")[: max(1, len(kept) // 4)]]
    rows = np.concatenate([rng.choice(near, N // 2), rng.choice(kept, N // 2)])
    return np.column_stack([points[rows], distances[rows], np.zeros((N, 3))])


def _surface_rows(points: Floats, normals: Floats, count: int, rng: np.random.Generator) -> Float[Floats, "N 7"]:
    on = rng.choice(len(points), count, replace=len(points) < count)
    return np.column_stack([points[on], np.zeros(count), normals[on]])


def off_surface(
    points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Draw N samples: half on the surface, half in the cube away from it, whose distances are unknown (NaN)."""
    free = rng.uniform(-1, 1, (8 * N, 3))
    free = free[cKDTree(points).query(free, distance_upper_bound=FAR)[0] > FAR][: N // 2]
    if len(free) < N // 2:
        raise InputError(f"{len(points)} points leave no room around them in the cube", "are they points of a surface?")
    free_rows = np.column_stack([free, np.full(len(free), np.nan), np.zeros_like(free)])
    return np.concatenate([_surface_rows(points, normals, N // 2, rng), free_rows])


def free_and_surface(
    points: Float[Floats, "P 3"], normals: Float[Floats, "P 3"], N: int, rng: np.random.Generator
) -> Float[Floats, "N 7"]:
    """Draw N samples: half on the surface, a quarter near it, a quarter in the whole cube, with signed distances.

    The nearest surface point gives the distance; the nearest eight together give the sign.
    """
    surface = _surface_rows(points, normals, N // 2, rng)
    near = rng.choice(len(points), N // 4, replace=len(points) < N // 4)
    near_points = np.clip(points[near] + _NEAR_DEVIATION * rng.standard_normal((N // 4, 3)), -1, 1)
    free = np.concatenate([near_points, rng.uniform(-1, 1, (N // 4, 3))])
    far, index = cKDTree(points).query(free, min(8, len(points)))
    height = ((free[:, None] - points[index]) * normals[index]).sum(2)
    spacing = np.median(far[:, -1] - far[:, 0])
    length = np.where(far[:, 0] < spacing, np.minimum(np.abs(height[:, 0]), far[:, 0]), far[:, 0])
    sdf = np.where(height.sum(1) < 0, -length, length)
    return np.concatenate([surface, np.column_stack([free, sdf, np.zeros_like(free)])])
